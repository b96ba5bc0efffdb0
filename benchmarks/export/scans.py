"""Scans in the layouts of other libraries: line integrals, geometry and grid, as their readers expect them.

Lengths are mm. `docs/reference/conventions.md` says how the frames lie in each other.
"""

import io
import json
import math
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.lib.format as npy
from numpy.typing import NDArray

from ctsim.dataset.durable import making, replacing
from ctsim.dataset.interop import Library, angles_to, astra_vectors, projections_to, volume_to
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.io.extra import load
from ctsim.io.volumes import metaimage
from ctsim.io.volumes.placed import Placed

EVERY = 10
"""R2-Gaussian and NAF want views for tests: every tenth, which is among those for training, too."""
PER_METRE = 1000  # NAF's lengths are metres


@dataclass(frozen=True, slots=True, kw_only=True)
class Measured:
    """What is exported: line integrals [view, v, u] and the true attenuation [z, y, x] in 1/mm, both float32.

    R2-Gaussian and NAF do not start without a true volume, which they compare their own with; it is None for others,
    and where the scan comes without. Data Exchange holds `counts` [view, v, u] instead, the open field `flat` [v, u],
    and the level `dark` that both include.
    """

    geometry: Geometry
    p: NDArray[np.float32]
    reference: NDArray[np.float32] | None
    counts: NDArray[Any]
    flat: NDArray[np.float32]
    dark: float


def write_scan(out: Path, to: str, scan: Measured) -> None:
    """Write a scan in a library's layout, whole or not at all.

    Raises InputError for a geometry that the layout cannot hold, and where it lacks the truth that the layout needs.
    """
    layout = LAYOUTS[to]
    geometry = scan.geometry
    if layout.truth and scan.reference is None:
        others = ", ".join(name for name, other in LAYOUTS.items() if not other.truth)
        raise InputError(f"--to {to}: holds a true volume, too, but the scan comes without one: expected {others}")
    if geometry.poses is not None and not layout.poses:
        raise InputError(f"--to {to}: holds a circular orbit only, but the scan's geometry is given by poses")
    if not layout.off_detector and any(geometry.off_detector[: 1 if layout.axis_told else 2]):
        raise InputError(
            f"--to {to}: its rays know no offset of the detector, but off_detector is {geometry.off_detector} mm"
        )
    if not layout.off_origin and any(geometry.off_origin):
        raise InputError(f"--to {to}: its volume is centred on the axis, but off_origin is {geometry.off_origin} mm")
    if layout.square and geometry.d_voxel[1] != geometry.d_voxel[2]:
        raise InputError(f"--to {to}: its voxels are square in x and y, but d_voxel is {geometry.d_voxel} mm (z, y, x)")
    out.parent.mkdir(parents=True, exist_ok=True)
    if layout.file:
        with replacing(out) as new:
            layout.write(new, scan)
        return
    with making(out) as new:
        layout.write(new, scan)


def _truth(scan: Measured) -> NDArray[np.float32]:
    """Return the true volume, which `write_scan` has seen to be there."""
    assert scan.reference is not None
    return scan.reference


def _json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _save(path: Path, values: NDArray[Any]) -> None:
    values, head = np.ascontiguousarray(values), io.BytesIO()
    npy.write_array_header_1_0(head, npy.header_data_from_array_1_0(values))
    with path.open("wb") as file:  # np.save says of a full disk only how many values were written
        file.write(head.getvalue())
        file.write(values.data)


def _tigre(folder: Path, scan: Measured) -> None:
    """Write the attributes of TIGRE's geometry by their names, its angles, and its projections."""
    g = scan.geometry
    geometry = {
        "mode": "cone",
        "DSD": g.dsd,
        "DSO": g.dso,
        "nDetector": g.n_detector,
        "dDetector": g.d_detector,
        "sDetector": g.s_detector,
        "offDetector": g.off_detector,
        "nVoxel": g.n_voxel,
        "dVoxel": g.d_voxel,
        "sVoxel": g.s_voxel,
        "offOrigin": g.off_origin,
        "accuracy": 0.5,
        "COR": 0.0,
        "rotDetector": (0.0, 0.0, 0.0),
    }
    _json(folder / "geometry.json", geometry)
    _save(folder / "angles.npy", angles_to(Library.TIGRE, g.angles))
    _save(folder / "projections.npy", projections_to(Library.TIGRE, scan.p))


def _rtk(folder: Path, scan: Measured) -> None:
    """Write RTK's geometry file, the projections with the detector's place, and an empty volume on the grid."""
    g = scan.geometry
    (v, u), (d_v, d_u) = g.off_detector, g.d_detector
    middle = (g.n_views - 1) / 2  # of the stack of views, which begins at 0
    stack = Placed(values=scan.p, spacing=(1.0, d_v, d_u), centre=(middle, v, u))
    metaimage.write_volume(folder / "projections.mha", stack)
    z, y, x = (0, 1, 2)
    order = (x, z, y)  # RTK's z, y, x
    grid = Placed(
        values=volume_to(Library.RTK, np.zeros(g.n_voxel, np.float32)),
        spacing=(g.d_voxel[order[0]], g.d_voxel[order[1]], g.d_voxel[order[2]]),
        centre=(g.off_origin[order[0]], g.off_origin[order[1]], g.off_origin[order[2]]),
    )
    metaimage.write_volume(folder / "grid.mha", grid)
    views = "".join(_rtk_view(g, float(angle)) for angle in angles_to(Library.RTK, g.angles))
    (folder / "geometry.xml").write_text(
        '<?xml version="1.0"?>\n<!DOCTYPE RTKGEOMETRY>\n<RTKThreeDCircularGeometry version="3">\n'
        f"  <SourceToIsocenterDistance>{g.dso!r}</SourceToIsocenterDistance>\n"
        f"  <SourceToDetectorDistance>{g.dsd!r}</SourceToDetectorDistance>\n"
        f"{views}</RTKThreeDCircularGeometry>\n",
        encoding="utf-8",
    )


def _rtk_view(g: Geometry, degrees: float) -> str:
    """Return a view's element: its angle, and the matrix that RTK checks it with, without offsets of the detector."""
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    rows = ((-g.dsd * cos, 0.0, g.dsd * sin, 0.0), (0.0, -g.dsd, 0.0, 0.0), (sin, 0.0, cos, -g.dso))
    matrix = "".join(f"      {' '.join(map(repr, row))}\n" for row in rows)
    return (
        f"  <Projection>\n    <GantryAngle>{degrees!r}</GantryAngle>\n"
        f"    <Matrix>\n{matrix}    </Matrix>\n  </Projection>\n"
    )


def _astra(folder: Path, scan: Measured) -> None:
    """Write ASTRA's two dictionaries, the first without its vectors, which are an array; and its projections."""
    g = scan.geometry
    n_z, n_y, n_x = g.n_voxel
    window = {
        f"Window{end}{axis}": middle + sign * side / 2
        for axis, middle, side in zip("ZYX", g.off_origin, g.s_voxel, strict=True)
        for end, sign in (("Min", -1), ("Max", 1))
    }
    volume = {"GridRowCount": n_y, "GridColCount": n_x, "GridSliceCount": n_z, "option": window}
    rays = {"type": "cone_vec", "DetectorRowCount": g.n_detector[0], "DetectorColCount": g.n_detector[1]}
    _json(folder / "geometry.json", {"proj_geom": rays, "vol_geom": volume})
    _save(folder / "vectors.npy", astra_vectors(g))
    _save(folder / "projections.npy", projections_to(Library.ASTRA, scan.p))


def _leap(folder: Path, scan: Measured) -> None:
    """Write LEAP's parameter file and its projections."""
    g = scan.geometry
    (n_v, n_u), (d_v, d_u), (v, u) = g.n_detector, g.d_detector, g.off_detector
    parameters: dict[str, Any] = {
        "numX": g.n_voxel[2],
        "numY": g.n_voxel[1],
        "numZ": g.n_voxel[0],
        "voxelWidth": g.d_voxel[2],
        "voxelHeight": g.d_voxel[0],
        "offsetX": g.off_origin[2],
        "offsetY": g.off_origin[1],
        "offsetZ": g.off_origin[0],
        "geometry": "cone",
        "numAngles": g.n_views,
        "numRows": n_v,
        "numCols": n_u,
        "pixelHeight": d_v,
        "pixelWidth": d_u,
        "centerRow": (n_v - 1) / 2 - v / d_v,
        "centerCol": (n_u - 1) / 2 - u / d_u,
        "sod": g.dso,
        "sdd": g.dsd,
        "tau": 0.0,
        "helicalPitch": 0.0,
        "tiltAngle": 0.0,
        "phis": ", ".join(repr(float(angle)) for angle in angles_to(Library.LEAP, g.angles)),
    }
    text = "".join(f"{key} = {value}\n" for key, value in parameters.items())
    (folder / "parameters.cfg").write_text(text, encoding="utf-8")
    _save(folder / "projections.npy", projections_to(Library.LEAP, scan.p))


def _turn(geometry: Geometry) -> dict[str, float]:
    """Return the first angle and the arc in degrees; both libraries only print them."""
    first, *rest = np.degrees(geometry.angles).tolist()
    even = abs(geometry.arc_deg) if geometry.angles_deg is None else abs((rest or [first])[-1] - first)
    return {"startAngle": first, "totalAngle": even}


def _r2(folder: Path, scan: Measured) -> None:
    """Write R2-Gaussian's folder: a file for each view, the true volume, and meta_data.json."""
    g = scan.geometry
    views, angles = projections_to(Library.R2_GAUSSIAN, scan.p), angles_to(Library.R2_GAUSSIAN, g.angles)
    told: dict[str, list[dict[str, Any]]] = {}
    for split, chosen in (("proj_train", range(g.n_views)), ("proj_test", range(0, g.n_views, EVERY))):
        (folder / split).mkdir()
        told[split] = []
        for number, view in enumerate(chosen):
            name = f"{split}/{split}_{number:04d}.npy"
            _save(folder / name, views[view])
            told[split].append({"file_path": name, "angle": float(angles[view])})
    _save(folder / "vol_gt.npy", volume_to(Library.R2_GAUSSIAN, _truth(scan)))
    low, high = ([o + sign * s / 2 for o, s in zip(g.off_origin, g.s_voxel, strict=True)][::-1] for sign in (-1, 1))
    scanner = {
        "mode": "cone",
        "filter": None,
        "DSD": g.dsd,
        "DSO": g.dso,
        "nDetector": g.n_detector,
        "sDetector": g.s_detector,
        "offDetector": g.off_detector,
        "nVoxel": g.n_voxel[::-1],
        "sVoxel": g.s_voxel[::-1],
        "offOrigin": g.off_origin[::-1],
        "accuracy": 0.5,
        "noise": False,
        **_turn(g),
    }
    _json(folder / "meta_data.json", {"scanner": scanner, "vol": "vol_gt.npy", "bbox": [low, high], **told})


def _naf(path: Path, scan: Measured) -> None:
    """Write NAF's pickle, a dict of arrays, numbers and names. Its rays take the detector as (u, v), v downwards."""
    g = scan.geometry
    views = np.ascontiguousarray(projections_to(Library.R2_GAUSSIAN, scan.p))
    image = volume_to(Library.R2_GAUSSIAN, _truth(scan)) * np.float32(PER_METRE)
    few = slice(0, None, EVERY)
    v, u = g.off_detector
    content = {
        "mode": "cone",
        "filter": None,
        "DSD": g.dsd,
        "DSO": g.dso,
        "nDetector": np.array(g.n_detector[::-1]),
        "dDetector": np.array(g.d_detector[::-1]),
        "offDetector": np.array([u, -v]),
        "nVoxel": np.array(g.n_voxel[::-1]),
        "dVoxel": np.array(g.d_voxel[::-1]),
        "offOrigin": np.array(g.off_origin[::-1]),
        "accuracy": 0.5,
        "randomAngle": False,
        "convert": False,
        "noise": 0,
        **_turn(g),
        "numTrain": g.n_views,
        "numVal": len(range(0, g.n_views, EVERY)),
        "image": np.ascontiguousarray(image),
        "train": {"angles": g.angles, "projections": views},
        "val": {"angles": g.angles[few], "projections": views[few]},
    }
    with path.open("wb") as file:
        pickle.dump(content, file, protocol=4)


def _dxchange(path: Path, scan: Measured) -> None:
    """Write Data Exchange, the HDF5 file of tomographic beamlines: what the detector read, as TomoPy expects it."""
    load("ctsim.io.scans.exchange", path).write_scan(path, scan.geometry, scan.counts, scan.flat, scan.dark)


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """A library's layout: how it is written, and which geometries it can hold.

    `file` is how its name ends where it is one file, "" for a folder. `content` are its readings. `truth` says that it
    holds the true volume. With `axis_told` it has no place for the axis, which its readers ask for, nor for a grid.
    """

    write: Callable[[Path, Measured], None]
    file: str = ""
    content: str = "line integrals"
    poses: bool = False
    off_detector: bool = True
    off_origin: bool = True
    square: bool = False
    axis_told: bool = False
    truth: bool = False


LAYOUTS = {
    "tigre": Layout(write=_tigre),
    "rtk": Layout(write=_rtk),
    "astra": Layout(write=_astra, poses=True),
    "leap": Layout(write=_leap, square=True),
    "r2": Layout(write=_r2, off_detector=False, truth=True),
    "naf": Layout(write=_naf, file=".pickle", off_origin=False, truth=True),
    "dxchange": Layout(write=_dxchange, file=".h5", content="counts", off_detector=False, axis_told=True),
}
