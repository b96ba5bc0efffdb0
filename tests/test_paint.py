"""Painted shapes are those of the formulas, and replace only what they may."""

import numpy as np
import pytest

from ctsim.phantoms.fields import Canvas, LabelGrid, frame_along

GRID = (31, 40, 37)
SIDES = (1.5, 1.0, 1.1)
SHIFT = (0.3, -0.2, 0.4)
EDGE = 1e-5  # of a level of about 1: float32 coordinates below 2 are off by less than 1e-7, through a dozen operations


def canvas(label: int = 0) -> Canvas:
    drawn = Canvas(LabelGrid(n=GRID, d_voxel=SIDES, shift=SHIFT), shrink=0.9)
    drawn.labels[:] = label
    return drawn


def centres() -> np.ndarray:
    """Middles of the voxels [z, y, x, 3] (x, y, z) in half shortest edges times 0.9."""
    unit = 0.9 * min(n * d for n, d in zip(GRID, SIDES, strict=True)) / 2
    z, y, x = ((np.arange(n) - (n - 1) / 2 + s) * d / unit for n, d, s in zip(GRID, SIDES, SHIFT, strict=True))
    return np.stack(np.broadcast_arrays(x, y[:, None], z[:, None, None]), -1)


def agrees(painted: np.ndarray, level: np.ndarray) -> None:
    """Painted where level <= 1, and some voxels are on either side."""
    sure = np.abs(level - 1) > EDGE
    assert np.array_equal(painted[sure], level[sure] <= 1)
    assert sure.mean() > 0.99 and 20 < painted.sum() < 0.5 * painted.size


@pytest.mark.parametrize("centre", [(0.1, -0.2, 0.3), (0.9, 0.9, -0.9)])
@pytest.mark.parametrize("turned", [False, True])
def test_an_ellipsoid(centre, turned: bool) -> None:
    frame = frame_along((1.0, 2.0, -0.5), 0.7) if turned else None
    radii = (0.5, 0.2, 0.8)
    drawn = canvas()
    drawn.ellipsoid(3, centre, radii, frame)
    along = (centres() - centre) @ (np.eye(3) if frame is None else frame).T
    agrees(drawn.labels == 3, ((along / radii) ** 2).sum(-1))


@pytest.mark.parametrize("radii", [(0.2, 0.2), (0.1, 0.4), (0.4, 0.05)])
def test_a_rod_widens_from_end_to_end(radii) -> None:
    a, b = np.array([-0.5, 0.1, -0.8]), np.array([0.6, -0.3, 0.7])
    drawn = canvas()
    drawn.capsule(2, a, b, radii)
    t = np.clip((centres() - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    gap = np.linalg.norm(centres() - a - t[..., None] * (b - a), axis=-1)
    agrees(drawn.labels == 2, (gap / (radii[0] + t * (radii[1] - radii[0]))) ** 2)


def test_a_rod_without_length_is_a_ball() -> None:
    rod, ball = canvas(), canvas()
    rod.capsule(1, (0.1, 0.2, 0.3), (0.1, 0.2, 0.3), (0.3, 0.3))
    ball.ellipsoid(1, (0.1, 0.2, 0.3), 0.3)
    assert np.array_equal(rod.labels, ball.labels) and rod.labels.any()


def test_a_tube_is_its_rods() -> None:
    points, radii = [(-0.8, 0, 0), (0, 0.5, 0.2), (0.7, -0.4, 0.3), (0.7, -0.4, -0.9)], [0.1, 0.2, 0.15, 0.3]
    whole, parts = canvas(), canvas()
    whole.tube(1, points, radii)
    for a, b, r, s in zip(points, points[1:], radii, radii[1:], strict=False):
        parts.capsule(1, a, b, (r, s))
    assert np.array_equal(whole.labels, parts.labels) and whole.labels.any()
    same, each = canvas(), canvas()
    same.tube(1, points, 0.1)
    each.tube(1, points, [0.1] * 4)
    assert np.array_equal(same.labels, each.labels)


@pytest.mark.parametrize("over", [(1,), (0, 255), (1, 2), ()])
def test_only_what_may_be_replaced_is(over) -> None:
    rng = np.random.default_rng(0)
    before = rng.choice(np.array([0, 1, 2, 255], np.uint8), GRID)

    def painted(draw, over) -> np.ndarray:
        drawn = canvas()
        drawn.labels[:] = before
        draw(drawn, over)
        return drawn.labels

    for draw in (
        lambda c, o: c.ellipsoid(7, (0, 0, 0), 0.6, over=o),
        lambda c, o: c.tube(7, [(-0.5, 0, 0), (0.5, 0, 0)], 0.3, over=o),
        lambda c, o: c.fill(7, lambda x, y, z: x + y + z > 0, over=o),
    ):
        anywhere, there = painted(draw, None), painted(draw, over)
        assert np.array_equal(there, np.where(np.isin(before, over), anywhere, before))
        assert (anywhere == 7).any()


def test_what_lies_beside_the_grid_paints_nothing() -> None:
    drawn = canvas(5)
    drawn.ellipsoid(1, (9.0, 0, 0), 0.5)
    drawn.tube(1, [(0, 9.0, 0), (0, 9.0, 1)], 0.5)
    drawn.fill(1, lambda x, y, z: x < 9, ((3, 3, 3), (4, 4, 4)))
    drawn.tube(1, np.zeros((0, 3)), 0.1)
    assert (drawn.labels == 5).all()
