"""The catalogue of `run-benchmark peers`, and what becomes of peers that are not measured."""

from pathlib import Path

import pytest

from benchmarks import host, peer_cases, peer_catalogue, peer_poly, peers
from benchmarks.peer_cases import MEASURED, RTK, Setup
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
        ("views = 180", "views = 0", "$.case[0].views"),
        ("views = 180", 'views = "many"', "$.case[0].views"),
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
    assert peer_catalogue.parse(WHOLE, "my.toml").case[0].peers == (RTK,)
    with pytest.raises(InputError) as error:
        peer_catalogue.parse(WHOLE.replace(before, after, 1), "my.toml")
    assert str(error.value).startswith("my.toml: ") and said in str(error.value) and "\n" not in str(error.value)


def test_code_and_catalogue_know_the_same_names(monkeypatch):
    found = peer_catalogue.load()
    assert set(MEASURED) <= {peer.name for peer in found.peer}
    assert set(peer_cases.path_scenes(16)) == set(peer_catalogue.case("paths").scenes)
    assert set(peer_poly.SCENES) == set(peer_catalogue.case("poly").scenes)
    assert {m for m in peer_catalogue.case("poly").peers if m in MEASURED} < set(peer_poly.NOTES)
    monkeypatch.setattr(host, "use_threads", lambda threads: None)
    names = [case.name for case in found.case]
    for name in names:
        monkeypatch.setattr(peer_poly if name == "poly" else peer_cases, name, lambda setup, name=name: [name])
    assert [peers.measure(name, Setup()) for name in names] == [[name] for name in names]
    assert f"({', '.join(names)})" in Path(peers.__file__).read_text(encoding="utf-8")  # what --help lists
    with pytest.raises(InputError, match="no case 'fkd': expected one of paths, exact"):
        peer_catalogue.case("fkd")


def test_the_scene_of_the_case_paper_is_the_suites_with_so_many_views():
    from benchmarks.make_dataset import load, select

    case = peer_catalogue.case("paper")
    for suite in ("quick", "paper"):
        chosen = select(load(suite), case.scenes, ())
    assert [scene.resolve().geometry.n_views for scene in chosen] == [case.views]


def test_a_peer_is_there_with_its_distribution_and_its_module():
    def peer(**found):
        return peer_catalogue.Peer(name="p", install="so", **found)

    assert peer(distribution="numpy").version == peer(distribution="numpy", module="numpy").version is not None
    assert peer(distribution="numpy", module="no_such_module").version is None
    assert peer(distribution="no-such-distribution", module="numpy").version is None
    assert peer(distribution="d").absence == "d is not installed (so)"
    assert peer(distribution="d", gpu=True).absence == "d is not installed (so; needs an NVIDIA GPU)"


def test_a_peer_without_code_says_so_where_it_is_installed():
    case = peer_catalogue.case("fdk")
    rows = peer_cases.left_out(Setup(versions={RTK: "2.7", "leap": "1.26"}), case, "s")
    assert [(m.contender, m.status) for m in rows] == [
        ("leap", "not measured"),
        ("tigre", "absent"),
        ("r2-gaussian", "absent"),
    ]
    assert rows[0].reason == "leapct 1.26 is installed, not measured: this command has no code for it"
    assert "not for commercial use" in rows[2].reason and "GPU" in rows[2].reason
