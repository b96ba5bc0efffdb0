"""Damaged and hostile scans: one sentence each, no file outside of the folder, no memory that the file does not pay.

Every reader gets 500 files: bytes flipped, cut short, shifted, and numbers of the header replaced.
"""

import re
import sys
import tracemalloc

import msgspec
import numpy as np
import pytest
import scan_files
import test_ct_damage
from closed_scans import GEOMETRY, counts_of, line_integrals
from test_ct_damage import FILES, ROOM, damaged

from ctsim.benchmarks import cli
from ctsim.errors import InputError
from ctsim.io.scans import formats as scans

FEW = msgspec.structs.replace(GEOMETRY, n_views=4)
P = line_integrals(FEW)
COUNTS = counts_of(P)
IMAGES = np.full((1, 32, 40), 40000, np.uint16)


def whole(folder, kind):
    """Write an undamaged scan; return it, the file to be damaged, and how much of that is a header."""
    if kind in ("log", "shifts", "image"):
        log = scan_files.skyscan(folder, COUNTS, FEW)
        scan_files.shifts(log, np.zeros((4, 2)))
        victim = {"log": log, "shifts": folder / "rods_TS.csv", "image": folder / "rods00000000.tif"}[kind]
        return log, victim, 300 if kind == "image" else 2000
    if kind in ("dxchange", "nxtomo"):
        path = getattr(scan_files, kind)(folder / "rods.h5", COUNTS, FEW, IMAGES, IMAGES // 400)
        return path, path, 4000
    if kind == "geom":
        path = scan_files.walnut(folder, COUNTS, FEW.pose_array(), IMAGES, IMAGES // 400)
        return path, path, 4000
    if kind == "pickle":
        path = scan_files.naf(folder / "rods.pickle", P, FEW)
        return path, path, 1500
    r2 = scan_files.r2(folder, P, FEW)
    return r2, r2 / ("meta_data.json" if kind == "json" else "proj_train/proj_train_0000.npy"), 3000


def read(path) -> str:
    """Read a scan and its first view; return what is wrong with it, empty if nothing is."""
    try:
        scan = scans.open_scan(path)
        image = scan.read(0)
        if scan.flat is not None:
            assert scan.flat.shape == image.shape
    except InputError as error:
        return str(error)
    assert image.shape == scan.geometry.n_detector and image.dtype.kind in "uif"
    return ""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["log", "shifts", "image", "dxchange", "nxtomo", "geom", "pickle", "json", "npy"])
def test_a_damaged_scan_is_read_or_refused_in_one_sentence(tmp_path, capfd, kind):
    folder = tmp_path / "scan"
    folder.mkdir()
    path, victim, header = whole(folder, kind)
    assert read(path) == ""
    data, rng, said = victim.read_bytes(), np.random.default_rng(21), set()
    tracemalloc.start()
    try:
        for number in range(FILES):
            victim.write_bytes(damaged(data, rng, header))
            test_ct_damage.opened = []
            tracemalloc.reset_peak()
            sentence = read(path)
            assert tracemalloc.get_traced_memory()[1] < ROOM, (number, sentence)
            assert sentence.isprintable() and len(sentence) < 700, (number, sentence)
            assert not sentence or sentence.startswith(str(folder)), sentence
            names = [p for p in test_ct_damage.opened if not p.endswith((".py", ".pyc"))]
            assert not [p for p in names if not p.startswith(str(folder))], (number, names)
            said.add(re.sub(r"[-\d.]+", "0", sentence.replace(str(tmp_path), ""))[:80])
    finally:
        test_ct_damage.opened = None
        tracemalloc.stop()
    assert len(said) > 1  # some were read, some refused
    assert capfd.readouterr() == ("", "")


def test_the_command_ends_with_2(tmp_path, capsys, monkeypatch):
    log = scan_files.skyscan(tmp_path / "scan", COUNTS, FEW, dso=float("nan"))
    monkeypatch.setattr(sys, "argv", ["make-dataset", "import", str(log), str(tmp_path / "data")])
    assert cli.make_dataset() == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "expected a finite number" in said
    assert not (tmp_path / "data").exists()
