"""A small 3-D network that adds a bounded residual to NMAR, and the same network on FDK alone.

    x = b + β tanh(u_0 + Σ_j u_j (c_j − b))

b is the last source (NMAR for `fusion`, FDK for `denoise`). The c_j are the sources and their Gaussian means with
standard deviations of one and two voxels. u_0 and u_j, a number a voxel each, come from a U-Net of three levels with
3 × 3 × 3 convolutions that sees the c_j and the metal: it says where to take which of them. β = 1 water: no voxel is
further from b.
"""

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

BOUND = 1.0  # water
WIDTHS = (1.0, 2.0)  # standard deviations of the Gaussian means, voxels
HALO = 24  # voxels from which on no voxel of another slice matters, a multiple of 4
SIZES: dict[str, dict[str, str | int]] = {
    "fusion": {"kind": "residual", "sources": 3, "metal": 1, "channels": 16},
    "denoise": {"kind": "residual", "sources": 1, "metal": 0, "channels": 16},
}
"""The architecture of each method: how many volumes it sees, whether it is told the metal, and its channels."""


class Residual(nn.Module):
    """The network u and the bound of its output."""

    def __init__(self, *, sources: int, metal: int, channels: int) -> None:
        super().__init__()
        self.metal = bool(metal)
        seen = sources * (1 + len(WIDTHS)) + 2 * metal
        self.first = nn.Conv3d(seen, channels, 3, padding=1)
        self.down = nn.ModuleList(nn.Conv3d(channels, channels, 3, padding=1) for _ in range(3))
        self.up = nn.ModuleList(nn.Conv3d(channels, channels, 3, padding=1) for _ in range(2))
        self.last = nn.Conv3d(channels, 1 + sources * (1 + len(WIDTHS)), 1)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)  # pyright: ignore[reportArgumentType]

    def forward(self, sources: Tensor, metal: Tensor) -> Tensor:
        """Return the volume, [item, 1, z, y, x] in multiples of water; arguments as for `change`."""
        return sources[:, -1:] + self.change(sources, metal)

    def change(self, sources: Tensor, metal: Tensor) -> Tensor:
        """Return what is added to the last source, [item, 1, z, y, x] in multiples of water.

        `sources` [item, source, z, y, x] are in multiples of water; `metal` [item, 1, z, y, x] is 1 in metal.
        """
        candidates = torch.cat([sources, *(smooth(sources, width) for width in WIDTHS)], 1)
        near = [metal, 4 * smooth(metal, WIDTHS[-1])] if self.metal else []
        u = self.weights(torch.cat([candidates, *near], 1))
        taken = (u[:, 1:] * (candidates - sources[:, -1:])).sum(1, keepdim=True)
        return BOUND * torch.tanh(u[:, :1] + taken)

    def weights(self, seen: Tensor) -> Tensor:
        """Return u_0 and u_j, of any size: volumes are padded to multiples of 4 voxels."""
        shape = seen.shape[2:]
        pad = [n for size in reversed(shape) for n in (0, -size % 4)]
        fine = functional.silu(self.first(functional.pad(seen, pad, mode="replicate")))
        middle = functional.silu(self.down[0](functional.avg_pool3d(fine, 2)))
        coarse = functional.silu(self.down[1](functional.avg_pool3d(middle, 2)))
        middle = functional.silu(self.down[2](middle + enlarged(coarse)))
        middle = middle + functional.silu(self.up[0](middle))
        fine = functional.silu(self.up[1](fine + enlarged(middle)))
        return self.last(fine)[..., : shape[0], : shape[1], : shape[2]]


def enlarged(x: Tensor) -> Tensor:
    """Return each voxel eight times."""
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")


def smooth(x: Tensor, width: float) -> Tensor:
    """Return the Gaussian mean of [item, channel, z, y, x]; `width` is its standard deviation, cut off at three."""
    radius = math.ceil(3 * width)
    at = torch.arange(-radius, radius + 1, device=x.device, dtype=torch.float32)
    weights = torch.exp(-0.5 * (at / width) ** 2)
    weights = (weights / weights.sum()).to(x.dtype)
    out = x.flatten(0, 1)[:, None]
    for axis in range(3):
        shape, pad = [1] * 5, [0] * 6
        shape[2 + axis] = len(at)
        pad[2 * (2 - axis)] = pad[2 * (2 - axis) + 1] = radius
        out = functional.conv3d(functional.pad(out, pad, mode="replicate"), weights.reshape(shape))
    return out.reshape(x.shape)


def loss(volume: Tensor, truth: Tensor, weight: Tensor) -> Tensor:
    """Return the weighted mean of Huber's loss, quadratic up to a tenth of water."""
    return (weight * functional.smooth_l1_loss(volume, truth, reduction="none", beta=0.1)).sum() / weight.sum()
