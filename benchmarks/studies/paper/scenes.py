"""Which scene of a bundled suite a record is of: a scene's name alone does not say, its identity does.

A record is of a planned scene when its `scene_id` is that of the bundled scene with the record's seed. `make-dataset
--seeds` hashes a repetition as NAME-sSEED, which records and tables call NAME. The simulator's code has no part in it.
"""

from collections.abc import Iterable

import msgspec

from ctsim.benchmarks.studies.methods.records import Run, RunRecord
from ctsim.benchmarks.suites import load
from ctsim.errors import InputError
from ctsim.phantoms.scene import Scene, scene_id


class Scenes:
    """The planned scenes by suite and name, and the identities that they have under a seed."""

    def __init__(self, planned: Iterable[tuple[str, str]]) -> None:
        """Read the suites of the planned scenes (suite, name)."""
        wanted = set(planned)
        suites = {suite: load(suite) for suite in sorted({suite for suite, _ in wanted})}
        self._scenes = {(k, s.name): s for k, scenes in suites.items() for s in scenes if (k, s.name) in wanted}
        self._named: dict[str, list[tuple[str, str]]] = {}
        for key in self._scenes:
            self._named.setdefault(key[1], []).append(key)
        self._known: dict[tuple[tuple[str, str], int], tuple[str, ...]] = {}

    def named(self, run: Run) -> list[tuple[str, str]]:
        """Return the planned scenes that have this run's name."""
        return self._named.get(run.scene, [])

    def of(self, run: Run) -> tuple[str, str] | None:
        """Return the planned scene that this run is of; None where it has no more in common than the name."""
        return next((key for key in self.named(run) if run.scene_id in self.identities(key, run)), None)

    def identities(self, key: tuple[str, str], run: Run) -> tuple[str, ...]:
        """Return the identities of a planned scene with the run's seed, as itself and as a repetition; none if bad."""
        asked = (key, run.seed)
        if asked not in self._known:
            names = run.scene, f"{run.scene}-s{run.seed}"
            self._known[asked] = tuple(filter(None, (_identity(self._scenes[key], name, run.seed) for name in names)))
        return self._known[asked]


def _identity(scene: Scene, name: str, seed: int) -> str:
    try:
        return scene_id(msgspec.structs.replace(scene, name=name, seed=seed))
    except InputError:  # no scene has such a seed
        return ""


def title(key: tuple[str, str]) -> str:
    """Return how tables call a planned scene: SUITE/NAME."""
    return "/".join(key)


def strangers(found: list[RunRecord], scenes: Scenes, planned: Iterable[tuple[str, str, str]]) -> list[str]:
    """Say how many records have the name of a planned cell (suite, scene, label) but are of no planned scene."""
    cells: dict[tuple[str, str], set[str]] = {}
    for suite, scene, label in planned:
        cells.setdefault((suite, scene), set()).add(label)
    left: dict[tuple[str, str], list[Run]] = {}
    for record in found:
        for key in scenes.named(record.run):
            if record.label in cells.get(key, ()) and scenes.of(record.run) not in cells:
                left.setdefault(key, []).append(record.run)
    return [_stranger(key, runs, scenes) for key, runs in left.items()]


def _stranger(key: tuple[str, str], runs: list[Run], scenes: Scenes) -> str:
    count = "1 record is" if len(runs) == 1 else f"{len(runs)} records are"
    ids = _some(run.scene_id for run in runs)
    expected = _some(f"{' or '.join(scenes.identities(key, run)) or 'none'} (seed {run.seed})" for run in runs)
    return (
        f"{title(key)}: {count} left out, of another scene of this name (scene_id {ids}); "
        f"expected {expected}, which `make-dataset {key[0]}` makes"
    )


def _some(texts: Iterable[str], most: int = 3) -> str:
    """Join the first few of the texts that differ."""
    known = list(dict.fromkeys(texts))
    return ", ".join(known[:most]) + (f" and {len(known) - most} more" if len(known) > most else "")
