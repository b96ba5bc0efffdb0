"""Simulated scans written in the layouts of scanners, by the layouts' descriptions and not by our readers."""

import csv
from pathlib import Path

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
    """Write how far each image moved, [view, (right, down)] in pixels, beside a log."""
    with (log.parent / f"{log.stem}_TS.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["image", "x shift", "y shift"])
        writer.writerows([k, f"{x:.6f}", f"{y:.6f}"] for k, (x, y) in enumerate(np.asarray(table)))
