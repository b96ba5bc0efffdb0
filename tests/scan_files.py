"""Simulated scans written in the layouts of scanners, by the layouts' descriptions and not by our readers."""

import csv
import json
import pickle
from pathlib import Path

import h5py
import numpy as np
import tifffile

from ctsim.geometry import Geometry

SCENE = """
name = "rods"
seed = 5

[phantom]
recipe = "validation"
metal = "Al"
n_voxel = [16, 16, 16]

[scanner]
n_voxel = [10, 12, 12]
n_detector = [32, 40]
n_views = 24
"""
LOG = """[System]
Scanner=SkyScan1275
Camera Pixel Size (um)=75.0
[Acquisition]
Data Directory=D:\\Results\\rods
Filename Prefix={prefix}
Number Of Files=  {files}
Number Of Rows= {rows}
Number Of Columns= {columns}
Image Rotation={tilt:.5f}
Optical Axis (line)=  {axis}
Object to Source (mm)={dso:.6f}
Camera to Source (mm)={dsd:.6f}
Source Voltage (kV)=  {kv}
Image Pixel Size (um)={pixel:.9f}
Depth (bits)=16
Rotation Step (deg)={step:.3f}
Use 360 Rotation={whole}
Filter={filter}
Rotation Direction={direction}
Scanning Start Angle={start:.3f}
Scanning Trajectory=ROUND
[Reconstruction]
Number Of Rows=7
"""


def skyscan(folder: Path, counts, geometry: Geometry, *, prefix="rods", **changes) -> Path:
    """Write counts [view, v, u] as a SkyScan scan; return its log."""
    folder.mkdir(parents=True, exist_ok=True)
    n, rows, columns = counts.shape
    sign = -1 if geometry.arc_deg < 0 else 1
    given = {
        "prefix": prefix,
        "files": n,
        "rows": rows,
        "columns": columns,
        "tilt": 0.0,
        "axis": (rows - 1) / 2 + geometry.off_detector[0] / geometry.d_detector[0],
        "dso": geometry.dso,
        "dsd": geometry.dsd,
        "kv": 90,
        "pixel": geometry.d_detector[1] * geometry.dso / geometry.dsd * 1000,
        "step": abs(geometry.arc_deg) / n,
        "whole": "YES" if abs(geometry.arc_deg) == 360 else "NO",
        "filter": "Al 0.5mm",
        "direction": "CC" if sign < 0 else "CW",
        "start": sign * geometry.start_deg,
    } | changes
    (folder / f"{prefix}.log").write_text(LOG.format(**given))
    for k, image in enumerate(counts):
        tifffile.imwrite(folder / f"{prefix}{k:08d}.tif", image[::-1], photometric="minisblack")
    return folder / f"{prefix}.log"


def shifts(log: Path, table) -> None:
    """Write how far each image moved, [view, (right, down)] in pixels, next to a log."""
    with (log.parent / f"{log.stem}_TS.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["image", "x shift", "y shift"])
        writer.writerows([k, f"{x:.6f}", f"{y:.6f}"] for k, (x, y) in enumerate(np.asarray(table)))


def dxchange(path: Path, counts, geometry: Geometry, flat, dark) -> Path:
    """Write counts as Data Exchange, with lengths in several units."""
    with h5py.File(path, "w") as file:
        group = file.create_group("exchange")
        group["data"] = counts[:, ::-1]
        group["data_white"], group["data_dark"] = flat[:, ::-1], dark[:, ::-1]
        group["theta"] = -np.degrees(geometry.angles)
        group["theta"].attrs["units"] = "degrees"
        lengths = {
            "source/distance": (geometry.dso / 1000, "m"),
            "detector/distance": (geometry.dsd - geometry.dso, "mm"),
            "detector/pixel_size_x": (geometry.d_detector[1] * 1000, "um"),
            "detector/pixel_size_y": (geometry.d_detector[0] / 10, "cm"),
        }
        for name, (value, unit) in lengths.items():
            file[f"measurement/instrument/{name}"] = value
            file[f"measurement/instrument/{name}"].attrs["units"] = unit
    return path


def nxtomo(path: Path, counts, geometry: Geometry, flat, dark) -> Path:
    """Write counts as NXtomo: dark images first, open ones last, an image that is invalid between."""
    keys = [2] * len(dark) + [0] * len(counts) + [3] + [1] * len(flat)
    data = np.concatenate([dark, counts, counts[:1] * 0, flat])[:, ::-1]
    angles = np.zeros(len(keys))
    angles[len(dark) : len(dark) + len(counts)] = -geometry.angles
    with h5py.File(path, "w") as file:
        entry = file.create_group("entry0000")
        detector, source = entry.create_group("instrument/detector"), entry.create_group("instrument/source")
        detector["data"], detector["image_key"] = data, np.array(keys, np.int8)
        entry["sample/rotation_angle"] = angles
        entry["sample/rotation_angle"].attrs["units"] = "rad"
        for group, name, value in (
            (detector, "distance", geometry.dsd - geometry.dso),
            (source, "distance", -geometry.dso),
            (detector, "x_pixel_size", geometry.d_detector[1]),
            (detector, "y_pixel_size", geometry.d_detector[0]),
        ):
            group[name] = value / 1000
            group[name].attrs["units"] = b"m"
        entry["data/data"] = h5py.SoftLink("/entry0000/instrument/detector/data")
    return path


def walnut(folder: Path, counts, poses, flat, dark) -> Path:
    """Write counts [view, v, u] with poses [view, 12] as the walnuts are; return the file of vectors."""
    folder.mkdir(parents=True, exist_ok=True)
    np.savetxt(folder / "scan_geom_corrected.geom", poses)
    for prefix, images in (("scan_", counts[::-1]), ("di", dark), ("io", flat)):
        for k, image in enumerate(images):
            tifffile.imwrite(folder / f"{prefix}{k:06d}.tif", image.T[::-1], photometric="minisblack")
    return folder / "scan_geom_corrected.geom"


def _scanner(geometry: Geometry) -> dict:
    """Return the settings that R2-Gaussian and NAF share, in TIGRE's order for the detector and x y z for voxels."""
    return {
        "mode": "cone",
        "DSO": geometry.dso,
        "DSD": geometry.dsd,
        "nDetector": list(geometry.n_detector),
        "nVoxel": list(geometry.n_voxel[::-1]),
        "offOrigin": list(geometry.off_origin[::-1]),
        "offDetector": list(geometry.off_detector),
    }


def r2(folder: Path, p, geometry: Geometry, test=(), *, both=False) -> Path:
    """Write line integrals as R2-Gaussian does, the views `test` for testing, `both` for training too."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = {"proj_train": [k for k in range(len(p)) if both or k not in test], "proj_test": list(test)}
    extents = {"sDetector": list(geometry.s_detector), "sVoxel": list(geometry.s_voxel[::-1])}
    meta = {"scanner": _scanner(geometry) | extents, "vol": "vol_gt.npy", "bbox": [[-1] * 3, [1] * 3]}
    for part, views in parts.items():
        (folder / part).mkdir(exist_ok=True)
        meta[part] = []
        for n, k in enumerate(views):
            name = f"{part}/{part}_{n:04d}.npy"
            np.save(folder / name, p[k, ::-1].astype(np.float32))
            meta[part].append({"file_path": name, "angle": float(geometry.angles[k])})
    (folder / "meta_data.json").write_text(json.dumps(meta))
    return folder


def naf(path: Path, p, geometry: Geometry, test=(), *, both=False, protocol=4) -> Path:
    """Write line integrals as NAF does."""
    train = [k for k in range(len(p)) if both or k not in test]
    found = _scanner(geometry) | {
        "dDetector": list(geometry.d_detector),
        "dVoxel": np.array(geometry.d_voxel[::-1]),
        "numTrain": len(train),
        "image": np.zeros(geometry.n_voxel[::-1], np.float32),
    }
    for part, views in (("train", train), ("val", list(test))):
        found[part] = {"angles": geometry.angles[views], "projections": p[views, ::-1].astype(np.float32)}
    with path.open("wb") as file:
        pickle.dump(found, file, protocol)
    return path
