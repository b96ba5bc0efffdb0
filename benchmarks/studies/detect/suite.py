"""Scenes of the detection study: a body with metal, and spheres of slightly denser tissue as lesions."""

import dataclasses
import functools
import hashlib
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.scores.channels import REACH
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.human import human_choice
from ctsim.materials import at_density
from ctsim.phantoms import scene as scenes
from ctsim.phantoms.recipes import AnyRecipe
from ctsim.phantoms.scanners import ScannerSettings
from ctsim.phantoms.suites import located, read_toml, scenes_of
from ctsim.settings import Simulation
from ctsim.solids import ELLIPSOID, Primitive, Solid
from ctsim.tracer.voxelise import metal_mask
from ctsim.types import Phantom

NEAR = 10.0
"""mm from a lesion's surface to the nearest metal, at most, of the locations near metal."""
FINER = 3  # voxels of the grid on which the distance is measured, along a voxel of the volume

Group = Literal["near", "far", "none"]


class Location(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the observer looks: (x, y, z) in mm. Group "none" is near metal, too, and has no lesion in any scan."""

    at: tuple[float, float, float]
    group: Group


class DetectScene(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A body with metal, its scanner, and the lesions.

    Lesions are spheres of `diameter` mm within the material `tissue`, of its composition and `density` times its
    density. The other keys are those of a scene.
    """

    name: str
    phantom: AnyRecipe
    tissue: str
    diameter: Annotated[float, msgspec.Meta(gt=0)]
    density: Annotated[float, msgspec.Meta(gt=0)]
    locations: Annotated[tuple[Location, ...], msgspec.Meta(min_length=1)]
    scanner: ScannerSettings = ScannerSettings()
    seed: int = 0
    simulation: Simulation = Simulation()

    def __post_init__(self) -> None:
        if self.density == 1:
            raise InputError("density must not be 1, which makes lesions that are not there")
        apart = (2 * REACH + 1) / 2 * self.diameter  # no lesion reaches into the region of another
        for k, one in enumerate(self.locations):
            for other in self.locations[:k]:
                if np.linalg.norm(np.subtract(one.at, other.at)) < apart:
                    raise InputError(
                        f"locations {list(other.at)} and {list(one.at)} are less than {apart:g} mm apart, "
                        f"{apart / self.diameter:g} diameters"
                    )

    @property
    def scan(self) -> scenes.Scene:
        """The scene without lesions, which also names the streams of the noise."""
        return scenes.Scene(
            name=self.name, phantom=self.phantom, scanner=self.scanner, seed=self.seed, simulation=self.simulation
        )

    @property
    def digest(self) -> str:
        """A hash of all keys."""
        return hashlib.sha256(msgspec.json.encode(self)).hexdigest()[:16]

    @property
    def material(self) -> str:
        """The material of the lesions."""
        return at_density(self.tissue, self.density)

    def bodies(self) -> tuple[Phantom, Phantom]:
        """Return the body with and without lesions, of the same materials. Raises InputError as `check` does."""
        body = scenes.build(self.scan)
        self.check(body)
        lesions = tuple(
            Solid(name=f"lesion{k}", material=self.material, primitives=(ball(place.at, self.diameter),))
            for k, place in enumerate(self.locations)
            if place.group != "none"
        )
        absent = dataclasses.replace(body, materials=(*body.materials, self.material))
        return dataclasses.replace(absent, solids=(*absent.solids, *lesions)), absent

    def check(self, body: Phantom) -> None:
        """Raise InputError unless every location has a sphere of the tissue around it."""
        if self.tissue not in body.materials:
            known = human_choice(body.materials[1:], self.tissue)
            raise InputError(f"{self.name}: tissue {self.tissue!r} is not in the body, expected one of {known}")
        label = body.materials.index(self.tissue)
        for place in self.locations:
            # squared distance from the sphere's centre to each voxel's box
            squared = np.zeros(())
            for n, d, o, c in zip(body.labels.shape, body.d_voxel, body.off_origin, reversed(place.at), strict=True):
                gap = np.maximum(np.abs((np.arange(n) + 0.5 - n / 2) * d + o - c) - d / 2, 0.0)
                squared = squared[..., None] + gap**2
            touched = body.labels[squared < (self.diameter / 2) ** 2]
            if not len(touched) or not (touched == label).all():
                raise InputError(f"{self.name}: location {list(place.at)} is not within {self.tissue}")

    def distances(self, body: Phantom, geometry: Geometry) -> NDArray[np.float64]:
        """Return the distance in mm from each lesion's surface to the nearest metal, to a third of a voxel.

        Raises InputError where it is not what the location's group says, and where there is no metal.
        """
        metal = metal_points(body, geometry)
        if not len(metal):
            raise InputError(f"{self.name}: there is no metal in the body, so that no lesion is near metal")
        found = np.array([np.linalg.norm(metal - place.at, axis=1).min() for place in self.locations])
        found -= self.diameter / 2
        for place, distance in zip(self.locations, found, strict=True):
            if distance <= 0 or (distance <= NEAR) != (place.group != "far"):
                raise InputError(
                    f"{self.name}: location {list(place.at)} of group {place.group!r} is {distance:.1f} mm from metal, "
                    f"expected {'above' if place.group == 'far' else 'at most'} {NEAR:g} mm"
                )
        return found


def ball(at: tuple[float, float, float], diameter: float) -> Primitive:
    """Return a sphere of `diameter` mm."""
    return Primitive(kind=ELLIPSOID, centre=at, params=(diameter / 2,) * 3)


def metal_points(body: Phantom, geometry: Geometry) -> NDArray[np.float64]:
    """Return the centres (x, y, z) in mm of the metal voxels of a grid three times as fine as the volume's."""
    fine = msgspec.structs.replace(
        geometry,
        n_voxel=tuple(FINER * n for n in geometry.n_voxel),
        d_voxel=tuple(d / FINER for d in geometry.d_voxel),
    )
    z, y, x = fine.voxel_centres()
    k, j, i = np.nonzero(metal_mask(body, fine))
    return np.stack([x[i], y[j], z[k]], 1)


@functools.lru_cache
def load(path: Path | None = None) -> tuple[DetectScene, ...]:
    """Read a file of scenes, by default the bundled one; raises InputError with file, key and expectation."""
    if path is not None:
        tables = located(read_toml(path), path.parent)
        return scenes_of(tables, DetectScene, str(path), lambda at, one, _: [(at, scenes.on_machine(one))])
    with resources.as_file(resources.files("ctsim.benchmarks.suites") / "detect.toml") as bundled:
        return load(bundled)


def named(scenes: Sequence[DetectScene], names: Sequence[str]) -> list[DetectScene]:
    """Return the named scenes, all without names. Raises InputError for an unknown name."""
    known = [scene.name for scene in scenes]
    for name in names:
        if name not in known:
            raise InputError(f"--scene {name}: no such scene, expected one of {human_choice(known, name)}")
    return [scene for scene in scenes if not names or scene.name in names]
