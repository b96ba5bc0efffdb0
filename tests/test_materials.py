import subprocess
import sys

import numpy as np
import pytest
import xraylib

from ctsim.errors import InputError
from ctsim.materials import (
    _TABLE,
    Material,
    attenuation,
    k_edges,
    k_vacancies,
    mass_attenuation,
    mass_energy_transfer,
    material,
    names,
    photoelectric,
    scattering_function,
)

ENERGIES = np.array([10.0, 20, 30, 50, 60, 80, 100, 150])
# μ/ρ with coherent scattering, cm2/g, all digits printed: J. H. Hubbell and S. M. Seltzer, NISTIR 5632 (NIST SRD 126),
# tables 3 and 4, physics.nist.gov/PhysRefData/XrayMassCoef: ElemTab/z13, z22, z26 and ComTab/water, air.
NIST = {
    "water": [5.329, 0.8096, 0.3756, 0.2269, 0.2059, 0.1837, 0.1707, 0.1505],
    "Al": [26.23, 3.441, 1.128, 0.3681, 0.2778, 0.2018, 0.1704, 0.1378],
    "Fe": [170.6, 25.68, 8.176, 1.958, 1.205, 0.5952, 0.3717, 0.1964],
    "Ti": [110.7, 15.85, 4.972, 1.213, 0.7661, 0.4052, 0.2721, 0.1649],
    "air": [5.120, 0.7779, 0.3538, 0.2080, 0.1875, 0.1662, 0.1541, 0.1356],
}
# μ_en/ρ of the same tables; it is μ_tr/ρ less the share that becomes bremsstrahlung (their chapter 3).
NIST_EN = {
    "air": [4.742, 0.5389, 0.1537, 0.04098, 0.03041, 0.02407, 0.02325, 0.02496],
    "Al": [25.43, 3.094, 0.8778, 0.1840, 0.1099, 0.05511, 0.03794, 0.02827],
    "water": [4.944, 0.5503, 0.1557, 0.04223, 0.03190, 0.02597, 0.02546, 0.02764],
}
# μ/ρ with coherent scattering at 30 and 60 keV, cm2/g: table 4, ComTab/soft, lung, adipose, muscle, blood and bone, for
# the compositions of ICRU 44.
NIST_TISSUES = {
    "soft_tissue": [0.3790, 0.2048],
    "lung": [0.3815, 0.2053],
    "adipose": [0.3063, 0.1974],
    "muscle": [0.3783, 0.2048],
    "blood": [0.3852, 0.2057],
    "cortical_bone": [1.331, 0.3148],
}
# xraylib's copy of NIST's compositions. Its tissues are those of the ICRP, which are others.
IN_XRAYLIB = {
    "air": "Air, Dry (near sea level)",
    "water": "Water, Liquid",
    "PMMA": "Polymethyl Methacralate (Lucite, Perspex)",
    "PE": "Polyethylene",
    "glass": "Glass, Plate",
    "CsI": "Cesium Iodide",
    "GOS": "Gadolinium Oxysulfide",
}
# How far our density lies from xraylib's. That of PE is NIST's table 2; `_TABLE` says where the others are from.
OTHER_DENSITY = {"PMMA": 0.01, "PE": 0.011, "GOS": 0.014, "Ti": 0.008}
TISSUES = ("soft_tissue", "lung", "adipose", "cortical_bone", "enamel", "dentin")
REQUIRED = {"air", "water", *TISSUES, "PLA", "PMMA", "cellulose", "Fe", "Ti", "Al", "CoCr", "Au", "steel"}


@pytest.mark.parametrize("name", NIST)
def test_attenuation_is_nists(name: str) -> None:
    # 0.1 %: the tables print four figures (up to 0.05 %), and xraylib is within 0.066 % of them (Al).
    assert mass_attenuation(name, ENERGIES) == pytest.approx(NIST[name], rel=1e-3)


@pytest.mark.parametrize("name", NIST_TISSUES)
def test_tissues_are_those_of_icru_44(name: str) -> None:
    # 0.1 % as above: hydrogen or calcium off by 0.1 percent by weight is seen in bone, by 0.4 in any tissue
    assert mass_attenuation(name, [30.0, 60.0]) == pytest.approx(NIST_TISSUES[name], rel=1e-3)


@pytest.mark.parametrize("name", _TABLE)
def test_weights_sum_to_a_hundred(name: str) -> None:
    words = _TABLE[name][0].split()
    if len(words) > 1:
        assert sum(map(float, words[1::2])) == pytest.approx(100, abs=1e-6)  # all sources print weights that sum to it


@pytest.mark.parametrize("name", IN_XRAYLIB)
def test_compounds_are_nists(name: str) -> None:
    nist = xraylib.GetCompoundDataNISTByName(IN_XRAYLIB[name])
    made = material(name)
    # 0.03 percent by weight: NIST's weights of hydrogen are from another atomic weight, 1.0080 to 1.0079, and rounded
    assert made.mass_fractions == pytest.approx(
        dict(zip(nist["Elements"], nist["massFractions"], strict=True)), abs=3e-4
    )
    assert made.density == pytest.approx(nist["density"], rel=OTHER_DENSITY.get(name, 2e-4))


@pytest.mark.parametrize("name", ["Al", "Ti", "Fe", "Cu", "Sn", "W", "Au"])
def test_elements_have_nists_density(name: str) -> None:
    tabulated = xraylib.ElementDensity(xraylib.SymbolToAtomicNumber(name))
    assert material(name).density == pytest.approx(tabulated, rel=OTHER_DENSITY.get(name, 1e-4))


# percent by weight, least and most: ASTM F75; AISI 316L; AA 6061
LIMITS = {
    "CoCr": {"Cr": (27, 30), "Mo": (5, 7), "Fe": (0, 0.75), "Si": (0, 1), "Mn": (0, 1)},
    "steel": {"Cr": (16, 18), "Ni": (10, 14), "Mo": (2, 3), "Mn": (0, 2), "Si": (0, 1)},
    "Al6061": {"Mg": (0.8, 1.2), "Si": (0.4, 0.8), "Cu": (0.15, 0.4), "Cr": (0.04, 0.35)},
}


@pytest.mark.parametrize("name", LIMITS)
def test_alloys_keep_to_their_standard(name: str) -> None:
    words = _TABLE[name][0].split()
    weights = dict(zip(words[2::2], map(float, words[3::2]), strict=True))  # the first is the rest
    assert set(weights) == set(LIMITS[name])
    assert all(low <= weights[symbol] <= high for symbol, (low, high) in LIMITS[name].items())


@pytest.mark.parametrize(("name", "apatite", "water"), [("enamel", 0.95, 0.04), ("dentin", 0.70, 0.10)])
def test_teeth_are_the_stated_mixtures(name: str, apatite: float, water: float) -> None:
    mixture = apatite * mass_attenuation("Ca10P6O26H2@3.16", ENERGIES) + water * mass_attenuation("water", ENERGIES)
    # collagen is C, N, O and H in about these weights, of which every fraction of a percent is as much as water's
    mixture += (1 - apatite - water) * mass_attenuation("H 6.5 C 51 N 17 O 25.5@1.3", ENERGIES)
    assert mass_attenuation(name, ENERGIES) == pytest.approx(mixture, rel=3e-3)  # weights rounded to 0.1 of 28 and 38


@pytest.mark.parametrize("name", NIST_EN)
def test_energy_transfer_is_nists(name: str) -> None:
    # 0.3 %: 0.1 % of the cross sections, the rest bremsstrahlung, binding and L fluorescence; measured: 0.18 % (Al).
    assert mass_energy_transfer(name, ENERGIES) == pytest.approx(NIST_EN[name], rel=3e-3)


@pytest.mark.parametrize(
    ("symbol", "z", "end"), [("W", 74, 300.0), ("Gd", 64, 300.0), ("Al", 13, 300.0), ("O", 8, 100.0)]
)
def test_the_share_of_the_k_shell_has_no_jump_where_its_table_ends(symbol: str, z: int, end: float) -> None:
    e = end + np.array([-0.01, 0.0, 1e-3, 0.1, 0.5, 1.0, 100.0])
    share = k_vacancies(f"{symbol}@1", e)[z] / photoelectric(f"{symbol}@1", e)
    # 1e-4: below the end the share changes by 2e-4 per keV at most (O), hence 2e-6 in the first step
    assert share == pytest.approx(np.full(e.size, share[1]), rel=1e-4)


def test_every_promised_name_is_known() -> None:
    assert set(names()) >= REQUIRED
    for name in names():
        made = material(name)
        assert sum(made.mass_fractions.values()) == pytest.approx(1)
        mu = attenuation(name, ENERGIES)
        assert mu.shape == ENERGIES.shape
        assert np.all(np.isfinite(mu) & (mu > 0))


@pytest.mark.parametrize(("symbol", "density", "at_60"), [("Pb", 11.35, 5.021), ("Ag", 10.5, 5.766)])
def test_an_element_is_a_material_of_its_tabulated_density(symbol: str, density: float, at_60: float) -> None:
    # densities: NIST SRD 126, table 1; μ/ρ at 60 keV: tables z82 and z47. 0.2 %: xraylib against NIST, heavy elements
    assert symbol not in names()
    assert material(symbol).density == pytest.approx(density, rel=1e-3)
    assert mass_attenuation(symbol, [60.0]) == pytest.approx(at_60, rel=2e-3)
    assert material("W").density == 19.3 and material("Sn").density == 7.31


@pytest.mark.parametrize("name", ["Fm", "Bh", "pb", "None", "Fm@10"])
def test_elements_without_tables_are_refused(name: str) -> None:
    with pytest.raises(InputError, match=name.split("@")[0]):
        attenuation(name, [60.0])


def test_a_hint_is_given_only_when_it_is_close() -> None:
    with pytest.raises(InputError) as caught:
        material("Unobtainium")
    assert "did you mean" not in str(caught.value) and "cortical_bone" in str(caught.value)
    with pytest.raises(InputError, match="did you mean cortical_bone"):
        material("cortical-bone")


def test_weights_and_formulas_agree() -> None:
    share = material("water").mass_fractions
    weights = Material(name="w", formula=f"H {100 * share[1]:.9f} O {100 * share[8]:.9f}", density=1.0)
    assert attenuation(weights, ENERGIES) == pytest.approx(attenuation("water", ENERGIES), rel=1e-8)
    assert attenuation("H2O@2", ENERGIES) == pytest.approx(2 * attenuation("water", ENERGIES))


def test_k_edges_are_sorted_and_inside() -> None:
    # Mo and Au in table 3: 20.00 and 80.725 keV
    assert k_edges(["CoCr", "Au", "water"], 10, 90) == pytest.approx((20.0, 80.72), abs=0.01)
    assert k_edges(["water"], 10, 90) == ()


@pytest.mark.parametrize(
    ("name", "says"),
    [("watr", "water"), ("Foo@3", "Foo"), ("NaI@dense", "density"), ("NaI@-1", "density"), ("unobtainium", "known")],
)
def test_unknown_materials_are_refused_by_name(name: str, says: str) -> None:
    with pytest.raises(InputError, match=says):
        material(name)


@pytest.mark.parametrize("energies", [[0.5], [1e4], [np.nan], [[10.0]]])
def test_energies_out_of_range_are_refused(energies: list) -> None:
    with pytest.raises(InputError, match="energies"):
        attenuation("water", energies)


def test_importing_loads_no_xraylib() -> None:
    probe = "import sys; import ctsim.materials; {}; sys.exit('xraylib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", probe.format("pass")]).returncode == 0
    loads = "ctsim.materials.material('Fe')"
    assert subprocess.run([sys.executable, "-c", probe.format(loads)]).returncode == 1  # the check can fail


def test_the_scattering_function_below_its_table_goes_with_the_square():
    """xraylib's table starts at 0.001 1/Å and refuses less, which a tube of a few kV asks for."""
    bound, squared = scattering_function("Fe", np.array([0.0, 2.5e-4, 5e-4, 1e-3, 1.1e-3]))
    np.testing.assert_allclose(bound[:3] / bound[3], [0, 1 / 16, 1 / 4], rtol=1e-12)
    assert bound[3] < bound[4] < 1e-4 and (abs(squared / squared[0] - 1) < 1e-3).all()
