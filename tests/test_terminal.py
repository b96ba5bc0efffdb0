"""What a command prints: one table that fits a terminal, and progress that a log can hold."""

import io
import re

import pytest
from test_tables import record

from ctsim.benchmarks.engine import terminal
from ctsim.benchmarks.engine.terminal import WIDEST, Bar
from ctsim.benchmarks.studies.methods import overview

SCENES = ("lung-Fe", "teeth-Ti", "broccoli-Al")
METHODS = {"fdk": "counts only", "splat": "counts only", "limar": "metal mask", "nmar": "metal mask"}


MORE = ["–", "–", "1.5"]
"""No cost of metal without a twin, and no record of false bone."""


def records(scenes=SCENES, **more):
    return [
        record(name, scene, psnr=20.0 + n + k, inputs=inputs, **more)
        for n, (name, inputs) in enumerate(METHODS.items())
        for k, scene in enumerate(scenes)
    ]


def row(text, method):
    lines = [line for line in text.splitlines() if re.search(rf"(^|\s){re.escape(method)}\s", line)]
    return [cell for line in lines for cell in re.findall(r"\S+", line.split(method, 1)[1])]


def test_scenes_stand_side_by_side_where_they_fit():
    text = overview.overview(records())
    assert max(map(len, text.splitlines())) <= WIDEST
    assert all(scene in text for scene in SCENES) and "mean" not in text
    assert row(text, "nmar") == ["23.00", *MORE, "24.00", *MORE, "25.00", *MORE]


def test_many_scenes_are_averaged():
    text = overview.overview(records([f"scene-{k}" for k in range(7)]))
    assert max(map(len, text.splitlines())) <= WIDEST
    assert "mean of 7 scenes" in text and "scene-0" not in text
    assert row(text, "fdk") == ["23.00", *MORE]


def test_scenes_that_do_not_fit_side_by_side_go_into_further_tables():
    text = overview.overview(records([f"scene-{k}" for k in range(5)]))
    assert max(map(len, text.splitlines())) <= WIDEST and text.count("method") == 3
    assert all(f"scene-{k}" in text for k in range(5)) and "mean" not in text


def test_a_narrow_terminal_loses_no_number(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "80")
    text = re.sub(r"\x1b\[[\d;]*m", "", overview.overview(records()))
    assert max(map(len, text.splitlines())) <= 80 and text.count("method") == 2
    assert "…" not in text and text.count("25.00") == 1 and text.count("1.5") == 12


def test_of_many_failures_the_first_are_named(tmp_path):
    given = [record(f"m{k}", "lung-Fe", status="timeout") for k in range(25)]
    text = overview.text(given, tmp_path / "r", tmp_path / "d")
    assert text.count("timeout – ") == 10 and "15 more runs failed or were skipped, see table.md" in text


def test_a_method_without_a_scene_has_no_mean_over_all():
    given = [r for r in records([f"s{k}" for k in range(7)]) if (r.label, r.run.scene) != ("splat", "s3")]
    assert row(overview.overview(given), "splat") == ["–"] * 4


def test_seeds_are_averaged_and_twins_left_out():
    given = [record(psnr=20.0), record(psnr=23.0, seed=1), record(psnr=40.0, variant="metal_free")]
    assert row(overview.overview(given), "fdk") == ["21.50", "20.00", "–", "1.5"]  # seed 0 alone has a twin


def test_a_run_that_failed_shows_how_it_ended_and_why(tmp_path):
    given = [*records(), record("sirt", "lung-Fe", status="timeout")]
    text = overview.text(given, tmp_path / "r", tmp_path / "d")
    assert "timeout" in row(text, "sirt") and "lung-Fe (metal), sirt: timeout – out | of luck" in text
    assert f"run-benchmark report {tmp_path}/r {tmp_path}/d" in text


def test_the_best_of_each_class_of_inputs_is_bold_on_a_terminal(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    text = overview.overview(records(["lung-Fe"]))
    bold = re.findall(r"\x1b\[1m *([\d.]+)\x1b\[0m", text)
    assert bold == ["21.00", "23.00"]


def test_an_encoding_without_lines_gets_a_table_in_ascii(monkeypatch):
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(io.BytesIO(), encoding="ascii"))
    assert overview.overview(records()).isascii()


def test_a_log_has_a_line_for_what_has_ended_and_no_escapes(monkeypatch):
    monkeypatch.setattr(terminal, "EVERY", 1e9)
    stream = io.StringIO()
    with Bar(3, "run", stream=stream) as bar:
        bar.note("fdk")
        bar.advance(text="fdk on lung-Fe: ok")
        bar.advance()
        bar.advance(text="limar [red] on lung-Fe: ok")
    assert stream.getvalue() == "1/3 runs: fdk on lung-Fe: ok\n3/3 runs: limar [red] on lung-Fe: ok\n"


def test_a_log_hears_of_long_work_now_and_then(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    with Bar(100, "view", stream=stream) as bar:
        for _ in bar.over(range(100), "scene"):
            now[0] += 1.0
    lines = stream.getvalue().splitlines()
    assert lines[0] == "11/100 views" and 8 <= len(lines) <= 10


class Screen(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("title", ["fdk on lung-Fe: ok", "[bold]a/b[/] on x: ok"])
def test_a_terminal_has_a_bar_with_what_was_done_last(title):
    stream = Screen()
    with Bar(2, "run", stream=stream) as bar:
        bar.advance(text=title)
    assert "1/2 runs" in stream.getvalue() and title in stream.getvalue()


def test_an_error_is_one_line_whatever_it_holds(capsys):
    terminal.complain("run-benchmark", f"[red]{'word ' * 60}: é")
    assert capsys.readouterr().err == f"run-benchmark: [red]{'word ' * 60}: é\n"
