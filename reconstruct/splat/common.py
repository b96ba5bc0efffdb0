"""Settings that both kinds of splat fits have: what is known of the beam, and how long a fit may take."""

import math
from typing import Annotated

from ctsim.reconstruct.beam import AssumedDetector, TubeTable, check_tables
from ctsim.reconstruct.primary import Readings
from ctsim.reconstruct.settings import about

Energy = Annotated[float, about("", "keV", gt=0, le=1000)]
Seconds = Annotated[
    float,
    about("time limit of the fit, which then returns its current volume; counts on after an interruption", "s", ge=0),
]


class Common(Readings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Scatter, what is known of the tube (for the response "known") and the detector, and how long a fit may take."""

    tube: TubeTable = None
    detector: AssumedDetector = None
    seconds: Seconds = math.inf
    checkpoints: Annotated[
        str, about("folder for the state of an unfinished fit, saved each minute; the next run continues from it")
    ] = ""

    def __post_init__(self) -> None:
        check_tables(self.tube, self.detector)
