"""Looking on while a method works: how far it is, and its volume on the way."""

import contextlib
import contextvars
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch

OnUpdate = Callable[[int, float, "torch.Tensor"], None]


class _Watcher:
    """Whom to call, and the times in s that are still to come; None where every iteration is wanted."""

    def __init__(self, on_update: OnUpdate, at: Sequence[float] | None) -> None:
        self.on_update, self.at = on_update, None if at is None else sorted(at)


_watcher: contextvars.ContextVar[_Watcher | None] = contextvars.ContextVar("watcher", default=None)


@contextlib.contextmanager
def watch(on_update: OnUpdate, *, at: Sequence[float] | None = None) -> Iterator[None]:
    """Call `on_update(view_updates, seconds, volume)` after each iteration of every method run within.

    With `at` it is called after the first iteration that ends at or after each of these times (s), once where one
    iteration passes several. `volume` is float32 [z, y, x]; the seconds since the start leave out what the watching
    took. Methods that do not iterate do not call.
    """
    token = _watcher.set(_Watcher(on_update, at))
    try:
        yield
    finally:
        _watcher.reset(token)


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """Where a fit stands: the share of its work that is done, seconds so far and about still to go, and its loss.

    The loss is what the method makes small, of its last step alone; it may jump from one to the next.
    """

    share: float
    seconds: float
    remaining: float
    loss: float


OnProgress = Callable[[Progress], None]
_listener: contextvars.ContextVar[tuple[OnProgress, float] | None] = contextvars.ContextVar("listener", default=None)


@contextlib.contextmanager
def listen(on_progress: OnProgress, *, every: float = 1.0) -> Iterator[None]:
    """Call `on_progress` about every `every` seconds of every splat fit run within, in this thread."""
    token = _listener.set((on_progress, every))
    try:
        yield
    finally:
        _listener.reset(token)


_resumed: contextvars.ContextVar[list[float] | None] = contextvars.ContextVar("resumed", default=None)


@contextlib.contextmanager
def resumed() -> Iterator[list[float]]:
    """Yield a list that gets the seconds before this part of every fit within that goes on from a checkpoint."""
    token = _resumed.set(seconds := [])
    try:
        yield seconds
    finally:
        _resumed.reset(token)


class Stopwatch:
    """A run's seconds, less what watching it took, and the times at which its watcher is still to be shown one."""

    def __init__(self, limit: float = math.inf) -> None:
        """Start at 0; the run is to end after `limit` seconds. `earlier` are those of its parts before this one."""
        self._began, self._paused = time.perf_counter(), 0.0
        self.limit, self.earlier, self._told = limit, 0.0, -math.inf
        self._watcher = _watcher.get()
        self._at = self._watcher.at if self._watcher else None

    def resume(self, earlier: float) -> None:
        """Count on from the seconds that an earlier part of the run took; the times within them are not shown."""
        self._began, self.earlier = self._began - earlier, earlier
        if (seconds := _resumed.get()) is not None:
            seconds.append(earlier)
        if self._at is not None:
            self._at = [t for t in self._at if t > self.seconds]

    def details(self) -> dict[str, float]:
        """Return what a result says of a run that was interrupted: the seconds before its last part."""
        return {"earlier_seconds": self.earlier} if self.earlier else {}

    @property
    def seconds(self) -> float:
        """Seconds since the start."""
        return time.perf_counter() - self._began - self._paused

    @property
    def over(self) -> bool:
        """Whether the limit is reached."""
        return self.seconds >= self.limit

    def tell(self, share: float, loss: float) -> None:
        """Tell the listener, if there is one and it is due, that a `share` of the work is done."""
        if (listener := _listener.get()) is None:
            return
        (on_progress, every), seconds = listener, self.seconds
        if seconds >= self._told + every:
            self._told = seconds
            left = min(seconds * (1 / share - 1), max(0.0, self.limit - seconds))
            on_progress(Progress(share=share, seconds=seconds, remaining=left, loss=loss))

    def show(self, view_updates: int, volume: Callable[[], NDArray[np.float32]], *, whole: bool = True) -> None:
        """Show the watcher, if there is one and it is due, the volume [z, y, x]; else `volume` is not called.

        `whole` is False within an iteration: then only a time that has passed counts.
        """
        if self._watcher is None:
            return
        seconds = self.seconds
        if self._at is None:
            due = whole
        else:
            due = bool(self._at) and seconds >= self._at[0]
            self._at = [t for t in self._at if t > seconds]
        if due:
            import torch  # loaded by every method already

            self._watcher.on_update(view_updates, seconds, torch.from_numpy(volume()))
            self._paused += self.seconds - seconds
