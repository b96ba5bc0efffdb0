import pandas as pd
import pytest

from benchmarks import tables
from benchmarks.protocol import Score
from benchmarks.records import Cost, Record, Run
from benchmarks.texts import escape, ranked
from ctsim.errors import InputError


def record(method="fdk", scene="lung", psnr=20.0, rmse=0.1, inputs="counts only", **more):
    run = Run(
        scene=scene, scene_id="a", scan="b", seed=more.pop("seed", 0), method=method, params={},
        variant=more.pop("variant", "metal"),
    )  # fmt: skip
    score = Score(
        region="the tissue", reference="50 keV", alignment="none", data_range=0.0234, n_voxels=9,
        identical=psnr is None, values={"psnr3d": psnr, "ssim3d": 0.5, "rmse": rmse},
    )  # fmt: skip
    status = more.pop("status", "ok")
    cost = Cost(wall=1.5, cpu=2.5, peak_bytes=2**21, view_updates=60, device="cpu")
    failed = {"scores": {}, "reason": "out | of luck"} if status != "ok" else {"scores": {"tissue": score}}
    return Record(identity=run.identity, run=run, label=method, inputs=inputs, status=status, cost=cost, **failed)


def cells(text, start):
    line = next(line for line in text.splitlines() if line.startswith(start))
    return [c.strip() for c in line.strip("|").split("|")]


def test_mean_and_std_over_seeds():
    text = tables.render([record(psnr=20.0), record(psnr=22.0, seed=1)], "md")
    # std with ddof = 1 of 20 and 22 is √2.
    assert "21.00 ± 1.41" in text


def test_ranks_stay_within_an_input_class():
    given = [record("a", psnr=20.0), record("b", psnr=25.0), record("c", psnr=30.0), record("d", 50, inputs="mask")]
    given[3] = record("d", psnr=50.0, inputs="mask")
    text = tables.render(given, "md")
    assert cells(text, "| counts only | a")[2] == "20.00"
    assert cells(text, "| counts only | b")[2] == "<u>25.00</u>"
    assert cells(text, "| counts only | c")[2] == "**30.00**"
    assert cells(text, "| mask | d")[2] == "50.00"


def test_ranked_knows_directions_and_ties():
    assert ranked([1.0, 3.0, 2.0], "max") == {1: "best", 2: "second"}
    assert ranked([1.0, 3.0, 2.0], "min") == {0: "best", 2: "second"}
    assert ranked([0.8, 1.1, 1.5], "one") == {1: "best", 0: "second"}
    assert ranked([2.0, 2.0, None, 1.0], "max") == {0: "best", 1: "best", 3: "second"}
    assert ranked([1.0, 2.0], "") == {} and ranked([1.0, None], "max") == {}


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
    text = tables.render(given, "md")
    assert cells(text, "| counts only | a")[-2:][0] == "25.00"
    assert cells(text, "| counts only | b")[-2:] == ["–", "–"]


def test_identical_is_named():
    assert "identical" in tables.render([record(psnr=None, rmse=0.0)], "md")


def test_gain_and_anchored_score():
    given = [
        record("fdk", psnr=20.0, rmse=0.5),
        record("fdk", rmse=0.1, psnr=34.0, variant="metal_free"),
        record("nmar", psnr=26.0, rmse=0.2, inputs="mask"),
        record("bad", psnr=19.0, rmse=0.7, inputs="mask"),
    ]
    table = tables.summary(given).set_index(["variant", "method", "protocol", "metric"])["mean"]
    assert table["metal", "fdk", "against", "anchored"] == pytest.approx(1.0)
    assert table["metal", "nmar", "against", "anchored"] == pytest.approx(0.25)
    assert table["metal", "nmar", "against", "over_fdk"] == pytest.approx(6.0)
    assert table["metal", "bad", "against", "over_nmar"] == pytest.approx(-7.0)
    assert table["metal", "bad", "against", "harm"] == 1 and table["metal", "nmar", "against", "harm"] == 0
    assert "metal_free" not in tables.render(given, "md")


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
