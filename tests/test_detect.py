"""The detection study: its scenes, the scans that it draws, and the command on a scene of 24 voxels."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch

from ctsim.benchmarks import cli
from ctsim.benchmarks.engine.record import latest
from ctsim.benchmarks.methods import CONTROLS, TABLE, find
from ctsim.benchmarks.oracles import central_rays
from ctsim.benchmarks.studies.detect import DEFAULT, Flags, measure, suite, tables
from ctsim.benchmarks.studies.detect.records import Pair, Seen, Site
from ctsim.benchmarks.studies.detect.study import Detect
from ctsim.errors import InputError

SMALL = """
[[scene]]
name = "small-hip"
seed = 1
tissue = "muscle"
diameter = 8.0
density = 1.3
simulation = { scatter_error = 0.5 }
locations = [
    { group = "near", at = [40.0, 0.0, -15.0] },
    { group = "near", at = [-41.0, -11.0, -14.0] },
    { group = "far", at = [-7.0, 37.0, 33.0] },
    { group = "none", at = [-53.0, -18.0, -19.0] },
]

[scene.phantom]
recipe = "hip"
metal = "Ti"
head = "CoCr"
size = 180.0
n_voxel = [47, 47, 47]

[scene.scanner]
preset = "c-arm"
arc_deg = 360.0
n_voxel = [24, 24, 24]
n_detector = [32, 32]
n_views = 12
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("detect") / "small.toml"
    path.write_text(SMALL, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def setup(small) -> measure.Setup:
    return measure.setup(small, "small-hip")


def test_the_contrast_to_noise_of_lesions_counts_noise_and_artefacts():
    """Noise of 0.3 and artefacts of 0.4 that differ between locations, of a contrast of 0.8: 0.8 / 0.5."""
    rng, n, sites = np.random.default_rng(0), 200, 100
    at = [Site(at=(k, 0.0, 0.0), group="near", distance_mm=1.0, contrast_hu=20.0) for k in range(sites)]
    anatomy, artefact = rng.normal(3, 1, sites), rng.normal(0.7, 0.4, sites)
    artefact = 0.7 + 0.4 * (artefact - artefact.mean()) / artefact.std()

    def seen(values):
        return Seen(ball=(), slice=(), lesion=tuple(values.tolist()))

    pairs = tuple(
        Pair(
            anatomy=seen(anatomy),
            absent=seen(anatomy + artefact + rng.normal(0, 0.3, sites)),
            present=seen(anatomy + artefact + 0.8 + rng.normal(0, 0.3, sites)),
        )
        for _ in range(n)
    )
    told = {"scene": "a", "method": "fdk", "inputs": "", "lost": 0, "reason": "", "sites": tuple(at)}
    one = tables.Series(**told, pairs=tuple(range(n)), found=pairs)
    assert one.cnr(range(sites)) == pytest.approx(0.8 / 0.5, rel=0.02)  # 20 000 numbers: 0.5 %, and their mean 0.4 %
    assert one.cnr([0]) == pytest.approx(0.8 / 0.3, rel=0.25)
    # less than 0.01 HU is rounding, of which no contrast is a multiple
    fainter = tuple(msgspec.structs.replace(site, contrast_hu=0.019) for site in at)
    assert tables.Series(**(told | {"sites": fainter}), pairs=tuple(range(n)), found=pairs).cnr(range(sites)) is None


def test_lesions_change_only_the_rays_through_them(setup, small):
    """Neither scatter nor the choice of energies may tell an observer that there are lesions."""
    (scene,) = suite.load(small)
    geometry = setup.present.scanner.geometry
    source, ray = central_rays(geometry)
    distance = np.full(geometry.shape, np.inf)
    for place in scene.locations:
        if place.group != "none":
            to = np.array(place.at) - source
            distance = np.minimum(distance, np.linalg.norm(np.cross(to, ray), axis=-1))
    # a pixel's rays are within half its diagonal of the central one, which is less at the object
    aside = scene.diameter / 2 + np.hypot(*geometry.d_detector) / 2
    outside, inside = distance > aside, distance < scene.diameter / 4
    assert outside.sum() > 1000 and inside.sum() > 10
    for with_lesions, without in zip(setup.present.moments, setup.absent.moments, strict=True):
        p = -np.log(with_lesions[0].astype(np.float64) / without[0])
        # sums over energies in float32 of the same terms in the same order
        assert np.abs(p[outside]).max() < 1e-6
        assert p[inside].min() > 0.02  # 6.9 mm or more of muscle of 1.3 times its density, 0.2/cm: 0.04 or more


def test_methods_get_the_same_scans_and_the_twin_control_the_same_noise(setup):
    fdk, nmar, twin = (find(name) for name in ("fdk", "nmar", "twin-fdk"))
    one, other = setup.scan(fdk, 3, lesion=True), setup.scan(nmar, 3, lesion=True)
    assert torch.equal(one.counts, other.counts) and torch.equal(one.flat, other.flat)
    assert one.metal is None and other.metal is not None and bool(other.metal.any())
    assert not torch.equal(one.counts, setup.scan(fdk, 4, lesion=True).counts)
    # present and absent scans have independent noise: rays far from all lesions differ, too
    assert not torch.equal(one.counts[:, 0, :], setup.scan(fdk, 3, lesion=False).counts[:, 0, :])
    free = setup.scan(twin, 3, lesion=True)
    assert free.metal is None and torch.equal(free.flat, one.flat)
    assert (free.counts.float() - one.counts.float() > 100).any()  # the metal's shadow is gone
    anatomy = setup.anatomy(nmar)
    assert anatomy.metal is not None and not bool(anatomy.metal.any()) and anatomy.counts.dtype == torch.float32


def test_a_volume_with_the_true_lesions_holds_all_of_them(setup):
    shape = setup.present.scanner.geometry.n_voxel
    empty, volume = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    for lesion, ball in zip(setup.lesions, setup.balls, strict=True):
        volume.reshape(-1)[ball.index] += lesion.astype(np.float32)
    seen = setup.seen(volume)
    assert seen.lesion == pytest.approx((1, 1, 1, 0), abs=1e-6)  # float32
    assert setup.seen(empty).lesion == (0, 0, 0, 0)
    assert not any(seen.ball[3]) and abs(seen.ball[0][0]) > 0
    # muscle attenuates as 1.05 times as much water, to some percent: 0.3 of it is 315 HU
    assert all(site.contrast_hu == pytest.approx(315, rel=0.05) for site in setup.sites[:3])
    # the lesion far from metal, where no voxel is left out: its mass is volume times contrast
    # the radius is half a voxel, of which painted shares err by 1/250; muscle has 0.0208/mm at 60 keV, else within 8 %
    mass = float(setup.lesions[2].sum()) * setup.present.scanner.geometry.d_voxel[0] ** 3
    assert mass == pytest.approx(4 / 3 * np.pi * 4.0**3 * 0.3 * 0.0208, rel=0.1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"density": 1.0}, "density must not be 1"),
        ({"tissue": "brain"}, "tissue 'brain' is not in the body"),
        ({"locations": [{"group": "near", "at": [0.0, 0.0, 0.0]}]}, "is not within muscle"),
        ({"locations": [{"group": "far", "at": [40.0, 0.0, -15.0]}]}, "expected above 10 mm"),
        ({"locations": [{"group": "near", "at": [-7.0, 37.0, 33.0]}]}, "expected at most 10 mm"),
        (
            {"locations": [{"group": "near", "at": [40.0, 0.0, -15.0]}, {"group": "near", "at": [40.0, 0.0, -4.0]}]},
            "are less than 12 mm apart",
        ),
    ],
)
def test_wrong_scenes_are_refused_in_one_sentence(small, change, words):
    (scene,) = suite.load(small)
    with pytest.raises((InputError, msgspec.ValidationError), match=words):
        changed = msgspec.convert(msgspec.to_builtins(scene) | change, suite.DetectScene)
        _, body = changed.bodies()
        changed.distances(body, changed.scan.resolve().geometry)


def test_the_bundled_scenes_are_what_they_say():
    for scene in suite.load():
        _, body = scene.bodies()
        distances = scene.distances(body, scene.scan.resolve().geometry)
        groups = [place.group for place in scene.locations]
        assert groups.count("near") >= 6 and groups.count("far") >= 3 and groups.count("none") >= 2
        assert distances.min() > 0.5  # mm


def run(results: Path, small: Path, *arguments: str) -> int:
    return cli.guarded(
        "run-benchmark detect", cli.OTHERS["detect"].module, [str(results), "--suite", str(small), *arguments]
    )


def test_the_command_measures_and_continues(small, tmp_path, capsys):
    asked = ("--method", "fdk", "--method", "twin-fdk", "--repeats", "10")
    assert run(tmp_path, small, *asked) == 0
    shown = capsys.readouterr()
    assert "fewer than 100 pairs" in shown.err
    text = (tmp_path / "detect.md").read_text()
    assert "2 near metal" in text and "10 pairs of scans, fewer than the 100 of the protocol" in text
    assert "## Locations without a lesion" in text and "## Each location" in text
    records = latest(Detect().store(Flags(results=tmp_path)).read())
    assert len(records) == 20 and all(r.ok for r in records)
    one, two = tables.series_of(records)
    assert (one.method, two.method) == ("fdk", "twin-fdk") and one.pairs == tuple(range(10))
    # without metal the anatomy is what is seen but for noise: a third of the variation near metal, or less
    left = [s.responses("near", less_anatomy=True).absent.mean(0) for s in (one, two)]
    assert np.abs(left[1]).max() < np.abs(left[0]).max() / 3
    assert run(tmp_path, small, *asked) == 0
    assert "20 of 20 pairs are recorded already" in capsys.readouterr().err
    assert run(tmp_path, small, *asked, "--table") == 0


def rows_of(text: str, title: str) -> dict[tuple[str, ...], list[str]]:
    """Return the rows of the table under a title by scene, lesions and method."""
    lines = text.partition(f"## {title}\n")[2].partition("\n## ")[0].splitlines()
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("| small-hip")]
    return {tuple(row[:3]): row[3:] for row in cells}


def test_controls_stand_in_the_default_table():
    assert [name for name in DEFAULT if TABLE[name][1] in CONTROLS] == ["zero", "hull", "twin-fdk"]


def test_controls_see_no_lesion_and_corrected_rows_are_rows_of_their_own(small, tmp_path):
    corrected = ("--method", "nmar", "--set", "nmar.panel=found", "--set", "nmar.scatter=0.02")
    named = ("fdk", "zero", "hull", "nmar")
    assert run(tmp_path, small, "--repeats", "10", *corrected) == 0  # before the plain row, which it follows in tables
    assert run(tmp_path, small, "--repeats", "10", *(part for name in named for part in ("--method", name))) == 0
    text = (tmp_path / "detect.md").read_text()
    rows = rows_of(text, "Detection of lesions")
    label, tie = "nmar[panel=found, scatter=0.02]", "0.500 [0.500, 0.500]"
    assert list(rows) == [("small-hip", group, name) for group in ("near", "far") for name in (*named, label)]
    for group in ("near", "far"):
        inputs, varying, _, known, _, recovered, cnr, _ = rows["small-hip", group, "zero"]
        assert (inputs, known, recovered, cnr) == ("control", tie, "0.00", "–")
        assert varying == (tie if group == "near" else "–")  # far from metal is one location alone
        # one value holds no lesion; whether it is told of them is the noise's to say
        inputs, *_, recovered, _, _ = rows["small-hip", group, "hull"]
        assert inputs == "control" and abs(float(recovered)) < 0.1
        assert rows["small-hip", group, label][:-1] != rows["small-hip", group, "nmar"][:-1]  # but for their seconds
    assert "nan" not in text and "all pairs tie" in text and "a label says panel=found, scatter=found" in text


def test_a_method_that_fails_is_a_finding(small, tmp_path, capsys, monkeypatch):
    (tmp_path / "broken_method.py").write_text("def reconstruct(scan):\n    raise ValueError('no')\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    asked = ("--method", "broken_method:reconstruct", "--repeats", "10")
    assert run(tmp_path / "r", small, *asked) == 1
    assert "10 pairs failed: anatomy: ValueError: no" in capsys.readouterr().out
    records = Detect().store(Flags(results=tmp_path / "r")).read()
    assert {r.status for r in records} == {"error"} and all(isinstance(r.found[0], Pair) for r in records)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--repeats", "9"), "--repeats must be at least 10"),
        (("--scene", "small"), "--scene small: no such scene, expected one of small-hip"),
        (("--method", "fdkk"), "there is no method 'fdkk'"),
        (("--set", "fdk.window=x"), "--set fdk.window"),
    ],
)
def test_what_makes_no_sense_is_one_sentence(small, tmp_path, capsys, arguments, words):
    assert run(tmp_path / "r", small, *arguments) == 2
    shown = capsys.readouterr().err
    assert words in shown and "Traceback" not in shown and not (tmp_path / "r").exists()
