"""What `run-benchmark pareto` tries: the simulator's choices, and the runs of every method.

Each is the settings of a task, so that a worker needs nothing else. Points are compared within a `group` and make
curves.
"""

from typing import Any

import msgspec

from ctsim.benchmarks.methods import Method, find
from ctsim.benchmarks.studies.pareto.suite import HIGHEST, Choices, Level, Listed, Suite
from ctsim.errors import InputError
from ctsim.settings import Simulation

USUAL = 1.0  # label voxels along an axis for each pixel along one; the bundled suites have 0.5 to 1.2
EXACT, BODY, VOXELS, SCATTER = "exact solids", "body in voxels, metal exact", "all in voxels", "scatter"


class Effort(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One run of a method: `changes` of its parameters, all `params`, and what the run and its curve are called.

    A run that is `watched` has a mark at each of the `stops`, if the method shows its volume. With `default` the run,
    or one mark of it if it is watched, is what the method does by default.
    """

    group: str
    curve: str
    label: str
    method: str
    changes: dict[str, Any] = {}
    params: dict[str, Any] = {}
    default: bool = True
    watched: bool = False
    stops: tuple[int, ...] = ()

    @property
    def kind(self) -> str:
        """What one warm-up compiles: this run's kernels, since other values of a parameter may take others."""
        return f"{self.curve}, {self.label}"


class Choice(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One way to simulate the scene; `grid` (None: analytic) and `metal` say what is turned into voxels."""

    group: str = EXACT
    curve: str
    label: str
    simulation: Simulation = Simulation()
    grid: float | None = None
    metal: bool = False
    level: Level = 0
    default: bool = False

    @property
    def kind(self) -> str:
        """What one warm-up compiles: the same for all choices."""
        return "simulator"


def efforts(suite: Suite, name: str) -> list[Effort]:
    """List the runs of a method as the suite says, or by its iterations, if it has them, where it is not listed.

    Raises InputError for a method or a parameter that there is not.
    """
    usual, listed, stops = find(name), suite.listed(name) or Listed(name=name), suite.iterations.stops
    more = [
        _effort(name, run.set, run.label, curve=run.curve, default=False, watched=True, stops=stops)
        for run in listed.run
    ]
    if not listed.default:
        return more
    if listed.parameter:
        return _by_value(usual, listed) + more
    count, times = usual.params.get("iterations"), listed.times
    if isinstance(count, int):  # one watched run
        count *= times or suite.iterations.times
        return [_effort(name, {"iterations": count}, f"{count} iterations", watched=True, stops=stops), *more]
    if times is not None:
        raise InputError(f"method {name!r} has no default iterations to go {times} times as far as")
    return [_effort(name, {}, "defaults"), *more]


def _by_value(usual: Method, listed: Listed) -> list[Effort]:
    """Return a run for the default of the listed parameter, and one for each other value."""
    key, usual_value = listed.parameter, usual.params.get(listed.parameter)
    usually = "defaults" if usual_value is None else f"{key} {_words(usual_value)}"
    runs: dict[str, dict[str, Any]] = {usually: {}} | {f"{key} {_words(v)}": {key: v} for v in listed.values}
    return [_effort(usual.name, changes, label, default=label == usually) for label, changes in runs.items()]


def _effort(name: str, changes: dict[str, Any], label: str, *, curve: str = "", **more: Any) -> Effort:
    method = find(name, changes)
    names = {"group": method.inputs, "curve": curve or name, "label": label}
    return Effort(**names, method=name, changes=changes, params=method.params, **more)


def _words(value: Any) -> str:
    return " + ".join(map(str, value)) if isinstance(value, tuple | list) else str(value)


def choices(asked: Choices) -> list[Choice]:
    """List every choice that is asked for: tolerances with sub-rays, voxels instead of solids, and scatter levels."""
    usual = Simulation()
    found = [
        Choice(
            curve=f"tolerance {_short(tolerance)}",
            label=f"{subrays} sub-ray{'s' * (subrays > 1)}",
            simulation=Simulation(tolerance=tolerance, subrays=subrays),
            default=(tolerance, subrays) == (usual.tolerance, usual.subrays),
        )
        for tolerance in sorted({*asked.tolerances, usual.tolerance}, reverse=True)
        for subrays in sorted({*asked.subrays, usual.subrays})
    ]
    whole = Simulation(skip=False)
    found.append(Choice(curve="nothing skipped", label=f"{usual.subrays} sub-rays", simulation=whole))
    # whether there is a closed form is the scene's matter, so voxels do not rival solids
    found += [
        Choice(
            group="voxels",
            curve=curve,
            label=f"{round(grid * asked.side)}³ labels",
            grid=grid,
            metal=metal,
            default=grid == USUAL and not metal,
        )
        for curve, metal in ((BODY, False), (VOXELS, True))
        for grid in _different(asked.grids, asked.side)
    ]
    # whether there is scatter is the scanner's matter: here there is, and then the highest level is what is computed
    return found + [
        Choice(group=SCATTER, curve=SCATTER, label=f"level {k}", level=k, default=k == HIGHEST) for k in asked.levels
    ]


def _short(tolerance: float) -> str:
    """Return a tolerance in its shortest form that is exact: 1e-04, 1.2e-04."""
    mantissa, exponent = f"{tolerance:e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{exponent}"


def _different(grids: tuple[float, ...], side: int) -> list[float]:
    """Return the grids that differ in the number of labels; of equal ones the default, or else the first."""
    found: dict[int, float] = {}
    for grid in (*(g for g in grids if g == USUAL), *grids):
        found.setdefault(round(grid * side), grid)
    return [grid for grid in grids if grid in found.values()]
