"""What a scene needs, what it does not, and what that costs: decided once, printed, then obeyed.

A short survey traces a coarse detector in a few views. It tells which materials are met and how thick
they are, hence how many energies reach the tolerance, and how fast this machine traces this scene.
"""

import time
from dataclasses import dataclass

import msgspec
import numba
import numpy as np
from numpy.typing import NDArray

from ctsim.detector import response
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.project import Tracer, path_lengths
from ctsim.quadrature import EnergyRule, energy_rule, full_rule
from ctsim.scatter import open_fraction
from ctsim.settings import Simulation, Truth
from ctsim.spectrum import Spectrum, spectrum
from ctsim.types import Phantom, Scanner

SURVEY_VIEWS, SURVEY_PIXELS = 8, 48
THICKNESS_MARGIN = 1.1  # a coarse survey can miss the thickest ray
NODE_SECONDS, NOISE_SECONDS, WRITE_SECONDS = 1.2e-9, 45e-9, 1e-9  # per ray and node, draw, byte; one core
COLUMNS = ("rays", "does", "skips (reason)", "error", "time", "disk")
SUBRAY_COST = 1.0  # extra traced rays per ray in a scene with inserts


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """One thing that is done, or is skipped for a reason."""

    name: str
    runs: bool
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Output:
    """A stack to write: its shape per view, (v, u) or (material, v, u), and its dtype."""

    name: str
    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The work for one scan. `seconds` is an estimate for this machine, the only entry that differs between runs.

    `materials` are those that are met, air first; `error` bounds |ΔP| of the energy quadrature;
    `l0` is the median water-equivalent path of the body in mm.
    """

    stream_id: str
    settings: Simulation
    truth: Truth
    stages: tuple[Stage, ...]
    outputs: tuple[Output, ...]
    materials: tuple[str, ...]
    rule: EnergyRule
    spectrum: Spectrum
    l0: float
    scatter_fraction: float
    n_rays: int
    seconds: float
    flops: float
    disk_bytes: int
    memory_bytes: int

    @property
    def error(self) -> float:
        """Bound on |ΔP| made by the energy quadrature."""
        return self.rule.error

    def runs(self, name: str) -> bool:
        """Say whether a stage is carried out."""
        return any(s.runs for s in self.stages if s.name == name)

    def to_dict(self) -> dict:
        """Return the plan for plan.json."""
        return {
            "stream_id": self.stream_id,
            "simulation": msgspec.to_builtins(self.settings),
            "truth": msgspec.to_builtins(self.truth),
            "stages": [{"name": s.name, "runs": s.runs, "reason": s.reason} for s in self.stages],
            "outputs": [{"name": o.name, "shape": list(o.shape), "dtype": o.dtype} for o in self.outputs],
            "materials": list(self.materials),
            "energies_kev": [float(e) for e in self.rule.energies],
            "weights": [float(w) for w in self.rule.w1],
            "quadrature_error": float(self.error),
            "l0_mm": self.l0,
            "scatter_fraction": self.scatter_fraction,
            "rays": self.n_rays,
            "disk_bytes": self.disk_bytes,
            "flops": self.flops,
            "memory_bytes": self.memory_bytes,
            "seconds": self.seconds,
        }

    def table_row(self) -> tuple[str, ...]:
        """Return the cells of a dry run's row, see `COLUMNS`."""
        does = ", ".join(s.name + (f" ({s.reason})" if s.reason else "") for s in self.stages if s.runs)
        skips = ", ".join(f"{s.name} ({s.reason})" for s in self.stages if not s.runs)
        rays, size = f"{self.n_rays / 1e6:.1f} M", f"{self.disk_bytes / 1e6:.0f} MB"
        return rays, does, skips, f"{self.error:.0e}", f"{self.seconds:.0f} s", size

    def text(self) -> str:
        """Return the plan as lines of text."""
        return "\n".join(f"{key:15s} {value}" for key, value in zip(COLUMNS, self.table_row(), strict=True))


def make_plan(phantom: Phantom, scanner: Scanner, simulation: Simulation, truth: Truth, stream_id: str) -> Plan:
    """Decide what simulating this scan takes; `stream_id` names its noise streams."""
    present = present_materials(phantom) if simulation.skip else phantom.materials
    if len(present) == 1 and not phantom.solids:
        raise InputError("the scene is empty: its labels are all air and it has no solids")
    source = spectrum(scanner.tube)
    survey = _survey(phantom, scanner.geometry)
    a1, _ = response(scanner.detector, source.energies)
    mean_energy = float(np.average(source.energies, weights=source.weights * a1))
    thickest = {m: THICKNESS_MARGIN * float(np.max(survey.lengths[k])) for k, m in enumerate(phantom.materials)}
    bowtie = scanner.tube.bowtie
    if bowtie is not None:
        thickest[bowtie.material] = thickest.get(bowtie.material, 0.0) + max(bowtie.center, bowtie.edge)
    met = [m for m in thickest if m != "air"]
    if simulation.skip:
        lengths = [thickest[m] for m in met]
        rule = energy_rule(source, scanner.detector, met, lengths, simulation.tolerance)
    else:
        rule = full_rule(source, scanner.detector)
    outputs = _outputs(phantom, scanner, truth, present)
    fraction = open_fraction(scanner.scatter, scanner.geometry)
    n_rays = int(np.prod(scanner.geometry.shape))
    pixels = float(n_rays)
    per_ray = survey.seconds * (1 + SUBRAY_COST * bool(phantom.solids)) + NODE_SECONDS * len(rule.energies)
    draws = pixels * (2 if _has_twin(phantom, truth) else 1) * (scanner.noise.model != "none")
    disk = _disk_bytes(outputs, scanner.geometry, _has_twin(phantom, truth))
    seconds = (pixels * per_ray + draws * NOISE_SECONDS) / numba.get_num_threads() + disk * WRITE_SECONDS
    return Plan(
        stream_id=stream_id,
        settings=simulation,
        truth=truth,
        stages=_stages(phantom, scanner, truth, present, rule),
        outputs=outputs,
        materials=present,
        rule=rule,
        spectrum=source,
        l0=_median_path(survey, phantom, mean_energy),
        scatter_fraction=fraction,
        n_rays=n_rays,
        seconds=seconds,
        flops=pixels * len(rule.energies) * (2 * len(present) + 16),
        disk_bytes=disk,
        memory_bytes=int(3 * phantom.labels.size + 60 * np.prod(scanner.geometry.n_detector)),
    )


def present_materials(phantom: Phantom) -> tuple[str, ...]:
    """Materials of the phantom that occur in its labels or solids, air first."""
    used = set(np.flatnonzero(np.bincount(phantom.labels.ravel(), minlength=len(phantom.materials))))
    solid = {s.material for s in phantom.solids}
    return tuple(m for k, m in enumerate(phantom.materials) if k == 0 or k in used or m in solid)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Survey:
    """Path lengths [material, view, v, u] of coarse views and the seconds one ray took on one core."""

    lengths: NDArray[np.float32]
    body: NDArray[np.float32]
    seconds: float


def _survey(phantom: Phantom, geometry: Geometry) -> _Survey:
    n = tuple(min(SURVEY_PIXELS, k) for k in geometry.n_detector)
    v, u = (d * k / m for d, k, m in zip(geometry.d_detector, geometry.n_detector, n, strict=True))
    views = np.unique(np.linspace(0, geometry.n_views - 1, min(SURVEY_VIEWS, geometry.n_views)).round().astype(int))
    poses = geometry.pose_array()[views]
    poses[:, 6:9] *= u / geometry.d_detector[1]
    poses[:, 9:] *= v / geometry.d_detector[0]
    coarse = msgspec.structs.replace(
        geometry,
        n_detector=n,
        d_detector=(v, u),
        n_views=len(views),
        angles_deg=None,
        poses=tuple(tuple(float(x) for x in row) for row in poses),
    )
    tracer = Tracer.of(phantom)
    bare = tracer.without_metal()
    path_lengths(tracer, coarse, 0)  # compile
    start = time.perf_counter()
    lengths = np.stack([path_lengths(tracer, coarse, k) for k in range(len(views))], 1)
    seconds = (time.perf_counter() - start) * numba.get_num_threads() / lengths[0].size
    body = np.stack([path_lengths(bare, coarse, k) for k in range(len(views))], 1) if tracer.metal.any() else lengths
    return _Survey(lengths=lengths, body=body, seconds=seconds)


def _median_path(survey: _Survey, phantom: Phantom, energy: float) -> float:
    """Median water-equivalent path (mm) of the rays that meet the metal-free body, at the mean detected energy."""
    at = np.array([energy])
    mu = np.array([0.0, *(float(attenuation(m, at)[0]) for m in phantom.materials[1:])])
    tau = np.tensordot(mu, survey.body, 1)
    met = tau[tau > 0]
    return float(np.median(met) / attenuation("water", at)[0]) if met.size else 0.0


def _has_twin(phantom: Phantom, truth: Truth) -> bool:
    return truth.twin and any(s.metal for s in phantom.solids)


def _outputs(phantom: Phantom, scanner: Scanner, truth: Truth, present: tuple[str, ...]) -> tuple[Output, ...]:
    image = scanner.geometry.n_detector
    counts = np.dtype(scanner.noise.dtype).name
    asked = [Output(name="counts", shape=image, dtype=counts)]
    if truth.noise_free:
        asked.append(Output(name="noise_free", shape=image, dtype="float32"))
    if truth.scatter_free and scanner.scatter.level:
        asked.append(Output(name="scatter_free", shape=image, dtype="float32"))
    asked += [Output(name=f"mono_{e:g}kev", shape=image, dtype="float32") for e in truth.mono_kev]
    twins = [Output(name=f"metal_free/{o.name}", shape=o.shape, dtype=o.dtype) for o in asked]
    asked += twins if _has_twin(phantom, truth) else []
    if any(s.metal for s in phantom.solids):
        if truth.trace:
            asked.append(Output(name="trace", shape=image, dtype="uint8"))
        if truth.metal_path:
            asked.append(Output(name="metal_path", shape=image, dtype="float32"))
    if truth.paths:
        asked.append(Output(name="paths", shape=(len(present) - 1, *image), dtype="float32"))
    return tuple(asked)


def _disk_bytes(outputs: tuple[Output, ...], geometry: Geometry, twin: bool) -> int:
    stacks = sum(int(np.prod(o.shape)) * np.dtype(o.dtype).itemsize for o in outputs) * geometry.n_views
    volumes = int(np.prod(geometry.n_voxel)) * (10 + (9 if twin else 0))
    return stacks + volumes + 4 * int(np.prod(geometry.n_detector))


def _stages(
    phantom: Phantom, scanner: Scanner, truth: Truth, present: tuple[str, ...], rule: EnergyRule
) -> tuple[Stage, ...]:
    metal = any(s.metal for s in phantom.solids)
    stages = [Stage(name=m, runs=True) for m in present[1:]]
    stages += [Stage(name=m, runs=False, reason="absent") for m in phantom.materials if m not in present]
    stages.append(Stage(name=f"{len(rule.energies)} energies", runs=True))
    why = "no solids" if not phantom.solids else ""
    stages.append(Stage(name="sub-rays", runs=not why, reason=why or "edges only"))
    level = scanner.scatter.level
    stages.append(
        Stage(name=f"scatter {level}" if level else "scatter", runs=bool(level), reason="" if level else "off")
    )
    stages.append(Stage(name="heel", runs=scanner.tube.heel, reason="" if scanner.tube.heel else "off"))
    bowtie = scanner.tube.bowtie is not None
    stages.append(Stage(name="bow-tie", runs=bowtie, reason="" if bowtie else "off"))
    noise = scanner.noise.model
    stages.append(Stage(name="noise", runs=noise != "none", reason=noise if noise != "none" else "off"))
    reason = "" if _has_twin(phantom, truth) else ("no metal" if not metal else "not asked")
    stages.append(Stage(name="metal-free twin", runs=not reason, reason=reason))
    for name, asked in (("noise-free", truth.noise_free), ("mono", bool(truth.mono_kev)), ("paths", truth.paths)):
        stages.append(Stage(name=name, runs=asked, reason="" if asked else "not asked"))
    scatter = truth.scatter_free and level > 0
    reason = "" if scatter else ("scatter off" if truth.scatter_free else "not asked")
    stages.append(Stage(name="scatter-free", runs=scatter, reason=reason))
    for name, asked in (("metal trace", truth.trace), ("metal path", truth.metal_path)):
        reason = "not asked" if not asked else ("" if metal else "no metal")
        stages.append(Stage(name=name, runs=not reason, reason=reason))
    return tuple(stages)
