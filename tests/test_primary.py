"""Scatter taken off the readings, for the methods that have no model of it."""

import os
import subprocess
import sys

import msgspec
import numpy as np
import pytest
import torch

from ctsim import find_scene, reconstruct_scan, simulate_scene
from ctsim.benchmarks.methods import CONTROLS, TABLE, find
from ctsim.geometry import Geometry
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.primary import without_scatter
from ctsim.reconstruct.scatter import Scatter
from ctsim.scatter import Scatter as Scattering
from ctsim.types import Scan

GEOMETRY = Geometry(
    dso=250.0,
    dsd=500.0,
    n_voxel=(8, 8, 8),
    d_voxel=(1.0, 1.0, 1.0),
    n_detector=(6, 8),
    d_detector=(1.0, 1.0),
    n_views=4,
)
OPEN, DARK = 5e4, 90.0


def scan_of(share, dtype=np.float32):
    """The scan whose signal is `share` [view, v, u] of an uneven open field."""
    open_field = OPEN * np.linspace(0.8, 1.2, 8) * np.ones((6, 1))
    counts, flat = (torch.from_numpy((x + DARK).astype(dtype)) for x in (share * open_field, open_field))
    return Scan(geometry=GEOMETRY, counts=counts, flat=flat.float(), dark=DARK, i0=1e7)


@pytest.mark.parametrize("scatter", [0.001, 0.02, 0.2])
def test_what_remains_is_the_primary_or_a_tenth_of_the_reading(scatter):
    primary = np.exp(-np.random.default_rng(0).uniform(0, 9, GEOMETRY.shape))
    scan = scan_of(primary + scatter)
    left = line_integrals(without_scatter(scan, Scatter(floor=scatter)), slice(None))[0].numpy()
    true = -np.log(np.maximum(primary, 0.1 * (primary + scatter)))
    # counts and what is taken off are rounded to 2⁻²⁴ of 6e4, against the least signal that is left, 0.1 of 4e4 · 0.001
    np.testing.assert_allclose(left, true, atol=3 * 6e4 * 2**-24 / (0.1 * 0.8 * OPEN * scatter) + 1e-5)


def test_scatter_with_a_course_is_taken_off_where_it_is():
    rows = np.linspace(0.01, 0.05, 6, dtype=np.float32)[None, :, None]
    scatter = Scatter(floor=0.01, gain=2.0, source=np.broadcast_to(rows, GEOMETRY.shape).copy())
    seen = without_scatter(scan_of(0.5 + 0.01 + 2 * np.broadcast_to(rows, GEOMETRY.shape)), scatter)
    assert line_integrals(seen, slice(None))[0].numpy() == pytest.approx(np.log(2), abs=1e-5)


def test_readings_without_a_signal_stay_as_they_are():
    scan = scan_of(np.full(GEOMETRY.shape, 0.3))
    nothing = torch.tensor([DARK, DARK - 7, 0.0, torch.nan])
    scan.counts[0, 0, :4] = nothing
    left = without_scatter(scan, Scatter(floor=0.1)).counts
    assert torch.equal(left[0, 0, :4].nan_to_num(-1), nothing.nan_to_num(-1))
    assert bool((left[0, 0, 4:] < scan.counts[0, 0, 4:]).all())


def test_what_was_below_the_floor_of_whole_counts_stays_and_no_other_falls_below():
    """Half a count, where 1e7 photons would allow 0.0025: as float32 alone these readings would be a P of 16.8."""
    scan = scan_of(np.full(GEOMETRY.shape, 0.3), np.uint16)
    scan.counts[0, 0, :4] = torch.tensor([90, 91, 92, 100], dtype=torch.uint16)
    before, clamped = line_integrals(scan, slice(None))
    for scatter, changed in ((1e-9, False), (0.1, True)):
        after, mask = line_integrals(without_scatter(scan, Scatter(floor=scatter)), slice(None))
        assert torch.equal(mask, clamped) and after[0, 0, 0] == before[0, 0, 0]
        assert torch.allclose(after, before, atol=1e-4, rtol=0) != changed
        assert bool((after <= torch.log((scan.flat - DARK) / 0.5) + 1e-5).all())


def test_infinite_readings_stay_unseen():
    scan = scan_of(np.full(GEOMETRY.shape, 0.3))
    scan.counts[0, 0, 0], scan.counts[0, 0, 1] = torch.inf, -torch.inf
    clamped = line_integrals(without_scatter(scan, Scatter(floor=0.1)), slice(None))[1]
    assert bool(clamped[0, 0, :2].all()) and int(clamped.sum()) == 2


def test_whole_counts_keep_what_lies_between_them_and_the_scan_its_own():
    scan = scan_of(np.full(GEOMETRY.shape, 0.3), np.uint16)
    before = scan.counts.clone()
    left = without_scatter(scan, Scatter(floor=0.1 / 3))
    assert left.counts.dtype == torch.float32 and torch.equal(scan.counts, before)
    assert without_scatter(scan, Scatter(floor=0.0)) is scan


@pytest.mark.parametrize("name", [name for name, (_, inputs) in TABLE.items() if inputs not in CONTROLS])
def test_every_method_is_offered_what_splats_take_for_granted(name):
    if name == "fdk-ramp":
        pytest.skip("the row without any choice")
    assert find(name, {"scatter": 0.01}).params["scatter"] == 0.01
    assert find(name, {"scatter": "found"}).params["scatter"] == "found"
    assert find(name).params["scatter"] == ("found" if name in ("splat", "field") else 0.0)


@pytest.fixture(scope="module")
def scans():
    """A thorax with iron without scatter, and the same with a constant one of 0.05 of the open field."""
    scene = find_scene("quick", "lung-Fe")
    levels = (Scattering(level=0), Scattering(level=1, fraction=0.05))
    scanners = [msgspec.structs.replace(scene.scanner, n_views=30, scatter=level) for level in levels]
    return [simulate_scene(msgspec.structs.replace(scene, scanner=scanner)) for scanner in scanners]


@pytest.mark.parametrize("name", ["fdk", "limar", "nmar", "water-precorrection", "sirt"])
def test_a_method_undoes_scatter_that_it_finds(scans, name):
    """Against the same method on the scan without scatter, in tissue; a planted error of 10 % of it would show."""
    plain, scattered = scans
    true = reconstruct_scan(plain, name).values.numpy()
    left, found = (reconstruct_scan(scattered, name, scatter=scatter) for scatter in (0.0, "found"))
    tissue = (plain.labels > 0) & (plain.labels < plain.labels.max())
    off = [abs(float((volume.values.numpy() - true)[tissue].mean())) for volume in (left, found)]
    assert off[1] < 0.1 * off[0]
    assert found.details["scatter"] == pytest.approx(0.05, rel=0.05) and "scatter" not in left.details


def test_a_scan_without_scatter_gives_the_same_bits(scans):
    volumes = [reconstruct_scan(scans[0], "fdk", scatter=scatter).values for scatter in (0.0, "found")]
    assert torch.equal(*volumes)


LAID = """
import hashlib

import numpy as np

from ctsim.reconstruct.scatter import Scatter

source = np.random.default_rng(1).random((1, 48, 48), dtype=np.float32)
image = Scatter(floor=0.01, gain=0.1, source=source, step=(8, 8)).of(0, (380, 384))
assert image.shape == (380, 384)
assert image.min() > 0.01
print(hashlib.sha256(np.ascontiguousarray(image)).hexdigest())
"""


def test_scatter_has_the_same_bits_for_any_number_of_numpys_threads():
    def printed(threads):
        told = os.environ | {name: str(threads) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
        code = [sys.executable, "-c", LAID]
        return subprocess.run(code, env=told, capture_output=True, text=True, timeout=120, check=True).stdout

    assert len({printed(threads) for threads in (1, 2, 3)}) == 1
