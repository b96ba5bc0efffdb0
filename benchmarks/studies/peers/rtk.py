"""RTK (the PyPI package itk-rtk) behind two functions: Joseph's forward projector and FDK.

Volumes and projections are ours, [z, y, x] and [view, v, u] in mm, permuted by `ctsim.interop`. What
RTK wants prepared (its axis order, its pose matrices) is prepared when a `Rtk` is made, before any clock
runs. Rit et al., J. Phys. Conf. Ser. 489, 2014, doi:10.1088/1742-6596/489/1/012079.
"""

import warnings
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.interop import Library, angles_to, volume_from, volume_to

AXES = (1, 0, 2)  # their x, y, z are our y, z, x


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
