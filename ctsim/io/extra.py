"""Modules of formats whose libraries come with the extra `io`."""

import importlib
from pathlib import Path
from types import ModuleType

from ctsim.errors import InputError


def load(module: str, path: Path) -> ModuleType:
    """Import a format's module. Raises InputError where the library that it needs is not installed."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        raise InputError(f"{path}: this format needs {error.name}; pip install 'ctsim[io]' installs it") from None
