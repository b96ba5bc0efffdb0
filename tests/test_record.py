"""Records of tasks: their identity, files that were cut short or damaged, merging, and which record a row shows."""

import errno
import json
import logging
import multiprocessing
import os
import random
import sys
import time
from pathlib import Path

import msgspec
import pytest

from ctsim.benchmarks import cli
from ctsim.benchmarks.engine.host import Host
from ctsim.benchmarks.engine.record import (
    Found,
    Record,
    Store,
    Task,
    by_row,
    done,
    encoded,
    latest,
    merged,
    provenance,
    short,
)
from ctsim.errors import InputError

HOST = Host(cpu="a processor", cores=2, threads=2, ram=2**30, system="Linux", python="3.12.1", versions={"numba": "1"})
A_TASK = {"study": "tests", "case": "one"}


class Value(Found, frozen=True, kw_only=True, forbid_unknown_fields=True):
    value: float = 0.0


def task(**fields) -> Task:
    return Task(**A_TASK | fields)


def record(hour: int = 0, /, value: float = 0.0, *, status="ok", runs=(), files=(), repeats=(), **fields) -> Record:
    """Return a record of an hour; `runs` are the timed ones, `repeats` the numbers of those of several parts."""
    parts = [tuple(float(k) for k in range(n)) for n in repeats] or [tuple(runs)]
    found = tuple(
        Value(
            ok=status == "ok",
            status=status,
            value=value,
            seconds={"all": part} if part else {},
            files=dict(files),
        )
        for part in parts
    )
    at = f"2026-01-01T{hour:02}:00:00+00:00"
    return Record(task=task(**fields), found=found, host=HOST, commit="a" * 40, time=at)


def store(folder: Path) -> Store:
    return Store(folder, "rows", Record[Value], "a record of tests")


def written(folder: Path, *records: Record) -> Store:
    """Return the store of a folder that holds these records, each appended on its own."""
    found = store(folder)
    for one in records:
        found.append([one])
    return found


# --- tasks -----------------------------------------------------------------------------------------------


def test_the_identity_counts_everything_but_place_and_hints():
    one = task(settings={"a": 1, "b": {"c": 2.5, "d": [1, 2]}}, place=(1,), hints={"a": 1})
    assert one.identity == task(settings={"b": {"d": [1, 2], "c": 2.5}, "a": 1}, place=(7, 7)).identity
    changes = {
        "study": "other", "part": "x", "case": "two", "subject": "x", "settings": {"a": 2}, "data": "x", "code": "x",
        "machine": "x", "version": 2,
    }  # fmt: skip
    assert changes.keys() | {"place", "hints"} == set(Task.__struct_fields__)
    identities = {task(**{name: value}).identity for name, value in changes.items()} | {task().identity}
    assert len(identities) == len(changes) + 1
    assert task(settings={"a": [1, 2]}).identity != task(settings={"a": [2, 1]}).identity


def test_the_identity_is_the_same_after_a_round_through_a_file(tmp_path):
    one = record(settings={"b": (1, 2), "a": {"z": None, "y": "µ"}}, place=(3, 1))
    (back,) = written(tmp_path, one).read()
    assert back.task.identity == one.task.identity and back.task.place == (3, 1)


@pytest.mark.parametrize(("repeats", "least"), [((), 1), ((5, 3), 3)])
def test_a_record_has_the_least_timed_runs_of_its_parts(repeats, least):
    assert record(repeats=repeats).repeats == least


# --- one file ---------------------------------------------------------------------------------------------


def test_there_are_no_records_where_there_is_no_file(tmp_path):
    assert store(tmp_path / "none").read() == [] and not (tmp_path / "none").exists()


def test_records_are_read_as_they_were_written(tmp_path):
    records = [record(hour, 0.1 * hour, subject=f"s{hour}") for hour in (3, 1, 2)]  # in the order of lines, not clocks
    assert written(tmp_path / "new" / "folder", *records).read() == records
    assert (tmp_path / "new" / "folder" / "rows.jsonl").read_bytes() == encoded(records)


def test_a_line_cut_short_at_any_byte_is_one_warning_and_cut_off_by_the_next(tmp_path, caplog):
    first, torn, third = record(1), record(2, subject="torn"), record(3, subject="third")
    rest, (path,) = encoded([torn]), (store(tmp_path).path,)
    for size in range(1, len(rest) - 1):  # without its last byte the line has lost its end only: see below
        path.write_bytes(encoded([first]) + rest[:size])
        caplog.clear()
        found = store(tmp_path)
        assert found.read() == found.read() == [first], size
        assert [r.levelno for r in caplog.records] == [logging.WARNING], size
        assert f"{path}: the last line was cut short" in caplog.text
        found.append([third])
        assert path.read_bytes() == encoded([first, third]), size


def test_a_whole_line_that_lost_its_end_is_kept(tmp_path, caplog):
    records = [record(hour, subject=f"s{hour}") for hour in range(3)]
    path, there = store(tmp_path).path, written(tmp_path / "there", record(9, subject="other"))
    for collects in (False, True):
        path.write_bytes(encoded(records[:2])[:-1])
        assert store(tmp_path).read() == records[:2]
        if collects:
            store(tmp_path).collect([there.folder])
            assert store(tmp_path).read() == [*records[:2], *there.read()]
        else:
            store(tmp_path).append(records[2:])
            assert path.read_bytes() == encoded(records)
    assert not caplog.records


DEEP = b'{"task":' + b"[" * 100_000


@pytest.mark.parametrize("damage", [b"\xff", DEEP, b"\x00" * 9, b"\xef\xbb\xbf{}", b"", b"\r{}"])
def test_a_damaged_line_is_named(tmp_path, damage):
    path = written(tmp_path, record(1)).path
    path.write_bytes(path.read_bytes() + damage + b"\n" + encoded([record(2)]))
    with pytest.raises(InputError, match=r"rows\.jsonl, line 2: expected a record of tests: "):
        store(tmp_path).read()


def test_a_carriage_return_ends_no_line(tmp_path, caplog):
    """It is one byte flipped away from an M; what follows it would be left out with a warning."""
    path = store(tmp_path).path
    lines = encoded([record(1, subject="M")]).replace(b"M", b"\r") + encoded([record(2)])
    path.write_bytes(lines)
    with pytest.raises(InputError, match="line 1: expected"):
        store(tmp_path).read()
    path.write_bytes(encoded([record(1), record(2)]).replace(b"\n", b"\r\n"))  # by an editor
    assert store(tmp_path).read() == [record(1), record(2)] and not caplog.records


OLD = {
    "measured": {"case": "rays", "scene": "s", "what": "w", "skipping": [1.0], "whole": [2.0], "difference": 0.0},
    "size": "core", "host": msgspec.to_builtins(HOST), "commit": "a" * 40, "time": "2026-01-01", "run": "r",
}  # fmt: skip


def test_records_of_another_format_are_one_sentence(tmp_path, monkeypatch, capsys):
    path = tmp_path / "skipping.jsonl"
    path.write_text(json.dumps(OLD) + "\n")
    before = path.read_bytes()
    for words in ([], ["--table"], ["--dry-run"]):
        monkeypatch.setattr(sys, "argv", ["run-benchmark", "skipping", str(tmp_path), *words])
        assert cli.run_benchmark() == 2
        said = capsys.readouterr()
        assert said.out == "" and said.err.count("\n") == 1
        assert f"{path}, line 1: expected a record of run-benchmark skipping: " in said.err
    assert path.read_bytes() == before


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    found = written(tmp_path, record(1))
    write, before = os.write, found.path.read_bytes()

    def full(handle, data):
        if len(data) < 20:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(handle, data[: len(data) // 2])

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*rows.jsonl'"):
        found.append([record(2)])
    assert found.path.read_bytes() == before


def test_a_full_disk_leaves_the_records_as_they_were_when_others_are_collected(tmp_path, monkeypatch):
    found, there = written(tmp_path / "here", record(1)), written(tmp_path / "there", record(2, subject="other"))
    before = found.path.read_bytes()

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*rows.jsonl'"):
        found.collect([there.folder])
    assert found.path.read_bytes() == before and [p.name for p in found.folder.iterdir()] == ["rows.jsonl"]


def test_many_records_are_read_in_a_moment(tmp_path):
    """10 000 records of 0.9 kB on two busy cores: read in 0.3 s; what to show is found in 0.9 s."""
    records = [
        record(k % 24, runs=[0.1] * 10, case=f"c{k % 100}", subject=f"s{k}", settings={"text": "x" * 400})
        for k in range(10_000)
    ]
    found = store(tmp_path)
    found.append(records)
    back = found.read()
    assert back == records
    assert len(latest(back)) == 10_000 and len(done(back)) == 10_000


# --- damage ------------------------------------------------------------------------------------------------

NESTED = [b"[" * n + b"]" * n for n in (100, 400, 700, 900, 950, 980, 990, 1000, 1500, 20_000)]
DEEPER = b'{"a":' * 100_000  # no end, either
VALUES = (
    b"NaN", b"Infinity", b"-1e999", b"1e400", b"1e308", b"9" * 25, b"-" + b"9" * 5000, b"18446744073709551616",
    b"null", b"true", b"[]", b"{}", b'""', b'"\\ud800"', b'"\\u0000"', b'"\xff"', b"-1", b"0.5", b"1.0",
    *NESTED, DEEPER,
)  # fmt: skip


def places(value, path=()):
    """The paths of all values in a value."""
    found = [path]
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value if isinstance(value, list) else ()):
        found += places(inner, (*path, key))
    return found


def with_value(line, rng):
    """A line with one of its values, or a key that is new, replaced by one of `VALUES`."""
    whole = json.loads(line)
    *path, key = rng.choice([p for p in places(whole) if p])
    inner = whole
    for k in path:
        inner = inner[k]
    if isinstance(inner, dict) and rng.random() < 0.2:
        key = "new"
    if isinstance(inner, dict) and rng.random() < 0.1:
        del inner[rng.choice(list(inner))]
    inner[key] = "@@"
    return json.dumps(whole).encode().replace(b'"@@"', rng.choice(VALUES))


def changed(line, rng):
    """A line with bytes flipped, cut out, put in or swapped, or with a value of another kind."""
    kind, data = rng.randrange(5), bytearray(line)
    at, n = rng.randrange(len(data)), rng.randint(1, 20)
    if kind == 0:
        for _ in range(rng.randint(1, 8)):
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    elif kind == 1:
        del data[at : at + n]
    elif kind == 2:
        data[at:at] = rng.randbytes(n)
    elif kind == 3:
        del data[at:]
    else:
        return with_value(line, rng)
    return bytes(data)


@pytest.mark.parametrize("seed", range(4))
def test_a_damaged_file_is_read_or_refused(tmp_path, seed):
    """A single exception of another kind is a traceback on every further call on that folder."""
    whole = record(1, runs=[1.0, 2.0], files={"volume": "v.tif"}, settings={"a": [1, {"b": 2.5}]}, place=(1, 2))
    line, rng, seen = msgspec.json.encode(whole), random.Random(f"records {seed}"), set()
    ours, theirs = store(tmp_path / "ours"), store(tmp_path / "theirs")
    for one in (ours, theirs):
        one.folder.mkdir()
    for _ in range(250):
        bad = changed(line, rng)
        theirs.path.write_bytes(b"\n".join([line, bad, line][: rng.randint(2, 3)]) + b"\n"[: rng.randrange(2)])
        ours.path.unlink(missing_ok=True)
        try:
            found = theirs.read()
            latest(found), done(found), provenance(found)
            ours.collect([theirs.folder])
            found = ours.read()
            ours.append(latest(found))
            assert ours.read()[: len(found)] == found
            seen.add("read")
        except InputError as error:
            assert len(str(error)) < 2000, bad[:200]
            seen.add("refused")
        except BaseException as error:
            raise AssertionError(f"{type(error).__name__} at {bad[:3000]!r}") from error
    assert seen == {"read", "refused"}


# --- several files -----------------------------------------------------------------------------------------


def hours(records) -> list[int]:
    return [int(r.time[11:13]) for r in records]


def named(hour: int, machine: str) -> Record:
    return record(hour, subject=f"{machine} {hour}")


def test_files_of_several_machines_are_one_in_the_order_of_time(tmp_path):
    here, there, third = (tmp_path / name for name in ("here", "there", "third"))
    written(there, named(1, "there"), named(4, "there"))
    written(third, named(2, "third"), named(4, "third"), named(5, "third"))
    found = store(here)
    assert found.collect([there, third]) == {there: 2, third: 3}
    assert hours(found.read()) == [1, 2, 4, 4, 5]
    assert [r.task.subject for r in found.read()][2:4] == ["there 4", "third 4"]  # at one time in the order given
    found.append([named(3, "here")])
    before = found.path.read_bytes()
    assert found.collect([there]) == {there: 0} and found.path.read_bytes() == before
    # what was appended here stays the last: within a file its order counts, not its clock
    assert hours(found.read()) == [1, 2, 4, 4, 5, 3]


@pytest.mark.parametrize("side_by_side", [True, False])
def test_a_clock_out_of_step_moves_no_record_past_others_of_its_file(tmp_path, side_by_side):
    here, there = tmp_path / "here", tmp_path / "there"
    for folder, clock in ((here, (2, 4, 6, 8)), (there, (1, 23, 3, 0, 5, 7))):  # 23 and 0 are out of step
        written(folder, *(named(hour, folder.name) for hour in clock))
    if side_by_side:
        (there / "rows.jsonl").rename(here / "rows-there.jsonl")
    else:
        assert store(here).collect([there]) == {there: 6}
    expected = "there 1, there 23, here 2, there 3, there 0, here 4, there 5, here 6, there 7, here 8"
    assert ", ".join(r.task.subject for r in store(here).read()) == expected


def test_the_files_of_another_name_are_not_read(tmp_path):
    found = written(tmp_path, record(1))
    for name in ("rowsand.jsonl", "other-rows.jsonl", "rows.json", "rows-1.jsonl.old"):
        (tmp_path / name).write_bytes(b"{}\n")
    assert found.read() == [record(1)]


def test_merging_one_file_changes_nothing():
    records = [named(hour, "one") for hour in (5, 1, 3)]
    assert merged([records]) == records and merged([[], records, []]) == records and merged([]) == []


def test_what_ended_well_here_stays_and_what_failed_in_both_is_left_out(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    states = {  # (here, there): how many are taken over, what is shown then
        ("ok", "ok"): (0, "ok", 0.0), ("ok", "error"): (0, "ok", 0.0), ("error", "timeout"): (0, "error", 0.0),
        ("error", "ok"): (1, "ok", 1.0), ("", "error"): (1, "error", 1.0), ("", "ok"): (1, "ok", 1.0),
    }  # fmt: skip
    for number, (ours, theirs) in enumerate(states):
        if ours:
            written(here, record(20, 0.0, status=ours, case=str(number)))
        written(there, record(1, 1.0, status=theirs, case=str(number)))
    assert store(here).collect([there]) == {there: 3}
    shown = {r.task.case: (r.found[0].status, r.found[0].value) for r in latest(store(here).read())}
    assert shown == {str(number): expected[1:] for number, expected in enumerate(states.values())}
    assert store(here).collect([there]) == {there: 0}


def test_a_record_that_several_folders_have_is_taken_over_once(tmp_path):
    for name, one in (("a", record(1, 1.0)), ("b", record(2, 2.0)), ("c", record(0, 3.0, status="error"))):
        written(tmp_path / name, one)
    others = [tmp_path / name for name in "abc"]
    assert store(tmp_path / "here").collect(others) == dict(zip(others, (1, 0, 0), strict=True))
    others = others[::-1]
    assert store(tmp_path / "other").collect(others) == dict(zip(others, (1, 1, 0), strict=True))


def test_all_rounds_of_a_task_are_taken_over(tmp_path):
    rounds = [record(hour, float(hour), runs=[1.0]) for hour in range(3)]
    written(tmp_path / "there", *rounds)
    assert store(tmp_path / "here").collect([tmp_path / "there"]) == {tmp_path / "there": 3}
    assert store(tmp_path / "here").read() == rounds


def test_files_are_found_from_the_folder_that_took_over_their_records(tmp_path, monkeypatch):
    there = tmp_path / "deep" / "there"
    absolute = tmp_path / "absolute.tif"
    written(there, record(1, files={"volume": "volumes/a.tif", "picture": str(absolute)}))
    (there / "volumes").mkdir()
    for path in (there / "volumes" / "a.tif", absolute):
        path.touch()
    monkeypatch.chdir(tmp_path)
    for here in (tmp_path / "here", Path("relative")):
        store(here).collect([Path("deep/there")])
        (one,) = store(here).read()
        assert one.found[0].files["volume"] == "../deep/there/volumes/a.tif"
        assert all((here / path).exists() for path in one.found[0].files.values())
    store(tmp_path / "third" / "time").collect([tmp_path / "here"])
    (one,) = store(tmp_path / "third" / "time").read()
    assert (tmp_path / "third" / "time" / one.found[0].files["volume"]).resolve() == there / "volumes" / "a.tif"


def test_nothing_is_collected_where_a_folder_has_no_records(tmp_path):
    written(tmp_path / "there", record(1))
    found = written(tmp_path / "here", record(2))
    before = found.path.read_bytes()
    for into in (found, store(tmp_path / "new")):
        with pytest.raises(InputError, match=r"--collect .*none: there are no records, expected a folder with rows"):
            into.collect([tmp_path / "there", tmp_path / "none"])
    assert found.path.read_bytes() == before and not (tmp_path / "new").exists()


APPENDED = 60


def keep_appending(folder: Path, who: int) -> None:
    """What another process does meanwhile."""
    for k in range(APPENDED):
        store(folder).append([record(who, float(k), subject=f"{who} {k}")])


def test_no_record_is_lost_where_processes_append_and_collect_at_once(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    written(there, record(0, subject="there"))
    spawn = multiprocessing.get_context("spawn")
    others = [spawn.Process(target=keep_appending, args=(here, who)) for who in (1, 2)]
    for other in others:
        other.start()
    end = time.monotonic() + 120
    while any(other.is_alive() for other in others) and time.monotonic() < end:
        store(here).collect([there])
        time.sleep(0.002)
    for other in others:
        other.kill()  # none is left, or the test has failed
        other.join()
    assert [other.exitcode for other in others] == [0, 0]
    expected = {"there", *(f"{who} {k}" for who in (1, 2) for k in range(APPENDED))}
    found = [r.task.subject for r in store(here).read()]
    assert set(found) == expected and len(found) == len(expected)


# --- what a row shows --------------------------------------------------------------------------------------


def shown(*records) -> list[float]:
    return [r.found[0].value for r in latest(records)]


def test_the_last_that_ended_well_is_shown_without_one_the_last():
    ok, again = record(1, 1.0), record(2, 2.0)
    failed, late = record(3, 3.0, status="error"), record(4, 4.0, status="timeout")
    assert shown(ok, again) == [2.0] and shown(again, ok) == [1.0]  # the last line, not the latest clock
    assert shown(ok, failed) == [1.0] and shown(failed, ok, late) == [1.0]
    assert shown(failed, late) == [4.0]
    assert [r.found[0].value for r in by_row([failed, ok, again])["", "one", ""]] == [1.0, 2.0]


def test_a_newer_identity_of_a_row_supersedes_an_older_one():
    old, new = record(1, 1.0, code="1"), record(2, 2.0, code="2", status="error")
    assert shown(old, new) == [2.0]  # what failed now is not hidden by what older code did
    assert shown(old, new, record(3, 3.0, code="1")) == [3.0]
    assert shown(old, record(1, 4.0, settings={"a": 1})) == [4.0]


def test_only_the_newest_data_of_a_case_count():
    old = [record(1, 1.0, data="old", subject=s) for s in "ab"]
    new = record(2, 2.0, data="new", subject="a")
    other = record(0, 3.0, data="old", case="other")
    assert shown(*old, new, other) == [2.0, 3.0]


def test_only_the_machine_that_was_last_to_measure_a_case_counts():
    here = [record(1, 1.0, machine="here", subject=s) for s in "ab"]
    there = record(2, 2.0, machine="there", subject="a")
    assert shown(*here, there) == [2.0]
    failed = record(2, 2.0, machine="there", subject="a", status="error")
    assert shown(*here, failed) == [1.0, 1.0]  # a machine that measured nothing
    assert shown(failed) == [2.0]


def test_rows_stand_by_their_place():
    records = [record(1, float(k), subject=str(k), place=place) for k, place in enumerate([(2,), (0, 5), (0,), (1, 9)])]
    assert shown(*records) == [2.0, 1.0, 3.0, 0.0]
    moved = record(1, 9.0, subject="0", place=(0, 1))  # the same task in another table
    assert shown(*records, moved) == [2.0, 9.0, 1.0, 3.0]


def test_what_is_done_ended_well_with_as_many_runs():
    five, three = record(repeats=(5,), case="five"), record(repeats=(5, 3), case="three")
    failed, untimed = record(status="error", case="failed"), record(case="untimed")
    records = [five, three, failed, untimed, five]

    def cases(repeats):
        return {r.task.case: done(records, repeats)[r.task.identity] for r in records}

    assert cases(1) == {"five": 2, "three": 1, "failed": 0, "untimed": 1}
    assert cases(4) == {"five": 2, "three": 0, "failed": 0, "untimed": 0}


def test_a_part_that_failed_leaves_the_task_unfinished():
    parts = (Value(value=1.0), Value(ok=False, status="error"), Value(ok=False))
    one = msgspec.structs.replace(record(), found=parts)
    assert not one.finished and done([one]) == {}
    assert msgspec.structs.replace(one, found=(parts[0], parts[2])).finished  # measured, though not as expected


def test_provenance_names_times_machines_and_commits():
    other = msgspec.structs.replace(HOST, cpu="another", versions={})
    changed = msgspec.structs.replace(record(3), host=other, commit="b" * 40 + "+changes")
    assert provenance([changed, record(1)]) == (
        "2026-01-01T01:00:00+00:00 to 2026-01-01T03:00:00+00:00, commit bbbbbbbbbbbb+changes, aaaaaaaaaaaa, "
        "another, 2 cores, 2 threads, Python 3.12.1, numba ? and "
        "a processor, 2 cores, 2 threads, Python 3.12.1, numba 1."
    )
    assert provenance([record(1)]).startswith("2026-01-01T01:00:00+00:00, commit aaaaaaaaaaaa, a processor")
    assert short("unknown") == "unknown"
