"""Many scans of one object that differ in their noise only: the signal is simulated once, the counts are drawn often.

A draw named as a scene's noise streams are has the counts and the flat that simulating the scene gives, to the last
bit.
"""

from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.detector.noise import Noise
from ctsim.plan import Plan
from ctsim.readout import Readout
from ctsim.simulate import Scattered, Simulator, flat_image
from ctsim.types import Phantom, Scanner


@dataclass(frozen=True, slots=True, kw_only=True)
class Expectation:
    """The noise-free signal of a scan, and of its metal-free twin if the plan has one.

    `moments` [2, view, v, u] float32 are mean and second moment of each, relative to the open field. `largest` is the
    largest P of each, which noise "tigre" takes; `scatter` is that of each, None where it is not by Monte Carlo.
    """

    plan: Plan
    scanner: Scanner
    moments: tuple[NDArray[np.float32], ...]
    largest: tuple[float, ...]
    scatter: Scattered

    def counts(self, stream_id: str, *, twin: bool = False) -> NDArray:
        """Draw the counts [view, v, u], of the type the scanner writes, from the streams named `stream_id`.

        The twin's noise comes from the same streams.
        """
        readout, (m1, m2) = Readout(self.scanner, stream_id), self.moments[twin]
        views = range(self.scanner.geometry.n_views)
        return np.stack([readout.counts((m1[k], m2[k]), k, largest=self.largest[twin])[0] for k in views])

    def noise_free(self) -> "Expectation":
        """Return the same signal for a detector without noise, which writes it in float32 photons, no pedestal."""
        scanner = msgspec.structs.replace(self.scanner, noise=Noise(model="none"))
        return replace(self, scanner=scanner)

    def flat(self, stream_id: str) -> NDArray[np.float32]:
        """Draw the open-field image in counts, float32 [v, u], from the streams named `stream_id`."""
        return flat_image(replace(self.plan, stream_id=stream_id), self.scanner)


def expected(plan: Plan, phantom: Phantom, scanner: Scanner, scatter: Scattered | None = None) -> Expectation:
    """Simulate all views of a scan without noise.

    `scatter` is that of another expectation of the plan, for bodies that differ too little to scatter differently: the
    error of Monte Carlo is then the same for both.
    """
    simulator = Simulator(plan, phantom, scanner, scatter)
    views = [simulator.expected(k) for k in range(scanner.geometry.n_views)]
    return Expectation(
        plan=plan,
        scanner=scanner,
        moments=tuple(np.stack([np.stack(view[which]) for view in views], 1) for which in range(len(views[0]))),
        largest=tuple(simulator.largest),
        scatter=tuple(simulator.scatter),
    )
