"""What `run-benchmark pareto` measures: `benchmarks/suites/pareto.toml`, or a file whose tables replace its tables.

`efforts` and `choices` list the runs. A run is the whole settings of a task, so a worker needs no file. Points of one
`group` are compared; within it they form curves.
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
USUAL = 107 / 96  # label voxels per pixel along an axis, as a scene has by default; the bundled suites have 0.5 to 1.2
EXACT, BODY, VOXELS, SCATTER = "exact solids", "body in voxels, metal exact", "all in voxels", "scatter"
Count = Annotated[int, msgspec.Meta(ge=1)]
Level = Literal[0, 1, 3]  # of scatter
HIGHEST = max(get_args(Level))


class Dataset(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The suite of scenes for the methods, by name or path; `scenes` (empty: all) names the scenes to use.

    With `aligned` volumes are also scored under that protocol.
    """

    suite: str
    scenes: tuple[str, ...] = ()
    aligned: bool = False


class Iterations(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The iterations after which a method is scored, and the multiple of its default at which it ends."""

    stops: Annotated[tuple[Count, ...], msgspec.Meta(min_length=1)]
    times: Count


class More(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A further run of a method, with the parameters in `set` and its own curve."""

    curve: str
    label: str
    set: dict[str, Any] = {}


class Listed(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A method and its effort: values of a parameter, or a multiple of its default iterations; and further runs.

    With `default` off there are only the further runs.
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
    """The settings of the simulator to measure; `grids` are label voxels per pixel along an axis."""

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
        """Return the file's entry of a method, None if there is none."""
        return next((m for m in self.method if m.name == name), None)


def load(path: Path | None) -> Suite:
    """Read a suite; tables that the file at `path` leaves out, or all for None, come from the bundled file.

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
    """One run of a method: `changes` of its parameters, all `params`, and the names of the run and its curve.

    A `watched` run has a mark at each of the `stops`, if the method shows its volume. With `default` the run, or one of
    its marks, is the method's default.
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
    """One way to simulate the scene. `grid`: label voxels per pixel, None for analytic; `metal`: metal too."""

    group: str = EXACT
    curve: str
    label: str
    simulation: Simulation = Simulation()
    grid: float | None = None
    metal: bool = False
    level: Level = 0
    default: bool = False


def efforts(suite: Suite, name: str) -> list[Effort]:
    """List the runs of a method: as in the suite or, if not listed there, by its iterations, if it has any.

    Raises InputError for an unknown method or parameter.
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
    """List the settings to measure: tolerances with sub-rays, voxels instead of solids, and scatter levels."""
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
    # a scene has a closed form or not, so voxels have their own group and do not compete with solids
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
    # the scanner decides about scatter; here there is some, and its best model is the highest level
    return found + [
        Choice(group=SCATTER, curve=SCATTER, label=f"level {k}", level=k, default=k == HIGHEST) for k in asked.levels
    ]


def _grids(asked: Choices) -> dict[int, float]:
    """Return the grids by their number of labels; of equal numbers the default grid, else the first."""
    grids = (*reversed(asked.grids), USUAL)
    return dict(sorted({round(grid * asked.side): grid for grid in grids}.items()))


def _short(tolerance: float) -> str:
    """Return a tolerance in its shortest form that is exact: 1e-04, 1.2e-04."""
    mantissa, exponent = f"{tolerance:e}".split("e")
    return f"{mantissa.rstrip('0').rstrip('.')}e{exponent}"
