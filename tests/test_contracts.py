"""What every method of the table owes its caller, on the smallest scene."""

import dataclasses

import msgspec
import numpy as np
import pytest
import torch

from ctsim.benchmarks.methods import TABLE, find
from ctsim.benchmarks.studies.methods.attempt import scan_for
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError
from ctsim.reconstruct.primary import without_scatter
from ctsim.reconstruct.scatter import Scatter
from ctsim.types import Status

FIELDS = ("naf", "polyner", "park", "field")
SHORT = {name: {"steps": 100} for name in ("splat-paper", "splat-r2", *FIELDS)}  # of 20 000, 30 000 and hundreds


@pytest.fixture(scope="module")
def stored(smallest):
    return open_scan(list_scans(smallest)[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLE)
def test_a_method_gives_a_finite_volume_of_the_scans_grid(name, stored):
    method = find(name, SHORT.get(name))
    scan = scan_for(method, stored, "metal")
    if reason := method.skip(scan):
        assert isinstance(reason, str)
        pytest.skip(reason)
    volume = method.reconstruct(scan)
    # a reason is for what went wrong; remarks on a volume that is fine stand in its details
    assert volume.status is Status.OK and not volume.reason
    assert volume.values.dtype == torch.float32
    assert tuple(volume.values.shape) == stored.geometry.n_voxel
    assert bool(torch.isfinite(volume.values).all())
    if name == "zero":
        assert not volume.values.any()
        return
    # 1/mm, not 1/cm, HU or counts: water at 90 kV is near 0.025, so a factor of 2 tells the units apart
    water = stored.reference("effective")[stored.labels == 1]
    measured = volume.values.numpy()[stored.labels == 1]
    assert np.median(water) / 2 < np.median(measured) < 2 * np.median(water)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name in TABLE if "scatter" in find(name).params and name not in ("splat", "field")]
)
def test_scatter_is_taken_off_once(name, stored):
    """`splat` and `field` have it in their model; for all others it leaves the counts before anything looks at them."""
    short, scan = SHORT.get(name, {}), scan_for(find(name), stored, "metal")
    volume = find(name, short | {"scatter": 0.02}).reconstruct(scan)
    again = find(name, short).reconstruct(without_scatter(scan, Scatter(floor=0.02)))
    assert torch.equal(volume.values, again.values) and volume.details["scatter"] == 0.02
    assert not torch.equal(volume.values, find(name, short).reconstruct(scan).values)


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLE)
def test_a_remark_on_a_truncated_scan_is_no_reason(name, stored):
    """Six columns see 10 mm of an object of three times that, and the mask of no metal is doubted."""
    method, whole = find(name, SHORT.get(name)), scan_for(find(name), stored, "metal")
    seen = slice(6, 12)
    geometry = msgspec.structs.replace(whole.geometry, n_detector=(16, 6))
    scan = dataclasses.replace(whole, geometry=geometry, counts=whole.counts[..., seen], flat=whole.flat[..., seen])
    doubted = {key: value for key, value in (("mask", "auto"), ("weights", "trace")) if key in method.params}
    method = find(name, SHORT.get(name, {}) | doubted)
    if name in FIELDS:
        with pytest.raises(InputError, match="reaches over the detector"):
            method.reconstruct(scan)
        assert "reaches over the detector" in str(method.skip(scan))
        return
    volume = method.reconstruct(scan)
    assert not volume.reason or volume.status is not Status.OK
    if "weights" in method.params:
        assert "over the detector" in volume.details["limitation"]
    if doubted:
        assert volume.details["mask_status"] == "mask_unreliable" and volume.details["mask_reason"]


@pytest.mark.slow
@pytest.mark.parametrize("name", TABLE)
def test_a_method_leaves_the_scan_as_it_was_and_repeats_itself(name, stored):
    method = find(name, SHORT.get(name))
    scan = scan_for(method, stored, "metal")
    counts = scan.counts.clone()
    if method.skip(scan):
        pytest.skip("does not apply")
    first = method.reconstruct(scan).values
    assert torch.equal(scan.counts, counts)
    assert torch.equal(method.reconstruct(scan).values, first)


def unlit(scan, kind):
    """Return the scan with readings that show nothing: at the pedestal or below it, 0, not a number, infinite."""
    if kind in ("zero", "dark"):
        return torch.full_like(scan.counts, 0 if kind == "zero" else int(scan.dark))
    return torch.full(scan.counts.shape, {"nan": torch.nan, "inf": torch.inf, "negative": -1e6}[kind])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["zero", "dark", "nan", "inf", "negative"])
@pytest.mark.parametrize("name", [name for name in TABLE if name != "zero"])
def test_a_scan_in_which_no_pixel_has_signal_does_not_end_well(name, kind, stored):
    method = find(name, SHORT.get(name))
    scan = scan_for(method, stored, "metal")
    volume = method.reconstruct(dataclasses.replace(scan, counts=unlit(scan, kind)))
    assert volume.status is Status.ERROR and volume.reason.startswith("no pixel has signal")
    assert tuple(volume.values.shape) == stored.geometry.n_voxel and not volume.values.any()


def test_one_pixel_with_signal_is_enough_for_a_volume(stored):
    scan = stored.scan
    counts = torch.zeros_like(scan.counts)
    counts[3, 4, 5] = 30_000
    volume = find("fdk").reconstruct(dataclasses.replace(scan, counts=counts))
    assert volume.status is Status.OK and volume.details["clamped_pixels"] == counts.numel() - 1
