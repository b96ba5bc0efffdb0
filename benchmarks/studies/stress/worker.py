"""Carry out a row of the stress suite, in a process of its own: a hang or a crash costs one row."""

import functools
from collections.abc import Callable

import numba

from ctsim.benchmarks.engine.record import Task
from ctsim.benchmarks.studies.stress import Flags, methods, simulator, splats
from ctsim.benchmarks.studies.stress.scans import Findings, carry_out
from ctsim.benchmarks.studies.stress.study import SIMULATOR, SPLAT_KERNELS, Judged, StressRow, catalogue

PROGRAMS: dict[tuple[str, str], Callable[[int, Findings], None]] = {
    ("flat-solids", SIMULATOR): simulator.flat_solids,
    ("float64", SIMULATOR): simulator.beside_float64,
    ("threads", SIMULATOR): simulator.same_bits,
    ("needles", SPLAT_KERNELS): splats.needles,
    ("sub-pixel", SPLAT_KERNELS): splats.sub_pixel,
    ("behind-source", SPLAT_KERNELS): splats.behind,
    ("outside", SPLAT_KERNELS): splats.outside,
    ("empty-set", SPLAT_KERNELS): splats.empty,
    ("nan-seed", SPLAT_KERNELS): splats.not_finite,
    ("opaque", SPLAT_KERNELS): splats.opaque,
    ("float64", SPLAT_KERNELS): splats.beside_float64,
    ("threads", SPLAT_KERNELS): splats.same_bits,
    ("float64", "fdk"): methods.chain,
}
"""What judges the rows that are no scene, by (case, subject)."""


def run(row: StressRow, side: int, found: Findings) -> None:
    """Judge a row on side³ voxels."""
    if row.method is None:
        if row.scene is None:
            PROGRAMS[row.case, row.subject](side, found)
        else:
            simulator.on_scene(row.scene, side, found)
    elif row.scene is None:
        methods.on_any_threads(*row.method, side, found)
    else:
        methods.on_scene(*row.method, row.scene, side, found)


def judge(task: Task, given: Flags) -> list[Judged]:
    """Judge a row on as many threads as the task says."""
    numba.set_num_threads(task.hints["threads"])
    row = catalogue(given.suite, given.method)[task.case, task.subject]
    found, seconds = carry_out(functools.partial(run, row, task.settings["side"]))
    return [Judged(ok=not found.wrong, found=str(found), seconds={"row": (round(seconds, 3),)})]
