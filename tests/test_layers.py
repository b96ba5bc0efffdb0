"""Layers of the labels that no ray crosses are neither drawn nor traced, and no reading changes."""

import msgspec
import numpy as np
import pytest
import torch

from ctsim.geometry import Geometry
from ctsim.phantoms import dataset, variants
from ctsim.phantoms.bodies.rods import MetalRods, Validation
from ctsim.phantoms.recipes import BUILDERS, build_recipe
from ctsim.phantoms.scanners import ScannerSettings
from ctsim.phantoms.scene import build, layers_of, parse_suite
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


DRAWN = [kind for kind in BUILDERS if kind.by_layers]


@pytest.mark.parametrize("kind", DRAWN, ids=lambda kind: kind.__struct_config__.tag)
@pytest.mark.parametrize("texture", [0.0, 0.05])
def test_layers_drawn_alone_are_those_of_the_whole(kind, texture):
    if texture and kind in (Validation, MetalRods):
        pytest.skip("solids have no texture")
    params = kind(n_voxel=(61, 48, 50), grid_shift=(0.3, -0.2, 0.1), texture=texture)
    whole = build_recipe(params, 3)
    for part in (slice(0), slice(30, 31), slice(11, 20)):
        found = build_recipe(params, 3, layers=part)
        assert found.solids == whole.solids and found.off_origin == whole.off_origin
        assert found.partial and not whole.partial and not np.delete(found.labels, part, 0).any()
        mine, all_of_it = (np.array(p.materials)[p.labels[part]] for p in (found, whole))
        assert np.array_equal(mine, all_of_it)


SCENE = """
name = "row"
truncated = true
seed = 4
phantom = {{ recipe = "{recipe}", n_voxel = [96, 64, 64], grid_shift = [0.2, 0.1, 0.3], texture = {texture} }}
scanner = {{ n_detector = [1, 70], n_views = 12, n_voxel = [1, 40, 40] }}
metal_in_view = {in_view}
truth = {{ twin = true, paths = true }}
"""


def scene(slices=1, **changes):
    given = {"recipe": "lung", "texture": 0.05, "in_view": "true"} | changes
    (one,) = parse_suite(SCENE.format(**given))
    if slices == 1:
        return one
    geometry = msgspec.structs.replace(one.resolve().geometry, n_voxel=(slices, 40, 40), d_voxel=(1.5, 1.5, 1.5))
    return msgspec.structs.replace(one, scanner=ScannerSettings(geometry=geometry))


@pytest.mark.parametrize(
    "changes",
    [{}, {"in_view": "false"}, {"slices": 5}, {"recipe": "teeth", "texture": 0.0}, {"recipe": "walnut"}],
    ids=str,
)
def test_a_scan_of_one_row_is_that_of_the_whole_body(changes, monkeypatch):
    one, scans = scene(**changes), []
    body = build(one, whole=False)
    n = int(body.labels.any((1, 2)).sum())
    assert (n < 96 / 4) == (changes.get("recipe") != "walnut")  # whose pieces are known by the whole
    for whole in (False, True):
        if whole:
            monkeypatch.setattr(dataset, "build", lambda scene, **_: build(scene))
        scans.append(dataset.simulate_scene(one))
    for mine, other in (scans, [scan.metal_free for scan in scans]):
        assert torch.equal(mine.scan.counts, other.scan.counts)
        for kind in ("effective", "50kev"):
            assert np.array_equal(mine.reference(kind), other.reference(kind))
    assert scans[0].info.materials == scans[1].info.materials  # as many channels of paths, whatever the row sees
    for name in ("labels", "metal"):
        assert np.array_equal(*(getattr(scan, name) for scan in scans))
    assert np.array_equal(*(scan.array("paths") for scan in scans))


def test_rows_of_one_body_with_several_metals_are_drawn_together(monkeypatch):
    rows = [
        msgspec.structs.replace(one, phantom=msgspec.structs.replace(one.phantom, metal=metal))
        for one in (scene(), scene(in_view="false"), scene(slices=5))
        for metal in ("Fe", "Ti")
    ]
    found = variants.build_all(rows)
    for one, body in zip(rows, found, strict=True):
        alone = build(one, whole=False)
        assert np.array_equal(body.labels, alone.labels) and body.off_origin == alone.off_origin
        assert body.partial and body.solids == alone.solids
    assert found[0].labels is found[1].labels and found[0].labels is not found[4].labels


def test_a_row_that_sees_no_layer_with_tissue_has_the_whole_body():
    """At 27 mm, above the thorax and within what may hold a body; far from the source rays hardly rise."""
    changes = {"dso": 4000.0, "dsd": 8000.0, "d_detector": (0.2, 2.0), "off_origin": (27.0, 0, 0)}
    geometry = msgspec.structs.replace(scene().resolve().geometry, off_detector=(54.0, 0.0), **changes)
    one = msgspec.structs.replace(scene(in_view="false"), scanner=ScannerSettings(geometry=geometry))
    assert layers_of(one)(0.0) != slice(None)
    body = build(one, whole=False)
    assert not body.partial and np.array_equal(body.labels, build(one).labels)


def test_what_scatters_or_comes_from_a_wide_spot_is_drawn_whole():
    row = scene()
    assert layers_of(row) is not None
    assert layers_of(msgspec.structs.replace(row, simulation=Simulation(skip=False))) is None
    for key, value in (("scatter", {"level": 3}), ("tube", {"focal_spot": {"size": [0.5, 0.5]}})):
        scanner = msgspec.convert(msgspec.to_builtins(row.scanner) | {key: value}, type(row.scanner))
        assert layers_of(msgspec.structs.replace(row, scanner=scanner)) is None
