"""Cone-beam geometry: where source, detector pixels and voxels are.

Right-handed x, y, z in mm with the origin at the isocentre; rotation about +z, counter-clockwise seen
from +z. At view angle a the source is at dso·(cos a, sin a, 0), the detector's u axis is
(−sin a, cos a, 0) and its v axis is +z; row 0 is at the bottom. Volumes are [z, y, x], projections
[view, v, u]. This is the frame of TIGRE and LEAP.
"""

import math
import reprlib
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError

Triple = tuple[float, float, float]
Pair = tuple[float, float]
FARTHEST = 1e6  # mm, and degrees: nothing of a scanner is larger
MOST_VIEWS, MOST_PIXELS, MOST_VOXELS = 10**6, 2**28, 2**34  # of a scan, of one view, of one volume
_SHORTEST, _FLAT = 1e-9, 1e-6  # a pixel's step in mm; the sine below which two directions are one
Count = Annotated[int, msgspec.Meta(ge=1)]
_KINDS = {  # of the keys: numbers of an axis each, one number where there are none; and whether they are whole
    "dso": ("", False),
    "dsd": ("", False),
    "n_voxel": ("zyx", True),
    "d_voxel": ("zyx", False),
    "n_detector": ("vu", True),
    "d_detector": ("vu", False),
    "n_views": ("", True),
    "off_origin": ("zyx", False),
    "off_detector": ("vu", False),
    "start_deg": ("", False),
    "arc_deg": ("", False),
}
_SAID = 80  # characters of what is refused
_LISTS = {"angles_deg": "a number for each view", "poses": "12 numbers for each view"}


class Geometry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scan's geometry: source and detector poses, detector pixels, and the reconstruction grid.

    Lengths are mm. Views lie at start_deg + k·arc_deg/n_views, or at `angles_deg`, or at `poses`.
    """

    dso: float
    """Distance from the source to the axis."""
    dsd: float
    """Distance from the source to the detector."""
    n_voxel: tuple[Count, Count, Count]
    """Voxels (z, y, x) of the reconstruction grid."""
    d_voxel: Triple
    """Size of a voxel (z, y, x)."""
    n_detector: tuple[Count, Count]
    """Pixels (v, u)."""
    d_detector: Pair
    """Size of a pixel (v, u)."""
    n_views: Count
    """Number of views."""
    off_origin: Triple = (0.0, 0.0, 0.0)
    """Centre of the grid (z, y, x)."""
    off_detector: Pair = (0.0, 0.0)
    """Shift of the detector (v, u) along its own axes."""
    start_deg: float = 0.0
    """Angle of the first view."""
    arc_deg: float = 360.0
    """Arc of the scan; negative is clockwise."""
    angles_deg: tuple[float, ...] | None = None
    """The angle of each view, instead of even steps."""
    poses: tuple[tuple[float, ...], ...] | None = None
    """12 numbers a view: source, detector centre, u step, v step; each x, y, z, the steps one pixel long."""

    def __post_init__(self) -> None:
        self._settle()
        for name in ("dso", "dsd", "d_voxel", "d_detector", "off_origin", "off_detector", "start_deg", "arc_deg"):
            if not np.all(np.isfinite(getattr(self, name))):
                raise InputError(f"{name} must be finite, got {getattr(self, name)}")
            if np.max(np.abs(getattr(self, name))) > FARTHEST:
                raise InputError(f"{name} must be within ±{FARTHEST:.0e}, got {getattr(self, name)}")
        for name in ("n_voxel", "n_detector", "n_views"):
            if np.min(getattr(self, name)) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name, most in (("n_voxel", MOST_VOXELS), ("n_detector", MOST_PIXELS), ("n_views", MOST_VIEWS)):
            if math.prod(np.atleast_1d(getattr(self, name)).tolist()) > most:
                raise InputError(f"{name} must give at most {most} in all, got {getattr(self, name)}")
        for name in ("d_voxel", "d_detector"):
            if np.min(getattr(self, name)) <= 0:
                raise InputError(f"{name} must be positive (mm), got {getattr(self, name)}")
        if not 0 < self.dso < self.dsd:
            wrong = "dsd" if self.dso > 0 else "dso"
            raise InputError(f"{wrong}: expected 0 < dso < dsd (mm), got dso = {self.dso} and dsd = {self.dsd}")
        if not 0 < abs(self.arc_deg) <= 360:
            raise InputError(f"arc_deg must be within (0, 360] in magnitude, got {self.arc_deg}")
        if self.angles_deg is not None and self.poses is not None:
            raise InputError("angles_deg and poses exclude each other: expected one of them")
        for name in ("angles_deg", "poses"):
            given = getattr(self, name)
            if given is not None and len(given) != self.n_views:
                raise InputError(f"{name} has {len(given)} entries but n_views is {self.n_views}")
        if self.angles_deg is not None:
            angles = _numbers(self.angles_deg)
            if angles is None or angles.ndim != 1:
                raise InputError(f"angles_deg: expected {_LISTS['angles_deg']}, got {_brief(self.angles_deg)}")
            if not np.all(np.abs(angles) <= FARTHEST):
                raise InputError(f"angles_deg must be finite and within ±{FARTHEST:.0e}")
        if self.poses is not None:
            _check_poses(self.poses, self.n_detector)
        elif not (longest := _longest_rays(self.pose(0)[None], self.n_detector)[0]) < FARTHEST:
            raise InputError(
                f"d_detector, n_detector, dsd and off_detector put a pixel {longest:.3g} mm from the source; "
                f"expected less than {FARTHEST:.0e} mm"
            )

    def _settle(self) -> None:
        """Refuse what is no number, or not as many as there are axes; turn NumPy's numbers and lists into ours.

        msgspec checks what is read from a file. What is written in Python reaches here as it is.
        """
        for name, (axes, whole) in _KINDS.items():
            given, kind = getattr(self, name), int if whole else float
            values = given if axes and type(given) is tuple else (given,)
            if len(values) == (len(axes) or 1) and all(type(x) is kind for x in values):
                continue  # as nearly always, so that it costs little
            found = _numbers(given)
            if found is None or found.shape != (len(axes),) * bool(axes) or (whole and found.dtype.kind == "f"):
                what = ("whole number" if whole else "number") + "s" * bool(axes)
                many = f"{len(axes)} {what} ({', '.join(axes)})" if axes else f"a {what}"
                raise InputError(f"{name}: expected {many}, got {_brief(given)}")
            msgspec.structs.force_setattr(self, name, tuple(found.tolist()) if axes else found.item())
        for name, wanted in _LISTS.items():
            given = getattr(self, name)
            if given is None or (type(given) is tuple and all(map(_is_plain, given))):
                continue
            if not isinstance(given, tuple | list | np.ndarray):
                raise InputError(f"{name}: expected {wanted}, got {_brief(given)}")
            msgspec.structs.force_setattr(self, name, _plain(given))

    @property
    def angles(self) -> NDArray[np.float64]:
        """View angles in radians, [view]."""
        if self.angles_deg is not None:
            return np.radians(np.asarray(self.angles_deg, np.float64))
        return np.radians(self.start_deg + np.arange(self.n_views) * (self.arc_deg / self.n_views))

    @property
    def s_voxel(self) -> Triple:
        """Extent of the reconstruction grid (z, y, x) in mm."""
        z, y, x = (n * d for n, d in zip(self.n_voxel, self.d_voxel, strict=True))
        return z, y, x

    @property
    def s_detector(self) -> Pair:
        """Extent of the detector (v, u) in mm."""
        v, u = (n * d for n, d in zip(self.n_detector, self.d_detector, strict=True))
        return v, u

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of the projections, (view, v, u)."""
        return (self.n_views, *self.n_detector)

    def pose_array(self) -> NDArray[np.float64]:
        """Source, detector centre, u step and v step of each view: [view, 12], mm, x y z order.

        Pixel (v, u) has its centre at centre + (u − (n_u−1)/2)·u_step + (v − (n_v−1)/2)·v_step.
        """
        if self.poses is not None:
            return np.asarray(self.poses, np.float64)
        return self._circle(self.angles)

    def pose(self, view: int) -> NDArray[np.float64]:
        """Return one view's row of `pose_array`, [12]."""
        if self.poses is not None:
            return np.asarray(self.poses[view], np.float64)
        return self._circle(self.angles[view : view + 1])[0]

    def poses_between(self, views: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return poses at fractional views [n], as `pose_array`: on the circle, or between given poses on a line."""
        known = np.arange(self.n_views)
        if self.poses is None:
            return self._circle(np.interp(views, known, self.angles))
        return np.stack([np.interp(views, known, column) for column in self.pose_array().T], 1)

    def _circle(self, a: NDArray[np.float64]) -> NDArray[np.float64]:
        cos, sin, zero = np.cos(a), np.sin(a), np.zeros_like(a)
        e_r = np.stack([cos, sin, zero], 1)
        e_u = np.stack([-sin, cos, zero], 1)
        e_v = np.stack([zero, zero, zero + 1], 1)
        off_v, off_u = self.off_detector
        d_v, d_u = self.d_detector
        centre = -(self.dsd - self.dso) * e_r + off_u * e_u + off_v * e_v
        return np.concatenate([self.dso * e_r, centre, d_u * e_u, d_v * e_v], 1)

    def voxel_centres(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Coordinates of the voxel centres along z, y and x in mm."""
        z, y, x = (
            (np.arange(n, dtype=np.float64) + 0.5 - n / 2) * d + o
            for n, d, o in zip(self.n_voxel, self.d_voxel, self.off_origin, strict=True)
        )
        return z, y, x

    @property
    def is_full_turn(self) -> bool:
        """Whether the views stand all round a circle, so that each ray has an opposite one, or nearly."""
        if self.poses is not None:
            return False
        if self.angles_deg is None:
            return abs(self.arc_deg) >= 360 - 1e-9
        return leaves_none_out(turn_of(self.angles)[-1])

    @property
    def fov_radius(self) -> float:
        """Radius in mm of the cylinder about the axis that every view's fan covers (0 if none).

        For a laterally offset detector over a full turn this is the covered half plus its mirror: the
        larger of the two sides, as long as every view sees the axis.
        """
        half, off = self.s_detector[1] / 2, abs(self.off_detector[1])
        edge = half + off if self.is_full_turn and off < half else half - off
        return self.dso * math.sin(math.atan(edge / self.dsd)) if edge > 0 else 0.0


def _numbers(given: Any) -> NDArray[Any] | None:
    """Return what is given as an array of real numbers; None where it is something else, or rows of unequal length."""
    try:
        found = np.asarray(given)
    except (TypeError, ValueError, RuntimeError, OverflowError):  # the third of a tensor that needs a gradient
        return None
    return found if found.dtype.kind in "iuf" else None


def _is_plain(given: Any) -> bool:
    """Whether something is a number of Python or a tuple of such."""
    return type(given) in (float, int) or (type(given) is tuple and all(type(x) in (float, int) for x in given))


def _plain(given: Any) -> Any:
    """Return numbers and arrays of NumPy as Python's, lists as tuples, and what is none of these as it is."""
    known = given.tolist() if isinstance(given, np.ndarray | np.generic) else given
    return tuple(map(_plain, known)) if isinstance(known, tuple | list) else known


def _brief(given: Any) -> str:
    """Return what is given in a few words on one line."""
    text = " ".join(reprlib.repr(given).split())
    return text if len(text) <= _SAID else f"{text[:_SAID]}…"


def turn_of(
    angles: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the distinct angles (radians) of a turn, which of them each view has, their repeats, and the gaps."""
    turn = 2 * math.pi
    angle = np.round(np.mod(angles, turn), 9).astype(np.float64)  # repeated views are one but for rounding
    angle[angle >= round(turn, 9)] = 0.0
    distinct, which, repeats = np.unique(angle, return_inverse=True, return_counts=True)
    return distinct, which, repeats, np.diff(distinct, append=distinct[0] + turn)


def leaves_none_out(gaps: NDArray[np.float64]) -> bool:
    """Say whether gaps between views are those of a whole turn: one over twice as wide as any other was not scanned."""
    widest = int(np.argmax(gaps))
    return len(gaps) > 1 and bool(gaps[widest] <= 2.001 * np.max(np.delete(gaps, widest)))


def few_views(n_views: int, most: int) -> NDArray[np.int64]:
    """Return at most `most` of the views, evenly spaced from the first to the last."""
    return np.unique(np.linspace(0, n_views - 1, min(most, n_views)).round().astype(np.int64))


def crosswise(e_u: NDArray[np.float64], e_v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the part of each step [..., xyz] at right angles to the other: p_u and p_v, the steps if they are so.

    The point x = a·e_u + b·e_v has a = x·p_u/(p_u·p_u) and b = x·p_v/(p_v·p_v).
    """
    if not np.any((e_u * e_v).sum(-1)):
        return e_u, e_v
    parts = []
    for part, other in ((e_u, e_v), (e_v, e_u)):
        square = (other * other).sum(-1, keepdims=True)
        for _ in range(2):  # again, since steps that are all but parallel leave the rounding of the first time
            part = part - (part * other).sum(-1, keepdims=True) / square * other
        parts.append(part)
    return parts[0], parts[1]


def _longest_rays(poses: NDArray[np.float64], n_detector: tuple[int, int]) -> NDArray[np.float64]:
    """Distance in mm from the source to the farthest corner of the detector in each view: [view]."""
    v, u = (n / 2 for n in n_detector)
    across = poses[:, 3:6] - poses[:, :3]
    corners = [across + i * u * poses[:, 6:9] + j * v * poses[:, 9:] for i in (-1, 1) for j in (-1, 1)]
    return np.linalg.norm(corners, axis=2).max(0)


def _check_poses(rows: tuple[tuple[float, ...], ...], n_detector: tuple[int, int]) -> None:
    """Refuse poses that are no source before a detector, naming the first such view."""
    for view, row in enumerate(rows):
        if not isinstance(row, (tuple, list, np.ndarray)):
            raise InputError(f"poses[{view}]: expected 12 numbers, got {_brief(row)}")
        if len(row) != 12:
            raise InputError(
                f"poses[{view}] has {len(row)} numbers; expected 12: "
                "source, detector centre, u step, v step (x, y, z each)"
            )
    if (found := _numbers(rows)) is None or found.ndim != 2:
        raise InputError(f"poses: expected {_LISTS['poses']}, got {_brief(rows)}")
    poses = found.astype(np.float64)

    def refuse(bad: Any, what: str) -> None:
        if bad.any():
            raise InputError(f"poses[{int(bad.argmax())}]: {what}")

    refuse(~(np.abs(poses) <= FARTHEST).all(1), f"every number must be finite and within ±{FARTHEST:.0e}")
    across, du, dv = poses[:, 3:6] - poses[:, :3], poses[:, 6:9], poses[:, 9:]
    length_u, length_v, length = (np.linalg.norm(x, axis=1) for x in (du, dv, across))
    for axis, steps in (("u", length_u), ("v", length_v)):
        refuse(steps < _SHORTEST, f"the {axis} step must be at least {_SHORTEST:.0e} mm long")
    normal = np.cross(du / length_u[:, None], dv / length_v[:, None])
    sine = np.linalg.norm(normal, axis=1)
    refuse(sine < _FLAT, "the u and v steps must not be parallel")
    height = np.abs((across * normal).sum(1)) / sine
    refuse(height <= _FLAT * length, "the source must not lie in the detector's plane")
    longest = _longest_rays(poses, n_detector)
    refuse(~(longest < FARTHEST), f"every pixel must be less than {FARTHEST:.0e} mm from the source")
