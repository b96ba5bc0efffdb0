"""Adding splats where the loss pulls at them and removing faint ones (Kerbl et al. 2023; Zha et al. 2024)."""

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim import rng
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.splat.descent.adam import Array, Moments
from ctsim.reconstruct.splat.kernels.rotations_cpu import write_rotations
from ctsim.reconstruct.splat.model import Splats

Step = Annotated[int, msgspec.Meta(ge=0)]
Threshold = Annotated[float, msgspec.Meta(ge=0, le=1e6)]


class Schedule(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """When and where to densify; `large` is a share of the volume's widest side, `faint` is in 1/mm."""

    first: Step = 500
    last: Step = 15000
    every: Annotated[int, msgspec.Meta(ge=1)] = 100
    pull: Threshold = 5e-5
    large: Threshold = 0.1
    faint: Threshold = 1e-5
    most: Step = 500_000

    def is_due(self, step: int) -> bool:
        """Say whether to densify after `step` steps."""
        return self.first < step < self.last and step % self.every == 0


def screen_pull(centres: NDArray[np.floating], n_u: int) -> NDArray[np.floating]:
    """Turn gradients per pixel into those per half a detector's width, which the published threshold is for."""
    return centres * (n_u / 2)


def densify(
    splats: Splats, pull: NDArray[np.floating], geometry: Geometry, schedule: Schedule, key: np.uint64
) -> tuple[Splats, NDArray[np.int64]]:
    """Return the splats afterwards, and of which splat before each is the same one (−1: it is new).

    Where `pull` [splat], the mean of `screen_pull`, reaches the threshold, a splat of no scale above `large` becomes
    two of half the density at the same place, and a larger one two of half the density, scales by 1.6 down, at places
    drawn from itself. Then those fainter than `faint` in all channels, those whose centre has left the volume of
    `geometry`, and any that are not finite, are removed.
    Where the cap allows fewer, the ones that are pulled most are chosen. `key` names the stream of random numbers.
    """
    if splats.rotations is None:
        raise InputError("the published methods learn rotations; expected splats that have some")
    room = max(0, schedule.most - len(splats))
    chosen = np.flatnonzero(pull >= schedule.pull)
    chosen = np.sort(chosen[np.argsort(-pull[chosen], kind="stable")[:room]])
    is_large = splats.scales[chosen].max(1, initial=0.0) > schedule.large * max(geometry.s_voxel)
    cloned, split = chosen[~is_large], chosen[is_large]
    densities = splats.densities.copy()
    densities[chosen] *= np.float32(0.5)
    stay = np.setdiff1d(np.arange(len(splats)), split)
    order = np.concatenate([stay, cloned, split, split])
    positions, scales = splats.positions[order], splats.scales[order]
    if split.size:
        tail = slice(len(order) - 2 * split.size, None)
        positions[tail] += _drawn(splats, order[tail], key)
        scales[tail] /= np.float32(1.6)
    origin = np.concatenate([stay, np.full(len(order) - len(stay), -1)])
    grown = Splats(positions=positions, scales=scales, densities=densities[order], rotations=splats.rotations[order])
    return _pruned(grown, origin, geometry, schedule.faint)


def _pruned(
    splats: Splats, origin: NDArray[np.int64], geometry: Geometry, faint: float
) -> tuple[Splats, NDArray[np.int64]]:
    assert splats.rotations is not None
    columns = [splats.positions, splats.scales, splats.densities, splats.rotations]
    kept = (splats.densities >= faint).any(1) & np.isfinite(np.concatenate(columns, 1)).all(1)
    middle, side = np.array(geometry.off_origin)[::-1], np.array(geometry.s_voxel)[::-1]
    kept &= (np.abs(splats.positions - middle) <= side / 2).all(1)
    positions, scales, densities, rotations = (array[kept] for array in columns)
    return Splats(positions=positions, scales=scales, densities=densities, rotations=rotations), origin[kept]


def _drawn(splats: Splats, chosen: NDArray[np.int64], key: np.uint64) -> Array:
    """Return places drawn from the splats `chosen`, from their centres [chosen, 3]."""
    assert splats.rotations is not None
    rows = np.empty((9, len(chosen)), np.float32)
    write_rotations(splats.rotations[chosen], rows)
    draws = np.concatenate([rng.normal(key, len(chosen), draw=k) for k in (0, 1)], 1)[:, :3]
    local = splats.scales[chosen] * draws
    return np.einsum("nij,nj->ni", rows.T.reshape(-1, 3, 3), local).astype(np.float32)


def carried(moments: Moments, origin: NDArray[np.int64]) -> Moments:
    """Return the moments of the splats after `densify`: new ones begin with none."""

    def moved(array: Array) -> Array:
        out = np.where((origin >= 0).reshape(-1, *[1] * (array.ndim - 1)), array[origin], 0)
        return out.astype(np.float32)

    first = {name: moved(value) for name, value in moments.first.items()}
    second = {name: moved(value) for name, value in moments.second.items()}
    return Moments(first=first, second=second, steps=moments.steps)
