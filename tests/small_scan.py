"""A scan small enough to be written in milliseconds, for the tests of writing and of reading."""

import hashlib
import time
from pathlib import Path

import msgspec
import numpy as np

from ctsim.dataset.writer import SceneWriter, Stack
from ctsim.geometry import Geometry

GEOMETRY = Geometry(
    dso=200.0,
    dsd=400.0,
    n_voxel=(5, 7, 11),
    d_voxel=(0.5, 0.4, 0.25),
    n_detector=(5, 7),
    d_detector=(0.2, 0.25),
    n_views=6,
)
STACKS = (
    Stack(name="counts", shape=(6, 5, 7), dtype="uint16", pixel=(0.2, 0.25)),
    Stack(name="metal_free/counts", shape=(6, 5, 7), dtype="uint16", pixel=(0.2, 0.25)),
    Stack(name="paths", shape=(6, 2, 5, 7), dtype="float32", pixel=(0.2, 0.25)),
)


def one_view(view: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(view)
    return {s.name: (rng.random(s.shape[1:]) * 6e4).astype(s.dtype) for s in STACKS}


def write(
    data: Path, name: str = "scene", *, scene_id: str = "a" * 12, plan: str = "p", pause: float = 0.0, **more
) -> Path:
    with SceneWriter(data, name, scene_id=scene_id, plan_hash=plan, stacks=STACKS, sync_seconds=0.0, **more) as writer:
        for view in range(writer.first_view, GEOMETRY.n_views):
            writer.put(view, one_view(view))
            time.sleep(pause)
        for prefix in ("", "metal_free/"):
            writer.write_image(f"{prefix}reference_effective", volume(), GEOMETRY.d_voxel)
        writer.write_image("flat", np.full((5, 7), 4e4, np.float32), GEOMETRY.d_detector)
        writer.write_image("labels", (volume() > 0.5).astype(np.uint8), GEOMETRY.d_voxel)
        info = {"geometry": GEOMETRY, "dark": 100.0, "i0": 1e5, "e_max": 90.0, "l0": 12.5}
        writer.write_text("scan.json", msgspec.json.encode(info))
        writer.write_text("plan.json", "{}")
        return writer.finish()


def volume() -> np.ndarray:
    return np.random.default_rng(99).random(GEOMETRY.n_voxel).astype(np.float32)


def content(folder: Path) -> dict[str, str]:
    files = (p for p in folder.rglob("*") if p.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
