"""The metric inspector: one volume under many conventions of PSNR and SSIM.

`run-benchmark inspect DATA RESULTS` reads a kept volume, `run-benchmark inspect DATA --method NAME`
reconstructs one. Each row of the table changes one convention of the protocol `tissue`; conventions
from the literature follow. Where the reference is at 50 keV, the method's own volume at 50 keV is scored, if it has
one, as in the tables.
"""

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from ctsim.benchmarks import methods
from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.known_beam import with_beam
from ctsim.benchmarks.scores import metrics
from ctsim.benchmarks.scores.metrics import ssim_along_axes
from ctsim.benchmarks.scores.protocol import TISSUE, Truth, tissue_range, truth_of
from ctsim.benchmarks.studies.inspect import Flags
from ctsim.benchmarks.studies.methods import records
from ctsim.benchmarks.studies.methods.attempt import attempt, scan_for
from ctsim.benchmarks.studies.methods.records import METAL
from ctsim.benchmarks.studies.methods.volumes import identity_of, own_at_50kev, read_volume
from ctsim.dataset.store import StoredScan, list_scans, open_scan
from ctsim.errors import InputError
from ctsim.human import human_choice

Volume = NDArray[Any]
Window = Literal["gauss", "gauss_zero", "r2", "uniform7"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspected:
    """A volume [z, y, x] in 1/mm with its method's label, and the method's own volume at 50 keV where it has one."""

    label: str
    values: Volume
    at_50kev: Volume | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Convention:
    """One way to compute PSNR and SSIM; the default is the protocol `tissue`.

    `data_range` is a rule's name or a number in 1/mm. `clip` bounds the volume after alignment: below by
    0, above not at all ("zero"), by the reference's maximum or by 1/mm ("one").
    """

    title: str
    region: Literal["tissue", "all", "body", "metal"] = "tissue"
    reference: Literal["effective", "50kev"] = "effective"
    data_range: str = "percentile"
    alignment: Literal["none", "gain", "gain_offset", "minmax"] = "none"
    clip: Literal["none", "zero", "reference", "one"] = "none"
    window: Window = "gauss"


@dataclass(frozen=True, slots=True, kw_only=True)
class Scored:
    """PSNR (dB), SSIM, and the data range, in the units that volumes have after alignment.

    None where a number does not exist: identical volumes have no PSNR, an empty region has neither.
    """

    psnr: float | None
    ssim: float | None
    data_range: float


BASE = Convention(title="protocol tissue")


def _each(name: str, titles: dict[str, Any]) -> tuple[Convention, ...]:
    """Return the protocol `tissue` with one field changed to each value, under its title."""
    return tuple(replace(BASE, title=title, **{name: value}) for title, value in titles.items())


SINGLE: dict[str, tuple[Convention, ...]] = {
    "region": _each("region", {"all voxels": "all", "body with its metal": "body", "metal only": "metal"}),
    "reference": _each("reference", {"50 keV": "50kev"}),
    "range": _each(
        "data_range",
        {
            "max of the whole reference": "max",
            "max − min of the whole reference": "maxmin",
            "max of the reconstruction": "found",
            "1 (peak of a unit volume)": "1",
            "2 (scikit-image's for floats)": "2",
        },
    ),
    "alignment": (
        *_each("alignment", {"one gain": "gain", "gain and offset": "gain_offset"}),
        replace(BASE, title="both scaled to [0, 1] by min and max", alignment="minmax", data_range="1"),
    ),
    "clipping": _each(
        "clip", {"negatives set to 0": "zero", "to [0, max of the reference]": "reference", "to [0, 1] 1/mm": "one"}
    ),
    "window": _each(
        "window", {"Gaussian, zeros beyond the border": "gauss_zero", "uniform 7³, sample covariance": "uniform7"}
    ),
}
_AT_50KEV = Convention(title="", region="all", reference="50kev")
WHOLE: tuple[Convention, ...] = (
    Convention(title="protocol aligned", alignment="gain"),
    replace(_AT_50KEV, title="protocol paper", data_range="maxmin"),
    replace(_AT_50KEV, title="range max, all voxels", data_range="max"),
    replace(_AT_50KEV, title="R2-Gaussian (peak 1, zero border, empty slices left out)", data_range="1", window="r2"),
    replace(_AT_50KEV, title="NAF (7³ window, range 2)", data_range="2", window="uniform7"),
)


def score(found: Inspected, truth: Truth, how: Convention) -> Scored:
    """Score a volume; against the reference at 50 keV its own at 50 keV, if there is one.

    Outside the region the volume counts as the reference in SSIM's window.
    """
    own = found.at_50kev if how.reference == "50kev" else None
    values, reference = found.values if own is None else own, truth.references[how.reference]
    region, data_range = region_of(truth, how.region), range_of(values, truth, how)
    values = clipped(aligned(values, truth, how), reference, how.clip)
    if how.alignment == "minmax":
        reference = unit(reference)
    if not region.any():
        return Scored(psnr=None, ssim=None, data_range=data_range)
    psnr = metrics.psnr3d(values, reference, data_range=data_range, region=region)
    return Scored(psnr=psnr, ssim=similarity(values, reference, region, data_range, how.window), data_range=data_range)


def region_of(truth: Truth, name: str) -> NDArray[np.bool_]:
    """Return the mask of a region by its name."""
    if name == "all":
        return np.ones_like(truth.metal)
    return {"tissue": truth.tissue, "body": truth.body | truth.metal, "metal": truth.metal}[name]


def range_of(values: Volume, truth: Truth, how: Convention) -> float:
    """Return the data range by its rule; a rule that gives 0 or less is an InputError."""
    reference = truth.references[how.reference]
    match how.data_range:
        case "percentile":
            return tissue_range(truth, how.reference)
        case "max":
            found = float(reference.max())
        case "maxmin":
            found = float(reference.max()) - float(reference.min())
        case "found":
            found = float(values.max())
        case number:
            found = float(number)
    if found <= 0:
        raise InputError(f"the data range of {how.title!r} is {found:.4g}; expected one above 0")
    return found


def aligned(values: Volume, truth: Truth, how: Convention) -> Volume:
    """Return the volume after alignment; gains and offsets are fitted as in `aligned`, on the body's tissue."""
    if how.alignment == "minmax":
        return unit(values)
    if how.alignment == "none":
        return values
    reference, body = truth.references[how.reference], truth.body & ~truth.near_metal
    body = body if body.any() else truth.tissue
    if how.alignment == "gain":
        gain = metrics.least_squares_gain(values, reference, body)
        return values if gain is None else values * np.float32(gain)
    x, y = values[body].astype(np.float64), reference[body].astype(np.float64)
    power = float(np.var(x))
    gain = float(np.mean((x - x.mean()) * (y - y.mean()))) / power if power else 0.0
    return (values * gain + (y.mean() - gain * x.mean())).astype(np.float32)


def unit(values: Volume) -> Volume:
    """Scale a volume to [0, 1] by its own minimum and maximum; a constant becomes 0."""
    low, high = float(values.min()), float(values.max())
    return (values - low) / (high - low) if high > low else np.zeros_like(values)


def clipped(values: Volume, reference: Volume, clip: str) -> Volume:
    """Return the volume bounded as the convention says."""
    high = {"zero": None, "reference": float(reference.max()), "one": 1.0}
    return values if clip == "none" else np.clip(values, 0.0, high[clip])


def similarity(
    values: Volume, reference: Volume, region: NDArray[np.bool_], data_range: float, window: Window
) -> float | None:
    """Return SSIM averaged over the region ("r2": over all voxels with peak 1, for any region and range).

    None with "uniform7" where an axis has fewer than 7 voxels, with "r2" where the reference is empty.
    """
    if window == "gauss":
        return metrics.ssim3d(values, reference, data_range=data_range, region=region)
    if window == "r2":
        return metrics.ssim3d_r2(values, reference)
    values = np.where(region, values, reference)
    if window == "gauss_zero":
        sums = ssim_along_axes(values, reference, region, data_range, mode="zero")
        return float(sum(s.sum() for s in sums)) / (3 * int(region.sum()))
    if min(values.shape) < 7:
        return None
    # scikit-image's own mean leaves a border of 3 voxels out; kept where all voxels are judged, as NAF does
    found: Any = structural_similarity(reference, values, win_size=7, data_range=data_range, full=True)
    mean, full = found
    return float(mean) if region.all() else float(full[region].mean(dtype=np.float64))


def table(found: Inspected, truth: Truth) -> Table:
    """Return a row for each convention: what it changes, data range, PSNR and SSIM with their changes."""
    base = score(found, truth, BASE)
    rows = [["–", BASE.title, f"{base.data_range:.4g}", _cell(base.psnr, None, 2), _cell(base.ssim, None, 3)]]
    for what, conventions in (*SINGLE.items(), ("all of it", WHOLE)):
        for how in conventions:
            new = score(found, truth, how)
            cells = _cell(new.psnr, base.psnr, 2), _cell(new.ssim, base.ssim, 3)
            rows.append([what, how.title, f"{new.data_range:.4g}", *cells])
    numbers = ("range", "PSNR3D (dB)", "SSIM3D")
    return simple(("changed", "convention", *numbers), rows, numbers=numbers)


def _cell(value: float | None, base: float | None, digits: int) -> str:
    if value is None:
        return "–"
    return f"{value:.{digits}f}" + ("" if base is None else f" ({value - base:+.{digits}f})")


def markdown(found: Inspected, stored: StoredScan) -> str:
    """Return the table in Markdown with what it shows. Raises InputError for volumes that cannot be scored."""
    truth = truth_of(stored)
    for volume, which in ((found.values, "volume"), (found.at_50kev, "volume at 50 keV")):
        if volume is not None and volume.shape != truth.metal.shape:
            raise InputError(f"the {which} has shape {volume.shape}, scan {stored.name!r} {truth.metal.shape}")
        if volume is not None and not np.isfinite(volume).all():
            raise InputError(f"the {which} of {found.label} has voxels that are not finite: it has no scores")
    what, own = "volume", "the same volume, the only one there is,"
    if found.at_50kev is not None:
        what, own = "run", "the method's own volume at 50 keV"
    return (
        f"# One {what}, many scores: {stored.name}, {found.label}\n\n"
        f"First the protocol tissue: region {TISSUE}; reference effective spectrum behind {truth.l0:.1f} mm of water; "
        "no alignment; nothing clipped; range the 99.9 percentile of the reference in the region; SSIM with Gaussian "
        "weights in slices along three axes. Each row changes what its first column says; a range follows its rule, so "
        f"that another reference has another one. Where the reference is 50 keV, {own} is scored. "
        "The last rows are conventions as they are printed. In brackets the change; ranges are 1/mm, but for volumes "
        f"scaled to [0, 1].\n\n{table(found, truth).markdown()}"
    )


def main(arguments: list[str]) -> int:
    """Run the command; return 0. Raises InputError where data, volume or method cannot be used."""
    given = tyro.cli(Flags, prog="run-benchmark inspect", args=arguments)
    scans = {folder.name: folder for folder in list_scans(given.data)}
    if not scans:
        raise InputError(f"{given.data}: the dataset has no scenes")
    if given.scene is not None and given.scene not in scans:
        raise InputError(f"--scene {given.scene!r}: {given.data} has {human_choice(scans, given.scene)}")
    stored = open_scan(scans[given.scene or next(iter(scans))])
    found = _made(given.method, stored) if given.results is None else _kept(given.results, given.method, stored)
    text = markdown(found, stored)
    name = "".join(c if c.isalnum() or c in "-.=" else "_" for c in f"inspect-{stored.name}-{found.label}")
    path = given.out or (given.results or Path()) / f"{name}.md"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    sys.stdout.write(f"{text}\nWritten: {path}\n")
    return 0


def _kept(results: Path, name: str | None, stored: StoredScan) -> Inspected:
    """Read the volumes that a results folder keeps of a scan and method."""
    shown = (r for r in records.latest(records.read(results)) if r.run.variant == METAL and r.volume)
    kept = {r.label: r for r in shown if r.task.data == stored.content_hash}
    if not kept:
        raise InputError(f"{results}: no volume of scene {stored.name!r} is kept; run a method first")
    if name is None and len(kept) > 1:
        raise InputError(f"{results}: there are several volumes; say --method {', '.join(kept)}")
    label = name or next(iter(kept))
    if label not in kept:
        raise InputError(f"--method {label!r}: {results} keeps volumes of {', '.join(kept)}")
    path = results / str(kept[label].volume)
    values = read_volume(path)
    if identity_of(path) != kept[label].identity:
        raise InputError(f"{path}: is not the volume of the last record of {label}; run it again with --force")
    own = own_at_50kev(path, kept[label].identity)
    return Inspected(label=label, values=values, at_50kev=None if own is None else read_volume(own))


def _made(name: str | None, stored: StoredScan) -> Inspected:
    """Reconstruct the scan."""
    if name is None:
        raise InputError("expected a results folder or --method NAME")
    method = with_beam(methods.find(name), stored)
    scan = scan_for(method, stored, METAL)
    if reason := method.skip(scan):
        raise InputError(f"method {name!r} does not apply to {stored.name!r}: {reason}")
    outcome = attempt(method, scan, 0.0)
    if outcome.status != OK or outcome.values is None:
        raise InputError(f"method {name!r} ended as {outcome.status}: {outcome.reason}")
    return Inspected(label=method.label, values=outcome.values, at_50kev=outcome.at_50kev)
