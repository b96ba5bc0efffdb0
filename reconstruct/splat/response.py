"""The scanner's polychromatic response: what a ray's two path values do to its line integral.

P = −log Σ_k η_k exp(−a_k La − b_k Lb) with Σ η = 1. La and Lb (unitless) are line integrals of the densities ρa
and ρb, so that a ray attenuates like ρa·a(E) + ρb·b(E). Energies are keV; Ē = E/E₀ with E₀ = (10 + e_max)/2, so
that the range 10…e_max becomes [1 − γ, 1 + γ], γ = (e_max − 10)/(e_max + 10). Basis "paper": a = 1, b = Ē⁻³, hence
P = La + φ(Lb); "klein-nishina": a = KN(E)/KN(E₀), b = Ē⁻³.

P does not change under b → c·b + d·a, ρb → ρb/c, ρa → ρa − (d/c)·ρb: the data fix neither ρa nor ρb, but they do
fix `tangent`. η_k is weights_k·h_k(θ), normalised; h is the response's form, weights are those of the quadrature.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from ctsim.beam.quadrature import P_MAX, gauss_rule
from ctsim.beam.spectrum import Filter, Spectrum, Tube
from ctsim.beam.spectrum import spectrum as tube_spectrum
from ctsim.detector.response import Detector
from ctsim.detector.response import response as deposit
from ctsim.errors import InputError
from ctsim.materials import attenuation
from ctsim.reconstruct.splat.kernels import response_cpu, response_reference

Name = Literal["paper", "hinge", "tube", "known", "mono", "sinh", "gmm", "free"]
Basis = Literal["paper", "klein-nishina"]
Array = NDArray[np.float64]
Image = NDArray[np.float32]

SOFTEST = 10.0  # keV, below which no photon counts
TOLERANCE = 1e-4  # of P, to which a known spectrum is reduced
START = (0.2, 1.0)  # the paper's r and Ē_th
SCINTILLATOR = Detector(kind="gos", thickness=0.2)
ELECTRON_REST = 510.998950  # keV
MOST_NODES = 64
_SMOOTH = 0.05  # width in Ē of the hinge
_PEAKS = 5
_RELATIVE_WIDTH = 0.5  # ε of "sinh"; ρb/ε is all that the data know, so that no other value fits better
FILTER = (0.1, 1.0, 20.0)
"""Filtration (mm of aluminium) of "tube": least unless it starts thinner, usual start, most.

The nodes are those of Gauss behind the least."""
STOPPED = 5.0  # keV, below which photons count as stopped by air and windows where a start is thinner
_NODES: dict[Name, int] = {"paper": 15, "hinge": 10, "tube": 14, "mono": 1, "sinh": 16, "gmm": 15, "free": 15}


@dataclass(frozen=True, slots=True, kw_only=True)
class Response:
    """Nodes of a response: `energies_kev`, `a`, `b`, quadrature `weights` and `eta` (sum 1), each float64 [node].

    `trainable` is θ [T], empty where nothing is to be learned; `make_response` says what it holds. `thinnest` is the
    least filtration (mm) of "tube".
    """

    name: Name
    basis: Basis
    e_max: float
    energies_kev: Array
    a: Array
    b: Array
    weights: Array
    eta: Array
    trainable: tuple[float, ...] = ()
    thinnest: float = FILTER[0]

    def described(self) -> dict[str, Any]:
        """Return what P is computed from in the types of JSON: names, θ as "theta", and lists over the nodes."""
        nodes = {"energies_kev": self.energies_kev, "a": self.a, "b": self.b, "eta": self.eta}
        head = {"name": self.name, "theta": list(self.trainable), "basis": self.basis, "e_max": self.e_max}
        return head | {name: values.tolist() for name, values in nodes.items()}

    def bounds(self) -> Array:
        """Return the least and the greatest value of every parameter [T, 2]."""
        return _bounds(self.name, self.eta.size, self.e_max, self.thinnest)

    def with_theta(self, theta: Sequence[float]) -> "Response":
        """Return the response at another θ; raises InputError outside `bounds`."""
        values = _checked(self.name, self.bounds(), theta)
        h, _ = _form(self.name, self.energies_kev, self.e_max, values)
        return dataclasses.replace(self, eta=_normalised(self.weights * h), trainable=values)

    def eta_gradient(self) -> Array:
        """Return dη_k/dθ_t [T, node]; every row sums to 0."""
        h, dh = _form(self.name, self.energies_kev, self.e_max, self.trainable)
        change = dh * self.weights
        return (change - change.sum(1)[:, None] * self.eta) / (self.weights @ h)


def make_response(
    name: Name,
    *,
    e_max: float,
    basis: Basis = "paper",
    nodes: int | None = None,
    theta: Sequence[float] | None = None,
    spectrum: tuple[ArrayLike, ArrayLike] | None = None,
    detector: Detector | None = None,
) -> Response:
    """Build a response for photons up to `e_max` keV; `nodes` is their number, `theta` the start of what is learned.

    - "paper": θ = (r, Ē_th), from (0.2, 1); a linear decay that fades into a plateau by a sigmoid of unit width;
      15 uniform nodes, both ends included. Taken literally the form is negative above about Ē = 1.55 (at 90 keV and
      the start values); it is clamped to 0 there, and so is its gradient. The sum is far from converged.
    - "hinge": θ = (r, Ē_th), the same idea, positive and less smooth, 10 Gauss–Legendre nodes.
    - "tube": θ = (t,), equivalent aluminium (mm): Finkelshtein and Pavlova's tube at kVp = `e_max` behind t, seen by
      `detector`, None for 0.2 mm of GOS; 14 Gauss nodes that stay when t changes: with GOS P within 2e-4 for 60 to
      140 kVp and t of 0.1 to 20. A start below 0.1 has nodes of its own and is the least t from then on: with GOS P
      within 0.02 of that of the photons above 5 keV.
    - "known": nothing to learn; `spectrum` is (energies keV, share of the detected signal), reduced to the fewest
      Gauss nodes that keep P within 1e-4 up to P = 14.6, or to `nodes`.
    - "mono": one node at Ē = 1.
    - "sinh": φ(b) = b − log(sinh(εb)/(εb)), ε = 0.5, after Park et al.: uniform in Ē⁻³, 16 nodes; basis "paper" only.
    - "gmm": θ = five log amplitudes, means (Ē) and log widths, in this order; nodes as in "paper".
    - "free": θ = a logit per node; nodes as in "paper".

    Raises InputError for what it does not know, for θ outside `bounds`, and for a spectrum that is not one.
    """
    _check_call(name, e_max, basis, nodes, spectrum is not None)
    if detector is not None and name != "tube":
        raise InputError(f"detector: only for response 'tube', got it with response {name!r}")
    thinnest = max(0.0, min((FILTER[0], *(() if theta is None else theta))))
    if spectrum is not None:
        energies, weights = _reduced(_signal(spectrum, e_max), basis, e_max, nodes)
    elif name == "tube":
        n = _NODES[name] if nodes is None else nodes
        energies, weights = _behind(thinnest, e_max, detector or SCINTILLATOR, n)
    else:
        energies, weights = _quadrature(name, e_max, _NODES[name] if nodes is None else nodes)
    start = _start(name, energies, e_max) if theta is None else theta
    values = _checked(name, _bounds(name, energies.size, e_max, thinnest), start)
    a, b = basis_functions(energies, basis, e_max)
    h, _ = _form(name, energies, e_max, values)
    return Response(
        name=name,
        basis=basis,
        e_max=float(e_max),
        energies_kev=energies,
        a=a,
        b=b,
        weights=weights,
        eta=_normalised(weights * h),
        trainable=values,
        thinnest=thinnest,
    )


def basis_functions(energies: ArrayLike, basis: Basis, e_max: float) -> tuple[Array, Array]:
    """Return a(E) and b(E) [n] at energies (keV) [n]; both are 1 at Ē = 1."""
    e = np.asarray(energies, np.float64)
    center = _center(e_max)
    a = np.ones_like(e) if basis == "paper" else _klein_nishina(e) / _klein_nishina(np.array(center))
    return a, (e / center) ** -3


def evaluate(response: Response, la: Image, lb: Image) -> tuple[Image, Image, Image]:
    """Return P, dP/dLa and dP/dLb, float32 in the shape of `la` and `lb`, which must be float32 of one shape.

    Finite for all finite values that are not negative, up to 1e4 and beyond; a little below 0 they count as they are.
    """
    _check_images(la, lb)
    flat = (np.ascontiguousarray(v).reshape(-1) for v in (la, lb))
    p, dp_da, dp_db = response_cpu.evaluate(response.a, response.b, response.eta, *flat)
    return p.reshape(la.shape), dp_da.reshape(la.shape), dp_db.reshape(la.shape)


def theta_sums(response: Response, la: Image, lb: Image, g: Image) -> Array:
    """Return Σ over pixels of g·dP/dη_k, float64 [node], bitwise equal for any number of threads; `g` float32.

    η is not renormalised, `eta_gradient` knows that it sums to 1. A node of weight 0 gets 0.
    """
    _check_images(la, lb, g)
    flat = (np.ascontiguousarray(v).reshape(-1) for v in (la, lb, g))
    return response_cpu.theta_sums(response.a, response.b, response.eta, *flat)


def theta_gradient(response: Response, la: Image, lb: Image, g: Image) -> Array:
    """Return Σ over pixels of g·dP/dθ, float64 [T], arguments as in `theta_sums`."""
    return response.eta_gradient() @ theta_sums(response, la, lb, g)


def tangent(response: Response, water: tuple[float, float], length: float) -> tuple[float, float]:
    """Return (dP/dLa, dP/dLb) behind `length` mm of water, whose densities `water` = (ρa, ρb) are 1/mm.

    ρa·dP/dLa + ρb·dP/dLb is what one more mm of any material adds to P there: its attenuation in the hardened
    beam, which the data do fix.
    """
    la, lb = (np.array([density * length]) for density in water)
    _, dp_da, dp_db = response_reference.evaluate(response.a, response.b, response.eta, la, lb)
    return float(dp_da[0]), float(dp_db[0])


def _check_images(first: Image, *others: Image) -> None:
    for image in (first, *others):
        if image.dtype != np.float32 or image.shape != first.shape:
            raise InputError(f"images must be float32 of shape {first.shape}, got {image.dtype} of {image.shape}")


def _check_call(name: str, e_max: float, basis: str, nodes: int | None, given: bool) -> None:
    if name not in get_args(Name):
        raise InputError(f"response must be one of {', '.join(get_args(Name))}, got {name!r}")
    if basis not in get_args(Basis):
        raise InputError(f"basis must be one of {', '.join(get_args(Basis))}, got {basis!r}")
    if not (math.isfinite(e_max) and e_max > SOFTEST):
        raise InputError(f"e_max must be above {SOFTEST:g} keV, got {e_max}")
    if (name == "known") != given:
        raise InputError(f"response 'known' needs a spectrum and no other takes one, got response {name!r}")
    if name == "sinh" and basis != "paper":
        raise InputError(f"basis must be 'paper' for response 'sinh', whose a is the same everywhere, got {basis!r}")
    low, high = (1, 1) if name == "mono" else (2, MOST_NODES)
    if nodes is not None and not low <= nodes <= high:
        raise InputError(f"nodes must be within {low} … {high} for response {name!r}, got {nodes}")


def _center(e_max: float) -> float:
    return 0.5 * (SOFTEST + e_max)


def _half_range(e_max: float) -> float:
    return (e_max - SOFTEST) / (e_max + SOFTEST)


def _klein_nishina(energies: Array) -> Array:
    """Total cross-section per free electron in units of 2π·r_e² (Klein and Nishina 1929)."""
    k = energies / ELECTRON_REST
    log = np.log1p(2 * k)
    return (1 + k) / k**2 * (2 * (1 + k) / (1 + 2 * k) - log / k) + log / (2 * k) - (1 + 3 * k) / (1 + 2 * k) ** 2


def _normalised(eta: Array) -> Array:
    total = eta.sum()
    if not (np.isfinite(total) and total > 0):
        raise InputError("the response has no weight at any energy")
    return eta / total


def _quadrature(name: Name, e_max: float, n: int) -> tuple[Array, Array]:
    """Return the energies (keV) and the quadrature weights of a response that no spectrum is given for."""
    center, half = _center(e_max), _half_range(e_max)
    if name == "mono":
        return np.array([center]), np.ones(1)
    if name in ("hinge", "sinh"):
        x, w = np.polynomial.legendre.leggauss(n)
        share = 1 + half * x if name == "hinge" else (1 + _RELATIVE_WIDTH * x) ** (-1 / 3)
        return center * share, w / 2
    return center * np.linspace(1 - half, 1 + half, n), np.full(n, 1 / n)


def _behind(filtration: float, e_max: float, detector: Detector, n: int) -> tuple[Array, Array]:
    """Return `_quadrature` of "tube", by n nodes of Gauss for the beam behind a filtration (mm Al)."""
    behind = (Filter(material="Al", thickness=filtration),) if filtration else ()
    beam = tube_spectrum(Tube(kvp=e_max, model="finkelshtein-pavlova", filters=behind))
    if filtration < FILTER[0]:
        kept = beam.energies >= STOPPED
        beam = Spectrum(energies=beam.energies[kept], weights=_normalised(beam.weights[kept]))
    rule = gauss_rule(beam, detector, n)
    return rule.energies, rule.w1 * np.exp(filtration * _aluminium(rule.energies))


def _aluminium(energies: Array) -> Array:
    """Attenuation (1/mm) less its smallest, which no normalised spectrum knows of."""
    mu = attenuation("Al", energies)
    return mu - mu.min()


def _signal(spectrum: tuple[ArrayLike, ArrayLike], e_max: float) -> Spectrum:
    energies, signal = (np.array(v, np.float64) for v in spectrum)
    if energies.ndim != 1 or energies.shape != signal.shape:
        raise InputError(f"a spectrum needs as many shares as energies, got {signal.shape} and {energies.shape}")
    kept = signal != 0
    energies, signal = energies[kept], signal[kept]
    if not (energies.size and energies.max() <= e_max):
        raise InputError(f"the spectrum must have signal, and none above e_max = {e_max:g} keV")
    return Spectrum(energies=energies, weights=_normalised(signal))


def _reduced(signal: Spectrum, basis: Basis, e_max: float, nodes: int | None) -> tuple[Array, Array]:
    """Return the Gauss nodes and weights of a detected spectrum: `nodes` of them, or the fewest for TOLERANCE."""
    # the rule wants photons and a detector separately, so the latter's response is divided out first
    deposited, _ = deposit(SCINTILLATOR, signal.energies)
    photons = Spectrum(energies=signal.energies, weights=_normalised(signal.weights / deposited))
    if nodes is not None:
        rule = gauss_rule(photons, SCINTILLATOR, min(nodes, signal.energies.size))
        return rule.energies, rule.w1
    a, b = basis_functions(signal.energies, basis, e_max)
    la, lb = (v.ravel() for v in np.meshgrid(_depths(a, basis == "paper"), _depths(b, False), indexing="ij"))
    exact, _, _ = response_reference.evaluate(a, b, signal.weights, la, lb)
    seen = exact <= P_MAX
    la, lb, exact = la[seen], lb[seen], exact[seen]
    for n in range(1, min(MOST_NODES, signal.energies.size) + 1):
        rule = gauss_rule(photons, SCINTILLATOR, n)
        p, _, _ = response_reference.evaluate(*basis_functions(rule.energies, basis, e_max), rule.w1, la, lb)
        if np.abs(p - exact).max() <= TOLERANCE:
            return rule.energies, rule.w1
    return signal.energies, signal.weights


def _depths(basis_function: Array, constant: bool) -> Array:
    """Path values to try a rule at: 0, then up to P_MAX at the energy that sees the least of it."""
    if constant:
        return np.zeros(1)  # adds the same to every exponent
    return np.concatenate([[0.0], np.geomspace(1e-4, 1.0, 150)]) * P_MAX / basis_function.min()


def _start(name: Name, energies: Array, e_max: float) -> tuple[float, ...]:
    """Return θ to start from; "gmm" and "free" start near the paper's response."""
    if name in ("paper", "hinge"):
        return START
    if name == "tube":
        return (FILTER[1],)
    half = _half_range(e_max)
    if name == "free":
        h, _ = _hinge(energies / _center(e_max), 1 - half, *START)
        return tuple(np.log(h).tolist())
    if name == "gmm":
        means = 1 + half * (np.arange(_PEAKS) * 2 + 1 - _PEAKS) / _PEAKS
        h, _ = _hinge(means, 1 - half, *START)
        return (*np.log(h).tolist(), *means.tolist(), *[math.log(half / _PEAKS)] * _PEAKS)
    return ()


def _bounds(name: Name, n_nodes: int, e_max: float, thinnest: float) -> Array:
    half = _half_range(e_max)
    if name in ("paper", "hinge"):
        return np.array([[0.0, 1.0], [1 - 0.9 * half, 1 + half]])
    if name == "tube":
        return np.array([[thinnest, FILTER[2]]])
    if name == "gmm":
        means, widths = [1 - half, 1 + half], [math.log(0.1 * half), math.log(2.0)]
        return np.array([[-20.0, 20.0]] * _PEAKS + [means] * _PEAKS + [widths] * _PEAKS)
    return np.array([[-20.0, 20.0]] * (n_nodes if name == "free" else 0)).reshape(-1, 2)


def _checked(name: Name, bounds: Array, theta: Sequence[float]) -> tuple[float, ...]:
    values = tuple(float(v) for v in theta)
    if len(values) != len(bounds):
        raise InputError(f"theta of response {name!r} has {len(bounds)} parameters, got {len(values)}")
    for value, (low, high) in zip(values, bounds.tolist(), strict=True):
        if not low <= value <= high:
            raise InputError(f"theta of response {name!r}: expected a value within [{low:g}, {high:g}], got {value}")
    return values


def _form(name: Name, energies: Array, e_max: float, theta: tuple[float, ...]) -> tuple[Array, Array]:
    """Return the response's form h [node] and dh/dθ [T, node], up to one factor."""
    relative, softest = energies / _center(e_max), 1 - _half_range(e_max)
    if name == "paper":
        return _paper(relative, softest, *theta)
    if name == "hinge":
        return _hinge(relative, softest, *theta)
    if name == "tube":
        mu = _aluminium(energies)
        h = np.exp(-mu * theta[0])
        return h, (-mu * h)[None]
    if name == "gmm":
        log_amplitude, mean, log_width = (v[:, None] for v in np.array(theta).reshape(3, _PEAKS))
        z = (relative - mean) / np.exp(log_width)
        peaks = np.exp(log_amplitude - 0.5 * z**2)
        return peaks.sum(0), np.concatenate([peaks, peaks * z / np.exp(log_width), peaks * z**2])
    if name == "free":
        h = np.exp(np.array(theta))
        return h, np.diag(h)
    return np.ones(energies.size), np.zeros((0, energies.size))


def _paper(e: Array, softest: float, r: float, threshold: float) -> tuple[Array, Array]:
    """Return the paper's form, a line from 1 at `softest` through r at the threshold; h [n], its derivatives [2, n]."""
    span = threshold - softest
    u = (e - softest) / span
    line = 1 - (1 - r) * u
    plateau = expit(e - threshold)
    h = line * (1 - plateau) + r * plateau
    by_r = u * (1 - plateau) + plateau
    by_threshold = ((1 - r) * u / span + (line - r) * plateau) * (1 - plateau)
    return np.maximum(h, 0.0), np.where(h > 0, np.stack([by_r, by_threshold]), 0.0)


def _hinge(e: Array, softest: float, r: float, threshold: float) -> tuple[Array, Array]:
    """Return r + (1 − r)·softplus(threshold − e)/(threshold − softest), h [n], and its derivatives [2, n]."""
    span = threshold - softest
    z = (threshold - e) / _SMOOTH
    fall = _SMOOTH * np.logaddexp(0.0, z) / span
    return r + (1 - r) * fall, np.stack([1 - fall, (1 - r) * (expit(z) - fall) / span])
