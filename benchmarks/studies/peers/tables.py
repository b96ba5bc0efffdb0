"""The tables of `run-benchmark peers`: what was measured, and what that says about the targets."""

from collections.abc import Callable, Sequence
from statistics import median
from typing import NamedTuple

from ctsim.benchmarks.engine.record import OK, Record, provenance
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.studies.peers.finding import FULL, OURS, SIDES, Measurement, versions

TARGETS: dict[str, dict[str, float]] = {
    "paths": {"time ratio": 0.25},
    "exact": {"relative RMS": 1e-4},
    "paper": {"seconds": 60.0, "peak GB": 2.0},
    "fdk": {"time ratio": 1 / 3, "error ratio": 1.02},  # 2 %: what interpolation of the filtered rows may differ by
    "poly": {"peak GB": 0.5, "time ratio": 0.2, "error ratio": 0.2},
}
"""The most that each quantity of ours may reach; ratios are to the best peer."""
EXACT = f"{OURS}, exact solids"  # the only one of ours with a target in the case `exact`


class Verdict(NamedTuple):
    """A target: on which scene, what of, what was measured, relative to which peer, and the limit."""

    scene: str
    quantity: str
    value: float
    peer: str
    limit: float

    @property
    def met(self) -> bool:
        """Whether the target is met."""
        return self.value <= self.limit


def verdicts(case: str, found: Sequence[Measurement]) -> list[Verdict]:
    """Compare all of ours with the targets of their case; those that need a peer are left out where there is none."""
    out: list[Verdict] = []
    measured = [m for m in found if m.status == OK]
    for m in measured:
        who, _, how = m.contender.partition(", ")
        if who != OURS or (case == "exact" and m.contender != EXACT):
            continue
        peers = [p for p in measured if p.scene == m.scene and p.contender.partition(",")[0] != OURS]
        reached, scene = _reached(m, peers), f"{m.scene} ({how})" if how else m.scene
        targets = TARGETS.get(case, {})
        out += [Verdict(scene, what, *reached[what], limit) for what, limit in targets.items() if what in reached]
    return out


def _reached(m: Measurement, peers: Sequence[Measurement]) -> dict[str, tuple[float, str]]:
    """Return the quantities of ours, and the peer each is relative to: the fastest one, or the most accurate one."""
    out: dict[str, tuple[float, str]] = {}
    if m.runs:
        out["seconds"] = median(m.runs), ""
        if timed := [p for p in peers if p.runs]:
            best = min(timed, key=lambda p: median(p.runs))
            # the median over neighbouring runs, which drifts of the machine hardly touch
            out["time ratio"] = median(a / b for a, b in zip(m.runs, best.runs, strict=False)), best.contender
    if m.error is not None:
        out["relative RMS"] = m.error, ""
        if errors := {p.contender: p.error for p in peers if p.error}:
            best = min(errors, key=errors.__getitem__)
            out["error ratio"] = m.error / errors[best], best
    if m.peak_bytes is not None:
        out["peak GB"] = m.peak_bytes / 1e9, ""
    return out


def judged(records: Sequence[Record[Measurement]]) -> list[Table]:
    """Return the table of targets, none where there are none."""
    rows = [
        (
            *(r.task.case, v.scene, v.quantity, v.peer or "–"),
            *(f"{v.value:.3g}", f"≤ {v.limit:.3g}", "yes" if v.met else "NO"),
        )
        for r in records
        for v in verdicts(r.task.case, r.found)
    ]
    columns = ("case", "scene", "quantity", "best peer", "reached", "target", "met")
    return [simple(columns, rows, numbers=("reached", "target"))] if rows else []


def measured(records: Sequence[Record[Measurement]], part: str) -> Table:
    """Return the table of measurements on grids of one size."""
    caption = (
        f"Grids of side {SIDES[part]}. Medians of interleaved runs; ratios of time are medians over pairs, each to the "
        "peer that is best in that quantity."
    )
    if part != FULL:
        caption += " Grids this small are all overhead: they prove the command, not the speed, and meet no target."
    rows = [[cell(r.task.case, m) for cell in COLUMNS.values()] for r in records for m in r.found]
    return simple(
        list(COLUMNS), rows, numbers=("s", "ms/view", "error", "peak (MB)"), caption=caption, notes=_sources(records)
    )


def _sources(records: Sequence[Record[Measurement]]) -> list[str]:
    """Say which peers were installed; where cases differ in that, in machine or commit, which is of which."""
    groups: dict[str, list[Record[Measurement]]] = {}
    for record in records:
        groups.setdefault(repr((record.host, record.commit, record.task.settings)), []).append(record)
    notes = []
    for group in groups.values():
        peers = ", ".join(f"{name} {version}" for name, version in versions(group[0].task).items()) or "none"
        cases = ", ".join(r.task.case for r in group)
        notes.append(f"{cases}: {provenance(group)} " * (len(groups) > 1) + f"Installed peers: {peers}.")
    return notes


COLUMNS: dict[str, Callable[[str, Measurement], str]] = {
    "case": lambda case, _: case,
    "scene": lambda _, m: m.scene,
    "contender": lambda _, m: m.contender,
    "s": lambda _, m: f"{median(m.runs):.3f}" if m.runs else m.skipped or (m.status if m.status != OK else "–"),
    "ms/view": lambda _, m: f"{1e3 * median(m.runs) / m.views:.2f}" if m.runs else "–",
    "error": lambda _, m: "–" if m.error is None else f"{m.error:.2e} {m.error_kind}",
    "peak (MB)": lambda _, m: "–" if m.peak_bytes is None else f"{m.peak_bytes / 1e6:.0f}",
    "note": lambda _, m: _note(m),
}


def _note(m: Measurement) -> str:
    first = "" if m.warm_up is None else f"first run {m.warm_up:.2f} s"
    return "; ".join(text for text in (m.reason, m.note, first) if text)
