"""Carry out a plan: counts and the ground truth asked for, view by view.

Nothing here grows with the number of views. A view depends on its own index only, and with lag on that of a few views
before it, which are made again where a run that was interrupted goes on. It gives the same bytes.
"""

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numba
import numpy as np
from numpy.typing import NDArray

from ctsim.beam.quadrature import effective_weights
from ctsim.beam.spectrum import bowtie_thickness, heel_factor
from ctsim.detector.noise import flat_field, largest_p, pixel_pattern
from ctsim.detector.response import response
from ctsim.geometry import Geometry
from ctsim.look import density_levels
from ctsim.materials import attenuation
from ctsim.montecarlo.series import ScatterSeries, scatter_series
from ctsim.montecarlo.transport import Source
from ctsim.plan import Plan
from ctsim.readout import Image, Moments, Readout, panel_of
from ctsim.scaninfo import TWIN
from ctsim.signals import Part, Signals, compact, share_rays
from ctsim.tracer.kernels.raytrace_cpu import STRIP
from ctsim.tracer.voxelise import Cover, body_attenuation, body_labels, cover_of, label_volume, metal_mask, painted
from ctsim.types import Phantom, Scanner

Scattered = Sequence[ScatterSeries | None]
REFERENCE_KEV = 50.0  # centre of 10–90 keV


def undivided(phantom: Phantom, plan: Plan) -> Phantom:
    """Return a phantom of the plan's materials with the levels of density put together: labels of `plan.told`."""
    if plan.told == plan.materials:
        return phantom
    table = np.array([plan.told.index(m) for m in plan.tissues], np.uint8)
    return replace(phantom, labels=table[phantom.labels], materials=plan.told)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Beam:
    """What reaches the detector without the object: intensity and layer per pixel, [v, u]."""

    gain: Image | None
    layer: Image | None
    layer_material: str | None
    open1: Image
    open2: Image


def _beam(plan: Plan, scanner: Scanner) -> _Beam:
    tube, geometry = scanner.tube, scanner.geometry
    n_v, n_u = geometry.n_detector
    v = (np.arange(n_v) - (n_v - 1) / 2) * geometry.d_detector[0] + geometry.off_detector[0]
    u = (np.arange(n_u) - (n_u - 1) / 2) * geometry.d_detector[1] + geometry.off_detector[1]
    gain = layer = name = None
    if tube.heel:
        # the anode–cathode axis is the rotation axis, so the heel runs along v
        gain = np.repeat(heel_factor(tube, np.arctan2(v, geometry.dsd))[:, None], n_u, 1).astype(np.float32)
    if tube.falloff:
        # 1/r² and the cosine of the slant, over those at the foot of the perpendicular from the source
        slant = np.cos(np.arctan(np.hypot(v[:, None], u) / geometry.dsd)) ** 3
        gain = (slant if gain is None else gain * slant).astype(np.float32)
    shape, w1, w2 = (n_v, n_u), float(plan.rule.w1.sum()), float(plan.rule.w2.sum())
    open1, open2 = np.full(shape, w1, np.float32), np.full(shape, w2, np.float32)
    if tube.bowtie is not None:
        name = tube.bowtie.material
        slant = np.hypot(1.0, v / geometry.dsd)[:, None]
        layer = (bowtie_thickness(tube.bowtie, np.arctan2(u, geometry.dsd))[None, :] * slant).astype(np.float32)
        passed = np.exp(-attenuation(name, plan.rule.energies)[:, None, None] * layer)
        open1 = np.tensordot(plan.rule.w1, passed, 1).astype(np.float32)
        open2 = np.tensordot(plan.rule.w2, passed, 1).astype(np.float32)
    return _Beam(gain=gain, layer=layer, layer_material=name, open1=open1, open2=open2)


def _fold(plan: Plan, phantom: Phantom) -> NDArray[np.float32] | None:
    """Relative density [told, material] of each material in the one it is told as; None where all are themselves."""
    if plan.told == plan.materials:
        return None
    levels, fold = density_levels(phantom), np.zeros((len(plan.told), len(plan.materials)), np.float32)
    for k, (name, base) in enumerate(zip(plan.materials, plan.tissues, strict=True)):
        fold[plan.told.index(base), k] = levels[name][1]
    return fold


def part_of(plan: Plan, phantom: Phantom, scanner: Scanner) -> Part:
    """Return what decides whether a scan is a variant of another one."""
    beam = _beam(plan, scanner)
    return Part(plan=plan, phantom=phantom, scanner=scanner, layer=beam.layer, layer_material=beam.layer_material)


def scatter_of(plan: Plan, phantom: Phantom, scanner: Scanner) -> Scattered:
    """Follow photons through the phantom and, where there is a twin, without its metal; None at levels other than 3."""
    body = compact(phantom, plan.materials)
    bodies = [body, body.without_metal()] if any(o.name == f"{TWIN}counts" for o in plan.outputs) else [body]
    if scanner.scatter.level != 3:
        return [None] * len(bodies)
    beam = _beam(plan, scanner)
    source = Source(
        spectrum=plan.spectrum,
        detector=scanner.detector,
        n_detector=scanner.geometry.n_detector,
        gain=beam.gain,
        layer=beam.layer,
        layer_material=beam.layer_material,
        grid_ratio=scanner.scatter.grid_ratio or 0.0,
    )
    tolerance, stream = plan.settings.scatter_error, plan.stream_id
    return [scatter_series(each, source, scanner.geometry, tolerance=tolerance, stream=stream) for each in bodies]


class Simulator:
    """One scan being simulated; holds what the views share.

    `scatter` is that of `scatter_of` where it is known already, as of a body that scatters alike. `signals` are those
    that the scan shares with its variants, and its place among these (`ctsim.signals.share_rays`).
    """

    def __init__(
        self,
        plan: Plan,
        phantom: Phantom,
        scanner: Scanner,
        scatter: Scattered | None = None,
        signals: tuple[Signals, int] | None = None,
    ) -> None:
        self.plan, self.scanner, self.geometry = plan, scanner, scanner.geometry
        self.beam = _beam(plan, scanner)
        self.fold = _fold(plan, phantom)
        ((self.signals, self.variant),) = (
            share_rays([part_of(plan, phantom, scanner)]) if signals is None else [signals]
        )
        self.metal = np.array([any(s.metal and s.material == m for s in phantom.solids) for m in plan.materials])
        self.names = {o.name for o in plan.outputs}
        self.readout = Readout(scanner, plan.stream_id)
        self.panel = self.readout.panel
        beam = self.beam
        opened = beam.open1, beam.open1 if beam.gain is None else beam.open1 * beam.gain
        self.opened, self.lit_open = opened if self.panel is None else map(self.panel.spread, opened)
        self.scatter = scatter_of(plan, phantom, scanner) if scatter is None else scatter
        self.largest = self._largest_p() if scanner.noise.model == "tigre" else [math.nan] * 2

    @property
    def frames(self) -> int:
        """How many earlier views a view depends on."""
        return 0 if self.panel is None else self.panel.frames

    def view(self, k: int) -> dict[str, NDArray]:
        """Everything the plan wants of view k. With lag, views come in order."""
        scan, twin, spans = self.signals.moments(k, self.variant)
        lit = self._lit(scan, k, 0)
        out = self._images(scan, lit)
        out["counts"], drawn = self.readout.counts(lit, k, largest=self.largest[0])
        if twin is not None:
            lit = self._lit(twin, k, 1)
            images = self._images(twin, lit, TWIN)
            # scatter of its own makes every pixel of the twin another
            known = None if spans is None or self.scatter[1] else (drawn.copy(), spans)
            images["counts"], _ = self.readout.counts(lit, k, TWIN, largest=self.largest[1], known=known)
            out |= {f"{TWIN}{name}": image for name, image in images.items()}
        return out | self._paths(k)

    def expected(self, k: int) -> list[Moments]:
        """Return the noise-free moments of what reaches the detector in view k of the scan, and of its twin if any."""
        signals = [moments for moments in self.signals.moments(k, self.variant)[:2] if moments is not None]
        return [self._lit(moments, k, which) for which, moments in enumerate(signals)]

    def _largest_p(self) -> list[float]:
        """Largest P that is read without noise in all views: of the scan and of its twin."""
        largest = [0.0, 0.0]
        for k in range(self.geometry.n_views):
            for which, lit in enumerate(self.expected(k)):
                largest[which] = max(largest[which], largest_p(lit[0]))
        return largest

    def _lit(self, moments: Moments, k: int, which: int) -> Moments:
        """Return the moments of what reaches the detector in view k of the scan (0) or its twin (1), with scatter."""
        m1, m2 = moments
        if self.beam.gain is not None:
            m1, m2 = m1 * self.beam.gain, m2 * self.beam.gain
        if (series := self.scatter[which]) is not None:
            s1, s2 = series.view(k)
            return m1 + s1, m2 + s2
        s = self.plan.scatter_fraction
        if s:
            # scattered photons carry the open field's spectrum, and come from all over the object: no heel of a pixel's
            m1, m2 = m1 + np.float32(s), m2 + np.float32(s * self.plan.rule.w2.sum())
        return m1, m2

    def _told(self, lengths: NDArray[np.float32]) -> NDArray[np.float32]:
        """Put lengths [material, v, u] in levels of density together, as lengths at nominal density."""
        return lengths if self.fold is None else np.tensordot(self.fold, lengths, 1)

    def _images(self, moments: Moments, lit: Moments, prefix: str = "") -> dict[str, NDArray]:
        """Return the noise-free images that were asked for, of the moments without and with scatter."""
        m1, out = moments[0], {}
        if "scatter_free" in self.names:
            out["scatter_free"] = -np.log(self._read(f"{prefix}scatter_free", m1) / self.opened)
        if "noise_free" in self.names:
            seen, opened = self._read(f"{prefix}noise_free", lit[0]), self.lit_open
            if self.beam.gain is not None:
                # behind the anode there is no open field to divide by: what the primary alone would give
                seen, opened = np.where(self.beam.gain > 0, (seen, opened), (m1, self.beam.open1))
            out["noise_free"] = -np.log(seen / opened)
        return out

    def _read(self, name: str, image: Image) -> Image:
        """Return what the panel makes of the next image of a stack."""
        return image if self.panel is None else self.panel.see(name, image)

    def _paths(self, k: int) -> dict[str, NDArray]:
        """Images made from path lengths along the central rays."""
        wanted = {"trace", "metal_path", "paths"} & self.names
        energies = self.plan.truth.mono_kev
        if not wanted and not energies:
            return {}
        lengths = self.signals.paths(k)[: len(self.plan.materials)]
        metal = lengths[self.metal].sum(0)
        all_paths = {"trace": (metal > 0).astype(np.uint8), "metal_path": metal, "paths": self._told(lengths)[1:]}
        out: dict[str, NDArray] = {name: all_paths[name] for name in wanted}
        twin = None
        if f"{TWIN}counts" in self.names and energies:
            twin = self.signals.paths(k, twin=True)
        for energy in energies:
            mu = np.array([0.0, *(attenuation(m, np.array([energy]))[0] for m in self.plan.materials[1:])])
            out[f"mono_{energy:g}kev"] = np.tensordot(mu, lengths, 1).astype(np.float32)
            if twin is not None:
                mono = np.tensordot(mu, twin[: len(mu)], 1).astype(np.float32)
                out[f"{TWIN}mono_{energy:g}kev"] = mono
        return out


@contextlib.contextmanager
def threads_of_view(geometry: Geometry) -> Iterator[None]:
    """Use one thread for views of one strip of rows: nothing is to be shared, and threads that wait spin."""
    before = numba.get_num_threads()
    if geometry.n_detector[0] <= STRIP:
        numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


def simulate_views(
    plan: Plan,
    phantom: Phantom,
    scanner: Scanner,
    first_view: int = 0,
    scatter: Scattered | None = None,
    signals: tuple[Signals, int] | None = None,
) -> Iterator[tuple[int, dict[str, NDArray]]]:
    """Yield (view, images by output name) from `first_view` on; `scatter` and `signals` as `Simulator` takes them.

    Line-integral images (noise_free, scatter_free, mono_…) are P = −ln(signal/open), float32 [v, u];
    metal_path and paths are mm; trace is 1 where the central ray meets metal.
    """
    if first_view == scanner.geometry.n_views:
        return  # a pass over all views, as TIGRE's noise takes, would be for nothing
    simulator = Simulator(plan, phantom, scanner, scatter, signals)
    for k in range(max(0, first_view - simulator.frames), first_view):
        simulator.view(k)  # light of earlier views comes in later ones
    for k in range(first_view, scanner.geometry.n_views):
        with threads_of_view(scanner.geometry):
            images = simulator.view(k)
        yield k, images


def flat_image(plan: Plan, scanner: Scanner) -> Image:
    """Open-field image in counts, pedestal included: float32 [v, u]."""
    beam = _beam(plan, scanner)
    gain = 1.0 if beam.gain is None else beam.gain
    pattern = pixel_pattern(scanner.geometry.n_detector, noise=scanner.noise, scene_id=plan.stream_id)
    panel = panel_of(scanner)
    return flat_field(
        (beam.open1 * np.float32(gain), beam.open2 * np.float32(gain)),
        noise=scanner.noise,
        i0=scanner.i0,
        scene_id=plan.stream_id,
        pattern=pattern,
        spread=None if panel is None else panel.spread,
    )


@dataclass(slots=True)
class SharedTruth:
    """What the true volumes of variants, as `ctsim.signals.same_rays` has them, share; empty before the first."""

    covers: list[Cover] = field(default_factory=list)
    labels: dict[Any, NDArray[np.uint8]] = field(default_factory=dict)
    bodies: dict[Any, NDArray[np.float32]] = field(default_factory=dict)
    present: list[int] = field(default_factory=list)
    """Labels that occur in the body: attenuation of others, as of metal that only solids have, changes nothing."""


def truth_volumes(
    plan: Plan, phantom: Phantom, scanner: Scanner, shared: SharedTruth | None = None
) -> Iterator[tuple[str, NDArray]]:
    """Yield (name, volume) on the reconstruction grid: labels, metal mask, references, and the twin's references.

    `reference_50kev` is μ at 50 keV, `reference_effective` Σ ω(E) μ(E) behind the scene's median
    water-equivalent path, both float32 [z, y, x] in 1/mm. `shared` is what an earlier variant left, and keeps what this
    one draws.
    """
    geometry = scanner.geometry
    energies, omega = effective_weights(plan.spectrum, scanner.detector, plan.l0)
    effective = _reference_mu(plan.materials, energies, omega)
    at_50 = _reference_mu(plan.materials, np.array([REFERENCE_KEV]), np.ones(1))
    body = compact(phantom, plan.materials)
    scans = [("", body)] + ([(TWIN, body.without_metal())] if plan.runs("metal-free twin") else [])
    covers = [] if shared is None else shared.covers
    covers[:] = covers or [cover_of(content, geometry) for _, content in scans]
    yield "metal", metal_mask(body, geometry, covers[0])
    for (prefix, _), volume in zip(scans, _labels(plan, scans, geometry, covers, shared), strict=True):
        yield prefix + "labels", volume
    for name, mu in (("reference_effective", effective), ("reference_50kev", at_50)):
        volume = _body(body, geometry, mu, shared)
        for (prefix, content), cover in zip(scans, covers, strict=True):
            last = content is scans[-1][1] and shared is None
            yield prefix + name, painted(volume if last else volume.copy(), content, mu, cover)


def _labels(
    plan: Plan,
    scans: Sequence[tuple[str, Phantom]],
    geometry: Geometry,
    covers: Sequence[Cover],
    shared: SharedTruth | None,
) -> list[NDArray[np.uint8]]:
    """Return the labels of the scan and of its twin; the body is the same with and without metal."""
    key = tuple(plan.told.index(m) for m in plan.tissues)
    known = {} if shared is None else shared.labels
    if (key, "") not in known:
        mine = body_labels(undivided(scans[0][1], plan), geometry)
        for (prefix, content), cover in zip(scans, covers, strict=True):
            told = undivided(content, plan)
            known[key, prefix] = label_volume(told, geometry, cover if told is content else None, mine.copy())
    return [known[key, prefix] for prefix, _ in scans]


def _body(
    body: Phantom, geometry: Geometry, mu: Mapping[str, float], shared: SharedTruth | None
) -> NDArray[np.float32]:
    """Return the attenuation without solids; of variants, the last two are kept."""
    if shared is None:
        return body_attenuation(body, geometry, mu)
    shared.present = shared.present or np.unique(body.labels).tolist()
    key = tuple(mu[body.materials[label]] for label in shared.present)
    volume = shared.bodies.pop(key) if key in shared.bodies else body_attenuation(body, geometry, mu)
    shared.bodies = dict([*shared.bodies.items()][-1:]) | {key: volume}
    return volume


def _reference_mu(materials: tuple[str, ...], energies: NDArray, omega: NDArray) -> Mapping[str, float]:
    return {m: 0.0 if m == "air" else float(attenuation(m, energies) @ omega) for m in materials}


def scan_info(plan: Plan, phantom: Phantom, scanner: Scanner, scatter: Scattered = ()) -> dict:
    """Return what a reader needs to use the counts; lengths mm, energies keV; "flat" is the open-field image."""
    noise, series = scanner.noise, next(iter(scatter), None)
    a1, _ = response(scanner.detector, plan.spectrum.energies)
    optional: dict[str, Any] = {"notes": list(plan.notes)} if plan.notes else {}
    if phantom.labels.any():  # solids alone are on no grid
        sizes = {"d_voxel": phantom.d_voxel, "off_origin": phantom.off_origin}
        grid = {"n_voxel": list(phantom.labels.shape), **{key: list(map(float, size)) for key, size in sizes.items()}}
        optional["label_grid"] = grid
    return {
        "geometry": msgspec.to_builtins(scanner.geometry),
        "flat": flat_image(plan, scanner),
        "dark": noise.dark,
        "gain": noise.gain(scanner.i0),
        "i0": scanner.i0,
        "view_kerma": plan.dose.view_kerma,
        "scan_kerma": plan.dose.scan_kerma,
        "e_max": float(plan.spectrum.e_max),
        "l0": plan.l0,
        "mean_detected_kev": float(np.average(plan.spectrum.energies, weights=plan.spectrum.weights * a1)),
        "scatter_fraction": plan.scatter_fraction if series is None else series.mean,
        "materials": list(plan.told),
        "metal": sorted({s.material for s in phantom.solids if s.metal}),
        **optional,
    }
