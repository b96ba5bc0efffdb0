"""Settings of a method: a frozen struct that states each parameter once, with its type, bounds, unit and meaning.

What a command line, a file or a call gives is converted into it: a method never sees a value that it cannot use.
"""

import difflib
import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast, get_args

import msgspec
from msgspec import inspect as kinds

from ctsim.errors import InputError

if TYPE_CHECKING:
    from ctsim.types import Scan, Volume

S = TypeVar("S", bound=msgspec.Struct)


def about(
    what: str,
    unit: str = "",
    *,
    ge: float | None = None,
    gt: float | None = None,
    le: float | None = None,
    also: type | None = None,
) -> msgspec.Meta:
    """Annotate a parameter: what it is, its unit, and its bounds.

    `also` is a type that Python callers may pass in addition to what the annotated type says.
    """
    bounds: dict[str, Any] = {"ge": ge, "gt": gt, "le": le}
    return msgspec.Meta(description=what, extra={"unit": unit, "also": also}, **bounds)


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """A parameter's name, its annotated type and its default."""

    name: str
    kind: Any
    default: Any

    @property
    def expected(self) -> str:
        """In words, the values that it may have, with their unit."""
        return _words(kinds.type_info(self.kind))

    @property
    def meaning(self) -> str:
        """What it is, "" where nobody says."""
        return (getattr(kinds.type_info(self.kind), "extra_json_schema", None) or {}).get("description", "")

    def converted(self, value: Any, where: str = "") -> Any:
        """Convert a value to the parameter's type; `where` begins the sentence of the InputError if it is no such."""
        also = (getattr(kinds.type_info(self.kind), "extra", None) or {}).get("also")
        if (value is None and self.default is None) or (also and isinstance(value, also)):
            return value
        try:
            return msgspec.convert(_plain(value), self.kind, strict=True)
        except msgspec.ValidationError:
            raise InputError(f"{where}{self.name}: expected {self.expected}, got {value!r}") from None


class Reconstruct(Protocol[S]):
    """A method: `reconstruct(scan, window="hann")`, or `reconstruct(scan, Settings(window="hann"))`."""

    settings: type[S]

    def __call__(self, scan: "Scan", settings: S | None = None, **changes: Any) -> "Volume":
        """Reconstruct a scan with settings, some of them changed."""
        ...


def keywords(kind: type[S]) -> Callable[[Callable[["Scan", S], "Volume"]], Reconstruct[S]]:
    """Turn a function of a scan and settings into a method that takes the fields of `kind` as keywords.

    All values are checked, also those of settings that were built without. The signature lists the fields.
    """
    empty = inspect.Parameter.empty
    listed = [("scan", inspect.Parameter.POSITIONAL_OR_KEYWORD, empty)] + [
        (p.name, inspect.Parameter.KEYWORD_ONLY, p.default) for p in parameters_of(kind).values()
    ]
    signature = inspect.Signature([inspect.Parameter(name, how, default=default) for name, how, default in listed])

    def wrap(function: Callable[["Scan", S], "Volume"]) -> Reconstruct[S]:
        @functools.wraps(function)
        def method(scan: "Scan", settings: S | None = None, **changes: Any) -> "Volume":
            given = {} if settings is None else msgspec.structs.asdict(settings)
            return function(scan, build(kind, given | changes))

        found = cast("Any", method)
        found.settings, found.__signature__ = kind, signature
        return cast("Reconstruct[S]", found)

    return wrap


@functools.cache
def parameters_of(kind: type[msgspec.Struct]) -> dict[str, Parameter]:
    """Return the parameters that a struct of settings states."""
    return {
        f.name: Parameter(
            name=f.name,
            kind=f.type,
            default=f.default if f.default_factory is msgspec.NODEFAULT else f.default_factory(),
        )
        for f in msgspec.structs.fields(kind)
    }


def build(kind: type[S], given: Mapping[str, Any], where: str = "") -> S:
    """Build settings from values by name; raises InputError for one that is unknown, out of bounds or does not fit."""
    values = convert(parameters_of(kind), given, where)
    try:
        return kind(**values)
    except InputError as error:  # of values that do not go together, which begins with the name of one
        raise InputError(f"{where}{error}") from None


def convert(known: Mapping[str, Parameter], given: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Convert values by name; raises InputError with near matches for an unknown name, and for a wrong value."""
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            expected = f"expected one of {', '.join(known)}" if known else "expected none"
            raise InputError(f"{where}{name}: unknown parameter; {f'did you mean {near[0]}?' if near else expected}")
    return {name: known[name].converted(value, where) for name, value in given.items()}


def value_of(name: str, value: Any, kind: Any) -> Any:
    """Check one value by its annotated type; raises InputError."""
    return Parameter(name=name, kind=kind, default=msgspec.NODEFAULT).converted(value)


def names_of(kind: Any) -> tuple[str, ...]:
    """Return the values of an annotated `Literal`."""
    return get_args(get_args(kind)[0])


def _plain(value: Any) -> Any:
    """Return numbers of numpy, structs and mappings as the built-in types that msgspec converts."""
    if isinstance(value, msgspec.Struct):
        return msgspec.to_builtins(value)
    if isinstance(value, Mapping):
        return dict(value)
    return value.item() if hasattr(value, "dtype") and getattr(value, "ndim", 1) == 0 else value


def _words(kind: kinds.Type, unit: str = "") -> str:
    """Say which values a type has."""
    if isinstance(kind, kinds.Metadata):
        return _words(kind.type, (kind.extra or {}).get("unit") or unit)
    if isinstance(kind, kinds.IntType | kinds.FloatType):
        word = "a whole number" if isinstance(kind, kinds.IntType) else "a number"
        return f"{word}{_bounds(kind)}" + (f" ({unit})" if unit else "")
    if isinstance(kind, kinds.LiteralType):
        values = list(cast("tuple[Any, ...]", kind.values))
        return f"one of {', '.join(map(str, values))}" if len(values) > 1 else repr(values[0])
    if isinstance(kind, kinds.UnionType):
        null = any(isinstance(t, kinds.NoneType) for t in kind.types)
        texts = [_words(t, unit) for t in kind.types if not isinstance(t, kinds.NoneType)]
        return " or ".join(texts) + (", or null" if null else "")
    if isinstance(kind, kinds.TupleType):
        return f"a list of {len(kind.item_types)}, each {_words(next(iter(kind.item_types)), unit)}"
    if isinstance(kind, kinds.VarTupleType | kinds.ListType):
        return f"a list, each {_words(kind.item_type, unit)}"
    if isinstance(kind, kinds.StructType):
        return f"a table of {', '.join(f.name for f in kind.fields)}"
    plain = {kinds.BoolType: "true or false", kinds.StrType: "text", kinds.DictType: "a table"}
    return plain.get(type(kind), "any value")


def _bounds(kind: kinds.IntType | kinds.FloatType) -> str:
    low, high = (kind.ge if kind.gt is None else kind.gt), (kind.le if kind.lt is None else kind.lt)
    numbers = [None if x is None else str(x) if isinstance(x, int) else f"{x:g}" for x in (low, high)]
    if kind.gt is None and kind.lt is None and None not in numbers:
        return f" within {numbers[0]} to {numbers[1]}"
    texts = [f"{'of at least' if kind.gt is None else 'above'} {numbers[0]}"] if numbers[0] else []
    texts += [f"{'at most' if kind.lt is None else 'below'} {numbers[1]}"] if numbers[1] else []
    return f" {', '.join(texts)}" if texts else ""
