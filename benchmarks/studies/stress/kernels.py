"""Stress rows of the simulator and of the splat kernels, each compared with float64.

Simulator: noise-free P along central rays against closed forms over the whole fine spectrum. Beyond P = 14.6 only a
finite P is promised. Some scenes are checked for more than P. Splat kernels: extreme splats together with a fair one,
which they must neither spoil nor move.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.beam.quadrature import P_MAX
from ctsim.beam.spectrum import Tube
from ctsim.benchmarks.studies.stress import suite
from ctsim.benchmarks.studies.stress.scans import FEW, Findings, Stacks, exact_p, few_views, lengths, simulated, usual
from ctsim.benchmarks.studies.stress.suite import P_SURE, RODS, Scene, in_air
from ctsim.detector.noise import Noise
from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH
from ctsim.materials import attenuation
from ctsim.plan import make_plan
from ctsim.reconstruct.splat.descent.densify import Schedule, densify
from ctsim.reconstruct.splat.kernels import response_reference, splat_reference
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.project import Projector
from ctsim.reconstruct.splat.response import evaluate, make_response
from ctsim.reconstruct.splat.volume import voxelise
from ctsim.settings import Simulation, Truth
from ctsim.simulate import REFERENCE_KEV, simulate_views
from ctsim.solids import FRUSTUM, Primitive, Solid
from ctsim.tracer.kernels import raytrace_cpu, raytrace_reference
from ctsim.tracer.project import EDGE_THRESHOLD, STEP_THRESHOLD, Response, Tracer, work_order
from ctsim.tracer.shadow import everywhere, inflate
from ctsim.types import Phantom, Scanner

CUTOFF = 6.0  # 2e-8 of a peak lies beyond it, so the choice of pixels within the cutoff does not matter
GEOMETRY = Geometry(
    dso=100.0,
    dsd=160.0,
    n_voxel=(5, 7, 11),
    d_voxel=(3.0, 2.5, 2.0),
    n_detector=(23, 30),
    d_detector=(1.3, 1.1),
    n_views=3,
    start_deg=7.0,
)
WITH_SCRATCH = (GEOMETRY.n_detector[0], GEOMETRY.n_detector[1] + WIDTH)  # of a splat projector's image
TURNED = (1.0, 0.3, 0.2, 0.1)


def on_scene(scene: Scene, side: int, found: Findings) -> None:
    """Compare a scan of a scene with its closed form, and run the scene's own check."""
    phantom, scanner = scene.phantom(), few_views(scene, side)
    inside = lengths(scene, scanner.geometry)
    exact = exact_p(scanner, inside)
    if scanner.scatter.fraction:
        exact = -np.log(np.exp(-exact) + scanner.scatter.fraction)
    stacks, volumes = simulated(phantom, scanner, Truth(twin=False, noise_free=True))
    for name, values in (stacks | volumes).items():
        found.finite(name, values)
    p, seen = stacks["noise_free"], exact <= P_MAX
    found.at_most("|ΔP|", float(np.abs(p - exact)[seen].max(initial=0.0)), P_SURE)
    found.say(f"P to {exact.max():.3g}")
    if not seen.all():
        low, high = float(p[~seen].min()), float(p[~seen].max())
        holds = low >= P_MAX - P_SURE and high <= suite.CLAMP
        found.say(f"P beyond {P_MAX:g} within {low:.3g} … {high:.3g}", holds=holds)
    if (rod := scene.lone) is not None:
        there = float(volumes["reference_50kev"].sum(dtype=np.float64) * np.prod(scanner.geometry.d_voxel))
        mu = float(attenuation(rod.material, np.array([REFERENCE_KEV]))[0])
        found.at_most("mass on the grid off by", abs(there / (mu * np.pi * rod.radius**2 * rod.height) - 1), suite.MASS)
    if scene.name in CHECKS:
        stacks |= {"exact": exact, "depth": np.sum(list(inside.values()), axis=0)}
        CHECKS[scene.name](phantom, scanner, stacks, found)


# --- further checks of some scenes --------------------------------------------------------


def unbiased(phantom: Phantom, scanner: Scanner, stacks: Stacks, found: Findings) -> None:
    """Compare the mean of counts without an ADC with the closed form; a Poisson draw is unbiased at any dose."""
    plain = msgspec.structs.replace(scanner, noise=Noise(electronic=0.0, adc_bits=None))
    counts = simulated(phantom, plain, Truth(twin=False))[0]["counts"]
    expected = plain.i0 * np.exp(-stacks["exact"])
    # an energy-integrating detector's variance is at most twice a counter's at 90 kVp; five standard errors
    limit = 5 * np.sqrt(2 * expected.sum()) / expected.sum()
    found.at_most("mean count off by", abs(counts.sum(dtype=np.float64) / expected.sum() - 1), limit)
    found.say(f"{np.mean(counts == 0):.0%} of the readings are 0")


def dark(phantom: Phantom, scanner: Scanner, stacks: Stacks, found: Findings) -> None:
    """Check that no photon passes: every reading is the pedestal."""
    pedestal = scanner.noise.dark
    found.say(f"all readings are the pedestal {pedestal:g}", holds=bool((stacks["counts"] == pedestal).all()))


def clipped(phantom: Phantom, scanner: Scanner, stacks: Stacks, found: Findings) -> None:
    """Check an open field at the ADC's full scale: noise clips there and does not wrap round."""
    full, readings = scanner.noise.full_scale, stacks["counts"][stacks["depth"] == 0]
    # half of a symmetric distribution lies above its mean; Poisson's at 1e4 is skewed by 1 %
    found.at_most("share of open readings at full scale off a half by", abs(np.mean(readings == full) - 0.5), 0.05)
    found.at_most("largest drop of an open reading", float(1 - readings.min() / full), 0.1)


def no_twin(phantom: Phantom, scanner: Scanner, stacks: Stacks, found: Findings) -> None:
    """Compare a scan without metal with the twin of one with metal, count by count."""
    with_metal = in_air(*phantom.solids, RODS["titanium"].solid())
    twin, _ = simulated(with_metal, scanner, Truth(), subrays=34)
    bare, _ = simulated(with_metal.without_metal(), scanner, Truth(), subrays=34)
    found.same("counts of the twin and of the bare body are", twin["metal_free/counts"], bare["counts"])
    found.say("no twin of its own", holds="metal_free/counts" not in bare)


def equal_views(phantom: Phantom, scanner: Scanner, stacks: Stacks, found: Findings) -> None:
    """Compare views at equal angles: without noise they are equal."""
    found.same("views at one angle are", stacks["noise_free"][::2], stacks["noise_free"][1::2])


def table_ends(phantom: Phantom, scanner: Scanner, stacks: Stacks, found: Findings) -> None:
    """Check that the bundled table refuses a voltage that only the closed-form tube reaches."""
    found.refused("covers 10 to 500", lambda: Tube(kvp=scanner.tube.kvp))


CHECKS: dict[str, Callable[[Phantom, Scanner, Stacks, Findings], None]] = {
    "ten-photons": unbiased,
    "tungsten-120mm": dark,
    "full-scale": clipped,
    "no-metal": no_twin,
    "duplicate-views": equal_views,
    "450kvp": table_ends,
}


# --- simulator cases without a scene -------------------------------------------------------------------------


def flat_solids(side: int, found: Findings) -> None:
    """Add solids of zero height or radius, which change nothing; negative sizes are refused."""
    phantom, scanner = usual(side, n_views=FEW)
    pieces = [Primitive(kind=FRUSTUM, centre=(3.0, 1.0, 2.0), params=p) for p in ((0.0, 5.0, 5.0), (10.0, 0.0, 0.0))]
    thin = [Solid(name="flat", material="Fe", primitives=(piece,), metal=True) for piece in pieces]
    without, both = (
        simulated(p, scanner, Truth(twin=False, noise_free=True))[0]["noise_free"]
        for p in (phantom, in_air(*phantom.solids, *thin))
    )
    found.same("P with and without them are", both, without)
    centre, params = (0.0, 0.0, 0.0), (-1.0, 1.0, 1.0)
    found.refused("must not be negative", lambda: Primitive(kind=FRUSTUM, centre=centre, params=params))


def raytrace_in_float64(side: int, found: Findings) -> None:
    """Compare the float32 kernel with its float64 reference, sub-rays included, in one view of few pixels."""
    phantom, scanner = usual(side, n_detector=(5, 7), detector_mm=(85.0, 91.0), n_views=1, start_deg=11.0)
    where = scanner.geometry
    pose, shape = where.pose(0), where.n_detector
    plan = make_plan(phantom, scanner, Simulation(), Truth(), "stress")
    tracer = Tracer.of(phantom)
    rule, background = Response.of(plan.rule, tracer.materials), tracer.background(where, 0)
    solids = (tracer.prims, inflate(tracer.prims, pose[None])[0], everywhere(shape, len(tracer.prims)))
    spans, order = np.tile(np.array([0, shape[1]]), (shape[0], 1)), work_order(-(-shape[0] // raytrace_cpu.STRIP))
    edge = (rule.edge_mu, EDGE_THRESHOLD, STEP_THRESHOLD, plan.settings.subrays, plan.settings.edge_tolerance)
    logs = []
    for kernel, kind in ((raytrace_cpu, np.float32), (raytrace_reference, np.float64)):
        m1, m2 = np.ones(shape, kind), np.ones(shape, kind)
        energies = (rule.mu, rule.w1, rule.w2)
        kernel.transmit_view(tracer.bricks[:5], solids, pose, order, spans, background, energies, edge, True, m1, m2)
        logs.append(np.log(np.stack([m1, m2]).astype(np.float64)))
    found.at_most("largest |ΔP| of float32", float(np.abs(logs[0] - logs[1]).max()), suite.FLOAT32)


def counts_on_threads(side: int, found: Findings) -> None:
    """Compare the counts of 1, 2 and all threads, and of views made alone."""
    phantom, scanner = usual(side, n_views=FEW)
    plan = make_plan(phantom, scanner, Simulation(), Truth(), "stress")

    def counts() -> NDArray[Any]:
        return np.stack([v["counts"] for _, v in simulate_views(plan, phantom, scanner)])

    first = found.same_on_threads("counts", counts)
    alone = [next(iter(simulate_views(plan, phantom, scanner, k)))[1]["counts"] for k in range(FEW)]
    found.same("views made alone and in turn are", np.stack(alone), first)


# --- splat kernels ------------------------------------------------------------------------------------


def splat(place: Sequence[float], scales: Sequence[float], turn: Sequence[float] = TURNED) -> Splats:
    """Return one splat of densities 1 and 2 (1/mm); places and scales are mm."""
    given = {"positions": place, "scales": scales, "rotations": turn, "densities": (1.0, 2.0)}
    return Splats(**{name: np.array([value], np.float32) for name, value in given.items()})


FAIR = splat([1.0, 2.0, -1.0], [1.0, 2.0, 1.5], (1.0, 2.0, 3.0, 4.0))


def joined(one: Splats, other: Splats) -> Splats:
    """Return both sets, the first one's splats first."""
    return Splats(**{name: np.concatenate([a, getattr(other, name)]) for name, a in asdict(one).items()})


def _near_float64(found: Findings, given: Splats) -> None:
    """Compare projections, exact and EWA, and the volume with the float64 reference."""
    shapes, values = given.shapes(), given.densities
    for tolerance in (0.0, np.inf):
        seen = Projector(geometry=GEOMETRY, tolerance=tolerance, cutoff=CUTOFF)
        images = seen.forward(shapes, values)
        exact = np.zeros((len(images), values.shape[1] * images.shape[2], images.shape[3]))
        splat_reference.forward_views(shapes, values, seen.cameras, exact)
        peak = max(float((splat_reference.peaks(shapes, c) * values.max(1)).max()) for c in seen.cameras)
        found.finite("the images", images)
        off = np.abs(images - exact.reshape(images.shape))[..., : GEOMETRY.n_detector[1]].max()
        found.at_most(f"{'EWA' if tolerance else 'exact'} off by, of the peak", float(off) / peak, suite.PROJECTED)
    grid = np.array([*GEOMETRY.d_voxel, *(axis[0] for axis in GEOMETRY.voxel_centres()), CUTOFF, 1 / 12])
    volume = voxelise(given, GEOMETRY, cutoff=CUTOFF)
    true = splat_reference.voxelise(shapes, values, grid, GEOMETRY.n_voxel)
    # relative to the splat in the middle of a voxel, since a thin one between voxel centres nearly vanishes
    greatest = max(float(true.max()), float(np.prod(given.scales[0] / (given.scales[0] + 1))))
    found.at_most("volume off by, of the greatest", float(np.abs(volume - true).max()) / greatest, suite.VOXELISED)


def _gradient_is_finite(found: Findings, given: Splats) -> None:
    image = np.random.Generator(np.random.Philox(key=3)).normal(size=(2, *WITH_SCRATCH)).astype(np.float32)
    gradient = Projector(geometry=GEOMETRY).gradient(given, image, 0)
    for name in ("densities", "positions", "log_scales", "rotations", "centres"):
        found.finite(f"the gradient in {name}", getattr(gradient, name))


def _with_fair(found: Findings, what: str, odd: Splats, *, seen: bool) -> None:
    """Project and voxelise an odd splat together with a fair one; without `seen` the odd one must have no effect."""
    both, projector = joined(odd, FAIR), Projector(geometry=GEOMETRY)
    image, alone = (projector.forward(s.shapes(), s.densities) for s in (both, FAIR))
    volume, volume_alone = (voxelise(s, GEOMETRY) for s in (both, FAIR))
    for name, values in (("images", image), ("the volume", volume)):
        found.finite(f"{what}: {name}", values)
    sums, sums_alone = (projector.adjoint(s.shapes(), np.ones_like(image)) for s in (both, FAIR))
    found.same(f"{what}: the other's sums alone and together are", sums[1:], sums_alone)
    if not seen:
        found.same(f"{what}: the images without and with it are", alone, image)
        found.say(f"{what}: no sums", holds=not sums[0].any())
    found.say(f"{what}: the other is all there", holds=bool((volume >= volume_alone * np.float32(1 - 1e-6)).all()))
    _gradient_is_finite(found, both)


def needles(_: int, found: Findings) -> None:
    """Project needles and discs of 20000:1, across the view and towards the source."""
    for scales, turn in (([10, 5e-4, 5e-4], TURNED), ([10, 5e-4, 5e-4], (1, 0, 0, 0.06)), ([8, 8, 4e-4], TURNED)):
        _near_float64(found, joined(splat([0, 0, 0], scales, turn), FAIR))
        _gradient_is_finite(found, splat([0, 0, 0], scales, turn))


def sub_pixel(_: int, found: Findings) -> None:
    """Project splats of a tenth, a thousandth and a millionth of a millimetre."""
    for scale in (0.1, 1e-3, 1e-6):
        given = splat([0.4, -0.3, 0.2], [scale] * 3)
        _near_float64(found, given)
        _gradient_is_finite(found, given)


def behind(_: int, found: Findings) -> None:
    """Put splats behind, at and next to the source of a view."""
    source = GEOMETRY.pose(0)[:3]
    one = {"behind the source": 2 * source, "at the source": source, "next to it": source + np.array([0.0, 0.0, 5.0])}
    view = Projector(geometry=GEOMETRY)
    for what, place in one.items():
        odd = splat(place.tolist(), [2, 2, 2])
        _with_fair(found, what, odd, seen=True)  # in other views it may be visible
        images = [view.forward(s.shapes(), s.densities, [0]) for s in (joined(odd, FAIR), FAIR)]
        found.same(f"{what}: the images of this view without and with it are", images[1], images[0])


def outside(_: int, found: Findings) -> None:
    """Put splats where no ray goes, up to 1e30 mm away."""
    for what, place in (("above", [0, 0, 500]), ("far away", [1e30, -1e30, 1e30])):
        _with_fair(found, what, splat(place, [2, 2, 2]), seen=False)


def empty(_: int, found: Findings) -> None:
    """Project, voxelise and differentiate no splats."""
    none = Splats(**{name: a[:0] for name, a in asdict(FAIR).items()})
    view = Projector(geometry=GEOMETRY)
    images = view.forward(none.shapes(), none.densities)
    found.say("images of zeros", holds=images.shape == (3, 2, *WITH_SCRATCH) and not images.any())
    found.say("a volume of zeros", holds=not voxelise(none, GEOMETRY).any())
    found.say("no sums", holds=view.adjoint(none.shapes(), images).shape == (0, 2))
    _gradient_is_finite(found, none)


def not_finite(_: int, found: Findings) -> None:
    """Seed a splat with NaN or infinity in each of its arrays; densification drops it."""
    for value in (np.nan, np.inf):
        for name in ("positions", "scales", "rotations", "densities"):
            odd = splat([0, 0, 0], [2, 2, 2])
            getattr(odd, name)[0, 0] = value
            _with_fair(found, f"{value} in {name}", odd, seen=name == "densities")
            kept, origin = densify(joined(odd, FAIR), np.zeros(2), GEOMETRY, Schedule(), np.uint64(1))
            found.say(f"{value} in {name}: dropped", holds=len(kept) == 1 and origin.tolist() == [1])


def opaque(_: int, found: Findings) -> None:
    """Evaluate the response behind path values up to 1e4, where exp(−κ·Lb) underflows."""
    grid = np.array([0, 1e-30, 1e-6, 1, 30, 1e3, 1e4], np.float32)
    la, lb = (a.ravel() for a in np.meshgrid(grid[:-1], grid, indexing="ij"))
    for name in ("paper", "hinge", "tube", "sinh"):
        response = make_response(name, e_max=90.0)
        there = evaluate(response, la, lb)
        exact = response_reference.evaluate(response.a, response.b, response.eta, la.astype(float), lb.astype(float))
        found.finite(name, np.stack(there))
        off = max(float((np.abs(a - b) / np.maximum(np.abs(b), 1)).max()) for a, b in zip(there, exact, strict=True))
        found.at_most(f"{name} off by", off, suite.RESPONDED)


def many(n: int) -> Splats:
    """Return n³/8 random splats in the volume."""
    rng, size = np.random.Generator(np.random.Philox(key=n)), max(n**3 // 8, 1)
    drawn = {
        "positions": rng.uniform(-8, 8, (size, 3)),
        "scales": rng.uniform(0.3, 3, (size, 3)),
        "densities": rng.random((size, 2)),
        "rotations": rng.normal(size=(size, 4)),
    }
    return Splats(**{name: a.astype(np.float32) for name, a in drawn.items()})


def splats_in_float64(side: int, found: Findings) -> None:
    """Compare sums over many splats with float64; only a few overlap in a pixel."""
    _near_float64(found, many(min(side, 8)))


def splats_on_threads(side: int, found: Findings) -> None:
    """Compare the sums of 1, 2 and all threads, and of views in another order."""
    given, view = many(side), Projector(geometry=GEOMETRY)
    shapes = given.shapes()

    def everything() -> NDArray[np.float32]:
        images = view.forward(shapes, given.densities)
        one, gradient = view.forward(shapes, given.densities, [1]), view.gradient(given, images[0], 0)
        parts = (images, one, view.adjoint(shapes, images), voxelise(given, GEOMETRY), gradient.positions)
        return np.concatenate([p.ravel() for p in (*parts, gradient.log_scales)])

    found.same_on_threads("all sums", everything)
    order = [2, 0, 1]
    images = [view.forward(shapes, given.densities, [k])[0] for k in range(3)]
    again = view.forward(shapes, given.densities, order)
    found.same("views alone and in another order are", np.stack([images[k] for k in order]), again)
