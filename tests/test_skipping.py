"""`run-benchmark skipping`: both ways of every pair do what they say, and a difference beyond what is stated shows."""

import math
from typing import get_args

import numpy as np
import pytest

from ctsim.beam.spectrum import Tube
from ctsim.beam.spot import FocalSpot, OffFocal
from ctsim.benchmarks import cli, make_dataset
from ctsim.benchmarks.engine import host
from ctsim.benchmarks.engine.record import Record, latest
from ctsim.benchmarks.studies.skipping import effects as skipping_effects
from ctsim.benchmarks.studies.skipping import methods as skipping_methods
from ctsim.benchmarks.studies.skipping import simulator as skipping_cases
from ctsim.benchmarks.studies.skipping import study as skipping
from ctsim.benchmarks.studies.skipping.simulator import Bench, Pair, image_difference, largest
from ctsim.benchmarks.studies.skipping.study import Skip
from ctsim.detector.panel import Blur, Lag
from ctsim.detector.response import Detector
from ctsim.phantoms.scene import build
from ctsim.scatter import Scatter, open_fraction
from ctsim.simulate import Simulator
from ctsim.tracer.bricks import MIXED
from ctsim.tracer.project import Tracer, transmit_all

pytestmark = pytest.mark.slow

CASES = get_args(skipping.Case)


def found(folder):
    """Return what was found last of every case: {case: rows}."""
    study = skipping.Skipping()
    return {r.task.case: r.found for r in latest(study.store(skipping.Flags(results=folder)).read())}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The command on tiny grids: exit code, what it found, and its folder. A process for each case takes a minute."""
    folder = tmp_path_factory.mktemp("skipping")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(skipping.Skipping, "isolated", False)
        code = skipping.main([str(folder), "--size", "small", "--repeats", "1"])
    return code, found(folder), folder


@pytest.fixture
def here(monkeypatch):
    """Cases are measured in this process, where they can be replaced."""
    monkeypatch.setattr(skipping.Skipping, "isolated", False)


def small(tmp_path):
    return Bench(size="small", repeats=1, folder=tmp_path)


def pairs(case, tmp_path):
    every = skipping_cases.CASES | skipping_effects.CASES | skipping_methods.CASES
    return list(every[case](small(tmp_path)))


def fake(difference, limit=1.0):
    return Pair(
        scene="none",
        what="nothing",
        skipping=lambda: 0.0,
        whole=lambda: 0.0,
        difference=lambda a, b: difference,
        unit="P",
        limit=limit,
    )


def test_every_case_is_measured_and_stays_within_what_is_stated(run):
    code, cases, folder = run
    assert code == 0
    assert tuple(cases) == CASES == tuple(skipping.SECONDS)
    every = skipping_cases.CASES | skipping_effects.CASES | skipping_methods.CASES
    assert every.keys() == set(CASES)
    rows = [row for rows in cases.values() for row in rows]
    assert all(len(row.seconds["skipping"]) == len(row.seconds["whole"]) == 1 for row in rows)
    for exact in ("twin", "truth", "metal-free", "scan", "record"):
        assert all(row.difference == row.limit == 0 for row in cases[exact]), exact
    # fewer energies and no scatter are seen in the result, or the two ways were the same
    (energies,) = cases["energies"]
    assert 0 < energies.difference <= energies.limit < 2e-4
    for choice in (*cases["scatter"], *cases["refining"]):
        assert choice.difference > 1e-3 and choice.limit is None
    text = (folder / "skipping.md").read_text(encoding="utf-8")
    assert all(f"| {case} |" in text for case in CASES) and "Grids this small" in text and "NO" not in text


def test_a_pixel_that_is_off_by_a_thousandth_is_found(here, tmp_path, monkeypatch, capsys):
    def off(tracer, *given, **more):
        found = transmit_all(tracer, *given, **more)
        found[0][:, 5, 7] *= 1.001 if tracer.skip else 1.0
        return found

    monkeypatch.setattr("ctsim.signals.transmit_all", off)
    given = [str(tmp_path), "--case", "rays", "--size", "small", "--repeats", "1"]
    assert skipping.main(given) == 1
    assert "| NO |" in capsys.readouterr().out
    assert all(row.limit < 2e-4 for row in found(tmp_path)["rays"])


@pytest.mark.parametrize("difference", [2.0, math.nan, math.inf])
def test_a_difference_beyond_what_is_stated_ends_with_one(here, tmp_path, monkeypatch, capsys, difference):
    monkeypatch.setitem(skipping_cases.CASES, "rays", lambda setup: iter([fake(0.5), fake(difference)]))
    assert skipping.main([str(tmp_path), "--case", "rays", "--repeats", "2"]) == 1
    assert "| NO |" in capsys.readouterr().out
    (good, bad) = found(tmp_path)["rays"]
    assert good.ok and not bad.ok and bad.difference == (2.0 if difference == 2.0 else None)
    monkeypatch.setitem(skipping_cases.CASES, "rays", lambda setup: iter([fake(0.5), fake(9.0, limit=None)]))
    assert skipping.main([str(tmp_path), "--case", "rays", "--repeats", "2", "--force"]) == 0
    out = capsys.readouterr().out
    assert "NO" not in out and out.count("| rays |") == 2  # the newest run alone


def test_a_twin_that_keeps_metal_on_open_detector_is_found(here, tmp_path, monkeypatch, capsys):
    """Plant what once was wrong: columns in which the body without metal meets nothing kept the scan with metal."""

    def leaving(tracer, geometry, view, response, *, background, out=None, **rays):
        before = None if out is None else [image.copy() for image in out[:2]]
        found = transmit_all(tracer, geometry, view, response, background=background, out=out, **rays)
        if before is not None:
            empty = background[1:].sum(0) == 0
            for image, old in zip(found, before, strict=True):
                image[:, empty] = old[:, empty]
        return found

    monkeypatch.setattr("ctsim.signals.transmit_all", leaving)
    given = [str(tmp_path), "--case", "twin", "--case", "rays", "--size", "small", "--repeats", "1"]
    assert skipping.main(given) == 1
    capsys.readouterr()
    held = {(case, row.scene): row.ok for case, rows in found(tmp_path).items() for row in rows}
    assert held == {
        ("twin", "lung-Fe"): True,
        ("twin", "chicken-Fe"): False,
        ("rays", "lung-Fe"): True,
        ("rays", "chicken-Fe"): False,
    }


def test_a_row_tells_both_ways_and_what_is_left_takes_as_long(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(host, "commit", lambda: "a" * 40)
    study, given = skipping.Skipping(), skipping.Flags(results=tmp_path, repeats=3, case=("rays", "twin"))
    rays, _ = study.tasks(given)
    # the times of neighbouring runs are 2, 3 and 2 times as long without the skip
    seconds = {"skipping": (1.0, 2.0, 3.0), "whole": (2.0, 6.0, 6.0)}
    pair = Skip(seconds=seconds, scene="s", what="w", difference=0.25, unit="P", limit=0.5, stated="rounding", note="n")
    other = Skip(ok=False, seconds=seconds, scene="s", what="w", unit="P", limit=0.0, stated="exact")
    record = Record[Skip](task=rays, found=(pair, other), host=host.host(), commit="a" * 40, time="2026-01-01")
    study.store(given).append([record])
    words = [str(tmp_path), "--case", "rays", "--case", "twin", "--repeats", "3"]
    assert skipping.main([*words, "--dry-run", "--force"]) == 0
    listed = [line.split() for line in capsys.readouterr().out.splitlines()]
    # medians of 2 s and 6 s for each of the pairs, three runs that count and one that does not; 4 x 2.6 s of SECONDS
    assert listed[0] == ["rays", "64", "s"] and listed[1] == ["twin", "10", "s"]
    assert skipping.main([*words, "--table"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert "| rays | w | s | 2.0000 | 6.0000 | 2.00 | 0.25 P | ≤ 0.5 (rounding) | yes | n |" in lines
    assert "| rays | w | s | 2.0000 | 6.0000 | 2.00 | not finite | exact | NO |  |" in lines
    # of grids that were never timed
    assert skipping.main([*words, "--dry-run", "--size", "small"]) == 0
    assert capsys.readouterr().out.splitlines()[1].split() == ["twin", "unknown"]
    monkeypatch.setattr("sys.argv", ["run-benchmark", "skipping", *words, "--table", "--size", "small"])
    assert cli.run_benchmark() == cli.EXIT_USER and "no records to show" in capsys.readouterr().err


def test_a_case_that_there_is_not_is_refused(tmp_path):
    with pytest.raises(SystemExit):
        skipping.main([str(tmp_path), "--case", "nothing"])


def test_an_interrupted_make_dataset_interrupts_the_command():
    with pytest.raises(KeyboardInterrupt):
        skipping_methods.quietly(lambda words: cli.EXIT_INTERRUPTED)


def test_arrays_that_are_not_finite_are_apart():
    one, bad = np.ones(3, np.float32), np.array([1, np.nan, 1], np.float32)
    assert largest([one], [one]) == 0
    assert math.isnan(largest([one, one], [one, bad]))
    # unsigned counts do not wrap around
    assert largest([np.array([1], np.uint16)], [np.array([3], np.uint16)]) == 2
    with pytest.raises(ValueError, match="nothing to compare"):
        largest([], [])


def test_bricks_with_nothing_left_out_hold_the_same_labels(tmp_path):
    phantom = build(small(tmp_path).scene())
    whole, usual = skipping_cases.all_mixed(phantom), Tracer.of(phantom).bricks
    assert (whole.code & 255 == MIXED).all() and not (usual.code & 255 == MIXED).all()
    z, y, x = (n // 4 for n in phantom.labels.shape)
    assert np.array_equal(whole.slot.ravel(), np.arange(z * y * x))  # bricks are kept, in order
    back = whole.pool.reshape(z, y, x, 4, 4, 4).transpose(0, 3, 1, 4, 2, 5).reshape(phantom.labels.shape)
    assert np.array_equal(back, phantom.labels)
    assert np.array_equal(whole.grid, usual.grid)


def test_sub_rays_are_cast_everywhere_in_the_way_without_the_skip(tmp_path):
    (edges,) = pairs("edges", tmp_path)
    # with all sub-rays wherever the thickness of a solid varies, many more pixels differ from their central ray
    few, every = edges.skipping(), edges.whole()
    changed = np.mean([np.mean(a != b) for a, b in zip(few, every, strict=True)])
    assert changed > 0.1


def test_the_stated_difference_of_scatter_is_its_fraction(tmp_path):
    pair, *_ = pairs("scatter", tmp_path)
    setup = small(tmp_path)
    fraction = open_fraction(Scatter(level=1), setup.planned().scanner.geometry)
    assert fraction > 0.005
    for without, lit in zip(pair.skipping(), pair.whole(), strict=True):
        lifted = np.exp(-lit["noise_free"].astype(np.float64)) - np.exp(-without["noise_free"].astype(np.float64))
        # signals up to 1 and their logarithms, each rounded to float32 a few times
        np.testing.assert_allclose(lifted, fraction, rtol=0, atol=1e-6)


EFFECTS = {
    "scatter 1": {"scatter": Scatter(level=1)},
    "scatter 3": {"scatter": Scatter(level=3)},
    "anti-scatter grid": {"scatter": Scatter(level=3, grid_ratio=10.0)},
    "focal spot": {"tube": Tube(focal_spot=FocalSpot(size=(3.0, 3.0)))},
    "off-focal": {"tube": Tube(off_focal=OffFocal(share=0.1, fwhm=9.0))},
    "falloff": {"tube": Tube(falloff=True)},
    "detector blur": {"detector": Detector(blur=Blur(fwhm=3.0))},
    "lag": {"detector": Detector(lag=(Lag(share=0.1, decay=0.1),))},
}


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_that_is_off_runs_none_of_its_code(tmp_path, monkeypatch, name):
    """The plan says so, and the counts are the same where that code cannot run."""
    setup = small(tmp_path)
    scan, given = setup.planned(), setup.planned(**EFFECTS[name])
    assert given.plan.runs(name) and not scan.plan.runs(name)
    off = [stage.reason for stage in scan.plan.stages if stage.name == name.removesuffix(" 1").removesuffix(" 3")]
    assert off == ["off"]
    before = [images for _, images in scan.views()]

    def never(*arguments, **more):
        raise RuntimeError("this was to be left out")

    monkeypatch.setattr("ctsim.simulate.scatter_series", never)
    monkeypatch.setattr("ctsim.readout.Panel", never)
    monkeypatch.setattr("ctsim.beam.spot.SubSources.geometry", never)
    if name in ("focal spot", "off-focal", "detector blur", "lag", "scatter 3", "anti-scatter grid"):
        with pytest.raises(RuntimeError, match="left out"):
            next(given.views())
    simulator = Simulator(scan.plan, scan.phantom, scan.scanner)
    assert scan.plan.spot is None and scan.plan.scatter_fraction == 0
    assert simulator.beam.gain is None and simulator.frames == 0
    assert image_difference(before, [images for _, images in scan.views()]) == 0


def test_a_sharp_panel_and_a_point_change_no_line_integral(tmp_path):
    neutral, *_ = pairs("blurs", tmp_path)
    without, through = neutral.skipping(), neutral.whole()
    assert image_difference(without, through, skipping_cases.P_IMAGES) == 0
    assert neutral.difference(without, through) <= neutral.limit


@pytest.mark.parametrize("name", ["limar", "nmar"])
def test_without_a_look_at_metal_all_is_projected_and_reconstructed(tmp_path, monkeypatch, name):
    calls = []
    for where in ("fdk_stream", "forward_columns"):
        real = getattr(skipping_methods, where)

        def counted(*arguments, real=real, where=where, **more):
            calls.append(where)
            return real(*arguments, **more)

        monkeypatch.setattr(skipping_methods, where, counted)
    pair = pairs("metal-free", tmp_path)[("limar", "nmar").index(name)]
    first = pair.skipping()
    assert not calls
    assert pair.difference(first, pair.whole()) == 0
    assert set(calls) == ({"fdk_stream"} if name == "limar" else {"fdk_stream", "forward_columns"})


def test_a_command_that_fails_is_not_taken_for_a_fast_one(tmp_path):
    with pytest.raises(RuntimeError, match="no such scene"):
        skipping_methods.quietly(make_dataset.main, "core", tmp_path, "--only", "none")
