"""What the detector writes: photon noise, electronic noise, fixed pattern, ADC, flat field."""

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim import rng
from ctsim.errors import InputError
from ctsim.kernels import noise_cpu

_NO_PATTERN = np.empty((2, 0, 0), np.float32)


class Noise(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How photons become counts.

    Model "tigre" is TIGRE's: P is normalised by the largest of the scan (of the twin by its own, so that the noise of
    the two differs everywhere). It has no fixed pattern, dead pixels, bow-tie or heel.
    """

    model: Literal["compound", "tigre", "none"] = "compound"
    """Compound Poisson noise, the noise of TIGRE, or none."""
    electronic: Annotated[float, msgspec.Meta(ge=0)] = 5.0
    """Standard deviation of the electronic noise, in photons at an open pixel (10 in TIGRE's demos)."""
    adc_bits: Annotated[int, msgspec.Meta(ge=4, le=16)] | None = 16
    """Bits of the ADC; null, "tigre" and "none" write float32 photons without pedestal."""
    adc_fill: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.8
    """The open field as a share of full scale."""
    pedestal: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.02
    """The dark level as a share of full scale."""
    n_flats: Annotated[int, msgspec.Meta(ge=0, le=10_000)] = 64
    """Open-field images that are averaged; 0 is a perfect flat."""
    fixed_pattern: Annotated[float, msgspec.Meta(ge=0, le=0.3)] = 0.0
    """Relative spread of the pixels' gains in the open field, which the flat removes."""
    pattern_residual: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.1
    """Spread of the change of gain with the signal, as a share of `fixed_pattern`; it makes rings."""
    dead_fraction: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.0
    """Share of pixels that always read the pedestal."""

    def __post_init__(self) -> None:
        if self.model not in ("compound", "tigre", "none"):
            raise InputError(f"noise.model must be 'compound', 'tigre' or 'none', got {self.model!r}")
        if not 0 <= self.electronic <= 1e6:
            raise InputError(f"noise.electronic must be within [0, 1e6] photons, got {self.electronic}")
        if self.model == "tigre" and (self.fixed_pattern or self.dead_fraction):
            raise InputError("noise.model = 'tigre' has no noise.fixed_pattern and no noise.dead_fraction; expected 0")
        if self.adc_bits is not None and not 4 <= self.adc_bits <= 16:
            raise InputError(f"noise.adc_bits must be within 4..16 or left out, got {self.adc_bits}")
        if not 0 <= self.pedestal < self.adc_fill <= 1:
            raise InputError(
                f"expected 0 <= noise.pedestal < noise.adc_fill <= 1, got {self.pedestal} and {self.adc_fill}"
            )
        if not 0 <= self.n_flats <= 10_000:
            raise InputError(f"noise.n_flats must be within 0..10000, got {self.n_flats}")
        if not 0 <= self.fixed_pattern <= 0.3:
            raise InputError(f"noise.fixed_pattern must be within [0, 0.3], got {self.fixed_pattern}")
        if not 0 <= self.pattern_residual <= 1:
            raise InputError(f"noise.pattern_residual must be within [0, 1], got {self.pattern_residual}")
        if not 0 <= self.dead_fraction < 1:
            raise InputError(f"noise.dead_fraction must be within [0, 1), got {self.dead_fraction}")

    @property
    def has_adc(self) -> bool:
        """Whether counts are whole numbers of an ADC."""
        return self.model == "compound" and self.adc_bits is not None

    @property
    def dtype(self) -> type[np.uint16] | type[np.float32]:
        """Type of the counts."""
        return np.uint16 if self.has_adc else np.float32

    @property
    def full_scale(self) -> int:
        """Highest count, 0 without an ADC."""
        return 2**self.adc_bits - 1 if self.has_adc and self.adc_bits is not None else 0

    @property
    def dark(self) -> float:
        """Counts at no signal: the pedestal, a whole number."""
        return float(round(self.pedestal * self.full_scale))

    def gain(self, i0: float) -> float:
        """Return the counts of the open field above `dark`: counts = dark + gain(i0)·relative signal."""
        return self.adc_fill * self.full_scale - self.dark if self.has_adc else float(i0)


def pixel_pattern(shape: tuple[int, int], *, noise: Noise, scene_id: str) -> NDArray[np.float32] | None:
    """Return how each pixel differs, float32 [2, v, u]; None if none does.

    [0] is the gain at full signal, around 1 and 0 where the pixel is dead; [1] by which share it is larger at no
    signal, linear between. Full signal is the open field of a tube without bow-tie and heel. Both are Gaussian, with
    standard deviations `fixed_pattern` and `fixed_pattern` times `pattern_residual`; no gain is below 0.05, no share
    below −0.95.
    """
    if noise.fixed_pattern == 0 and noise.dead_fraction == 0:
        return None
    n = shape[0] * shape[1]
    gains = 1.0 + noise.fixed_pattern * rng.normal(rng.stream_key(scene_id, "pixel gain", 0), n)[:, 0]
    bends = rng.normal(rng.stream_key(scene_id, "pixel residual", 0), n)[:, 0]
    bends *= noise.fixed_pattern * noise.pattern_residual
    dead = rng.uniform(rng.stream_key(scene_id, "dead pixels", 0), n)[:, 0] < noise.dead_fraction
    pattern = np.where(dead, 0.0, np.maximum(gains, 0.05)), np.maximum(bends, -0.95)
    return np.stack(pattern).reshape(2, *shape).astype(np.float32)


def detect(
    m1: NDArray[Any],
    m2: NDArray[Any],
    *,
    noise: Noise,
    i0: float,
    key: np.uint64,
    pattern: NDArray[np.float32] | None = None,
    known: tuple[NDArray[Any], NDArray[np.int64]] | None = None,
) -> NDArray[Any]:
    """Draw what the detector writes in one view, [v, u] of type `noise.dtype`.

    `m1` is the mean signal relative to the open field, scatter included, and `m2` the second moment Σ w2·e^(−τ):
    without electronics the relative signal has variance m2/i0. One draw has that mean, that variance and nearly
    the compound Poisson's skewness: g·Poisson(i0·m1²/m2), g = m2/(m1·i0). `key` names the view's stream
    (`rng.stream_key`); `pattern` comes from `pixel_pattern`. `known` = (counts, spans) are counts to be drawn
    again, in place, in columns spans[v] = (from, to) only; model "none", which draws nothing, fills all. For model
    "tigre" there is `detect_tigre`.

    Raises InputError on moments that are negative, not finite, or m2 = 0 where m1 > 0.
    """
    if noise.model == "tigre":
        raise ValueError("one view is not enough for the model tigre; use detect_tigre")
    if m1.ndim != 2 or m1.shape != m2.shape:
        raise InputError(f"expected m1 and m2 of one shape [v, u], got {m1.shape} and {m2.shape}")
    _check_i0(i0)
    if pattern is not None and pattern.shape != (2, *m1.shape):
        raise InputError(f"pattern has shape {pattern.shape}, expected {(2, *m1.shape)} for this view")
    if known is None:
        known = np.empty(m1.shape, noise.dtype), np.tile(np.array([0, m1.shape[1]]), (m1.shape[0], 1))
    out, spans = known
    if out.shape != m1.shape or out.dtype != noise.dtype:
        raise InputError(f"counts must be {np.dtype(noise.dtype)} {m1.shape}, got {out.dtype} {out.shape}")
    if m1.dtype != np.float32 or m2.dtype != np.float32:
        m1, m2 = m1.astype(np.float64, copy=False), m2.astype(np.float64, copy=False)
    if noise.model == "compound":
        bad = np.zeros(m1.shape[0], np.uint8)
        gains = _NO_PATTERN if pattern is None else pattern.astype(np.float32, copy=False)
        scale = (float(i0), noise.electronic, noise.gain(i0), noise.dark, float(noise.full_scale))
        noise_cpu.detect(m1, m2, gains, spans, *scale, np.uint64(key), out, bad)
        if bad.any():
            raise InputError(f"detector row {int(bad.argmax())}: m1 and m2 must be finite and m2 > 0 where m1 > 0")
        return out
    _check_signal(m1)
    out[...] = m1 * i0 if pattern is None else _read(m1, pattern) * i0
    return out


def photons(
    m1: NDArray[Any],
    m2: NDArray[Any],
    *,
    noise: Noise,
    i0: float,
    key: np.uint64,
    known: tuple[NDArray[np.float32], NDArray[np.int64]] | None = None,
) -> NDArray[np.float32]:
    """Draw the signal of one view's photons, [v, u], in photons of the open field: what `detect` reads out.

    Arguments as in `detect`; `known` holds signals.
    """
    bare = msgspec.structs.replace(noise, electronic=0.0, adc_bits=None)
    return detect(m1, m2, noise=bare, i0=i0, key=key, known=known)


def read_out(
    drawn: NDArray[np.float32], *, noise: Noise, i0: float, key: np.uint64, pattern: NDArray[np.float32] | None = None
) -> NDArray[Any]:
    """Return what the detector writes of a signal [v, u] in photons of the open field.

    It is `detect` of the `photons` of one stream, but for the rounding of these to float32.
    """
    if noise.model != "compound":
        return drawn if pattern is None else (_read(drawn / np.float32(i0), pattern) * i0).astype(noise.dtype)
    gains = _NO_PATTERN if pattern is None else pattern
    out = np.empty(drawn.shape, noise.dtype)
    scale = (float(i0), noise.electronic, noise.gain(i0), noise.dark, float(noise.full_scale))
    noise_cpu.read_out(drawn, gains, *scale, np.uint64(key), out)
    return out


def _read(signal: NDArray[Any], pattern: NDArray[np.float32]) -> NDArray[Any]:
    """Return what pixels with a pattern read of a mean signal relative to the open field."""
    return signal * pattern[0] * (1 + pattern[1] * np.maximum(1 - signal, 0))


def _check_i0(i0: float) -> None:
    if not 0 < i0 <= 1e12:
        raise InputError(f"i0 must be within (0, 1e12] photons, got {i0}")


def _check_signal(m1: NDArray[Any]) -> None:
    if not (np.isfinite(m1).all() and (m1 >= 0).all()):
        raise InputError("m1 must be finite and not negative")


def largest_p(m1: NDArray[Any]) -> float:
    """Return the largest −ln m1 where m1 > 0, at least 0."""
    return -math.log(float(m1[m1 > 0].min(initial=1.0)))


def detect_tigre(m1: NDArray[Any], *, top: float, noise: Noise, i0: float, key: np.uint64) -> NDArray[np.float32]:
    """Draw one view's photons, float32 [v, u], as TIGRE's CTnoise would.

    `m1` is the mean signal [v, u] relative to the open field; p = −ln m1 is divided by `top` before the draw and
    multiplied by it afterwards. TIGRE takes the largest p of the whole scan (`largest_p` over its views).

    Raises InputError on a signal that is negative or not finite.
    """
    _check_i0(i0)
    _check_signal(m1)
    out = np.empty(m1.shape, np.float32)
    # Where all views are open nothing is to be normalised; 1 leaves p as it is.
    noise_cpu.detect_tigre(m1, top if top > 0 else 1.0, float(i0), noise.electronic, np.uint64(key), out)
    return out


def flat_field(
    open_field: tuple[NDArray[np.float32], NDArray[np.float32]],
    *,
    noise: Noise,
    i0: float,
    scene_id: str,
    pattern: NDArray[np.float32] | None = None,
    spread: Callable[[NDArray[np.float32]], NDArray[np.float32]] | None = None,
) -> NDArray[np.float32]:
    """Return the open-field image in counts, pedestal included, float32 [v, u].

    `open_field` is the signal and second moment (m1, m2) [v, u] without an object. The image is the mean of
    `noise.n_flats` views of it through the same detector, or exact when that is 0 and for the models
    "tigre" and "none". A dead pixel reads exactly `noise.dark`. `spread` is what happens to the light of each view.
    """
    m1, m2 = open_field
    if noise.n_flats == 0 or noise.model != "compound":
        m1 = m1 if spread is None else spread(m1)
        gains = m1 if pattern is None else _read(m1, pattern)
        return (noise.dark + noise.gain(i0) * gains).astype(np.float32)
    total = np.zeros(m1.shape)
    for k in range(noise.n_flats):
        key = rng.stream_key(scene_id, "flat", k)
        if spread is None:
            total += detect(m1, m2, noise=noise, i0=i0, key=key, pattern=pattern)
        else:
            drawn = spread(photons(m1, m2, noise=noise, i0=i0, key=key))
            total += read_out(drawn, noise=noise, i0=i0, key=key, pattern=pattern)
    return (total / noise.n_flats).astype(np.float32)
