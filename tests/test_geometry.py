"""Geometry and scanner: what no machine has is refused by the name of the key and the number of the view."""

import msgspec
import numpy as np
import pytest

from ctsim.geometry import Geometry

GEOMETRY = Geometry(
    dso=200.0,
    dsd=400.0,
    n_voxel=(5, 7, 11),
    d_voxel=(0.5, 0.4, 0.25),
    n_detector=(5, 8),
    d_detector=(0.2, 0.25),
    n_views=3,
)


def with_(**changes) -> Geometry:
    return msgspec.structs.replace(GEOMETRY, **changes)


def posed(changes: dict[int, float], view: int = 1) -> tuple[tuple[float, ...], ...]:
    """The orbit's poses with some of one view's twelve numbers replaced."""
    poses = GEOMETRY.pose_array()
    for column, value in changes.items():
        poses[view, column] = value
    return tuple(tuple(float(x) for x in row) for row in poses)


@pytest.mark.parametrize("off", [0.5, 1.0, 1.5])
def test_a_full_turn_covers_half_the_detector_more_or_nothing(off: float) -> None:
    # half a detector of 2 mm is 1 mm: from there on no view sees the axis, and a ring is no field of view
    turn, short = with_(off_detector=(0.0, off)), with_(off_detector=(0.0, off), arc_deg=200.0)
    edge = 1.0 + off if off < 1.0 else 0.0
    assert turn.fov_radius == pytest.approx(200 * np.sin(np.arctan(edge / 400)))
    assert short.fov_radius == pytest.approx(200 * np.sin(np.arctan(max(1.0 - off, 0) / 400)))
