"""Beam-hardening correction, with and without a known spectrum: what it flattens, and what it leaves alone."""

import dataclasses
import math

import msgspec
import numpy as np
import pytest
import torch

from ctsim.baselines import bhc, known_spectrum
from ctsim.baselines.known_spectrum import Beam, precorrect
from ctsim.baselines.metal import Metal, Trace
from ctsim.beam.quadrature import full_rule
from ctsim.benchmarks.studies.methods.volumes import attached
from ctsim.detector.noise import Noise
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.plan import make_plan
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.log import line_integrals
from ctsim.settings import Simulation, Truth
from ctsim.simulate import flat_image, simulate_views
from ctsim.solids import FRUSTUM, Primitive, Solid
from ctsim.tracer.voxelise import metal_mask
from ctsim.types import Phantom, Scan, Scanner, Status

METHODS = {
    "bhc-poly": bhc.bhc_poly,
    "water-precorrection": known_spectrum.water_precorrection,
    "ibhc": known_spectrum.ibhc,
}
RADIUS = 21.0
# the cone stays within the reconstructed slices, so that the volume holds all that a ray meets
GEOMETRY = Geometry(
    dso=250.0, dsd=500.0, n_voxel=(8, 64, 64), d_voxel=(1.0, 0.8, 0.8), n_detector=(16, 96), d_detector=(0.8, 1.4),
    n_views=160,
)  # fmt: skip
INNER = slice(2, 6)


def rod(radius, x, y, material):
    piece = Primitive(kind=FRUSTUM, centre=(x, y, 0.0), params=(30.0, radius, radius))
    return Solid(name="rod", material=material, primitives=(piece,), metal=material in ("Fe", "Al"))


def simulated(solids=(), noise=Noise(model="none"), geometry=GEOMETRY):  # noqa: B008
    """A scan of solids, exact and not voxels, in a cylinder of water, and its metal-free twin."""
    phantom = Phantom(
        labels=np.zeros((8, 80, 80), np.uint8), materials=("air", "water", "Fe", "Al"), d_voxel=(1.0, 0.625, 0.625),
        solids=(rod(RADIUS, 0.0, 0.0, "water"), *solids),
    )  # fmt: skip
    scanner = Scanner(geometry=geometry, noise=noise)
    plan = make_plan(phantom, scanner, Simulation(), Truth(twin=bool(solids)), "scene")
    views = [images for _, images in simulate_views(plan, phantom, scanner)]
    mask = torch.from_numpy(metal_mask(phantom, geometry))

    def scan(name, metal):
        return Scan(
            geometry=geometry, counts=torch.from_numpy(np.stack([v[name] for v in views])),
            flat=torch.from_numpy(flat_image(plan, scanner)), dark=scanner.noise.dark, metal=metal,
            e_max=float(plan.spectrum.e_max),
        )  # fmt: skip

    twin = scan("metal_free/counts" if solids else "counts", torch.zeros_like(mask))
    return scan("counts", mask), twin


def positions():
    y, x = (np.mgrid[:64, :64] - 31.5) * 0.8
    return x, y


@pytest.fixture(scope="module")
def water():
    return simulated()[1]


@pytest.fixture(scope="module")
def rods():
    return simulated((rod(5.0, 11.0, 0.0, "Al"), rod(5.0, -11.0, 0.0, "Al")))


def away():
    """Voxels of water, away from the rods."""
    x, y = positions()
    return (np.hypot(x, y) < 18.5) & (np.hypot(np.abs(x) - 11, y) > 7)


def cupping(volume):
    """Fall from the rim, at 0.8 of the radius, to the centre, as a share of the rim."""
    r = np.hypot(*positions())
    slices = volume.values.numpy()[INNER]
    rim = slices[:, (r > 0.75 * RADIUS) & (r < 0.85 * RADIUS)].mean()
    return float((rim - slices[:, r < 0.15 * RADIUS].mean()) / rim)


def test_precorrection_flattens_the_cup_that_hardening_makes(water):
    beam = Beam.of(water, None, None)
    rule = full_rule(beam.spectrum, beam.detector)
    mu = attenuation("water", rule.energies)

    def image(r):
        # Abel's inversion of P(L), L = 2 √(R² − s²): the mean of dP/dL at L = 2 √(R² − r²) cos θ over θ
        theta = (np.arange(200) + 0.5) / 200 * math.pi / 2
        left = np.exp(-np.outer(2 * math.sqrt(RADIUS**2 - r**2) * np.cos(theta), mu)) * rule.w1
        return float(np.mean(left @ mu / left.sum(1)))

    want = 1 - image(0.08 * RADIUS) / image(0.8 * RADIUS)
    raw, flat = cupping(fdk(water)), cupping(known_spectrum.water_precorrection(water))
    # voxels of 0.04 R blur the rise at the rim
    assert raw == pytest.approx(want, rel=0.1)
    assert abs(flat) < 0.1 * raw


def test_precorrected_water_has_the_effective_value(water):
    volume = known_spectrum.water_precorrection(water)
    r = np.hypot(*positions())
    # without noise FDK on 160 views is right to well under a percent inside a cylinder
    got = volume.values.numpy()[INNER][:, r < 0.8 * RADIUS].mean()
    assert got == pytest.approx(volume.details["water_per_mm"], rel=0.01)
    # the kVp follows from the highest energy: the tube is that of the simulation
    assert volume.details["tube"]["kvp"] == pytest.approx(90.0, abs=1e-6)
    # chords of the central disc: half of the rays that meet it go further than √3 R
    assert volume.details["water_path_mm"] == pytest.approx(math.sqrt(3) * RADIUS, rel=0.05)


def test_the_table_is_monotone_and_undoes_what_the_spectrum_does(water):
    beam = Beam.of(water, None, None)
    table = beam.table()
    rule = full_rule(beam.spectrum, beam.detector)
    length = np.array([0.0, 0.3, 7.0, 55.0, 300.0])
    p = -np.log(np.exp(-np.outer(length, attenuation("water", rule.energies))) @ rule.w1)
    # linear between nodes that are L0/n apart at most; float32 holds P to 1e-6 or better
    np.testing.assert_allclose(precorrect(p.astype(np.float32), table), table.water * length, rtol=1e-4, atol=1e-6)
    many = precorrect(np.linspace(-2, 60, 5000, dtype=np.float32), table)
    assert np.all(np.diff(many) > 0)


def test_one_energy_needs_no_correction(water):
    volume = known_spectrum.water_precorrection(water, tube={"model": "mono", "kvp": 60.0})
    np.testing.assert_allclose(volume.values, fdk(water).values, atol=1e-6)


def error(volume, twin):
    return float(np.sqrt(np.mean((volume.values.numpy() - twin.values.numpy())[INNER][:, away()] ** 2)))


def test_on_aluminium_the_polynomial_comes_closer_to_the_scan_without(rods):
    scan, bare = rods
    twin, corrected = fdk(bare), bhc.bhc_poly(scan)
    # half a voxel of 10 that the mask is off bounds what the lengths can explain; measured 0.58
    assert error(corrected, twin) < 0.7 * error(fdk(scan), twin)
    details = corrected.details
    assert details["corrected"] and list(details["coefficients"]) == list(bhc.TERMS)
    assert details["residual_after"] < 0.25 * details["residual_before"]


def test_iterating_evens_out_water_between_rods_of_aluminium(rods):
    scan, _ = rods

    def spread(volume):
        values = volume.values.numpy()[INNER][:, away()]
        return float(values.std() / values.mean())

    alone, repeated = known_spectrum.water_precorrection(scan), known_spectrum.ibhc(scan, iterations=2)
    # measured 0.64 and 0.60
    assert spread(repeated) < 0.75 * spread(alone)
    assert spread(repeated) < 0.75 * spread(fdk(scan))
    assert repeated.details["view_updates"] == 3 * GEOMETRY.n_views


@pytest.mark.parametrize("mask", ["oracle", "auto"])
def test_without_metal_the_polynomial_leaves_fdk_to_the_last_bit(water, mask, monkeypatch):
    monkeypatch.setattr("ctsim.baselines.metal.Tracer.background", None)
    volume = bhc.bhc_poly(water, mask=mask)
    assert torch.equal(volume.values, fdk(water).values) and not volume.details["corrected"]


@pytest.fixture(scope="module")
def starving():
    geometry = msgspec.structs.replace(GEOMETRY, n_views=60)
    return simulated((rod(3.0, 9.0, 2.0, "Fe"),), Noise(), geometry)[0]


@pytest.mark.parametrize("name", METHODS)
def test_starved_readings_stay_finite(starving, name):
    dark = starving.counts.clone()
    dark[:, :, 40:56] = 0  # below the pedestal: P saturates
    bright = starving.counts.clone()
    bright[:, :4] = 65535  # brighter than the open field: negative P
    first = fdk(starving).values.abs().max()
    for counts in (starving.counts, dark, bright):
        volume = METHODS[name](dataclasses.replace(starving, counts=counts))
        assert volume.status is Status.OK and bool(torch.isfinite(volume.values).all())
        assert volume.values.abs().max() < 20 * first


def test_what_pictures_show_is_what_was_backprojected(rods):
    scan, _ = rods
    found = attached(bhc.bhc_poly(scan).details, scan.geometry)
    measured = line_integrals(scan, int(found["view"]))[0].numpy()
    trace, less = found["trace"], found["projection"]
    assert trace.any() and (less[~trace] == measured[~trace]).all() and (less[trace] <= measured[trace]).all()
    assert less[trace].mean() < measured[trace].mean()
    # prior and volume share a grid: there is no metal in it, but water
    assert 0 < found["prior"][scan.metal.numpy() != 0].max() < 0.05


def test_a_fit_gone_wrong_takes_no_more_than_was_measured(rods, monkeypatch):
    """As from two views, which tell little of six coefficients."""
    scan, _ = rods
    real = bhc._fit
    monkeypatch.setattr(
        bhc, "_fit", lambda *of: dataclasses.replace(fit := real(*of), coefficients=50 * fit.coefficients)
    )
    found = attached(bhc.bhc_poly(scan).details, scan.geometry)
    measured = line_integrals(scan, int(found["view"]))[0].numpy()
    trace, less = found["trace"], found["projection"]
    assert (less[trace] >= np.minimum(measured[trace], 0)).all() and (less[trace] == 0).any()


def test_where_no_pixel_of_the_trace_has_a_signal_nothing_is_fitted(starving):
    metal = Metal(mask=starving.metal.numpy() != 0, source="oracle")
    trace, counts = Trace(metal, starving), starving.counts.clone()
    for view in range(starving.geometry.n_views):
        counts.numpy()[view][trace.lengths(view) > trace.thinnest] = 0
    scan = dataclasses.replace(starving, counts=counts)
    volume = bhc.bhc_poly(scan)
    assert torch.equal(volume.values, fdk(scan).values) and volume.status is Status.OK
    assert volume.details["uncorrected_reason"] == "no pixel of the trace has a signal: the volume is FDK's"


def test_a_named_metal_is_a_material_of_its_own(starving):
    volume = known_spectrum.ibhc(starving, metal="Fe", iterations=1)
    assert volume.details["materials"] == ("water", "cortical_bone", "Fe") and volume.details["mask_status"] == "ok"
    # with metal taken for bone the volume is another
    assert not torch.equal(volume.values, known_spectrum.ibhc(starving, iterations=1).values)


@pytest.mark.parametrize(
    ("name", "setting", "words"),
    [
        ("bhc-poly", {"mask": "somewhere.tif"}, "no file 'somewhere.tif'"),
        ("bhc-poly", {"insert": "gold"}, "insert: expected one of"),
        ("bhc-poly", {"prior": "x"}, "prior: expected one of"),
        ("ibhc", {"iterations": 0}, "iterations: expected a whole number within 1 to 50, got 0"),
        ("ibhc", {"bone": "bonne"}, "bone: "),
        ("ibhc", {"bone": ""}, "bone: "),
        ("ibhc", {"metal": "Unobtainium"}, "metal: "),
        *[
            (name, setting, words)
            for name in ("water-precorrection", "ibhc")
            for setting, words in (
                ({"tube": {"kv": 90}}, "tube: .*kv"),
                ({"tube": {"kvp": -1.0}}, "tube: .*kvp must be within"),
                ({"tube": "90 kV"}, "tube: expected a table"),
                ({"tube": {"bowtie": {"center": 1.0, "edge": 9.0, "half_angle_deg": 10.0}}}, "without a bow-tie"),
                ({"detector": {"kind": "film"}}, "detector: "),
            )
        ],
    ],
)
def test_wrong_settings_are_refused_by_name(starving, name, setting, words):
    with pytest.raises(InputError, match=words):
        METHODS[name](starving, **setting)
