"""Stress rows of the reconstruction methods: every method, variants of `splat` included, on every scene of a suite.

A volume must have the grid's shape, finite values, and status ok or a stated reason; where no reading is above the
pedestal, the status must not be ok. Its values stay within π·(dso/(dso − r))²·max|P|/pitch, the closed-form bound of
FDK at radius r: the views' weights sum to 2π, the ramp's absolute values to 1/(2 pitch), and backprojection weighs by
the square. A voxel that an iterative method fits to a ray through half of it stays below this, too. Where the data
determine the object, the status must be ok; and unless the result states its `limitation`, the RMSE over the body, away
from metal, must not exceed 0.7 of an empty volume's. Elsewhere a result whose status is diverged says itself that
values ran away; they need only be finite. Of two forms of a scan with the same content a method must give the same
volume.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.beam.spectrum import TABLE_KVP
from ctsim.benchmarks.methods import MASK_AND_SPECTRUM, SPECTRUM, TABLE, TRAINED_MASK, Method, find
from ctsim.benchmarks.studies.stress import scans
from ctsim.benchmarks.studies.stress.scans import USUAL, Example, Findings, example
from ctsim.benchmarks.studies.stress.suite import BOUNDS, GROUPS, NEAR, P_SURE, Machine, Scene, same_of
from ctsim.detector.noise import Noise
from ctsim.geometry import Geometry
from ctsim.reconstruct.fdk import ramp
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.filters import padded_length, ramp_kernel
from ctsim.reconstruct.kernels.backproject_reference import backproject
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.redundancy import ray_weights
from ctsim.settings import Truth
from ctsim.types import Scan, Status, Volume


def bound(scan: Scan) -> float:
    """Return the greatest value (1/mm) that a volume of a scan may have; the module's docstring derives it."""
    g = scan.geometry
    radius = min(ray_weights(g).radius, math.hypot(*g.s_voxel[1:]) / 2)
    pitch = min(g.d_detector[1] * g.dso / g.dsd, *g.d_voxel)
    steepest = float(line_integrals(scan, slice(None))[0].abs().max())
    return math.pi * (g.dso / (g.dso - radius)) ** 2 * steepest / pitch


def on_scene(name: str, settings: dict[str, Any], scene: Scene, side: int, found: Findings) -> None:
    """Run a method on a scene and judge what it returns."""
    method, given = find(name, settings), example(scene, side)
    if method.name in TABLE and method.inputs in (SPECTRUM, MASK_AND_SPECTRUM) and given.scan.e_max > TABLE_KVP[1]:
        found.refused("kvp must be within", lambda: method.reconstruct(given.scan))
        return
    if reason := method.skip(given.scan):
        found.say(f"skipped: {reason}")
        return
    volume = _volume(method, given.scan)
    values = volume.values.numpy()
    if values.shape != given.scan.geometry.n_voxel:
        found.say(f"the volume has shape {values.shape}, the grid {given.scan.geometry.n_voxel}", holds=False)
        return
    _judge(volume, found, given, scene, BOUNDS.get(name, 1.0))
    no_metal = given.scan.metal is not None and not given.scan.metal.any()
    if name in GROUPS["by-mask"] and method.inputs != TRAINED_MASK and no_metal:  # trained ones denoise all the same
        found.same("without metal its bits and FDK's are", values, fdk(given.scan).values.numpy())
    if scene.has_other(name):
        other = example(scene, side, scene.like).scan
        factor = given.scan.geometry.dso / other.geometry.dso  # lengths may differ
        expected = _volume(method, other).values.numpy()
        off = float(np.abs(values * factor - expected).max() / max(np.abs(expected).max(), 1e-30))
        found.at_most("off the other form of the scan by", off, same_of(name))


def _volume(method: Method, scan: Scan) -> Volume:
    """Run a method; only one that declares the true mask gets it."""
    return method.reconstruct(scan if method.mask == "oracle" else dataclasses.replace(scan, metal=None))


def _judge(volume: Volume, found: Findings, given: Example, scene: Scene, bounds: float) -> None:
    values = volume.values.numpy()
    said = volume.details.get("limitation") or volume.reason
    found.finite("the volume", values)
    named = volume.status is Status.OK or (volume.status is not Status.NONFINITE and bool(volume.reason))
    wrong = volume.status is not Status.OK if scene.near else scene.unlit and volume.status is Status.OK
    found.say(str(volume.status), holds=named and not wrong)
    most = math.inf if volume.status is Status.DIVERGED else bounds
    found.at_most("greatest value over its bound", float(np.abs(values).max() / bound(given.scan)), most)
    if scene.near and not said:
        found.at_most("error over an empty volume's", given.error(values), NEAR)
    elif given.region.any():
        found.say(f"error over an empty volume's {given.error(values):.2g}")
    if said:
        found.say(f"says: {said}")


def on_any_threads(name: str, settings: dict[str, Any], side: int, found: Findings) -> None:
    """Compare the volumes of 1, 2 and all threads."""
    method, scan = find(name, settings), example(USUAL, side).scan
    found.same_on_threads("volumes", lambda: _volume(method, scan).values.numpy())


# --- the whole chain: counts and FDK in float32, closed-form P and FDK in float64 -----------------------


def fdk_in_float64(p: NDArray[np.float64], of: Geometry) -> NDArray[np.float64]:
    """Reconstruct line integrals [view, v, u] of a full turn on a centred detector: [z, y, x] in 1/mm."""
    (n_v, n_u), (d_v, d_u), weights = of.n_detector, of.d_detector, ray_weights(of)
    u, v = (np.arange(n_u) - (n_u - 1) / 2) * d_u, (np.arange(n_v) - (n_v - 1) / 2) * d_v
    cosine = of.dsd / np.sqrt(of.dsd**2 + u**2 + v[:, None] ** 2)
    spacing, n = d_u * of.dso / of.dsd, padded_length(n_u)
    weighted = p * cosine * weights.values.astype(np.float64)[:, None]
    spectrum = np.fft.rfft(weighted, n, axis=-1) * np.fft.rfft(ramp_kernel(n, spacing)).real * spacing
    filtered = np.fft.irfft(spectrum, n, axis=-1)[..., :n_u]
    volume = np.zeros(of.n_voxel)
    orbit, grid = np.array([of.dso, of.dsd, d_v, d_u, 0, 0]), np.array([*of.d_voxel, 0, 0, 0, weights.radius])
    backproject(filtered, of.angles, orbit, grid, volume)  # pyright: ignore[reportArgumentType]  float64 is not rounded
    return volume


def chain(side: int, found: Findings) -> None:
    """Compare the volumes of both chains; the limit is the simulator's |ΔP|, carried through FDK."""
    scanner = Machine(noise=Noise(model="none")).resolve(side)
    stacks, volumes = scans.simulated(USUAL.phantom(), scanner, Truth(twin=False))
    scan = scans.scan_from(stacks, volumes, scanner)
    values = ramp(scan).values.numpy()
    p = scans.exact_p(scanner, scans.lengths(USUAL, scanner.geometry))
    exact = fdk_in_float64(p, scanner.geometry)
    found.finite("the volume", values)
    limit = bound(scan) * P_SURE / p.max()
    found.at_most("volume off float64's by (1/mm)", float(np.abs(values - exact).max()), limit)
    found.say(f"greatest value {exact.max():.2g} 1/mm")
