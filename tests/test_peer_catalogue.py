"""The catalogue of `run-benchmark peers`, and what becomes of cases and peers that are not measured."""

import os
from pathlib import Path

import apart_jobs
import msgspec
import pytest

from ctsim.benchmarks import cli
from ctsim.benchmarks.engine import host, lines
from ctsim.benchmarks.studies.peers import cases as peer_cases
from ctsim.benchmarks.studies.peers import catalogue as peer_catalogue
from ctsim.benchmarks.studies.peers import poly as peer_poly
from ctsim.benchmarks.studies.peers import study as peers
from ctsim.benchmarks.studies.peers import tables as peer_tables
from ctsim.benchmarks.studies.peers.cases import MEASURED, OURS, RTK, Measurement, Setup
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
    from ctsim.benchmarks.suites import load, select

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


@pytest.fixture
def commit(monkeypatch):
    """Let the code be a commit's, and no peer be there."""
    monkeypatch.setattr(peer_catalogue, "installed", dict)
    monkeypatch.setattr(host, "use_threads", lambda threads: None)  # those of this process are not ours to set
    monkeypatch.setattr(host, "commit", lambda: "a" * 40)


def test_a_case_that_dies_or_overstays_is_a_row_and_the_next_begins(tmp_path, monkeypatch, capsys, commit):
    monkeypatch.setattr(peers, "measure", apart_jobs.die_in_exact)
    monkeypatch.setenv("CTSIM_TEST_MARK", str(tmp_path / "mark"))
    words = [str(tmp_path / "r"), "--repeats", "1", "--small", "--case", "exact", "--case", "fdk"]
    assert peers.main([*words, "--seconds", "60"]) == 1
    died, whole = (r.measurement for r in peer_tables.read(tmp_path / "r" / peers.NAME))
    assert (died.case, died.status, died.reason) == ("exact", "error", "the process died with exit code 3")
    assert whole.status == "ok" and whole.note.startswith("32 ") and whole.note != f"32 {os.getpid()}"
    assert not Path((tmp_path / "mark").read_text()).parent.exists()  # nor what it left there

    assert peers.main([*words, "--seconds", "0.1", "--force"]) == 1
    late = [r.measurement for r in peer_tables.read(tmp_path / "r" / peers.NAME)][2:]
    assert [(m.case, m.status, m.reason) for m in late] == [
        ("exact", "timeout", "did not end within 0.1 s"),
        ("fdk", "timeout", "did not end within 0.1 s"),
    ]
    capsys.readouterr()
    assert peers.main([*words, "--table"]) == 1  # it has failed, and is not known
    assert "| fdk | all | all | timeout | – | – | – | did not end within 0.1 s |" in capsys.readouterr().out
    assert peers.main([*words, "--dry-run"]) == 0 and "2 of 2 cases" in capsys.readouterr().out


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "inf"])
def test_a_limit_must_be_positive(tmp_path, seconds):
    with pytest.raises(InputError, match="--seconds must be positive"):
        peers.main([str(tmp_path / "r"), "--seconds", seconds])
    assert not (tmp_path / "r").exists()


def test_records_of_other_machines_are_taken_over_and_told_apart(tmp_path, monkeypatch, capsys):
    def record(case, minute, cpu="ours"):
        return peer_tables.PeerRecord(
            measurement=Measurement(case=case, scene="s", contender=OURS, seconds=(1.0 + minute,)), side=256,
            rtk="2.7", host=msgspec.structs.replace(host.host(), cpu=cpu), commit="a" * 40,
            time=f"2026-01-01T00:0{minute}:00+00:00", run=f"2026-01-01T00:0{minute}:00+00:00",
        )  # fmt: skip

    here, there = tmp_path / "here", tmp_path / "there"
    for folder in (here, there, tmp_path / "none"):
        folder.mkdir()
    lines.append(here / peers.NAME, record("fdk", 1), record("paths", 3))
    lines.append(there / peers.NAME, record("paths", 0, "theirs"), record("fdk", 2, "theirs"))
    assert peers.main([str(here), "--table"]) == 0
    assert "Cases of several runs" not in capsys.readouterr().out
    assert peers.main([str(here), "--collect", str(there)]) == 0
    said = capsys.readouterr()
    assert f"{there}: 2 records taken over" in said.err
    # the newest of each case, and under whose name it was measured
    assert "| fdk | s | ctsim | 3.000 |" in said.out and "| paths | s | ctsim | 4.000 |" in said.out
    assert "- fdk: 2026-01-01T00:02:00+00:00, commit aaaaaaaaaaaa, theirs, " in said.out
    assert "- paths: 2026-01-01T00:03:00+00:00, commit aaaaaaaaaaaa, ours, " in said.out
    before = (here / peers.NAME).read_bytes()
    monkeypatch.setattr("sys.argv", ["run-benchmark", "peers", str(here), "--collect", str(tmp_path / "none")])
    assert cli.run_benchmark() == cli.EXIT_USER
    assert "--collect" in (error := capsys.readouterr().err) and error.count("\n") == 1
    assert (here / peers.NAME).read_bytes() == before
