"""Scenes that differ in metal, beam, noise and dose alone: one body is built for them, and its rays are traced once."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import msgspec

from ctsim.beam.spectrum import Tube
from ctsim.detector.noise import Noise
from ctsim.phantoms.scene import Scene, build, layers_of
from ctsim.types import Phantom

MOST, FILES = 16, 200  # scenes made together, and their stacks of views, a file each, that are open
STAND_IN = "Re"
"""A metal that no recipe has of its own: what it is in is the recipe's metal."""


def families(scenes: Sequence[Scene], most: int = MOST) -> Iterator[tuple[Scene, ...]]:
    """Divide scenes into groups, of at most `most`, that seem to differ in metal, beam, noise and dose alone.

    Groups come in the order of their first scenes.
    """
    groups: dict[bytes, list[Scene]] = {}
    for scene in scenes:
        groups.setdefault(msgspec.json.encode(_shared(scene)), []).append(scene)
    for group in groups.values():
        size = max(1, min(most, FILES // _stacks(group[0])))
        yield from (tuple(group[k : k + size]) for k in range(0, len(group), size))


def _stacks(scene: Scene) -> int:
    """Return the most stacks of views that a scene has."""
    return 2 * (3 + len(scene.truth.mono_kev)) + 3


def _shared(scene: Scene) -> Any:
    """Return what scenes of a family have in common."""
    scanner = msgspec.structs.replace(
        scene.scanner, tube=Tube(), noise=Noise(), i0=None, scan_mas=None, scan_kerma=None
    )
    tube, noise = scene.resolve().tube, scene.resolve().noise
    # such noise takes a pass over all views first, in which scenes are not in step
    alone = scene.name if noise.model == "tigre" else ""
    rays = tube.focal_spot, tube.off_focal, tube.bowtie, alone
    return _without_metal(scene), scene.seed, scanner, rays, scene.simulation, scene.truth, scene.metal_in_view


def _without_metal(scene: Scene) -> Any:
    """Return the recipe but for what its metal is; whether there is metal stays."""
    metal = "none" if scene.phantom.metal == "none" else STAND_IN
    return msgspec.structs.replace(scene.phantom, metal=metal)


def build_all(scenes: Sequence[Scene]) -> list[Phantom]:
    """Build the phantoms of scenes as `ctsim.phantoms.scene.build` does; those that differ in metal share arrays.

    Layers that their scans do not see may be missing.
    """
    if len(scenes) == 1:
        return [build(scenes[0], whole=False)]
    bodies: list[tuple[Scene, Phantom]] = []
    made: dict[tuple[int, str], Phantom] = {}
    built: list[Phantom] = []
    for scene in scenes:
        body = next((phantom for other, phantom in bodies if _same_body(other, scene)), None)
        if body is None:
            body = build(msgspec.structs.replace(scene, phantom=_without_metal(scene)), whole=False)
            bodies.append((scene, body))
        key = id(body), scene.phantom.metal
        if key not in made:
            made[key] = _with_metal(body, scene.phantom.metal) or build(scene, whole=False)
        built.append(made[key])
    return built


def _same_body(a: Scene, b: Scene) -> bool:
    """Say whether the phantoms of two scenes are the same but for the recipe's metal."""
    if (_without_metal(a), a.seed, a.metal_in_view) != (_without_metal(b), b.seed, b.metal_in_view):
        return False
    parts = [layers_of(scene) for scene in (a, b)]
    if a.metal_in_view:
        return a.resolve().geometry == b.resolve().geometry and len({part is None for part in parts}) == 1
    mine, other = (slice(None) if part is None else part(0.0) for part in parts)
    return mine == other


def _with_metal(body: Phantom, metal: str) -> Phantom | None:
    """Put a metal where a body holds the stand-in; None where the body has this material already."""
    if STAND_IN not in body.materials:
        return body
    if metal in body.materials:
        return body if metal == STAND_IN else None
    materials = tuple(metal if m == STAND_IN else m for m in body.materials)
    solids = tuple(replace(s, material=metal) if s.material == STAND_IN else s for s in body.solids)
    return replace(body, materials=materials, solids=solids)
