"""What `make-dataset import` does: read a scan's headers, settle what they leave open, and write a scene."""

import hashlib
import re
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import tyro

from ctsim.beam.spectrum import Tube
from ctsim.benchmarks.engine.terminal import Bar
from ctsim.benchmarks.importing import Flags
from ctsim.benchmarks.importing.settle import Settled, settle
from ctsim.dataset.writer import SceneWriter, Stack, is_complete
from ctsim.errors import InputError
from ctsim.geometry import FARTHEST
from ctsim.io.scans.formats import open_scan
from ctsim.io.scans.scanfile import ScanFile, Stated
from ctsim.phantoms.dataset import spectrum_csv
from ctsim.scaninfo import ScanInfo
from ctsim.types import Scanner


def main(argv: list[str]) -> int:
    """Run the command; return 0."""
    given: Any = tyro.cli(Flags, prog="make-dataset import", args=argv)
    bring(given)
    return 0


def bring(given: Flags) -> Path:
    """Write the scene and say what it is; return its folder.

    Raises InputError where the scan cannot be read, lacks what no flag gives, or another scene has its name.
    """
    scan = open_scan(given.scan, given.format, _stated(given))
    name = given.name or _name(given.scan)
    identity = _identity(scan, given)
    if not given.force and is_complete(given.out, name, identity):
        sys.stdout.write(f"{given.out / name}: already complete\n")
        return given.out / name
    settled = settle(scan, given)
    folder = _write(scan, settled, given, name, identity)
    sys.stdout.write(f"{folder}: {settled.text()}\n")
    for note in settled.notes:
        sys.stdout.write(f"  {note}\n")
    sys.stdout.write(f"Next: run-benchmark {given.out} results --method fdk --method nmar --method splat\n")
    return folder


def _stated(given: Flags) -> Stated:
    for name in ("dso", "dsd", "pixel"):
        value = getattr(given, name)
        if value is not None and not 0 < value < FARTHEST:
            raise InputError(f"--{name} must be within 0 to {FARTHEST:.0e} mm, got {value}")
    return Stated(dso=given.dso, dsd=given.dsd, pixel=given.pixel)


def _name(path: Path) -> str:
    stem = re.sub(r"[^A-Za-z0-9_.+-]+", "-", path.stem if path.is_file() else path.resolve().name)
    return stem.strip("-_.+")[:100] or "scan"


def _identity(scan: ScanFile, given: Flags) -> str:
    """Hash the scan's headers, its place, and the flags that change what is written."""
    header = scan.path.read_bytes() if scan.path.is_file() and scan.path.stat().st_size < 2**24 else b""
    flags = [given.center, given.n_voxel, given.voxel, given.turn, given.kv, given.filter, given.i0, given.hold]
    shown = repr((str(scan.path.resolve()), scan.geometry, flags)).encode()
    return hashlib.sha256(header + shown).hexdigest()[:12]


def _write(scan: ScanFile, settled: Settled, given: Flags, name: str, identity: str) -> Path:
    """Write counts, open field, and what is known of both; held-out views apart."""
    geometry, kept, held = settled.geometry, settled.kept, settled.held
    pixel = geometry.d_detector
    stack = Stack(name="counts", shape=geometry.shape, dtype=settled.dtype, pixel=pixel)
    with SceneWriter(
        given.out, name, scene_id=identity, plan_hash=identity, stacks=(stack,), force=given.force
    ) as writer:
        with Bar(len(kept), "view") as bar:
            bar.at(writer.first_view, name)
            for view in bar.over(range(writer.first_view, len(kept)), name):
                writer.put(view, {"counts": settled.counts(scan, int(kept[view]))})
        writer.write_image("flat", settled.flat, pixel)
        if len(held):
            writer.write_image("held", np.stack([settled.counts(scan, int(k)) for k in held]), (1.0, *pixel))
        tube = settled.tube
        if tube is not None:
            writer.write_text("spectrum.csv", spectrum_csv(Scanner(geometry=geometry, tube=tube)))
        writer.write_text("scan.json", msgspec.json.format(msgspec.json.encode(_info(settled, tube)), indent=1) + b"\n")
        writer.write_text("source.json", _source(scan, given))
        return writer.finish()


def _info(settled: Settled, tube: Tube | None) -> ScanInfo:
    return ScanInfo(
        geometry=settled.geometry,
        dark=settled.dark,
        i0=settled.i0,
        e_max=tube.kvp if tube else settled.kvp,
        l0=settled.l0,
        gain=settled.level,
        held=settled.held_geometry,
        notes=settled.notes,
    )


def _source(scan: ScanFile, given: Flags) -> bytes:
    """Return what was imported and how, for a reader."""
    flags = {k: str(v) if isinstance(v, Path) else v for k, v in vars(given).items()}
    return msgspec.json.format(msgspec.json.encode({"scan": scan.path.name, "flags": flags}), indent=1) + b"\n"
