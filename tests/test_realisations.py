from dataclasses import replace

import msgspec
import numpy as np
import pytest

from ctsim.detector.noise import Noise
from ctsim.detector.panel import Blur, Lag
from ctsim.detector.response import Detector
from ctsim.phantoms.scene import build, parse_suite, stream_id
from ctsim.plan import make_plan
from ctsim.realisations import expected
from ctsim.simulate import flat_image, simulate_views

SCENE = """
name = "rods"
seed = 5
phantom = { recipe = "validation", metal = "Al", n_voxel = [16, 16, 16] }
scanner = { preset = "ideal", n_voxel = [10, 12, 12], n_detector = [16, 18], n_views = 8, i0 = 1e4 }
"""
MACHINES = {
    "plain": {},
    "blur and lag": {"detector": Detector(blur=Blur(fwhm=1.5), lag=(Lag(share=0.1, decay=0.6),))},
    "pattern": {"noise": Noise(fixed_pattern=0.05, dead_fraction=0.01)},
    "tigre": {"noise": Noise(model="tigre")},
}


def planned(**changes):
    (scene,) = parse_suite(SCENE)
    phantom, scanner = build(scene), msgspec.structs.replace(scene.resolve(), **changes)
    return make_plan(phantom, scanner, scene.simulation, scene.truth, stream_id(scene)), phantom, scanner


@pytest.mark.parametrize("machine", MACHINES)
def test_a_draw_is_what_the_simulator_writes_for_its_streams(machine):
    plan, phantom, scanner = planned(**MACHINES[machine])
    found = expected(plan, phantom, scanner)
    for name in (plan.stream_id, "another"):
        plan = replace(plan, stream_id=name)
        views = [images for _, images in simulate_views(plan, phantom, scanner)]
        for twin, output in enumerate(("counts", "metal_free/counts")):
            drawn = found.counts(name, twin=bool(twin))
            assert drawn.dtype == scanner.noise.dtype
            assert np.array_equal(drawn, np.stack([view[output] for view in views]))
        assert np.array_equal(found.flat(name), flat_image(plan, scanner))
    assert not np.array_equal(found.counts("one"), found.counts("two"))


def test_the_mean_of_draws_is_the_expectation():
    plan, phantom, scanner = planned(noise=Noise(adc_bits=None, electronic=0.0))
    found, n = expected(plan, phantom, scanner), 64
    m1, m2 = found.moments[0].astype(np.float64)
    mean = np.mean([found.counts(f"draw {k}") for k in range(n)], 0, dtype=np.float64) / scanner.i0
    z = (mean - m1) / np.sqrt(m2 / scanner.i0 / n)
    # the square of a standard normal number has the mean 1 and the variance 2 (4 sigma); float32 counts add 1e-7
    assert abs((z**2).mean() - 1) < 4 * np.sqrt(2 / z.size)


def test_bodies_that_scatter_alike_share_the_errors_of_monte_carlo(monkeypatch):
    scatter = msgspec.structs.replace(planned()[2].scatter, level=3)
    plan, phantom, scanner = planned(scatter=scatter)
    found = expected(plan, phantom, scanner)
    assert [series is not None for series in found.scatter] == [True, True]

    def never(*arguments, **more):
        raise RuntimeError("followed again")

    monkeypatch.setattr("ctsim.simulate.scatter_series", never)
    again = expected(plan, phantom, scanner, found.scatter)
    assert all(np.array_equal(a, b) for a, b in zip(again.moments, found.moments, strict=True))
    with pytest.raises(RuntimeError, match="followed again"):
        expected(plan, phantom, scanner)
