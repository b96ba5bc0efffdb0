"""Scenes: pure recipes of a scan, read from TOML, hashed to an id, built into a phantom."""

import functools
import hashlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import tomli_w
from numpy.typing import NDArray

from ctsim.dataset.manifest import is_reserved
from ctsim.errors import InputError
from ctsim.geometry import Geometry, crosswise
from ctsim.look import all_rays
from ctsim.phantoms.identity import identity
from ctsim.phantoms.recipes import AnyRecipe, build_recipe
from ctsim.phantoms.scanners import REACH, ScannerSettings, with_machine
from ctsim.phantoms.suites import NULL, decode, located, parse_toml, read_toml, scenes_of
from ctsim.phantoms.vary import Drawn, expand, individual_of
from ctsim.phantoms.visible import build_in_view
from ctsim.settings import Simulation, Truth
from ctsim.tracer.layers import crossed
from ctsim.types import Phantom, Scanner

ROUGH, ROUND = 48, 720  # points on an edge of the object's bounding cylinder: over many views, and for one alone
_LATER = {"metal_in_view": False, "drawn": None}  # keys that old ids mean by their default: see `identity`


class Scene(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scene: what is scanned, by which scanner, and what is written."""

    name: str
    """Names the scene's folder: letters, digits, '.', '_' and '-'."""
    phantom: AnyRecipe
    """The object."""
    scanner: ScannerSettings = ScannerSettings()
    """The scanner: a preset with changes, or a full geometry."""
    seed: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)] = 0
    """Another seed draws another individual and another noise."""
    truncated: bool = False
    """Allow an object that reaches out of the field of view."""
    truth: Truth = Truth()
    """Which ground truth is written in addition to the references."""
    simulation: Simulation = Simulation()
    """Accuracy of the simulation."""
    metal_in_view: bool = False
    """Draw the object again until a view shows metal; a scan of one row is of a slice with metal.

    Where `count` stands, it is true unless it is stated.
    """
    drawn: Drawn | None = None
    """Where a scene of a table with `count` comes from."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", self.name):
            raise InputError(f"name must be letters, digits, '.', '_', '-' (it names a folder), got {self.name!r}")
        if is_reserved(self.name):
            raise InputError(f"name: {self.name!r} is what the data folder's own index is called; expected another")
        if not 0 <= self.seed < 2**63:
            raise InputError(f"seed must be within 0 to 2^63 - 1, got {self.seed}")
        _check_imaging(self.scanner, (self.phantom.size, self.phantom.height), self.truncated)

    def resolve(self) -> Scanner:
        """Return the scanner with the preset and its overrides worked out."""
        return self.scanner.resolve(self.phantom.size)


def _check_imaging(settings: ScannerSettings, body: tuple[float, float], truncated: bool) -> None:
    """Refuse a scanner that cannot image the object; most scenes of a suite have the same.

    `body` is the edge (mm) of the object's cube and the share of it that the object's height takes.
    """
    try:
        _known_to_image(settings, body, truncated)
    except TypeError:  # lists, which cannot be remembered, where a scene was not read from a file
        _known_to_image.__wrapped__(settings, body, truncated)


@functools.lru_cache(16)
def _known_to_image(settings: ScannerSettings, body: tuple[float, float], truncated: bool) -> None:
    try:
        scanner = settings.resolve(body[0])
    except InputError as error:
        raise InputError(f"scanner.{error}") from error
    check_geometry(scanner.geometry, body[0], truncated, height=body[1])


def build(scene: Scene, *, whole: bool = True) -> Phantom:
    """Build the scene's phantom, the same for the same recipe and seed.

    If it need not be `whole`, layers of its labels that no ray crosses, and that the reconstruction grid does not
    cover, may be left as air. Raises InputError where the scene asks for metal in view and there is none.
    """
    layers = None if whole else layers_of(scene)
    if scene.metal_in_view:
        phantom = build_in_view(scene.phantom, scene.seed, scene.resolve().geometry, layers)
    else:
        phantom = build_recipe(scene.phantom, scene.seed, layers=slice(None) if layers is None else layers(0.0))
    return phantom if layers is None or phantom.labels.any() else build(scene)


def layers_of(scene: Scene) -> Callable[[float], slice] | None:
    """Return which layers a scan needs of a body that is moved by so many mm along z; None where it needs all."""
    scanner, params = scene.resolve(), scene.phantom
    geometry = all_rays(scanner)
    scatters = scanner.scatter.level == 3  # photons meet all of it
    if geometry is None or scatters or not params.by_layers or not scene.simulation.skip:
        return None
    z, y, x = (s * d for s, d in zip(params.grid_shift, params.d_voxel, strict=True))
    return lambda dz: crossed(params.n_voxel, params.d_voxel, (z + dz, y, x), geometry, grid=True)


def individual(scene: Scene) -> str:
    """Name whose body is scanned; scans of one individual must not be divided between training and test."""
    return individual_of(scene.phantom.recipe, scene.seed, getattr(scene.phantom, "sha256", ""))


def scene_id(scene: Scene) -> str:
    """Return 12 hexadecimal digits of the SHA-256 of what the scene says (see `ctsim.phantoms.identity`)."""
    return _digest(scene, ())


def stream_id(scene: Scene) -> str:
    """Return the key of the scene's noise streams: its id without `truth`, `simulation` and `drawn`.

    Asking for more ground truth, for another tolerance or another split must not change the noise.
    """
    return _digest(scene, ("truth", "simulation", "drawn"))


def _digest(scene: Scene, without: tuple[str, ...]) -> str:
    # decoding turns 60 into 60.0 where a float is meant, so equal scenes have equal text; key by key, for the whole
    # would be checked again, which takes a hundred times as long
    kept = {
        name: identity(msgspec.convert(msgspec.to_builtins(getattr(scene, name)), kind))
        for name, kind in _kinds().items()
        if name not in without and (name not in _LATER or getattr(scene, name) != _LATER[name])
    }
    if "sha256" in kept["phantom"]:  # the file is known by its content, wherever it lies
        del kept["phantom"]["path"]
    return hashlib.sha256(msgspec.json.encode(kept, order="deterministic")).hexdigest()[:12]


@functools.cache
def _kinds() -> dict[str, Any]:
    """Return the types of a scene's keys, which takes longer to find out than to use."""
    return {item.name: item.type for item in msgspec.structs.fields(Scene)}


def scene_to_toml(scene: Scene) -> str:
    """Return the scene as TOML that `load_suite` reads back to an equal scene."""
    return tomli_w.dumps(_plain(scene))


def load_suite(path: str | Path) -> tuple[Scene, ...]:
    """Read a file of `[[scene]]` tables over an optional `[defaults]`, or of one scene at top level.

    Defaults are merged under every scene, table by table. The string "null" stands for a value left
    empty. A relative path of a CT volume begins at the file's folder. Raises `InputError` with file, key and what was
    expected.
    """
    path = Path(path)
    return _scenes(located(read_toml(path), path.parent), str(path))


def parse_suite(text: str, where: str = "scene") -> tuple[Scene, ...]:
    """Read scenes from TOML text; `where` names the file in messages. See `load_suite`.

    A relative path of a CT volume begins at the working directory.
    """
    return _scenes(parse_toml(text, where), where)


def _scenes(data: dict[str, Any], where: str) -> tuple[Scene, ...]:
    if "scene" not in data and not set(data).isdisjoint(Scene.__struct_fields__):
        data = {"scene": [data]} if "count" in data else data
        if "scene" not in data:
            return (read_scene(data, where),)
    scenes = scenes_of(data, Scene, where, _expanded)
    _check_splits(scenes, where)
    return scenes


def _expanded(place: str, table: dict[str, Any], where: str) -> Iterator[tuple[str, dict[str, Any]]]:
    return ((at, on_machine(one)) for at, one in expand(place, table, where, Scene))


def read_scene(table: Mapping[str, Any], where: str) -> Scene:
    """Read one scene of a table; `where` names it in messages. See `load_suite`."""
    return decode(on_machine(table), Scene, where)


def on_machine(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return a scene's table with what of the preset its scanner does not state."""
    scanner = table.get("scanner")
    return {**table, "scanner": with_machine(scanner)} if isinstance(scanner, Mapping) else dict(table)


def _check_splits(scenes: Sequence[Scene], where: str) -> None:
    """Refuse an individual that two tables put into two splits: what is tested on would have been trained on."""
    known: dict[str, Scene] = {}
    for scene in scenes:
        if scene.drawn and scene.drawn.split:
            other = known.setdefault(individual(scene), scene)
            if other.drawn and other.drawn.split != scene.drawn.split:
                raise InputError(
                    f"{where}: {other.name} ({other.drawn.split}) and {scene.name} ({scene.drawn.split}) are of one "
                    "individual; give their tables the same split, or seeds that do not overlap"
                )


def _plain(value: Any) -> Any:
    """Turn structs into TOML values, leaving out what is None by default."""
    if isinstance(value, msgspec.Struct):
        config = value.__struct_config__
        out = {config.tag_field: config.tag} if config.tag_field else {}
        for item in msgspec.structs.fields(value):
            held = getattr(value, item.name)
            if held is not None or item.default is not None:
                out[item.encode_name] = NULL if held is None else _plain(held)
        return out
    return [_plain(v) for v in value] if isinstance(value, tuple | list) else value


def check_geometry(geometry: Geometry, size: float, truncated: bool, height: float = REACH) -> None:
    """Refuse a geometry that cannot image an object of a cube of `size` mm, `height` times as tall.

    Raises `InputError` when the source comes inside the object or the reconstructed volume, when no
    view sees the object, and when a view cuts it off although `truncated` is false; one row may see a slice of it.
    """
    poses = geometry.pose_array()
    _check_source(poses[:, :3], geometry, size)
    circle = geometry.poses is None  # on which every view casts the same shadow
    u, v = _shadow(poses[:1] if circle else poses, size, height, ROUND if circle else ROUGH)
    half_v, half_u = ((n / 2) for n in geometry.n_detector)
    fan = geometry.n_detector[0] == 1 < geometry.n_detector[1]  # a slice is all that one row is to see
    seen = (u.min(1) < half_u) & (u.max(1) > -half_u) & (v.min(1) < half_v) & (v.max(1) > -half_v)
    if not seen.any():
        raise InputError(
            f"phantom.size = {size} mm: the object lies outside the cone of all views; check dso, dsd and off_detector"
        )
    off = geometry.off_detector[1] / geometry.d_detector[1]
    if geometry.is_full_turn and abs(off) < half_u:  # the opposite view sees the other side
        u, half_u = u + off, half_u + abs(off)
    outside = (np.abs(u) > half_u).any() or ((np.abs(v) > half_v).any() and not fan)
    if outside and not truncated:
        raise InputError(
            f"phantom.size = {size} mm: the object reaches out of the cone: its shadow needs "
            f"{2 * np.abs(v).max():.0f} x {2 * np.abs(u).max():.0f} pixels "
            f"(v, u) of {geometry.n_detector}; say truncated = true if this is meant"
        )


def _check_source(source: NDArray[np.float64], geometry: Geometry, size: float) -> None:
    radius = np.hypot(source[:, 0], source[:, 1])
    if ((radius <= REACH * size / 2) & (np.abs(source[:, 2]) <= REACH * size / 2)).any():
        raise InputError(
            f"phantom.size = {size} mm: the source lies inside the object, whose radius and half height are "
            f"{REACH * size / 2:.4g} mm; expected a larger dso or a smaller size"
        )
    box = np.array(geometry.s_voxel[::-1]) / 2
    if (np.abs(source - np.array(geometry.off_origin[::-1])) <= box).all(1).any():
        raise InputError(
            f"scanner: the source lies inside the reconstructed volume of {geometry.s_voxel} mm (z, y, x) "
            f"at off_origin = {geometry.off_origin}; expected a smaller one"
        )


def _shadow(
    poses: NDArray[np.float64], size: float, height: float, n: int = ROUGH
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Detector coordinates (pixels from the centre) of the object's bounding cylinder, u, v [view, point].

    `n` points on each of its edges stand for them.
    """
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    ring = REACH * size / 2 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    points = np.concatenate([np.add(ring, [0, 0, h]) for h in (-height * size / 2, height * size / 2)])
    source, centre, du, dv = (poses[:, k : k + 3] for k in (0, 3, 6, 9))
    normal = np.cross(du, dv)
    ray = points[None] - source[:, None]
    depth = (ray * normal[:, None]).sum(-1)
    reach = ((centre - source) * normal).sum(-1)[:, None]
    ahead = depth * np.sign(reach) > 0
    hit = source[:, None] + ray * (reach / np.where(ahead, depth, 1.0))[..., None] - centre[:, None]
    du, dv = crosswise(du, dv)
    u = (hit * du[:, None]).sum(-1) / (du * du).sum(-1)[:, None]
    v = (hit * dv[:, None]).sum(-1) / (dv * dv).sum(-1)[:, None]
    return np.where(ahead, u, 1e9), np.where(ahead, v, 1e9)
