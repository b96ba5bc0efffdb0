"""Scanner presets, and the scanner table of a scene file.

Distances are those of machines one can buy, rounded; the panel is binned so that the asked number of
pixels covers the object's shadow, as an operator would choose the binning and the collimation.

What spoils their images has typical sizes, not those measured on one machine (docs/explanation/physics.md names the
sources). The preset "ideal" has the distances of the micro-CT and none of it.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

import msgspec

from ctsim.beam.dose import i0_of_kerma, i0_of_mas
from ctsim.beam.spectrum import Filter, Tube
from ctsim.beam.spot import FocalSpot, OffFocal
from ctsim.detector.noise import Noise
from ctsim.detector.panel import Blur, Lag
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.geometry import Count, Geometry, Pair, Triple
from ctsim.phantoms.recipe import REACH
from ctsim.scatter import Scatter
from ctsim.types import Scanner

MARGIN = 1.06  # air around the object's shadow, so that filters and flat-field checks see open pixels


class Machine(NamedTuple):
    """Fixed properties of a machine: distances and panel (v, u) in mm, arc, tube, detector and scatter."""

    dso: float
    dsd: float
    panel: Pair
    arc_deg: float
    tube: Tube
    detector: Detector
    scatter: Scatter = Scatter(level=3)


_SOFT = (Filter(material="Al", thickness=0.5),)
_HARD = (Filter(material="Al", thickness=2.5),)
_CSI_BLUR = Blur(fwhm=0.37, tail=0.08, tail_fwhm=20.0)
_SILICON_LAG = (Lag(share=0.023, decay=0.3), Lag(share=0.02, decay=0.8))

MACHINES: dict[str, Machine] = {
    # the next one's distances, tube and screen; nothing scatters, blurs or darkens the corners
    "ideal": Machine(
        250.0, 500.0, (146.0, 230.0), 360.0,
        Tube(kvp=90.0, filters=_SOFT),
        Detector(kind="gos", thickness=0.1),
        Scatter(),
    ),
    # desktop micro-CT: half-metre source to panel, 3072 x 1944 pixels of 75 um, GOS screen; it stops for each view, so
    # there is no lag
    "skyscan1273": Machine(
        250.0, 500.0, (146.0, 230.0), 360.0,
        Tube(kvp=90.0, filters=_SOFT, focal_spot=FocalSpot(size=(0.01, 0.01)), falloff=True),
        Detector(kind="gos", thickness=0.1, blur=Blur(fwhm=0.3)),
    ),
    # seated dental cone-beam unit, full turn, fixed anode
    "dental": Machine(
        430.0, 690.0, (250.0, 300.0), 360.0,
        Tube(kvp=90.0, filters=_HARD, focal_spot=FocalSpot(size=(0.5, 0.5)), falloff=True),
        Detector(kind="csi", thickness=0.5, blur=_CSI_BLUR, lag=_SILICON_LAG),
    ),
    # interventional C-arm: 200 degree short scan, 30 x 40 cm panel, rotating anode, grid
    "c-arm": Machine(
        785.0, 1200.0, (300.0, 400.0), 200.0,
        Tube(
            kvp=100.0,
            filters=(*_HARD, Filter(material="Cu", thickness=0.1)),
            focal_spot=FocalSpot(size=(0.6, 0.6)),
            off_focal=OffFocal(share=0.03, fwhm=20.0),
            falloff=True,
        ),
        Detector(kind="csi", thickness=0.6, blur=_CSI_BLUR, lag=_SILICON_LAG),
        Scatter(level=3, grid_ratio=10.0),
    ),
}  # fmt: skip


def with_machine(table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the scanner table of a scene file with the preset's values for what its parts leave open.

    `tube = { kvp = 110.0 }` keeps the preset's filters. Another kind of detector has no thickness from the preset, and
    scatter whose level is stated no grid: files that state a scene in full leave out a grid that is not there.
    """
    name = table.get("preset", "ideal")
    machine = MACHINES.get(name if isinstance(name, str) else "", MACHINES["ideal"])
    found = dict(table)
    for part, keys in KEPT.items():
        given, own = table.get(part), msgspec.to_builtins(getattr(machine, part))
        if not isinstance(given, Mapping):
            continue
        whole = (part == "scatter" and "level" in given) or given.get("kind", own.get("kind")) != own.get("kind")
        if not whole:
            found[part] = {**{key: own[key] for key in keys if own[key] is not None}, **given}
    return found


KEPT = {"tube": ("kvp", "filters"), "detector": ("kind", "thickness"), "scatter": ("level", "grid_ratio")}
"""What presets differ in, besides what `ScannerSettings.resolve` keeps."""


def shadow(dso: float, dsd: float, object_mm: float) -> Pair:
    """Return the extent (v, u) in mm of the shadow of the largest object of a cube of `object_mm`."""
    radius = REACH * object_mm / 2
    if radius >= dso:
        raise InputError(f"the source lies inside the object: dso = {dso} mm, the object's radius is {radius:.4g} mm")
    return 2 * radius * dsd / (dso - radius), 2 * dsd * math.tan(math.asin(radius / dso))


def preset(
    name: str,
    n_views: int,
    n_detector: tuple[int, int],
    n_voxel: tuple[int, int, int],
    object_mm: float,
) -> Scanner:
    """Return a preset scanner whose square pixels and voxels cover a cube of `object_mm`.

    One row of several pixels covers a slice: one layer of voxels is then as thick as the row is high on the axis.
    Raises `InputError` for an unknown name and for an object that the panel cannot cover.
    """
    if name not in MACHINES:
        raise InputError(f"preset {name!r} is unknown: expected one of {', '.join(MACHINES)}")
    if not (math.isfinite(object_mm) and object_mm > 0):
        raise InputError(f"object_mm must be positive (mm), got {object_mm}")
    if min(*n_detector, *n_voxel, n_views) < 1:
        raise InputError(f"n_views, n_detector and n_voxel must be at least 1, got {n_views}, {n_detector}, {n_voxel}")
    machine = MACHINES[name]
    try:
        need = [s * MARGIN for s in shadow(machine.dso, machine.dsd, object_mm)]
    except InputError as error:
        raise InputError(f"preset {name!r}, phantom.size = {object_mm} mm: {error}") from None
    fan = n_detector[0] == 1 < n_detector[1]
    if fan:
        need[0] = need[1] / n_detector[1]
    if need[0] > machine.panel[0] or need[1] > machine.panel[1]:
        raise InputError(
            f"preset {name!r}: an object of {object_mm} mm needs {need[0]:.0f} x {need[1]:.0f} mm of panel (v, u), "
            f"the machine has {machine.panel[0]:.0f} x {machine.panel[1]:.0f}"
        )
    pixel = max(s / n for s, n in zip(need, n_detector, strict=True))
    z, y, x = (object_mm / n for n in n_voxel)
    if fan and n_voxel[0] == 1:
        z = pixel * machine.dso / machine.dsd
    geometry = Geometry(
        dso=machine.dso,
        dsd=machine.dsd,
        n_voxel=n_voxel,
        d_voxel=(z, y, x),
        n_detector=n_detector,
        d_detector=(pixel, pixel),
        n_views=n_views,
        arc_deg=machine.arc_deg,
    )
    return _scanner(machine, geometry)


def _scanner(machine: Machine, geometry: Geometry) -> Scanner:
    return Scanner(geometry=geometry, tube=machine.tube, detector=machine.detector, scatter=machine.scatter)


class ScannerSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The scanner of a scene: a preset with changes, or a full `geometry`.

    With a `geometry`, the keys that shape one (`n_views` … `off_origin`) must be left out.
    """

    preset: Literal["ideal", "skyscan1273", "dental", "c-arm"] = "ideal"
    """The machine: distances, panel, arc, tube, detector and scatter; "ideal" has no scatter and no blur."""
    n_views: Count | None = None
    """Number of projections (60 by default)."""
    n_detector: tuple[Count, Count] | None = None
    """Pixels (v, u); the panel is binned to cover the object (96, 96)."""
    n_voxel: tuple[Count, Count, Count] | None = None
    """Grid (z, y, x) of the reconstruction and the references (64, 64, 64)."""
    field_mm: Annotated[float, msgspec.Meta(gt=0)] | None = None
    """Edge of the reconstructed cube in mm, by default the object's."""
    start_deg: float | None = None
    """Angle of the first view."""
    arc_deg: float | None = None
    """Arc of the scan; negative is clockwise."""
    angles_deg: tuple[float, ...] | None = None
    """The angle of each view, instead of even steps."""
    off_detector: Pair | None = None
    """Shift of the detector (v, u) in mm."""
    off_origin: Triple | None = None
    """Centre of the grid (z, y, x) in mm."""
    geometry: Geometry | None = None
    """All of the geometry, instead of a preset."""
    tube: Tube | None = None
    """Changes to the preset's tube: voltage, filters, focal spot, off-focal radiation, falloff stay if not stated.
    A `Tube` made in Python is whole but for the last three."""
    detector: Detector | None = None
    """Changes to the preset's detector: kind, thickness, blur, lag stay if not stated; another kind has no thickness
    from it, a lag of share 0 is none. A `Detector` made in Python is whole but for blur and lag."""
    noise: Noise | None = None
    """How photons become counts."""
    scatter: Scatter | None = None
    """The scatter model; if its level is stated, a preset's grid is left out."""
    i0: Annotated[float, msgspec.Meta(ge=1, le=1e12)] | None = None
    """Photons that reach an open pixel in one view, behind the filters (1e5 by default)."""
    scan_mas: Annotated[float, msgspec.Meta(gt=0, le=1e6)] | None = None
    """Instead of `i0`: mAs of the whole scan, the same share in every view; not for the model "mono"."""
    scan_kerma: Annotated[float, msgspec.Meta(gt=0, le=1e6)] | None = None
    """Instead of `i0`: air kerma in mGy at the isocentre, without the object, of the whole scan."""

    def __post_init__(self) -> None:
        if self.field_mm is not None and not (math.isfinite(self.field_mm) and self.field_mm > 0):
            raise InputError(f"field_mm must be positive (mm), got {self.field_mm}")
        if self.geometry is not None and (given := [k for k in SHAPING if getattr(self, k) is not None]):
            raise InputError(f"geometry is given in full, so {', '.join(given)} must be left out")
        if len(given := [k for k in DOSE if getattr(self, k) is not None]) > 1:
            raise InputError(f"{given[-1]}: expected only one of {', '.join(DOSE)}, got {' and '.join(given)}")

    def resolve(self, object_mm: float) -> Scanner:
        """Return the scanner for an object of a cube of `object_mm`."""
        n_voxel = self.n_voxel or (64, 64, 64)
        if self.geometry is None:
            scanner = preset(self.preset, self.n_views or 60, self.n_detector or (96, 96), n_voxel, object_mm)
            names = ("start_deg", "arc_deg", "angles_deg", "off_detector", "off_origin")
            changes = {k: getattr(self, k) for k in names if getattr(self, k) is not None}
            if self.field_mm is not None:
                z, *across = (self.field_mm / n for n in n_voxel)
                slices = n_voxel[0] == scanner.geometry.n_detector[0] == 1 < scanner.geometry.n_detector[1]
                changes["d_voxel"] = (scanner.geometry.d_voxel[0] if slices else z, *across)
            if self.angles_deg is not None and self.n_views is None:
                changes["n_views"] = len(self.angles_deg)
            scanner = msgspec.structs.replace(scanner, geometry=msgspec.structs.replace(scanner.geometry, **changes))
        else:
            machine = MACHINES[self.preset]
            scanner = _scanner(machine, self.geometry)
        parts = {k: getattr(self, k) for k in ("noise", "scatter", "i0")}
        parts |= {"tube": self._tube(scanner.tube), "detector": self._detector(scanner.detector)}
        scanner = msgspec.structs.replace(scanner, **{k: v for k, v in parts.items() if v is not None})
        if self.scan_mas is not None:
            scanner = msgspec.structs.replace(scanner, i0=i0_of_mas(scanner.tube, scanner.geometry, self.scan_mas))
        if self.scan_kerma is not None:
            scanner = msgspec.structs.replace(scanner, i0=i0_of_kerma(scanner.tube, scanner.geometry, self.scan_kerma))
        return scanner

    def _tube(self, machine: Tube) -> Tube:
        """Return the tube; a change of voltage or filter leaves the machine's focal spot as it is."""
        tube = self.tube
        if tube is None:
            return machine
        return msgspec.structs.replace(
            tube,
            focal_spot=tube.focal_spot or machine.focal_spot,
            off_focal=tube.off_focal or machine.off_focal,
            falloff=tube.falloff or machine.falloff,
        )

    def _detector(self, machine: Detector) -> Detector:
        detector = self.detector
        if detector is None or detector.kind == "counting":  # which has no light
            return detector or machine
        lag = tuple(part for part in detector.lag or machine.lag if part.share)
        return msgspec.structs.replace(detector, blur=detector.blur or machine.blur, lag=lag)


SHAPING = (
    "n_views", "n_detector", "n_voxel", "field_mm", "start_deg", "arc_deg", "angles_deg", "off_detector", "off_origin",
)  # fmt: skip
DOSE = ("i0", "scan_mas", "scan_kerma")
