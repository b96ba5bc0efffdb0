"""A wheel of the sources that are tested."""

import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def build_wheel(folder: Path) -> Path:
    """Build a wheel from a copy of the sources in `folder`, and return it."""
    left_out = shutil.ignore_patterns(".*", "__pycache__", "build", "*.egg-info", "docs", "tests")
    shutil.copytree(ROOT, folder / "source", symlinks=True, ignore=left_out)
    code = f"from setuptools import build_meta; build_meta.build_wheel({str(folder)!r})"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder / "source", capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob("*.whl")
    return wheel
