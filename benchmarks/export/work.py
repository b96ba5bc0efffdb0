"""What `make-dataset export` does: write a scan for a library, or a volume [z, y, x] on its grid, in HU where asked."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from numpy.typing import NDArray

from ctsim.benchmarks.export import Flags
from ctsim.benchmarks.export.scans import LAYOUTS, Measured, write_scan
from ctsim.benchmarks.scores.artefact import effective_attenuation
from ctsim.dataset.arrayfile import read_array
from ctsim.dataset.manifest import MANIFEST
from ctsim.dataset.store import StoredScan, open_scan
from ctsim.errors import InputError
from ctsim.io.extra import load
from ctsim.io.volumes.formats import FORMATS
from ctsim.io.volumes.placed import Placed
from ctsim.materials import attenuation
from ctsim.reconstruct.log import line_integrals
from ctsim.scaninfo import TWIN

REFERENCE_50KEV = "reference_50kev"


def main(argv: list[str]) -> int:
    """Run the command; return 0."""
    given: Any = tyro.cli(Flags, prog="make-dataset export", args=argv)
    export(given)
    return 0


def export(given: Flags) -> None:
    """Write the scan or the volume that the flags ask for, and say what was written.

    Raises InputError where the scan or the volume cannot be read or has no HU, and where OUT is there or is named as
    another format.
    """
    _check_out(given.out, given.to)
    if given.kev is not None and not given.hu and given.to in FORMATS and given.to != "dicom":
        raise InputError("--kev says at which energy water is 0 HU: expected --hu with it")
    if given.scan.name == TWIN.rstrip("/") and (given.scan.parent / MANIFEST).is_file():
        how = "with --twin" if given.to in LAYOUTS else f"with --volume {TWIN}NAME"
        raise InputError(f"SCAN: {given.scan} is the twin of {given.scan.parent}: expected that one, {how}")
    stored = open_scan(given.scan)
    if given.to in LAYOUTS:
        _export_scan(given, stored)
        return
    if given.twin:
        raise InputError(f"--twin goes with the layouts of scans: a volume of the twin is --volume {TWIN}NAME")
    values = _volume(stored, given.volume)
    unit = "1/mm" if values.dtype.kind == "f" else str(values.dtype)
    if given.hu or given.to == "dicom":
        values, unit = _in_hu(stored, values, given), "HU"
    grid = stored.geometry
    writer = load(FORMATS[given.to].writer, given.out)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    writer.write_volume(
        given.out,
        Placed(
            values=values,
            spacing=grid.d_voxel,
            centre=grid.off_origin,
            subject=stored.name,
            study=stored.content_hash,
        ),
    )
    shape, size = (" × ".join(f"{v:g}" for v in given) for given in (values.shape, grid.d_voxel))
    sys.stdout.write(f"{given.out}: {shape} voxels of {size} mm (z × y × x) in {unit}\n")


def _export_scan(given: Flags, stored: StoredScan) -> None:
    plain = Flags(scan=given.scan, out=given.out, to=given.to, twin=given.twin)
    if given != plain:
        raise InputError(f"--to {given.to} writes the scan: expected neither --volume, --hu nor --kev")
    if given.twin:
        if stored.metal_free is None:
            raise InputError(f"--twin: the scan {stored.name!r} has no metal-free twin")
        stored = stored.metal_free
    scan = stored.scan
    p, _ = line_integrals(scan, slice(None))
    truth = LAYOUTS[given.to].truth and f"{stored.prefix}reference_effective.tif" in stored.files
    content = Measured(
        geometry=stored.geometry,
        p=p.numpy(),
        reference=np.asarray(stored.reference("effective"), np.float32) if truth else None,
        counts=scan.counts.numpy(),
        flat=scan.flat.numpy(),
        dark=scan.dark,
    )
    write_scan(given.out, given.to, content)
    shape, what = " × ".join(str(n) for n in stored.geometry.shape), LAYOUTS[given.to].content
    sys.stdout.write(f"{given.out}: {shape} {what} (view × v × u) for {given.to}\n")
    grid = stored.geometry
    if LAYOUTS[given.to].axis_told and grid.off_detector[1]:
        axis = -grid.off_detector[1] / grid.d_detector[1]
        sys.stdout.write(
            f"The format does not say where the axis is: {axis:+.4g} columns from the detector's middle. "
            f"make-dataset import needs --center {axis:.4g}, or --center auto\n"
        )


def _check_out(out: Path, to: str) -> None:
    if out.exists():
        raise InputError(f"OUT: {out} is there already, expected a new name")
    ends = (LAYOUTS[to].file,) if to in LAYOUTS else FORMATS[to].ends
    if not out.name.endswith(ends):
        raise InputError(f"OUT: {out} is to be {to}, expected a name that ends in {' or '.join(ends)}")
    if to == "dicom" and out.suffix in (".dcm", ".nii", ".mha"):
        raise InputError(f"OUT: {out} will be a folder of slices, expected a name without {out.suffix}")


def _volume(stored: StoredScan, name: str) -> NDArray[Any]:
    """Return a volume of the scan by its name, or that of a file."""
    shape = stored.geometry.n_voxel
    if f"{name}.tif" in stored.files:
        values = stored.array(name)
        if values.shape != shape:
            raise InputError(f"--volume: {name} has shape {values.shape}, expected a volume on the grid {shape}")
    elif Path(name).exists():
        values = read_array(Path(name), shape)
    else:
        known = ", ".join(
            sorted(file.removesuffix(".tif") for file, entry in stored.files.items() if entry.shape == shape)
        )
        if not known:
            raise InputError(f"--volume: {name} is no file, and a measured scan has no true volume: expected a file")
        raise InputError(f"--volume: {name} is no file and none of {known}")
    return values.astype(np.float32) if values.dtype.kind == "f" else values


def _in_hu(stored: StoredScan, values: NDArray[Any], given: Flags) -> NDArray[np.float32]:
    """Return 1000·(μ/μ_water − 1)."""
    if values.dtype.kind != "f":
        raise InputError(f"--volume: {given.volume} holds {values.dtype}, which is no attenuation and has no HU")
    kev = 50.0 if given.kev is None and given.volume.endswith(REFERENCE_50KEV) else given.kev
    if kev is None:
        water = effective_attenuation(stored)
    elif 1 <= kev <= 800:
        water = float(attenuation("water", np.array([kev]))[0])
    else:
        raise InputError(f"--kev must be within 1 to 800, got {kev:g}")
    if water is None:
        raise InputError(f"{stored.folder}: comes without spectrum.csv, so HU need an energy: expected --kev KEV")
    return ((values.astype(np.float64) / water - 1) * 1000).astype(np.float32)
