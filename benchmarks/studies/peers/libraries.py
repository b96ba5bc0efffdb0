"""Other libraries behind a few functions, as `run-benchmark peers` measures them; each is loaded when it is set up.

RTK (the PyPI package itk-rtk): Joseph's forward projector and FDK. Volumes and projections are ours, [z, y, x] and
[view, v, u] in mm, permuted by `ctsim.dataset.interop`. What RTK needs (its axis order, its pose matrices) is prepared
when a `Rtk` is made, before the clock starts. Rit et al., J. Phys. Conf. Ser. 489, 2014,
doi:10.1088/1742-6596/489/1/012079.

XCIST (the PyPI package gecatsim): polychromatic P of voxel volumes. A view goes through XCIST's own stages (gantry,
voxelised distance-driven projector, energy-integrating detection) with one source point, one sub-view, no noise and no
scatter; reading the phantom and the open beam are prepared when an `Xcist` is made. Spectrum and attenuation are the
caller's, so that P is the same quantity for all contenders. Wu et al., Phys. Med. Biol. 67, 2022,
doi:10.1088/1361-6560/ac9174.
"""

import copy
import ctypes
import json
import os
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ctsim.dataset.interop import Library, angles_to, volume_from, volume_to
from ctsim.errors import InputError
from ctsim.geometry import Geometry

AXES = (1, 0, 2)  # RTK's x, y, z are our y, z, x
_MODELS = ("detector", "source", "gantry", "ray_angles", "filters", "flux", "phantom")
_STAGES = ("RunModels", "C_Projector_Voxelized", "Detection_EI")
_NEVER = -1  # not a view's number: XCIST prepares at its first view and frees its memory at its last


class Rtk:
    """RTK set up for one circular scan on a given number of threads.

    Raises InputError for a geometry given by poses.
    """

    def __init__(self, geometry: Geometry, threads: int = 2) -> None:
        if geometry.poses is not None:
            raise InputError("RTK's geometry here is a circular orbit: give angles instead of poses")
        with warnings.catch_warnings():
            # SWIG's modules crash where its own deprecation warnings are errors; ITK loads them on first use
            warnings.simplefilter("ignore")
            itk: Any = import_module("itk")
            RTK = itk.RTK
            image = itk.Image[itk.F, 3]
            self._joseph = RTK.JosephForwardProjectionImageFilter[image, image]
            self._feldkamp = RTK.FDKConeBeamReconstructionFilter[image]
            self._zero = RTK.ConstantImageSource[image]
            itk.array_from_image(itk.image_from_array(np.zeros((2, 2, 2), np.float32)))
        itk.MultiThreaderBase.SetGlobalDefaultNumberOfThreads(threads)
        self._itk = itk
        self._geometry = geometry
        self._orbit = RTK.ThreeDCircularProjectionGeometry.New()
        for angle in angles_to(Library.RTK, geometry.angles):
            self._orbit.AddProjection(geometry.dso, geometry.dsd, float(angle))

    def volume(self, values: NDArray[np.float32]) -> Any:
        """Return a volume [z, y, x] on the geometry's grid as an image of RTK's."""
        return self._image(volume_to(Library.RTK, values), *self._grid())

    def stack(self, projections: NDArray[np.float32]) -> Any:
        """Return projections [view, v, u] as an image of RTK's."""
        return self._image(projections, *self._pixels())

    def project(self, volume: Any) -> NDArray[np.float32]:
        """Integrate an image of `volume` along the rays of all views by Joseph's method: [view, v, u]."""
        (n_v, n_u), n_views = self._geometry.n_detector, self._geometry.n_views
        return self._run(self._joseph, volume, [n_u, n_v, n_views], *self._pixels())

    def fdk(self, stack: Any) -> NDArray[np.float32]:
        """Reconstruct an image of `stack` by FDK with the plain ramp: [z, y, x] in 1/mm."""
        size = [self._geometry.n_voxel[k] for k in AXES]
        return volume_from(Library.RTK, self._run(self._feldkamp, stack, size, *self._grid()))

    def _grid(self) -> tuple[list[float], list[float]]:
        """Return spacing and origin of volumes, in their axes."""
        g = self._geometry
        return [g.d_voxel[k] for k in AXES], [-(g.n_voxel[k] - 1) / 2 * g.d_voxel[k] + g.off_origin[k] for k in AXES]

    def _pixels(self) -> tuple[list[float], list[float]]:
        """Return spacing and origin of the projections, (u, v, view)."""
        g = self._geometry
        corner = [-(g.n_detector[k] - 1) / 2 * g.d_detector[k] + g.off_detector[k] for k in (1, 0)]
        return [g.d_detector[1], g.d_detector[0], 1.0], [*corner, 0.0]

    def _image(self, values: NDArray[np.float32], spacing: list[float], origin: list[float]) -> Any:
        image = self._itk.image_from_array(np.ascontiguousarray(values))
        image.SetSpacing(spacing)
        image.SetOrigin(origin)
        return image

    def _run(self, kind: Any, image: Any, size: list[int], spacing: list[float], origin: list[float]) -> NDArray:
        """Run one of RTK's filters from an image to one of zeros."""
        zero, step = self._zero.New(), kind.New()
        zero.SetSpacing(spacing)
        zero.SetOrigin(origin)
        zero.SetSize(size)
        zero.SetConstant(0.0)
        step.SetInput(0, zero.GetOutput())
        step.SetInput(1, image)
        step.SetGeometry(self._orbit)
        step.Update()
        return self._itk.array_view_from_image(step.GetOutput())


class Xcist:
    """XCIST set up for one circular scan, with its phantom loaded.

    `volumes` are volume shares [z, y, x] on the geometry's grid, one per material; `mu` [bin, material] is
    1/mm, `energies` [bin] keV, `weights` [bin] the shares of the signal of the open beam. The library holds one
    phantom per process, so making another `Xcist` closes the previous one.
    Raises InputError for poses, voxels that are not square in x and y, and a detector shifted along u.
    """

    _loaded: ClassVar["Xcist | None"] = None

    def __init__(
        self,
        geometry: Geometry,
        volumes: Sequence[NDArray[np.float32]],
        mu: NDArray[np.float64],
        energies: NDArray[np.float64],
        weights: NDArray[np.float64],
    ) -> None:
        _check(geometry)
        table = np.ascontiguousarray(mu, np.float32)
        if table.shape != (len(energies), len(volumes)):
            raise InputError(f"mu must be [bin, material], {(len(energies), len(volumes))}, got {table.shape}")
        if Xcist._loaded is not None:
            Xcist._loaded.close()
        self.geometry = geometry
        with _undisturbed(), tempfile.TemporaryDirectory(prefix="ctsim-xcist-") as folder:
            self._cfg: Any = import_module("gecatsim").CatSim().get_current_cfg()
            self._run_models, self._project, self._detect = (_theirs(name) for name in _STAGES)
            ctypes.c_int.in_dll(self._cfg.clib, "PrintReportOutput").value = 0
            _configure(self._cfg, geometry, energies, weights)
            self._cfg.phantom.filename = _write_phantom(Path(folder), geometry, volumes)
            self._open = self._first_views()
        Xcist._loaded = self
        # XCIST's own attenuation has other cross-sections and compositions
        self._cfg.clib.set_material_info_vox(len(volumes), len(energies), table)

    def project(self) -> NDArray[np.float32]:
        """Measure all views: P [view, v, u], 0 for the open beam."""
        if Xcist._loaded is not self:
            raise InputError("this Xcist is closed: the library holds the phantom of another one")
        return -np.log(np.stack([self._view(k) for k in range(self.geometry.n_views)]) / self._open)

    def close(self) -> None:
        """Free the library's phantom."""
        if Xcist._loaded is self:
            self._cfg.sim.stopViewId = 0  # it frees its memory after the view it takes for the last
            self._view(0)
            Xcist._loaded = None

    def _first_views(self) -> NDArray[np.float32]:
        """Do XCIST's one-time work, load the phantom, and return a view of the open beam [v, u]."""
        sim = self._cfg.sim
        sim.startViewId, sim.stopViewId, sim.isPhantomScan = 0, _NEVER, False
        opened = self._view(0)
        sim.isPhantomScan = True
        self._run_models(self._cfg, 0, 0, ("phantom",))
        sim.startViewId = _NEVER
        return opened

    def _view(self, k: int) -> NDArray[np.float32]:
        """Return the signal of one view, [v, u]: the body of XCIST's loop over views, without its files."""
        cfg, (n_v, n_u) = self._cfg, self.geometry.n_detector
        # XCIST counts degrees from +y, counter-clockwise seen from +z
        cfg.protocol.startAngle = float(np.degrees(self.geometry.angles[k])) - 90.0
        self._run_models(cfg, k, 0, _MODELS)  # after the first view only the gantry moves
        cfg.thisSubView = copy.copy(cfg.detFlux)
        lit = self._project(cfg, k, 0) if cfg.sim.isPhantomScan else cfg
        # XCIST's order is by columns, along −u
        return np.asarray(self._detect(lit, k, 0).thisView, np.float32).reshape(n_u, n_v).T[:, ::-1]


def _theirs(name: str) -> Any:
    return getattr(import_module(f"gecatsim.pyfiles.{name}"), name)


def _check(geometry: Geometry) -> None:
    if geometry.poses is not None:
        raise InputError("XCIST's geometry here is a circular orbit: give angles instead of poses")
    if geometry.d_voxel[1] != geometry.d_voxel[2]:
        raise InputError(f"XCIST's voxels are square in x and y, got {geometry.d_voxel[:0:-1]} mm")
    if geometry.off_detector[1] != 0:
        raise InputError(f"XCIST turns a detector that is shifted along u, got {geometry.off_detector[1]} mm")


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Ignore the warnings of XCIST's start (unclosed files, numpy.matlib), and keep it from changing PATH."""
    path = os.environ["PATH"]
    with warnings.catch_warnings(action="ignore"), ExitStack() as after:
        after.callback(os.environ.update, PATH=path)
        yield


def _configure(cfg: Any, geometry: Geometry, energies: NDArray[np.float64], weights: NDArray[np.float64]) -> None:
    """Set scanner, physics and scan in XCIST's terms; photons times energy are the weights."""
    (n_v, n_u), (d_v, d_u) = geometry.n_detector, geometry.d_detector
    cfg.spec.nEbin = len(energies)
    cfg.spec.Evec = cfg.sim.Evec = np.asarray(energies, np.float32)
    cfg.spec.Ivec = np.tile(np.asarray(weights / energies, np.float32), (n_v * n_u, 1))
    scanner = vars(cfg.scanner)
    scanner.update(detectorRowCount=n_v, detectorRowsPerMod=n_v, detectorColCount=n_u, detectorColsPerMod=n_u)
    scanner.update(detectorRowSize=d_v, detectorRowOffset=geometry.off_detector[0] / d_v)
    scanner.update(detectorColSize=d_u, detectorColOffset=0.0, sid=geometry.dso, sdd=geometry.dsd)
    # a third-generation detector of a single module is flat; one this deep absorbs everything, at every energy
    scanner.update(detectorCallback="Detector_ThirdgenCurved", detectorPrefilter=[], detectorDepth=1e9)
    scanner.update(detectionCallback="Detection_EI", detectionGain=1.0, focalspotShape="Uniform")
    samples = ("colSampleCount", "rowSampleCount", "srcXSampleCount", "srcYSampleCount", "viewSampleCount")
    vars(cfg.scanner).update(scanner)
    vars(cfg.physics).update(dict.fromkeys(samples, 1), scatterCallback="")
    vars(cfg.protocol).update(flatFilter=[], bowtie="")
    vars(cfg.sim).update(isOffsetScan=False, subViewCount=1, enableQuantumNoise=0, eNoise=0.0)
    cfg.time = 0.0  # the gantry stands at startAngle


def _write_phantom(folder: Path, geometry: Geometry, volumes: Sequence[NDArray[np.float32]]) -> str:
    """Write volumes as XCIST's voxelised phantom, rows from +y down; return the path of its JSON file."""
    for k, volume in enumerate(volumes):
        np.ascontiguousarray(volume[:, ::-1], np.float32).tofile(folder / f"{k}.raw")
    # any material it knows: the attenuation is replaced
    each: dict[str, object] = {"mat_name": "water", "volumefractionmap_datatype": "float"}
    axes = zip("zyx", ("slices", "rows", "cols"), geometry.n_voxel, geometry.d_voxel, geometry.off_origin, strict=True)
    for axis, count, n, d, offset in axes:
        # offset of the isocentre, counted from 1
        each |= {count: n, f"{axis}_size": d, f"{axis}_offset": (n + 1) / 2 - offset / d}
    phantom = {name: [value] * len(volumes) for name, value in each.items()} | {
        "n_materials": len(volumes),
        "volumefractionmap_filename": [f"{k}.raw" for k in range(len(volumes))],
    }
    path = folder / "phantom.json"
    path.write_text(json.dumps(phantom), encoding="utf-8")
    return str(path)
