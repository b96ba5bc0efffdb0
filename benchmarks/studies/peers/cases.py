"""What `run-benchmark peers` measures: scenes, contenders and oracles; its fifth case is in `peer_poly`.

Contenders of a case run in one process on the same number of threads, in turns (A B A B …), after one
run each that is not counted. Seconds are those of whole sweeps over the views; what a contender may
prepare once for a scene (bricks, pose matrices, permuted volumes) is prepared before.
"""

import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from ctsim.benchmarks.engine import apart
from ctsim.benchmarks.engine.host import in_turns
from ctsim.benchmarks.oracles import SIZE, relative, upright_chord, voxelised
from ctsim.benchmarks.studies.peers import catalogue as peer_catalogue
from ctsim.benchmarks.studies.peers import paper as peer_paper
from ctsim.benchmarks.studies.peers import rtk as peer_rtk
from ctsim.benchmarks.studies.peers import xcist as peer_xcist
from ctsim.benchmarks.studies.peers.catalogue import Case
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.phantoms.bodies import Validation
from ctsim.phantoms.body_lung import Lung
from ctsim.phantoms.recipes import build_recipe
from ctsim.phantoms.scanners import preset
from ctsim.plan import present_materials
from ctsim.project import Tracer, path_lengths
from ctsim.reconstruct.fdk import fdk as ours_fdk
from ctsim.simulate import compact
from ctsim.types import Phantom, Scanner
from ctsim.voxelise import attenuation_volume

OURS = "ctsim"
MEASURED = RTK, XCIST = "itk-rtk", "xcist"  # the catalogue's peers that there is code for
FAILED = ("error", "timeout")
FULL, SMALL = 256, 32  # side of grids and detectors
KEV = np.array([50.0])


@dataclass(frozen=True, slots=True, kw_only=True)
class Setup:
    """How large the cases are: grid and detector side `n`, counted runs, threads; which peers are there."""

    n: int = 256
    repeats: int = 5
    threads: int = 2
    versions: Mapping[str, str] = field(default_factory=dict)

    def views(self, case: Case) -> int:
        """Return the number of views, fewer on small grids."""
        return case.views if self.n >= FULL else max(case.views // 15, 2)

    def measures(self, case: Case, peer: str) -> bool:
        """Say whether a peer takes part: the catalogue says so, it is there, and there is code for it."""
        return peer in case.peers and peer in self.versions and peer in MEASURED

    def scanner(self, views: int) -> Scanner:
        """Return the desktop scanner of the bundled suites on n³ voxels and n² pixels."""
        n = self.n
        return preset("skyscan1273", views, (n, n), (n, n, n), SIZE)


class Measurement(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What one contender reached on one scene of a case.

    `seconds` are the counted runs of `views` views each, `warm_up` the first call; `error` is what
    `error_kind` says; `peak_bytes` the resident memory of a process that did only this.
    """

    case: str
    scene: str
    contender: str
    status: str = "ok"
    reason: str = ""
    seconds: tuple[float, ...] = ()
    views: int = 1
    warm_up: float | None = None
    error: float | None = None
    error_kind: str = ""
    peak_bytes: int | None = None
    note: str = ""


def left_out(setup: Setup, case: Case, scene: str) -> list[Measurement]:
    """Return the rows that say which of a case's peers are not measured: how to install them, or that no code can."""
    out = []
    for peer in peer_catalogue.load().peer:
        if peer.name in case.peers and not setup.measures(case, peer.name):
            status, reason = "absent", peer.absence
            if version := setup.versions.get(peer.name):
                status = "not measured"
                reason = f"{peer.distribution} {version} is installed, not measured: this command has no code for it"
            out.append(Measurement(case=case.name, scene=scene, contender=peer.name, status=status, reason=reason))
    return out


# --- 1: path lengths ---------------------------------------------------------------------------------


def path_scenes(n: int) -> dict[str, Phantom]:
    """Return the scenes of case 1: a thorax of three materials, the same with metal, and a plain cylinder."""
    thorax = build_recipe(Lung(n_voxel=(n, n, n), size=SIZE, metal="Fe"), 1)
    bare = thorax.without_metal()
    z = (np.arange(n) + 0.5 - n / 2) * SIZE / n
    y, x = z[:, None], z[None, :]
    disc = np.where(np.hypot(y, x) < 26, 1, 0)
    disc[np.hypot(y, x - 13) < 4] = 2
    disc[np.hypot(y - 9, x + 9) < 3] = 3
    labels = (disc[None] * (np.abs(z) < 27)[:, None, None]).astype(np.uint8)
    cylinder = Phantom(
        labels=labels, materials=("air", "water", "cortical_bone", "Al"), d_voxel=(SIZE / n, SIZE / n, SIZE / n)
    )
    return {
        "lung": compact(bare, present_materials(bare)),
        "lung + Fe": compact(thorax, present_materials(thorax)),
        "cylinder": cylinder,
    }


def paths(setup: Setup) -> list[Measurement]:
    """Case 1: path lengths in all materials at once against Joseph's projector on one material."""
    case = peer_catalogue.case("paths")
    geometry = setup.scanner(setup.views(case)).geometry
    rtk = peer_rtk.Rtk(geometry, setup.threads) if setup.measures(case, RTK) else None
    phantoms = path_scenes(setup.n)
    out = []
    for scene in case.scenes:
        phantom = phantoms[scene]
        contenders: dict[str, Callable[[], object]] = {OURS: partial(_trace_all, Tracer.of(phantom), geometry)}
        if rtk is not None:
            commonest = 1 + int(np.argmax(np.bincount(phantom.labels.ravel())[1:]))
            contenders[RTK] = partial(rtk.project, rtk.volume((phantom.labels == commonest).astype(np.float32)))
        notes = {OURS: f"all of {', '.join(phantom.materials[1:])}", RTK: "Joseph, one material"}
        for name, (first, seconds) in in_turns(contenders, setup.repeats).items():
            timed = {"seconds": seconds, "views": geometry.n_views, "warm_up": first}
            out.append(Measurement(case="paths", scene=scene, contender=name, note=notes[name], **timed))
        out += left_out(setup, case, scene)
    return out


def _trace_all(tracer: Tracer, geometry: Geometry) -> None:
    for view in range(geometry.n_views):
        path_lengths(tracer, geometry, view)


# --- 2: error against closed form --------------------------------------------------------------------


def exact(setup: Setup) -> list[Measurement]:
    """Case 2: relative RMS of line integrals at 50 keV of three rods in a water cylinder, central rays."""
    case = peer_catalogue.case("exact")
    geometry = setup.scanner(setup.views(case)).geometry
    out = []
    for metal in case.metals:
        phantom = build_recipe(Validation(n_voxel=(setup.n, setup.n, setup.n), size=SIZE, metal=metal), 1)
        mu = {m: float(attenuation(m, KEV)[0]) for m in ("water", metal)}
        water, *rods = phantom.solids
        truth = np.empty(geometry.shape)
        for k in range(geometry.n_views):
            truth[k] = mu["water"] * upright_chord(geometry, k, water)
            for rod in rods:
                truth[k] += (mu[metal] - mu["water"]) * upright_chord(geometry, k, rod)
        weights = np.array([mu.get(m, 0.0) for m in phantom.materials])
        variants = {
            f"{OURS}, exact solids": phantom,
            f"{OURS}, exact rods in voxels": voxelised(phantom, geometry, tuple(rods)),
            f"{OURS}, voxels only": voxelised(phantom, geometry, ()),
        }
        integrals: dict[str, NDArray] = {
            name: _integrals(Tracer.of(p), geometry, weights) for name, p in variants.items()
        }
        volume = attenuation_volume(phantom, geometry, mu)
        if setup.measures(case, RTK):
            rtk = peer_rtk.Rtk(geometry, setup.threads)
            integrals[RTK] = rtk.project(rtk.volume(volume))
        if setup.measures(case, XCIST):
            one = np.ones(1)
            integrals[XCIST] = peer_xcist.Xcist(geometry, [volume], one[:, None], KEV, one).project()
        shared = {"case": "exact", "scene": f"{metal} rods in water", "views": geometry.n_views}
        kind = "relative RMS of line integrals"
        notes = {RTK: "Joseph", XCIST: "distance-driven, which averages over the pixel"}
        out += [
            Measurement(contender=name, error=relative(p, truth), error_kind=kind, note=notes.get(name, ""), **shared)
            for name, p in integrals.items()
        ]
        out += left_out(setup, case, shared["scene"])
    return out


def _integrals(tracer: Tracer, geometry: Geometry, mu: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([np.tensordot(mu, path_lengths(tracer, geometry, k), 1) for k in range(geometry.n_views)])


# --- 3: a whole dataset ------------------------------------------------------------------------------


def paper(setup: Setup) -> list[Measurement]:
    """Case 3: scenes of the `paper` suite by make-dataset in a process of its own, start included.

    A scene of the `quick` suite goes before, so that kernels are compiled and cached.
    """
    case = peer_catalogue.case("paper")
    return [_made(scene, case.views) for scene in case.scenes]


def _made(scene: str, views: int) -> Measurement:
    shared = {"case": "paper", "scene": scene, "contender": OURS, "views": views}
    with tempfile.TemporaryDirectory(prefix="ctsim-peers-") as folder:
        runs, said = [], ""
        for suite in ("quick", "paper"):
            start = time.perf_counter()
            done = apart.call(peer_paper.make, suite, str(Path(folder) / suite), scene)
            runs.append(time.perf_counter() - start)
            if done.returncode:
                last = (done.stderr.strip().splitlines() or ["no message"])[-1]
                return Measurement(status="error", reason=f"make-dataset {suite}: {last}", **shared)
            said = done.stdout
        size = sum(f.stat().st_size for f in (Path(folder) / "paper").rglob("*") if f.is_file())
    note = f"{size / 1e6:.0f} MB written, one run"
    return Measurement(seconds=(runs[1],), warm_up=runs[0], peak_bytes=int(said.split()[-1]), note=note, **shared)


# --- 4: FDK ------------------------------------------------------------------------------------------


def fdk(setup: Setup) -> list[Measurement]:
    """Case 4: FDK of exact line integrals at 50 keV; RMSE against the truth where every view sees the voxel."""
    return [one for metal in peer_catalogue.case("fdk").metals for one in _fdk_of_rods(setup, metal)]


def _fdk_of_rods(setup: Setup, metal: str) -> list[Measurement]:
    case = peer_catalogue.case("fdk")
    geometry = setup.scanner(setup.views(case)).geometry
    phantom = build_recipe(Validation(n_voxel=(setup.n, setup.n, setup.n), size=SIZE, metal=metal), 1)
    mu = {m: float(attenuation(m, KEV)[0]) for m in ("water", metal)}
    weights = np.array([mu.get(m, 0.0) for m in phantom.materials])
    p = _integrals(Tracer.of(phantom), geometry, weights).astype(np.float32)
    truth = attenuation_volume(phantom, geometry, mu)
    z, y, x = geometry.voxel_centres()
    seen = np.broadcast_to(np.hypot(y[:, None], x) < 0.98 * min(geometry.fov_radius, SIZE / 2), truth.shape).copy()
    seen[np.abs(z) > SIZE / 4] = False
    last: dict[str, NDArray] = {}

    def run_ours() -> None:
        last[OURS] = ours_fdk(torch.from_numpy(p), geometry).numpy()

    contenders: Mapping[str, Callable[[], object]] = {OURS: run_ours}
    if setup.measures(case, RTK):
        rtk = peer_rtk.Rtk(geometry, setup.threads)
        stack = rtk.stack(p)

        def run_rtk() -> None:
            last[RTK] = rtk.fdk(stack)

        contenders[RTK] = run_rtk
    shared = {"case": "fdk", "scene": f"{metal} rods in water", "views": geometry.n_views, "error_kind": "RMSE (1/mm)"}
    out = []
    for name, (first, seconds) in in_turns(contenders, setup.repeats).items():
        error = float(np.sqrt(np.mean((last[name][seen] - truth[seen]) ** 2, dtype=np.float64)))
        out.append(Measurement(contender=name, seconds=seconds, warm_up=first, error=error, **shared))
    return out + left_out(setup, case, shared["scene"])
