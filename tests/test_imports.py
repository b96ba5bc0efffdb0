"""Imports run one way, and importing loads no more than it must."""

import importlib.metadata
import pkgutil
import subprocess
import sys
import zipfile
from graphlib import TopologicalSorter
from pathlib import Path

import grimp
import pytest
from setuptools import find_packages
from wheels import build_wheel

from ctsim.benchmarks.cli import OF_DATASETS, OTHERS

ROOT = Path(__file__).parents[1]
DRAWS = {"matplotlib", "pandas", "tyro", "rich"}
SLOW = {"torch", "numba", "scipy", "xraylib", "skimage"}
COMMANDS = ("make-dataset", "run-benchmark")
SUBCOMMANDS = [*(f"make-dataset {name}" for name in OF_DATASETS), *(f"run-benchmark {name}" for name in OTHERS)]
PARTS = ("phantoms", "reconstruct", "baselines", "benchmarks", "reports")


def run(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def loaded(code: str) -> set[str]:
    """Top-level modules in memory after `code` ran in a fresh interpreter."""
    return said_and_loaded(code)[1]


def said_and_loaded(code: str) -> tuple[str, set[str]]:
    """What `code` printed in a fresh interpreter, and the top-level modules in memory after it."""
    printed = run(f"{code}\nimport sys\nprint(chr(0), *{{m.partition('.')[0] for m in sys.modules}})")
    said, _, names = printed.rpartition("\0")
    return said, set(names.split())


def modules(*left_out: str) -> list[str]:
    """All modules of ctsim but for those of some parts."""
    found = [m.name for m in pkgutil.walk_packages([str(ROOT / "ctsim")], "ctsim.")]
    return [name for name in found if name.split(".")[1] not in left_out]


def test_no_module_of_benchmarks_imports_itself_by_way_of_others():
    """Imports within functions are counted, too; a module's own package is loaded before it in any case."""
    graph = grimp.build_graph("ctsim", cache_dir=None)
    ours = [name for name in graph.modules if name.startswith("ctsim.benchmarks.")]
    imported = {name: graph.find_modules_directly_imported_by(name) - {name.rpartition(".")[0]} for name in ours}
    TopologicalSorter(imported).prepare()


def test_an_installed_ctsim_claims_one_name_on_the_import_path():
    found = find_packages(str(ROOT), include=["ctsim*"])
    folders = {".".join(p.parent.relative_to(ROOT).parts) for part in ("ctsim", *PARTS) for p in inits(ROOT / part)}
    assert {*found} == {name if name.startswith("ctsim") else f"ctsim.{name}" for name in folders}
    assert (importlib.metadata.distribution("ctsim").read_text("top_level.txt") or "").split() == ["ctsim"]


def test_a_wheel_holds_all_of_ctsim_but_the_tools(tmp_path):
    wheel = build_wheel(tmp_path)
    held = {name for name in zipfile.ZipFile(wheel).namelist() if name.endswith((".py", ".toml", ".html", ".npz"))}
    parts = [path for part in PARTS for path in (ROOT / part).rglob("*")]
    ours = [path for path in [*parts, *(ROOT / "ctsim").rglob("*")] if path.suffix in (".py", ".toml", ".html", ".npz")]
    names = {str(path.relative_to(ROOT)) for path in ours}
    tools = {name for name in names if name.startswith("benchmarks/tools/")}
    assert tools and held == {name if name.startswith("ctsim/") else f"ctsim/{name}" for name in names - tools}


def inits(folder: Path) -> list[Path]:
    return list(folder.rglob("__init__.py"))


@pytest.mark.parametrize("package", ["ctsim", *(f"ctsim.{part}" for part in PARTS)])
def test_importing_a_package_loads_nothing_heavy(package):
    declares = {"tyro"} if package == "ctsim.reports" else set()  # the flags of run-benchmark report
    assert not loaded(f"import {package}") & (DRAWS | SLOW) - declares


@pytest.mark.parametrize("module", ["ctsim.errors", "ctsim.geometry", "ctsim.dataset.manifest", "ctsim.dataset.store"])
def test_what_lists_and_checks_datasets_loads_nothing_slow(module):
    assert not loaded(f"import {module}") & (DRAWS | SLOW)


def test_the_package_loads_nothing_until_a_name_is_used():
    own = loaded("import ctsim; ctsim.__version__; dir(ctsim)")
    assert not own & {"numpy", "msgspec", *DRAWS, *SLOW}
    assert "numpy" in loaded("import ctsim; ctsim.open_scan")
    assert not loaded("import ctsim; ctsim.open_scan, ctsim.list_scans, ctsim.InputError") & (DRAWS | SLOW)


def test_making_data_does_without_torch():
    assert "torch" not in loaded(
        "import ctsim.phantoms.scene, ctsim.simulate, ctsim.dataset.writer, ctsim.benchmarks.make_dataset.work"
    )


@pytest.mark.slow
def test_nothing_below_benchmarks_draws_or_talks():
    names = [m for m in modules("api", "benchmarks", "reports") if m != "ctsim.beam.make_table"]
    assert len(names) > 30
    brought = loaded("import torch")
    assert not (loaded("import " + ", ".join(names)) - brought) & DRAWS


@pytest.mark.slow
@pytest.mark.parametrize("words", [*COMMANDS, *SUBCOMMANDS])
def test_help_loads_nothing_slow(words):
    command, *more = words.split()
    (entry,) = importlib.metadata.entry_points(group="console_scripts", name=command)
    module, _, function = entry.value.partition(":")
    code = (
        f"import sys; sys.argv = {[command, *more, '--help']!r}\nfrom {module} import {function}\n"
        f"try:\n    {function}()\nexcept SystemExit as end:\n    assert not end.code"
    )
    said, names = said_and_loaded(code)
    assert words in said and not names & (SLOW | {"matplotlib", "pandas"})


@pytest.mark.slow
def test_importing_everything_neither_prints_nor_warns():
    names = modules("reports")
    left_out = {"ctsim.beam.make_table"}  # it needs what only an extra installs
    assert run("import " + ", ".join(n for n in names if n not in left_out)) == ""
