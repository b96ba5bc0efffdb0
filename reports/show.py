"""Show text and figures from a notebook, also where it runs as a plain script.

In Jupyter they appear below the cell. A script writes text to the terminal and figures as PNG into the folder that
the environment variable CTSIM_FIGURES names, else `figures/`.
"""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

if TYPE_CHECKING:
    from ctsim.reports.kept import Case


def text(markdown: str) -> None:
    """Show Markdown."""
    if _in_jupyter():
        from IPython.display import Markdown, display  # pyright: ignore[reportMissingImports]

        display(Markdown(markdown))
    else:
        sys.stdout.write(markdown + "\n\n")


def figure(drawing: Figure, name: str) -> None:
    """Show a figure; `name` is its file's, without suffix."""
    if _in_jupyter():
        from IPython.display import Image, display  # pyright: ignore[reportMissingImports]

        from ctsim.reports.view import png

        display(Image(data=png(drawing)))
        return
    path = Path(os.environ.get("CTSIM_FIGURES", "figures")) / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=110)
    sys.stdout.write(f"Figure: {path}\n\n")


def slices(case: "Case", name: str) -> None:
    """Show a case's viewer; a script draws what it shows first."""
    from ctsim.reports.view import figure as drawn
    from ctsim.reports.view import first_state, viewer

    if _in_jupyter():
        from IPython.display import display  # pyright: ignore[reportMissingImports]

        display(viewer(case))
    else:
        figure(drawn(case, first_state(case)), name)


def table(head: list[str], rows: list[list[str]]) -> None:
    """Show a table, the first column text and the others numbers."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    text("\n".join("| " + " | ".join(line) + " |" for line in lines))


def _in_jupyter() -> bool:
    """Say whether a notebook's kernel runs this code; a kernel has loaded IPython."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and hasattr(shell, "kernel")
