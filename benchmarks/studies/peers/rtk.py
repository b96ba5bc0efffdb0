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
        # their x, y, z are our y, z, x
        z, y, x = range(3)
        self._axes = (y, z, x)

    def volume(self, values: NDArray[np.float32]) -> Any:
        """Return a volume [z, y, x] on the geometry's grid as an image of RTK's."""
        g = self._geometry
        image = self._itk.image_from_array(np.ascontiguousarray(volume_to(Library.RTK, values)))
        image.SetSpacing([g.d_voxel[k] for k in self._axes])
        image.SetOrigin([-(g.n_voxel[k] - 1) / 2 * g.d_voxel[k] + g.off_origin[k] for k in self._axes])
        return image

    def stack(self, projections: NDArray[np.float32]) -> Any:
        """Return projections [view, v, u] as an image of RTK's."""
        image = self._itk.image_from_array(np.ascontiguousarray(projections))
        image.SetSpacing(self._pixels()[0])
        image.SetOrigin(self._pixels()[1])
        return image

    def _pixels(self) -> tuple[list[float], list[float]]:
        """Spacing and origin of the projections, (u, v, view)."""
        (n_v, n_u), (d_v, d_u), (off_v, off_u) = (
            self._geometry.n_detector,
            self._geometry.d_detector,
            self._geometry.off_detector,
        )
        return [d_u, d_v, 1.0], [-(n_u - 1) / 2 * d_u + off_u, -(n_v - 1) / 2 * d_v + off_v, 0.0]

    def project(self, volume: Any) -> NDArray[np.float32]:
        """Integrate an image of `volume` along the rays of all views by Joseph's method: [view, v, u]."""
        g = self._geometry
        zero = self._zero.New()
        spacing, origin = self._pixels()
        zero.SetSpacing(spacing)
        zero.SetOrigin(origin)
        zero.SetSize([g.n_detector[1], g.n_detector[0], g.n_views])
        zero.SetConstant(0.0)
        joseph = self._joseph.New()
        joseph.SetInput(0, zero.GetOutput())
        joseph.SetInput(1, volume)
        joseph.SetGeometry(self._orbit)
        joseph.Update()
        return self._itk.array_view_from_image(joseph.GetOutput())

    def fdk(self, stack: Any) -> NDArray[np.float32]:
        """Reconstruct an image of `stack` by FDK with the plain ramp: [z, y, x] in 1/mm."""
        n = self._geometry.n_voxel
        grid = self.volume(np.zeros((1, 1, 1), np.float32))  # for spacing and origin only
        zero = self._zero.New()
        zero.SetSpacing(grid.GetSpacing())
        zero.SetOrigin(grid.GetOrigin())
        zero.SetSize([n[k] for k in self._axes])
        zero.SetConstant(0.0)
        feldkamp = self._feldkamp.New()
        feldkamp.SetInput(0, zero.GetOutput())
        feldkamp.SetInput(1, stack)
        feldkamp.SetGeometry(self._orbit)
        feldkamp.Update()
        return volume_from(Library.RTK, self._itk.array_view_from_image(feldkamp.GetOutput()))
