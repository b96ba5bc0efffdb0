"""Programs as methods: what they are told and not told, how they are started, and how their failures read."""

import dataclasses
import json
import os
import shlex
import subprocess
import sys
import time

import numpy as np
import pytest
import tifffile
import torch
from run_records import run_methods

from ctsim.benchmarks import methods, program
from ctsim.benchmarks.engine.host import peak_memory
from ctsim.benchmarks.studies.methods.attempt import attempt
from ctsim.dataset.store import open_scan
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.types import Scan

GEOMETRY = Geometry(
    dso=400.0,
    dsd=900.0,
    n_voxel=(5, 7, 11),
    d_voxel=(1.0, 2.0, 3.0),
    n_detector=(6, 8),
    d_detector=(1.5, 0.5),
    n_views=4,
    off_detector=(2.0, -3.0),
)
COUNTS = np.arange(4 * 6 * 8, dtype=np.uint16).reshape(4, 6, 8) + 7
SCAN = Scan(
    geometry=GEOMETRY,
    counts=torch.from_numpy(COUNTS),
    flat=torch.full((6, 8), 4e4),
    dark=3.0,
    name="hip",
)
WRITE = "import sys, numpy as np; np.save(sys.argv[2], np.full({shape}, 0.5, np.float32))"


def python(code, *more):
    """Return the method that runs a line of Python on {scan} and {out}.npy."""
    return methods.find(f"cmd:{shlex.join([sys.executable, '-c', code, '{scan}', '{out}.npy', *more])}")


def test_a_program_reads_the_scan_and_its_volume_comes_back():
    code = (
        "import sys, json, numpy as np, tifffile\n"
        "g = json.load(open(sys.argv[1] + '/scan.json'))\n"
        "v = np.zeros(g['geometry']['n_voxel'], np.float32)\n"
        "c = tifffile.imread(sys.argv[1] + '/counts.tif'); v[1, 2, 3] = c[1, 2, 3]; v[0, 0, 0] = c.sum()\n"
        "np.save(sys.argv[2], v)"
    )
    outcome = attempt(python(code), SCAN, 0.0)
    assert (outcome.status, outcome.reason) == ("ok", "")
    assert outcome.values[1, 2, 3] == COUNTS[1, 2, 3] and outcome.values[0, 0, 0] == COUNTS.sum()
    assert outcome.cost.wall > 0 and outcome.cost.cpu > 0 and outcome.cost.peak_bytes > 2**20
    assert outcome.cost.view_updates is None


def test_the_folder_holds_what_a_scanner_tells_and_nothing_else(tmp_path):
    program.write_scan(tmp_path, SCAN)
    assert {path.name for path in tmp_path.iterdir()} == {"counts.tif", "flat.tif", "scan.json"}
    assert json.loads((tmp_path / "scan.json").read_bytes()).keys() == {"name", "geometry", "dark", "i0", "e_max"}
    found = tifffile.imread(tmp_path / "counts.tif")
    assert found.dtype == np.uint16 and np.array_equal(found, COUNTS)


def test_only_a_program_that_names_the_mask_gets_it(tmp_path):
    metal = torch.zeros(GEOMETRY.n_voxel, dtype=torch.bool)
    metal[1, 2, 3] = True
    program.write_scan(tmp_path, dataclasses.replace(SCAN, metal=metal))
    found = tifffile.imread(tmp_path / "metal.tif")
    assert found.shape == GEOMETRY.n_voxel and found.sum() == found[1, 2, 3] == 1
    without, told = python("pass"), python("pass", "{mask}")
    assert (without.mask, without.inputs) == ("none", "counts only")
    assert (told.mask, told.inputs) == ("oracle", "metal mask")


def test_memory_is_that_of_the_program(tmp_path):
    """Not that of the process that started it, which Linux hands down."""
    np.save(tmp_path / "v.npy", np.ones((5, 7, 11), np.float32))
    copy = f"cp {tmp_path / 'v.npy'} $2.npy"
    small = attempt(methods.find(f"cmd:{shlex.join(['sh', '-c', copy, 'sh', '{scan}', '{out}'])}"), SCAN, 0.0)
    assert small.status == "ok" and 2**20 < small.cost.peak_bytes < 2**25 < peak_memory()
    large = attempt(python(f"import sys; b = b'x' * 2**27; {WRITE.format(shape=(5, 7, 11))}"), SCAN, 0.0)
    assert large.cost.peak_bytes > 2**27
    failing = attempt(python("import sys, time; b = b'x' * 2**27; time.sleep(0.3); sys.exit(1)"), SCAN, 0.0)
    assert failing.status == "error" and failing.cost.peak_bytes > 2**27 and failing.cost.wall > 0.3


def test_an_interruption_ends_the_program(tmp_path, monkeypatch):
    code = f"import os, time; open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(99)"

    def interrupted(process, timeout=None):
        while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
            time.sleep(0.01)
        monkeypatch.undo()
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess.Popen, "wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        attempt(python(code), SCAN, 0.0)
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


@pytest.mark.parametrize(
    ("code", "reason"),
    [
        ("import sys; print('one'); sys.exit('no licence')", "the program ended with exit code 1: no licence"),
        ("import os; os.kill(os.getpid(), 9)", "the program ended with signal SIGKILL"),
        ("pass", "the program wrote nothing at {out}"),
        (
            "import sys; open(sys.argv[2], 'w').write('x')",
            "the program wrote no volume: volume.npy is no TIFF stack or",
        ),
        (
            "import sys\nfor n in 'ab': open(sys.argv[2] + n + '.tif', 'w')",
            "the program wrote volume.npya.tif, volume.npyb.tif at {out}, expected one volume",
        ),
        (
            WRITE.format(shape=(11, 7, 5)),
            "the program wrote a volume of shape (11, 7, 5), expected (5, 7, 11) (z, y, x)",
        ),
    ],
)
def test_a_failure_is_one_sentence(code, reason):
    outcome = attempt(python(code), SCAN, 0.0)
    assert outcome.status == "error" and outcome.values is None and outcome.cost is not None
    assert outcome.reason.startswith(reason) and "\n" not in outcome.reason


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("no-such-program {scan} {out}", "there is no program 'no-such-program'"),
        ("ls {scan}", "expected {out} among its arguments"),
        ("ls {out}", "expected {scan} among its arguments"),
        ("ls {scan} {out} {msk}", "expected {mask}, got {msk}"),
        ("ls '{scan} {out}", "cannot be split into words"),
        ("", "expected {scan}"),
    ],
)
def test_a_command_that_cannot_run_is_refused_first(command, said):
    with pytest.raises(InputError, match=r"^--method cmd:") as caught:
        methods.find(f"cmd:{command}")
    assert said in str(caught.value)


def test_a_program_has_no_parameters():
    with pytest.raises(InputError, match="a program has no parameters"):
        methods.find(python("pass").name, {"window": "hann"})


def test_no_shell_reads_the_command():
    """Each word arrives as it stands."""
    told = "import sys; assert sys.argv[3:] == ['$(touch', 't);', '>', 'x*'], sys.argv"
    code = f"{told}; {WRITE.format(shape=(5, 7, 11))}"
    name = f"cmd:{shlex.join([sys.executable, '-c', code, '{scan}', '{out}.npy'])} $(touch t); > x*"
    assert attempt(methods.find(name), SCAN, 0.0).status == "ok"


def test_its_code_is_that_of_the_files_it_names(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text("pass")
    name = f"cmd:{sys.executable} {script} {{scan}} {{out}}"
    first = methods.find(name)
    assert methods.find(name, first.overrides) == first  # as a worker finds it
    script.write_text("pass  # another")
    assert methods.find(name).code != first.code
    assert first.label == name


@pytest.mark.slow
def test_a_program_is_run_scored_and_checked(smallest, tmp_path):
    """The reference itself is scored as such; turned, or in HU, it is an error that says so."""
    stored = open_scan(smallest / "smallest")
    np.save(tmp_path / "v.npy", stored.reference("effective"))
    code = "import sys, numpy as np; v = np.load(sys.argv[3]); np.save(sys.argv[2], eval(sys.argv[4]))"
    changes = ("v", "v[:, ::-1]", "v * 5e4 - 1000")
    chosen = [python(code, str(tmp_path / "v.npy"), change) for change in changes]
    right, turned, scaled = run_methods([stored], chosen, tmp_path, anchor=False)
    assert right.status == "ok" and right.scores["tissue"].identical and right.inputs == "counts only"
    assert right.cost.cpu > 0 and right.cost.warm_up == 0
    assert turned.status == "error" and turned.reason.startswith("the program's volume looks flipped along y")
    assert scaled.status == "error" and scaled.reason.startswith("the program's volume looks like HU")
    assert not turned.scores and turned.volume is None
