"""The splats' polychromatic response against float64, closed forms and its own invariances."""

import dataclasses
import json
import math
from typing import get_args

import numpy as np
import pytest
from by_threads import one_and_several

from ctsim.beam.quadrature import full_rule
from ctsim.beam.spectrum import Filter, Spectrum, Tube, spectrum
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.materials import attenuation
from ctsim.reconstruct.splat.kernels import response_reference as reference
from ctsim.reconstruct.splat.response import (
    SCINTILLATOR,
    Basis,
    Name,
    basis_functions,
    evaluate,
    make_response,
    tangent,
    theta_gradient,
    theta_sums,
)

E_MAX = 90.0
NAMES = get_args(Name)
CASES = [(n, b) for n in NAMES for b in get_args(Basis) if (n, b) != ("sinh", "klein-nishina")]
LEARNED = ["paper", "hinge", "tube", "gmm", "free"]
# exp_minus is within 4e-7 relative, the logarithm within 2e-7, P itself is rounded a few times to 6e-8
NEAR = 1e-6


def detected():
    rule = full_rule(spectrum(Tube(kvp=E_MAX)), Detector())
    return rule.energies, rule.w1


def build(name, basis: Basis = "paper", **given):
    return make_response(name, e_max=E_MAX, basis=basis, spectrum=detected() if name == "known" else None, **given)


def pixels(shape, seed=1):
    rng = np.random.default_rng(seed)
    la, lb = rng.uniform(0, 6, shape), np.exp(rng.uniform(-8, 4, shape))
    return la.astype(np.float32), lb.astype(np.float32), rng.standard_normal(shape).astype(np.float32)


def exact(response, la, lb):
    return reference.evaluate(response.a, response.b, response.eta, np.ravel(la), np.ravel(lb))


@pytest.mark.parametrize("name, basis", CASES)
def test_the_kernel_agrees_with_float64(name, basis):
    response = build(name, basis)
    assert response.eta.sum() == pytest.approx(1, abs=1e-14)
    for shape in ((5, 7, 11), (61, 73), (1,)):
        la, lb, _ = pixels(shape)
        p, dp_da, dp_db = evaluate(response, la, lb)
        p64, a64, b64 = (v.reshape(shape) for v in exact(response, la, lb))
        assert p.dtype == dp_da.dtype == dp_db.dtype == np.float32
        np.testing.assert_allclose(p, p64, rtol=NEAR, atol=NEAR)
        np.testing.assert_allclose(dp_da, a64, rtol=NEAR)
        np.testing.assert_allclose(dp_db, b64, rtol=NEAR)


@pytest.mark.parametrize("name, basis", CASES)
def test_p_can_be_computed_from_what_is_told_of_a_response(name, basis):
    response = build(name, basis)
    said = json.loads(json.dumps(response.described(), allow_nan=False))
    assert (said["name"], said["basis"], said["e_max"]) == (name, basis, E_MAX)
    assert said["theta"] == list(response.trainable)
    np.testing.assert_array_equal(said["energies_kev"], response.energies_kev)
    la, lb, _ = pixels((61, 73))
    by_hand = sum(
        eta * np.exp(-a * la.astype(np.float64) - b * lb.astype(np.float64))
        for a, b, eta in zip(said["a"], said["b"], said["eta"], strict=True)
    )
    # JSON keeps float64 as it is, so what is left is float32 of `evaluate`: a relative error of the sum, which is an
    # absolute one of its logarithm, and P's own rounding
    np.testing.assert_allclose(evaluate(response, la, lb)[0], -np.log(by_hand), rtol=NEAR, atol=NEAR)


@pytest.mark.parametrize("name, basis", CASES)
def test_extreme_paths_stay_finite_and_right(name, basis):
    response = build(name, basis)
    grid = np.array([0, 1e-30, 1e-6, 1, 30, 1e3], np.float32)
    la, lb = np.meshgrid(grid, np.append(grid, np.float32(1e4)), indexing="ij")
    la, lb = np.append(la, np.float32(-0.1)), np.append(lb, np.float32(-0.01))  # and a little below zero
    for got, expected in zip(evaluate(response, la, lb), exact(response, la, lb), strict=True):
        assert np.all(np.isfinite(got))
        np.testing.assert_allclose(got, expected, rtol=NEAR, atol=NEAR)
    sums = theta_sums(response, la, lb, np.ones_like(la))
    assert np.all(np.isfinite(sums)) and np.all(np.isfinite(response.eta_gradient() @ sums))


@pytest.mark.parametrize("name", NAMES)
def test_phi_rises_from_zero_and_bends_down(name):
    response = build(name)
    lb = np.concatenate([[0.0], np.geomspace(1e-6, 1e4, 400)])
    p, dp_da, dp_db = exact(response, np.zeros_like(lb), lb)
    assert abs(p[0]) < 1e-14  # Σ η = 1 to rounding
    assert np.all(np.diff(p) > 0) and np.all(np.diff(dp_db) < 1e-12)
    np.testing.assert_allclose(dp_da, 1, rtol=1e-13)
    assert dp_db[0] == pytest.approx(response.eta @ response.b)
    low, high = response.b[response.eta > 0].min(), response.b.max()
    assert np.all((dp_db >= low * (1 - 1e-12)) & (dp_db <= high))
    lb32 = lb.astype(np.float32)
    p32, _, slope32 = evaluate(response, np.zeros_like(lb32), lb32)
    assert abs(p32[0]) < NEAR and np.all(np.diff(slope32) <= NEAR * slope32[:-1])


def test_one_node_is_linear():
    response = build("mono")
    la, lb, _ = pixels((7, 11))
    p, dp_da, dp_db = evaluate(response, la, lb)
    np.testing.assert_array_equal(p, la + lb)
    assert np.all(dp_da == 1) and np.all(dp_db == 1)
    # and so is any response whose weight sits at one node, the third one's
    one = np.zeros(10)
    one[2] = 1.0
    hinge = build("hinge", "klein-nishina")
    single = dataclasses.replace(hinge, eta=one)
    p, dp_da, dp_db = evaluate(single, la, lb)
    np.testing.assert_allclose(p, la * hinge.a[2] + lb * hinge.b[2], rtol=3e-7)  # three roundings
    assert np.all(dp_da == np.float32(hinge.a[2])) and np.all(dp_db == np.float32(hinge.b[2]))


@pytest.mark.parametrize("name, basis", CASES)
def test_the_gauge_changes_neither_p_nor_the_read_out(name, basis):
    response, c, d = build(name, basis), 1.7, 0.4
    other = dataclasses.replace(response, b=c * response.b + d * response.a)
    water, metal, length = (0.017, 0.004), (0.05, 0.3), 60.0

    def moved(density):
        return density[0] - d / c * density[1], density[1] / c

    la, lb, _ = (v.astype(np.float64).ravel() for v in pixels((5, 7)))
    np.testing.assert_allclose(exact(other, *moved((la, lb)))[0], exact(response, la, lb)[0], rtol=1e-12, atol=1e-14)
    a_bar, b_bar = tangent(response, water, length)
    a_moved, b_moved = tangent(other, moved(water), length)
    rho_a, rho_b = moved(metal)
    assert a_moved * rho_a + b_moved * rho_b == pytest.approx(a_bar * metal[0] + b_bar * metal[1], rel=1e-12)
    # while what is read at one energy, say Ē = 1 where a = b = 1, does change
    assert abs(rho_a + rho_b - sum(metal)) > 0.1 * sum(metal)
    p, _, _ = evaluate(response, *(v.astype(np.float32) for v in (la, lb)))
    q, _, _ = evaluate(other, *(v.astype(np.float32) for v in moved((la, lb))))
    # rounding La and Lb to float32 moves P by 6e-8·(a|La| + b|Lb|), and ρa may be the difference of larger numbers
    np.testing.assert_allclose(q, p, atol=2e-7 * float(np.max(np.abs(la) + response.b.max() * lb)))


@pytest.mark.parametrize("name, basis", CASES)
def test_derivatives_are_those_of_p(name, basis):
    response, step = build(name, basis), 1e-5
    la, lb, _ = (v.astype(np.float64).ravel() for v in pixels((5, 7, 11)))
    _, dp_da, dp_db = exact(response, la, lb)
    by_a = (exact(response, la + step, lb)[0] - exact(response, la - step, lb)[0]) / (2 * step)
    by_b = (exact(response, la, lb + step)[0] - exact(response, la, lb - step)[0]) / (2 * step)
    # rounding: 1e-14/1e-5; curvature: h²·P'''/6, and P''' in Lb is at most about b_max³/10
    np.testing.assert_allclose(by_a, dp_da, rtol=1e-6)
    np.testing.assert_allclose(by_b, dp_db, rtol=1e-6, atol=step**2 * response.b.max() ** 3 / 60)


@pytest.mark.parametrize("name, basis", [c for c in CASES if c[0] in LEARNED])
def test_theta_s_gradient_is_that_of_p(name, basis):
    start = build(name, basis)
    shift = 0.03 * np.cos(np.arange(len(start.trainable)))  # away from the start's symmetry
    response = start.with_theta(tuple(start.trainable + shift))
    la, lb, g = (v.astype(np.float64).ravel() for v in pixels((5, 7, 11)))
    sums = reference.theta_sums(response.a, response.b, response.eta, la, lb, g)
    gradient, step = response.eta_gradient() @ sums, 1e-5
    np.testing.assert_allclose(response.eta_gradient().sum(1), 0, atol=1e-13)
    numeric = []
    for axis in np.eye(gradient.size) * step:
        up, down = (response.with_theta(tuple(response.trainable + s * axis)) for s in (1, -1))
        numeric.append(g @ (exact(up, la, lb)[0] - exact(down, la, lb)[0]) / (2 * step))
    # 385 terms of about 1, each rounded to 1e-14 of P and divided by the step: 4e-7 at the very worst
    np.testing.assert_allclose(gradient, numeric, rtol=1e-6, atol=1e-6)
    assert np.abs(gradient).max() > 1e-2
    fast = theta_gradient(response, *(v.astype(np.float32) for v in (la, lb, g)))
    parts = reference.theta_sums(response.a, response.b, response.eta, la, lb, -np.abs(g))
    np.testing.assert_allclose(fast, gradient, atol=float(np.max(np.abs(response.eta_gradient()) @ parts)) * 2e-6)


@pytest.mark.parametrize("name, basis", CASES)
def test_theta_sums_agree_with_float64(name, basis):
    response = build(name, basis)
    la, lb, g = pixels((5, 7, 11))
    parts = (response.a, response.b, response.eta, la.ravel(), lb.ravel())
    # an exponent of 60 is off by 4e-7·60/4, more than which hardly any node still counts
    near = 6e-6 * reference.theta_sums(*parts, -np.abs(g.ravel()))
    got = theta_sums(response, la, lb, g)
    assert got.dtype == np.float64 and np.all(np.abs(got - reference.theta_sums(*parts, g.ravel())) <= near)


def test_results_are_bitwise_equal_for_any_number_of_threads():
    response = build("hinge", "klein-nishina")
    la, lb, g = pixels((3, 61, 127))  # several chunks, the last one ragged
    one, several = one_and_several(lambda: (*evaluate(response, la, lb), theta_sums(response, la, lb, g)))
    for first, last in zip(one, several, strict=True):
        np.testing.assert_array_equal(first, last)


def test_the_paper_s_form_goes_negative_and_is_clamped():
    response = build("paper")
    relative = response.energies_kev / 50.0
    assert response.eta.size == 15 and relative[0] == pytest.approx(0.2) and relative[-1] == pytest.approx(1.8)
    # the formula, written again: −0.0006 at Ē = 1.55 and positive at 1.54
    line = 1 - 0.8 * (relative - 0.2) / 0.8
    fading = 1 / (1 + np.exp(relative - 1))
    form = line * fading + 0.2 * (1 - fading)
    assert np.all((form < 0) == (relative > 1.545))
    np.testing.assert_allclose(response.eta, np.maximum(form, 0) / np.maximum(form, 0).sum(), rtol=1e-13)
    assert np.all(response.eta_gradient()[:, form < 0] == 0) and np.all(response.eta >= 0)


def test_fifteen_uniform_nodes_are_far_from_converged_and_ten_of_gauss_are_not():
    # mean κ of the hinge at 90 kVp: an independent sum over 100 000 midpoints
    e = 1 + 0.8 * ((np.arange(100_000) + 0.5) / 50_000 - 1)

    def form(x):
        return 0.2 + 0.8 * 0.05 * np.logaddexp(0, (1 - x) / 0.05) / 0.8

    converged = form(e) @ e**-3 / form(e).sum()
    uniform = np.linspace(0.2, 1.8, 15)
    hinge = build("hinge")
    assert hinge.eta @ hinge.b == pytest.approx(converged, rel=1e-3)  # the bend at the threshold costs 5e-4
    assert converged == pytest.approx(16.26, abs=0.01)
    assert form(uniform) @ uniform**-3 / form(uniform).sum() == pytest.approx(27.46, abs=0.01)
    paper = build("paper")
    assert paper.eta @ paper.b > 30  # with the paper's own form it is 32.3


def test_a_sinh_s_nodes_reproduce_the_closed_form():
    response = build("sinh")
    lb = np.geomspace(1e-3, 24.0, 100)  # P reaches 15
    z = 0.5 * lb
    p, _, _ = exact(response, np.zeros_like(lb), lb)
    np.testing.assert_allclose(p, lb - np.log(np.sinh(z) / z), rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("basis", ["paper", "klein-nishina"])
def test_a_known_spectrum_s_nodes_stand_for_all_of_it(basis):
    """A material is the pair (ρa, ρb) that fits its attenuation best, by least squares weighted with the signal."""
    energies, signal = detected()
    response = build("known", basis)
    assert 5 < response.eta.size < 20 and response.trainable == ()
    functions = np.stack(basis_functions(energies, basis, E_MAX), axis=1)
    root = np.sqrt(signal)
    for name, longest in (("water", 100.0), ("Fe", 10.0)):
        density, *_ = np.linalg.lstsq(functions * root[:, None], attenuation(name, energies) * root, rcond=None)
        assert np.all(density > 0)
        la, lb = np.linspace(0, longest, 101)[:, None].T * density[:, None]
        depth = functions @ density * np.linspace(0, longest, 101)[:, None]
        full = depth.min(1) - np.log(np.exp(depth.min(1)[:, None] - depth) @ signal)
        assert full.max() > 2
        p, _, _ = exact(response, la, lb)
        assert np.abs(p - full).max() <= 1e-4
        fast, _, _ = evaluate(response, la.astype(np.float32), lb.astype(np.float32))
        assert np.abs(fast - full).max() <= 1e-4 + 3 * NEAR * full.max()


@pytest.mark.parametrize("kvp", [60.0, 90.0, 140.0])
def test_the_tube_follows_its_filter(kvp):
    lb = np.append(0.0, np.geomspace(1e-3, 80, 80))
    start = make_response("tube", e_max=kvp)
    for thickness in (0.1, 0.5, 3.0, 20.0):
        behind = Tube(kvp=kvp, model="finkelshtein-pavlova", filters=(Filter(material="Al", thickness=thickness),))
        fine = full_rule(spectrum(behind), SCINTILLATOR)
        full = reference.evaluate(*basis_functions(fine.energies, "paper", kvp), fine.w1, 0 * lb, lb)[0]
        response = start.with_theta((thickness,))
        np.testing.assert_array_equal(response.energies_kev, start.energies_kev)
        assert np.abs(exact(response, 0 * lb, lb)[0] - full)[full < 14.6].max() < 2e-4  # as the docstring says


@pytest.mark.parametrize("kvp", [60.0, 90.0, 140.0])
@pytest.mark.parametrize("thickness", [0.0, 0.05])
def test_a_tube_behind_less_has_nodes_of_its_own(kvp, thickness):
    """P behind water, bone and iron is that of the spectrum from 5 keV on, as the docstring says."""
    filters = (Filter(material="Al", thickness=thickness),) if thickness else ()
    beam = spectrum(Tube(kvp=kvp, model="finkelshtein-pavlova", filters=filters))
    seen = beam.energies >= 5
    beam = Spectrum(energies=beam.energies[seen], weights=beam.weights[seen] / beam.weights[seen].sum())
    fine = full_rule(beam, SCINTILLATOR)
    response = make_response("tube", e_max=kvp, theta=(thickness,))
    assert response.energies_kev.min() > 5 and response.bounds().tolist() == [[thickness, 20]]
    for material in ("water", "cortical_bone", "Fe"):
        mu, few = attenuation(material, fine.energies), attenuation(material, response.energies_kev)
        lengths = np.geomspace(1e-4, 1, 200)[:, None] * 12 / mu.min()
        full, got = (-np.log(np.exp(-lengths * m) @ w) for m, w in ((mu, fine.w1), (few, response.eta)))
        assert np.abs(got - full)[full < 12].max() < 0.02


def test_a_tube_that_starts_thin_may_come_back_to_its_start():
    thin = make_response("tube", e_max=E_MAX, theta=(0.05,))
    there = thin.with_theta((5.0,)).with_theta((0.07,))
    assert there.with_theta((0.05,)).eta.tolist() == thin.eta.tolist()
    with pytest.raises(InputError, match=r"expected a value within \[0.05, 20\], got 0.04"):
        there.with_theta((0.04,))
    with pytest.raises(InputError, match=r"expected a value within \[0.1, 20\], got 0.05"):
        make_response("tube", e_max=E_MAX).with_theta((0.05,))


def test_a_tube_is_seen_by_the_detector_that_is_told():
    counting = Detector(kind="counting")
    told = make_response("tube", e_max=90.0, theta=(0.5,), detector=counting)
    behind = Tube(kvp=90.0, model="finkelshtein-pavlova", filters=(Filter(material="Al", thickness=0.5),))
    fine, lb = full_rule(spectrum(behind), counting), np.geomspace(1e-3, 80, 80)
    full = reference.evaluate(*basis_functions(fine.energies, "paper", 90.0), fine.w1, 0 * lb, lb)[0]
    assert np.abs(exact(told, 0 * lb, lb)[0] - full)[full < 14.6].max() < 2e-4
    with pytest.raises(InputError, match="detector: only for response 'tube', got it with response 'mono'"):
        make_response("mono", e_max=90.0, detector=counting)


def test_klein_nishina_is_the_cross_section():
    # Thomson's limit is 0.665246 b per electron; 0.4927 b at 100 keV (Hubbell et al. 1975, per electron)
    a, b = basis_functions([0.1, 30.0, 50.0, 100.0], "klein-nishina", E_MAX)
    assert a[2] == b[2] == 1
    assert a[3] / a[0] == pytest.approx(0.4927 / (0.665246 * (1 - 2 * 0.1 / 510.999)), rel=2e-4)
    assert b[3] == pytest.approx(1 / 8)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"name": "spline"}, "response must be one of"),
        ({"basis": "water"}, "basis must be one of"),
        ({"e_max": 10.0}, "e_max must be above 10 keV"),
        ({"e_max": math.nan}, "e_max must be above 10 keV"),
        ({"name": "known"}, "needs a spectrum"),
        ({"spectrum": ([50.0], [1.0])}, "no other takes one"),
        ({"name": "known", "spectrum": ([50.0, 95.0], [1.0, 1.0])}, "none above e_max"),
        ({"name": "known", "spectrum": ([50.0, 60.0], [1.0])}, "as many shares"),
        ({"name": "known", "spectrum": ([50.0, 60.0], [1.0, -0.1])}, "non-negative"),
        ({"name": "sinh", "basis": "klein-nishina"}, "must be 'paper'"),
        ({"name": "mono", "nodes": 2}, "nodes must be within 1 … 1"),
        ({"nodes": 1}, "nodes must be within 2"),
        ({"theta": (0.2,)}, "2 parameters, got 1"),
        ({"theta": (1.2, 1.0)}, "within [0, 1], got 1.2"),
        ({"theta": (0.2, math.nan)}, "got nan"),
        ({"name": "free", "nodes": 4, "theta": (0.0,) * 3}, "4 parameters, got 3"),
    ],
)
def test_what_cannot_be_built_says_so(change, words):
    given = {"name": "hinge", "e_max": E_MAX} | change
    with pytest.raises(InputError) as error:
        make_response(given.pop("name"), **given)
    assert words in str(error.value)


def test_images_must_match():
    response, image = build("hinge"), np.zeros((5, 7), np.float32)
    with pytest.raises(InputError, match="float32 of shape"):
        evaluate(response, image, np.zeros((5, 7)))  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="float32 of shape"):
        theta_sums(response, image, image, image[:4])


def test_an_empty_image_gives_an_empty_answer():
    response, image = build("hinge"), np.zeros((0, 7), np.float32)
    assert all(v.shape == (0, 7) for v in evaluate(response, image, image))
    np.testing.assert_array_equal(theta_sums(response, image, image, image), np.zeros(10))
