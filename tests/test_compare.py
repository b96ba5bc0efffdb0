import pytest

from ctsim.benchmarks.scores.score import SeedValue, anchored, derived, harm, row_of


def row(method, metric, value, *, variant="metal", protocol="tissue", **more):
    base = {"scene": "lung", "seed": 0, "inputs": "counts only"}
    said = {"variant": variant, "method": method, "protocol": protocol, "metric": metric, "value": value}
    return SeedValue(**{**base, **said, **more})


def found(rows):
    return {(r.method, r.seed, r.protocol, r.metric): r.value for r in derived(rows)}


def test_similarity_is_anchored_as_an_error():
    rows = [row("fdk", "ssim3d", 0.5), row("fdk", "ssim3d", 0.9, variant="metal_free"), row("net", "ssim3d", 0.8)]
    # errors 0.5, 0.1 and 0.2: s = 0.1 / 0.4
    assert found(rows)["net", 0, "anchored", "tissue/ssim3d"] == pytest.approx(0.25)


def test_there_is_no_score_where_the_metal_did_no_harm():
    assert anchored(0.3, 0.2, 0.2) is None and anchored(0.3, 0.2, 0.1) is None
    assert anchored(0.1, 0.2, 0.4) == pytest.approx(-0.5)


def test_seeds_and_scenes_are_not_mixed():
    rows = [row("fdk", "psnr3d", 20.0), row("net", "psnr3d", 23.0), row("net", "psnr3d", 30.0, seed=1)]
    rows += [row("net", "psnr3d", 30.0, scene="teeth")]
    scores = found(rows)
    assert scores["net", 0, "against", "over_fdk"] == 3.0 and ("net", 1, "against", "over_fdk") not in scores


def test_only_runs_that_ended_well_are_compared():
    rows = [row("fdk", "psnr3d", 20.0), row("net", "psnr3d", 23.0, status="diverged"), row("a", "psnr3d", None)]
    assert set(found(rows)) == {("fdk", 0, "against", "over_fdk")}
    rows[0] = rows[0]._replace(status="diverged")
    assert found(rows) == {}


def test_harm_names_its_scenes():
    assert harm([0.5, 1.5, 2.0]) == (pytest.approx(2 / 3), "0.67 (2/3)")
    assert harm([1.0, 1.0]) == (0.0, "0.00 (0/2)")
    assert harm([None, 2.0]) == (None, "1.00 (1/1)")
    assert harm([None]) == (None, "–")


def test_the_row_to_compare_with():
    assert row_of("nmar", ["nmar[mask=auto]", "nmar"]) == "nmar"
    assert row_of("nmar", ["fdk", "nmar-oracle", "nmar[a=1]"]) == "nmar[a=1]"
    assert row_of("nmar", ["fdk", "nmarlite"]) is None
