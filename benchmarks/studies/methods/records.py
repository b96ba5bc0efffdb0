"""Runs of methods, their results, and the records of both.

Of several records of a run the last that ended well counts, else the last. Only records of this version of the
protocols count, and of a scene and seed only those of the newest data.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from ctsim.benchmarks.engine.record import Found, Record, Store, Task
from ctsim.benchmarks.engine.record import latest as latest_rows
from ctsim.benchmarks.methods import FAILED, TABLE
from ctsim.benchmarks.scores.score import VERSION, Score
from ctsim.benchmarks.studies.methods.grids import shared_text
from ctsim.benchmarks.studies.methods.splits import trained_text
from ctsim.dataset.folder import mixture

STUDY, FILE, WHAT = "methods", "records", "a record of run-benchmark"
NAME = f"{FILE}.jsonl"
METAL, TWIN = "metal", "metal_free"
SUBMITTED, STATED = "submitted", "stated"
"""The method of a volume that was made elsewhere, and the device of seconds that somebody stated."""


class Cost(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The cost of a run: seconds without warm-up, bytes, views used times passes; None where it is not known."""

    wall: float
    cpu: float | None = None
    peak_bytes: int | None = None
    view_updates: int | None = None
    device: str
    warm_up: float = 0.0
    isolated: bool = False


class Run(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scene's seed and recipe, and a method ("module:function") with its parameters.

    `variant` is "metal" for the scan itself and "metal_free" for its twin; `mask` names the source of a metal mask
    ("none", "oracle", "auto"). The method of a volume that was made elsewhere is "submitted".
    """

    scene: str
    scene_id: str
    seed: int
    method: str
    params: dict[str, Any]
    mask: str = "none"
    variant: str = METAL


class RunTask(Task, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A run as a task: `data` hashes the scan's files, `code` the method's sources; `version` is that of the protocols.

    `place` numbers the scan in its dataset and the method in its command.
    """

    settings: Run  # pyright: ignore[reportGeneralTypeIssues, reportIncompatibleVariableOverride]


class Result(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a run ended: scores by protocol, cost, and the details that the method gives of its volume.

    `inputs` is what the method needs in addition to the counts; `files["volume"]` its kept volume; `data_code` hashes
    the code of the simulator that made the scan (empty: unknown). `kerma` is the scan's air kerma (mGy) at the
    isocentre (None: the scan or the record is older); `phantom` hashes the labels of the scan (empty: it has none, or
    the record is older).
    """

    inputs: str = ""
    scores: dict[str, Score] = msgspec.field(default_factory=dict)
    cost: Cost | None = None
    details: dict[str, Any] = msgspec.field(default_factory=dict)
    data_code: str = ""
    kerma: float | None = None
    phantom: str = ""


class RunRecord(Record[Result], frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The record of a run."""

    task: RunTask

    @property
    def run(self) -> Run:
        """The scene and the method of the run."""
        return self.task.settings

    @property
    def label(self) -> str:
        """The method with the parameters that differ from its defaults."""
        return self.task.subject

    @property
    def identity(self) -> str:
        """The identity of the task."""
        return self.task.identity

    @property
    def reason(self) -> str:
        """The reason of the status."""
        return self.found[0].reason

    @property
    def inputs(self) -> str:
        """What the method needs in addition to the counts."""
        return self.found[0].inputs

    @property
    def scores(self) -> dict[str, Score]:
        """The scores by protocol."""
        return self.found[0].scores

    @property
    def cost(self) -> Cost | None:
        """The cost; None where it did not run."""
        return self.found[0].cost

    @property
    def volume(self) -> str | None:
        """The path of the kept volume relative to the results folder; None where none is kept."""
        return self.found[0].files.get("volume")

    @property
    def details(self) -> dict[str, Any]:
        """The details that the method gives of its volume."""
        return self.found[0].details

    @property
    def data_code(self) -> str:
        """The hash of the simulator's code that made the scan."""
        return self.found[0].data_code

    @property
    def kerma(self) -> float | None:
        """The scan's air kerma (mGy) at the isocentre; None where it is unknown."""
        return self.found[0].kerma

    @property
    def phantom(self) -> str:
        """The hash of the labels of the scan; empty where it is unknown."""
        return self.found[0].phantom


def case_of(run: Run) -> str:
    """Return the case of a run: its scene and seed."""
    return f"{run.scene}, seed {run.seed}"


def task_of(run: Run, label: str, *, data: str, code: str, place: tuple[int, int] = (0, 0), **hints: Any) -> RunTask:
    """Return the task of a run; `hints` tell a worker where the scan and the method are."""
    return RunTask(
        study=STUDY,
        part=run.variant,
        case=case_of(run),
        subject=label,
        settings=run,
        data=data,
        code=code,
        version=VERSION,
        place=place,
        hints=hints,
    )


def read(results: Path) -> list[RunRecord]:
    """Read the records of a results folder, oldest first. Raises InputError where a line is not a record."""
    return Store(results, FILE, RunRecord, WHAT).read()


def latest(records: Sequence[RunRecord]) -> list[RunRecord]:
    """Return the records that a table shows: the last of each scene, seed, variant and method label.

    They are in the order of the dataset, of the methods table and of the command, not in that of the runs' ends.
    """
    data = {r.task.case: (r.run.scene_id, r.task.data) for r in records if r.task.version == VERSION}
    known = [r for r in records if data.get(r.task.case) == (r.run.scene_id, r.task.data) and r.task.version == VERSION]
    kept = latest_rows(known)
    scenes: dict[str, int] = {}
    labels: dict[str, int] = {}
    for record in kept:
        scene, method = record.task.place
        scenes[record.run.scene] = min(scene, scenes.get(record.run.scene, scene))
        labels[record.label] = min(method, labels.get(record.label, method))
    columns = {scene: k for k, scene in enumerate(sorted(scenes, key=lambda scene: scenes[scene]))}
    ranked = sorted(labels, key=lambda label: (rank(label), labels[label]))
    methods = {label: k for k, label in enumerate(ranked)}
    return sorted(kept, key=lambda r: (columns[r.run.scene], r.run.seed, methods[r.label], r.run.variant == METAL))


def rank(label: str) -> int:
    """Return the place of a method in the methods table by its label; other methods come last."""
    return list(TABLE).index(name) if (name := label.partition("[")[0]) in TABLE else len(TABLE)


def outdated(records: Sequence[RunRecord]) -> str:
    """Say in one sentence how many records have other protocol versions and are left out; "" if none."""
    others = [r.task.version for r in records if r.task.version != VERSION]
    if not others:
        return ""
    versions = ", ".join(str(v) for v in sorted(set(others)))
    return (
        f"{len(others)} of {len(records)} records are of protocol version {versions} and left out: "
        f"this is version {VERSION}, run the methods again"
    )


def remarks(records: Sequence[RunRecord]) -> list[str]:
    """Say what tables of these records leave out and what they mix, each as a sentence without a full stop."""
    shown = latest(records)
    known = {r.task.data: r.data_code for r in shown if r.data_code}
    made = {f"{r.run.scene} (seed {r.run.seed})": known.get(r.task.data, "") for r in shown}
    details = {f"{r.label} on {r.run.scene}": r.details for r in shown}
    flattered = shared_text(details), trained_text(details)
    said = outdated(records), mixture(made.items()), *flattered, _stated(shown), doubtful(shown), _limits(shown)
    return [text for text in said if text]


def _stated(shown: Sequence[RunRecord]) -> str:
    """Say whose seconds were not measured here; "" where all were."""
    labels = dict.fromkeys(r.label for r in shown if r.cost is not None and r.cost.device == STATED)
    return f"not measured but stated: the seconds of {', '.join(labels)}" if labels else ""


def doubtful(shown: Sequence[RunRecord]) -> str:
    """Say what a dagger means; "" where no method has one."""
    rules = {r.label: FAILED[r.label] for r in shown if r.label in FAILED}
    listed = ", ".join(f"{label} {rule}" for label, rule in rules.items())
    return f"†: failed these rules of `run-benchmark reproduce --neural`: {listed}" if rules else ""


def _limits(shown: Sequence[RunRecord]) -> str:
    """Say which volumes come with a limitation that their method states; "" where none does."""
    runs: dict[tuple[str, str], list[str]] = {}
    for r in shown:
        if r.run.variant == METAL and (text := r.details.get("limitation")):
            runs.setdefault((r.label, str(text)), []).append(f"{r.run.scene} (seed {r.run.seed})")
    listed = (f"{label} on {', '.join(cases)}: {text}" for (label, text), cases in runs.items())
    return f"limits that methods state of their volumes: {'; '.join(listed)}" if runs else ""
