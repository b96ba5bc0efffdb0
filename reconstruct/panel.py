"""Lag and glare that a scan shows by itself: what its open pixels read less than the open field.

A panel reads some of a view's light in later views (lag; Siewerdsen and Jaffray, Med. Phys. 26, 1999) and some of it
millimetres from where it arose (veiling glare; Seibert et al., Med. Phys. 12, 1985). Behind metal that is most of what
is read: with 8 % of glare from open air, no thickness of gold reads more than P = 3. Both show in pixels that no shadow
reaches: near a shadow they lack the glare of its light, and in the first views what comes later, if nothing had lit the
panel before. What they read is linear in both and in scatter, so one least-squares fit tells them apart.
"""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import fft, ndimage, optimize

from ctsim.geometry import Geometry, few_views
from ctsim.reconstruct.log import count_floor
from ctsim.reconstruct.scatter import Image, between, source_of
from ctsim.types import Scan

WIDTHS = tuple(16 * 2 ** (k / 2) for k in range(-4, 6))
"""Full widths at half maximum (mm) of the Gaussians of which glare is a sum."""
DECAYS = (0.0, 0.25, 0.5, 0.7, 0.85, 0.93)  # from view to view, of the parts of the lag
FIRST, VIEWS = 40, 60  # views in which lag shows, and others
SIDE = 112  # most blocks along a side of the panel
SHADOW, MARGIN = 0.06, 1  # below the open field, of a block in shadow; blocks next to one that are no open ones
ROUNDS = 2, 3  # of lag and glare, and of glare and the light without it
FEWEST = 1000  # open blocks
LEAST = 0.004  # share of the light from which on lag, or glare, is taken off
SIGNIFICANT = 5.0  # times how much the mean of a view's open blocks varies otherwise, of the lag
EXPLAINED = 0.7  # of what open blocks vary by beyond noise and scatter, that glare has to explain
DRIFT = 2  # greatest power of time in a drift of the tube
TINY = 1e-6
DARKEST = 1e-3  # share of the blocks that may hold less than the glare
NORMAL = 1.4826  # standard over median deviation
WIDE = 5  # steps of a grid in the width of a Gaussian that is looked up on it
SIGMA = 1 / (2 * math.sqrt(2 * math.log(2)))  # of a Gaussian over its full width at half maximum

Parts = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """What a panel does to light: parts of the lag as (share, decay), and of the glare as (share, width in mm).

    Of a view's light the nth later view reads share·(1 − decay)·decay^(n − 1), and a pixel around it the share of a
    Gaussian whose full width at half maximum is the width.
    """

    lag: Parts = ()
    glare: Parts = ()

    def __bool__(self) -> bool:
        """Whether there is anything to take off."""
        return bool(self.lag or self.glare)

    def details(self) -> dict[str, object]:
        """Return what a result says of its panel."""
        return {"panel": {"lag": [list(part) for part in self.lag], "glare": [list(part) for part in self.glare]}}


def panel_of(scan: Scan) -> Panel:
    """Find lag and glare in a scan, each none where it is not significant or too few pixels are open.

    Open is what reads nearly the open field, and is not next to what does not. Faint matter around an object would be
    taken for glare, so that has to explain most of what those pixels vary by, and no pixel may hold less.
    """
    n = scan.geometry.n_views
    step = tuple(-(-k // SIDE) for k in scan.geometry.n_detector)
    d_v, d_u = (d * k for d, k in zip(scan.geometry.d_detector, step, strict=True))
    read = np.stack([_blocks(_share(scan, view), step) for view in range(n)])
    views = np.unique(np.concatenate([np.arange(min(FIRST, n)), few_views(n, VIEWS)]))
    panel = Panel()
    for _ in range(ROUNDS[0]):
        light = np.stack(list(_unlagged(read, panel.lag)))[views]
        fit = _Fit.of(light, scan.geometry, (d_v, d_u))
        if fit is None:
            return Panel()
        levels, counts = fit.levels(read[views])
        panel = Panel(lag=_lag(views, levels, counts), glare=fit.glare())
    return panel


def without_panel(scan: Scan, panel: Panel, kept: float = 0.0) -> Scan:
    """Return the scan without lag and glare, its counts float32; itself where there is none.

    At least the share `kept` of each reading is left. Lag is taken off view by view (Hsieh et al., Proc. SPIE 3977,
    2000), as if nothing had lit the panel before the first. Noise stays, and what glare takes off is smooth.
    """
    if not panel:
        return scan
    dark = np.float32(scan.dark)
    open_field = scan.flat.numpy() - dark
    counts = scan.counts.numpy().astype(np.float32)
    shares = (_share(scan, view) for view in range(len(counts)))
    for view, light in enumerate(_unlagged(shares, panel.lag)):
        read = _share(scan, view)
        if panel.glare:
            light = _without_glare(light, panel, scan.geometry.d_detector)
        usable = np.isfinite(read)
        counts[view][usable] = (np.maximum(light, np.float32(kept) * read) * open_field + dark)[usable]
    return dataclasses.replace(scan, counts=torch.from_numpy(counts), floor=count_floor(scan))


def _unlagged(images: Iterable[Image], lag: Parts) -> Iterator[Image]:
    """Yield the light of the views that were read as `images`; what is not finite is taken for the light before it."""
    before: Image | np.float32 = np.float32(1)
    late = [np.float32(0) for _ in lag]
    now = np.float32(1 - sum(share for share, _ in lag))
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
    if not later.any():
        return ()
    drift = np.stack([(n / n[-1]) ** k for k in range(DRIFT + 1)], 1)
    columns = np.concatenate([-np.power(np.array(DECAYS), n[:, None]), drift, -drift], 1)
    found = _least_squares(columns * weights[:, None], levels * weights)
    left, shares = levels - columns @ found, found[: len(DECAYS)]
    if shares.sum() < max(LEAST, SIGNIFICANT * math.sqrt(np.mean(np.square(left[later])))):
        return ()
    return _parts(shares, DECAYS)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Fit:
    """Least squares over open blocks: light − 1 is a level of the view less what glare takes, plus scatter.

    `excess` and `columns`, of the glare's widths and of the scatter, have no mean over a view's open blocks.
    """

    light: Image
    d: tuple[float, float]
    is_open: NDArray[np.bool_]
    widths: list[float]
    excess: NDArray[np.float64]
    columns: NDArray[np.float64]
    means: NDArray[np.float64]
    shares: NDArray[np.float64]

    @classmethod
    def of(cls, light: Image, geometry: Geometry, d: tuple[float, float]) -> "_Fit | None":
        """Fit views [view, v, u] without lag, of blocks that are `d` (mm) long; None where too few are open."""
        side = 2 * MARGIN + 1
        is_open = ~ndimage.maximum_filter(light < 1 - SHADOW, (1, side, side), mode="nearest")
        if np.count_nonzero(is_open) < FEWEST:
            return None
        extent = min(n * k for n, k in zip(light.shape[1:], d, strict=True))
        widths = [w for w in WIDTHS if 2 * max(d) < w < extent / 2]
        excess, _ = _centred(light - 1, is_open)
        straight = light
        for _ in range(ROUNDS[1]):
            cosines = fft.dctn(straight, axes=(-2, -1))
            lost = (_filtered(cosines, _transfer(light.shape[-2:], ((1, w),), d) - 1) for w in widths)
            images = (*lost, source_of(np.minimum(straight, 1), geometry, d))
            columns, means = (np.stack(both, -1) for both in zip(*(_centred(i, is_open) for i in images), strict=True))
            shares = _least_squares(columns, excess)
            parts = _parts(shares, widths)
            if not parts:
                break
            straight = (light - _glare(light, parts, d)) / np.float32(1 - sum(share for share, _ in parts))
        return cls(
            light=light,
            d=d,
            is_open=is_open,
            widths=widths,
            excess=excess,
            columns=columns,
            means=means,
            shares=shares,
        )

    def levels(self, read: Image) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return what open blocks of each view read beyond the open field but for glare and scatter, and how many."""
        _, mean = _centred(read - 1, self.is_open)
        return mean - self.means @ self.shares, np.count_nonzero(self.is_open, axis=(1, 2))

    def glare(self) -> Parts:
        """Return its parts, or none if they explain too little; scaled down until nearly all blocks hold them."""
        parts = _parts(self.shares, self.widths)
        noise = self._noise()
        with_it, without = (
            max(float(np.mean(np.square(self.excess - columns @ _least_squares(columns, self.excess)))) - noise, 0.0)
            for columns in (self.columns, self.columns[:, len(self.widths) :])
        )
        if not parts or with_it > (1 - EXPLAINED) * without:
            return ()
        ratios = self.light / np.maximum(_glare(self.light, parts, self.d), TINY)
        held = min(1.0, float(np.quantile(ratios, DARKEST)))
        if held * sum(share for share, _ in parts) < LEAST:
            return ()
        return tuple((held * share, width) for share, width in parts)

    def _noise(self) -> float:
        """Return the variance of an open block by its neighbours along a row."""
        both = self.is_open[:, :, 1:] & self.is_open[:, :, :-1]
        steps = np.abs(np.diff(self.light, axis=2)[both])
        return float(NORMAL * np.median(steps)) ** 2 / 2 if steps.size else 0.0


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
    both = np.linalg.qr(np.column_stack([columns, values]), mode="r")  # as many rows as columns say the same
    return np.asarray(optimize.nnls(both[:, :-1], both[:, -1])[0])


def _share(scan: Scan, view: int) -> Image:
    """Return a view's readings over the open field, NaN where there is none."""
    dark = np.float32(scan.dark)
    open_field = scan.flat.numpy() - dark
    usable = np.isfinite(open_field) & (open_field > count_floor(scan))
    share = (scan.counts[view].numpy().astype(np.float32) - dark) / np.where(usable, open_field, np.nan)
    return np.where(np.isfinite(share), share, np.float32(np.nan)).astype(np.float32)


def _blocks(image: Image, step: tuple[int, ...]) -> Image:
    """Return means over blocks of `step` pixels (v, u), the last of them shorter; NaN is left out."""
    at = [np.arange(0, n, k) for n, k in zip(image.shape, step, strict=True)]

    def summed(values: NDArray[np.floating]) -> NDArray[np.float64]:
        rows = np.add.reduceat(values, at[0], axis=0, dtype=np.float64)
        return np.asarray(np.add.reduceat(rows, at[1], axis=1))

    seen = np.isfinite(image)
    total, number = summed(np.where(seen, image, 0)), summed(seen.astype(np.float32))
    mean = total.sum() / max(number.sum(), 1)
    return np.where(number > 0, total / np.maximum(number, 1), mean).astype(np.float32)


def _glare(read: Image, parts: Parts, d: tuple[float, float]) -> Image:
    """Return the glare in images [..., v, u], read over blocks that are `d` (mm) long; the panel's edge reflects."""
    spread = _transfer(read.shape[-2:], parts, d)
    straight = np.float32(1 - sum(share for share, _ in parts))
    return _filtered(fft.dctn(read, axes=(-2, -1)), spread / (straight + spread))


def _transfer(shape: tuple[int, ...], parts: Parts, d: tuple[float, float]) -> Image:
    """Return what the cosines of an image [v, u] are multiplied by where Gaussians spread it."""
    v, u = (np.pi * np.arange(n) / (n * k) for n, k in zip(shape, d, strict=True))
    squares = v[:, None] ** 2 + u**2
    shares = (share * np.exp(-0.5 * (SIGMA * width) ** 2 * squares) for share, width in parts)
    return np.asarray(sum(shares), np.float32)


def _filtered(cosines: Image, transfer: Image) -> Image:
    return np.asarray(fft.idctn(cosines * transfer, axes=(-2, -1)), np.float32)


def _without_glare(read: Image, panel: Panel, d_detector: tuple[float, float]) -> Image:
    """Return a view's light; the glare is smooth, so it is worked out on blocks and looked up between them."""
    parts = panel.glare
    narrowest = min(width for _, width in parts)
    step = tuple(max(int(narrowest / (WIDE * d)), 1) for d in d_detector)
    d_v, d_u = (d * k for d, k in zip(d_detector, step, strict=True))
    blocks = _blocks(read, step)
    glare = _glare(blocks, parts, (d_v, d_u))
    rows, columns = (between(n, m, k) for n, m, k in zip(read.shape, glare.shape, step, strict=True))
    return (read - rows @ glare @ columns.T) / np.float32(1 - sum(share for share, _ in parts))
