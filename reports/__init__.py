"""`run-benchmark report`, figures, and what notebooks show of benchmark results."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Flags:
    """Write RESULTS as one self-contained HTML file, or its tables as a page in Markdown."""

    results: tyro.conf.Positional[Path]
    """A results folder."""
    data: tyro.conf.Positional[Path | None] = None
    """The dataset it was measured on; without it the page has no slices."""
    out: Path | None = None
    """The HTML file (default: report.html in RESULTS, unless --markdown is given)."""
    markdown: Path | None = None
    """Write the tables as Markdown into this file."""
    also: Annotated[tyro.conf.UseAppendAction[tuple[Path, ...]], tyro.conf.arg(metavar="RESULTS")] = ()
    """Another results folder whose tables follow in the Markdown; may be given several times."""
