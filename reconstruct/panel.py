"""Lag and glare that a scan shows by itself: what its open pixels read less than the open field.

A panel reads some of a view's light in later views (lag; Siewerdsen and Jaffray, Med. Phys. 26, 1999) and some of it
millimetres from where it arose (veiling glare; Seibert et al., Med. Phys. 12, 1985). Behind metal that is most of what
is read: with 8 % of glare a small piece in open air reads P = 2.5, however dense it is. Both show in pixels that no
shadow reaches: near a shadow they lack the glare of its light, and in the first views what comes later, if nothing had
lit the panel before. What they read is linear in glare and scatter, so least squares tell them apart.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import fft, ndimage, optimize

from ctsim.geometry import Geometry, few_views
from ctsim.reconstruct.log import Filling, count_floor
from ctsim.reconstruct.scatter import SPREAD, Image, alive, between, laid, source_of
from ctsim.types import Scan

WIDTHS = tuple(16 * 2 ** (k / 2) for k in range(-4, 6))
"""Full widths at half maximum (mm) of the Gaussians of which glare is a sum."""
DECAYS = (0.0, 0.25, 0.5, 0.7, 0.85, 0.93)  # from view to view, of the parts of the lag
FIRST, LATER, VIEWS = 40, 20, 60
"""Views in which lag shows; least number of others, with open blocks, that tell how much levels vary; and views in
which glare is sought besides the first."""
SIDE = 112  # most blocks along a side of the panel
SHADOW, MARGIN = 0.06, 1  # below the open field, of a block in shadow; blocks next to one that are no open ones
ROUNDS = 2, 3  # of lag and glare, and of glare and the light without it
FEWEST = 1000  # open blocks
RIM, NARROW = 5, 0.25
"""Blocks in the narrowest Gaussian, since shadows have rims, and the widest one over that of the scatter, from which
wider ones are hard to tell."""
LEAST, MOST = (0.004, 0.01), 0.5  # shares of the light from which on lag and glare are taken off, and up to which
SIGNIFICANT = 5.0  # standard deviations
EXPLAINED = 0.7  # of what open blocks vary by beyond noise and scatter, that glare has to explain
DARKEST, HELD, NEAR = 1e-3, 0.7, 3.0
"""The share of the blocks that may hold less than the glare, the least share of it that all others have to hold, and
how many times the glare the darkest of them may hold to confirm it."""
DRIFT = 2  # greatest power of time in a drift of the tube
NORMAL = 1.4826  # standard over median deviation
TINY = 1e-6
WIDE = 5  # steps of a grid in the width of a Gaussian that is looked up on it
SIGMA = 1 / (2 * math.sqrt(2 * math.log(2)))  # of a Gaussian over its full width at half maximum

Parts = tuple[tuple[float, float], ...]
Step = tuple[int, int]


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """What a panel does to light: parts of the lag as (share, decay), and of the glare as (share, width in mm).

    Of a view's light the nth later view reads share·(1 − decay)·decay^(n − 1), and a pixel around it the share of a
    Gaussian whose full width at half maximum is the width. Glare is `confirmed` by a shadow that is hardly brighter.
    """

    lag: Parts = ()
    glare: Parts = ()
    confirmed: bool = True

    def __bool__(self) -> bool:
        """Whether there is anything to take off."""
        return bool(self.lag or self.glare)

    @property
    def sentence(self) -> str:
        """Say that glare may be something else, or nothing."""
        if self.confirmed:
            return ""
        return (
            f"{100 * _total(self.glare):.1f} % of glare were taken off, which no dark shadow confirms: faint matter "
            "around the object looks the same"
        )

    def details(self) -> dict[str, object]:
        """Return what a result says of its panel."""
        return {"panel": {"lag": [list(part) for part in self.lag], "glare": [list(part) for part in self.glare]}}


def panel_of(scan: Scan) -> Panel:
    """Find lag and glare in a scan, each none where it is not significant or too few pixels are open.

    Open is what reads nearly the open field, and is not next to what does not. Faint matter around an object looks like
    glare, so that has to explain most of what these pixels vary by, and shadows have to hold it. A tube that grows
    brighter in the first views looks like lag. In fewer than 60 views no lag is found.
    """
    shares, step = _Shares(scan), _step(scan.geometry, SIDE)
    d = _lengths(scan.geometry, step)
    n = scan.geometry.n_views
    read = np.stack([_blocks(shares.of(view), step) for view in range(n)])
    field = _blocks(shares.open_field, step)
    views = np.unique(np.concatenate([np.arange(min(FIRST, n)), few_views(n, VIEWS)]))
    panel = Panel()
    for _ in range(ROUNDS[0]):
        light = np.stack(list(_unlagged(read, panel.lag)))[views]
        fit = _Fit.of(light, field, scan.geometry, d)
        if fit is None:
            return Panel()
        lost = np.isnan(read[views])
        levels, counts = fit.levels(np.where(lost, light, read[views]))
        counts[lost.all((1, 2))] = 0
        glare, confirmed = fit.glare()
        panel = Panel(lag=_lag(views, levels, counts), glare=glare, confirmed=confirmed)
    return panel


def without_panel(scan: Scan, panel: Panel, kept: float = 0.0) -> Scan:
    """Return the scan without lag and glare, its counts float32; itself where there is none.

    At least the share `kept` of each reading is left, if that is above 0. Lag is taken off view by view (Hsieh et al.,
    Proc. SPIE 3977, 2000), as if nothing had lit the panel before the first. Noise stays, also below the dark level.
    """
    if not panel:
        return scan
    shares, dark = _Shares(scan), np.float32(scan.dark)
    counts = scan.counts.numpy().astype(np.float32)
    glare = _GlareOf(panel.glare, scan.geometry, shares.open_field) if panel.glare else None
    reads, images = itertools.tee(map(shares.of, range(len(counts))))
    for view, (read, light) in enumerate(zip(reads, _unlagged(images, panel.lag), strict=True)):
        if glare is not None:
            light = glare.without(light)
        if kept > 0:
            light = np.where(read > 0, np.maximum(light, np.float32(kept) * read), light)
        usable = np.isfinite(read) & ~shares.dead
        counts[view][usable] = (light * shares.open_field + dark)[usable]
    return dataclasses.replace(scan, counts=torch.from_numpy(counts), floor=count_floor(scan))


class _Shares:
    """Readings over the open field; where that is `dead`, both are those of the neighbours."""

    def __init__(self, scan: Scan) -> None:
        self._scan, self._dark = scan, np.float32(scan.dark)
        open_field = scan.flat.numpy() - self._dark
        self.dead = ~(np.isfinite(open_field) & (open_field > count_floor(scan)))
        self._filling = Filling.of(self.dead)
        self.open_field = open_field.astype(np.float32)
        self._fill(self.open_field)

    def of(self, view: int) -> Image:
        """Return a view's [v, u], NaN where a reading is not finite."""
        with np.errstate(divide="ignore", invalid="ignore"):
            share = (self._scan.counts[view].numpy().astype(np.float32) - self._dark) / self.open_field
        self._fill(share)
        share[~np.isfinite(share)] = np.nan
        return share

    def _fill(self, image: Image) -> None:
        if self._filling is not None:
            self._filling.fill(image)


def _unlagged(images: Iterable[Image], lag: Parts) -> Iterator[Image]:
    """Yield the light of the views that were read as `images`; what is not finite is taken for the light before it."""
    before: Image | np.float32 = np.float32(1)
    late = [np.float32(0) for _ in lag]
    now = np.float32(1 - _total(lag))
    for image in images:
        light = (image - sum(late, np.float32(0))) / now
        light = np.where(np.isfinite(light), light, before)
        late = [
            np.float32(decay) * part + np.float32((1 - decay) * share) * light
            for part, (share, decay) in zip(late, lag, strict=True)
        ]
        before = light
        yield light


def _lag(views: NDArray[np.int64], levels: NDArray[np.float64], counts: NDArray[np.int64]) -> Parts:
    """Return the lag of which views' levels rise: a constant and a drift of the tube less its parts.

    None is returned if it is not more than levels vary by otherwise. `counts` says how much a level is worth.
    """
    seen = counts > 0
    n, levels, weights = views[seen], levels[seen], np.sqrt(counts[seen])
    later = n >= FIRST
    if np.count_nonzero(later) < LATER:
        return ()
    drift = np.stack([(n / n[-1]) ** k for k in range(DRIFT + 1)], 1)
    columns = np.concatenate([-np.power(np.array(DECAYS), n[:, None]), drift, -drift], 1)
    found = _least_squares(columns * weights[:, None], levels * weights)
    left, shares = (levels - columns @ found)[later], found[: len(DECAYS)]
    free = max(len(left) - np.count_nonzero(found), 1)
    power = float(left @ left)
    again = min(max(float(left[1:] @ left[:-1]) / power, 0.0), 0.95) if power > 0 else 0.0  # a walk varies slowly
    varied = math.sqrt(power / free * (1 + again) / (1 - again))
    if not max(LEAST[0], SIGNIFICANT * varied) <= shares.sum() < MOST:
        return ()
    return _parts(shares, DECAYS)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fit:
    """Least squares over open blocks: light − 1 is a level of the view less what glare takes, plus scatter.

    `excess` and `columns`, of the glare's widths and of the scatter, have no mean over a view's open blocks; `means`
    are those of the columns. `shares` are what is found.
    """

    light: Image
    field: Image
    d: tuple[float, float]
    is_open: NDArray[np.bool_]
    widths: list[float]
    excess: NDArray[np.float64]
    columns: NDArray[np.float64]
    means: NDArray[np.float64]
    shares: NDArray[np.float64]

    @classmethod
    def of(cls, light: Image, field: Image, geometry: Geometry, d: tuple[float, float]) -> "_Fit | None":
        """Fit views [view, v, u] without lag, of blocks that are `d` (mm) long; None where too few are open."""
        side = 2 * MARGIN + 1
        is_open = ~ndimage.maximum_filter(light < 1 - SHADOW, (1, side, side), mode="nearest")
        if np.count_nonzero(is_open) < FEWEST:
            return None
        widest = NARROW * SPREAD * (geometry.dsd - geometry.dso) / SIGMA
        widths = [w for w in WIDTHS if RIM * max(d) < w < widest]
        excess, _ = _centred(light - 1, is_open)
        columns, means = _columns(light, field, is_open, widths, geometry, d)
        for _ in range(ROUNDS[1] - 1):
            if parts := _parts(_least_squares(columns, excess), widths):
                straight = _straight(light * field, parts, d) / _straight(field, parts, d)
                columns, means = _columns(straight, field, is_open, widths, geometry, d)
        return cls(
            light=light,
            field=field,
            d=d,
            is_open=is_open,
            widths=widths,
            excess=excess,
            columns=columns,
            means=means,
            shares=_least_squares(columns, excess),
        )

    def levels(self, read: Image) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return what open blocks of each view read beyond the open field but for glare and scatter, and how many."""
        _, mean = _centred(read - 1, self.is_open)
        return mean - self.means @ self.shares, np.count_nonzero(self.is_open, axis=(1, 2))

    def glare(self) -> tuple[Parts, bool]:
        """Return its parts, none if they explain too little or blocks do not hold them, and if a shadow confirms it."""
        parts, nothing = _parts(self.shares, self.widths), ((), True)
        if not LEAST[1] <= _total(parts) < MOST:
            return nothing
        noise = self._noise()
        with_it, without = (
            float(np.mean(np.square(self.excess - columns @ _least_squares(columns, self.excess))))
            for columns in (self.columns, self.columns[:, len(self.widths) :])
        )
        least = SIGNIFICANT**2 * len(self.widths) * noise / len(self.excess)
        if without - with_it < max(least, EXPLAINED * (without - noise)):
            return nothing
        glare = _glare(self.light * self.field, parts, self.d) / self.field
        lit = alive(self.light)
        held = float(np.quantile((self.light / np.maximum(glare, TINY))[lit], DARKEST)) if lit.any() else 0.0
        if held < HELD:
            return nothing
        return tuple((min(held, 1.0) * share, width) for share, width in parts), held < NEAR

    def _noise(self) -> float:
        """Return the variance of an open block by its neighbours along a row."""
        both = self.is_open[:, :, 1:] & self.is_open[:, :, :-1]
        steps = np.abs(np.diff(self.light, axis=2)[both])
        return float(NORMAL * np.median(steps)) ** 2 / 2 if steps.size else 0.0


class _GlareOf:
    """Takes glare off views, whose open field has it as well; it is smooth, so it is worked out on blocks."""

    def __init__(self, parts: Parts, geometry: Geometry, open_field: Image) -> None:
        narrowest = min(width for _, width in parts)
        d_v, d_u = geometry.d_detector
        self._step = max(int(narrowest / (WIDE * d_v)), 1), max(int(narrowest / (WIDE * d_u)), 1)
        self._parts, self._d, self._field = parts, _lengths(geometry, self._step), open_field
        self._rows, self._columns = (
            between(n, -(-n // k), k) for n, k in zip(open_field.shape, self._step, strict=True)
        )
        self._open = self._straight(open_field)

    def without(self, light: Image) -> Image:
        """Return a view [v, u] without glare, both over the open field."""
        return self._straight(light * self._field) / self._open

    def _straight(self, signal: Image) -> Image:
        glare = _glare(_blocks(signal, self._step), self._parts, self._d)
        return (signal - laid(glare, self._rows, self._columns)) / np.float32(1 - _total(self._parts))


def _columns(
    light: Image,
    field: Image,
    is_open: NDArray[np.bool_],
    widths: Sequence[float],
    geometry: Geometry,
    d: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what glare of each width adds to open blocks, and scatter, less their means in a view, and these means."""
    # a block's own noise would be in what it is explained by, too
    level = _centred(light, is_open)[1].astype(np.float32)[:, None, None]
    clean = np.where(is_open, level, light)
    of_light, of_field = (fft.dctn(image, axes=(-2, -1)) for image in (clean * field, field))
    transfers = (_transfer(field.shape, ((1, width),), d) for width in widths)
    glares = [(_filtered(of_light, one) - clean * _filtered(of_field, one)) / field for one in transfers]
    both = [_centred(image, is_open) for image in (*glares, source_of(np.minimum(light, 1), geometry, d))]
    return np.stack([values for values, _ in both], -1), np.stack([means for _, means in both], -1)


def _total(parts: Parts) -> float:
    return sum(share for share, _ in parts)


def _centred(images: Image, where: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the pixels `where` [view, v, u] less their mean in each view, and these means, 0 of none."""
    total = np.sum(images, axis=(1, 2), dtype=np.float64, where=where)
    means = total / np.maximum(np.count_nonzero(where, axis=(1, 2)), 1)
    return (images - means[:, None, None])[where], means


def _parts(shares: NDArray[np.float64], scales: Sequence[float]) -> Parts:
    """Return the parts that are not 0; shares beyond the scales are of something else."""
    return tuple((float(share), scale) for share, scale in zip(shares, scales, strict=False) if share > 0)


def _least_squares(columns: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the coefficients, none below 0, whose sum of columns is nearest to the values."""
    both = np.asarray(np.linalg.qr(np.column_stack([columns, values]), mode="r"))  # few rows that say the same
    return np.asarray(optimize.nnls(both[:, :-1], both[:, -1])[0])


def _step(geometry: Geometry, most: int) -> Step:
    """Return how many pixels (v, u) a block has of which at most so many lie along a side."""
    n_v, n_u = geometry.n_detector
    return -(-n_v // most), -(-n_u // most)


def _lengths(geometry: Geometry, step: Step) -> tuple[float, float]:
    """Return the sides of a block (v, u) in mm."""
    return geometry.d_detector[0] * step[0], geometry.d_detector[1] * step[1]


def _blocks(image: Image, step: Step) -> Image:
    """Return means over blocks of `step` pixels (v, u), the last of them shorter; NaN is left out, unless it is all."""
    at = [np.arange(0, n, k) for n, k in zip(image.shape, step, strict=True)]

    def summed(values: NDArray[np.generic]) -> NDArray[np.float64]:
        rows = np.add.reduceat(values, at[0], axis=0, dtype=np.float64)
        return np.asarray(np.add.reduceat(rows, at[1], axis=1))

    seen = np.isfinite(image)
    with np.errstate(invalid="ignore"):
        return (summed(np.where(seen, image, 0)) / summed(seen)).astype(np.float32)


def _straight(signal: Image, parts: Parts, d: tuple[float, float]) -> Image:
    """Return signals [..., v, u] without their glare."""
    return (signal - _glare(signal, parts, d)) / np.float32(1 - _total(parts))


def _glare(signal: Image, parts: Parts, d: tuple[float, float]) -> Image:
    """Return the glare in signals [..., v, u] of blocks that are `d` (mm) long; the panel's edge reflects."""
    spread = _transfer(signal.shape[-2:], parts, d)
    transfer = np.asarray(spread / (1 - _total(parts) + spread), np.float32)
    return _filtered(fft.dctn(signal, axes=(-2, -1)), transfer)


def _transfer(shape: tuple[int, ...], parts: Parts, d: tuple[float, float]) -> Image:
    """Return what the cosines of an image [v, u] are multiplied by where Gaussians spread it."""
    v, u = (np.pi * np.arange(n) / (n * k) for n, k in zip(shape, d, strict=True))
    squares = v[:, None] ** 2 + u**2
    shares = (share * np.exp(-0.5 * (SIGMA * width) ** 2 * squares) for share, width in parts)
    return np.asarray(sum(shares), np.float32)


def _filtered(cosines: Image, transfer: Image) -> Image:
    return np.asarray(fft.idctn(cosines * transfer, axes=(-2, -1)), np.float32)
