"""The page of the commands: every flag, from the dataclasses that tyro parses."""

import dataclasses
import functools
import importlib
import types
import typing
from typing import Any

import tyro

from ctsim.benchmarks.tools.reference import text

HEAD = """# Commands

Two commands are installed: `make-dataset` simulates scans, `run-benchmark` reconstructs and scores them. The
subcommands of `run-benchmark` are studies and reports. Every command has `--help`. A wrong input ends with one
sentence and exit code 2. Ctrl-C ends a command with exit code 130, and the same command then continues."""
POSITIONAL = typing.get_args(tyro.conf.Positional[int])[1]
REPEATED = typing.get_args(tyro.conf.UseAppendAction[int])[1]
NO_PAIR = typing.get_args(tyro.conf.FlagCreatePairsOff[int])[1]


@functools.cache
def forms() -> dict[str, type]:
    """Return every command with the dataclass of its arguments."""
    from ctsim.benchmarks.cli import OTHERS

    names = {"make-dataset": "ctsim.benchmarks.make_dataset", "run-benchmark": "ctsim.benchmarks.studies.methods.study"}
    names |= {f"run-benchmark {name}": command.module for name, command in sorted(OTHERS.items())}
    return {name: form_of(importlib.import_module(module)) for name, module in names.items()}


def form_of(module: types.ModuleType) -> type:
    """Return the dataclass of a command's arguments: the first of these that its module or package declares."""
    found = (getattr(module, name, None) for name in ("Flags", "Arguments", "Options"))
    return next(f for f in found if f is not None and f.__module__ in (module.__name__, module.__package__))


def page() -> str:
    """Return the page as Markdown."""
    return "\n\n".join([HEAD, *(section(name, form) for name, form in forms().items())])


def section(name: str, form: type) -> str:
    """Return heading, call, description and flags of one command."""
    flags = [_flag(item, hint, said) for item, hint, said in _fields(form)]
    flags.sort(key=lambda flag: flag[0].startswith("`-"))  # folders first, as they are typed
    call = " ".join([name, *(f[0].strip("`") for f in flags if not f[0].startswith("`-")), "[flags]"])
    rows = text.table(("argument", "value", "default", "meaning"), flags)
    return f"## {name}\n\n```text\n{call}\n```\n\n{text.described(form)}\n\n{rows}"


def _fields(form: type) -> list[tuple[dataclasses.Field[Any], Any, str]]:
    hints, said = typing.get_type_hints(form, include_extras=True), text.field_texts(form)
    return [(item, hints[item.name], said.get(item.name, "")) for item in dataclasses.fields(form)]


def _flag(item: dataclasses.Field[Any], hint: Any, said: str) -> tuple[str, str, str, str]:
    """Return the row of one argument: how it is typed, its value, its default, what it means."""
    kind, marks = _stripped(hint)
    metavar = next((m.metavar for m in marks if getattr(m, "metavar", None)), None)
    if POSITIONAL in marks:
        name = metavar or item.name.upper().replace("_", "-")
        return f"`{name}`", "", "" if item.default is dataclasses.MISSING else "optional", said
    flag = f"--{item.name.replace('_', '-')}"
    if kind is bool:
        shown = f"`{flag}`" if NO_PAIR in marks else f"`{flag}`, `--no-{flag[2:]}`"
        return shown, "", "on" if item.default else "off", said
    default = "" if item.default in (None, (), dataclasses.MISSING) else text.code(item.default)
    often = ", may be repeated" if REPEATED in marks else ""
    return f"`{flag}`", f"`{metavar}`{often}" if metavar else text.kind_name(kind), default, said


def _stripped(hint: Any) -> tuple[Any, list[Any]]:
    """Return a type without its annotations, also those within `X | None`, and the annotations."""
    if typing.get_origin(hint) is typing.Annotated:
        inner, *marks = typing.get_args(hint)
        kind, more = _stripped(inner)
        return kind, [*marks, *more]
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        inner = [i for i in typing.get_args(hint) if i is not types.NoneType]
        if len(inner) == 1:
            return _stripped(inner[0])
    return hint, []
