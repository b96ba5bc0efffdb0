"""LIMAR and NMAR: what they leave alone, what they count, and where they must stay finite."""

import dataclasses

import msgspec
import numpy as np
import pytest
import torch
from scipy import ndimage

from ctsim.baselines import bhc, limar, nmar, prior
from ctsim.baselines.inpaint import Filled, fill, harmonic
from ctsim.baselines.metal import Metal, Trace, auto_mask, find_metal, reach, reinsert, water_value
from ctsim.baselines.morphology import dilate, spread
from ctsim.baselines.prior import choice_views, choose_prior, tissue_prior
from ctsim.benchmarks.methods import ASSUMED, FITTED, MASK_AND_ASSUMED, METAL_MASK, find
from ctsim.detector.noise import Noise
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.plan import make_plan
from ctsim.reconstruct.fdk import ramp
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.filters import RAMP
from ctsim.settings import Simulation, Truth
from ctsim.simulate import flat_image, simulate_views
from ctsim.solids import FRUSTUM, Primitive, Solid
from ctsim.tracer.project import Tracer, path_lengths
from ctsim.tracer.voxelise import metal_mask
from ctsim.types import Phantom, Scan, Scanner, Status

METHODS = {"limar": limar.reconstruct, "nmar": nmar.reconstruct}
GEOMETRY = Geometry(
    dso=250.0, dsd=500.0, n_voxel=(14, 40, 40), d_voxel=(1.5, 1.25, 1.25), n_detector=(24, 64), d_detector=(2.0, 2.0),
    n_views=60,
)  # fmt: skip


def rod(radius, x, y, half=40.0, material="Fe"):
    piece = Primitive(kind=FRUSTUM, centre=(x, y, 0.0), params=(half, radius, radius))
    return Solid(name="rod", material=material, primitives=(piece,), metal=material in ("Fe", "Al", "Ti"))


def simulated(solids, geometry=GEOMETRY):
    """A scan on solids and a body of 2× finer voxels than are reconstructed, and its metal-free twin."""
    body = rod(21.0, 0.0, 0.0, 30.0, "water")
    bone = rod(4.0, -9.0, 6.0, 30.0, "cortical_bone")
    phantom = Phantom(
        labels=np.zeros((28, 80, 80), np.uint8),
        materials=("air", "water", "cortical_bone", "Fe", "Al"),
        d_voxel=(0.75, 0.625, 0.625),
        solids=(body, bone, *solids),
    )
    scanner = Scanner(geometry=geometry)
    plan = make_plan(phantom, scanner, Simulation(), Truth(twin=bool(solids)), "scene")
    views = [images for _, images in simulate_views(plan, phantom, scanner)]
    mask = torch.from_numpy(metal_mask(phantom, geometry))

    def scan(name, metal):
        return Scan(
            geometry=geometry, counts=torch.from_numpy(np.stack([v[name] for v in views])),
            flat=torch.from_numpy(flat_image(plan, scanner)), dark=Noise().dark, metal=metal,
        )  # fmt: skip

    twin = scan("metal_free/counts" if solids else "counts", torch.zeros_like(mask))
    return scan("counts", mask), twin


@pytest.fixture(scope="module")
def iron():
    return simulated((rod(2.2, 8.0, 2.0), rod(1.8, -4.0, -11.0)))


def tissue_error(volume, twin, scan):
    """RMS difference from FDK of the metal-free twin, away from the metal, in the unit of the volume."""
    z = slice(4, 10)
    far = ~np.asarray(dilate(scan.metal.numpy() != 0, 2))[z]
    return float(np.sqrt(np.mean((volume.values.numpy() - twin.values.numpy())[z][far] ** 2)))


def test_on_iron_nmar_is_better_than_limar_and_limar_than_nothing(iron):
    scan, bare = iron
    twin, first = fdk(bare), fdk(scan)
    none = tissue_error(first, twin, scan)
    by = {prior: tissue_error(nmar.reconstruct(scan, prior=prior), twin, scan) for prior in ("fdk", "limar")}
    # streaks of iron spoil the prior that is made from them
    assert by["limar"] < tissue_error(limar.reconstruct(scan), twin, scan) < 0.6 * none
    chosen = nmar.reconstruct(scan)
    assert tissue_error(chosen, twin, scan) == by[chosen.details["prior"]] < none


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("mask", ["oracle", "auto"])
def test_without_metal_the_result_is_fdk_to_the_last_bit_and_nothing_is_projected(iron, name, mask, monkeypatch):
    _, bare = iron
    first = fdk(bare)
    monkeypatch.setattr("ctsim.baselines.metal.Tracer.background", None)
    monkeypatch.setattr("ctsim.baselines.nmar.forward_columns", None)
    monkeypatch.setattr("ctsim.baselines.prior.forward_columns", None)
    volume = METHODS[name](bare, mask=mask)
    assert torch.equal(volume.values, first.values) and not volume.details["corrected"]
    # bone is the densest there is: the automatic mask finds it, and says that it is not to be relied on
    assert volume.details["mask_status"] == ("no_metal" if mask == "oracle" else "mask_unreliable")


@pytest.mark.parametrize("name", METHODS)
def test_reinsertion_changes_metal_voxels_only(iron, name):
    scan, _ = iron
    by = {insert: METHODS[name](scan, insert=insert).values.numpy() for insert in ("fdk", "mean", "none")}
    mask, first = scan.metal.numpy() != 0, fdk(scan).values.numpy()
    for insert in ("fdk", "mean"):
        assert np.array_equal(by[insert][~mask], by["none"][~mask])
    assert np.array_equal(by["fdk"][mask], first[mask])
    assert by["mean"][mask].mean() == pytest.approx(first[mask].mean(), rel=1e-5)
    assert len(np.unique(by["mean"][mask])) == 2  # two rods, one value each


def test_only_rows_that_hold_metal_are_touched(iron):
    scan, _ = iron
    metal = find_metal(scan, fdk(scan).values.numpy(), "oracle")
    short = dataclasses.replace(metal, mask=metal.mask & (np.arange(14) < 4)[:, None, None])
    trace = Trace(short, scan, dilation=0)
    seen = np.stack([trace.view(k) for k in range(scan.geometry.n_views)])
    assert seen.any() and not seen[:, 14:].any()
    first = ramp(scan).values
    values, filled = limar.interpolated(trace, first, "rows", RAMP)
    assert filled.pixels == seen.sum() and filled.rows == seen.any(2).sum() and filled.views == seen.any((1, 2)).sum()
    # the filter runs along rows and the cone spreads them: voxels above the highest row touched are FDK's
    assert torch.equal(values[-2:], first[-2:]) and not torch.equal(values[:4], first[:4])


@pytest.mark.parametrize("name", ["limar", "nmar", "bhc-poly", "water-precorrection"])
def test_the_correction_is_filtered_as_the_volume_that_it_is_added_to(iron, name, monkeypatch):
    """FDK is linear in the window's gain: Hann is 0.5 + 0.5 cos and Hamming 0.54 + 0.46 cos, so 0.92 Hann + 0.08."""
    scan, _ = iron
    first = ramp(scan).values
    metal = find_metal(scan, first.numpy(), "oracle")
    prior = choose_prior(Trace(metal, scan), metal, first, RAMP, "fdk")  # the same for all windows
    for module in (nmar, bhc):
        monkeypatch.setattr(module, "choose_prior", lambda *_: prior)
    kept = {"insert": "none"} if name != "water-precorrection" else {}
    by = {w: find(name, {"window": w, "cutoff": 1.0, **kept}).reconstruct(scan) for w in ("hann", "ram-lak", "hamming")}
    values = {w: volume.values.double() for w, volume in by.items()}
    expected = 0.92 * values["hann"] + 0.08 * values["ram-lak"]
    assert not torch.equal(values["hann"], values["ram-lak"])
    assert all(volume.details.get("corrected", True) for volume in by.values())
    # float32 sums of 60 views
    torch.testing.assert_close(values["hamming"], expected, rtol=0, atol=2e-6 * float(expected.abs().max()) * 60**0.5)


def test_a_ratio_with_a_tiny_floor_diverges_on_a_protruding_rod_and_the_offset_does_not():
    long = rod(2.0, 26.0, 0.0)  # beside the body: its shadow leaves the prior's in most views
    scan, bare = simulated((rod(2.2, 8.0, 2.0), long))
    twin = fdk(bare)
    error = {
        kind: tissue_error(nmar.reconstruct(scan, normalisation=kind, floor=floor), twin, scan)
        for kind, floor in (("offset", None), ("additive", None), ("ratio", None))
    }
    broken = tissue_error(nmar.reconstruct(scan, normalisation="ratio", floor=1e-6), twin, scan)
    water = water_value(twin.values.numpy())
    assert max(error.values()) < water
    assert broken > 10 * max(error.values())


def test_the_guard_fires_on_aluminium_beside_bone():
    scan, _ = simulated((rod(3.0, 8.0, 2.0, material="Al"),))
    first = fdk(scan)
    metal = auto_mask(first.values.numpy())
    assert metal.doubt and not metal.found
    volume = limar.reconstruct(scan, mask="auto")
    assert torch.equal(volume.values, first.values)
    assert volume.status is Status.OK and not volume.reason and "times water" in volume.details["mask_reason"]


def toothed(*rods, enamel=4.8, water=0.02):
    """Return a smooth body of water with enamel and rods of given multiples of it; and the rods."""
    z, y, x = np.meshgrid(*[np.arange(48) - 23.5] * 3, indexing="ij")
    values, metal = np.where(np.hypot(x, y) < 20, water, 0.0), np.zeros(x.shape, bool)
    values[np.abs(z) < 10] *= np.where(np.hypot(x + 10, y) < 5, enamel, 1)[np.abs(z) < 10]
    for (at_x, at_y), times in rods:
        inside = (np.hypot(x - at_x, y - at_y) < 3) & (np.abs(z) < 8)
        values[inside], metal = water * times, metal | inside
    noise = np.random.default_rng(0).normal(0, 0.1 * water, x.shape)
    return (ndimage.gaussian_filter(values, 0.7) + noise).astype(np.float32), metal


def test_the_automatic_mask_finds_two_metals_and_no_enamel():
    """Titanium next to enamel, and a metal of nearly twice its value: half of the latter is below the former."""
    values, metal = toothed(((8, 6), 16.0), ((8, -8), 9.5), ((-10, 6), 9.5))
    found = auto_mask(values)
    assert not found.doubt
    # half a voxel around rods of six voxels across: (3.5 / 3)² of their volume
    assert 2 * (found.mask & metal).sum() / (found.mask.sum() + metal.sum()) > 0.85
    alone, _ = toothed()
    assert auto_mask(alone).doubt.startswith("nothing reaches 7 times water")


@pytest.mark.parametrize(
    ("rod", "times", "enamel", "least"),
    [((8, 6), 12.0, 6.5, 0.8), ((-10, 0), 8.2, 4.6, 0.7)],  # a crown's edge towards enamel lies farther out
    ids=["apart", "crown"],
)
def test_the_automatic_mask_holds_no_enamel_of_half_the_metals_value(rod, times, enamel, least):
    values, metal = toothed((rod, times), enamel=enamel)
    found = auto_mask(values)
    assert not found.doubt
    assert 2 * (found.mask & metal).sum() / (found.mask.sum() + metal.sum()) > least


def test_the_automatic_mask_is_doubted_where_enamel_is_nearly_as_dense():
    values, _ = toothed(((8, 6), 8.0), enamel=5.8)
    assert auto_mask(values).doubt.endswith("times the body's densest, expected 1.5 or more")


@pytest.mark.parametrize(("water", "enamel"), [(0.044, 6.6), (0.055, 7.2), (0.083, 8.7)])
def test_the_automatic_mask_takes_no_enamel_for_metal_in_a_soft_beam(water, enamel):
    """Of a jaw of 10 mm at 90, 70 and 40 kV."""
    values, _ = toothed(enamel=enamel, water=water)
    assert auto_mask(values).doubt.startswith("nothing reaches")
    values, metal = toothed(((8, 6), 16.0), enamel=enamel, water=water)
    found = auto_mask(values)
    assert not found.doubt
    assert 2 * (found.mask & metal).sum() / (found.mask.sum() + metal.sum()) > 0.8


def test_the_automatic_mask_finds_iron(iron):
    scan, _ = iron
    found, true = auto_mask(fdk(scan).values.numpy()), scan.metal.numpy() != 0
    assert not found.doubt
    # at rods of 3 voxels across half a voxel around decides over a third of the mask
    assert 2 * (found.mask & true).sum() / (found.mask.sum() + true.sum()) > 0.75


def test_the_trace_is_where_the_mask_has_length(iron):
    scan, _ = iron
    metal = Metal(mask=scan.metal.numpy() != 0, source="oracle")
    trace = Trace(metal, scan, dilation=0)
    phantom = Phantom(labels=metal.mask.astype(np.uint8), materials=("air", "Fe"), d_voxel=GEOMETRY.d_voxel)
    for view in (0, 17):
        length = path_lengths(Tracer.of(phantom), scan.geometry, view)[1]
        assert np.array_equal(trace.view(view), length > 0.05 * np.prod(GEOMETRY.d_voxel) ** (1 / 3))
        wide = Trace(metal, scan, dilation=1).view(view)
        assert wide.sum() > trace.view(view).sum() and wide[trace.view(view)].all()


def test_metal_that_the_mask_leaves_out_is_within_reach(iron):
    """With the metal-free readings put into the trace, what is left is the metal that the trace does not cover."""
    scan, bare = iron
    first, twin = fdk(scan), fdk(bare)
    metal = find_metal(scan, first.values.numpy(), "oracle")

    def left(dilation):
        trace = Trace(metal, scan, dilation)
        held = torch.from_numpy(np.stack([trace.view(k) for k in range(scan.geometry.n_views)]))
        mended = dataclasses.replace(scan, counts=torch.where(held, bare.counts, scan.counts))
        return tissue_error(fdk(mended), twin, scan)

    # rods of 3 voxels across, of which the mask leaves out up to half a voxel all around; a trace widened by a pixel
    # takes all of that, and the rule all but what is no darker than the densest tissue near
    assert left(1) < 0.02 * tissue_error(first, twin, scan)
    assert left(None) < 0.25 * left(0)


def test_the_reach_grows_with_the_pixels_that_a_voxel_covers():
    # half a voxel is 1.5 mm on the detector, 0.75 of its pixels: with half a pixel 1.25; then 3.0, and 0.65
    assert reach(GEOMETRY) == (1, 1)
    assert reach(msgspec.structs.replace(GEOMETRY, d_detector=(0.6, 0.6))) == (3, 3)
    assert reach(msgspec.structs.replace(GEOMETRY, d_detector=(10.0, 10.0))) == (1, 1)
    # a long edge upright counts along the rows' columns alone, one lying down along the rows
    d_z, d_y, d_x = GEOMETRY.d_voxel
    assert reach(msgspec.structs.replace(GEOMETRY, d_voxel=(10 * d_z, d_y, d_x))) == (8, 1)
    assert reach(msgspec.structs.replace(GEOMETRY, d_voxel=(d_z, 10 * d_y, d_x))) == (1, 7)


def test_a_mask_spreads_as_far_along_each_axis_as_it_is_told():
    point = np.zeros((9, 11), bool)
    point[4, 5] = True
    np.testing.assert_array_equal(spread(point, (3, 3)), dilate(point, 3))
    found = spread(point, (1, 4))
    assert found[:, 5].sum() == 3 and found[4].sum() == 9 and found.sum() == 11


def test_voxels_that_hold_blurred_metal_do_not_pass_for_bone(iron):
    scan, _ = iron
    values = fdk(scan).values.numpy()
    metal, water = find_metal(scan, values, "oracle"), water_value(values)
    skin = dilate(metal.mask, 1, corners=True)
    assert values[skin & ~metal.mask].max() > 1.5 * water
    assert (tissue_prior(values, metal, water)[skin] == np.float32(water)).all()


def test_a_fitted_prior_has_water_for_metal_and_comes_closer_to_the_twin(iron, monkeypatch):
    """With FDK of the twin in place of splats, plus the metal that they would draw."""
    scan, bare = iron
    twin = fdk(bare)
    with_metal = twin.values + 40 * torch.from_numpy(scan.metal.numpy().astype(np.float32))
    fitted = dataclasses.replace(twin, values=with_metal, details={"view_updates": 123})
    monkeypatch.setitem(prior.FITTED, "splat", lambda _: fitted)
    by = {name: nmar.reconstruct(scan, prior=name) for name in ("auto", "splat")}
    error = {name: tissue_error(volume, twin, scan) for name, volume in by.items()}
    assert error["splat"] < 0.8 * error["auto"]
    details = by["splat"].details
    assert details["prior"] == "splat" and details["view_updates"] == 123 + 2 * GEOMETRY.n_views
    given, water = details["intermediates"]["prior"], details["water_per_mm"]
    skin = dilate(scan.metal.numpy() > 0, 1, corners=True)
    assert (given[skin] == np.float32(water)).all() and np.array_equal(given[~skin], twin.values.numpy().clip(0)[~skin])
    for status in (Status.ERROR, Status.DIVERGED):
        ended = dataclasses.replace(fitted, status=status, reason="it ran away")
        monkeypatch.setitem(prior.FITTED, "splat", lambda _, ended=ended: ended)
        volume = nmar.reconstruct(scan, prior="splat")
        assert torch.equal(volume.values, fdk(scan).values)
        assert f"the prior, splat, ended as {status}: it ran away" in volume.details["uncorrected_reason"]


@pytest.mark.parametrize(
    ("settings", "inputs"),
    [
        ({}, METAL_MASK),
        *(({"prior": name}, MASK_AND_ASSUMED) for name in FITTED),
        ({"prior": "splat", "mask": "auto"}, ASSUMED),
    ],
)
def test_a_fitted_prior_assumes_the_spectrum_of_its_fit(settings, inputs):
    assert set(FITTED) == set(prior.FITTED)
    assert find("nmar", settings).inputs == inputs


HARD = {
    "trace on the detector's edge": ({"d_detector": (2.0, 1.0)}, (rod(2.0, 15.0, 0.0),)),
    "metal fills whole rows": ({"d_detector": (2.0, 0.3)}, (rod(9.0, 0.0, 0.0),)),
    "merging shadows": ({}, (rod(2.0, 5.0, 0.0), rod(2.0, 10.0, 0.0), rod(2.0, 15.0, 0.0))),
    "offset detector": ({"off_detector": (3.0, 14.0)}, (rod(2.0, 5.0, 0.0),)),
    "non-cubic voxels": ({"d_voxel": (3.0, 0.9, 1.3)}, (rod(2.0, 5.0, 0.0),)),
    "metal outside the volume": ({"n_voxel": (14, 20, 20)}, (rod(2.0, 17.0, 0.0),)),
    "short arc": ({"arc_deg": 200.0}, (rod(2.0, 5.0, 0.0),)),
    "one view": ({"n_views": 1}, (rod(2.0, 5.0, 0.0),)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("case", HARD)
def test_hard_scans_stay_finite_and_counted(name, case):
    changes, solids = HARD[case]
    geometry = msgspec.structs.replace(GEOMETRY, **{"n_views": 12, **changes})
    scan, _ = simulated(solids, geometry)
    volume = METHODS[name](scan)
    assert volume.status is Status.OK and bool(torch.isfinite(volume.values).all())
    first = fdk(scan)
    assert volume.values.abs().max() < 20 * first.values.abs().max()
    if case == "metal outside the volume":
        assert torch.equal(volume.values, first.values) and volume.details["mask_status"] == "no_metal"
    else:
        assert volume.details["filled_pixels"] > 0
    if case == "metal fills whole rows":
        assert volume.details["full_rows"] > 0
    if case == "trace on the detector's edge":
        assert volume.details["edge_gaps"] > 0


@pytest.mark.parametrize("name", METHODS)
def test_starved_readings_stay_finite(iron, name):
    scan, _ = iron
    dark = scan.counts.clone()
    dark[:, :, 28:36] = 0  # below the pedestal: P saturates at ln i0 and more
    bright = scan.counts.clone()
    bright[:, :4] = 65535  # brighter than the open field: negative P
    for counts in (dark, bright):
        volume = METHODS[name](dataclasses.replace(scan, counts=counts))
        assert volume.status is Status.OK and bool(torch.isfinite(volume.values).all())


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"mask": "somewhere.tif"}, "no file 'somewhere.tif'"),
        ({"insert": "gold"}, "insert: expected one of"),
        ({"interpolation": "cubic"}, "interpolation: expected one of"),
        ({"dilation": -1}, "dilation: expected a whole number"),
    ],
)
def test_wrong_settings_are_refused_by_name(iron, name, setting, words):
    with pytest.raises(InputError, match=words):
        METHODS[name](iron[0], **setting)
    with pytest.raises(InputError, match="no true metal mask"):
        METHODS[name](dataclasses.replace(iron[0], metal=None))
    for wrong, said in (({"prior": "x"}, "prior"), ({"floor": 0.0}, "floor"), ({"normalisation": "x"}, "normalis")):
        with pytest.raises(InputError, match=said):
            nmar.reconstruct(iron[0], **wrong)


def test_settings_are_set_by_name_and_carry_their_defaults():
    filtered = {"panel": "ideal", "scatter": 0.0, "window": "cosine", "cutoff": 0.9}
    bridged = {"mask": "oracle", "interpolation": "rows", "insert": "fdk", "dilation": None}
    assert find("limar").params == filtered | bridged
    method = find("nmar", {"normalisation": "ratio", "mask": "auto"})
    assert method.params == {
        **find("limar").params, "mask": "auto", "prior": "auto", "normalisation": "ratio", "floor": None,
    }  # fmt: skip
    with pytest.raises(
        InputError, match=r"nmar\.margin: unknown parameter; expected one of panel, scatter, window, cutoff, mask"
    ):
        find("nmar", {"margin": 0.9})


def test_a_mask_file_serves_as_well_as_the_oracle(iron, tmp_path):
    import tifffile

    scan, _ = iron
    tifffile.imwrite(tmp_path / "mask.tif", scan.metal.numpy())
    given = limar.reconstruct(dataclasses.replace(scan, metal=None), mask=str(tmp_path / "mask.tif"))
    assert torch.equal(given.values, limar.reconstruct(scan).values)
    np.save(tmp_path / "mask.npy", scan.metal.numpy())
    again = limar.reconstruct(dataclasses.replace(scan, metal=None), mask=str(tmp_path / "mask.npy"))
    assert torch.equal(given.values, again.values)
    tifffile.imwrite(tmp_path / "small.tif", scan.metal.numpy()[1:])
    with pytest.raises(InputError, match=r"mask: .*small\.tif holds uint8 of shape .*, expected \("):
        limar.reconstruct(scan, mask=str(tmp_path / "small.tif"))


def test_rows_are_bridged_by_straight_lines():
    image = np.arange(7 * 11, dtype=np.float32).reshape(7, 11) ** 1.5
    trace = np.zeros(image.shape, bool)
    trace[1, 3:7] = trace[2, :4] = trace[3, 8:] = trace[4] = True
    want, filled = image.copy(), Filled()
    want[1, 3:7] = np.interp(np.arange(3, 7), [2, 7], image[1, [2, 7]])
    want[2, :4], want[3, 8:] = image[2, 4], image[3, 7]
    fill(image, trace, "rows", filled)
    np.testing.assert_allclose(image[:4], want[:4], rtol=1e-6)
    assert np.array_equal(image[5:], want[5:])
    assert (filled.pixels, filled.rows, filled.edge_gaps, filled.full_rows, filled.views) == (22, 4, 2, 1, 1)
    # the full row is harmonic: each pixel the mean of its neighbours, mirrored at the detector's edge
    left, right = np.r_[image[4, 0], image[4, :-1]], np.r_[image[4, 1:], image[4, -1]]
    np.testing.assert_allclose(image[4] * 4, left + right + image[3] + image[5], rtol=1e-5)


def test_harmonic_filling_continues_a_harmonic_function():
    v, u = np.mgrid[:20, :30].astype(np.float64) / 10
    exact = u**2 - v**2 + 3 * u * v
    image, unknown = exact.astype(np.float32), np.zeros(exact.shape, bool)
    unknown[5:13, 7:21] = True
    image[unknown] = 99
    harmonic(image, unknown)
    # the five-point stencil has no error on polynomials of degree 2; float32 holds values up to 20
    np.testing.assert_allclose(image, exact, atol=4e-6)
    nothing_known = np.full((3, 4), 7.0, np.float32)
    harmonic(nothing_known, np.ones((3, 4), bool))
    assert (nothing_known == 7).all()


def test_water_is_measured_in_the_scan(iron):
    scan, bare = iron
    twin = fdk(bare).values.numpy()
    inside = twin[5:9, 15:25, 22:30]  # of the body, away from the bone
    assert water_value(twin) == pytest.approx(np.median(inside), rel=0.06)
    assert water_value(fdk(scan).values.numpy()) == pytest.approx(np.median(inside), rel=0.1)
    assert water_value(np.zeros((4, 5, 6), np.float32)) == 0


def test_reinsertion_refuses_what_it_does_not_know():
    metal = Metal(mask=np.ones((2, 2, 2), bool), source="oracle")
    with pytest.raises(InputError, match="insert must be one of"):
        reinsert(torch.zeros(2, 2, 2), np.zeros((2, 2, 2), np.float32), metal, "x")


def test_the_views_that_decide_between_priors_are_the_same_where_each_is_given_twice():
    for n in (1, 5, 31, 32, 33, 48, 60, 240):
        views = choice_views(n)
        assert len(set(views)) == min(n, 32) and min(views) >= 0 and max(views) < n
        if n >= 32:
            assert [view // 2 for view in choice_views(2 * n)] == views
