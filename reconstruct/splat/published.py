"""The published splat methods: R²-Gaussian (Zha et al. 2024), its polychromatic successor, and the steps between.

A step projects the splats into one view by EWA and takes a step of Adam down L1 + 0.25 (1 − SSIM). Their settings
stand in `published_settings`, what a step does in `learner` and `objective`.
"""

import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import few_views
from ctsim.reconstruct.log import NO_SIGNAL, finite_or_not, is_blind, line_integrals
from ctsim.reconstruct.primary import primary
from ctsim.reconstruct.settings import keywords
from ctsim.reconstruct.splat.checkpoint import Checkpoint, identity_of
from ctsim.reconstruct.splat.descent.adam import Array
from ctsim.reconstruct.splat.descent.learner import LEAST_VALUE, Learner, seed_splats, splats_of
from ctsim.reconstruct.splat.descent.objective import Objective
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.published_settings import Baseline, Settings
from ctsim.reconstruct.splat.response import Response, basis_functions, tangent
from ctsim.reconstruct.splat.volume import voxelise
from ctsim.reconstruct.watch import Stopwatch
from ctsim.types import Scan, Status, Volume

VIEWS = 12  # that the hardening of the read-out is measured in
BETTER = 1e-3  # share by which held-out views must be met better to count


@keywords(Settings)
@primary
def paper(scan: Scan, settings: Settings) -> Volume:
    """Reconstruct by the polychromatic method, attenuation in 1/mm; keywords are those of `Settings`."""
    return fit_published(scan, settings)


@keywords(Baseline)
@primary
def r2(scan: Scan, settings: Baseline) -> Volume:
    """Reconstruct by R²-Gaussian, attenuation in 1/mm; keywords are those of `Baseline`."""
    return fit_published(scan, settings)


def fit_published(scan: Scan, settings: Settings) -> Volume:
    """Reconstruct `scan` with settings that were checked.

    After the settings' seconds it returns what there is. `watch` is shown a volume each pass over the views, or at the
    times it asks for. The volume's details hold "densities": the volumes of ρa and ρb [z, y, x] in 1/mm as "rho_a" and
    "rho_b", those there are. Raises InputError for poses (FDK seeds the splats), for a response that does not exist,
    and for a checkpoint that is damaged.
    """
    if settings.held_out >= scan.geometry.n_views:
        raise InputError(f"held_out: expected fewer than the {scan.geometry.n_views} views, got {settings.held_out}")
    stopwatch = Stopwatch(limit=settings.seconds)
    objective = Objective.of(scan, settings)
    response = settings.make_response(scan.e_max)
    clamped = int(objective.valid.size - objective.valid.sum())
    if is_blind(scan, clamped):
        details = {"clamped_pixels": clamped, "splats": 0, "view_updates": 0}
        return Volume(values=torch.zeros(scan.geometry.n_voxel), status=Status.ERROR, reason=NO_SIGNAL, details=details)
    seen, _ = line_integrals(scan, slice(None))  # clamped readings as dark as they are: as 0 metal would have no seeds
    splats = seed_splats(seen.numpy(), scan.geometry, settings, response)
    if not len(splats):
        reason = f"no voxel of the FDK volume is above {LEAST_VALUE:g} 1/mm, so there is no splat to fit"
        details = {"clamped_pixels": clamped, "splats": 0, "view_updates": 0, "limitation": reason}
        return Volume(values=torch.zeros(scan.geometry.n_voxel), details=details)
    held_out = np.unique(np.linspace(0, scan.geometry.n_views - 1, settings.held_out + 2).round().astype(int)[1:-1])
    views = np.setdiff1d(np.arange(scan.geometry.n_views), held_out)
    run = _Run(Learner(objective, splats, response, views), held_out.tolist(), stopwatch)
    if settings.checkpoints:
        run.resume(Checkpoint(folder=Path(settings.checkpoints), identity=_identity(scan, settings)))
    run.go()
    volume = run.volume()
    volume.details["clamped_pixels"] = clamped
    return volume


def _identity(scan: Scan, settings: Settings) -> str:
    """Hash what the state of a run depends on, which its end, its read-out and where it is kept are not."""
    return identity_of(
        scan, msgspec.structs.replace(settings, seconds=math.inf, readout=None, checkpoints=""), "published", __name__
    )


class _Run:
    """A learner on its way to the end, which may be that of time or of what held-out views gain."""

    def __init__(self, learner: Learner, held_out: list[int], stopwatch: Stopwatch) -> None:
        self.learner, self.held_out, self.stopwatch = learner, held_out, stopwatch
        self.settings, self.done, self.loss = learner.settings, 0, math.nan
        self.checkpoint: Checkpoint | None = None
        self.best: dict[str, NDArray[Any]] = {}
        self.best_misfit, self.best_step, self.idle = math.inf, 0, 0

    def go(self) -> None:
        """Take the steps that are left; a loss that is not finite ends them."""
        settings, stopwatch = self.settings, self.stopwatch
        while self.done < settings.steps and not stopwatch.over and self.idle < settings.patience:
            self.loss = self.learner.step(self.done)
            self.done += 1
            whole = self.done % len(self.learner.views) == 0
            if not math.isfinite(self.loss):
                break
            if self.held_out and (whole or self.done == settings.steps):
                self._judge()
            stopwatch.tell(self.done / settings.steps, self.loss)
            stopwatch.show(self.done, self.values, whole=whole)
            if self.checkpoint is not None and self.checkpoint.due():
                self.checkpoint.write(self._state())
        if self.checkpoint is not None:
            if stopwatch.over:
                self.checkpoint.write(self._state())
            else:
                self.checkpoint.remove()

    def _judge(self) -> None:
        """Keep the state that meets the held-out views best, and count the passes without one that is better."""
        misfit = self.learner.objective.misfit(self.learner.splats(), self.learner.response, self.held_out)
        self.idle = 0 if misfit < self.best_misfit * (1 - BETTER) else self.idle + 1
        if misfit < self.best_misfit:
            self.best, self.best_misfit, self.best_step = self.learner.state(), misfit, self.done

    def _state(self) -> dict[str, NDArray[Any]]:
        numbers = np.array([self.done, self.best_step, self.idle])
        reals = np.array([self.stopwatch.seconds, self.loss, self.best_misfit])
        best = {f"best.{name}": value for name, value in self.best.items()}
        return {**self.learner.state(), **best, "run.numbers": numbers, "run.reals": reals}

    def resume(self, checkpoint: Checkpoint) -> None:
        """Go on where the checkpoint stands, if it does, and keep it."""
        self.checkpoint = checkpoint
        if (state := checkpoint.read()) is None:
            return
        try:
            self.learner.restore(state)
            self.done, self.best_step, self.idle = state["run.numbers"].tolist()
            earlier, self.loss, self.best_misfit = state["run.reals"].tolist()
        except (KeyError, TypeError, ValueError) as error:
            raise checkpoint.damaged(error) from None
        self.best = {k.removeprefix("best."): v for k, v in state.items() if k.startswith("best.")}
        self.stopwatch.resume(earlier)

    def _found(self) -> tuple[Splats, Response]:
        learner = self.learner
        if not self.best:
            return learner.splats(), learner.response
        theta = np.clip(self.best["theta"].astype(np.float64), *learner.response.bounds().T)  # it was rounded
        response = learner.response.with_theta(theta.tolist()) if self.settings.learns else learner.response
        return splats_of(self.best, learner.objective.activation), response

    def values(self) -> Array:
        """Return the volume as it is, read out as settings say, [z, y, x] in 1/mm."""
        splats, response = self.learner.splats(), self.learner.response
        weights, _ = read_out(splats, response, self.learner.objective)
        geometry = self.learner.objective.projector.geometry
        return voxelise(splats, geometry, splats.densities @ weights[:, None], mean=False)[0]

    def volume(self) -> Volume:
        """Return the result: what met held-out views best, if any are, else the last state."""
        splats, response = self._found()
        weights, how = read_out(splats, response, self.learner.objective)
        densities = voxelise(splats, self.learner.objective.projector.geometry, mean=False)
        values = np.einsum("c,czyx->zyx", weights, densities)
        sound = self.done == 0 or bool(self.best) or math.isfinite(self.loss)
        status, reason = finite_or_not(values) if sound else (Status.NONFINITE, "the last loss is not finite")
        details: dict[str, Any] = {
            "read-out": how,
            "splats": len(splats),
            "view_updates": self.done,
            **self.stopwatch.details(),
            "response": response.described() | {"name": self.settings.response},
            "densities": {f"rho_{c}": density for c, density in zip(self.settings.channels, densities, strict=True)},
        }
        if self.held_out:
            misfit = self.best_misfit if self.best else None
            details["held_out"] = {"views": self.held_out, "misfit": misfit, "step": self.best_step}
        return Volume(
            values=torch.from_numpy(values),
            status=status,
            reason=reason,
            details=details,
        )


def read_out(splats: Splats, response: Response, objective: Objective) -> tuple[Array, str]:
    """Return by what each density counts in the volume, float32 [channel], and in words at which energy that is.

    "hardened" reads what one more mm adds to P behind the median path of the rays that meet something: attenuation in
    the beam as the object leaves it, which the data fix for any response.
    """
    settings = objective.settings
    if settings.basis == "constant":
        return np.ones(1, np.float32), "one density for all energies"
    if settings.readout == "hardened":
        la, lb = _median_paths(splats, objective)
        by_a, by_b = tangent(response, (la, lb), 1.0)
        how = f"hardened by the object: behind La = {la:.3g}, Lb = {lb:.3g}"
    elif settings.readout is None:
        by_a, by_b, how = 1.0, 1.0, "at Ē = 1"
    else:
        a, b = basis_functions(np.array([settings.readout]), response.basis, response.e_max)
        by_a, by_b, how = float(a[0]), float(b[0]), f"at {settings.readout:g} keV"
    return np.array([{"a": by_a, "b": by_b}[c] for c in settings.channels], np.float32), how


def _median_paths(splats: Splats, objective: Objective) -> tuple[float, float]:
    """Return the medians of La and Lb over rays that meet something, where P is above a hundredth of its greatest."""
    met: list[Array] = []
    for view in few_views(objective.projector.geometry.n_views, VIEWS):
        paths = objective.paths(splats, int(view))[..., : objective.p.shape[2]]
        both = np.stack([np.zeros_like(paths[0]), paths[0]]) if len(paths) == 1 else paths
        met.append(both[:, objective.p[view] > 0.01 * objective.greatest])
    rays = np.concatenate(met, 1)
    if not rays.shape[1]:
        return 0.0, 0.0
    la, lb = np.median(rays, 1)
    return float(la), float(lb)
