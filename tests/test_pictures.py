"""Pictures: when they are drawn, how they are saved, and text of the user's in them."""

import io
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import msgspec
import numpy as np
import pytest
from matplotlib.figure import Figure
from run_records import changed
from test_paper_tables import record
from test_pareto_points import task, timed
from test_run import GEOMETRY, Double, double, once

from ctsim.benchmarks.scores.protocol import truth_of
from ctsim.benchmarks.studies.methods import panels
from ctsim.benchmarks.studies.methods.panels import PanelRow, draw
from ctsim.benchmarks.studies.methods.volumes import write_volume
from ctsim.benchmarks.studies.pareto import results
from ctsim.benchmarks.studies.pareto.finding import points
from ctsim.reports import figures, view

# what matplotlib cannot parse as mathematics, what it would draw as such, and an escape of its own
TEXTS = ("my_m[path=$HOME/x_{$]", "a$b$c", r"\$1, $2 \$")


def text_of(figure):
    """All text that a figure draws."""
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg")
    nodes = (node for node in ET.fromstring(buffer.getvalue()).iter() if node.tag.endswith("}text"))
    return "\n".join("".join(node.itertext()) for node in nodes)


def saved(tmp_path, *found, scans=None):
    """Which pictures were drawn, by their names."""
    return [path.name for path in panels.write_panels(list(found), scans or [double(tmp_path)], tmp_path)]


def test_a_picture_is_drawn_again_only_where_it_would_show_something_else(tmp_path):
    first = once("good", tmp_path)
    other = Double(folder=tmp_path, name="other", content_hash="another")
    picture = tmp_path / "panels" / "box.png"
    assert saved(tmp_path, first) == ["box.png"]
    assert saved(tmp_path, first, scans=[double(tmp_path), other]) == []
    second = once("shows", tmp_path)
    assert saved(tmp_path, first, second) == ["box.png"] and saved(tmp_path, first, second) == []
    assert second.volume is not None
    write_volume(tmp_path / second.volume, np.ones(GEOMETRY.n_voxel, np.float32), second.identity)  # by --force
    assert saved(tmp_path, first, second) == ["box.png"] and saved(tmp_path, first, second) == []
    scores = {"tissue": msgspec.structs.replace(first.scores["tissue"], values={"psnr3d": 1.0, "ssim3d": 0.5})}
    assert saved(tmp_path, changed(first, scores=scores)) == ["box.png"]
    for damage in (b"", picture.read_bytes()[:20], b"no picture"):
        picture.write_bytes(damage)
        assert saved(tmp_path, first) == ["box.png"]
    picture.unlink()
    assert saved(tmp_path, first) == ["box.png"]


@pytest.mark.slow
@pytest.mark.parametrize("stop", [KeyboardInterrupt, OSError])
def test_a_drawing_that_was_stopped_leaves_the_picture_before(tmp_path, monkeypatch, stop):
    first, second = once("good", tmp_path), once("shows", tmp_path)
    saved(tmp_path, first)
    before = (tmp_path / "panels" / "box.png").read_bytes()

    def half(self, path, **_):
        Path(path).write_bytes(b"half")
        raise stop

    with monkeypatch.context() as patch, pytest.raises(stop):
        patch.setattr(Figure, "savefig", half)
        saved(tmp_path, first, second)
    assert [(p.name, p.read_bytes()) for p in (tmp_path / "panels").iterdir()] == [("box.png", before)]
    assert saved(tmp_path, first, second) == ["box.png"]  # the same command goes on


def test_records_are_sorted_out_once_whatever_the_number_of_scans(tmp_path, monkeypatch):
    calls, latest = [], panels.latest
    monkeypatch.setattr(panels, "latest", lambda found: calls.append(1) or latest(found))
    saved(tmp_path, scans=[double(tmp_path)] * 9)
    assert len(calls) == 1


def scored(label, scene, psnr):
    found = record(psnr=psnr)
    return changed(found, scene=scene, label=label, scores={"tissue": found.scores["paper"]})


@pytest.mark.parametrize("text", TEXTS)
def test_panels_draw_the_very_text(text):
    stored = replace(double(Path()), name=f"scene {text}")
    truth = truth_of(stored)
    shown = text_of(draw(stored, truth, [PanelRow(caption=text, volume=truth.references["effective"])]))
    assert f"\n{text}\n" in shown and f"scene {text} · protocol" in shown


@pytest.mark.parametrize("text", TEXTS)
def test_figures_of_the_report_draw_the_very_text(text):
    found = [scored(label, scene, 20.0) for label in (text, "fdk") for scene in (f"s {text}", "t")]
    for figure in (figures.quality(found), figures.worth(found)):
        assert figure is not None and text in figures.svg(figure, "")
    assert f"s {text}" in text_of(figures.quality(found))


@pytest.mark.parametrize("text", TEXTS)
def test_the_figure_of_pareto_draws_the_very_text(text):
    found = [timed(task(case=f"s {text}", curve=text), ("1", 1.0, 2.0), ("2", 2.0, 1.0))]
    shown = text_of(results.figure(points(found)))
    assert f"s {text}" in shown and f"\n{text}\n" in shown


@pytest.mark.parametrize("text", TEXTS)
def test_the_viewer_draws_the_very_text(text):
    stored = replace(double(Path()), name=f"scene {text}")
    truth = truth_of(stored)
    values = truth.references["effective"]
    case = SimpleNamespace(
        stored=stored, truth=truth, reference=values, look=SimpleNamespace(water=None),
        kept=[SimpleNamespace(record=SimpleNamespace(label=text), values=np.array(values))],
    )  # fmt: skip
    state = view.State(index=5, level=0.02, width=0.04, error=0.02, methods=(text,))
    shown = text_of(view.figure(case, state))
    assert f"scene {text}, slice 5" in shown and f"{text}: error" in shown
