"""An installed ctsim: what the wheel holds, and that it works in a project with folders named as ours.

The wheel lies on the path before the environment's packages, and `-S` leaves out an editable install. With CTSIM_PYPI=1
PyPI's package `phantoms` is installed next to it, else a stub of that name.
"""

import json
import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest
from wheels import ROOT, build_wheel

import ctsim
from ctsim.dataset.store import list_scans


def pip(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def site(wheel, tmp_path_factory) -> Path:
    """What pip installs from the wheel, and a package `phantoms` of somebody else after it."""
    folder = tmp_path_factory.mktemp("site")
    done = pip("--no-index", "--no-compile", "--target", str(folder), str(wheel))
    assert done.returncode == 0, done.stderr
    theirs = ("--only-binary", ":all:", "--target", str(folder), "--upgrade", "phantoms")
    if os.environ.get("CTSIM_PYPI") == "1":
        done = pip(*theirs)
        assert done.returncode == 0, done.stderr
    else:
        (folder / "phantoms").mkdir()
        (folder / "phantoms" / "__init__.py").write_text("THEIRS = True\n", encoding="utf-8")
    return folder


@pytest.fixture
def project(tmp_path) -> Path:
    """A user's folder with packages of the names that ours have in the repository."""
    for name in ("reports", "phantoms"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("OWN = True\n", encoding="utf-8")
    return tmp_path


def run(project: Path, site: Path, code: str) -> str:
    """Run a script of the project with the installed ctsim, without this repository."""
    (project / "script.py").write_text(code, encoding="utf-8")
    path = os.pathsep.join([str(site), sysconfig.get_path("purelib")])
    done = subprocess.run(
        [sys.executable, "-S", "script.py"], cwd=project, env={**os.environ, "PYTHONPATH": path},
        capture_output=True, text=True, timeout=900, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_says_its_version_its_types_and_how_to_cite_it(wheel):
    archive = zipfile.ZipFile(wheel)
    assert {"ctsim/py.typed", "ctsim/__init__.pyi", "ctsim/CITATION.cff"} <= {*archive.namelist()}
    assert archive.read("ctsim/CITATION.cff") == (ROOT / "CITATION.cff").read_bytes()
    (metadata,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    assert f"\nVersion: {ctsim.__version__}\n" in archive.read(metadata).decode()
    assert f"\nversion: {ctsim.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert "version" not in tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_nothing_but_ctsim_is_installed(wheel):
    tops = {name.partition("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert tops == {"ctsim", f"ctsim-{ctsim.__version__}.dist-info"}


def test_ours_and_others_of_one_name_are_apart(project, site):
    code = (
        "import ctsim, reports, phantoms, ctsim.phantoms.recipes, ctsim.reports\n"
        "assert reports.OWN and phantoms.OWN and not hasattr(ctsim.phantoms, 'OWN')\n"
        "print(ctsim.__file__, ctsim.phantoms.__file__, ctsim.reports.__file__, sep='\\n')"
    )
    found = [Path(line) for line in run(project, site, code).splitlines()]
    assert found == [site / "ctsim" / part / "__init__.py" for part in ("", "phantoms", "reports")]
    assert (site / "phantoms" / "__init__.py").is_file()


def test_every_file_of_the_packages_is_in_the_wheel(wheel):
    """But the tools that write the documentation. Otherwise a first use of what is missing fails at a user's."""
    held = {*zipfile.ZipFile(wheel).namelist()}
    links = [path for path in (ROOT / "ctsim").iterdir() if path.is_symlink()]
    folders = [(ROOT / "ctsim", "ctsim"), *((path.resolve(), f"ctsim/{path.name}") for path in links)]
    files = {
        f"{name}/{path.relative_to(folder).as_posix()}"
        for folder, name in folders
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert len(files) > 300 and {name for name in files - held if "/benchmarks/tools/" not in name} == set()


USED = """
import importlib, pkgutil
import ctsim

for module in pkgutil.walk_packages(ctsim.__path__, "ctsim."):
    if ".notebooks" in module.name or module.name.endswith("__main__"):
        continue
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:  # of an extra
        assert not error.name.startswith("ctsim"), module.name
print(ctsim.__file__)
"""
SIMULATED = 'ctsim.simulate_scene(ctsim.find_scene("quick", "lung-Fe"))'


@pytest.mark.slow
def test_an_installed_ctsim_imports_and_runs_the_readme(project, site, smallest, monkeypatch):
    """All modules are there, and the README's Python runs on a scan that lies on the disk.

    Files in a new place are compiled again: 20 s here, and a minute more for the simulator. `test_docs` runs all of it.
    """
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(site.parent / "compiled"))
    (scan,) = list_scans(smallest)
    (example,) = re.findall(r"^```python\n(.*?)^```", (ROOT / "README.md").read_text(encoding="utf-8"), re.M | re.S)
    assert SIMULATED in example
    where, psnr = run(project, site, USED + example.replace(SIMULATED, f"ctsim.open_scan({str(scan)!r})")).split()
    assert where == str(site / "ctsim" / "__init__.py") and 10 < float(psnr) < 60
    assert (project / "views.png").stat().st_size


COMMAND = """
import sys
from ctsim.benchmarks import cli

sys.argv = {words!r}
sys.exit(getattr(cli, sys.argv[0].replace("-", "_"))())
"""
NET = """
import torch

from ctsim import Scan, Volume


def reconstruct(scan: Scan) -> Volume:
    return Volume(values=torch.full(scan.geometry.n_voxel, 0.01))
"""


@pytest.mark.slow
def test_an_installed_ctsim_simulates_and_scores_the_readmes_own_scene(project, site, monkeypatch):
    """The README's TOML block, and the commands after it, with a method of a package in the user's folder."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(site.parent / "compiled"))
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (scene,) = re.findall(r"^```toml\n(.*?)^```", text, re.M | re.S)
    commands = re.findall(r"^```bash\n(.*?)^```", text[text.index(scene) :], re.M | re.S)[0].splitlines()
    assert [line.split()[0] for line in commands] == ["make-dataset", "run-benchmark"]
    (project / commands[0].split()[1]).write_text(scene, encoding="utf-8")
    (project / "my_lab.py").write_text(NET, encoding="utf-8")
    for line in commands:
        run(project, site, COMMAND.format(words=line.split()))
    results = project / commands[1].split()[2]
    rows = [json.loads(line)["task"] for line in (results / "records.jsonl").read_text(encoding="utf-8").splitlines()]
    assert {(row["subject"], row["part"]) for row in rows} == {
        (method, part) for method in ("fdk", "my_lab:reconstruct") for part in ("metal", "metal_free")
    }
    assert (results / "panels" / "walnut-pins.png").stat().st_size > 10_000
