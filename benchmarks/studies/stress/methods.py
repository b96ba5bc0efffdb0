"""Stress cases of the reconstruction methods: every scene of a suite by every method, variants of `splat` included.

A volume must have the grid's shape, finite values, and status ok (any other needs a sentence, and where no reading is
above the pedestal it must be another). Its values stay within
π·(dso/(dso − r))²·max|P|/pitch, the closed-form bound of FDK: views weigh 2π in all, the ramp's absolute values sum to
1/(2 pitch) and backprojection weighs by the square, r from the axis; a voxel that an iterative method fits to a ray
that crosses half of it stays below that, too. Where the data determine the object, the RMSE over the body, away from
metal, must not exceed 0.7 of an empty volume's, unless the result says what is wrong (its `limitation`). Exact
symmetries are held against the same method on the other scan.
"""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ctsim.benchmarks.methods import SPECTRUM, TABLE, Method, code_version, find
from ctsim.benchmarks.studies.stress.cases import Case, Findings
from ctsim.benchmarks.studies.stress.scans import Example, on_threads, thread_counts
from ctsim.benchmarks.studies.stress.suite import GROUPS, Scene, load
from ctsim.reconstruct.fdk import reconstruct as fdk
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.redundancy import ray_weights
from ctsim.spectrum import TABLE_KVP
from ctsim.types import Scan, Status, Volume

NEAR = 0.7
SAME = 1e-3  # of the greatest value: float32
SAME_BY_DESCENT = 0.03
BOUNDS = {"ibhc": 10.0}  # adds to P what its own volume says of hardening, streaks included
STEPS = 100  # of the published methods, whose own 20000 are hours; they add splats from the 500th on
VARIANTS: dict[str, tuple[dict[str, Any], ...]] = {
    "splat": ({"response": "known"}, {"preset": "paper", "steps": STEPS}, {"preset": "r2", "steps": STEPS})
}
"""Parameters with which a method runs beside its defaults."""
THREADS = Scene(name="usual", what="1, 2 and all threads")


def subjects(names: Sequence[str] = ()) -> list[Method]:
    """Return the methods of these names, by default of the table, each with its variants."""
    chosen = dict.fromkeys(names or TABLE)
    return [find(name, given) for name in chosen for given in ({}, *VARIANTS.get(name, ()))]


def bound(scan: Scan) -> float:
    """Return the greatest value (1/mm) that a volume of a scan may have, as the module's docstring says."""
    g = scan.geometry
    radius = min(ray_weights(g).radius, math.hypot(*g.s_voxel[1:]) / 2)
    pitch = min(g.d_detector[1] * g.dso / g.dsd, *g.d_voxel)
    steepest = float(line_integrals(scan, slice(None))[0].abs().max())
    return math.pi * (g.dso / (g.dso - radius)) ** 2 * steepest / pitch


def under_stress(method: Method, scene: Scene, side: int, found: Findings) -> None:
    """Run a method on a scene and judge what it returns."""
    given, other = scene.scan(side), scene.other(side)
    if _refuses(method, given.scan.e_max):
        found.refused("kvp must be within", lambda: method.reconstruct(given.scan, "cpu"))
        return
    if reason := method.skip(given.scan):
        found.say(f"skipped: {reason}")
        return
    volume = method.reconstruct(_seen(method, given.scan), "cpu")
    values = volume.values.numpy()
    if values.shape != given.scan.geometry.n_voxel:
        found.say(f"the volume has shape {values.shape}, the grid {given.scan.geometry.n_voxel}", holds=False)
        return
    _judge(volume, found, given, scene, BOUNDS.get(method.name, 1.0))
    if method.name in GROUPS["by-mask"] and given.scan.metal is not None and not given.scan.metal.any():
        found.same("without metal its bits and FDK's are", values, fdk(given.scan).values.numpy())
    if other is not None and scene.has_other(method.name):
        found.at_most(
            "off the other form of the scan by", _apart(method, given.scan, values, other.scan), _limit(method)
        )


def _seen(method: Method, scan: Scan) -> Scan:
    """Return the scan as a method gets it: with the true mask only where it declares to be given it."""
    return scan if method.mask == "oracle" else dataclasses.replace(scan, metal=None)


def _apart(method: Method, scan: Scan, values: NDArray[np.float32], other: Scan) -> float:
    """Return how far a volume is from that of the other form, of the latter's greatest value; lengths may differ."""
    factor = scan.geometry.dso / other.geometry.dso
    expected = method.reconstruct(_seen(method, other), "cpu").values.numpy()
    return float(np.abs(values * factor - expected).max() / max(np.abs(expected).max(), 1e-30))


def _limit(method: Method) -> float:
    return SAME_BY_DESCENT if method.name in GROUPS["descent"] else SAME


def _refuses(method: Method, e_max: float) -> bool:
    """Say whether a method of the table takes a spectrum from one that ends below the scan's."""
    return method.name in TABLE and method.inputs == SPECTRUM and e_max > TABLE_KVP[1]


def _judge(volume: Volume, found: Findings, given: Example, scene: Scene, bounds: float) -> None:
    values = volume.values.numpy()
    said = volume.details.get("limitation") or volume.reason
    found.finite("the volume", values)
    named = volume.status is Status.OK or (volume.status is not Status.NONFINITE and bool(volume.reason))
    found.say(str(volume.status), holds=named and not (scene.unlit and volume.status is Status.OK))
    found.at_most("greatest value over its bound", float(np.abs(values).max() / bound(given.scan)), bounds)
    if scene.near and not said:
        found.at_most("error over an empty volume's", given.error(values), NEAR)
    elif given.region.any():
        found.say(f"error over an empty volume's {given.error(values):.2g}")
    if said:
        found.say(f"says: {said}")


def on_any_threads(method: Method, side: int, found: Findings) -> None:
    """Compare the volumes of 1, 2 and all threads."""
    scan = _seen(method, THREADS.scan(side).scan)
    first, *others = thread_counts()
    values = on_threads(first, lambda: method.reconstruct(scan, "cpu").values.numpy())
    for n in others:
        other = on_threads(n, lambda: method.reconstruct(scan, "cpu").values.numpy())
        found.same(f"volumes of {first} and {n} threads are", values, other)


def _expected(method: Method, scene: Scene) -> str:
    bounds = f"{BOUNDS[method.name]:g} times " if method.name in BOUNDS else ""
    words = [f"finite, within {bounds}the bound of values"]
    if scene.unlit:
        words.append("a status other than ok, and its reason")
    if scene.near:
        words.append(f"error ≤ {NEAR:g} of an empty volume's, or its limitation said")
    if scene.has_other(method.name):
        words.append(f"as the other form of the scan to {_limit(method):g}")
    return "; ".join(words)


def cases(suite: Path | None = None, names: Sequence[str] = ()) -> list[Case]:
    """Return every scene of a suite by every method, scene by scene, so that methods share scans."""
    own = code_version(__name__) + code_version("ctsim.phantoms.shapes")
    methods, found = subjects(names), []
    for scene in load(suite):
        for method in methods:
            run, expected = partial(under_stress, method, scene), _expected(method, scene)
            code = own + scene.digest + method.code
            what = scene.what
            case = Case(name=scene.name, subject=method.label, what=what, expected=expected, run=run, code=code)
            found.append(case)
    for method in methods:
        run, bits = partial(on_any_threads, method), "equal to the last bit"
        code = own + method.code
        found.append(Case(name="threads", subject=method.label, what=THREADS.what, expected=bits, run=run, code=code))
    return found
