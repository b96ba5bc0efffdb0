"""What each method makes of a field's outputs: the line integrals P that a scan reads, a penalty, and the volume.

One function tells the methods apart, `line_integrals`. Outputs are [point, output] in 1/mm; L[·] are their line
integrals (`Grid.project`).
"""

import math
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.reconstruct.field.grid import Grid, Views
from ctsim.reconstruct.kernels import tv_cpu
from ctsim.reconstruct.splat.kernels import curve_cpu

Image = NDArray[np.float32]
SERIES = 0.1  # below which log(sinh b / b) is its series
HARDENING = 0.3  # of the scale of Park's second output
SMOOTH = 1e-3  # of water, at which the root of total variation is rounded


class Physics(Protocol):
    """Outputs a point, their scales, and what they mean."""

    @property
    def scales(self) -> tuple[float, ...]:
        """By what each output is multiplied, in units of the scan's mean attenuation."""
        ...

    def line_integrals(self, values: torch.Tensor, views: Views) -> torch.Tensor:
        """Return P of some views, [view, v, u]."""
        ...

    def penalty(self, values: torch.Tensor) -> torch.Tensor | None:
        """Return what is added to the misfit, None for nothing."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Mono:
    """P = L[μ]: one attenuation for all energies."""

    grid: Grid
    scales: tuple[float, ...] = (1.0,)

    def line_integrals(self, values: torch.Tensor, views: Views) -> torch.Tensor:
        """Return L[μ]."""
        return self.grid.project(values[:, 0], views)

    def penalty(self, values: torch.Tensor) -> None:
        """Add nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Park:
    """P = L[f] − log(sinh L[g] / L[g]): a flat spectrum, and attenuation that is linear in energy.

    f is attenuation in the middle of the spectrum, g its change over half of the width.
    """

    grid: Grid
    scales: tuple[float, ...] = (1.0, HARDENING)

    def line_integrals(self, values: torch.Tensor, views: Views) -> torch.Tensor:
        """Return P of f and g."""
        f, g = (self.grid.project(values[:, k].contiguous(), views) for k in range(2))
        return f - log_sinhc(g)

    def penalty(self, values: torch.Tensor) -> None:
        """Add nothing."""


def log_sinhc(b: torch.Tensor) -> torch.Tensor:
    """Return log(sinh b / b) for b ≥ 0: b²/6 − b⁴/180 below 0.1, and b − log 2b + log1p(−exp(−2b)) above.

    The next term of the series, b⁶/2835, is below 4e-10 there.
    """
    small = b < SERIES
    large = torch.where(small, torch.ones_like(b), b)  # away from 0, as both branches have a gradient
    square = b * b
    exact = large - torch.log(2 * large) + torch.log1p(-torch.exp(-2 * large))
    return torch.where(small, square / 6 - square * square / 180, exact)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bins:
    """P = −log Σ η_k exp(−L[μ_k]): an attenuation for each bin of a known spectrum (Polyner).

    `metal` are the points of the mask, a share of `grid`'s, and `metal_grid` these alone. Without `smoothness` all
    bins are equal outside the mask: their mean. With it they may differ, and smoothness · mean_{x ∉ M}
    Σ_k |μ_{k+1} − μ_k| / `unit` is added, as published.
    """

    grid: Grid
    metal_grid: Grid | None
    metal: torch.Tensor
    eta: torch.Tensor
    unit: float
    smoothness: float | None
    inside: float = 10.0  # times the mean attenuation, the scale of metal

    @property
    def scales(self) -> tuple[float, ...]:
        """All bins alike."""
        return (1.0,) * self.eta.numel()

    def attenuations(self, values: torch.Tensor) -> torch.Tensor:
        """Return the attenuation of each bin, [point, bin], in 1/mm."""
        outside = values if self.smoothness is not None else values.mean(1, keepdim=True).expand_as(values)
        return torch.where(self.metal[:, None], self.inside * values, outside)

    def line_integrals(self, values: torch.Tensor, views: Views) -> torch.Tensor:
        """Return P; where the bins are equal outside the mask, the K projections are those of its metal alone."""
        log_eta = torch.log(self.eta).to(values.dtype)[:, None, None, None]
        mu = self.attenuations(values)
        if self.smoothness is not None:
            paths = torch.stack([self.grid.project(mu[:, k].contiguous(), views) for k in range(mu.shape[1])])
            return -torch.logsumexp(log_eta - paths, 0)
        tissue = torch.where(self.metal, torch.zeros_like(mu[:, 0]), mu[:, 0])
        shared = self.grid.project(tissue, views)
        if self.metal_grid is None:
            return shared
        inside = mu[self.metal]
        paths = [self.metal_grid.project(inside[:, k].contiguous(), views) for k in range(mu.shape[1])]
        return shared - torch.logsumexp(log_eta - torch.stack(paths), 0)

    def penalty(self, values: torch.Tensor) -> torch.Tensor | None:
        """Return the smoothness between bins outside the mask, None where they are equal there."""
        if not self.smoothness:
            return None
        outside = values[~self.metal]
        return self.smoothness / self.unit * torch.diff(outside, dim=1).abs().sum(1).mean()


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """P = −log(Σ η_k exp(−a_k L[ρa] − b_k L[ρb]) + S): the response and the material curve of `splat`.

    The output is u, hardened attenuation; (ρa, ρb) are piecewise linear in it between `knots` [knot]: `densities`
    [knot, 2] and `slopes` [knot − 1, 2]. S is `scatter` over the open field. The penalty is `tv` times the mean of
    |∇u|/water over the voxels of the grid, ∇ in differences along y, x and z times `ratios`; `water` is in 1/mm.
    """

    grid: Grid
    knots: torch.Tensor
    densities: torch.Tensor
    slopes: torch.Tensor
    nodes: torch.Tensor
    log_eta: torch.Tensor
    ratios: tuple[float, ...]
    water: float
    tv: float
    scatter: float = 0.0
    dark: NDArray[np.bool_] | None = field(default=None)
    scales: tuple[float, ...] = (1.0,)

    def densities_of(self, u: torch.Tensor) -> torch.Tensor:
        """Return ρa and ρb, [point, 2]."""
        return _Densities.apply(u, self)  # pyright: ignore[reportReturnType]

    def line_integrals(self, values: torch.Tensor, views: Views) -> torch.Tensor:
        """Return P with the scatter, without it where a reading is a bound."""
        rho = self.densities_of(values[:, 0])
        la, lb = (self.grid.project(rho[:, k].contiguous(), views) for k in range(2))
        a, b, log_eta = (t.view(-1, 1, 1, 1) for t in (self.nodes[:, 0], self.nodes[:, 1], self.log_eta))
        log_primary = torch.logsumexp(log_eta - a * la - b * lb, 0)
        if not self.scatter:
            return -log_primary
        seen = -torch.logaddexp(log_primary, torch.full_like(log_primary, math.log(self.scatter)))
        return seen if self.dark is None else torch.where(torch.from_numpy(self.dark[views]), -log_primary, seen)

    def penalty(self, values: torch.Tensor) -> torch.Tensor | None:
        """Return total variation."""
        return _Variation.apply(values[:, 0], self) if self.tv else None  # pyright: ignore[reportReturnType]


class _Densities(torch.autograd.Function):
    """The material curve at each point."""

    @staticmethod
    def forward(ctx: Any, u: torch.Tensor, curve: Curve) -> torch.Tensor:
        knots, densities, slopes = (t.double().numpy() for t in (curve.knots, curve.densities, curve.slopes))
        ctx.u, ctx.knots, ctx.slopes = u.detach().contiguous().numpy(), knots, slopes
        out = np.empty((u.numel(), 2), ctx.u.dtype)
        curve_cpu.evaluate(ctx.u, knots, densities, slopes, 1.0, out)
        return torch.from_numpy(out)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
        out = np.empty_like(ctx.u)
        curve_cpu.transpose(ctx.u, ctx.knots, ctx.slopes, gradients[0].contiguous().numpy(), out)
        return torch.from_numpy(out), None


class _Variation(torch.autograd.Function):
    """Total variation, its root rounded; the gradient is worked out along with it."""

    @staticmethod
    def forward(ctx: Any, u: torch.Tensor, curve: Curve) -> torch.Tensor:
        water, grid = curve.water, curve.grid
        volume = grid.columns(u.detach() / water).numpy()
        ratios = np.array(curve.ratios, volume.dtype)
        field, sums = np.empty((3, *volume.shape), volume.dtype), np.empty(len(volume))
        tv_cpu.smoothed_slopes(volume, ratios, SMOOTH, field, sums)
        by_volume = np.empty_like(volume)
        tv_cpu.transposed(field, ratios, by_volume)
        weight = curve.tv / math.prod(grid.whole.n_voxel)
        ctx.gradient = grid.at_points(torch.from_numpy(by_volume)) * (weight / water)
        return torch.tensor(weight * float(sums.sum()), dtype=u.dtype)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
        return gradients[0] * ctx.gradient, None
