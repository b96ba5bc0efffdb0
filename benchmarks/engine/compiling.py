"""Tell people that kernels are being compiled, which is slow and silent, and happens once."""

import contextlib
import time
from collections.abc import Callable, Iterator

from numba.core.event import Event, Listener, install_listener

PATIENCE = 1.0  # seconds of compiling that need no word
TEXT = "compiling kernels, once (about 20 s) …"


@contextlib.contextmanager
def announced(say: Callable[[str], object]) -> Iterator[None]:
    """Call `say` once if compiling in this process takes longer than `PATIENCE`; loading from the cache is silent."""
    with install_listener("numba:compile", _Patient(say)):
        yield


class _Patient(Listener):
    """Adds up the seconds of compiling; compilations nest."""

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say, self._said = say, False
        self._depth, self._spent, self._since = 0, 0.0, 0.0

    def on_start(self, event: Event) -> None:
        now = time.monotonic()
        if self._depth == 0:
            self._since = now
        self._depth += 1
        self._look(now)

    def on_end(self, event: Event) -> None:
        now = time.monotonic()
        self._look(now)
        self._depth -= 1
        if self._depth == 0:
            self._spent += now - self._since

    def _look(self, now: float) -> None:
        if not self._said and self._spent + now - self._since > PATIENCE:
            self._said = True
            self._say(TEXT)
