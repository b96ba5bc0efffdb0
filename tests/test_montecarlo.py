"""Photon Monte Carlo against quadrature, the ray tracer and TG-195 (Sechopoulos et al. 2015, Med. Phys. 42, 5679)."""

import dataclasses

import numpy as np
import pytest
from by_threads import one_and_several

from ctsim.beam.spectrum import Spectrum
from ctsim.detector.response import Detector
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation
from ctsim.montecarlo.kernels.transport_reference import single_scatter
from ctsim.montecarlo.transport import Histories, Source, absorbed_energy, scatter_image
from ctsim.montecarlo.world import World
from ctsim.solids import ELLIPSOID, FRUSTUM, Primitive, Solid
from ctsim.tracer.project import Tracer, path_lengths
from ctsim.types import Phantom

POSE = np.array([250.0, 0, 0, -250, 0, 0, 0, 120, 0, 0, 0, 120])
DRY_AIR = "C 0.0124 N 75.5268 O 23.1781 Ar 1.2827@0.00120479"
SOFT = "H 10.5 C 25.6 N 2.7 O 60.2 Na 0.1 P 0.2 S 0.3 Cl 0.2 K 0.2@1.03"  # TG-195, table of materials
SIGMAS = 4.0
ALL = Detector(kind="ideal", thickness=100.0)  # takes all energy, to 1e-4 at 120 keV


def ball(material, radius=30.0, n=80, **more):
    part = Primitive(kind=ELLIPSOID, centre=(0.0, 0.0, 0.0), params=(radius,) * 3)
    solid = Solid(name="ball", material=material, primitives=(part,), metal=False)
    labels = np.zeros((n, n, n), np.uint8)
    return Phantom(labels=labels, materials=("air", material), d_voxel=(1.0, 1.0, 1.0), solids=(solid,), **more)


def source(energy, n_detector=(1, 1), **more):
    spectrum = Spectrum(energies=np.array([energy]), weights=np.array([1.0]))
    return Source(spectrum=spectrum, detector=ALL, n_detector=n_detector, **more)


def image(phantom, energy, histories, cells=(3, 3), **more):
    world = World.of(phantom, energy + 1)
    return scatter_image(world, source(energy), POSE, cells=cells, histories=histories, **more)


@pytest.mark.slow
@pytest.mark.parametrize(("material", "energy"), [("water", 25.0), ("Al", 80.0)])
def test_photons_scattered_once_are_as_many_as_quadrature_says(material, energy):
    """The reference shares neither sampling nor tables: xraylib's differential cross-sections, integrated."""
    fine = single_scatter(material, 30.0, energy, POSE, (27, 27), nodes=24)
    expected = sum(fine).reshape(3, 9, 3, 9).sum((1, 3)) * 9 / energy
    found = image(ball(material), energy, 1_500_000)
    off = (found.single - expected) / found.error
    assert abs(off).max() < SIGMAS, off
    assert found.error.max() < 0.06 * expected.max()
    total = found.single.sum() / expected.sum() - 1
    # xraylib's total cross-sections differ from the integrals of its differential ones by up to 0.4 %
    assert abs(total) < 0.004 + SIGMAS * np.sqrt((found.error**2).sum()) / expected.sum()


@pytest.mark.parametrize("voxels", [False, True])
def test_primary_photons_are_as_many_as_the_ray_tracer_says(voxels):
    rods = [
        Solid(
            name=name, material=name, metal=False,
            primitives=(Primitive(kind=FRUSTUM, centre=at, params=(20.0, 4.0, 4.0), axis=axis),),
        )
        for name, at, axis in (("Fe", (0.0, 12.0, 0.0), (0.0, 0.0, 1.0)), ("Ti", (5.0, -9.0, 6.0), (0.3, 0.2, 1.0)))
    ]  # fmt: skip
    labels = np.zeros((40, 40, 40), np.uint8)
    labels[6:34, 8:33, 5:30] = 1
    density = np.where(np.arange(40) < 20, 1.0, 0.5).astype(np.float32) * np.ones_like(labels) if voxels else None
    phantom = Phantom(
        labels=labels, materials=("air", "water", "Fe", "Ti"), d_voxel=(1.5, 1.5, 1.5), solids=tuple(rods),
        density=density,
    )  # fmt: skip
    energy, cells = 70.0, (8, 8)
    geometry = Geometry(
        n_voxel=(8, 8, 8), d_voxel=(1.0, 1.0, 1.0), n_detector=(1024, 1024), d_detector=(0.125, 0.125), dso=250.0,
        dsd=500.0, n_views=1,
    )  # fmt: skip
    found = scatter_image(
        World.of(phantom, 71.0), source(energy, geometry.n_detector), geometry.pose(0), cells=cells,
        histories=4_000_000,
    )  # fmt: skip
    lengths = path_lengths(Tracer.of(phantom), geometry, 0)
    tau = sum(attenuation(m, [energy])[0] * lengths[k] for k, m in enumerate(phantom.materials) if k)
    expected = np.exp(-tau).reshape(8, 128, 8, 128).mean((1, 3))  # of pixels so small that rays at edges count as one
    sigma = np.sqrt(expected * 64 / 4_000_000)  # a photon arrives or does not
    assert ((found.primary - expected) ** 2 / sigma**2).mean() < 1.7  # χ² of 64 degrees: 1 ± 0.18
    assert found.primary.mean() / expected.mean() == pytest.approx(1, abs=SIGMAS * 4e-4)


def test_a_body_in_three_pieces_of_grid_is_the_same_body():
    """Voxels and solids, coarse blocks and fine ones: the same ball scatters alike."""
    n = 96
    at = (np.arange(n) + 0.5) * 0.75 - 36
    labels = (at[:, None, None] ** 2 + at[:, None] ** 2 + at**2 <= 900).astype(np.uint8)
    voxels = Phantom(labels=labels, materials=("air", "water"), d_voxel=(0.75, 0.75, 0.75))
    one, other = image(ball("water"), 60.0, 1_000_000), image(voxels, 60.0, 1_000_000)
    off = (one.scatter - other.scatter) / np.hypot(one.error, other.error)
    assert abs(off).max() < SIGMAS and not np.array_equal(one.scatter, other.scatter)


def test_solids_reach_out_of_the_voxels():
    """The same ball, around voxels that hold a part of it."""
    small = dataclasses.replace(ball("water"), labels=np.zeros((8, 30, 20), np.uint8), off_origin=(3.0, -5.0, 8.0))
    one, other = image(ball("water"), 60.0, 500_000), image(small, 60.0, 500_000)
    assert abs((one.scatter - other.scatter) / np.hypot(one.error, other.error)).max() < SIGMAS
    assert one.primary.mean() == pytest.approx(other.primary.mean(), abs=3e-3)


def test_density_scales_attenuation():
    """Half the density of twice the matter."""
    thin = ball("water")
    labels = np.ones((80, 80, 80), np.uint8)
    density = np.full(labels.shape, 0.5, np.float32)
    half = Phantom(labels=labels, materials=("air", "water"), d_voxel=(0.5,) * 3, density=density)
    light = Phantom(labels=labels, materials=("air", "H 11.19 O 88.81@0.5"), d_voxel=(0.5,) * 3)
    one, other = image(half, 60.0, 1_000_000), image(light, 60.0, 1_000_000)
    assert abs((one.scatter - other.scatter) / np.hypot(one.error, other.error)).max() < SIGMAS
    assert one.primary.mean() == pytest.approx(other.primary.mean(), abs=2e-3)
    assert one.scatter.mean() != pytest.approx(image(thin, 60.0, 100_000).scatter.mean(), rel=0.1)


def test_the_same_histories_for_any_number_of_threads():
    phantom = ball("water")
    one, several = one_and_several(lambda: image(phantom, 60.0, 20_000, stream="s"))
    assert np.array_equal(one.scatter, several.scatter) and np.array_equal(one.primary, several.primary)
    assert not np.array_equal(one.scatter, image(phantom, 60.0, 20_000, stream="t").scatter)


def test_energy_is_kept():
    """In a ball that lets nothing out, all energy is absorbed."""
    regions = np.ones((80, 80, 80), np.uint8)
    pose = np.array([0.0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1])  # from the middle outwards
    found, _ = absorbed_energy(World.of(ball("Fe"), 61.0), source(60.0), pose, regions, histories=20_000)
    assert found.sum() == pytest.approx(60.0, rel=1e-3)


VOIS = [
    (0, -150, 85),
    (-150, 0, 85),
    (0, 0, 85),
    (150, 0, 85),
    (0, 150, 85),
    (0, 0, 25),
    (0, 0, 55),
    (0, 0, 115),
    (0, 0, 145),
]
BODY, CUBES = 33171.4, (27.01, 27.0, 36.67, 27.01, 27.01, 72.86, 53.35, 23.83, 14.6)  # eV per photon


def test_tg195_case_2_radiography():
    """56.4 keV on a box of soft tissue in air: absorbed energy of the body and of nine cubes of 30 mm."""
    labels = np.ones((360, 78, 78), np.uint8)
    labels[310:350] = 2
    regions = np.zeros(labels.shape, np.uint8)
    regions[310:350] = 1
    for number, (x, y, depth) in enumerate(VOIS, 2):
        k, j, i = 310 + depth // 5, (y + 180) // 5, (x + 180) // 5
        regions[k : k + 6, j : j + 6, i : i + 6] = number
    phantom = Phantom(labels=labels, materials=("air", DRY_AIR, SOFT), d_voxel=(5.0,) * 3, off_origin=(900.0, 0.0, 0.0))
    pose = np.array([0.0, 0, 1e-3, 0, 0, 1800, 390, 0, 0, 0, 390, 0])
    found, error = absorbed_energy(
        World.of(phantom, 58.0), source(56.4, isotropic=True), pose, regions, histories=2_000_000
    )
    assert found[1:].sum() * 1e3 == pytest.approx(BODY, rel=3e-3)
    off = (found[2:] * 1e3 - CUBES) / np.hypot(error[2:] * 1e3, 0.005 * np.array(CUBES))  # codes differ by 0.5 %
    assert abs(off).max() < SIGMAS, off


@pytest.mark.parametrize(
    ("wide", "expected"),
    [(10, (11592.27, 2576.72, 1766.85, 1330.53)), (80, (3380.39, 3332.64, 3176.44, 2559.58))],
)
def test_tg195_case_4_computed_tomography(wide, expected):
    """56.4 keV, a fan on a cylinder of PMMA: energy in slabs of 10 mm, the first in the middle of the beam."""
    labels = np.ones((301, 34, 122), np.uint8)  # air from the source on: it takes 1 % of the photons
    regions = np.zeros(labels.shape, np.uint8)
    for number in range(4):
        regions[150 + number, :, 44:78] = number + 1
    part = Primitive(kind=FRUSTUM, centre=(0.0, 0.0, 0.0), params=(1500.0, 160.0, 160.0))
    cylinder = Solid(name="body", material="C5H8O2@1.19", primitives=(part,), metal=False)
    phantom = Phantom(
        labels=labels, materials=("air", DRY_AIR, "C5H8O2@1.19"), d_voxel=(10.0,) * 3, solids=(cylinder,)
    )  # fmt: skip
    pose = np.array([600.0, 0, 0, 0, 0, 0, 0, 320, 0, 0, 0, wide])
    found, error = absorbed_energy(
        World.of(phantom, 58.0), source(56.4, isotropic=True), pose, regions, histories=600_000
    )
    off = (found[1:] * 1e3 - expected) / np.hypot(error[1:] * 1e3, 0.005 * np.array(expected))
    assert abs(off).max() < SIGMAS, (found[1:] * 1e3 / expected - 1, off)


def test_a_focused_grid_stops_what_comes_from_the_side():
    """Photons from a speck in the middle: each cell's share follows from two directions, those of speck and source."""
    speck, cells, ratio = ball("water", radius=0.5, n=8), (1, 60), 6.0
    world, run = World.of(speck, 61.0), {"cells": cells, "histories": 2_000_000}
    small = np.array([250.0, 0, 0, -50, 0, 0, 0, 1, 0, 0, 0, 1])  # 300 mm from source to detector, 50 from the speck
    plain = scatter_image(world, source(60.0, (4, 60)), small, **run)
    behind = scatter_image(world, source(60.0, (4, 60), grid_ratio=ratio), small, **run)
    u = (np.arange(6000) + 0.5) / 100 - 30
    share = np.maximum(0, 1 - ratio * abs(u / 50 - u / 300)).reshape(60, 100).mean(1)
    # the same photons in both: what differs is where in a cell of 1 mm they arrive, and the speck's width of 1 mm
    assert behind.scatter.sum() == pytest.approx((plain.scatter[0] * share).sum(), rel=0.03)
    middle = share > 0.5
    np.testing.assert_allclose(behind.scatter[0, middle], (plain.scatter[0] * share)[middle], rtol=0.1)
    assert behind.scatter[0, 0] == 0 and share.max() > 0.9
    np.testing.assert_array_equal(behind.primary, plain.primary)


def test_fewer_histories_than_parts_are_refused():
    with pytest.raises(InputError, match="histories must be at least 64, got 63"):
        Histories(key=np.uint64(0), count=63)
    assert Histories(key=np.uint64(0), count=64).first == 0
