import msgspec
import pytest

from ctsim.benchmarks.studies.methods.grids import coincide, shared_text, with_grid
from ctsim.benchmarks.studies.methods.records import read
from ctsim.benchmarks.studies.methods.study import main
from ctsim.dataset.store import list_scans, open_scan
from ctsim.geometry import Geometry
from ctsim.scaninfo import LabelGrid

VOLUME = Geometry(
    dso=200.0, dsd=400.0, n_voxel=(8, 16, 16), d_voxel=(2.0, 1.0, 1.0), n_detector=(5, 7), d_detector=(0.2, 0.25),
    n_views=6,
)  # fmt: skip


def labels(n, shift=0.0):
    """A label grid of n³ voxels over the volume's 16 mm, moved by a part of its voxels."""
    return LabelGrid(n_voxel=(n, n, n), d_voxel=(16 / n,) * 3, off_origin=(shift * 16 / n,) * 3)


@pytest.mark.parametrize(
    ("n", "shift", "shared"),
    [
        (16, 0.0, True), (32, 0.0, True), (8, 0.0, True), (16, 1.0, True),  # the same, twice as fine, twice as coarse
        (16, 0.5, False), (16, 0.05, False), (24, 0.0, False), (27, 0.0, False), (27, 0.31, False),
    ],
)  # fmt: skip
def test_grids_coincide_where_faces_lie_on_faces(n, shift, shared):
    assert coincide((16, 16, 16), VOLUME, labels(n, shift)) == shared
    moved = msgspec.structs.replace(VOLUME, off_origin=(0.3, 0.0, 0.0))
    assert not coincide((16, 16, 16), moved, labels(n, shift))  # one axis is enough to part them


def test_a_method_that_states_its_grid_is_judged_by_it():
    assert with_grid({"a": 1}, VOLUME, labels(24)) == {"a": 1}
    assert with_grid({"grid": [24, 24, 24]}, VOLUME, labels(24))["shared_grid"] == [24, 24, 24]
    assert with_grid({}, VOLUME, LabelGrid(n_voxel=(8, 16, 16), d_voxel=(2.0, 1.0, 1.0)))["shared_grid"] == [8, 16, 16]
    for odd in ("text", [1, 2], [0, 1, 1], None):
        assert with_grid({"grid": odd}, VOLUME, labels(24)) == {"grid": odd}
    assert with_grid({}, VOLUME, None) == {}
    assert shared_text({"fdk on a": {}}) == ""
    assert "fdk on a (8 x 8 x 8)" in shared_text({"fdk on a": {"shared_grid": [8, 8, 8]}})


SCENE = """
name = "{name}"

[phantom]
recipe = "lung"
metal = "Fe"
n_voxel = [12, 12, 12]
grid_shift = [{shift}, {shift}, {shift}]

[scanner]
n_voxel = [12, 12, 12]
n_detector = [16, 18]
n_views = 12
"""


def test_the_tables_name_the_rows_that_share_the_grid(tmp_path, capsys):
    from ctsim.benchmarks import make_dataset

    for name, shift in (("same", 0.0), ("moved", 0.31)):
        (tmp_path / f"{name}.toml").write_text(SCENE.format(name=name, shift=shift), encoding="utf-8")
        assert make_dataset.main([str(tmp_path / f"{name}.toml"), str(tmp_path / "data")]) == 0
    grids = {folder.name: open_scan(folder).info.label_grid for folder in list_scans(tmp_path / "data")}
    assert grids["moved"].n_voxel == grids["same"].n_voxel == (12, 12, 12)
    d = grids["moved"].d_voxel[0]
    assert grids["same"].off_origin == (0.0, 0.0, 0.0)
    assert grids["moved"].off_origin == pytest.approx((0.31 * d,) * 3)
    assert main([str(tmp_path / "data"), str(tmp_path / "results"), "--method", "fdk", "--no-keep-volumes"]) == 0
    said = capsys.readouterr().out
    table = (tmp_path / "results" / "table.md").read_text(encoding="utf-8")
    for text in (said, table):
        assert "fdk on same (12 x 12 x 12)" in text and "fdk on moved" not in text
    assert [r.details.get("shared_grid") for r in read(tmp_path / "results") if r.run.scene == "moved"] == [None, None]
