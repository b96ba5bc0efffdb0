import numpy as np
import pytest

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.interop import (
    Library,
    angles_to,
    astra_vectors,
    points_to,
    projections_from,
    projections_to,
    volume_from,
    volume_to,
)

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


def cone_source(library, angle, dso):
    """Where each library's own documentation puts the source, in its own frame."""
    if library is Library.ASTRA:  # ASTRA 'cone': source at (sin, −cos, 0)
        return dso * np.stack([np.sin(angle), -np.cos(angle), 0 * angle], -1)
    if library is Library.RTK:  # RTK turns about y, from z towards x; degrees
        return dso * np.stack([np.sin(np.radians(angle)), 0 * angle, np.cos(np.radians(angle))], -1)
    a = np.radians(angle) if library is Library.LEAP else angle
    return dso * np.stack([np.cos(a), np.sin(a), 0 * a], -1)


@pytest.mark.parametrize("library", Library)
def test_sources_coincide_in_every_frame(library):
    ours = points_to(library, GEOMETRY.pose_array()[:, :3])
    theirs = cone_source(library, angles_to(library, GEOMETRY.angles), GEOMETRY.dso)
    # A few roundings of a 400 mm coordinate.
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=2e-13 * 4)


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
