"""Tables say where a trained method is scored on scans that it may have been trained on."""

import pytest

from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.studies.methods.splits import trained_text, with_split
from ctsim.benchmarks.studies.methods.study import main
from ctsim.dataset.store import list_scans, open_scan

SCENES = """
[[scene]]
name = "body"
count = 6
split = { train = 0.5, test = 0.5 }
phantom = { recipe = "metal_rods", metal = "Fe", n_voxel = [12, 12, 12], grid_shift = [0.3, 0.3, 0.3] }
scanner = { n_voxel = [12, 12, 12], n_detector = [16, 18], n_views = 12 }
[scene.vary]
phantom.size = { uniform = [40.0, 60.0] }
"""


@pytest.mark.parametrize(
    "inputs, split, flattered",
    [
        ("training", "train", True),
        ("training, metal mask", "val", True),
        ("training", "test", False),
        ("training", "", False),
        ("counts only", "train", False),
    ],
)
def test_only_trained_methods_on_scans_to_train_on_are_flattered(inputs, split, flattered):
    details = with_split({"seconds": 1.0}, inputs, split)
    assert details == ({"seconds": 1.0, "trained_on": split} if flattered else {"seconds": 1.0})
    assert bool(trained_text({"fusion on a": details})) == flattered


def test_the_tables_name_the_rows(tmp_path, monkeypatch, capsys):
    (tmp_path / "body.toml").write_text(SCENES, encoding="utf-8")
    (tmp_path / "trained.py").write_text(
        "from ctsim.reconstruct.fdk import reconstruct as fdk\nINPUTS = 'training'\n"
        "def reconstruct(scan): return fdk(scan)\n",
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(tmp_path)
    data, results = tmp_path / "data", tmp_path / "results"
    assert make_dataset.main([str(tmp_path / "body.toml"), str(data)]) == 0
    splits = {folder.name: open_scan(folder).split for folder in list_scans(data)}
    assert set(splits.values()) == {"train", "test"}
    methods = ["--method", "fdk", "--method", "trained:reconstruct"]
    assert main([str(data), str(results), *methods, "--no-keep-volumes"]) == 0
    said = capsys.readouterr().out, (results / "table.md").read_text(encoding="utf-8")
    for name, split in splits.items():
        for text in said:
            told = " ".join(text.split())
            assert (f"reconstruct on {name} ({split})" in told) == (split != "test")
            assert f"fdk on {name} (" not in told
