"""Layers of the labels that no ray crosses are left out of the tracing, and no reading changes."""

import msgspec
import numpy as np
import pytest

from ctsim.geometry import Geometry
from ctsim.plan import make_plan
from ctsim.settings import Simulation, Truth
from ctsim.simulate import simulate_views
from ctsim.solids import ELLIPSOID, Primitive, Solid
from ctsim.tracer import project
from ctsim.tracer.layers import layers_seen
from ctsim.types import Phantom, Scanner

ROW = Geometry(
    dso=250.0, dsd=500.0, n_voxel=(1, 12, 12), d_voxel=(1.0, 4.0, 4.0),
    n_detector=(1, 40), d_detector=(2.0, 2.0), n_views=5, start_deg=3.0,
)  # fmt: skip


def phantom(dense: bool = False) -> Phantom:
    rng = np.random.default_rng(4)
    labels = rng.integers(0, 3, (41, 11, 13)).astype(np.uint8)
    ball = Primitive(kind=ELLIPSOID, centre=(4.0, -3.0, 0.5), params=(5.0, 4.0, 6.0))
    return Phantom(
        labels=labels,
        materials=("air", "water", "cortical_bone", "Fe"),
        d_voxel=(1.1, 3.0, 2.5),
        off_origin=(0.37, 0.4, -0.7),
        density=rng.uniform(0.5, 1.5, labels.shape).astype(np.float32) if dense else None,
        solids=(Solid(name="ball", material="Fe", metal=True, primitives=(ball,)),),
    )


@pytest.mark.parametrize("offset", [0.0, 13.0, -31.0])
def test_every_layer_that_a_ray_crosses_is_kept(offset):
    """Material elsewhere is another phantom to no ray: the path lengths along dense rays are those of the whole."""
    geometry = msgspec.structs.replace(ROW, off_detector=(offset, 0.0))
    body = phantom()
    part = layers_seen(body, geometry)
    n = part.labels.shape[0]
    assert n < 12 and part.labels.base is not None
    # the row is 2 mm high, 1 on the axis; it rises by `offset` over 500 mm, and the body reaches ±27 mm
    tall = abs(offset) / 500 * 2 * 27 + 1.2
    assert n <= tall / 1.1 + 5
    fine = msgspec.structs.replace(geometry, n_detector=(9, 40), d_detector=(2.0 / 9, 2.0))
    for view in range(5):
        whole, cut = (project.path_lengths(project.Tracer.of(p), fine, view) for p in (body, part))
        # float32 lengths of up to 40 mm, summed over some 30 pieces
        np.testing.assert_allclose(cut, whole, atol=40 * 30 * 2**-24)


@pytest.mark.parametrize("dense", [False, True])
def test_no_count_changes(dense, monkeypatch):
    machine, body = Scanner(geometry=ROW), phantom(dense)
    found = []
    for cut in (True, False):
        if not cut:
            monkeypatch.setattr(project, "layers_seen", lambda body, _: body)
        plan = make_plan(body, machine, Simulation(), Truth(), "scene")
        found.append(np.stack([out["counts"] for _, out in simulate_views(plan, body, machine)]))
    assert np.array_equal(*found)


def test_what_most_rays_cross_and_tilted_detectors_are_left_alone():
    body = phantom()
    assert layers_seen(body, msgspec.structs.replace(ROW, n_detector=(30, 40))) is body
    pose = (250.0, 0.0, 0.0, -250.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.6, 0.0, 1.9)
    assert layers_seen(body, msgspec.structs.replace(ROW, poses=(pose,), n_views=1)) is body


def test_a_row_beside_the_body_keeps_one_layer():
    part = layers_seen(phantom(), msgspec.structs.replace(ROW, off_detector=(400.0, 0.0)))
    assert part.labels.shape[0] == 1
