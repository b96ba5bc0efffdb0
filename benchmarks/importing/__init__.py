"""`make-dataset import`: a measured scan as a scene without truth. The flags of the command."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Flags:
    """Copy a measured scan into a data folder, as a scene that run-benchmark takes.

    The format is found by the files' names. Such a scene has no truth: metal masks are found in the volume, and scores
    are those that need no reference.
    """

    scan: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCAN")]
    """Folder or header of the scan."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Data folder."""
    format: Literal["auto", "skyscan", "walnut", "hdf5", "r2", "naf"] = "auto"
    """Format of the scan."""
    name: str | None = None
    """Name of the scene (default: that of SCAN)."""
    center: Annotated[str, tyro.conf.arg(metavar="auto|file|PIXELS")] = ""
    """Where the axis of rotation is: how many columns to the right of the detector's middle, as an eye at the source
    sees it; file: what the format states; auto: found from opposite views of a full turn (default: file where the
    format states it, else auto)."""
    n_voxel: int | None = None
    """Voxels of the volume along x and y; z follows (default: a detector's columns, at most 512)."""
    voxel: float | None = None
    """Size of the cubic voxels in mm (default: so that the field of view fits)."""
    turn: Literal["file", "clockwise", "counter-clockwise"] = "file"
    """Which way the source turns about the object as seen from above, if it is not as the file is understood."""
    dso: float | None = None
    """Distance from the source to the axis in mm, if the format does not state it."""
    dsd: float | None = None
    """Distance from the source to the detector in mm, if the format does not state it."""
    pixel: float | None = None
    """Size of a detector's pixel in mm, if the format does not state it."""
    kv: float | None = None
    """Tube voltage, if the format does not state it."""
    filter: str | None = None
    """Sheets in front of the tube, such as "Al 0.5mm" or "Cu 0.1mm + Al 1mm", or none; if the format does not state
    them."""
    i0: float | None = None
    """Photons per open pixel and view (default: by the noise next to the object, else 1e5)."""
    hold: int | None = None
    """Views kept from the methods, for scores (default: one of 40, at most 12)."""
    force: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Import a scan again that is there."""
