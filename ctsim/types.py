"""The values that travel down the street: Phantom, Scanner, Scan, Volume, Status."""

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim.beam.spectrum import Tube
from ctsim.detector.noise import Noise
from ctsim.detector.response import Detector
from ctsim.errors import InputError, check_kind
from ctsim.geometry import Geometry, Triple
from ctsim.scaninfo import check_readings, is_number
from ctsim.scatter import Scatter
from ctsim.solids import Solid

if TYPE_CHECKING:
    import torch  # loaded where there are readings: most of a second that making data does without


@dataclass(frozen=True, slots=True, kw_only=True)
class Phantom:
    """What is scanned: a label volume, an optional density map, and analytic solids that replace it.

    `labels` is uint8 [z, y, x]; label k is `materials[k]` and label 0 is always air, which does not
    attenuate (the flat field is taken through air). `density` is relative to the material's nominal
    density, float32 [z, y, x]. `d_voxel` and `off_origin` (z, y, x) are mm. `partial` says that layers of the labels
    are not drawn, so that a material which does not occur in them may be of the body all the same.
    """

    labels: NDArray[np.uint8]
    materials: tuple[str, ...]
    d_voxel: Triple
    off_origin: Triple = (0.0, 0.0, 0.0)
    density: NDArray[np.float32] | None = None
    solids: tuple[Solid, ...] = ()
    partial: bool = False

    def __post_init__(self) -> None:
        if self.labels.ndim != 3 or self.labels.dtype != np.uint8:
            raise InputError(f"labels must be uint8 [z, y, x], got {self.labels.dtype} of shape {self.labels.shape}")
        if not self.materials or self.materials[0] != "air":
            raise InputError(f"materials[0] must be 'air', got {self.materials[:1]}")
        if self.labels.size and int(self.labels.max()) >= len(self.materials):
            raise InputError(f"label {int(self.labels.max())} has no material: only {len(self.materials)} are named")
        if min(self.d_voxel) <= 0:
            raise InputError(f"d_voxel must be positive (mm), got {self.d_voxel}")
        if self.density is not None:
            if self.density.shape != self.labels.shape:
                raise InputError(f"density has shape {self.density.shape}, labels {self.labels.shape}")
            if not np.isfinite(self.density).all() or self.density.min() < 0:
                raise InputError("density must be finite and not negative")
        for solid in self.solids:
            if solid.material not in self.materials:
                raise InputError(f"solid {solid.name!r}: material {solid.material!r} is not among {self.materials}")

    def without_metal(self) -> "Phantom":
        """Return the same body with its metal inserts taken out."""
        return replace(self, solids=tuple(s for s in self.solids if not s.metal))


class Scanner(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything about the machine: geometry, tube, detector, dose, noise and scatter.

    `i0` is the number of photons that reach an open pixel in one view.
    """

    geometry: Geometry
    tube: Tube = Tube()
    detector: Detector = Detector()
    i0: Annotated[float, msgspec.Meta(ge=1, le=1e12)] = 1e5
    noise: Noise = Noise()
    scatter: Scatter = Scatter()

    def __post_init__(self) -> None:
        if self.detector.kind == "counting" and self.detector.threshold >= self.tube.kvp:
            raise InputError(
                f"detector.threshold must be below tube.kvp = {self.tube.kvp} keV, got {self.detector.threshold}"
            )
        tube, panel = self.tube, self.detector
        if (tube.heel or tube.bowtie or tube.falloff) and self.noise.model == "tigre":
            raise InputError(
                "noise.model = 'tigre' knows P only: expected neither tube.heel, tube.bowtie nor tube.falloff with it "
                '(of the presets only "ideal" has no falloff)'
            )
        if (panel.blur or panel.lag) and self.noise.model == "tigre":
            raise InputError(
                "noise.model = 'tigre' has independent pixels: expected neither detector.blur nor detector.lag with it "
                '(of the presets only "ideal" has none)'
            )
        if (tube.heel or tube.bowtie or tube.falloff) and self.geometry.poses is not None:
            raise InputError(
                "tube.heel, tube.bowtie and tube.falloff need a circular orbit, but geometry.poses is given"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """All that a reconstruction method gets.

    `counts` [view, v, u] is what the detector wrote (uint16 where there is an ADC, else float32);
    `flat` [v, u] float32 is the open-field image and `dark` the pedestal, both in counts. `e_max` is
    the highest photon energy (keV); `i0` the photons per open pixel and view. `metal` [z, y, x], not 0 in metal,
    is the true mask, there only for methods that declare to be given it. `name` is that of the scene, "" where it has
    none; that of a metal-free twin ends in "/metal_free". `floor` is the smallest signal, in counts above the pedestal,
    whose logarithm is taken; None is half a photon, and of whole counts at least half a count.

    Raises
    ------
    InputError
        When arrays are no tensors of real numbers in the geometry's shapes, when no pixel of `flat` is finite and
        above `dark`, and when a number cannot be what it is to be. The counts themselves are not read.
    """

    geometry: Geometry
    counts: "torch.Tensor"
    flat: "torch.Tensor"
    dark: float = 0.0
    i0: float = 1e5
    e_max: float = 90.0
    metal: "torch.Tensor | None" = None
    name: str = ""
    floor: float | None = None

    def __post_init__(self) -> None:
        check_kind("geometry", self.geometry, Geometry, "a ctsim.Geometry")
        check_kind("name", self.name, str, "a text")
        if self.floor is not None and not (is_number(self.floor) and self.floor > 0):
            raise InputError(f"floor: expected a number of counts above 0, got {self.floor!r}")
        check_readings(self.dark, self.i0, self.e_max)
        _check_array("counts", self.counts, self.geometry.shape, READINGS)
        _check_array("flat", self.flat, self.geometry.n_detector, READINGS)
        if self.metal is not None:
            _check_array("metal", self.metal, self.geometry.n_voxel, ("bool", *READINGS))
        flat = self.flat.double()
        if not bool(((flat > self.dark) & (flat < math.inf)).any()):
            raise InputError(f"flat: no pixel is finite and above the pedestal, dark = {self.dark:g} counts")

    def __reduce__(self) -> "tuple[Callable[..., Scan], tuple[Any, ...]]":
        """Pickle unsigned readings by the signed numbers of the same bits: torch loads no uint16 and uint32."""
        import torch

        values: dict[str, Any] = {one.name: getattr(self, one.name) for one in fields(self)}
        unsigned: dict[str, str] = {}
        for name, value in values.items():
            if isinstance(value, torch.Tensor) and value.dtype in (torch.uint16, torch.uint32):
                unsigned[name] = str(value.dtype).removeprefix("torch.")
                values[name] = value.view(getattr(torch, unsigned[name].removeprefix("u")))
        return _unpickled, (type(self), values, unsigned)

    @classmethod
    def from_line_integrals(
        cls, p: "torch.Tensor | NDArray[np.floating]", geometry: Geometry, *, e_max: float, i0: float = 1e5
    ) -> "Scan":
        """Return the scan whose −log projections are `p` [view, v, u], for measurements that are no longer counts.

        `i0` is how many photons an open pixel saw: readings below half a photon, p above ln(2 i0), count as nothing
        seen, as do values that are not finite. Raises InputError as `Scan` does.
        """
        import torch

        check_kind("geometry", geometry, Geometry, "a ctsim.Geometry")
        check_readings(0.0, i0, e_max)
        try:
            p = torch.as_tensor(p)
        except (TypeError, ValueError, RuntimeError):
            kind = f"{type(p).__name__} of {p.dtype}" if isinstance(p, np.ndarray) else type(p).__name__
            raise InputError(f"p: expected real numbers [view, v, u], got {kind}") from None
        _check_array("p", p, geometry.shape, (*READINGS, "bfloat16", "uint64", "bool"))
        counts = i0 * torch.exp(-p.double())
        flat = torch.full(geometry.n_detector, i0, dtype=torch.float32)
        return cls(geometry=geometry, counts=counts.float(), flat=flat, i0=i0, e_max=e_max)


def _unpickled(kind: type[Scan], values: dict[str, Any], unsigned: dict[str, str]) -> Scan:
    import torch

    return kind(**values | {name: values[name].view(getattr(torch, dtype)) for name, dtype in unsigned.items()})


READINGS = ("uint8", "uint16", "uint32", "int8", "int16", "int32", "int64", "float16", "float32", "float64")
"""What readings may be stored as: real numbers of types that NumPy has too."""


def _check_array(name: str, given: Any, shape: tuple[int, ...], dtypes: tuple[str, ...]) -> None:
    """Raise InputError unless `given` is a tensor of that shape and one of these types that needs no gradient."""
    import torch

    if not isinstance(given, torch.Tensor):
        hint = f"; torch.from_numpy({name}) makes one" if isinstance(given, np.ndarray) else ""
        raise InputError(f"{name} must be a torch.Tensor, got {type(given).__module__}.{type(given).__name__}{hint}")
    if tuple(given.shape) != shape:
        raise InputError(f"{name}: shape {tuple(given.shape)}, the geometry says {shape}")
    if str(given.dtype).removeprefix("torch.") not in dtypes:
        raise InputError(f"{name} must be real numbers ({', '.join(dtypes)}), got {given.dtype}")
    if given.requires_grad:
        raise InputError(f"{name} must not require gradients; {name}.detach() does not")


class Status(enum.StrEnum):
    """How a run ended."""

    OK = "ok"
    SKIPPED = "skipped"
    NONFINITE = "nonfinite"
    DIVERGED = "diverged"
    OUT_OF_MEMORY = "out_of_memory"
    TIMEOUT = "timeout"
    ERROR = "error"


@dataclass(frozen=True, slots=True, kw_only=True)
class Volume:
    """A reconstruction: `values` float32 [z, y, x] in 1/mm on the geometry's grid, and how it ended.

    `at_energy` gives the attenuation at an energy (keV), as `values`, where the method knows how it depends on energy.
    """

    values: "torch.Tensor"
    status: Status = Status.OK
    reason: str = ""
    details: dict[str, Any] = field(default_factory=dict)
    at_energy: "Callable[[float], torch.Tensor] | None" = None
