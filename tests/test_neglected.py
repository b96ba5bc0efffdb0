"""Sizes of neglected effects against closed forms and published numbers."""

import math

import numpy as np
import pytest

from ctsim.benchmarks.tools import neglected
from ctsim.materials import k_shell, k_vacancies
from ctsim.montecarlo.tables import Interactions


def test_an_electrons_range_in_water_is_near_the_published_one() -> None:
    # NIST ESTAR (NISTIR 4999), CSDA range in water: 1.431e-2 g/cm2 at 100 keV, 4.320e-3 at 50 keV. 5 %: Kanaya and
    # Okayama fit one power law to all elements.
    assert neglected.electron_range("water", [50.0, 100.0]) == pytest.approx([0.04320, 0.1431], rel=0.05)


def test_lubberts_factor_of_a_thin_absorber_is_a_hyperbolic_tangent() -> None:
    # even absorption: ((1 - exp(-k))/k)^2 over (1 - exp(-2k))/(2k) is tanh(k/2)/(k/2) with k = 2 pi f t
    k = 2 * math.pi * 1.2 * 0.3
    assert neglected.lubberts(1e-9, 1.2, 0.3) == pytest.approx(math.tanh(k / 2) / (k / 2), rel=1e-6)
    assert neglected.lubberts(0.7, 1e-9, 0.3) == pytest.approx(1.0, abs=1e-6)


def test_fluorescence_of_a_film_is_its_vacancies_times_the_solid_angle() -> None:
    # 1 nm of iron: no attenuation within it, to 1e-4. The panel is 500 mm from the source, the film halfway.
    beam = neglected.spectrum(neglected.SOFT)
    shell = k_shell(26)
    assert shell is not None
    deposit = sum(share * neglected.response(neglected.CSI, [line])[0][0] for line, share in shell.lines)
    made = (beam.weights * k_vacancies("Fe", beam.energies)[26]).sum() * 1e-6 * shell.fluorescence_yield * deposit
    expected = made * 4 * 100 / (4 * math.pi * 250.0**2) / neglected.signal(neglected.SOFT, neglected.CSI, {})
    assert neglected.fluorescence("Fe", 1e-6, neglected.SOFT, neglected.CSI) == pytest.approx(expected, rel=1e-3)


def test_doppler_broadening_of_a_scattered_photon_is_the_profiles_width() -> None:
    # dE'/dp = transfer / (1 + E(1 - cos θ)/mc²), times the width of water's profile 2·J_H + J_O. 3 %: the
    # transfer changes over the line.
    from xraylib import ComptonProfile

    p = np.linspace(0, 3, 3001)
    profile = np.array([2 * ComptonProfile(1, v) + ComptonProfile(8, v) for v in p])
    half = p[profile > 0.5 * profile[0]][-1]
    free = 60.0 / (1 + 60.0 / 510.998950)
    transfer = math.hypot(60.0, free) / 137.035999
    assert neglected.doppler(60.0, 90.0, neglected.GOS)[0] == pytest.approx(2 * half * transfer * free / 60.0, rel=0.03)


def test_an_unchanged_form_factor_changes_nothing() -> None:
    tables = Interactions.of(("air", "water"), 91.0)
    q = tables.d_q * np.arange(tables.form.shape[1])
    squared = np.gradient(tables.form[1], q**2 + 1e-12)
    same = neglected.with_form(tables, q, np.sqrt(squared))
    # 0.5 %: the numerical derivative of the integral
    assert same.mu[1, 100:, 2] == pytest.approx(tables.mu[1, 100:, 2], rel=5e-3)
    none = neglected.with_form(tables, np.array([0.0, 0.0799, 0.08, 1.0]), np.array([0.0, 0.0, 1.0, 1.0]))
    assert none.form[1, q < 0.07].max() == 0
