"""What a method is worth beside others: gains over FDK and NMAR, and the score anchored on the metal-free twin.

All of it is derived from scores that are recorded; nothing is reconstructed or judged anew.
"""

from collections.abc import Iterable
from typing import NamedTuple

from ctsim.benchmarks.engine.record import OK

FDK, NMAR = "fdk", "nmar"
ANCHORED = {
    "tissue": ("rmse", "ssim3d"),
    "aligned": ("rmse", "ssim3d"),
    "aligned_50kev": ("rmse", "ssim3d"),
    "artefact": ("roi_std", "cupping", "streak", "rmse", "rmse_near", "rmse_far"),
}
"""The metrics that have an anchored score; of `artefact` FDK's error without the metal is 0 by definition."""
COMPARED = {**ANCHORED, "tissue": ("psnr3d", *ANCHORED["tissue"])}
"""The metrics that anything is derived of."""

Place = tuple[str, int, str, str, str, str]
"""Scene, seed, variant, method, protocol, metric."""


class Row(NamedTuple):
    """One number of a run, None where it does not exist; `identical` and `volume` are those of its score."""

    scene: str
    seed: int
    variant: str
    method: str
    inputs: str
    protocol: str
    metric: str
    value: float | None
    status: str = OK
    volume: str = ""
    identical: bool = False


def row_of(name: str, labels: Iterable[str]) -> str | None:
    """Return the label to compare with: `name` itself, else the first with parameters, such as nmar[mask=oracle]."""
    labels = list(dict.fromkeys(labels))
    return name if name in labels else next((x for x in labels if x.startswith((f"{name}[", f"{name}-"))), None)


def error(metric: str, value: float) -> float:
    """Return a metric as an error that is 0 at best: 1 − SSIM3D, any other as it is."""
    return 1 - value if metric.startswith("ssim3d") else value


def anchored(e: float, e_reference: float, e_fdk: float) -> float | None:
    """Return (e − e_ref) / (e_FDK − e_ref); None where FDK is no worse with the metal than without it."""
    return (e - e_reference) / (e_fdk - e_reference) if e_fdk > e_reference else None


def harm(scores: list[float | None]) -> tuple[float | None, str]:
    """Return the share of scenes whose anchored score is above 1, and its text with the count of scenes.

    Scenes without a score are not counted; the share is None, and not ranked, where one is missing.
    """
    known = [s for s in scores if s is not None]
    if not known:
        return None, "–"
    harmed = sum(s > 1 for s in known)
    share = harmed / len(known)
    return share if len(known) == len(scores) else None, f"{share:.2f} ({harmed}/{len(known)})"


def derived(rows: list[Row]) -> list[Row]:
    """Derive the rows of `against` (dB of tissue PSNR3D) and `anchored` ("protocol/metric") from scored rows.

    Comparisons are made within one scene and seed, between runs that ended well.
    """
    scored = [row for row in rows if row.status == OK and row.value is not None and row.value == row.value]
    labels = dict.fromkeys(row.method for row in scored if row.variant == "metal")
    bases = {name: row_of(name, labels) for name in (FDK, NMAR)}
    values = {_place(row, row.method, row.variant): row.value for row in scored if row.method in (FDK, *bases.values())}
    found = []
    for row in scored:
        if row.variant == "metal":
            pairs = _gains(row, values, bases) + _anchors(row, values)
            found += [row._replace(protocol=p, metric=m, value=v, identical=False) for p, m, v in pairs]
    return found


def _place(row: Row, method: str, variant: str) -> Place:
    return row.scene, row.seed, variant, method, row.protocol, row.metric


def _gains(row: Row, values: dict[Place, float | None], bases: dict[str, str | None]) -> list[tuple[str, str, float]]:
    """Return the gain in tissue PSNR3D over FDK and NMAR, where those rows are there."""
    if row.metric != "psnr3d" or row.protocol != "tissue" or row.value is None:
        return []
    found = []
    for name, label in bases.items():
        base = None if label is None else values.get(_place(row, label, "metal"))
        found += [] if base is None else [("against", f"over_{name}", row.value - base)]
    return found


def _anchors(row: Row, values: dict[Place, float | None]) -> list[tuple[str, str, float]]:
    """Return a metric's anchored score, where FDK ran on the scan and its twin."""
    protocol, metric = row.protocol, row.metric
    if metric not in ANCHORED.get(protocol, ()) or row.value is None:
        return []
    worst = values.get(_place(row, FDK, "metal"))
    # artefacts are differences from the twin, which differs from itself by nothing
    best = error(metric, 0.0) if protocol == "artefact" else values.get(_place(row, FDK, "metal_free"))
    if worst is None or best is None:
        return []
    s = anchored(error(metric, row.value), error(metric, best), error(metric, worst))
    return [] if s is None else [("anchored", f"{protocol}/{metric}", s)]
