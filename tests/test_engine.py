"""What every study has from the engine: its flags, what is measured again and what is not, and how it ends.

Each entry of STUDIES is a command, three of its cases that take little time, and what makes them wait or fail.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import tiny_study
from engine_jobs import lives, until
from test_record import places

from ctsim.benchmarks import cli
from ctsim.benchmarks.engine import host, study
from ctsim.benchmarks.engine.process import Lost
from ctsim.benchmarks.studies.methods import run as methods_run
from ctsim.benchmarks.studies.pareto import finding as pareto_finding
from ctsim.benchmarks.studies.pareto import measure as pareto_measure
from ctsim.benchmarks.studies.pareto import results as pareto_results
from ctsim.benchmarks.studies.pareto.study import Pareto
from ctsim.benchmarks.studies.peers import cases as peer_cases
from ctsim.benchmarks.studies.peers import finding as peer_finding
from ctsim.benchmarks.studies.peers.study import Peers
from ctsim.benchmarks.studies.skipping import effects, simulator
from ctsim.benchmarks.studies.skipping.simulator import Pair
from ctsim.benchmarks.studies.skipping.study import Skipping
from ctsim.benchmarks.studies.stress.study import Judged, Stress, StressRow
from ctsim.benchmarks.studies.validate import cases as validate_cases
from ctsim.benchmarks.studies.validate.finding import check
from ctsim.benchmarks.studies.validate.study import Validate

COMMIT = "a" * 40
TINY = tiny_study.Tiny


@dataclass(frozen=True)
class Command:
    """A study as the tests call it.

    `words` are flags of every call but the first word, the results folder; `cases` asks for cases by number, `few` for
    the first of them. `prepare(monkeypatch)` lets its tasks run in this process, in no time. `by_commit` says that its
    tasks depend on the commit, and not on the sources that they use; `timed` that it has --repeats, and `prints` that
    it prints its tables.
    """

    study: study.Study[Any, Any]
    module: str
    cases: tuple[str, ...]
    words: tuple[str, ...] = ()
    prepare: Callable[[pytest.MonkeyPatch], None] = lambda monkeypatch: None
    flag: str = "--case"
    by_commit: bool = True
    timed: bool = True
    prints: bool = True

    def call(self, folder: Path, *words: str, cases: int | None = None) -> int:
        """Run the command as the user does, on the first of its cases; return the exit code."""
        asked = [word for case in self.cases[:cases] for word in (self.flag, case)]
        name = f"run-benchmark {self.study.name}".rstrip()
        return cli.guarded(name, self.module, [str(folder), *self.words, *asked, *words])

    def listed(self, lines: list[str]) -> list[str]:
        """Return the cases that --dry-run lists, and the word of their sum."""
        words = (*self.cases, "total:")
        return [next((word for word in line.split() if word in words), line) for line in lines]

    def records(self, folder: Path) -> list[Any]:
        given = self.study.flags(results=folder)
        return self.study.store(given).read()


def in_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the study of skipping compare nothing with nothing, here."""
    nothing = Pair(scene="s", what="w", skipping=float, whole=float, difference=lambda a, b: a - b, unit="P")
    monkeypatch.setattr(Skipping, "isolated", False)
    for cases in (simulator.CASES, effects.CASES):
        for case in list(cases):
            monkeypatch.setitem(cases, case, lambda setup: iter([nothing]))


def timed_in_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the study of run times find one mark of FDK, on scans that are not there, here."""
    mark = pareto_finding.Mark(label="defaults", seconds=0.5, values={"rmse": 0.1, "psnr3d": 30.0}, default=True)
    run = pareto_finding.TimedRun(marks=(mark,))
    monkeypatch.setattr(Pareto, "isolated", False)
    monkeypatch.setattr(Pareto, "prepare", lambda self, given: None)
    monkeypatch.setattr(pareto_measure, "measure", lambda task, given: [run])
    monkeypatch.setattr(methods_run, "fdk_seconds", lambda geometry: 1.0)
    monkeypatch.setattr(pareto_results, "save_figure", lambda points, path: None)
    monkeypatch.setattr(host, "use_threads", lambda threads: None)  # those of this process are not ours to set


def without_peers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a case of the study of peers take two seconds a run, of which there is one peer."""

    def found(setup: Any, scene: str) -> list[Any]:
        names = (peer_finding.OURS, peer_finding.RTK)
        runs = {"run": (2.0,) * setup.repeats}
        return [peer_finding.Measurement(contender=name, seconds=runs, error=0.1) for name in names]

    for case in list(peer_cases.CASES):
        monkeypatch.setitem(peer_cases.CASES, case, found)
    monkeypatch.setattr(peer_finding, "installed", dict)
    monkeypatch.setattr(peer_finding.Setup, "left_out", lambda self: [])
    monkeypatch.setattr(host, "use_threads", lambda threads: None)


def three_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the stress suite have three rows that find nothing, here."""
    rows = {(case, "s"): StressRow(case, "s", "w", "e", "code") for case in STUDIES["stress"].cases}

    def measure(self: Stress, task: Any, given: Any) -> list[Judged]:
        return [Judged(found="nothing", seconds={"row": (0.5,)})]

    monkeypatch.setattr(Stress, "isolated", False)
    monkeypatch.setattr(Stress, "limit", lambda self, task, given: None if given.seconds == 120 else given.seconds)
    monkeypatch.setattr(Stress, "rows", lambda self, given: rows)
    monkeypatch.setattr(Stress, "measure", measure)


def validated_in_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the study of validation find that one is one, here."""
    monkeypatch.setattr(Validate, "isolated", False)
    for case in list(validate_cases.CASES):
        monkeypatch.setitem(validate_cases.CASES, case, lambda short: [check("one", 1.0, 1.0, tolerance=0.1)])


STUDIES = {
    "tiny": Command(tiny_study.Tiny(), "tiny_study", ("good", "better", "best")),
    "skipping": Command(
        Skipping(), "ctsim.benchmarks.studies.skipping.study", ("rays", "energies", "edges"),
        ("--size", "small", "--repeats", "1"), in_no_time,
    ),
    "pareto": Command(
        Pareto(), "ctsim.benchmarks.studies.pareto.study", ("lung-Fe", "teeth-Ti", "broccoli-Al"),
        ("--part", "methods", "--method", "fdk", "--repeats", "1"), timed_in_no_time, "--scene", by_commit=False,
    ),
    "peers": Command(
        Peers(), "ctsim.benchmarks.studies.peers.study", ("paths", "fdk", "poly"), ("--repeats", "1"), without_peers,
    ),
    "validate": Command(
        Validate(), "ctsim.benchmarks.studies.validate.study", ("attenuation", "spectra", "head"), ("--short",),
        validated_in_no_time, timed=False,
    ),
    "stress": Command(
        Stress(), "ctsim.benchmarks.studies.stress.study", ("flat", "odd", "empty"), ("--short",), three_rows,
        by_commit=False, timed=False, prints=False,
    ),
}  # fmt: skip


@pytest.fixture(params=STUDIES)
def command(request, monkeypatch):
    """A study, of a known commit."""
    monkeypatch.setattr(host, "commit", lambda: COMMIT)
    found = STUDIES[request.param]
    found.prepare(monkeypatch)
    return found


@pytest.fixture
def measured(command, monkeypatch):
    """The cases that were measured in this process, in order."""
    found: list[str] = []
    measure = type(command.study).measure

    def counted(self, task, given):
        found.append(task.case)
        return measure(self, task, given)

    monkeypatch.setattr(type(command.study), "measure", counted)
    return found


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def one_sentence(capsys, name: str) -> str:
    """Return what was said; fail unless it is one sentence on stderr."""
    said = capsys.readouterr()
    assert said.out == "" and said.err.startswith(f"run-benchmark {name}: ") and said.err.count("\n") == 1, said.err
    return said.err


# --- every study -------------------------------------------------------------------------------------------


def test_a_dry_run_lists_and_writes_nothing(command, measured, tmp_path, capsys):
    folder = tmp_path / "new"
    assert command.call(folder, "--dry-run") == 0
    lines = capsys.readouterr().out.splitlines()
    assert command.listed(lines) == [*command.cases, "total:"]
    assert lines[-1].startswith(f"total: 3 of 3 {command.study.unit}s, ")
    assert not folder.exists() and measured == []
    assert command.call(folder, cases=1) == 0
    before = files(folder)
    capsys.readouterr()
    assert command.call(folder, "--dry-run") == 0
    lines = capsys.readouterr().out.splitlines()
    assert command.listed(lines) == [*command.cases[1:], "total:"]
    assert lines[-1].startswith(f"total: 2 of 3 {command.study.unit}s, ")
    assert files(folder) == before


def test_what_is_recorded_is_not_measured_again_unless_forced(command, measured, tmp_path, capsys):
    assert command.call(tmp_path, cases=2) == 0
    assert measured == list(command.cases[:2])
    first, table = command.records(tmp_path), capsys.readouterr().out
    assert command.call(tmp_path, cases=2) == 0
    said = capsys.readouterr()
    assert said.out == table and f"2 of 2 {command.study.unit}s are recorded already (--force)" in said.err
    assert measured == list(command.cases[:2]) and command.records(tmp_path) == first
    assert command.call(tmp_path) == 0
    assert measured == list(command.cases) and command.records(tmp_path)[:2] == first
    assert command.call(tmp_path, "--force", cases=1) == 0
    assert measured == [*command.cases, command.cases[0]] and len(command.records(tmp_path)) == 4
    assert "recorded already" not in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("commit", [COMMIT + "+changes", "unknown"])
def test_a_commit_that_does_not_say_what_ran_is_measured_again(command, measured, tmp_path, monkeypatch, commit):
    monkeypatch.setattr(host, "commit", lambda: commit)
    monkeypatch.setenv("CTSIM_TEST_CODE", commit)
    for _ in range(2):
        assert command.call(tmp_path, cases=1) == 0
    assert measured == [command.cases[0]] * (2 if command.by_commit else 1)


def test_more_runs_are_measured_and_fewer_are_recorded_already(command, measured, tmp_path):
    if not command.timed:
        pytest.skip("it has no --repeats")
    for repeats, times in ((2, 1), (3, 2), (2, 2), (3, 2)):
        assert command.call(tmp_path, "--repeats", str(repeats), cases=1) == 0
        assert len(measured) == times + command.study.rounds, repeats  # two rounds are two tasks, three are three


def test_the_table_is_written_from_the_records_alone(command, measured, tmp_path, capsys):
    assert command.call(tmp_path) == 0
    printed = capsys.readouterr().out
    page = tmp_path / f"{command.study.file}.md"
    text, done = page.read_bytes(), list(measured)
    assert all(case in text.decode() for case in command.cases)
    if command.prints:
        assert printed.partition("\nWritten: ")[0] in text.decode()  # which may have details below
    page.unlink()
    with (tmp_path / f"{command.study.file}.jsonl").open("ab") as file:
        file.write(b'{"task": {')  # as a kill leaves it
    assert command.call(tmp_path, "--table") == 0
    assert page.read_bytes() == text and measured == done and capsys.readouterr().out == printed


def test_a_line_that_was_cut_short_is_warned_of_once(command, tmp_path, capsys, caplog):
    assert command.call(tmp_path, cases=1) == 0
    with (tmp_path / f"{command.study.file}.jsonl").open("ab") as file:
        file.write(b'{"task": {')
    for words in (["--table"], ["--dry-run"], []):
        caplog.clear()
        assert command.call(tmp_path, *words, cases=1) == 0
        assert len([r for r in caplog.records if "cut short" in r.getMessage()]) == 1, words


@pytest.mark.slow
def test_what_was_found_may_be_anything_and_is_shown_or_refused(command, tmp_path, capsys):
    """A single exception of another kind is a traceback on every further call on that folder."""
    assert command.call(tmp_path, cases=1) == 0
    capsys.readouterr()
    path, seen = tmp_path / f"{command.study.file}.jsonl", set()
    whole = json.loads(path.read_text())
    for *way, key in places(whole["found"])[1:]:
        for value in (None, [], {}, "a|b\n", -1, [1.0, 2.0], {"a": [1.0]}):
            bad = json.loads(json.dumps(whole))
            inner = bad["found"]
            for k in way:
                inner = inner[k]
            inner[key] = value
            path.write_text(json.dumps(bad) + "\n")
            # what a plan reads of a record does not depend on the kind of damage
            for words in (["--table"], ["--dry-run", "--force"])[: 1 + (value is None)]:
                try:
                    seen.add(code := command.call(tmp_path, *words, cases=1))
                except Exception as error:
                    raise AssertionError(f"{type(error).__name__}: {error} at {bad['found']}") from error
                said = capsys.readouterr().err
                assert code != 2 or (said.count("\n") == 1 and len(said) < 2000)
    assert {0, 2} <= seen <= {0, 1, 2}


@pytest.mark.parametrize("word", ["--table", "--collect"])
def test_there_is_no_table_without_records(command, tmp_path, capsys, word):
    folder = tmp_path / "none"
    assert command.call(folder, word, *([str(tmp_path)] if word == "--collect" else [])) == 2
    assert "there are no records" in one_sentence(capsys, command.study.name) and not folder.exists()


def test_records_of_other_folders_are_taken_over(command, measured, tmp_path, capsys):
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    assert command.call(ours, cases=1) == 0 and command.call(theirs) == 0
    done, both = list(measured), [*command.records(ours), *command.records(theirs)[1:]]
    capsys.readouterr()
    for taken in (2, 0):
        assert command.call(ours, "--collect", str(theirs)) == 0
        said = capsys.readouterr()
        assert f"{theirs}: {taken} records taken over" in said.err
        page = (ours / f"{command.study.file}.md").read_text()
        assert all(case in page for case in command.cases)
        assert sorted(r.task.identity for r in command.records(ours)) == sorted(r.task.identity for r in both)
    assert command.call(ours) == 0 and measured == done  # what was taken over is not measured again


@pytest.mark.slow
def test_flags_that_cannot_be_are_one_sentence(command, measured, tmp_path, capsys):
    folder, name = tmp_path / "new", command.study.name
    for words, said in (
        *[(["--repeats", n], f"--repeats must be at least 1, got {n}") for n in ("0", "-1") if command.timed],
        (["--seconds", "0"], "--seconds must be positive, got 0"),
        (["--seconds", "nan"], "--seconds must be positive, got nan"),
        (["--seconds", "inf"], "--seconds must be positive, got inf"),
        (["--dry-run", "--collect", str(tmp_path)], "--collect writes records, --dry-run writes nothing"),
        (["--dry-run", "--table"], "--table writes tables, --dry-run writes nothing"),
        (["--workers", "0"], "--workers 0: expected 1 or more"),
        (["--workers", "0", "--dry-run"], "--workers 0: expected 1 or more"),
        (["--workers", "2", "--scheduler", "tcp://127.0.0.1:9"], "exclude each other"),
        (["--scheduler", "nonsense://x"], "no Dask scheduler answers there"),
    ):
        assert command.call(folder, *words) == 2, words
        assert said in one_sentence(capsys, name)
    assert not folder.exists() and measured == []


def test_a_folder_that_cannot_be_is_one_sentence_before_anything_is_measured(command, measured, tmp_path, capsys):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        assert command.call(folder, cases=1) == 2
        assert str(tmp_path / "file") in one_sentence(capsys, command.study.name)
    assert measured == []


def test_help_names_every_shared_flag(command, capsys):
    with pytest.raises(SystemExit) as ended:
        command.call(Path("x"), "--help")
    said = capsys.readouterr().out
    assert ended.value.code == 0
    for flag in ("--seconds", "--force", "--dry-run", "--table", "--collect", "--workers", "--scheduler"):
        assert flag in said
    assert ("--repeats" in said) == command.timed


def test_a_time_limit_is_a_row_and_the_next_task_starts(command, tmp_path, capsys):
    # a process cannot even start in that time
    assert command.call(tmp_path, "--seconds", "0.001", cases=2) == 1
    assert (
        capsys.readouterr().out.count("timeout: did not end within 0.001 s")
        + "".join(f.reason for r in command.records(tmp_path) for f in r.found).count("did not end within 0.001 s")
        >= 2
    )
    assert [r.task.case for r in command.records(tmp_path)] == list(command.cases[:2])
    assert {f.status for r in command.records(tmp_path) for f in r.found} == {"timeout"}
    assert command.call(tmp_path, cases=2) == 0  # what failed is measured again
    assert [r.found[0].status for r in command.records(tmp_path)] == ["timeout", "timeout", "ok", "ok"]
    assert "timeout" not in capsys.readouterr().out


def test_ctrl_c_keeps_what_is_finished_and_the_same_command_goes_on(command, measured, tmp_path, monkeypatch, capsys):
    measure, stops = type(command.study).measure, [command.cases[1]]

    def interrupted(self, task, given):
        if task.case in stops:
            stops.remove(task.case)
            raise KeyboardInterrupt
        return measure(self, task, given)

    monkeypatch.setattr(type(command.study), "measure", interrupted)
    assert command.call(tmp_path) == cli.EXIT_INTERRUPTED == 130
    assert "interrupted; what was finished is kept" in capsys.readouterr().err
    assert [r.task.case for r in command.records(tmp_path)] == [command.cases[0]]
    assert command.call(tmp_path) == 0 and measured == list(command.cases)


# --- the tiny study ----------------------------------------------------------------------------------------


@pytest.fixture
def tiny(monkeypatch):
    """Call a variant of the tiny study on cases: tiny(folder, cases, *flags, kind=Tiny) -> exit code."""
    monkeypatch.setattr(host, "commit", lambda: COMMIT)

    def call(folder, cases, *words, kind=TINY):
        folder.mkdir(exist_ok=True)
        monkeypatch.setattr(tiny_study, "Tiny", kind)
        asked = [word for case in cases.split() for word in ("--case", case)]
        return cli.guarded("run-benchmark tiny", "tiny_study", [str(folder), *asked, *words])

    return call


def log(folder: Path) -> list[str]:
    path = folder / "log"
    return path.read_text().split() if path.exists() else []


def found(folder: Path) -> list[tuple[str, str, str]]:
    return [(r.task.case, f.status, f.reason) for r in STUDIES["tiny"].records(folder) for f in r.found]


@pytest.mark.parametrize(
    ("cases", "code"), [("good better", 0), ("good bad", 1), ("good fails", 1), ("bad", 1), ("good", 0)]
)
def test_the_exit_code_tells_whether_all_ended_as_expected(tiny, tmp_path, cases, code, capsys):
    assert [tiny(tmp_path, cases), tiny(tmp_path, cases), tiny(tmp_path, cases, "--table")] == [code] * 3


def test_only_what_was_asked_for_counts(tiny, tmp_path, capsys):
    assert tiny(tmp_path, "bad") == 1 and tiny(tmp_path, "good") == 0 and tiny(tmp_path, "", "--table") == 1


def test_a_task_that_fails_now_ends_with_one_though_it_ended_well_before(tiny, tmp_path, capsys):
    (tmp_path / "mended").touch()
    assert tiny(tmp_path, "fails") == 0
    (tmp_path / "mended").unlink()
    assert tiny(tmp_path, "fails", "--force") == 1
    assert "| fails | ok |" in capsys.readouterr().out  # tables show what is known


def test_a_task_that_failed_is_measured_again_and_one_that_is_not_as_expected_is_not(tiny, tmp_path, capsys):
    assert tiny(tmp_path, "fails bad good") == 1 and log(tmp_path) == ["fails", "bad", "good"]
    assert tiny(tmp_path, "fails bad good") == 1 and log(tmp_path)[3:] == ["fails"]
    (tmp_path / "mended").touch()
    assert tiny(tmp_path, "fails good") == 0 and log(tmp_path)[4:] == ["fails"]
    assert tiny(tmp_path, "fails good") == 0 and len(log(tmp_path)) == 5
    assert "not yet" not in capsys.readouterr().out.split("Written")[-2]


def test_what_a_task_raises_ends_the_command_and_keeps_what_is_finished(tiny, tmp_path, capsys):
    with pytest.raises(ValueError, match="what is ours"):
        tiny(tmp_path, "good raises better")
    assert found(tmp_path) == [("good", "ok", "")]
    assert tiny(tmp_path, "refuses") == 2 and "run-benchmark tiny: not this one" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("kind", [tiny_study.Isolated, tiny_study.Tiny])
def test_a_task_that_hangs_or_dies_is_a_row_and_costs_no_other(tiny, tmp_path, capsys, kind):
    assert tiny(tmp_path, "slow good dies better", "--seconds", "4", kind=kind) == 1
    assert found(tmp_path) == [
        ("slow", "timeout", "did not end within 4 s"),
        ("good", "ok", ""),
        ("dies", "error", "the process died with signal SIGKILL"),
        ("better", "ok", ""),
    ]
    assert "| slow | timeout | did not end within 4 s |" in capsys.readouterr().out
    if (tmp_path / "temporary").exists():  # unless it took 4 s to start; its folder for temporary files is gone
        assert not Path((tmp_path / "temporary").read_text()).exists()


def test_the_tables_show_only_what_is_asked_for(tiny, tmp_path, capsys):
    assert tiny(tmp_path, "good better") == 0
    capsys.readouterr()
    assert tiny(tmp_path, "good", "--table") == 0
    said = capsys.readouterr().out
    assert "| good |" in said and "| better |" not in said
    assert tiny(tmp_path, "other", "--table") == 2


def test_a_dry_run_says_how_long_and_what_was_never_measured(tiny, tmp_path, capsys):
    assert tiny(tmp_path, "good better", "--dry-run") == 0
    assert [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()] == [
        "good 60 s",
        "better unknown",
        "total: 2 of 2 tasks, 60 s, without compiling; never measured: better",
    ]
    assert tiny(tmp_path, "good better") == 0
    capsys.readouterr()
    assert tiny(tmp_path, "good better", "--dry-run", "--repeats", "3") == 0
    # runs of 0.5 s, three that count and one that does not
    assert capsys.readouterr().out.splitlines()[0].split() == ["good", "2", "s"]


def test_tasks_are_measured_in_rounds(tiny, tmp_path, capsys):
    kind = tiny_study.Rounds
    assert tiny(tmp_path, "good better", "--dry-run", kind=kind) == 0
    assert "total: 4 of 4 tasks" in capsys.readouterr().out
    assert tiny(tmp_path, "good better", kind=kind) == 0
    assert log(tmp_path) == ["good", "better"] * 2
    assert tiny(tmp_path, "good better", "--repeats", "3", kind=kind) == 0  # one round is left
    assert log(tmp_path)[4:] == ["good", "better"]
    assert "4 of 6 tasks are recorded already" in capsys.readouterr().err
    assert tiny(tmp_path, "good better", "--repeats", "2", kind=kind) == 0 and len(log(tmp_path)) == 6
    assert tiny(tmp_path, "good", "--repeats", "2", "--force", kind=kind) == 0 and len(log(tmp_path)) == 8


@pytest.mark.parametrize("workers", ["1", "2"])
def test_what_failed_is_not_tried_again_in_a_later_round(tiny, tmp_path, capsys, workers):
    words = ("--repeats", "3", "--workers", workers)
    assert tiny(tmp_path, "fails good", *words, kind=tiny_study.Rounds) == 1
    assert sorted(log(tmp_path)) == ["fails", "good", "good", "good"]


def test_tables_follow_what_is_measured(tiny, tmp_path, capsys, monkeypatch):
    seen = []
    write = study.write_synced
    monkeypatch.setattr(study, "SHARE", 1e9)  # after every task
    monkeypatch.setattr(study, "write_synced", lambda path, data: (seen.append(data.decode()), write(path, data)))
    assert tiny(tmp_path, "good better", kind=tiny_study.Follows) == 0
    assert [("| good |" in text, "| better |" in text) for text in seen] == [(True, False), (True, True), (True, True)]
    assert tiny(tmp_path, "best fails", kind=tiny_study.Follows) == 1
    assert "| best |" in seen[3] and "| fails | error |" in seen[4] and "| good |" not in seen[3] + seen[4]
    seen.clear()
    monkeypatch.setattr(study, "SHARE", 1e-9)
    assert tiny(tmp_path / "new", "good better interrupted best", kind=tiny_study.Follows) == 130
    assert "better" not in seen[-2] and "| better |" in seen[-1] and "best" not in seen[-1]  # as Ctrl-C came
    assert tiny(tmp_path / "new", "slow-x interrupted", "--seconds", "0.01", kind=tiny_study.Follows) == 1
    assert "good" not in seen[-1]
    seen.clear()
    assert tiny(tmp_path / "other", "good interrupted", kind=TINY) == 130 and seen == []


def test_two_workers_find_the_same_as_one(tiny, tmp_path, capsys):
    cases = "good better bad fails best"
    for workers in ("1", "2"):
        folder = tmp_path / workers
        assert tiny(folder, cases, "--workers", workers) == 1
    one, two = (STUDIES["tiny"].records(tmp_path / workers) for workers in ("1", "2"))
    assert sorted(found(tmp_path / "1")) == sorted(found(tmp_path / "2"))
    assert {r.task.identity: r.found for r in one} == {r.task.identity: r.found for r in two}
    tables = [(tmp_path / w / "tiny.md").read_text().split("\n\n", 1)[1] for w in ("1", "2")]
    assert tables[0] == tables[1]
    assert tiny(tmp_path / "2", cases, "--workers", "2") == 1  # only what failed is left
    assert log(tmp_path / "2")[5:] == ["fails"]


@pytest.mark.slow
def test_a_cluster_finds_the_same_also_within_a_limit(tiny, tmp_path, capsys):
    pytest.importorskip("distributed")
    from distributed import LocalCluster

    cases = "good bad fails"
    assert tiny(tmp_path / "here", cases) == 1
    with LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs="CRITICAL"
    ) as cluster:
        for name, words in (("there", ()), ("limited", ("--seconds", "60"))):
            assert tiny(tmp_path / name, cases, "--scheduler", cluster.scheduler_address, *words) == 1
            assert sorted(found(tmp_path / name)) == sorted(found(tmp_path / "here"))


def test_a_task_whose_worker_dies_each_time_is_a_row(tiny, tmp_path, capsys):
    assert tiny(tmp_path, "dies good", "--workers", "2") == 1
    assert sorted(found(tmp_path)) == [
        ("dies", "out_of_memory", "its process died 3 times, the last time with signal SIGKILL"),
        ("good", "ok", ""),
    ]
    assert log(tmp_path).count("dies") == 3


def test_of_a_group_whose_worker_dies_each_task_is_tried_by_itself(tmp_path):
    class Deadly:
        workers = 2

        def answers(self, function, jobs):
            for n, group in enumerate(jobs):
                yield n, Lost("it died") if any(task.case == "dies" for task in group) else function(group)

    given = tiny_study.Flags(results=tmp_path, repeats=1)
    groups = [tuple(tiny_study.Task(study="tiny", case=case) for case in cases) for cases in (("good", "dies"), ("x",))]
    found = list(study._round(TINY(), groups, given, Deadly()))
    ends = {r.task.case: (r.found[0].status, r.found[0].reason) for r in found}
    assert len(found) == 3 and ends == {"good": ("ok", ""), "x": ("ok", ""), "dies": ("error", "it died")}


@pytest.mark.slow
def test_workers_keep_limits(tiny, tmp_path, capsys):
    assert tiny(tmp_path, "slow good", "--workers", "2", "--seconds", "3") == 1
    assert sorted(found(tmp_path)) == [("good", "ok", ""), ("slow", "timeout", "did not end within 3 s")]


def test_a_worker_that_lives_on_keeps_no_process_and_no_folder_of_another_command(tmp_path, monkeypatch):
    """Dask's do."""
    started = []
    process = study.Process
    monkeypatch.setattr(study, "Process", lambda variables: started.append(process(variables)) or started[-1])
    pids = []
    for n in range(3):
        given = tiny_study.Flags(results=tmp_path, repeats=n + 1, seconds=60.0)
        for case in ("good", "better"):
            (one,) = study._measure_group(TINY(), given, (tiny_study.Task(study="tiny", case=case),))
            assert one.finished and one.repeats == n + 1
        pids.append(started[n].run(os.getpid))
    folders = [one._environment["TMPDIR"] for one in started]
    assert [lives(pid) for pid in pids] == [os.path.exists(path) for path in folders] == [False, False, True]


def start(folder: Path, *words: str) -> subprocess.Popen:
    folder.mkdir(exist_ok=True)
    code = "import sys; from ctsim.benchmarks import cli; sys.exit(cli.guarded('tiny', 'tiny_study', sys.argv[1:]))"
    path = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    return subprocess.Popen(
        [sys.executable, "-c", code, str(folder), *words],
        env={**os.environ, "PYTHONPATH": path, "TMPDIR": str(folder / "tmp"), "CTSIM_TEST_CODE": COMMIT},
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a job in the background is born deaf to it
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", [(), ("--seconds", "600"), ("--workers", "2"), ("--workers", "2", "--seconds", "600")]
)
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_keeps_what_is_finished_and_leaves_nothing_behind(tmp_path, sign, words, tiny, capsys):
    folder = tmp_path / "results"
    (folder / "tmp").mkdir(parents=True)
    with start(folder, "--case", "good", "--case", "slow", *words) as it:
        until(lambda: (folder / "waiting").exists() and (folder / "tiny.jsonl").exists())
        time.sleep(0.1)
        it.send_signal(sign)
        said = it.communicate(timeout=60)[1]
    assert it.returncode == 130 and "interrupted; what was finished is kept" in said and "Traceback" not in said
    assert found(folder) == [("good", "ok", "")]
    if "--seconds" in words:  # a process of its own has a folder of its own for temporary files
        assert list((folder / "tmp").iterdir()) == []
    (folder / "mended").touch()
    assert tiny(folder, "good slow") == 0 and sorted(log(folder)) == ["good", "slow", "slow"]


def test_two_commands_in_one_folder_lose_nothing(tmp_path):
    both = [start(tmp_path, *(w for n in range(10) for w in ("--case", f"good-{who}-{n}"))) for who in "ab"]
    for it in both:
        _, said = it.communicate(timeout=60)
        assert it.returncode == 0, said
    assert len(found(tmp_path)) == 20 == len({case for case, *_ in found(tmp_path)})


def test_a_record_is_on_the_disk_before_the_next_task_begins(tiny, tmp_path, capsys, monkeypatch):
    seen = []

    class Looks(tiny_study.Tiny):
        def measure(self, task, given):
            path = tmp_path / "tiny.jsonl"
            seen.append(path.read_bytes().count(b"\n") if path.exists() else 0)
            return super().measure(task, given)

    assert tiny(tmp_path, "a b c", kind=Looks) == 0 and seen == [0, 1, 2]


def test_a_record_says_where_when_and_by_which_commit(tiny, tmp_path, capsys):
    assert tiny(tmp_path, "good") == 0
    (one,) = STUDIES["tiny"].records(tmp_path)
    assert one.host == host.host() and one.commit == COMMIT and one.time.endswith("+00:00")
    line = json.loads((tmp_path / "tiny.jsonl").read_text())
    assert list(line) == ["task", "found", "host", "commit", "time"]
