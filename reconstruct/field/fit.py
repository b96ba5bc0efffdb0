"""The fit of a field: steps of Adam from ordered subsets of the views, up to a stop by views that are kept apart."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.reconstruct.field.data import Data, held_out_views, subsets
from ctsim.reconstruct.field.encoding import Encoding, resolutions_of
from ctsim.reconstruct.field.grid import Grid
from ctsim.reconstruct.field.network import Adam, first_parameters, rate_share
from ctsim.reconstruct.field.physics import Physics
from ctsim.reconstruct.primary import Readings
from ctsim.reconstruct.settings import about
from ctsim.reconstruct.splat.checkpoint import Checkpoint
from ctsim.reconstruct.splat.common import Seconds
from ctsim.reconstruct.watch import Stopwatch

PATIENCE = 12  # turns over the views without a better misfit of the held-out ones, after which a fit ends
Image = NDArray[np.float32]
Read = Callable[[torch.Tensor], Image]
Steps = Annotated[int, about("steps of Adam, a subset of the views each", ge=1, le=10_000_000)]


class Common(Readings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The network, how it is trained, and how long a fit may take.

    `stop` "held-out" keeps one view in ten from the fit and returns the field that meets these views best; "none", as
    published, fits all views and returns the last field.
    """

    steps: Steps = 100
    views: Annotated[int, about("views in a subset", ge=1, le=10_000)] = 6
    rate: Annotated[float, about("learning rate of the network; tables have twice as much", gt=0, le=10)] = 0.02
    levels: Annotated[
        Annotated[int, about("", ge=1, le=32)] | None, about("levels of the encoding; null: each twice as fine")
    ] = None
    coarsest: Annotated[int, about("cubes of the coarsest level along the longest axis", ge=1, le=4096)] = 8
    features: Annotated[int, about("features a level", ge=1, le=64)] = 4
    table: Annotated[int, about("entries of a level's table at most, as a power of 2", ge=4, le=26)] = 19
    width: Annotated[int, about("neurons of the hidden layer", ge=1, le=4096)] = 32
    fineness: Annotated[float, about("how much finer the field's grid is than the volume's", ge=1, le=16)] = 1.5
    stop: Annotated[Literal["held-out", "none"], about("what ends the fit before its last step")] = "held-out"
    seed: Annotated[int, about("of the first parameters and of the order of subsets", ge=0, le=2**63 - 1)] = 0
    seconds: Seconds = math.inf
    checkpoints: Annotated[
        str, about("folder for the state of an unfinished fit, saved each minute; the next run continues from it")
    ] = ""


class Fit:
    """A field on its way: after `go`, `values` are those that the stop chose."""

    def __init__(self, physics: Physics, grid: Grid, data: Data, settings: Common, unit: float) -> None:
        """Start at `unit` (1/mm) times the scales of the physics, at every point."""
        self.physics, self.grid, self.data, self.settings = physics, grid, data, settings
        finest = max(grid.whole.n_voxel)
        levels = resolutions_of(settings.coarsest, finest, settings.levels)
        self.encoding = Encoding.of(grid, levels, settings.table)
        self.scale = torch.tensor([unit * s for s in physics.scales], dtype=torch.float32)
        first = first_parameters(self.encoding, settings.features, settings.width, len(physics.scales), settings.seed)
        self.adam = Adam(parameters=first, rate=settings.rate)
        n_views = len(data.p)
        self.held_out = held_out_views(n_views) if settings.stop == "held-out" else np.zeros(0, np.int64)
        self.views = np.setdiff1d(np.arange(n_views), self.held_out)
        self.loss, self.view_updates = math.nan, 0
        self.best: dict[str, torch.Tensor] = {}
        self.best_misfit, self.best_step, self.idle = math.inf, 0, 0

    @property
    def parameters(self) -> int:
        """The number of parameters."""
        return sum(p.numel() for p in self.adam.parameters.values())

    def go(self, stopwatch: Stopwatch, read: Read, checkpoint: Checkpoint | None = None) -> None:
        """Take the steps that are left, or until time or held-out views end them; `read(values)` makes the volume."""
        turn: list[NDArray[np.int64]] = []
        n_turn = len(subsets(self.views, self.settings.views, 0, 0))
        while self.adam.steps < self.settings.steps and self.idle < PATIENCE and not stopwatch.over:
            number, k = divmod(self.adam.steps, n_turn)
            if k == 0 or not turn:
                turn = subsets(self.views, self.settings.views, self.settings.seed, number)
            self.step(turn[k])
            whole = k + 1 == n_turn
            if not math.isfinite(self.loss):
                break
            if self.held_out.size and (whole or self.adam.steps == self.settings.steps):
                self._judge()
            stopwatch.tell(self.adam.steps / self.settings.steps, self.loss)
            stopwatch.show(self.view_updates, lambda: read(self.now()), whole=whole)
            if checkpoint is not None and checkpoint.due():
                checkpoint.write(self._state(stopwatch))
        if checkpoint is not None and stopwatch.over:
            checkpoint.write(self._state(stopwatch))
        elif checkpoint is not None:
            checkpoint.remove()

    def step(self, views: NDArray[np.int64]) -> None:
        """Take one step from some views."""
        parameters = {name: p.requires_grad_() for name, p in self.adam.parameters.items()}
        loss = self.objective(parameters, views)
        gradients = torch.autograd.grad(loss, list(parameters.values()))
        for p in parameters.values():
            p.requires_grad_(False)
        share = rate_share(self.adam.steps / self.settings.steps)
        self.adam.step(dict(zip(parameters, gradients, strict=True)), share)
        self.loss, self.view_updates = float(loss.detach()), self.view_updates + len(views)

    def objective(self, parameters: dict[str, torch.Tensor], views: NDArray[np.int64]) -> torch.Tensor:
        """Return the misfit of some views and the penalty."""
        values = self.encoding(parameters, self.scale)
        misfit = self.data.misfit(self.physics.line_integrals(values, views), views)
        penalty = self.physics.penalty(values)
        return misfit if penalty is None else misfit + penalty

    def now(self) -> torch.Tensor:
        """Return the field as it is, [point, output]."""
        with torch.no_grad():
            return self.encoding(self.adam.parameters, self.scale)

    def found(self) -> torch.Tensor:
        """Return the field that met the held-out views best, if there are any, else the last: [point, output]."""
        with torch.no_grad():
            return self.encoding(self.best or self.adam.parameters, self.scale)

    def _judge(self) -> None:
        with torch.no_grad():
            paths = self.physics.line_integrals(self.now(), self.held_out)
            terms = self.data.misfits(paths, self.held_out).numpy()
        misfit = float(terms.mean(dtype=np.float64))  # by numpy, as torch's mean depends on the number of threads
        self.idle += 1
        if misfit < self.best_misfit:
            self.best = {name: p.clone() for name, p in self.adam.parameters.items()}
            self.best_misfit, self.best_step, self.idle = misfit, self.adam.steps, 0

    def details(self) -> dict[str, Any]:
        """Return what a result says of its fit."""
        held = {"views": self.held_out.tolist(), "misfit": self.best_misfit, "step": self.best_step}
        return {
            "steps": self.adam.steps,
            "parameters": self.parameters,
            "points": len(self.grid),
            "grid": list(self.grid.whole.n_voxel),  # what labels on the same grid would flatter
            "levels": [f"{n} {'dense' if d else 'hashed'}" for n, d in self.levels()],
            "misfit": self.loss if math.isfinite(self.loss) else None,
            "view_updates": self.view_updates,
            **({"held_out": held} if self.best else {}),
            **({} if math.isfinite(self.loss) or not self.best else {"limitation": self._broke_off}),
        }

    @property
    def _broke_off(self) -> str:
        return f"the loss of step {self.adam.steps} is not finite: the volume is that of step {self.best_step}"

    def levels(self) -> list[tuple[int, bool]]:
        """Return the resolution of each level, and whether it needs no hash."""
        return list(zip(self.encoding.resolutions, self.encoding.dense, strict=True))

    def _state(self, stopwatch: Stopwatch) -> dict[str, NDArray[Any]]:
        numbers = np.array([self.adam.steps, self.view_updates, self.best_step, self.idle])
        reals = np.array([stopwatch.seconds, self.loss, self.best_misfit])
        best = {f"best.{name}": p.numpy() for name, p in self.best.items()}
        return {**self.adam.state(), **best, "numbers": numbers, "reals": reals}

    def resume(self, checkpoint: Checkpoint, stopwatch: Stopwatch) -> None:
        """Go on where a checkpoint stands, if it does, and let the watch count on."""
        if (state := checkpoint.read()) is None:
            return
        try:
            steps, self.view_updates, self.best_step, self.idle = state["numbers"].tolist()
            earlier, self.loss, self.best_misfit = state["reals"].tolist()
            self.adam.restore(state, steps)
            kept = {k.removeprefix("best."): torch.from_numpy(v) for k, v in state.items() if k.startswith("best.")}
            self.best = {name: kept[name].view_as(p) for name, p in self.adam.parameters.items()} if kept else {}
        except (KeyError, TypeError, ValueError) as error:
            raise checkpoint.damaged(error) from None
        stopwatch.resume(earlier)


def checkpoint_in(folder: str, identity: str) -> Checkpoint | None:
    """Return where an unfinished fit is kept, None where no folder is named."""
    return Checkpoint(folder=Path(folder), identity=identity) if folder else None
