"""Random streams that are named, not seeded: Philox4x32-10 keyed by scene, purpose and view.

A number depends on its stream's name and its own index alone. Order, chunks, workers and threads change
nothing, and two scans of one scene share their noise pixel by pixel.
"""

import hashlib

import numpy as np
from numpy.typing import NDArray

from ctsim.kernels import noise_cpu


def stream_key(scene_id: str, purpose: str, view: int) -> np.uint64:
    """Hash a stream's name into Philox's 64-bit key (BLAKE2b of the length-prefixed parts)."""
    digest = hashlib.blake2b(digest_size=8)
    for part in (scene_id, purpose, str(int(view))):
        data = part.encode()
        digest.update(len(data).to_bytes(8, "little") + data)
    return np.uint64(int.from_bytes(digest.digest(), "little"))


def words(key: np.uint64, n: int, *, first: int = 0, draw: int = 0) -> NDArray[np.uint32]:
    """Return the four random 32-bit words of the counters (first + i, draw), [n, 4]."""
    out = np.empty((n, 4), np.uint32)
    noise_cpu.blocks(np.uint64(key), first, draw, out)
    return out


def uniform(key: np.uint64, n: int, *, draw: int = 0) -> NDArray[np.float64]:
    """Return two independent uniform numbers within (0, 1) for each of n counters, [n, 2], on a grid of 2^-52."""
    w = words(key, n, draw=draw).astype(np.uint64)
    pair = np.stack([w[:, 0] << np.uint64(32) | w[:, 1], w[:, 2] << np.uint64(32) | w[:, 3]], 1)
    return ((pair >> np.uint64(12)).astype(np.float64) + 0.5) * 2.0**-52


def normal(key: np.uint64, n: int, *, draw: int = 0) -> NDArray[np.float64]:
    """Return two independent standard normal numbers for each of n counters, [n, 2] (Box–Muller)."""
    u = uniform(key, n, draw=draw)
    radius, angle = np.sqrt(-2.0 * np.log(u[:, 0])), 2.0 * np.pi * u[:, 1]
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
