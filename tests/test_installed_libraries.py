"""The libraries themselves, where they are installed, read what `make-dataset export` writes.

They project and reconstruct a lopsided pair of smooth blobs, whose density, line integrals and shadows have closed
forms, on a grid, a detector and an orbit in which all differs that can. `docs/how-to/export-scans.md` says how to get
each library and what the comparisons gave.
"""

import importlib.util
import json
import subprocess
import sys

import msgspec
import numpy as np
import pytest
import SimpleITK as sitk
import torch

from ctsim.benchmarks.export.scans import Measured, write_scan
from ctsim.dataset.interop import Library, angles_to, astra_vectors, volume_from, volume_to
from ctsim.geometry import Geometry
from ctsim.reconstruct.fdk import fdk

GEOMETRY = Geometry(
    dso=400.0,
    dsd=900.0,
    n_voxel=(56, 60, 66),
    d_voxel=(0.8, 1.0, 0.9),
    off_origin=(1.0, -2.0, 3.0),
    n_detector=(70, 90),
    d_detector=(1.5, 1.4),
    off_detector=(2.25, -3.0),  # row 33 lies in the plane of the orbit
    n_views=72,
    start_deg=17.0,
)
SQUARE = msgspec.structs.replace(GEOMETRY, n_voxel=(56, 64, 66), d_voxel=(0.8, 0.9, 0.9))
"""For LEAP, and ASTRA's projectors on the CPU, whose voxels are square in x and y."""
BLOBS = ((0.02, (6.0, -4.0, 3.0), 4.0), (0.012, (-5.0, 6.0, -4.0), 3.5))
"""Attenuation (1/mm) in the middle, the middle (x, y, z) and the standard deviation (mm)."""

# The projectors spread a voxel evenly to both sides, which keeps a shadow's centre: what is left is sampling, at most
# 0.03 pixels measured. Half a pixel or voxel astray is 0.5 and more (test_a_wrong_geometry_moves_the_shadows).
SHADOW = 0.1  # pixels
# Linear interpolation between voxels of h = 1 mm adds h²/6 to the variances across the ray, which lowers the peak of
# the narrow blob by h²/(6·3.5²) = 1.4 %. 0.8 % of the RMS measured.
PROJECTED = 0.015


def density(g):
    """Return the attenuation in the voxels' centres, float32 [z, y, x]."""
    z, y, x = np.meshgrid(*g.voxel_centres(), indexing="ij")
    places = np.stack([x, y, z], -1)
    return sum(a * np.exp(-((places - c) ** 2).sum(-1) / (2 * s**2)) for a, c, s in BLOBS).astype(np.float32)


def rays(g):
    """Return sources [view, 1, 1, xyz] and pixels [view, v, u, xyz] as docs/reference/conventions.md has them."""
    a = g.angles[:, None, None]
    k_v, k_u = (np.arange(n) - (n - 1) / 2 for n in g.n_detector)
    v, u = (k_v * g.d_detector[0] + g.off_detector[0])[:, None], k_u * g.d_detector[1] + g.off_detector[1]
    back = g.dsd - g.dso
    pixels = (-back * np.cos(a) - u * np.sin(a), -back * np.sin(a) + u * np.cos(a), v + 0 * (u + a))
    return np.stack([g.dso * np.cos(a), g.dso * np.sin(a), 0 * a], -1), np.stack(np.broadcast_arrays(*pixels), -1)


def integrals(g):
    """Return the line integrals of the blobs, float32 [view, v, u]."""
    source, pixels = rays(g)
    ray = pixels - source
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    total = np.zeros(g.shape)
    for a, c, s in BLOBS:
        apart = ((c - source) ** 2).sum(-1) - ((c - source) * ray).sum(-1) ** 2
        total += a * s * np.sqrt(2 * np.pi) * np.exp(-apart / (2 * s**2))
    return total.astype(np.float32)


def export(folder, to, g):
    """Write the scan of the blobs for a library; return its line integrals."""
    p = integrals(g)
    counts, flat = np.ones(g.shape, np.uint16), np.ones(g.n_detector, np.float32)
    write_scan(folder, to, Measured(geometry=g, p=p, reference=density(g), counts=counts, flat=flat, dark=0.0))
    return p


def shadows(p):
    """Return the centre of each view's shadow, in pixels: [view, (v, u)]."""
    p = np.asarray(p, np.float64)
    v, u = np.mgrid[: p.shape[1], : p.shape[2]]
    return np.stack([(p * at).sum((1, 2)) for at in (v, u)], 1) / p.sum((1, 2))[:, None]


def apart(theirs, ours):
    """Return the RMS of the difference in units of the RMS of `ours`."""
    return float(np.sqrt(np.mean((theirs.astype(np.float64) - ours) ** 2) / np.mean(ours.astype(np.float64) ** 2)))


def apart_in_view(theirs, ours, g):
    """Return how far volumes [z, y, x] are apart where every view sees, two voxels off the edge.

    Further out a shifted detector has a ray or its opposite only, and methods differ in what they make of that.
    """
    edge = g.s_detector[1] / 2 - abs(g.off_detector[1])
    _, y, x = np.meshgrid(*g.voxel_centres(), indexing="ij")
    seen = np.hypot(x, y) < g.dso * np.sin(np.arctan(edge / g.dsd)) - 2
    assert seen.mean() > 0.4
    return apart(theirs[seen], ours[seen])


def say(text):
    """Print what was measured, for `pytest -rP`."""
    sys.stdout.write(text + "\n")


def check_projections(theirs, p):
    moved = np.abs(shadows(theirs) - shadows(p)).max()
    say(f"shadows {moved:.2g} pixels apart, projections {apart(theirs, p):.2%} in RMS")
    assert moved < SHADOW
    assert apart(theirs, p) < PROJECTED


FAULTS = {
    "v offset negated": {"off_detector": (-2.25, -3.0)},
    "u offset negated": {"off_detector": (2.25, 3.0)},
    "offsets exchanged": {"off_detector": (-3.0, 2.25)},
    "half a pixel along v": {"off_detector": (2.25 + 0.75, -3.0)},
    "half a pixel along u": {"off_detector": (2.25, -3.0 + 0.7)},
    "pixel sizes exchanged": {"d_detector": (1.4, 1.5)},
    "turns the other way": {"arc_deg": -360.0},
    "a quarter turn ahead": {"start_deg": 107.0},
    "a view ahead": {"start_deg": 22.0},
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_geometry_moves_the_shadows(fault):
    """So that no fault of an export is within the tolerance of the comparisons below."""
    wrong = integrals(msgspec.structs.replace(GEOMETRY, **FAULTS[fault]))
    assert np.abs(shadows(wrong) - shadows(integrals(GEOMETRY))).max() > 4 * SHADOW


def test_upside_down_or_mirrored_projections_move_the_shadows():
    p = integrals(GEOMETRY)
    for wrong in (p[:, ::-1], p[:, :, ::-1], p[::-1]):
        assert np.abs(shadows(wrong) - shadows(p)).max() > 4 * SHADOW


@pytest.fixture(scope="module")
def leap(tmp_path_factory):
    """Return LEAP, set up on the CPU from an exported file, with the exported and our line integrals."""
    leapctype = pytest.importorskip("leapctype", reason="LEAP is not on PyPI: build it, and put its src on PYTHONPATH")
    folder = tmp_path_factory.mktemp("scan") / "leap"
    p = export(folder, "leap", SQUARE)
    model = leapctype.tomographicModels()
    model.set_gpu(-1)
    assert model.load_parameters(str(folder / "parameters.cfg"))
    return model, np.load(folder / "projections.npy"), p


@pytest.mark.slow
def test_leap_projects_as_our_export_says(leap):
    model, exported, _ = leap
    theirs = np.zeros(SQUARE.shape, np.float32)
    model.project_cpu(theirs, np.ascontiguousarray(volume_to(Library.LEAP, density(SQUARE))))
    check_projections(theirs, exported)


@pytest.mark.slow
def test_leap_reconstructs_our_export_to_our_fdk(leap):
    """By its filtered backprojection with its own default, the Shepp-Logan window.

    It averages filtered rows over a voxel's shadow where ours interpolates between pixels. To second order that adds
    h²/12 for voxels of h = 0.9 mm and takes off d²/6 for pixels of d = 0.62 mm at the axis: less than h²/12, which
    is 0.6 % of the variance of the narrow blob. 0.5 % measured, and a volume astray by half a voxel is 8 % apart.
    """
    model, exported, p = leap
    theirs = np.zeros(SQUARE.n_voxel, np.float32)
    model.FBP_cpu(exported, theirs)
    ours = fdk(torch.from_numpy(p), SQUARE, window="shepp-logan").numpy()
    found = apart_in_view(volume_from(Library.LEAP, theirs), ours, SQUARE)
    say(f"volumes {found:.2%} apart in RMS")
    assert found < 0.01


def with_astra(folder, g):
    """Export for ASTRA; return the library, its two dictionaries and the projections as the folder has them."""
    library = pytest.importorskip("astra", reason="ASTRA is not installed: pip install 'ctsim[peers]'")
    export(folder, "astra", g)
    found = json.loads((folder / "geometry.json").read_bytes())
    found["proj_geom"]["Vectors"] = np.load(folder / "vectors.npy")
    return library, found["proj_geom"], found["vol_geom"], np.load(folder / "projections.npy")


def test_astra_has_our_vectors():
    """ASTRA turns its own circular orbit into vectors, and shifts the detector by (columns, rows)."""
    library = pytest.importorskip("astra", reason="ASTRA is not installed: pip install 'ctsim[peers]'")
    g = GEOMETRY
    (d_v, d_u), (off_v, off_u), angles = g.d_detector, g.off_detector, angles_to(Library.ASTRA, g.angles)
    cone = library.create_proj_geom("cone", d_u, d_v, *g.n_detector, angles, g.dso, g.dsd - g.dso)
    theirs = library.functions.geom_postalignment(cone, (off_u / d_u, off_v / d_v))["Vectors"]
    # a few roundings of coordinates of 500 mm
    np.testing.assert_allclose(theirs, astra_vectors(g), rtol=0, atol=8 * 500 * 2**-52)


def test_astra_takes_our_export(tmp_path):
    """ASTRA's own objects hold the folder's geometry and projections, and give them back."""
    library, beams, grid, p = with_astra(tmp_path / "astra", GEOMETRY)
    stack = library.data3d.create("-sino", beams, p)
    body = library.data3d.create("-vol", grid, np.ascontiguousarray(volume_to(Library.ASTRA, density(GEOMETRY))))
    theirs = library.data3d.get_geometry(stack)
    np.testing.assert_allclose(theirs["Vectors"], beams["Vectors"], rtol=0, atol=8 * 500 * 2**-52)
    assert np.array_equal(library.data3d.get(stack), p)
    middles = zip("ZYX", GEOMETRY.voxel_centres(), GEOMETRY.d_voxel, strict=True)
    ends = {
        f"Window{end}{axis}": c[k] + h * d
        for axis, c, d in middles
        for end, k, h in (("Min", 0, -0.5), ("Max", -1, 0.5))
    }
    assert library.data3d.get_geometry(body)["options"] == pytest.approx(ends, abs=40 * 2**-24)  # it has float32

    library.data3d.delete([stack, body])


def test_astra_sees_points_where_our_export_has_them(tmp_path):
    """ASTRA's C++ projects points through the exported vectors, on a machine without a GPU too."""
    _, beams, _, _ = with_astra(tmp_path / "astra", GEOMETRY)
    project = getattr(importlib.import_module("astra.experimental"), "projectPoint", None)
    if project is None:
        pytest.skip("this ASTRA was built without CUDA and has no projectPoint")
    source, pixels = rays(GEOMETRY)
    for view in range(0, GEOMETRY.n_views, 5):
        for v, u in ((0, 0), (0, 89), (69, 0), (33, 41)):
            point = source[view, 0, 0] + 0.4 * (pixels[view, v, u] - source[view, 0, 0])
            # some roundings of coordinates of 1 m, magnified twice, in pixels of 1.4 mm
            assert project(beams, *point, view) == pytest.approx((u, v), abs=100 * 1000 * 2**-52)


@pytest.mark.slow
def test_astra_projects_as_our_export_says(tmp_path):
    """ASTRA's cone needs a GPU. Its fan does not: the row in the plane of the orbit, by the exported vectors."""
    library, beams, grid, p = with_astra(tmp_path / "astra", SQUARE)
    in_plane = np.ascontiguousarray(beams["Vectors"][:, [0, 1, 3, 4, 6, 7]])
    fan = library.create_proj_geom("fanflat_vec", beams["DetectorColCount"], in_plane)
    window = [grid["option"][f"Window{end}{axis}"] for axis in "XY" for end in ("Min", "Max")]
    plane = library.create_vol_geom(grid["GridRowCount"], grid["GridColCount"], *window)
    flat = msgspec.structs.replace(SQUARE, n_voxel=(1, *SQUARE.n_voxel[1:]), off_origin=(0.0, *SQUARE.off_origin[1:]))
    image = np.ascontiguousarray(density(flat)[0, ::-1])  # ASTRA's images have their first row on top, its volumes not
    projector = library.create_projector("line_fanflat", fan, plane)
    _, theirs = library.create_sino(image, projector)
    check_projections(theirs[:, None], p[33][:, None])


WITH_RTK = """
import sys
import itk
import numpy as np
from itk.rtkfdk import main
kind = itk.Image[itk.F, 3]
reader = itk.RTK.ThreeDCircularProjectionGeometryXMLFileReader.New()
reader.SetFilename("geometry.xml")
reader.GenerateOutputInformation()
project = itk.RTK.JosephForwardProjectionImageFilter[kind, kind].New()
for place, name in enumerate(("projections", "grid")):
    image = itk.imread(name + ".mha", itk.F)
    itk.array_view_from_image(image)[:] = 0 if place == 0 else np.load("body.npy")
    project.SetInput(place, image)
project.SetGeometry(reader.GetOutputObject())
project.Update()
np.save("seen.npy", itk.array_from_image(project.GetOutput()))
sys.argv = ["rtkfdk", *sys.argv[1:]]
main()
"""
RTKFDK = "--geometry geometry.xml --path . --regexp projections.mha --like grid.mha --output volume.mha"


@pytest.fixture(scope="module")
def with_rtk(tmp_path_factory):
    """Export for RTK; return line integrals, ours and exported, its projections, and the volume of the page's command.

    In a process of its own: SWIG's modules crash where warnings are errors.
    """
    if importlib.util.find_spec("itk") is None:
        pytest.skip("RTK is not installed: pip install 'ctsim[peers]'")
    folder = tmp_path_factory.mktemp("scan") / "rtk"
    p = export(folder, "rtk", GEOMETRY)
    np.save(folder / "body.npy", volume_to(Library.RTK, density(GEOMETRY)))
    command = [sys.executable, "-c", WITH_RTK, *RTKFDK.split()]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr
    exported, volume = (
        sitk.GetArrayFromImage(sitk.ReadImage(str(folder / f"{n}.mha"))) for n in ("projections", "volume")
    )
    return p, exported, np.load(folder / "seen.npy"), volume


@pytest.mark.slow
def test_rtk_projects_as_our_export_says(with_rtk):
    _, exported, theirs, _ = with_rtk
    check_projections(theirs, exported)


@pytest.mark.slow
def test_rtk_reconstructs_our_export_to_our_fdk(with_rtk):
    """By the command that the page names. Both use the plain ramp and interpolate between pixels."""
    p, _, _, theirs = with_rtk
    ours = fdk(torch.from_numpy(p), GEOMETRY).numpy()
    found = apart_in_view(volume_from(Library.RTK, theirs), ours, GEOMETRY)
    say(f"volumes {found:.2g} apart in RMS")
    # Ten times the roundings: some 20 of 6e-8, of peaks that are ten times the RMS, are 1e-5, as measured. Half a
    # pixel along u is 5e-3.
    assert found < 1e-4
