"""Draw pictures of the documentation: the frame of its conventions, the README's artefact, the gallery of phantoms.

`python -m ctsim.reports.drawings geometry docs/images/geometry.svg`
`python -m ctsim.reports.drawings artefact DATA/SCENE docs/images/artefact.png RESULTS/volumes/SCENE__fdk.tif …`
`python -m ctsim.reports.drawings phantoms docs/images/phantoms.png`
"""

import sys
from pathlib import Path

import matplotlib
import matplotlib.patches
import numpy as np
import tifffile
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ctsim.benchmarks.scalebar import scale_bar
from ctsim.benchmarks.scores.protocol import truth_of
from ctsim.benchmarks.studies.methods.panels import cut
from ctsim.dataset.store import open_scan
from ctsim.errors import InputError
from ctsim.reports.gallery import gallery

DSO, DSD, HALF_U, HALF_V = 5.0, 8.0, 2.6, 2.0
ANGLE = np.radians(35.0)
BLUE, RED, GREY = "#1f5fa8", "#c0392b", "#666666"


def geometry(path: Path) -> None:
    """Draw the frame seen from +z and the detector seen from the source, as SVG."""
    figure = Figure(figsize=(9.2, 4.8), layout="constrained")
    orbit, panel = figure.subplots(1, 2, width_ratios=(1.25, 1))
    _orbit(orbit)
    _panel(panel)
    with matplotlib.rc_context({"svg.hashsalt": "ctsim", "font.size": 9}):
        figure.savefig(path, metadata={"Date": None})


def _orbit(axes: Axes) -> None:
    """Draw source, detector, volume and angle in the plane z = 0."""
    radial, along_u = np.array([np.cos(ANGLE), np.sin(ANGLE)]), np.array([-np.sin(ANGLE), np.cos(ANGLE)])
    source, centre = DSO * radial, -(DSD - DSO) * radial
    turn = np.linspace(0, 2 * np.pi, 200)
    axes.plot(DSO * np.cos(turn), DSO * np.sin(turn), ":", color=GREY, lw=0.8)
    axes.add_patch(matplotlib.patches.Rectangle((-1.2, -1.2), 2.4, 2.4, fill=False, ec="black"))
    axes.text(-1.1, -1.1, "volume [z, y, x]", fontsize=7.5)
    for name, (x, y) in {"+x": (2.6, 0), "+y": (0, 2.6)}.items():
        axes.annotate("", (x, y), (0, 0), arrowprops={"arrowstyle": "->"})
        axes.text(1.12 * x, 1.12 * y, name, ha="center", va="center")
    axes.text(-1.1, -1.35, "+z towards you", va="top", fontsize=7.5)
    axes.plot(*source, "o", color=RED)
    axes.text(1.1 * source[0], 1.1 * source[1], "source = dso·(cos a, sin a, 0)", color=RED, ha="center", va="bottom")
    ends = np.stack([centre - HALF_U * along_u, centre + HALF_U * along_u])
    axes.plot(*ends.T, color=BLUE, lw=3)
    for end in ends:
        axes.plot(*np.stack([source, end]).T, color=RED, lw=0.6)
    axes.annotate("", ends[1] + 0.9 * along_u, ends[1], arrowprops={"arrowstyle": "->", "color": BLUE})
    _label(axes, ends[1] + 1.2 * along_u, "+u", BLUE)
    _label(axes, centre - 0.9 * radial - 0.6 * along_u, "detector", BLUE)
    axes.plot(*np.stack([source, centre]).T, "--", color=GREY, lw=0.8)
    _label(axes, 0.62 * source - 0.4 * along_u, "dso", GREY)
    _label(axes, 0.78 * centre + 0.55 * along_u, "dsd − dso", GREY)
    arc = np.linspace(0, ANGLE, 40)
    axes.plot(1.9 * np.cos(arc), 1.9 * np.sin(arc), color="black", lw=1)
    axes.text(2.1 * np.cos(ANGLE / 2), 2.1 * np.sin(ANGLE / 2), "a", va="center")
    axes.set_title("seen from +z; a grows counter-clockwise")
    axes.set(aspect="equal", xlim=(-6.2, 6.6), ylim=(-5.4, 5.4))
    axes.axis("off")


def _label(axes: Axes, at: NDArray[np.float64], text: str, colour: str) -> None:
    axes.text(float(at[0]), float(at[1]), text, color=colour, ha="center", va="center")


def _panel(axes: Axes) -> None:
    """Draw the detector's rows, columns and offset as the source sees them."""
    n_u, n_v = 6, 5
    for k in range(n_u + 1):
        axes.plot([k - n_u / 2] * 2, [-n_v / 2, n_v / 2], color=BLUE, lw=0.7)
    for k in range(n_v + 1):
        axes.plot([-n_u / 2, n_u / 2], [k - n_v / 2] * 2, color=BLUE, lw=0.7)
    axes.text(-2.5, -2, "[0, 0]", ha="center", va="center", fontsize=8)
    axes.text(2.5, 2, "[n_v−1,\nn_u−1]", ha="center", va="center", fontsize=7)
    axes.plot(0, 0, "+", color="black", ms=9)
    axes.text(0.1, 0.15, "off_detector", fontsize=8)
    for name, start, end in (("+u", (-3, -3), (-0.6, -3)), ("+v = +z", (-3.4, -2.5), (-3.4, 2.6))):
        axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": BLUE})
        axes.text(end[0] + 0.1, end[1] + 0.05, name, color=BLUE, ha="left" if name == "+u" else "center", va="bottom")
    axes.text(0, -3.5, "row 0 is the bottom row; index [view, v, u]", ha="center", va="top")
    axes.text(0, -4.1, "u of pixel k = (k − (n_u − 1)/2)·d_u + off_u", ha="center", va="top", fontsize=8)
    axes.set_title("the detector, seen from the source")
    axes.set(aspect="equal", xlim=(-4.4, 3.6), ylim=(-4.8, 3.4))
    axes.axis("off")


def artefact(scene: Path, volumes: list[Path], path: Path) -> None:
    """Draw the slice of a scene with the most metal: the reference and reconstructions named SCENE__METHOD.tif.

    The first row's window holds bone, the second's soft tissue, in which faint streaks show.
    """
    truth = truth_of(open_scan(scene))
    z = cut(truth.metal, truth.body)[0]
    reference = np.asarray(truth.references["effective"][z])
    tissue = float(np.median(reference[truth.body[z] & ~truth.metal[z]]))
    figure = Figure(figsize=(2.8 * (1 + len(volumes)) + 0.6, 6.0), layout="constrained")
    panels = [("reference", reference)]
    panels += [(v.stem.split("__")[-1].upper(), np.asarray(tifffile.memmap(v, mode="r")[z])) for v in volumes]
    windows = ((0.0, 2.5 * tissue), (0.6 * tissue, 1.4 * tissue))
    for row, (low, high) in zip(figure.subplots(2, len(panels), squeeze=False), windows, strict=True):
        for axes, (title, image) in zip(row, panels, strict=True):
            axes.imshow(image, cmap="gray", vmin=low, vmax=high, origin="lower")
            axes.contour(truth.metal[z], levels=[0.5], colors="#ffb000", linewidths=0.7)
            axes.set(title=title, xticks=[], yticks=[])
        scale_bar(row[0], reference.shape, truth.d_voxel[2], size=8)
        figure.colorbar(row[0].images[0], ax=list(row), fraction=0.02, pad=0.01, label="1/mm")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def main(arguments: list[str]) -> None:
    """Draw what the command line asks for; raise InputError for other words."""
    match arguments:
        case ["geometry", path]:
            geometry(Path(path))
        case ["artefact", scene, path, *volumes] if volumes:
            artefact(Path(scene), [Path(v) for v in volumes], Path(path))
        case ["phantoms", path]:
            gallery().savefig(path, dpi=80)
        case _:
            raise InputError("expected: geometry OUT, artefact SCENE OUT VOLUME…, or phantoms OUT")


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except InputError as error:
        sys.stderr.write(f"drawings: {error}\n")
        sys.exit(2)
