"""Stress rows of the simulator: noise-free P along central rays and float64 closed forms over the whole fine spectrum.

Beyond P = 14.6 nothing is promised but a finite P. Some scenes are checked for more than P.
"""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.studies.stress.scans import FEW, Findings, Stacks, exact_p, few_views, lengths, simulated, usual
from ctsim.benchmarks.studies.stress.suite import CLAMP, FLOAT32, MASS, P_SURE, RODS, Scene, in_air
from ctsim.kernels import raytrace_cpu, raytrace_reference
from ctsim.materials import attenuation
from ctsim.noise import Noise
from ctsim.plan import make_plan
from ctsim.project import EDGE_THRESHOLD, STEP_THRESHOLD, Response, Tracer, work_order
from ctsim.quadrature import P_MAX
from ctsim.settings import Simulation, Truth
from ctsim.shadow import everywhere, inflate
from ctsim.simulate import REFERENCE_KEV, simulate_views
from ctsim.solids import FRUSTUM, Primitive, Solid
from ctsim.spectrum import Tube
from ctsim.types import Phantom, Scanner


def on_scene(scene: Scene, side: int, found: Findings) -> None:
    """Compare a scan of a scene with its closed form, and check what is special about it."""
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
        found.say(f"P beyond {P_MAX:g} within {low:.3g} … {high:.3g}", holds=low >= P_MAX - P_SURE and high <= CLAMP)
    if (rod := scene.lone) is not None:
        there = float(volumes["reference_50kev"].sum(dtype=np.float64) * np.prod(scanner.geometry.d_voxel))
        mu = float(attenuation(rod.material, np.array([REFERENCE_KEV]))[0])
        found.at_most("mass on the grid off by", abs(there / (mu * np.pi * rod.radius**2 * rod.height) - 1), MASS)
    if scene.name in CHECKS:
        stacks |= {"exact": exact, "depth": np.sum(list(inside.values()), axis=0)}
        CHECKS[scene.name](phantom, scanner, stacks, found)


# --- what some scenes are checked for beyond P --------------------------------------------------------


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
    """Look for photons behind what lets none through: what is left is the pedestal."""
    pedestal = scanner.noise.dark
    found.say(f"all readings are the pedestal {pedestal:g}", holds=bool((stacks["counts"] == pedestal).all()))


def clipped(phantom: Phantom, scanner: Scanner, stacks: Stacks, found: Findings) -> None:
    """Look at an open field that fills the ADC: noise clips at full scale and does not wrap round."""
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
    """Compare the views at equal angles, which are equal before noise."""
    found.same("views at one angle are", stacks["noise_free"][::2], stacks["noise_free"][1::2])


def table_ends(phantom: Phantom, scanner: Scanner, stacks: Stacks, found: Findings) -> None:
    """Ask the bundled table for a tube that only the closed-form one reaches."""
    found.refused("covers 10 to 500", lambda: Tube(kvp=scanner.tube.kvp))


CHECKS: dict[str, Callable[[Phantom, Scanner, Stacks, Findings], None]] = {
    "ten-photons": unbiased,
    "tungsten-120mm": dark,
    "full-scale": clipped,
    "no-metal": no_twin,
    "duplicate-views": equal_views,
    "450kvp": table_ends,
}


# --- cases that are no scenes -------------------------------------------------------------------------


def flat_solids(side: int, found: Findings) -> None:
    """Add solids without height or radius, which change nothing; negative ones are refused."""
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


def beside_float64(side: int, found: Findings) -> None:
    """Compare the float32 kernel with its float64 twin, sub-rays included, in one view of few pixels."""
    phantom, scanner = usual(side, n_detector=(5, 7), detector_mm=(85.0, 91.0), n_views=1, start_deg=11.0)
    where = scanner.geometry
    pose, shape = where.pose(0), where.n_detector
    plan = make_plan(phantom, scanner, Simulation(), Truth(), "stress")
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
    found.at_most("largest |ΔP| of float32", float(np.abs(logs[0] - logs[1]).max()), FLOAT32)


def same_bits(side: int, found: Findings) -> None:
    """Compare the counts of 1, 2 and all threads, and of views made alone."""
    phantom, scanner = usual(side, n_views=FEW)
    plan = make_plan(phantom, scanner, Simulation(), Truth(), "stress")

    def counts() -> NDArray[Any]:
        return np.stack([v["counts"] for _, v in simulate_views(plan, phantom, scanner)])

    first = found.same_on_threads("counts", counts)
    alone = [next(iter(simulate_views(plan, phantom, scanner, k)))[1]["counts"] for k in range(FEW)]
    found.same("views made alone and in turn are", np.stack(alone), first)
