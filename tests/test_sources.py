"""The hash that says which code made a scan."""

import os
import shutil
from pathlib import Path

import pytest

from ctsim.dataset.sources import NOT_OF_DATA, TABLES, TEXT, hash_of, source_hash
from ctsim.errors import InputError

ROOT = Path(__file__).parents[1]
FOR_PEOPLE = {"beam/NOTICE.txt", "CITATION.cff", "__init__.pyi", "py.typed"}


@pytest.fixture
def copy(tmp_path) -> Path:
    """The sources that are tested, elsewhere."""
    ignored = shutil.ignore_patterns("__pycache__", *NOT_OF_DATA)
    return Path(shutil.copytree(ROOT / "ctsim", tmp_path / "ctsim", ignore=ignored))


def test_the_place_the_time_and_the_line_ends_of_sources_do_not_matter(copy):
    cache = copy / "kernels" / "__pycache__"
    cache.mkdir()
    (cache / "noise_cpu.cpython-311.pyc").write_bytes(b"compiled")
    for path in (copy / "phantoms").rglob("*.py"):
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
        os.utime(path, (0, 0))
    assert hash_of(copy) == source_hash()


def test_methods_commands_and_reports_are_not_hashed(copy):
    for name in NOT_OF_DATA:
        (copy / name).mkdir()
        (copy / name / "new.py").write_text("X = 1\n", encoding="utf-8")
    assert hash_of(copy) == source_hash()


@pytest.mark.parametrize("changed", ["detector/noise.py", "tracer/kernels/raytrace_cpu.py", "phantoms/recipe.py"])
def test_a_changed_a_new_and_a_renamed_source_are_other_code(copy, changed):
    path = copy / changed
    before, text = hash_of(copy), path.read_text(encoding="utf-8")
    path.write_text(text + "X = 1\n", encoding="utf-8")
    found = {before, hash_of(copy)}
    path.write_text(text, encoding="utf-8")
    (path.parent / "another.py").write_text("")
    found.add(hash_of(copy))
    (path.parent / "another.py").unlink()
    path.rename(path.parent / "renamed.py")
    found.add(hash_of(copy))
    assert len(found) == 4


def test_a_changed_table_is_other_code(copy):
    path = copy / "beam" / "tungsten_spectra.npz"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    assert hash_of(copy) != source_hash()


def test_every_file_of_the_packages_is_hashed_or_known_to_be_for_people(copy):
    """A new kind of table, say CSV, must be added to those that are hashed."""
    files = (path for path in copy.rglob("*") if path.is_file())
    left = {f"{path.relative_to(copy)}" for path in files if path.suffix not in (TEXT, TABLES)}
    assert left == FOR_PEOPLE


@pytest.mark.parametrize(("folder", "package"), [("", "ctsim"), ("phantoms", "ctsim.phantoms")])
def test_a_package_without_sources_tells_nothing(copy, folder, package):
    for path in (copy / folder).rglob("*.py"):
        if folder or "phantoms" not in path.parts:
            path.unlink()
    with pytest.raises(InputError, match=f"the package {package} has no sources"):
        hash_of(copy)
