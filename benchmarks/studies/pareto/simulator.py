"""The simulator's choices, each timed and compared with a converged scan of the same scene.

The scene is analytic: a water cylinder with a bone rod and two iron rods. The reference has the finest of every choice:
closed-form chords, 16² finer pixels a pixel of up to 64 rays each averaged in intensity, and the whole fine spectrum.
Errors are those of P = −ln(signal/open) without noise in a few views. The scatter levels stand in a group of their own,
where the reference has level 1's signal added: a constant, whose own error is not known here.
"""

import functools
import time

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.oracles import SIZE, poly_scene, relative, voxelised
from ctsim.benchmarks.studies.pareto.choices import EXACT, SCATTER, Choice
from ctsim.benchmarks.studies.pareto.finding import Mark
from ctsim.benchmarks.studies.pareto.suite import HIGHEST
from ctsim.noise import Noise
from ctsim.phantoms.scanners import preset
from ctsim.plan import Plan, make_plan
from ctsim.project import Response, Tracer, transmit
from ctsim.quadrature import full_rule
from ctsim.scatter import Scatter, open_fraction
from ctsim.settings import Truth
from ctsim.simulate import simulate_views
from ctsim.spectrum import spectrum
from ctsim.types import Phantom, Scanner

CHECKED = 2  # views that are compared with the reference
FINER, FINEST = 16, 64
"""Of the reference: finer pixels along a side of a pixel, and rays in each."""
CALM = 1e-4  # |ΔP| of the central ray alone, below which a pixel has no edge
USUALLY = Choice(curve=EXACT, label="default")


class Bench:
    """The scene with its reference and what is prepared for each choice; `side` is that of detector and grid."""

    def __init__(self, side: int, views: int) -> None:
        self.side = side
        scanner = preset("skyscan1273", views, (side, side), (side, side, side), SIZE)
        self.scanner = msgspec.structs.replace(scanner, noise=Noise(model="none"))
        self.phantom = poly_scene(side)
        self.checked = tuple(sorted({round((k + 0.5) * views / CHECKED) % views for k in range(CHECKED)}))
        self._plans: dict[Choice, tuple[Plan, Phantom, Scanner]] = {}

    def plan(self, choice: Choice) -> tuple[Plan, Phantom, Scanner]:
        """Plan a choice, once; no clock runs yet."""
        if choice not in self._plans:
            scanner = msgspec.structs.replace(self.scanner, scatter=Scatter(level=choice.level))
            phantom = self._phantom(choice.grid, choice.metal)
            plan = make_plan(phantom, scanner, choice.simulation, Truth(twin=False, noise_free=True), "pareto")
            self._plans[choice] = plan, phantom, scanner
        return self._plans[choice]

    def warm_up(self, _: Choice) -> float:
        """Run the defaults, so that compiling and the reference are not timed with a choice; return the seconds."""
        return sum(mark.seconds for mark in self.run(USUALLY))

    def run(self, choice: Choice) -> tuple[Mark, ...]:
        """Time all views of a choice and return its errors."""
        plan, phantom, scanner = self.plan(choice)
        start = time.perf_counter()
        views = [images["noise_free"] for _, images in simulate_views(plan, phantom, scanner)]
        seconds = time.perf_counter() - start
        found = np.stack([views[k] for k in self.checked])
        s = open_fraction(Scatter(level=HIGHEST), scanner.geometry) if choice.curve == SCATTER else 0.0
        label = f"{choice.label}, {len(plan.rule.energies)} energies"
        return (Mark(label=label, seconds=seconds, values=self.errors(found, s), default=choice.default),)

    def errors(self, p: NDArray[np.float32], scatter: float = 0.0) -> dict[str, float]:
        """Compare P of the checked views with the reference, to which `scatter` (S/I0) is added.

        `rms` is relative, `worst` and `off_edges` are the greatest |ΔP|, the latter where a pixel has no edge.
        """
        exact, calm = self._reference
        exact = -np.log(np.exp(-exact) + scatter)
        off = np.abs(p - exact)
        return {"rms": relative(p, exact), "worst": float(off.max()), "off_edges": float(off[calm].max())}

    @functools.cached_property
    def _reference(self) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """P of the checked views, and where the central ray alone says the same."""
        exact = self.converged(FINER, FINEST)
        return exact, np.abs(self.converged(1, 1) - exact) < CALM

    def converged(self, finer: int, subrays: int) -> NDArray[np.float64]:
        """P of the checked views, of `finer`² pixels a pixel with up to `subrays` rays each and the whole spectrum."""
        tracer, coarse = Tracer.of(self.phantom), self.scanner.geometry
        whole = full_rule(spectrum(self.scanner.tube), self.scanner.detector)
        response = Response.of(whole, tracer.materials)
        (n_v, n_u), (d_v, d_u) = coarse.n_detector, coarse.d_detector
        fine = msgspec.structs.replace(
            coarse, n_detector=(n_v * finer, n_u * finer), d_detector=(d_v / finer, d_u / finer)
        )
        out = np.empty((len(self.checked), n_v, n_u))
        for k, view in enumerate(self.checked):
            signal, _ = transmit(tracer, fine, view, response, subrays=subrays)
            out[k] = signal.reshape(n_v, finer, n_u, finer).mean((1, 3), dtype=np.float64)
        return -np.log(out)

    def _phantom(self, grid: float | None, metal: bool) -> Phantom:
        """Return the scene, or its body (and with `metal` all of it) as labels of so many voxels a pixel."""
        if grid is None:
            return self.phantom
        n = max(round(grid * self.side), 1)
        cubes = msgspec.structs.replace(
            self.scanner.geometry, n_voxel=(n, n, n), d_voxel=(SIZE / n, SIZE / n, SIZE / n)
        )
        return voxelised(self.phantom, cubes, tuple(s for s in self.phantom.solids if s.metal and not metal))
