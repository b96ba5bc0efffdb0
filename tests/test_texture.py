"""Density in levels: what is drawn, what rays meet, what the truth says; and label grids that are shifted."""

import math

import msgspec
import numpy as np
import pytest

import ctsim
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation, mass_attenuation, material, nominal
from ctsim.phantoms.bodies.hip import Hip
from ctsim.phantoms.bodies.lung import Lung
from ctsim.phantoms.bodies.random import Random
from ctsim.phantoms.bodies.teeth import Teeth
from ctsim.phantoms.bodies.volume import CtVolume
from ctsim.phantoms.fields import Canvas, LabelGrid
from ctsim.phantoms.recipes import BUILDERS, build_recipe
from ctsim.phantoms.scene import parse_suite
from ctsim.phantoms.texture import LEVELS, levels
from ctsim.plan import make_plan
from ctsim.settings import Simulation, Truth
from ctsim.simulate import scan_info, simulate_views, truth_volumes
from ctsim.tracer.bricks import make_bricks
from ctsim.tracer.columns import make_columns
from ctsim.tracer.project import Tracer, path_lengths
from ctsim.tracer.voxelise import attenuation_volume
from ctsim.types import Phantom

MU = 1e-2


def body(kind=Random, seed=1, n=64, **changes) -> Phantom:
    return build_recipe(kind(n_voxel=(n, n, n), metal="none", **changes), seed)


def density(phantom: Phantom) -> np.ndarray:
    """Density relative to nominal [z, y, x], 1 in air."""
    return np.array([nominal(m)[1] for m in phantom.materials])[phantom.labels]


def tissues(phantom: Phantom) -> np.ndarray:
    return np.array([nominal(m)[0] for m in phantom.materials])[phantom.labels]


def geometry(phantom: Phantom, n: int = 32, **changes) -> Geometry:
    size = phantom.labels.shape[0] * phantom.d_voxel[0]
    known = {"n_detector": (40, 44), "d_detector": (3.0, 3.0), "n_views": 3, "dso": 300.0, "dsd": 500.0}
    return Geometry(n_voxel=(n, n, n), d_voxel=(size / n,) * 3, **(known | changes))


def test_levels_are_even_and_of_unit_spread() -> None:
    found = levels()
    assert len(found) == LEVELS and np.allclose(np.diff(found, 2), 0) and np.array_equal(found, -found[::-1])
    drawn = np.random.default_rng(0).standard_normal(400_000)
    level = np.clip(np.rint(drawn / 0.65), -3, 3).astype(int)
    # the standard deviation of 4e5 normal numbers is known to 1/sqrt(8e5) = 0.11 %
    assert found[level + 3].std() == pytest.approx(1, abs=0.005)


@pytest.mark.parametrize("kind", [Random, Lung, Hip])
def test_texture_changes_density_only_and_by_the_seed(kind) -> None:
    plain, one, again, other = (body(kind, s, **t) for s, t in ((1, {}), *[(k, {"texture": 0.05}) for k in (1, 1, 2)]))
    assert np.array_equal(np.array(plain.materials)[plain.labels], tissues(one))
    assert one.materials == again.materials and np.array_equal(one.labels, again.labels)
    assert not np.array_equal(density(one), density(other))
    inside = plain.labels > 0
    # 30 lengths of 2 mm along an edge and a body of a third of the cube: some 9000 cells, of which a thousand are
    # independent, so that the spread is known to 1/sqrt(2000) = 2.2 % and the mean to 0.05/sqrt(1000)
    assert density(one)[inside].std() == pytest.approx(0.05, rel=0.12)
    assert density(one)[inside].mean() == pytest.approx(1, abs=0.006)
    assert (density(one)[~inside] == 1).all() and one.solids == plain.solids


@pytest.mark.parametrize("length", [3.0, 6.0])
def test_correlation_falls_to_a_half_over_the_length(length: float) -> None:
    # labels filled with one tissue are not there, so the field is read where tissue is: pairs of voxels
    found = []
    for seed in range(6):
        phantom = body(Hip, seed, n=60, texture=0.1, texture_mm=length)
        inside, deviation = phantom.labels > 0, density(phantom) - 1
        for axis in range(3):
            lag = round(length / phantom.d_voxel[0])
            near = [np.delete(a, np.s_[-lag:], axis) for a in (inside, deviation)]
            far = [np.delete(a, np.s_[:lag], axis) for a in (inside, deviation)]
            both = near[0] & far[0]
            found.append((near[1][both] * far[1][both]).mean() / (deviation[inside] ** 2).mean())
    # 0.493 for cubic B-splines at a lag of a cell; levels take 4.4 % of the variance away, which pairs do not share.
    # 18 estimates from some hundred independent cells each scatter by about 0.1, their mean by 0.03
    assert np.mean(found) == pytest.approx(0.48, abs=0.08)


def test_another_grid_shows_the_same_texture() -> None:
    coarse, fine = (body(Hip, 1, n=n, texture=0.1, texture_mm=8.0) for n in (32, 96))
    mean = density(fine).reshape(32, 3, 32, 3, 32, 3).mean((1, 3, 5))
    alike = (tissues(fine).reshape(32, 3, 32, 3, 32, 3) == tissues(coarse)[:, None, :, None, :, None]).all((1, 3, 5))
    inside = alike & (coarse.labels > 0)
    # levels are 6.6 % apart: half a level of rounding, uniform, is 1.9 % and is drawn twice
    assert (density(coarse)[inside] - mean[inside]).std() < 0.03


def test_rays_meet_levels_as_they_meet_a_density_map() -> None:
    phantom = body(Teeth, 1, n=48, texture=0.1)
    assert make_columns(phantom) is not None  # a map of density has none
    names = tuple(dict.fromkeys(nominal(m)[0] for m in phantom.materials))
    labels = np.array([names.index(nominal(m)[0]) for m in phantom.materials], np.uint8)[phantom.labels]
    mapped = Phantom(
        labels=labels, materials=names, d_voxel=phantom.d_voxel, density=density(phantom).astype(np.float32)
    )
    assert make_columns(mapped) is None and make_bricks(mapped).density.size
    where = geometry(phantom)
    for view in range(3):
        split = path_lengths(Tracer.of(phantom), where, view)
        together = np.zeros((len(names), *split.shape[1:]))
        for name, length in zip(phantom.materials, split, strict=True):
            together[names.index(nominal(name)[0])] += nominal(name)[1] * length
        # lengths of up to 60 mm in float32, summed over a hundred voxels: 60·6e-8·100 mm
        assert np.allclose(together[1:], path_lengths(Tracer.of(mapped), where, view)[1:], atol=4e-4)
    mu = {m: MU * (1 + k) * nominal(m)[1] for k, m in ((names.index(nominal(m)[0]), m) for m in phantom.materials)}
    plain = {m: mu[m] / nominal(m)[1] for m in names}
    reference = attenuation_volume(phantom, where, mu)
    assert np.allclose(reference, attenuation_volume(mapped, where, plain), rtol=1e-5, atol=1e-8)
    flat = attenuation_volume(Phantom(labels=labels, materials=names, d_voxel=mapped.d_voxel), where, plain)
    assert np.abs(reference / np.where(flat > 0, flat, 1) - 1)[flat > 0].std() > 0.02  # it carries the texture


SCENE = """
name = "s"
phantom = {{ recipe = "teeth", n_voxel = [32, 32, 32], texture = {texture} }}
scanner = {{ n_voxel = [16, 16, 16], n_detector = [24, 24], n_views = 2 }}
truth = {{ paths = true, mono_kev = [60.0] }}
"""


@pytest.mark.parametrize("texture", [0.0, 0.06])
def test_labels_and_lengths_tell_tissues_and_not_their_levels(texture: float) -> None:
    (scene,) = parse_suite(SCENE.format(texture=texture))
    phantom, scanner = build_recipe(scene.phantom, 0), scene.resolve()
    plan = make_plan(phantom, scanner, Simulation(), scene.truth, "s")
    told = ("air", "soft_tissue", "cortical_bone", "dentin", "enamel", "Ti")
    assert plan.told == told == tuple(scan_info(plan, phantom, scanner)["materials"])
    assert len(plan.materials) == (1 + 4 * LEVELS + 1 if texture else len(told))
    assert ("7 densities" in plan.text()) == bool(texture) and "absent" not in plan.text()
    truth = dict(truth_volumes(plan, phantom, scanner))
    assert set(np.unique(truth["labels"])) <= set(range(len(told)))
    (_, first), _ = simulate_views(plan, phantom, scanner)
    (size,) = [o.shape for o in plan.outputs if o.name == "paths"]
    assert first["paths"].shape == size == (5, 24, 24)
    mu = np.array([attenuation(m, [60.0])[0] for m in told[1:]])
    # levels are named to six digits
    assert np.allclose(np.tensordot(mu, first["paths"], 1), first["mono_60kev"], rtol=1e-5, atol=1e-5)


def test_the_energies_serve_all_levels_together() -> None:
    plans = []
    for texture in (0.0, 0.06):
        (scene,) = parse_suite(SCENE.format(texture=texture))
        plans.append(make_plan(build_recipe(scene.phantom, 0), scene.resolve(), Simulation(), Truth(), "s"))
    assert abs(len(plans[0].rule.energies) - len(plans[1].rule.energies)) <= 1
    assert plans[1].error <= 2 * Simulation().tolerance


def test_a_name_with_a_density_is_the_material_at_that_density() -> None:
    other, muscle = material("muscle@1.2"), material("muscle")
    assert other.density == 1.2 and other.mass_fractions == muscle.mass_fractions
    assert np.array_equal(mass_attenuation("muscle@1.2", [60.0]), mass_attenuation("muscle", [60.0]))
    assert nominal("muscle@2.1") == ("muscle", 2.0) and nominal("NaI@0.3") == ("NaI@0.3", 1.0)
    assert material("NaI@3.67").density == 3.67


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"texture": 0.3}, "texture must be within 0.0 to 0.2"),
        ({"texture": math.nan}, "texture must be within"),
        ({"texture_mm": 0.1}, "texture_mm must be within size / 200"),
        ({"grid_shift": (0.0, 0.6, 0.0)}, "grid_shift must be within -0.5 to 0.5"),
        ({"grid_shift": (0.0, math.nan, 0.0)}, "grid_shift must be within"),
    ],
)
def test_what_cannot_be_drawn_is_refused(changes: dict, text: str) -> None:
    with pytest.raises(InputError, match=text):
        Lung(**changes)


def test_solids_and_ct_volumes_have_no_texture() -> None:
    validation = next(kind for kind in BUILDERS if kind.__struct_config__.tag == "validation")
    with pytest.raises(InputError, match="'validation' consists of solids"):
        build_recipe(validation(n_voxel=(8, 8, 8), texture=0.05), 0)
    with pytest.raises(InputError, match="texture: expected none"):
        CtVolume(path="x.npy", spacing=(1.0, 1.0, 1.0), sha256="a", texture=0.05)


SHIFT = (0.31, -0.17, 0.43)


def centroid(volume: np.ndarray, d: float) -> np.ndarray:
    total = volume.sum(dtype=np.float64)
    return np.array(
        [
            (volume.sum(tuple(a for a in range(3) if a != axis), dtype=np.float64) * (np.arange(k) + 0.5 - k / 2)).sum()
            * d
            / total
            for axis, k in enumerate(volume.shape)
        ]
    )


def test_references_on_a_shifted_grid_are_averages_over_their_voxels() -> None:
    n, size, radii, middle = 61, 60.0, np.array([14.0, 11.0, 17.0]), np.array([3.0, -5.0, 2.0])
    canvas = Canvas(LabelGrid(n=(n, n, n), d_voxel=(size / n,) * 3, shift=SHIFT))
    canvas.ellipsoid(1, middle / canvas.unit, radii / canvas.unit)  # x, y, z
    shift = tuple(s * size / n for s in SHIFT)
    phantom = Phantom(labels=canvas.labels, materials=("air", "water"), d_voxel=(size / n,) * 3, off_origin=(*shift,))
    where = geometry(phantom, 20)
    found = attenuation_volume(phantom, where, {"water": 1.0})
    fine = (np.arange(240) + 0.5 - 120) * size / 240
    inside = ((fine[None, None, :] - middle[0]) / radii[0]) ** 2 + (
        (fine[None, :, None] - middle[1]) / radii[1]
    ) ** 2 + ((fine[:, None, None] - middle[2]) / radii[2]) ** 2 < 1
    exact = inside.reshape(20, 12, 20, 12, 20, 12).mean((1, 3, 5))
    # a staircase of steps of 0.98 mm: the rms of its edge is 0.98/sqrt(12) = 0.28 mm, averaged over the (3/0.98)² steps
    # in a voxel's face 0.09 mm of 3 mm
    rim = (exact > 0) & (exact < 1)
    assert np.sqrt(((found - exact)[rim] ** 2).mean()) < 0.045
    assert np.abs(found - exact)[~rim].max() < 0.17  # a step reaches half of 0.98 mm into the next voxel of 3 mm
    # an unshifted reading of the labels would lie 0.16 to 0.42 mm off
    assert np.abs(centroid(found, 3.0) - middle[::-1]).max() < 0.03


@pytest.mark.parametrize("kind", [k for k in BUILDERS if k is not CtVolume], ids=lambda k: k.__struct_config__.tag)
def test_a_shifted_grid_shows_the_same_object_elsewhere_sampled(kind) -> None:
    plain, moved = (build_recipe(kind(n_voxel=(48, 48, 48), grid_shift=s), 1) for s in ((0.0, 0.0, 0.0), (0.5,) * 3))
    assert plain.solids == moved.solids
    if not plain.labels.any():
        return
    assert moved.off_origin == pytest.approx((0.625,) * 3) and not np.array_equal(plain.labels, moved.labels)
    where = geometry(plain, 40)
    mu = dict.fromkeys(plain.materials, 1.0)
    first, second = (attenuation_volume(p, where, mu) for p in (plain, moved))
    # half a voxel is 0.63 mm. Walls thinner than a voxel come and go, which moved the pepper's centre by 0.17 mm
    assert np.abs(centroid(first, 1.5) - centroid(second, 1.5)).max() < 0.2


def test_a_ct_volume_stays_where_it_is_on_a_shifted_grid(tmp_path) -> None:
    z, y, x = np.meshgrid(*((np.arange(40) - 19.5,) * 3), indexing="ij")
    np.save(tmp_path / "ball.npy", np.where((x - 3) ** 2 + (y + 4) ** 2 + z**2 < 100, 40, -1000).astype(np.int16))
    made = CtVolume(path=str(tmp_path / "ball.npy"), spacing=(1.0,) * 3, size=40.0, n_voxel=(36,) * 3, metal="none")
    for shift in ((0.0, 0.0, 0.0), SHIFT):
        phantom = build_recipe(msgspec.structs.replace(made, grid_shift=shift), 0)
        volume = attenuation_volume(phantom, geometry(phantom, 20), dict.fromkeys(phantom.materials, 1.0))
        # the file's own ball is a staircase of 1 mm; not shifted it would lie up to 0.48 mm off
        assert np.abs(centroid(volume, 2.0) - [0, -4, 3]).max() < 0.15


def test_texture_as_suites_have_it_neither_flatters_nor_harms_total_variation() -> None:
    """Methods that smooth would lead by more on bodies without texture; by a fifth of density they do lead by less."""

    def gain(texture: float) -> float:
        phantom = {"recipe": "lung", "metal": "Fe", "size": 60.0, "n_voxel": [71, 71, 71], "texture": texture}
        scanner = {"preset": "ideal", "n_voxel": [40, 40, 40], "n_detector": [80, 80], "n_views": 60, "i0": 1e5}
        scan = ctsim.simulate_scene(ctsim.new_scene(name="lung", phantom=phantom, scanner=scanner))
        volumes = (ctsim.reconstruct_scan(scan, method) for method in ("asd-pocs", "fdk"))
        scores = (ctsim.score_volume(volume, scan, protocols=["tissue"])["tissue"] for volume in volumes)
        smoothed, plain = (score.values["psnr3d"] for score in scores)
        return smoothed - plain

    smooth = gain(0.0)
    assert abs(gain(0.03) - smooth) < 0.15 < smooth - gain(0.2)
