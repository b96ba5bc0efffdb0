"""Scenes that differ in metal, beam, noise and dose alone: one body is built for them, and its rays are traced once."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import msgspec

from ctsim.beam.spectrum import Tube
from ctsim.detector.noise import Noise
from ctsim.phantoms.scene import Scene, build
from ctsim.types import Phantom

MOST = 16
"""Scenes made together: a file each is open for every stack of views."""


def families(scenes: Sequence[Scene], most: int = MOST) -> Iterator[tuple[Scene, ...]]:
    """Divide scenes into runs, of at most `most`, that seem to differ in metal, beam, noise and dose alone."""
    for _, group in itertools.groupby(scenes, _shared):
        alike = tuple(group)
        yield from (alike[k : k + most] for k in range(0, len(alike), most))


def _shared(scene: Scene) -> Any:
    """Return what scenes of a family have in common."""
    scanner = msgspec.structs.replace(
        scene.scanner, tube=Tube(), noise=Noise(), i0=None, scan_mas=None, scan_kerma=None
    )
    body = _without_metal(scene)
    return body, scene.seed, scanner, scene.simulation, scene.truth, scene.metal_in_view


def _without_metal(scene: Scene) -> Any:
    """Return the recipe but for what its metal is; whether there is metal stays."""
    metal = "none" if scene.phantom.metal == "none" else "Fe"
    return msgspec.structs.replace(scene.phantom, metal=metal)


def build_all(scenes: Sequence[Scene]) -> list[Phantom]:
    """Build the phantoms of scenes as `ctsim.phantoms.scene.build` does; those that differ in metal share arrays."""
    built: list[Phantom] = []
    for scene in scenes:
        alike = [(other, phantom) for other, phantom in zip(scenes, built, strict=False) if _same_body(other, scene)]
        # the very same phantom rather than one with its metal renamed
        alike.sort(key=lambda pair: pair[0].phantom.metal != scene.phantom.metal)
        phantom = _with_metal(alike[0][1], alike[0][0], scene) if alike else None
        built.append(build(scene) if phantom is None else phantom)
    return built


def _same_body(a: Scene, b: Scene) -> bool:
    """Say whether the phantoms of two scenes are the same but for the name of the recipe's metal."""
    if (_without_metal(a), a.seed, a.metal_in_view) != (_without_metal(b), b.seed, b.metal_in_view):
        return False
    return not a.metal_in_view or a.resolve().geometry == b.resolve().geometry


def _with_metal(phantom: Phantom, like: Scene, scene: Scene) -> Phantom | None:
    """Give a phantom the metal of another scene; None where a name stands for more than the recipe's metal."""
    old, new = like.phantom.metal, scene.phantom.metal
    if old == new:
        return phantom
    others = (value for name, value in msgspec.structs.asdict(scene.phantom).items() if name != "metal")
    if old in others or new in phantom.materials:
        return None
    materials = tuple(new if m == old else m for m in phantom.materials)
    solids = tuple(replace(s, material=new) if s.material == old else s for s in phantom.solids)
    return replace(phantom, materials=materials, solids=solids)
