"""An import that is there stays where its data are the same to the byte, and is refused by the changed file's name."""

import os
import shutil

import msgspec
import numpy as np
import pytest
import scan_files
from closed_scans import GEOMETRY, counts_of, line_integrals

from ctsim.benchmarks.importing import Flags
from ctsim.benchmarks.importing.work import bring
from ctsim.errors import InputError

FEW = msgspec.structs.replace(GEOMETRY, n_views=6)
P = line_integrals(FEW)
COUNTS = counts_of(P)
IMAGE = np.full((1, 32, 40), 40000, np.uint16)


def skyscan(folder):
    log = scan_files.skyscan(folder, COUNTS, FEW)
    scan_files.shifts(log, np.zeros((6, 2)))
    return log


def hdf5(folder):
    folder.mkdir()
    return scan_files.dxchange(folder / "scan.h5", COUNTS, FEW, IMAGE, IMAGE // 100)


SOURCES = {
    "rods00000003.tif": skyscan,
    "rods_TS.csv": skyscan,
    "rods.log": skyscan,
    "proj_train/proj_train_0002.npy": lambda folder: scan_files.r2(folder, P, FEW),
    "scan_000004.tif": lambda folder: scan_files.walnut(folder, COUNTS, FEW.pose_array(), IMAGE, IMAGE // 100),
    "io000000.tif": lambda folder: scan_files.walnut(folder, COUNTS, FEW.pose_array(), IMAGE, IMAGE // 100),
    "scan.h5": hdf5,
}


def change(path):
    """Change one value and nothing that a folder shows: neither size nor time."""
    before, data = path.stat(), bytearray(path.read_bytes())
    at = (
        data.rindex(b"0.000000") + 2
        if path.suffix == ".csv"
        else data.find(b"kV)=  90") + 6
        if path.suffix == ".log"
        else len(data) - 3
    )
    data[at] = ord("8") if path.suffix in (".csv", ".log") else data[at] ^ 1
    path.write_bytes(data)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.parametrize("changed", SOURCES)
def test_changed_data_are_no_finished_import(tmp_path, capsys, changed):
    source = SOURCES[changed](tmp_path / "scan")
    flags = Flags(scan=source, out=tmp_path / "data", center="file", hold=0, name="one")
    folder = bring(flags)
    made = (folder / "manifest.json").read_bytes()
    shutil.copytree(tmp_path / "scan", tmp_path / "copy")
    bring(Flags(**{**vars(flags), "scan": tmp_path / "copy" / source.relative_to(tmp_path / "scan")}))
    assert "already complete" in capsys.readouterr().out  # the same bytes in another place, at another time
    change(tmp_path / "scan" / changed)
    with pytest.raises(InputError, match=rf"one: was imported .* {changed} has changed.*--force"):
        bring(flags)
    assert (folder / "manifest.json").read_bytes() == made
    bring(Flags(**{**vars(flags), "force": True}))
    assert (folder / "manifest.json").read_bytes() != made


def test_other_flags_are_another_scene(tmp_path):
    flags = Flags(scan=skyscan(tmp_path / "scan"), out=tmp_path / "data", center="file", hold=0)
    bring(flags)
    with pytest.raises(InputError, match="holds another scene"):
        bring(Flags(**{**vars(flags), "i0": 5e4}))
