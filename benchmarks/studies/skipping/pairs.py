"""Two ways to one result that differ in what is left out, how they are timed, and how far apart rounding brings them.

Both run in turns on the same views, after one run each that is not counted; what a scan prepares once (bricks, columns,
solids) is prepared before the clock.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.engine.host import in_turns
from ctsim.benchmarks.studies.skipping.study import CORE, Skip
from ctsim.benchmarks.suites import load, select
from ctsim.phantoms.scene import Scene, build, stream_id
from ctsim.plan import Plan, make_plan
from ctsim.settings import Truth
from ctsim.shadow import MOST_TIMES
from ctsim.simulate import simulate_views
from ctsim.types import Phantom, Scanner

LINES = Truth(noise_free=True)
P_IMAGES = ("noise_free", "metal_free/noise_free")
HALF_ULP = 2.0**-24  # of float32, relative
Images = Sequence[dict[str, NDArray[Any]]]


def largest(one: Sequence[Any], other: Sequence[Any]) -> float:
    """Return the largest |a − b| of two sequences of arrays in pairs; not a number where either holds such."""
    found = [np.abs(np.asarray(a, np.float64) - np.asarray(b)).max() for a, b in zip(one, other, strict=True)]
    if not found:
        raise ValueError("there is nothing to compare")
    return float(np.max(found))


def apart(one: Images, other: Images, names: Sequence[str] = ()) -> float:
    """Return the largest difference of the named images, all that both have by default."""
    named = names or sorted(one[0].keys() & other[0].keys())
    return largest(*([view[name] for view in way for name in named] for way in (one, other)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Pair:
    """Two ways to one result, and how far apart results are. Fields as in `Skip`."""

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
        """Run both in turns; the results of the last turn are compared."""
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
        """Return a bundled scene, the thorax with iron by default; on tiny grids where the size is small."""
        (found,) = select(load(suite), (name,), ())
        if self.size == CORE:
            return found
        scanner = msgspec.structs.replace(found.scanner, n_voxel=(16, 16, 16), n_detector=(24, 24), n_views=12)
        phantom = msgspec.structs.replace(found.phantom, n_voxel=(24, 24, 24))
        return msgspec.structs.replace(found, phantom=phantom, scanner=scanner)

    def inside_and_outside(self) -> Iterator[PlannedScan]:
        """Yield a scan whose metal is seen through the body only, and one whose metal is seen beside it, too."""
        yield from map(self.planned, (self.scene(), self.scene("real", "chicken-Fe")))

    def planned(
        self, scene: Scene | None = None, truth: Truth = LINES, *, phantom: Phantom | None = None, **changes: Any
    ) -> PlannedScan:
        """Plan a scene, the thorax by default, with another phantom than its own and with `changes` of its scanner.

        It has new views for every run, and one to prepare.
        """
        scene = scene or self.scene()
        phantom, scanner = phantom or build(scene), msgspec.structs.replace(scene.resolve(), **changes)
        geometry = msgspec.structs.replace(scanner.geometry, n_views=1 + self.views * (self.repeats + 1))
        scanner = msgspec.structs.replace(scanner, geometry=geometry)
        plan = make_plan(phantom, scanner, scene.simulation, truth, stream_id(scene))
        return PlannedScan(scene=scene, plan=plan, phantom=phantom, scanner=scanner)

    def next_views(self, scan: PlannedScan) -> Callable[[], Images]:
        """Prepare a scan and make its first view; return what makes the next few views at each call."""
        views = scan.views()
        next(views)
        return lambda: [images for _, images in itertools.islice(views, self.views)]

    def pair(self, what: str, skipping: PlannedScan, whole: PlannedScan, **more: Any) -> Pair:
        """Return a pair of scans; their P without noise is compared unless `more` says otherwise."""
        ways = {"skipping": self.next_views(skipping), "whole": self.next_views(whole)}
        given: dict[str, Any] = {"difference": partial(apart, names=P_IMAGES)} | ways | more
        return Pair(scene=skipping.scene.name, what=what, **given)


def rounding(scan: PlannedScan) -> float:
    """Bound |ΔP| of two ways that take the same rays, or equal ones more often, under a plan that skips nothing.

    Each way rounds, in float32: a product and a sum a material in every τ; exp(−τ), within 4e-7·max(1, τ/4)
    (tests/test_project.py); a product and a sum an energy; a division by the open field; the logarithm, within 4 ulp
    (NumPy states 3.83), which are at most 8 half ulps of P. The signal's error is the mean of those of its energies,
    weighted by what each lets through, and the mean τ under these weights is at most P (Gibbs' inequality). A pixel
    has up to `subrays`·`MOST_TIMES` rays, summed in a row; beyond a shadow one with the skip, and as many equal ones
    without it.
    """
    p = max(0.0, *(float(np.max(images["noise_free"])) for _, images in scan.views()))
    materials, energies = len(scan.plan.materials), len(scan.plan.rule.energies)
    rays = scan.plan.settings.subrays * MOST_TIMES
    return 2 * ((materials * p + energies + rays + 1 + 8 * p) * HALF_ULP + 4e-7 * (1 + p / 4))


Cases = dict[str, Callable[[Bench], Iterator[Pair]]]
