"""`run-benchmark stress RESULTS`: numerical stress, each case with an expected outcome.

Listing the rows simulates and reconstructs nothing.
"""

import functools
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from ctsim.beam.quadrature import P_MAX
from ctsim.benchmarks.engine import host, study
from ctsim.benchmarks.engine.record import Found, Record, Task, latest
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.methods import CONTROLS, TABLE, Method, find
from ctsim.benchmarks.studies.stress import Flags, suite
from ctsim.benchmarks.studies.stress.suite import Scene, load
from ctsim.dataset.versions import code_version
from ctsim.errors import InputError
from ctsim.human import human_choice

SIMULATOR, SPLAT_KERNELS = "simulator", "splat kernels"  # subjects other than methods
# of a row, short and full, for one idle core; derived from runs on a busy machine
SECONDS = {SIMULATOR: (0.3, 0.6), SPLAT_KERNELS: (0.1, 0.1)}
SECONDS_OF_METHOD = (0.2, 0.5)
STEPS = 100  # of the published splats, whose default of 20000 takes hours; splats are added from step 500
FIELD_STEPS = 80  # of fields
VARIANTS: dict[str, tuple[dict[str, Any], ...]] = {
    "splat": ({}, {"response": "known"}),
    "splat-paper": ({"steps": STEPS},),
    "splat-r2": ({"steps": STEPS},),
    **{name: ({"steps": FIELD_STEPS},) for name in suite.FIELDS},
}
"""Parameter sets of methods that do not run with their defaults only."""

CLOSED_FORM = f"|ΔP| ≤ {suite.P_SURE:g} of the float64 closed form where P ≤ {P_MAX:g}, finite beyond"
MASS = f"mass on the grid within {suite.MASS:g}"
CHECKS = {
    "ten-photons": "mean count within five standard errors",
    "tungsten-120mm": "the pedestal everywhere",
    "full-scale": "half of the open readings at full scale, none wraps",
    "no-metal": "the bits of the metal-free twin of a body with metal, and no twin",
    "duplicate-views": "equal views have equal bits",
    "450kvp": "the bundled table refuses by name",
}
"""Further expectations of the simulator, by scene."""

ODD = "finite, and the other splats keep their bits"
FLAT, NARROW, THREADS = "solids of no thickness", "float32 against float64", "1, 2 and all threads"
PEAK = f"within {suite.PROJECTED:g} of float64's peak"
BITS = "equal to the last bit"
PROGRAMS = {
    SIMULATOR: (
        ("flat-solids", FLAT, "the bits of the scan without them; negative sizes refused"),
        ("float64", NARROW, f"|ΔP| ≤ {suite.FLOAT32:g}, sub-rays included"),
        ("threads", THREADS, f"{BITS}, views in any order, too"),
    ),
    SPLAT_KERNELS: (
        ("needles", "needles and discs of 20000:1", f"{PEAK}; finite gradient"),
        ("sub-pixel", "splats far smaller than a pixel", PEAK),
        ("behind-source", "splats behind, at and next to the source", f"{ODD}; not seen in that view"),
        ("outside", "splats that no ray meets", f"{ODD}; not seen"),
        ("empty-set", "no splats", "zeros of the right shapes"),
        ("nan-seed", "a splat of NaN or infinity", f"{ODD}; not seen, and dropped"),
        ("opaque", "path values up to 1e4", f"the response within {suite.RESPONDED:g} of float64"),
        ("float64", NARROW, f"many splats of all shapes {PEAK}"),
        ("threads", THREADS, f"{BITS}, views in another order, too"),
    ),
    "fdk": (("float64", NARROW, f"closed-form P and FDK in float64 as far off as |ΔP| ≤ {suite.P_SURE:g} allows"),),
}
"""Rows without a scene: case, what it is, what is expected. `worker` has the functions that judge them."""


class StressRow(NamedTuple):
    """One row: a scene, a method (name and settings), both or neither.

    `subject` is SIMULATOR, SPLAT_KERNELS or a method's label. `code` hashes the scene and the sources.
    """

    case: str
    subject: str
    what: str
    expected: str
    code: str
    method: tuple[str, dict[str, Any]] | None = None
    scene: Scene | None = None


@functools.lru_cache
def catalogue(path: Path | None = None, methods: tuple[str, ...] = ()) -> dict[tuple[str, str], StressRow]:
    """Return all rows by (case, subject), or only those of `methods`. Methods run on the scenes of the file at `path`.

    Raises InputError for an invalid file and an unknown method.
    """
    chosen = [*_of_methods(load(path), methods)]
    own = [] if methods else [*_of_simulator(), *_programs(SPLAT_KERNELS, "kernels")]
    chain = [*_programs("fdk", "methods")] if "fdk" in (methods or TABLE) else []
    return {(row.case, row.subject): row for row in (*own, *chain, *chosen)}


def subjects(names: Sequence[str] = ()) -> list[tuple[str, dict[str, Any]]]:
    """Return the named methods, by default all of the table but its controls, each with its parameter sets."""
    usual = [name for name, (_, inputs) in TABLE.items() if inputs not in CONTROLS]
    return [(name, given) for name in dict.fromkeys(names or usual) for given in VARIANTS.get(name, ({},))]


def label(name: str, given: dict[str, Any]) -> str:
    """Return a method's label without loading the method."""
    return Method(name=name, target="", inputs="", params={}, overrides=given).label


def _code(module: str) -> str:
    return code_version(f"ctsim.benchmarks.studies.stress.{module}")


def _programs(subject: str, module: str) -> Iterator[StressRow]:
    for case, what, expected in PROGRAMS[subject]:
        yield StressRow(case, subject, what, expected, _code(module))


def _of_simulator() -> Iterator[StressRow]:
    for scene in load():
        if scene.simulated:
            words = (CLOSED_FORM, MASS if scene.lone else "", CHECKS.get(scene.name, ""))
            expected, code = "; ".join(filter(None, words)), _code("kernels") + scene.digest
            yield StressRow(scene.name, SIMULATOR, scene.what, expected, code, scene=scene)
    yield from _programs(SIMULATOR, "kernels")


def _of_methods(scenes: Sequence[Scene], names: Sequence[str]) -> Iterator[StressRow]:
    """Yield all methods on each scene in turn, so that they share its scan."""
    methods = [(method, label(*method), _code("methods") + _code_of(method[0])) for method in subjects(names)]
    for scene in scenes:
        for method, named, code in methods if scene.methods else ():
            expected = _expected(method[0], scene)
            yield StressRow(scene.name, named, scene.what, expected, code + scene.digest, method, scene)
    for method, named, code in methods:
        yield StressRow("threads", named, THREADS, BITS, code, method)


def _code_of(name: str) -> str:
    """Hash a method's sources; methods of the table are not imported."""
    return code_version(TABLE[name][0].partition(":")[0]) if name in TABLE else find(name).code


def _expected(name: str, scene: Scene) -> str:
    bounds = f"{suite.BOUNDS[name]:g} times " if name in suite.BOUNDS else ""
    words = [f"finite, within {bounds}the bound of values" + ("; status ok" if scene.near else " or diverged")]
    if scene.unlit:
        words.append("a status other than ok, and its reason")
    if scene.near:
        words.append(f"error ≤ {suite.NEAR:g} of an empty volume's, or its limitation said")
    if scene.has_other(name):
        words.append(f"as the other form of the scan to {suite.same_of(name):g}")
    return "; ".join(words)


# --- the command ----------------------------------------------------------------------------------------------


class Judged(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a row ended: `found` says it in words; `seconds` has its time under "row"."""

    found: str = ""

    @property
    def words(self) -> str:
        """The finding, or how the row ended without one."""
        return self.found or f"NOT EXPECTED: {self.reason}"

    @property
    def took(self) -> float:
        """The seconds of the row, 0 if it did not end."""
        return sum(self.seconds.get("row", ()))


class StressRecord(Record[Judged], frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The record of a row: one outcome."""

    @property
    def finished(self) -> bool:
        """Always true: a crash or a timeout is a finding too, and the last one counts."""
        return True


class Stress(study.Study[Record[Judged], Flags]):
    """The study."""

    name = file = "stress"
    unit = "row"
    kind, record, flags = Judged, StressRecord, Flags
    work = "ctsim.benchmarks.studies.stress.worker:judge"
    isolated = True
    estimate = "on one idle core, without compiling (a minute)"

    def __init__(self) -> None:
        self.threads = host.threads()  # of a row; its process has at least two, to compare with one

    def environment(self, given: Flags) -> Mapping[str, str]:
        """Allow the process at least two threads."""
        return {"NUMBA_NUM_THREADS": str(max(2, self.threads))}

    def measure(self, task: Task, given: Flags) -> Sequence[Judged]:
        """Judge a row on the available threads."""
        return super().measure(msgspec.structs.replace(task, hints={"threads": self.threads}), given)

    def rows(self, given: Flags) -> dict[tuple[str, str], StressRow]:
        """Return the rows by (case, subject)."""
        return catalogue(given.suite, given.method)

    def check(self, given: Flags) -> None:
        """Refuse unknown cases."""
        known = list(dict.fromkeys(case for case, _ in self.rows(given)))
        for name in given.case:
            if name not in known:
                raise InputError(f"--case {name!r}: expected one of {human_choice(known, name)}")

    def tasks(self, given: Flags) -> list[Task]:
        """Return a task for each row."""
        side = suite.SHORT if given.short else suite.FULL
        rows = [row for row in self.rows(given).values() if not given.case or row.case in given.case]
        return [
            Task(
                study=self.name, part=part(given), case=row.case, subject=row.subject, code=row.code, place=(place,),
                settings={"side": side, "expected": row.expected}, hints={"what": row.what},
            )
            for place, row in enumerate(rows)
        ]  # fmt: skip

    def shows(self, task: Task, given: Flags) -> bool:
        """Whether a row was asked for."""
        asked = not given.case or task.case in given.case
        return asked and task.part == part(given) and (task.case, task.subject) in self.rows(given)

    def pending(self, tasks: Sequence[Task], records: Sequence[Record[Judged]], given: Flags) -> list[Task]:
        """Return the rows that never ran, or were not as expected when they last ran."""
        last = {} if given.force else {r.task.identity: r.found[0].ok for r in records}
        return [task for task in tasks if not last.get(task.identity)]

    def expected(self, task: Task, given: Flags) -> float:
        """Return the usual seconds of the subject's rows."""
        return SECONDS.get(task.subject, SECONDS_OF_METHOD)[0 if given.short else 1]

    def took(self, record: Record[Judged], given: Flags) -> float | None:
        """Return the seconds that the row took, if it ended."""
        return record.found[0].took or None

    def line(self, task: Task) -> tuple[str, str]:
        """Return the case and what it is."""
        return task.case, task.hints["what"]

    def tables(self, records: Sequence[Record[Judged]], given: Flags) -> list[Table]:
        """Return three tables: what is not as expected, the cases, all rows."""
        side = records[0].task.settings["side"]
        caption = f"{side} voxels a side; {_how_many(records)}; {_seconds(records):.0f} s in all."
        rows = [
            [r.task.case, r.task.subject, r.task.settings["expected"], one.words, "yes" if one.ok else "NO"]
            for r in records
            for one in r.found[:1]
        ]
        wrong = [[case, subject, words] for case, subject, _, words, ok in rows if ok == "NO"]
        return [
            *[simple(["case", "subject", "found"], wrong, title="Not as expected", caption=caption)] * bool(wrong),
            by_case(records, "" if wrong else caption),
            simple(["case", "subject", "expected", "found", "ok"], rows, title="Rows"),
        ]

    def write(self, records: Sequence[Record[Judged]], given: Flags) -> str:
        """Write the tables; return what is not as expected. Warns of rows from other sources."""
        super().write(records, given)
        shown, path = latest(records), self.folder(given) / f"{self.file}.md"
        here = {task.identity for task in self.tasks(given)}
        if old := sum(r.task.identity not in here for r in shown):
            sys.stderr.write(f"{path}: {old} of {len(shown)} rows are of other sources than those that are here\n")
        wrong = (r for r in shown if not r.found[0].ok)
        named = "".join(f"NOT AS EXPECTED: {r.task.case}, {r.task.subject}: {r.found[0].words}\n" for r in wrong)
        return f"{named}{_how_many(shown)}. Written: {path}\n"


def part(given: Flags) -> str:
    """Return the name of the grid size."""
    return "short" if given.short else "full"


def by_case(records: Sequence[Record[Judged]], caption: str = "") -> Table:
    """Return a table of the cases: how many rows each has, and how many are as expected."""
    cases: dict[str, list[Record[Judged]]] = {}
    for record in records:
        cases.setdefault(record.task.case, []).append(record)
    rows = [
        [name, rows[-1].task.hints["what"], len(rows), sum(r.found[0].ok for r in rows), f"{_seconds(rows):.1f}"]
        for name, rows in cases.items()
    ]
    numbers = ("rows", "as expected", "s")
    return simple(["case", "what", *numbers], rows, numbers=numbers, title="Cases", caption=caption)


def _seconds(records: Sequence[Record[Judged]]) -> float:
    return sum(r.found[0].took for r in records)


def _how_many(records: Sequence[Record[Judged]]) -> str:
    return f"{sum(r.found[0].ok for r in records)} of {len(records)} rows are as expected"


def main(arguments: list[str]) -> int:
    """Run the command; 0 if every row is as expected, 1 if one is not."""
    return study.main(Stress(), arguments)
