"""Gradients of projections in the splats against finite differences and float64."""

import dataclasses

import numpy as np
import pytest
from by_threads import one_and_several
from test_splat_project import GEOMETRIES, SMALL, one, splats, with_

from ctsim.errors import InputError
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct.splat.kernels import gradient_reference as reference
from ctsim.reconstruct.splat.kernels.splat_reference import forward_views
from ctsim.reconstruct.splat.model import Splats
from ctsim.reconstruct.splat.project import Projector

PARTS = ["densities", "positions", "scales", "rotations"]
CUTOFF = 8.0  # exp(−32): the gradient knows no cutoff


def projector(name, box=True):
    return Projector(geometry=GEOMETRIES[name], tolerance=np.inf, cutoff=CUTOFF, box=box)


def loss_image(geometry, channels=2, seed=7):
    """Smooth and rough at once, so that all moments count."""
    image = np.zeros((channels, geometry.n_detector[0], geometry.n_detector[1] + WIDTH), np.float32)
    image[..., :-WIDTH] = np.random.default_rng(seed).standard_normal(image[..., :-WIDTH].shape) + 0.5
    return image


def arrays(given):
    return {name: getattr(given, name).astype(np.float64) for name in PARTS}


def analytic(parts, camera, image):
    return reference.gradient(
        parts["positions"], parts["scales"], parts["rotations"], parts["densities"], camera, image.astype(float)
    )


@pytest.mark.parametrize("box", [True, False])
@pytest.mark.parametrize("name", ["centred", "tilted", "5 by 7"])
def test_the_reference_has_the_finite_differences_of_the_projection(name, box):
    seen, geometry = projector(name, box), GEOMETRIES[name]
    parts, image = arrays(splats(4, "ellipsoids", low=1.0)), loss_image(GEOMETRIES[name])
    camera = seen.cameras[1].copy()
    camera[12] = np.inf

    def loss(changed):
        there = np.zeros((1, 2 * geometry.n_detector[0], geometry.n_detector[1] + WIDTH))
        shapes = reference.pack(changed["positions"], changed["scales"], changed["rotations"])
        forward_views(shapes, changed["densities"], camera[None], there)
        return (there.reshape(image.shape) * image).sum()

    for part, gradient in zip(PARTS, analytic(parts, camera, image), strict=False):
        step, largest = 1e-3, np.abs(gradient).max()
        for index in np.ndindex(parts[part].shape):
            sides = []
            for h in (step, -step, 2 * step, -2 * step):
                changed = {key: value.copy() for key, value in parts.items()}
                changed[part][index] = (
                    changed[part][index] * np.exp(h) if part == "scales" else changed[part][index] + h
                )
                sides.append(loss(changed))
            # fourth order: what is left is step⁴/30 of the fifth derivative, about 1e-12, and rounding, 1e-15/step
            numeric = (8 * (sides[0] - sides[1]) - (sides[2] - sides[3])) / (12 * step)
            assert abs(numeric - gradient[index]) < 1e-6 * largest


@pytest.mark.parametrize("box", [True, False])
@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("name", GEOMETRIES)
def test_the_kernel_agrees_with_float64(name, channels, box):
    seen, given = projector(name, box), splats(30, "ellipsoids", low=0.5)
    given = dataclasses.replace(given, densities=np.ascontiguousarray(given.densities[:, :channels]))
    image = loss_image(seen.geometry, channels)
    for view in range(3):
        got = seen.gradient(given, image, view)
        exact = analytic(arrays(given), seen.cameras[view], image)
        fast = (got.densities, got.positions, got.log_scales, got.rotations, got.centres)
        for a, b in zip(fast, (*exact[:4], np.linalg.norm(exact[4], axis=1)), strict=True):
            assert a is not None and a.dtype == np.float32 and a.shape == b.shape
            # weights within 1e-5 of the peak; pixels of either sign cancel in the sums
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-4 * np.abs(b).max())


def test_the_kernel_has_the_finite_differences_of_its_own_projection():
    # few rows, as multiplication from row to row errs by up to 4e-6 and otherwise at every step
    seen, given = projector("5 by 7"), splats(3, "ellipsoids", low=2.0, high=4.0)
    rotations = given.rotations
    assert rotations is not None
    longer = (3 * rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32)
    given = dataclasses.replace(given, rotations=longer)  # a step turns it by less
    image = loss_image(seen.geometry)
    # a smooth loss, whose change over a step is large beside float32's rounding of the image
    image[..., :-WIDTH] = 1 + np.linspace(-1, 1, 7) + np.linspace(-1, 1, 5)[:, None] ** 2
    got = seen.gradient(given, image, 1)

    def loss(changed):
        there = seen.forward(changed.shapes(), changed.densities, [1])[0]
        return (there.astype(float) * image).sum()

    for part, gradient in zip(PARTS, (got.densities, got.positions, got.log_scales, got.rotations), strict=True):
        assert gradient is not None
        for index in np.ndindex(gradient.shape):
            sides, h = [], 0.05
            for step in (h, -h, 2 * h, -2 * h):
                value = getattr(given, part).copy()
                value[index] = value[index] * np.exp(step) if part == "scales" else value[index] + step
                sides.append(loss(dataclasses.replace(given, **{part: value})))
            numeric = (8 * (sides[0] - sides[1]) - (sides[2] - sides[3])) / (12 * h)
            # step⁴/30 is 2e-7 of the fifth derivative; sums of 35 values rounded to 1e-6, over the step
            assert abs(numeric - gradient[index]) < 1e-4 * np.abs(gradient).max()


def test_densities_have_the_adjoint_and_round_splats_the_sum_of_their_scales():
    seen, given = projector("detector offset"), splats(20, "round", low=0.5)
    image = loss_image(seen.geometry)
    got = seen.gradient(given, image, 2)
    sums = seen.adjoint(given.shapes(), image[None], [2])
    np.testing.assert_allclose(got.densities, sums, rtol=0, atol=1e-6 * np.abs(sums).max())
    same = Splats(
        positions=given.positions,
        scales=np.repeat(given.scales, 3, 1),
        densities=given.densities,
        rotations=np.tile(np.array([1, 2, 3, 4], np.float32), (20, 1)),
    )
    other = seen.gradient(same, image, 2)
    assert got.rotations is None and got.log_scales.shape == (20, 1)
    for a, b in ((got.positions, other.positions), (got.log_scales[:, 0], other.log_scales.sum(1))):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * np.abs(b).max())
    # a ball does not turn, and no quaternion changes its length
    assert other.rotations is not None
    assert np.abs(other.rotations).max() < 1e-5 * np.abs(other.log_scales).max()
    ellipsoids = splats(20, "ellipsoids")
    turned, rotations = seen.gradient(ellipsoids, image, 2).rotations, ellipsoids.rotations
    assert turned is not None and rotations is not None
    assert np.abs((turned * rotations).sum(1)).max() < 1e-5 * np.abs(turned).max()


def test_the_tolerance_does_not_matter_and_threads_change_no_bit():
    given, image = splats(300, "ellipsoids"), loss_image(SMALL)

    def gradients():
        got = [Projector(geometry=SMALL, tolerance=t).gradient(given, image, 0) for t in (np.inf, 0.0, 1e-3)]
        return [[getattr(one, field.name) for field in dataclasses.fields(one)] for one in got]

    one, several = one_and_several(gradients)
    for other in (*one[1:], *several):
        assert all(np.array_equal(a, b) for a, b in zip(one[0], other, strict=True))


@pytest.mark.parametrize("value", [0.0, 1e-30, np.nan, np.inf, -np.inf, 1e30])
@pytest.mark.parametrize("what", PARTS)
def test_odd_splats_have_finite_gradients(what, value):
    given = splats(2, "ellipsoids", low=0.5)
    odd = {name: getattr(given, name).copy() for name in PARTS}
    odd[what][0] = value
    seen, image = Projector(geometry=SMALL), loss_image(SMALL)
    got = seen.gradient(Splats(**odd), image, 0)
    alone = seen.gradient(Splats(**{name: array[1:] for name, array in odd.items()}), image, 0)
    for field in dataclasses.fields(got):
        assert np.all(np.isfinite(getattr(got, field.name)))
        assert np.array_equal(getattr(got, field.name)[1], getattr(alone, field.name)[0])


def test_splats_that_are_not_seen_have_no_gradient_and_wrong_input_is_refused():
    seen, image = Projector(geometry=with_(n_views=1)), loss_image(SMALL, 1)
    for place in ([300, 40, 0], [0, 0, 500]):
        got = seen.gradient(one(place, [1, 2, 3], (1, 2, 3, 4)), image, 0)
        assert not any(np.any(getattr(got, field.name)) for field in dataclasses.fields(got))
    assert len(seen.gradient(splats(0, "round"), loss_image(SMALL), 0).densities) == 0
    with pytest.raises(InputError, match="images must be float32"):
        seen.gradient(splats(2, "round"), image, 0)
    with pytest.raises(InputError, match="views must lie within"):
        seen.gradient(splats(2, "round"), loss_image(SMALL), 1)
