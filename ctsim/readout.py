"""Draw what the detector writes of the signal of one view after the other."""

import math

import numpy as np
from numpy.typing import NDArray

from ctsim.detector.noise import detect, detect_tigre, photons, pixel_pattern, read_out
from ctsim.detector.panel import Panel
from ctsim.rng import stream_key
from ctsim.types import Scanner

Image = NDArray[np.float32]
Moments = tuple[Image, Image]


def panel_of(scanner: Scanner) -> Panel | None:
    """Return the panel where its light spreads or comes late."""
    detector = scanner.detector
    if detector.blur is None and not detector.lag:
        return None
    return Panel(detector.blur, detector.lag, scanner.geometry.d_detector)


class Readout:
    """The detector of one scan and of its metal-free twin, whose noise comes from the streams named `stream_id`."""

    def __init__(self, scanner: Scanner, stream_id: str) -> None:
        self.scanner, self.stream_id, self.panel = scanner, stream_id, panel_of(scanner)
        self.pattern = pixel_pattern(scanner.geometry.n_detector, noise=scanner.noise, scene_id=stream_id)

    def counts(
        self,
        moments: Moments,
        k: int,
        prefix: str = "",
        *,
        largest: float = math.nan,
        known: tuple[NDArray, NDArray[np.int64]] | None = None,
    ) -> tuple[NDArray, NDArray]:
        """Draw the counts [v, u] of view k; return them, and what was drawn before the panel acted.

        `moments` (m1, m2) reach the detector; `prefix` is "", or TWIN for the twin, whose stream is the same. With
        lag, views come in order. `largest` is the scan's `largest_p`, for noise "tigre" only. `known` = (drawn, spans)
        are to be drawn again in those columns only.
        """
        m1, m2 = moments
        key, noise, i0 = stream_key(self.stream_id, "view", k), self.scanner.noise, self.scanner.i0
        if noise.model == "tigre":
            counts = detect_tigre(m1, top=largest, noise=noise, i0=i0, key=key)
            return counts, counts
        if self.panel is None:
            counts = detect(m1, m2, noise=noise, i0=i0, key=key, pattern=self.pattern, known=known)
            return counts, counts
        drawn = photons(m1, m2, noise=noise, i0=i0, key=key, known=known)
        seen = self.panel.see(f"{prefix}counts", drawn)
        return read_out(seen, noise=noise, i0=i0, key=key, pattern=self.pattern), drawn
