import errno
import os
import sys

import msgspec
import pytest

from ctsim.benchmarks import cli, methods
from ctsim.benchmarks.engine.host import host, measured
from ctsim.benchmarks.scores.protocol import Score
from ctsim.benchmarks.studies.methods import records, tables
from ctsim.benchmarks.studies.methods.records import Record, Run
from ctsim.errors import InputError


def run(**changes):
    given = {"scene": "lung", "scene_id": "a1", "scan": "b2", "seed": 0, "method": "fdk", "params": {"a": 1, "b": 2.5}}
    return Run(**{**given, **changes})


def record(status="ok", label="fdk", time="", **changes):
    r = run(**changes)
    score = Score(region="r", reference="e", alignment="none", data_range=0.1, n_voxels=3, values={"psnr3d": None})
    scores = {"tissue": score}
    return Record(
        identity=r.identity, run=r, label=label, inputs="counts only", status=status, scores=scores, time=time
    )


def test_append_and_read_give_the_same_records(tmp_path):
    path = tmp_path / "deep" / records.NAME
    given = [record(), record("error", seed=1)]
    for r in given:
        records.append(path, r)
    assert records.read(path) == (given, None)
    assert path.read_bytes().count(b"\n") == 2


def test_records_of_before_there_were_details_are_read(tmp_path):
    path = tmp_path / records.NAME
    records.append(path, record())
    path.write_bytes(path.read_bytes().replace(b',"details":{}', b""))
    assert b"details" not in path.read_bytes() and records.read(path) == ([record()], None)


def test_scans_of_different_code_are_named():
    one, two = (msgspec.structs.replace(record(seed=k, scan=f"s{k}"), data_code=f"v{k}") for k in (1, 2))
    assert records.remarks([one, one]) == []
    assert records.remarks([one, msgspec.structs.replace(one, label="limar", data_code="")]) == []  # of the same scan
    assert records.remarks([one, two]) == [
        "the scenes were made by different code of the simulator, so their scores may not compare: "
        "lung (seed 1) by v1; lung (seed 2) by v2; make-dataset --force makes them again"
    ]
    for text in (tables.render([one, two], "md"), tables.render([one, two], "tex")):
        assert "lung (seed 1) by v1; lung (seed 2) by v2" in text


def test_every_field_of_a_run_changes_its_identity():
    changes = {
        "scene": "teeth", "scene_id": "x", "scan": "x", "seed": 1, "method": "nmar", "params": {"a": 2, "b": 2.5},
        "mask": "oracle", "variant": "metal_free", "code": "x", "protocol": 99,
    }  # fmt: skip
    assert set(changes) == set(Run.__struct_fields__)
    identities = {run(**{k: v}).identity for k, v in changes.items()} | {run().identity}
    assert len(identities) == len(changes) + 1
    assert run(params={"b": 2.5, "a": 1}).identity == run().identity


def test_a_torn_last_line_is_left_out_and_reported(tmp_path):
    path = tmp_path / records.NAME
    records.append(path, record())
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:57])
    found, torn = records.read(path)
    assert found == [record()] and torn.length == 57 and "cut short" in str(torn)
    assert records.repair(path) == torn
    assert path.read_bytes() == whole and path.with_suffix(".torn").read_bytes() == whole[:57]
    records.append(path, record(seed=1))
    assert records.read(path) == ([record(), record(seed=1)], None)


def test_a_whole_line_without_its_end_is_kept(tmp_path):
    path = tmp_path / records.NAME
    records.append(path, record())
    path.write_bytes(path.read_bytes()[:-1])
    assert records.repair(path) is None
    records.append(path, record(seed=1))
    assert records.read(path) == ([record(), record(seed=1)], None)


def test_a_bad_line_within_is_an_error_with_its_number(tmp_path):
    path = tmp_path / records.NAME
    records.append(path, record())
    path.write_bytes(path.read_bytes() + b'{"not": "a record"}\n')
    records.append(path, record(seed=1))
    with pytest.raises(InputError, match=r"line 2: expected a record"):
        records.read(path)


DEEP = b'{"details": {"a": ' + b"[" * 100_000


@pytest.mark.parametrize(
    "damage", [b'{"identity": "\xff"}', b"\x00" * 40, DEEP, b'{"identity": "\\ud800"}', b"\xef\xbb\xbf{}"]
)
def test_no_damage_is_a_traceback(tmp_path, damage):
    path = tmp_path / records.NAME
    records.append(path, record())
    whole = path.read_bytes()
    path.write_bytes(whole + damage + b"\n" + whole)
    with pytest.raises(InputError, match=rf"{records.NAME}, line 2: expected a record of run-benchmark"):
        records.read(path)
    path.write_bytes(whole + damage)
    found, torn = records.read(path)
    assert found == [record()] and torn is not None and torn.length == len(damage)


def test_the_command_names_the_file_and_the_line_of_a_byte_that_is_no_text(tmp_path, monkeypatch, capsys):
    path = tmp_path / records.NAME
    records.append(path, record(label="fdk-in-latin-1"))
    path.write_bytes(path.read_bytes().replace(b"latin-1", b"l\xe4tin-1"))
    for words in (["data", str(tmp_path), "--table"], ["paper-tables", str(tmp_path)], ["report", str(tmp_path)]):
        monkeypatch.setattr(sys, "argv", ["run-benchmark", *words])
        assert cli.run_benchmark() == 2
        said = capsys.readouterr().err
        assert f"{path}, line 1: " in said and "0xe4" in said and said.count("\n") == 1


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    path = tmp_path / records.NAME
    records.append(path, record())
    before = path.read_bytes()
    write = os.write

    def fill_up(descriptor, data):
        write(descriptor, data[:20])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", fill_up)
    with pytest.raises(OSError, match="No space"):
        records.append(path, record(seed=1))
    assert path.read_bytes() == before


def test_only_ok_is_done_and_counts_before_a_failure_of_the_same_run():
    a, b, c = record(), record("skipped", seed=1), record("error", seed=2)
    assert records.done([a, b, c]) == {a.identity}
    for given in ([a, record("error")], [record("error"), a], [record("error"), a, record("timeout")]):
        assert records.done(given) == {a.identity} and records.latest(given) == [a]
    again = record(label="fdk", time="later")
    assert records.latest([a, again, record("error")]) == [again]  # of two that ended well the last
    assert records.latest([record("error"), record("timeout")]) == [record("timeout")]


def test_a_failed_run_of_before_does_not_hide_what_is_measured_now():
    """Which code and data count is what was run last, not what last ended well."""
    old, new = record(code="1"), record("error", code="2")
    assert records.latest([old, new]) == [new]
    assert records.latest([new, old, record("error", code="1")]) == [old]


def test_within_a_file_the_last_line_counts_whatever_its_clock_said(tmp_path):
    path = tmp_path / records.NAME
    for given in (record("error", time="2031-01-01"), record("timeout", time="2026-01-01")):
        records.append(path, given)
    assert [r.status for r in records.latest(records.read_all(tmp_path)[0])] == ["timeout"]
    records.append(path, record(code="new", time="2026-01-02"))
    assert [r.run.code for r in records.latest(records.read_all(tmp_path)[0])] == ["new"]


def test_a_clock_ahead_on_one_machine_hides_nothing_of_another(tmp_path):
    """Here new code ran on the second day; there, old code on the first, one record of it dated 2031."""
    here, there = tmp_path / "here", tmp_path / "there"
    for k, time in enumerate(("2026-01-01T01", "2031-01-01", "2026-01-01T03", "2026-01-01T04")):
        records.append(there / records.NAME, record("ok", code="old", seed=k, time=time))
    for k in range(4):
        records.append(here / records.NAME, record("ok", code="new", seed=k, time=f"2026-01-02T0{k}"))
    assert records.collect(here, [there]) == {there: 4}
    shown = records.latest(records.read_all(here)[0])
    assert [r.run.code for r in shown] == ["new"] * 4
    before = (here / records.NAME).read_bytes()
    assert records.collect(here, [there]) == {there: 0} and (here / records.NAME).read_bytes() == before
    # files that lie side by side are merged alike
    (here / records.NAME).unlink()
    (there / records.NAME).rename(here / "records-there.jsonl")
    for k in range(4):
        records.append(here / records.NAME, record("ok", code="new", seed=k, time=f"2026-01-02T0{k}"))
    assert [r.run.code for r in records.latest(records.read_all(here)[0])] == ["new"] * 4


def test_a_failure_dated_in_the_future_is_mended_by_a_collected_success(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    records.append(here / records.NAME, record("error", time="2031-01-01"))
    records.append(there / records.NAME, record(time="2026-01-01"))
    assert records.collect(here, [there]) == {there: 1}
    assert [r.status for r in records.latest(records.read_all(here)[0])] == ["ok"]


def test_nothing_is_collected_where_a_folder_has_no_records(tmp_path):
    here, there = tmp_path / "here", tmp_path / "there"
    records.append(there / records.NAME, record())
    with pytest.raises(InputError, match=r"--collect .*none: there are no records"):
        records.collect(here, [there, tmp_path / "none"])
    assert not here.exists()


def test_latest_supersedes_other_code_versions():
    old, new = record(code="1"), record("error", code="2")
    assert records.latest([old, new, record(seed=1)]) == [new, record(seed=1)]


def test_a_scan_made_anew_supersedes_what_was_measured_on_the_old():
    given = [record(), record(label="nmar"), record(scan="new"), record(seed=1)]
    assert records.latest(given) == [record(scan="new"), record(seed=1)]


def test_files_of_several_machines_merge(tmp_path):
    records.append(tmp_path / "records.jsonl", record())
    records.append(tmp_path / "records-other.jsonl", record(seed=1))
    found, torn = records.read_all(tmp_path)
    assert {r.run.seed for r in found} == {0, 1} and torn == []


def test_host_is_described_and_survives_json():
    here = host()
    assert here.ram > 0 and here.cores >= 1 and here.versions["numpy"]
    assert msgspec.json.decode(msgspec.json.encode(here), type=type(here)) == here


def test_measured_sees_time_and_memory():
    with measured() as small:
        pass
    with measured() as large:
        block = bytearray(os.urandom(1) * 200_000_000)
    assert large.peak_bytes - small.peak_bytes > 150_000_000 and len(block)
    assert large.wall > 0 and large.cpu >= 0


def test_methods_are_found_by_name_and_by_path(tmp_path, monkeypatch):
    (tmp_path / "my_lab_net.py").write_text(
        "INPUTS = 'training'\n\n"
        "def reconstruct(scan, *, device, steps=3, window='hann'):\n    return (scan, device, steps)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    method = methods.find("my_lab_net:reconstruct", {"steps": 5})
    assert method.params == {"steps": 5, "window": "hann"} and method.inputs == "training" and method.mask == "none"
    assert method.label == "my_lab_net:reconstruct[steps=5]"
    assert method.reconstruct("scan", "cpu") == ("scan", "cpu", 5)
    assert method.skip("scan") is None
    with pytest.raises(InputError, match="no parameter 'step'"):
        methods.find("my_lab_net:reconstruct", {"step": 5})


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("fkd", "did you mean fdk"),
        ("zzz", "module:function"),
        ("no_such_lab:f", "cannot be imported"),
        ("os:sep", "not a"),
    ],
)
def test_unknown_methods_are_named(name, message):
    with pytest.raises(InputError, match=message):
        methods.find(name)


def test_code_version_follows_imports(tmp_path, monkeypatch):
    package = tmp_path / "my_lab_pkg"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "net.py").write_text("from my_lab_pkg import helper\nfrom . import other\nimport os\n")
    (package / "helper.py").write_text("a = 1\n")
    (package / "other.py").write_text("b = 1\n")
    (package / "unrelated.py").write_text("c = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    versions = []
    for name, text in [("", ""), ("helper", "a = 2\n"), ("other", "b = 2\n"), ("unrelated", "c = 2\n")]:
        if name:
            (package / f"{name}.py").write_text(text)
        methods.code_version.cache_clear()
        versions.append(methods.code_version("my_lab_pkg.net"))
    assert len(set(versions)) == 3 and versions[2] == versions[3]


def test_settings_are_parsed_and_refused():
    found = methods.parse_overrides(("fdk.window=hann", "fdk.cut=0.5", "lab.x:f.n=3"), ("fdk", "lab.x:f"))
    assert found == {"fdk": {"window": "hann", "cut": 0.5}, "lab.x:f": {"n": 3}}
    for bad in ("window=hann", "fdk.window", "nmar.a=1"):
        with pytest.raises(InputError, match="--set"):
            methods.parse_overrides((bad,), ("fdk",))
