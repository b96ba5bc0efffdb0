"""Show text and figures from a notebook, or from a notebook that runs as a script.

In Jupyter they appear below the cell. A script writes text to the terminal and figures as PNG into the folder that
the environment variable CTSIM_FIGURES names, else `figures/`.
"""

import os
import sys
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ctsim.benchmarks.engine.table import simple
from ctsim.reports import view
from ctsim.reports.kept import Case


def text(markdown: str) -> None:
    """Show Markdown."""
    if (display := _jupyter()) is not None:
        display.display(display.Markdown(markdown))
    else:
        sys.stdout.write(markdown + "\n\n")


def figure(drawing: Figure, name: str) -> None:
    """Show a figure; `name` is its file's, without suffix."""
    if (display := _jupyter()) is not None:
        display.display(display.Image(data=view.png(drawing)))
        return
    path = Path(os.environ.get("CTSIM_FIGURES", "figures")) / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=110)
    sys.stdout.write(f"Figure: {path}\n\n")


def slices(case: Case, name: str) -> None:
    """Show a case's viewer; a script draws its first state."""
    if (display := _jupyter()) is not None:
        display.display(view.viewer(case))
    else:
        figure(view.figure(case, view.first_state(case)), name)


def table(head: list[str], rows: list[list[str]]) -> None:
    """Show a table, the first column text and the others numbers."""
    text(simple(head, rows, numbers=head[1:]).markdown())


def _jupyter() -> Any:
    """Return IPython's display if a notebook's kernel runs this code, which has then loaded it; else None."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return ipython.display if ipython is not None and hasattr(shell, "kernel") else None
