"""`run-benchmark inspect`: how PSNR and SSIM of one volume depend on the convention. The flags of the command."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Flags:
    """Show how the scores of one volume depend on the convention, as a table in Markdown."""

    data: tyro.conf.Positional[Path]
    """The folder that make-dataset wrote."""
    results: tyro.conf.Positional[Path | None] = None
    """A results folder with kept volumes; the table is written into it."""
    method: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Which row of the results (default: the only one); without RESULTS, the method to reconstruct by."""
    scene: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Which scene (default: the first)."""
    out: Path | None = None
    """The file to write (default: inspect-SCENE-METHOD.md in RESULTS, or here)."""
