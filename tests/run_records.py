"""Records of runs, as a command writes them, and running methods without a command."""

from pathlib import Path
from typing import Any

from msgspec.structs import replace

from ctsim.benchmarks.engine.host import Host
from ctsim.benchmarks.engine.record import OK
from ctsim.benchmarks.engine.study import record_of
from ctsim.benchmarks.methods import Method
from ctsim.benchmarks.scores.score import VERSION
from ctsim.benchmarks.studies.methods import plan
from ctsim.benchmarks.studies.methods.records import Result, Run, RunRecord, case_of, task_of
from ctsim.benchmarks.studies.methods.run import Runner
from ctsim.benchmarks.studies.methods.study import Flags, Methods

HOST = Host(cpu="A CPU", cores=2, threads=2, ram=1, system="", python="", versions={})


def make_record(
    method: str = "fdk", *, label: str = "", scan: str = "b", code: str = "", place=(0, 0), protocol: int = VERSION,
    time: str = "", host: Host = HOST, commit: str = "", volume: str | None = None, **more: Any,
) -> RunRecord:  # fmt: skip
    """Return the record of a run; `more` are fields of the run and of its result."""
    of_run = {key: more.pop(key) for key in Run.__struct_fields__ if key in more}
    run = Run(**{"scene": "lung-Fe", "scene_id": "a", "seed": 0, "method": method, "params": {}, **of_run})
    task = task_of(run, label or method, data=scan, code=code, place=place)
    task = type(task)(**{**{f: getattr(task, f) for f in task.__struct_fields__}, "version": protocol})
    files = {} if volume is None else {"volume": volume}
    found = Result(ok=more.get("status", OK) in (OK, "skipped"), files=files, **more)
    return RunRecord(task=task, found=(found,), host=host, commit=commit, time=time)


def append(folder: Path, *records: RunRecord) -> None:
    """Append records to those of a results folder."""
    Methods().store(Flags(data=folder, results=folder)).append(records)


def changed(record: RunRecord, **fields: Any) -> RunRecord:
    """Return a record with other fields of its result; `label`, `place` and `scene` are of its task."""
    of_task = {{"label": "subject"}.get(k, k): fields.pop(k) for k in ("label", "place") if k in fields}
    if "scene" in fields:
        of_task["settings"] = replace(record.run, scene=fields.pop("scene"))
        of_task["case"] = case_of(of_task["settings"])
    found = replace(record.found[0], **fields)
    return replace(record, task=replace(record.task, **of_task), found=(found,))


def run_jobs(jobs: list[plan.Job], results: Path, **options: Any) -> list[RunRecord]:
    """Run jobs one after the other in this process and record them, as the command does."""
    given = Flags(data=Path("-"), results=results, **options)
    study, runner, records = Methods(), Runner(given), []
    for job in jobs:
        record: Any = record_of(study, job.task, [runner.run(job)])
        study.store(given).append([record])
        records.append(record)
    return records


def run_methods(scans: list[Any], methods: list[Method], results: Path, **options: Any) -> list[RunRecord]:
    """Run methods on scans, each on the metal-free twin first unless `anchor` is false."""
    return run_jobs(plan.jobs(scans, methods, anchor=options.get("anchor", True)), results, **options)
