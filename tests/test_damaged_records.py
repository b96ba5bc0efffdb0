"""Files of records whose bytes were changed at random: they are read, or refused in one sentence."""

import json
import random

import msgspec
import pytest
from ctsim.benchmarks.studies.pareto.records import latest, points
from ctsim.benchmarks.studies.pareto.records import read as read_pareto
from test_paper_tables import record
from test_pareto_points import setting, timed

from ctsim import locks, manifest
from ctsim.benchmarks.engine import lines
from ctsim.benchmarks.engine.host import host
from ctsim.benchmarks.engine.record import Record, Store, Task, done
from ctsim.benchmarks.methods import parse_overrides
from ctsim.benchmarks.studies.methods import records, tables
from ctsim.benchmarks.studies.methods.records import RunRecord
from ctsim.benchmarks.studies.peers import cases as peer_cases
from ctsim.benchmarks.studies.peers import tables as peer_tables
from ctsim.benchmarks.studies.skipping.finding import Skip
from ctsim.benchmarks.studies.stress import tables as stress_records
from ctsim.errors import InputError
from ctsim.folder import read_progress
from ctsim.scaninfo import read_info

BY = {"host": host(), "commit": "a" * 40, "time": "2026-01-01T00:00:00+00:00"}
KINDS = {
    "records": (records.NAME, record(params={"a": [1, {"b": 2.5}]}, time=BY["time"])),
    "pareto": ("pareto.jsonl", timed(setting(params={"a": [1]}), ("1", 1.0, 2.0))),
    "skipping": ("skipping.jsonl", Record[Skip](task=Task(study="skipping", case="rays"), found=(Skip(),), **BY)),
    "stress": (
        stress_records.NAME,
        stress_records.StressRecord(
            identity="i", case="c", subject="s", what="w", expected="e", side=8, ok=True, found="f", seconds=1.0, **BY
        ),
    ),
    "peers": (
        "peers.jsonl",
        peer_tables.PeerRecord(
            measurement=peer_cases.Measurement(case="fdk", scene="s", contender="c", seconds=(1.0,)), side=8, rtk="",
            **BY,
        ),
    ),
}  # fmt: skip
NESTED = [b"[" * n + b"]" * n for n in (100, 400, 700, 900, 950, 980, 990, 1000, 1500, 20_000)]
DEEPER = b'{"a":' * 100_000  # no end, either
VALUES = (
    *(b"NaN", b"Infinity", b"-1e999", b"1e400", b"1e308", b"9" * 25, b"-" + b"9" * 5000, b"18446744073709551616"),
    *(
        b"null",
        b"true",
        b"[]",
        b"{}",
        b'""',
        b'"\\ud800"',
        b'"\\u0000"',
        b'"\xff"',
        b"-1",
        b"0.5",
        b"1.0",
        *NESTED,
        DEEPER,
    ),
)


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


def read_records(path):
    found = records.read(path.parent)
    done(found)
    if records.latest(found):
        tables.write(found, path.parent)


def store(kind, folder):
    return {
        "records": Store(folder, "records", RunRecord, "a record"),
        "skipping": Store(folder, "skipping", Record[Skip], "a record"),
    }[kind]


READERS = {
    "records": read_records,
    "pareto": lambda path: points(latest(read_pareto(path))),
    "skipping": lambda path: store("skipping", path.parent).read(),
    "stress": stress_records.read,
    "peers": peer_tables.read,
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file_is_read_or_refused(kind, tmp_path):
    """A single exception of another kind is a traceback on every further call on that folder."""
    name, whole = KINDS[kind]
    line, rng, seen = msgspec.json.encode(whole), random.Random(f"records {kind}"), set()
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    for folder in (ours, theirs):
        folder.mkdir()
    for _ in range(300):
        bad = changed(line, rng)
        (theirs / name).write_bytes(b"\n".join([line, bad, line][: rng.randint(2, 3)]) + b"\n"[: rng.randrange(2)])
        (ours / name).unlink(missing_ok=True)
        try:
            READERS[kind](theirs / name)
            taken(kind, ours, theirs)
            READERS[kind](ours / name)
            seen.add("read")
        except InputError as error:
            assert len(str(error)) < 2000, bad[:200]
            seen.add("refused")
        except BaseException as error:
            raise AssertionError(f"{type(error).__name__} at {bad[:3000]!r}") from error
    assert seen == {"read", "refused"}


def taken(kind, ours, theirs):
    """Take over the records of one folder by another."""
    name, whole = KINDS[kind]
    if kind in ("records", "skipping"):
        store(kind, ours).collect([theirs])
    else:
        lines.collect(ours / name, [theirs], type(whole), "a record")


def nested(depth):
    """What JSON readers of other keys pass over, or recurse into."""
    return b"[" * depth + b"]" * depth


@pytest.mark.parametrize("depth", [100, 900, 1000, 5000, 100_000])
def test_what_is_nested_too_deep_is_damage(depth, tmp_path):
    """In files of a data folder as in records; msgspec raises RecursionError for it, whatever the key."""
    folder = tmp_path / "a"
    folder.mkdir()
    for key, head in ((b"x", b'"format":3'), (b"files", b'"name":"a"'), (b"format", b'"name":"a"')):
        (folder / manifest.MANIFEST).write_bytes(b'{%b,"%b":%b}' % (head, key, nested(depth)))
        with pytest.raises(InputError, match=r"manifest.json: damaged"):
            manifest.read_manifest(folder)
        assert manifest.verify_scene(folder)
    line = b'{"name":"a","scene_id":"s","content_hash":"c","x":%b}\n' % nested(depth)
    (tmp_path / manifest.INDEX).write_bytes(line)
    try:
        assert set(manifest.read_index(tmp_path)) == {"a"}  # a key of a newer version
    except InputError as error:
        assert "line 1 is damaged" in str(error)
    (folder / "scan.json").write_bytes(b'{"dark":%b}' % nested(depth))
    with pytest.raises(InputError, match=r"scan.json: "):
        read_info(folder / "scan.json")
    (folder / manifest.PROGRESS).write_bytes(b'{"x":%b}' % nested(depth))
    assert read_progress(folder) is None
    (folder / "lock").write_bytes(b'{"x":%b}' % nested(depth))
    assert locks._read(folder / "lock") is None
    assert parse_overrides([f"fdk.x={nested(depth).decode()}"], ["fdk"])
