"""What photons leave in a slab, by Monte Carlo, against its twin, quadrature, conservation and Beer's law."""

import math

import numpy as np
import pytest
import xraylib as xrl
from by_threads import one_and_several
from scipy.integrate import quad
from scipy.special import expn

from ctsim.detector.kernels import slab_cpu, slab_reference
from ctsim.detector.slab import Slab, absorbed
from ctsim.errors import InputError
from ctsim.materials import attenuation, compton, k_shell, k_vacancies, material, photoelectric

SIGMAS = 4.0
TABLE = 2e-4  # attenuations are linear between energies 0.5 % from each other: E^-3 is wrong by 4e-5, edges by more


@pytest.mark.parametrize("share", [0.7, 1.0])
@pytest.mark.parametrize(("name", "energy"), [("GOS", 9.0), ("GOS", 60.0), ("CsI", 40.0), ("CsI", 300.0)])
def test_histories_are_those_of_the_reference(name, energy, share):
    """Both draw the same numbers; logarithms may differ by rounding."""
    slab, key = Slab.of(name), 2**63 + 12345
    found, expected = np.zeros((2, slab_cpu.CHUNKS, 6))
    slab_cpu.slab(slab, 0.2, energy, share, key, 1000, found)
    slab_reference.slab(slab, 0.2, energy, share, key, 1000, expected)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-10)
    assert expected[:, slab_cpu.DEPOSIT].any() and expected[:, slab_cpu.FRONT].any()


def one_line_only(name, z):
    """A slab where nothing happens but photoelectric absorption and the K fluorescence of one element."""
    slab = Slab.of(name)
    rates, lines = slab.rates.copy(), slab.lines.copy()
    rates[:, -2:] = rates[:, [-3]]
    edge = xrl.EdgeEnergy(z, xrl.K_SHELL)
    of_k = (lines[:, 1] > 0.8 * edge) & (lines[:, 1] < edge)
    lines[~of_k, 0] = 0.0
    lines[:, 2] = -1
    return slab._replace(rates=rates, lines=lines)


@pytest.mark.parametrize("thickness", [0.02, 0.1, 5.0])
@pytest.mark.parametrize(("name", "z", "energy"), [("GOS", 64, 52.0), ("GOS", 64, 90.0), ("CsI", 53, 35.0)])
def test_escape_of_one_element_s_k_photons_is_its_integral(name, z, energy, thickness):
    """These K photons cannot ionise the K shell that they come from, so that one generation is all there is."""
    shell = k_shell(z)
    assert shell is not None
    mu = photoelectric(name, [energy])[0]
    vacancies = k_vacancies(name, [energy])[z][0] / mu
    expected = -np.expm1(-mu * thickness) * np.array([1.0, energy, energy**2])
    for line, part in shell.lines:
        soft = photoelectric(name, [line])[0]

        def out(depth, soft=soft):
            away = expn(2, soft * depth) + expn(2, soft * (thickness - depth))
            return mu * math.exp(-mu * depth) * 0.5 * away

        points = [p for p in (0.01, 0.1, 0.5) if p < thickness]
        escape = quad(out, 0, thickness, points=points, epsrel=1e-9)[0] * vacancies * shell.fluorescence_yield * part
        expected += escape * np.array([0.0, -line, (energy - line) ** 2 - energy**2])
    found = absorbed(one_line_only(name, z), thickness, energy, histories=1_000_000)
    assert np.all(abs(found.moments - expected) < SIGMAS * found.errors + TABLE * expected), found.moments / expected


def radiated(z, shell):
    """Mean and mean square of the energy (keV) that a vacancy radiates, and what it makes below it."""
    rows = []
    for donor in [f"{n}{k}" for n in "LMNO" for k in range(1, 8)]:
        line = getattr(xrl, f"{shell}{donor}_LINE", None)
        try:
            rows.append((xrl.RadRate(z, line), xrl.LineEnergy(z, line), donor))
        except (ValueError, TypeError):
            continue
    strength = xrl.FluorYield(z, getattr(xrl, f"{shell}_SHELL")) / sum(rate for rate, *_ in rows)
    ways = [(strength * rate, energy, donor) for rate, energy, donor in rows]
    for to in {"L1": ("L2", "L3"), "L2": ("L3",)}.get(shell, ()):
        ways.append((xrl.CosKronTransProb(z, getattr(xrl, f"F{shell}{to[1]}_TRANS")), 0.0, to))
    first = second = 0.0
    for probability, energy, donor in ways:
        if 0 < energy < 1:  # such photons stay
            continue
        a, b = radiated(z, donor) if donor[0] == "L" and z > 40 else (0.0, 0.0)
        first += probability * (energy + a)
        second += probability * (energy**2 + 2 * energy * a + b)
    return first, second


def film(name, energy):
    """Moments of the deposit per mm of a film that lets all secondaries out, from xraylib alone."""
    which = material(name)
    total = np.zeros(3)
    for z, w in which.mass_fractions.items():
        photo, rest = xrl.CS_Photo(z, energy), 1.0
        for shell in ("K", "L1", "L2", "L3"):
            number = getattr(xrl, f"{shell}_SHELL")
            if xrl.EdgeEnergy(z, number) > energy or (z < 40 and shell != "K") or z == 8:
                continue
            share = xrl.CS_Photo_Partial(z, number, energy) / xrl.CS_Photo_Total(z, energy)
            first, second = radiated(z, shell)
            rest -= share
            total += w * photo * share * np.array([1, energy - first, energy**2 - 2 * energy * first + second])
        total += w * photo * rest * energy ** np.arange(3)

        def law(theta, power, z=z):
            kept = 1 / (1 + energy / 510.99895 * (1 - math.cos(theta)))
            lost = (energy * (1 - kept)) ** power
            return xrl.DCS_Compt(z, energy, theta) * 2 * math.pi * math.sin(theta) * lost

        total += w * np.array([quad(law, 1e-2, math.pi, args=(p,), epsrel=1e-6)[0] for p in range(3)])
    return 0.1 * which.density * total


@pytest.mark.parametrize("name", ["GOS", "CsI", "CdTe@5.85"])
@pytest.mark.parametrize("energy", [9.0, 40.0, 60.0, 250.0])
def test_a_film_keeps_what_its_electrons_get(name, energy):
    """1e-7 mm stops 1e-4 of 6 keV at a slant; Compton scatter below 0.01 rad (3e-5) is left out of the integral."""
    found = absorbed(Slab.of(name), 1e-7, energy, histories=1_000_000)
    expected = film(name, energy) * 1e-7
    assert np.all(abs(found.moments - expected) < SIGMAS * found.errors + 5e-4 * expected), found.moments / expected


@pytest.mark.parametrize("forced", [True, False])
@pytest.mark.parametrize("name", ["GOS", "CsI"])
def test_what_is_not_absorbed_leaves(name, forced):
    for thickness in (0.01, 0.3, 30.0):
        for energy in (2.0, 36.5, 80.0, 450.0):
            found = absorbed(Slab.of(name), thickness, energy, histories=20_000, forced=forced)
            assert found.moments[1] + found.front + found.back + found.passed * energy == pytest.approx(energy)


@pytest.mark.parametrize(("name", "thickness", "energy"), [("GOS", 0.1, 60.0), ("CsI", 0.4, 45.0), ("CsI", 2.0, 200.0)])
def test_photons_pass_by_beer_s_law_and_forcing_them_changes_no_mean(name, thickness, energy):
    n = 400_000
    plain = absorbed(Slab.of(name), thickness, energy, histories=n, stream="plain", forced=False)
    passing = math.exp(-attenuation(name, [energy])[0] * thickness)
    assert plain.passed == pytest.approx(passing, abs=SIGMAS * math.sqrt(passing * (1 - passing) / n) + TABLE * passing)
    forced = absorbed(Slab.of(name), thickness, energy, histories=n, stream="forced")
    assert np.all(abs(forced.moments - plain.moments) < SIGMAS * np.hypot(forced.errors, plain.errors))
    assert np.all(forced.errors < plain.errors)


def test_a_thick_slab_loses_energy_through_its_face_only():
    thick, thicker = (absorbed(Slab.of("CsI"), t, 60.0, histories=300_000, stream=f"{t}") for t in (20.0, 40.0))
    assert thick.back == thicker.back == 0.0 and thick.passed < 1e-15
    assert np.all(abs(thick.moments - thicker.moments) < SIGMAS * np.hypot(thick.errors, thicker.errors))
    assert thick.moments[1] + thick.front == pytest.approx(60.0)


def test_compton_scatter_shares_energy_as_its_integral_says():
    """Without photoelectric absorption a film keeps the mean share of Klein–Nishina times the scattering function."""
    slab = Slab.of("GOS")
    rates = slab.rates.copy()
    rates[:, -2:] -= rates[:, [-3]]
    rates[:, :-2] = 0.0
    rates[:, -1] = rates[:, -2]
    found = absorbed(slab._replace(rates=rates), 1e-7, 200.0, histories=400_000)
    scattered, share = (value[0] for value in compton("GOS", [200.0]))
    assert found.moments[0] == pytest.approx(scattered * 1e-7, rel=TABLE)
    # the share's own integral has 24 nodes, a few parts in 1e4
    assert found.moments[1] == pytest.approx(scattered * 1e-7 * 200 * share, abs=SIGMAS * found.errors[1], rel=5e-4)


@pytest.mark.parametrize(("kind", "energy"), [("Rayl", 10.0), ("Rayl", 60.0), ("Rayl", 300.0), ("Compt", 60.0)])
def test_a_film_scatters_back_what_its_differential_cross_sections_say(kind, energy):
    slab, n = Slab.of("CsI"), 400_000
    rates, scattered = np.zeros_like(slab.rates), np.diff(slab.rates, axis=1)
    rates[:, -1] = scattered[:, -1] if kind == "Rayl" else scattered[:, -2]
    if kind == "Compt":
        rates[:, -2] = rates[:, -1]
    found = absorbed(slab._replace(rates=rates), 1e-7, energy, histories=n)

    def law(theta):
        kept = 1 / (1 + energy / 510.99895 * (1 - math.cos(theta))) if kind == "Compt" else 1.0
        differential = getattr(xrl, f"DCS_{kind}_CP")("CsI", energy, theta)
        return differential * math.sin(theta) * np.array([1, kept])

    theta = np.linspace(1e-3, math.pi, 20_001)
    values = np.array([law(t) for t in theta.tolist()])
    back = np.trapezoid(np.where(theta[:, None] > math.pi / 2, values, 0), theta, axis=0)
    forward = np.trapezoid(values, theta, axis=0) - back
    share = back[0] / (back[0] + forward[0])
    noise = SIGMAS * math.sqrt(share * (1 - share) / n)
    # 2e-4: the squared form factor is linear in q² between 2048 nodes
    assert found.front / (found.front + found.back) == pytest.approx(back[1] / (back[1] + forward[1]), abs=noise + 2e-4)


def test_the_same_moments_for_any_number_of_threads():
    one, several = one_and_several(lambda: absorbed(Slab.of("CsI"), 0.1, 60.0, histories=5000, stream="s").moments)
    assert np.array_equal(one, several)
    assert not np.array_equal(one, absorbed(Slab.of("CsI"), 0.1, 60.0, histories=5000, stream="t").moments)


def test_bad_arguments_are_refused():
    with pytest.raises(InputError, match="histories"):
        absorbed(Slab.of("GOS"), 0.1, 60.0, histories=10)
    with pytest.raises(InputError, match="energy"):
        absorbed(Slab.of("GOS"), 0.1, 600.0, histories=1000)
