"""Settings of methods: a wrong one is one sentence and exit code 2 before any scan is opened."""

import json
import math
import subprocess
import sys
import typing
from typing import Any, cast

import msgspec
import numpy as np
import pytest
import torch

from ctsim.baselines.sart import OsSart, os_sart
from ctsim.benchmarks import cli, methods
from ctsim.benchmarks.methods import EXTERNAL, TABLE
from ctsim.dataset import store
from ctsim.dataset.store import list_scans, open_scan
from ctsim.errors import InputError
from ctsim.reconstruct import fdk
from ctsim.reconstruct.settings import parameters_of
from ctsim.reconstruct.splat import fast

SCAN = cast("Any", "scan")


@pytest.fixture
def command(smallest, tmp_path, monkeypatch, capsys):
    """`run-benchmark` where opening a scan is an error: exit code, and what it said."""

    def opened(_):
        raise AssertionError("a scan was opened")

    monkeypatch.setattr(store, "open_scan", opened)

    def run(*more):
        monkeypatch.setattr(sys, "argv", ["run-benchmark", str(smallest), str(tmp_path / "results"), *more])
        code = cli.run_benchmark()
        assert not (tmp_path / "results").exists()
        return code, capsys.readouterr().err.removeprefix("run-benchmark: ").rstrip("\n")

    return run


def numbers(kind):
    """The numeric types within an annotated one."""
    info = msgspec.inspect.type_info(kind)
    waiting, found = [info], []
    while waiting:
        info = waiting.pop()
        if isinstance(info, msgspec.inspect.IntType | msgspec.inspect.FloatType):
            found.append(info)
        waiting += getattr(info, "types", ()) or getattr(info, "item_types", ())
        waiting += [x for x in (getattr(info, "type", None), getattr(info, "item_type", None)) if x is not None]
    return found


def wrong_values(parameter):
    """Values of another type, and just outside the bounds, as --set takes them."""
    text = isinstance(parameter.default, str) and "one of" not in parameter.expected
    found = ["3", "[1]"] if text and not numbers(parameter.kind) else ["abc", "true" if text else "[[1]]"]
    if not isinstance(parameter.default, bool):
        found.append("true")
    if "null" not in parameter.expected:
        found.append("null")
    for number in numbers(parameter.kind):
        outside = [x for x in (number.gt, number.lt) if x is not None]
        outside += [x + step for x, step in ((number.ge, -1), (number.le, 1)) if x is not None and abs(x) < 2**62]
        several = parameter.expected.startswith("a list of 2")
        found += [json.dumps([x, x] if several else x) for x in outside]
    return found


FIXED = ("fdk-ramp", "zero", "hull")  # nothing to set


@pytest.mark.parametrize("name", TABLE)
def test_a_wrong_value_of_any_parameter_is_refused_before_a_scan_is_opened(name, command):
    known = methods.parameters(name, methods.resolve(TABLE[name][0]))
    assert bool(known) == (name not in FIXED)
    for key, parameter in known.items():
        assert parameter.meaning, (name, key)
        values = wrong_values(parameter)
        assert len(values) >= 2
        for value in values:
            said = refused(name, f"{name}.{key}={value}")
            assert said.startswith(f"--set {name}.{key}: expected {parameter.expected}, got "), (key, value, said)
        assert command("--method", name, "--set", f"{name}.{key}={values[0]}")[0] == 2


def refused(name, setting):
    """What is said of a setting, as the command says it."""
    with pytest.raises(InputError) as caught:
        methods.chosen((name,), (setting,))
    return str(caught.value)


@pytest.mark.parametrize("name", TABLE)
def test_a_parameter_that_is_not_there_is_refused_and_near_ones_are_suggested(name, command):
    for key in methods.find(name).params:
        said = refused(name, f"{name}.{key}x=1")
        assert said.startswith(f"--set {name}.{key}x: unknown parameter; did you mean ")
    code, said = command("--method", name, "--set", f"{name}.nosuch=1")
    expected = "expected none" if name in FIXED else "expected one of "
    assert code == 2 and said.startswith(f"--set {name}.nosuch: unknown parameter; {expected}")


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("splat.filtration=abc", "expected a number within 0 to 20 (mm Al), or null, got 'abc'"),
        ("splat.filtration=-0.05", "expected a number within 0 to 20 (mm Al), or null, got -0.05"),
        ("splat.passes=3", "expected a list of 2, each a whole number within 0 to 1000, or null, got 3"),
        ("splat.passes=[0,0]", "expected two counts that are not both 0, got (0, 0)"),
        ("splat.filtraton=1", "unknown parameter; did you mean filtration?"),
        ("splat.preset=paper", "--method splat-paper or --method splat-r2"),
        ("splat.tube={}", "only for response 'known', got it with response 'tube'"),
        ("splat-paper.detector={}", "only for response 'known' or 'tube', got it with response 'paper'"),
        ("splat.detector={\"kind\":\"film\"}", "detector: Invalid enum value 'film' - at `$.kind`"),
        ("field.filtration=-1", "expected a number within 0 to 20 (mm Al), or null, got -1"),
        ("splat-paper.response=mono", "basis: expected constant with response mono"),
        ("fdk.cutoff=NaN", "expected a number above 0, at most 1 (of the Nyquist frequency), got 'NaN'"),
        ("fdk.cutoff=1e999", "expected a number above 0, at most 1 (of the Nyquist frequency), got '1e999'"),
        ("limar.mask=orcale", "there is no file 'orcale'"),
        ("ibhc.bone=bonne", "bonne"),
        ("water-precorrection.tube={\"kvpp\":90}", "kvpp"),
        ("water-precorrection.detector={\"kind\":\"film\"}", "film"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_with_what_was_expected(setting, said, command):
    name = setting.partition(".")[0]
    code, sentence = command("--method", name, "--set", setting)
    assert code == 2 and "\n" not in sentence and sentence.startswith(f"--set {name}.") and said in sentence


def test_a_method_that_is_not_there_is_no_fault_of_a_setting(command):
    code, said = command("--method", "splt", "--set", "splt.tv=1")
    assert code == 2 and said.startswith("there is no method 'splt': did you mean splat")


MINE = """
from typing import Literal
from ctsim.reconstruct.fdk import reconstruct as fdk

def typed(scan, *, steps: int = 3, mode: Literal["a", "b"] = "a", rate: float = 0.5, size: int = None, **more):
    return (scan, steps, mode, rate, size, more)

def loose(scan, *, device, steps=3):
    return (scan, device, steps)

def strange(scan, *, net: "NoSuchName" = None, steps: int = 3):
    return (scan, net, steps)
"""


@pytest.fixture
def mine(tmp_path, monkeypatch):
    (tmp_path / "my_typed.py").write_text(MINE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield "my_typed"
    sys.modules.pop("my_typed", None)


def test_a_method_of_ones_own_has_its_annotations_for_types(mine, command):
    found = methods.find(f"{mine}:typed", {"steps": 5, "rate": 2, "size": 7})
    assert found.reconstruct(SCAN) == ("scan", 5, "a", 2.0, 7, {}) and found.overrides == {
        "steps": 5,
        "rate": 2.0,
        "size": 7,
    }
    assert methods.find(f"{mine}:typed", {"size": None}).overrides == {}
    for setting, said in (
        ("steps=many", "expected a whole number, got 'many'"),
        ("mode=c", "expected one of a, b, got 'c'"),
        ("rate=fast", "expected a number, got 'fast'"),
        ("stps=1", "unknown parameter; did you mean steps?"),
    ):
        name = f"{mine}:typed"
        code, sentence = command("--method", name, "--set", f"{name}.{setting}")
        assert (code, sentence) == (2, f"--set {name}.{setting.partition('=')[0]}: {said}")


def test_without_annotations_values_are_passed_on_and_a_device_is_the_cpu(mine):
    assert methods.find(f"{mine}:loose", {"steps": "many"}).reconstruct(SCAN) == ("scan", "cpu", "many")
    assert methods.find(f"{mine}:strange", {"net": "x.pt"}).reconstruct(SCAN) == ("scan", "x.pt", 3)
    assert methods.within(methods.find(f"{mine}:typed"), 9.0) == methods.find(f"{mine}:typed")


def test_what_equals_a_default_changes_no_label_and_records_stay_plain_json():
    assert methods.find("fdk", {"window": "cosine", "cutoff": 0.9}).label == "fdk"
    found = methods.find("splat", {"passes": [3, 4], "filtration": 1})
    assert found.label == "splat[filtration=1.0, passes=[3, 4]]"
    for name in TABLE:
        params = methods.find(name).params
        params = {key: value for key, value in params.items() if value != math.inf}
        assert msgspec.json.decode(msgspec.json.encode(params)) == params
        again = methods.find(name, params)
        assert again.overrides == {} and again.params == methods.find(name).params


def test_a_method_takes_keywords_or_settings_and_checks_both(smallest):
    scan = open_scan(list_scans(smallest)[0]).scan
    by_name = fdk.reconstruct(scan, window="hann", cutoff=np.float32(0.5)).values
    assert torch.equal(by_name, fdk.reconstruct(scan, fdk.Settings(window="hann", cutoff=0.5)).values)
    assert torch.equal(by_name, fdk.reconstruct(scan, fdk.Settings(cutoff=0.5), window="hann").values)
    with pytest.raises(InputError, match="cutoff: expected a number above 0"):
        fdk.reconstruct(scan, fdk.Settings(cutoff=0.0))
    with pytest.raises(InputError, match="subsets: expected a whole number within"):
        os_sart(scan, OsSart(subsets=0))


def test_bounds_are_those_of_the_struct_alone():
    found = parameters_of(fast.Settings)["fineness"]
    assert found.expected == "a number within 1 to 16" and found.default == 1.5
    hints = typing.get_type_hints(fast.Settings, include_extras=True)
    assert hints["fineness"] == found.kind


def test_the_list_of_methods_names_every_parameter_with_its_default_and_unit(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "methods"])
    assert cli.run_benchmark() == 0
    shown = capsys.readouterr().out
    blocks = {block.partition(":")[0]: block for block in shown.split("\n\n")}
    assert list(blocks) == [*TABLE, *EXTERNAL]
    for name, block in blocks.items():
        method = methods.find(name)
        head, *lines = block.strip().splitlines()
        assert head == f"{name}: {method.inputs}"
        assert [line.split()[0] for line in lines] == list(method.params)
    words = "filtration null a number within 0 to 20 (mm Al), or null; filtration behind the assumed tube"
    assert words in " ".join(blocks["splat"].split())
    monkeypatch.setattr(sys, "argv", ["run-benchmark", "methods", "fdk"])
    assert cli.run_benchmark() == 0 and capsys.readouterr().out == blocks["fdk"].rstrip("\n") + "\n"


def test_finding_near_names_of_methods_loads_no_torch():
    code = "import sys; from ctsim.benchmarks import methods; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
