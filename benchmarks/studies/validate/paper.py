"""The paper's validation of its simulator, repeated: PSNR of −log projections against Monte Carlo scatter and noise.

Three aluminium rods in a water cylinder of 55 mm, 256² pixels, 90 kVp behind 0.5 mm of aluminium, 0.1 mm of GOS,
1e9 photons on the panel. The reference image is the analytic primary, scatter of another stream with a small error,
and compound noise.
"""

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from ctsim import rng
from ctsim.benchmarks.studies.validate.finding import Check, Curves, check
from ctsim.benchmarks.studies.validate.published import numbers
from ctsim.benchmarks.studies.validate.scatter import source_of
from ctsim.detector.noise import Noise, detect
from ctsim.montecarlo.series import scatter_series
from ctsim.phantoms.scene import build, parse_suite
from ctsim.plan import make_plan
from ctsim.scatter import constant_fraction
from ctsim.settings import Simulation, Truth
from ctsim.simulate import compact
from ctsim.tracer.project import Response, Tracer, transmit

Image = NDArray[np.float64]
PHOTONS = 1e9
SIGMAS = 4.0
VIEWS = (0, 20, 40)
REPRODUCED = "an independent reproduction"
# PSNR (dB) of three views that are not known, of this scene by another Monte Carlo code and an older detector model
OTHERS = {
    "without scatter": (32.85, 32.36, 32.38), "level 1": (40.3, 40.1, 39.7), "noise alone": (40.5, 40.6, 40.1),
}  # fmt: skip
SCENE = """
name = "paper"
seed = 1
phantom = {{ recipe = "validation", metal = "Al", n_voxel = [32, 32, 32] }}
scanner = {{ n_detector = [{n}, {n}], n_views = 60 }}
"""


def paper(short: bool) -> list[Check]:
    """Return the PSNR of each model of scatter, view by view."""
    (scene,) = parse_suite(SCENE.format(n=64 if short else 256))
    phantom, scanner = build(scene), scene.resolve()
    plan = make_plan(phantom, scanner, Simulation(), Truth(twin=False), "validate")
    body, geometry = compact(phantom, plan.materials), scanner.geometry
    usual, fine = (0.05, 0.03) if short else (0.02, 0.005)
    level3, true = (
        scatter_series(body, source_of(scanner), geometry, tolerance=tolerance, stream=stream)
        for stream, tolerance in (("one", usual), ("other", fine))
    )
    tracer, i0 = Tracer.of(body), PHOTONS / math.prod(geometry.n_detector)
    response = Response.of(plan.rule, tracer.materials)
    found = []
    for k in VIEWS:
        m1, m2 = (image.astype(np.float64) for image in transmit(tracer, geometry, k, response))
        s1, s2 = (image.astype(np.float64) for image in true.view(k))
        key = rng.stream_key("validate", "paper", k)
        noise = Noise(electronic=0.0, adc_bits=None)
        drawn = detect(m1 + s1, m2 + s2, noise=noise, i0=i0, key=key).astype(np.float64) / i0
        models = {
            "without scatter": m1,
            "level 1": m1 + constant_fraction(geometry),
            "level 3": m1 + level3.view(k)[0],
            "noise alone": m1 + s1,
        }
        reference, top = _log(drawn, i0), float(_log(m1, i0).max())
        psnr = {name: _psnr(_log(image, i0), reference, top) for name, image in models.items()}
        from_noise = (m2 + s2) / (i0 * (m1 + s1) ** 2)  # Var(−ln x) = Var(x)/x²
        error = float(np.hypot(level3.error, true.error) * s1.mean())
        found += _rows(k, psnr, top, from_noise, (error / float((m1 + s1).min())) ** 2)
        if k == VIEWS[0]:
            found[-1] = _with_profile(found[-1], models | {"reference": drawn}, i0)
    return found


def _rows(k: int, psnr: dict[str, float], top: float, noise: Image, scatter: float) -> list[Check]:
    """Return the checks of a view.

    `noise` is the mean squared error of each pixel's P by noise, `scatter` the most that the image can have by scatter:
    all of the error that the series state where the signal is least.
    """
    theirs = numbers().paper
    others = {name: f"{REPRODUCED}: {', '.join(map(str, values))}" for name, values in OTHERS.items()}
    level1 = float(np.mean(OTHERS["level 1"]))
    expected = 20 * math.log10(top) - 10 * math.log10(noise.mean())
    # the sum of the squares of normal numbers of variance v has the variance 2·Σv²; the logarithm's next order is v²
    square = float((noise**2).sum())
    sampling = 10 * math.log10(1 + (SIGMAS * math.sqrt(2 * square) + 3 * square) / noise.sum())
    # the error of scatter, and its product with the noise, of variance 4·Σv·error²
    product = SIGMAS * 2 * math.sqrt(scatter * float(noise.sum()))
    of_series = 10 * math.log10(1 + (scatter * noise.size + product) / noise.sum())
    found = [
        check(f"PSNR without scatter, view {k}", psnr["without scatter"], theirs.psnr, unit="dB", relative=False,
              source=f"{theirs.source}; {others['without scatter']}"),
        check(f"PSNR of level 1, view {k}", psnr["level 1"], level1, unit="dB", relative=False,
              source=others["level 1"]),
        check(f"PSNR of the noise alone, view {k}", psnr["noise alone"], expected, unit="dB", relative=False,
              tolerance=sampling, why="4 σ of sampling",
              source=f"closed form; {others['noise alone']}"),
        check(f"PSNR of level 3, view {k}", psnr["level 3"], psnr["noise alone"], unit="dB", relative=False,
              tolerance=of_series,
              why="errors that both series state, where the signal is least", source="noise alone"),
    ]  # fmt: skip
    return found


def _log(image: Image, i0: float) -> Image:
    """Return −ln of the signal, at least half a photon."""
    return -np.log(np.maximum(image, 0.5 / i0))


def _psnr(image: Image, reference: Image, top: float) -> float:
    """Return the PSNR in dB over the largest P of the primary."""
    return float(20 * math.log10(top) - 10 * math.log10(((image - reference) ** 2).mean()))


def _with_profile(one: Check, models: dict[str, Image], i0: float) -> Check:
    """Return the check with profiles of P through the middle row."""
    row = models["reference"].shape[0] // 2
    lines = {name: tuple(_log(image[row], i0).tolist()) for name, image in models.items() if name != "noise alone"}
    n = models["reference"].shape[1]
    curves = Curves(title="view 0, middle row", across="pixel", up="P", x=tuple(range(n)), lines=lines)
    return msgspec.structs.replace(one, curves=(curves,))
