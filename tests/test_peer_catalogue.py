"""The catalogue of `run-benchmark peers`, and what becomes of cases and peers that are not measured."""

from pathlib import Path

import pytest

from ctsim.benchmarks.engine import host
from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.studies.peers import cases, finding, poly, study
from ctsim.benchmarks.studies.peers.finding import MEASURED, RTK, Measurement, Setup
from ctsim.errors import InputError

WHOLE = """
[[case]]
name = "fdk"
views = 180
metals = ["Al"]
turn = 1.0
rest = 2.0
peers = ["itk-rtk"]

[[peer]]
name = "itk-rtk"
distribution = "itk-rtk"
install = "pip install itk-rtk"
"""


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("views = 180", "views = 0", "case[0].views"),
        ("views = 180", 'views = "many"', "case[0].views"),
        ("rest = 2.0", "", "rest"),
        ("turn = 1.0", "trun = 1.0", "trun"),
        ('metals = ["Al"]', "", "expected scenes or metals"),
        ('metals = ["Al"]', 'metals = ["Al"]\nscenes = ["lung"]', "expected scenes or metals"),
        ('peers = ["itk-rtk"]', 'peers = ["itk"]', "no peer 'itk', expected of itk-rtk"),
        (
            "[[peer]]",
            '[[peer]]\nname = "itk-rtk"\ndistribution = "x"\ninstall = "y"\n[[peer]]',
            "'itk-rtk' is there twice",
        ),
        ("[[case]]", "[[case]", "my.toml"),
    ],
)
def test_what_is_no_catalogue_is_one_sentence(before, after, said):
    assert finding.parse(WHOLE, "my.toml").case[0].peers == (RTK,)
    with pytest.raises(InputError) as error:
        finding.parse(WHOLE.replace(before, after, 1), "my.toml")
    assert str(error.value).startswith("my.toml: ") and said in str(error.value) and "\n" not in str(error.value)


def test_code_and_catalogue_know_the_same_names(monkeypatch):
    found = finding.load()
    assert set(MEASURED) <= {peer.name for peer in found.peer}
    assert set(cases.PATH_SCENES) == set(finding.case("paths").scenes)
    assert set(poly.SCENES) == set(finding.case("poly").scenes)
    assert {m for m in finding.case("poly").peers if m in MEASURED} < set(poly.NOTES)
    names = [case.name for case in found.case]
    assert set(names) == set(cases.CASES)
    assert f"({', '.join(names)})" in Path(study.__file__).read_text(encoding="utf-8")  # what --help lists
    with pytest.raises(InputError, match="no case 'fkd': expected one of paths, exact"):
        finding.case("fkd")


def test_a_case_is_measured_on_all_of_its_scenes_and_peers_left_out_follow(monkeypatch):
    monkeypatch.setattr(host, "use_threads", lambda threads: None)
    monkeypatch.setitem(cases.CASES, "exact", lambda setup, metal: [Measurement(contender=f"{setup.side} {metal}")])
    task = Task(study="peers", part="small", case="exact", settings={"threads": 1, RTK: "2.7"})
    found = cases.measure(task, study.Flags(results=Path("none")))
    assert [(m.scene, m.contender) for m in found] == [
        (f"{metal} rods in water", who) for metal in ("Al", "Fe") for who in (f"32 {metal}", "xcist")
    ]


def test_the_scene_of_the_case_paper_is_the_suites_with_so_many_views():
    from ctsim.benchmarks.suites import load, select

    case = finding.case("paper")
    for suite in ("quick", "paper"):
        chosen = select(load(suite), case.scenes, ())
    assert [scene.resolve().geometry.n_views for scene in chosen] == [case.views]


def test_a_peer_is_there_with_its_distribution_and_its_module():
    def peer(**found):
        return finding.Peer(name="p", install="so", **found)

    assert peer(distribution="numpy").version == peer(distribution="numpy", module="numpy").version is not None
    assert peer(distribution="numpy", module="no_such_module").version is None
    assert peer(distribution="no-such-distribution", module="numpy").version is None
    assert peer(distribution="d").absence == "d is not installed (so)"
    assert peer(distribution="d", gpu=True).absence == "d is not installed (so; needs an NVIDIA GPU)"


def test_a_peer_without_code_says_so_where_it_is_installed():
    rows = Setup(case=finding.case("fdk"), versions={RTK: "2.7", "leap": "1.26"}).left_out()
    assert [(m.contender, m.skipped) for m in rows] == [
        ("leap", "not measured"),
        ("tigre", "absent"),
        ("r2-gaussian", "absent"),
    ]
    assert rows[0].reason == "leapct 1.26: this command has no code for it"
    assert "not for commercial use" in rows[2].reason and "GPU" in rows[2].reason
