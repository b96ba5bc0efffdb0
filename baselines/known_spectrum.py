"""Beam-hardening correction with a known spectrum: of water by a table, of water, bone and metal by iteration.

Joseph and Spital, J. Comput. Assist. Tomogr. 2, 1978, doi:10.1097/00004728-197801000-00017: the volume says how long
a ray is in which material, the spectrum by how much its P falls short of a straight line. Projections [view, v, u],
volumes [z, y, x] in 1/mm, lengths in mm.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Self

import msgspec
import numpy as np
import scipy.ndimage
import torch
from numpy.typing import NDArray

from ctsim.baselines.kernels.excess_cpu import add_excess
from ctsim.baselines.metal import auto_mask, water_value
from ctsim.baselines.prior import BONE, LUNG
from ctsim.beam.quadrature import effective_weights, energy_rule, full_rule
from ctsim.beam.spectrum import Spectrum, Tube, spectrum
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.geometry import few_views
from ctsim.materials import attenuation, material
from ctsim.reconstruct.beam import DetectorTable, Given, TubeTable, check_tables, known_detector, known_tube
from ctsim.reconstruct.fdk import fdk_stream
from ctsim.reconstruct.filters import Filter
from ctsim.reconstruct.log import count_floor, how_it_ended, is_blind, line_integrals
from ctsim.reconstruct.primary import primary
from ctsim.reconstruct.projector import forward_columns
from ctsim.reconstruct.redundancy import ray_weights
from ctsim.reconstruct.settings import about, keywords
from ctsim.types import Scan, Volume

P_TOP, NODES = 30.0, 2048  # of the table of water; beyond it goes on straight
L0_VIEWS, SEEN = 8, 0.05  # views, and the least P, that the median path is taken from
Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """P of water, `poly` [n] ascending from 0, for `lengths` [n] (mm); `water` is its effective μ (1/mm)."""

    poly: NDArray[np.float64]
    lengths: NDArray[np.float64]
    water: float


def precorrect(p: Array, table: Table) -> Array:
    """Map line integrals of any shape as if all the object were water; beyond the table's ends it goes on straight.

    Strictly monotone, so that nothing is lost; a pre-step for any method that takes line integrals.
    """
    poly, mono = table.poly, table.water * table.lengths
    out = np.interp(p, poly, mono)
    below, above = p < poly[0], p > poly[-1]
    out[below] = p[below] * (mono[1] / poly[1])
    out[above] = mono[-1] + (p[above] - poly[-1]) * (mono[-1] - mono[-2]) / (poly[-1] - poly[-2])
    return out.astype(np.float32)


@dataclass(frozen=True, slots=True, kw_only=True)
class Beam:
    """A known tube and detector, and the effective spectrum behind the scan's median water path `l0` (mm)."""

    tube: Tube
    detector: Detector
    spectrum: Spectrum
    l0: float

    @classmethod
    def of(cls, scan: Scan, tube: Given | Tube, detector: Given | Detector) -> Self:
        """Take what is given; what is left out is the simulator's default, kVp from the scan's highest energy.

        Raises InputError for keys and values that Tube and Detector refuse, and for a bow-tie, behind which every
        pixel has a spectrum of its own.
        """
        known, sees = known_tube(tube, scan.e_max), known_detector(detector)
        beam = cls(tube=known, detector=sees, spectrum=spectrum(known), l0=0.0)
        return cls(tube=known, detector=sees, spectrum=beam.spectrum, l0=_median_path(scan, beam.table()))

    def effective(self, which: str) -> float:
        """μ (1/mm) of a material at the effective spectrum."""
        energies, weights = effective_weights(self.spectrum, self.detector, self.l0)
        return float(attenuation(which, energies) @ weights)

    def table(self) -> Table:
        """Return the table of water."""
        rule = full_rule(self.spectrum, self.detector)
        mu = attenuation("water", rule.energies)
        lengths = P_TOP / mu.min() * np.linspace(0, 1, NODES) ** 2  # the curve bends where it is short
        least = mu.min()
        poly = least * lengths - np.log(np.exp(-np.outer(lengths, mu - least)) @ rule.w1)
        poly[0] = 0.0
        return Table(poly=poly, lengths=lengths, water=self.effective("water"))

    def details(self) -> dict[str, object]:
        """Return what a result says of its spectrum."""
        return {
            "tube": msgspec.to_builtins(self.tube),
            "detector": msgspec.to_builtins(self.detector),
            "water_path_mm": self.l0,
            "water_per_mm": self.effective("water"),
        }


def _median_path(scan: Scan, table: Table) -> float:
    """Return the median length in water (mm) that P says, of the rays that meet anything, in a few views."""
    views = few_views(scan.geometry.n_views, L0_VIEWS)
    p = np.concatenate([line_integrals(scan, int(k))[0].numpy().ravel() for k in views])
    met = p[p > SEEN]
    return float(np.interp(np.median(met), table.poly, table.lengths)) if met.size else 0.0


class Known(Filter, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The filter, and what is known of the spectrum: a scan does not carry it."""

    tube: TubeTable = None
    detector: DetectorTable = None

    def __post_init__(self) -> None:
        check_tables(self.tube, self.detector)


@keywords(Known)
@primary
def water_precorrection(scan: Scan, settings: Known) -> Volume:
    """Reconstruct `scan` by FDK of line integrals that a table for water made linear in its length.

    The scale is that of the effective spectrum. Keywords are those of `Known`. Exact for water alone; near metal the
    streaks become worse. Raises InputError as `Beam.of` and FDK do.
    """
    beam = Beam.of(scan, settings.tube, settings.detector)
    table = beam.table()
    return _ended(*_changed(scan, lambda p, _: precorrect(p, table), settings), scan, beam, 1, {})


class Ibhc(Known, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is known, and of what the object is."""

    iterations: Annotated[int, about("corrections after the water correction", ge=1, le=50)] = 3
    bone: Annotated[str, about("material of voxels denser than water")] = "cortical_bone"
    metal: Annotated[str, about("material in the automatic metal mask; empty: metal is treated as bone")] = ""

    def __post_init__(self) -> None:
        Known.__post_init__(self)
        for key, which in (("bone", self.bone), ("metal", self.metal)):
            if which or key == "bone":
                _material(key, which)


@keywords(Ibhc)
@primary
def ibhc(scan: Scan, settings: Ibhc) -> Volume:
    """Reconstruct `scan` and repeat, each time with P + mono − poly of the water, bone and metal found in the volume.

    Keywords are those of `Ibhc`. It begins with the volume of `water_precorrection`. Voxels from 1.5 times water on are
    `bone` of the density that gives their value, less dense ones water. poly is −ln of the signal behind the three
    lengths, mono their sum at the effective spectrum. Raises InputError as `water_precorrection` does. Al gains; rods
    of iron, whose streaks are not of hardening alone, do not.
    """
    bone, metal = settings.bone, settings.metal
    beam = Beam.of(scan, settings.tube, settings.detector)
    table = beam.table()
    values, clamped = _changed(scan, lambda p, _: precorrect(p, table), settings)
    found = auto_mask(values.numpy()) if metal else None
    names = ("water", bone, metal) if found is not None and found.found else ("water", bone)
    longest = math.hypot(*(n * d for n, d in zip(scan.geometry.n_voxel, scan.geometry.d_voxel, strict=True)))
    rule = energy_rule(beam.spectrum, beam.detector, names, [longest] * len(names))
    mu = np.stack([attenuation(name, rule.energies) for name in names])
    mono = np.array([beam.effective(name) for name in names])
    runs, mask = 1, found.mask if found is not None and found.found else None
    while runs <= settings.iterations and (water := water_value(values.numpy())) > 0:
        columns = _classes(values.numpy(), water, mask, mono)

        def change(p: Array, views: slice, columns: list[Array] = columns) -> Array:
            lengths = np.stack([forward_columns(c, scan.geometry, views) for c in columns])
            add_excess(p.reshape(-1), lengths.reshape(len(columns), -1), mu, rule.w1, mono)
            return p

        values, clamped = _changed(scan, change, settings)
        runs += 1
    more = {"materials": names} | (found.details() if found is not None else {})
    return _ended(values, clamped, scan, beam, runs, more)


def _classes(volume: Array, water: float, metal: NDArray[np.bool_] | None, mono: NDArray[np.float64]) -> list[Array]:
    """Split a volume [z, y, x] into densities of water, bone and metal relative to their nominal ones, [y, x, z].

    The volume smoothed by a voxel decides on the class; what is below 0.15 of water counts as air.
    """
    smooth = scipy.ndimage.gaussian_filter(volume, 1.0)
    dense = smooth >= BONE * water
    light = (smooth >= LUNG * water) & ~dense
    parts = [light, dense]
    if metal is not None:
        parts = [light & ~metal, dense & ~metal, metal]
    positive = np.maximum(volume, 0)
    return [
        np.ascontiguousarray(np.where(part, positive, 0).transpose(1, 2, 0) / np.float32(m), np.float32)
        for part, m in zip(parts, mono, strict=True)
    ]


def _material(key: str, which: str) -> None:
    try:
        material(which)
    except InputError as error:
        raise InputError(f"{key}: {error}") from None


def _changed(scan: Scan, change: Callable[[Array, slice], Array], by: Filter) -> tuple[torch.Tensor, int]:
    """Return FDK of line integrals that `change` may alter a few views at a time, and the number of clamped pixels."""
    clamped = 0

    def read(views: slice) -> Array:
        nonlocal clamped
        p, mask = line_integrals(scan, views)
        clamped += int(mask.sum())
        return change(p.numpy(), views)

    return fdk_stream(read, scan.geometry, window=by.window, cutoff=by.cutoff), clamped


def _ended(values: torch.Tensor, clamped: int, scan: Scan, beam: Beam, runs: int, more: dict[str, object]) -> Volume:
    """Wrap a volume that was reconstructed with a known spectrum."""
    weights, (status, reason) = ray_weights(scan.geometry), how_it_ended(values, scan, clamped)
    details = (
        beam.details()
        | more
        | {
            "view_updates": runs * scan.geometry.n_views,
            "clamped_pixels": clamped,
            "count_floor": count_floor(scan),
            "rays": weights.kind,
            "field_of_view_mm": weights.radius,
        }
    )
    return Volume(
        values=torch.zeros_like(values) if is_blind(scan, clamped) else values,
        status=status,
        reason=reason,
        details=details | ({"limitation": weights.note} if weights.note else {}),
    )
