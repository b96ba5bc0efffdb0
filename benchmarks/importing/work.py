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
from ctsim.benchmarks.importing.readings import sound
from ctsim.benchmarks.importing.settle import Settled, settle
from ctsim.dataset.manifest import file_sha256, is_name
from ctsim.dataset.writer import SceneWriter, Stack, is_complete
from ctsim.errors import InputError
from ctsim.geometry import FARTHEST
from ctsim.io.scans.formats import open_scan
from ctsim.io.scans.scanfile import ScanFile, Stated
from ctsim.phantoms.dataset import spectrum_csv
from ctsim.scaninfo import ScanInfo
from ctsim.types import Scanner

SOURCE = "source.json"


class _Source(msgspec.Struct, frozen=True, kw_only=True):
    """What source.json holds: the name of the scan's header, the flags, and the SHA-256 of each file by its name."""

    scan: str
    flags: dict[str, Any]
    files: dict[str, str] = {}


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
    if not is_name(name):
        raise InputError(f"--name {name!r}: expected a plain folder name, of letters, digits and ._+-")
    digests = {path.relative_to(scan.path.parent).as_posix(): file_sha256(path) for path in scan.files}
    identity = _identity(scan, digests, given)
    if not given.force:
        _check_unchanged(given.out / name, digests)
    if not given.force and is_complete(given.out, name, identity):
        sys.stdout.write(f"{given.out / name}: already complete\n")
        return given.out / name
    scan = sound(scan)
    settled = settle(scan, given)
    folder = _write(scan, settled, name, identity, given, digests)
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


def _identity(scan: ScanFile, digests: dict[str, str], given: Flags) -> str:
    """Hash all bytes of the scan, and the flags that change what is written."""
    flags = [given.center, given.n_voxel, given.voxel, given.turn, given.kv, given.filter, given.i0, given.hold]
    return hashlib.sha256(repr((digests, scan.geometry, flags)).encode()).hexdigest()[:12]


def _check_unchanged(folder: Path, digests: dict[str, str]) -> None:
    """Name the file by which an import that is there differs; what else differs is refused as another scene."""
    try:
        known = msgspec.json.decode((folder / SOURCE).read_bytes(), type=_Source).files
    except (OSError, msgspec.DecodeError, UnicodeDecodeError):
        return
    changed = [name for name in sorted({*known, *digests}) if known.get(name) != digests.get(name)]
    if known and changed:
        raise InputError(
            f"{folder}: was imported from other data, for {changed[0]} has changed; "
            "import it under another --name, or replace it with --force"
        )


def _write(scan: ScanFile, settled: Settled, name: str, identity: str, given: Flags, digests: dict[str, str]) -> Path:
    """Write counts, open field, and what is known of both; held-out views apart."""
    geometry, kept, held = settled.geometry, settled.kept, settled.held
    pixel = geometry.d_detector
    stack = Stack(name="counts", shape=geometry.shape, dtype=settled.dtype, pixel=pixel)
    with SceneWriter(
        given.out, name, scene_id=identity, plan_hash=identity, stacks=(stack,), force=given.force
    ) as writer:
        if writer.first_view:
            sys.stderr.write(f"{name}: goes on from view {writer.first_view} of {len(kept)}\n")
        with Bar(len(kept), "view", writer.first_view) as bar:
            for view in bar.over(range(writer.first_view, len(kept)), name):
                writer.put(view, {"counts": settled.counts(scan, int(kept[view]))})
            bar.at(len(kept), name)
        writer.write_image("flat", settled.flat, pixel)
        if len(held):
            writer.write_image("held", np.stack([settled.counts(scan, int(k)) for k in held]), (1.0, *pixel))
        tube = settled.tube
        if tube is not None:
            writer.write_text("spectrum.csv", spectrum_csv(Scanner(geometry=geometry, tube=tube)))
        writer.write_text("scan.json", msgspec.json.format(msgspec.json.encode(_info(settled, tube)), indent=1) + b"\n")
        writer.write_text(SOURCE, _source(scan, given, digests))
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


def _source(scan: ScanFile, given: Flags, digests: dict[str, str]) -> bytes:
    """Return what was imported and how."""
    flags = {k: str(v) if isinstance(v, Path) else v for k, v in vars(given).items()}
    found = _Source(scan=scan.path.name, flags=flags, files=digests)
    return msgspec.json.format(msgspec.json.encode(found), indent=1) + b"\n"
