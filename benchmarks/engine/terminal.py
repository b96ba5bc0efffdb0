"""What a person sees while a command works: progress, tables and errors; plain lines where nobody watches."""

import contextlib
import io
import sys
import time
from collections.abc import Iterable, Iterator
from typing import TextIO, TypeVar

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

WIDEST = 100
"""Columns that a table may take."""
EVERY = 10.0
"""Seconds between lines of progress where nobody watches."""

T = TypeVar("T")


class Bar:
    """How far a command is: `total` units of work, what was done last, and what is done now.

    On a terminal a bar follows. Elsewhere, as in the log of a job, every finished unit that has a name is a line, and
    others are counted in a line every `EVERY` seconds. `done` is how many units are finished.
    """

    def __init__(self, total: int, unit: str, done: int = 0, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stderr
        self._total, self._unit, self.done = total, unit, done
        self._said = time.monotonic()
        self._rich: Progress | None = None
        if self._stream.isatty():
            console = Console(file=self._stream, highlight=False)
            times = (TimeElapsedColumn(), TextColumn("<"), TimeRemainingColumn(elapsed_when_finished=True))
            counts = TextColumn("{task.completed:.0f}/{task.total:.0f} " + unit + "s", markup=False)
            note = TextColumn("{task.description}", markup=False)
            self._rich = Progress(SpinnerColumn(), BarColumn(24), counts, *times, note, console=console)
            self._task = self._rich.add_task("", total=total, completed=done)

    def __enter__(self) -> "Bar":
        if self._rich:
            self._rich.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._rich:
            self._rich.stop()

    def note(self, text: str) -> None:
        """Say what is done now."""
        if self._rich:
            self._rich.update(self._task, description=text)

    def advance(self, n: int = 1, text: str = "") -> None:
        """Count finished units; `text` names what has ended, and how."""
        self.at(self.done + n, text)

    def at(self, done: int, text: str = "") -> None:
        """Say how many units are finished."""
        self.done = done
        if self._rich:
            self._rich.update(self._task, completed=done, description=text or None)
        elif text or (time.monotonic() - self._said > EVERY):
            self._said = time.monotonic()
            self._stream.write(f"{done}/{self._total} {self._unit}s{': ' if text else ''}{text}\n")
            self._stream.flush()

    def over(self, items: Iterable[T], text: str) -> Iterator[T]:
        """Yield items, counting each as a unit once it was worked on."""
        self.note(text)
        for item in items:
            yield item
            self.at(self.done + 1)


def width() -> int:
    """Return how many columns a table may take: those of the terminal, at most `WIDEST`."""
    console = Console()
    return min(WIDEST, console.width) if console.is_terminal else WIDEST


def rendered(*parts: RenderableType) -> str:
    """Return tables and texts as this process's stdout shows them: with colours on a terminal, else without.

    No line is wider than `WIDEST` columns or the terminal.
    """
    plain = Console()
    console = Console(
        file=io.StringIO(),
        force_terminal=plain.is_terminal,
        color_system=plain.color_system,  # type: ignore[arg-type]
        width=width(),
        highlight=False,
        legacy_windows=False,
    )
    for part in parts:
        console.print(part, soft_wrap=isinstance(part, str), markup=False)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def complain(name: str, sentence: str) -> None:
    """Write an error of the user's to stderr: the command's name and one sentence."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    with contextlib.suppress(BrokenPipeError):
        console.print(Text.assemble((f"{name}:", "bold red"), f" {sentence}"))
