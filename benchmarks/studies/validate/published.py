"""Materials, spectra and half-value layers against the published numbers of `published.toml`."""

import functools
import math
from importlib import resources
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim import materials
from ctsim.beam.spectrum import Filter, Tube, spectrum
from ctsim.benchmarks.studies.validate.finding import Check, Curves, check

DIGITS = 5e-4  # half a unit of the last of four digits, at most
BINS = 0.9e-2  # SpekPy's HVL1 at 90 kVp and 0.5 mm Al: from 1.0157 (bins of 0.5 keV) to 1.0067 mm (0.05 keV)


class Nist(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Table values at `energies` (keV), by material, in cm²/g."""

    source: str
    energies: tuple[float, ...]
    attenuation: dict[str, tuple[float, ...]]
    absorption: dict[str, tuple[float, ...]]


class SpekPyTube(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A spectrum by SpekPy, in bins of `bin_kev`."""

    kvp: float
    filter: str
    mm: float
    bin_kev: float
    mean: float
    hvl1: float
    hvl2: float | None = None
    fluence: float | None = None


class SpekPy(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Spectra by SpekPy."""

    source: str
    tube: tuple[SpekPyTube, ...]


class Layer(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Primary air kerma without aluminium and behind `mm` of it."""

    kev: float
    mm: tuple[float, float]
    kerma: tuple[float, float, float]


class Radiography(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Energy absorbed in the body and in nine cubes, eV per photon."""

    body: float
    cubes: tuple[float, ...]


class Tomography(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Energy absorbed in four slices, eV per photon, of a narrow and a wide beam."""

    narrow: tuple[float, ...]
    wide: tuple[float, ...]


class TG195(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Cases of the report."""

    source: str
    soft_tissue: str
    pmma: str
    layer: tuple[Layer, ...]
    radiography: Radiography
    tomography: Tomography


class Paper(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The paper's validation."""

    source: str
    psnr: float


class Published(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All of `published.toml`."""

    nist: Nist
    spekpy: SpekPy
    tg195: TG195
    paper: Paper


@functools.cache
def numbers() -> Published:
    """Return the published numbers."""
    text = resources.files("ctsim.benchmarks.studies.validate").joinpath("published.toml").read_bytes()
    return msgspec.toml.decode(text, type=Published)


def attenuation(short: bool) -> list[Check]:
    """Compare μ/ρ with NIST."""
    nist = numbers().nist
    # NIST prints four digits, and xraylib's tables come from four-digit tables as well
    why = "four digits in either table"
    return [
        _worst(f"μ/ρ, {name}", materials.mass_attenuation(name, nist.energies), values, 2 * DIGITS, why)
        for name, values in nist.attenuation.items()
    ]


def absorption(short: bool) -> list[Check]:
    """Compare the energy transferred with NIST's energy absorbed."""
    nist = numbers().nist
    # the tables' standard uncertainty is 1.6 % up to 100 kV (Andreo et al., Phys. Med. Biol. 57, 2117, 2012);
    # bremsstrahlung, which only μ_en leaves out, is below 0.2 % for light elements at 150 keV
    why = "digits as for μ/ρ, and bremsstrahlung, which μ_en leaves out"
    return [
        _worst(f"μ_tr/ρ, {name}", materials.mass_energy_transfer(name, nist.energies), values, 3e-3, why)
        for name, values in nist.absorption.items()
    ]


def _worst(what: str, ours: NDArray[np.float64], values: tuple[float, ...], tolerance: float, why: str) -> Check:
    """Return the check at the energy with the largest relative difference, with the curve over all energies."""
    nist = numbers().nist
    off = ours / np.array(values) - 1
    k = int(np.argmax(abs(off)))
    curve = Curves(
        title="", across="keV", up="difference (%)", x=nist.energies, lines={what: tuple((100 * off).tolist())}
    )
    quantity = f"{what}, {nist.energies[k]:g} keV"
    more: dict[str, Any] = {
        "unit": "cm²/g",
        "tolerance": tolerance,
        "why": why,
        "source": nist.source,
        "curves": (curve,),
    }
    return check(quantity, ours[k], values[k], **more)


def spectra(short: bool) -> list[Check]:
    """Compare mean energies, half-value layers and fluences with SpekPy."""
    found = []
    for theirs in numbers().spekpy.tube:
        tube = Tube(kvp=theirs.kvp, filters=(Filter(material=theirs.filter, thickness=theirs.mm),))
        ours = spectrum(tube)
        what = f"{theirs.kvp:g} kVp, {theirs.mm:g} mm {theirs.filter}"
        source = f"{numbers().spekpy.source}, bins of {theirs.bin_kev:g} keV"
        # between the table's nodes 0.37 % in HVL1, 0.13 % in the mean, 0.2 % in fluence; xraylib against SpekPy's
        # attenuation 0.4 % in a HVL of aluminium, as much once more for a copper filter (docs/explanation/physics.md)
        copper = 0.4e-2 if theirs.filter == "Cu" else 0.0
        bins = BINS if theirs.bin_kev > 0.1 else 0.0
        layers = 0.37e-2 + 0.4e-2 + copper + bins
        how = "interpolation 0.37 %, attenuation 0.4 %" + ", copper 0.4 %" * bool(copper) + ", bins 0.9 %" * bool(bins)
        dose = "interpolation 0.2 %, attenuation 0.4 %"
        rows = [
            ("mean", "keV", ours.mean, theirs.mean, 2e-3, "interpolation 0.13 %, bins 0.05 %"),
            ("HVL1", "mm Al", ours.hvl(), theirs.hvl1, layers, how),
            ("HVL2", "mm Al", ours.hvl(order=2), theirs.hvl2, layers, how),
            ("fluence", "1/cm²", ours.fluence or math.nan, theirs.fluence, 6e-3, dose),
        ]  # fmt: skip
        found += [
            check(f"{name}, {what}", value, other, unit=unit, tolerance=tolerance, why=why, source=source)
            for name, unit, value, other, tolerance, why in rows
            if other is not None
        ]
    return found


def layers(short: bool) -> list[Check]:
    """Compare the transmission through half- and quarter-value layers with TG-195, case 1, at one energy."""
    found = []
    for layer in numbers().tg195.layer:
        mu = materials.attenuation("Al", [layer.kev])[0]
        for thickness, kerma in zip(layer.mm, layer.kerma[1:], strict=True):
            # digits of both kermas and of the thickness, and what μ may be off by
            digits = _half_unit(kerma) / kerma + _half_unit(layer.kerma[0]) / layer.kerma[0]
            tolerance = digits + mu * _half_unit(layer.mm[0]) + 2 * DIGITS * mu * thickness
            what = f"transmission, {layer.kev:g} keV, {thickness:g} mm Al"
            why = "digits of kerma and thickness, and of μ"
            more: dict[str, Any] = {"tolerance": tolerance, "why": why, "source": f"{numbers().tg195.source}, case 1"}
            found.append(check(what, math.exp(-mu * thickness), kerma / layer.kerma[0], **more))
    return found


def _half_unit(value: float) -> float:
    """Return half a unit of the fourth digit of a number."""
    return 0.5 * 10.0 ** (math.floor(math.log10(value)) - 3)
