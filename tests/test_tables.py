import cProfile
import csv
import pstats
import random
import shutil
import subprocess

import msgspec
import numpy as np
import pandas as pd
import pytest
from run_records import changed, make_record

from ctsim.benchmarks.engine.table import escape, simple
from ctsim.benchmarks.scores.score import Score
from ctsim.benchmarks.studies.methods import captions, records, tables
from ctsim.benchmarks.studies.methods.records import Cost
from ctsim.errors import InputError


def record(method="fdk", scene="lung", psnr=20.0, rmse=0.1, inputs="counts only", **more):
    score = Score(
        region="the tissue", reference="50 keV", alignment="none", data_range=0.0234, n_voxels=9,
        identical=psnr is None, values={"psnr3d": psnr, "ssim3d": 0.5, "rmse": rmse},
    )  # fmt: skip
    status = more.pop("status", "ok")
    cost = Cost(wall=1.5, cpu=2.5, peak_bytes=2**21, view_updates=60, device="cpu")
    failed = {"scores": {}, "reason": "out | of luck"} if status != "ok" else {"scores": {"tissue": score}}
    return make_record(method, scene=scene, inputs=inputs, status=status, cost=cost, **failed, **more)


def cells(text, start):
    line = next(line for line in text.splitlines() if line.startswith(start))
    return [c.strip() for c in line.strip("|").split("|")]


def test_fewer_seeds_than_another_row_are_said_and_have_no_rank():
    given = [record(name, psnr=psnr, seed=k) for name, psnr in (("fdk", 20.0), ("other", 19.0)) for k in range(3)]
    given += [record("net", psnr=99.0), record("net", psnr=98.0, seed=1)]
    text = tables.render(given, "md")
    assert "98.50 ± 0.71 (2/3 seeds)" in text and "**20.00 ± 0.00**" in text
    assert "seeds)" not in tables.render([*given, record("net", psnr=97.0, seed=2)], "md")


def test_mean_and_std_over_seeds():
    text = tables.render([record(psnr=20.0), record(psnr=22.0, seed=1)], "md")
    # std with ddof = 1 of 20 and 22 is √2.
    assert "21.00 ± 1.41" in text


def test_air_kerma_is_with_the_cost_and_a_dash_in_older_records():
    for given, expected in (
        ([record(kerma=1.2345), record("net")], ["1.234", "–"]),
        ([record(), record("net")], ["–", "–"]),
    ):
        text = tables.render(given, "md")
        text = text[text.index("## cost") :]
        assert cells(text, "| inputs")[-1] == "lung: air kerma (mGy)"
        assert [cells(text, f"| counts only | {who}")[-1] for who in ("fdk", "net")] == expected
    seeds = [record(kerma=1.5), record(seed=1, kerma=1.5)]
    assert "1.500 ± 0.000" in tables.render(seeds, "md")
    assert "air kerma" in tables.render(seeds, "tex")
    found = tables.summary(seeds).set_index(["protocol", "metric"])
    assert found.loc[("cost", "kerma"), "mean"] == 1.5


def test_ranks_stay_within_an_input_class():
    given = [record("a", psnr=20.0), record("b", psnr=25.0), record("c", psnr=30.0), record("d", 50, inputs="mask")]
    given[3] = record("d", psnr=50.0, inputs="mask")
    text = tables.render(given, "md")
    assert cells(text, "| counts only | a")[2] == "20.00"
    assert cells(text, "| counts only | b")[2] == "<u>25.00</u>"
    assert cells(text, "| counts only | c")[2] == "**30.00**"
    assert cells(text, "| mask | d")[2] == "50.00"


def test_a_label_of_two_classes_of_inputs_is_two_rows_each_with_its_own_numbers():
    """As after the class of a method has changed and one of two scenes was run again."""
    first, again = record("net", psnr=20.0), record("net", scene="teeth", psnr=25.0, inputs="mask")
    text = tables.render([first, again], "md")
    text = text[text.index("## tissue") :]
    assert cells(text, "| counts only | net")[2] == "20.00" and cells(text, "| mask | net")[2] == "–"
    assert "25.00" in cells(text, "| mask | net") and "25.00" not in cells(text, "| counts only | net")


def test_captions_state_protocol_region_and_range():
    for form in ("md", "tex"):
        text = tables.render([record(), record(scene="teeth")], form)
        assert "Protocol tissue: region the tissue; reference 50 keV; alignment none" in text
        assert "data range 0.0234 (lung), 0.0234 (teeth) 1/mm" in text


def test_failures_are_rows_with_a_reason():
    text = tables.render([record(), record("net", status="out_of_memory")], "md")
    assert cells(text, "| counts only | net")[2] == "out_of_memory"
    assert "lung (metal), net: out_of_memory – out \\| of luck" in text


def test_a_table_of_failures_only_still_shows_them():
    text = tables.render([record(status="error")], "md")
    assert "lung (metal), fdk: error" in text


def test_a_mean_needs_every_scene():
    given = [
        record("a"),
        record("a", scene="teeth", psnr=30.0),
        record("b"),
        record("b", scene="teeth", status="error"),
    ]
    text = tables.render(given, "md", ["tissue"])
    assert cells(text, "| counts only | a")[-2:][0] == "25.00"
    assert cells(text, "| counts only | b")[-2:] == ["–", "–"]


def test_identical_is_named():
    assert "identical" in tables.render([record(psnr=None, rmse=0.0)], "md")


def test_gain_over_fdk_and_nmar():
    given = [record("fdk", psnr=20.0), record("nmar", psnr=26.0, inputs="mask"), record("bad", psnr=19.0)]
    table = tables.summary(given).set_index(["method", "protocol", "metric"])["mean"]
    assert table["nmar", "against", "over_fdk"] == pytest.approx(6.0)
    assert table["bad", "against", "over_nmar"] == pytest.approx(-7.0)
    assert "(the row nmar)" in tables.render(given, "md")
    assert "over NMAR (dB)" not in tables.render(given[:1], "md")
    assert "## against" not in tables.render(given[2:], "md")


def test_nmar_with_parameters_is_named():
    given = [record("fdk"), record("nmar[mask=oracle]", psnr=26.0), record("nmar[mask=auto]", psnr=25.0)]
    text = tables.render(given, "md")
    assert "over NMAR (the row nmar[mask=oracle])" in text
    assert cells(text[text.index("## against") :], "| counts only | nmar[mask=auto]")[3] == "<u>-1.00</u>"


def anchors(scene, rmse, best=0.1, worst=0.5, **more):
    """FDK with and without the metal, and a method, of which the RMSE is given."""
    return [
        record("fdk", rmse=worst, scene=scene, **more),
        record("fdk", rmse=best, scene=scene, variant="metal_free", **more),
        record("net", rmse=rmse, scene=scene, **more),
    ]


def test_anchored_score_of_the_rmse():
    given = anchors("lung", 0.2)
    table = tables.summary(given).set_index(["variant", "method", "protocol", "metric"])["mean"]
    assert table["metal", "net", "anchored", "tissue/rmse"] == pytest.approx(0.25)  # (0.2 − 0.1) / (0.5 − 0.1)
    assert table["metal", "fdk", "anchored", "tissue/rmse"] == 1.0
    assert "metal_free" not in tables.render(given, "md")


def test_harm_is_a_share_of_scenes():
    given = anchors("a", 0.2) + anchors("b", 0.6) + anchors("c", 0.7)
    text = tables.render(given, "md")
    text = text[text.index("## anchored") :]
    assert "harm rate: s tissue RMSE" in text
    row = cells(text, "| counts only | net")
    # s = 0.25, 1.25, 1.5; of two metrics SSIM has no score (all are equal), so the columns are RMSE alone
    assert row[2:] == ["**0.250**", "<u>1.250</u>", "<u>1.500</u>", "**1.000**", "<u>0.67 (2/3)</u>"]
    assert cells(text, "| counts only | fdk")[-1] == "**0.00 (0/3)**"


def test_harm_counts_scenes_not_seeds():
    # seeds 0.3 and 1.3: harmful once, but not on average
    given = anchors("a", 0.22, seed=0) + anchors("a", 0.62, seed=1)
    text = tables.render(given, "md")
    row = cells(text[text.index("## anchored") :], "| counts only | net")
    # std with ddof = 1 of 0.3 and 1.3 is 1/√2
    assert row[2] == "**0.800 ± 0.707**" and row[3].strip("*<u>/") == "0.00 (0/1)"


def test_a_scene_without_a_score_is_not_counted_as_unharmed():
    given = anchors("a", 0.6) + anchors("b", 0.6, best=0.5)  # in b the metal does FDK no harm
    text = tables.render(given, "md")
    row = cells(text[text.index("## anchored") :], "| counts only | net")
    assert row[3:] == ["–", "–", "1.00 (1/1)"]


def artefact_record(method, streak, note="ROI water", rmse=0.5):
    found = record(method, psnr=20.0, rmse=rmse)
    score = Score(
        region="ROIs", reference="twin", alignment="none", data_range=None, n_voxels=9, note=note,
        values={"streak": streak, "rmse_near": None},
    )  # fmt: skip
    return changed(found, scores={**found.scores, "artefact": score})


def test_artefacts_are_anchored_on_nothing():
    given = [artefact_record("fdk", 80.0), record(rmse=0.1, variant="metal_free"), artefact_record("net", 20.0)]
    table = tables.summary(given).set_index(["method", "protocol", "metric"])["mean"]
    assert table["net", "anchored", "artefact/streak"] == 0.25
    assert ("net", "anchored", "artefact/rmse_near") not in table.index


def test_what_a_score_declares_stands_below_its_table():
    given = [artefact_record("fdk", 80.0), artefact_record("net", 20.0)]
    assert "- lung (seed 0): ROI water\n" in tables.render(given, "md")
    assert "\\end{table}\n% lung (seed 0): ROI water\n" in tables.render(given, "tex")
    given[1] = artefact_record("net", None, "no twin | at all")
    text = tables.render(given, "md")
    assert "- lung (seed 0, fdk): ROI water\n" in text and "- lung (seed 0, net): no twin \\| at all\n" in text


def test_old_protocols_are_left_out_and_said_to_be(tmp_path):
    old = record("old", psnr=99.0)
    old = msgspec.structs.replace(old, task=msgspec.structs.replace(old.task, version=1))
    text = tables.render([record(), old], "md")
    assert "99.00" not in text and "1 of 2 records are of protocol version 1 and left out" in text
    with pytest.raises(InputError, match="protocol version 1"):
        tables.write([old], tmp_path)


def test_ranges_of_seeds_that_differ_are_both_given():
    other = record(seed=1)
    score = msgspec.structs.replace(other.scores["tissue"], data_range=0.025)
    other = changed(other, scores={"tissue": score})
    assert "data range 0.0234 to 0.025 (lung) 1/mm" in tables.render([record(), other], "md")


def test_identical_is_said_of_the_psnr_alone():
    given = record(psnr=None)
    score = msgspec.structs.replace(given.scores["tissue"], values={"psnr3d": None, "ssim3d": None}, identical=True)
    text = tables.render([changed(given, scores={"tissue": score})], "md")
    assert cells(text, "| counts only | fdk")[2:4] == ["identical", "–"]


def test_latex_is_booktabs_and_escaped(tmp_path):
    text = tables.render([record("my_lab[a=1%]", psnr=20.0), record(psnr=21.0)], "tex")
    for part in (r"\toprule", r"\midrule", r"\bottomrule", r"my\_lab[a=1\%]", r"\textbf{21.00}", r"\underline{20.00}"):
        assert part in text
    assert text.count("{") - text.count(r"\{") == text.count("}") - text.count(r"\}")
    assert escape(r"\_&", "tex") == r"\textbackslash{}\_\&"


def test_write_makes_three_files(tmp_path):
    tables.write([record(), record(scene="teeth")], tmp_path)
    frame = pd.read_csv(tmp_path / "table.csv")
    assert set(frame.scene) == {"lung", "teeth"} and {"mean", "std", "n", "status"} <= set(frame.columns)
    assert (tmp_path / "table.md").exists() and (tmp_path / "table.tex").exists()
    with pytest.raises(InputError, match="no records"):
        tables.write([], tmp_path)


def test_the_csv_says_which_volume_was_scored(tmp_path):
    given = record()
    own = msgspec.structs.replace(given.scores["tissue"], volume="read at 50 keV")
    tables.write([changed(given, scores={**given.scores, "paper": own})], tmp_path)
    frame = pd.read_csv(tmp_path / "table.csv", keep_default_na=False)
    said = {(row.protocol, row.volume) for row in frame.itertuples()}
    assert said == {("tissue", "as returned"), ("paper", "read at 50 keV"), ("against", "as returned"), ("cost", "")}


def test_texts_that_differ_in_numbers_only_are_merged_to_ranges():
    assert captions.merged(["behind 9.5 mm", "behind 30.25 mm", "behind 12.0 mm"]) == "behind 9.5 to 30.25 mm"
    assert captions.merged(["50 keV", "behind 1.0 of 2.0", "behind 1.0 of 3.0"]) == "50 keV / behind 1.0 of 2.0 to 3.0"
    assert captions.merged([]) == "" and captions.merged(["# 1.5 #", "# 2.5 #"]) == "# 1.5 to 2.5 #"


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles_with_whatever_a_caption_or_a_reason_holds(tmp_path):
    odd = "50 % of {a_b} & c^2 ≤ 3 µm ~ $x$ # \\n ± − – > 2×10³ μ γ ² ° ·"
    failed = record("net", status="error", scene="teeth")
    given = [record(odd), record("b", scene="teeth"), changed(failed, reason=f"{odd}\nand more")]
    sheet = tables.render(given, "tex") + simple(["a"], [["1"]], caption=f"{odd} `--flag {odd}`").latex()
    page = "\\documentclass{article}\\usepackage{booktabs}\\begin{document}" + sheet + "\\end{document}"
    (tmp_path / "page.tex").write_text(page, encoding="utf-8")
    told = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "page.tex"]
    done = subprocess.run(told, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "\nand more" not in sheet  # a comment is one line
    assert done.returncode == 0, done.stdout[-2000:]
    assert (tmp_path / "page.pdf").exists()


def test_latex_heads_name_a_scene_once_over_its_columns():
    text = tables.render([record(), record(scene="teeth")], "tex", ["tissue"])
    head = text[text.index("\\toprule") : text.index("\\midrule")]
    assert head.count("lung") == head.count("teeth") == 1
    assert "\\cmidrule(lr){3-4}\\cmidrule(lr){5-6}" in head


def many(n_scenes, n_seeds=1, methods=("fdk", "nmar", "net"), seed=0):
    """Records with random scores; some runs failed, and some scores are missing."""
    rng = random.Random(seed)
    found = []
    for scene in range(n_scenes):
        for k in range(n_seeds):
            for m in methods:
                psnr = None if rng.random() < 0.1 else rng.gauss(30, 5)
                more = {"status": "error"} if rng.random() < 0.1 else {}
                found.append(record(m, f"s{scene}", psnr, rng.random(), seed=k, **more))
    return found


def test_numbers_are_those_of_a_data_frame():
    """The oracle is pandas, grouping one row for each number."""
    given = many(3, 7)
    rows = [
        {"scene": r.run.scene, "method": r.label, "metric": m, "value": np.nan if v is None else v}
        for r in given
        for score in r.scores.values()
        for m, v in score.values.items()
    ]
    grouped = pd.DataFrame(rows).groupby(["scene", "method", "metric"])["value"]
    expected = grouped.agg(["mean", "std", "count"])
    table = tables.summary(given)
    table = table[table.protocol == "tissue"].set_index(["scene", "method", "metric"])
    assert len(table) == len(expected) == 27 and expected["count"].between(2, 7).all()
    for place, row in expected.iterrows():
        ours = table.loc[place]
        # 7 numbers near 30 are summed in another order: 7 ε of relative error each way; ε = 2.2e-16
        assert ours["mean"] == pytest.approx(row["mean"], rel=4e-15) and ours["n"] == row["count"]
        assert ours["std"] == pytest.approx(row["std"], rel=1e-13)


def test_tables_take_time_in_proportion_to_the_records(tmp_path):
    """Calls are counted, for the clock is no judge: what was done once a scene or once a table grows faster."""

    def calls(n_scenes):
        given = many(n_scenes)
        profile = cProfile.Profile()
        profile.runcall(tables.write, given, tmp_path)
        return pstats.Stats(profile).total_calls

    calls(1)  # imports
    few, many_more = calls(20), calls(80)
    assert many_more < 4.4 * few  # 4 times the scenes, and what a table has once
    assert many_more / len(many(80)) < 800


def test_the_numbers_are_made_once_for_all_tables(tmp_path, monkeypatch):
    made = []
    for where, name in ((tables, "numbers"), (tables, "latest"), (tables, "_tables")):
        whole = getattr(where, name)
        monkeypatch.setattr(where, name, lambda *a, whole=whole, name=name: [made.append(name), whole(*a)][1])
    tables.write(many(2), tmp_path)
    assert sorted(made) == ["_tables", "latest", "numbers"]


ODD_LINES = "\n\r\x0b\x0c\x1c\x85\u2028\u2029"
TEX = "".join(f"{end}\\input{{/etc/passwd}}" for end in ODD_LINES) + "^^M$%#&~_{}<|\\"


def hostile(text):
    """A record, and a failed one, that hold a text wherever theirs are somebody else's."""
    score = Score(
        region=text, reference=text, alignment=text, data_range=1.0, n_voxels=1, values={"psnr3d": 20.0, text: 1.0},
        note=text, volume=text,
    )  # fmt: skip
    scores = {"tissue": score, text: score}
    whole = record(f"fdk{text}", f"lung{text}", inputs=text)
    whole = changed(whole, scores=scores)
    bad = record(f"net{text}", f"lung{text}", inputs=text, status="error")
    return [whole, changed(bad, reason=text, status=text)]


def test_nothing_in_a_record_becomes_tex():
    text = tables.render(hostile(TEX), "tex")
    for line in text.split("\n"):
        assert not set(line) & set(ODD_LINES)
        code = line.replace(r"\%", "").partition("%")[0]  # what TeX reads of it
        assert r"\input" not in code and "^^" not in code
        if not line.startswith("%"):
            assert code.count("{") - code.count(r"\{") == code.count("}") - code.count(r"\}")
    assert text.count(r"\textbackslash{}input") > 20  # it is there, as text
    assert len([line for line in text.splitlines() if line.startswith("%")]) == 2  # a note and a failure


def test_a_page_of_markdown_keeps_its_lines():
    plain, odd = (tables.render(hostile(text), "md") for text in ("x", f"x{ODD_LINES}| --- |"))
    assert odd.count("\n") == plain.count("\n") and not set(odd) & set(ODD_LINES[1:])


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", " =1", "＝1", '=cmd|"/c calc"!A1,"'])
def test_no_cell_of_the_csv_is_a_formula(tmp_path, text):
    given = hostile(text)
    given = [changed(r, label=text * k, scene=text) for k, r in enumerate(given, 1)]
    tables.write(given, tmp_path)
    with (tmp_path / "table.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 + 2 * 6  # two protocols of two metrics, and two runs' costs
    for row in rows:
        assert None not in row  # as many cells as columns
        texts = [row[k] for k in ("scene", "method", "inputs", "status", "volume", "protocol", "metric")]
        assert not any(t.strip()[:1] in tuple("=+-@＝") for t in texts if t), row
        assert row["mean"] == "" or float(row["mean"]) is not None


def test_numbers_stay_numbers_in_the_csv(tmp_path):
    given = [record("fdk", psnr=20.0), record("bad", psnr=-19.5), record("tiny", psnr=1e-300)]
    tables.write(given, tmp_path)
    frame = pd.read_csv(tmp_path / "table.csv").set_index(["method", "protocol", "metric"])["mean"]
    assert frame["bad", "tissue", "psnr3d"] == -19.5 and frame["bad", "against", "over_fdk"] == -39.5
    assert frame["tiny", "tissue", "psnr3d"] == 1e-300


@pytest.mark.parametrize("value", [1e308, -1e308, 5e-324, -0.0, 1e22])
def test_absurd_values_are_shown_and_crash_nothing(tmp_path, value):
    given = [
        record("fdk", psnr=20.0),
        *(record("net", psnr=v, rmse=value, seed=k) for k, v in enumerate((value, -value))),
    ]
    given += [record("nmar", psnr=value, rmse=value, seed=k) for k in range(2)]
    given += [record("nmar", scene="teeth", psnr=value)]
    given = [changed(r, place=(-(10**25), 10**25)) for r in given]
    tables.write(given, tmp_path)
    frame = pd.read_csv(tmp_path / "table.csv").set_index(["scene", "method", "protocol", "metric"])["mean"]
    assert frame["lung", "nmar", "tissue", "psnr3d"] == value and frame["lung", "net", "tissue", "psnr3d"] == 0.0
    assert records.latest(given)


def soft(record, rmse, bone=0.0):
    """Add what the protocols `soft` and `structure` say."""
    blank = record.scores["tissue"]
    more = {"soft": {"rmse": rmse}, "structure": {"false_bone": bone, "false_air": bone / 2}}
    scores = {p: msgspec.structs.replace(blank, values=values) for p, values in more.items()}
    return changed(record, scores=record.scores | scores)


def test_the_cost_of_metal_is_against_the_own_twin_and_the_best_fdk_of_the_twin():
    """A method that erases detail in both scans loses nothing against itself, and much against FDK."""
    given = [
        soft(record("fdk", psnr=20.0), 300.0), soft(record("fdk", psnr=26.0, variant="metal_free"), 90.0),
        soft(record("fdk-ramp", psnr=15.0), 500.0), soft(record("fdk-ramp", psnr=27.0, variant="metal_free"), 100.0),
        soft(record("fdk-like", psnr=10.0), 500.0), soft(record("fdk-like", psnr=99.0, variant="metal_free"), 1.0),
        soft(record("flat", psnr=19.0), 250.0), soft(record("flat", psnr=19.0, variant="metal_free"), 250.0),
        soft(record("late", psnr=25.0), 80.0),
    ]  # fmt: skip
    table = tables.summary(given).set_index(["method", "protocol", "metric"])["mean"]
    found = {who: [table.get((who, "metal_cost", m)) for m in ("own_db", "fdk_db", "own_hu", "fdk_hu")] for who in
             ("fdk", "fdk-ramp", "flat", "late")}  # fmt: skip
    assert found == {
        "fdk": [6.0, 7.0, 210.0, 210.0],
        "fdk-ramp": [12.0, 12.0, 400.0, 410.0],
        "flat": [0.0, 8.0, 0.0, 160.0],
        "late": [None, 2.0, None, -10.0],
    }


def test_the_main_table_has_what_matters_of_each_scene_and_their_mean():
    given = [
        soft(record(who, scene, psnr=psnr, variant=variant), 100.0, 0.25)
        for scene in ("lung", "teeth")
        for who, psnr in (("fdk", 20.0), ("net", 23.0))
        for variant in ("metal", "metal_free")
    ]
    text = tables.render(given, "md")
    assert (
        text.index("## main: lung")
        < text.index("## main: teeth")
        < text.index("## main: mean")
        < text.index("## tissue")
    )
    heads = ["PSNR3D (dB)", "SSIM3D", "cost of metal (dB)", "short of FDK without metal (dB)", "false bone (%)"]
    for scene in ("lung", "teeth", "mean"):
        part = text[text.index(f"## main: {scene}") :]
        assert cells(part, "| inputs")[2:] == [*heads, "false air (%)", "soft tissue RMSE (HU)", "wall (s)"]
        row = [cell.strip("*") for cell in cells(part, "| counts only | net")[2:8]]
        assert row == ["23.00", "0.500", "0.00", "-3.00", "25.00", "12.50"]


def test_scenes_whose_range_differs_are_to_be_compared_in_hu():
    wide = record(scene="wide")
    other = msgspec.structs.replace(wide.scores["tissue"], data_range=0.05)
    assert "compare scenes by HU" not in tables.render([record(), record(scene="teeth")], "md")
    assert "compare scenes by HU" in tables.render([record(), changed(wide, scores={"tissue": other})], "md")


def test_no_anchored_score_where_the_metal_hardly_matters():
    """FDK loses 24 % of its error here, then 26 %: the least that counts is a quarter."""
    for rmse, expected in ((0.124, False), (0.126, True)):
        given = [record(rmse=rmse), record(rmse=0.1, variant="metal_free"), record("net", rmse=0.2)]
        there = tables.summary(given).set_index(["method", "protocol", "metric"]).index
        assert (("net", "anchored", "tissue/rmse") in there) is expected


def test_nor_of_an_artefact():
    """The error of an artefact is 0 without metal, so that of the tissue says whether the metal matters."""
    for rmse, expected in ((0.124, False), (0.126, True)):
        given = [artefact_record("fdk", 80.0, rmse=rmse), record(rmse=0.1, variant="metal_free")]
        for twin in ([], given[1:]):
            table = tables.summary([given[0], *twin, artefact_record("net", 20.0)])
            there = table.set_index(["method", "protocol", "metric"]).index
            assert (("net", "anchored", "artefact/streak") in there) is (expected and bool(twin))
