"""Files of records whose bytes were changed at random: they are read, or refused in one sentence."""

import json
import logging
import random
from pathlib import Path

import msgspec
import pytest
from test_paper_tables import record
from test_pareto_points import task, timed

from ctsim.benchmarks.engine.host import host
from ctsim.benchmarks.engine.record import Record, Task, done
from ctsim.benchmarks.methods import parse_overrides
from ctsim.benchmarks.studies.methods import study as methods
from ctsim.benchmarks.studies.pareto import study as pareto
from ctsim.benchmarks.studies.peers import study as peers
from ctsim.benchmarks.studies.peers.finding import Measurement
from ctsim.benchmarks.studies.skipping import study as skipping
from ctsim.benchmarks.studies.skipping.study import Skip
from ctsim.benchmarks.studies.stress import study as stress
from ctsim.benchmarks.studies.validate import study as validate
from ctsim.benchmarks.studies.validate.finding import check
from ctsim.dataset import locks, manifest
from ctsim.dataset.folder import read_progress
from ctsim.errors import InputError
from ctsim.scaninfo import read_info

BY = {"host": host(), "commit": "a" * 40, "time": "2026-01-01T00:00:00+00:00"}
SKIPPED = Skip(seconds={"skipping": (1.0,), "whole": (2.0,)}, difference=0.0, limit=0.1)
CHECKED = check("q", 1.0, 2.0, tolerance=0.6, seconds={"case": (1.0,)})
PEER = Measurement(scene="s", contender="c", seconds={"run": (1.0,)})
KINDS = {
    "records": (methods.Methods(), methods.Flags, record(params={"a": [1, {"b": 2.5}]}, time=BY["time"])),
    "pareto": (pareto.Pareto(), pareto.Flags, timed(task(hints={"a": [1]}), ("1", 1.0, 2.0))),
    "skipping": (
        skipping.Skipping(),
        skipping.Flags,
        Record(task=Task(study="skipping", part="core", case="rays"), found=(SKIPPED,), **BY),
    ),
    "stress": (
        stress.Stress(),
        stress.Flags,
        stress.StressRecord(
            task=Task(
                study="stress", part="full", case="c", subject="s", settings={"side": 24, "expected": "e"},
                hints={"what": "w"},
            ),
            found=(stress.Judged(found="f", seconds={"row": (1.0,)}),),
            **BY,
        ),
    ),
    "validate": (
        validate.Validate(),
        validate.Flags,
        Record(task=Task(study="validate", part="full", case="noise", subject="noise"), found=(CHECKED,), **BY),
    ),
    "peers": (
        peers.Peers(),
        peers.Flags,
        Record(task=Task(study="peers", part="full", case="fdk"), found=(PEER,), **BY),
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


def shown(kind: str, folder: Path) -> None:
    """Read the records of a folder and make its tables, as --table does."""
    study, flags, _ = KINDS[kind]
    given = flags(results=folder, **({"data": folder} if kind == "records" else {}))
    found = study.store(given).read()
    done(found)
    if found := [r for r in found if study.shows(r.task, given)]:
        study.write(found, given)


def taken(kind: str, ours: Path, theirs: Path) -> None:
    """Take over the records of one folder by another."""
    study, flags, _ = KINDS[kind]
    study.store(flags(results=ours, **({"data": ours} if kind == "records" else {}))).collect([theirs])


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file_is_read_or_refused(kind, tmp_path, caplog):
    """A single exception of another kind is a traceback on every further call on that folder."""
    caplog.set_level(logging.ERROR)
    study, _, whole = KINDS[kind]
    name = f"{study.file}.jsonl"
    line, rng, seen = msgspec.json.encode(whole), random.Random(f"records {kind}"), set()
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    for folder in (ours, theirs):
        folder.mkdir()
    for _ in range(100 if kind == "pareto" else 300):  # its tables are fitted
        bad = changed(line, rng)
        (theirs / name).write_bytes(b"\n".join([line, bad, line][: rng.randint(2, 3)]) + b"\n"[: rng.randrange(2)])
        (ours / name).unlink(missing_ok=True)
        try:
            shown(kind, theirs)
            taken(kind, ours, theirs)
            shown(kind, ours)
            seen.add("read")
        except InputError as error:
            assert len(str(error)) < 2000, bad[:200]
            seen.add("refused")
        except BaseException as error:
            raise AssertionError(f"{type(error).__name__} at {bad[:3000]!r}") from error
    assert seen == {"read", "refused"}


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
