"""Stress rows of the splat kernels: odd splats together with a fair one, which they must neither spoil nor move."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.studies.stress.scans import Findings
from ctsim.benchmarks.studies.stress.suite import PROJECTED, RESPONDED, VOXELISED
from ctsim.geometry import Geometry
from ctsim.reconstruct.splat.densify import Schedule, densify
from ctsim.reconstruct.splat.kernels import response_reference, splat_reference
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.project import Projector
from ctsim.reconstruct.splat.response import evaluate, make_response
from ctsim.reconstruct.splat.volume import voxelise

CUTOFF = 6.0  # beyond it lies 2e-8 of a peak, so that it does not matter which pixels a cutoff takes in
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
TURNED = (1.0, 0.3, 0.2, 0.1)


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
        found.at_most(f"{'EWA' if tolerance else 'exact'} off by, of the peak", float(off) / peak, PROJECTED)
    grid = np.array([*GEOMETRY.d_voxel, *(axis[0] for axis in GEOMETRY.voxel_centres()), CUTOFF, 1 / 12])
    volume = voxelise(given, GEOMETRY, cutoff=CUTOFF)
    true = splat_reference.voxelise(shapes, values, grid, GEOMETRY.n_voxel)
    # of what the splat would be in the middle of a voxel: a thin one between voxel centres is next to nothing
    greatest = max(float(true.max()), float(np.prod(given.scales[0] / (given.scales[0] + 1))))
    found.at_most("volume off by, of the greatest", float(np.abs(volume - true).max()) / greatest, VOXELISED)


def _gradient_is_finite(found: Findings, given: Splats) -> None:
    image = np.random.Generator(np.random.Philox(key=3)).normal(size=(2, 23, 38)).astype(np.float32)
    gradient = Projector(geometry=GEOMETRY).gradient(given, image, 0)
    for name in ("densities", "positions", "log_scales", "rotations", "centres"):
        found.finite(f"the gradient in {name}", getattr(gradient, name))


def _beside_fair(found: Findings, what: str, odd: Splats, *, seen: bool) -> None:
    """Project and voxelise a splat before a fair one; without `seen` nothing of it may show."""
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
        _beside_fair(found, what, odd, seen=True)  # other views may see it
        images = [view.forward(s.shapes(), s.densities, [0]) for s in (joined(odd, FAIR), FAIR)]
        found.same(f"{what}: the images of this view without and with it are", images[1], images[0])


def outside(_: int, found: Findings) -> None:
    """Put splats where no ray goes, as far as float32 does."""
    for what, place in (("above", [0, 0, 500]), ("far away", [1e30, -1e30, 1e30])):
        _beside_fair(found, what, splat(place, [2, 2, 2]), seen=False)


def empty(_: int, found: Findings) -> None:
    """Project, voxelise and differentiate no splats."""
    none = Splats(**{name: a[:0] for name, a in asdict(FAIR).items()})
    view = Projector(geometry=GEOMETRY)
    images = view.forward(none.shapes(), none.densities)
    found.say("images of zeros", holds=images.shape == (3, 2, 23, 38) and not images.any())
    found.say("a volume of zeros", holds=not voxelise(none, GEOMETRY).any())
    found.say("no sums", holds=view.adjoint(none.shapes(), images).shape == (0, 2))
    _gradient_is_finite(found, none)


def not_finite(_: int, found: Findings) -> None:
    """Seed a splat with NaN or infinity in each of its arrays; densification drops it."""
    for value in (np.nan, np.inf):
        for name in ("positions", "scales", "rotations", "densities"):
            odd = splat([0, 0, 0], [2, 2, 2])
            getattr(odd, name)[0, 0] = value
            _beside_fair(found, f"{value} in {name}", odd, seen=name == "densities")
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
        found.at_most(f"{name} off by", off, RESPONDED)


def many(n: int) -> Splats:
    """Return n³/8 splats of all shapes in the volume."""
    rng, size = np.random.Generator(np.random.Philox(key=n)), max(n**3 // 8, 1)
    drawn = {
        "positions": rng.uniform(-8, 8, (size, 3)),
        "scales": rng.uniform(0.3, 3, (size, 3)),
        "densities": rng.random((size, 2)),
        "rotations": rng.normal(size=(size, 4)),
    }
    return Splats(**{name: a.astype(np.float32) for name, a in drawn.items()})


def beside_float64(side: int, found: Findings) -> None:
    """Compare sums over many splats with float64: no more than a few meet in a pixel."""
    _near_float64(found, many(min(side, 8)))


def same_bits(side: int, found: Findings) -> None:
    """Project, backproject and voxelise on 1, 2 and all threads, and views in another order."""
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
