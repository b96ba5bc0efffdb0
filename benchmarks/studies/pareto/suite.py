"""What `run-benchmark pareto` measures, as data: `benchmarks/suites/pareto.toml`, or tables of your own over it."""

from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec

from ctsim.errors import InputError
from ctsim.phantoms.suites import decode, parse_toml, read_toml
from ctsim.settings import Simulation

NAME = "pareto.toml"
Count = Annotated[int, msgspec.Meta(ge=1)]
Level = Literal[0, 1]  # of scatter
HIGHEST = max(get_args(Level))


class Dataset(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The suite of scenes that methods are measured on, by name or path; `scenes` if not all of them."""

    suite: str
    scenes: tuple[str, ...] = ()


class Iterations(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """After how many iterations a method is scored, and how many times its default it goes."""

    stops: Annotated[tuple[Count, ...], msgspec.Meta(min_length=1)]
    times: Count


class Run(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
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
    run: tuple[Run, ...] = ()
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
    tolerances: tuple[float, ...]
    subrays: tuple[int, ...]
    grids: tuple[Annotated[float, msgspec.Meta(gt=0)], ...]
    levels: tuple[Level, ...]

    def __post_init__(self) -> None:
        given = [("tolerances", k, {"tolerance": value}) for k, value in enumerate(self.tolerances)]
        given += [("subrays", k, {"subrays": value}) for k, value in enumerate(self.subrays)]
        for name, k, setting in given:
            try:
                msgspec.convert(setting, Simulation)
            except msgspec.ValidationError as error:
                raise InputError(f"{name}[{k}]: {str(error).partition(' - at ')[0]}") from None


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
