"""What the networks see of a scan: FDK, LIMAR, NMAR and the metal mask, in units of the scan's water.

The unit is water as FDK shows it (`ctsim.baselines.metal.water_value`), so that a network that was trained at one tube
voltage meets the same numbers at another. Volumes [z, y, x].
"""

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.baselines.limar import Bridging, interpolated
from ctsim.baselines.metal import Metal, Trace, find_metal, reinsert, water_value
from ctsim.baselines.nmar import Normalise, normalised
from ctsim.baselines.prior import choose_prior
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.filters import Filter
from ctsim.types import Scan, Status, Volume

LOWEST, HIGHEST = -2.0, 8.0  # multiples of water; what lies beyond is cut off for the networks
SOURCES = ("fdk", "limar", "nmar")
Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """FDK of a scan as it is, `sources` by name (FDK, LIMAR, NMAR) in 1/mm, the metal, and water in 1/mm.

    Without metal, and where the mask is not to be relied on, all sources are FDK. `metal` is None where nobody asked
    for it. `water` is 0 where nothing stands out from air.
    """

    first: Volume
    sources: dict[str, Array]
    metal: Metal | None
    water: float
    view_updates: int

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Return where metal is, as far as it can be relied on."""
        if self.metal is None or not self.metal.found:
            return np.zeros(self.first.values.shape, np.bool_)
        return self.metal.mask

    def scaled(self, name: str) -> Array:
        """Return a source in multiples of water, cut off at −2 and 8."""
        return np.clip(self.sources[name] / np.float32(self.water), LOWEST, HIGHEST)

    def details(self) -> dict[str, object]:
        """Return what a result says of them."""
        found = {} if self.metal is None else self.metal.details() | {"corrected": self.metal.found}
        return self.first.details | found | {"water_per_mm": self.water, "view_updates": self.view_updates}


def blind(scan: Scan, by: Filter) -> Inputs:
    """Return what a network sees that is told no metal: FDK with the filter `by`."""
    first = fdk(scan, window=by.window, cutoff=by.cutoff)
    values = first.values.numpy()
    water = water_value(values) if first.status is Status.OK else 0.0
    return Inputs(first=first, sources={"fdk": values}, metal=None, water=water, view_updates=scan.geometry.n_views)


def told(scan: Scan, settings: Bridging, names: tuple[str, ...] = SOURCES) -> Inputs:
    """Return the sources `names` of a scan, each the same to the last bit as that method's volume with these settings.

    FDK, mask and trace are shared. Raises InputError as `ctsim.baselines.metal.find_metal` and FDK do.
    """
    plain = blind(scan, settings)
    x_0 = plain.sources["fdk"]
    metal = find_metal(scan, x_0, settings.mask)
    sources, updates = dict.fromkeys(names, x_0), scan.geometry.n_views
    if plain.first.status is Status.OK and metal.found and plain.water > 0:
        trace = Trace(metal, scan, settings.dilation)
        if "limar" in names:
            sources["limar"] = _limar(trace, plain.first, metal, settings)
            updates += scan.geometry.n_views
        if "nmar" in names:
            sources["nmar"] = _nmar(trace, plain.first, metal, settings)
            updates += 2 * scan.geometry.n_views
    return Inputs(first=plain.first, sources=sources, metal=metal, water=plain.water, view_updates=updates)


def _limar(trace: Trace, first: Volume, metal: Metal, settings: Bridging) -> Array:
    """Return what `ctsim.baselines.limar.reconstruct` does."""
    values, _ = interpolated(trace, first.values, settings.interpolation, settings)
    reinsert(values, first.values.numpy(), metal, settings.insert)
    return values.numpy()


def _nmar(trace: Trace, first: Volume, metal: Metal, settings: Bridging) -> Array:
    """Return what `ctsim.baselines.nmar.reconstruct` does with its own defaults; FDK where it finds no body."""
    choice = choose_prior(trace, metal, first.values, settings, "auto", settings.interpolation)
    if choice is None:
        return first.values.numpy()
    bridge = functools.partial(Normalise().fill, largest=choice.largest, how=settings.interpolation)
    values, _ = normalised(trace, first.values, choice.columns, bridge, settings)
    reinsert(values, first.values.numpy(), metal, settings.insert)
    return values.numpy()
