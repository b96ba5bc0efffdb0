import os
import sys

import msgspec
import pytest
from run_records import make_record

from ctsim.benchmarks import cli, methods
from ctsim.benchmarks.engine.host import host, measured
from ctsim.benchmarks.engine.record import Store, done
from ctsim.benchmarks.scores.score import Score
from ctsim.benchmarks.studies.methods import records, tables
from ctsim.benchmarks.studies.methods.records import Run, RunRecord
from ctsim.dataset import versions
from ctsim.errors import InputError


def record(status="ok", label="fdk", time="", **changes):
    score = Score(region="r", reference="e", alignment="none", data_range=0.1, n_voxels=3, values={"psnr3d": None})
    given = {"scene": "lung", "scene_id": "a1", "scan": "b2", "params": {"a": 1, "b": 2.5}, **changes}
    return make_record(label=label, time=time, status=status, inputs="counts only", scores={"tissue": score}, **given)


def store(folder, name="records"):
    return Store(folder, name, RunRecord, records.WHAT)


def append(folder, *found, name="records"):
    store(folder, name).append(found)


def test_scans_of_different_code_are_named():
    one, two = (record(seed=k, scan=f"s{k}", data_code=f"v{k}") for k in (1, 2))
    assert records.remarks([one, one]) == []
    assert records.remarks([one, record(seed=1, scan="s1", label="limar")]) == []  # of the same scan
    assert records.remarks([one, two]) == [
        "the scenes were made by different code of the simulator, so their scores may not compare: "
        "lung (seed 1) by v1; lung (seed 2) by v2; make-dataset --force makes them again"
    ]
    for text in (tables.render([one, two], "md"), tables.render([one, two], "tex")):
        assert "lung (seed 1) by v1; lung (seed 2) by v2" in text


def test_limits_that_methods_state_are_named_below_the_tables():
    dark = {"limitation": "readings of P > 3 are missed by 1.2"}
    found = [record(seed=k, scan=f"s{k}", label="splat", details=dark) for k in (1, 2)]
    twin = record(label="sirt", variant="metal_free", details={"limitation": "the scan is truncated"})
    said = "limits that methods state of their volumes: splat on lung (seed 1), lung (seed 2): readings of P > 3"
    assert [text.partition(" are missed")[0] for text in records.remarks([*found, twin])] == [said]
    assert said in tables.render(found, "md")


def test_every_field_of_a_run_changes_its_identity():
    changes = {
        "scene": "teeth", "scene_id": "x", "scan": "x", "seed": 1, "method": "nmar", "params": {"a": 2, "b": 2.5},
        "mask": "oracle", "variant": "metal_free", "code": "x", "protocol": 99,
    }  # fmt: skip
    assert set(changes) == {*Run.__struct_fields__, "scan", "code", "protocol"}
    identities = {record(**{k: v}).identity for k, v in changes.items()} | {record().identity}
    assert len(identities) == len(changes) + 1
    assert record(params={"b": 2.5, "a": 1}).identity == record().identity


def test_the_command_names_the_file_and_the_line_of_a_byte_that_is_no_text(tmp_path, monkeypatch, capsys):
    path = tmp_path / "records.jsonl"
    append(tmp_path, record(label="fdk-in-latin-1"))
    path.write_bytes(path.read_bytes().replace(b"latin-1", b"l\xe4tin-1"))
    for words in (["data", str(tmp_path), "--table"], ["paper-tables", str(tmp_path)], ["report", str(tmp_path)]):
        monkeypatch.setattr(sys, "argv", ["run-benchmark", *words])
        assert cli.run_benchmark() == 2
        said = capsys.readouterr().err
        assert f"{path}, line 1: " in said and "0xe4" in said and said.count("\n") == 1


def test_only_ok_is_done_and_counts_before_a_failure_of_the_same_run():
    a, b, c = record(), record("skipped", seed=1), record("error", seed=2)
    assert set(done([a, b, c])) == {a.identity}
    for given in ([a, record("error")], [record("error"), a], [record("error"), a, record("timeout")]):
        assert set(done(given)) == {a.identity} and records.latest(given) == [a]
    again = record(label="fdk", time="later")
    assert records.latest([a, again, record("error")]) == [again]  # of two that ended well the last
    assert records.latest([record("error"), record("timeout")]) == [record("timeout")]


def test_a_scan_made_anew_supersedes_what_was_measured_on_the_old():
    given = [record(), record(label="nmar"), record(scan="new"), record(seed=1)]
    assert records.latest(given) == [record(scan="new"), record(seed=1)]


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
    assert method.reconstruct("scan") == ("scan", "cpu", 5)
    assert method.skip("scan") is None
    with pytest.raises(InputError, match=r"my_lab_net:reconstruct\.step: unknown parameter; did you mean steps\?"):
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


NET = """
from my_lab_pkg import helper

class Net:
    def run(self, layers):
        for layer in layers:
            match layer:
                case "last":
                    try:
                        import os
                    except ImportError:
                        with open(layer):
                            from . import other
"""


def test_code_version_follows_imports(tmp_path, monkeypatch):
    package = tmp_path / "my_lab_pkg"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "net.py").write_text(NET)
    (package / "helper.py").write_text("a = 1\n")
    (package / "other.py").write_text("b = 1\n")
    (package / "unrelated.py").write_text("c = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    seen = []
    for name, text in [("", ""), ("helper", "a = 2\n"), ("other", "b = 2\n"), ("unrelated", "c = 2\n")]:
        if name:
            (package / f"{name}.py").write_text(text)
        versions.code_version.cache_clear()
        versions._read.cache_clear()
        seen.append(versions.code_version("my_lab_pkg.net"))
    assert len(set(seen)) == 3 and seen[2] == seen[3]


def test_settings_are_parsed_and_refused():
    found = methods.parse_overrides(("fdk.window=hann", "fdk.cut=0.5", "lab.x:f.n=3"), ("fdk", "lab.x:f"))
    assert found == {"fdk": {"window": "hann", "cut": 0.5}, "lab.x:f": {"n": 3}}
    for bad in ("window=hann", "fdk.window", "nmar.a=1"):
        with pytest.raises(InputError, match="--set"):
            methods.parse_overrides((bad,), ("fdk",))
