"""Lag and glare found in a scan and taken off: against scans that are spoilt here, by kernels that are not assumed."""

import dataclasses

import msgspec
import numpy as np
import pytest
import torch
from scipy.signal import fftconvolve

from ctsim import find_scene, reconstruct_scan, simulate_scene
from ctsim.benchmarks.methods import find
from ctsim.detector.panel import Blur, Lag
from ctsim.detector.response import Detector
from ctsim.geometry import Geometry
from ctsim.reconstruct.panel import Panel, panel_of, without_panel
from ctsim.reconstruct.starved import Below
from ctsim.types import Scan

VIEWS, SIZE, I0, DARK = 90, 96, 1e5, 40.0
GEOMETRY = Geometry(
    dso=250.0,
    dsd=500.0,
    n_voxel=(48, 48, 48),
    d_voxel=(1.0, 1.0, 1.0),
    n_detector=(SIZE, SIZE),
    d_detector=(1.4, 1.4),
    n_views=VIEWS,
)
IDEAL = Detector(kind="csi", thickness=0.6, blur=Blur(fwhm=0.37), lag=(Lag(share=1e-9, decay=0.0),))
"""The dental panel without glare and with next to no lag; none would be the preset's."""


def light(faint=0.0, metal=30.0):
    """A ball that wanders over the panel with a core of metal, seen by the panel as shares of the open field."""
    v, u = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    out = np.empty((VIEWS, SIZE, SIZE))
    for view, turn in enumerate(2 * np.pi * np.arange(VIEWS) / VIEWS):
        r = np.hypot(v, u - 6 * np.cos(turn))
        inner = 1.5 * np.sqrt(np.maximum(1 - (r / 25) ** 2, 0)) + metal * (np.hypot(v, u - 14 * np.cos(turn)) < 5)
        out[view] = np.exp(-inner - faint * np.sqrt(np.maximum(1 - (r / 38) ** 2, 0)))
    return out


def kernel(radius):
    """Seibert's: exp(−r/k)/r, here with k = 8 mm; no sum of Gaussians."""
    v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1] * 1.4
    r = np.maximum(np.hypot(v, u), 0.5)
    shape = np.exp(-r / 8) / r
    return shape / shape.sum()


def glaring(images, share):
    padded = np.pad(images, ((0, 0), (40, 40), (40, 40)), mode="symmetric")
    return (1 - share) * images + share * fftconvolve(padded, kernel(40)[None], mode="valid", axes=(1, 2))


def lagging(images, parts, before=0.0):
    """Light of each view in the views after it, by the definition; `before` was seen in all earlier views."""
    out, n = (1 - sum(share for share, _ in parts)) * images, np.arange(1, 400)
    for share, decay in parts:
        late = share * (1 - decay) * decay ** (n - 1.0)
        for view in range(VIEWS):
            out[view] += np.tensordot(late[:view], images[view - 1 :: -1] if view else images[:0], 1)
            out[view] += before * late[view:].sum()
    return out


def scan_of(share, photons=I0, noise=0.0, field=None):
    """The scan of these shares of an open field, uneven by default; photons are counted, electronics add noise."""
    rng = np.random.default_rng(0)
    open_field = share_of_open() if field is None else I0 * field
    counts = (
        rng.poisson(share * open_field * photons / I0) * (I0 / photons) + noise * rng.normal(size=share.shape) + DARK
    )
    counts, flat = (torch.from_numpy(a.astype(np.float32)) for a in (counts, open_field + DARK))
    return Scan(geometry=GEOMETRY, counts=counts, flat=flat, dark=DARK, i0=photons)


def share_of(scan):
    return (scan.counts.numpy() - DARK) / (scan.flat.numpy() - DARK)


def total(parts):
    return sum(share for share, _ in parts)


def test_glare_and_lag_of_unknown_kernels_are_found_and_taken_off():
    true = light()
    scan = scan_of(lagging(glaring(true, 0.08), [(0.03, 0.4), (0.02, 0.78)]))
    panel = panel_of(scan)
    assert total(panel.lag) == pytest.approx(0.05, abs=0.003)
    dark = true < 1e-6
    dark[:, 1:-1, 1:-1] &= dark[:, :-2, 1:-1] & dark[:, 2:, 1:-1] & dark[:, 1:-1, :-2] & dark[:, 1:-1, 2:]
    before, after = ((share_of(s) - true)[dark] for s in (scan, without_panel(scan, panel)))
    assert before.mean() > 0.01 and abs(after.mean()) < 0.2 * before.mean()
    first = [abs(float((share_of(s) - true)[0][true[0] == 1].mean())) for s in (scan, without_panel(scan, panel))]
    assert first[0] > 0.05 and first[1] < 0.1 * first[0]


def test_what_is_told_is_taken_off_exactly():
    """Gaussians and exponentials of any width and decay; noise aside there is nothing else in the readings.

    Glare is looked up on lines between blocks of h = 2.8 mm: the second derivative of an edge that a Gaussian blurs is
    0.242/σ² at most, so that light is off by 0.1/0.9·h²/8·0.242/σ² = 4.6e-4.
    """
    true, field = light(), share_of_open()
    v, u = np.mgrid[-60:61, -60:61] * 1.4
    gaussian = np.exp(-4 * np.log(2) * (v**2 + u**2) / 18.0**2)[None]

    def spread(signal):
        padded = np.pad(signal, ((0, 0), (60, 60), (60, 60)), mode="symmetric")
        return 0.9 * signal + 0.1 * fftconvolve(padded, gaussian / gaussian.sum(), mode="valid", axes=(1, 2))

    flat = spread(field[None])
    seen = lagging(spread(true * field), [(0.04, 0.6)])
    counts, open_field = (torch.from_numpy((a + DARK).astype(np.float32)) for a in (seen, flat[0]))
    scan = dataclasses.replace(scan_of(true), counts=counts, flat=open_field)
    left = share_of(without_panel(scan, Panel(lag=((0.04, 0.6),), glare=((0.1, 18.0),)))) - true
    assert np.abs(left).max() < 4.6e-4 and np.abs(seen / flat - true)[true < 1e-6].max() > 0.02


def share_of_open():
    return I0 * np.linspace(0.8, 1.2, SIZE) * np.ones((SIZE, 1))


@pytest.mark.parametrize("share", [0.0, 0.03])
def test_a_panel_without_either_shows_none(share):
    """Not even with scatter: it spreads much wider, and adds light where glare takes it."""
    scan = scan_of(light() + share * np.exp(-((np.arange(SIZE) - 48) ** 2) / 60**2))
    panel = panel_of(scan)
    assert not panel and without_panel(scan, panel) is scan


def test_faint_matter_around_an_object_is_no_glare_where_a_shadow_says_so():
    assert panel_of(scan_of(light(faint=0.03))).glare == ()


def test_glare_that_no_shadow_confirms_has_a_limitation():
    panels = [panel_of(scan_of(glaring(light(metal=metal), 0.08))) for metal in (30.0, 0.0)]
    assert [bool(panel.glare) for panel in panels] == [True, True]
    assert panels[0].sentence == "" and "no dark shadow confirms" in panels[1].sentence


@pytest.mark.parametrize("photons", [1e4, 1e5])
def test_glare_is_found_whatever_the_dose(photons):
    """A block's own noise in what it is explained by would halve what is found with 1e4 photons."""
    images = glaring(light(), 0.08)
    true = panel_of(scan_of(images, photons=1e7))
    assert total(panel_of(scan_of(images, photons=photons)).glare) == pytest.approx(total(true.glare), rel=0.15)


def test_an_open_field_that_is_uneven_has_glare_of_its_own():
    """As behind a bow-tie: signals spread, not their shares of the open field."""
    field = np.ones((SIZE, 1)) * np.exp(-2 * ((np.arange(SIZE) - 47.5) / 48) ** 2)
    true, spread = light(), glaring(field[None], 0.08)[0]
    scan = scan_of(glaring(true * field, 0.08) / spread, photons=1e9, field=spread)
    off = [share_of(s)[true < 1e-6].mean() for s in (scan, without_panel(scan, panel_of(scan)))]
    assert off[0] > 0.01 and abs(off[1]) < 0.2 * off[0]


def test_noise_below_the_dark_level_stays_and_says_how_dark_readings_may_be():
    scan = scan_of(glaring(light(), 0.08), noise=30.0)
    left = without_panel(scan, panel_of(scan))
    assert Below.of(left).noise > 20 / I0 > Below.of(scan).noise
    kept = without_panel(scan, panel_of(scan), kept=0.1)
    assert bool((kept.counts >= torch.minimum(scan.counts, torch.tensor(DARK)) - 1e-3).all())


@pytest.mark.parametrize("lost", ["a view", "a row", "a dark view"])
def test_lost_readings_do_not_hide_the_glare(lost):
    scan = scan_of(lagging(glaring(light(), 0.08), [(0.05, 0.6)]))
    true = panel_of(scan)
    if lost == "a row":
        scan.counts[:, 7] = torch.nan
    else:
        scan.counts[0] = torch.nan if lost == "a view" else DARK
    found = panel_of(scan)
    assert total(found.glare) == pytest.approx(total(true.glare), rel=0.1)
    assert total(found.lag) == pytest.approx(total(true.lag), abs=0.01)


def test_dead_pixels_have_the_light_of_their_neighbours():
    true = light()
    scan = scan_of(glaring(true, 0.08), photons=1e9)
    flat = scan.flat.clone()
    flat[44:52, 54:60] = DARK
    dead = dataclasses.replace(scan, flat=flat, counts=torch.where(flat > DARK, scan.counts, DARK))
    panel = panel_of(scan)
    away = (true < 1e-6) & (flat.numpy() > DARK)
    whole, left = (without_panel(s, panel).counts.numpy()[away] / I0 for s in (scan, dead))
    assert abs(float((left - whole).mean())) < 2e-4


def test_a_short_scan_or_a_tiny_panel_says_nothing_and_stays():
    for views, shape in ((1, (SIZE, SIZE)), (39, (SIZE, SIZE)), (VIEWS, (1, SIZE)), (VIEWS, (1, 1)), (VIEWS, (3, 3))):
        geometry = msgspec.structs.replace(GEOMETRY, n_views=views, n_detector=shape)
        counts = torch.from_numpy(light()[:views, : shape[0], : shape[1]] * I0).to(torch.uint16)
        scan = Scan(geometry=geometry, counts=counts, flat=torch.full(shape, I0), i0=I0)
        assert panel_of(scan).lag == () and without_panel(scan, Panel()) is scan
        left = without_panel(scan, Panel(lag=((0.03, 0.5),), glare=((0.05, 12.0),)))
        assert left.counts.dtype == torch.float32 and bool(left.counts.isfinite().all())


def test_a_tube_that_flickers_or_drifts_is_no_lag():
    rng = np.random.default_rng(1)
    walk = 1 + np.cumsum(0.001 * rng.normal(size=VIEWS))
    for course in (1 + 0.01 * rng.normal(size=VIEWS), walk, np.linspace(0.99, 1.01, VIEWS)):
        assert panel_of(scan_of(light() * course[:, None, None])).lag == ()


def test_few_views_are_too_few_to_tell_lag_from_flicker():
    rng = np.random.default_rng(1)
    shares = light()[:42] * (1 + 0.01 * rng.normal(size=(8, 42)))[..., None, None]
    geometry = msgspec.structs.replace(GEOMETRY, n_views=42)
    flat = torch.full((SIZE, SIZE), I0)
    for share in shares:
        counts = torch.from_numpy((I0 * share).astype(np.float32))
        assert panel_of(Scan(geometry=geometry, counts=counts, flat=flat, i0=I0)).lag == ()


def test_lag_of_a_panel_that_was_lit_before_is_not_found():
    scan = scan_of(lagging(light(), [(0.04, 0.6)], before=1.0))
    assert panel_of(scan).lag == ()


def test_lost_readings_stay_and_do_not_spread():
    true = light()
    scan = scan_of(lagging(glaring(true, 0.08), [(0.04, 0.6)]))
    panel = panel_of(scan)
    lost = torch.zeros(scan.counts.shape, dtype=torch.bool)
    lost[5, 10, 10], lost[:, 20, 30], lost[40] = True, True, True
    counts = torch.where(lost, torch.nan, scan.counts)
    flat = scan.flat.clone()
    flat[50, 60] = DARK
    left = without_panel(dataclasses.replace(scan, counts=counts, flat=flat), panel).counts
    assert bool(left[lost].isnan().all()) and torch.equal(left[:40, 50, 60], scan.counts[:40, 50, 60])
    alive = ~lost
    alive[:, 50, 60] = False
    whole = without_panel(scan, panel).counts
    assert bool(left[alive].isfinite().all())
    # a lost view is taken for the one before it, whose light moved by a pixel at most
    assert torch.allclose(left[alive], whole[alive], atol=0.04 * I0) and float((left - whole)[alive].abs().mean()) < 50


def test_some_of_each_reading_is_kept():
    scan = scan_of(glaring(light(), 0.08))
    left, read = (share_of(s) for s in (without_panel(scan, Panel(glare=((0.3, 20.0),)), kept=0.1), scan))
    assert (left >= 0.0999 * read).all() and (left < 0.101 * read).any()


def test_too_few_open_pixels_tell_nothing():
    assert not panel_of(scan_of(0.5 * glaring(light(), 0.08)))


@pytest.fixture(scope="module")
def scans():
    """A jaw on a dental scanner, whose panel lags and glares, and the same on a panel that does neither."""
    scene = find_scene("headline", "jaw-mixed")
    scanner = msgspec.structs.replace(scene.scanner, n_views=90, n_detector=(96, 96), n_voxel=(48, 48, 48))
    phantom = msgspec.structs.replace(scene.phantom, n_voxel=(73, 73, 73))
    simulation = msgspec.structs.replace(scene.simulation, scatter_error=0.5, spot_error=0.5)
    truth = msgspec.structs.replace(scene.truth, twin=False)
    spoilt = msgspec.structs.replace(scene, phantom=phantom, scanner=scanner, simulation=simulation, truth=truth)
    ideal = msgspec.structs.replace(spoilt, scanner=msgspec.structs.replace(scanner, detector=IDEAL))
    return spoilt.resolve().detector, [simulate_scene(one) for one in (spoilt, ideal)]


def test_the_simulators_panel_is_found(scans):
    detector, (spoilt, ideal) = scans
    panel = panel_of(spoilt.scan)
    assert total(panel.glare) == pytest.approx(detector.blur.tail, rel=0.15)
    assert total(panel.lag) == pytest.approx(sum(part.share for part in detector.lag), rel=0.15)
    assert not panel_of(ideal.scan)


@pytest.mark.parametrize("name", ["fdk", "nmar", "sirt"])
def test_every_method_is_offered_it(scans, name):
    _, (spoilt, ideal) = scans
    assert find(name).params["panel"] == "ideal" and find("splat").params["panel"] == "found"
    true, left, found = (
        reconstruct_scan(scan, name, panel=panel)
        for scan, panel in ((ideal, "ideal"), (spoilt, "ideal"), (spoilt, "found"))
    )
    dense = spoilt.metal > 0
    off = [abs(float((volume.values - true.values).numpy()[dense].mean())) for volume in (left, found)]
    assert off[1] < 0.5 * off[0] and found.details["panel"]["glare"] and "panel" not in left.details
