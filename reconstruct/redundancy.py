"""How much each measured ray counts: angular steps, rays seen twice, detectors shifted sideways."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry, leaves_none_out, turn_of


@dataclass(frozen=True, slots=True, kw_only=True)
class RayWeights:
    """What `ray_weights` found out about a scan.

    `values` [view, u] in radians; `radius` of the field of view in mm; `margin`, the columns to add before
    and after each row for the filtered rays that a shifted detector misses; `note`, what falls short.
    """

    values: NDArray[np.float32]
    radius: float
    kind: str
    margin: tuple[int, int] = (0, 0)
    note: str = ""


def ray_weights(geometry: Geometry) -> RayWeights:
    """Return the weight of every ray of a circular orbit: its angular step times its share of the redundancy.

    The shares of a ray and its opposite add up to one. A full turn shares equally, or smoothly across the
    overlap when the detector is shifted sideways (Wang, Med. Phys. 29, 2002, doi:10.1118/1.1489043); a
    shorter arc follows Parker (Med. Phys. 9, 1982, doi:10.1118/1.595078), with Silver's wider overlap for
    arcs beyond 180° plus the fan (Med. Phys. 27, 2000, doi:10.1118/1.598939).
    """
    place, step, arc, full = _view_steps(geometry)
    n_u, d_u, off = geometry.n_detector[1], geometry.d_detector[1], geometry.off_detector[1]
    u = (np.arange(n_u) - (n_u - 1) / 2) * d_u + off
    fan = np.arctan(u / geometry.dsd)
    long, short = n_u * d_u / 2 + abs(off), n_u * d_u / 2 - abs(off)
    notes, margin = [], (0, 0)
    if full:
        kind = "full turn" if abs(off) <= d_u / 2 else "full turn, shifted detector"
        share = np.broadcast_to(_overlap_share(fan, off, short, geometry), (len(step), n_u))
        edge = long
        # Filtered rays are not zero where the detector ends, though the weighted rays are.
        missing = math.ceil((long - short) / d_u - 1e-9) if abs(off) > d_u / 2 else 0
        margin = (missing, 0) if off > 0 else (0, missing)
        if short <= 0:
            notes.append("the detector does not reach the rotation axis, so the centre is not measured")
    else:
        kind = "short scan"
        share = parker_share(place[:, None], fan[None, :], arc)
        edge = short if short > 0 else long
        needed = 180 + 2 * math.degrees(math.atan(edge / geometry.dsd))
        if math.degrees(arc) < needed - 1e-6:
            notes.append(f"the arc of {math.degrees(arc):.4g}° is below 180° plus the fan, {needed:.4g}°")
        if abs(off) > d_u / 2:
            notes.append("a short scan does not complete the rays that the shifted detector misses")
    radius = geometry.dso * math.sin(math.atan(edge / geometry.dsd))
    values = (step[:, None] * share).astype(np.float32)
    return RayWeights(values=values, radius=radius, kind=kind, margin=margin, note="; ".join(notes))


def parker_share(place: NDArray[np.float64], fan: NDArray[np.float64], arc: float) -> NDArray[np.float64]:
    """Return each ray's share for an arc below 360°; rays without an opposite in the arc count fully.

    `place` is the view's distance from the start of the arc and `fan` the ray's angle, positive along +u;
    the opposite of (place, fan) is (place + π − 2 fan, −fan). Broadcasts; radians.
    """
    surplus = arc - math.pi
    rise, fall = surplus + 2 * fan, surplus - 2 * fan
    with np.errstate(divide="ignore", invalid="ignore"):
        up = np.sin(np.pi / 2 * place / rise) ** 2
        down = np.sin(np.pi / 2 * (arc - place) / fall) ** 2
    share = np.where(place < rise, up, 1.0)
    return np.where(arc - place < fall, down, share)


def _overlap_share(fan: NDArray[np.float64], off: float, short: float, geometry: Geometry) -> NDArray[np.float64]:
    """Share of a full turn's rays, [u]: a half, and smoothly to 0 and 1 where the shifted detector ends."""
    if abs(off) <= geometry.d_detector[1] / 2:
        return np.full_like(fan, 0.5)
    if short <= 0:
        return np.ones_like(fan)
    # A small shift keeps equal shares in the middle: they are the best for noise.
    end = math.atan(short / geometry.dsd)
    feather = min(end, math.atan(4 * abs(off) / geometry.dsd))
    ramp = np.sin(np.pi / 2 * np.clip((np.abs(fan) - (end - feather)) / feather, 0, 1))
    return 0.5 + 0.5 * np.sign(fan) * math.copysign(1.0, off) * ramp


def _view_steps(geometry: Geometry) -> tuple[NDArray[np.float64], NDArray[np.float64], float, bool]:
    """Place of each view within the arc, the angle it stands for, the arc, and whether it is a full turn; radians."""
    n = geometry.n_views
    if geometry.angles_deg is None:
        arc = math.radians(abs(geometry.arc_deg))
        step = np.full(n, arc / n)
        place = (np.arange(n, dtype=np.float64) + 0.5) * (arc / n)
        return (place if geometry.arc_deg > 0 else arc - place), step, arc, abs(geometry.arc_deg) > 360 - 1e-6
    turn = 2 * math.pi
    distinct, which, repeats, gaps = turn_of(geometry.angles)  # repeated views share one step
    if len(distinct) == 1:
        return np.full(n, math.pi), np.full(n, turn / n), turn, True
    widest = int(np.argmax(gaps))
    if leaves_none_out(gaps):
        step = (gaps + np.roll(gaps, 1)) / 2
        return distinct[which], (step / repeats)[which], turn, True
    after = gaps.copy()
    after[widest] = gaps[widest - 1]
    before = np.roll(gaps, 1)
    start = (widest + 1) % len(distinct)
    before[start] = gaps[start]
    step = (after + before) / 2
    arc = float(step.sum())
    place = np.mod(distinct - distinct[start], turn) + before[start] / 2
    return place[which], (step / repeats)[which], arc, False
