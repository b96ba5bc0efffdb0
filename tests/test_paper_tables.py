import functools
import sys
from types import SimpleNamespace

import msgspec
import pytest
from run_records import append, make_record

from ctsim.benchmarks import cli
from ctsim.benchmarks.methods import FAILED
from ctsim.benchmarks.scores.score import Score
from ctsim.benchmarks.studies.methods.plan import repetition
from ctsim.benchmarks.studies.methods.records import Cost
from ctsim.benchmarks.studies.paper import layout as paper_layout
from ctsim.benchmarks.studies.paper import tables as paper_tables
from ctsim.benchmarks.suites import load as load_suite
from ctsim.errors import InputError
from ctsim.phantoms.scene import scene_id

PAPER = paper_layout.load()
TABLES = {table.number: table for table in PAPER.table}


@functools.cache
def identity(suite, scene, seed=1, name=""):
    (found,) = (s for s in load_suite(suite) if s.name == scene)
    return scene_id(msgspec.structs.replace(found, seed=seed, name=name or scene))


def record(method="fdk", scene="lung-Fe", psnr=20.0, *, ssim=0.5, seed=1, scan="b", n_voxels=64, wall=61.0, **more):
    params = more.pop("params", {})
    of = more.pop("scene_id", None) or identity(
        more.pop("suite", "ablation" if scene.startswith("ablation") else "core"), scene, seed
    )
    score = Score(
        region="all voxels", reference="50 keV", alignment="none", data_range=0.25, n_voxels=n_voxels,
        values={"psnr3d": psnr, "ssim3d": ssim},
    )  # fmt: skip
    planned = paper_layout.Planned(suite="", scene=scene, method=method, params=more.pop("overrides", {}))
    status = more.pop("status", "ok")
    return make_record(
        method, label=planned.label, scene=more.pop("name", scene), scene_id=of, scan=scan, seed=seed, params=params,
        inputs=more.pop("inputs", "counts only"), status=status, scores={"paper": score} if status == "ok" else {},
        cost=Cost(wall=wall, cpu=2.5, peak_bytes=2**21, view_updates=60, device="cpu"), **more,
    )  # fmt: skip


def lines(text, start):
    return [[c.strip() for c in x.strip("|").split("|")] for x in text.splitlines() if x.startswith(f"| {start} |")]


# How many figures each table has in the paper's source, and their sum, times in seconds: added up from the LaTeX.
SUMS = {
    1: (6, 86.413), 2: (10, 153.665), 3: (54, 580.962), 4: (24, 104303), 5: (8, 102.711),
    6: (8, 117.966), 7: (12, 166.142), 8: (16, 19637), 9: (8, 94.2581),
}  # fmt: skip


def test_no_figure_of_the_paper_is_mistyped():
    found = {}
    for number, table in TABLES.items():
        numbers = [paper_layout.printed(text).number for row in table.rows for text in row.figures if text]
        found[number] = (len(numbers), round(sum(n for n in numbers if n is not None), 4))
    assert found == SUMS


def test_figures_that_the_paper_prints_more_than_once_agree():
    def row(number, *stubs):
        (found,) = (r.figures for r in TABLES[number].rows if r.stubs == stubs)
        return found

    lung, teeth, broccoli = (row(3, "Ours (splat-paper)")[k : k + 2] for k in (0, 2, 4))
    assert lung == row(1, "Our model") == row(5, "Baseline with both") == row(6, "15") == row(7, "Lung")[2:]
    assert (teeth, broccoli) == (row(7, "Teeth")[2:], row(7, "Broccoli")[2:])
    assert row(5, "Baseline") == row(7, "Lung")[:2]
    times = {r.stubs: r.figures for r in TABLES[4].rows}
    assert {stubs: figures[2] for stubs, figures in times.items()} == {r.stubs: r.figures[1] for r in TABLES[8].rows}
    for gamma, e_max in (r.stubs for r in TABLES[9].rows):
        energy = float(e_max.partition(",")[0])
        assert f"{(energy - 10) / (energy + 10):.3f}" == gamma


def test_the_paper_comes_out_best_where_it_prints_itself_bold():
    """It marks no more than its own column or row in tables 1, 3, 4, 5 and 7."""
    sheets = {sheet.number: sheet for sheet in paper_tables.filled([], "paper")}

    def places(number, column):
        """The places in a column of the paper; ours is next to it."""
        k, found = len(TABLES[number].stubs) + 2 * column, sheets[number].places()
        return [found.get((i, k), "") for i in range(len(TABLES[number].rows))]

    for number, ours in ((1, "Our model"), (3, "Ours (splat-paper)"), (5, "Baseline with both")):
        best = [r.stubs[0] for r, p in zip(TABLES[number].rows, places(number, 0), strict=True) if p == "best"]
        assert best == [ours]
    for number, column in ((4, 2), (7, 2), (7, 3)):
        assert set(places(number, column)) == {"best"}
    assert places(6, 1)[:4] == ["", "best", "best", "second"]  # 0.993 twice


def test_every_cell_has_a_scene_of_a_bundled_suite():
    suites = {p.suite for t in PAPER.table for row in t.plan() for p in row}
    scenes = {suite: {scene.name for scene in load_suite(suite)} for suite in suites}
    for table in PAPER.table:
        for row in table.plan():
            for planned in row:
                assert planned.scene in scenes[planned.suite], (table.number, planned)


REAL = "Real (here look-alike)"


def broccolis(text):
    return {line[0]: line[7] for k in ("Synthetic", REAL) for line in lines(text, k) if line[1] == "Broccoli"}


def test_a_scene_of_the_same_name_fills_no_cell_and_is_counted():
    """Table 4 has the broccoli of core and that of lookalike, whose times are 16 m 08 s and 16 m 16 s in the paper."""
    found = [
        record("splat-paper", "broccoli-Al", suite="core", wall=60.0, scan="core"),
        record("splat-paper", "broccoli-Al", suite="quick", wall=3.0, scan="quick"),
        record("splat-paper", "lung-Fe", suite="quick", wall=4.0, scan="quick"),
        record("fdk", "lung-Fe", suite="quick", wall=5.0, scan="quick"),  # in no cell of table 4
    ]
    text = paper_tables.text_of(found, "md", "paper", (4,))
    assert broccolis(text) == {"Synthetic": "1m 00s", REAL: "–"}
    quick, core = identity("quick", "lung-Fe"), identity("core", "lung-Fe")
    repeated = identity("core", "lung-Fe", name="lung-Fe-s1")
    said = f"(scene_id {quick}); expected {core} or {repeated} (seed 1), which `make-dataset core` makes"
    assert f"- core/lung-Fe: 1 record is left out, of another scene of this name {said}\n" in text
    assert (
        "- core/broccoli-Al: 1 record is left out" in text and "- lookalike/broccoli-Al: 1 record is left out" in text
    )
    found.append(record("splat-paper", "broccoli-Al", suite="lookalike", wall=120.0, scan="lookalike"))
    text = paper_tables.text_of(found, "md", "paper", (4,))
    assert broccolis(text) == {"Synthetic": "1m 00s", REAL: "2m 00s"}


def test_any_seed_of_the_planned_scene_counts_as_itself_and_as_a_repetition(tmp_path):
    """`make-dataset --seeds 2` hashes NAME-s2, which records call NAME; a suite of one's own keeps the name."""
    stored = SimpleNamespace(folder=tmp_path, name="lung-Fe-s2", info=SimpleNamespace(seed=2))
    assert repetition(stored) == ("lung-Fe", 2)
    repeated = identity("core", "lung-Fe", 2, "lung-Fe-s2")
    found = [record(psnr=20.0), record(psnr=22.0, seed=2, scan="c", scene_id=repeated)]
    found.append(record(psnr=24.0, seed=3, scan="d"))
    text = paper_tables.text_of(found, "md", "paper", (3,))
    assert lines(text, "FDK")[0][2] == "22.00 ± 2.00" and "left out" not in text


def test_seeds_that_no_scene_has_count_for_none():
    text = paper_tables.text_of([record(psnr=77.0, seed=-1, scene_id="0" * 12)], "md", "paper", (3,))
    assert "77.00" not in text and "core/lung-Fe: 1 record is left out" in text


def test_cells_hold_mean_and_spread_and_compete_within_their_side():
    found = [
        record("fdk", psnr=20.0),
        record("fdk", psnr=22.0, seed=2, scan="c"),
        record("limar", psnr=30.0, ssim=0.7, inputs="metal mask", mask="oracle", params={"insert": "fdk"}),
        record("nmar", psnr=25.0, ssim=0.6, inputs="metal mask", mask="oracle", params={"insert": "mean"}),
    ]
    text = paper_tables.text_of(found, "md", "paper", (3,))
    # std with ddof = 1 of 20 and 22 is √2; the paper's own stand beside
    assert lines(text, "FDK")[0][1:5] == ["19.04", "21.00 ± 1.41", "0.924", "0.500 ± 0.000"]
    assert lines(text, "LIMAR")[0][1:3] == ["19.83", "**30.00**"]
    assert lines(text, "NMAR")[0][1:3] == ["<u>20.49</u>", "<u>25.00</u>"]
    assert lines(text, "Ours (splat-paper)")[0][1:3] == ["**29.19**", "–"]


def test_the_caption_states_what_a_number_means():
    found = [
        record("fdk", seed=3),
        record("limar", seed=3, inputs="metal mask", mask="oracle", params={"insert": "fdk"}),
        record("limar", seed=4, scan="c", inputs="metal mask", mask="oracle", params={"insert": "fdk"}),
    ]
    text = paper_tables.text_of(found, "md", "paper", (3,))
    for part in (
        "Protocol paper: region all voxels; reference 50 keV; alignment none; data range 0.25 (core/lung-Fe) 1/mm",
        "Seeds 3, 4, not all of them in each cell.",
        "Grid: 64 voxels (core/lung-Fe).",
        "Inputs: counts only (fdk); metal mask, oracle (limar).",
        "Metal insertion: reconstructed like the rest (fdk); fdk (limar).",
        "The phantoms differ from the paper's",
    ):
        assert part in text, part


def test_times_are_written_as_the_paper_does_and_the_fastest_wins():
    found = [
        record("splat-paper", "broccoli-Al", wall=3725.4),
        record("splat", "broccoli-Al", wall=9.0),
    ]
    text = paper_tables.text_of(found, "md", "paper", (4,))
    ((_, _, *cells), _) = [line for line in lines(text, "Synthetic") if line[1] in ("Broccoli", "Lung")]
    assert cells[4:] == ["**16m 08s**", "<u>1h 02m 05s</u>", "**9.0s**"]
    assert "Measured on A CPU, 2 threads, device cpu." in text and "Protocol cost" in text
    assert [paper_layout.duration(s) for s in (0.04, 9.96, 59.6, 3599.7)] == ["0.0s", "10s", "1m 00s", "1h 00m 00s"]
    assert paper_layout.seconds("2h 06m 55s") == 7615.0
    with pytest.raises(InputError, match="a time must be like"):
        paper_layout.seconds("2:06:55")


def test_a_missing_cell_names_the_command_that_makes_it():
    text = paper_tables.text_of([record("fdk", s) for s in ("lung-Fe", "teeth-Ti", "broccoli-Al")], "md", "paper")
    table = dict(enumerate(text.split("## Table ")[1:], 1))
    core = "`make-dataset core data/`, then `run-benchmark data/ results/ --scene lung-Fe --scene teeth-Ti"
    nets = "--method acdnet-lite --method dicdnet-lite --method oscnet-lite --method polyner --method park"
    ours = "--method splat-paper --method splat-r2 --method splat --method naf --method field`"
    assert f"{core} --scene broccoli-Al --method limar --method nmar {nets} {ours}" in table[3]
    assert "--method fdk" not in table[3]
    assert "`run-benchmark ablation data/ results/ --table 5`" in table[5]
    assert "A run has 2000 or 3000 steps here" in table[5] and "steps here" not in table[3]
    assert "`make-dataset lookalike data/`" in table[8] and "--scene walnut-Fe" in table[8]


def test_the_commands_are_understood_and_make_the_label_of_the_cell():
    """The flags lead `run-benchmark` to the very label that the cell looks for."""
    import shlex

    import tyro

    from ctsim.benchmarks.methods import Method, parse_overrides
    from ctsim.benchmarks.studies.methods.study import Flags as Arguments

    for table in PAPER.table:
        for *_, planned in table.plan():
            given = tyro.cli(Arguments, args=["data", "results", *shlex.split(planned.flags)])
            overrides = parse_overrides(given.set, given.method)[planned.method]
            label = Method(name=planned.method, target="", inputs="", params={}, overrides=overrides).label
            assert label == planned.label


def test_a_failed_run_shows_its_status_and_its_reason():
    found = [record("fdk", status="timeout", reason="did not end within 5 s"), record("nmar")]
    text = paper_tables.text_of(found, "md", "paper", (3,))
    assert lines(text, "FDK")[0][2] == "timeout" and lines(text, "NMAR")[0][2] == "20.00"
    assert "- core/lung-Fe, fdk: timeout – did not end within 5 s" in text


def test_folders_merge_and_the_newest_data_count(tmp_path, monkeypatch, capsys):
    new, old = tmp_path / "new", tmp_path / "old"
    for folder, when, scan, psnr in ((new, "2026-02", "b", 30.0), (old, "2026-01", "a", 10.0)):
        append(folder, record("fdk", psnr=psnr, scan=scan, time=when))
    append(old, record("fdk", "teeth-Ti", psnr=11.0, time="2026-01"))
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "paper-tables", str(new), str(old), "--table", "3"])
    assert cli.run_benchmark() == 0
    text = capsys.readouterr().out
    assert lines(text, "FDK")[0][2] == "30.00" and lines(text, "FDK")[0][6] == "11.00"
    assert "- core/lung-Fe: 1 records of older data are left out" in text


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere"], "nowhere: there is no such folder"),
        ([".", "--table", "10"], "tables 1 to 9"),
        ([], "no folder is given"),
    ],
)
def test_what_is_not_there_is_one_sentence(arguments, says, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "paper-tables", *arguments])
    assert cli.run_benchmark() == 2
    said = capsys.readouterr().err
    assert says in said and said.count("\n") == 1


def test_records_of_another_protocol_version_are_left_out_and_counted():
    text = paper_tables.text_of([record("fdk", psnr=77.0, protocol=1)], "md", "paper", (3,))
    assert "77.00" not in text and "1 of 1 records are of protocol version 1 and left out" in text


def test_latex_is_booktabs_and_balanced():
    text = paper_tables.text_of([record("fdk"), record("nmar", psnr=25.0)], "tex", "paper")
    assert text.count(r"\begin{table}") == text.count(r"\bottomrule") == 9
    for part in (
        r"\textbf{25.00}",
        r"\underline{20.00}",
        r"\multicolumn{4}{c}{Lung}",
        r"$\gamma$",
        "-{}-scene lung-Fe",
    ):
        assert part in text, part
    body = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    assert body.count("{") == body.count("}") and not any(c in body for c in "–γ²±")
    for table in body.split(r"\begin{tabular}{")[1:]:
        width = len(table.partition("}")[0])
        rows = table.partition(r"\midrule")[2].partition(r"\bottomrule")[0].strip().splitlines()
        assert all(row.count("&") == width - 1 for row in rows)


def test_a_table_with_a_hole_is_refused():
    broken = msgspec.to_builtins(TABLES[1])
    broken["rows"][0]["figures"] = ["26.51"]
    with pytest.raises(msgspec.ValidationError, match="table 1, row GMM"):
        msgspec.convert(broken, paper_layout.PaperTable)
    broken = msgspec.to_builtins(TABLES[1]) | {"scene": ""}
    with pytest.raises(msgspec.ValidationError, match="expected suite, scene and method"):
        msgspec.convert(broken, paper_layout.PaperTable)


def test_a_row_whose_method_failed_a_rule_has_its_dagger():
    found = [record("park"), record("acdnet-lite"), record("fdk")]
    text = "".join(sheet.markdown() for sheet in paper_tables.filled(found, "paper", (3, 4)))
    assert f"| Park et al. †{FAILED['park']} |" in text and "lite †" not in text and "FDK †" not in text
    assert "failed these rules" in text
