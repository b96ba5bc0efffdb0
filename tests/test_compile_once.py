"""Kernels are compiled once, and a command says so while it compiles."""

from pathlib import Path

import numpy as np
import pytest
from numba import njit, prange
from numba.core.errors import TypingError
from numba.core.event import end_event, start_event
from test_simulate import EVERYTHING, phantom, run, scanner

from ctsim.benchmarks.engine import terminal
from ctsim.kernels.once import compiled_once
from ctsim.tracer.kernels import raytrace_cpu


def specialisations(name):
    kernel = getattr(raytrace_cpu, name)
    return getattr(kernel, "compiled", kernel).signatures


@pytest.mark.parametrize("name", ["_corners", "_centres", "measure_edges", "_measure_strip"])
def test_a_scan_with_its_twin_and_path_lengths_needs_one_specialisation(name):
    plan, _ = run(phantom(), scanner(), truth=EVERYTHING)
    assert any(o.name == "metal_free/counts" for o in plan.outputs)
    assert len(specialisations(name)) == 1


@pytest.mark.parametrize("name", ["_measure_strips", "_replace_rows"])
def test_no_parallel_loop_holds_the_code_of_rows(name):
    run(phantom(), scanner(), truth=EVERYTHING)
    cached = Path(getattr(raytrace_cpu, name).stats.cache_path).glob(f"raytrace_cpu.{name}-*.nbc")
    code = max(cached, key=lambda path: path.stat().st_mtime).read_bytes()
    assert name.encode() in code
    for inner in (b"walk", b"measure_edges", b"_intersect_near"):
        assert inner not in code


@compiled_once("int64", "float64[:,:]", "float64[:]")
def _total(i, values, out):
    if values[i, 0] < 0:
        raise ValueError("negative")
    for value in values[i]:
        out[i] += value


@njit(parallel=True)
def _totals(total, values, out):
    for i in prange(out.size):
        _total(total, i, values, out)


@njit
def _one(total, i, values, out):
    _total(total, i, values, out)


def test_a_function_called_by_address_has_one_specialisation_for_all_layouts():
    values = np.arange(12.0).reshape(3, 4)
    for given in (values, np.asfortranarray(values), np.repeat(values, 2, 1)[:, ::2]):
        out = np.zeros(3)
        _totals(_total.address(), given, out)
        assert np.array_equal(out, values.sum(1))
    assert len(_total.compiled.signatures) == 1


def test_a_function_called_by_address_passes_its_exception_on():
    with pytest.raises(ValueError, match="negative"):
        _one(_total.address(), 0, np.full((1, 2), -1.0), np.zeros(1))


def test_other_types_are_refused_while_compiling():
    with pytest.raises(TypingError, match="_total takes"):
        _one(_total.address(), 0, np.zeros((1, 2), np.complex128), np.zeros(1))


def test_compiling_is_announced_once_and_only_where_it_takes_long(monkeypatch):
    now, said = [0.0], []
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])

    def compile_for(seconds, within=0.0):
        start_event("numba:compile")
        if within:
            compile_for(within)
        now[0] += seconds
        end_event("numba:compile")

    with terminal.announced(said.append):
        for _ in range(4):
            compile_for(0.2)
            now[0] += 100.0  # of other work
        assert said == []
        compile_for(0.1, within=0.2)
        assert said == [terminal.COMPILING]
        compile_for(10.0, within=10.0)
    compile_for(10.0)
    assert said == [terminal.COMPILING]
