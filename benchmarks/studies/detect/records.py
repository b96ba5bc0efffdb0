"""What one pair of scans leaves: the responses of the observer's channels, not the volumes."""

import msgspec

from ctsim.benchmarks.engine.record import Found
from ctsim.benchmarks.studies.detect.suite import Group

Rows = tuple[tuple[float, ...], ...]


class Site(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A location: (x, y, z) in mm, its group, the distance of a lesion's surface to metal, the lesion's contrast."""

    at: tuple[float, float, float]
    group: Group
    distance_mm: float
    contrast_hu: float


class Seen(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Responses [location][channel] to one volume: of the channels in a ball, in the central slice, and of the lesion.

    `lesion` [location] is how much of the lesion's true image the volume holds, up to what it holds without a lesion:
    Σ t·v / Σ t², where t is the image in 1/mm on the volume's grid; 0 where there is no lesion.
    """

    ball: Rows
    slice: Rows
    lesion: tuple[float, ...]


class Pair(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One pair of scans by one method. `seconds` has the times of both reconstructions.

    `anatomy` is seen in the method's volume of the scan without metal, lesions and noise.
    """

    inputs: str = ""
    sites: tuple[Site, ...] = ()
    anatomy: Seen | None = None
    present: Seen | None = None
    absent: Seen | None = None
