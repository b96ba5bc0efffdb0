"""Datasets of a scanner with focal spot, blur, lag and scatter: killed, or made by two workers, they stay the same."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from forks import Forks, Run

from ctsim.benchmarks import make_dataset
from ctsim.benchmarks.suites import load
from ctsim.dataset.manifest import verify
from ctsim.detector.panel import Lag, response
from ctsim.phantoms.dataset import plan_scene

pytestmark = pytest.mark.slow

VIEWS = 12
LAG = (Lag(share=0.05, decay=0.1), Lag(share=0.03, decay=0.2))
SUITE = f"""
[defaults]
truth = {{ noise_free = true, scatter_free = true }}
simulation = {{ scatter_error = 0.3, spot_error = 0.1 }}
[defaults.scanner]
preset = "ideal"
n_views = {VIEWS}
n_detector = [10, 12]
n_voxel = [10, 14, 22]
scatter = {{ level = 3, grid_ratio = 8.0 }}
tube = {{ falloff = true, focal_spot = {{ size = [3.0, 3.0] }}, off_focal = {{ share = 0.05, fwhm = 8.0 }} }}
[defaults.scanner.detector]
kind = "csi"
thickness = 0.5
blur = {{ fwhm = 8.0, tail = 0.1, tail_fwhm = 20.0 }}
lag = [{", ".join(f"{{ share = {part.share}, decay = {part.decay} }}" for part in LAG)}]
[defaults.phantom]
recipe = "validation"
n_voxel = [16, 16, 16]

[[scene]]
name = "rods"

[[scene]]
name = "bare"
phantom = {{ metal = "none" }}
"""


class Bench:
    """The suite, the process that forks, and the files of a run that nothing disturbed."""

    def __init__(self, forks: Forks, folder: Path) -> None:
        self.forks, self.suite = forks, folder / "suite.toml"
        self.suite.write_text(SUITE, encoding="utf-8")
        assert self.make(folder / "data", here=True).code == 0
        self.data, self.content = folder / "data", content(folder / "data")

    def make(self, data: Path, *flags: str, **how) -> Run:
        return self.forks.run("make-dataset", self.suite, data, *flags, **how)


@pytest.fixture(scope="module")
def bench(tmp_path_factory) -> Iterator[Bench]:
    with Forks() as forks:
        yield Bench(forks, tmp_path_factory.mktemp("bench"))


def content(data: Path) -> dict[str, str]:
    """Hash every file but the plan and the manifest, whose estimate of time differs between runs."""
    files = (p for p in data.rglob("*") if p.is_file() and p.name not in ("plan.json", "manifest.json"))
    return {p.relative_to(data).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def test_the_scenes_have_all_of_it_and_remember_some_views(bench):
    """Or the other tests would prove nothing."""
    for scene in load(str(bench.suite)):
        plan = plan_scene(scene)
        names = ("falloff", "focal spot", "off-focal", "detector blur", "lag", "scatter 3")
        assert [name for name in names if not plan.runs(name)] == []
        assert plan.spot is not None and len(plan.spot.weights) > 1
    assert 1 < response(LAG).size - 1 < VIEWS // 2


def test_a_killed_run_goes_on_to_the_same_bytes(bench, tmp_path, capsys):
    killed_at, mark = VIEWS // 2, tmp_path / "mark"
    codes = [bench.make(tmp_path / "data", view=(killed_at, str(mark))).code for _ in range(2)]
    assert codes == [-9, 0]
    assert mark.read_text().split() == [str(killed_at + 1), "0"]  # the first scene goes on, the second one begins
    assert content(tmp_path / "data") == bench.content
    assert make_dataset.main(["--verify", str(tmp_path / "data")]) == 0
    assert "2 scenes, every file is as it was written" in capsys.readouterr().out


def test_two_workers_make_the_same_bytes(bench, tmp_path):
    assert make_dataset.main([str(bench.suite), str(tmp_path / "data"), "--workers", "2"]) == 0
    assert content(tmp_path / "data") == bench.content and verify(tmp_path / "data") == []
