"""What a score is, how tables show it, and what is derived from scores that are recorded.

This module is light; `.protocol`, `.artefact` and `.projection` compute scores and are loaded only for that.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import msgspec

from ctsim.benchmarks.engine.record import OK

VERSION = 11
"""Part of every run's identity; raised when a protocol changes its meaning.

1: tissue, aligned, paper, metal, cost. 2: every method runs on the metal-free twin too, for `artefact`.
3: `projection`, and `rmse` of `artefact`. The version was not raised for `at_energy`: only new code has it, and code is
part of the identity. 4: `soft` and `structure`, of the twin too; `tissue` stays inside the field of view.
5: fine structures in `soft`. 6: false bone begins at 1000 HU. 7: metal that
fills less than half of its voxels is left out of `tissue`. 8: near metal is at least 6 voxels. 9: noise near metal is
without errors of its edge, each metal has its own threshold for Dice, and bone that the reference holds is not false.
10: MTF50 near metal reaches 12 voxels, and the contrast of fine structures is left out where noise decides it. 11: both
CNR of `soft` have the sign of the contrast, and are left out where nothing deviates.
"""

AS_RETURNED, AT_50KEV = "as returned", "read at 50 keV"
NO_TWIN = "the scan has no metal-free twin"
NOT_ASKED = "the metal-free twin was not to be reconstructed"
TWIN_ENDED = "the run on the metal-free twin ended as"
"""Notes of `artefact` where it has no numbers."""


class Score(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The scores under one protocol, and how they were computed.

    `data_range` is 1/mm; `values` maps a metric to its number, or to None where it does not exist; `volume` says which
    of a method's volumes was scored.
    """

    region: str
    reference: str
    alignment: str
    data_range: float | None
    n_voxels: int
    values: dict[str, float | None]
    identical: bool = False
    note: str = ""
    volume: str = AS_RETURNED

    @classmethod
    def none(cls, region: str, metrics: Iterable[str], why: str) -> "Score":
        """Return a score without numbers, and why there are none."""
        empty = dict.fromkeys(metrics)
        return cls(
            region=region, reference="none", alignment="none", data_range=None, n_voxels=0, values=empty, note=why
        )


def lacks_twin(scores: dict[str, Score]) -> bool:
    """Whether to score a volume again: it was scored without its twin, though there may be one.

    A method that skipped the twin for a reason would skip it again.
    """
    note = scores["artefact"].note if "artefact" in scores else ""
    return note == NOT_ASKED or (note.startswith(TWIN_ENDED) and not note.startswith(f"{TWIN_ENDED} skipped"))


@dataclass(frozen=True, slots=True)
class Metric:
    """How a metric is shown: title, decimals, which way is better ("max", "min", "one" = nearest 1), and a factor."""

    title: str
    digits: int
    better: Literal["", "max", "min", "one"] = ""
    scale: float = 1.0


NO_REFERENCE = "no_reference"
"""The protocol of measured scans, which have no truth."""
PROJECTION = "projection"
"""The protocol of views that no method saw."""
KERMA = "kerma"  # a scan's air kerma, not a run's cost, but tables show it there
_IMAGE = {"psnr3d": Metric("PSNR3D (dB)", 2, "max"), "ssim3d": Metric("SSIM3D", 3, "max")}

COLUMNS: dict[str, dict[str, Metric]] = {
    "tissue": _IMAGE,
    "aligned": {**_IMAGE, "gain": Metric("gain", 3)},
    "aligned_50kev": {**_IMAGE, "gain": Metric("gain", 3)},
    "paper": {
        **_IMAGE,
        "psnr3d_full_gtmax": Metric("psnr3d_full_gtmax", 2, "max"),
        "psnr3d_r2": Metric("psnr3d_r2", 2, "max"),
        "ssim3d_r2": Metric("ssim3d_r2", 3, "max"),
        "ssim3d_naf": Metric("ssim3d_naf", 3, "max"),
    },
    "soft": {
        **_IMAGE,
        "rmse": Metric("RMSE (HU)", 1, "min"),
        "contrast": Metric("contrast left", 3, "one"),
        "cnr": Metric("CNR", 2, "max"),
        "worst_bias": Metric("bias of the worst class (HU)", 1),
        "worst_rmse": Metric("RMSE of the worst class (HU)", 1, "min"),
        "fine_contrast": Metric("fine structures: contrast left", 3, "one"),
        "fine_cnr": Metric("fine structures: CNR", 2, "max"),
        "noise_near": Metric("noise near (HU)", 1),
        "noise_far": Metric("noise far (HU)", 1),
        "grain_near": Metric("noise correlation near", 2),
        "grain_far": Metric("noise correlation far", 2),
        "mtf50_near": Metric("MTF50 near metal (1/mm)", 3, "max"),
        "mtf50_far": Metric("MTF50 far from it (1/mm)", 3, "max"),
    },
    "structure": {
        "false_bone": Metric("false bone (%)", 2, "min", 100),
        "false_air": Metric("false air (%)", 2, "min", 100),
        "false_bone_near": Metric("false bone near (%)", 2, "min", 100),
        "false_bone_between": Metric("false bone between (%)", 2, "min", 100),
        "false_air_near": Metric("false air near (%)", 2, "min", 100),
        "false_air_between": Metric("false air between (%)", 2, "min", 100),
        "bias_between": Metric("bias between (HU)", 0),
        "rmse_between": Metric("RMSE between (HU)", 0, "min"),
    },
    "metal": {
        "core_ratio": Metric("core ratio", 3, "one"),
        "dice": Metric("Dice", 3, "max"),
        "boundary_rms": Metric("boundary RMS (mm)", 3, "min"),
    },
    "artefact": {
        "roi_std": Metric("ROI std (HU)", 1, "min"),
        "cupping": Metric("excess cupping (points)", 2, "min"),
        "streak": Metric("streak (HU)", 1, "min"),
        "rmse": Metric("RMSE (HU)", 1, "min"),
        "rmse_near": Metric("RMSE near (HU)", 1, "min"),
        "rmse_far": Metric("RMSE far (HU)", 1, "min"),
    },
    PROJECTION: {
        "noise_free/outside": Metric("RMSE P, outside trace", 4, "min"),
        "effective/outside": Metric("RMSE effective, outside trace", 4, "min"),
        "effective/trace": Metric("RMSE effective, in trace", 3, "min"),
        "50kev/outside": Metric("RMSE 50 keV, outside trace", 4, "min"),
        "50kev/trace": Metric("RMSE 50 keV, in trace", 3, "min"),
    },
    NO_REFERENCE: {
        "air_streak": Metric("streaks in air (HU)", 1, "min"),
        "air_entropy": Metric("entropy of air (bits)", 2, "min"),
        "artefact_index": Metric("artefact index (HU)", 1, "min"),
        "held/outside": Metric("RMSE P, held out, outside trace", 4, "min"),
        "held/trace": Metric("RMSE P, held out, in trace", 3, "min"),
    },
    "metal_cost": {
        "own_db": Metric("against its own twin (dB)", 2, "min"),
        "fdk_db": Metric("against FDK without metal (dB)", 2, "min"),
        "own_hu": Metric("against its own twin (HU)", 1, "min"),
        "fdk_hu": Metric("against FDK without metal (HU)", 1, "min"),
        "own_bone": Metric("false bone against its own twin (points)", 2, "min", 100),
        "own_air": Metric("false air against its own twin (points)", 2, "min", 100),
    },
    "against": {
        "over_fdk": Metric("over FDK (dB)", 2, "max"),
        "over_nmar": Metric("over NMAR (dB)", 2, "max"),
    },
    "anchored": {
        "tissue/rmse": Metric("s tissue RMSE", 3, "min"),
        "tissue/ssim3d": Metric("s tissue 1 − SSIM3D", 3, "min"),
        "aligned/rmse": Metric("s aligned RMSE", 3, "min"),
        "artefact/streak": Metric("s streak", 3, "min"),
        "artefact/rmse_near": Metric("s RMSE near", 3, "min"),
    },
    "cost": {
        "wall": Metric("wall (s)", 2, "min"),
        "cpu": Metric("CPU (s)", 2, "min"),
        "peak_bytes": Metric("peak (MiB)", 0, "min", 1 / 2**20),
        "view_updates": Metric("view updates", 0),
        "warm_up": Metric("warm-up (s)", 2),
        KERMA: Metric("air kerma (mGy)", 3),
    },
}
"""The metrics that tables show of each protocol, in order."""

PROTOCOLS = (
    *("paper", "tissue", "aligned", "aligned_50kev", "metal"),
    *("soft", "structure", PROJECTION, "artefact"),
)
"""The protocols that one volume of a simulated scan is scored under."""

NEED_TRUTH = tuple(protocol for protocol in COLUMNS if protocol not in (NO_REFERENCE, "cost"))
"""The protocols that a scan without truth is not scored under."""

MAIN: dict[tuple[str, str], Metric] = {
    ("tissue", "psnr3d"): _IMAGE["psnr3d"],
    ("tissue", "ssim3d"): _IMAGE["ssim3d"],
    ("metal_cost", "own_db"): Metric("cost of metal (dB)", 2, "min"),
    ("metal_cost", "fdk_db"): Metric("short of FDK without metal (dB)", 2, "min"),
    ("structure", "false_bone"): Metric("false bone (%)", 2, "min", 100),
    ("structure", "false_air"): Metric("false air (%)", 2, "min", 100),
    ("structure", "false_bone_between"): Metric("false bone between metal (%)", 2, "min", 100),
    ("structure", "rmse_between"): Metric("RMSE between metal (HU)", 0, "min"),
    ("soft", "rmse"): Metric("soft tissue RMSE (HU)", 1, "min"),
    ("cost", "wall"): Metric("wall (s)", 2, "min"),
}
"""Protocol and metric of the main table's columns: one or two of the protocols that matter most."""

MAIN_ACROSS: dict[tuple[str, str], Metric] = {
    ("soft", "rmse"): MAIN["soft", "rmse"],
    ("artefact", "rmse"): Metric("artefact RMSE (HU)", 1, "min"),
    ("metal_cost", "own_hu"): Metric("cost of metal (HU)", 1, "min"),
    ("metal_cost", "fdk_hu"): Metric("short of FDK without metal (HU)", 1, "min"),
    ("structure", "false_bone"): MAIN["structure", "false_bone"],
    ("structure", "false_air"): MAIN["structure", "false_air"],
    ("structure", "false_bone_between"): MAIN["structure", "false_bone_between"],
    ("structure", "rmse_between"): MAIN["structure", "rmse_between"],
    ("tissue", "psnr3d"): _IMAGE["psnr3d"],
    ("tissue", "ssim3d"): _IMAGE["ssim3d"],
    ("cost", "wall"): MAIN["cost", "wall"],
}
"""The same where scanners are compared: HU first, since the range that dB are taken of moves with the spectrum."""

MAIN_MEASURED: dict[tuple[str, str], Metric] = {
    **{(NO_REFERENCE, metric): how for metric, how in COLUMNS[NO_REFERENCE].items()},
    ("cost", "wall"): MAIN["cost", "wall"],
}
"""The same where no scan has a truth."""

FDK, NMAR = "fdk", "nmar"
FDK_ROWS = (FDK, "fdk-ramp")
"""The rows without correction of any kind, with any filter: the best of them on the twin is what metal could leave."""
ANCHORED = {
    "tissue": ("rmse", "ssim3d"),
    "aligned": ("rmse", "ssim3d"),
    "aligned_50kev": ("rmse", "ssim3d"),
    "artefact": ("roi_std", "cupping", "streak", "rmse", "rmse_near", "rmse_far"),
}
"""The metrics that have an anchored score. FDK's `artefact` error without the metal is 0 by definition."""
LOST = {
    ("tissue", "psnr3d"): ("db", -1.0),
    ("soft", "rmse"): ("hu", 1.0),
    ("structure", "false_bone"): ("bone", 1.0),
    ("structure", "false_air"): ("air", 1.0),
}
"""What the cost of metal is taken of: (protocol, metric) -> its name's end, and the sign of what is worse."""
LEAST_LOSS = 0.25
"""An anchored score exists where the metal raises FDK's error by more than this share of its error without: for
`artefact`, whose error without is 0 by definition, the RMSE under `tissue`."""
COMPARED = {
    **ANCHORED,
    "tissue": ("psnr3d", *ANCHORED["tissue"]),
    "soft": ("rmse",),
    "structure": ("false_bone", "false_air"),
}
"""The metrics that costs, gains or anchored scores are derived from."""

Place = tuple[str, int, str, str, str, str]
"""Scene, seed, variant, method, protocol, metric."""


class SeedValue(NamedTuple):
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
    """Return the label to compare with: `name` itself, else the first with parameters, such as nmar[mask=oracle].

    A name that goes on behind a hyphen, such as fdk-ramp, is another method.
    """
    labels = list(dict.fromkeys(labels))
    return name if name in labels else next((x for x in labels if x.startswith(f"{name}[")), None)


def error(metric: str, value: float) -> float:
    """Return a metric as an error that is 0 at best: 1 − SSIM3D, any other as it is."""
    return 1 - value if metric.startswith("ssim3d") else value


def anchored(e: float, e_reference: float, e_fdk: float) -> float | None:
    """Return (e − e_ref) / (e_FDK − e_ref); None where metal costs FDK no more than a quarter of that without."""
    loss = e_fdk - e_reference
    return (e - e_reference) / loss if loss > LEAST_LOSS * e_reference else None


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


def derived(rows: list[SeedValue]) -> list[SeedValue]:
    """Derive the rows of `metal_cost`, `against` (dB of tissue PSNR3D) and `anchored` ("protocol/metric").

    Comparisons are made within one scene and seed, between runs that ended well.
    """
    scored = [row for row in rows if row.status == OK and row.value is not None and row.value == row.value]
    labels = dict.fromkeys(row.method for row in scored if row.variant == "metal")
    bases = {name: row_of(name, labels) for name in (FDK, NMAR)}
    values = {_place(row, row.method, row.variant): row.value for row in scored}
    filtered = [label for label in labels if label.partition("[")[0] in FDK_ROWS]
    found = []
    for row in scored:
        if row.variant == "metal":
            pairs = _costs(row, values, filtered) + _gains(row, values, bases) + _anchors(row, values)
            found += [row._replace(protocol=p, metric=m, value=v, identical=False) for p, m, v in pairs]
    return found


def _place(row: SeedValue, method: str, variant: str) -> Place:
    return row.scene, row.seed, variant, method, row.protocol, row.metric


def _costs(row: SeedValue, values: dict[Place, float | None], filtered: Sequence[str]) -> list[tuple[str, str, float]]:
    """Return what the metal costs a method against its own twin, and against the best FDK of the twin.

    The second is no win for a method that erases with and without metal alike.
    """
    if (row.protocol, row.metric) not in LOST or row.value is None:
        return []
    unit, sign = LOST[row.protocol, row.metric]
    own = values.get(_place(row, row.method, "metal_free"))
    clean = [v for label in filtered if (v := values.get(_place(row, label, "metal_free"))) is not None]
    found = [] if own is None else [("metal_cost", f"own_{unit}", sign * (row.value - own) + 0.0)]
    if clean:
        best = min(clean, key=lambda v: sign * v)
        found.append(("metal_cost", f"fdk_{unit}", sign * (row.value - best) + 0.0))
    return found


def _gains(
    row: SeedValue, values: dict[Place, float | None], bases: dict[str, str | None]
) -> list[tuple[str, str, float]]:
    """Return the gain in tissue PSNR3D over FDK and over NMAR, if they ran."""
    if row.metric != "psnr3d" or row.protocol != "tissue" or row.value is None:
        return []
    found = []
    for name, label in bases.items():
        base = None if label is None else values.get(_place(row, label, "metal"))
        found += [] if base is None else [("against", f"over_{name}", row.value - base)]
    return found


def _anchors(row: SeedValue, values: dict[Place, float | None]) -> list[tuple[str, str, float]]:
    """Return a metric's anchored score, if FDK ran on the scan and its twin."""
    protocol, metric = row.protocol, row.metric
    if metric not in ANCHORED.get(protocol, ()) or row.value is None:
        return []
    worst = values.get(_place(row, FDK, "metal"))
    if protocol == "artefact":
        # an artefact is a difference from the twin, so the twin's own is 0
        tissue = row._replace(protocol="tissue", metric="rmse")
        with_it, without = (values.get(_place(tissue, FDK, variant)) for variant in ("metal", "metal_free"))
        matters = with_it is not None and without is not None and anchored(0.0, without, with_it) is not None
        best = error(metric, 0.0) if matters else None
    else:
        best = values.get(_place(row, FDK, "metal_free"))
    if worst is None or best is None:
        return []
    s = anchored(error(metric, row.value), error(metric, best), error(metric, worst))
    return [] if s is None else [("anchored", f"{protocol}/{metric}", s)]
