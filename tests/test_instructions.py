"""What is equal on processors with other instructions: paths and draws to the bit, signals to a derived rounding.

Another processor is this one when numba is told to use no more than x86-64 began with (or the least of its kind): no
fused multiply-add, vectors of 128 bits, eight lanes. `CTSIM_INSTRUCTIONS=full` compiles the whole simulator so, which
takes 2 min.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ctsim.detector.noise import Noise, detect, pixel_pattern
from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.splat.columns import LatticeProjector
from ctsim.reconstruct.splat.lattice import Lattice
from ctsim.rng import stream_key
from ctsim.tracer.kernels.ray_cpu import signal
from ctsim.tracer.project import Tracer, path_lengths
from ctsim.types import Phantom

FULL = os.environ.get("CTSIM_INSTRUCTIONS") == "full"
U = 2.0**-24  # of float32
SUITE = """
name = "rods"
phantom = { recipe = "validation", n_voxel = [24, 24, 24], metal = "Fe" }
scanner = { n_views = 3, n_detector = [40, 48], n_voxel = [10, 14, 22] }
truth = { noise_free = true }
"""


def rays():
    """Return lengths [material, ray] in mm, mu [material, node] in 1/mm, and both weights [node]: τ up to 20."""
    r = np.random.default_rng(3)
    lengths = (r.random((5, 4000)) * r.choice([0, 1, 10, 40], (5, 4000))).astype(np.float32)
    return lengths, (r.random((5, 11)) * 0.2).astype(np.float32), *r.random((2, 11)).astype(np.float32)


def measure() -> dict[str, np.ndarray]:
    """Compute what is compared, with the instructions of this process."""
    r = np.random.default_rng(5)
    lengths, mu, w1, w2 = rays()
    n = lengths.shape[1]
    s1, s2 = np.empty((2, n), np.float32)
    rules = mu[None], w1[None], w2[None], np.array([w1.size])
    signal(lengths, n, rules, 0, np.empty(n, np.float32), s1, s2)
    found = {"s1": s1, "s2": s2}
    geometry = Geometry(
        dso=200.0,
        dsd=300.0,
        n_voxel=(8, 8, 8),
        d_voxel=(2.0, 2.0, 2.0),
        n_detector=(30, 34),
        d_detector=(1.0, 1.0),
        n_views=7,
    )
    labels = r.integers(0, 3, (12, 13, 14)).astype(np.uint8)
    tracer = Tracer.of(Phantom(labels=labels, materials=("air", "water", "Fe"), d_voxel=(1.0, 1.1, 1.2)))
    found["paths"] = np.stack([path_lengths(tracer, geometry, k) for k in range(7)])
    density = r.uniform(0.5, 1.5, labels.shape).astype(np.float32)
    tracer = Tracer.of(
        Phantom(labels=labels, materials=("air", "water", "Fe"), d_voxel=(1.0, 1.1, 1.2), density=density)
    )
    found["paths, density"] = np.stack([path_lengths(tracer, geometry, k) for k in range(7)])
    noise = Noise()
    pattern = pixel_pattern((60, 70), noise=noise, scene_id="a")
    m1 = (r.random((60, 70)) ** 8).astype(np.float32)  # from no photon on
    found["counts"] = detect(
        m1, m1 * np.float32(0.9), noise=noise, i0=1e4, key=stream_key("a", "view", 1), pattern=pattern
    )
    found |= splats(geometry, r)
    if FULL:
        found |= simulated()
    return found


def splats(geometry, r) -> dict[str, np.ndarray]:
    """Project a lattice of splats and take images back, all positive, with the lanes of these instructions."""
    lattice = Lattice(geometry=geometry, support=r.random(geometry.n_voxel) < 0.7)
    projector, views = LatticeProjector(geometry, lattice), np.arange(geometry.n_views)
    pictures = r.random((len(views), 2, *geometry.n_detector)).astype(np.float32)
    return {
        "lanes": np.array(WIDTH),
        "projected": projector.pictures(projector.forward(r.random((len(lattice), 2)).astype(np.float32), views)),
        "sums": projector.adjoint(projector.arranged(pictures), views),
    }


def simulated() -> dict[str, np.ndarray]:
    """Simulate a small scan."""
    from ctsim.phantoms.scene import build, parse_suite, stream_id
    from ctsim.plan import make_plan
    from ctsim.simulate import simulate_views

    (scene,) = parse_suite(SUITE)
    plan = make_plan(build(scene), scene.resolve(), scene.simulation, scene.truth, stream_id(scene))
    views = [images for _, images in simulate_views(plan, build(scene), scene.resolve())]
    return {f"full {name}": np.stack([images[name] for images in views]) for name in ("counts", "noise_free")}


@pytest.fixture(scope="module")
def other(tmp_path_factory) -> dict[str, np.ndarray]:
    folder = tmp_path_factory.mktemp("other")
    command = "import sys, numpy; from test_instructions import measure; numpy.savez(sys.argv[1], **measure())"
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, [os.environ.get("PYTHONPATH")])])
    told = {"NUMBA_CPU_NAME": "generic", "NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": paths}
    subprocess.run([sys.executable, "-c", command, folder / "a.npz"], env={**os.environ, **told}, check=True)
    with np.load(folder / "a.npz") as found:
        return dict(found)


@pytest.fixture(scope="module")
def here() -> dict[str, np.ndarray]:
    return measure()


@pytest.mark.slow
def test_paths_and_draws_are_the_same_to_the_bit(here, other):
    """Their kernels let the compiler neither fuse nor reorder."""
    for name in ("paths", "counts"):
        assert np.array_equal(here[name], other[name]), name


def test_signals_are_within_rounding_of_the_formula_on_both(here, other):
    """Σ w·exp(−Σ μ·L) in float64, with the roundings of float32 in whatever order, fused or not."""
    lengths, mu, *weights = (a.astype(np.float64) for a in rays())
    tau = np.einsum("mk,mi->ki", mu, lengths)
    assert 15 < tau.max() < 25
    for name, w in zip(("s1", "s2"), weights, strict=True):
        terms = w[:, None] * np.exp(-tau)
        # τ: a product and a sum for each of m materials, of positive terms. exp: τ·log₂e rounded twice, which counts
        # τ-fold, and four roundings for the polynomial and its own error. The sum over n nodes: a product and n sums.
        each = (len(mu) + 1) * tau + 2 * tau + 4
        bound = U * ((terms * each).sum(0) / terms.sum(0) + mu.shape[1] + 1)
        for found in (here, other):
            assert (np.abs(found[name] / terms.sum(0) - 1) <= bound * (1 + 1e-5)).all()


def test_splats_are_within_rounding_with_lanes_of_another_number(here, other):
    """Weights are the same to the bit, and sums of positive terms, in any order, within a rounding for each."""
    assert other["lanes"] == 8
    for name, terms in (("projected", here["sums"].shape[0]), ("sums", 7 * 12 * 12)):  # a shadow is 11 pixels wide
        assert here[name].any()
        assert (np.abs(here[name].astype(float) - other[name]) <= 2 * terms * U * here[name]).all(), name


@pytest.mark.skipif(not FULL, reason="CTSIM_INSTRUCTIONS=full compiles the whole simulator, which takes 2 min")
def test_a_scan_is_the_same_but_for_rounding(here, other):
    tau, free = here["full noise_free"], other["full noise_free"]
    # as above for both, with up to 5 materials, 16 nodes, a largest node's τ of 3 times the mean's, and the mean of 34
    # sub-rays at edges; and the roundings of the ratio and of the logarithm
    high = np.maximum(tau, 0)
    bound = 2 * U * (8 * 3 * high + 4 + 17 + 34) + 2 * U * np.maximum(high, 1)
    assert (np.abs(tau - free) <= bound).all()
    # a count changes where a draw lies within the signal's rounding of its next value: 1e-3 of the pixels measured
    assert np.mean(here["full counts"] != other["full counts"]) < 0.01
