import errno
import os

import msgspec
import pytest

from benchmarks import methods, records
from benchmarks.host import host, measured
from benchmarks.protocol import Score
from benchmarks.records import Record, Run
from ctsim.errors import InputError


def run(**changes):
    given = {"scene": "lung", "scene_id": "a1", "scan": "b2", "seed": 0, "method": "fdk", "params": {"a": 1, "b": 2.5}}
    return Run(**{**given, **changes})


def record(status="ok", label="fdk", **changes):
    r = run(**changes)
    score = Score(region="r", reference="e", alignment="none", data_range=0.1, n_voxels=3, values={"psnr3d": None})
    return Record(
        identity=r.identity, run=r, label=label, inputs="counts only", status=status, scores={"tissue": score}
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


def test_only_ok_is_done_and_the_last_record_counts():
    a, b, c = record(), record("skipped", seed=1), record("error", seed=2)
    assert records.done([a, b, c]) == {a.identity}
    assert records.done([a, record("error")]) == set()
    assert records.done([record("error"), a]) == {a.identity}


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
