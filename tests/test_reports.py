"""What people look at: the page, the documentation's tables, the viewer and the notebooks."""

import base64
import importlib.util
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from run_records import append, make_record

import ctsim
from ctsim import reports
from ctsim.benchmarks import cli, make_dataset
from ctsim.benchmarks.engine import host
from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.scalebar import length_of
from ctsim.benchmarks.studies.methods import study as cli_run
from ctsim.benchmarks.studies.methods import tables
from ctsim.benchmarks.studies.methods.volumes import at_50kev_of, write_volume
from ctsim.benchmarks.studies.stress import study as stress
from ctsim.dataset.manifest import read_index
from ctsim.dataset.store import open_scan
from ctsim.errors import InputError
from ctsim.reports import figures, kept, report, show, slices, view

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
METHODS = ("fdk", "limar", "nmar")
NOTEBOOKS = ROOT / "reports" / "notebooks"
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.fixture(scope="module")
def results(smallest, tmp_path_factory):
    folder = tmp_path_factory.mktemp("reports") / "tiny"
    assert cli_run.main([str(smallest), str(folder), *(w for m in METHODS for w in ("--method", m))]) == 0
    return folder


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """A scene of the suite `quick`, but without scatter, which takes longest, and its results: two folders."""
    folder = tmp_path_factory.mktemp("quick")
    data, found, suite = folder / "data", folder / "results", folder / "quick.toml"
    text = (ROOT / "benchmarks" / "suites" / "quick.toml").read_text(encoding="utf-8")
    suite.write_text(
        text.replace("[defaults.scanner]", "[defaults.scanner]\nscatter = { level = 0 }"), encoding="utf-8"
    )
    assert make_dataset.main([str(suite), str(data), "--only", "lung-Fe"]) == 0
    assert cli_run.main([str(data), str(found), *(w for m in METHODS for w in ("--method", m))]) == 0
    return data, found


@pytest.fixture(scope="module")
def case(smallest, results):
    return kept.open_case(smallest, results)


@pytest.fixture(scope="module")
def written(smallest, results):
    path = results / "report.html"
    assert report.main([str(results), str(smallest), "--out", str(path)]) == 0
    return path.read_text(encoding="utf-8")


def command(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "report", *map(str, arguments)])
    code = cli.run_benchmark()
    return code, capsys.readouterr()


def rows_of(text):
    """Cells of every body row of an HTML text, tags taken out."""
    rows = (re.findall(r"<td[^>]*>(.*?)</td>", row) for row in re.findall(r"<tr[^>]*>(.*?)</tr>", text, re.S))
    return [[re.sub("<[^>]+>", "", cell) for cell in row] for row in rows if row]


def images_of(text):
    """Slices that the page carries, of its first scene."""
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', text, re.S)[1])


# Tables


def test_the_page_holds_every_cell_of_the_tables(results, written):
    text = tables.render(report.read(results), "md")
    expected = [[c.strip() for c in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    plain = [[re.sub(r"\*\*|</?u>", "", c) for c in row] for row in expected if row[0] != "inputs"]
    shown = rows_of(written)
    assert len(plain) > 20 and all(row in shown for row in plain)


# Slices


def test_quantising_is_linear_and_clips():
    image = np.array([[-1.0, 0.0, 0.5, 1.0, 7.0]])
    assert slices.quantised(image, 0.0, 1.0).tolist() == [[0, 0, 128, 255, 255]]


def test_a_slice_is_the_volumes_with_row_0_at_the_bottom(case):
    frame, z = slices.frame_of(case, 100), case.at[0]
    shown = slices.volume_image(case, case.reference, frame, z)
    inside = case.reference[z, frame.rows, frame.columns]
    expected = np.clip(inside / case.look.top, 0, 1) * 255
    assert np.abs(shown[::-1] - expected).max() <= 0.5 + 1e-4  # rounding, and float32 in front of it
    judged = case.truth.judged
    assert judged[:, frame.rows, frame.columns].sum() == judged.sum()


def test_errors_are_signed_and_leave_the_metal_out(case):
    frame, z = slices.frame_of(case, 100), case.at[0]
    metal = frame.cut(case.truth.metal, z)
    assert metal.any()
    # none is 127.5 of 255 and rounds to the even 128
    assert (slices.error_image(case, case.reference, frame, z) == 128).all()
    more = slices.error_image(case, case.reference + np.float32(case.look.error / 2), frame, z)
    assert set(more[metal]) == {128}
    # 0.75 · 255 = 191.25; float32 sums of 0.1 are off by 1e-8 of a scale of 0.01, so it rounds to 191
    assert set(more[~metal]) == {191}


def test_slices_are_at_even_steps_and_meet_the_most_metal(case):
    n_z = case.truth.metal.shape[0]
    for most in (1, 3, 5, 100):
        z = slices.frame_of(case, most).z
        assert len(z) <= most and case.at[0] in z and len(set(np.diff(z))) <= 1
        assert z[0] >= 0 and z[-1] < n_z
    judged = np.flatnonzero(case.truth.judged.any(axis=(1, 2)))
    assert slices.frame_of(case, 100).z == tuple(judged)


def test_what_is_carried_is_what_was_put_in():
    image = np.random.default_rng(3).integers(0, 256, (40, 51)).astype(np.uint8)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(base64.b64decode(slices.png(image))))), image)


def test_an_outline_lies_within_its_metal(case):
    frame, z = slices.frame_of(case, 100), case.at[0]
    ring, fill = (
        np.asarray(Image.open(io.BytesIO(base64.b64decode(s))).convert("RGBA"))
        for s in slices.metal_stencils(case, frame, z)
    )
    metal = frame.cut(case.truth.metal, z)
    assert np.array_equal(fill[..., 3] > 0, metal)
    assert set(map(tuple, fill[fill[..., 3] > 0][:, :3])) == {slices.UNJUDGED}
    n = ring.shape[0] // metal.shape[0]
    drawn = ring[..., 3] > 0
    assert drawn.any() and not (drawn & ~np.kron(metal, np.ones((n, n), bool))).any()
    assert slices.stencil(np.zeros((3, 3), bool), slices.RING) == ""


# Page


def test_the_page_needs_nothing_from_elsewhere(written):
    assert "default-src 'none'" in written
    own = re.sub(r'xmlns(:\w+)?="[^"]*"|<(rdf:RDF|metadata).*?</\1>', "", written, flags=re.S)
    assert not re.search(r"(?i)(src|href|action)=[\"'](?!#|data:)|url\((?!#)|@import|\bimport\(|fetch\(|XMLHttp", own)


def test_each_picture_of_a_slice_has_a_scale(case, written):
    bars = re.findall(r'<i class="bar" style="width: ([0-9.]+)%">([0-9.]+) mm</i>', written)
    assert len(bars) == len(re.findall('<div class="frame ', written)) == 7  # the reference, and two of each method
    columns = slices.frame_of(case, 100).columns
    width = (columns.stop - columns.start) * case.stored.geometry.d_voxel[2]
    for share, length in bars:
        assert float(length) == length_of(width) == pytest.approx(float(share) / 100 * width, rel=1e-3)


def test_the_page_carries_the_slices_of_the_volumes(case, written):
    found = images_of(written)
    frame = slices.frame_of(case, 100)
    assert tuple(found["z"]) == frame.z and found["z"][found["start"]] == case.at[0]
    assert set(found["volume"]) == {"reference", "0", "1", "2"} and set(found["error"]) == {"0", "1", "2"}
    for row, k in enumerate(case.kept):
        image = slices.volume_image(case, k.values, frame, frame.z[2])
        assert found["volume"][str(row)][2] == slices.png(image)
    assert [k.record.label for k in case.kept] == re.findall(r"<figcaption><b>(\w+)</b> PSNR3D", written)


def test_without_a_dataset_the_page_says_why_there_are_no_slices(results, monkeypatch, capsys, tmp_path):
    code, said = command(monkeypatch, capsys, results, "--out", tmp_path / "r.html")
    assert code == 0 and "r.html" in said.out
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "made without a dataset" in text and "application/json" not in text


def stress_record(folder, ok, found, *, case="starved", subject="fdk"):
    """Append a record of the stress suite to a results folder."""
    task = Task(
        study="stress", part="short", case=case, subject=subject, settings={"side": 16, "expected": "finite"},
        hints={"what": "no photons"},
    )  # fmt: skip
    outcome = stress.Judged(ok=ok, found=found, seconds={"row": (0.5,)})
    record = stress.StressRecord(
        task=task, found=(outcome,), host=host.host(), commit="0" * 40, time="2026-01-01T00:00:00"
    )
    stress.Stress().store(stress.Flags(results=folder)).append([record])


def test_other_tables_in_the_folder_are_shown_too(results, tmp_path):
    folder = tmp_path / "r"
    shutil.copytree(results, folder)
    case, subject = next(iter(stress.Stress().rows(stress.Flags(results=folder))))
    stress_record(folder, False, "3 < 4", subject="gone")
    assert "<summary>stress" not in report.html_page(folder, None, "")  # there is no such row any more
    stress_record(folder, True, "finite & <b>", case=case, subject=subject)
    for name, text in {"stress": "old", "reproduce": "old", "ablation": "old", "mine": "## A | <b>"}.items():
        (folder / f"{name}.md").write_text(text, encoding="utf-8")
    text = report.html_page(folder, None, "run-benchmark report")
    assert re.findall(r"<summary>(\w[^<]*)</summary>", text)[-4:] == [
        "stress, small grids", "ablation", "reproduce", "mine",
    ]  # fmt: skip
    assert [case, subject, "finite", "finite &amp; &lt;b&gt;", "yes"] in rows_of(text)
    assert "OS-SART ends well after 10 passes on every scan" in text and "Table 5. Components" in text
    assert "<pre>## A | &lt;b&gt;</pre>" in text and "<pre>old" not in text


def test_records_that_cannot_be_read_leave_their_page_as_text(results, tmp_path, caplog):
    folder = tmp_path / "r"
    shutil.copytree(results, folder)
    (folder / "peers.jsonl").write_text('{"of": "another version"}\n', encoding="utf-8")
    (folder / "peers.md").write_text("| rtk |", encoding="utf-8")
    text = report.html_page(folder, None, "run-benchmark report")
    assert "<summary>peers</summary>" in text and "<pre>| rtk |</pre>" in text
    (message,) = caplog.messages
    assert "peers.jsonl, line 1" in message and "peers.md" in message


def test_what_did_not_end_well_is_a_table(results, tmp_path):
    folder = tmp_path / "r"
    append(folder, make_record("net", scene="lung", status="error", reason="out of <luck>"))
    text = report.html_page(folder, None, "run-benchmark report")
    assert "<summary>Failures and skips</summary>" in text
    assert ["lung", "net", "metal", "error", "out of &lt;luck&gt;"] in rows_of(text)
    assert "Failures and skips" not in report.html_page(results, None, "run-benchmark report")


def test_a_figure_takes_the_colours_of_the_page(results):
    drawn = dict(figures.drawn(report.read(results)))
    assert len(drawn) == 3
    for label, figure in drawn.items():
        text = figures.svg(figure, label)
        assert text.startswith("<svg") and "currentColor" in text and figures.INK not in text


def test_figures_hold_the_numbers_of_the_records(results):
    records = report.read(results)
    wide = figures.scores(records, "tissue", "psnr3d")
    for record in records:
        if record.run.variant == "metal":
            expected = record.scores["tissue"].values["psnr3d"]
            assert wide.loc[record.label, record.run.scene] == pytest.approx(expected)


# Browser


SCRIPTED = """<script>
addEventListener("load", () => setTimeout(() => {
  const names = performance.getEntriesByType("resource").map((entry) => entry.name);
  document.body.dataset.loaded = names.filter((name) => !name.startsWith("data:")).join(" ") || "nothing";
}, 500));
%s</script></body>"""


def browse(text, folder, fragment="", script=""):
    """The document after its scripts and `script` ran in headless Chromium, and what it asked of the network."""
    if BROWSER is None:
        pytest.skip("there is no Chromium here (Debian: apt-get install chromium)")
    path = folder / "page.html"
    path.write_text(text.replace("</body>", SCRIPTED % script), encoding="utf-8")
    options = ["--headless=new", "--disable-gpu", "--no-first-run", "--virtual-time-budget=3000", "--dump-dom"]
    options += ["--no-sandbox"] if os.geteuid() == 0 else []
    done = subprocess.run(
        [BROWSER, *options, f"--user-data-dir={folder / 'profile'}", f"{path.as_uri()}{fragment}"],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    found = re.search(r'<body[^>]* data-loaded="([^"]*)"', done.stdout)
    assert done.returncode == 0 and found, done.stderr[-2000:]
    return done.stdout, found[1]


def sources(dom, kind):
    return re.findall(rf'data-kind="{kind}"[^>]*?src="data:image/png;base64,([^"]*)"', dom)


def test_the_address_sorts_and_turns_to_a_slice(written, tmp_path):
    dom, loaded = browse(written, tmp_path, "#slice=7&sort=tissue.2&show=error")
    found = images_of(written)
    k = found["z"].index(7)
    assert f"<output>{found['said'][k]}</output>" in dom and found["said"][k].startswith("slice 7 of 0 … 9")
    assert sources(dom, "volume") == [found["volume"][row][k] for row in ("reference", "0", "1", "2")]
    assert sources(dom, "error") == [found["error"][row][k] for row in ("0", "1", "2")]
    assert re.search(r'class="tiles[^"]*show-error', dom)
    numbers = [float(row[2]) for row in rows_of(dom.partition('id="table-tissue"')[2])[: len(METHODS)]]
    assert numbers == sorted(numbers, reverse=True) and len(set(numbers)) > 1
    assert loaded == "nothing"


CLICKS = """
const head = () => document.querySelector('#table-tissue th[data-column="2"] button');
head().click(); head().click();
const slider = document.querySelector("input[type=range]");
slider.value = 1;
slider.dispatchEvent(new Event("input"));
document.querySelector("input[name=method][value=limar]").click();
document.title = location.hash;
document.querySelector("nav a").click();
"""


def test_clicks_sort_and_the_slider_moves_every_image(written, tmp_path):
    dom, loaded = browse(written, tmp_path, script=CLICKS)
    found = images_of(written)
    assert sources(dom, "volume") == [found["volume"][row][1] for row in ("reference", "0", "1", "2")]
    assert f"<title>#slice={found['z'][1]}</title>" in dom
    assert re.search(r'data-method="limar" hidden', dom) and not re.search(r'data-method="nmar" hidden', dom)
    numbers = [float(row[2]) for row in rows_of(dom.partition('id="table-tissue"')[2])[: len(METHODS)]]
    assert numbers == sorted(numbers) and 'aria-sort="ascending"' in dom
    assert loaded == "nothing"


def test_a_page_that_loads_something_is_caught(tmp_path):
    _, loaded = browse('<body><img src="http://127.0.0.1:9/pixel.png"></body>', tmp_path)
    assert loaded == "http://127.0.0.1:9/pixel.png"


# Documentation


def test_the_markdown_page_holds_the_tables_of_each_folder(results, tmp_path, monkeypatch, capsys):
    other = tmp_path / "other"
    shutil.copytree(results, other)
    out = tmp_path / "docs" / "results.md"
    code, said = command(monkeypatch, capsys, results, "--markdown", out, "--also", other)
    text = out.read_text(encoding="utf-8")
    assert code == 0 and str(out) in said.out
    assert re.findall(r"^## (.+)$", text, re.M) == ["tiny", "other"]
    tissue = tables.render(report.read(results), "md", ("tissue",)).partition("\n\n")[2].strip()
    assert text.count(tissue) == 2 and text.count("### tissue\n") == 2
    (record, *_) = report.read(results)
    command_line = shlex.join(["run-benchmark", "report", str(results), "--markdown", str(out), "--also", str(other)])
    for words in (command_line, record.commit[:12], record.host.cpu, record.time[:10]):
        assert words in text


def test_errors_are_one_sentence_and_code_2(smallest, results, tmp_path, monkeypatch, capsys):
    (tmp_path / "empty").mkdir()
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    cases = [
        ((tmp_path / "empty",), "there are no records"),
        ((results, tmp_path / "nothing"), "nothing"),
        ((results, "--also", results), "--markdown"),
        ((results, "--markdown", tmp_path / "x.md", "--also", tmp_path / "empty"), "there are no records"),
    ]
    for arguments, words in cases:
        code, said = command(monkeypatch, capsys, *arguments)
        assert code == 2 and said.err.startswith("run-benchmark report: ") and said.err.count("\n") == 1, said.err
        assert words in said.err
    assert not (tmp_path / "x.md").exists()


def test_a_dataset_of_other_scans_is_refused(case, results, monkeypatch):
    other = replace(case.stored, content_hash="of another scan")
    monkeypatch.setattr(kept, "list_scans", lambda _: [other.folder])
    monkeypatch.setattr(kept, "open_scan", lambda _: other)
    with pytest.raises(InputError, match="none of its 1 scans"):
        list(kept.first_cases(other.folder.parent, report.read(results), results))


def test_every_subcommand_names_a_module_that_is_there():
    for name, command in cli.OTHERS.items():
        assert importlib.util.find_spec(command.module) is not None, name


def test_help_lists_every_subcommand(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "--help"])
    with pytest.raises(SystemExit) as end:
        cli.run_benchmark()
    lines = capsys.readouterr().out.splitlines()
    assert not end.value.code
    for name, command in cli.OTHERS.items():
        assert f"  {name:14}{command.about}" in lines and len(command.about) < 66


def test_the_readmes_command_is_understood():
    import tyro

    lines = re.findall(r"run-benchmark report ([^`\n#]+)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert lines
    for line in lines:
        tyro.cli(reports.Flags, args=shlex.split(line))


# Viewer


def test_a_state_shows_the_reference_the_methods_and_their_errors(case):
    state = view.first_state(case)
    shown = view.images(case, state)
    assert [s.title for s in shown] == ["reference", *METHODS, *(f"{m}: error" for m in METHODS)]
    water = case.look.water
    z = case.at[0]
    for image, values in zip(shown[1:4], (k.values for k in case.kept), strict=True):
        # float32 values of some hundred HU
        np.testing.assert_allclose(image.values, 1000 * (values[z] / water - 1), rtol=1e-5, atol=1e-2)
    for image, k in zip(shown[4:], case.kept, strict=True):
        np.testing.assert_allclose(image.values, 1000 * (k.values[z] - case.reference[z]) / water, rtol=1e-5, atol=1e-2)
    assert {(s.low, s.high) for s in shown[:4]} == {(state.level - state.width / 2, state.level + state.width / 2)}
    assert shown[0].low == pytest.approx(-1000) and shown[0].high == pytest.approx(1000 * (case.look.top / water - 1))
    assert {(s.low, s.high) for s in shown[4:]} == {(-state.error, state.error)}


def test_a_state_follows_its_axis_slice_and_methods(case):
    for axis, name in enumerate(view.AXES):
        state = replace(view.first_state(case), axis=name, index=3, methods=("nmar",), errors=False)
        shown = view.images(case, state)
        assert [s.title for s in shown] == ["reference", "nmar"]
        expected = 1000 * (np.take(case.reference, 3, axis) / case.look.water - 1)
        np.testing.assert_allclose(shown[0].values, expected, rtol=1e-5, atol=1e-2)
        assert len(view.figure(case, state).axes) == 2


def test_without_water_windows_are_in_attenuation(case):
    bare = replace(case, look=replace(case.look, water=None))
    state = view.first_state(bare)
    assert view.unit(bare) == "1/mm" and state.width == pytest.approx(case.look.top)
    assert np.array_equal(view.images(bare, state)[0].values, case.reference[case.at[0]])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"axis": "u"}, "axis must be one of z, y, x"),
        ({"width": 0.0}, "above 0"),
        ({"index": 10}, "within 0 … 9 along z"),
        ({"methods": ("sart",)}, "no volume of 'sart'"),
    ],
)
def test_a_state_that_cannot_be_shown_is_refused(case, change, words):
    with pytest.raises(InputError, match=re.escape(words)):
        view.images(case, replace(view.first_state(case), **change))


def test_the_viewers_controls_redraw(case):
    box = view.viewer(case)
    *controls, screen = box.children
    named = {control.description: control for control in controls}
    seen = {bytes(screen.value)}
    for description, value in (("slice", 2), ("normal to", "x"), ("show errors", False), ("methods", ("fdk",))):
        named[description].value = value
        shown = bytes(screen.value)
        assert shown not in seen and shown.startswith(b"\x89PNG")
        seen.add(shown)
    assert named["slice"].max == case.reference.shape[2] - 1


def test_without_ipywidgets_the_viewer_says_what_to_install(case, monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(InputError, match=r"ctsim\[notebook\]"):
        view.viewer(case)


def test_a_case_holds_the_volume_at_50_kev_of_that_very_run(smallest, results, case):
    first = case.kept[0]
    at_50kev = at_50kev_of(results / str(first.record.volume))
    try:
        for identity, found in ((first.record.identity, True), ("another run", False)):
            write_volume(at_50kev, np.ones(first.values.shape, np.float32), identity)
            own = kept.open_case(smallest, results).kept[0].at_50kev
            assert (own is not None) == found and (own is None or (own == 1).all())
    finally:
        at_50kev.unlink()
    assert all(k.at_50kev is None for k in case.kept)


# Notebooks


def notebook(name, data, results, figures_folder):
    """Run a notebook as a script; what it wrote to the terminal."""
    folders = {"CTSIM_DATA": str(data), "CTSIM_RESULTS": str(results), "CTSIM_FIGURES": str(figures_folder)}
    done = subprocess.run(
        [sys.executable, "-W", "error", str(NOTEBOOKS / f"{name}.py")],
        env={**os.environ, **folders, "MPLBACKEND": "Agg", "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, timeout=240, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_in_a_kernel_things_are_displayed(case, monkeypatch, tmp_path):
    pytest.importorskip("ipywidgets")  # loaded now, as it needs the IPython that is replaced
    shown = []
    shell = SimpleNamespace(kernel=None)
    display = SimpleNamespace(
        display=shown.append, Markdown=lambda text: ("text", text), Image=lambda data: ("image", data[:4])
    )
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell, display=display))
    monkeypatch.chdir(tmp_path)
    show.table(["a", "b"], [["x", "1"]])
    show.figure(Figure(), "f")
    show.slices(case, "s")
    assert shown[:2] == [("text", "| a | b |\n|---|---:|\n| x | 1 |\n"), ("image", b"\x89PNG")]
    assert shown[2].children and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "n_figures", "words"),
    [
        ("results", 4, "## anchored"),
        ("metrics", 1, "| protocol paper |"),
        ("physics", 5, "Measured over predicted standard deviation"),
    ],
)
def test_a_notebook_runs_as_a_script(name, n_figures, words, quick, tmp_path):
    said = notebook(name, *quick, tmp_path)
    assert words in said and len(list(tmp_path.glob(f"{name}-*.png"))) == n_figures


def test_the_stability_notebook_shows_what_the_stress_suite_recorded(smallest, tmp_path):
    for ok, found in ((False, "an older row"), (True, "finite"), (False, "3 values are not finite")):
        stress_record(tmp_path, ok, found, subject="fdk" if "older" in found or ok else "nmar")
    said = notebook("stability", smallest, tmp_path, tmp_path)
    assert "1 of 2 rows are as expected" in said and "- starved, nmar: 3 values are not finite" in said
    assert "older" not in said and (tmp_path / "stability-stress.png").exists()


def cells(said):
    """Rows of the Markdown tables in a text: first cell -> the other cells of every such row."""
    found = {}
    for line in re.findall(r"^\| (.+) \|$", said, re.M):
        first, *others = line.split(" | ")
        found.setdefault(first, []).append(others)
    return found


def test_the_training_notebook_makes_data_trains_and_scores(tmp_path, monkeypatch):
    folder = tmp_path / "training"
    monkeypatch.setenv("CTSIM_TRAINING", str(folder))
    monkeypatch.setenv("CTSIM_TRAINING_SIZE", "tiny")
    found = cells(notebook("train", tmp_path, tmp_path, tmp_path))
    names = ("train", "val", "test")
    assert {path.name for path in (folder / "shards").iterdir()} == {f"{name}-00000.h5" for name in names}
    assert {path.stem for path in tmp_path.glob("train-*.png")} == {"train-loss", "train-slices"}
    index = read_index(folder / "data")
    assert all(found[name][0][1] == found[name][0][0] for name in names)  # one scan an individual
    assert sum(int(found[name][0][0]) for name in names) <= len(index) == 12
    for network in ("U-Net on LIMAR", "U-Net without LIMAR", "denoiser"):
        assert float(found[network][0][1]) > float(found[network][0][2])  # the loss falls
    stored = [open_scan(folder / "data" / name) for name, line in index.items() if line.about.split == "test"]
    scored = [s for s in stored if s.metal.any()]
    assert int(found["test"][0][0]) == len(scored) > 1
    for method in ("fdk", "limar"):
        one = [ctsim.score_volume(ctsim.reconstruct_scan(s, method), s, protocols="tissue") for s in scored]
        psnr = np.mean([score["tissue"].values["psnr3d"] for score in one])
        assert float(found[method.upper()][0][1].split()[0]) == pytest.approx(psnr, abs=0.0051)  # two decimals
    assert found["FDK"][0][-1] == found["LIMAR"][0][-1]  # without metal LIMAR is FDK
    assert len(found["U-Net on LIMAR over LIMAR"][0]) == 4
