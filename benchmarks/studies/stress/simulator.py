"""Stress cases of the simulator: noise-free P against float64 closed forms over the whole fine spectrum.

Limit of |ΔP|: the plan keeps Gauss nodes within 1e-4 where P ≤ 14.6 (a tenth more between the paths it tries), and
float32 adds 1e-5 at most. Beyond 14.6 nothing is promised but a finite P, as long as exponents are clamped at 80.
"""

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.methods import code_version
from ctsim.benchmarks.studies.stress.cases import SIMULATOR, Case, Findings
from ctsim.benchmarks.studies.stress.scans import (
    BODY,
    HEIGHT,
    SIZE,
    USUAL,
    WATER,
    Chords,
    block_chord,
    block_phantom,
    chords,
    exact_p,
    geometry,
    in_air,
    on_threads,
    rod,
    scaled_by,
    simulated,
    thread_counts,
    uneven,
)
from ctsim.kernels import raytrace_cpu, raytrace_reference
from ctsim.materials import attenuation
from ctsim.noise import Noise
from ctsim.plan import make_plan
from ctsim.project import EDGE_THRESHOLD, STEP_THRESHOLD, Response, Tracer, work_order
from ctsim.quadrature import P_MAX
from ctsim.scatter import Scatter
from ctsim.settings import Simulation, Truth
from ctsim.shadow import everywhere, inflate
from ctsim.simulate import REFERENCE_KEV, simulate_views
from ctsim.solids import FRUSTUM, Primitive, Solid
from ctsim.spectrum import Tube
from ctsim.types import Phantom, Scanner

LIMIT = 1.2e-4
CLAMP = 81.0  # exponents at 80, and the weight of one node
MASS = 0.01  # of a rod on the grid: 1/250 of every voxel that its surface crosses, of 216 cm³ for its 94 at worst
FEW = 6  # views
WITH_MASS = ("voxel-1um", "voxel-10mm", "one-voxel", "volume-5x7x11")
CLOSED_FORM = f"|ΔP| ≤ {LIMIT:g} of the float64 closed form where P ≤ {P_MAX:g}, finite beyond"
QUIET = Noise(model="none")


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """A phantom on a scanner, and the true chords in each material [view, v, u].

    `mass`, a material and how much of it there is (mm³), is held against the reference volume.
    """

    phantom: Phantom
    scanner: Scanner
    chords: Chords
    mass: tuple[str, float] | None = None


def bench(side: int, *solids: Solid, of: Mapping[str, Any] | None = None, **scanner: Any) -> Bench:
    """Put rods that lie apart within the first of them, by default the usual ones, on a scanner of few views."""
    solids = solids or USUAL
    where = geometry(side, **{"n_views": FEW, **(of or {})})
    machine = Scanner(**{"geometry": where, "noise": QUIET, **scanner})
    return Bench(phantom=in_air(solids), scanner=machine, chords=chords(where, *solids))


def compare(found: Findings, given: Bench) -> dict[str, NDArray[Any]]:
    """Simulate, and hold P along central rays against the closed form; return the stacks."""
    stacks, volumes = simulated(given.phantom, given.scanner, Truth(twin=False, noise_free=True))
    p, exact = stacks["noise_free"], exact_p(given.scanner, given.chords)
    if given.scanner.scatter.fraction:
        exact = -np.log(np.exp(-exact) + given.scanner.scatter.fraction)
    seen = exact <= P_MAX
    for name, values in (stacks | volumes).items():
        found.finite(name, values)
    found.at_most("|ΔP|", float(np.abs(p - exact)[seen].max(initial=0.0)), LIMIT)
    found.say(f"P to {exact.max():.3g}")
    if not seen.all():
        low, high = float(p[~seen].min()), float(p[~seen].max())
        found.say(f"P beyond {P_MAX:g} within {low:.3g} … {high:.3g}", holds=low >= P_MAX - LIMIT and high <= CLAMP)
    if given.mass is not None:
        material, volume = given.mass
        there = float(volumes["reference_50kev"].sum(dtype=np.float64) * np.prod(given.scanner.geometry.d_voxel))
        true = float(attenuation(material, np.array([REFERENCE_KEV]))[0]) * volume
        found.at_most("mass on the grid off by", abs(there / true - 1), MASS)
    return stacks


def volume_of(radius: float, height: float = HEIGHT) -> float:
    """Volume of a rod in mm³."""
    return float(np.pi * radius**2 * height)


# --- scenes ------------------------------------------------------------------------------------------


def scaled(side: int, factor: float, *solids: Solid) -> Bench:
    """Return a bench on rods, all of whose lengths are multiplied."""
    where = scaled_by(geometry(side, n_views=FEW), factor)
    machine = Scanner(geometry=where, noise=QUIET)
    radius, height = solids[0].primitives[0].params[1], 2 * solids[0].primitives[0].params[0]
    mass = solids[0].material, volume_of(radius, height)
    return Bench(phantom=in_air(solids), scanner=machine, chords=chords(where, *solids), mass=mass)


def grid_bench(side: int, d_voxel: tuple[float, float, float], n_voxel: tuple[int, int, int]) -> Bench:
    """Return the water alone on another grid that holds all of it."""
    given = bench(side, WATER, of={"d_voxel": d_voxel, "n_voxel": n_voxel})
    return Bench(phantom=given.phantom, scanner=given.scanner, chords=given.chords, mass=("water", volume_of(BODY)))


def block(side: int, density: float | None, edge: float, **of: Any) -> Bench:
    """Return a block of water voxels with a map of relative density."""
    where = geometry(side, **{"n_views": 8, **of})
    lengths = {"water": (density or 1.0) * block_chord(where, (edge / 2, edge / 2, edge / 2))}
    phantom = block_phantom(density, edge)
    return Bench(phantom=phantom, scanner=Scanner(geometry=where, noise=QUIET), chords=lengths)


def nested(side: int) -> Bench:
    """Return iron in titanium in water, with a hole of air along the iron's axis."""
    at = (8.0, 3.0)
    radii = {"Ti": 7.0, "Fe": 5.0, "air": 2.0}
    solids = (WATER, *(rod(m, r, at=at) for m, r in radii.items()))
    given = bench(side, WATER, rod("Ti", 7.0, at=at))
    each = [chords(given.scanner.geometry, s)[s.material] for s in solids]
    between: Chords = dict(zip(("water", "Ti", "Fe"), (a - b for a, b in itertools.pairwise(each)), strict=True))
    return Bench(phantom=in_air(solids), scanner=given.scanner, chords=between)


def overlapping(side: int) -> Bench:
    """Return a long thin rod through a short wide disc on one axis: what they share belongs to the later one."""
    disc, thin, shared = rod("Ti", 9.0, height=10.0), rod("Fe", 4.0, height=40.0), rod("Ti", 4.0, height=10.0)
    given = bench(side, WATER)
    water, ti, fe, both = (chords(given.scanner.geometry, s)[s.material] for s in (WATER, disc, thin, shared))
    lengths = {"water": water - ti - fe + both, "Ti": ti - both, "Fe": fe}
    return Bench(phantom=in_air((WATER, disc, thin)), scanner=given.scanner, chords=lengths)


def tangent(side: int) -> Bench:
    """Return two rods that touch each other and two that touch the water's surface from within."""
    edge = BODY - 3.0
    metals = [rod("Fe", 3.0, at=(x, 0.0)) for x in (-3.0, 3.0)] + [rod("Ti", 3.0, at=(0.0, y)) for y in (-edge, edge)]
    return bench(side, WATER, *metals)


def and_rod(side: int, x: float) -> Bench:
    """Return the usual scene and one more rod of titanium, beyond the water."""
    given, other = bench(side), rod("Ti", 3.0, at=(x, 0.0))
    lengths = dict(given.chords)
    lengths["Ti"] = lengths["Ti"] + chords(given.scanner.geometry, other)["Ti"]
    return Bench(phantom=in_air((*USUAL, other)), scanner=given.scanner, chords=lengths)


CONE_60 = {"dso": 90.0, "dsd": 180.0}  # the detector's half height of 104 mm spans 30°

SCENES: dict[str, tuple[str, Callable[[int], Bench]]] = {
    "iron-40mm": ("a rod of 40 mm iron in water", lambda n: bench(n, WATER, rod("Fe", 20.0))),
    "scatter": (
        "scatter of twice the open field",
        lambda n: bench(n, scatter=Scatter(level=1, fraction=2.0)),
    ),
    "metal-fills-field": ("iron wider than the field of view", lambda n: bench(n, rod("Fe", 60.0, height=200.0))),
    "metal-at-edge": ("metal that crosses the volume's edge", lambda n: and_rod(n, SIZE / 2)),
    "metal-outside": ("metal outside the volume that rays meet", lambda n: and_rod(n, 40.0)),
    "one-view": ("one view", lambda n: bench(n, of={"n_views": 1})),
    "two-views": ("two views", lambda n: bench(n, of={"n_views": 2})),
    "arc-90": ("an arc of 90°", lambda n: bench(n, of={"arc_deg": 90.0})),
    "uneven-angles": ("angles that crowd on one side", lambda n: bench(n, of={"angles_deg": uneven(FEW)})),
    "cone-2deg": ("a cone of 2°", lambda n: bench(n, of={"dso": 2100.0, "dsd": 4300.0})),
    "cone-60deg": (
        "a cone of 60°",
        lambda n: bench(n, of=CONE_60 | {"d_detector": (208.0 / (1.5 * n),) * 2}),
    ),
    "offsets": (
        "detector and volume off centre",
        lambda n: bench(n, of={"off_detector": (4.0, -9.0), "off_origin": (3.0, -4.0, 2.0)}),
    ),
    "truncated": ("a detector that sees a third of the object", lambda n: bench(n, of={"n_detector": (n, n // 2)})),
    "voxel-1um": (
        "voxels of 1 µm, a rod of gold",
        lambda n: scaled(n, n / SIZE / 1e3, rod("Au", 0.35e-3 * n, height=0.7e-3 * n)),
    ),
    "voxel-10mm": (
        "voxels of 10 mm, a barrel of water",
        lambda n: scaled(n, n / SIZE * 10, rod("water", 4.0 * n, height=8.0 * n)),
    ),
    "one-voxel": ("a volume of one voxel", lambda n: grid_bench(n, (SIZE, SIZE, SIZE), (1, 1, 1))),
    "volume-5x7x11": (
        "a volume of 5×7×11 voxels",
        lambda n: grid_bench(n, (SIZE / 5, SIZE / 7, SIZE / 11), (5, 7, 11)),
    ),
    "single-energy": ("one energy, 60 keV", lambda n: bench(n, tube=Tube(model="mono", kvp=60.0))),
    "k-edge": (
        "thin tin and tungsten, whose K-edges lie within 120 kVp",
        lambda n: bench(n, WATER, rod("Sn@1", 4.0), rod("W@0.5", 4.0, at=(9.0, 2.0)), tube=Tube(kvp=120.0)),
    ),
    "20kvp": ("a tube of 20 kV", lambda n: bench(n, rod("water", 12.0), tube=Tube(kvp=20.0))),
    "overlapping-solids": ("solids that overlap", overlapping),
    "tangent-solids": ("solids that touch", tangent),
    "nested-solids": ("iron with a hole in titanium in water", nested),
    "grid-rays": (
        "rays along voxel planes, edges and corners",
        lambda n: block(n, None, 32.0, n_detector=(5, 5), d_detector=(8.0, 8.0)),
    ),
    "density-1e-3": ("water of a thousandth of its density", lambda n: block(n, 1e-3, 32.0)),
    "density-1e3": ("water of a thousand times its density", lambda n: block(n, 1e3, 32.0)),
}


def _in_closed_form(make: Callable[[int], Bench], side: int, found: Findings) -> None:
    compare(found, make(side))


# --- what needs more than one closed form ------------------------------------------------------------


def ten_photons(side: int, found: Findings) -> None:
    """Hold the mean of counts without an ADC against the closed form; a Poisson draw is unbiased at any dose."""
    noise = Noise(electronic=0.0, adc_bits=None)
    given = bench(side, WATER, i0=10.0, noise=noise, of={"n_views": 8})
    stacks = compare(found, given)
    expected = 10.0 * np.exp(-exact_p(given.scanner, given.chords))
    # an energy-integrating detector's variance is at most twice a counter's at 90 kVp; five standard errors
    limit = 5 * np.sqrt(2 * expected.sum()) / expected.sum()
    found.at_most("mean count off by", abs(stacks["counts"].sum(dtype=np.float64) / expected.sum() - 1), limit)
    found.say(f"{np.mean(stacks['counts'] == 0):.0%} of the readings are 0")


def dark(side: int, found: Findings) -> None:
    """Put 60 mm of tungsten in the beam, through which no photon gets: what is left is the pedestal."""
    noise = Noise(electronic=0.0, n_flats=0)
    given = bench(side, rod("W", 60.0, height=200.0), noise=noise)
    counts = compare(found, given)["counts"]
    found.say(f"all readings are the pedestal {noise.dark:g}", holds=bool((counts == noise.dark).all()))


def saturated(side: int, found: Findings) -> None:
    """Fill the ADC with the open field: noise clips at full scale and does not wrap round."""
    noise = Noise(adc_fill=1.0, pedestal=0.0, n_flats=0)
    given = bench(side, i0=1e4, noise=noise)
    counts = compare(found, given)["counts"]
    is_open = sum(given.chords.values()) == 0
    share = float(np.mean(counts[is_open] == noise.full_scale))
    # half of a symmetric distribution lies above its mean; Poisson's at 1e4 is skewed by 1 %
    found.at_most("share of open readings at full scale off a half by", abs(share - 0.5), 0.05)
    found.at_most("largest drop of an open reading", float(1 - counts[is_open].min() / noise.full_scale), 0.1)


def no_metal(side: int, found: Findings) -> None:
    """Compare a scan without metal with the twin of one with metal, count by count."""
    given = bench(side, noise=Noise())
    twin, _ = simulated(given.phantom, given.scanner, Truth(), subrays=34)
    bare, _ = simulated(given.phantom.without_metal(), given.scanner, Truth(), subrays=34)
    found.same("counts of the twin and of the bare body are", twin["metal_free/counts"], bare["counts"])
    found.say("no twin of its own", holds="metal_free/counts" not in bare)


def duplicates(side: int, found: Findings) -> None:
    """Scan at equal angles, which give equal views before noise."""
    angles = tuple(np.repeat([10.0, 70.0, 200.0], 2).tolist())
    p = compare(found, bench(side, of={"angles_deg": angles, "n_views": 6}))["noise_free"]
    found.same("views at one angle are", p[::2], p[1::2])


def flat_solids(side: int, found: Findings) -> None:
    """Add solids without height or radius, which change nothing; negative ones are refused."""
    given = bench(side)
    flat = [(0.0, 5.0, 5.0), (10.0, 0.0, 0.0)]
    pieces = [Primitive(kind=FRUSTUM, centre=(3.0, 1.0, 2.0), params=params) for params in flat]
    thin = [Solid(name="flat", material="Fe", primitives=(piece,), metal=True) for piece in pieces]
    phantom = in_air((*given.phantom.solids, *thin))
    stacks = compare(found, Bench(phantom=phantom, scanner=given.scanner, chords=given.chords))
    found.same("P with and without them are", stacks["noise_free"], compare(found, given)["noise_free"])
    found.refused(
        "must not be negative", lambda: Primitive(kind=FRUSTUM, centre=(0.0, 0.0, 0.0), params=(-1.0, 1.0, 1.0))
    )


def tube_450(side: int, found: Findings) -> None:
    """Take the closed-form tube to 450 kVp; the bundled table says that it does not reach."""
    compare(found, bench(side, tube=Tube(kvp=450.0, model="finkelshtein-pavlova")))
    found.refused("covers 10 to 500", lambda: Tube(kvp=450.0))


def oblong(side: int, found: Findings) -> None:
    """Hold the mass on voxels of 50:1, flat and upright."""
    for d, n in (((SIZE / 50, SIZE, SIZE), (50, 1, 1)), ((SIZE, SIZE, SIZE / 50), (1, 1, 50))):
        compare(found, grid_bench(side, d, n))


def beside_float64(side: int, found: Findings) -> None:
    """Hold the float32 kernel against its float64 twin, sub-rays included, in one view of few pixels."""
    where = geometry(side, n_detector=(5, 7), d_detector=(17.0, 13.0), n_views=1, start_deg=11.0)
    phantom, pose, shape = in_air(USUAL), where.pose(0), where.n_detector
    plan = make_plan(phantom, Scanner(geometry=where, noise=QUIET), Simulation(), Truth(), "stress")
    tracer = Tracer.of(phantom)
    rule, background = Response.of(plan.rule, tracer.materials), tracer.background(where, 0)
    solids = (tracer.prims, inflate(tracer.prims, pose), everywhere(shape, len(tracer.prims)))
    spans, order = np.tile(np.array([0, shape[1]]), (shape[0], 1)), work_order(-(-shape[0] // raytrace_cpu.STRIP))
    edge = (rule.edge_mu, EDGE_THRESHOLD, STEP_THRESHOLD, plan.settings.subrays, plan.settings.edge_tolerance)
    logs = []
    for kernel, kind in ((raytrace_cpu, np.float32), (raytrace_reference, np.float64)):
        m1, m2 = np.ones(shape, kind), np.ones(shape, kind)
        energies = (rule.mu, rule.w1, rule.w2)
        kernel.transmit_view(tracer.bricks[:5], solids, pose, order, spans, background, energies, edge, True, m1, m2)
        logs.append(np.log(np.stack([m1, m2]).astype(np.float64)))
    # the exponential is good to 4e-7·max(1, P/4) and so are the sums; lengths of 50 mm to 8e-6 mm, by 0.5/mm
    found.at_most("largest |ΔP| of float32", float(np.abs(logs[0] - logs[1]).max()), 2e-5)


def same_bits(side: int, found: Findings) -> None:
    """Compare the counts of 1, 2 and all threads, and of views made alone."""
    given = bench(side, noise=Noise())
    plan = make_plan(given.phantom, given.scanner, Simulation(), Truth(), "stress")

    def counts() -> NDArray[Any]:
        return np.stack([v["counts"] for _, v in simulate_views(plan, given.phantom, given.scanner)])

    results = {n: on_threads(n, counts) for n in thread_counts()}
    first = results[1]
    for n, other in results.items():
        found.same(f"counts of 1 and {n} threads are", first, other)
    backwards = [next(iter(simulate_views(plan, given.phantom, given.scanner, k)))[1]["counts"] for k in range(FEW)]
    found.same("views made alone and in turn are", np.stack(backwards), first)


SPECIAL: dict[str, tuple[str, str, Callable[[int, Findings], None]]] = {
    "ten-photons": (
        "10 photons a pixel",
        f"{CLOSED_FORM}; mean count within five standard errors",
        ten_photons,
    ),
    "all-zero-counts": ("60 mm of tungsten: no photon gets through", "the pedestal everywhere, P finite", dark),
    "saturated": ("the open field fills the ADC", "half of the open readings at full scale, none wraps", saturated),
    "no-metal": ("a body without metal", "the bits of the metal-free twin, and no twin", no_metal),
    "duplicate-views": ("each view twice", f"{CLOSED_FORM}; equal views have equal bits", duplicates),
    "flat-solids": ("solids of no thickness", "the bits of the scan without them; negative sizes refused", flat_solids),
    "450kvp": ("a tube of 450 kV", f"{CLOSED_FORM}; the bundled table refuses by name", tube_450),
    "anisotropic": ("voxels of 50:1, flat and upright", f"{CLOSED_FORM}; mass on the grid within {MASS:g}", oblong),
    "float64": ("float32 kernels beside float64", "|ΔP| ≤ 2e-5", beside_float64),
    "threads": ("1, 2 and all threads; views in any order", "equal to the last bit", same_bits),
}


def cases() -> list[Case]:
    """Return the simulator's cases."""
    code = code_version(__name__) + code_version("ctsim.phantoms.shapes")
    found = {}
    for name, (what, make) in SCENES.items():
        expected = CLOSED_FORM + (f"; mass on the grid within {MASS:g}" if name in WITH_MASS else "")
        found[name] = (what, expected, partial(_in_closed_form, make))
    found |= SPECIAL
    return [
        Case(name=name, subject=SIMULATOR, what=what, expected=expected, run=run, code=code)
        for name, (what, expected, run) in found.items()
    ]
