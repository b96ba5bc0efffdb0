"""What `run-benchmark pareto` measures: `benchmarks/suites/pareto.toml`, or tables of your own over it.

`efforts` and `choices` make runs of it. Each is the settings of a task, so that a worker needs nothing else. Points are
compared within a `group` and make curves.
"""

from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec

from ctsim.benchmarks.methods import find
from ctsim.errors import InputError
from ctsim.phantoms.suites import decode, parse_toml, read_toml
from ctsim.settings import Simulation, Subrays, Tolerance

NAME = "pareto.toml"
USUAL = 1.0  # label voxels along an axis for each pixel along one; the bundled suites have 0.5 to 1.2
EXACT, BODY, VOXELS, SCATTER = "exact solids", "body in voxels, metal exact", "all in voxels", "scatter"
Count = Annotated[int, msgspec.Meta(ge=1)]
Level = Literal[0, 1]  # of scatter
HIGHEST = max(get_args(Level))


class Dataset(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The suite of scenes that methods are measured on, by name or path; `scenes` if not all of them.

    With `aligned` volumes are scored under that protocol, too.
    """

    suite: str
    scenes: tuple[str, ...] = ()
    aligned: bool = False


class Iterations(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """After how many iterations a method is scored, and how many times its default it goes."""

    stops: Annotated[tuple[Count, ...], msgspec.Meta(min_length=1)]
    times: Count


class More(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One more run of a method, with the parameters in `set`: a curve of its own."""

    curve: str
    label: str
    set: dict[str, Any] = {}


class Listed(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A method and its effort: values of a parameter, or how many times its default iterations; and further runs.

    With `default` off there are the further runs alone.
    """

    name: str
    times: Count | None = None
    parameter: str = ""
    values: tuple[Any, ...] = ()
    run: tuple[More, ...] = ()
    default: bool = True

    def __post_init__(self) -> None:
        if not self.default and (self.parameter or self.times is not None or not self.run):
            raise InputError("default: off is for a method with runs of its own, and without parameter and times")
        if bool(self.parameter) != bool(self.values):
            raise InputError("parameter and values: expected both or neither")
        if self.parameter and self.times is not None:
            raise InputError("times: expected none with a parameter and its values")


class Choices(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the simulator's scene is simulated; `grids` are label voxels along an axis for a pixel along one."""

    side: Annotated[int, msgspec.Meta(ge=16)]  # on fewer pixels all are at edges
    views: Annotated[int, msgspec.Meta(ge=2)]
    tolerances: tuple[Tolerance, ...]
    subrays: tuple[Subrays, ...]
    grids: tuple[Annotated[float, msgspec.Meta(gt=0)], ...]
    levels: tuple[Level, ...]


class Suite(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The tables of the file."""

    dataset: Dataset
    iterations: Iterations
    method: tuple[Listed, ...]
    simulator: Choices

    def __post_init__(self) -> None:
        curves = [m.name for m in self.method if m.default] + [run.curve for m in self.method for run in m.run]
        if twice := [curve for curve in curves if curves.count(curve) > 1]:
            raise InputError(f"method: two curves are called {twice[0]!r}; expected names that differ")

    def listed(self, name: str) -> Listed | None:
        """Return what the file says of a method, None where it does not name it."""
        return next((m for m in self.method if m.name == name), None)


def load(path: Path | None) -> Suite:
    """Read the tables of a file, each that it leaves out from the bundled one; only the latter for None.

    Raises InputError naming the file, the key and what was expected.
    """
    bundled = parse_toml((resources.files("ctsim.benchmarks.suites") / NAME).read_text(encoding="utf-8"), NAME)
    if path is None:
        return msgspec.convert(bundled, Suite)
    suite = decode(bundled | read_toml(path, f"like {NAME}"), Suite, str(path))
    if not suite.dataset.suite.endswith(".toml"):
        return suite
    dataset = msgspec.structs.replace(suite.dataset, suite=str(path.parent / suite.dataset.suite))
    return msgspec.structs.replace(suite, dataset=dataset)


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


def efforts(suite: Suite, name: str) -> list[Effort]:
    """List the runs of a method as the suite says, or by its iterations, if it has them, where it is not listed.

    Raises InputError for a method or a parameter that there is not.
    """
    usual, listed, stops = find(name), suite.listed(name) or Listed(name=name), suite.iterations.stops

    def effort(changes: dict[str, Any], label: str, *, curve: str = "", **more: Any) -> Effort:
        method = find(name, changes)
        more |= {"group": method.inputs, "curve": curve or name, "label": label}
        return Effort(method=name, changes=changes, params=method.params, **more)

    further = [effort(r.set, r.label, curve=r.curve, default=False, watched=True, stops=stops) for r in listed.run]
    if not listed.default:
        return further
    if key := listed.parameter:
        value = usual.params.get(key)
        usually = "defaults" if value is None else f"{key} {_words(value)}"
        runs = {usually: {}} | {f"{key} {_words(v)}": {key: v} for v in listed.values}
        return [effort(changes, label, default=label == usually) for label, changes in runs.items()] + further
    count, times = usual.params.get("iterations"), listed.times
    if isinstance(count, int):  # one watched run
        count *= times or suite.iterations.times
        return [effort({"iterations": count}, f"{count} iterations", watched=True, stops=stops), *further]
    if times is not None:
        raise InputError(f"method {name!r} has no default iterations to go {times} times as far as")
    return [effort({}, "defaults"), *further]


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
            label=f"{labels}³ labels",
            grid=grid,
            metal=metal,
            default=grid == USUAL and not metal,
        )
        for curve, metal in ((BODY, False), (VOXELS, True))
        for labels, grid in _grids(asked).items()
    ]
    # whether there is scatter is the scanner's matter: here there is, and then the highest level is what is computed
    return found + [
        Choice(group=SCATTER, curve=SCATTER, label=f"level {k}", level=k, default=k == HIGHEST) for k in asked.levels
    ]


def _grids(asked: Choices) -> dict[int, float]:
    """Return the grids by their number of labels; of those with the same number the default, or else the first."""
    grids = (*reversed(asked.grids), *(grid for grid in asked.grids if grid == USUAL))
    return dict(sorted({round(grid * asked.side): grid for grid in grids}.items()))


def _short(tolerance: float) -> str:
    """Return a tolerance in its shortest form that is exact: 1e-04, 1.2e-04."""
    mantissa, exponent = f"{tolerance:e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{exponent}"
