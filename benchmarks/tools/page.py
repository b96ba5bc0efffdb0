"""What the tools that write one measured page have in common."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from ctsim.benchmarks.engine.host import commit, machine
from ctsim.benchmarks.suites import load
from ctsim.errors import InputError
from ctsim.phantoms.scene import Scene


def put(text: str, name: str, folder: str | None) -> int:
    """Write a page into a folder and say where, or print it without one; return 0."""
    if folder is None:
        sys.stdout.write(text)
        return 0
    path = Path(folder) / name
    path.write_text(text, encoding="utf-8")
    sys.stdout.write(f"{path}\n")
    return 0


def of_suite(arguments: list[str], suite: str, name: str, page: Callable[[Sequence[Scene]], str]) -> int:
    """Put the page of a suite's scenes where the arguments of a command say; return 0."""
    if len(arguments) > 1:
        raise InputError("expected the folder of the measured pages or nothing")
    return put(page(load(suite)), name, arguments[0] if arguments else None)


def headed(title: str, doc: str | None, caption: str, table: str) -> str:
    """Return a page with its table, and above it how it was made: by the indented line of the tool's docstring."""
    command = next(line.strip() for line in (doc or "").splitlines() if line.startswith("    "))
    made = f"Made by `{command}`. Do not edit. Measured at commit {commit()}, {machine()}."
    return f"# {title}\n\n{made}\n\n{caption}\n\n{table}"


def rows_of(scenes: Sequence[Scene], row: Callable[[Scene], list[str]]) -> list[list[str]]:
    """Return the row of each scene, whose name is told at its start."""
    rows = []
    for scene in scenes:
        sys.stderr.write(f"{scene.name}\n")
        rows.append(row(scene))
    return rows
