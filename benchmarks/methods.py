"""The methods: names of plain functions `reconstruct(scan, ...) -> Volume`. `run-benchmark methods` lists them.

A method of ours states its parameters as a struct of settings (`ctsim.reconstruct.settings`). `--method
my_lab.net:reconstruct` names a function of your own: its keyword parameters are its settings, converted to the types
that they are annotated with; one called `device` is always "cpu". Its module may define `skip(scan) -> str | None`
(a reason, or None to run) and `INPUTS`, which says what the method needs in addition to the counts. Methods are ranked
within one class of inputs. `--method "cmd:./mine {scan} {out}"` runs a program (`ctsim.benchmarks.program`).
"""

import dataclasses
import difflib
import importlib
import inspect
import os
import pkgutil
import sys
import typing
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, cast

import msgspec
import msgspec.inspect
import tyro

from ctsim.dataset.versions import code_version
from ctsim.errors import InputError
from ctsim.reconstruct.settings import Parameter, build, convert, parameters_of

if TYPE_CHECKING:
    from ctsim.types import Scan, Volume

PROGRAM = "cmd:"
"""A method's name that begins so is the command of a program."""
RUNS_PROGRAM = "ctsim.benchmarks.program"
COUNTS_ONLY, METAL_MASK, SPECTRUM = "counts only", "metal mask", "spectrum"
MASK_AND_SPECTRUM = "metal mask and spectrum"
ASSUMED = "assumed spectrum"
"""Told no spectrum: a tungsten tube and 0.2 mm of GOS are assumed, and the filter is found in the scan.

A filter or a detector that is told stands in the row's label."""
MASK_AND_ASSUMED = "metal mask and assumed spectrum"
TRAINED, TRAINED_MASK = "training", "training, metal mask"
"""Counts and weights that were trained on other scans (the suite `train`), and the same with a metal mask."""
CONTROL, TWIN = "control", "control, told the twin"
CONTROLS = (CONTROL, TWIN)
"""The classes of rows that are no methods: tables show them and never rank them."""

TABLE: dict[str, tuple[str, str]] = {
    "fdk": ("ctsim.reconstruct.fdk:reconstruct", COUNTS_ONLY),
    "fdk-ramp": ("ctsim.reconstruct.fdk:ramp", COUNTS_ONLY),
    "zero": ("ctsim.baselines.control:zero", CONTROL),
    "hull": ("ctsim.baselines.control:hull", CONTROL),
    "twin-fdk": ("ctsim.baselines.control:twin_fdk", TWIN),
    "limar": ("ctsim.baselines.limar:reconstruct", METAL_MASK),
    "nmar": ("ctsim.baselines.nmar:reconstruct", METAL_MASK),
    "bhc-poly": ("ctsim.baselines.bhc:bhc_poly", METAL_MASK),
    "water-precorrection": ("ctsim.baselines.known_spectrum:water_precorrection", SPECTRUM),
    "ibhc": ("ctsim.baselines.known_spectrum:ibhc", SPECTRUM),
    "sart": ("ctsim.baselines.sart:sart", COUNTS_ONLY),
    "os-sart": ("ctsim.baselines.sart:os_sart", COUNTS_ONLY),
    "sirt": ("ctsim.baselines.sart:sirt", COUNTS_ONLY),
    "cgls": ("ctsim.baselines.krylov:cgls", COUNTS_ONLY),
    "fista-tv": ("ctsim.baselines.tv_methods:fista_tv", COUNTS_ONLY),
    "asd-pocs": ("ctsim.baselines.tv_methods:asd_pocs", COUNTS_ONLY),
    "awpcsd": ("ctsim.baselines.tv_methods:awpcsd", COUNTS_ONLY),
    "fusion": ("ctsim.baselines.learned.methods:fusion", TRAINED_MASK),
    "denoise": ("ctsim.baselines.learned.methods:denoise", TRAINED),
    "denoise-lite": ("ctsim.baselines.learned.methods:denoise_lite", TRAINED),
    "dicdnet-lite": ("ctsim.baselines.learned.methods:dicdnet_lite", TRAINED_MASK),
    "acdnet-lite": ("ctsim.baselines.learned.methods:acdnet_lite", TRAINED_MASK),
    "oscnet-lite": ("ctsim.baselines.learned.methods:oscnet_lite", TRAINED_MASK),
    "splat": ("ctsim.reconstruct.splat.fast:reconstruct", ASSUMED),
    "splat-paper": ("ctsim.reconstruct.splat.published:paper", COUNTS_ONLY),
    "splat-r2": ("ctsim.reconstruct.splat.published:r2", COUNTS_ONLY),
    "naf": ("ctsim.reconstruct.field.methods:naf", COUNTS_ONLY),
    "polyner": ("ctsim.baselines.polyner:reconstruct", MASK_AND_SPECTRUM),
    "park": ("ctsim.reconstruct.field.methods:park", COUNTS_ONLY),
    "field": ("ctsim.reconstruct.field.methods:field", ASSUMED),
}
"""name -> ("module:function", what it needs in addition to the counts)."""
EXTERNAL = {
    "mbir": "ctsim.baselines.external:mbir",
    "mbir-mar": "ctsim.baselines.external:mbir_mar",
}
"""name -> "module:function" of methods that run another package, which `ctsim[peers-methods]` installs."""
UNMASKED = {
    METAL_MASK: COUNTS_ONLY,
    MASK_AND_SPECTRUM: SPECTRUM,
    MASK_AND_ASSUMED: ASSUMED,
    TRAINED_MASK: TRAINED,
}
"""What a method needs that is told the metal mask -> what it needs where it finds the metal itself."""
FAILED = {"naf": "5", "polyner": "5", "park": "3,5", "field": "5", "denoise": "2"}
"""Methods -> the rules of `run-benchmark reproduce --neural` that they failed when last judged, with their defaults."""
ASKED = {"known": SPECTRUM, "tube": ASSUMED}
"""A splat's `response` -> what it needs then."""
FITTED = ("splat", "field")
"""Values of a `prior` that is built on an assumed spectrum."""
KEPT_IN = "checkpoints"
"""The parameter of our methods that says where an unfinished fit is kept: no part of what a record and a table name."""
GONE = {("splat", "preset"): "presets are methods of their own; expected --method splat-paper or --method splat-r2"}
"""(method, removed parameter) -> what to do instead."""
WIDEST = 24  # characters; a longer default is not aligned with the others


def daggered(label: str) -> str:
    """Return a method's label; with a dagger and the rules that it failed, if it is one of `FAILED`."""
    return f"{label} †{FAILED[label]}" if label in FAILED else label


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """A method and its parameters as plain JSON values: all in `params`, those not at their default in `overrides`.

    Where checkpoints are kept stands in `overrides` alone. What the scan told the method stands in `told` and `params`,
    not in its label; a `limitation` is added to the details of its volumes (`ctsim.benchmarks.known_beam`).
    """

    name: str
    target: str
    inputs: str
    params: dict[str, Any]
    overrides: dict[str, Any] = field(default_factory=dict)
    code: str = ""
    told: dict[str, Any] = field(default_factory=dict)
    limitation: str = ""

    @property
    def label(self) -> str:
        """The name with the parameters that differ from the defaults, as tables show it."""
        given = ", ".join(f"{k}={v}" for k, v in sorted(named(self.name, self.overrides).items()))
        return f"{self.name}[{given}]" if given and not self.program else self.name

    @property
    def program(self) -> bool:
        """Whether it is a program: its name is its command, and all of its parameters."""
        return self.name.startswith(PROGRAM)

    @property
    def control(self) -> bool:
        """Whether it is a row to compare with, not a method."""
        return self.inputs in CONTROLS

    @property
    def told_twin(self) -> bool:
        """Whether it is handed the metal-free twin in place of the scan.

        Only the table can say so: the `INPUTS` of a module of your own is a text that tables show.
        """
        return TABLE.get(self.name) == (self.target, TWIN)

    @property
    def mask(self) -> str:
        """Where the metal mask comes from, "none" for a method without."""
        return str(self.params.get("mask", "none"))

    def reconstruct(self, scan: "Scan") -> "Volume":
        """Run the method."""
        function = resolve(self.target)
        given = convert(parameters(self.name, function), self.told | self.overrides, f"{self.name}.")
        if "device" in inspect.signature(function).parameters:
            given["device"] = "cpu"
        volume = function(scan, **given)
        if not self.limitation:
            return volume
        said = [text for text in (volume.details.get("limitation"), self.limitation) if text]
        return dataclasses.replace(volume, details={**volume.details, "limitation": "; ".join(said)})

    def skip(self, scan: "Scan") -> str | None:
        """Return why the method's module would skip `scan`; None to run."""
        asked = getattr(sys.modules[resolve(self.target).__module__], "skip", None)
        return asked(scan) if asked else None


def resolve(target: str) -> Callable[..., "Volume"]:
    """Import "module:function"; modules in the working directory are found too.

    Raises InputError where there is no such module or function, or it cannot be called.
    """
    if "" not in sys.path and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    try:
        found = pkgutil.resolve_name(target)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(f"method {target!r} cannot be imported: {error}") from None
    if not callable(found):
        raise InputError(f"method {target!r} is not a function")
    return cast("Callable[..., Volume]", found)


def find(name: str, overrides: dict[str, Any] | None = None) -> Method:
    """Look a method up by its table name or as "module:function" and bind its parameters.

    Raises InputError naming near matches for an unknown method or parameter.
    """
    if name.startswith(PROGRAM):
        return _program(name, overrides or {})
    if name in TABLE:
        target, inputs = TABLE[name]
    elif ":" in name or name in EXTERNAL:
        target, inputs = EXTERNAL.get(name, name), ""
    else:
        near = difflib.get_close_matches(name, [*TABLE, *EXTERNAL], n=3)
        hint = f"did you mean {' or '.join(near)}?" if near else f"expected {', '.join(TABLE)} or module:function"
        raise InputError(f"there is no method {name!r}: {hint}")
    function = resolve(target)
    module = sys.modules[function.__module__]
    params, changed = _settings(name, function, overrides or {})
    if inputs == METAL_MASK and params.get("prior") in FITTED:
        inputs = MASK_AND_ASSUMED
    if inputs in UNMASKED and params["mask"] == "auto":
        inputs = UNMASKED[inputs]  # it finds the metal itself
    if inputs in (COUNTS_ONLY, ASSUMED) and (response := params.get("response")) in ASKED:
        inputs = ASKED[response]
    return Method(
        name=name,
        target=target,
        inputs=inputs or getattr(module, "INPUTS", COUNTS_ONLY),
        params=params,
        overrides=changed,
        code=code_version(function.__module__),
    )


def _program(name: str, overrides: dict[str, Any]) -> Method:
    """Return a program as a method: what is a parameter of others stands in its command.

    Raises InputError where the command lacks a place for scan or volume, or its program is not there.
    """
    program = importlib.import_module(RUNS_PROGRAM)  # loads torch
    command = name.removeprefix(PROGRAM)
    told = {"command": command, "mask": "oracle" if program.asks_for_mask(command) else "none"}
    if other := overrides.keys() - told.keys():
        raise InputError(f"{name}.{min(other)}: a program has no parameters, expected its options in the command")
    return Method(
        name=name,
        target=f"{RUNS_PROGRAM}:reconstruct",
        inputs=METAL_MASK if told["mask"] == "oracle" else COUNTS_ONLY,
        params=told,
        overrides=told,
        code=f"{code_version(RUNS_PROGRAM)[:8]}{program.code_of(command)[:8]}",
    )


def chosen(names: tuple[str, ...], settings: tuple[str, ...], seconds: float | None = None) -> list[Method]:
    """Return the methods that --method names, with the parameters that --set and --seconds give.

    Raises InputError for a wrong name, parameter or value.
    """
    given = parse_overrides(settings, names)
    found = []
    for name in names:
        find(name)  # the error for an unknown name does not speak of --set
        try:
            found.append(within(find(name, given[name]), seconds))
        except InputError as error:
            raise InputError(f"--set {error}" if given[name] else str(error)) from None
    return found


def within(method: Method, seconds: float | None) -> Method:
    """Set a method's parameter `seconds`, if it has one and --set gives none."""
    if seconds is None or "seconds" not in method.params or "seconds" in method.overrides:
        return method
    whole = int(seconds) if float(seconds).is_integer() else seconds  # so that a parameter of whole numbers takes it
    return find(method.name, {**method.overrides, "seconds": whole})


def parameters(name: str, function: Callable[..., Any]) -> dict[str, Parameter]:
    """Return the parameters of a method: those of its settings, or its keyword parameters except `device`."""
    settings = getattr(function, "settings", None)
    if settings is not None:
        return parameters_of(settings)
    listed = list(inspect.signature(function).parameters.values())
    if not listed:
        raise InputError(f"method {name!r} must be reconstruct(scan, ...), got {inspect.signature(function)}")
    try:
        types = typing.get_type_hints(function, include_extras=True)
    except (NameError, TypeError, AttributeError):  # an annotation that only a type checker can resolve
        types = {}
    several = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    return {
        p.name: Parameter(
            name=p.name, kind=_known(types.get(p.name, Any)), default=None if p.default is p.empty else p.default
        )
        for p in listed[1:]
        if p.name != "device" and p.kind not in several
    }


def _known(kind: Any) -> Any:
    """Return a type that msgspec converts values to: Any for types that it does not know, such as arrays."""
    try:
        return Any if isinstance(msgspec.inspect.type_info(kind), msgspec.inspect.CustomType) else kind
    except TypeError:
        return Any


def _settings(name: str, function: Callable[..., Any], given: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Check settings; return all parameters, and those not at their default, as plain JSON values."""
    known, where = parameters(name, function), f"{name}."
    for key in given:
        if key not in known and (name, key) in GONE:
            raise InputError(f"{where}{key}: {GONE[name, key]}")
    values = convert(known, given, where)
    if hasattr(function, "settings"):
        build(cast("Any", function).settings, given, where)
    defaults = {key: _plain(parameter.default) for key, parameter in known.items()}
    changed = {key: plain for key, value in values.items() if (plain := _plain(value)) != defaults[key]}
    return defaults | named(name, changed), changed


def named(name: str, changed: dict[str, Any]) -> dict[str, Any]:
    """Return the settings that say what a method does, without where it keeps its state."""
    return {key: value for key, value in changed.items() if key != KEPT_IN or name not in TABLE}


def _plain(value: Any) -> Any:
    """Return a value in the types of JSON, for records; its `repr` where JSON has no such type."""
    plain = msgspec.to_builtins(value, enc_hook=repr)
    return [_plain(item) for item in plain] if isinstance(plain, tuple) else plain


def parse_overrides(settings: tuple[str, ...], names: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Parse "method.parameter=value" settings; a value that is not JSON is text.

    Raises InputError for a setting of another form, or of a method that is not run.
    """
    found: dict[str, dict[str, Any]] = {name: {} for name in names}
    for setting in settings:
        path, equals, text = setting.partition("=")
        method, dot, parameter = path.rpartition(".")
        if not (equals and dot and parameter):
            raise InputError(f"--set {setting!r}: expected method.parameter=value")
        if method not in found:
            raise InputError(f"--set {setting!r}: method {method!r} is not among those to run, {', '.join(names)}")
        try:
            found[method][parameter] = msgspec.json.decode(text)
        except (msgspec.DecodeError, RecursionError):
            found[method][parameter] = text
    return found


@dataclass(frozen=True)
class Flags:
    """List the methods, what they need, and their parameters with defaults, bounds and units."""

    method: tyro.conf.Positional[Annotated[tuple[str, ...], tyro.conf.arg(metavar="[NAME ...]")]] = ()
    """Only these methods, or module:function of your own (default: all of the table)."""


def main(arguments: list[str]) -> int:
    """Print the list; return 0."""
    given = tyro.cli(Flags, prog="run-benchmark methods", args=arguments)
    sys.stdout.write("\n".join(described(name) for name in given.method or [*TABLE, *EXTERNAL]))
    return 0


def described(name: str) -> str:
    """Return a line with a method's inputs, and one for each parameter."""
    method = find(name)
    known = parameters(name, resolve(method.target))
    defaults = {key: _default(method.params[key]) for key in known}
    widths = [max((len(t) for t in texts if len(t) <= WIDEST), default=0) for texts in (known, defaults.values())]
    lines = [f"{name}: {method.inputs}"]
    for key, parameter in known.items():
        meaning = f"; {parameter.meaning}" if parameter.meaning else ""
        lines.append(f"  {key:{widths[0]}}  {defaults[key]:{widths[1]}}  {parameter.expected}{meaning}")
    return "\n".join(lines) + "\n"


def _default(value: Any) -> str:
    """Write a default as --set takes it; infinity is no limit."""
    if value == float("inf"):
        return "no limit"
    return value or '""' if isinstance(value, str) else msgspec.json.encode(value).decode()
