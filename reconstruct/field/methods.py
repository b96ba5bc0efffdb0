"""Neural fields that are told counts alone: "naf", "park" and "field". "polyner" is in `ctsim.baselines.polyner`."""

import functools
from typing import Annotated, Any, Literal

import numpy as np
import torch

from ctsim.geometry import few_views
from ctsim.reconstruct.beam import AssumedDetector, TubeTable, check_tables, refuse_beam, refuse_filtration
from ctsim.reconstruct.field.data import Data
from ctsim.reconstruct.field.fit import Common, Steps
from ctsim.reconstruct.field.physics import Curve, Image, Mono, Park
from ctsim.reconstruct.field.run import Given, Model, Seen, on_cpu, run, truncated
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.panel import without_panel
from ctsim.reconstruct.primary import PanelLight, Scattered, panel_in, primary, scatter_in
from ctsim.reconstruct.settings import about, keywords
from ctsim.reconstruct.splat import fast
from ctsim.reconstruct.splat.common import Energy
from ctsim.reconstruct.splat.course import levels_of
from ctsim.reconstruct.splat.curve import MaterialCurve
from ctsim.reconstruct.splat.level import Data as Level
from ctsim.reconstruct.splat.level import least_met
from ctsim.reconstruct.splat.response import Response, basis_functions, tangent
from ctsim.reconstruct.starved import Below, weights_and_bounds
from ctsim.reconstruct.tv import axis_ratios
from ctsim.types import Scan, Volume

skip = truncated


class Naf(Common, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As `Common`."""


class ParkField(Common, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As `Common`."""


@keywords(Naf)
@on_cpu
@primary
def naf(scan: Scan, settings: Naf) -> Volume:
    """Reconstruct by a field of one attenuation, P = L[μ], in 1/mm; keywords are those of `Naf`.

    After NAF, Zha, Zhang and Li, MICCAI 2022, doi:10.1007/978-3-031-16446-0_42.
    """

    def make(given: Given) -> Model:
        return Model(physics=Mono(grid=given.grid), read=first_output, details={})

    return run(scan, settings, make)


@keywords(ParkField)
@on_cpu
@primary
def park(scan: Scan, settings: ParkField) -> Volume:
    """Reconstruct by two fields, P = L[f] − log(sinh L[g] / L[g]), and return f in 1/mm; keywords as in `ParkField`.

    After Park et al., arXiv:2307.14579: a flat spectrum, in which attenuation is f in the middle and changes by g over
    half of its width.
    """

    def make(given: Given) -> Model:
        return Model(physics=Park(grid=given.grid), read=first_output, details={})

    return run(scan, settings, make)


def first_output(values: torch.Tensor) -> tuple[Image, str]:
    """Read the first output."""
    return values[:, 0].contiguous().numpy(), "one attenuation for all energies"


class Field(Common, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """As `Common`, and the beam as in `splat`'s settings."""

    steps: Steps = 250
    tv: Annotated[float, about("total variation's weight in the loss", "of water", ge=0, le=1000)] = 0.003
    response: Annotated[Literal["tube", "known"], about("beam: assumed, or known from tube and detector")] = "tube"
    filtration: Annotated[fast.Filter | None, about("filtration behind the assumed tube; null: found", "mm Al")] = None
    tube: TubeTable = None
    detector: AssumedDetector = None
    readout: Annotated[Energy | Literal["hardened"], about("energy at which the volume is read")] = "hardened"
    panel: PanelLight = "found"
    scatter: Scattered = "found"

    def __post_init__(self) -> None:
        check_tables(self.tube, self.detector)
        refuse_beam(self.response, self.tube, self.detector)
        refuse_filtration(self.response, self.filtration)

    def of_splat(self) -> fast.Settings:
        """Return the settings of `splat` that assume the same beam."""
        beam = {name: getattr(self, name) for name in ("response", "filtration", "tube", "detector")}
        return fast.Settings(**beam)


@keywords(Field)
@on_cpu
def field(scan: Scan, settings: Field) -> Volume:
    """Reconstruct by a field with the response and the material curve of `splat`, in 1/mm; keywords as in `Field`."""
    panel = panel_in(scan, settings.panel)
    scan, details = without_panel(scan, panel), panel.details() if settings.panel == "found" else {}

    def see(scan: Scan, settings: Field) -> Seen:
        found = scatter_in(scan, settings.scatter)
        details.update(found.details())
        p, clamped = line_integrals(scan, slice(None))
        weights = weights_and_bounds(scan, p.numpy(), ~clamped.numpy(), found, Below.of(scan).noise)
        data = Data(p=p.numpy(), weights=weights, power=2)
        return Seen(data=data, clamped=int(clamped.sum()), scatter=found.mean)

    def make(given: Given) -> Model:
        return _field_model(given, settings, details)

    return run(scan, settings, make, see)


def _field_model(given: Given, settings: Field, readings: dict[str, Any]) -> Model:
    beam = settings.of_splat()
    finest = fast.finer(given.scan.geometry, beam.fineness)
    level = Level(geometry=finest, p=given.data.p, weights=given.data.weights, scatter=given.scatter)
    filtration = fast.find_filtration(levels_of(level, coarse=True), given.scan, beam)
    response = beam.make_response(given.scan.e_max, filtration.value if filtration else beam.assumed)
    curve = MaterialCurve.of(response, fast.rough_length(level, response, least_met(level)))
    physics = curve_physics(given, curve, response, settings.tv)
    read = functools.partial(_read, physics, curve, response, settings.readout)
    details = {"response": response.described(), **readings}
    if filtration is not None:
        details |= {"filtration": filtration.described()}
        details |= {"limitation": filtration.sentence} if filtration.sentence else {}
    at_energy = functools.partial(_read_at, physics, response)
    return Model(physics=physics, read=read, details=details, at_energy=at_energy)


def curve_physics(given: Given, curve: MaterialCurve, response: Response, tv: float) -> Curve:
    """Put a response and a material curve into tensors."""
    return Curve(
        grid=given.grid,
        knots=torch.tensor(curve.knots, dtype=torch.float32),
        densities=torch.tensor(curve.densities, dtype=torch.float32),
        slopes=torch.tensor(curve.slopes, dtype=torch.float32),
        nodes=torch.tensor(np.stack([response.a, response.b], 1), dtype=torch.float32),
        log_eta=torch.log(torch.tensor(np.maximum(response.eta, 1e-30), dtype=torch.float32)),
        ratios=tuple(axis_ratios(given.grid.whole).tolist()),
        water=curve.water,
        tv=tv,
        scatter=given.scatter,
        dark=given.data.weights < 0,
        scales=(curve.water / given.unit,),  # the start is water, as that of splats
    )


def _read(
    physics: Curve, curve: MaterialCurve, response: Response, readout: float | str, values: torch.Tensor
) -> tuple[Image, str]:
    """Read the field as `splat` is read: hardened by its own water, or at an energy."""
    if not isinstance(readout, str):
        return _read_at(physics, response, values, readout), f"at {readout:g} keV"
    length = _typical_length(physics, curve, values)
    weights = tangent(response, curve.of_water, length)
    rho = physics.densities_of(values[:, 0])
    return (rho @ torch.tensor(weights, dtype=rho.dtype)).numpy(), f"hardened by {length:.1f} mm of water"


def _read_at(physics: Curve, response: Response, values: torch.Tensor, kev: float) -> Image:
    a, b = basis_functions(np.array([kev]), response.basis, response.e_max)
    rho = physics.densities_of(values[:, 0])
    return (rho @ torch.tensor([float(a[0]), float(b[0])], dtype=rho.dtype)).numpy()


def _typical_length(physics: Curve, curve: MaterialCurve, values: torch.Tensor) -> float:
    """Return the median water-equivalent path (mm) through what is no metal, of the rays that meet it."""
    geometry = physics.grid.whole
    u = values[:, 0]
    shares = torch.where(u < fast.DENSEST * curve.water, u / curve.water, torch.zeros_like(u))
    views = np.asarray(few_views(geometry.n_views, fast.VIEWS))
    with torch.no_grad():
        paths = physics.grid.project(shares.contiguous(), views).numpy()
    met = paths[paths > fast.SHORTEST * max(geometry.d_voxel)]
    return float(np.median(met)) if met.size else 0.0
