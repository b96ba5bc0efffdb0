"""What a scene needs, what it does not, and what that costs: decided once, printed, then obeyed.

What the rays meet, hence how many energies reach the tolerance and how long a view takes here, comes from `ctsim.look`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import msgspec
import numba
import numpy as np

from ctsim.beam.dose import Dose, dose_of
from ctsim.beam.quadrature import EnergyRule
from ctsim.beam.spectrum import Spectrum, Tube, spectrum
from ctsim.beam.spot import SubSources
from ctsim.detector.panel import response as lag_response
from ctsim.detector.response import Detector
from ctsim.geometry import Geometry
from ctsim.human import human_bytes, human_time
from ctsim.look import Looked, density_levels, look
from ctsim.montecarlo.series import expected_histories
from ctsim.scaninfo import TWIN
from ctsim.scatter import open_fraction
from ctsim.settings import Simulation, Truth
from ctsim.types import Phantom, Scanner

# a draw and core, a byte, a voxel of a scan's labels and references (4.4 s for 2 scans of 256³)
NOISE_SECONDS, WRITE_SECONDS, VOLUME_SECONDS = 15e-9, 1e-9, 130e-9
HISTORY_SECONDS = 1.3e-6  # a core and photon of scatter by Monte Carlo: 0.8 (broccoli) to 1.8 (a head of water)
PLANNING_BYTES = 45_000_000  # of the search for energies
DENSITY_BYTES = 12  # a voxel of a density map's bricks and runs: 9 in large pieces, 21 where four materials mix


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
class Plan(Looked):
    """The work for one scan. `seconds` is an estimate for this machine, the only entry that differs between runs.

    `error` is the greatest error of P = −ln(signal/open) found of the energy quadrature; `scatter_error` is the RMS
    error of scatter by Monte Carlo over its mean, None for other scatter; `scatter_fraction` is the constant of level
    1, whose error is not known. `memory_bytes` estimates the arrays; Python and its libraries take a quarter of a
    gigabyte more.
    """

    stream_id: str
    settings: Simulation
    truth: Truth
    stages: tuple[Stage, ...]
    outputs: tuple[Output, ...]
    spectrum: Spectrum
    beam: str
    dose: Dose
    scatter_fraction: float
    scatter_error: float | None
    n_rays: int
    seconds: float
    flops: float
    disk_bytes: int
    memory_bytes: int

    @property
    def error(self) -> float:
        """Greatest |ΔP| found of the energy quadrature."""
        return self.rule.error

    @property
    def told(self) -> tuple[str, ...]:
        """The materials that labels and path lengths tell apart, air first: those of `tissues`, each once."""
        return tuple(dict.fromkeys(self.tissues))

    def runs(self, name: str) -> bool:
        """Say whether a stage is carried out."""
        return any(s.runs for s in self.stages if s.name == name)

    def to_dict(self) -> dict:
        """Return the plan for plan.json."""
        told = {
            "stream_id": self.stream_id,
            "simulation": msgspec.to_builtins(self.settings),
            "truth": msgspec.to_builtins(self.truth),
            "stages": [{"name": s.name, "runs": s.runs, "reason": s.reason} for s in self.stages],
            "outputs": [{"name": o.name, "shape": list(o.shape), "dtype": o.dtype} for o in self.outputs],
            "materials": list(self.materials),
            "energies_kev": [float(e) for e in self.rule.energies],
            "weights": [float(w) for w in self.rule.w1],
            "quadrature_error": float(self.error),
            "edge_error": self.edge_error,
            "l0_mm": self.l0,
            **({"scatter_fraction": self.scatter_fraction} if self.scatter_error is None else {}),
            "rays": self.n_rays,
            "disk_bytes": self.disk_bytes,
            "flops": self.flops,
            "memory_bytes": self.memory_bytes,
            "seconds": self.seconds,
        }
        if self.scatter_error is not None:
            told["scatter_error"] = self.scatter_error
        if self.spot is not None:
            told["sub_sources"], told["spot_error"] = len(self.spot.weights), self.spot.error
        if self.notes:
            told["notes"] = list(self.notes)
        return told

    def text(self) -> str:
        """Return the plan for people: what is done, what is skipped and why, error, and what it takes."""
        does = "; ".join(s.name + (f" ({s.reason})" if s.reason else "") for s in self.stages if s.runs)
        skipped: dict[str, list[str]] = {}
        for stage in self.stages:
            if not stage.runs:
                skipped.setdefault(stage.reason, []).append(stage.name)
        edges = f", {self.edge_error:.0e} (worst edge pixel looked at)" if self.edge_error else ""
        scatter = f", {self.scatter_error:.0%} of the scatter" if self.scatter_error else ""
        spot = f", {self.spot.error:.0e} of the step (focal spot)" if self.spot else ""
        lines = {
            "does": does,
            "skips": "; ".join(f"{reason}: {', '.join(names)}" for reason, names in skipped.items()),
            "error": f"{self.error:.0e} (energies){edges}{spot}{scatter}",
            "beam": self.beam,
            "dose": self.dose.text(),
            "takes": f"{human_time(self.seconds)}, {human_bytes(self.disk_bytes)} on disk, "
            f"{human_bytes(self.memory_bytes)} of memory, {self.n_rays / 1e6:.3g} M rays, {self.flops / 1e9:.2g} Gflop",
        }
        told = [(key, value) for key, value in lines.items() if value] + [("note", note) for note in self.notes]
        return "\n".join(f"  {key:7s} {value}" for key, value in told)


def make_plan(phantom: Phantom, scanner: Scanner, simulation: Simulation, truth: Truth, stream_id: str) -> Plan:
    """Decide what simulating this scan takes; `stream_id` names its noise streams."""
    return make_plans(phantom, [scanner], simulation, truth, [stream_id])[0]


def make_plans(
    phantom: Phantom, scanners: Sequence[Scanner], simulation: Simulation, truth: Truth, stream_ids: Sequence[str]
) -> list[Plan]:
    """Plan scans of a phantom, as `make_plan` does, whose simulation, truth, geometry and `all_rays` are the same.

    Scans may differ in beam, scatter, dose and noise. What none of these changes is found once for all scans, the rest
    once for each beam.
    """
    beams: dict[tuple[Tube, Detector], Scanner] = {}
    for scanner in scanners:
        beams.setdefault((scanner.tube, scanner.detector), scanner)
    found = look(phantom, list(beams.values()), simulation, twin=_has_twin(phantom, truth))
    looked = dict(zip(beams, found, strict=True))
    return [
        _plan(phantom, scanner, simulation, truth, stream_id, looked[scanner.tube, scanner.detector])
        for scanner, stream_id in zip(scanners, stream_ids, strict=True)
    ]


def _plan(
    phantom: Phantom, scanner: Scanner, simulation: Simulation, truth: Truth, stream_id: str, looked: Looked
) -> Plan:
    """Decide what a scan takes that was looked at."""
    twin = _has_twin(phantom, truth)
    present, tissues = looked.materials, looked.tissues
    outputs = _outputs(any(s.metal for s in phantom.solids), scanner, truth, len(set(tissues)))
    n_rays, n_voxels = int(np.prod(scanner.geometry.shape)), int(np.prod(scanner.geometry.n_voxel))
    draws = n_rays * (2 if twin else 1) * (scanner.noise.model != "none")
    disk = _disk_bytes(outputs, scanner.geometry, twin)
    scatter_error = simulation.scatter_error if scanner.scatter.level == 3 else None
    photons = 0 if scatter_error is None else expected_histories(scanner.geometry, scatter_error)
    passes = 2 if scanner.noise.model == "tigre" else 1  # the first finds the scan's largest P
    passes *= 1 if looked.spot is None else len(looked.spot.weights)
    return Plan(
        stream_id=stream_id,
        settings=simulation,
        truth=truth,
        stages=_stages(phantom, scanner, truth, tissues, looked.rule) + _blurs(scanner, looked.spot),
        outputs=outputs,
        **{item.name: getattr(looked, item.name) for item in fields(Looked)},
        spectrum=spectrum(scanner.tube),
        beam=f"{scanner.tube.text()}; {scanner.detector.text()}",
        dose=dose_of(scanner.tube, scanner.geometry, scanner.i0),
        scatter_fraction=open_fraction(scanner.scatter, scanner.geometry),
        scatter_error=scatter_error,
        n_rays=n_rays,
        seconds=passes * scanner.geometry.n_views * looked.view_seconds
        + draws * NOISE_SECONDS / numba.get_num_threads()
        + n_voxels * (2 if twin else 1) * VOLUME_SECONDS
        + photons * (2 if twin else 1) * HISTORY_SECONDS / numba.get_num_threads()
        + disk * WRITE_SECONDS,
        flops=float(n_rays) * len(looked.rule.energies) * (2 * len(present) + 16),
        disk_bytes=disk,
        memory_bytes=_memory_bytes(phantom, scanner.geometry) + _lag_bytes(scanner, outputs),
    )


def _has_twin(phantom: Phantom, truth: Truth) -> bool:
    return truth.twin and any(s.metal for s in phantom.solids)


def disk_estimate(scanner: Scanner, truth: Truth, *, metal: bool, n_tissues: int) -> int:
    """Return the bytes of a scan of a phantom that is not known: whether with metal, and of how many materials."""
    return _disk_bytes(_outputs(metal, scanner, truth, n_tissues), scanner.geometry, metal and truth.twin)


def _outputs(metal: bool, scanner: Scanner, truth: Truth, n_tissues: int) -> tuple[Output, ...]:
    image = scanner.geometry.n_detector
    counts = np.dtype(scanner.noise.dtype).name
    asked = [Output(name="counts", shape=image, dtype=counts)]
    if truth.noise_free:
        asked.append(Output(name="noise_free", shape=image, dtype="float32"))
    if truth.scatter_free and scanner.scatter.level:
        asked.append(Output(name="scatter_free", shape=image, dtype="float32"))
    asked += [Output(name=f"mono_{e:g}kev", shape=image, dtype="float32") for e in truth.mono_kev]
    twins = [Output(name=f"{TWIN}{o.name}", shape=o.shape, dtype=o.dtype) for o in asked]
    asked += twins if metal and truth.twin else []
    if metal:
        if truth.trace:
            asked.append(Output(name="trace", shape=image, dtype="uint8"))
        if truth.metal_path:
            asked.append(Output(name="metal_path", shape=image, dtype="float32"))
    if truth.paths:
        asked.append(Output(name="paths", shape=(n_tissues - 1, *image), dtype="float32"))
    return tuple(asked)


def _disk_bytes(outputs: tuple[Output, ...], geometry: Geometry, twin: bool) -> int:
    stacks = sum(int(np.prod(o.shape)) * np.dtype(o.dtype).itemsize for o in outputs) * geometry.n_views
    volumes = int(np.prod(geometry.n_voxel)) * (10 + (9 if twin else 0))
    return stacks + volumes + 4 * int(np.prod(geometry.n_detector))


def _memory_bytes(phantom: Phantom, geometry: Geometry) -> int:
    """Peak of the arrays held: those of planning and of a view, or those of the reference volumes."""
    view = (8 * len(phantom.materials) + 60) * int(np.prod(geometry.n_detector))
    radii = [p.radius / min(geometry.d_voxel) for s in phantom.solids for p in s.primitives]
    n_voxels = int(np.prod(geometry.n_voxel))
    sampled = min(n_voxels, int(sum(4.2 * r**3 for r in radii)))  # voxels that solids may fill in part
    volumes = 19 * n_voxels + 24 * sampled
    bricks, held = 3 * phantom.labels.size, phantom.labels.size
    if phantom.density is not None:
        held += phantom.density.nbytes
        bricks += DENSITY_BYTES * int(np.count_nonzero(phantom.labels))
    return held + max(PLANNING_BYTES + bricks + view, volumes)


def _lag_bytes(scanner: Scanner, outputs: tuple[Output, ...]) -> int:
    """Bytes of the earlier views that a panel with lag remembers of each stack that it acts on."""
    stacks = sum(o.name.endswith(("counts", "noise_free", "scatter_free")) for o in outputs)
    return 4 * (lag_response(scanner.detector.lag).size - 1) * stacks * int(np.prod(scanner.geometry.n_detector))


def _stages(
    phantom: Phantom, scanner: Scanner, truth: Truth, tissues: tuple[str, ...], rule: EnergyRule
) -> tuple[Stage, ...]:
    metal = any(s.metal for s in phantom.solids)
    met = {m: tissues.count(m) for m in tissues[1:]}
    stages = [Stage(name=m, runs=True, reason=f"{n} densities" if n > 1 else "") for m, n in met.items()]
    bases = dict.fromkeys(base for base, _ in density_levels(phantom).values())
    stages += [Stage(name=m, runs=False, reason="absent") for m in bases if m not in tissues]
    stages.append(Stage(name=f"{len(rule.energies)} energies", runs=True))
    why = "no solids" if not phantom.solids else ""
    stages.append(Stage(name="sub-rays", runs=not why, reason=why or "edges only"))
    level = scanner.scatter.level
    stages.append(
        Stage(name=f"scatter {level}" if level else "scatter", runs=bool(level), reason="" if level else "off")
    )
    stages.append(Stage(name="heel", runs=scanner.tube.heel, reason="" if scanner.tube.heel else "off"))
    grid = scanner.scatter.grid_ratio
    reason = f"ratio {grid:g}" if grid else "off"
    stages.append(Stage(name="anti-scatter grid", runs=grid is not None, reason=reason))
    bowtie = scanner.tube.bowtie is not None
    stages.append(Stage(name="bow-tie", runs=bowtie, reason="" if bowtie else "off"))
    noise = scanner.noise.model
    why = {"none": "off", "tigre": "tigre, in two passes"}.get(noise, noise)
    stages.append(Stage(name="noise", runs=noise != "none", reason=why))
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


def _blurs(scanner: Scanner, spot: SubSources | None) -> tuple[Stage, ...]:
    """Return the stages that make a scan less sharp or its field less even."""
    tube, detector = scanner.tube, scanner.detector
    points = around = ""
    if spot is not None:
        points = f"{spot.grid[0]} x {spot.grid[1]} sub-sources"
        around = f"{len(spot.weights) - math.prod(spot.grid)} sub-sources"
    widths = [] if detector.blur is None else [detector.blur.fwhm, detector.blur.tail_fwhm]
    light = " and ".join(f"{width:g} mm" for width in widths if width is not None)
    late = f"of the last {lag_response(detector.lag).size - 1} views" if detector.lag else ""
    found = (("falloff", tube.falloff, ""), ("focal spot", tube.focal_spot is not None, points))
    found += (("off-focal", tube.off_focal is not None, around),)
    found += (("detector blur", bool(widths), light), ("lag", bool(late), late))
    return tuple(Stage(name=name, runs=runs, reason=why if runs else "off") for name, runs, why in found)
