"""Our axes in the words of other libraries: TIGRE, LEAP, ASTRA, RTK, and R2-Gaussian, whose order NAF has, too.

Only this module and `ctsim.io`, for files of patients, permute axes. Ours: volume [z, y, x], projections [view, v, u],
angles in radians, right-handed x, y, z in mm. Functions take and return views of the array where they can.
"""

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry


class Library(StrEnum):
    """Whose conventions."""

    TIGRE = "tigre"
    LEAP = "leap"
    ASTRA = "astra"
    RTK = "rtk"
    R2_GAUSSIAN = "r2_gaussian"


# Axis k of theirs is axis order[k] of ours.
_VOLUME = {
    Library.TIGRE: (0, 1, 2),
    Library.LEAP: (0, 1, 2),
    Library.ASTRA: (0, 1, 2),
    Library.RTK: (2, 0, 1),
    Library.R2_GAUSSIAN: (2, 1, 0),
}
_PROJECTIONS = {
    Library.TIGRE: (0, 1, 2),
    Library.LEAP: (0, 1, 2),
    Library.ASTRA: (1, 0, 2),
    Library.RTK: (0, 1, 2),
    Library.R2_GAUSSIAN: (0, 1, 2),
}
# Component k of theirs is component order[k] of our x, y, z.
_POINTS = dict.fromkeys(Library, (0, 1, 2)) | {Library.RTK: (1, 2, 0)}


def volume_to(library: Library, volume: NDArray) -> NDArray:
    """Permute a volume [z, y, x] to the axis order of `library`; a view."""
    return np.transpose(_three_axes(volume, "volume"), _VOLUME[library])


def volume_from(library: Library, volume: NDArray) -> NDArray:
    """Permute a volume of `library` to [z, y, x]; a view."""
    return np.transpose(_three_axes(volume, "volume"), np.argsort(_VOLUME[library]))


def projections_to(library: Library, projections: NDArray) -> NDArray:
    """Permute projections [view, v, u] to the axis order of `library`, rows flipped where it does so; a view."""
    theirs = np.transpose(_three_axes(projections, "projections"), _PROJECTIONS[library])
    return theirs[:, ::-1] if library is Library.R2_GAUSSIAN else theirs


def projections_from(library: Library, projections: NDArray) -> NDArray:
    """Permute projections of `library` to [view, v, u]; a view."""
    theirs = _three_axes(projections, "projections")
    theirs = theirs[:, ::-1] if library is Library.R2_GAUSSIAN else theirs
    return np.transpose(theirs, np.argsort(_PROJECTIONS[library]))


def points_to(library: Library, points: NDArray) -> NDArray:
    """Rename the components of points [..., xyz] to the frame of `library`, in mm."""
    return points[..., list(_POINTS[library])]


def angles_to(library: Library, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert view angles in radians: ASTRA's and LEAP's are a quarter turn ahead, LEAP's and RTK's are in degrees.

    LEAP's set_conebeam takes the quarter turn off again; its source is at the angle that is left.
    """
    if library is Library.ASTRA:
        return angles + np.pi / 2
    if library is Library.LEAP:
        return np.degrees(angles) + 90
    return np.degrees(angles) if library is Library.RTK else angles


def astra_vectors(geometry: Geometry) -> NDArray[np.float64]:
    """Return the rows of ASTRA's `cone_vec` geometry, [view, 12] in mm: source, detector centre, u step, v step."""
    return geometry.pose_array()


def _three_axes(array: NDArray, name: str) -> NDArray:
    if array.ndim != 3:
        raise InputError(f"{name} must have three axes, got shape {array.shape}")
    return array
