import msgspec
import numpy as np
import pytest

from ctsim.dataset.interop import (
    Library,
    angles_to,
    astra_vectors,
    points_to,
    projections_from,
    projections_to,
    volume_from,
    volume_to,
)
from ctsim.errors import InputError
from ctsim.geometry import Geometry

GEOMETRY = Geometry(
    dso=400.0,
    dsd=900.0,
    n_voxel=(5, 7, 11),
    d_voxel=(1.0, 2.0, 3.0),
    n_detector=(7, 11),
    d_detector=(1.5, 0.5),
    n_views=5,
    start_deg=17.0,
    off_detector=(2.0, -3.0),
)


@pytest.mark.parametrize("library", Library)
def test_round_trips_return_the_same_array(library):
    volume = np.arange(5 * 7 * 11).reshape(5, 7, 11)
    projections = np.arange(3 * 5 * 7).reshape(3, 5, 7)
    assert np.array_equal(volume_from(library, volume_to(library, volume)), volume)
    assert np.array_equal(projections_from(library, projections_to(library, projections)), projections)


def test_axes_stand_where_the_table_says():
    volume = np.zeros((5, 7, 11))
    volume[1, 2, 3] = 1
    projections = np.zeros((3, 5, 7))
    projections[1, 2, 3] = 1
    places = {name: tuple(np.argwhere(volume_to(name, volume))[0]) for name in Library}
    assert places == {
        "tigre": (1, 2, 3),
        "leap": (1, 2, 3),
        "astra": (1, 2, 3),
        "rtk": (3, 1, 2),
        "r2_gaussian": (3, 2, 1),
    }
    projections[1, 2, 3] = 1
    assert projections_to(Library.ASTRA, projections)[2, 1, 3] == 1
    assert projections_to(Library.R2_GAUSSIAN, projections)[1, 5 - 1 - 2, 3] == 1


def turned(angle, x, y, z):
    """Turn a point about z by each angle: [view, xyz]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([x * cos - y * sin, x * sin + y * cos, z + 0 * angle], -1)


def spread(source, origin, *steps):
    """Return sources [view, xyz], and pixels origin + Σ step·number over (numbers, step) of the axes after the view."""
    for numbers, step in steps:
        origin = origin[..., None, :] + np.asarray(numbers)[:, None] * step.reshape(-1, *[1] * (origin.ndim - 1), 3)
    return source, origin


def tigre(a, g):
    """Common/CUDA/Siddon_projection.cu: everything is laid out at angle 0 and turned; rows are counted from the top."""
    (n_v, n_u), (d_v, d_u), (off_v, off_u) = g.n_detector, g.d_detector, g.off_detector
    first = turned(a, -(g.dsd - g.dso), d_u * (-n_u / 2 + 0.5) + off_u, d_v * (n_v / 2 - 0.5) + off_v)
    u, v = turned(a, 0, d_u, 0), turned(a, 0, 0, -d_v)
    return spread(turned(a, g.dso, 0, 0), first, (n_v - np.arange(n_v) - 1, v), (np.arange(n_u), u))


def leap(degrees, g):
    """src/parameters.cpp takes half of π from the angles; rays are those of src/projectors_Siddon_cpu.cpp.

    What set_conebeam calls centerRow and centerCol is where docs/reference/conventions.md puts it.
    """
    phi = degrees * np.pi / 180 - 0.5 * np.pi
    (n_v, n_u), (d_v, d_u), (off_v, off_u) = g.n_detector, g.d_detector, g.off_detector
    centre_row, centre_col = (n_v - 1) / 2 - off_v / d_v, (n_u - 1) / 2 - off_u / d_u
    source = np.stack([g.dso * np.cos(phi), g.dso * np.sin(phi), 0 * phi], -1)
    u, v = (np.arange(n_u) - centre_col) * d_u, (np.arange(n_v) - centre_row) * d_v
    cos, sin = np.cos(phi)[:, None, None], np.sin(phi)[:, None, None]
    ray = (-g.dsd * cos - u * sin, -g.dsd * sin + u * cos, v[:, None] + 0 * (u + cos))
    return source, source[:, None, None] + np.stack(np.broadcast_arrays(*ray), -1)


def astra(a, g):
    """python/astra/functions.py, geom_2vec for 'cone'; cuda/3d/cone_fp.cu counts rows along +v. It has no offsets."""
    (n_v, n_u), (d_v, d_u), one = g.n_detector, g.d_detector, np.ones_like(a)
    source = g.dso * np.stack([np.sin(a), -np.cos(a), 0 * a], -1)
    centre = (g.dsd - g.dso) * np.stack([-np.sin(a), np.cos(a), 0 * a], -1)
    u, v = d_u * np.stack([np.cos(a), np.sin(a), 0 * a], -1), d_v * np.stack([0 * a, 0 * a, one], -1)
    source, pixels = spread(source, centre, (np.arange(n_v) - (n_v - 1) / 2, v), (np.arange(n_u) - (n_u - 1) / 2, u))
    return source, pixels.swapaxes(0, 1)  # data are (row, angle, column)


def rtk(degrees, g):
    """rtkThreeDCircularProjectionGeometry.cxx: its frame is turned by minus the gantry angle about y."""
    b = np.radians(degrees)
    x = np.stack([np.cos(b), 0 * b, -np.sin(b)], -1)
    y = np.broadcast_to([0.0, 1.0, 0.0], x.shape)
    z = np.stack([np.sin(b), 0 * b, np.cos(b)], -1)
    (n_v, n_u), (d_v, d_u), (off_v, off_u) = g.n_detector, g.d_detector, g.off_detector
    first = (g.dso - g.dsd) * z + (off_u - (n_u - 1) / 2 * d_u) * x + (off_v - (n_v - 1) / 2 * d_v) * y
    return spread(g.dso * z, first, (np.arange(n_v), d_v * y), (np.arange(n_u), d_u * x))


def r2(a, g):
    """r2_gaussian/dataset/dataset_readers.py, angle2pose: the camera looks along its z, its y points down.

    Pixels are those of a perspective camera of this width and height; it knows no offset of the detector.
    """
    zero, cos, sin = 0 * a, np.cos(a), np.sin(a)
    axes = (-sin, cos, zero), (zero, zero, zero - 1), (-cos, -sin, zero)
    across, down, ahead = (np.stack(axis, -1) for axis in axes)
    source = g.dso * np.stack([cos, sin, zero], -1)
    (n_v, n_u), (d_v, d_u) = g.n_detector, g.d_detector
    rows, columns = (2 * np.arange(n_v) + 1) / n_v - 1, (2 * np.arange(n_u) + 1) / n_u - 1
    return spread(source, source + g.dsd * ahead, (rows, n_v * d_v / 2 * down), (columns, n_u * d_u / 2 * across))


RAYS = {Library.TIGRE: tigre, Library.LEAP: leap, Library.ASTRA: astra, Library.RTK: rtk, Library.R2_GAUSSIAN: r2}


def pixels_of(g):
    """Return the detector's pixel centres of the page's formulas: [view, v, u, xyz] in mm."""
    k_v, k_u = (np.arange(n) - (n - 1) / 2 for n in g.n_detector)
    v, u = k_v * g.d_detector[0] + g.off_detector[0], k_u * g.d_detector[1] + g.off_detector[1]
    a = np.radians([17.0 + 72 * k for k in range(5)])[:, None, None]
    axes = (-(g.dsd - g.dso) * np.cos(a) - u * np.sin(a), -(g.dsd - g.dso) * np.sin(a) + u * np.cos(a), v[:, None])
    return np.stack(np.broadcast_arrays(*axes), -1)


@pytest.mark.parametrize("library", Library)
def test_every_source_and_pixel_is_where_the_library_has_it(library):
    """Each library's place of every ray, from its source code in other words, against ours, offsets included."""
    bare = library in (Library.ASTRA, Library.R2_GAUSSIAN)
    g = msgspec.structs.replace(GEOMETRY, off_detector=(0.0, 0.0)) if bare else GEOMETRY
    source, pixels = RAYS[library](angles_to(library, g.angles), g)
    # four roundings of an angle below 8 rad, to degrees and back, seen from 1 m away; twenty of coordinates of 0.5 m
    close = {"rtol": 0, "atol": 4 * 2**-51 * 1000 + 20 * 2**-53 * 500}
    np.testing.assert_allclose(points_to(library, g.pose_array()[:, :3]), source, **close)
    ours = points_to(library, pixels_of(g))
    arranged = np.stack([projections_to(library, ours[..., axis]) for axis in range(3)], -1)
    assert arranged.shape == pixels.shape
    np.testing.assert_allclose(arranged, pixels, **close)


@pytest.mark.parametrize("library", Library)
def test_every_voxel_is_where_the_library_has_it(library):
    """Voxel i of n is centred (i − (n − 1)/2) voxels from the volume's offset, along the axes of each library's arrays.

    TIGRE, LEAP (parameters.cpp: x_0) and ASTRA (cone_bp.cu) have [z, y, x], R2-Gaussian [x, y, z]. RTK's [z, y, x],
    of ITK, are our x, z, y.
    """
    g = msgspec.structs.replace(GEOMETRY, off_origin=(4.0, -5.0, 6.0))
    z, y, x = ((np.arange(n) - (n - 1) / 2) * d + o for n, d, o in zip(g.n_voxel, g.d_voxel, g.off_origin, strict=True))
    if library is Library.R2_GAUSSIAN:
        theirs = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1)
    else:
        their_z, their_y, their_x = (x, z, y) if library is Library.RTK else (z, y, x)
        theirs = np.stack(np.meshgrid(their_z, their_y, their_x, indexing="ij")[::-1], -1)
    ours = points_to(library, np.stack(np.meshgrid(*g.voxel_centres(), indexing="ij")[::-1], -1))
    arranged = np.stack([volume_to(library, ours[..., axis]) for axis in range(3)], -1)
    np.testing.assert_allclose(arranged, theirs, rtol=0, atol=40 * 2**-52)  # some roundings of up to 22 mm


def test_astra_vectors_place_the_corner_pixels():
    source, centre, u_step, v_step = np.split(astra_vectors(GEOMETRY), 4, axis=1)
    corner = centre - 5 * u_step - 3 * v_step
    a = GEOMETRY.angles
    u, v = -5 * 0.5 - 3.0, -3 * 1.5 + 2.0
    expected = np.stack([-500 * np.cos(a) - u * np.sin(a), -500 * np.sin(a) + u * np.cos(a), v + 0 * a], 1)
    np.testing.assert_allclose(corner, expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(source, axis=1), 400.0, rtol=1e-15)


def test_wrong_number_of_axes_is_named():
    with pytest.raises(InputError, match="three axes"):
        volume_to(Library.RTK, np.zeros((3, 4)))
