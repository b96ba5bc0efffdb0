"""Stress cases of the reconstruction methods: every scene by every method of the table.

A volume must have the grid's shape, finite values, and status ok (any other needs a sentence). Its values stay within
π·(dso/(dso − r))²·max|P|/pitch, the closed-form bound of FDK: views weigh 2π in all, the ramp's absolute values sum to
1/(2 pitch) and backprojection weighs by the square, r from the axis; a voxel that an iterative method fits to a ray
that crosses half of it stays below that, too. Where the data determine the object, the RMSE over the body, away from
metal, must not exceed 0.7 of an empty volume's, unless the result says what is wrong (its `limitation`). Exact
symmetries are held against the same method on the other scan.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
import numpy as np
import torch

from benchmarks.methods import SPECTRUM, TABLE, code_version, find
from benchmarks.stress_cases import Case, Findings
from benchmarks.stress_scans import (
    BONE,
    SIZE,
    USUAL,
    WATER,
    Example,
    block_phantom,
    example,
    geometry,
    in_air,
    on_threads,
    rod,
    scaled_by,
    thread_counts,
    uneven,
)
from ctsim.noise import Noise
from ctsim.scatter import Scatter
from ctsim.solids import Solid
from ctsim.spectrum import TABLE_KVP, Tube
from ctsim.types import Scan, Scanner, Status, Volume
from reconstruct.fdk import reconstruct as fdk
from reconstruct.log import line_integrals
from reconstruct.redundancy import ray_weights

NEAR = 0.7
SAME = 1e-3  # of the greatest value: float32
BY_MASK = ("limar", "nmar", "bhc-poly")
DESCENT = ("asd-pocs", "awpcsd")  # their steps are of one length whatever the gradient of TV, in flat regions rounding
SAME_BY_DESCENT = 0.03
BOUNDS = {"ibhc": 10.0}  # adds to P what its own volume says of hardening, streaks included
ORDERED = ("sart", "os-sart", "asd-pocs", "awpcsd", "splat")  # a view that comes twice moves them twice
SAMPLED = ("bhc-poly",)  # fits in 64 views, other ones where there are twice as many
PHYSICAL = ("splat", "ibhc")  # take materials from tables in 1/mm


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A scan that is hard on methods; `near` says whether the data determine the object.

    `like` is a scan that must give the same volume but for a factor in length: methods that need not are `unlike`.
    """

    what: str
    make: Callable[[int], Example]
    near: bool = True
    like: Callable[[int], Example] | None = None
    factor: Callable[[int], float] = lambda _: 1.0
    unlike: Collection[str] = ()


def scan_of(side: int, *solids: Solid, of: dict[str, Any] | None = None, **scanner: Any) -> Example:
    """Simulate rods, by default the usual ones, on a scanner."""
    return example(Scanner(geometry=geometry(side, **(of or {})), **scanner), in_air(solids or USUAL))


def changed(given: Example, of: dict[str, Any] | None = None, **scan: Any) -> Example:
    """Return an example with parts of its scan and of its geometry replaced."""
    where = msgspec.structs.replace(given.scan.geometry, **(of or {}))
    return dataclasses.replace(given, scan=dataclasses.replace(given.scan, geometry=where, **scan))


def filled(side: int, value: int) -> Example:
    """Return the usual scan with one reading everywhere."""
    given = scan_of(side)
    return changed(given, counts=torch.full_like(given.scan.counts, value))


def magnified(side: int, factor: float) -> Example:
    """Return the usual counts as those of a machine and an object of so many times the size."""
    given = scan_of(side)
    scan = dataclasses.replace(given.scan, geometry=scaled_by(given.scan.geometry, factor))
    return dataclasses.replace(given, scan=scan, reference=given.reference / np.float32(factor))


def twice(side: int) -> Example:
    """Return the usual scan with every view given twice."""
    given = scan_of(side)
    angles = np.degrees(given.scan.geometry.angles).repeat(2)
    of = {"angles_deg": tuple(angles.tolist()), "n_views": angles.size}
    return changed(given, of, counts=given.scan.counts.repeat_interleave(2, 0))


def rounded(side: int) -> Example:
    """Return the usual counts as float32, each moved by a unit in its last place or less."""
    given = scan_of(side)
    ulps = np.random.Generator(np.random.Philox(key=5)).uniform(-1, 1, given.scan.counts.shape)
    return changed(given, counts=given.scan.counts.float() * torch.from_numpy(1 + ulps * 2.0**-24).float())


def on_grid(side: int, turn: float = 0.0) -> Example:
    """Return 8 views whose middle rays run along voxel planes, edges and diagonals; turned, they just miss them."""
    n = side + 1
    given = scan_of(side, of={"n_detector": (n, n), "d_detector": (150.0 / n,) * 2, "n_views": 8})
    return changed(given, {"start_deg": turn})


def dense(side: int, density: float, **scanner: Any) -> Example:
    """Return a scan of a block of water of another density."""
    return example(Scanner(geometry=geometry(side), **scanner), block_phantom(density, 32.0))


OBLONG = {"n_voxel": (1, 50, 50), "d_voxel": (SIZE, SIZE / 50, SIZE / 50)}
OBLONG |= {"n_detector": (6, 72), "d_detector": (25.0, 150.0 / 72), "n_views": 60}
SCENES: dict[str, Scene] = {
    "iron-40mm": Scene(
        what="a rod of 40 mm iron in water", make=lambda n: scan_of(n, WATER, rod("Fe", 20.0)), near=False
    ),
    "ten-photons": Scene(what="10 photons a pixel", make=lambda n: scan_of(n, i0=10.0), near=False),
    "all-zero-counts": Scene(what="all counts 0", make=lambda n: filled(n, 0), near=False),
    "saturated": Scene(what="all counts at full scale", make=lambda n: filled(n, 65535), near=False),
    "scatter": Scene(
        what="scatter of twice the open field",
        make=lambda n: scan_of(n, scatter=Scatter(level=1, fraction=2.0), noise=Noise(adc_bits=None)),
        near=False,
    ),
    "no-metal": Scene(what="a body without metal", make=lambda n: scan_of(n, WATER, BONE)),
    "metal-fills-field": Scene(
        what="iron wider than the field of view",
        make=lambda n: scan_of(n, rod("Fe", 60.0, height=200.0)),
        near=False,
    ),
    "metal-at-edge": Scene(
        what="metal that crosses the volume's edge", make=lambda n: scan_of(n, *USUAL, rod("Ti", 3.0, at=(30.0, 0.0)))
    ),
    "metal-outside": Scene(
        what="metal outside the field of view", make=lambda n: scan_of(n, WATER, BONE, rod("Ti", 3.0, at=(44.0, 5.0)))
    ),
    "one-view": Scene(what="one view", make=lambda n: scan_of(n, of={"n_views": 1}), near=False),
    "two-views": Scene(what="two views", make=lambda n: scan_of(n, of={"n_views": 2}), near=False),
    "arc-90": Scene(what="an arc of 90°", make=lambda n: scan_of(n, of={"arc_deg": 90.0}), near=False),
    "duplicate-views": Scene(what="every view twice", make=twice, like=scan_of, unlike=(*ORDERED, *SAMPLED)),
    "uneven-angles": Scene(
        what="angles that crowd on one side", make=lambda n: scan_of(n, of={"angles_deg": uneven(2 * n)})
    ),
    "cone-2deg": Scene(what="a cone of 2°", make=lambda n: scan_of(n, of={"dso": 2100.0, "dsd": 4300.0})),
    "cone-60deg": Scene(
        what="a cone of 60°",
        make=lambda n: scan_of(n, of={"dso": 90.0, "dsd": 180.0, "d_detector": (208.0 / (1.5 * n),) * 2}),
    ),
    "offsets": Scene(
        what="detector and volume off centre",
        make=lambda n: scan_of(n, of={"off_detector": (4.0, -9.0), "off_origin": (3.0, -4.0, 2.0)}),
    ),
    "truncated": Scene(
        what="a detector that sees a third of the object",
        make=lambda n: scan_of(n, of={"n_detector": (n, n // 2)}),
        near=False,
    ),
    "anisotropic": Scene(
        what="voxels of 50:1",
        make=lambda n: scan_of(n, of=OBLONG),
    ),
    "voxel-1um": Scene(
        what="voxels of 1 µm",
        make=lambda n: magnified(n, n / SIZE / 1e3),
        near=False,
        like=scan_of,
        factor=lambda n: n / SIZE / 1e3,
        unlike=PHYSICAL,
    ),
    "voxel-10mm": Scene(
        what="voxels of 10 mm",
        make=lambda n: magnified(n, 10 * n / SIZE),
        like=scan_of,
        factor=lambda n: 10 * n / SIZE,
        unlike=PHYSICAL,
    ),
    "one-voxel": Scene(
        what="a volume of one voxel within the object",
        make=lambda n: scan_of(n, of={"n_voxel": (1, 1, 1), "d_voxel": (15.0,) * 3}),
        near=False,
    ),
    "volume-5x7x11": Scene(
        what="a volume of 5×7×11 voxels",
        make=lambda n: scan_of(
            n,
            rod("water", 18.0, at=(6.0, -4.0)),
            of={"n_voxel": (5, 7, 11), "d_voxel": (SIZE / 5, SIZE / 7, SIZE / 11)},
        ),
    ),
    "single-energy": Scene(what="one energy, 60 keV", make=lambda n: scan_of(n, tube=Tube(model="mono", kvp=60.0))),
    "k-edge": Scene(
        what="iodine and tungsten in water, whose K-edges lie within 120 kVp",
        make=lambda n: scan_of(
            n, WATER, rod("NaI@0.3", 4.0, at=(-9.0, 6.0)), rod("W@0.2", 4.0, at=(9.0, 2.0)), tube=Tube(kvp=120.0)
        ),
    ),
    "20kvp": Scene(what="a tube of 20 kV", make=lambda n: scan_of(n, rod("water", 12.0), tube=Tube(kvp=20.0))),
    "450kvp": Scene(
        what="a tube of 450 kV",
        make=lambda n: scan_of(n, tube=Tube(kvp=450.0, model="finkelshtein-pavlova")),
    ),
    "grid-rays": Scene(
        what="rays along voxel planes, edges and corners",
        make=on_grid,
        near=False,
        like=lambda n: on_grid(n, 1e-5),
        unlike=BY_MASK + DESCENT,  # a ray along a face of the mask is in its shadow or not
    ),
    "density-1e-3": Scene(
        what="water of a thousandth of its density",
        make=lambda n: dense(n, 1e-3, i0=1e9, noise=Noise(model="none")),
    ),
    "density-1e3": Scene(what="water of a thousand times its density", make=lambda n: dense(n, 1e3), near=False),
    "rounding": Scene(what="counts moved by float32's rounding", make=rounded, like=scan_of),
}


@functools.lru_cache(maxsize=4)
def made(make: Callable[[int], Example], side: int) -> Example:
    """Return a scan that all methods share."""
    return make(side)


def bound(scan: Scan) -> float:
    """Return the greatest value (1/mm) that a volume of a scan may have, as the module's docstring says."""
    g = scan.geometry
    radius = min(ray_weights(g).radius, math.hypot(*g.s_voxel[1:]) / 2)
    pitch = min(g.d_detector[1] * g.dso / g.dsd, *g.d_voxel)
    steepest = float(line_integrals(scan, slice(None))[0].abs().max())
    return math.pi * (g.dso / (g.dso - radius)) ** 2 * steepest / pitch


def under_stress(name: str, scene: Scene, side: int, found: Findings) -> None:
    """Run a method on a scene and judge what it returns."""
    given, method = made(scene.make, side), find(name)
    if _refuses(name, given.scan.e_max):
        found.refused("kvp must be within", lambda: method.reconstruct(given.scan, "cpu"))
        return
    volume = method.reconstruct(given.scan, "cpu")
    values = volume.values.numpy()
    if values.shape != given.scan.geometry.n_voxel:
        found.say(f"the volume has shape {values.shape}, the grid {given.scan.geometry.n_voxel}", holds=False)
        return
    _judge(volume, found, given, near=scene.near, bounds=BOUNDS.get(name, 1.0))
    if name in BY_MASK and given.scan.metal is not None and not given.scan.metal.any():
        found.same("without metal its bits and FDK's are", values, fdk(given.scan).values.numpy())
    if scene.like is not None and name not in scene.unlike:
        other = method.reconstruct(made(scene.like, side).scan, "cpu").values.numpy()
        off = float(np.abs(values * scene.factor(side) - other).max() / max(np.abs(other).max(), 1e-30))
        found.at_most("off the other form of the scan by", off, _limit(name))


def _limit(name: str) -> float:
    return SAME_BY_DESCENT if name in DESCENT else SAME


def _refuses(name: str, e_max: float) -> bool:
    """Say whether a method takes a spectrum from a table that ends below the scan's."""
    return TABLE[name][1] == SPECTRUM and e_max > TABLE_KVP[1]


def _judge(volume: Volume, found: Findings, given: Example, *, near: bool, bounds: float) -> None:
    values = volume.values.numpy()
    said = volume.details.get("limitation") or volume.reason
    found.finite("the volume", values)
    named = volume.status is Status.OK or (volume.status is not Status.NONFINITE and bool(volume.reason))
    found.say(str(volume.status), holds=named)
    found.at_most("greatest value over its bound", float(np.abs(values).max() / bound(given.scan)), bounds)
    if near and not said:
        found.at_most("error over an empty volume's", given.error(values), NEAR)
    elif given.region.any():
        found.say(f"error over an empty volume's {given.error(values):.2g}")
    if said:
        found.say(f"says: {said}")


def on_any_threads(name: str, side: int, found: Findings) -> None:
    """Compare the volumes of 1, 2 and all threads."""
    scan, method = made(scan_of, side).scan, find(name)
    first, *others = thread_counts()
    values = on_threads(first, lambda: method.reconstruct(scan, "cpu").values.numpy())
    for n in others:
        other = on_threads(n, lambda: method.reconstruct(scan, "cpu").values.numpy())
        found.same(f"volumes of {first} and {n} threads are", values, other)


def _expected(name: str, scene: Scene) -> str:
    words = ["finite, within " + (f"{BOUNDS[name]:g} times " if name in BOUNDS else "") + "the bound of values"]
    if scene.near:
        words.append(f"error ≤ {NEAR:g} of an empty volume's, or its limitation said")
    if scene.like is not None and name not in scene.unlike:
        words.append(f"as the other form of the scan to {_limit(name):g}")
    return "; ".join(words)


def cases() -> list[Case]:
    """Return every scene by every method, scene by scene, so that methods share scans."""
    own = code_version(__name__) + code_version("phantoms.shapes")
    codes = {name: own + code_version(target.partition(":")[0]) for name, (target, _) in TABLE.items()}
    found = []
    for scene_name, scene in SCENES.items():
        for name in TABLE:
            run, expected = partial(under_stress, name, scene), _expected(name, scene)
            case = Case(name=scene_name, subject=name, what=scene.what, expected=expected, run=run, code=codes[name])
            found.append(case)
    for name in TABLE:
        run, what = partial(on_any_threads, name), "1, 2 and all threads"
        bits = "equal to the last bit"
        found.append(Case(name="threads", subject=name, what=what, expected=bits, run=run, code=codes[name]))
    return found
