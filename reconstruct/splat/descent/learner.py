"""The course of the published splat methods: seeds, steps of Adam, densification, and all of it as arrays.

Where the publications leave it open: views come in a new random order each pass. Densities are in 1/mm, as published:
0.005, above which voxels are seeds, is a fifth of water.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ctsim import rng
from ctsim.geometry import Geometry
from ctsim.reconstruct.fdk import fdk
from ctsim.reconstruct.splat.descent import adam, densify
from ctsim.reconstruct.splat.descent.adam import Array, Moments
from ctsim.reconstruct.splat.descent.objective import Objective, stream
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.published_settings import ALONE, RATES, START, Settings
from ctsim.reconstruct.splat.response import Response

LEAST_VALUE = 0.005  # 1/mm, of a voxel that may be a seed
NEIGHBOURS = 3  # whose distance is a splat's first scale
LEAST_DENSITY = 1e-10  # 1/mm, to which densities are raised when learning starts again
RESPONSE_RATE = 1e-3


def seed_splats(p: NDArray[np.float32], geometry: Geometry, settings: Settings, response: Response) -> Splats:
    """Draw voxels of the FDK volume of `p` [view, v, u] that are above the least value; the splats are sorted by z.

    A scale is the root mean square distance to the three nearest others, the density a share of the voxel's.
    """
    volume = fdk(torch.from_numpy(p), geometry).numpy()
    found = np.flatnonzero(volume.ravel() > LEAST_VALUE)
    draws = rng.uniform(rng.stream_key(stream(settings), "seeds", 0), found.size)[:, 0]
    found = np.sort(found[np.argsort(draws, kind="stable")[: settings.n_splats]])
    k, j, i = np.unravel_index(found, volume.shape)
    z, y, x = geometry.voxel_centres()
    positions = np.stack([x[i], y[j], z[k]], 1)
    scales = np.full(len(found), max(geometry.d_voxel))
    if len(found) > NEIGHBOURS:
        distances, _ = KDTree(positions).query(positions, k=NEIGHBOURS + 1)
        scales = np.sqrt(np.mean(distances[:, 1:] ** 2, axis=1))
    return Splats(
        positions=positions.astype(np.float32),
        scales=np.repeat(scales[:, None], 3, 1).astype(np.float32),
        densities=(volume.ravel()[found][:, None] * shares(settings, response)).astype(np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (len(found), 1)),
    )


def shares(settings: Settings, response: Response) -> NDArray[np.float64]:
    """Return the first densities [channel] as shares of the voxel's value: those published, for two and for one.

    One that is photoelectric is divided by what P grows with it at first, so that P begins alike.
    """
    if settings.channels == "b":
        return np.array([ALONE / float(response.eta @ response.b)])
    return np.array([ALONE] if settings.channels == "a" else [START[c] for c in settings.channels])


class Learner:
    """Splats and response on their way, with Adam's moments and the pulls since the last densification."""

    def __init__(self, objective: Objective, splats: Splats, response: Response, views: NDArray[np.int64]) -> None:
        self.objective, self.response, self.views = objective, response, views
        self.settings = objective.settings
        self._schedule = self.settings.densification(objective.projector.geometry.n_voxel)
        self._take(objective.activation.parameters(splats))
        self._moments = adam.no_moments(self._parameters)
        self._theta = {"theta": np.array(response.trainable, np.float32)}
        self._theta_moments = adam.no_moments(self._theta)
        self._forget()

    def __len__(self) -> int:
        return len(self._pulls)

    def splats(self) -> Splats:
        """Return the splats as they are; a step changes their arrays."""
        return self.objective.activation.splats(self._parameters)

    def step(self, done: int) -> float:
        """Take the step after `done` steps; return the loss before it."""
        turn, place = divmod(done, len(self.views))
        draws = rng.uniform(rng.stream_key(stream(self.settings), "views", turn), len(self.views))[:, 0]
        view = int(self.views[np.argsort(draws, kind="stable")[place]])
        terms = self.objective(self._parameters, self.response, view, done)
        self._pulls += densify.screen_pull(terms.centres, self.objective.p.shape[2])
        self._seen += terms.centres > 0
        rates = {name: adam.rate(start, done, self.settings.steps) for name, start in self._rates().items()}
        self._moments = adam.step(self._parameters, terms.parameters, self._moments, rates)
        if terms.theta.size:
            self._learn_response(terms.theta, done)
        if self._schedule.is_due(done + 1):
            self._densify(done + 1)
        return terms.loss

    def _rates(self) -> dict[str, float | Array]:
        densities = np.array([RATES[c] for c in self.settings.channels], np.float32)
        scaled = adam.RATES["positions"] * self.objective.unit
        return {**adam.RATES, "positions": scaled, "densities": densities}

    def _learn_response(self, gradient: NDArray[np.float64], done: int) -> None:
        rates = {"theta": adam.rate(RESPONSE_RATE, done, self.settings.steps)}
        by_theta = {"theta": gradient.astype(np.float32)}
        self._theta_moments = adam.step(self._theta, by_theta, self._theta_moments, rates)
        self._set_theta(self._theta["theta"])

    def _set_theta(self, theta: Array) -> None:
        low, high = self.response.bounds().T
        self._theta = {"theta": np.clip(theta, low, high).astype(np.float32)}
        self.response = self.response.with_theta(np.clip(self._theta["theta"].astype(np.float64), low, high).tolist())

    def _densify(self, done: int) -> None:
        activation, pull = self.objective.activation, self._pulls / np.maximum(self._seen, 1)
        key = rng.stream_key(stream(self.settings), "split", done)
        geometry = self.objective.projector.geometry
        splats, origin = densify.densify(self.splats(), pull, geometry, self._schedule, key)
        splats, order = sorted_by_z(splats)
        # a density that underflowed is no softplus; one channel may be 0 where the other is not
        densities = np.maximum(splats.densities, np.float32(LEAST_DENSITY))
        splats = dataclasses.replace(splats, densities=densities)
        self._take(activation.parameters(splats))
        self._moments = densify.carried(self._moments, origin[order])
        self._forget()

    def _take(self, parameters: Mapping[str, Array]) -> None:
        self._parameters = {k: np.array(v, order="C") for k, v in parameters.items()}  # steps change them in place

    def _forget(self) -> None:
        n = len(self._parameters["positions"])
        self._pulls, self._seen = np.zeros(n), np.zeros(n, np.int64)

    def state(self) -> dict[str, NDArray[Any]]:
        """Return all that the next step depends on, as copies."""
        state = {f"parameters.{name}": value for name, value in self._parameters.items()}
        for name, moments in (("moments", self._moments), ("theta_moments", self._theta_moments)):
            state |= {f"{name}.first.{key}": value for key, value in moments.first.items()}
            state |= {f"{name}.second.{key}": value for key, value in moments.second.items()}
            state[f"{name}.steps"] = np.array(moments.steps)
        state |= {"theta": self._theta["theta"], "pulls": self._pulls, "seen": self._seen}
        return {name: value.copy() for name, value in state.items()}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from a state. Raises KeyError, TypeError or ValueError where it is none of this fit."""
        parameters = _below(state, "parameters.")
        expected = {k: (len(parameters["positions"]), *v.shape[1:]) for k, v in self._parameters.items()}
        for name in ("parameters", "moments.first", "moments.second"):
            _check_shapes(_below(state, f"{name}."), expected)
        n = expected["positions"][:1]
        _check_shapes({name: state[name] for name in ("pulls", "seen")}, {"pulls": n, "seen": n})
        self._take(parameters)
        self._moments, self._theta_moments = (
            Moments(
                first=_below(state, f"{name}.first."),
                second=_below(state, f"{name}.second."),
                steps=int(state[f"{name}.steps"]),
            )
            for name in ("moments", "theta_moments")
        )
        if self.settings.learns:
            self._set_theta(state["theta"])
        self._pulls, self._seen = state["pulls"].copy(), state["seen"].copy()


def _below(state: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    return {name.removeprefix(prefix): value.copy() for name, value in state.items() if name.startswith(prefix)}


def _check_shapes(arrays: Mapping[str, Array], expected: Mapping[str, tuple[int, ...]]) -> None:
    found = {name: array.shape for name, array in arrays.items()}
    if found != expected:
        raise ValueError(f"arrays of shapes {found}, expected {expected}")


def sorted_by_z(splats: Splats) -> tuple[Splats, NDArray[np.int64]]:
    """Return the splats in the order of their height, which keeps neighbours near in memory, and that order."""
    order = np.argsort(splats.positions[:, 2], kind="stable")
    rotations = None if splats.rotations is None else splats.rotations[order]
    return Splats(
        positions=splats.positions[order],
        scales=splats.scales[order],
        densities=splats.densities[order],
        rotations=rotations,
    ), order


def splats_of(state: Mapping[str, NDArray[Any]], activation: adam.Activation) -> Splats:
    """Return the splats of a state."""
    return activation.splats(_below(state, "parameters."))
