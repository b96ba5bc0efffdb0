"""`make-dataset shards`: scans of a data folder in a few HDF5 files, for training. The flags of the command."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True, kw_only=True)
class Flags:
    """Write the scans of a data folder into HDF5 shards: line integrals, FDK of scan and twin, reference, masks.

    Shards are named by split, as train-00000.h5. Those that are there with the same scans are kept. `ctsim.torch.Scans`
    reads them.
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """Data folder that make-dataset wrote."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder of the shards."""
    items: tuple[str, ...] = ()
    """Arrays to write: some of p twin_p trace fdk twin reference metal; by default all that the scans have."""
    scans_per_shard: int = 64
    """Most scans in one file."""
    workers: int = 1
    """Number of shards written at once, each with its share of the cores."""
