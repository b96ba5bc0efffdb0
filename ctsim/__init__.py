"""Simulate polychromatic cone-beam CT scans of objects with metal, reconstruct them, and score the volumes.

`import ctsim` loads nothing heavy. The names in `__all__` are the short interface; each is imported when it is first
used. No name of it is also a module's. Types are declared in `__init__.pyi`.
"""

import importlib

__version__ = "0.1.0"

_MODULES = {
    "find_scene": "ctsim.api",
    "new_scene": "ctsim.api",
    "reconstruct_scan": "ctsim.api",
    "score_volume": "ctsim.api",
    "simulate_scene": "ctsim.phantoms.dataset",
    "list_scans": "ctsim.dataset.store",
    "open_scan": "ctsim.dataset.store",
    "plot_geometry": "ctsim.reports.plots",
    "plot_projections": "ctsim.reports.plots",
    "Geometry": "ctsim.geometry",
    "InputError": "ctsim.errors",
    "Scan": "ctsim.types",
    "Scene": "ctsim.phantoms.scene",
    "Volume": "ctsim.types",
}
"""Each name of the short interface and the module that defines it."""

__all__ = ["__version__", *_MODULES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'ctsim' has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(_MODULES[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
