"""Dose: photons per pixel from the charge of the tube or from an air kerma, and the air kerma of a scan.

A tube sends a number of photons into each steradian, the same in every view. A pixel gets those in its solid angle, and
the isocentre those per cm2 at its distance. Neither the air nor the heel weakens them. Photons per pixel are those
behind the filters; air kerma is behind the middle of the bow-tie, too, and without the object.
"""

from typing import NamedTuple

import numpy as np

from ctsim.beam.spectrum import Spectrum, Tube, spectrum
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation

FEWEST, MOST = 1.0, 1e12  # photons per open pixel and view
_CM2_PER_M2, _MM2_PER_CM2 = 1e4, 100.0


class Dose(NamedTuple):
    """Air kerma (mGy) at the isocentre without the object, and the charge (mAs) of the whole scan.

    `scan_mas` is None for a tube that states no photons per mAs.
    """

    view_kerma: float
    scan_kerma: float
    scan_mas: float | None

    def text(self) -> str:
        """Return the dose for people."""
        charge = "" if self.scan_mas is None else f", {self.scan_mas:.3g} mAs"
        return f"{self.scan_kerma:.3g} mGy of air kerma at the isocentre ({self.view_kerma:.3g} mGy a view){charge}"


def dose_of(tube: Tube, geometry: Geometry, i0: float) -> Dose:
    """Return the dose of a scan with `i0` photons per open pixel and view."""
    source, n = spectrum(tube), geometry.n_views
    kerma = i0 / _photons_per_kerma(tube, source, geometry)
    charge = None if source.fluence is None else n * i0 / _photons_per_mas(source.fluence, geometry)
    return Dose(view_kerma=kerma, scan_kerma=n * kerma, scan_mas=charge)


def i0_of_mas(tube: Tube, geometry: Geometry, scan_mas: float) -> float:
    """Return the photons per open pixel and view of a scan with `scan_mas`, divided evenly over its views.

    Raises InputError for a tube that states no photons per mAs, and where the photons are out of bounds.
    """
    fluence = spectrum(tube).fluence
    if fluence is None:
        raise InputError(
            f"scan_mas needs a tube that states its photons per mAs, but tube.model is {tube.model!r}; "
            "expected i0 or scan_kerma"
        )
    return _checked("scan_mas", scan_mas, "mAs", scan_mas / geometry.n_views * _photons_per_mas(fluence, geometry))


def i0_of_kerma(tube: Tube, geometry: Geometry, scan_kerma: float) -> float:
    """Return the photons per open pixel and view of a scan with `scan_kerma` (mGy) at the isocentre.

    Raises InputError where they are out of bounds.
    """
    photons = scan_kerma / geometry.n_views * _photons_per_kerma(tube, spectrum(tube), geometry)
    return _checked("scan_kerma", scan_kerma, "mGy", photons)


def _checked(key: str, value: float, unit: str, photons: float) -> float:
    if not FEWEST <= photons <= MOST:
        raise InputError(
            f"{key} = {value:g} {unit} gives {photons:.3g} photons per open pixel and view; "
            f"expected {FEWEST:g} to {MOST:g}"
        )
    return photons


def _photons_per_mas(fluence: float, geometry: Geometry) -> float:
    """Photons per pixel and mAs: `fluence` per cm2 at 1 m is 1e4 times as much per steradian."""
    return _CM2_PER_M2 * fluence * _steradians(geometry)


def _photons_per_kerma(tube: Tube, source: Spectrum, geometry: Geometry) -> float:
    """Photons per pixel for 1 mGy at the isocentre, the origin."""
    passed = 1.0
    if tube.bowtie is not None:
        passed = np.exp(-attenuation(tube.bowtie.material, source.energies) * tube.bowtie.center)
    kerma = source.kerma(passed)
    if not kerma > 0:
        raise InputError(f"tube.bowtie: {tube.bowtie and tube.bowtie.center} mm on the central ray leave no air kerma")
    distance2 = (geometry.pose_array()[:, :3] ** 2).sum(1)
    return _steradians(geometry) / (kerma * _MM2_PER_CM2 * float(np.mean(1 / distance2)))


def _steradians(geometry: Geometry) -> float:
    """Solid angle of a pixel where the perpendicular from the source meets the detector, the mean over the views.

    On a circular orbit it is the pixel's area over dsd².
    """
    poses = geometry.pose_array()
    normal = np.cross(poses[:, 6:9], poses[:, 9:])
    area = np.linalg.norm(normal, axis=1)
    height = ((poses[:, 3:6] - poses[:, :3]) * normal).sum(1) / area
    return float(np.mean(area / height**2))
