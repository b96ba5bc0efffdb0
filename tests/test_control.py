"""The controls: what they return, that tables never rank them, and that only the table leads to the metal-free twin."""

import dataclasses
import re

import numpy as np
import pytest
import torch
from test_fdk import GEOMETRY as CIRCLE
from test_fdk import MU, cylinder, make_scan
from test_tables import cells
from test_tables import record as table_record
from test_twins import pair

from ctsim.benchmarks.engine.table import Cell, Column, Table
from ctsim.benchmarks.methods import (
    ASSUMED,
    CONTROL,
    CONTROLS,
    COUNTS_ONLY,
    MASK_AND_SPECTRUM,
    SPECTRUM,
    TABLE,
    TRAINED,
    TRAINED_MASK,
    TWIN,
    find,
)
from ctsim.benchmarks.scores.score import NO_TWIN, row_of
from ctsim.benchmarks.studies.methods import attempt, overview, plan, tables
from ctsim.reconstruct.fdk import fdk, ramp
from ctsim.reconstruct.log import line_integrals
from ctsim.types import Status, Volume

INPUTS = TWIN
"""What this module says of `counted`: a claim that must not open the door to the twin."""


def counted(scan, *, device):
    """The volume is the first count, everywhere."""
    return Volume(values=torch.full(scan.geometry.n_voxel, float(scan.counts[0, 0, 0])))


def test_zero_is_zero_on_the_scans_grid():
    volume = find("zero").reconstruct(make_scan(CIRCLE, 1e4 * torch.exp(-cylinder(CIRCLE))))
    assert tuple(volume.values.shape) == CIRCLE.n_voxel and not volume.values.any() and volume.status is Status.OK


def test_the_hull_of_a_cylinder_is_the_cylinder_and_its_value_the_cylinders():
    volume = find("hull").reconstruct(make_scan(CIRCLE, 1e4 * torch.exp(-cylinder(CIRCLE))))
    inside = volume.values.numpy() != 0
    assert volume.details["voxels"] == inside.sum() > 0
    assert len(np.unique(volume.values.numpy())) == 2
    assert volume.details["attenuation"] == pytest.approx(float(volume.values.max()))
    # closed form: the object's area in the central slice; an edge one voxel off on both sides is 2 · 2 / radius of it
    radius = 20.0 / CIRCLE.d_voxel[1]
    area = inside[CIRCLE.n_voxel[0] // 2].sum()
    assert area == pytest.approx(np.pi * radius**2, rel=4 / radius)
    assert volume.details["attenuation"] == pytest.approx(MU, rel=2 / radius)


def test_the_hulls_value_is_the_least_squares_one():
    """Metal raises P, so that another value would fit worse: the gradient of the misfit by the value is 0."""
    from ctsim.reconstruct.projector import forward

    p = cylinder(CIRCLE)
    p[:, :, 40:50] *= 3
    scan = make_scan(CIRCLE, 1e4 * torch.exp(-p))
    volume = find("hull").reconstruct(scan)
    fitted = forward(volume.values, CIRCLE).double()
    measured, clamped = line_integrals(scan, slice(None))
    fitted[clamped] = 0
    gradient = float((fitted * (measured.double() - fitted)).sum() / (fitted**2).sum())
    assert abs(gradient) < 1e-5  # float32 path lengths


def test_a_pixel_in_which_nothing_was_seen_is_in_the_shadow():
    p = cylinder(CIRCLE)
    scan = make_scan(CIRCLE, 1e4 * torch.exp(-p))
    flat = scan.flat.clone()
    flat[CIRCLE.n_detector[0] // 2, CIRCLE.n_detector[1] // 2] = 0  # a dead pixel, which says nothing
    dead = find("hull").reconstruct(dataclasses.replace(scan, flat=flat))
    whole = find("hull").reconstruct(scan)
    assert dead.details["voxels"] == whole.details["voxels"]


def test_open_beam_has_an_empty_hull_and_says_so():
    volume = find("hull").reconstruct(make_scan(CIRCLE, torch.full(CIRCLE.shape, 1e4)))
    assert not volume.values.any() and "empty" in volume.details["limitation"]


def test_fdk_ramp_is_the_plain_ramp_and_fdk_is_not():
    p = cylinder(CIRCLE)
    scan = make_scan(CIRCLE, 1e4 * torch.exp(-p))
    plain = find("fdk-ramp").reconstruct(scan)
    torch.testing.assert_close(plain.values, fdk(p, CIRCLE, window="ram-lak", cutoff=1.0), rtol=0, atol=1e-6)
    assert (plain.details["window"], plain.details["cutoff"]) == ("ram-lak", 1.0)
    assert torch.equal(plain.values, ramp(scan).values)
    assert not torch.equal(plain.values, find("fdk").reconstruct(scan).values)


def test_all_methods_that_end_in_fdk_share_one_filter():
    filters = {n: (p["window"], p["cutoff"]) for n in TABLE if "window" in (p := find(n).params)}
    learned = {name for name in TABLE if find(name).inputs in (TRAINED, TRAINED_MASK)}
    assert len(learned) == 6
    assert set(filters) == {"fdk", "twin-fdk", "limar", "nmar", "bhc-poly", "water-precorrection", "ibhc", *learned}
    assert len(set(filters.values())) == 1


# --- the twin ------------------------------------------------------------------------------------------


def test_only_the_row_of_the_table_gets_the_twin(tmp_path):
    """The scan holds 1000 counts a pixel, its twin 900."""
    stored = pair(tmp_path)
    for variant in ("metal", "metal_free"):
        assert int(attempt.scan_for(find("twin-fdk"), stored, variant).counts[0, 0, 0]) == 900
    for name in [name for name in TABLE if name != "twin-fdk"]:
        assert int(attempt.scan_for(find(name), stored, "metal").counts[0, 0, 0]) == 1000, name
    own = find("test_control:counted")
    assert own.inputs == TWIN and not own.told_twin
    outcome = attempt.run_here(stored, "metal", own, 0.0)
    assert outcome.values is not None and outcome.values.max() == 1000


def test_no_name_or_target_of_ones_own_opens_the_door(tmp_path):
    """By its target, too, the function of the table is a method of one's own and gets the scan."""
    by_target = find(TABLE["twin-fdk"][0])
    assert not by_target.told_twin
    assert int(attempt.scan_for(by_target, pair(tmp_path), "metal").counts[0, 0, 0]) == 1000


def test_the_twins_row_is_another_run_than_fdk(tmp_path):
    listed = plan.jobs([pair(tmp_path)], [find("fdk"), find("twin-fdk"), find("fdk-ramp")], anchor=True)
    assert len({job.task.identity for job in listed}) == 6


def test_without_a_twin_its_row_is_skipped_with_a_reason(tmp_path):
    stored = dataclasses.replace(pair(tmp_path), metal_free=None)
    outcome = attempt.skip(find("twin-fdk"), stored, "metal")
    assert outcome is not None and outcome.status == "skipped" and outcome.reason.startswith(NO_TWIN)
    assert attempt.skip(find("twin-fdk"), pair(tmp_path), "metal") is None


# --- classes and ranks ---------------------------------------------------------------------------------


def test_controls_have_classes_of_their_own():
    assert {n: i for n, (_, i) in TABLE.items() if i in CONTROLS} == {
        "zero": CONTROL, "hull": CONTROL, "twin-fdk": TWIN,
    }  # fmt: skip


def test_a_table_marks_no_row_of_a_class_without_ranks():
    columns = [Column("inputs"), Column("a", number=True, better="max")]
    rows = [[Cell(who), Cell(str(n), n)] for who, n in (("x", 1.0), ("x", 2.0), ("y", 9.0), ("y", 8.0))]
    table = Table(columns=columns, rows=rows, rank_within=0, unranked=("y",))
    assert table.places() == {(1, 1): "best", (0, 1): "second"}


def test_controls_are_never_best_or_second():
    given = [table_record("zero", psnr=50.0, inputs=CONTROL), table_record("hull", psnr=40.0, inputs=CONTROL)]
    given += [
        table_record(name, psnr=n, inputs=TWIN) for name, n in (("twin-fdk", 60.0), ("twin-fdk[cutoff=0.5]", 61.0))
    ]
    given += [table_record("fdk", psnr=20.0), table_record("net", psnr=10.0)]
    text = tables.render(given, "md")
    for inputs, name, expected in ((CONTROL, "zero", "50.00"), (CONTROL, "hull", "40.00"), (TWIN, "twin-fdk", "60.00")):
        assert cells(text, f"| {inputs} | {name} |")[2] == expected
    assert cells(text, "| counts only | fdk")[2] == "**20.00**"


def test_the_terminal_has_no_best_control(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    bold = r"\x1b\[1m(?:[^\x1b]*)"
    given = [table_record("zero", psnr=50.0, inputs=CONTROL), table_record("hull", psnr=40.0, inputs=CONTROL)]
    given += [table_record("fdk", psnr=20.0), table_record("net", psnr=10.0)]
    shown = "".join(re.findall(bold, overview.overview(given)))
    assert "20.00" in shown and "50.00" not in shown


def test_gains_over_fdk_are_not_over_the_ramp():
    assert row_of("fdk", ["fdk-ramp", "limar"]) is None
    assert row_of("fdk", ["fdk-ramp", "fdk[cutoff=0.5]"]) == "fdk[cutoff=0.5]"


@pytest.mark.parametrize(
    ("name", "settings", "inputs"),
    [
        ("splat", {}, ASSUMED),
        ("splat", {"filtration": 2.5}, ASSUMED),
        ("splat", {"detector": {"kind": "counting"}}, ASSUMED),
        ("splat", {"response": "known"}, SPECTRUM),
        ("splat-paper", {}, COUNTS_ONLY),
        ("splat-paper", {"response": "tube"}, ASSUMED),
        ("splat-paper", {"response": "known"}, SPECTRUM),
        ("splat-r2", {}, COUNTS_ONLY),
        ("field", {}, ASSUMED),
        ("field", {"response": "known"}, SPECTRUM),
        ("polyner", {}, MASK_AND_SPECTRUM),
        ("polyner", {"mask": "auto"}, SPECTRUM),
    ],
)
def test_a_splat_is_in_the_class_of_what_it_is_told(name, settings, inputs):
    assert find(name, settings).inputs == inputs
