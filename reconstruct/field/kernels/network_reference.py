"""The field at points of any place, in float64 and by torch, so that gradients are torch's."""

from collections.abc import Mapping

import numpy as np
import torch
from numpy.typing import NDArray

PRIMES = (1, 2654435761, 805459861)  # Müller et al. 2022, section 3
CORNERS = 8


def corners(
    points: NDArray[np.float64], resolution: int, table: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], bool]:
    """Return the entries [n, 8] of the corners around each point, their weights [n, 8], and whether all fit the table.

    Corner c lies c & 1 cubes further along axis 0, c >> 1 & 1 along axis 1 and c >> 2 along axis 2.
    """
    scaled = points * resolution
    first = np.clip(np.floor(scaled), 0, resolution - 1).astype(np.int64)
    share = scaled - first
    sizes = np.max(first, axis=0, initial=0) + 2
    fits = int(np.prod(sizes)) <= 1 << table
    at, weights = np.empty((len(points), CORNERS), np.int64), np.empty((len(points), CORNERS))
    for c in range(CORNERS):
        step = np.array([c & 1, c >> 1 & 1, c >> 2])
        i, j, k = (first + step).T
        if fits:
            at[:, c] = (i * sizes[1] + j) * sizes[2] + k
        else:
            at[:, c] = (i * PRIMES[0] ^ j * PRIMES[1] ^ k * PRIMES[2]) % (1 << table)
        weights[:, c] = np.prod(np.where(step, share, 1 - share), 1)
    return at, weights, fits


def encode(
    points: NDArray[np.float64], resolutions: tuple[int, ...], table: int
) -> tuple[torch.Tensor, torch.Tensor, int]:
    """Return the rows of a table [n, level, 8] that points [n, 3] need, their weights, and the number of rows."""
    rows, weights, entries = [], [], 0
    for resolution in resolutions:
        at, weight, _ = corners(points, resolution, table)
        used, at = np.unique(at, return_inverse=True)
        rows.append(at.reshape(-1, CORNERS) + entries)
        weights.append(weight)
        entries += used.size
    return torch.from_numpy(np.stack(rows, 1)), torch.from_numpy(np.stack(weights, 1)), entries


def evaluate(
    rows: torch.Tensor, weights: torch.Tensor, parameters: Mapping[str, torch.Tensor], scale: torch.Tensor
) -> torch.Tensor:
    """Return scale · squareplus(w2ᵀ · relu(w1ᵀ · h + b1) + b2), [point, output]."""
    features = (parameters["table"][rows] * weights[..., None]).sum(2).flatten(1)
    hidden = torch.relu(features @ parameters["w1"] + parameters["b1"])
    x = hidden @ parameters["w2"] + parameters["b2"]
    return scale * 0.5 * (x + torch.sqrt(x * x + 4))
