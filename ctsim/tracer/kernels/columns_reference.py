"""Readable twin of `columns_cpu`'s list of label boundaries: one voxel column at a time."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray


def boundaries(labels: NDArray[np.uint8]) -> list[list[list[tuple[int, int, int]]]]:
    """Return (height, label below, label above) of each change upwards in column [y][x] of `labels` [z, y, x].

    Below and above the volume the label is 0.
    """
    columns = np.pad(labels.astype(int), ((1, 1), (0, 0), (0, 0))).transpose(1, 2, 0).tolist()
    return [[[(z, a, b) for z, (a, b) in enumerate(pairwise(c)) if a != b] for c in row] for row in columns]
