"""Bundled suites: scenes for datasets, and what studies measure."""

from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from ctsim.errors import InputError
from ctsim.human import human_choice

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

    from ctsim.phantoms.scene import Scene

STUDY_SUITES = ("detect", "pareto", "stress", "tune-settings")
"""Suites of studies; make-dataset does not take them."""


def load(suite: str) -> "tuple[Scene, ...]":
    """Return the scenes of a bundled suite by its name, or of a TOML file by its path.

    Raises
    ------
    InputError
        When there is no such suite or file, or the file is wrong (naming file, key and what was expected).
    """
    from ctsim.phantoms.scene import load_suite

    known = bundled()
    if suite in known:
        with resources.as_file(known[suite]) as path:
            return load_suite(path)
    if not Path(suite).is_file():
        raise InputError(f"{suite}: neither a TOML file nor a bundled suite ({', '.join(sorted(known))})")
    return load_suite(Path(suite))


def identity(scene: "Scene") -> str:
    """Return the hash of a scene's recipe; only a call loads the code that builds scenes."""
    from ctsim.phantoms.scene import scene_id

    return scene_id(scene)


def bundled() -> "dict[str, Traversable]":
    """Return the bundled suites by name, without `STUDY_SUITES`."""
    folder = resources.files("ctsim.benchmarks.suites")
    files = {entry.name.removesuffix(".toml"): entry for entry in folder.iterdir() if entry.name.endswith(".toml")}
    return {name: entry for name, entry in files.items() if name not in STUDY_SUITES}


def select(scenes: "tuple[Scene, ...]", only: tuple[str, ...], seeds: tuple[int, ...]) -> "tuple[Scene, ...]":
    """Return the named scenes (all when none is named), once for each seed when seeds are given."""
    names = [scene.name for scene in scenes]
    for name in only:
        if name not in names:
            raise InputError(f"--only {name}: no such scene, expected one of {human_choice(names, name)}")
    chosen = tuple(scene for scene in scenes if not only or scene.name in only)
    if not seeds:
        return chosen
    if drawn := next((scene for scene in chosen if scene.drawn), None):
        raise InputError(f"--seeds: {drawn.name} comes from count, which gives it its seed; raise count instead")
    return tuple(
        msgspec.structs.replace(scene, name=f"{scene.name}-s{seed}", seed=seed) for scene in chosen for seed in seeds
    )
