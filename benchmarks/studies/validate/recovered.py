"""Attenuation at 50 keV that reconstructions give back, against NIST: water and aluminium rods."""

import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.benchmarks.methods import find
from ctsim.benchmarks.studies.validate.finding import Check, check
from ctsim.benchmarks.studies.validate.published import DIGITS, numbers
from ctsim.materials import material
from ctsim.phantoms.scene import Scene, build, parse_suite, stream_id
from ctsim.plan import make_plan
from ctsim.reconstruct.fdk import fdk
from ctsim.settings import Truth
from ctsim.simulate import scan_info, simulate_views
from ctsim.types import Phantom, Scan

KEV = 50.0
INSIDE = 2.0  # mm within the surface
FDK = 5e-3  # what FDK is tested to in a cylinder of water (tests/test_fdk.py)
SCENE = """
name = "val-Al"
seed = 1
phantom = {{ recipe = "validation", metal = "Al", n_voxel = [32, 32, 32] }}
scanner = {{ n_voxel = [{n}, {n}, {n}], n_detector = [{pixels}, {pixels}], n_views = {views} }}
"""
SMALL = {"n": 64, "pixels": 96, "views": 60}
LARGE = {"n": 128, "pixels": 192, "views": 240}


def recovered(short: bool) -> list[Check]:
    """Compare FDK of mono projections, FDK of counts and splat of counts with NIST."""
    (fine,), (scene,) = (parse_suite(SCENE.format(**size)) for size in (SMALL if short else LARGE, SMALL))
    large, mono = _scanned(fine)
    found = _rows("FDK of one energy", fdk(mono, large.geometry).numpy(), build(fine), large, known=False)
    return found + of_counts(scene)


def of_counts(scene: Scene) -> list[Check]:
    """Compare FDK and splat of counts, whose deviations are known."""
    phantom, (scan, _) = build(scene), _scanned(scene)
    found = _rows("FDK of counts", find("fdk-ramp").reconstruct(scan).values.numpy(), phantom, scan, known=True)
    volume = find("splat").reconstruct(scan)
    if volume.at_energy is None:
        raise RuntimeError(f"splat gave no volume at an energy: {volume.reason}")
    return found + _rows("splat of counts", volume.at_energy(KEV).numpy(), phantom, scan, known=True)


def _scanned(scene: Scene) -> tuple[Scan, torch.Tensor]:
    """Simulate a scene; return its scan and its line integrals at one energy [view, v, u]."""
    phantom, scanner = build(scene), scene.resolve()
    plan = make_plan(phantom, scanner, scene.simulation, Truth(twin=False, mono_kev=(KEV,)), stream_id(scene))
    images = [images for _, images in simulate_views(plan, phantom, scanner)]
    info = scan_info(plan, phantom, scanner)
    counts, mono = (torch.from_numpy(np.stack([i[name] for i in images])) for name in ("counts", f"mono_{KEV:g}kev"))
    flat = torch.from_numpy(info["flat"])
    scan = Scan(
        geometry=scanner.geometry, counts=counts, flat=flat, dark=info["dark"], i0=info["i0"], e_max=info["e_max"]
    )
    return scan, mono


def _rows(what: str, values: NDArray[np.float32], phantom: Phantom, scan: Scan, *, known: bool) -> list[Check]:
    """Return the mean of a volume in water and in aluminium against NIST."""
    nist = numbers().nist
    place = nist.energies.index(KEV)
    found = []
    for name, inside in _regions(phantom, scan).items():
        true = 0.1 * nist.attenuation[name][place] * material(name).density
        found.append(
            check(f"{name}, {what}", float(values[inside].mean(dtype=np.float64)), true, unit="1/mm, 50 keV",
                  tolerance=2 * DIGITS + FDK, why="μ, and FDK of a water cylinder", known=known,
                  source=f"{nist.source}; {int(inside.sum())} voxels")
        )  # fmt: skip
    return found


def _regions(phantom: Phantom, scan: Scan) -> dict[str, NDArray[np.bool_]]:
    """Return the voxels well inside water and inside the rods, in the middle half of the height."""
    z, y, x = scan.geometry.voxel_centres()
    radius = {}
    for solid in phantom.solids:
        (part,) = solid.primitives
        off = np.hypot(y[:, None] - part.centre[1], x - part.centre[0])
        radius[solid.name] = part.params[1] - off
    middle = (np.abs(z) < 0.25 * scan.geometry.s_voxel[0])[:, None, None]
    rods = [depth for name, depth in radius.items() if name != "water"]
    water = (radius["water"] > INSIDE) & (np.max(rods, axis=0) < -INSIDE)
    # rods are few voxels wide: those whose edge is at least a voxel and a half away
    rod = np.max(rods, axis=0) > 1.5 * scan.geometry.d_voxel[1]
    return {"water": middle & water, "Al": middle & rod}
