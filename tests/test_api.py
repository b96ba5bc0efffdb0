"""The short interface: its names, its scans in memory, and scores that are those of the command."""

import ast
import importlib.util
from pathlib import Path

import msgspec
import numpy as np
import pytest
import scan_files
import torch
from closed_scans import GEOMETRY, counts_of, line_integrals
from conftest import SMALLEST
from run_records import run_jobs

import ctsim
from ctsim import api
from ctsim.api import find_scene, new_scene, reconstruct_scan, score_volume
from ctsim.benchmarks import methods
from ctsim.benchmarks.importing import Flags
from ctsim.benchmarks.importing.work import bring
from ctsim.benchmarks.scores.score import NOT_ASKED, PROTOCOLS
from ctsim.benchmarks.studies.methods import plan
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError
from ctsim.phantoms.dataset import simulate_scene
from ctsim.phantoms.scene import load_suite, parse_suite
from ctsim.types import Scan, Status, Volume

NAMES = [name for name in ctsim.__all__ if name != "__version__"]


@pytest.fixture(scope="module")
def simulated():
    """The scene of `smallest` in memory."""
    return simulate_scene(*parse_suite(SMALLEST))


@pytest.fixture(scope="module")
def stored(smallest):
    return open_scan(list_scans(smallest)[0])


@pytest.fixture(scope="module")
def recorded(stored, tmp_path_factory):
    """The scores that run-benchmark records: (method, variant) -> scores."""
    found = [methods.find("fdk", {"window": "hann"}), methods.find("nmar"), methods.find("twin-fdk")]
    records = run_jobs(plan.jobs([stored], found, anchor=True), tmp_path_factory.mktemp("results"))
    return {(r.label.partition("[")[0], r.run.variant): r.scores for r in records}


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_there_and_is_no_module_too(name):
    assert getattr(ctsim, name).__name__ == name
    assert name in dir(ctsim) and importlib.util.find_spec(f"ctsim.{name}") is None


def test_the_stub_declares_the_same_names_of_the_same_modules():
    tree = ast.parse(Path(ctsim.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    declared = {n.names[0].asname: n.module for n in tree.body if isinstance(n, ast.ImportFrom)}
    assert declared == ctsim._MODULES


def test_another_name_is_refused():
    with pytest.raises(AttributeError, match=r"'ctsim' has no attribute 'reconstrct'"):
        _ = ctsim.reconstrct  # pyright: ignore[reportAttributeAccessIssue]


def test_a_scan_in_memory_holds_what_the_folder_holds(simulated, stored):
    names = {name.removesuffix(".tif") for name in stored.files if name.endswith(".tif")}
    assert set(simulated.arrays) == names
    for name in names:
        np.testing.assert_array_equal(simulated.file(name), stored.file(name))
        assert simulated.file(name).dtype == stored.file(name).dtype
    assert simulated.info == stored.info and simulated.scene_id == stored.scene_id
    for name in ("scene.toml", "scan.json", "spectrum.csv"):
        assert simulated.text(name) == stored.text(name)
    assert simulated.text("none.txt") is None is stored.text("none.txt")


def test_what_is_written_into_a_scan_in_memory_reaches_nobody_else(simulated):
    before = simulated.file("counts")
    simulated.scan.counts.zero_()
    simulated.metal[:] = 1
    np.testing.assert_array_equal(simulated.scan.counts.numpy(), before)
    assert not simulated.metal.all()
    with pytest.raises(InputError, match="without noise_free; expected one of counts"):
        simulated.array("noise_free")


@pytest.mark.parametrize("where", ["simulated", "stored"])
@pytest.mark.parametrize(("method", "given"), [("fdk", {"window": "hann"}), ("nmar", {}), ("twin-fdk", {})])
def test_scores_are_those_that_the_command_records(where, method, given, recorded, request):
    scan = request.getfixturevalue(where)
    volume = reconstruct_scan(scan, method, **given)
    twin = reconstruct_scan(scan.metal_free, method, **given)
    assert score_volume(volume, scan, twin=twin) == recorded[method, "metal"]
    assert score_volume(twin, scan, variant="metal_free") == recorded[method, "metal_free"]
    # scores of other counts differ, so equality says something
    assert recorded[method, "metal"]["tissue"] != recorded["nmar" if method == "fdk" else "fdk", "metal"]["tissue"]


def test_an_array_made_elsewhere_is_scored(simulated):
    volume = reconstruct_scan(simulated)
    found = score_volume(volume.values.numpy().astype(np.float64), simulated)
    assert found == score_volume(volume, simulated) and found["artefact"].note == NOT_ASKED


def test_only_the_protocols_that_are_asked_for_cost_work(simulated, monkeypatch):
    """Views that no method saw are simulated for `projection` alone."""
    volume, asked, held_out = reconstruct_scan(simulated), [], api.held_out
    whole = score_volume(volume, simulated)
    assert set(whole) == set(PROTOCOLS)
    monkeypatch.setattr(api, "held_out", lambda scan: asked.append(scan) or held_out(scan))
    api._judge_with_views.cache_clear()
    for names in (("tissue",), ("metal", "soft"), ()):
        assert score_volume(volume, simulated, protocols=names) == {name: whole[name] for name in names}
    assert not asked
    assert score_volume(volume, simulated, protocols="tissue") == {"tissue": whole["tissue"]}
    assert score_volume(volume, simulated, protocols=["projection"]) == {"projection": whole["projection"]}
    assert len(asked) == 1
    with pytest.raises(InputError, match=r"protocols: expected names among paper, tissue.*got 'tisue'"):
        score_volume(volume, simulated, protocols=("tissue", "tisue"))
    with pytest.raises(InputError, match="got 'tisue'"):
        score_volume(volume, simulated, protocols="tisue")


def test_volumes_that_cannot_be_scored_are_refused(simulated):
    shape = simulated.geometry.n_voxel
    for values, words in (
        (np.zeros((2, 3, 4)), r"shape \(2, 3, 4\)"),
        (np.full(shape, np.nan), "not finite"),
        (np.zeros(shape, complex), "real numbers"),
    ):
        with pytest.raises(InputError, match=words):
            score_volume(values, simulated)
    with pytest.raises(InputError, match='variant="metal_free"'):
        score_volume(np.zeros(shape), simulated.metal_free)
    with pytest.raises(InputError, match=r"variant: expected 'metal' or 'metal_free', got 'metalfree'"):
        score_volume(np.zeros(shape), simulated, variant="metalfree")  # pyright: ignore[reportArgumentType]


WATER = 0.025  # 1/mm, about that at 90 kV


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda v: v[:, :, ::-1], "looks flipped along x: correlation"),
        (lambda v: v.transpose(0, 2, 1)[:, ::-1], "looks transposed .* and flipped along"),
        (lambda v: v.transpose(1, 2, 0), r"has shape \(12, 12, 10\), expected \(10, 12, 12\) .*: it is transposed"),
        (lambda v: (v / WATER - 1) * 1000, "looks like HU: its mean"),
        (lambda v: np.round((v / WATER - 1) * 1000).astype(np.int16), "looks like HU: its mean"),
        (lambda v: v * 10, "looks like 1/cm: its mean"),
        (lambda v: -v, "looks like the negative of a volume"),
        (np.zeros_like, "holds 0 in every voxel"),
    ],
    ids=["mirrored", "turned", "transposed", "hu", "whole-hu", "per-cm", "negative", "zero"],
)
def test_an_array_of_another_unit_or_orientation_is_refused(simulated, wrong, said):
    right = reconstruct_scan(simulated).values.numpy()
    with pytest.raises(InputError, match=f"^the volume {said}"):
        score_volume(wrong(right), simulated, protocols="tissue")
    with pytest.raises(InputError, match=f"^the twin's volume {said}"):
        score_volume(right, simulated, twin=wrong(right), protocols="tissue")
    if not said.startswith("looks flipped"):  # without its metal the body is that of its mirror image
        with pytest.raises(InputError, match=f"^the volume {said}"):
            own = reconstruct_scan(simulated.metal_free).values.numpy()
            score_volume(wrong(own), simulated, variant="metal_free", protocols="tissue")
    if wrong(right).shape == right.shape:  # a volume says that it is meant to be so
        meant = Volume(values=torch.from_numpy(wrong(right).astype(np.float32)))
        assert score_volume(meant, simulated, protocols="tissue")["tissue"].values


def test_a_volume_of_another_kind_is_refused(simulated):
    with pytest.raises(InputError, match=r"^Volume.values must be a torch.Tensor, got a numpy.ndarray"):
        score_volume(Volume(values=np.ones(simulated.geometry.n_voxel)), simulated)  # pyright: ignore


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: ctsim.simulate_scene("quick"), "scene: expected a Scene, such as of find_scene or new_scene, got str"),
        (lambda: ctsim.reconstruct_scan(42), "scan: expected a scan, .* got int"),
        (lambda: ctsim.score_volume(np.zeros((2, 2, 2)), "data/x"), "scan: expected a scan with its truth, .* got str"),
        (lambda: ctsim.plot_geometry("x"), "scan: expected a scan or a Geometry, got str"),
        (lambda: ctsim.plot_projections("x"), "expected a scan or real numbers"),
        (lambda: ctsim.find_scene(42, "x"), "suite: expected the name of a suite .* got int"),
    ],
)
def test_what_is_no_scan_is_one_sentence(call, said):
    with pytest.raises(InputError, match=f"^{said}"):
        call()


def test_a_measured_scan_has_no_truth_to_score_with(tmp_path):
    few = msgspec.structs.replace(GEOMETRY, n_views=6)
    log = scan_files.skyscan(tmp_path / "scan", counts_of(line_integrals(few)), few)
    own = open_scan(bring(Flags(scan=log, out=tmp_path / "data")))
    with pytest.raises(InputError, match="data/rods: is a measured scan, which has no truth"):
        ctsim.score_volume(np.zeros(own.geometry.n_voxel), own)
    for scan in (own, own.scan):  # said the same way of both
        with pytest.raises(InputError, match=r"^mask = 'oracle': the scan has no true metal mask; say 'auto' or name"):
            ctsim.reconstruct_scan(scan, "nmar")
    assert ctsim.reconstruct_scan(own, "nmar", mask="auto").details["mask"] == "auto"
    with pytest.raises(InputError, match=r"was written without metal\.tif"):
        ctsim.reconstruct_scan(own, "cmd:true {scan} {out} {mask}")


@pytest.mark.parametrize("status", list(Status))
def test_what_run_benchmark_does_not_score_is_refused(simulated, status):
    volume = Volume(values=reconstruct_scan(simulated).values, status=status, reason="it is so")
    if status in ("ok", "diverged"):
        assert score_volume(volume, simulated)["tissue"].values
    else:
        with pytest.raises(InputError, match=f"status is {status}, which is not scored: it is so"):
            score_volume(volume, simulated)
    if status != "ok":
        with pytest.raises(InputError, match=f"status is {status}"):
            score_volume(volume.values.numpy(), simulated, twin=volume)


def test_a_measured_scan_is_reconstructed_without_truth(simulated):
    own = Scan(
        geometry=simulated.geometry, counts=simulated.scan.counts, flat=simulated.scan.flat, dark=simulated.info.dark
    )
    assert torch.equal(reconstruct_scan(own).values, reconstruct_scan(simulated).values)
    with pytest.raises(InputError, match="expected a simulated scan"):
        reconstruct_scan(own, "twin-fdk")


def skip(scan):
    return "it is Tuesday"


def nothing(scan):
    return 3


def test_methods_that_skip_or_are_wrong_are_named(simulated, monkeypatch):
    with pytest.raises(InputError, match="did you mean nmar"):
        reconstruct_scan(simulated, "nmarr")
    with pytest.raises(InputError, match=r"fdk\.window"):
        reconstruct_scan(simulated, "fdk", window="han")
    with pytest.raises(InputError, match="skips this scan: it is Tuesday"):
        reconstruct_scan(simulated, "test_api:nothing")
    monkeypatch.delitem(globals(), "skip")
    with pytest.raises(InputError, match="returned a int"):
        reconstruct_scan(simulated, "test_api:nothing")


def test_scenes_are_found_by_name_and_seed(smallest):
    assert find_scene("quick", "lung-Fe").name == "lung-Fe"
    another = find_scene("quick", "lung-Fe", seed=3)
    assert (another.name, another.seed) == ("lung-Fe-s3", 3)
    with pytest.raises(InputError, match=r"'quick' has no scene 'lung', expected one of lung-Fe"):
        find_scene("quick", "lung")
    with pytest.raises(InputError, match="neither a TOML file nor a bundled suite"):
        find_scene("quik", "lung-Fe")
    (path,) = smallest.glob("*/scene.toml")
    assert find_scene(str(path), "smallest") == load_suite(path)[0]


def test_a_scene_of_ones_own_is_that_of_a_file():
    keys = {"recipe": "validation", "metal": "Al", "n_voxel": (16, 16, 16)}
    scanner = {"n_voxel": (10, 12, 12), "n_detector": (16, 18), "n_views": 12}
    assert new_scene(name="smallest", seed=5, phantom=keys, scanner=scanner) == parse_suite(SMALLEST)[0]
    with pytest.raises(InputError, match=r"scene: phantom\.metl"):
        new_scene(name="a", phantom={"recipe": "validation", "metl": "Al"})


def test_a_scene_takes_what_numpy_gives():
    ours = new_scene(name="a", seed=3, phantom={"recipe": "walnut", "n_voxel": [40, 41, 42], "size": 50.0})
    for n in (np.array([40, 41, 42]), tuple(np.int64(k) for k in (40, 41, 42))):
        size = np.float32(50)
        assert new_scene(name="a", seed=np.int64(3), phantom={"recipe": "walnut", "n_voxel": n, "size": size}) == ours
    for wrong, said in ((np.array([40, 40]), "phantom.n_voxel"), (np.array([40.5, 40, 40]), r"phantom.n_voxel\[0\]")):
        with pytest.raises(InputError, match=f"^scene: {said}: "):
            new_scene(name="a", phantom={"recipe": "walnut", "n_voxel": wrong})
    with pytest.raises(InputError, match=r"^scene: scanner.tube: "):
        new_scene(name="a", phantom={"recipe": "walnut"}, scanner={"tube": np.ones(2)})


def test_a_method_that_knows_energies_is_read_at_50_kev(simulated):
    values = reconstruct_scan(simulated).values
    volume = Volume(values=values, at_energy=lambda kev: values * (kev / 100))
    found, plain = score_volume(volume, simulated), score_volume(values.numpy(), simulated)
    assert found["tissue"] == plain["tissue"]
    half = msgspec.structs.replace(score_volume(values.numpy() / 2, simulated)["paper"], volume=found["paper"].volume)
    assert found["paper"] == half != plain["paper"]


@pytest.mark.parametrize("seed", [1.5, True, "a"])
def test_a_seed_is_a_whole_number(seed):
    with pytest.raises(InputError, match="seed: expected a whole number or None"):
        ctsim.find_scene("quick", "lung-Fe", seed=seed)


def test_a_folder_is_a_text_or_a_path():
    with pytest.raises(InputError, match="folder: expected the folder of a scan"):
        ctsim.open_scan(None)
