"""TIGRE itself, where it is installed, takes what `make-dataset export` writes. Nothing here needs a GPU.

Its projectors are CUDA. What runs without one: its geometry's own check, the host code that lays out the rays for the
projector, and the weighting and filtering of its FDK.
"""

import ctypes
import importlib
import json
import warnings

import msgspec
import numpy as np
import pytest
from test_installed_libraries import GEOMETRY, apart, density, export, rays, say

from ctsim.dataset.interop import Library, projections_from, volume_to
from ctsim.reconstruct.filters import filter_rows, padded_length, ramp_response

CENTRED = msgspec.structs.replace(GEOMETRY, off_detector=(0.0, 0.0))


@pytest.fixture(scope="module")
def tigre():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it imports from a part of NumPy that is going away
        return pytest.importorskip("tigre", reason="TIGRE is not on PyPI: build it from its source with nvcc")


def read(tigre, folder):
    """Return TIGRE's geometry with an exported folder's attributes, its angles and its projections."""
    geometry = tigre.geometry(mode="cone")
    for name, value in json.loads((folder / "geometry.json").read_bytes()).items():
        setattr(geometry, name, np.array(value) if isinstance(value, list) else value)
    return geometry, np.load(folder / "angles.npy"), np.load(folder / "projections.npy")


def test_tigre_accepts_our_geometry(tigre, tmp_path):
    export(tmp_path / "tigre", "tigre", GEOMETRY)
    geometry, angles, p = read(tigre, tmp_path / "tigre")
    geometry.check_geo(angles)
    geometry.checknans()
    assert p.shape == (geometry.n_proj, *geometry.nDetector) and p.dtype == np.float32
    assert volume_to(Library.TIGRE, density(GEOMETRY)).shape == tuple(geometry.nVoxel)
    assert np.array_equal(geometry.angles[:, 0], GEOMETRY.angles) and not geometry.angles[:, 1:].any()
    assert geometry.offDetector.shape == (len(angles), 2) and geometry.offOrigin.shape == (len(angles), 3)


FLOATS = ctypes.POINTER(ctypes.c_float)


class Layout(ctypes.Structure):
    """TIGRE's geometry in C++, in the order of Common/CUDA/types_TIGRE.hpp."""

    _fields_ = [
        *((f"nVoxel{axis}", ctypes.c_int) for axis in "XYZ"),
        *((f"{kind}Voxel{axis}", ctypes.c_float) for kind in "sd" for axis in "XYZ"),
        *((f"offOrig{axis}", FLOATS) for axis in "XYZ"),
        ("DSO", FLOATS),
        *((f"nDetec{axis}", ctypes.c_int) for axis in "UV"),
        *((f"{kind}Detec{axis}", ctypes.c_float) for kind in "sd" for axis in "UV"),
        *((name, FLOATS) for name in ("offDetecU", "offDetecV", "DSD", "dRoll", "dPitch", "dYaw")),
        *((name, ctypes.c_float) for name in ("unitX", "unitY", "unitZ", "alpha", "theta", "psi")),
        ("COR", FLOATS),
        *((name, ctypes.c_float) for name in ("maxLength", "accuracy")),
    ]


class Point(ctypes.Structure):
    _fields_ = [(axis, ctypes.c_float) for axis in "xyz"]


SIDDON = "_Z20computeDeltas_Siddon8GeometryiP7Point3DS1_S1_S1_"  # its host function's name in the library


def layout(geometry):
    """Fill TIGRE's structure from a geometry that was checked, as its utilities/cuda_interface/_types.pxd does."""
    values = {"unitX": 1, "unitY": 1, "unitZ": 1, "accuracy": geometry.accuracy}
    for ours, theirs, axes in (("Voxel", "Voxel", "ZYX"), ("Detector", "Detec", "VU")):
        for kind in "nsd":
            numbers = getattr(geometry, kind + ours).tolist()
            values |= {f"{kind}{theirs}{axis}": number for axis, number in zip(axes, numbers, strict=True)}
    columns = {name: getattr(geometry, name) for name in ("DSO", "DSD", "COR")}
    columns |= dict(zip(("offOrigZ", "offOrigY", "offOrigX"), geometry.offOrigin.T, strict=True))
    columns |= dict(zip(("offDetecV", "offDetecU"), geometry.offDetector.T, strict=True))
    columns |= dict(zip(("dYaw", "dPitch", "dRoll"), geometry.rotDetector.T, strict=True))
    for name, column in columns.items():
        values[name] = (ctypes.c_float * len(column))(*column.tolist())
    return Layout(**values)


def test_tigre_lays_out_the_rays_where_our_export_has_them(tigre, tmp_path):
    """The host code of its Siddon projector gives the source, a corner pixel and the steps, in voxels from the corner.

    Its kernel counts rows down from that corner and stores the last of them first.
    """
    host = getattr(ctypes.CDLL(importlib.import_module("_Ax").__file__), SIDDON, None)
    if host is None:
        pytest.skip("this TIGRE does not show computeDeltas_Siddon")
    export(tmp_path / "tigre", "tigre", GEOMETRY)
    geometry, angles, _ = read(tigre, tmp_path / "tigre")
    geometry.check_geo(angles)
    theirs = layout(geometry)
    source, pixels = rays(GEOMETRY)
    n_v, n_u = GEOMETRY.n_detector
    corner = np.subtract(GEOMETRY.off_origin, np.divide(GEOMETRY.s_voxel, 2))[::-1]
    for view in range(len(angles)):
        theirs.alpha = float(geometry.angles[view, 0])
        points = [Point() for _ in range(4)]
        host(theirs, view, *(ctypes.byref(point) for point in points))
        origin, u, v, focus = (np.array([p.x, p.y, p.z]) * GEOMETRY.d_voxel[::-1] for p in points)
        rows, columns = n_v - 1 - np.arange(n_v)[:, None, None], np.arange(n_u)[:, None]
        # ten roundings in float32 of coordinates of 700 voxels
        close = {"rtol": 0, "atol": 10 * 700 * 2**-24}
        np.testing.assert_allclose(focus + corner, source[view, 0, 0], **close)
        np.testing.assert_allclose(origin + corner + rows * v + columns * u, pixels[view], **close)


@pytest.mark.slow
def test_tigre_weights_and_filters_our_export_as_we_do(tigre, tmp_path, monkeypatch):
    """Its FDK up to the backprojection, which it hands the filtered projections; with a centred detector.

    With a shifted one it takes the weights of the cone from the detector's own middle instead of the central ray.
    """
    g = CENTRED
    p = export(tmp_path / "tigre", "tigre", g)
    geometry, angles, exported = read(tigre, tmp_path / "tigre")
    single = importlib.import_module("tigre.algorithms.single_pass_algorithms")
    monkeypatch.setattr(single, "Atb", lambda filtered, *_, **__: filtered)
    theirs = projections_from(Library.TIGRE, single.FDK(exported, geometry, angles))
    source, pixels = rays(g)
    cosine = g.dsd / np.linalg.norm(pixels - source, axis=-1)
    n = padded_length(g.n_detector[1])
    ramp = ramp_response(n, g.d_detector[1] * g.dso / g.dsd)
    ours = filter_rows((p * cosine * np.pi / g.n_views).astype(np.float32), ramp, n)
    # some roundings in float32 and its FFT
    found = apart(theirs, ours)
    say(f"filtered projections {found:.2g} apart in RMS")
    assert found < 1e-5
