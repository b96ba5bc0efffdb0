"""What `run-benchmark skipping` measures of the simulator: each skip as a pair of runs, with it and without it.

Both run in turns on the same views, after one run each that is not counted. What a scan prepares once (bricks, columns,
solids) is prepared before the clock starts. The pairs of effects that a scanner
may leave out are in `effects`, those of methods and commands in `methods`.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.beam.quadrature import full_rule
from ctsim.benchmarks.engine.host import in_turns
from ctsim.benchmarks.studies.skipping.study import CORE, Skip
from ctsim.benchmarks.suites import load, select
from ctsim.phantoms.bodies.rods import Validation
from ctsim.phantoms.scanners import ScannerSettings
from ctsim.phantoms.scene import Scene, build, stream_id
from ctsim.plan import Plan, make_plan
from ctsim.settings import Truth
from ctsim.simulate import compact, simulate_views
from ctsim.tracer.bricks import Bricks, make_bricks
from ctsim.tracer.layers import layers_seen
from ctsim.tracer.project import EDGE_THRESHOLD, Response, Tracer, transmit
from ctsim.tracer.shadow import MOST_TIMES
from ctsim.types import Phantom, Scanner

LINES = Truth(noise_free=True)
P_IMAGES = ("noise_free", "metal_free/noise_free")
HALF_ULP = 2.0**-24  # of float32, relative
ABSENT = ("Al", "Ti", "Cu", "Au")  # metals that the thorax does not hold
Images = Sequence[dict[str, NDArray[Any]]]
Signals = list[NDArray[np.float32]]


def largest(one: Sequence[Any], other: Sequence[Any]) -> float:
    """Return the largest |a − b| of two sequences of arrays, pair by pair; NaN where either holds NaN."""
    found = [np.abs(np.asarray(a, np.float64) - np.asarray(b)).max() for a, b in zip(one, other, strict=True)]
    if not found:
        raise ValueError("there is nothing to compare")
    return float(np.max(found))


def image_difference(one: Images, other: Images, names: Sequence[str] = ()) -> float:
    """Return the largest difference of the named images, by default of all that both ways have."""
    named = names or sorted(one[0].keys() & other[0].keys())
    return largest(*([view[name] for view in way for name in named] for way in (one, other)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """One result computed with a skip and without it, and how the two are compared. Fields as in `Skip`."""

    scene: str
    what: str
    skipping: Callable[[], Any]
    whole: Callable[[], Any]
    difference: Callable[[Any, Any], float] = largest
    unit: str = "P"
    limit: float | None = 0.0
    stated: str = "exact"
    note: str = ""

    def measure(self, repeats: int) -> Skip:
        """Run both ways in turns; compare the results of the last turn."""
        last: dict[str, Any] = {}

        def run(name: str) -> None:
            last[name] = getattr(self, name)()

        seconds = in_turns({name: partial(run, name) for name in ("skipping", "whole")}, repeats)
        difference = self.difference(last["skipping"], last["whole"])
        finite = math.isfinite(difference)
        alike = ("scene", "what", "unit", "limit", "stated", "note")
        return Skip(
            ok=finite and (self.limit is None or difference <= self.limit),
            seconds={name: counted for name, (_, counted) in seconds.items()},
            difference=difference if finite else None,
            **{name: getattr(self, name) for name in alike},
        )


# --- scans of a few views -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class PlannedScan:
    """A scene's scan, ready to be simulated."""

    scene: Scene
    plan: Plan
    phantom: Phantom
    scanner: Scanner

    def views(self) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
        """Simulate view after view."""
        return simulate_views(self.plan, self.phantom, self.scanner)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench:
    """The size of the cases, the number of counted runs, and a folder for files.

    `size` "core" is the scene lung-Fe of that suite, "small" a tiny one that only proves the command.
    """

    size: str = CORE
    repeats: int = 5
    folder: Path

    @property
    def views(self) -> int:
        """Views of one run of a simulator case."""
        return 16 if self.size == CORE else 2

    def scene(self, suite: str = "core", name: str = "lung-Fe") -> Scene:
        """Return a bundled scene, the thorax with iron by default; on tiny grids where the size is small."""
        (found,) = select(load(suite), (name,), ())
        if self.size == CORE:
            return found
        scanner = msgspec.structs.replace(found.scanner, n_voxel=(16, 16, 16), n_detector=(24, 24), n_views=12)
        phantom = msgspec.structs.replace(found.phantom, n_voxel=(24, 24, 24))
        simulation = msgspec.structs.replace(found.simulation, scatter_error=0.5)  # photons would take all of the time
        return msgspec.structs.replace(found, phantom=phantom, scanner=scanner, simulation=simulation)

    def inside_and_outside(self) -> Iterator[PlannedScan]:
        """Yield a scan with metal seen only through the body, and one with metal also seen next to the body."""
        yield from map(self.planned, (self.scene(), self.scene("lookalike", "chicken-Fe")))

    def planned(
        self, scene: Scene | None = None, truth: Truth = LINES, *, phantom: Phantom | None = None, **changes: Any
    ) -> PlannedScan:
        """Plan a scene, by default the thorax, with `phantom` in place of its own and `changes` of its scanner.

        It has new views for every run, and one more to prepare with.
        """
        scene = scene or self.scene()
        phantom, scanner = phantom or build(scene), msgspec.structs.replace(scene.resolve(), **changes)
        geometry = msgspec.structs.replace(scanner.geometry, n_views=1 + self.views * (self.repeats + 1))
        scanner = msgspec.structs.replace(scanner, geometry=geometry)
        plan = make_plan(phantom, scanner, scene.simulation, truth, stream_id(scene))
        return PlannedScan(scene=scene, plan=plan, phantom=phantom, scanner=scanner)

    def next_views(self, scan: PlannedScan) -> Callable[[], Images]:
        """Prepare a scan and make its first view; return a function that makes the next few views at each call."""
        views = scan.views()
        next(views)
        return lambda: [images for _, images in itertools.islice(views, self.views)]

    def first_views(self, scan: PlannedScan) -> Callable[[], Images]:
        """Return a function that begins a scan at each call and makes its first few views."""
        return lambda: [images for _, images in itertools.islice(scan.views(), self.views)]

    def pair(self, what: str, skipping: PlannedScan, whole: PlannedScan, **more: Any) -> Pair:
        """Return a pair of scans, compared by P without noise unless `more` says otherwise."""
        ways = {"skipping": self.next_views(skipping), "whole": self.next_views(whole)}
        given: dict[str, Any] = {"difference": partial(image_difference, names=P_IMAGES)} | ways | more
        return Pair(scene=skipping.scene.name, what=what, **given)


def rounding(scan: PlannedScan) -> float:
    """Bound |ΔP| by rounding of two ways with the same rays, or with equal rays repeated; `scan` skips nothing.

    Each way rounds in float32: a product and a sum per material in every τ; exp(−τ), within 4e-7·max(1, τ/4)
    (tests/test_project.py); a product and a sum per energy; a division by the open field; the logarithm, within 4 ulp
    (NumPy states 3.83), which are at most 8 half ulps of P. The signal's error is the mean error of its
    energies, weighted by their transmission; the mean τ under these weights is at most P (Gibbs' inequality). A pixel
    has up to `subrays`·`MOST_TIMES` rays, summed one after the other; outside a shadow it has one ray with the skip,
    and that number of equal rays without it.
    """
    p = max(0.0, *(float(np.max(images["noise_free"])) for _, images in scan.views()))
    materials, energies = len(scan.plan.materials), len(scan.plan.rule.energies)
    rays = scan.plan.settings.subrays * MOST_TIMES
    return 2 * ((materials * p + energies + rays + 1 + 8 * p) * HALF_ULP + 4e-7 * (1 + p / 4))


# --- pairs --------------------------------------------------------------------------------------------


def materials(setup: Bench) -> Iterator[Pair]:
    """Yield a phantom whose table names metals that it does not hold, traced without them and with them."""
    body = build(setup.scene())
    scan = setup.planned(phantom=replace(body, materials=body.materials + ABSENT))
    names = scan.phantom.materials
    every = replace(scan, plan=replace(scan.plan, materials=names, tissues=names))
    what = f"materials that do not occur: {', '.join(ABSENT)}"
    yield setup.pair(what, scan, every, limit=rounding(every), stated="rounding")


def all_mixed(phantom: Phantom) -> Bricks:
    """Return the phantom's bricks, none with a single label: rays visit every voxel, air included.

    Each label becomes two, by the parity of the voxel, so that every brick is mixed; in the bricks they are one again.
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
        # both ways add in 2⁻⁴⁰ mm or float64, then round to float32
        limit=float(np.spacing(np.float32(longest))),
        stated="float32 of the longest path",
    )


def rays(setup: Bench) -> Iterator[Pair]:
    """Yield scans that trace rays and primitives only where shadows fall, and everywhere."""
    for scan in setup.inside_and_outside():
        settings = msgspec.structs.replace(scan.plan.settings, skip=False)
        every = replace(scan, plan=replace(scan.plan, settings=settings))
        what = "rays that miss the object, and inserts that a ray cannot meet"
        yield setup.pair(what, scan, every, limit=rounding(every), stated="rounding")


def signals(setup: Bench, scan: PlannedScan, tracer: Tracer, response: Response) -> Signals:
    """Measure the first views of a scan without noise.

    No pixel gets further sub-rays for its estimated error, which may depend on the energy rule.
    """
    few = {"subrays": scan.plan.settings.subrays, "edge_tolerance": math.inf}
    return [transmit(tracer, scan.scanner.geometry, view, response, **few)[0] for view in range(setup.views)]


def in_logarithm(one: Signals, other: Signals) -> float:
    """Return the largest difference of P between two lists of signals."""
    return largest([np.log(a) for a in one], [np.log(b) for b in other])


def layers(setup: Bench) -> Iterator[Pair]:
    """Yield the body of a scan of one detector row, drawn where the row sees it, and drawn as a whole."""
    scene = setup.scene()
    whole = scene.resolve().geometry
    geometry = msgspec.structs.replace(whole, n_detector=(1, whole.n_detector[1]), n_voxel=(1, *whole.n_voxel[1:]))
    one = msgspec.structs.replace(scene, scanner=ScannerSettings(geometry=geometry), truncated=True)

    def labels(whole: bool) -> list[NDArray[np.uint8]]:
        return [layers_seen(build(one, whole=whole), geometry).labels]

    yield Pair(
        scene=scene.name,
        what="layers of the body that one detector row does not see",
        skipping=partial(labels, False),
        whole=partial(labels, True),
        unit="labels",
        note=f"{len(labels(True)[0])} of {scene.phantom.n_voxel[0]} layers",
    )


def energies(setup: Bench) -> Iterator[Pair]:
    """Yield a scan at the plan's Gauss nodes, and at every energy of the spectrum with the same sub-rays."""
    scan = setup.planned()
    plan, tracer = scan.plan, Tracer.of(compact(scan.phantom, scan.plan.materials))
    fine = full_rule(plan.spectrum, scan.scanner.detector)
    few, every = (Response.of(rule, tracer.materials) for rule in (plan.rule, fine))
    # the mean attenuation sets the number of an edge's sub-rays; the two rules' means differ by 6e-5
    alike = replace(every, edge_mu=few.edge_mu)
    measured = partial(signals, setup, scan, tracer)
    moved = in_logarithm(measured(every), measured(alike))
    yield Pair(
        scene=scan.scene.name,
        what=f"{len(plan.rule.energies)} energies instead of {len(fine.energies)}",
        skipping=partial(measured, few),
        whole=partial(measured, alike),
        difference=in_logarithm,
        limit=1.1 * plan.settings.tolerance,  # a tenth more between the lengths it tried
        stated="simulation.tolerance and docs/explanation/physics.md",
        note=f"sub-rays counted by its own mean attenuation move edge pixels by up to {moved:.2g}" if moved else "",
    )


def edges(setup: Bench) -> Iterator[Pair]:
    """Yield a scan of solids with sub-rays at edges only, and with all sub-rays wherever the thickness varies.

    Compared are the pixels that keep their central ray, in a few views. The other pixels have more sub-rays where the
    thickness changes more: a choice of accuracy, stated in the note.
    """
    thorax = setup.scene()
    recipe = Validation(n_voxel=thorax.phantom.n_voxel, size=thorax.phantom.size, metal="Fe")
    scan = setup.planned(msgspec.structs.replace(thorax, name="rods-Fe", phantom=recipe), Truth())
    tracer, geometry, most = Tracer.of(scan.phantom), scan.scanner.geometry, scan.plan.settings.subrays
    few = Response.of(scan.plan.rule, tracer.materials)
    # then every change of thickness takes all sub-rays
    every = replace(few, edge_mu=1e9 * few.edge_mu)

    def plain(view: int) -> NDArray[np.bool_]:
        # with 16 times the sub-rays every pixel changes but those that keep their central ray
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
        # concave thickness: 2/3 of the change from the mean, 1/8 of the squared range from the logarithm
        limit=2 / 3 * EDGE_THRESHOLD + (2 * EDGE_THRESHOLD) ** 2 / 8,
        stated="docs/explanation/skipping.md",
        note=f"all sub-rays instead of a share move the worst pixel at an edge by {moved:.2g}",
    )


def refining(setup: Bench) -> Iterator[Pair]:
    """Yield scans without and with further sub-rays for edge pixels of large estimated error; shows their cost."""
    for scan in setup.inside_and_outside():
        settings = msgspec.structs.replace(scan.plan.settings, edge_tolerance=math.inf)
        without = replace(scan, plan=replace(scan.plan, settings=settings))
        what = f"further sub-rays for edge pixels estimated to be off by over {scan.plan.settings.edge_tolerance} in P"
        note = "by default they are made: the gain is what they cost"
        yield setup.pair(what, without, scan, limit=None, stated="a choice", note=note)


def twin(setup: Bench) -> Iterator[Pair]:
    """Yield scans with metal-free twins: the twin made in the metal's shadow only, and as a whole scan."""
    for scan in setup.inside_and_outside():
        single = msgspec.structs.replace(LINES, twin=False)
        both = (scan.phantom, scan.phantom.without_metal())
        alone, bare = (setup.planned(scan.scene, single, phantom=phantom) for phantom in both)
        # the twin's energies and materials
        known = scan.plan
        bare = replace(bare, plan=replace(bare.plan, rule=known.rule, materials=known.materials, tissues=known.tissues))
        yield Pair(
            scene=scan.scene.name,
            what="rays and draws of the metal-free twin out of the metal's shadow",
            skipping=setup.next_views(scan),
            whole=in_pairs(setup.next_views(alone), setup.next_views(bare)),
            difference=image_difference,
            unit="counts and P",
        )


def in_pairs(scan: Callable[[], Images], bare: Callable[[], Images]) -> Callable[[], Images]:
    """Return a function that makes the next views of a scan and, under its twin's names, of the bare body."""
    return lambda: [
        a | {f"metal_free/{name}": image for name, image in b.items()} for a, b in zip(scan(), bare(), strict=True)
    ]


def truth(setup: Bench) -> Iterator[Pair]:
    """Yield a scan with the default ground truth, and with all of it."""
    every = Truth(noise_free=True, scatter_free=True, mono_kev=(60.0,), trace=True, metal_path=True, paths=True)
    asked, all_of_it = (setup.planned(truth=t) for t in (Truth(), every))
    yield setup.pair("ground truth that is not asked for", asked, all_of_it, difference=image_difference, unit="counts")


NAMED = (materials, bricks, rays, layers, energies, edges, refining, twin, truth)
Cases = dict[str, Callable[[Bench], Iterator[Pair]]]
CASES: Cases = {case.__name__: case for case in NAMED}
