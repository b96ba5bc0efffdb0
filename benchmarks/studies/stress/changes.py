"""What the stress suite does to scans once they are simulated: other counts, or another geometry said of the same."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
import numpy as np
import torch

from ctsim.benchmarks.studies.stress.scans import Example, Positive, scaled_by


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
        angles = np.degrees(given.scan.geometry.angles).repeat(2)
        where = {"angles_deg": tuple(angles.tolist()), "n_views": angles.size}
        return _changed(given, where, counts=given.scan.counts.repeat_interleave(2, 0))


class Filled(Change, frozen=True, kw_only=True, tag="filled"):
    """One reading everywhere, in counts."""

    value: Annotated[int, msgspec.Meta(ge=0, le=65535)]

    def of(self, given: Example) -> Example:
        """Return the example with the reading."""
        return _changed(given, {}, counts=torch.full_like(given.scan.counts, self.value))


class Rounded(Change, frozen=True, kw_only=True, tag="rounded"):
    """The counts as float32, each moved by a unit in its last place or less."""

    def of(self, given: Example) -> Example:
        """Return the example with other last digits."""
        ulps = np.random.Generator(np.random.Philox(key=5)).uniform(-1, 1, given.scan.counts.shape)
        return _changed(given, {}, counts=given.scan.counts.float() * torch.from_numpy(1 + ulps * 2.0**-24).float())


class Turned(Change, frozen=True, kw_only=True, tag="turned"):
    """The same counts, said to begin so many degrees further on."""

    deg: float

    def of(self, given: Example) -> Example:
        """Return the example with another first angle."""
        where = given.scan.geometry
        if where.angles_deg is None:
            return _changed(given, {"start_deg": where.start_deg + self.deg})
        return _changed(given, {"angles_deg": tuple(a + self.deg for a in where.angles_deg)})


class Magnified(Change, frozen=True, kw_only=True, tag="magnified"):
    """The counts as those of a machine and an object of such a size that voxels have this edge along x, in mm."""

    voxel_mm: Positive

    def of(self, given: Example) -> Example:
        """Return the example with all lengths scaled."""
        where = given.scan.geometry
        factor = self.voxel_mm * where.n_voxel[2] / where.s_voxel[2]
        scan = dataclasses.replace(given.scan, geometry=scaled_by(where, factor))
        return dataclasses.replace(given, scan=scan, reference=given.reference / np.float32(factor))


AnyChange = Unchanged | Twice | Filled | Rounded | Turned | Magnified


def _changed(given: Example, where: Mapping[str, Any], **scan: Any) -> Example:
    """Return an example with parts of its geometry and of its scan replaced."""
    geometry = msgspec.structs.replace(given.scan.geometry, **where)
    return dataclasses.replace(given, scan=dataclasses.replace(given.scan, geometry=geometry, **scan))
