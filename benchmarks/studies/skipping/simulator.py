"""What `run-benchmark skipping` measures: what the simulator leaves out, done with and without it.

Each pair is two ways to the same result that differ in one skip. They run in turns on the same views, after one
run each that is not counted; what a scan prepares once (bricks, columns, solids) is prepared before the clock.
Those of methods and commands are in `skipping_methods`.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.engine.host import in_turns
from ctsim.benchmarks.studies.skipping.finding import CORE, Skip
from ctsim.benchmarks.studies.skipping.limits import rounding
from ctsim.benchmarks.suites import load, select
from ctsim.bricks import Bricks, make_bricks
from ctsim.geometry import Geometry
from ctsim.phantoms.bodies import Validation
from ctsim.phantoms.scene import Scene, build, stream_id
from ctsim.plan import Plan, make_plan
from ctsim.project import EDGE_THRESHOLD, Response, Tracer, transmit
from ctsim.quadrature import full_rule
from ctsim.scatter import Scatter
from ctsim.settings import Truth
from ctsim.simulate import compact, simulate_views
from ctsim.types import Phantom, Scanner

ABSENT = ("Al", "Ti", "Cu", "Au")  # metals that a table may name and a thorax does not hold
LINES = Truth(noise_free=True)
Images = Sequence[dict[str, NDArray[Any]]]
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """How large the cases are, counted runs, and a folder of their own.

    `size` "core" is the scene lung-Fe of that suite as it is, "small" one that proves the command only.
    """

    size: str = CORE
    repeats: int = 5
    folder: Path

    @property
    def views(self) -> int:
        """Views of one run of the simulator's cases."""
        return 16 if self.size == CORE else 2

    def scene(self, suite: str = "core", name: str = "lung-Fe") -> Scene:
        """Return a bundled scene, the thorax with iron by default."""
        (found,) = select(load(suite), (name,), ())
        return found if self.size == CORE else shrunk(found)

    def inside_and_outside(self) -> tuple[Scene, Scene]:
        """Return a scene whose metal is seen through the body only, and one whose metal is seen beside it, too."""
        return self.scene(), self.scene("real", "chicken-Fe")

    def scanner(self, scene: Scene) -> Scanner:
        """Return the scene's scanner with new views for every run, and one to prepare."""
        scanner = scene.resolve()
        n_views = 1 + self.views * (self.repeats + 1)
        return msgspec.structs.replace(scanner, geometry=msgspec.structs.replace(scanner.geometry, n_views=n_views))


def shrunk(scene: Scene) -> Scene:
    """Return the scene on tiny grids."""
    return msgspec.structs.replace(
        scene,
        phantom=msgspec.structs.replace(scene.phantom, n_voxel=(24, 24, 24)),
        scanner=msgspec.structs.replace(scene.scanner, n_voxel=(16, 16, 16), n_detector=(24, 24), n_views=12),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair(Generic[T]):
    """Two ways to one result, and how far apart results are. Fields as in `Skip`."""

    scene: str
    what: str
    skipping: Callable[[], T]
    whole: Callable[[], T]
    difference: Callable[[T, T], float]
    unit: str
    limit: float | None = 0.0
    stated: str = "exact"
    note: str = ""

    def measure(self, repeats: int) -> Skip:
        """Run both in turns; the results of the last turn are compared."""
        last: dict[str, T] = {}

        def run(name: str, way: Callable[[], T]) -> Callable[[], None]:
            def once() -> None:
                last[name] = way()

            return once

        ways = {"skipping": run("skipping", self.skipping), "whole": run("whole", self.whole)}
        seconds = {name: counted for name, (_, counted) in in_turns(ways, repeats).items()}
        difference = self.difference(last["skipping"], last["whole"])
        finite = math.isfinite(difference)
        return Skip(
            ok=finite and (self.limit is None or difference <= self.limit),
            seconds=seconds,
            scene=self.scene,
            what=self.what,
            difference=difference if finite else None,
            unit=self.unit,
            limit=self.limit,
            stated=self.stated,
            note=self.note,
        )


# --- what a scan of some views gives ------------------------------------------------------------------


def planned(
    setup: Setup, truth: Truth = LINES, scene: Scene | None = None, **changes: Any
) -> tuple[Plan, Phantom, Scanner]:
    """Return the plan of a scene (the thorax by default), its phantom, and its scanner with `changes`."""
    scene = scene or setup.scene()
    phantom, scanner = build(scene), msgspec.structs.replace(setup.scanner(scene), **changes)
    return make_plan(phantom, scanner, scene.simulation, truth, stream_id(scene)), phantom, scanner


def next_views(setup: Setup, plan: Plan, phantom: Phantom, scanner: Scanner) -> Callable[[], Images]:
    """Prepare a scan and make its first view; return what makes the next few views at each call."""
    views = simulate_views(plan, phantom, scanner)
    next(views)
    return lambda: [images for _, images in itertools.islice(views, setup.views)]


def apart(one: Images, other: Images, names: Sequence[str] = ()) -> float:
    """Return the largest difference of the named images, all that both have by default."""
    pairs = [
        (a[name], b[name])
        for a, b in zip(one, other, strict=True)
        for name in (names or sorted(a.keys() & b.keys()))
    ]  # fmt: skip
    return largest(pairs)


def largest(pairs: Sequence[tuple[NDArray[Any], NDArray[Any]]]) -> float:
    """Return the largest |a − b| of pairs of arrays of one shape; not a number where either holds such."""
    if not pairs:
        raise ValueError("there is nothing to compare")
    return float(np.max([np.abs(a.astype(np.float64) - b).max() for a, b in pairs]))


# --- the simulator's skips ----------------------------------------------------------------------------


def materials(setup: Setup) -> Iterator[Pair[Images]]:
    """Yield a phantom whose table names metals that it does not hold, traced without and with them."""
    scene = setup.scene()
    body, scanner = build(scene), setup.scanner(scene)
    phantom = dataclasses.replace(body, materials=body.materials + ABSENT)
    plan = make_plan(phantom, scanner, scene.simulation, LINES, stream_id(scene))
    every = dataclasses.replace(plan, materials=phantom.materials)
    yield Pair(
        scene=scene.name,
        what=f"materials that do not occur: {', '.join(ABSENT)}",
        skipping=next_views(setup, plan, phantom, scanner),
        whole=next_views(setup, every, phantom, scanner),
        difference=lambda a, b: apart(a, b, ("noise_free", "metal_free/noise_free")),
        unit="P",
        limit=rounding(every, phantom, scanner),
        stated="rounding",
    )


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


def bricks(setup: Setup) -> Iterator[Pair[list[NDArray[np.float32]]]]:
    """Yield path lengths with bricks of one label crossed in one step, and voxel by voxel."""
    scene = setup.scene()
    phantom, geometry = build(scene), setup.scanner(scene).geometry
    fast = dataclasses.replace(Tracer.of(phantom), columns=None)
    slow = dataclasses.replace(fast, bricks=all_mixed(phantom))

    def lengths(tracer: Tracer) -> list[NDArray[np.float32]]:
        return [tracer.background(geometry, view) for view in range(setup.views)]

    longest = max(float(np.max(view)) for view in lengths(fast))
    yield Pair(
        scene=scene.name,
        what="bricks of one label, air among them, crossed in one step",
        skipping=lambda: lengths(fast),
        whole=lambda: lengths(slow),
        difference=lambda a, b: largest(list(zip(a, b, strict=True))),
        unit="mm",
        # both add up in 2⁻⁴⁰ mm or float64, and are then rounded to float32
        limit=float(np.spacing(np.float32(longest))),
        stated="float32 of the longest path",
    )


def rays(setup: Setup) -> Iterator[Pair[Images]]:
    """Yield scans whose rays and primitives are looked at where shadows fall, and everywhere."""
    for scene in setup.inside_and_outside():
        plan, phantom, scanner = planned(setup, scene=scene)
        every = dataclasses.replace(plan, settings=msgspec.structs.replace(plan.settings, skip=False))
        yield Pair(
            scene=scene.name,
            what="rays that miss the object, and inserts that a ray cannot meet",
            skipping=next_views(setup, plan, phantom, scanner),
            whole=next_views(setup, every, phantom, scanner),
            difference=lambda a, b: apart(a, b, ("noise_free", "metal_free/noise_free")),
            unit="P",
            limit=rounding(every, phantom, scanner),
            stated="rounding",
        )


def signals(setup: Setup, scan: tuple[Tracer, Geometry, int], response: Response) -> list[NDArray[np.float32]]:
    """Measure the first views of a scan of (tracer, geometry, most sub-rays) without noise.

    No pixel gets further sub-rays for its estimated error: whether it does may depend on the rule.
    """
    tracer, geometry, most = scan
    few = {"subrays": most, "edge_tolerance": math.inf}
    return [transmit(tracer, geometry, view, response, **few)[0] for view in range(setup.views)]


def in_logarithm(one: Sequence[NDArray[np.float32]], other: Sequence[NDArray[np.float32]]) -> float:
    """Return the largest difference of P of two lists of signals."""
    return largest([(np.log(a), np.log(b)) for a, b in zip(one, other, strict=True)])


def energies(setup: Setup) -> Iterator[Pair[list[NDArray[np.float32]]]]:
    """Yield a scan at the plan's Gauss nodes and at every energy of the spectrum, with the same sub-rays."""
    plan, phantom, scanner = planned(setup)
    body = compact(phantom, plan.materials)
    tracer, fine = Tracer.of(body), full_rule(plan.spectrum, scanner.detector)
    scan = tracer, scanner.geometry, plan.settings.subrays
    few, every = (Response.of(rule, tracer.materials) for rule in (plan.rule, fine))
    # an edge's sub-rays are counted by the mean attenuation, in which both differ by 6e-5
    alike = dataclasses.replace(every, edge_mu=few.edge_mu)
    moved = in_logarithm(signals(setup, scan, every), signals(setup, scan, alike))
    yield Pair(
        scene=setup.scene().name,
        what=f"{len(plan.rule.energies)} energies instead of {len(fine.energies)}",
        skipping=lambda: signals(setup, scan, few),
        whole=lambda: signals(setup, scan, alike),
        difference=in_logarithm,
        unit="P",
        limit=1.1 * plan.settings.tolerance,  # between the paths tried it is up to a tenth more
        stated="simulation.tolerance and docs/explanation/physics.md",
        note=f"sub-rays counted by its own mean attenuation move edge pixels by up to {moved:.2g}" if moved else "",
    )


def edges(setup: Setup) -> Iterator[Pair[list[NDArray[np.float32]]]]:
    """Yield a scan of solids with sub-rays at their edges, and with all of them wherever a solid's thickness varies.

    What is compared is the pixels left to their central ray, in a few views; the others get as many sub-rays as the
    change of thickness is worth, which is accuracy chosen and stands in the note.
    """
    scene = setup.scene()
    recipe = Validation(n_voxel=scene.phantom.n_voxel, size=scene.phantom.size, metal="Fe")
    scene = msgspec.structs.replace(scene, name="rods-Fe", phantom=recipe)
    phantom, scanner = build(scene), setup.scanner(scene)
    plan = make_plan(phantom, scanner, scene.simulation, Truth(), stream_id(scene))
    tracer, geometry, most = scan = Tracer.of(phantom), scanner.geometry, plan.settings.subrays
    few = Response.of(plan.rule, tracer.materials)
    # every change of thickness is then one that takes all sub-rays
    every = dataclasses.replace(few, edge_mu=1e9 * few.edge_mu)

    def plain(view: int) -> NDArray[np.bool_]:
        # with so many sub-rays only pixels that have none keep the value of their central ray
        one, many = (
            transmit(tracer, geometry, view, few, subrays=n, edge_tolerance=math.inf)[0] for n in (1, 16 * most)
        )
        return one == many

    central = [plain(view) for view in range(min(setup.views, 4))]

    def difference(a: list[NDArray[np.float32]], b: list[NDArray[np.float32]]) -> float:
        return in_logarithm(*([signal[view][kept] for view, kept in enumerate(central)] for signal in (a, b)))

    moved = in_logarithm(signals(setup, scan, few), signals(setup, scan, every))
    yield Pair(
        scene=scene.name,
        what=f"sub-rays where solids have no edge: {np.mean(central):.0%} of pixels",
        skipping=lambda: signals(setup, scan, few),
        whole=lambda: signals(setup, scan, every),
        difference=difference,
        unit="P",
        # of concave thickness: two thirds of the change in the mean, an eighth of its range's square in the logarithm
        limit=2 / 3 * EDGE_THRESHOLD + (2 * EDGE_THRESHOLD) ** 2 / 8,
        stated="docs/explanation/skipping.md",
        note=f"all sub-rays instead of a share move the worst pixel at an edge by {moved:.2g}",
    )


def refining(setup: Setup) -> Iterator[Pair[Images]]:
    """Yield scans without and with further sub-rays for edge pixels that are too far off: their cost, not an error."""
    for scene in setup.inside_and_outside():
        plan, phantom, scanner = planned(setup, scene=scene)
        settings = msgspec.structs.replace(plan.settings, edge_tolerance=math.inf)
        yield Pair(
            scene=scene.name,
            what=f"further sub-rays for edge pixels estimated to be off by over {plan.settings.edge_tolerance} in P",
            skipping=next_views(setup, dataclasses.replace(plan, settings=settings), phantom, scanner),
            whole=next_views(setup, plan, phantom, scanner),
            difference=lambda a, b: apart(a, b, ("noise_free", "metal_free/noise_free")),
            unit="P",
            limit=None,
            stated="a choice",
            note="by default they are made: the gain is what they cost",
        )


def scatter(setup: Setup) -> Iterator[Pair[Images]]:
    """Yield a scan without and with the constant scatter of level 1: what level 0 leaves out, not an error."""
    plain, phantom, scanner = planned(setup)
    plan, _, scattering = planned(setup, scatter=Scatter(level=1))
    yield Pair(
        scene=setup.scene().name,
        what="scatter at level 0, which leaves it out",
        skipping=next_views(setup, plain, phantom, scanner),
        whole=next_views(setup, plan, phantom, scattering),
        difference=lambda a, b: apart(a, b, ("noise_free", "metal_free/noise_free")),
        unit="P",
        limit=None,
        stated="a choice",
        note=f"level 1 adds S/I0 = {plan.scatter_fraction:.2g} to every pixel",
    )


def twin(setup: Setup) -> Iterator[Pair[Images]]:
    """Yield scans with their metal-free twins, measured in the metal's shadow only, and as two whole scans."""
    for scene in setup.inside_and_outside():
        plan, phantom, scanner = planned(setup, scene=scene)
        single, bare = msgspec.structs.replace(LINES, twin=False), phantom.without_metal()
        alone = make_plan(phantom, scanner, scene.simulation, single, plan.stream_id)
        # the same energies and table for both, as the twin has
        without = make_plan(bare, scanner, scene.simulation, single, plan.stream_id)
        without = dataclasses.replace(without, rule=plan.rule, materials=plan.materials)
        yield Pair(
            scene=scene.name,
            what="rays and draws of the metal-free twin out of the metal's shadow",
            skipping=next_views(setup, plan, phantom, scanner),
            whole=in_pairs(next_views(setup, alone, phantom, scanner), next_views(setup, without, bare, scanner)),
            difference=apart,
            unit="counts and P",
        )


def in_pairs(scan: Callable[[], Images], bare: Callable[[], Images]) -> Callable[[], Images]:
    """Return what makes the next views of a scan and of the body without metal, named as its twin's."""
    return lambda: [
        a | {f"metal_free/{name}": image for name, image in b.items()} for a, b in zip(scan(), bare(), strict=True)
    ]


def truth(setup: Setup) -> Iterator[Pair[Images]]:
    """Yield a scan with no more ground truth than is asked for, and with all there is."""
    plan, phantom, scanner = planned(setup, Truth())
    asked = Truth(noise_free=True, scatter_free=True, mono_kev=(60.0,), trace=True, metal_path=True, paths=True)
    every = planned(setup, asked)[0]
    yield Pair(
        scene=setup.scene().name,
        what="ground truth that is not asked for",
        skipping=next_views(setup, plan, phantom, scanner),
        whole=next_views(setup, every, phantom, scanner),
        difference=apart,
        unit="counts",
    )


Pairs = Callable[[Setup], Iterator[Pair[Any]]]
CASES: dict[str, Pairs] = {
    "materials": materials,
    "bricks": bricks,
    "rays": rays,
    "energies": energies,
    "edges": edges,
    "refining": refining,
    "scatter": scatter,
    "twin": twin,
    "truth": truth,
}
