"""`run-benchmark score`: a volume that was made elsewhere becomes a row of the tables. The flags of the command."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class Flags:
    """Score a volume that another program reconstructed from a scan, and add it to the tables as "NAME (submitted)".

    The volume is a TIFF stack, .npy, NIfTI, MetaImage or NRRD file, or a folder of DICOM slices, on the scan's grid. A
    volume that is flipped, transposed or in another unit is refused.
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """The folder that make-dataset wrote."""
    results: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS")]
    """Folder for records, tables and volumes; created if missing."""
    volume: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="VOLUME")]
    """The volume of the scan."""
    scene: str
    """The scan's name."""
    name: str
    """The method's name in the tables."""
    twin: Path | None = None
    """The volume of the metal-free twin by the same method: for the cost of metal and the protocol artefact."""
    unit: Literal["1/mm", "1/cm", "hu"] = "1/mm"
    """Unit of the values. 0 HU is water under the scan's effective spectrum."""
    seconds: float | None = None
    """Seconds that the reconstruction took. Tables say that they are stated, not measured."""
    inputs: str = "counts only"
    """What the method needs in addition to the counts, such as "metal mask"; methods are ranked within such a class."""
    cite: str = ""
    """Where the method is described, such as a DOI; kept in the record."""
