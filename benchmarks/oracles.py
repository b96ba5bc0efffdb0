"""Closed forms and converged references that studies compare results with, and the analytic scene for them.

Lengths are in mm, projections are P = -ln(signal/open), [v, u] or [view, v, u]; everything is float64.
"""

from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.beam.quadrature import full_rule
from ctsim.beam.spectrum import spectrum
from ctsim.geometry import Geometry
from ctsim.phantoms.scanners import preset
from ctsim.phantoms.shapes import cylinder
from ctsim.solids import Solid
from ctsim.tracer.project import Response, Tracer, transmit
from ctsim.tracer.voxelise import label_volume
from ctsim.types import Phantom, Scanner

SIZE = 60.0  # edge of the scene's cube in mm
FINER = 16  # finer pixels along each side of a pixel in `measured_pixel`
Rays = tuple[NDArray[np.float64], NDArray[np.float64]]


def relative(p: NDArray, exact: NDArray) -> float:
    """Return the root mean square of p − exact over that of exact."""
    return float(np.sqrt(np.mean((np.asarray(p, np.float64) - exact) ** 2) / np.mean(np.asarray(exact) ** 2)))


def central_rays(geometry: Geometry, view: int | None = None) -> Rays:
    """Return the sources [view, 1, 1, xyz] and the unit vectors [view, v, u, xyz] of central rays, of all views or one.

    A ray along a plane is tilted by 1e-12: it enters and leaves far away.
    """
    poses = geometry.pose_array() if view is None else geometry.pose(view)[None]
    n_v, n_u = geometry.n_detector
    u, v = np.arange(n_u) - (n_u - 1) / 2, np.arange(n_v) - (n_v - 1) / 2
    source, centre, e_u, e_v = np.split(poses[:, None, None], 4, axis=-1)
    ray = centre + u[:, None] * e_u + v[:, None, None] * e_v - source
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    return source, np.where(np.abs(ray) < 1e-12, 1e-12, ray)


def slab_span(rays: Rays, half: tuple[float, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where rays enter and leave a slab or box: the space between planes at ±half along the last axes."""
    source, ray = (part[..., -len(half) :] for part in rays)
    ends = np.sort(np.stack([(sign * np.array(half) - source) / ray for sign in (-1, 1)]), axis=0)
    return ends[0].max(-1), ends[1].min(-1)


def upright_span(rays: Rays, solid: Solid) -> NDArray[np.float64]:
    """Return where rays enter and leave an upright cylinder, the same for rays that miss it: [2, view, v, u]."""
    half, radius = solid.primitives[0].params[:2]
    start, ray = rays[0] - np.asarray(solid.primitives[0].centre), rays[1]
    low, high = slab_span((start, ray), (half,))
    start, across = start[..., :2], ray[..., :2]
    a, b, c = (across**2).sum(-1), (across * start).sum(-1), (start**2).sum(-1) - radius**2
    root = np.sqrt(np.maximum(b**2 - a * c, 0.0))
    enter = np.maximum((-b - root) / a, low)
    leave = np.minimum((-b + root) / a, high)
    return np.stack([enter, np.where(root > 0, np.maximum(leave, enter), enter)])


def upright_chord(geometry: Geometry, view: int, solid: Solid) -> NDArray[np.float64]:
    """Return the chord (mm) of every central ray of a view through an upright cylinder: [v, u]."""
    enter, leave = upright_span(central_rays(geometry, view), solid)[:, 0]
    return leave - enter


def voxelised(phantom: Phantom, geometry: Geometry, keep: tuple[Solid, ...]) -> Phantom:
    """Return the phantom with all solids but `keep` turned into labels on the geometry's grid."""
    rest = tuple(s for s in phantom.solids if s not in keep)
    body = Phantom(labels=phantom.labels, materials=phantom.materials, d_voxel=phantom.d_voxel, solids=rest)
    labels = label_volume(body, geometry)
    return Phantom(labels=labels, materials=phantom.materials, d_voxel=geometry.d_voxel, solids=keep)


def scanner_of(side: int, views: int) -> Scanner:
    """Return the desktop scanner of the bundled suites on side² pixels, with side³ voxels in the scene's cube."""
    return preset("ideal", views, (side, side), (side, side, side), SIZE)


def poly_scene(n: int) -> Phantom:
    """Return an analytic scene on a grid of n³ voxels: water cylinder, bone rod, two iron rods."""
    solids = (
        cylinder("water", "water", (25.0, 54.0), metal=False),
        cylinder("bone", "cortical_bone", (5.0, 48.0), centre=(11.0, 6.0, 0.0), metal=False),
        cylinder("iron 1", "Fe", (2.5, 44.0), centre=(-9.0, 9.0, 0.0)),
        cylinder("iron 2", "Fe", (2.0, 44.0), centre=(-4.0, -13.0, 0.0)),
    )
    names = ("air", "water", "cortical_bone", "Fe")
    return Phantom(
        labels=np.zeros((n, n, n), np.uint8), materials=names, d_voxel=(SIZE / n, SIZE / n, SIZE / n), solids=solids
    )


def measured_pixel(
    phantom: Phantom, scanner: Scanner, views: Sequence[int], *, finer: int = FINER, subrays: int = 1
) -> NDArray[np.float64]:
    """Return P of every pixel as a detector measures it: rays averaged in intensity, the whole fine spectrum.

    A pixel is `finer`² finer pixels of up to `subrays` rays each; 1 and 1 is the central ray alone. Chords are the
    tracer's closed forms, so the scene has to be analytic.
    """
    coarse = scanner.geometry
    (n_v, n_u), (d_v, d_u) = coarse.n_detector, coarse.d_detector
    fine = msgspec.structs.replace(coarse, n_detector=(n_v * finer, n_u * finer), d_detector=(d_v / finer, d_u / finer))
    tracer = Tracer.of(phantom)
    response = Response.of(full_rule(spectrum(scanner.tube), scanner.detector), tracer.materials)
    out = np.empty((len(views), n_v, n_u))
    for k, view in enumerate(views):
        signal, _ = transmit(tracer, fine, view, response, subrays=subrays)
        out[k] = signal.reshape(n_v, finer, n_u, finer).mean((1, 3), dtype=np.float64)
    return -np.log(out)
