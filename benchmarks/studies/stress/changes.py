"""What the stress suite does to simulated scans: other counts, or another geometry said of the same ones."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.geometry import Geometry
from ctsim.types import Scan

Positive = Annotated[float, msgspec.Meta(gt=0)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Example:
    """A scan as a method gets it, with the true metal mask, and what it is judged by.

    `reference` [z, y, x] is the effective attenuation in 1/mm; errors are taken over `region`, voxels a voxel or more
    inside the body and more than two from metal, in the field of view.
    """

    scan: Scan
    reference: NDArray[np.float32]
    region: NDArray[np.bool_]

    def error(self, values: NDArray[np.float32]) -> float:
        """Return the RMSE over that of an empty volume; 0 where there is no region."""
        if not self.region.any():
            return 0.0
        there = self.reference[self.region].astype(np.float64)
        return float(np.sqrt(np.mean((values[self.region] - there) ** 2) / np.mean(there**2)))

    def replaced(self, where: Mapping[str, Any], **scan: Any) -> "Example":
        """Return the example with parts of its geometry and of its scan replaced."""
        geometry = msgspec.structs.replace(self.scan.geometry, **where)
        return dataclasses.replace(self, scan=dataclasses.replace(self.scan, geometry=geometry, **scan))


class Change(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind"):
    """A change by its name."""

    def of(self, given: Example) -> Example:
        """Return the changed example."""
        raise NotImplementedError


class Unchanged(Change, frozen=True, kw_only=True, tag="unchanged"):
    """The scan as it was simulated."""

    def of(self, given: Example) -> Example:
        """Return the example itself."""
        return given


class Twice(Change, frozen=True, kw_only=True, tag="twice"):
    """Every view given twice."""

    def of(self, given: Example) -> Example:
        """Return the example with each view followed by itself."""
        return given.replaced(self.where(given.scan.geometry), counts=given.scan.counts.repeat_interleave(2, 0))

    def where(self, geometry: Geometry) -> dict[str, Any]:
        """Return what changes of a geometry."""
        angles = np.degrees(geometry.angles).repeat(2)
        return {"angles_deg": tuple(angles.tolist()), "n_views": angles.size}


class Filled(Change, frozen=True, kw_only=True, tag="filled"):
    """One reading everywhere, in counts."""

    value: Annotated[int, msgspec.Meta(ge=0, le=65535)]

    def of(self, given: Example) -> Example:
        """Return the example with the reading."""
        return given.replaced({}, counts=given.scan.counts.clone().fill_(self.value))


class Rounded(Change, frozen=True, kw_only=True, tag="rounded"):
    """The counts as float32, each moved by a unit in its last place or less."""

    def of(self, given: Example) -> Example:
        """Return the example with other last digits."""
        counts = given.scan.counts.float()
        ulps = np.random.Generator(np.random.Philox(key=5)).uniform(-1, 1, counts.shape)
        return given.replaced({}, counts=counts * counts.new_tensor((1 + ulps * 2.0**-24).astype(np.float32)))


class Turned(Change, frozen=True, kw_only=True, tag="turned"):
    """The same counts, said to begin so many degrees further on."""

    deg: float

    def of(self, given: Example) -> Example:
        """Return the example with another first angle."""
        where = given.scan.geometry
        if where.angles_deg is None:
            return given.replaced({"start_deg": where.start_deg + self.deg})
        return given.replaced({"angles_deg": tuple(a + self.deg for a in where.angles_deg)})


class Magnified(Change, frozen=True, kw_only=True, tag="magnified"):
    """The counts as those of a machine and an object of such a size that voxels have this edge along x, in mm."""

    voxel_mm: Positive

    def of(self, given: Example) -> Example:
        """Return the example with all lengths scaled."""
        g = given.scan.geometry
        factor = self.voxel_mm / g.d_voxel[2]
        voxel, pixel = (tuple(d * factor for d in sizes) for sizes in (g.d_voxel, g.d_detector))
        scaled = given.replaced({"dso": g.dso * factor, "dsd": g.dsd * factor, "d_voxel": voxel, "d_detector": pixel})
        return dataclasses.replace(scaled, reference=given.reference / np.float32(factor))


AnyChange = Unchanged | Twice | Filled | Rounded | Turned | Magnified
