"""The cases of `run-benchmark validate` by name; each returns its checks."""

import time
from collections.abc import Callable

import msgspec

from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.studies.validate import closed, paper, published, recovered, scatter, transport
from ctsim.benchmarks.studies.validate.finding import Check
from ctsim.benchmarks.studies.validate.study import Flags

CASES: dict[str, Callable[[bool], list[Check]]] = {
    "attenuation": published.attenuation,
    "absorption": published.absorption,
    "spectra": published.spectra,
    "energies": closed.energies,
    "chords": closed.chords,
    "primary": transport.primary,
    "noise": closed.noise,
    "tg195-1": published.layers,
    "tg195-2": transport.radiography,
    "tg195-4": transport.tomography,
    "lung-Fe": scatter.lung,
    "teeth-Ti": scatter.teeth,
    "head": scatter.head,
    "recovered": recovered.recovered,
    "paper": paper.paper,
}


def measure(task: Task, given: Flags) -> list[Check]:
    """Return the checks of a case; the first holds the seconds of all."""
    began = time.perf_counter()
    first, *others = CASES[task.case](task.part == "short")
    seconds = {"case": (time.perf_counter() - began,)}
    return [msgspec.structs.replace(first, seconds=seconds), *others]
