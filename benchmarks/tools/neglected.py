"""Sizes of effects that the simulator leaves out: `python -m ctsim.benchmarks.tools.neglected [FORM_FACTOR]`.

Prints the table of docs/explanation/physics.md, section "What is not modelled". Each size comes from a closed form, a
quadrature or the scatter Monte Carlo, with the package's own tables. Where a choice is needed, it makes the effect
large. FORM_FACTOR is a text file with the measured molecular form factor of water, x (1/Å) and F/√W in two columns.
EGSnrc distributes that of Peplow and Verghese (1998), Phys. Med. Biol. 43, 2431, as `mff_water.dat`. Without the file
the row of molecular interference is left out.
"""

import math
import sys
from pathlib import Path

import numpy as np
import xraylib as xrl
from numpy.typing import ArrayLike, NDArray

from ctsim.beam.spectrum import Filter, Tube, spectrum
from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.engine.table import simple
from ctsim.detector.response import Detector, response, swank
from ctsim.errors import InputError
from ctsim.materials import attenuation, k_shell, k_vacancies, material
from ctsim.montecarlo.tables import HC, Interactions
from ctsim.montecarlo.transport import Source, scatter_image
from ctsim.montecarlo.world import World, make_blocks
from ctsim.phantoms.scanners import preset
from ctsim.solids import ELLIPSOID, Primitive, Solid
from ctsim.types import Phantom

CORE = preset("ideal", 240, (224, 224), (128, 128, 128), 60.0)  # the scanner of the suite `core`
GOS, CSI = Detector(kind="gos", thickness=0.1), Detector(kind="csi", thickness=0.5)
SOFT = Tube(kvp=90.0, filters=(Filter(material="Al", thickness=0.5),))
HARD = Tube(kvp=120.0, filters=(Filter(material="Al", thickness=2.5),))
PATHS = {"60 mm of water": {"water": 60.0}, "with 5 mm of Fe": {"water": 60.0, "Fe": 5.0}}
_REST, _ATOMIC = 510.998950, 137.035999  # keV; mc in atomic units of momentum
_HISTORIES = 2_000_000
_POSE = np.array([250.0, 0, 0, -250, 0, 0, 0, 120, 0, 0, 0, 120])
_FLAT = 16.0  # 1/Å, beyond the largest momentum transfer of 120 kVp

Share = NDArray[np.float64] | float


def signal(tube: Tube, detector: Detector, paths: dict[str, float], share: Share = 1.0) -> float:
    """Return the mean signal (keV) of a photon behind paths (mm); `share` [n] multiplies the detector's response."""
    beam = spectrum(tube)
    depth = sum((attenuation(m, beam.energies) * t for m, t in paths.items()), np.zeros(beam.energies.size))
    return float((beam.weights * np.exp(-depth) * response(detector, beam.energies)[0] * share).sum())


def shifts(tube: Tube, detector: Detector, share: Share = 1.0) -> list[float]:
    """Return, for each path of PATHS, how P changes from SOFT and the same kind of detector to those given."""
    plain = {"gos": GOS, "csi": CSI}[detector.kind]
    out = []
    for paths in PATHS.values():
        before = signal(SOFT, plain, paths) / signal(SOFT, plain, {})
        after = signal(tube, detector, paths, share) / signal(tube, detector, {}, share)
        out.append(-math.log(after / before))
    return out


def ball(radius: float) -> Phantom:
    """Return a ball of water as a solid in an empty grid."""
    part = Primitive(kind=ELLIPSOID, centre=(0.0, 0.0, 0.0), params=(radius,) * 3)
    solid = Solid(name="ball", material="water", primitives=(part,), metal=False)
    labels = np.zeros((80, 80, 80), np.uint8)
    return Phantom(labels=labels, materials=("air", "water"), d_voxel=(1.0, 1.0, 1.0), solids=(solid,))


def with_form(tables: Interactions, x: NDArray[np.float64], form: NDArray[np.float64]) -> Interactions:
    """Replace the form factor of material 1; `form` [n] is F/√W at `x` [n] (1/Å). The cross-section scales with it."""
    q = tables.d_q * np.arange(tables.form.shape[1])
    squared = np.interp(q, x, form) ** 2
    new = tables.form.copy()
    new[1, 1:] = np.cumsum(0.5 * (squared[1:] + squared[:-1]) * np.diff(q**2))
    energies = 1.0 + 0.1 * np.arange(tables.mu.shape[1])
    totals = [_thomson(energies, q, f) for f in (tables.form[1], new[1])]
    mu = tables.mu.copy()
    mu[1, :, 2] *= totals[1] / totals[0]
    return tables._replace(form=new, mu=mu)


def _thomson(energies: NDArray[np.float64], q: NDArray[np.float64], form: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integrate F²·(1 + cos²θ) over all directions, up to a factor; `form` is the integral of F² over q²."""
    half = np.linspace(0.0, 1.0, 801)  # sin²(θ/2)
    top = energies[:, None] / HC
    steps = np.diff(np.interp(top * np.sqrt(half), q, form), axis=1)
    middle = 0.5 * (half[1:] + half[:-1])
    return (steps * (1 + (1 - 2 * middle) ** 2)).sum(1) / top[:, 0] ** 2


def interference(x: NDArray[np.float64], form: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return the share by which a form factor changes the scatter of a 60 mm ball of water, and what it refers to.

    The four numbers are the change in the middle of the shadow, its standard error, the change of the mean over a
    panel of 120 mm, and scatter over primary in the middle.
    """
    plain = World.of(ball(30.0), SOFT.kvp)
    tables = with_form(plain.tables, x, form)
    changed = plain._replace(tables=tables, blocks=make_blocks(ball(30.0), plain.prims, tables))
    source = Source(spectrum=spectrum(SOFT), detector=GOS, n_detector=(1, 1))
    images = [scatter_image(w, source, _POSE, cells=(5, 5), histories=_HISTORIES) for w in (plain, changed)]
    before, after = (image.scatter for image in images)
    noise = math.hypot(*(image.error[2, 2] / image.scatter[2, 2] for image in images))
    middle, mean = after[2, 2] / before[2, 2] - 1, after.mean() / before.mean() - 1
    return float(middle), noise, float(mean), float(before[2, 2] / images[0].primary[2, 2])


def doppler(energy: float, angle: float, detector: Detector) -> tuple[float, float]:
    """Return FWHM (keV) and change of the mean signal (share) of photons that water's electrons scatter by `angle`.

    Impulse approximation, with the Compton profiles of free atoms; `angle` is in degrees.
    """
    cos = math.cos(math.radians(angle))
    free = energy / (1 + energy / _REST * (1 - cos))
    e = np.linspace(max(0.5 * free, 1.0), energy, 8001)
    momentum = (
        _ATOMIC * (energy * e / _REST * (1 - cos) - (energy - e)) / np.sqrt(energy**2 + e**2 - 2 * energy * e * cos)
    )
    profile = np.array(
        [2 * xrl.ComptonProfile(1, p) + xrl.ComptonProfile(8, p) for p in np.minimum(abs(momentum), 99.0)]
    )
    density = profile * np.gradient(momentum, e)
    density /= density.sum()
    wide = e[density > 0.5 * density.max()]
    return float(wide[-1] - wide[0]), float(density @ response(detector, e)[0] / response(detector, [free])[0][0] - 1)


def fluorescence(which: str, thickness: float, tube: Tube, detector: Detector, tissue: float = 0.0) -> float:
    """Return the signal of K fluorescence behind a plate of 100 mm² at the isocentre of `core`, per open signal.

    `thickness` and `tissue` behind the plate are in mm. Photons leave along the beam; Compton build-up is left out.
    """
    beam, mu = spectrum(tube), attenuation(which, spectrum(tube).energies)
    geometry = CORE.geometry
    solid_angle = 100.0 * (geometry.dsd / geometry.dso) ** 2 / (4 * math.pi * (geometry.dsd - geometry.dso) ** 2)
    total = 0.0
    for z, vacancies in k_vacancies(which, beam.energies).items():
        if (shell := k_shell(z)) is None:
            continue
        for line, share in shell.lines:
            if line < 3.0:
                continue  # air and covers stop them
            out = attenuation(which, [line])[0]
            # ∫ exp(−μz)·exp(−μ_K(t − z)) dz over the plate
            reach = (np.exp(-out * thickness) - np.exp(-mu * thickness)) / (mu - out)
            yielded = float((beam.weights * vacancies * reach).sum()) * shell.fluorescence_yield * share
            total += yielded * response(detector, [line])[0][0] * math.exp(-attenuation("water", [line])[0] * tissue)
    return solid_angle * total / signal(tube, detector, {})


def lubberts(absorbed: float, frequency: float, thickness: float) -> float:
    """Return Lubberts' factor L(f): light of each depth loses exp(−2π·f·depth), as in a clear slab without walls.

    `absorbed` is μt of the photons, which enter at the far side of the light sensor; `frequency` is in 1/mm.
    L is the square of the mean transfer over the mean square. Noise power is 1/L times that of one kernel.
    """
    blur = 2 * math.pi * frequency * thickness

    def mean(k: float) -> float:  # of exp(−k·(1 − z/t)) with the density of exp(−μz)
        return (math.exp(-absorbed) - math.exp(-k)) / (k - absorbed) * absorbed / -math.expm1(-absorbed)

    return mean(blur) ** 2 / mean(2 * blur)


def electron_range(which: str, energy: ArrayLike) -> NDArray[np.float64]:
    """Return the range (mm) of electrons of `energy` keV after Kanaya and Okayama (1972), J. Phys. D 5, 43."""
    found = material(which)
    ratio = sum(w * xrl.AtomicWeight(z) / z**0.889 for z, w in found.mass_fractions.items())
    return 2.76e-5 * ratio * np.asarray(energy, np.float64) ** 1.67 / found.density


def rotation() -> float:
    """Return how far (pixels) the edge of `core`'s object moves over the panel in one view."""
    g = CORE.geometry
    return 30.0 * 2 * math.pi / g.n_views * g.dsd / g.dso / g.d_detector[1]


def shared(pitch: float, energy: float, threshold: float = 15.0) -> float:
    """Return the share of photons that two pixels of `pitch` mm count, since both get more than the threshold.

    The cloud is a Gaussian of the width sqrt(2·(kT/q)·L²/V) at the end of L = 1 mm of CdTe under V = 500 V.
    """
    from scipy.special import ndtri

    sigma = math.sqrt(2 * 0.0253 / 500.0)
    return 4 * sigma * float(ndtri(1 - threshold / energy)) / pitch


def rows(file: Path | None) -> list[list[str]]:
    """Return the table: effect, size, how it was obtained."""
    out = []
    if file is not None:
        x, form = np.loadtxt(file, unpack=True)
        middle, noise, mean, ratio = interference(x[x < _FLAT], form[x < _FLAT])
        out.append(["molecular interference", f"scatter {middle:+.1%} (±{noise:.1%}) in the shadow's middle, "
                    f"where S/P is {ratio:.3f}, {mean:+.1%} on average",
                    "Monte Carlo, ball of water of 60 mm"])  # fmt: skip
    for energy, angle in ((60.0, 20.0), (60.0, 90.0), (90.0, 90.0)):
        width, change = doppler(energy, angle, GOS)
        out.append([f"Doppler broadening, {energy:g} keV by {angle:g}°", f"FWHM {width:.2f} keV, signal {change:+.2%}",
                    "quadrature, Compton profiles"])  # fmt: skip
    out += _fluorescence_rows()
    pixel = CORE.geometry.d_detector[1]
    for name, detector, which in (("GOS", GOS, "GOS"), ("CsI", CSI, "CsI")):
        depth = float(attenuation(which, [60.0])[0]) * detector.thickness
        for f in (0.25 / pixel, 0.5 / pixel):
            out.append([f"light spread by depth, {detector.thickness:g} mm of {name}",
                        f"noise power {1 / lubberts(depth, f, detector.thickness) - 1:+.1%} at {f:.2f}/mm",
                        "closed form, clear slab, 60 keV"])  # fmt: skip
    out.append(["light yield that varies by ±15 % over the depth", f"variance +{0.15**2 / 3:.2%}", "even absorption"])
    out += _panel_rows()
    for pitch in (0.1, pixel):
        out.append([f"charge sharing, pixels of {pitch:.2g} mm", f"{shared(pitch, 60.0):.0%} counted twice", "60 keV"])
    out.append(["pile-up", "rate × dead time: 10 % of the counts at 1e6 a second and 100 ns", "closed form"])
    out.append(["rotation in a view", f"{rotation():.1f} pixels at the edge of `core`'s object", "closed form"])
    return out


def _fluorescence_rows() -> list[list[str]]:
    """Return the rows of K fluorescence. Plates of light metals are about as thick as makes it most."""
    out = []
    for which, thickness, tube, name in (
        ("Ti", 0.04, SOFT, "Ti"), ("Fe", 0.03, SOFT, "Fe"), ("Au", 1.0, HARD, "gold crown"),
        ("Au", 0.13, HARD, "Au"), ("W", 0.1, HARD, "W"),
        ("Pb", 0.2, HARD, "Pb"), ("Ag", 0.06, HARD, "Ag"), ("H 10.9 O 87.1 I 2.0@1.02", 10.0, HARD, "20 mg/ml of I"),
        ("H 10.9 O 87.1 Gd 2.0@1.02", 10.0, HARD, "20 mg/ml of Gd"),
    ):  # fmt: skip
        free, inside = (fluorescence(which, thickness, tube, CSI, depth) for depth in (0.0, 30.0))
        primary = signal(tube, CSI, {which: thickness}) / signal(tube, CSI, {})
        out.append([f"K fluorescence, {name}, {thickness:g} mm",
                    f"{free:.1e} of the open field, {free / primary:.1e} of the primary; behind 30 mm of water "
                    f"{inside:.1e} of the open field",
                    f"plate of 100 mm², {tube.kvp:g} kVp"])  # fmt: skip
    return out


def _panel_rows() -> list[list[str]]:
    """Return the rows of what moves P through the response or the beam."""
    g, beam = CORE.geometry, spectrum(SOFT)
    behind = {"water": 60.0}
    v, u = (0.5 * n * d for n, d in zip(g.n_detector, g.d_detector, strict=True))
    slant = math.hypot(v, u, g.dsd) / g.dsd
    out = []
    for name, detector in (("GOS", GOS), ("CsI", CSI)):
        thicker = Detector(kind=detector.kind, thickness=detector.thickness * slant)
        open_field = signal(SOFT, thicker, {}) / signal(SOFT, detector, {}) - 1
        out.append([f"slant in {name}, corner, 1/cos θ = {slant:.3f}", f"open signal {open_field:+.1%}, Swank's factor "
                    f"{float((swank(thicker, [60.0]) / swank(detector, [60.0]))[0]) - 1:+.2%} at 60 keV, P "
                    + moved(shifts(SOFT, thicker)), "response of a thicker slab"])  # fmt: skip
        oblique = [signal(SOFT, Detector(kind=detector.kind, thickness=detector.thickness / math.cos(angle)), behind)
                   for angle in (0.0, math.radians(20.0), math.radians(30.0))]  # fmt: skip
        more = " and ".join(f"{o / oblique[0] - 1:+.0%}" for o in oblique[1:])
        out.append([f"slant of scattered photons in {name}", f"their signal {more} at 20 and 30°", "same"])
    reach = electron_range("GOS", beam.energies)
    lost = np.clip(1 - reach / (4 * GOS.thickness), 0, 1)
    at60 = float(electron_range("GOS", 60.0))
    out.append(["electrons' range, 0.1 mm of GOS", f"{1e3 * at60:.0f} μm at 60 keV; escape below {at60 / 0.4:.1%}, "
                "P below " + moved(shifts(SOFT, GOS, lost)), "straight tracks"])  # fmt: skip
    half = math.degrees(math.atan(v / g.dsd))
    for off in (-half, half):
        length = math.sin(math.radians(11.0 + off)) / math.sin(math.radians(11.0))
        out.append([f"focal spot at {off:+.1f}°", f"length {length:.2f} of the nominal one", "sin(α ± φ)/sin α"])
    for off in (-half, -0.5 * half, 0.5 * half, half):
        tilted = Tube(kvp=SOFT.kvp, filters=SOFT.filters, anode_deg=11.0 + off)
        change = moved(shifts(tilted, GOS))
        out.append([f"spectrum at {off:+.1f}° along the anode's axis", f"P {change}", "table, other take-off angle"])
    return out


def moved(changes: list[float]) -> str:
    """Return changes of P as text, with the paths that they belong to."""
    return ", ".join(f"{c:+.4f} ({name})" for c, name in zip(changes, PATHS, strict=True))


def main(arguments: list[str]) -> int:
    """Print the table; return 0."""
    if len(arguments) > 1:
        raise InputError("expected at most one argument, the file of water's form factor")
    file = Path(arguments[0]) if arguments else None
    sys.stdout.write(simple(("effect", "size", "how"), rows(file)).markdown())
    return 0


if __name__ == "__main__":
    sys.exit(guarded("neglected", "ctsim.benchmarks.tools.neglected", sys.argv[1:], resumes=False))
