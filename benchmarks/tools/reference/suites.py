"""The page of the bundled suites: what they are for, and their scenes."""

import itertools

from ctsim.benchmarks.suites import bundled, load
from ctsim.benchmarks.tools.reference import text
from ctsim.phantoms.scene import Scene

HEAD = """# Bundled suites

`make-dataset SUITE data/` simulates a suite. `--only NAME` takes single scenes, `--seeds 1 2 3` repeats every scene.
The files lie in `benchmarks/suites/`. A suite of your own is a TOML file: see
[write a scene](../tutorials/write-a-scene.md)."""


def page() -> str:
    """Return the page as Markdown."""
    return "\n\n".join([HEAD, *(section(name) for name in sorted(bundled()))])


def section(name: str) -> str:
    """Return what a suite's file says at its head, and its scenes."""
    lines = bundled()[name].read_text(encoding="utf-8").splitlines()
    comment = itertools.takewhile(lambda line: line.startswith("#"), lines)
    said = " ".join(line.lstrip("# ") for line in comment)
    rows = [_row(scene) for scene in load(name)]
    return f"## {name}\n\n{said}\n\n" + text.table(("scene", "recipe", "metal", "volume", "views", "tube"), rows)


def _row(scene: Scene) -> tuple[str, ...]:
    scanner = scene.resolve()
    g, tube = scanner.geometry, scanner.tube
    filters = ", ".join(f"{f.thickness:g} mm {f.material}" for f in tube.filters)
    volume, views = " × ".join(map(str, g.n_voxel)), f"{g.n_views} of {' × '.join(map(str, g.n_detector))}"
    return (
        f"`{scene.name}`",
        f"`{scene.phantom.recipe}`",
        scene.phantom.metal,
        volume,
        views,
        f"{tube.kvp:g} kVp, {filters}",
    )
