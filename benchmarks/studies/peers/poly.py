"""The case `poly` of `run-benchmark peers`: polychromatic projections, against the signal of a pixel of finite size.

A module of its own, since it must not load torch, which would count in a contender's peak memory.
"""

import contextlib
from collections.abc import Callable

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.beam.quadrature import EnergyRule, full_rule
from ctsim.beam.spectrum import spectrum
from ctsim.benchmarks.engine import host
from ctsim.benchmarks.engine.process import Process, Stopped
from ctsim.benchmarks.oracles import measured_pixel, poly_scene, relative, scanner_of, voxelised
from ctsim.benchmarks.studies.peers.finding import OURS, RTK, XCIST, Measurement, Setup
from ctsim.benchmarks.studies.peers.libraries import Rtk, Xcist
from ctsim.materials import attenuation
from ctsim.plan import make_plan
from ctsim.settings import Simulation, Truth
from ctsim.tracer.project import Response, Tracer, transmit
from ctsim.tracer.voxelise import fractions

BINS = 80
CHECKED = 2  # views that the oracle measures
SCENES = {"water, bone, Fe": poly_scene}
NOTES = {
    f"{OURS}, exact metal in voxels": "water and bone from voxels, metal exact, sub-rays",
    f"{OURS}, exact solids": "all solids exact, sub-rays",
    RTK: f"Joseph per material, {BINS} bins in NumPy",
    XCIST: f"distance-driven per material in one thread, {BINS} bins, no oversampling, our attenuation",
}
Run = Callable[[], NDArray[np.float32]]


def eighty_bins(rule: EnergyRule) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sum a fine spectrum in at most 80 equal bins; return the mean energy (keV) and signal share of each."""
    bins = np.linspace(rule.energies[0], rule.energies[-1], BINS + 1)
    of = np.clip(np.searchsorted(bins, rule.energies, side="right") - 1, 0, BINS - 1)
    share = np.bincount(of, rule.w1, BINS)
    kept = share > 0
    energy = np.bincount(of, rule.w1 * rule.energies, BINS)[kept] / share[kept]
    return energy, np.asarray(share[kept], np.float64)


class Contenders:
    """The contenders of one scene, each prepared as a function that measures all views: [view, v, u]."""

    def __init__(self, setup: Setup, scene: str) -> None:
        self.setup, self.scanner = setup, scanner_of(setup.side, setup.views)
        self.geometry, self.phantom = self.scanner.geometry, SCENES[scene](setup.side)

    def prepare(self, name: str) -> Run:
        """Prepare a contender by its name in the table."""
        peers = {RTK: self.rtk, XCIST: self.xcist}
        return peers[name]() if name in peers else self.ours(voxels="voxels" in name)

    def ours(self, *, voxels: bool) -> Run:
        """Prepare our measurement: metal analytic, the body in voxels or analytic."""
        metal = tuple(s for s in self.phantom.solids if s.metal)
        phantom = voxelised(self.phantom, self.geometry, metal) if voxels else self.phantom
        rule = make_plan(phantom, self.scanner, Simulation(tolerance=1e-4), Truth(twin=False), "peers").rule
        tracer = Tracer.of(phantom)
        response = Response.of(rule, tracer.materials)

        def run() -> NDArray[np.float32]:
            views = range(self.geometry.n_views)
            return np.stack([-np.log(transmit(tracer, self.geometry, k, response)[0]) for k in views])

        return run

    def rtk(self) -> Run:
        """Prepare Joseph's projector on each material's volume share, and 80 bins in NumPy."""
        rtk = Rtk(self.geometry, self.setup.threads)
        shares, mu, _, weights = self._binned()
        volumes = [rtk.volume(v) for v in shares]
        w, mu = weights.astype(np.float32), mu.astype(np.float32)

        def run() -> NDArray[np.float32]:
            lengths = np.stack([rtk.project(v) for v in volumes], 1)  # [view, material, v, u]
            signal = [w @ np.exp(-(mu @ view.reshape(len(volumes), -1))) for view in lengths]
            return -np.log(np.stack(signal)).reshape(self.geometry.shape)

        return run

    def xcist(self) -> Run:
        """Prepare XCIST on each material's volume share, with the same bins and attenuation."""
        return Xcist(self.geometry, *self._binned()).project

    def _binned(self) -> tuple[list[NDArray[np.float32]], NDArray, NDArray, NDArray]:
        """Return volume shares [z, y, x], attenuation (1/mm) [bin, material], energies (keV) and signal shares."""
        names, share = self.phantom.materials[1:], fractions(self.phantom, self.geometry)
        energies, weights = eighty_bins(full_rule(spectrum(self.scanner.tube), self.scanner.detector))
        return [share[m] for m in names], np.stack([attenuation(m, energies) for m in names], 1), energies, weights


def poly(setup: Setup, scene: str) -> list[Measurement]:
    """Measure time, relative RMS of P against the measured pixel, and peak memory of each contender alone."""
    contenders = Contenders(setup, scene)
    names = [name for name in NOTES if name.startswith(OURS) or setup.measures(name)]
    timed = setup.timed({name: contenders.prepare(name) for name in names})
    checked = [round((k + 0.5) * setup.views / CHECKED) % setup.views for k in range(CHECKED)]
    oracle = measured_pixel(contenders.phantom, contenders.scanner, checked)
    return [
        msgspec.structs.replace(
            m,
            error=relative(p[checked], oracle),
            error_kind="relative RMS of P",
            peak_bytes=_alone(setup, scene, name),
            note=NOTES[name],
        )
        for name, (p, m) in timed.items()
    ]


def _alone(setup: Setup, scene: str, name: str) -> int | None:
    """Measure the peak memory in a process of its own; None if that died."""
    with Process() as process, contextlib.suppress(Stopped):
        return process.run(peak, setup, scene, name)


def peak(setup: Setup, scene: str, name: str) -> int:
    """Prepare a contender; return the peak resident memory (bytes) while it runs twice.

    It includes the interpreter, the loaded libraries and the contender's volumes.
    """
    host.use_threads(setup.threads)
    run = Contenders(setup, scene).prepare(name)
    with host.measured() as usage:
        run()
        run()
    return usage.peak_bytes
