"""A look at some rays of a scan, before it is simulated: what they meet, and what measuring them takes.

A short survey (`ctsim.tracer.survey`) tells how thick the materials are that are met, hence how many energies
reach the tolerance, how long a view takes on this machine and how good the edges of the inserts are.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ctsim.beam.quadrature import EnergyRule, energy_rule, full_rule
from ctsim.beam.spectrum import spectrum
from ctsim.beam.spot import SubSources, magnification, sub_sources
from ctsim.detector.response import response
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation, nominal
from ctsim.notes import metal_notes
from ctsim.settings import Simulation
from ctsim.tracer.project import Response, Tracer
from ctsim.tracer.shadow import box_corners, primitive_corners
from ctsim.tracer.survey import survey, trial
from ctsim.types import Phantom, Scanner

THICKNESS_MARGIN = 1.1  # a coarse survey can miss the thickest ray


@dataclass(frozen=True, slots=True, kw_only=True)
class Looked:
    """What a look at some rays of a scan tells, whatever its dose and noise are.

    `materials` are the ones that rays meet, air first; `tissues` names for each the one that it is a level of density
    of, mostly itself. `edge_error` is the largest error of P = −ln(signal/open) found in eight windows at edges of
    inserts, in one view (see `ctsim.tracer.survey`). `spot` holds the points of a focal spot of finite size;
    `edge_error` is that of each point. `l0` is the median water-equivalent path of the body in mm. `view_seconds` is
    what a view took here, without noise. `notes` are those of `ctsim.notes`.
    """

    materials: tuple[str, ...]
    tissues: tuple[str, ...]
    rule: EnergyRule
    l0: float
    edge_error: float
    view_seconds: float
    spot: SubSources | None
    notes: tuple[str, ...]


def look(phantom: Phantom, scanners: Sequence[Scanner], simulation: Simulation, *, twin: bool) -> list[Looked]:
    """Find out what the rays of scans, and of their metal-free twins if there are to be such, meet.

    The scanners have the same geometry and `all_rays`. What is found of each, but for its seconds, is to the last bit
    what is found of it alone. Raises InputError where there is nothing to see, or nothing that sees it.
    """
    present = present_materials(phantom) if simulation.skip else phantom.materials
    if len(present) == 1 and not phantom.solids:
        raise InputError("the scene is empty: its labels are all air and it has no solids")
    geometry, levels = scanners[0].geometry, density_levels(phantom)
    tracer = Tracer.of(phantom, geometry=all_rays(scanners[0]))
    found = survey(tracer, geometry)
    energies = [_mean_energy(scanner) for scanner in scanners]
    rules = [_rule(phantom, scanner, simulation, found.lengths) for scanner in scanners]
    seen = [Response.of(rule, tracer.materials) for rule in rules]
    tried = trial(tracer, geometry, seen, settings=simulation, twin=twin)
    return [
        Looked(
            materials=present,
            tissues=tuple(levels[m][0] for m in present),
            rule=rules[k],
            l0=found.median_path(phantom.materials, energies[k]),
            edge_error=tried[k].edge_error,
            view_seconds=tried[k].seconds,
            spot=_spot(tracer, scanner, simulation),
            notes=metal_notes(phantom, geometry, seen[k], simulation.subrays),
        )
        for k, scanner in enumerate(scanners)
    ]


def all_rays(scanner: Scanner) -> Geometry | None:
    """Return the geometry if its rays are all there are; None where a focal spot has more than one point."""
    spread = scanner.tube.focal_spot is not None or scanner.tube.off_focal is not None
    return None if spread else scanner.geometry


def _mean_energy(scanner: Scanner) -> float:
    """Return the mean energy (keV) of what is detected of the open beam."""
    source = spectrum(scanner.tube)
    a1, _ = response(scanner.detector, source.energies)
    if not (source.weights * a1).any():
        raise InputError("detector: no photon of the tube's spectrum is detected; check threshold, thickness and kvp")
    return float(np.average(source.energies, weights=source.weights * a1))


def _rule(phantom: Phantom, scanner: Scanner, simulation: Simulation, lengths: NDArray[np.float32]) -> EnergyRule:
    """Return the energies for the thickest rays of the survey, `lengths` [material, view, v, u]."""
    source = spectrum(scanner.tube)
    if not simulation.skip:
        return _checked(full_rule(source, scanner.detector), scanner)
    levels, along = density_levels(phantom), dict[str, NDArray[np.float64]]()
    for k, m in enumerate(phantom.materials):
        base, share = levels[m]
        along[base] = along.get(base, 0.0) + share * lengths[k]
    thickest = {m: THICKNESS_MARGIN * float(np.max(length)) for m, length in along.items()}
    bowtie = scanner.tube.bowtie
    if bowtie is not None:
        thickest[bowtie.material] = thickest.get(bowtie.material, 0.0) + max(bowtie.center, bowtie.edge)
    met = [m for m in thickest if m != "air"]
    rule = energy_rule(source, scanner.detector, met, [thickest[m] for m in met], simulation.tolerance)
    return _checked(rule, scanner)


def _spot(tracer: Tracer, scanner: Scanner, simulation: Simulation) -> SubSources | None:
    """Return the points of the focal spot for the part of the object that is nearest to the source."""
    tube, tolerance = scanner.tube, simulation.spot_error
    if tube.focal_spot is None and tube.off_focal is None:
        return None
    low, high = tracer.bricks.box[:3], tracer.bricks.box[3:]
    body = box_corners(low, high)[: int(low[0] <= high[0])]
    points = np.concatenate([body, primitive_corners(tracer.prims)]).reshape(-1, 3)
    return sub_sources(tube.focal_spot, magnification(scanner.geometry, points), tolerance, tube.off_focal)


def _checked(rule: EnergyRule, scanner: Scanner) -> EnergyRule:
    """Return the energies, or raise InputError where the bow-tie lets nothing through."""
    bowtie = scanner.tube.bowtie
    if bowtie is not None:
        # rays slant through it; nothing may vanish in float32, which ends at 1e-38
        thickest = 2 * max(bowtie.center, bowtie.edge)
        if np.exp(-attenuation(bowtie.material, rule.energies) * thickest) @ rule.w1 < 1e-30:
            raise InputError(f"tube.bowtie: {thickest / 2} mm of {bowtie.material} let nothing through")
    return rule


def present_materials(phantom: Phantom) -> tuple[str, ...]:
    """Materials of the phantom that occur in its labels or solids, air first; all of one that is not drawn whole."""
    if phantom.partial:
        return phantom.materials
    solid = {s.material for s in phantom.solids}
    # label by label takes a fifth of the time of counting all of them, which makes each a larger integer first
    return tuple(m for k, m in enumerate(phantom.materials) if k == 0 or m in solid or (phantom.labels == k).any())


def density_levels(phantom: Phantom) -> dict[str, tuple[str, float]]:
    """Return, for each material, the one of the phantom's that it is a level of density of, and its relative density.

    A material of solids is itself, whatever its density.
    """
    solid, found = {s.material for s in phantom.solids}, {}
    for m in phantom.materials:
        base, share = (m, 1.0) if m in solid else nominal(m)
        found[m] = (base, share) if base in phantom.materials else (m, 1.0)
    return found
