"""The published splat methods as one loop: R²-Gaussian (Zha et al. 2024) and its polychromatic successor.

A step projects the splats into one view by EWA and takes a step of Adam down L1 + 0.25 (1 − SSIM). "paper" learns two
densities a splat and the response's r and Ē_th; "r2" one density and no response, and adds 0.05 TV of a brick.

R2-Gaussian scales scenes to [−1, 1]³. Here lengths stay mm and P stays P, which is not homogeneous once it is
polychromatic, so densities are learned per unit, half the volume's widest side: v = unit·μ of the FDK volume. 0.005 is
little then (water is near 0.7 in 60 mm): it keeps all but what FDK shows at or below air.

Rates and the times of densification scale with the number of steps: a run of a tenth of the steps densifies as often,
on a tenth of the views, and so adds as many splats to a fit that has come less far.

Where the publications leave it open: clamped pixels are 0 in both images that a loss compares; SSIM's range is the
greatest P; views come in a new random order each pass; TV pulls at densities only, not at places and shapes.
"""

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ctsim import rng
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.types import Scan, Status, Volume
from reconstruct.fdk import fdk
from reconstruct.log import line_integrals
from reconstruct.splat import adam, densify
from reconstruct.splat import response as responses
from reconstruct.splat.adam import Activation, Array
from reconstruct.splat.loss import SSIM_SHARE, TV_SHARE, brick, l1_ssim, total_variation
from reconstruct.splat.model import Splats
from reconstruct.splat.project import Projector
from reconstruct.splat.response import Response, make_response
from reconstruct.splat.volume import voxelise, voxelise_adjoint

NEIGHBOURS = 3  # whose distance is a splat's first scale
LEAST_DENSITY = 1e-10  # per unit, to which densities are raised when they are learned anew
Channels = Literal["a", "b", "ab"]
OnStep = Callable[[int, float, float, int], None]
"""Called after a step with its number, from 1, its loss, the seconds since the start, and the number of splats."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What a preset says; densities and lengths are per unit and in units.

    `channels` are the path values that splats have a density for, `start` those densities as shares of v and
    `density_rates` their learning rates, one each. `theta` starts the response, None its own start; it stays there
    where `learn_response` is False. `e_max` (keV) replaces the scan's, for another γ. `schedule` is that of
    `schedule_steps` steps. Raises InputError for values that make no sense.
    """

    steps: int = 20_000
    schedule_steps: int = 20_000
    seed: int = 0
    seconds: float = math.inf
    response: responses.Name = "paper"
    basis: responses.Basis = "paper"
    nodes: int | None = None
    theta: tuple[float, ...] | None = None
    learn_response: bool = True
    e_max: float | None = None
    channels: Channels = "ab"
    start: tuple[float, ...] = (0.075, 0.0075)
    n_splats: int = 50_000
    least_value: float = 0.005
    ssim_share: float = SSIM_SHARE
    tv_share: float = 0.0
    rates: Mapping[str, float] = field(default_factory=lambda: dict(adam.RATES))
    density_rates: tuple[float, ...] = (0.01, 0.1)
    response_rate: float = 1e-3
    schedule: densify.Schedule = field(default_factory=densify.Schedule)

    def __post_init__(self) -> None:
        for name in ("steps", "schedule_steps", "n_splats"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not self.seconds >= 0:
            raise InputError(f"seconds must be at least 0, got {self.seconds}")
        if not len(self.channels) == len(self.start) == len(self.density_rates):
            raise InputError(
                f"channels {self.channels!r} need as many start values and rates, got {self.start} "
                f"and {self.density_rates}"
            )
        if min(self.start) <= 0:
            raise InputError(f"start must be positive, got {self.start}")

    def times(self) -> densify.Schedule:
        """Return the schedule for the number of steps."""
        share, given = self.steps / self.schedule_steps, self.schedule
        return dataclasses.replace(
            given,
            first=round(given.first * share),
            last=round(given.last * share),
            every=max(1, round(given.every * share)),
        )


PRESETS = {
    "paper": Settings(),
    "r2": Settings(
        steps=30_000,
        schedule_steps=30_000,
        response="mono",
        channels="a",
        start=(0.15,),
        density_rates=(0.01,),
        tv_share=TV_SHARE,
    ),
}


def paper(
    scan: Scan,
    *,
    device: str = "cpu",
    steps: int = 20_000,
    seconds: float = math.inf,
    seed: int = 0,
    response: responses.Name = "paper",
    e_max: float | None = None,
) -> Volume:
    """Reconstruct by the polychromatic method as published; the volume is ρa + ρb, attenuation at Ē = 1 in 1/mm.

    `response` is one of `make_response`, `e_max` (keV) replaces the scan's greatest energy. Raises InputError as
    `fit_published` does.
    """
    settings = dataclasses.replace(
        PRESETS["paper"], steps=steps, seconds=seconds, seed=seed, response=response, e_max=e_max
    )
    return fit_published(scan, settings, device=device)


def r2(scan: Scan, *, device: str = "cpu", steps: int = 30_000, seconds: float = math.inf, seed: int = 0) -> Volume:
    """Reconstruct by R2-Gaussian as published, 1/mm. Raises InputError as `fit_published` does."""
    settings = dataclasses.replace(PRESETS["r2"], steps=steps, seconds=seconds, seed=seed)
    return fit_published(scan, settings, device=device)


def fit_published(scan: Scan, settings: Settings, *, device: str = "cpu", on_step: OnStep | None = None) -> Volume:
    """Reconstruct `scan` with `settings`; the volume is the densities' sum, attenuation at Ē = 1 in 1/mm.

    After `seconds` it returns what there is. Raises InputError for another device than the CPU, for poses (FDK seeds
    the splats), and for a response that does not exist.
    """
    if torch.device(device).type != "cpu":
        raise InputError(f"the published splat methods run on device 'cpu' only, got {device!r}")
    began = time.perf_counter()
    objective = Objective.of(scan, settings)
    splats = seed_splats(objective.p, scan.geometry, settings)
    e_max = scan.e_max if settings.e_max is None else settings.e_max
    curve = make_response(
        settings.response, e_max=e_max, basis=settings.basis, nodes=settings.nodes, theta=settings.theta
    )
    details: dict[str, Any] = {"read-out": "at Ē = 1", "clamped_pixels": int((~objective.valid).sum())}
    if not len(splats):
        reason = f"no voxel of the FDK volume is above {settings.least_value:g} per unit, so there is no splat to fit"
        details |= {"splats": 0, "view_updates": 0}
        return Volume(values=torch.zeros(scan.geometry.n_voxel), reason=reason, details=details)
    learner = _Learner(objective, splats, curve)
    done, value = 0, math.nan
    while done < settings.steps and time.perf_counter() - began < settings.seconds:
        value = learner.step(done)
        done += 1
        if on_step is not None:
            on_step(done, value, time.perf_counter() - began, len(learner))
    found = learner.splats()
    values = voxelise(found, scan.geometry, found.densities.sum(1, keepdims=True), mean=False)[0]
    finite = bool(np.isfinite(values).all()) and (done == 0 or math.isfinite(value))
    details |= {"splats": len(found), "view_updates": done, "seconds": time.perf_counter() - began}
    details["response"] = {"name": curve.name, "theta": list(learner.response.trainable)}
    return Volume(
        values=torch.from_numpy(values),
        status=Status.OK if finite else Status.NONFINITE,
        reason="" if finite else "the reconstruction or its loss holds values that are not finite",
        details=details,
    )


def seed_splats(p: NDArray[np.float32], geometry: Geometry, settings: Settings) -> Splats:
    """Draw voxels of the FDK volume of `p` [view, v, u] that are above the least value; the splats are sorted by z.

    A scale is the root mean square distance to the three nearest others, the density a share of the voxel's.
    """
    volume, unit = fdk(torch.from_numpy(p), geometry).numpy(), adam.unit_length(geometry)
    found = np.flatnonzero(volume.ravel() * unit > settings.least_value)
    draws = rng.uniform(rng.stream_key(_scene(settings), "seeds", 0), found.size)[:, 0]
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
        densities=(volume.ravel()[found][:, None] * np.array(settings.start)).astype(np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (len(found), 1)),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Terms:
    """A view's loss, its gradients by what is learned and by θ [T], and by the centres' places in pixels [splat]."""

    loss: float
    parameters: dict[str, Array]
    theta: NDArray[np.float64]
    centres: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Objective:
    """The loss of one view: line integrals `p` and which of them count, `valid`, [view, v, u]."""

    settings: Settings
    projector: Projector
    activation: Activation
    p: NDArray[np.float32]
    valid: NDArray[np.bool_]
    data_range: float

    @classmethod
    def of(cls, scan: Scan, settings: Settings) -> "Objective":
        """Take the logarithm of a scan."""
        p, clamped = line_integrals(scan, slice(None))
        valid = ~clamped.numpy()
        return cls(
            settings=settings,
            projector=Projector(geometry=scan.geometry, tolerance=np.inf, box=False),
            activation=adam.activation(scan.geometry),
            p=p.numpy(),
            valid=valid,
            data_range=max(float(p.numpy().max(where=valid, initial=0.0)), 1e-6),
        )

    def __call__(self, parameters: Mapping[str, Array], response: Response, view: int, step: int) -> Terms:
        """Return the loss and gradients of `view`; `step` chooses the brick of TV."""
        splats = self.activation.splats(parameters)
        la, lb = self._paths(splats, view)
        p, by_a, by_b = responses.evaluate(response, la, lb)
        valid, n_u = self.valid[view], self.p.shape[2]
        target, there = np.where(valid, self.p[view], 0), np.where(valid, p[:, :n_u], 0)
        value, by_p = l1_ssim(there, target, self.data_range, self.settings.ssim_share)
        pull = np.zeros_like(p)
        pull[:, :n_u] = by_p * valid
        slopes = {"a": by_a, "b": by_b}
        images = np.stack([pull * slopes[c] for c in self.settings.channels])
        by_splats = self.projector.gradient(splats, images, view)
        if self.settings.tv_share:
            tv, by_densities = self._tv(splats, step)
            value += self.settings.tv_share * tv
            by_splats = dataclasses.replace(by_splats, densities=by_splats.densities + by_densities)
        return Terms(
            loss=value,
            parameters=self.activation.gradient(parameters, splats, by_splats),
            theta=responses.theta_gradient(response, la, lb, pull),
            centres=by_splats.centres,
        )

    def _paths(self, splats: Splats, view: int) -> tuple[Array, Array]:
        """Return La and Lb [v, u + 8]; a channel without densities is 0."""
        given = self.projector.forward(splats.shapes(), splats.densities, [view])[0]
        paths = dict(zip(self.settings.channels, given, strict=True))
        zero = np.zeros_like(given[0])
        return np.ascontiguousarray(paths.get("a", zero)), np.ascontiguousarray(paths.get("b", zero))

    def _tv(self, splats: Splats, step: int) -> tuple[float, Array]:
        """Return TV of a brick of the volume per unit, and the settings' share of its gradient by densities (1/mm)."""
        part = brick(self.projector.geometry, _scene(self.settings), step)
        volume = voxelise(splats, part, splats.densities.sum(1, keepdims=True), mean=False)[0]
        tv, by_volume = total_variation(volume * np.float32(self.activation.unit))
        scaled = (by_volume * (self.settings.tv_share * self.activation.unit)).astype(np.float32)
        return tv, voxelise_adjoint(splats, part, scaled[None], mean=False)


class _Learner:
    """Splats and response on their way, with Adam's moments and the pulls since the last densification."""

    def __init__(self, objective: Objective, splats: Splats, response: Response) -> None:
        self.objective, self.response = objective, response
        self.settings, self._schedule = objective.settings, objective.settings.times()
        self._parameters = objective.activation.parameters(splats)
        self._moments = adam.no_moments(self._parameters)
        self._theta = {"theta": np.array(response.trainable, np.float32)}
        self._theta_moments = adam.no_moments(self._theta)
        self._forget(len(splats))

    def __len__(self) -> int:
        return len(self._pulls)

    def splats(self) -> Splats:
        """Return the splats as they are."""
        return self.objective.activation.splats(self._parameters)

    def step(self, done: int) -> float:
        """Take the step after `done` steps; return the loss before it."""
        n_views, n_u = len(self.objective.p), self.objective.p.shape[2]
        turn, place = divmod(done, n_views)
        draws = rng.uniform(rng.stream_key(_scene(self.settings), "views", turn), n_views)[:, 0]
        view = int(np.argsort(draws, kind="stable")[place])
        terms = self.objective(self._parameters, self.response, view, done)
        self._pulls += densify.screen_pull(terms.centres, n_u)
        self._seen += terms.centres > 0
        rates = {name: adam.rate(start, done, self.settings.steps) for name, start in self._rates().items()}
        self._parameters, self._moments = adam.step(self._parameters, terms.parameters, self._moments, rates)
        if self.settings.learn_response and self.response.trainable:
            self._learn_response(terms.theta, done)
        if self._schedule.is_due(done + 1):
            self._densify(done + 1)
        return terms.loss

    def _rates(self) -> dict[str, float | Array]:
        unit = self.objective.activation.unit
        densities = np.array(self.settings.density_rates, np.float32)
        given = self.settings.rates
        return {
            "positions": given["positions"] * unit,
            "scales": given["scales"],
            "rotations": given["rotations"],
            "densities": densities,
        }

    def _learn_response(self, gradient: NDArray[np.float64], done: int) -> None:
        rates = {"theta": adam.rate(self.settings.response_rate, done, self.settings.steps)}
        by_theta = {"theta": gradient.astype(np.float32)}
        self._theta, self._theta_moments = adam.step(self._theta, by_theta, self._theta_moments, rates)
        low, high = self.response.bounds().T
        self._theta = {"theta": np.clip(self._theta["theta"], low, high).astype(np.float32)}
        self.response = self.response.with_theta(np.clip(self._theta["theta"].astype(np.float64), low, high).tolist())

    def _densify(self, done: int) -> None:
        activation, pull = self.objective.activation, self._pulls / np.maximum(self._seen, 1)
        key = rng.stream_key(_scene(self.settings), "split", done)
        splats, origin = densify.densify(self.splats(), pull, activation.unit, self._schedule, key)
        splats, order = sorted_by_z(splats)
        # a density that underflowed is no softplus; one channel may be 0 where the other is not
        densities = np.maximum(splats.densities, np.float32(LEAST_DENSITY / activation.unit))
        splats = dataclasses.replace(splats, densities=densities)
        self._parameters = activation.parameters(splats)
        self._moments = densify.carried(self._moments, origin[order])
        self._forget(len(splats))

    def _forget(self, n: int) -> None:
        self._pulls, self._seen = np.zeros(n), np.zeros(n, np.int64)


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


def _scene(settings: Settings) -> str:
    return f"published-{settings.seed}"
