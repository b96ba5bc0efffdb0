"""A run has its own view of the data and leaves the process as it was; whatever a method does is on its record."""

import contextlib
import gc
import os
import random
import signal
import sys
import warnings
from collections.abc import Iterator

import numba
import numpy as np
import pytest
import torch
from run_records import run_methods
from test_run import GEOMETRY, double

from ctsim.benchmarks import methods
from ctsim.benchmarks.studies.methods.attempt import restored
from ctsim.benchmarks.studies.methods.volumes import read_volume
from ctsim.dataset.store import list_scans, open_scan
from ctsim.types import Volume

HERE = sys.modules[__name__]


def mean(scan, *, device):
    """A volume of the mean count, which is another one where somebody wrote into the counts."""
    return Volume(values=torch.full(scan.geometry.n_voxel, 1e-6 * float(scan.counts.float().mean())))


def scribble(scan, *, device, into="counts"):
    found = mean(scan, device=device)
    for name in into.split(","):
        if name == "resized":
            scan.counts.resize_(1)
        elif name == "dark":
            object.__setattr__(scan, "dark", scan.dark + 1)
        elif getattr(scan, name) is not None:
            getattr(scan, name).zero_()
    return found


def half_way(scan, *, device):
    scan.counts.zero_()
    raise RuntimeError("gave up")


def leave(scan, *, device):
    sys.exit(3)


def leave_while_warming_up(scan, *, device):
    if scan.geometry.n_voxel[0] < 10:  # the tiny scan's 8 slices
        sys.exit("too small")
    return mean(scan, device=device)


def interrupt(scan, *, device):
    raise KeyboardInterrupt


def an_array(scan, *, device):
    return np.zeros(scan.geometry.n_voxel, np.float32)


def nothing(scan, *, device):
    return None


def array_values(scan, *, device):
    return Volume(values=np.zeros(scan.geometry.n_voxel, np.float32))


def complex_values(scan, *, device):
    return Volume(values=torch.zeros(scan.geometry.n_voxel, dtype=torch.complex64))


def fine(scan, *, device):
    return Volume(values=torch.zeros(scan.geometry.n_voxel), status="fine")


BUFFER = torch.zeros(GEOMETRY.n_voxel)


def into_one_buffer(scan, *, device):
    """Return the same tensor each time."""
    return Volume(values=BUFFER.fill_(0.01 if scan.counts[0, 0, 0] == 900 else 0.03))


def run_all(stored, results, *names, **options):
    """Run methods of this module one after another; return their records of the scan itself."""
    found = [methods.find(f"test_own_view:{name}" if isinstance(name, str) else name) for name in names]
    return run_methods([stored], found, results, **{"anchor": False, **options})


@pytest.fixture
def stored(smallest):
    return open_scan(list_scans(smallest)[0])


@pytest.mark.slow
@pytest.mark.parametrize("isolate", [False, True])
def test_what_a_method_writes_into_its_scan_is_its_error_and_no_others(stored, tmp_path, isolate):
    (alone,) = run_all(stored, tmp_path / "alone", "mean")
    scribbler, after = run_all(stored, tmp_path / "after", "scribble", "mean", isolate=isolate)
    assert after.status == "ok" and after.scores == alone.scores
    assert scribbler.status == "error" and "changed its input (counts)" in scribbler.reason
    assert scribbler.scores == {} and scribbler.volume is None


@pytest.mark.parametrize("into", ["flat", "metal", "resized", "dark", "counts,flat"])
def test_a_change_of_any_part_of_the_scan_is_found(stored, tmp_path, into, monkeypatch):
    monkeypatch.setattr(HERE, "mask", "oracle", raising=False)
    method = methods.find("test_own_view:scribble", {"into": into})
    object.__setattr__(method, "params", {**method.params, "mask": "oracle"})
    (record,) = run_methods([stored], [method], tmp_path, anchor=False, keep_volumes=False)
    part = {"resized": "counts", "counts,flat": "counts, flat"}.get(into, into)
    assert (record.status, f"changed its input ({part})" in record.reason) == ("error", True), record.reason


def test_a_failure_keeps_its_own_reason_beside_the_change(stored, tmp_path):
    (record,) = run_all(stored, tmp_path, "half_way")
    assert record.status == "error"
    assert record.reason.startswith("RuntimeError: gave up") and "changed its input (counts)" in record.reason


def test_nan_in_the_counts_is_no_change():
    from ctsim.types import Scan

    counts = torch.full(GEOMETRY.shape, float("nan"))
    counts[0] = 3.0
    scan = Scan(geometry=GEOMETRY, counts=counts, flat=torch.full(GEOMETRY.n_detector, 9.0))
    from ctsim.benchmarks.studies.methods.attempt import changed

    assert changed(scan, Scan(geometry=GEOMETRY, counts=counts.clone(), flat=scan.flat.clone())) == []


def test_the_volume_of_the_twin_is_not_the_next_runs(tmp_path):
    from test_twins import pair

    twin, scan = run_all(pair(tmp_path), tmp_path, "into_one_buffer", anchor=True)
    assert read_volume(tmp_path / twin.volume).max() == np.float32(0.01)
    assert scan.scores["artefact"].values["rmse"] > 0  # the difference of 0.02 1/mm, and not of a volume with itself


def test_an_exit_is_that_runs_error_and_the_next_goes_on(stored, tmp_path):
    left, warmed, after = run_all(stored, tmp_path, "leave", "leave_while_warming_up", "mean")
    assert left.status == "error" and "exit" in left.reason and "3" in left.reason
    assert (warmed.status, after.status) == ("ok", "ok")


def test_skip_may_not_end_the_benchmark_either(stored, tmp_path, monkeypatch):
    monkeypatch.setattr(HERE, "skip", lambda scan: sys.exit(4), raising=False)
    (record,) = run_all(stored, tmp_path, "mean")
    assert record.status == "error" and "skip() failed" in record.reason and "4" in record.reason


def test_ctrl_c_still_interrupts(stored, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run_all(stored, tmp_path, "interrupt")


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("an_array", "the method returned a numpy.ndarray, expected a ctsim.types.Volume"),
        ("nothing", "the method returned a NoneType, expected a ctsim.types.Volume"),
        ("array_values", "Volume.values must be a torch.Tensor, got a numpy.ndarray"),
        ("complex_values", "Volume.values must be real numbers, got torch.complex64"),
        ("fine", "Volume.status must be one of ok, skipped,"),
    ],
)
def test_what_is_no_volume_is_one_sentence(stored, tmp_path, name, reason):
    (record,) = run_all(stored, tmp_path, name)
    assert record.status == "error" and record.reason.startswith(reason), record.reason


# --- the process is left as it was -------------------------------------------------------------------


def spoil(scan, *, device):
    """Change whatever a process shares."""
    numba.set_num_threads(1)
    torch.set_num_threads(max(1, torch.get_num_threads() - 1))
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    torch.set_grad_enabled(False)
    torch.use_deterministic_algorithms(True)
    os.chdir("/")
    os.environ["CTSIM_TEST_SPOILED"] = "1"
    os.environ.pop("CTSIM_TEST_KEPT", None)
    os.environ["CTSIM_TEST_SET"] = "another"
    np.seterr(all="ignore")
    warnings.simplefilter("ignore")
    random.seed(1)
    np.random.seed(1)  # noqa: NPY002 the global state is what is meant
    torch.manual_seed(1)
    sys.setrecursionlimit(321 + sys.getrecursionlimit())
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    gc.disable()
    sys.stdout = sys.stderr
    return Volume(values=torch.zeros(scan.geometry.n_voxel, dtype=torch.float32, device="cpu"))


def spoil_and_fail(scan, *, device):
    spoil(scan, device=device)
    raise SystemExit


def state() -> dict[str, object]:
    """Say what a process is like, by calls of this test's own."""
    return {
        "numba": numba.get_num_threads(),
        "torch": torch.get_num_threads(),
        "dtype": torch.tensor(1.5).dtype,
        "device": torch.ones(1).device.type,
        "grad": torch.is_grad_enabled(),
        "deterministic": torch.are_deterministic_algorithms_enabled(),
        "folder": os.getcwd(),
        "environment": dict(os.environ),
        "errors": np.geterr(),
        "filters": list(warnings.filters),
        "python": random.getstate(),
        "numpy": np.random.get_state()[1].tobytes(),  # noqa: NPY002
        "generator": torch.get_rng_state().numpy().tobytes(),
        "recursion": sys.getrecursionlimit(),
        "ctrl-c": signal.getsignal(signal.SIGINT),
        "gc": gc.isenabled(),
        "stdout": sys.stdout,
    }


@contextlib.contextmanager
def clean() -> Iterator[None]:
    """Put back what this test looks at, by other means than the product's, so that a failure spoils no other test."""
    before, stdout, numbers = state(), sys.stdout, (np.random.get_state(), torch.get_rng_state())  # noqa: NPY002
    errors = np.geterr()
    with warnings.catch_warnings():
        try:
            yield
        finally:
            numba.set_num_threads(before["numba"])
            torch.set_num_threads(before["torch"])
            torch.set_default_dtype(before["dtype"])
            torch.set_default_device(None)
            torch.set_grad_enabled(before["grad"])
            torch.use_deterministic_algorithms(before["deterministic"])
            os.chdir(before["folder"])
            os.environ.clear()
            os.environ.update(before["environment"])
            np.seterr(**errors)
            random.setstate(before["python"])
            np.random.set_state(numbers[0])  # noqa: NPY002
            torch.set_rng_state(numbers[1])
            sys.setrecursionlimit(before["recursion"])
            signal.signal(signal.SIGINT, before["ctrl-c"])
            gc.enable()
            sys.stdout = stdout


@pytest.mark.parametrize("name", ["spoil", "spoil_and_fail"])
def test_a_run_leaves_the_process_as_it_was(tmp_path, monkeypatch, name):
    monkeypatch.setenv("CTSIM_TEST_KEPT", "1")
    monkeypatch.setenv("CTSIM_TEST_SET", "1")
    with clean():
        before = state()
        (record,) = run_all(double(tmp_path), tmp_path, name)
        after = state()
    assert {key for key in before if before[key] != after[key]} == set()
    assert record.status == ("ok" if name == "spoil" else "error")


def test_what_happens_beside_a_run_is_left_alone():
    with clean():
        with restored():
            pass
        os.environ["CTSIM_TEST_LATER"] = "1"
        with restored():
            os.environ["CTSIM_TEST_LATER"] = "2"
        assert os.environ["CTSIM_TEST_LATER"] == "1"
