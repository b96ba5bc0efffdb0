"""Scenes of one body: built once, traced once, and each what it is alone."""

import errno
import hashlib
import time
import types
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ctsim import plan as plan_module
from ctsim import simulate
from ctsim.beam.spot import FocalSpot
from ctsim.dataset.manifest import read_index, verify
from ctsim.detector.noise import Noise
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.phantoms import dataset
from ctsim.phantoms.bodies.teeth import Teeth
from ctsim.phantoms.bodies.volume import CtVolume
from ctsim.phantoms.dataset import make_scene, make_scenes
from ctsim.phantoms.recipes import BUILDERS
from ctsim.phantoms.scene import Scene, build, parse_suite, stream_id
from ctsim.phantoms.variants import build_all, families
from ctsim.plan import make_plan
from ctsim.scatter import Scatter
from ctsim.settings import Simulation, Truth
from ctsim.signals import Part, same_rays, share_rays
from ctsim.simulate import SharedTruth, part_of
from ctsim.tracer.project import Tracer
from ctsim.types import Phantom

TABLE = """
[[scene]]
name = "body"
count = 5
scans_each = 5
phantom = {{ recipe = "lung", n_voxel = [24, 24, 24] }}
truth = {{ trace = true, mono_kev = [60.0], metal_path = true, paths = true, noise_free = true }}
scanner = {{ preset = "ideal", n_views = 7, n_detector = [20, 24], n_voxel = [16, 16, 16]{more} }}

[scene.vary]
phantom.metal = ["Fe", "Ti", "Au"]
scanner.tube.kvp = [80, 120]
scanner.i0 = {{ log = [1e3, 1e6] }}
"""
MORE = {
    "a point": "",
    "light that spreads and comes late": ", detector = { blur = { fwhm = 0.4 }, lag = [{ share = 0.1, decay = 0.5 }] }",
    "a calibrated pattern": ", noise = { fixed_pattern = 0.02, adc_bits = 14 }",
}


def scenes(more: str = "", **changes: object) -> tuple[Scene, ...]:
    return tuple(msgspec.structs.replace(s, **changes) for s in parse_suite(TABLE.format(more=more)))


def digests(folder: Path) -> dict[str, str]:
    """Hash every file of a data folder but its index and what tells of the time taken."""
    found = sorted(p for p in folder.rglob("*") if p.is_file() and p.parent != folder and p.suffix != ".json")
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in found}


def part(scene: Scene) -> Part:
    return part_of(dataset.plan_scene(scene), build(scene), scene.resolve())


@pytest.mark.parametrize("more", MORE.values(), ids=MORE.keys())
def test_scenes_made_together_are_what_they_are_alone(tmp_path, more):
    many = scenes(more)
    assert len({s.phantom.metal for s in many}) > 1 and len({s.scanner.tube.kvp for s in many}) > 1
    make_scenes(many, tmp_path / "together")
    for scene in many:
        make_scene(scene, tmp_path / "alone")
    assert digests(tmp_path / "together") == digests(tmp_path / "alone")
    assert len(digests(tmp_path / "alone")) > 60


def test_scenes_looked_at_together_have_the_plans_that_they_have_alone(monkeypatch):
    """With the worst error at edges, which is looked for in the same places whatever the beam."""
    many = scenes(simulation=Simulation(subrays=4))
    first = build_all(many)[0]
    many = [msgspec.structs.replace(s, phantom=many[0].phantom) for s in many]
    looked, whole = [], plan_module.look

    def counted(phantom, scanners, *args, **kw):
        looked.append(len(scanners))
        return whole(phantom, scanners, *args, **kw)

    monkeypatch.setattr(plan_module, "look", counted)
    jobs = dataset._jobs(many, [first] * len(many))
    beams = {s.scanner.tube.kvp for s in many}
    assert looked == [len(beams)] and len(beams) > 1
    for job in jobs:
        alone = make_plan(first, job.scanner, job.scene.simulation, job.scene.truth, stream_id(job.scene))
        assert job.plan.to_dict() | {"seconds": 0} == alone.to_dict() | {"seconds": 0}
        assert job.plan.edge_error > 0
    assert len({job.plan.edge_error for job in jobs}) == len(beams)


def test_only_scenes_that_may_be_looked_at_together_are(monkeypatch):
    """Whatever scenes are made together, each has the plan that it has alone."""
    one = scenes()[0]
    changes: list[dict[str, object]] = [
        {"simulation": Simulation(subrays=4)},
        {"simulation": Simulation(skip=False)},
        {"truth": Truth(twin=False)},
    ]
    beams: list[dict[str, object]] = [
        {"n_views": 9},
        {"tube": msgspec.structs.replace(one.scanner.tube, focal_spot=FocalSpot(size=(0.4, 0.4)))},
        {"detector": Detector(kind="csi", thickness=0.3)},
        {"scatter": Scatter(level=1, fraction=0.1)},
        {"noise": Noise(model="none")},
    ]
    many = [one, *(msgspec.structs.replace(one, **change) for change in changes)]
    many += [msgspec.structs.replace(one, scanner=msgspec.structs.replace(one.scanner, **beam)) for beam in beams]
    jobs = dataset._jobs(many, [build(one)] * len(many))
    alone = [dataset.plan_scene(scene) for scene in many]
    assert [dataset.plan_hash(job.plan) for job in jobs] == [dataset.plan_hash(plan) for plan in alone]
    assert len({dataset.plan_hash(plan) for plan in alone}) > 6


def test_labels_are_shared_where_the_same_levels_are_put_together():
    labels = np.arange(8, dtype=np.uint8).reshape(2, 2, 2) % 4
    materials = ("air", "water", "fat@0.9", "fat@1.1")
    body = Phantom(labels=labels, materials=materials, d_voxel=(1.0, 1.0, 1.0))
    grid = Geometry(
        dso=10, dsd=20, n_voxel=(2, 2, 2), d_voxel=(1, 1, 1), n_detector=(1, 1), d_detector=(1, 1), n_views=1
    )
    shared, got = SharedTruth(), []
    for tissues in (("air", "water", "fat", "fat"), materials, ("air", "water", "fat", "fat")):
        plan = types.SimpleNamespace(tissues=tissues, told=tuple(dict.fromkeys(tissues)), materials=materials)
        cover = simulate.cover_of(body, grid)
        got.append(simulate._labels(plan, [("", body)], grid, [cover], shared)[0])
    assert np.array_equal(got[0], np.minimum(labels, 2)) and np.array_equal(got[1], labels) and got[2] is got[0]


@pytest.mark.parametrize("metals", [("Fe",), ("Fe", "Ti", "Au")])
def test_doses_and_metals_share_what_is_drawn_of_the_truth(tmp_path, monkeypatch, metals):
    """The covers, the body without solids at two sets of energies, and the body's labels are drawn once for all."""
    one, *_ = scenes()
    many = [
        msgspec.structs.replace(
            s,
            phantom=msgspec.structs.replace(one.phantom, metal=metals[k % len(metals)]),
            scanner=msgspec.structs.replace(one.scanner, i0=s.scanner.i0),
        )
        for k, s in enumerate(scenes())
    ]
    for scene in many:
        make_scene(scene, tmp_path / "alone")
    asked = []
    for name in ("cover_of", "body_attenuation", "body_labels"):
        whole = getattr(simulate, name)
        monkeypatch.setattr(simulate, name, lambda *of, name=name, whole=whole: asked.append(name) or whole(*of))
    make_scenes(many, tmp_path / "together")
    assert digests(tmp_path / "together") == digests(tmp_path / "alone")
    assert sorted(asked) == ["body_attenuation"] * 2 + ["body_labels"] + ["cover_of"] * 2


def test_rays_of_variants_are_traced_once(tmp_path, monkeypatch):
    real, traced = Tracer.background, []

    def counted(self, geometry, view, out=None):
        traced.append(view)
        return real(self, geometry, view, out)

    many = scenes(truth=Truth())
    monkeypatch.setattr(Tracer, "background", counted)
    jobs = [part(scene) for scene in many]
    traced.clear()
    shared = share_rays([replace(j, phantom=p) for j, p in zip(jobs, build_all(many), strict=True)])
    assert len({id(signals) for signals, _ in shared}) == 1
    for k in range(7):
        for signals, place in shared:
            signals.moments(k, place)
    assert traced == list(range(7))


def test_doses_share_their_signals():
    """The rays of one beam and metal are measured once, however many doses there are."""
    first = scenes()[0]
    beam = first.scanner.tube
    many = [
        msgspec.structs.replace(s, phantom=first.phantom, scanner=msgspec.structs.replace(s.scanner, tube=beam))
        for s in scenes()
    ]
    phantoms = build_all(many)
    parts = [replace(part(s), phantom=p) for s, p in zip(many, phantoms, strict=True)]
    ((signals, _), *others) = share_rays(parts)
    assert len(signals.responses.nodes) == 1
    assert all(other is signals for other, _ in others)
    assert len({s.scanner.i0 for s in many}) == 5


CHANGES = {
    "another insert": {"phantom": {"insert_mm": 3.0}},
    "another size": {"phantom": {"size": 61.0}},
    "other texture": {"phantom": {"texture": 0.05}},
    "no metal": {"phantom": {"metal": "none"}},
    "another detector": {"scanner": {"n_detector": (21, 24)}},
    "a focal spot": {"scanner": {"tube": {"focal_spot": {"size": [0.5, 0.5]}}}},
    "other sub-rays": {"simulation": {"subrays": 20}},
    "another seed": {"seed": 5},
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES.keys())
def test_scenes_that_differ_in_more_share_nothing(change):
    one = scenes()[0]
    told = msgspec.to_builtins(one)
    for key, value in change.items():
        told[key] = told[key] | value if isinstance(value, dict) else value
    other = msgspec.convert(told, Scene)
    a, b = (replace(part(s), phantom=p) for s, p in zip((one, other), build_all((one, other)), strict=True))
    assert not same_rays(a, b)
    assert same_rays(a, a)


DRAWN = [kind for kind in BUILDERS if kind is not CtVolume]


@pytest.mark.parametrize("kind", DRAWN, ids=lambda kind: kind.__name__)
def test_metal_of_another_name_is_all_that_another_metal_changes(kind):
    """For every recipe, among them those with a second metal of the same name."""
    names = ["Au", "Fe", "Ti", "CoCr", "amalgam", "water", "soft_tissue", "Fe"]
    made = [Scene(name=f"s{k}", seed=1, phantom=kind(metal=m, n_voxel=(20, 20, 20))) for k, m in enumerate(names)]
    for scene, phantom in zip(made, build_all(made), strict=True):
        alone = build(scene)
        assert phantom.materials == alone.materials and phantom.solids == alone.solids
        assert np.array_equal(phantom.labels, alone.labels)
        assert (phantom.d_voxel, phantom.off_origin) == (alone.d_voxel, alone.off_origin)


def test_restorations_of_another_metal_keep_theirs():
    """Gold crowns stay gold where the recipe's metal, once gold too, is another one."""
    made = [
        Scene(name=m, seed=3, phantom=Teeth(metal=m, n_voxel=(20, 20, 20), gold_crowns=1)) for m in ("Au", "Ti", "Fe")
    ]
    for order in (made, made[::-1]):
        for scene, phantom in zip(order, build_all(order), strict=True):
            alone = build(scene)
            assert (phantom.materials, phantom.solids) == (alone.materials, alone.solids)
            assert "Au" in alone.materials


def test_scanners_that_may_not_be_mixed_are_made_one_after_another(tmp_path):
    told = msgspec.to_builtins(scenes(truth=Truth())[0])
    parts = ({"tube": {"heel": True}}, {"noise": {"model": "tigre"}})
    both = [
        msgspec.convert(told | {"name": f"s{k}", "scanner": told["scanner"] | part}, Scene)
        for k, part in enumerate(parts)
    ]
    make_scenes(both, tmp_path)
    assert [len(family) for family in families(both)] == [1, 1]


@pytest.mark.parametrize("order", ["one body after the other", "in turn"])
def test_families_are_of_one_body(order):
    two = scenes() + tuple(msgspec.structs.replace(s, name=f"x{s.name}", seed=9) for s in scenes())
    if order == "in turn":
        mixed = [s for pair in zip(two[:5], two[5:], strict=True) for s in pair]
        assert list(families(mixed)) == list(families(two))
    assert [[s.name for s in f] for f in families(two)] == [[s.name for s in two[:5]], [s.name for s in two[5:]]]
    assert [len(f) for f in families(two, 2)] == [2, 2, 1, 2, 2, 1]


def test_scenes_that_were_interrupted_at_different_views_go_on(tmp_path, monkeypatch):
    many = scenes(MORE["light that spreads and comes late"])[:3]
    make_scenes(many, tmp_path / "whole")

    def stopping(view: int):
        def watch(name: str, views: Iterable, first: int, n: int) -> Iterable:
            for k, arrays in views:
                if k == view:
                    raise KeyboardInterrupt
                yield k, arrays

        return watch

    for scene, view in zip(many, (2, 5), strict=False):
        with pytest.raises(KeyboardInterrupt):
            make_scenes((scene,), tmp_path / "parts", watch=stopping(view))
    began = {}

    def watch(name: str, views: Iterable, first: int, n: int) -> Iterable:
        began[name] = first
        return views

    make_scenes(many, tmp_path / "parts", watch=watch)
    assert list(began.values()) == [2, 5, 0]
    assert digests(tmp_path / "parts") == digests(tmp_path / "whole")


def test_folders_that_are_put_in_place_together_are_listed_in_the_order_of_their_scenes(tmp_path, monkeypatch):
    many = scenes(truth=Truth())[:3]
    settle = dataset.SceneWriter.settle

    def late(self, about=None):
        time.sleep(0.3 if self.name == many[0].name else 0.0)
        return settle(self, about)

    monkeypatch.setattr(dataset.SceneWriter, "settle", late)
    assert make_scenes(many, tmp_path) == [tmp_path / s.name for s in many]
    assert list(read_index(tmp_path)) == [s.name for s in many]


def test_a_folder_that_cannot_be_put_in_place_leaves_the_others_finished(tmp_path, monkeypatch):
    many = scenes(truth=Truth())[:3]
    settle = dataset.SceneWriter.settle

    def refused(self, about=None):
        if self.name == many[1].name:
            raise PermissionError(errno.EACCES, "Permission denied", str(self.final))
        return settle(self, about)

    monkeypatch.setattr(dataset.SceneWriter, "settle", refused)
    with pytest.raises(PermissionError):
        make_scenes(many, tmp_path / "data")
    assert list(read_index(tmp_path / "data")) == [many[0].name, many[2].name]
    monkeypatch.undo()
    make_scenes(many[1:2], tmp_path / "data")
    make_scenes(many, tmp_path / "whole")
    assert digests(tmp_path / "data") == digests(tmp_path / "whole")
    assert verify(tmp_path / "data") == []


def test_true_volumes_are_whole_however_late_they_are_written(tmp_path, monkeypatch):
    many = scenes()[:2]
    make_scenes(many, tmp_path / "whole")
    write = dataset.SceneWriter.write_image

    def late(self, name, array, spacing):
        time.sleep(0.03)
        write(self, name, array, spacing)

    monkeypatch.setattr(dataset.SceneWriter, "write_image", late)
    make_scenes(many, tmp_path / "late")
    assert digests(tmp_path / "late") == digests(tmp_path / "whole")


def test_a_true_volume_that_cannot_be_written_stops_the_scene(tmp_path, monkeypatch):
    def full(self, name, array, spacing):
        if name == "metal_free/reference_50kev":  # the last one
            raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(dataset.SceneWriter, "write_image", full)
    with pytest.raises(InputError, match="disk is full; scene 'body-00000' keeps its first 7 of 7 views"):
        make_scenes(scenes()[:1], tmp_path)
    assert not (tmp_path / "body-00000").exists()
