"""Scans without their scatter, lag and glare, for methods that have no model of them.

The scatter is taken off the counts before a method looks at them. Where next to nothing would remain a share of the
reading is kept, as the logarithm of what noise leaves there would be wild; Siewerdsen et al., Med. Phys. 33, 2006,
doi:10.1118/1.2148916, limit it for the same reason.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Annotated, Literal, TypeVar

import msgspec
import numpy as np
import torch

from ctsim.reconstruct.log import LineIntegrals, count_floor
from ctsim.reconstruct.panel import Panel, panel_of, without_panel
from ctsim.reconstruct.scatter import Scatter, scatter_of
from ctsim.reconstruct.settings import about
from ctsim.types import Scan, Volume

KEPT = 0.1  # of a reading, at least


Excess = Annotated[float, msgspec.Meta(ge=0, le=100)]
Scattered = Annotated[
    Literal["found"] | Excess, about("scatter in every reading; found: by the open pixels", "of the open field")
]


PanelLight = Annotated[Literal["ideal", "found"], about("lag and glare of the panel: none; found: by the open pixels")]


class Readings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is taken off the readings of a scan before a method sees them: lag and glare of its `panel`, and `scatter`.

    "found" is what `ctsim.reconstruct.panel.panel_of` and `ctsim.reconstruct.scatter.scatter_of` find in the scan,
    scatter with its course over the panel; a number is the same everywhere, and 0 none.
    """

    panel: PanelLight = "ideal"
    scatter: Scattered = 0.0


S = TypeVar("S", bound=Readings)


def panel_in(scan: Scan, panel: Literal["ideal", "found"]) -> Panel:
    """Return lag and glare that a setting stands for: none, or what is found in the scan."""
    return panel_of(scan) if panel == "found" else Panel()


def scatter_in(scan: Scan, scattered: Literal["found"] | float) -> Scatter:
    """Return the scatter that a setting stands for: what is found in the scan, or a constant over the open field."""
    if scattered != "found":
        return Scatter(floor=float(scattered))
    p, clamped = LineIntegrals(scan).of(slice(None))
    return scatter_of(p, np.logical_not(clamped, out=clamped), scan.geometry, scan.i0)


def without_scatter(scan: Scan, scatter: Scatter) -> Scan:
    """Return the scan with scatter taken off its counts, which are then float32; itself where there is none.

    At least a tenth of each reading is kept, and the floor of the logarithm; what was below it stays. Noise stays what
    it was.
    """
    if scatter.mean == 0:
        return scan
    open_field, dark = scan.flat.numpy() - np.float32(scan.dark), np.float32(scan.dark)
    counts, floor = scan.counts.numpy().astype(np.float32), count_floor(scan)
    least = np.float32(1.01 * floor)  # above the floor: a reading that was seen is seen
    for view, image in enumerate(counts):
        signal = image - dark
        with np.errstate(invalid="ignore"):  # of infinite readings
            room = np.maximum(signal - np.maximum(np.float32(KEPT) * signal, least), 0)
        image -= np.minimum(scatter.of(view, image.shape) * open_field, room)
    return dataclasses.replace(scan, counts=torch.from_numpy(counts), floor=floor)


def primary(function: Callable[[Scan, S], Volume]) -> Callable[[Scan, S], Volume]:
    """Hand a method of a scan and settings the scan without the lag, glare and scatter that its settings tell.

    Details of the volume hold the parts of lag and glare, and the scatter's mean, gain and constant, as those of splats
    do. At least a tenth of each reading is kept from glare, too.
    """

    @functools.wraps(function)
    def method(scan: Scan, settings: S) -> Volume:
        panel = panel_in(scan, settings.panel)
        scan, details = without_panel(scan, panel, KEPT), panel.details() if settings.panel == "found" else {}
        if settings.scatter != 0:
            scatter = scatter_in(scan, settings.scatter)
            scan, details = without_scatter(scan, scatter), details | scatter.details()
        volume = function(scan, settings)
        return dataclasses.replace(volume, details=volume.details | details)

    return method
