"""Judge one row of the stress suite. It has a process of its own, so that a hang or a crash costs one row."""

import functools
from collections.abc import Callable

import numba

from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.studies.stress import Flags, kernels, methods
from ctsim.benchmarks.studies.stress.scans import Findings, carry_out
from ctsim.benchmarks.studies.stress.study import SIMULATOR, SPLAT_KERNELS, Judged, StressRow, catalogue

PROGRAMS: dict[tuple[str, str], Callable[[int, Findings], None]] = {
    ("flat-solids", SIMULATOR): kernels.flat_solids,
    ("float64", SIMULATOR): kernels.raytrace_in_float64,
    ("threads", SIMULATOR): kernels.counts_on_threads,
    ("needles", SPLAT_KERNELS): kernels.needles,
    ("sub-pixel", SPLAT_KERNELS): kernels.sub_pixel,
    ("behind-source", SPLAT_KERNELS): kernels.behind,
    ("outside", SPLAT_KERNELS): kernels.outside,
    ("empty-set", SPLAT_KERNELS): kernels.empty,
    ("nan-seed", SPLAT_KERNELS): kernels.not_finite,
    ("opaque", SPLAT_KERNELS): kernels.opaque,
    ("float64", SPLAT_KERNELS): kernels.splats_in_float64,
    ("threads", SPLAT_KERNELS): kernels.splats_on_threads,
    ("float64", "fdk"): methods.chain,
}
"""The functions that judge rows without a scene, by (case, subject)."""


def run(row: StressRow, side: int, found: Findings) -> None:
    """Judge a row on side³ voxels."""
    if row.method is None:
        if row.scene is None:
            PROGRAMS[row.case, row.subject](side, found)
        else:
            kernels.on_scene(row.scene, side, found)
    elif row.scene is None:
        methods.on_any_threads(*row.method, side, found)
    else:
        methods.on_scene(*row.method, row.scene, side, found)


def judge(task: Task, given: Flags) -> list[Judged]:
    """Judge a row on the task's number of threads."""
    numba.set_num_threads(task.hints["threads"])
    row = catalogue(given.suite, given.method)[task.case, task.subject]
    found, seconds = carry_out(functools.partial(run, row, task.settings["side"]))
    return [Judged(ok=not found.wrong, found=str(found), seconds={"row": (round(seconds, 3),)})]
