"""How the commands end: by a signal, or at once where an argument is wrong."""

import io
import signal
import subprocess
import sys
import time

import pytest
from conftest import SMALLEST
from engine_jobs import started
from run_records import append
from test_paper_tables import record

from ctsim.benchmarks import cli, make_dataset
from ctsim.benchmarks.studies.methods import records
from ctsim.dataset.store import list_scans, open_scan

WAITING = """
import os
import time
from pathlib import Path
from ctsim.reconstruct.fdk import reconstruct as fdk

def reconstruct(scan, *, device):
    first = Path("first")  # of the processes that run it
    if not first.exists():
        first.write_text(str(os.getpid()))
    if first.read_text() != str(os.getpid()) and not Path("go").exists():
        Path("waiting").touch()
        time.sleep(60)
    return fdk(scan)
"""


def stopped(command, arguments, folder, begun):
    """Start a command in `folder`, send it SIGTERM once `begun()` is true, and return its exit code and last words."""
    code = f"import sys; from ctsim.benchmarks.cli import {command}; sys.argv[0] = '{command}'; sys.exit({command}())"
    with started([sys.executable, "-c", code, *arguments], cwd=folder, stderr=subprocess.PIPE, text=True) as child:
        end = time.monotonic() + 60
        while not begun() and child.poll() is None and time.monotonic() < end:
            time.sleep(0.005)
        child.send_signal(signal.SIGTERM)
        _, said = child.communicate(timeout=60)
    return child.returncode, said


@pytest.mark.slow
def test_a_terminated_make_dataset_goes_on_to_the_same_bytes(tmp_path):
    scene, data = tmp_path / "scene.toml", tmp_path / "data"
    scene.write_text(SMALLEST.replace("n_views = 12", "n_views = 200"), encoding="utf-8")
    code, said = stopped("make_dataset", (scene, data), tmp_path, lambda: any(data.glob(".*.partial/*")))
    assert code == 130 and "interrupted" in said and "Traceback" not in said
    assert not (data / "index.jsonl").exists()
    for folder in (data, tmp_path / "undisturbed"):
        assert make_dataset.main([str(scene), str(folder)]) == 0
    hashes = {open_scan(list_scans(folder)[0]).content_hash for folder in (data, tmp_path / "undisturbed")}
    assert len(hashes) == 1


@pytest.mark.slow
def test_a_terminated_run_benchmark_keeps_its_records_and_goes_on(smallest, tmp_path, monkeypatch, capsys):
    (tmp_path / "waiting_method.py").write_text(WAITING, encoding="utf-8")
    arguments = [smallest, tmp_path / "r", "--method", "waiting_method:reconstruct", "--isolate"]
    code, said = stopped("run_benchmark", arguments, tmp_path, (tmp_path / "waiting").exists)
    assert code == 130 and "interrupted" in said and "Traceback" not in said
    assert [r.task.part for r in records.read(tmp_path / "r")] == [records.TWIN]
    (tmp_path / "go").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["run-benchmark", *map(str, arguments)])
    monkeypatch.setattr(sys, "path", list(sys.path))
    assert cli.run_benchmark() == 0 and "waiting_method" in capsys.readouterr().out
    assert [(r.task.part, r.status) for r in records.read(tmp_path / "r")] == [
        (records.TWIN, "ok"),
        (records.METAL, "ok"),
    ]


def test_the_signals_handler_is_put_back(smallest, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["run-benchmark", str(smallest), str(tmp_path), "--table"])
    before = signal.getsignal(signal.SIGTERM)
    assert cli.run_benchmark() == 2  # there are no records
    assert signal.getsignal(signal.SIGTERM) is before


def test_what_cannot_go_on_does_not_say_that_it_will(monkeypatch, capsys):
    def stopped(_arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("ctsim.benchmarks.tools.tune_nmar.main", stopped)
    assert cli.guarded("tune_nmar", "ctsim.benchmarks.tools.tune_nmar", [], resumes=False) == 130
    assert "from the beginning" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
@pytest.mark.parametrize(
    ("command", "words", "shown"),
    [
        (cli.make_dataset, ["quick", "out", "--dry-run", "--only", "broccoli-Al"], "broccoli-Al"),
        (cli.make_dataset, ["–", "out"], ""),
        (cli.run_benchmark, ["data", "r", "--table"], "lost: dB"),
        (cli.run_benchmark, ["paper-tables", "r", "--table", "3"], "| – |"),
        (cli.run_benchmark, ["paper-tables", "r\udcff"], ""),
    ],
)
def test_a_terminal_of_another_encoding_ends_no_command(tmp_path, monkeypatch, encoding, command, words, shown):
    """Tables have –, ³ and ±, and a file's name may be no text at all, which Python writes as such a surrogate."""
    for seed, psnr in ((1, 20.0), (2, 22.0)):
        append(tmp_path / "r", record(seed=seed, scan=str(seed), psnr=psnr))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["command", *words])
    streams = {name: io.TextIOWrapper(io.BytesIO(), encoding=encoding) for name in ("stdout", "stderr")}
    for name, stream in streams.items():
        monkeypatch.setattr(sys, name, stream)
    assert command() == (0 if shown else 2)
    streams["stdout"].flush()
    assert shown.encode(encoding, "backslashreplace") in streams["stdout"].buffer.getvalue()
