import itertools

import numpy as np
import pytest

from ctsim.beam.quadrature import EnergyRule, effective_weights, energy_rule, full_rule, gauss_rule
from ctsim.beam.spectrum import Spectrum, Tube, spectrum
from ctsim.detector.response import Detector, response
from ctsim.errors import InputError
from ctsim.materials import attenuation

MATERIALS = ("water", "cortical_bone", "Al", "Ti", "Fe")
LONGEST = (100.0, 30.0, 20.0, 15.0, 10.0)


def tau(rule: EnergyRule, lengths: np.ndarray, materials=MATERIALS) -> np.ndarray:
    return lengths @ np.array([attenuation(m, rule.energies) for m in materials])


def log_signal(rule: EnergyRule, lengths: np.ndarray, materials=MATERIALS) -> np.ndarray:
    return -np.log(np.exp(-tau(rule, lengths, materials)) @ rule.w1)


def lengths(used: tuple[int, ...], n: int = 400) -> np.ndarray:
    rng = np.random.default_rng(3)  # not the combinations that energy_rule tries
    out = np.zeros((n, len(MATERIALS)))
    out[:, used] = rng.random((n, len(used))) ** 2 * np.array(LONGEST)[list(used)]
    return out


@pytest.mark.parametrize("used", [(0,), (0, 4), (0, 1, 2, 3, 4)])
def test_gauss_converges_geometrically(used: tuple[int, ...]) -> None:
    source = spectrum(Tube())
    fine = full_rule(source, Detector())
    assert fine.energies.size >= 320
    paths = lengths(used)
    exact = log_signal(fine, paths)
    kept = exact <= 14.6
    errors = []
    for n in (6, 8, 10, 12, 14):
        rule = gauss_rule(source, Detector(), n)
        errors.append(float(np.max(np.abs(log_signal(rule, paths) - exact)[kept])))
    assert all(after < before / 2.5 for before, after in itertools.pairwise(errors))
    # The spectrum starts at 5 keV here; the photons below 10 keV cost one to two nodes, see the next test.
    assert errors[2] < 2e-4
    assert errors[3] < 1e-4


@pytest.mark.parametrize("used", [(0,), (0, 4), (0, 1, 2, 3, 4)])
def test_ten_nodes_reach_1e_4_from_10_to_90_keV(used: tuple[int, ...]) -> None:
    source = spectrum(Tube())
    hard = source.energies > 10
    source = Spectrum(energies=source.energies[hard], weights=source.weights[hard] / source.weights[hard].sum())
    fine, rule = full_rule(source, Detector()), gauss_rule(source, Detector(), 10)
    assert fine.energies.size >= 320
    paths = lengths(used)
    exact = log_signal(fine, paths)
    # Random paths find up to 1.5 % more than 1e-4 for all five materials.
    assert np.max(np.abs(log_signal(rule, paths) - exact)[exact <= 14.6]) < 1.02e-4


@pytest.mark.parametrize("tolerance", [1e-3, 1e-4])
@pytest.mark.parametrize("kind", ["gos", "csi", "counting"])
def test_rule_keeps_its_tolerance_on_paths_it_did_not_try(kind: str, tolerance: float) -> None:
    source, detector = spectrum(Tube()), Detector(kind=kind)
    rule = energy_rule(source, detector, MATERIALS, LONGEST, tolerance)
    fine = full_rule(source, detector)
    paths = lengths((0, 1, 2, 3, 4))
    exact = log_signal(fine, paths)
    kept = exact <= 14.6
    assert rule.error <= tolerance
    assert rule.energies.size <= 13
    # What is stated is the greatest of a search, not a bound: two percent are left for what it misses.
    assert np.max(np.abs(log_signal(rule, paths) - exact)[kept]) <= 1.02 * tolerance


def test_smaller_objects_take_fewer_energies() -> None:
    source = spectrum(Tube())
    sizes = [energy_rule(source, Detector(), ["water"], [x], 1e-4).energies.size for x in (0.0, 5.0, 100.0)]
    assert sizes[0] == 1
    assert sizes[0] < sizes[1] < sizes[2]


@pytest.mark.parametrize("kind", ["gos", "ideal", "counting"])
def test_second_moment_is_the_direct_sum(kind: str) -> None:
    source, detector = spectrum(Tube()), Detector(kind=kind)
    rule = energy_rule(source, detector, MATERIALS, LONGEST, 1e-4)
    a1, a2 = response(detector, source.energies)
    paths = lengths((0, 1, 2, 3, 4))
    paths = paths[log_signal(full_rule(source, detector), paths) <= 14.6]
    through = np.exp(-paths @ np.array([attenuation(m, source.energies) for m in MATERIALS]))
    direct = through @ (source.weights * a2) / (source.weights @ a1) ** 2
    # 1 % is what the noise may be off; the rule is 1e-3 at worst, so that 2e-3 would show a fault.
    assert np.exp(-tau(rule, paths)) @ rule.w2 == pytest.approx(direct, rel=2e-3)
    assert rule.w2.min() > 0


def test_rule_is_normalised() -> None:
    source, detector = spectrum(Tube()), Detector()
    a1, a2 = response(detector, source.energies)
    for rule in (full_rule(source, detector), energy_rule(source, detector, ["water"], [50.0], 1e-4)):
        assert rule.w1.sum() == pytest.approx(1)
        assert rule.mean_signal == pytest.approx(source.weights @ a1)
        assert rule.w2.sum() == pytest.approx(source.weights @ a2 / (source.weights @ a1) ** 2)
        assert rule.energies[0] > source.energies[0] - 1e-9
        assert rule.energies[-1] <= source.energies[-1]


def test_gauss_is_exact_on_polynomials() -> None:
    source = Spectrum(energies=np.linspace(10, 70, 7), weights=np.full(7, 1 / 7))
    fine, rule = full_rule(source, Detector()), gauss_rule(source, Detector(), 4)
    for power in range(8):  # a rule with n nodes is exact to degree 2n − 1
        assert rule.w1 @ rule.energies**power == pytest.approx(fine.w1 @ fine.energies**power, rel=1e-11)
    whole = gauss_rule(source, Detector(), 7)
    assert whole.energies == pytest.approx(fine.energies)
    assert whole.w1 == pytest.approx(fine.w1)


def test_k_edge_of_the_object_splits_the_interval() -> None:
    source, detector = spectrum(Tube(kvp=120)), Detector()
    rule = energy_rule(source, detector, ["water", "Au"], [100.0, 1.0], 1e-4)
    fine = full_rule(source, detector)
    paths = np.array(list(itertools.product([0.0, 30, 100], [0.0, 0.1, 0.4, 1.0])))
    exact = log_signal(fine, paths, ("water", "Au"))
    kept = exact <= 14.6
    assert rule.energies.size < 30
    assert np.max(np.abs(log_signal(rule, paths, ("water", "Au")) - exact)[kept]) <= 1.02e-4
    # The same number of nodes without the split is worse by far.
    blind = gauss_rule(source, detector, rule.energies.size)
    assert np.max(np.abs(log_signal(blind, paths, ("water", "Au")) - exact)[kept]) > 3 * rule.error


def test_one_energy_is_one_node() -> None:
    detector = Detector()
    rule = energy_rule(spectrum(Tube(kvp=60, model="mono")), detector, ["Fe"], [10.0], 1e-4)
    a1, a2 = response(detector, [60.0])
    assert rule.energies.tolist() == [60.0]
    assert rule.w1.tolist() == [1.0]
    assert rule.w2 == pytest.approx(a2 / a1**2)
    assert rule.error == 0


def test_effective_weights_harden() -> None:
    source = spectrum(Tube())
    means = []
    for length in (0.0, 60.0, 5000.0):
        e, omega = effective_weights(source, Detector(), length)
        assert omega.sum() == pytest.approx(1)
        means.append(float(e @ omega))
    assert means[0] < means[1] < means[2]
    fine = full_rule(source, Detector())
    assert means[0] == pytest.approx(fine.energies @ fine.w1)


def test_bad_requests_are_refused() -> None:
    source = spectrum(Tube())
    with pytest.raises(InputError, match="one entry per material"):
        energy_rule(source, Detector(), ["water"], [1.0, 2.0], 1e-4)
    with pytest.raises(InputError, match="tolerance"):
        energy_rule(source, Detector(), ["water"], [1.0], 0.0)
    with pytest.raises(InputError, match="max_lengths"):
        energy_rule(source, Detector(), ["water"], [np.nan], 1e-4)
    with pytest.raises(InputError, match="sees nothing"):
        full_rule(source, Detector(kind="counting", threshold=95.0))
