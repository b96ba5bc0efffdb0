"""`run-benchmark detect`: how well lesions near metal are detected. The flags of the command."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from ctsim.benchmarks.engine.study import Options

DEFAULT = ("fdk", "zero", "hull", "twin-fdk", "limar", "nmar", "splat")
PAIRS = 100


@dataclass(frozen=True, kw_only=True)
class Flags(Options):
    """Measure how well a model observer detects lesions near metal in the volumes of each method.

    Scans with and without lesions differ in nothing else but their noise. All methods get the same scans.
    docs/explanation/protocols.md says what is measured.
    """

    results: tyro.conf.Positional[Path]
    """Folder for detect.jsonl and detect.md; created if missing."""
    repeats: int = PAIRS
    """Pairs of scans of each scene, one with and one without lesions; at least 10."""
    method: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """A method's name, such as fdk, or module:function of your own; may be given several times (default: fdk, limar,
    nmar, splat, and the controls zero, hull and twin-fdk)."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="METHOD.PARAMETER=VALUE")] = ()
    """A method's parameter, one of those that `run-benchmark methods` lists; may be given several times."""
    suite: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """Scenes in place of the bundled ones; docs/how-to/measure-detection.md lists the keys."""
    scene: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """Only this scene; may be given several times (default: all)."""
