"""One HTML file that needs nothing else: tables that sort, figures, and a slice slider for each scene.

The methods study and `ctsim.reports.figures` write its parts; this module puts them together. A policy in the
file forbids it to load anything.
"""

import html
import json
import string
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any

import matplotlib
import matplotlib.colors
import numpy as np

from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.engine.table import html_prose, simple
from ctsim.benchmarks.scalebar import length_of
from ctsim.benchmarks.studies.methods.records import RunRecord, latest
from ctsim.benchmarks.studies.methods.tables import tables
from ctsim.reports import figures, slices
from ctsim.reports.kept import Case, Kept, Measured

PRIMARY, FAILURES = "tissue", "Failures and skips"
TITLES = {
    "tissue": "Tissue, the primary protocol",
    "aligned": "Tissue after one gain",
    "aligned_50kev": "Tissue after one gain, against 50 keV",
    "paper": "All voxels against 50 keV",
    "metal": "The metal itself",
    "artefact": "Artefacts, against the metal-free twin",
    "projection": "Views that no method saw",
    "against": "Gains over FDK and NMAR",
    "anchored": "Anchored scores and harm",
    "cost": "Cost",
}
_BOX = '<input type="checkbox" autocomplete="off"'  # a reloaded page is as at first
SIGNED_STOPS = 17  # of the error colours; the browser interpolates between them


@dataclass(frozen=True, slots=True, kw_only=True)
class Content:
    """The content of a page. `more` holds further parts in HTML by title; `missing` says why there are no slices."""

    title: str
    provenance: str
    records: Sequence[RunRecord]
    cases: list[Case | Measured]
    most: int = 1
    more: dict[str, str]
    missing: str = ""


def page(content: Content, done: Callable[[], Any] = lambda: None) -> str:
    """Return the page; `done` is called after every slice that was encoded."""
    found = {table.title: replace(table, title="").html() for table in tables(content.records)}
    found |= _failures(content.records)
    scenes = [_scene(case, slices.frame_of(case, content.most), done) for case in content.cases]
    parts = {
        "scores": ("Scores", _table(PRIMARY, found.pop(PRIMARY)) if PRIMARY in found else ""),
        "figures": ("Figures", _figures(content.records)),
        "slices": ("Slices", _slices(scenes, content.cases) if scenes else f"<p>{html.escape(content.missing)}</p>"),
        "protocols": ("All protocols", "".join(_folded(name, part) for name, part in found.items())),
        "more": ("More", "".join(_folded(name, part) for name, part in content.more.items())),
    }
    kept = {name: part for name, part in parts.items() if part[1]}
    return string.Template(_asset("page.html")).substitute(
        title=html.escape(content.title),
        provenance=html_prose(content.provenance),
        style=_asset("page.css"),
        script=_asset("page.js"),
        transfer=_transfer(),
        contents="".join(f'<a href="#{name}">{title}</a>' for name, (title, _) in kept.items()),
        main="".join(f'<h2 id="{name}">{title}</h2>\n{body}\n' for name, (title, body) in kept.items()),
    )


def _asset(name: str) -> str:
    return resources.files("ctsim.reports").joinpath(name).read_text(encoding="utf-8")


def _failures(records: Sequence[RunRecord]) -> dict[str, str]:
    """Return {title: table of the runs that did not end well}, empty if all did."""
    rows = [[r.run.scene, r.label, r.run.variant, r.status, r.reason] for r in latest(records) if r.status != OK]
    return {FAILURES: simple(("scene", "method", "variant", "status", "reason"), rows).html()} if rows else {}


def _table(name: str, part: str) -> str:
    return f'<div id="table-{html.escape(name.replace(" ", "-"))}">{part}</div>'


def _folded(name: str, part: str) -> str:
    title = TITLES.get(name, name)
    return f"<details><summary>{html.escape(title)}</summary>{_table(name, part)}</details>"


def _figures(records: Sequence[RunRecord]) -> str:
    shown = (f"<figure>{figures.svg(figure, label)}</figure>" for label, figure in figures.drawn(records))
    drawn = "".join(shown)
    return f'<div class="figures">{drawn}</div>' if drawn else ""


def _slices(scenes: list[str], cases: list[Case | Measured]) -> str:
    """Return the controls that all scenes share, then the scenes."""
    labels = dict.fromkeys(kept.record.label for case in cases for kept in case.kept)
    radios = (("both", "volumes and errors"), ("volume", "volumes"), ("error", "errors"))
    show = "".join(
        f'<label><input type="radio" autocomplete="off" name="show" value="{value}"'
        f"{' checked' * (value == 'both')}>{text}</label>"
        for value, text in radios
    )
    boxes = "".join(
        f'<label>{_BOX} name="method" value="{html.escape(label)}" checked>{html.escape(label)}</label>'
        for label in labels
    )
    said, look = ["Slices normal to z, row 0 at the bottom, in 8 bits over the stated window."], ""
    if any(isinstance(case, Case) for case in cases):
        said += [
            "Errors are volume minus effective-spectrum reference. Slices are cropped to the judged body. Metal is "
            "outlined, and grey in the errors because it is not judged. Of several seeds of a scene the first is shown."
        ]
        ring = f'<label>{_BOX} name="ring" checked>metal outline</label>'
        look = f'<fieldset class="look">{show}{ring}</fieldset>'
    if any(isinstance(case, Measured) for case in cases):
        said += ["Measured scans have no truth: their slices are whole, without errors and without outlines."]
    return (
        f'<p class="caption">{" ".join(said)}</p>{look}'
        f'<details><summary>Methods</summary><fieldset class="look">{boxes}</fieldset></details>' + "".join(scenes)
    )


def images_a_slice(case: Case | Measured) -> int:
    """Return how many images a slice has: volumes, and with a truth the reference and the errors."""
    return 2 * len(case.kept) + 1 if isinstance(case, Case) else len(case.kept)


def _scene(case: Case | Measured, frame: slices.Frame, done: Callable[[], Any]) -> str:
    """Return a scene's section: slider, legends, a tile a method, and the images themselves."""
    name = html.escape(case.stored.name)
    start = int(np.argmin(np.abs(np.array(frame.z) - case.at[0])))
    whole = isinstance(case, Measured)
    tiles = [] if whole else [_tile(case, frame, "reference", "<b>reference</b>, effective spectrum", "")]
    tiles += [_tile(case, frame, str(k), _caption(kept), kept.record.label) for k, kept in enumerate(case.kept)]
    data = json.dumps(_images(case, frame, start, done), separators=(",", ":")).replace("<", "\\u003c")
    return (
        f'<section class="scene" id="scene-{name}"><h3>{name}</h3>{_said(case, frame)}<div class="control">'
        f'<input type="range" autocomplete="off" min="0" max="{len(frame.z) - 1}" value="{start}" '
        f'aria-label="slice of {name}">'
        f"<output></output></div>{_legends(case)}"
        f'<div class="tiles{" bare" * whole}">{"".join(tiles)}</div><script type="application/json">{data}</script>'
        "</section>\n"
    )


def _said(case: Case | Measured, frame: slices.Frame) -> str:
    """Say where the edges of the slices are, and which slices are left out, if any are."""
    geometry = case.stored.geometry
    ends = []
    for axis, part in ((2, frame.columns), (1, frame.rows)):
        at, half = geometry.voxel_centres()[axis], geometry.d_voxel[axis] / 2
        ends.append(f"{at[part.start] - half:.1f} … {at[part.stop - 1] + half:.1f} mm".replace("-", "−"))
    said = "Measured, without truth. " * isinstance(case, Measured)
    said += f"From left to right x = {ends[0]}, from bottom to top y = {ends[1]}."
    step = frame.z[1] - frame.z[0] if len(frame.z) > 1 else 1
    said += f" One slice in {step} is here, to keep the file small." * (step > 1)
    return f'<p class="caption">{said}</p>'


def _tile(case: Case | Measured, frame: slices.Frame, row: str, caption: str, label: str) -> str:
    _, d_y, d_x = case.stored.geometry.d_voxel
    height, width = ((part.stop - part.start) for part in (frame.rows, frame.columns))
    ratio = f'style="aspect-ratio: {width * d_x:.6g} / {height * d_y:.6g}"'
    length = length_of(width * d_x)
    bar = f'<i class="bar" style="width: {100 * length / (width * d_x):.4g}%">{length:g} mm</i>'
    judged = isinstance(case, Case)
    ring = '<img class="stencil ring" data-kind="ring" alt="">' if judged else ""
    only = "" if label and judged else " only"
    alt = html.escape(label or "reference")
    frames = (
        f'<div class="frame volume{only}" {ratio}><img class="values" data-kind="volume" data-row="{row}" '
        f'alt="{alt}: volume">{ring}{bar}</div>'
    )
    if label and judged:
        frames += (
            f'<div class="frame error" {ratio}><img class="values" data-kind="error" data-row="{row}" '
            f'alt="{alt}: error"><img class="stencil" data-kind="fill" alt="">{ring}{bar}</div>'
        )
    return (
        f'<figure class="tile" data-method="{html.escape(label)}"><div class="pair">{frames}</div>'
        f"<figcaption>{caption}</figcaption></figure>"
    )


def _caption(kept: Kept) -> str:
    record = kept.record
    status = "" if record.status == OK else f" · {html.escape(record.status)}"
    if PRIMARY not in record.scores:
        return f"<b>{html.escape(record.label)}</b>{status}"
    values = record.scores[PRIMARY].values
    psnr, ssim = values["psnr3d"], values["ssim3d"]
    said = "identical" if psnr is None else f"{psnr:.2f} dB"
    said += "" if ssim is None else f" · SSIM3D {ssim:.3f}"
    return f"<b>{html.escape(record.label)}</b> PSNR3D {said}{status}"


def _images(case: Case | Measured, frame: slices.Frame, start: int, done: Callable[[], Any]) -> dict[str, Any]:
    """Encode every slice of every volume; `said` is the text next to the slider."""
    heights, total = case.stored.geometry.voxel_centres()[0], case.stored.geometry.n_voxel[0]

    def encoded(make: Callable[..., slices.Image8], values: Any) -> list[str]:
        found = []
        for z in frame.z:
            found.append(slices.png(make(case, values, frame, z)))
            done()
        return found

    found = {
        "z": list(frame.z),
        "said": [f"slice {z} of 0 … {total - 1}, z = {heights[z]:.1f} mm" for z in frame.z],
        "start": start,
        "volume": {str(k): encoded(slices.volume_image, kept.values) for k, kept in enumerate(case.kept)},
    }
    if isinstance(case, Measured):
        return found
    stencils = [slices.metal_stencils(case, frame, z) for z in frame.z]
    found["volume"]["reference"] = encoded(slices.volume_image, case.reference)
    return found | {
        "error": {str(k): encoded(slices.error_image, kept.values) for k, kept in enumerate(case.kept)},
        "ring": {"all": [ring for ring, _ in stencils]},
        "fill": {"all": [fill for _, fill in stencils]},
    }


def _legends(case: Case | Measured) -> str:
    """Return the bars of the window and of the error scale, in HU where the scan's water is known."""
    grey, signed = "#000, #fff", ", ".join(_colours())
    if isinstance(case, Measured):
        ends = (f"{case.low:.4g}".replace("-", "−"), f"{case.top:.4g} 1/mm")
        return f'<div class="legends">{_legend("volumes", grey, ends)}</div>'
    water = case.look.water
    top, error = case.look.top, case.look.error
    volume = ("0", f"{top:.4g} 1/mm")
    errors = (f"−{error:.4g}", "0", f"+{error:.4g} 1/mm")
    if water is not None:
        volume = ("−1000 HU", f"{case.hounsfield(top):.0f} HU ({top:.4g} 1/mm)")
        errors = (f"−{1000 * error / water:.0f} HU", "0", f"+{1000 * error / water:.0f} HU")
    return f'<div class="legends">{_legend("volumes", grey, volume)}{_legend("errors", signed, errors)}</div>'


def _legend(title: str, colours: str, ends: Iterable[str]) -> str:
    marks = "".join(f"<span>{end}</span>" for end in ends)
    bar = f'<div class="bar" style="background: linear-gradient(to right, {colours})"></div>'
    return f'<div class="legend">{title}{bar}<div class="ends">{marks}</div></div>'


def _colours() -> list[str]:
    """Return the panels' error colours, from most negative to most positive."""
    signed = matplotlib.colormaps["RdBu_r"]
    return [matplotlib.colors.to_hex(signed(x)) for x in np.linspace(0, 1, SIGNED_STOPS)]


def _transfer() -> str:
    """Return the filter that turns the stored grey of an error into its colour."""
    rgb = np.array([matplotlib.colors.to_rgb(colour) for colour in _colours()])
    return "".join(
        f'<feFunc{name} type="table" tableValues="{" ".join(f"{v:.4g}" for v in rgb[:, k])}"/>'
        for k, name in enumerate("RGB")
    )
