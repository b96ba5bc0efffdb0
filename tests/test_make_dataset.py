"""make-dataset from the command line, with a scene small enough to be made in a second."""

import hashlib
import shutil
import tomllib
from pathlib import Path

import msgspec
import numpy as np
import pytest
import tifffile
import tomli_w

from ctsim.benchmarks.make_dataset import main
from ctsim.benchmarks.make_dataset import work as command
from ctsim.benchmarks.make_dataset.work import PLANNED
from ctsim.benchmarks.suites import STUDY_SUITES, bundled, load, select
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError
from ctsim.human import human_bytes, human_time
from ctsim.phantoms import dataset
from ctsim.phantoms.dataset import plan_scene
from ctsim.phantoms.scene import load_suite, parse_suite, scene_id

SUITE = """
[defaults]
truth = { noise_free = true, mono_kev = [60.0], trace = true, paths = true }
[defaults.scanner]
n_views = 7
n_detector = [10, 12]
n_voxel = [10, 14, 22]
[defaults.phantom]
recipe = "validation"
n_voxel = [16, 16, 16]

[[scene]]
name = "rods"

[[scene]]
name = "bare"
phantom = { metal = "none" }
"""


@pytest.fixture
def suite(tmp_path) -> str:
    path = tmp_path / "suite.toml"
    path.write_text(SUITE)
    return str(path)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A finished dataset: copy it before changing it."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "suite.toml").write_text(SUITE)
    assert main([str(folder / "suite.toml"), str(folder / "data")]) == 0
    return folder / "data"


def content(folder: Path) -> dict[str, str]:
    """Hash every file but the plan and the manifest, whose estimate of time differs between runs."""
    files = (p for p in folder.rglob("*") if p.is_file() and p.name not in ("plan.json", "manifest.json"))
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_every_promised_file_is_there_and_opens(made, suite):
    assert [p.name for p in list_scans(made)] == ["rods", "bare"]
    stored = open_scan(made / "rods")
    names = {p.name for p in stored.folder.iterdir()}
    assert names >= {
        "counts.tif", "flat.tif", "reference_effective.tif", "reference_50kev.tif", "labels.tif", "metal.tif",
        "scene.toml", "scan.json", "plan.json", "spectrum.csv", "manifest.json", "metal_free",
        "noise_free.tif", "mono_60kev.tif", "trace.tif", "paths.tif",
    }  # fmt: skip
    assert stored.scan.counts.shape == (7, 10, 12)
    assert stored.metal.any() and stored.l0 > 0
    assert stored.metal_free is not None
    trace = stored.array("trace").astype(bool)
    same = stored.scan.counts.numpy() == stored.metal_free.scan.counts.numpy()
    assert trace.any() and not same[trace].all()
    # the twin has the same noise streams: far from metal not a single count differs
    assert same[:, :, [0, -1]].all()
    assert open_scan(made / "bare").metal_free is None
    np.testing.assert_array_equal(tifffile.imread(made / "rods/counts.tif"), stored.scan.counts.numpy())


def test_the_stored_recipe_rebuilds_the_scene(made, suite):
    (again,) = load_suite(made / "rods" / "scene.toml")
    assert scene_id(again) == open_scan(made / "rods").scene_id == scene_id(load_suite(suite)[0])


def test_the_spectrum_is_normalised(made):
    rows = np.loadtxt(made / "rods/spectrum.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows[:, 1:].sum(0), 1.0, rtol=1e-6)  # eight digits are printed


def test_a_dry_run_tells_all_and_writes_nothing(tmp_path, suite, capsys):
    assert main([suite, str(tmp_path / "data"), "--dry-run"]) == 0
    out = capsys.readouterr().out
    names = [line.split(":")[0] for line in out.splitlines() if not line.startswith(" ")]
    assert names == ["rods", "bare", "total"]
    rods, bare = out.split("bare\n")
    assert "no metal: metal-free twin" in bare and "no metal" not in rods
    assert "(energies)" in rods and "on disk" in rods and "not asked: " in rods
    assert not (tmp_path / "data").exists()


def planned(capsys, *words):
    """Return the titles of a dry run, and its last line."""
    assert main([*map(str, words), "--dry-run"]) == 0
    *titles, total = [line for line in capsys.readouterr().out.splitlines() if not line.startswith(" ")]
    return titles, total


def test_a_dry_run_plans_one_of_the_scenes_that_differ_in_their_seed_alone(made, tmp_path, suite, capsys):
    titles, total = planned(capsys, suite, tmp_path / "data", "--seeds", *range(500))
    more = "and 499 more that differ in their seed alone"
    assert titles == [f"rods-s0, {more}", f"bare-s0, {more}"] and total.endswith(" (planned 2 of 1000 scenes)")
    plans = [plan_scene(scene) for scene in select(load(suite), (), (0,))]
    assert f", {human_bytes(500 * sum(plan.disk_bytes for plan in plans))} on disk " in total
    data = Path(shutil.copytree(made, tmp_path / "made"))
    (tmp_path / "two.toml").write_text(Path(suite).read_text().replace('"bare"', '"other"'))
    assert planned(capsys, tmp_path / "two.toml", data)[0] == ["rods: already complete", "other"]


def test_a_dry_run_of_many_plans_one_of_a_recipe_and_geometry(tmp_path, suite, capsys):
    def listed(n):
        doses = [{"name": f"s{k}", "scanner": {"i0": 1e4 + k}} for k in range(n)]
        given = tomllib.loads(Path(suite).read_text())
        text = tomli_w.dumps(given | {"scene": [{**given["scene"][k % 2], **one} for k, one in enumerate(doses)]})
        (tmp_path / "many.toml").write_text(text)
        return planned(capsys, tmp_path / "many.toml", tmp_path / "data")

    assert listed(PLANNED)[0] == [f"s{k}" for k in range(PLANNED)]
    titles, total = listed(1000)
    assert titles == [f"s{k}, and 499 more of its recipe, metal, grids and number of views" for k in (0, 1)]
    assert total.endswith("(planned 2 of 1000 scenes)")


def test_finished_scenes_are_skipped(made, suite, tmp_path, capsys):
    data = Path(shutil.copytree(made, tmp_path / "data"))
    before = (data / "rods/manifest.json").stat().st_mtime_ns
    assert main([suite, str(data)]) == 0
    assert capsys.readouterr().err.splitlines() == ["rods: already complete", "bare: already complete"]
    assert (data / "rods/manifest.json").stat().st_mtime_ns == before
    assert main([suite, str(data), "--dry-run"]) == 0
    assert capsys.readouterr().out.count("already complete") == 2


@pytest.mark.parametrize("stop", [0, 3, 6])
def test_an_interrupted_run_goes_on_to_the_same_bytes(made, suite, tmp_path, monkeypatch, capsys, stop):
    real, first = dataset.simulate_views, []

    def interrupted(plan, phantom, scanner, first_view=0, **more):
        first.append(first_view)
        for view, arrays in real(plan, phantom, scanner, first_view=first_view, **more):
            if view == stop and len(first) == 1:
                raise KeyboardInterrupt
            yield view, arrays

    monkeypatch.setattr(dataset, "simulate_views", interrupted)
    data = tmp_path / "data"
    assert main([suite, str(data), "--only", "rods"]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert not (data / "rods").exists()
    assert main([suite, str(data), "--only", "rods"]) == 0
    assert first == [0, stop]
    assert content(data / "rods") == content(made / "rods")


def test_verify_passes_and_then_names_what_changed(made, tmp_path, capsys):
    data = Path(shutil.copytree(made, tmp_path / "data"))
    assert main(["--verify", str(data)]) == 0
    assert "2 scenes" in capsys.readouterr().out
    path = data / "rods/counts.tif"
    pixels = bytearray(path.read_bytes())
    pixels[-1] ^= 1
    path.write_bytes(pixels)
    assert main(["any", str(data), "--verify"]) == 2
    assert str(path) in capsys.readouterr().err


def test_another_scene_of_that_name_is_refused_unless_forced(made, suite, tmp_path, capsys):
    data = Path(shutil.copytree(made, tmp_path / "data"))
    Path(suite).write_text(SUITE.replace("n_views = 7", "n_views = 3"))
    before = content(data)
    assert main([suite, str(data), "--only", "rods"]) == 2
    error = capsys.readouterr().err
    assert "holds another scene" in error and error.count("\n") == 1
    assert content(data) == before
    assert main([suite, str(data), "--only", "rods", "--force"]) == 0
    assert open_scan(data / "rods").geometry.n_views == 3
    assert main(["--verify", str(data)]) == 0


def test_seeds_make_one_scan_each(suite, tmp_path):
    assert main([suite, str(tmp_path / "data"), "--only", "bare", "--seeds", "1", "2"]) == 0
    one, two = (open_scan(p) for p in list_scans(tmp_path / "data"))
    assert (one.name, two.name) == ("bare-s1", "bare-s2")
    assert not np.array_equal(one.scan.counts.numpy(), two.scan.counts.numpy())


def test_a_disk_too_small_is_refused_before_starting(suite, tmp_path, monkeypatch, capsys):
    usage = type(shutil.disk_usage(tmp_path))
    monkeypatch.setattr(command.shutil, "disk_usage", lambda _: usage(10**6, 10**6, 1000))
    assert main([suite, str(tmp_path / "data")]) == 2
    assert "only 1 kB are free" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[[scene", "not TOML"),
        (SUITE + "colour = 1\n", "colour"),
        (SUITE.replace("n_views = 7", "n_views = 'many'"), "n_views"),
        (SUITE.replace("n_views = 7", "n_views = nan"), "n_views"),
        (SUITE.replace('"rods"', '"../rods"'), "name"),
        ("", "no scenes"),
    ],
)
def test_a_wrong_file_is_one_sentence_that_names_it(suite, tmp_path, capsys, text, said):
    Path(suite).write_text(text)
    assert main([suite, str(tmp_path / "data")]) == 2
    error = capsys.readouterr().err
    assert suite in error and said in error and error.count("\n") == 1
    assert not (tmp_path / "data").exists()


def test_wrong_arguments_are_one_sentence(suite, tmp_path, capsys):
    cases = (
        ([suite], "data folder is missing"),
        (["nothing.toml", "x"], "nothing.toml"),
        (["--verify", str(tmp_path / "none")], "no such folder"),
        (["--verify", suite], "is a file, expected a data folder"),
        ([suite, "x", "--only", "rod"], "expected one of rods"),
        ([suite, suite], "is a file"),
    )
    for argv, said in cases:
        assert main(argv) == 2
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1


def test_a_wrong_name_among_thousands_is_answered_with_the_nearest_and_their_number():
    (one,) = parse_suite('name = "a"\nphantom = { recipe = "validation" }')
    many = tuple(msgspec.structs.replace(one, name=f"head-{k:04}") for k in range(300))
    with pytest.raises(InputError, match="no such scene, expected one of 300, nearest head-0077, ") as e:
        select(many, ("head-00077",), ())
    assert len(str(e.value)) < 150
    with pytest.raises(InputError, match="no such scene, expected one of 300, such as head-0000, head-0001, "):
        select(many, ("x",), ())


@pytest.mark.parametrize(
    ("where", "flags"),
    [
        ("ctsim.phantoms.variants.build", []),
        ("ctsim.phantoms.dataset.build", ["--dry-run"]),
        ("ctsim.phantoms.dataset.make_plans", []),
        ("ctsim.phantoms.dataset.simulate_views", []),
        ("ctsim.phantoms.dataset.truth_volumes", []),
    ],
)
def test_a_scene_too_large_for_memory_is_named(suite, tmp_path, monkeypatch, capsys, where, flags):
    monkeypatch.setattr(where, lambda *_, **__: np.zeros(2**58))  # 2 EB: NumPy's own MemoryError
    assert main([suite, str(tmp_path / "data"), *flags]) == 2
    error = capsys.readouterr().err
    assert "make-dataset: rods: " in error and "memory" in error and error.count("\n") == 1


def test_what_commands_measure_is_no_suite_of_scenes(tmp_path, capsys):
    assert {"quick", "core", "paper"} <= bundled().keys() and not bundled().keys() & set(STUDY_SUITES)
    for name in bundled():
        assert load(name), name
    assert main(["pareto", str(tmp_path / "data")]) == 2
    offered = capsys.readouterr().err.partition("bundled suite ")[2]
    assert "quick" in offered and "pareto" not in offered and not (tmp_path / "data").exists()


def test_units_read_well():
    assert (human_bytes(113_400_000), human_bytes(12), human_bytes(999_900)) == ("113 MB", "12 B", "1 MB")
    assert (human_time(41.3), human_time(300), human_time(12600)) == ("41 s", "5 min", "3.5 h")


def test_the_manifest_lists_every_file(made):
    listed = set(msgspec.json.decode((made / "rods/manifest.json").read_bytes())["files"])
    present = {p.relative_to(made / "rods").as_posix() for p in (made / "rods").rglob("*") if p.is_file()}
    assert present - listed == {"manifest.json"}
