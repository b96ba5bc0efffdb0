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


def light(faint=0.0):
    """A ball that wanders over the panel with a core of metal, seen by the panel as shares of the open field."""
    v, u = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    out = np.empty((VIEWS, SIZE, SIZE))
    for view, turn in enumerate(2 * np.pi * np.arange(VIEWS) / VIEWS):
        r = np.hypot(v, u - 6 * np.cos(turn))
        p = 1.5 * np.sqrt(np.maximum(1 - (r / 25) ** 2, 0)) + 30 * (np.hypot(v, u - 14 * np.cos(turn)) < 5)
        out[view] = np.exp(-p - faint * np.sqrt(np.maximum(1 - (r / 38) ** 2, 0)))
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


def scan_of(share):
    """The scan of these shares of an uneven open field, photons counted."""
    open_field = I0 * np.linspace(0.8, 1.2, SIZE) * np.ones((SIZE, 1))
    counts = np.random.default_rng(0).poisson(share * open_field) + DARK
    counts, flat = (torch.from_numpy(a.astype(np.float32)) for a in (counts, open_field + DARK))
    return Scan(geometry=GEOMETRY, counts=counts, flat=flat, dark=DARK, i0=I0)


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
    0.242/σ² at most, so that this is off by 0.1·h²/8·0.242/σ² = 4.1e-4.
    """
    true = light()
    v, u = np.mgrid[-60:61, -60:61] * 1.4
    gaussian = np.exp(-4 * np.log(2) * (v**2 + u**2) / 18.0**2)
    padded = np.pad(true, ((0, 0), (60, 60), (60, 60)), mode="symmetric")
    spread = fftconvolve(padded, gaussian[None] / gaussian.sum(), mode="valid", axes=(1, 2))
    seen = lagging(0.9 * true + 0.1 * spread, [(0.04, 0.6)])
    scan = dataclasses.replace(
        scan_of(true), counts=torch.from_numpy((seen * share_of_open() + DARK).astype(np.float32))
    )
    left = share_of(without_panel(scan, Panel(lag=((0.04, 0.6),), glare=((0.1, 18.0),)))) - true
    assert np.abs(left).max() < 4.2e-4 and np.abs(seen - true)[true < 1e-6].max() > 0.02


def share_of_open():
    return I0 * np.linspace(0.8, 1.2, SIZE) * np.ones((SIZE, 1))


@pytest.mark.parametrize("share", [0.0, 0.03])
def test_a_panel_without_either_shows_none(share):
    """Not even with scatter: it spreads much wider, and adds light where glare takes it."""
    scan = scan_of(light() + share * np.exp(-((np.arange(SIZE) - 48) ** 2) / 60**2))
    panel = panel_of(scan)
    assert not panel and without_panel(scan, panel) is scan


def test_faint_matter_around_an_object_is_no_glare():
    assert panel_of(scan_of(light(faint=0.03))).glare == ()


def test_a_tube_that_flickers_or_drifts_is_no_lag():
    rng = np.random.default_rng(1)
    for course in (1 + 0.01 * rng.normal(size=VIEWS), np.linspace(0.99, 1.01, VIEWS)):
        assert panel_of(scan_of(light() * course[:, None, None])).lag == ()


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
    scene = msgspec.structs.replace(scene, phantom=phantom, scanner=scanner)
    spoilt = msgspec.structs.replace(scene, scanner=scanner)
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
