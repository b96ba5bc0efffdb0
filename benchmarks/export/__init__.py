"""`make-dataset export`: scans and volumes in the formats of other programs. The flags of the command."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Flags:
    """Write a volume on a scan's grid as NIfTI, MetaImage or DICOM, or the scan in the layout of another library.

    NIfTI and MetaImage keep the values in 1/mm, or HU with --hu. DICOM slices are HU in 16 bits. All three state
    spacing and place. The layouts of TIGRE, RTK, ASTRA, LEAP, R2-Gaussian (r2) and NAF hold line integrals, geometry
    and grid; Data Exchange (dxchange) holds counts, open field, dark level and geometry.
    """

    scan: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCAN")]
    """Folder of a scan, data/SCENE."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """New file (.nii, .nii.gz, .mha, .pickle or .h5), or new folder (DICOM slices, and the layouts of libraries)."""
    to: Literal["nifti", "mha", "dicom", "tigre", "rtk", "astra", "leap", "r2", "naf", "dxchange"]
    """Format of a volume, or library."""
    volume: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = "reference_effective"
    """A volume of the scan (reference_effective, reference_50kev, labels, metal, metal_free/…), or a TIFF stack or .npy
    array on the scan's grid, such as a reconstruction in results/volumes."""
    twin: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write the metal-free twin of the scan, in a library's layout."""
    hu: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write HU instead of 1/mm."""
    kev: float | None = None
    """Energy whose attenuation of water is 0 HU; by default that of the scan's effective spectrum, and 50 for
    reference_50kev."""
