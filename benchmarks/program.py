"""A program of any language as a method: `--method "cmd:./mine {scan} {out}"`.

It gets a folder with what a scanner tells, and no truth: counts.tif [view, v, u] and flat.tif [v, u] as they are
stored, and scan.json. A program that names {mask} is told the metal, too: metal.tif [z, y, x], 1 in metal. The folder
is a copy, apart from the data. The words of the command are passed as they are; no shell reads them.
"""

import difflib
import hashlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tifffile
import torch

from ctsim.benchmarks.engine.host import Usage
from ctsim.benchmarks.engine.process import how_it_ended
from ctsim.errors import InputError
from ctsim.io.volumes.formats import FORMATS, open_volume
from ctsim.types import Scan, Volume

COMMAND, USAGE = "command", "usage"
SAID = "said"  # file of what a program prints
SCAN, OUT, MASK = "{scan}", "{out}", "{mask}"
NAMED = re.compile(r"\{[a-z_]+\}")  # what looks like one of them
LONGEST = 200  # characters of what a program says that a reason repeats
KNOWN = tuple(end for format in FORMATS.values() for end in format.suffixes)


class _Ended(msgspec.Struct, frozen=True):
    """What `launch` writes: the status of wait4, seconds, and bytes."""

    status: int
    wall: float
    cpu: float
    peak_bytes: int


class ProgramError(InputError):
    """A program gave no volume; the message is the whole reason, `usage` what it used until then."""

    usage: Usage | None = None


def words_of(command: str) -> list[str]:
    """Split a command into its words, by the rules of a shell for quotes and backslashes.

    Raises InputError for a command without {scan} or {out}, with a name in braces that is nearly one of ours, with
    open quotes, or with a program that is not there.
    """
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise InputError(f"--method cmd:{command}: cannot be split into words ({error})") from None
    for place, what in ((SCAN, "the scan's folder"), (OUT, "the volume to be written")):
        if not any(place in word for word in words[1:]):
            raise InputError(f"--method cmd:{command}: expected {place} among its arguments, which stands for {what}")
    for found in NAMED.findall(" ".join(words)):
        meant = difflib.get_close_matches(found, (SCAN, OUT, MASK), 1)
        if meant and meant[0] != found:
            raise InputError(f"--method cmd:{command}: expected {meant[0]}, got {found}")
    if shutil.which(words[0]) is None:
        raise InputError(f"--method cmd:{command}: there is no program {words[0]!r} that can be run")
    return words


def asks_for_mask(command: str) -> bool:
    """Whether a command names the metal mask."""
    return MASK in command


def code_of(command: str) -> str:
    """Hash the program and the files among its arguments; what they load in turn is not seen."""
    digest = hashlib.sha256()
    words = words_of(command)
    for path in (shutil.which(words[0]), *words[1:]):
        if path and os.path.isfile(path):
            with open(path, "rb") as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:16]


def reconstruct(scan: Scan, command: str, mask: str = "none") -> Volume:
    """Run the program on a copy of the scan and read the volume that it writes, in 1/mm on the scan's grid.

    The usage of the process and of its children is in the details, for the record's cost. Raises ProgramError where it
    ends with another exit code than 0, or does not write one volume of the grid's shape.
    """
    words = words_of(command)
    with tempfile.TemporaryDirectory(prefix="ctsim-") as folder:
        source, out = Path(folder) / "scan", Path(folder) / "out"
        source.mkdir()
        out.mkdir()
        write_scan(source, scan)
        places = {SCAN: str(source), OUT: str(out / "volume"), MASK: str(source / "metal.tif")}
        code, usage = _run([_filled(word, places) for word in words], Path(folder))
        try:
            if code:
                raise ProgramError(f"the program ended with {how_it_ended(code)}{_last_line(Path(folder) / SAID)}")
            values = _read(out, scan.geometry.n_voxel)
        except ProgramError as error:
            error.usage = usage
            raise
    return Volume(values=torch.from_numpy(values), details={USAGE: usage})


def write_scan(folder: Path, scan: Scan) -> None:
    """Write what a scanner tells of a scan: readings, open field, geometry, pedestal, photons and highest energy."""
    told = {
        "name": scan.name,
        "geometry": scan.geometry,
        "dark": scan.dark,
        "i0": scan.i0,
        "e_max": scan.e_max,
    }
    (folder / "scan.json").write_bytes(msgspec.json.format(msgspec.json.encode(told), indent=2))
    arrays: dict[str, Any] = {"counts": scan.counts, "flat": scan.flat}
    if scan.metal is not None:
        arrays["metal"] = (scan.metal != 0).to(torch.uint8)
    for name, values in arrays.items():
        tifffile.imwrite(folder / f"{name}.tif", values.numpy(), photometric="minisblack")


def _filled(word: str, places: dict[str, str]) -> str:
    for place, path in places.items():
        word = word.replace(place, path)
    return word


def _run(words: list[str], folder: Path) -> tuple[int, Usage]:
    """Run a program to its end; return its exit code and what it used. What it says is in the folder."""
    note = folder / "usage.json"
    launcher = [sys.executable, "-I", "-S", str(Path(__file__).with_name("launch.py")), str(note)]
    with (folder / SAID).open("wb") as file:
        process = subprocess.Popen([*launcher, *words], stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT)
        try:
            ended = process.wait()
        except BaseException:  # Ctrl-C
            process.terminate()
            process.wait()
            raise
    if not note.exists():  # there is no such program, or the launcher was killed
        return ended or 1, Usage()
    found = msgspec.json.decode(note.read_bytes(), type=_Ended)
    return os.waitstatus_to_exitcode(found.status), Usage(wall=found.wall, cpu=found.cpu, peak_bytes=found.peak_bytes)


def _last_line(said: Path) -> str:
    lines = said.read_bytes().decode(errors="replace").strip().splitlines()
    return f": {lines[-1].strip()[:LONGEST]}" if lines else ""


def _read(out: Path, shape: tuple[int, int, int]) -> np.ndarray:
    """Read the volume that a program left in a folder, float32 [z, y, x]."""
    there = sorted(out.iterdir())
    if not there:
        raise ProgramError("the program wrote nothing at {out}")
    named = [path for path in there if path.name.lower().endswith(KNOWN)]
    found = named or there
    if len(found) > 1:
        raise ProgramError(
            f"the program wrote {', '.join(path.name for path in found)} at {{out}}, expected one volume"
        )
    try:
        file = open_volume(found[0])
        values = file.values()
    except InputError as error:
        raise ProgramError("the program wrote no volume: " + str(error).replace(f"{out}/", "")) from None
    if values.shape != shape:
        raise ProgramError(f"the program wrote a volume of shape {values.shape}, expected {shape} (z, y, x)")
    if file.rescale is not None:
        values = values * np.float64(file.rescale[0]) + file.rescale[1]
    return np.ascontiguousarray(values, np.float32)
