"""The rows of the stress suite: every case with its subject, what is expected of it, and the function that judges it.

Listing them simulates and reconstructs nothing.
"""

import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ctsim.benchmarks.methods import TABLE, Method, code_version, find
from ctsim.benchmarks.studies.stress import limits
from ctsim.benchmarks.studies.stress.suite import Scene, load
from ctsim.quadrature import P_MAX

SIMULATOR, SPLATS = "simulator", "splat kernels"  # subjects that are no methods
MODULES = {name: f"ctsim.benchmarks.studies.stress.{name}" for name in ("simulator", "splats", "methods")}
STEPS = 100  # of the published methods, whose own 20000 are hours; they add splats from the 500th on
VARIANTS: dict[str, tuple[dict[str, Any], ...]] = {
    "splat": ({}, {"response": "known"}),
    "splat-paper": ({"steps": STEPS},),
    "splat-r2": ({"steps": STEPS},),
}
"""Parameters with which a method runs where those are not its defaults alone."""

CLOSED_FORM = f"|ΔP| ≤ {limits.P_SURE:g} of the float64 closed form where P ≤ {P_MAX:g}, finite beyond"
MASS = f"mass on the grid within {limits.MASS:g}"
CHECKS = {
    "ten-photons": "mean count within five standard errors",
    "tungsten-120mm": "the pedestal everywhere",
    "full-scale": "half of the open readings at full scale, none wraps",
    "no-metal": "the bits of the metal-free twin of a body with metal, and no twin",
    "duplicate-views": "equal views have equal bits",
    "450kvp": "the bundled table refuses by name",
}
"""What is expected of the simulator beside the closed form, by scene."""

ODD = "finite, and the other splats keep their bits"
FLAT, NARROW, THREADS = "solids of no thickness", "float32 beside float64", "1, 2 and all threads"
PEAK = f"within {limits.PROJECTED:g} of float64's peak"
BITS = "equal to the last bit"
OWN = {
    SIMULATOR: (
        ("flat-solids", FLAT, "the bits of the scan without them; negative sizes refused", "flat_solids"),
        ("float64", NARROW, f"|ΔP| ≤ {limits.FLOAT32:g}, sub-rays included", "beside_float64"),
        ("threads", THREADS, f"{BITS}, views in any order, too", "same_bits"),
    ),
    SPLATS: (
        ("needles", "needles and discs of 20000:1", f"{PEAK}; finite gradient", "needles"),
        ("sub-pixel", "splats far smaller than a pixel", PEAK, "sub_pixel"),
        ("behind-source", "splats behind, at and next to the source", f"{ODD}; not seen in that view", "behind"),
        ("outside", "splats that no ray meets", f"{ODD}; not seen", "outside"),
        ("empty-set", "no splats", "zeros of the right shapes", "empty"),
        ("nan-seed", "a splat of NaN or infinity", f"{ODD}; not seen, and dropped", "not_finite"),
        ("opaque", "path values up to 1e4", f"the response within {limits.RESPONDED:g} of float64", "opaque"),
        ("float64", NARROW, f"many splats of all shapes {PEAK}", "beside_float64"),
        ("threads", THREADS, f"{BITS}, views in another order, too", "same_bits"),
    ),
    "fdk": (
        ("float64", NARROW, f"closed-form P and FDK in float64 as far off as |ΔP| ≤ {limits.P_SURE:g} allows", "chain"),
    ),
}
"""Case, what it is, what is expected, and the function, of what is no scene."""


class Row(NamedTuple):
    """One row: `run` names a function `(*given, side, found)` as "module:function" that judges it on side³ voxels.

    `subject` is SIMULATOR, SPLATS or a method's label. `code` hashes scene and sources, which decide the result.
    """

    case: str
    subject: str
    what: str
    expected: str
    run: str
    given: tuple[Any, ...]
    code: str


@functools.lru_cache
def catalogue(suite: Path | None = None, methods: tuple[str, ...] = ()) -> dict[tuple[str, str], Row]:
    """Return all rows by (case, subject), those of methods on the scenes of a file; only those of `methods` if named.

    Raises InputError for a file that is wrong and a method that does not exist.
    """
    chosen, names = [*_of_methods(load(suite), methods)], methods or tuple(TABLE)
    own = [] if methods else [*_of_simulator(), *_own(SPLATS, "splats")]
    chain = [*_own("fdk", "methods")] if "fdk" in names else []
    return {(row.case, row.subject): row for row in (*own, *chain, *chosen)}


def subjects(names: Sequence[str] = ()) -> list[tuple[str, dict[str, Any]]]:
    """Return the methods of these names, by default of the table, each with the parameters of its variants."""
    return [(name, given) for name in dict.fromkeys(names or TABLE) for given in VARIANTS.get(name, ({},))]


def label(name: str, given: dict[str, Any]) -> str:
    """Return a method's label without loading the method."""
    return Method(name=name, target="", inputs="", params={}, overrides=given).label


def _own(subject: str, module: str) -> Iterator[Row]:
    code = code_version(MODULES[module])
    for case, what, expected, function in OWN[subject]:
        yield Row(case, subject, what, expected, f"{MODULES[module]}:{function}", (), code)


def _of_simulator() -> Iterator[Row]:
    run, code = f"{MODULES['simulator']}:on_scene", code_version(MODULES["simulator"])
    for scene in load():
        if scene.simulated:
            words = (CLOSED_FORM, MASS if scene.lone else "", CHECKS.get(scene.name, ""))
            expected = "; ".join(filter(None, words))
            yield Row(scene.name, SIMULATOR, scene.what, expected, run, (scene,), code + scene.digest)
    yield from _own(SIMULATOR, "simulator")


def _of_methods(scenes: Sequence[Scene], names: Sequence[str]) -> Iterator[Row]:
    """Yield every scene by every method, scene by scene, so that methods share scans."""
    module = MODULES["methods"]
    methods = [(method, label(*method), code_version(module) + _code(method[0])) for method in subjects(names)]
    for scene in scenes:
        for method, named, code in methods if scene.methods else ():
            expected, given = _expected(method[0], scene), (*method, scene)
            yield Row(scene.name, named, scene.what, expected, f"{module}:on_scene", given, code + scene.digest)
    for method, named, code in methods:
        yield Row("threads", named, THREADS, BITS, f"{module}:on_any_threads", method, code)


def _code(name: str) -> str:
    """Hash a method's sources; those of the table are not loaded for it."""
    return code_version(TABLE[name][0].partition(":")[0]) if name in TABLE else find(name).code


def _expected(name: str, scene: Scene) -> str:
    bounds = f"{limits.BOUNDS[name]:g} times " if name in limits.BOUNDS else ""
    words = [f"finite, within {bounds}the bound of values"]
    if scene.unlit:
        words.append("a status other than ok, and its reason")
    if scene.near:
        words.append(f"error ≤ {limits.NEAR:g} of an empty volume's, or its limitation said")
    if scene.has_other(name):
        words.append(f"as the other form of the scan to {limits.same_of(name):g}")
    return "; ".join(words)
