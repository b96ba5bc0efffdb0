"""Ellipsoids and round-ended rods painted into a label volume, compiled.

Labels are uint8 [z, y, x]; `axes` are the voxels' centres x, y, z (float32, rising). `over` is a table of 256 flags:
the labels that may be replaced. A shape is looked for in its bounding box alone.
"""

import numpy as np
from numba import njit


@njit(cache=True)
def _cut(axis, low, high):
    """Return the first and one past the last index with low <= axis < high."""
    first = 0
    while first < len(axis) and axis[first] < low:
        first += 1
    last = first
    while last < len(axis) and axis[last] < high:
        last += 1
    return first, last


@njit(cache=True)
def ellipsoid(labels, axes, label, centre, radii, frame, over):
    """Paint an ellipsoid: centre and radii [3] float64 in x, y, z; the rows of frame [3, 3] are its axes."""
    box, near = np.empty((3, 2), np.int64), np.empty(3, np.float32)
    for k in range(3):
        reach = np.sqrt((frame[0, k] * radii[0]) ** 2 + (frame[1, k] * radii[1]) ** 2 + (frame[2, k] * radii[2]) ** 2)
        box[k, 0], box[k, 1] = _cut(axes[k], centre[k] - reach, centre[k] + reach)
        near[k] = centre[k]
    for iz in range(box[2, 0], box[2, 1]):
        z = axes[2][iz] - near[2]
        for iy in range(box[1, 0], box[1, 1]):
            y = axes[1][iy] - near[1]
            for ix in range(box[0, 0], box[0, 1]):
                x = axes[0][ix] - near[0]
                level = 0.0
                for k in range(3):
                    level += ((frame[k, 0] * x + frame[k, 1] * y + frame[k, 2] * z) / radii[k]) ** 2
                if level <= 1 and over[labels[iz, iy, ix]]:
                    labels[iz, iy, ix] = label


@njit(cache=True)
def tube(labels, axes, label, points, radii, over):
    """Paint a chain of round-ended rods through points [k, 3] (x, y, z) with a radius [k] at each; float64."""
    for k in range(len(points) - 1):
        _rod(labels, axes, label, points[k], points[k + 1], radii[k], radii[k + 1], over)


@njit(cache=True)
def _rod(labels, axes, label, start, end, r0, r1, over):
    r, length2 = max(r0, r1), 0.0
    box, d, near = np.empty((3, 2), np.int64), np.empty(3, np.float32), np.empty(3, np.float32)
    for k in range(3):  # expressions of whole arrays take seconds to compile
        length2 += (end[k] - start[k]) ** 2
        d[k], near[k] = end[k] - start[k], start[k]
        box[k, 0], box[k, 1] = _cut(axes[k], min(start[k], end[k]) - r, max(start[k], end[k]) + r)
    length2 = np.float32(length2 if length2 > 0 else 1e-12)
    r0, grows = np.float32(r0), np.float32(r1 - r0)
    for iz in range(box[2, 0], box[2, 1]):
        z = axes[2][iz] - near[2]
        for iy in range(box[1, 0], box[1, 1]):
            y = axes[1][iy] - near[1]
            for ix in range(box[0, 0], box[0, 1]):
                x = axes[0][ix] - near[0]
                t = min(max((x * d[0] + y * d[1] + z * d[2]) / length2, np.float32(0)), np.float32(1))
                gap = (x - t * d[0]) ** 2 + (y - t * d[1]) ** 2 + (z - t * d[2]) ** 2
                if gap <= (r0 + t * grows) ** 2 and over[labels[iz, iy, ix]]:
                    labels[iz, iy, ix] = label
