"""What a command shows on a terminal: progress, tables, errors; in a log, plain lines."""

import contextlib
import io
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, TextIO, TypeVar

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

if TYPE_CHECKING:
    from numba.core.event import Event

WIDEST = 100
"""Most columns of characters that a table may take."""
EVERY = 10.0
"""Seconds between lines of progress in a log."""
PATIENCE = 1.0
"""Seconds of compiling that need no message."""
COMPILING = "compiling kernels, once (20 to 45 s) …"

T = TypeVar("T")


class Bar:
    """Progress of a command: `done` of `total` units, and what it does now.

    A terminal shows a bar. A log has a line for each finished unit with a name, and a count every `EVERY` seconds.
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
        """Say what the command does now."""
        if self._rich:
            self._rich.update(self._task, description=text)

    def advance(self, n: int = 1, text: str = "") -> None:
        """Add `n` finished units; `text` names what has ended, and how."""
        self.at(self.done + n, text)

    def at(self, done: int, text: str = "") -> None:
        """Set the number of finished units; `text` names what has ended, and how."""
        self.done = done
        if self._rich:
            self._rich.update(self._task, completed=done, description=text or None)
        elif text or (time.monotonic() - self._said > EVERY):
            self._said = time.monotonic()
            self._stream.write(f"{done}/{self._total} {self._unit}s{': ' if text else ''}{text}\n")
            self._stream.flush()

    def over(self, items: Iterable[T], text: str) -> Iterator[T]:
        """Yield items; each counts as a finished unit once the caller asks for the next."""
        self.note(text)
        for item in items:
            yield item
            self.at(self.done + 1)


def width() -> int:
    """Return the width of a table in characters: the terminal's, at most `WIDEST`."""
    console = Console()
    return min(WIDEST, console.width) if console.is_terminal else WIDEST


def rendered(*parts: RenderableType) -> str:
    """Return tables and texts as stdout shows them: in colour on a terminal, no table wider than `width()`."""
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
    """Write a user's error to stderr: the command's name and one sentence."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    with contextlib.suppress(BrokenPipeError):
        console.print(Text.assemble((f"{name}:", "bold red"), f" {sentence}"))


@contextlib.contextmanager
def announced(say: Callable[[str], object]) -> Iterator[None]:
    """Call `say` once if compiling kernels in this process takes longer than `PATIENCE`; a cached kernel is silent."""
    from numba.core.event import Listener, install_listener  # numba is slow to load, and only this needs it

    Listener.register(_Compilation)
    with install_listener("numba:compile", _Compilation(say)):
        yield


class _Compilation:
    """Adds up the seconds of compiling, where one compilation may start another: a `Listener` of numba's."""

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say, self._said = say, False
        self._depth, self._spent, self._since = 0, 0.0, 0.0

    def notify(self, event: "Event") -> None:
        now = time.monotonic()
        if self._depth == 0:
            self._since = now
        if not self._said and self._spent + now - self._since > PATIENCE:
            self._said = True
            self._say(COMPILING)
        self._depth += 1 if event.is_start else -1
        if self._depth == 0:
            self._spent += now - self._since
