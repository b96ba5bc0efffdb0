"""X-ray tubes: which photons reach the object.

Energies are keV, thicknesses mm. A spectrum is the photon share per energy bin, after the tube's filters
and without air; the bow-tie is not in it, because it is one more chord per ray.
"""

import functools
import importlib.util
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ctsim.beam import anode
from ctsim.beam.spot import FocalSpot, OffFocal
from ctsim.errors import InputError
from ctsim.materials import E_MIN, attenuation, mass_energy_transfer, material

TABLE_KVP = (20.0, 300.0)
_TABLE_ANGLE_DEG = (1.0, 40.0)
_MGY_PER_KEV_PER_G = 1.602176634e-10
_NEGLIGIBLE = 1e-12  # bins with less than this share of the largest are cut off at the soft end


def _check_material(name: str) -> None:
    try:
        material(name)
    except InputError as error:
        raise InputError(f"material: {error}") from None


class Filter(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A sheet in front of the tube."""

    material: str
    """Its material."""
    thickness: float
    """Its thickness in mm."""

    def __post_init__(self) -> None:
        _check_material(self.material)
        if not (math.isfinite(self.thickness) and self.thickness >= 0):
            raise InputError(f"thickness must be at least 0 mm for a filter of {self.material!r}, got {self.thickness}")


class Bowtie(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A filter whose thickness grows with the square of the fan angle."""

    material: str = "Al"
    """Its material."""
    center: float
    """Thickness in mm on the central ray."""
    edge: float
    """Thickness in mm at and beyond `half_angle_deg`."""
    half_angle_deg: float
    """The fan angle at which `edge` is reached."""

    def __post_init__(self) -> None:
        _check_material(self.material)
        for name in ("center", "edge"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"bowtie: {name} must be at least 0 mm, got {value}")
        if not 0 < self.half_angle_deg < 90:
            raise InputError(f"bowtie: half_angle_deg must be within (0, 90), got {self.half_angle_deg}")


class Tube(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An X-ray tube with a tungsten anode."""

    kvp: float = 90.0
    """Tube voltage in kV; for the model "mono" the photon energy in keV."""
    anode_deg: float = 11.0
    """Angle of the anode."""
    filters: tuple[Filter, ...] = (Filter(material="Al", thickness=0.5),)
    """Sheets in front of the tube."""
    model: Literal["table", "finkelshtein-pavlova", "spekpy", "mono"] = "table"
    """Bundled SpekPy spectra (20–300 kVp), a closed form (10–500), the installed SpekPy, or one energy."""
    heel: bool = False
    """Include the anode's heel."""
    bowtie: Bowtie | None = None
    """A bow-tie filter."""
    falloff: bool = False
    """Include 1/r² and the slant at which pixels off the centre are hit."""
    focal_spot: FocalSpot | None = None
    """A focal spot of finite size, instead of a point."""
    off_focal: OffFocal | None = None
    """Radiation from around the focal spot."""

    def __post_init__(self) -> None:
        if self.model not in ("table", "finkelshtein-pavlova", "spekpy", "mono"):
            raise InputError(
                f"tube: model must be 'table', 'finkelshtein-pavlova', 'spekpy' or 'mono', got {self.model!r}"
            )
        low, high = (2.0, 500.0) if self.model == "mono" else (10.0, 500.0)
        if self.model != "table" and not low <= self.kvp <= high:  # nor is NaN
            raise InputError(f"tube: kvp must be within [{low:g}, {high:g}] for model {self.model!r}, got {self.kvp}")
        if self.model == "table" and not TABLE_KVP[0] <= self.kvp <= TABLE_KVP[1]:
            raise InputError(
                f"tube: kvp must be within {TABLE_KVP[0]:g} to {TABLE_KVP[1]:g} kVp, as the bundled table is, "
                f"got {self.kvp:g}; model = 'finkelshtein-pavlova' covers 10 to 500"
            )
        low, high = _TABLE_ANGLE_DEG
        if not (math.isfinite(self.anode_deg) and low <= self.anode_deg <= high):
            raise InputError(f"tube: anode_deg must be within [{low:g}, {high:g}], got {self.anode_deg}")

    def sheets(self) -> str:
        """Return the filters in words."""
        return " + ".join(f"{f.thickness:g} mm {f.material}" for f in self.filters) or "no filter"

    def text(self) -> str:
        """Return voltage, filters and a model other than the usual one for people."""
        if self.model == "mono":
            return f"{self.kvp:g} keV"
        model = "" if self.model == "table" else f" ({self.model})"
        return f"{self.kvp:g} kV{model}, {self.sheets()}{'' if self.bowtie is None else ' + bow-tie'}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Spectrum:
    """Photon shares `weights` [n] (sum 1) in bins around `energies` [n] (keV, ascending).

    `fluence` is photons per cm2 at 1 m and mAs behind the filters, None for "mono", which has no mAs.
    """

    energies: NDArray[np.float64]
    weights: NDArray[np.float64]
    fluence: float | None = None

    def __post_init__(self) -> None:
        e, w = self.energies, self.weights
        if e.ndim != 1 or e.shape != w.shape or e.size == 0:
            raise InputError(f"a spectrum needs as many weights as energies, got {w.shape} and {e.shape}")
        if not (np.all(np.isfinite(e)) and np.all(np.diff(e) > 0) and e[0] > 0):
            raise InputError("a spectrum's energies must be positive, finite and ascending")
        if not (np.all(np.isfinite(w)) and w.min() >= 0 and abs(w.sum() - 1) < 1e-9):
            raise InputError("a spectrum's weights must be non-negative and sum to 1")

    @property
    def mean(self) -> float:
        """Mean photon energy (keV)."""
        return float(self.energies @ self.weights)

    @property
    def e_max(self) -> float:
        """Highest photon energy (keV)."""
        return float(self.energies[-1])

    def hvl(self, which: str = "Al", order: int = 1) -> float:
        """Return the `order`-th half-value layer (mm) of a material, in air kerma."""
        mu, kerma = attenuation(which, self.energies), self._kerma_per_bin()
        start = _thickness_to(kerma, mu, 0.5 ** (order - 1))
        return _thickness_to(kerma, mu, 0.5**order) - start

    def kerma(self, passed: NDArray[np.float64] | float = 1.0) -> float:
        """Return the air kerma (mGy) of one photon per cm2, of which the share `passed` [n] is left in each bin."""
        return float(np.sum(self._kerma_per_bin() * passed)) * _MGY_PER_KEV_PER_G

    def _kerma_per_bin(self) -> NDArray[np.float64]:
        return self.weights * self.energies * mass_energy_transfer("air", self.energies)


def _thickness_to(kerma: NDArray[np.float64], mu: NDArray[np.float64], share: float) -> float:
    """Thickness behind which `share` of the kerma is left, by Newton on the log, which is convex."""
    total, thickness = kerma.sum(), 0.0
    for _ in range(60):
        left = kerma * np.exp(-mu * thickness)
        step = math.log(left.sum() / total / share) * left.sum() / float(left @ mu)
        thickness += step
        if abs(step) <= 1e-12 * max(thickness, 1e-12):
            break
    return float(thickness)


@functools.lru_cache(maxsize=64)
def spectrum(tube: Tube) -> Spectrum:
    """Return the tube's spectrum on its central ray, behind its filters; bins of at most 0.25 keV to 100 kVp.

    Raises InputError where model "spekpy" is asked for and not installed, or where filters leave nothing.
    """
    if tube.model == "mono":
        return _frozen(np.array([tube.kvp]), np.ones(1))
    e, photons = _behind_filters(tube, math.radians(tube.anode_deg))
    total = float(photons.sum())
    if not total > 0 or not math.isfinite(total):
        raise InputError(f"tube: the filters {tube.filters} leave no photons at {tube.kvp:g} kVp")
    first = int(np.argmax(photons > _NEGLIGIBLE * photons.max()))
    return _frozen(e[first:], photons[first:] / photons[first:].sum(), total)


def _frozen(e: NDArray[np.float64], w: NDArray[np.float64], fluence: float | None = None) -> Spectrum:
    e.flags.writeable = w.flags.writeable = False
    return Spectrum(energies=e, weights=w, fluence=fluence)


def _behind_filters(tube: Tube, takeoff: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Bin centres (keV) and photons per bin, cm2 at 1 m and mAs at a take-off angle (radians)."""
    n = math.ceil((tube.kvp - E_MIN) / max(0.25, tube.kvp / 400))
    edges = np.linspace(E_MIN, tube.kvp, n + 1)
    e = 0.5 * (edges[1:] + edges[:-1])
    width = edges[1] - edges[0]
    density, line_e, line_photons = _anode(tube, takeoff, e)
    transmitted = density * width * _transmission(tube.filters, e)
    if line_e.size:
        line_photons = line_photons * _transmission(tube.filters, line_e)
        # Shared between the two nearest bins: keeps number and mean energy.
        at = np.clip((line_e - e[0]) / width, 0, n - 1)
        low = np.minimum(at.astype(int), n - 2)
        np.add.at(transmitted, low, line_photons * (1 - (at - low)))
        np.add.at(transmitted, low + 1, line_photons * (at - low))
    return e, transmitted


def _transmission(filters: tuple[Filter, ...], e: NDArray[np.float64]) -> NDArray[np.float64]:
    depth = np.zeros(e.size)
    for f in filters:
        depth += attenuation(f.material, e) * f.thickness
    return np.exp(-depth)


def _anode(
    tube: Tube, takeoff: float, e: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Unfiltered continuum per keV at `e`, and the lines' energies and photons."""
    if tube.model == "finkelshtein-pavlova":
        return anode.continuum(tube.kvp, takeoff, e), *anode.lines(tube.kvp, takeoff)
    if tube.model == "spekpy":
        return _from_spekpy(tube.kvp, takeoff, e), np.zeros(0), np.zeros(0)
    t = _table()
    weights = _node_weights(t, tube.kvp, math.degrees(takeoff))
    log_g = np.sum([w * t["log_continuum"][i, j] for i, j, w in weights], axis=0)
    log_line = np.sum([w * t["log_line"][i, j] for i, j, w in weights], axis=0)
    continuum = np.exp(np.interp(e / tube.kvp, t["u"], log_g)) * (tube.kvp / e - 1)
    continuum *= anode.self_absorption(tube.kvp, takeoff, e)
    on = tube.kvp > t["line_edge"]
    photons = np.exp(log_line[on]) * (tube.kvp / t["line_edge"][on] - 1) ** 1.65
    return continuum, t["line_energy"][on], photons


@functools.lru_cache(maxsize=1)
def _table() -> dict[str, NDArray[np.float64]]:
    with np.load(Path(__file__).with_name("tungsten_spectra.npz"), allow_pickle=False) as file:
        return {name: file[name].astype(np.float64) for name in file.files}


def _node_weights(t: dict[str, NDArray[np.float64]], kvp: float, angle_deg: float) -> list[tuple[int, int, float]]:
    """Bilinear weights in log kVp and log angle: (kVp index, angle index, weight)."""
    by_kvp = _line_weights(np.log(t["kvp"]), math.log(kvp))
    by_angle = _line_weights(np.log(t["angle_deg"]), math.log(angle_deg))
    return [(i, j, v * w) for i, v in by_kvp for j, w in by_angle if v * w > 0]


def _line_weights(grid: NDArray[np.float64], value: float) -> tuple[tuple[int, float], tuple[int, float]]:
    """Weights of the two grid points around `value`, clamped to the grid."""
    at = float(np.interp(value, grid, np.arange(grid.size)))
    low = min(int(at), grid.size - 2)
    return (low, 1 - (at - low)), (low + 1, at - low)


def _from_spekpy(kvp: float, takeoff: float, e: NDArray[np.float64]) -> NDArray[np.float64]:
    if importlib.util.find_spec("spekpy") is None:
        raise InputError("tube: model 'spekpy' needs SpekPy; install the extra: pip install 'ctsim[spekpy]'")
    import spekpy  # pyright: ignore[reportMissingImports]

    tube = spekpy.Spek(
        kvp=kvp, th=math.degrees(takeoff), physics="casim", mu_data_source="nist", dk=e[1] - e[0], mas=1, z=100
    )
    k, flux = tube.get_spectrum()
    return np.interp(e, np.asarray(k), np.asarray(flux))


def heel_factor(tube: Tube, angles_rad: ArrayLike) -> NDArray[np.float64]:
    """Return the energy fluence at emission angles (radians) relative to the central ray; 0 behind the anode.

    The angle lies in the plane of the electron beam and the central ray; negative leans towards the anode,
    so that the take-off angle is anode_deg + angle. Beyond −anode_deg nothing gets out. Hardening along
    the heel is in the intensity, not in the spectrum that the simulator uses.
    """
    angles = np.asarray(angles_rad, dtype=np.float64)
    takeoff = math.radians(tube.anode_deg) + angles
    if tube.model == "mono":
        return np.where(takeoff > 0, 1.0, 0.0)
    nodes, values = _heel_curve(tube)
    inside = np.interp(takeoff, nodes, values)
    return np.where(takeoff > 0, inside, 0.0)


@functools.lru_cache(maxsize=16)
def _heel_curve(tube: Tube) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    low, high = (math.radians(a) for a in _TABLE_ANGLE_DEG)
    nodes = np.geomspace(low, high, 48)
    energy = np.array([float(np.dot(*_behind_filters(tube, a))) for a in nodes])
    center = float(np.dot(*_behind_filters(tube, math.radians(tube.anode_deg))))
    # Below the first node intensity falls to zero with the sine of the take-off angle.
    return np.concatenate([[0.0], nodes]), np.concatenate([[0.0], energy]) / center


def bowtie_thickness(bowtie: Bowtie, fan_angle: ArrayLike) -> NDArray[np.float64]:
    """Return the chord (mm) through the bow-tie at fan angles (radians); constant beyond its half angle."""
    share = np.minimum(np.abs(np.asarray(fan_angle, dtype=np.float64)) / math.radians(bowtie.half_angle_deg), 1.0)
    return bowtie.center + (bowtie.edge - bowtie.center) * share**2
