"""Imports run one way, and importing loads no more than it must."""

import importlib.metadata
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DRAWS = {"matplotlib", "pandas", "tyro", "tqdm"}
SLOW = {"torch", "numba", "scipy", "xraylib", "skimage"}
BELOW_BENCHMARKS = ("ctsim", "phantoms", "reconstruct", "baselines")


def run(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded(code: str) -> set[str]:
    """Top-level modules in memory after `code` ran in a fresh interpreter."""
    printed = run(f"{code}\nimport sys\nprint()\nprint(*{{m.partition('.')[0] for m in sys.modules}})")
    return set(printed.splitlines()[-1].split())


def modules(package: str) -> list[str]:
    return [m.name for m in pkgutil.walk_packages([str(ROOT / package)], f"{package}.")]


def test_the_layers_hold():
    run("from importlinter.cli import lint_imports; assert lint_imports(cache_dir=None) == 0")


@pytest.mark.parametrize("package", ["ctsim", "phantoms", "reconstruct", "baselines", "benchmarks", "reports"])
def test_importing_a_package_loads_nothing_heavy(package):
    assert not loaded(f"import {package}") & (DRAWS | SLOW)


@pytest.mark.parametrize("module", ["ctsim.errors", "ctsim.geometry", "ctsim.manifest", "ctsim.store"])
def test_what_lists_and_checks_datasets_loads_nothing_slow(module):
    assert not loaded(f"import {module}") & (DRAWS | SLOW)


def test_making_data_does_without_torch():
    assert "torch" not in loaded("import phantoms.scene, ctsim.simulate, ctsim.writer, benchmarks.make_dataset")


def test_nothing_below_benchmarks_draws_or_talks():
    names = [m for p in BELOW_BENCHMARKS for m in modules(p) if m != "ctsim.data.make_spectrum_table"]
    assert len(names) > 30
    brought = loaded("import torch")  # torch itself loads tqdm
    assert not (loaded("import " + ", ".join(names)) - brought) & DRAWS


@pytest.mark.parametrize("command", ["make-dataset", "run-benchmark"])
def test_help_loads_nothing_slow(command):
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name=command)
    module, _, function = entry.value.partition(":")
    code = (
        f"import sys; sys.argv = [{command!r}, '--help']\nfrom {module} import {function}\n"
        f"try:\n    {function}()\nexcept SystemExit as end:\n    assert not end.code"
    )
    assert not loaded(code) & (SLOW | {"matplotlib", "pandas"})
    assert command in run(code)


def test_importing_everything_neither_prints_nor_warns():
    names = [m for p in (*BELOW_BENCHMARKS, "benchmarks") for m in modules(p)]
    left_out = {"ctsim.data.make_spectrum_table", "benchmarks.peer_rtk"}  # they need what only an extra installs
    assert run("import " + ", ".join(n for n in names if n not in left_out)) == ""
