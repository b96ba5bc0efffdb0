"""Shadows hold every ray that meets the object, and little else."""

import msgspec
import numpy as np
import pytest

from ctsim.geometry import Geometry
from ctsim.solids import BOX, CAPSULE, ELLIPSOID, FRUSTUM, TORUS, Primitive, Solid, pack
from ctsim.tracer import shadow
from ctsim.tracer.kernels.solids_reference import intersect

SIZES = {
    ELLIPSOID: (5.0, 1.0, 3.0),
    FRUSTUM: (9.0, 0.6, 1.4),
    CAPSULE: (8.0, 0.7),
    BOX: (4.0, 1.0, 2.0),
    TORUS: (6.0, 1.0),
}
GEOMETRY = Geometry(
    dso=120.0, dsd=240.0, n_voxel=(8, 8, 8), d_voxel=(1.0,) * 3, n_detector=(31, 47), d_detector=(1.9, 1.4), n_views=3,
    off_detector=(4.0, -9.0), start_deg=17.0,
)  # fmt: skip


def rows_of(kind, seed):
    rng = np.random.default_rng(seed)
    pieces = tuple(
        Primitive(kind=kind, centre=tuple(rng.uniform(-9, 9, 3)), params=SIZES[kind], axis=tuple(rng.normal(size=3)))
        for _ in range(6)
    )
    return pack([Solid(name="s", material="Fe", primitives=pieces, metal=True)], ("air", "Fe"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", SIZES)
def test_no_ray_that_meets_a_primitive_lies_outside_its_shadow(kind):
    prims, (n_v, n_u) = rows_of(kind, kind), GEOMETRY.n_detector
    met = np.zeros((n_v, len(prims), n_u), bool)
    for view in range(GEOMETRY.n_views):
        pose = GEOMETRY.pose(view)
        cast = shadow.cast(pose[None], GEOMETRY.n_detector, shadow.primitive_corners(prims))[0]
        source, centre, e_u, e_v = pose.reshape(4, 3)
        step = 7 if kind == TORUS else 1  # its reference solves a quartic a ray
        # pixel centres and corners, since both are asked for
        columns = range(view % step, n_u, step)
        for v, u, shift in ((v, u, s) for v in range(view % 2, n_v, 2) for u in columns for s in (0.0, -0.5, 0.5)):
            towards = centre + (u + shift - (n_u - 1) / 2) * e_u + (v + shift - (n_v - 1) / 2) * e_v - source
            towards /= np.linalg.norm(towards)
            for p, prim in enumerate(prims):
                if intersect(prim, *source, *towards, np.empty(4)):
                    assert cast[v, p, 0] <= u + shift <= cast[v, p, 1]
                    met[v, p, u] |= shift == 0
    assert met.sum() > (25 if kind == TORUS else 150)


def test_the_shadow_of_a_slanted_rod_is_a_narrow_band():
    rod = Primitive(kind=FRUSTUM, centre=(0.0, 0.0, 0.0), params=(11.0, 0.5, 0.5), axis=(0.3, 1.0, 0.8))
    prims = pack([Solid(name="s", material="Fe", primitives=(rod,), metal=True)], ("air", "Fe"))
    fine = msgspec.structs.replace(GEOMETRY, n_detector=(310, 470), d_detector=(0.19, 0.14))
    cast = shadow.cast(fine.pose(0)[None], fine.n_detector, shadow.primitive_corners(prims))[0]
    width = np.maximum(cast[..., 1] - cast[..., 0] + 1, 0)
    rows = (width > 0).sum()
    box = rows * (cast[..., 1].max() - cast[..., 0][width > 0].min())
    assert rows > 100 and width.sum() < 0.25 * box


def test_parts_beside_the_detector_and_behind_the_source():
    aside = shadow.box_corners(np.array([-5.0, 500.0, -5.0]), np.array([5.0, 510.0, 5.0]))
    around = shadow.box_corners(np.full(3, -200.0), np.full(3, 200.0))
    front = msgspec.structs.replace(GEOMETRY, start_deg=0.0)
    cast = shadow.cast(front.pose(0)[None], GEOMETRY.n_detector, np.concatenate([aside, around]))[0]
    assert np.all(cast[:, 0, 0] > cast[:, 0, 1])
    assert np.array_equal(cast[:, 1:], shadow.everywhere(GEOMETRY.n_detector, 1))
    assert np.array_equal(shadow.row_spans(cast, 47), np.tile([0, 47], (31, 1)))
    assert not shadow.row_spans(cast[:, :1], 47).any() and not shadow.row_spans(cast[:, :0], 47).any()
