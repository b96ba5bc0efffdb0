"""`run-benchmark skipping`: both ways of every pair do what they say, and a difference beyond what is stated shows."""

import math

import msgspec
import numpy as np
import pytest

from ctsim.benchmarks import cli, make_dataset
from ctsim.benchmarks.engine import host, lines
from ctsim.benchmarks.studies.skipping import methods as skipping_methods
from ctsim.benchmarks.studies.skipping import simulator as skipping_cases
from ctsim.benchmarks.studies.skipping import study as skipping
from ctsim.benchmarks.studies.skipping import tables as skipping_tables
from ctsim.benchmarks.studies.skipping.simulator import Pair, Setup
from ctsim.bricks import MIXED
from ctsim.errors import InputError
from ctsim.phantoms.scene import build
from ctsim.project import Tracer, transmit
from ctsim.scatter import Scatter, open_fraction


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The command on tiny grids: exit code, records, and its folder."""
    folder = tmp_path_factory.mktemp("skipping")
    code = skipping.main([str(folder), "--size", "small", "--repeats", "1"])
    return code, skipping_tables.read(folder / skipping.NAME), folder


@pytest.fixture
def here(monkeypatch):
    """Cases are measured in this process, where they can be replaced."""
    monkeypatch.setattr("ctsim.benchmarks.engine.limited.Limited.run", lambda self, function, *given: function(*given))


def small(tmp_path):
    return Setup(size="small", repeats=1, folder=tmp_path)


def pairs(case, tmp_path):
    return list((skipping_cases.CASES | skipping_methods.CASES)[case](small(tmp_path)))


def fake(difference, limit=1.0, case="rays"):
    return Pair(
        case=case,
        scene="none",
        what="nothing",
        skipping=lambda: 0.0,
        whole=lambda: 0.0,
        difference=lambda a, b: difference,
        unit="P",
        limit=limit,
    )


def test_every_case_is_measured_and_stays_within_what_is_stated(run):
    code, records, folder = run
    assert code == 0
    assert tuple(dict.fromkeys(r.measured.case for r in records)) == skipping.CASES
    assert skipping_cases.CASES.keys() | skipping_methods.CASES.keys() == set(skipping.CASES)
    assert all(len(r.measured.skipping) == len(r.measured.whole) == 1 and r.commit for r in records)
    by = {r.measured.case: r.measured for r in records}
    for exact in ("twin", "truth", "metal-free", "scan", "record"):
        assert by[exact].difference == by[exact].limit == 0
    # fewer energies and no scatter are seen in the result, or the two ways were the same
    assert 0 < by["energies"].difference <= by["energies"].limit < 2e-4
    assert by["scatter"].difference > 1e-3 and by["scatter"].limit is None
    assert by["refining"].difference > 1e-3 and by["refining"].limit is None
    text = (folder / "skipping.md").read_text(encoding="utf-8")
    assert all(f"| {case} |" in text for case in skipping.CASES) and "Grids this small" in text and "NO" not in text


def test_a_pixel_that_is_off_by_a_thousandth_is_found(here, tmp_path, monkeypatch, capsys):
    def off(tracer, *given, **more):
        found = transmit(tracer, *given, **more)
        found[0][5, 7] *= 1.001 if tracer.skip else 1.0
        return found

    monkeypatch.setattr("ctsim.simulate.transmit", off)
    given = [str(tmp_path), "--case", "rays", "--size", "small", "--repeats", "1"]
    assert skipping.main(given) == 1
    assert "| NO |" in capsys.readouterr().out
    assert all(r.measured.limit < 2e-4 for r in skipping_tables.read(tmp_path / skipping.NAME))


@pytest.mark.parametrize("difference", [2.0, math.nan, math.inf])
def test_a_difference_beyond_what_is_stated_ends_with_one(here, tmp_path, monkeypatch, capsys, difference):
    monkeypatch.setitem(skipping_cases.CASES, "rays", lambda setup: iter([fake(0.5), fake(difference)]))
    assert skipping.main([str(tmp_path), "--case", "rays", "--repeats", "2"]) == 1
    assert "| NO |" in capsys.readouterr().out
    found = skipping_tables.read(tmp_path / skipping.NAME)
    assert [r.measured.held for r in found] == [True, False]
    monkeypatch.setitem(skipping_cases.CASES, "rays", lambda setup: iter([fake(0.5), fake(9.0, limit=None)]))
    assert skipping.main([str(tmp_path), "--case", "rays", "--repeats", "2", "--force"]) == 0
    out = capsys.readouterr().out
    assert "NO" not in out and out.count("| rays |") == 2  # the newest run alone


def test_a_twin_that_keeps_metal_on_open_detector_is_found(here, tmp_path, monkeypatch, capsys):
    """Plant what once was wrong: columns in which the body without metal meets nothing kept the scan with metal."""

    def leaving(tracer, geometry, view, response, *, background, out=None, **rays):
        before = None if out is None else [image.copy() for image in out[:2]]
        found = transmit(tracer, geometry, view, response, background=background, out=out, **rays)
        if before is not None:
            empty = background[1:].sum(0) == 0
            for image, old in zip(found, before, strict=True):
                image[empty] = old[empty]
        return found

    monkeypatch.setattr("ctsim.simulate.transmit", leaving)
    given = [str(tmp_path), "--case", "twin", "--case", "rays", "--size", "small", "--repeats", "1"]
    assert skipping.main(given) == 1
    capsys.readouterr()
    held = {
        (r.measured.case, r.measured.scene): r.measured.held for r in skipping_tables.read(tmp_path / skipping.NAME)
    }
    assert held == {
        ("twin", "lung-Fe"): True,
        ("twin", "chicken-Fe"): False,
        ("rays", "lung-Fe"): True,
        ("rays", "chicken-Fe"): False,
    }


def test_an_interrupted_command_goes_on_from_the_case_it_was_in(here, tmp_path, monkeypatch, capsys):
    done = []

    def once(setup):
        done.append("rays")
        yield fake(0.0)

    def interrupted(setup):
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr(host, "commit", lambda: "a" * 40)
    monkeypatch.setitem(skipping_cases.CASES, "rays", once)
    monkeypatch.setitem(skipping_cases.CASES, "energies", interrupted)
    words = [str(tmp_path), "--case", "rays", "--case", "energies", "--repeats", "2"]
    monkeypatch.setattr("sys.argv", ["run-benchmark", "skipping", *words])
    assert cli.run_benchmark() == cli.EXIT_INTERRUPTED
    assert len(skipping_tables.read(tmp_path / skipping.NAME)) == 1
    monkeypatch.setitem(skipping_cases.CASES, "energies", lambda setup: iter([fake(5.0, case="energies")]))
    assert cli.run_benchmark() == 1 and done == ["rays"]
    assert "rays: recorded already" in capsys.readouterr().err
    assert cli.run_benchmark() == 1  # what is recorded is judged again
    for change in (["--force"], ["--size", "small"], ["--repeats", "3"]):
        before = len(done)
        skipping.main([*words, *change])
        assert len(done) == before + 1, change
    monkeypatch.setattr(host, "commit", lambda: "a" * 40 + "+changes")
    before = len(done)
    assert [skipping.main(words), skipping.main(words)] == [1, 1] and len(done) == before + 2


def test_a_dry_run_lists_what_is_left_and_what_it_takes(tmp_path, monkeypatch, capsys):
    def dry(*words):
        assert skipping.main([*words, "--dry-run"]) == 0
        return [line.split() for line in capsys.readouterr().out.splitlines()]

    monkeypatch.setattr(host, "commit", lambda: "a" * 40)
    out = tmp_path / "out"
    assert tuple(skipping.SECONDS) == skipping.CASES
    listed = dry(str(out), "--repeats", "4")
    assert [line[0] for line in listed[:-1]] == list(skipping.CASES) and not out.exists()
    assert listed[-2] == ["record", "5", "runs", "both", "ways", "24", "s"]  # 5 × 4.8 s
    assert listed[-1][:4] == ["total:", str(len(skipping.CASES)), "of", str(len(skipping.CASES))]
    assert dry(str(out), "--size", "small", "--case", "rays")[0][-1] == "unknown"  # of grids that were never timed

    # two pairs of 2 s and 4 s: 12 s a turn, by their records
    out.mkdir()
    one = skipping_tables.Measured(
        case="rays", scene="none", what="nothing", skipping=(2.0,) * 2, whole=(4.0,) * 2, difference=0.0, unit="P",
        limit=0.0, stated="exact",
    )  # fmt: skip
    for code in ("a", "b"):
        record = skipping_tables.SkipRecord(
            measured=one, size="core", host=host.host(), commit=code * 40, time="now", run=code
        )
        lines.append(out / skipping.NAME, record, record)
    words = [str(out), "--case", "rays", "--case", "twin"]
    (twin, total) = dry(*words, "--repeats", "2")
    assert twin == ["twin", "3", "runs", "both", "ways", "7.8", "s"] and total[1:6] == ["1", "of", "2", "cases,", "7.8"]
    assert dry(*words, "--repeats", "3")[0] == ["rays", "4", "runs", "both", "ways", "48", "s"]
    assert dry(*words, "--repeats", "2", "--force")[0][:2] == ["rays", "3"]


def test_the_table_is_rendered_from_the_records_alone(here, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(skipping_cases.CASES, "rays", lambda setup: iter([fake(2.0)]))
    words = [str(tmp_path), "--case", "rays", "--repeats", "1"]
    assert skipping.main(words) == 1
    (tmp_path / "skipping.md").rename(tmp_path / "first.md")
    monkeypatch.setitem(skipping_cases.CASES, "rays", lambda setup: 1 / 0)
    with (tmp_path / skipping.NAME).open("ab") as file:
        file.write(b'{"measured": {')  # as a kill leaves it
    assert skipping.main([str(tmp_path), "--table"]) == 1
    assert (tmp_path / "skipping.md").read_bytes() == (tmp_path / "first.md").read_bytes()
    capsys.readouterr()
    for none in ([str(tmp_path / "none")], [str(tmp_path), "--size", "small"]):
        monkeypatch.setattr("sys.argv", ["run-benchmark", "skipping", *none, "--table"])
        assert cli.run_benchmark() == cli.EXIT_USER
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and "there are no records of size" in said
    assert not (tmp_path / "none").exists()


def test_a_case_that_overstays_is_a_row_with_its_reason_and_is_tried_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(host, "commit", lambda: "a" * 40)
    words = [str(tmp_path), "--case", "rays", "--case", "twin", "--repeats", "1"]
    # a process cannot even start in that time
    assert skipping.main([*words, "--seconds", "0.01"]) == 1
    out = capsys.readouterr().out
    for case in ("rays", "twin"):
        assert f"| {case} | – | – | – | – | – | – | – | NO | timeout: did not end within 0.01 s |" in out
    assert [r.measured.status for r in skipping_tables.read(tmp_path / skipping.NAME)] == ["timeout"] * 2
    assert skipping.main([*words, "--dry-run"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["rays", "twin", "total:"]
    monkeypatch.setattr("ctsim.benchmarks.engine.limited.Limited.run", lambda self, function, *given: function(*given))
    for case in ("rays", "twin"):
        monkeypatch.setitem(skipping_cases.CASES, case, lambda setup, case=case: iter([fake(0.0, case=case)]))
    assert skipping.main(words) == 0
    said = capsys.readouterr()
    assert "timeout" not in said.out and "recorded already" not in said.err


def test_records_of_other_machines_are_taken_over(tmp_path, capsys):
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    another = msgspec.structs.replace(host.host(), cpu="another processor")
    for folder, case, at, difference in ((ours, "rays", host.host(), 0.0), (theirs, "twin", another, 2.0)):
        folder.mkdir()
        measured = skipping_tables.Measured(
            case=case, scene="none", what="nothing", skipping=(1.0,), whole=(2.0,), difference=difference, unit="P",
            limit=1.0, stated="exact",
        )  # fmt: skip
        record = skipping_tables.SkipRecord(
            measured=measured, size="core", host=at, commit="a" * 40, time=f"2026-01-01T00:00:0{len(case)}", run=case
        )
        lines.append(folder / skipping.NAME, record)
    both = [*skipping_tables.read(ours / skipping.NAME), *skipping_tables.read(theirs / skipping.NAME)]
    for taken in (1, 0):
        assert skipping.main([str(ours), "--collect", str(theirs)]) == 1  # what was measured there is judged too
        said = capsys.readouterr()
        assert f"{theirs}: {taken} records taken over" in said.err
        assert "| rays |" in said.out and "| twin |" in said.out
        assert host.host().cpu in said.out and "another processor" in said.out
    assert skipping_tables.read(ours / skipping.NAME) == both
    with pytest.raises(InputError, match=r"--collect .*none: there are no records"):
        skipping.main([str(ours), "--collect", str(tmp_path / "none")])


def test_an_interrupted_make_dataset_interrupts_the_command():
    with pytest.raises(KeyboardInterrupt):
        skipping_methods.quietly(lambda words: cli.EXIT_INTERRUPTED)


def test_arrays_that_are_not_finite_are_apart():
    one, bad = np.ones(3, np.float32), np.array([1, np.nan, 1], np.float32)
    assert skipping_cases.largest([(one, one)]) == 0
    assert math.isnan(skipping_cases.largest([(one, one), (one, bad)]))
    # unsigned counts do not wrap around
    assert skipping_cases.largest([(np.array([1], np.uint16), np.array([3], np.uint16))]) == 2
    with pytest.raises(ValueError, match="nothing to compare"):
        skipping_cases.largest([])


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
    (pair,) = pairs("scatter", tmp_path)
    setup = small(tmp_path)
    fraction = open_fraction(Scatter(level=1), setup.scanner(setup.scene()).geometry)
    assert fraction > 0.005
    for without, lit in zip(pair.skipping(), pair.whole(), strict=True):
        lifted = np.exp(-lit["noise_free"].astype(np.float64)) - np.exp(-without["noise_free"].astype(np.float64))
        # signals up to 1 and their logarithms, each rounded to float32 a few times
        np.testing.assert_allclose(lifted, fraction, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["limar", "nmar"])
def test_regardless_of_metal_all_is_projected_and_reconstructed(tmp_path, monkeypatch, name):
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


def test_wrong_arguments_are_one_sentence(tmp_path):
    with pytest.raises(InputError, match="--repeats must be at least 1"):
        skipping.main([str(tmp_path), "--repeats", "0"])
    with pytest.raises(InputError, match="seconds must be positive"):
        skipping.main([str(tmp_path / "out"), "--seconds", "-1"])
    assert not (tmp_path / "out").exists()
    with pytest.raises(SystemExit):
        skipping.main([str(tmp_path), "--case", "nothing"])


def test_a_command_that_fails_is_not_taken_for_a_fast_one(tmp_path):
    with pytest.raises(RuntimeError, match="no such scene"):
        skipping_methods.quietly(make_dataset.main, "core", tmp_path, "--only", "none")


def test_a_file_that_holds_something_else_is_named_by_line(tmp_path):
    (tmp_path / skipping.NAME).write_text('{"measured": 1}\n')
    with pytest.raises(InputError, match=r"skipping.jsonl, line 1: expected a record"):
        skipping_tables.read(tmp_path / skipping.NAME)
