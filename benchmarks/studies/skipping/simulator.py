"""What `run-benchmark skipping` measures: what the simulator leaves out, done with and without it.

Each pair differs in one skip. Those of methods and commands are in `methods`.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.studies.skipping.pairs import (
    LINES,
    Bench,
    Cases,
    Images,
    Pair,
    PlannedScan,
    apart,
    largest,
    rounding,
)
from ctsim.bricks import Bricks, make_bricks
from ctsim.phantoms.bodies import Validation
from ctsim.phantoms.scene import build
from ctsim.project import EDGE_THRESHOLD, Response, Tracer, transmit
from ctsim.quadrature import full_rule
from ctsim.scatter import Scatter
from ctsim.settings import Truth
from ctsim.simulate import compact
from ctsim.types import Phantom

ABSENT = ("Al", "Ti", "Cu", "Au")  # metals that a table may name and a thorax does not hold
Signals = list[NDArray[np.float32]]


def materials(setup: Bench) -> Iterator[Pair]:
    """Yield a phantom whose table names metals that it does not hold, traced without and with them."""
    body = build(setup.scene())
    scan = setup.planned(phantom=replace(body, materials=body.materials + ABSENT))
    every = replace(scan, plan=replace(scan.plan, materials=scan.phantom.materials))
    what = f"materials that do not occur: {', '.join(ABSENT)}"
    yield setup.pair(what, scan, every, limit=rounding(every), stated="rounding")


def all_mixed(phantom: Phantom) -> Bricks:
    """Return the phantom's bricks with none of one label: rays visit every voxel, and no air is left out.

    Labels are doubled and told apart by the parity of the voxel, so that every brick is kept; then halved again.
    """
    parity = np.indices(phantom.labels.shape, np.uint8).sum(0, dtype=np.uint8) & np.uint8(1)
    names = ("air", *(f"half {k}" for k in range(2 * len(phantom.materials) - 1)))
    marked = Phantom(
        labels=2 * phantom.labels + parity, materials=names, d_voxel=phantom.d_voxel, off_origin=phantom.off_origin
    )
    found = make_bricks(marked)
    return found._replace(pool=found.pool >> np.uint8(1))


def bricks(setup: Bench) -> Iterator[Pair]:
    """Yield path lengths with bricks of one label crossed in one step, and voxel by voxel."""
    scan = setup.planned()
    fast = replace(Tracer.of(scan.phantom), columns=None)
    slow = replace(fast, bricks=all_mixed(scan.phantom))

    def lengths(tracer: Tracer) -> Signals:
        return [tracer.background(scan.scanner.geometry, view) for view in range(setup.views)]

    longest = max(float(np.max(view)) for view in lengths(fast))
    yield Pair(
        scene=scan.scene.name,
        what="bricks of one label, air among them, crossed in one step",
        skipping=partial(lengths, fast),
        whole=partial(lengths, slow),
        unit="mm",
        # both add up in 2⁻⁴⁰ mm or float64, and are then rounded to float32
        limit=float(np.spacing(np.float32(longest))),
        stated="float32 of the longest path",
    )


def rays(setup: Bench) -> Iterator[Pair]:
    """Yield scans whose rays and primitives are looked at where shadows fall, and everywhere."""
    for scan in setup.inside_and_outside():
        settings = msgspec.structs.replace(scan.plan.settings, skip=False)
        every = replace(scan, plan=replace(scan.plan, settings=settings))
        what = "rays that miss the object, and inserts that a ray cannot meet"
        yield setup.pair(what, scan, every, limit=rounding(every), stated="rounding")


def signals(setup: Bench, scan: PlannedScan, tracer: Tracer, response: Response) -> Signals:
    """Measure the first views of a scan without noise.

    No pixel gets further sub-rays for its estimated error: whether it does may depend on the rule.
    """
    few = {"subrays": scan.plan.settings.subrays, "edge_tolerance": math.inf}
    return [transmit(tracer, scan.scanner.geometry, view, response, **few)[0] for view in range(setup.views)]


def in_logarithm(one: Signals, other: Signals) -> float:
    """Return the largest difference of P of two lists of signals."""
    return largest([np.log(a) for a in one], [np.log(b) for b in other])


def energies(setup: Bench) -> Iterator[Pair]:
    """Yield a scan at the plan's Gauss nodes and at every energy of the spectrum, with the same sub-rays."""
    scan = setup.planned()
    plan, tracer = scan.plan, Tracer.of(compact(scan.phantom, scan.plan.materials))
    fine = full_rule(plan.spectrum, scan.scanner.detector)
    few, every = (Response.of(rule, tracer.materials) for rule in (plan.rule, fine))
    # an edge's sub-rays are counted by the mean attenuation, in which both differ by 6e-5
    alike = replace(every, edge_mu=few.edge_mu)
    measured = partial(signals, setup, scan, tracer)
    moved = in_logarithm(measured(every), measured(alike))
    yield Pair(
        scene=scan.scene.name,
        what=f"{len(plan.rule.energies)} energies instead of {len(fine.energies)}",
        skipping=partial(measured, few),
        whole=partial(measured, alike),
        difference=in_logarithm,
        limit=1.1 * plan.settings.tolerance,  # between the paths tried it is up to a tenth more
        stated="simulation.tolerance and docs/explanation/physics.md",
        note=f"sub-rays counted by its own mean attenuation move edge pixels by up to {moved:.2g}" if moved else "",
    )


def edges(setup: Bench) -> Iterator[Pair]:
    """Yield a scan of solids with sub-rays at their edges, and with all of them wherever a solid's thickness varies.

    What is compared is the pixels left to their central ray, in a few views; the others get as many sub-rays as the
    change of thickness is worth, which is accuracy chosen and stands in the note.
    """
    thorax = setup.scene()
    recipe = Validation(n_voxel=thorax.phantom.n_voxel, size=thorax.phantom.size, metal="Fe")
    scan = setup.planned(msgspec.structs.replace(thorax, name="rods-Fe", phantom=recipe), Truth())
    tracer, geometry, most = Tracer.of(scan.phantom), scan.scanner.geometry, scan.plan.settings.subrays
    few = Response.of(scan.plan.rule, tracer.materials)
    # every change of thickness is then one that takes all sub-rays
    every = replace(few, edge_mu=1e9 * few.edge_mu)

    def plain(view: int) -> NDArray[np.bool_]:
        # with so many sub-rays only pixels that have none keep the value of their central ray
        one, many = (
            transmit(tracer, geometry, view, few, subrays=n, edge_tolerance=math.inf)[0] for n in (1, 16 * most)
        )
        return one == many

    central = [plain(view) for view in range(min(setup.views, 4))]

    def difference(a: Signals, b: Signals) -> float:
        return in_logarithm(*([signal[view][kept] for view, kept in enumerate(central)] for signal in (a, b)))

    measured = partial(signals, setup, scan, tracer)
    moved = in_logarithm(measured(few), measured(every))
    yield Pair(
        scene=scan.scene.name,
        what=f"sub-rays where solids have no edge: {np.mean(central):.0%} of pixels",
        skipping=partial(measured, few),
        whole=partial(measured, every),
        difference=difference,
        # of concave thickness: two thirds of the change in the mean, an eighth of its range's square in the logarithm
        limit=2 / 3 * EDGE_THRESHOLD + (2 * EDGE_THRESHOLD) ** 2 / 8,
        stated="docs/explanation/skipping.md",
        note=f"all sub-rays instead of a share move the worst pixel at an edge by {moved:.2g}",
    )


def refining(setup: Bench) -> Iterator[Pair]:
    """Yield scans without and with further sub-rays for edge pixels that are too far off: their cost, not an error."""
    for scan in setup.inside_and_outside():
        settings = msgspec.structs.replace(scan.plan.settings, edge_tolerance=math.inf)
        without = replace(scan, plan=replace(scan.plan, settings=settings))
        what = f"further sub-rays for edge pixels estimated to be off by over {scan.plan.settings.edge_tolerance} in P"
        note = "by default they are made: the gain is what they cost"
        yield setup.pair(what, without, scan, limit=None, stated="a choice", note=note)


def scatter(setup: Bench) -> Iterator[Pair]:
    """Yield a scan without and with the constant scatter of level 1: what level 0 leaves out, not an error."""
    plain, scattering = setup.planned(), setup.planned(scatter=Scatter(level=1))
    note = f"level 1 adds S/I0 = {scattering.plan.scatter_fraction:.2g} to every pixel"
    yield setup.pair(
        "scatter at level 0, which leaves it out", plain, scattering, limit=None, stated="a choice", note=note
    )


def twin(setup: Bench) -> Iterator[Pair]:
    """Yield scans with their metal-free twins, measured in the metal's shadow only, and as two whole scans."""
    for scan in setup.inside_and_outside():
        single = msgspec.structs.replace(LINES, twin=False)
        both = (scan.phantom, scan.phantom.without_metal())
        alone, bare = (setup.planned(scan.scene, single, phantom=phantom) for phantom in both)
        # the same energies and table for both, as the twin has
        bare = replace(bare, plan=replace(bare.plan, rule=scan.plan.rule, materials=scan.plan.materials))
        yield Pair(
            scene=scan.scene.name,
            what="rays and draws of the metal-free twin out of the metal's shadow",
            skipping=setup.next_views(scan),
            whole=in_pairs(setup.next_views(alone), setup.next_views(bare)),
            difference=apart,
            unit="counts and P",
        )


def in_pairs(scan: Callable[[], Images], bare: Callable[[], Images]) -> Callable[[], Images]:
    """Return what makes the next views of a scan and of the body without metal, named as its twin's."""
    return lambda: [
        a | {f"metal_free/{name}": image for name, image in b.items()} for a, b in zip(scan(), bare(), strict=True)
    ]


def truth(setup: Bench) -> Iterator[Pair]:
    """Yield a scan with no more ground truth than is asked for, and with all there is."""
    every = Truth(noise_free=True, scatter_free=True, mono_kev=(60.0,), trace=True, metal_path=True, paths=True)
    asked, all_of_it = (setup.planned(truth=t) for t in (Truth(), every))
    yield setup.pair("ground truth that is not asked for", asked, all_of_it, difference=apart, unit="counts")


NAMED = (materials, bricks, rays, energies, edges, refining, scatter, twin, truth)
CASES: Cases = {case.__name__: case for case in NAMED}
