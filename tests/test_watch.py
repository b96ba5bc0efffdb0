"""Looking on while a method works: at every iteration, at chosen times, and without cost to the method's own clock."""

import time

import numpy as np
import pytest
import torch

from ctsim.reconstruct import watch as module
from ctsim.reconstruct.watch import Progress, Stopwatch, listen, watch


class Clock:
    """A clock that the test turns."""

    def __init__(self) -> None:
        self.now = 100.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    return clock


def iterate(clock, stopwatch, n, seconds=1.0, per_pass=1):
    """Iterations that take a second each; the volume holds the iteration's number."""
    for k in range(1, n + 1):
        clock.now += seconds
        stopwatch.show(k, lambda k=k: np.full((1, 1, 1), k, np.float32), whole=k % per_pass == 0)


def test_each_iteration_is_shown_and_watching_takes_no_time(clock):
    seen = []

    def look(updates: int, seconds: float, volume: torch.Tensor) -> None:
        seen.append((updates, seconds, float(volume)))
        clock.now += 50  # not the method's

    with watch(look):
        stopwatch = Stopwatch()
        iterate(clock, stopwatch, 3)
    assert seen == [(1, 1.0, 1.0), (2, 2.0, 2.0), (3, 3.0, 3.0)]
    assert stopwatch.seconds == 3.0


def test_times_are_met_by_the_first_iteration_after_them_and_once(clock):
    seen = []
    with watch(lambda updates, seconds, volume: seen.append((updates, seconds)), at=[4.5, 0.0, 1.5, 1.7, 99.0]):
        iterate(clock, Stopwatch(), 6, per_pass=100)
        iterate(clock, Stopwatch(), 2)  # another run has all the times before it again
    assert seen == [(1, 1.0), (2, 2.0), (5, 5.0), (1, 1.0), (2, 2.0)]


def test_a_run_that_goes_on_has_the_times_behind_it(clock):
    seen = []
    with watch(lambda updates, seconds, volume: seen.append(seconds), at=[1.0, 11.5]):
        stopwatch = Stopwatch()
        stopwatch.resume(10.0)
        iterate(clock, stopwatch, 3)
    assert seen == [12.0] and stopwatch.seconds == 13.0 and stopwatch.details() == {"earlier_seconds": 10.0}


def test_without_times_only_whole_iterations_are_shown(clock):
    seen = []
    with watch(lambda updates, seconds, volume: seen.append(updates)):
        iterate(clock, Stopwatch(), 9, per_pass=4)
    assert seen == [4, 8]


def test_nobody_looking_costs_no_volume():
    def volume() -> np.ndarray:
        raise AssertionError("made for nobody")

    with watch(lambda *_: None, at=[1e9]):
        Stopwatch().show(1, volume)
    stopwatch, began = Stopwatch(), time.perf_counter()
    stopwatch.show(1, volume)
    assert 0 <= stopwatch.seconds <= time.perf_counter() - began + 1


def test_a_listener_hears_every_so_often_and_what_is_left(clock):
    heard: list[Progress] = []
    with listen(heard.append, every=2.0):
        stopwatch = Stopwatch(limit=6.0)
        for k in range(1, 6):
            clock.now += 1
            stopwatch.tell(k / 20, 1.0 / k)
    assert [p.seconds for p in heard] == [1, 3, 5]
    assert [p.share for p in heard] == [1 / 20, 3 / 20, 5 / 20] and [p.loss for p in heard] == [1, 1 / 3, 1 / 5]
    assert [p.remaining for p in heard] == [5, 3, 1]  # the limit comes before the end of the work
    stopwatch.tell(0.5, 0.0)
    assert len(heard) == 3 and not stopwatch.over
    clock.now += 1
    assert stopwatch.over
