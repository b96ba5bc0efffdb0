"""Text of the user's in pictures."""

import io
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import msgspec
import numpy as np
import pytest
from test_paper_tables import record
from test_pareto_points import setting, timed
from test_run import double

from benchmarks import pareto_figure
from benchmarks.panels import Row, draw
from benchmarks.pareto_records import points
from benchmarks.protocol import truth_of
from reports import figures, view

# what matplotlib cannot parse as mathematics, what it would draw as such, and an escape of its own
TEXTS = ("my_m[path=$HOME/x_{$]", "a$b$c", r"\$1, $2 \$")


def text_of(figure):
    """All text that a figure draws."""
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg")
    nodes = (node for node in ET.fromstring(buffer.getvalue()).iter() if node.tag.endswith("}text"))
    return "\n".join("".join(node.itertext()) for node in nodes)


def scored(label, scene, psnr):
    found = record(psnr=psnr)
    run = msgspec.structs.replace(found.run, scene=scene)
    return msgspec.structs.replace(found, run=run, label=label, scores={"tissue": found.scores["paper"]})


@pytest.mark.parametrize("text", TEXTS)
def test_panels_draw_the_very_text(text):
    stored = replace(double(Path()), name=f"scene {text}")
    truth = truth_of(stored)
    shown = text_of(draw(stored, truth, [Row(caption=text, volume=truth.references["effective"])]))
    assert f"\n{text}\n" in shown and f"scene {text} · protocol" in shown


@pytest.mark.parametrize("text", TEXTS)
def test_figures_of_the_report_draw_the_very_text(text):
    found = [scored(label, scene, 20.0) for label in (text, "fdk") for scene in (f"s {text}", "t")]
    for figure in (figures.quality(found), figures.worth(found)):
        assert figure is not None and text in figures.svg(figure, "")
    assert f"s {text}" in text_of(figures.quality(found))


@pytest.mark.parametrize("text", TEXTS)
def test_the_figure_of_pareto_draws_the_very_text(text):
    found = [timed(setting(part="methods", scene=f"s {text}", curve=text), ("1", 1.0, 2.0), ("2", 2.0, 1.0))]
    shown = text_of(pareto_figure.draw(points(found)))
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
