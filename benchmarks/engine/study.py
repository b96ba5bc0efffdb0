"""The life of every measuring command: list tasks, skip what is recorded, measure, record, write tables."""

import contextlib
import functools
import pkgutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Annotated, Any, ClassVar, Generic, TypeVar

import tyro

from ctsim.benchmarks.engine import host
from ctsim.benchmarks.engine.host import check_workers, open_jobs
from ctsim.benchmarks.engine.process import Jobs, Lost, Process, Stopped, check_limit
from ctsim.benchmarks.engine.record import Found, Record, Store, Task, by_row, done, latest, provenance
from ctsim.benchmarks.engine.table import Table
from ctsim.benchmarks.engine.terminal import Bar
from ctsim.dataset.durable import write_synced
from ctsim.errors import InputError
from ctsim.human import human_time

SHARE = 0.1  # share of the time for writing tables while tasks are measured

Others = Annotated[tuple[Path, ...], tyro.conf.arg(metavar="OTHER [OTHER ...]")]


@dataclass(frozen=True, kw_only=True)
class Options:
    """The flags that every measuring command has."""

    seconds: float | None = None
    """Time limit of one task, compilation and the start of its process included; a task that exceeds it is recorded
    as a timeout, and the next one starts."""
    force: tyro.conf.FlagCreatePairsOff[bool] = False
    """Measure again what is recorded already."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """List what is left to measure and the time it is expected to take; write nothing."""
    table: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only write the tables from the records."""
    collect: Others = ()
    """Merge the records of these results folders, such as those of other machines, then only write the tables."""
    workers: int = 1
    """Processes that measure at the same time, each with its share of the cores; times are then those of a shared
    machine."""
    scheduler: Annotated[str | None, tyro.conf.arg(metavar="tcp://HOST:PORT")] = None
    """Measure on the workers of this Dask scheduler; they must see the same folders under the same names."""


@dataclass(frozen=True, kw_only=True)
class Flags(Options):
    """The flags of a command whose tasks are timed in turns."""

    results: tyro.conf.Positional[Path]
    """Folder for records and tables; created if missing."""
    repeats: int = 5
    """Timed runs of each task; tables show medians."""


G = TypeVar("G", bound=Options)
R = TypeVar("R", bound=Record[Any])


class Study(Generic[R, G]):
    """A measuring command: its flags, its tasks, how a task is measured, and its tables.

    `name` is the command's word, `file` the name of its records, `unit` its word for a task. `kind` is the type of an
    outcome, `record` the type of a record. `work` names a function `work(task, given) -> Sequence[kind]` as
    "module:function"; it is imported where it runs. With `isolated` every task has a process of its own, also without a
    time limit. With `rounds` every task is measured once a round, so that all see the same drift of the machine. With
    `follows` the tables are also written while tasks are measured. `estimate` says what the seconds of --dry-run leave
    out.
    """

    name: ClassVar[str]
    file: ClassVar[str]
    unit: ClassVar[str] = "task"
    work: ClassVar[str]
    isolated: ClassVar[bool] = False
    rounds: ClassVar[bool] = False
    follows: ClassVar[bool] = False
    estimate: ClassVar[str] = "without compiling"
    kind: type[Found]
    record: type[R]
    flags: type[G]

    def check(self, given: G) -> None:
        """Raise InputError for flags that exclude each other; called first."""

    def folder(self, given: G) -> Path:
        """Return the results folder."""
        return given.results  # type: ignore[attr-defined]

    def store(self, given: G) -> Store[R]:
        """Return the records in the results folder."""
        return Store(self.folder(given), self.file, self.record, f"a record of run-benchmark {self.name}".rstrip())

    def prepare(self, given: G) -> None:
        """Make data that tasks need; called before `tasks`, not with --dry-run."""

    def tasks(self, given: G) -> Sequence[Any]:
        """Return the tasks that the flags ask for, in the order of the table. Simulates and reconstructs nothing."""
        raise NotImplementedError

    def repeats(self, given: G) -> int:
        """Return how many timed runs a task needs."""
        return getattr(given, "repeats", 1)

    def runs(self, task: Any, given: G) -> int:
        """Return how many timed runs this task needs; 1 if it is not timed."""
        return self.repeats(given)

    def machine(self, given: G) -> str:
        """Return what times depend on: the processor, its threads, and the number of tasks that share them."""
        shared = f", {given.workers} tasks at once" if given.workers > 1 else ""
        return host.machine() + (f", by {given.scheduler}" if given.scheduler else shared)

    def shows(self, task: Any, given: G) -> bool:
        """Whether the tables of these flags show a recorded task."""
        return True

    def pending(self, tasks: Sequence[Any], records: Sequence[R], given: G) -> Sequence[Any]:
        """Return the tasks that are not recorded, in the order in which they are to be measured."""
        records = [r for r in records if self.rounds or r.repeats >= self.runs(r.task, given)]
        known = done([] if given.force else records)
        rounds = range(self.repeats(given) if self.rounds else 1)
        # a commit with changes does not say what code ran
        return [t for n in rounds for t in tasks if known[t.identity] <= n or not host.certain(t.code)]

    def groups(self, left: Sequence[Any], records: Sequence[R]) -> Sequence[tuple[Any, ...]]:
        """Split tasks into groups; one worker measures a group, in this order."""
        return [(task,) for task in left]

    def expected(self, task: Any, given: G) -> float | None:
        """Return the expected seconds of a task without a record; None if unknown."""
        return None

    def took(self, record: R, given: G) -> float | None:
        """Return the expected seconds of a recorded task: all its timed runs, and one untimed first."""
        once = sum(median(s) for one in record.found for s in one.seconds.values() if s)
        return once * (self.runs(record.task, given) + 1)

    def line(self, task: Any) -> tuple[str, str]:
        """Return the name and the rest of the line of --dry-run that counts this task."""
        return task.case, task.subject

    def title(self, task: Any) -> str:
        """Return a task's name for people."""
        return f"{task.case} {task.subject}".rstrip()

    def limit(self, task: Any, given: G) -> float | None:
        """Return the time limit of a task in seconds."""
        return given.seconds

    def environment(self, given: G) -> Mapping[str, str]:
        """Return variables for the process that measures."""
        return {}

    def measure(self, task: Any, given: G) -> Sequence[Any]:
        """Measure a task in this process."""
        return pkgutil.resolve_name(self.work)(task, given)

    def recorded(self, task: Any) -> Any:
        """Return a task as its record keeps it."""
        return task

    def tables(self, records: Sequence[R], given: G) -> list[Table]:
        """Return the tables of records: one of each row, with `rounds` those of all rounds, in order."""
        raise NotImplementedError

    def details(self, records: Sequence[R], given: G) -> list[Table]:
        """Return further tables, for the file only."""
        return []

    def shown(self, records: Sequence[R]) -> list[R]:
        """Return the records that tables show, in order."""
        if not self.rounds:
            return latest(records)
        return sorted((r for rounds in by_row(records).values() for r in rounds), key=lambda r: r.task.place)

    def write(self, records: Sequence[R], given: G) -> str:
        """Write the tables into the results folder; return what the command prints."""
        shown = self.shown(records)
        text = f"{provenance(shown)}\n\n" + "\n".join(table.markdown() for table in self.tables(shown, given))
        more = "".join(f"\n{table.markdown()}" for table in self.details(shown, given))
        path = self.folder(given) / f"{self.file}.md"
        write_synced(path, (text + more).encode())
        return f"{text}\nWritten: {path}; records in {self.file}.jsonl\n"

    def draw(self, records: Sequence[R], given: G) -> None:
        """Draw pictures into the results folder, once all tasks have ended."""

    def watched(self, say: Callable[[str], None]) -> contextlib.AbstractContextManager[None]:
        """Call `say` with the progress of a task that is measured in this process."""
        return contextlib.nullcontext()

    def code(self, tasks: Sequence[Any], records: Sequence[R], given: G) -> int:
        """Return the exit code: 0 if every task that was asked for ended as expected."""
        rows = {task.row for task in tasks}
        return int(any(not r.ok for r in latest(records) if not rows or r.task.row in rows))


def main(study: Study[Any, Any], arguments: list[str]) -> int:
    """Run a study's command; return 0 if every task that was asked for ended as expected, else 1."""
    given = tyro.cli(study.flags, prog=f"run-benchmark {study.name}".rstrip(), args=arguments)
    _check(study, given)
    store = study.store(given)
    measures = not (given.table or given.collect)
    if measures and not given.dry_run:
        study.prepare(given)
    tasks = study.tasks(given) if measures else []
    for other, count in store.collect(given.collect).items() if given.collect else ():
        sys.stderr.write(f"{other}: {count} records taken over\n")
    records = store.read()
    if given.dry_run:
        left = study.pending(tasks, records, given)
        sys.stdout.write(listing(study, left, records, given, _all(study, tasks, given)))
        return 0
    failed = measure_all(study, tasks, records, given) if tasks else []
    shown = _shown(study, store, given)
    if not shown:
        raise InputError(f"{store.path}: there are no records to show; run without --table first")
    text = study.write(shown, given)
    if tasks:
        study.draw(shown, given)
    sys.stdout.write(text)
    return int(bool(failed)) or study.code(tasks, shown, given)


def _all(study: Study[Any, G], tasks: Sequence[Task], given: G) -> int:
    """Return how many measurements the flags ask for."""
    return len(tasks) * (study.repeats(given) if study.rounds else 1)


def _shown(study: Study[R, G], store: Store[R], given: G) -> list[R]:
    """Return the records that the tables of these flags show."""
    return [record for record in store.read() if study.shows(record.task, given)]


def _check(study: Study[Any, Any], given: Options) -> None:
    """Raise InputError for flags that exclude each other."""
    if study.repeats(given) < 1:
        raise InputError(f"--repeats must be at least 1, got {study.repeats(given)}")
    check_limit(given.seconds)
    check_workers(given.workers, given.scheduler)
    if given.dry_run and (given.collect or given.table):
        what = "--collect writes records" if given.collect else "--table writes tables"
        raise InputError(f"{what}, --dry-run writes nothing: expected one of them")
    study.check(given)


def measure_all(study: Study[R, G], tasks: Sequence[Task], records: Sequence[R], given: G) -> list[R]:
    """Measure what is not recorded, behind a progress bar; return the records of what did not end as expected.

    Each record is on the disk before the next task begins. The tables follow as tasks end, and once more at the end,
    also after Ctrl-C. Raises OSError where results cannot be written.
    """
    left, store, n_all = study.pending(tasks, records, given), study.store(given), _all(study, tasks, given)
    if len(left) < n_all:
        sys.stderr.write(f"{n_all - len(left)} of {n_all} {study.unit}s are recorded already (--force)\n")
    failed, due = [], 0.0
    with open_jobs(given.workers, given.scheduler) as jobs:
        store.folder.mkdir(parents=True, exist_ok=True)  # so that nothing is measured that cannot be recorded
        with Bar(len(left), study.unit) as bar, study.watched(bar.note):
            try:
                for record in _records(study, study.groups(left, records), given, jobs):
                    store.append([record])
                    failed += [] if record.ok else [record]
                    how = "not as expected" if record.finished and not record.ok else record.status
                    bar.advance(text=f"{study.title(record.task)}: {how}")
                    if study.follows and (began := time.monotonic()) > due:
                        _follow(study, store, given)
                        due = (now := time.monotonic()) + (now - began) / SHARE
            except BaseException as error:
                if study.follows:
                    with contextlib.suppress(OSError, InputError):
                        _follow(study, store, given, draw=True)
                if isinstance(error, OSError) and error.filename is None:  # a full disk
                    raise OSError(error.errno, error.strerror or str(error), str(store.folder)) from error
                raise
    return failed


def _follow(study: Study[R, G], store: Store[R], given: G, *, draw: bool = False) -> None:
    """Write the tables and draw the pictures, if there are records to show."""
    if shown := _shown(study, store, given):
        study.write(shown, given)
        if draw:
            study.draw(shown, given)


def _records(study: Study[R, G], groups: Sequence[tuple[Task, ...]], given: G, jobs: Jobs | None) -> Iterator[R]:
    """Measure groups of tasks here, or by `jobs` on several processes or a cluster; yield their records as they end.

    A task that failed is not tried again in a later round.
    """
    failed: set[str] = set()
    if jobs is None:
        with _measuring(study, given) as measure:
            for task in (task for group in groups for task in group if task.identity not in failed):
                yield (record := measure(task))
                failed |= set() if record.finished else {task.identity}
        return
    for of_round in _rounds(groups):
        left = (tuple(task for task in group if task.identity not in failed) for group in of_round)
        for record in _round(study, [part for part in left if part], given, jobs):
            failed |= set() if record.finished else {record.task.identity}
            yield record


def _round(study: Study[R, G], parts: Sequence[tuple[Task, ...]], given: G, jobs: Jobs) -> Iterator[R]:
    """Measure groups that do not wait for each other; of one whose process dies, each task is tried by itself."""
    again: list[tuple[Task, ...]] = []
    for answer in jobs.answers(functools.partial(_measure_group, study, given), parts):
        if answer is None:
            continue
        number, found = answer
        if not isinstance(found, Lost):
            yield from found
        elif len(parts[number]) > 1:
            again += [(task,) for task in parts[number]]
        else:
            lost = study.kind(ok=False, status=found.status, reason=found.reason)
            yield from (record_of(study, task, [lost]) for task in parts[number])
    if again:
        yield from _round(study, again, given, jobs)


def _rounds(groups: Sequence[tuple[Task, ...]]) -> list[list[tuple[Task, ...]]]:
    """Split groups into rounds; within a round only one group measures a task."""
    rounds: dict[int, list[tuple[Task, ...]]] = {}
    times = Counter[str]()
    for group in groups:
        rounds.setdefault(max(times[task.identity] for task in group), []).append(group)
        times.update({task.identity for task in group})
    return [rounds[n] for n in sorted(rounds)]


@contextlib.contextmanager
def _measuring(study: Study[R, G], given: G) -> Iterator[Callable[[Task], R]]:
    """Yield a function that measures a task and returns its record: here, or in another process (see `isolated`).

    The other process serves all tasks, so kernels are compiled once. Its temporary files are removed at the end.
    """
    host.commit()  # cached now: the commit of the loaded code, not of a later one

    def record(task: Task) -> R:
        limit = study.limit(task, given)
        try:
            if limit is None and not study.isolated:
                return record_of(study, task, study.measure(task, given))
            return record_of(study, task, process.run(study.measure, task, given, seconds=limit))
        except Stopped as end:
            return record_of(study, task, [study.kind(ok=False, status=end.status, reason=str(end))])

    with (
        tempfile.TemporaryDirectory(prefix="ctsim-", ignore_cleanup_errors=True) as folder,
        Process({"TMPDIR": folder, **study.environment(given)}) as process,
    ):
        yield record


def record_of(study: Study[R, Any], task: Task, found: Sequence[Any]) -> R:
    """Return the record of outcomes, as of now and here."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return study.record(task=study.recorded(task), found=tuple(found), host=host.host(), commit=host.commit(), time=now)


_measures: dict[Any, Callable[[Task], Any]] = {}
_opened = contextlib.ExitStack()


def _measure_group(study: Study[R, G], given: G, group: tuple[Task, ...]) -> list[R]:
    """Measure a group of tasks on a worker. A Dask worker outlives a command: the last one's process is closed."""
    who = type(study), given
    if who not in _measures:
        _opened.close()
        _measures.clear()
        _measures[who] = _opened.enter_context(_measuring(study, given))
    return [_measures[who](task) for task in group]


def listing(study: Study[R, G], left: Sequence[Task], records: Sequence[R], given: G, n_all: int) -> str:
    """Return what --dry-run prints: a line for each row with the seconds expected, and their sum."""
    known = {r.task.row: study.took(r, given) for r in latest(records) if r.finished}
    lines: dict[tuple[str, str], list[float | None]] = {}
    for task in left:
        once = known[task.row] if task.row in known else study.expected(task, given)
        lines.setdefault(study.line(task), []).append(once)
    wide, long = (max((len(line[k]) for line in lines), default=0) for k in (0, 1))
    out, total = [], 0.0
    for (name, more), seconds in lines.items():
        times = [s for s in seconds if s is not None]
        total += sum(times)
        count = f"{len(seconds)} x " if len(seconds) > 1 else ""
        out.append(f"{name:{wide}}  {more:{long}}  {count}{human_time(sum(times)) if times else 'unknown'}")
    unknown = dict.fromkeys(name for (name, _), seconds in lines.items() if None in seconds)
    never = f"; never measured: {', '.join(unknown)}" if unknown else ""
    out.append(f"total: {len(left)} of {n_all} {study.unit}s, {human_time(total)}, {study.estimate}{never}")
    return "\n".join(out) + "\n"
