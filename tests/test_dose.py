"""Photons per pixel from mAs or air kerma, and the air kerma of a scan, against published numbers and SpekPy."""

import math
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest

from ctsim.beam.dose import dose_of, i0_of_kerma, i0_of_mas
from ctsim.beam.spectrum import Bowtie, Filter, Tube, spectrum
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.phantoms.scene import build, load_suite, parse_suite, scene_id, scene_to_toml, stream_id
from ctsim.plan import make_plan
from ctsim.scaninfo import ScanInfo
from ctsim.simulate import scan_info

SUITES = Path(__file__).parent.parent / "benchmarks" / "suites"
RODS = 'name = "rods"\nphantom = { recipe = "validation" }\n'
SPEKPY = [
    # kVp, filter, mm; SpekPy 2.5.4 (casim, NIST, 11°, bins of 0.1 keV): photons/cm2 and air kerma in uGy, mAs and 1 m
    (90, "Al", 0.5, 3.25661e8, 280.427),
    (90, "Al", 1.0, 2.74744e8, 179.605),
    (120, "Al", 0.5, 5.17217e8, 348.072),
    (120, "Al", 2.5, 3.54145e8, 157.035),
    (60, "Cu", 0.5, 1.01257e7, 3.95223),
    (90, "Cu", 2.0, 8.21218e6, 2.50863),
]


def tube(kvp: float = 90.0, metal: str = "Al", thickness: float = 0.5, **rest) -> Tube:
    return Tube(kvp=kvp, filters=(Filter(material=metal, thickness=thickness),), **rest)


def geometry(**changes) -> Geometry:
    """A panel at 0.4 m with square pixels of 0.2 mm, the axis at 0.2 m, one view."""
    plain = {
        "dso": 200.0, "dsd": 400.0, "n_voxel": (4, 4, 4), "d_voxel": (1.0, 1.0, 1.0), "n_detector": (5, 7),
        "d_detector": (0.2, 0.2), "n_views": 1,
    }  # fmt: skip
    return Geometry(**{**plain, **changes})


def tolerance(metal: str, thickness: float) -> float:
    """Relative error allowed in fluence and kerma against SpekPy.

    0.5 %: the table between and at its nodes, and μ_tr against μ_en of air (0.3 %). Behind copper the two sources of
    attenuation differ by 0.4 % of the optical depth, which is up to 4 for the photons that count here: 1.6 %.
    """
    return 5e-3 + (1.6e-2 if metal == "Cu" else 0.0)


def test_photons_of_a_published_scan() -> None:
    # 3.256e8 photons/cm2/mAs at 1 m are 3.256e8 · (1/0.4)² · 0.02² = 8.14e5 in a pixel of 0.2 mm at 0.4 m. The
    # spectrum's test allows 0.5 %.
    assert i0_of_mas(tube(), geometry(), 1.0) == pytest.approx(8.14e5, rel=5e-3)


@pytest.mark.parametrize(("kvp", "metal", "thickness", "fluence", "kerma"), SPEKPY)
def test_photons_and_kerma_are_spekpys(kvp: float, metal: str, thickness: float, fluence: float, kerma: float) -> None:
    made, rel = tube(kvp, metal, thickness), tolerance(metal, thickness)
    i0 = i0_of_mas(made, geometry(), 3.0)
    assert i0 == pytest.approx(3.0 * fluence * 0.02**2 / 0.4**2, rel=rel)
    found = dose_of(made, geometry(), i0)
    assert found.scan_kerma == pytest.approx(3.0 * kerma * 1e-3 / 0.2**2, rel=rel)
    assert found.scan_mas == pytest.approx(3.0, rel=1e-12)


def test_a_filter_costs_photons() -> None:
    # SpekPy's ratio of 0.5 mm Al to 2 mm Cu at 90 kVp
    ratio = SPEKPY[0][3] / SPEKPY[-1][3]
    assert ratio == pytest.approx(39.66, abs=0.01)
    photons = [i0_of_mas(tube(90, *sheet), geometry(), 100.0) for sheet in (("Al", 0.5), ("Cu", 2.0))]
    assert photons[0] / photons[1] == pytest.approx(ratio, rel=2.1e-2)


def test_kerma_of_one_energy_is_a_closed_form() -> None:
    # fluence · E · μ_en/ρ of air; NIST: 0.03041 cm2/g at 60 keV. 0.5 %: μ_tr against μ_en.
    mono = Tube(kvp=60.0, model="mono")
    fluence = 1e5 * (400 / 200) ** 2 / 0.02**2  # photons per cm2 at the axis
    expected = fluence * 60.0 * 0.03041 * 1.602176634e-10
    found = dose_of(mono, geometry(), 1e5)
    assert found.view_kerma == pytest.approx(expected, rel=5e-3)
    assert found.scan_mas is None
    assert i0_of_kerma(mono, geometry(), expected) == pytest.approx(1e5, rel=5e-3)


def test_views_share_a_scans_charge_and_kerma() -> None:
    # more views, as much dose: that is what mAs of the scan means
    one, ten = geometry(), geometry(n_views=10)
    assert i0_of_mas(tube(), ten, 5.0) == pytest.approx(i0_of_mas(tube(), one, 5.0) / 10, rel=1e-12)
    assert i0_of_kerma(tube(), ten, 5.0) == pytest.approx(i0_of_kerma(tube(), one, 5.0) / 10, rel=1e-12)
    found = dose_of(tube(), ten, 1e5)
    assert found.scan_kerma == pytest.approx(10 * found.view_kerma, rel=1e-12)


def test_photons_follow_the_pixel_and_the_distance() -> None:
    plain = i0_of_mas(tube(), geometry(), 1.0)
    assert i0_of_mas(tube(), geometry(d_detector=(0.6, 0.2)), 1.0) == pytest.approx(3 * plain, rel=1e-12)
    assert i0_of_mas(tube(), geometry(dsd=800.0), 1.0) == pytest.approx(plain / 4, rel=1e-12)
    # the axis does not matter to the detector, nor the detector's shift to the pixel opposite the source
    assert i0_of_mas(tube(), geometry(dso=100.0), 1.0) == pytest.approx(plain, rel=1e-12)
    assert i0_of_mas(tube(), geometry(off_detector=(0.3, 0.4)), 1.0) == pytest.approx(plain, rel=1e-12)
    near, far = (dose_of(tube(), geometry(dso=d), plain).scan_kerma for d in (100.0, 200.0))
    assert near == pytest.approx(4 * far, rel=1e-12)


def test_poses_have_the_dose_of_their_own_distances() -> None:
    """`dso` and `dsd` describe nothing where poses are given."""
    plain = geometry(n_views=6)
    poses = tuple(tuple(row) for row in plain.pose_array().tolist())
    given = geometry(n_views=6, poses=poses, dso=1.0, dsd=2.0, d_detector=(9.0, 9.0))
    assert i0_of_mas(tube(), given, 1.0) == pytest.approx(i0_of_mas(tube(), plain, 1.0), rel=1e-12)
    assert dose_of(tube(), given, 1e5) == pytest.approx(dose_of(tube(), plain, 1e5), rel=1e-12)


def test_a_bow_tie_is_in_the_kerma_and_not_in_the_photons() -> None:
    """As in the simulator, whose `i0` are the photons of a tube without it; a sheet as thick gives the same kerma."""
    bowtie = Bowtie(material="Al", center=2.0, edge=9.0, half_angle_deg=10.0)
    with_it, sheet = tube(bowtie=bowtie), tube(thickness=2.5)
    assert i0_of_mas(with_it, geometry(), 1.0) == i0_of_mas(tube(), geometry(), 1.0)
    one, other = (dose_of(made, geometry(), i0_of_mas(made, geometry(), 1.0)).scan_kerma for made in (with_it, sheet))
    # a sheet attenuates the lines at their own energies, the bow-tie in the bins that share them, a fraction of
    # 0.25 keV away. Sharing keeps the mean energy, so only the curvature is left: (0.25 keV)²/8 · μ″ · 2 mm = 4e-6 of
    # the K lines (μ″ = 12 · 0.075/mm / 59² keV²), which have less than a tenth of the kerma. L lines hardly pass.
    assert one == pytest.approx(other, rel=1e-6)


def test_the_heel_leaves_the_central_ray() -> None:
    assert dose_of(tube(heel=True), geometry(), 1e5) == dose_of(tube(), geometry(), 1e5)


def scene(keys: str):
    return parse_suite(RODS + f"scanner = {{ {keys} }}", "s.toml")[0]


def test_keys_set_the_photons_of_a_scene() -> None:
    plain = scene("n_views = 8").resolve()
    dose = dose_of(plain.tube, plain.geometry, plain.i0)
    for key, value in (("scan_mas", dose.scan_mas), ("scan_kerma", dose.scan_kerma)):
        one = scene(f"n_views = 8, {key} = {value!r}")
        assert one.resolve().i0 == pytest.approx(1e5, rel=1e-12)
        assert parse_suite(scene_to_toml(one)) == (one,)
    other = scene(f"n_views = 8, scan_mas = {dose.scan_mas!r}, tube = {{ kvp = 120 }}").resolve()
    # 120 to 90 kVp behind 0.5 mm Al: SpekPy
    assert other.i0 == pytest.approx(1e5 * SPEKPY[2][3] / SPEKPY[0][3], rel=1e-2)


def test_a_scene_can_empty_the_photons_of_the_defaults() -> None:
    text = "[defaults.scanner]\ni0 = 2e4\n[[scene]]\n" + RODS
    assert parse_suite(text)[0].resolve().i0 == 2e4
    with pytest.raises(InputError, match="got i0 and scan_mas"):
        parse_suite(text + "scanner = { scan_mas = 1 }")
    assert parse_suite(text + 'scanner = { scan_mas = 1, i0 = "null" }')[0].resolve().i0 > 1e5


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("scan_mas = 1, i0 = 1e5", ["scan_mas: expected only one of i0, scan_mas, scan_kerma"]),
        ("scan_kerma = 1, i0 = 1e5", ["scan_kerma: expected only one of"]),
        ("scan_kerma = 1, scan_mas = 1", ["got scan_mas and scan_kerma"]),
        ('scan_mas = 1, tube = { kvp = 60, model = "mono" }', ["scan_mas needs a tube", "'mono'", "scan_kerma"]),
        ("scan_mas = 1e-9", ["scan_mas = 1e-09 mAs gives", "1 to 1e+12"]),
        ("scan_kerma = 1e-9", ["scan_kerma = 1e-09 mGy gives", "photons per open pixel and view"]),
        ("scan_mas = 1e6, n_detector = [1, 1], n_views = 1", ["scan_mas = 1e+06 mAs gives", "1e+12"]),
        ("scan_mas = 0", ["scan_mas", "> 0"]),
        ("scan_kerma = 2e6", ["scan_kerma", "<= 1000000"]),
    ],
)
def test_bad_values_are_refused_in_one_sentence(keys: str, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        scene(keys)
    assert re.match(r"s\.toml: scanner\.scan_(mas|kerma)", str(caught.value))
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_photons_by_charge_and_by_kerma_are_part_of_ids() -> None:
    others = ["", "scan_mas = 1", "scan_mas = 2", "scan_kerma = 1", "scatter = { level = 3 }"]
    others.append("scatter = { level = 3, grid_ratio = 8.0 }")
    for name in (scene_id, stream_id):
        assert len({name(scene(keys)) for keys in others}) == len(others)


def test_a_scan_and_its_plan_state_the_kerma() -> None:
    one = parse_suite(
        'name = "rods"\nphantom = { recipe = "validation", n_voxel = [16, 16, 16] }\n'
        "scanner = { n_views = 4, n_detector = [8, 8], n_voxel = [8, 8, 8], scan_kerma = 2.5 }"
    )[0]
    phantom, scanner = build(one), one.resolve()
    plan = make_plan(phantom, scanner, one.simulation, one.truth, stream_id(one))
    info = scan_info(plan, phantom, scanner)
    assert info["scan_kerma"] == pytest.approx(2.5, rel=1e-12)
    assert info["view_kerma"] == pytest.approx(2.5 / 4, rel=1e-12)
    charge = plan.dose.scan_mas
    assert charge is not None
    assert f"dose    2.5 mGy of air kerma at the isocentre (0.625 mGy a view), {charge:.3g} mAs\n" in plan.text()
    info.pop("flat")
    read = msgspec.convert(info, ScanInfo)
    assert (read.view_kerma, read.scan_kerma) == (info["view_kerma"], info["scan_kerma"])
    older = {k: v for k, v in info.items() if k not in ("view_kerma", "scan_kerma")}
    assert msgspec.convert(older, ScanInfo).scan_kerma is None


def test_kerma_of_a_spectrum_is_a_sum_over_its_bins() -> None:
    made = spectrum(tube())
    half = made.kerma(np.full(made.energies.size, 0.5))
    assert half == pytest.approx(made.kerma() / 2, rel=1e-12)
    behind = np.exp(-attenuation("Al", made.energies) * made.hvl())
    assert math.log2(made.kerma() / made.kerma(behind)) == pytest.approx(1.0, rel=1e-9)


def test_comparisons_of_the_suite_hold_what_they_name_equal() -> None:
    doses: dict[str, list] = {}
    for one in load_suite(SUITES / "systems.toml"):
        scanner = one.resolve()
        kind = one.name.partition("-same-")[2]
        doses.setdefault(kind, []).append((scanner.i0, *dose_of(scanner.tube, scanner.geometry, scanner.i0)[1:]))
    for kind, found in doses.items():
        photons, kerma, charge = np.transpose(found)
        column = {"": photons, "kerma": kerma, "mAs": charge}[kind]
        assert np.ptp(column) <= 1e-12 * column.max(), kind
        # the first system is the same in all three within the three digits of the keys
        assert photons[0] == pytest.approx(1e5, rel=5e-3), kind
    assert list(doses) == ["", "mAs", "kerma"]
