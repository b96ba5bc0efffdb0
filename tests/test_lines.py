"""Files of records that commands append to, and what comes of several of them."""

import errno
import multiprocessing
import os
import time
from pathlib import Path

import msgspec
import pytest

from ctsim.benchmarks.engine import lines
from ctsim.durable import write_synced
from ctsim.errors import InputError


class Row(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    time: str
    value: dict[str, float]


def row(hour: int, value: float = 0.0) -> Row:
    return Row(time=f"2026-01-01T{hour:02}:00:00+00:00", value={"error": value})


def test_a_line_that_was_cut_short_is_left_out_and_written_over(tmp_path):
    path = tmp_path / "rows.jsonl"
    lines.append(path, row(1))
    with path.open("ab") as file:
        file.write(b'{"time": "torn')
    assert lines.read(path, Row, "a row") == [row(1)]
    lines.append(path, row(2))
    assert lines.read(path, Row, "a row") == [row(1), row(2)]


def test_files_of_several_machines_are_one_in_the_order_of_time(tmp_path):
    here, there, third = (tmp_path / name for name in ("here", "there", "third"))
    for folder, rows in ((there, (row(1), row(4))), (third, (row(2), row(4), row(4, 1.0)))):
        folder.mkdir()
        lines.append(folder / "rows.jsonl", *rows)
    path = here / "rows.jsonl"
    assert lines.collect(path, (there, third), Row, "a row") == {there: 2, third: 2}
    assert lines.read(path, Row, "a row") == [row(1), row(2), row(4), row(4, 1.0)]
    lines.append(path, row(3))
    assert lines.collect(path, (there,), Row, "a row") == {there: 0}
    # what was appended here stays the last: within a file its order counts, not its clock
    assert [found.time[11:13] for found in lines.read(path, Row, "a row")] == ["01", "02", "04", "04", "03"]


def test_a_clock_out_of_step_moves_no_record_past_others_of_its_file(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    clocks = {here: (2, 4, 6, 8), there: (1, 23, 3, 0, 5, 7)}  # 23 and 0 are out of step
    for number, (folder, hours) in enumerate(clocks.items()):
        folder.mkdir()
        lines.append(folder / "rows.jsonl", *(row(hour, number) for hour in hours))
    assert lines.collect(here / "rows.jsonl", (there,), Row, "a row") == {there: 6}
    found = [(int(r.time[11:13]), r.value["error"]) for r in lines.read(here / "rows.jsonl", Row, "a row")]
    assert found == [(1, 1), (23, 1), (2, 0), (3, 1), (0, 1), (4, 0), (5, 1), (6, 0), (7, 1), (8, 0)]


@pytest.mark.parametrize("damage", [b'{"time": "\xff", "value": {}}', b'{"time": ' + b"[" * 100_000, b"\x00" * 9])
def test_a_damaged_line_is_named(tmp_path, damage):
    path = tmp_path / "rows.jsonl"
    lines.append(path, row(1))
    path.write_bytes(path.read_bytes() + damage + b"\n")
    lines.append(path, row(2))
    with pytest.raises(InputError, match=r"rows\.jsonl, line 2: expected a row"):
        lines.read(path, Row, "a row")


def keep_appending(path: Path, who: int) -> None:
    """What another process does meanwhile."""
    for k in range(APPENDED):
        lines.append(path, row(who, k))


APPENDED = 60


def test_no_record_is_lost_where_processes_append_and_collect_at_once(tmp_path):
    path, there = tmp_path / "rows.jsonl", tmp_path / "there"
    there.mkdir()
    lines.append(there / "rows.jsonl", row(0))
    spawn = multiprocessing.get_context("spawn")
    others = [spawn.Process(target=keep_appending, args=(path, who)) for who in (1, 2)]
    for other in others:
        other.start()
    end = time.monotonic() + 120
    while any(other.is_alive() for other in others) and time.monotonic() < end:
        lines.collect(path, (there,), Row, "a row")
        time.sleep(0.002)
    for other in others:
        other.kill()  # none is left, or the test has failed
        other.join()
    lines.collect(path, (there,), Row, "a row")
    assert [other.exitcode for other in others] == [0, 0]
    expected = [row(0), *(row(who, k) for who in (1, 2) for k in range(APPENDED))]
    assert sorted(lines.read(path, Row, "a row"), key=lambda r: (r.time, r.value["error"])) == expected


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / "rows.jsonl"
    lines.append(path, row(1))
    write, before = os.write, path.read_bytes()

    def full(handle, data):
        if len(data) < 20:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(handle, data[: len(data) // 2])

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*rows.jsonl'"):
        lines.append(path, row(2))
    assert path.read_bytes() == before


def test_a_file_that_cannot_be_replaced_stays_and_nothing_is_left_beside_it(tmp_path, monkeypatch):
    path = tmp_path / "table.md"
    write_synced(path, b"before")

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*table.md'"):
        write_synced(path, b"after")
    assert path.read_bytes() == b"before" and [p.name for p in tmp_path.iterdir()] == ["table.md"]


def test_what_was_taken_over_is_said_and_nothing_is_written_on_a_dry_run(tmp_path, capsys):
    path, there = tmp_path / "rows.jsonl", tmp_path / "there"
    lines.take_over(path, (), Row, "a row", dry_run=True)
    there.mkdir()
    lines.append(there / "rows.jsonl", row(1))
    with pytest.raises(InputError, match="--collect writes records, --dry-run writes nothing"):
        lines.take_over(path, (there,), Row, "a row", dry_run=True)
    assert not path.exists()
    lines.take_over(path, (there,), Row, "a row", dry_run=False)
    assert capsys.readouterr().err == f"{there}: 1 records taken over\n"


def test_a_folder_without_records_changes_nothing(tmp_path):
    lines.append(tmp_path / "rows.jsonl", row(1))
    before = (tmp_path / "rows.jsonl").read_bytes()
    with pytest.raises(InputError, match=r"--collect .*nowhere: there are no records, expected a folder with rows"):
        lines.collect(tmp_path / "rows.jsonl", (tmp_path / "nowhere",), Row, "a row")
    assert (tmp_path / "rows.jsonl").read_bytes() == before
