"""One scene from its plan to its folder on disk."""

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ctsim.errors import InputError

if TYPE_CHECKING:
    from ctsim.phantoms.scene import Scene
    from ctsim.plan import Plan
    from ctsim.types import Phantom, Scanner


def make_scene(
    scene: "Scene",
    plan: "Plan",
    parts: "tuple[Phantom, Scanner]",
    out: Path,
    *,
    force: bool = False,
    title: str | None = "",
) -> Path:
    """Simulate one scene into `out`, going on from where an earlier run stopped; return its folder.

    Its progress is shown under `title`, not at all where that is None.

    Raises
    ------
    InputError
        When another scene is in the way or the disk is full.
    """
    from ctsim.phantoms.scene import scene_id, scene_to_toml
    from ctsim.simulate import scan_info, simulate_views, truth_volumes
    from ctsim.writer import SceneWriter, Stack

    phantom, scanner = parts
    geometry = scanner.geometry
    stacks = tuple(
        Stack(name=o.name, shape=(geometry.n_views, *o.shape), dtype=o.dtype, pixel=geometry.d_detector)
        for o in plan.outputs
    )
    with SceneWriter(
        out, scene.name, scene_id=scene_id(scene), plan_hash=plan_hash(plan), stacks=stacks, force=force
    ) as writer:
        if writer.first_view and title is not None:
            say(f"{scene.name}: goes on from view {writer.first_view} of {geometry.n_views}")
        views = simulate_views(plan, phantom, scanner, first_view=writer.first_view)
        shown = title if title is None else title or scene.name
        for view, arrays in _progress(views, writer.first_view, geometry.n_views, shown):
            writer.put(view, arrays)
        info = dict(scan_info(plan, phantom, scanner))
        writer.write_image("flat", info.pop("flat"), geometry.d_detector)
        for name, volume in truth_volumes(plan, phantom, scanner):
            writer.write_image(name, volume, geometry.d_voxel)
        writer.write_text("scene.toml", scene_to_toml(scene))
        writer.write_text("scan.json", _json(info))
        writer.write_text("plan.json", _json(plan.to_dict()))
        writer.write_text("spectrum.csv", spectrum_csv(scanner))
        return writer.finish()


def plan_hash(plan: "Plan") -> str:
    """Hash what a plan does, leaving out its estimates of time, which change with the machine."""
    import hashlib

    kept = {k: v for k, v in plan.to_dict().items() if k != "seconds"}
    return hashlib.sha256(_json(kept)).hexdigest()


def spectrum_csv(scanner: "Scanner") -> str:
    """Return the tube's spectrum and what the detector makes of it as CSV."""
    from ctsim.detector import response
    from ctsim.spectrum import spectrum

    tube = spectrum(scanner.tube)
    signal = tube.weights * response(scanner.detector, tube.energies)[0]
    signal = signal / signal.sum()
    rows = zip(tube.energies, tube.weights, signal, strict=True)
    return "energy_kev,photon_fraction,signal_fraction\n" + "".join(f"{e:.4f},{w:.8g},{s:.8g}\n" for e, w, s in rows)


@contextlib.contextmanager
def memory(name: str) -> Iterator[None]:
    """Turn a lack of memory into the user's error that names the scene."""
    try:
        yield
    except MemoryError as error:
        raise InputError(
            f"{name}: there is not enough memory ({error or 'no size is known'}); expected a smaller "
            "phantom.n_voxel, scanner.n_voxel or scanner.n_detector"
        ) from error


def say(text: str) -> None:
    """Write a line for people, beside what the command prints."""
    sys.stderr.write(text + "\n")


def _progress(views: Iterator[Any], first: int, n_views: int, title: str | None) -> Iterator[Any]:
    from tqdm import tqdm

    hidden = True if title is None else None  # None: hidden where nobody watches
    return iter(tqdm(views, title, n_views, initial=first, unit="view", disable=hidden, file=sys.stderr))


def _json(value: Any) -> bytes:
    import msgspec
    import numpy as np

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        raise TypeError(f"{type(value).__name__} cannot be written as JSON")

    return msgspec.json.format(msgspec.json.encode(value, enc_hook=plain), indent=1) + b"\n"
