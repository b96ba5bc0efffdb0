"""Few energies that stand for all: Gauss quadrature with the detected spectrum as weight.

The signal behind path lengths L is m1·Σ w1_k exp(−Σ_m μ_m(E_k) L_m), and its variance per incident photon,
over m1², Σ w2_k exp(−τ_k). Nodes come from Lanczos with full reorthogonalisation on the fine spectrum, in
intervals split at the K- and L-edges of the object (Golub and Welsch 1969, doi:10.1090/S0025-5718-69-99647-1).
"""

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ctsim.beam.spectrum import Spectrum
from ctsim.beam.trials import Beam, climb, make_trials
from ctsim.detector.response import Detector, response
from ctsim.errors import InputError
from ctsim.materials import Material, absorption_edges, attenuation

P_MAX = 14.6  # −log of the faintest signal that a rule answers for
_N_MAX = 60
_TINY = 1e-300  # a rule so short that it leaves no signal is merely very wrong
_SPLIT = 0.1  # in tolerances
_ROUGH = 16  # nodes per interval that tell P well enough to choose trials


@dataclass(frozen=True, slots=True, kw_only=True)
class EnergyRule:
    """Energies and weights of a scan.

    `w1` [N] sums to 1; `w2` [N] sums to m2/m1², so that a pixel that i0 photons would reach has the variance
    Σ w2 exp(−τ)/i0 of its signal over the open one. `mean_signal` is m1, keV per incident photon (1 for a
    counter: the share counted); `error` is the greatest |ΔP| that a search over path lengths found.
    """

    energies: NDArray[np.float64]
    w1: NDArray[np.float64]
    w2: NDArray[np.float64]
    mean_signal: float
    error: float


def full_rule(spectrum: Spectrum, detector: Detector) -> EnergyRule:
    """Return the fine spectrum itself as a rule; its error is 0 by definition."""
    a1, a2 = response(detector, spectrum.energies)
    signal = spectrum.weights * a1
    m1 = float(signal.sum())
    if not m1 > 0:
        raise InputError(f"the detector {detector.kind!r} sees nothing of a spectrum up to {spectrum.e_max:g} keV")
    kept = signal > 0
    return EnergyRule(
        energies=spectrum.energies[kept],
        w1=signal[kept] / m1,
        w2=(spectrum.weights * a2)[kept] / m1**2,
        mean_signal=m1,
        error=0.0,
    )


def energy_rule(
    spectrum: Spectrum,
    detector: Detector,
    materials: Sequence[str | Material],
    max_lengths: Sequence[float],
    tolerance: float = 1e-4,
) -> EnergyRule:
    """Return the smallest Gauss rule whose |ΔP| stays within `tolerance`.

    `max_lengths` (mm) are the longest path per material. Each alone and several at once are tried from
    P = `tolerance` to 14.6, and from the worst of them a search climbs to greater errors (`ctsim.beam.trials`). Where
    60 energies do not suffice the fine spectrum itself is the rule.
    """
    if len(materials) != len(max_lengths):
        raise InputError(f"max_lengths must have one entry per material ({len(materials)}), got {len(max_lengths)}")
    if not all(math.isfinite(v) and v >= 0 for v in max_lengths):
        raise InputError(f"max_lengths must be at least 0 mm, got {tuple(max_lengths)}")
    if not tolerance > 0:
        raise InputError(f"tolerance must be positive, got {tolerance}")
    fine = full_rule(spectrum, detector)
    if fine.energies.size == 1:
        return fine
    used = [(m, length) for m, length in zip(materials, max_lengths, strict=True) if length > 0]
    if not used:
        return replace(_gauss(fine, _intervals(fine, ()), [1]), error=0.0)
    return _Search(fine, [m for m, _ in used], tolerance).run(np.array([length for _, length in used]))


class _Search:
    """The search for a rule: it adds nodes until no path is found on which the rule is wrong."""

    def __init__(self, fine: EnergyRule, materials: list[str | Material], tolerance: float) -> None:
        self.fine, self.materials, self.tolerance = fine, materials, tolerance
        self.beam = Beam(weights=fine.w1, mu=_mu(materials, fine.energies))
        edges = absorption_edges(materials, fine.energies[0], fine.energies[-1])
        below = [float(fine.w1[fine.energies < edge].sum()) for edge in edges]
        # An edge that leaves next to no signal on one side is not worth a node of its own.
        kept = [e for e, share in zip(edges, below, strict=True) if min(share, 1 - share) > _SPLIT * tolerance]
        self.intervals = _intervals(fine, kept)
        self.sizes = [part.stop - part.start for part in self.intervals]

    def run(self, longest: NDArray[np.float64]) -> EnergyRule:
        """Return the smallest rule, or the fine spectrum where 60 energies do not suffice; `longest` [material] mm."""
        rough = self._beam([_ROUGH] * len(self.sizes))
        tried = make_trials(rough, longest, self.tolerance, P_MAX)
        counts = [1] * len(self.sizes)
        while True:
            counts, errors = self._counts(tried.lengths, counts)
            if not counts:
                return self.fine
            # Gauss rules converge so fast that one of twice the nodes serves as the exact sum while climbing.
            few, many = self._beam(counts), self._beam([2 * n + 4 for n in counts])
            worse = climb(tried, errors, functools.partial(_difference, few, many), rough, P_MAX)
            error = float(max(errors.max(), _difference(few, self.beam, worse).max()))
            if error <= self.tolerance:
                return replace(_gauss(self.fine, self.intervals, counts), error=error)
            tried = replace(tried, lengths=np.concatenate([tried.lengths, worse]))

    def _beam(self, counts: Sequence[int]) -> Beam:
        """Return the beam of the Gauss rule with `counts` nodes per interval."""
        parts = [self._nodes(i, n) for i, n in enumerate(counts)]
        nodes, weights = (np.concatenate(x) for x in zip(*parts, strict=True))
        return Beam(weights=weights, mu=_mu(self.materials, nodes))

    def _nodes(self, i: int, n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        part = self.intervals[i]
        return _lanczos(self.fine.energies[part], self.fine.w1[part], min(n, self.sizes[i]))

    def _counts(self, lengths: NDArray[np.float64], counts: list[int]) -> tuple[list[int], NDArray[np.float64]]:
        """Return nodes per interval, from `counts` up, that suffice for the trials [c, material], and errors [c].

        No nodes where more than 60 were needed.
        """
        counts = list(counts)
        depth = lengths @ self.beam.mu
        low = depth.min(axis=1)[:, None]
        parts = np.stack([np.exp(low - depth[:, p]) @ self.fine.w1[p] for p in self.intervals])
        total = parts.sum(axis=0)

        def off(i: int) -> NDArray[np.float64]:
            """Error of interval i, relative to the whole signal."""
            nodes, weights = self._nodes(i, counts[i])
            return (np.exp(low - lengths @ _mu(self.materials, nodes)) @ weights - parts[i]) / total

        # The signal is a sum over intervals, so that each one's error is its own and the worst gets the next node.
        offs = [off(i) for i in range(len(counts))]
        while True:
            errors = np.abs(np.log(np.maximum(1 + sum(offs), _TINY)))
            if errors.max() <= self.tolerance:
                return counts, errors
            if sum(counts) >= _N_MAX:
                return [], errors
            open_ = (i for i in range(len(counts)) if counts[i] < self.sizes[i])
            worst = max(open_, key=lambda i: np.max(np.abs(offs[i])))
            counts[worst] += 1
            offs[worst] = off(worst)


def _difference(a: Beam, b: Beam, lengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """|ΔP| [c] between two beams behind path lengths [c, material]."""
    return np.abs(a.log_signal(lengths) - b.log_signal(lengths))


def _mu(materials: Sequence[str | Material], energies: NDArray[np.float64]) -> NDArray[np.float64]:
    """Attenuation (1/mm) [material, energy], also of no materials."""
    return np.array([attenuation(m, energies) for m in materials]).reshape(len(materials), energies.size)


def gauss_rule(spectrum: Spectrum, detector: Detector, n: int, edges: Sequence[float] = ()) -> EnergyRule:
    """Return the Gauss rule with `n` energies in every interval between `edges` (keV); its error is not measured."""
    fine = full_rule(spectrum, detector)
    intervals = _intervals(fine, edges)
    return _gauss(fine, intervals, (n,) * len(intervals))


def effective_weights(
    spectrum: Spectrum, detector: Detector, water_length: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return energies [n] and ω [n] ∝ S·a1·exp(−μ_water·`water_length` mm), sum 1: the effective spectrum."""
    if not (math.isfinite(water_length) and water_length >= 0):
        raise InputError(f"water_length must be at least 0 mm, got {water_length}")
    fine = full_rule(spectrum, detector)
    depth = attenuation("water", fine.energies) * water_length
    weights = fine.w1 * np.exp(depth.min() - depth)
    return fine.energies, weights / weights.sum()


def _intervals(fine: EnergyRule, edges: Sequence[float]) -> list[slice]:
    cuts = np.unique(np.concatenate([[0], np.searchsorted(fine.energies, edges), [fine.energies.size]])).astype(int)
    return [slice(a, b) for a, b in itertools.pairwise(cuts)]


def _gauss(fine: EnergyRule, intervals: list[slice], counts: Sequence[int]) -> EnergyRule:
    energies, w1, w2 = [], [], []
    for part, n in zip(intervals, counts, strict=True):
        e, w = fine.energies[part], fine.w1[part]
        nodes, weights = _lanczos(e, w, min(n, e.size))
        # a2/a1 at the nodes, least squares with the weight w1 and orthogonal polynomials, keeps the moments of m2.
        energies.append(nodes)
        w1.append(weights)
        w2.append(weights * _project(e, w, fine.w2[part] / w, nodes, weights))
    return EnergyRule(
        energies=np.concatenate(energies),
        w1=np.concatenate(w1),
        w2=np.concatenate(w2),
        mean_signal=fine.mean_signal,
        error=math.nan,
    )


def _lanczos(x: NDArray[np.float64], w: NDArray[np.float64], n: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Nodes and weights [n] of the Gauss rule of the discrete measure w at x."""
    total = w.sum()
    q = np.zeros((n, x.size))
    q[0] = np.sqrt(w / total)
    alpha, beta = np.zeros(n), np.zeros(max(n - 1, 0))
    for k in range(n):
        v = x * q[k]
        alpha[k] = q[k] @ v
        if k + 1 == n:
            break
        for _ in range(2):  # twice is enough (Parlett): orthogonal to all before, to rounding
            v = v - q[: k + 1].T @ (q[: k + 1] @ v)
        beta[k] = np.linalg.norm(v)
        q[k + 1] = v / beta[k]
    jacobi = np.diag(alpha) + np.diag(beta, 1) + np.diag(beta, -1)
    nodes, vectors = np.linalg.eigh(jacobi)
    return nodes, total * vectors[0] ** 2


def _project(
    x: NDArray[np.float64],
    w: NDArray[np.float64],
    f: NDArray[np.float64],
    nodes: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Values [n] at the nodes of f's w-orthogonal projection on polynomials of degree < n.

    With them Σ w_k f_k p(x_k) equals the fine sum of w·f·p for every polynomial p of degree < n.
    """
    # Lagrange polynomials of the nodes are orthogonal under w: (ℓ_k, ℓ_k) = w_k.
    difference = x[:, None] - nodes
    basis = np.ones((x.size, nodes.size))
    for k in range(nodes.size):
        for j in range(nodes.size):
            if j != k:
                basis[:, k] *= difference[:, j] / (nodes[k] - nodes[j])
    return (w * f) @ basis / weights
