"""A scan in memory: what a scene's folder would hold, without files."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.dataset.truth import ScanWithTruth
from ctsim.dataset.writer import Stack
from ctsim.errors import InputError
from ctsim.scaninfo import TWIN, ScanInfo


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SimulatedScan(ScanWithTruth):
    """A simulated scan that is on no disk: the same numbers as the folder that `make-dataset` writes.

    `arrays` and `texts` are the folder's files by their names without .tif; two scans are equal if they are the same
    object.
    """

    arrays: Mapping[str, NDArray[Any]] = field(repr=False)
    texts: Mapping[str, str] = field(repr=False)

    def file(self, name: str) -> NDArray[Any]:
        """Return a copy of an array by its full name."""
        if name not in self.arrays:
            raise InputError(
                f"scan {self.name!r}: was simulated without {name}; expected one of {', '.join(self.arrays)}"
            )
        return self.arrays[name].copy()

    def text(self, name: str) -> str | None:
        """Return a text by its file's name; None where there is none."""
        return self.texts.get(name)


class MemoryWriter:
    """Collects one scene as `SceneWriter` writes it; always from the first view."""

    first_view = 0

    def __init__(self, name: str, *, scene_id: str, stacks: tuple[Stack, ...]) -> None:
        self._name, self._scene_id = name, scene_id
        self._arrays: dict[str, NDArray[Any]] = {s.name: np.empty(s.shape, s.dtype) for s in stacks}
        self._stacks = tuple(stack.name for stack in stacks)
        self._texts: dict[str, str] = {}

    def put(self, view: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Keep one view of every stack."""
        for name in self._stacks:
            self._arrays[name][view] = arrays[name]

    def write_image(self, name: str, array: NDArray[Any], spacing: tuple[float, ...]) -> None:
        """Keep a whole volume [z, y, x] or image [v, u]; the geometry knows its spacing."""
        self._arrays[name] = np.array(array)

    def write_text(self, name: str, text: str | bytes) -> None:
        """Keep a text such as scene.toml."""
        self._texts[name] = text if isinstance(text, str) else text.decode()

    def finish(self) -> SimulatedScan:
        """Return the scan, and its twin if there is one."""
        info = msgspec.json.decode(self._texts["scan.json"], type=ScanInfo)
        same: dict[str, Any] = {"name": self._name, "scene_id": self._scene_id, "info": info}
        same |= {"arrays": self._arrays, "texts": self._texts}
        twin = SimulatedScan(prefix=TWIN, **same) if f"{TWIN}counts" in self._arrays else None
        return SimulatedScan(metal_free=twin, **same)
