"""Which runs come first, what they are said to take, records of several machines, and tables in any order of ends."""

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest
from test_run import double
from test_tables import record

from ctsim.benchmarks.methods import TABLE, Method, find
from ctsim.benchmarks.studies.methods import plan, records, run, study, tables
from ctsim.benchmarks.studies.methods.plan import Costs, ordered
from ctsim.benchmarks.studies.methods.records import RunTask
from ctsim.benchmarks.studies.methods.run import FDKS, fdk_seconds, in_fdks
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.splat.course import ALONE, PASSES
from ctsim.reconstruct.splat.fast import finer

CIRCLE = Geometry(
    dso=100.0,
    dsd=150.0,
    n_voxel=(128, 128, 128),
    d_voxel=(0.2,) * 3,
    n_detector=(512, 512),
    d_detector=(0.15, 0.15),
    n_views=360,
    angles_deg=tuple(float(k) for k in range(360)),
)


def method(name: str) -> Method:
    return Method(name=name, target="test_run:good", inputs="counts only", params={})


def listed(*names: str) -> list[RunTask]:
    """Return the runs of methods on two scans, each with its twin."""
    scans = [double(Path("a")), dataclasses.replace(double(Path("b")), name="crate")]
    return [job.task for job in plan.jobs(scans, [method(name) for name in names], anchor=True)]


def took(name: str, seconds: float, status: str = "ok", **more):
    found = record(name, status=status, **more)
    assert found.cost is not None
    cost = msgspec.structs.replace(found.cost, wall=seconds)
    return msgspec.structs.replace(found, found=(msgspec.structs.replace(found.found[0], cost=cost),))


def order(names: tuple[str, ...], found) -> list[str]:
    groups = ordered(listed(*names), Costs(found))
    assert all([t.part for t in g] == ["metal_free", "metal"] for g in groups)  # the twin, then what it judges
    assert [g[0].place[0] for g in groups] == [0, 1] * len(names)  # a whole row before the next method
    return [g[0].subject for g in groups[::2]]


def test_cheap_methods_come_first():
    known = [took("fdk", 9.0), took("limar", 2.0), took("splat", 800.0)]
    assert order(("splat", "fdk", "limar"), known) == ["limar", "fdk", "splat"]
    # one that never ran counts as dear as the dearest before it in the methods table
    assert order(("splat", "my:method", "nmar", "fdk", "limar"), known) == [
        "limar",
        "fdk",
        "nmar",
        "splat",
        "my:method",
    ]
    assert order(("splat", "my:method", "fdk"), []) == ["fdk", "splat", "my:method"]
    assert order(("b:b", "a:a"), [took("a:a", 1.0, "timeout")]) == ["b:b", "a:a"]  # a failure says nothing of the cost


def test_a_worker_with_other_code_is_refused(smallest, tmp_path):
    given = study.Flags(data=smallest, results=tmp_path)
    task = study.Methods().tasks(given)[0]
    with pytest.raises(InputError, match="a worker has another version"):
        study.Methods().measure(msgspec.structs.replace(task, code="other"), given)


def placed(name: str, scene: str, place: tuple[int, int], **more):
    return record(name, scene, place=place, **more)


def test_tables_do_not_depend_on_which_run_ended_first():
    given = [
        placed(name, scene, (i, k), variant=variant, seed=seed)
        for i, scene in enumerate(("teeth", "lung"))
        for k, name in enumerate(("my:net", "nmar", "fdk", "a:lab"))
        for variant in ("metal_free", "metal")
        for seed in (1, 2)
    ]
    expected = tables.render(given, "md"), tables.summary(given).to_csv()
    for other in (given[::-1], given[::3] + given[1::3] + given[2::3], sorted(given, key=lambda r: r.identity)):
        assert (tables.render(other, "md"), tables.summary(other).to_csv()) == expected
    shown = records.latest(given[::-1])
    assert list(dict.fromkeys(r.run.scene for r in shown)) == ["teeth", "lung"]
    assert list(dict.fromkeys(r.label for r in shown)) == ["fdk", "nmar", "my:net", "a:lab"]


def test_a_method_that_never_ran_is_guessed_from_the_time_of_fdk(smallest, tmp_path, capsys):
    told = [
        str(smallest),
        str(tmp_path / "results"),
        "--dry-run",
        "--no-anchor",
        "--method",
        "fdk",
        "--method",
        "splat",
    ]
    assert study.main(told) == 0
    out = capsys.readouterr().out
    assert "2 of 2 runs" in out and "unknown" not in out and "never measured" not in out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "name, overrides, expected",
    [
        ("fdk", {}, 1.0),
        ("sirt", {"iterations": 7}, 7 * FDKS["sirt"]),
        ("splat", {}, (PASSES[1] + PASSES[0] / 15) * 1.5**3 * FDKS["splat"]),
        ("splat", {"passes": [15, 0], "fineness": 1}, FDKS["splat"]),
        ("splat-r2", {}, 30_000 * FDKS["splat-r2"]),
        ("splat-paper", {"steps": 100}, 100 * FDKS["splat-paper"]),
    ],
)
def test_a_guess_counts_iterations_passes_or_steps(name, overrides, expected):
    found = in_fdks(find(name, overrides), CIRCLE)
    assert found is None if expected is None else found == pytest.approx(expected)


def test_where_a_pass_is_long_splat_is_guessed_with_fewer():
    long = msgspec.structs.replace(CIRCLE, n_views=10_000, angles_deg=None)
    assert in_fdks(find("splat"), long) == pytest.approx((1 + 8 / 15) * 1.5**3 * FDKS["splat"])


def test_a_flat_scan_is_guessed_with_the_passes_over_one_grid():
    flat = msgspec.structs.replace(CIRCLE, n_voxel=(1, *CIRCLE.n_voxel[1:]), d_voxel=(1.0, *CIRCLE.d_voxel[1:]))
    for given, expected in (({}, ALONE), ({"passes": [20, 9]}, 29)):
        found = in_fdks(find("splat", given), flat)
        grid = math.prod(finer(flat, 1.5).n_voxel) / math.prod(flat.n_voxel)
        assert found == pytest.approx(expected * grid * FDKS["splat"])


def test_a_method_that_has_so_many_seconds_is_guessed_to_take_no_more(monkeypatch):
    monkeypatch.setattr(run, "fdk_seconds", lambda geometry: 100.0)
    stored = SimpleNamespace(geometry=CIRCLE)
    told, free = (SimpleNamespace(method=find("splat", given), stored=stored) for given in ({"seconds": 9.0}, {}))
    assert run.estimated(told) == 9.0 < run.estimated(free)


def test_every_method_of_the_table_has_a_guess_and_others_have_none():
    assert set(TABLE) <= set(FDKS)
    assert in_fdks(method("my:method"), CIRCLE) is None


def test_fdk_s_time_is_that_of_a_small_scan_times_what_is_more_of_it(monkeypatch):
    seen = []
    monkeypatch.setattr(run, "fdk", lambda scan: seen.append(scan.geometry))
    fdk_seconds.cache_clear()
    assert fdk_seconds(CIRCLE) > 0
    assert [(g.n_voxel, g.n_views) for g in seen] == [((64, 64, 64), 64)] * 2


def test_the_time_of_fdk_is_found_for_poses_which_fdk_itself_refuses():
    poses = tuple(map(tuple, msgspec.structs.replace(CIRCLE, n_views=9, angles_deg=None).pose_array().tolist()))
    small = {"n_voxel": (8, 8, 8), "n_detector": (8, 8), "n_views": 9, "angles_deg": None, "poses": poses}
    assert fdk_seconds(msgspec.structs.replace(CIRCLE, **small)) > 0
