"""Case 5 of `run-benchmark peers`: polychromatic projections, against what a pixel of finite size measures."""

import sys
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.engine import apart, host
from ctsim.benchmarks.engine.host import in_turns
from ctsim.benchmarks.oracles import measured_pixel, poly_scene, relative, voxelised
from ctsim.benchmarks.studies.peers import catalogue as peer_catalogue
from ctsim.benchmarks.studies.peers import rtk as peer_rtk
from ctsim.benchmarks.studies.peers import xcist as peer_xcist
from ctsim.benchmarks.studies.peers.cases import (
    OURS,
    RTK,
    XCIST,
    Measurement,
    Setup,
    left_out,
)
from ctsim.materials import attenuation
from ctsim.plan import make_plan
from ctsim.project import Response, Tracer, transmit
from ctsim.quadrature import EnergyRule, full_rule
from ctsim.settings import Simulation, Truth
from ctsim.spectrum import spectrum
from ctsim.voxelise import fractions

BINS = 80
CHECKED = 2  # views that the oracle measures


SCENES = {"water, bone, Fe": poly_scene}


def eighty_bins(rule: EnergyRule) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gather a fine spectrum in at most 80 equal bins: mean energy (keV) and signal share of each."""
    bins = np.linspace(rule.energies[0], rule.energies[-1], BINS + 1)
    of = np.clip(np.searchsorted(bins, rule.energies, side="right") - 1, 0, BINS - 1)
    share = np.bincount(of, rule.w1, BINS)
    kept = share > 0
    energy = np.bincount(of, rule.w1 * rule.energies, BINS)[kept] / share[kept]
    return energy, np.asarray(share[kept], np.float64)


class Contenders:
    """The polychromatic contenders of one scene, each prepared as a function that measures all views: [view, v, u]."""

    def __init__(self, setup: Setup, scene: str) -> None:
        self.setup, self.scanner = setup, setup.scanner(setup.views(peer_catalogue.case("poly")))
        self.geometry, self.phantom = self.scanner.geometry, SCENES[scene](setup.n)

    def ours(self, *, voxels: bool) -> Callable[[], NDArray[np.float32]]:
        """Prepare our measurement, the body in voxels or analytic as the metal always is."""
        metal = tuple(s for s in self.phantom.solids if s.metal)
        phantom = voxelised(self.phantom, self.geometry, metal) if voxels else self.phantom
        rule = make_plan(phantom, self.scanner, Simulation(tolerance=1e-4), Truth(twin=False), "peers").rule
        tracer = Tracer.of(phantom)
        response = Response.of(rule, tracer.materials)

        def run() -> NDArray[np.float32]:
            views = range(self.geometry.n_views)
            return np.stack([-np.log(transmit(tracer, self.geometry, k, response)[0]) for k in views])

        return run

    def rtk(self) -> Callable[[], NDArray[np.float32]]:
        """Prepare Joseph's projector on each material's volume share, and 80 bins in NumPy."""
        rtk = peer_rtk.Rtk(self.geometry, self.setup.threads)
        volumes = [rtk.volume(v) for v in self._shares()]
        _, weights, mu = self._bins()
        w, mu = weights.astype(np.float32), mu.astype(np.float32)

        def run() -> NDArray[np.float32]:
            lengths = np.stack([rtk.project(v) for v in volumes], 1)  # [view, material, v, u]
            signal = [w @ np.exp(-(mu @ view.reshape(len(volumes), -1))) for view in lengths]
            return -np.log(np.stack(signal)).reshape(self.geometry.shape)

        return run

    def xcist(self) -> Callable[[], NDArray[np.float32]]:
        """Prepare XCIST on each material's volume share, with the same bins and attenuation."""
        energies, weights, mu = self._bins()
        return peer_xcist.Xcist(self.geometry, self._shares(), mu, energies, weights).project

    def prepare(self, contender: str) -> Callable[[], NDArray[np.float32]]:
        """Prepare a contender by its name in the table."""
        peers = {RTK: self.rtk, XCIST: self.xcist}
        return peers[contender]() if contender in peers else self.ours(voxels="voxels" in contender)

    def _shares(self) -> list[NDArray[np.float32]]:
        share = fractions(self.phantom, self.geometry)
        return [share[m] for m in self.phantom.materials[1:]]

    def _bins(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Energies (keV) and signal shares [bin], attenuation (1/mm) [bin, material]."""
        energies, weights = eighty_bins(full_rule(spectrum(self.scanner.tube), self.scanner.detector))
        return energies, weights, np.stack([attenuation(m, energies) for m in self.phantom.materials[1:]], 1)


NOTES = {
    f"{OURS}, exact metal in voxels": "water and bone from voxels, metal exact, sub-rays",
    f"{OURS}, exact solids": "all solids exact, sub-rays",
    RTK: f"Joseph per material, {BINS} bins in NumPy",
    XCIST: f"distance-driven per material in one thread, {BINS} bins, no oversampling, our attenuation",
}


def poly(setup: Setup) -> list[Measurement]:
    """Case 5: time, relative RMS of P against the measured pixel, and peak memory of each contender alone."""
    return [one for scene in peer_catalogue.case("poly").scenes for one in _poly(setup, scene)]


def _poly(setup: Setup, scene: str) -> list[Measurement]:
    case, contenders = peer_catalogue.case("poly"), Contenders(setup, scene)
    n_views = contenders.geometry.n_views
    checked = tuple(round((k + 0.5) * n_views / CHECKED) % n_views for k in range(CHECKED))
    names = [name for name in NOTES if name.startswith(OURS) or setup.measures(case, name)]
    runs = {name: contenders.prepare(name) for name in names}
    timed = in_turns(runs, setup.repeats)
    oracle = measured_pixel(contenders.phantom, contenders.scanner, checked)
    out = []
    for name, run in runs.items():
        first, seconds = timed[name]
        out.append(
            Measurement(
                case="poly",
                scene=scene,
                contender=name,
                seconds=seconds,
                views=n_views,
                warm_up=first,
                error=relative(run()[list(checked)], oracle),
                error_kind="relative RMS of P",
                peak_bytes=_alone(setup, scene, name),
                note=NOTES[name],
            )
        )
    return out + left_out(setup, case, scene)


def _tell_peak(setup: Setup, scene: str, contender: str) -> None:
    """Be a process: prepare a contender, then say the peak resident memory (bytes) while it runs twice.

    It holds the interpreter and the libraries that are loaded, and the contender's volumes.
    """
    host.use_threads(setup.threads)
    run = Contenders(setup, scene).prepare(contender)
    with host.measured() as usage:
        run()
        run()
    sys.stdout.write(f"\n{usage.peak_bytes}\n")


def _alone(setup: Setup, scene: str, contender: str) -> int | None:
    """Measure the peak memory in a process of its own; None where that failed."""
    done = apart.call(_tell_peak, setup, scene, contender)
    return int(done.stdout.split()[-1]) if done.returncode == 0 else None
