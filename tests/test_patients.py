"""Hips, spines and restored jaws: bone under the skin, metal in bone and in touch, several metals in one body."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.materials import attenuation, material
from ctsim.phantoms.bodies.hip import Hip
from ctsim.phantoms.bodies.jaw import Jaw
from ctsim.phantoms.bodies.spine import Spine
from ctsim.phantoms.bodies.teeth import Teeth
from ctsim.phantoms.recipes import build_recipe
from ctsim.solids import Solid
from ctsim.tracer.voxelise import fractions
from ctsim.types import Phantom

N = 96
KINDS = pytest.mark.parametrize("kind", (Hip, Spine))
SEEDED = pytest.mark.parametrize("seed", (1, 2, 3))
BONES = ("cortical_bone", "spongiosa")
SIZE = 60.0
CAPPED = slice(int(N * 0.22), int(N * 0.78))  # slices between the planes in which these bodies are cut, and 1 mm


@cache
def body(kind, seed: int = 1, **changes) -> Phantom:
    return build_recipe(kind(n_voxel=(N, N, N), **changes), seed)


def part(phantom: Phantom, *names: str) -> NDArray[np.bool_]:
    return np.isin(phantom.labels, [phantom.materials.index(name) for name in names])


def grid(phantom: Phantom) -> Geometry:
    d = phantom.d_voxel
    detector = {"n_detector": (8, 8), "d_detector": (10.0, 10.0)}
    return Geometry(dso=500.0, dsd=900.0, n_voxel=(N, N, N), d_voxel=d, n_views=1, **detector)


def cells(phantom: Phantom, solids: list[Solid]) -> NDArray[np.bool_]:
    """Voxels that some of a phantom's solids fill by more than a tenth."""
    bare = Phantom(
        labels=np.zeros_like(phantom.labels),
        materials=phantom.materials,
        d_voxel=phantom.d_voxel,
        solids=tuple(solids),
    )
    return fractions(bare, grid(phantom))["air"] < 0.9


@KINDS
@SEEDED
def test_bone_and_metal_lie_deep_under_the_skin(kind, seed: int) -> None:
    phantom = body(kind, seed)
    inner = cells(phantom, list(phantom.solids))[CAPPED] | part(phantom, *BONES)[CAPPED]
    for shown, inside in zip(phantom.labels[CAPPED], inner, strict=True):
        filled = ndimage.binary_fill_holes(shown > 0)
        deep = ndimage.distance_transform_edt(np.pad(filled, 1), phantom.d_voxel[1:])[1:-1, 1:-1]
        # skin, fat and muscle: at least 2 mm in a 60 mm cube, 6 mm and more in a patient
        assert not inside.any() or deep[inside].min() > 2.0


@KINDS
@SEEDED
def test_the_body_is_one_piece_and_no_gas_lies_against_bone(kind, seed: int) -> None:
    phantom = body(kind, seed)
    _, n = ndimage.label(phantom.labels > 0)
    assert n == 1
    beside_air = ndimage.binary_dilation(phantom.labels == 0)
    assert not (part(phantom, *BONES) & beside_air)[CAPPED].any()
    assert not phantom.labels[: int(N * 0.2)].any()  # a slice: nothing beyond its planes
    assert not phantom.labels[-int(N * 0.2) :].any()


@SEEDED
def test_the_head_fills_its_cup_and_the_stem_stands_in_the_shaft(seed: int) -> None:
    phantom = body(Hip, seed)
    solids = {s.name: s for s in phantom.solids}
    assert {s.material for s in solids.values()} == {"Ti", "CoCr"} and len(solids) == 10
    for side in ("left", "right"):
        cup, head = (cells(phantom, [solids[f"{name}-{side}"]]) for name in ("cup", "head"))
        (ball,) = solids[f"head-{side}"].primitives
        assert ball.params[0] > 0.8 * max(p.radius for p in solids[f"cup-{side}"].primitives)
        assert (cup & head).any()  # the head lies in the cup: it is painted after it
        around = ndimage.binary_dilation(cup, iterations=2) & ~cup & ~head
        assert part(phantom, *BONES)[around].mean() > 0.35  # the socket about the dome; the rest is the open side
        stem = cells(phantom, [solids[f"stem-{side}"], solids[f"tip-{side}"]])
        assert (ndimage.binary_dilation(stem) & cells(phantom, [solids[f"neck-{side}"]])).any()
        low = stem & (np.arange(N) < N * 0.4)[:, None, None]
        assert low.any() and part(phantom, *BONES, "adipose")[low].all()  # marrow or bone, not muscle
    assert sum("left" in name for name in (s.name for s in body(Hip, seed, n_inserts=1).solids)) == 5


@SEEDED
def test_screws_run_through_pedicles_and_rods_through_their_heads(seed: int) -> None:
    phantom = body(Spine, seed)
    assert {s.material for s in phantom.solids} == {"Ti", "CoCr"}
    rods = {s.name: s for s in phantom.solids if s.material == "CoCr"}
    assert set(rods) == {"rod-left", "rod-right"}
    for solid in phantom.solids:
        if solid.name.startswith("head"):
            side = "left" if "left" in solid.name else "right"
            gap = np.array([p.centre for p in rods[f"rod-{side}"].primitives])
            (head,) = solid.primitives
            ends = [gap[k] - head.centre for k in range(len(gap))]
            assert min(np.linalg.norm(e[:2]) for e in ends) < head.params[1]  # its axis passes within the head
        if solid.name.startswith("screw"):
            shank = cells(phantom, [solid])
            assert part(phantom, *BONES, "adipose")[shank].mean() > 0.9  # marrow counts as bone
            canal = part(phantom, "soft_tissue") & shank
            assert canal.mean() < 1e-5  # never in the dural sac
    assert len(body(Spine, seed, n_inserts=3).solids) == 3 * 2 + 1  # the third vertebra's side has one head: no rod


@SEEDED
@pytest.mark.parametrize("kind", [Teeth, Jaw])
def test_restorations_sit_in_teeth_and_need_free_ones(kind: type[Teeth], seed: int) -> None:
    plain = body(kind, seed)
    full = body(kind, seed, fillings=4, gold_crowns=2, bridges=1)
    assert np.array_equal(plain.labels, full.labels) and full.solids[: len(plain.solids)] == plain.solids
    more = full.solids[len(plain.solids) :]
    assert [s.material for s in more] == ["CoCr"] + ["Au"] * 2 + ["amalgam"] * 4
    assert all(s.metal for s in more)
    for solid in more:
        inside = cells(full, [solid])
        if solid.material == "CoCr":
            assert ndimage.label(inside)[1] == 1  # one piece over three teeth
        else:
            assert part(full, "enamel", "dentin")[inside].mean() > 0.5, solid.name
    others = [s for s in more if s.material == "amalgam"]
    metal = cells(full, [s for s in full.solids if s not in others])
    assert not any((cells(full, [s]) & metal).sum() > 0.2 * cells(full, [s]).sum() for s in others)
    with pytest.raises(InputError, match="fillings: 12 are asked for"):
        body(kind, seed, fillings=12, bridges=2, missing=10)
    assert not any(s.metal for s in body(kind, seed, metal="none", fillings=4, bridges=2).solids)


def shares(phantom: Phantom, where: NDArray[np.bool_]) -> dict[str, float]:
    """What a region consists of, by material."""
    counts = np.bincount(phantom.labels[where], minlength=len(phantom.materials))
    return dict(zip(phantom.materials, counts / counts.sum(), strict=True))


@SEEDED
def test_a_jaw_has_the_tissues_of_a_face(seed: int) -> None:
    phantom = body(Jaw, seed)
    filled = phantom.labels > 0
    whole = shares(phantom, filled)
    # no tissue is a trace, none is nearly all
    assert all(0.1 < whole[name] < 0.4 for name in ("soft_tissue", "adipose", "muscle"))
    assert 0.005 < whole["blood"] < 0.05
    side = np.arange(N) < N / 2
    assert all(0.3 < part(phantom, "blood")[:, :, half].mean() / part(phantom, "blood").mean() / 2 < 0.7
               for half in (side, ~side))  # fmt: skip
    # under the surface: skin 1.2 to 1.5 mm thick, then mostly fat, then mostly muscle
    outer = np.stack([np.pad(ndimage.binary_fill_holes(layer), 1) for layer in filled])
    deep = np.stack([ndimage.distance_transform_edt(layer, phantom.d_voxel[1:])[1:-1, 1:-1] for layer in outer])
    deep[: int(N * 0.2)] = deep[-int(N * 0.2) :] = 0  # above and below, bone comes near to the planes of the cut
    assert shares(phantom, (deep > 0) & (deep < 0.8))["soft_tissue"] > 0.95
    assert shares(phantom, (deep > 1.7) & (deep < 2.5))["adipose"] > 0.5
    assert shares(phantom, (deep > 4.5) & (deep < 6))["muscle"] > 0.3
    assert deep[part(phantom, *BONES) & (deep > 0)].min() > 1.2


@SEEDED
def test_a_jaw_has_bones_with_marrow_and_roots_in_ligaments(seed: int) -> None:
    phantom = body(Jaw, seed)
    core = part(phantom, "spongiosa")
    around = shares(phantom, ndimage.binary_dilation(core) & ~core)
    assert around["muscle"] + around["blood"] + around["air"] < 0.01
    inner = shares(phantom, ndimage.binary_closing(core, iterations=2))
    assert inner["adipose"] > 1.3 * inner["cortical_bone"] > 0.05  # marrow, and fewer struts
    compact = part(phantom, "cortical_bone")
    lower, upper = slice(int(N * 0.1), int(N * 0.4)), slice(int(N * 0.6), int(N * 0.9))
    assert all(compact[half].mean() > 0.04 and core[half].mean() > 0.04 for half in (lower, upper))
    # the branch behind the teeth, on both sides, and the palate between the arches
    back = (slice(int(N * 0.45), int(N * 0.55)), slice(int(N * 0.2), int(N * 0.26)))
    assert all(compact[(*back, half)].any() for half in (slice(None, N // 2), slice(N // 2, None)))
    assert compact[upper, int(N * 0.45) : int(N * 0.55), int(N * 0.47) : int(N * 0.53)].mean() > 0.05
    fine = build_recipe(Jaw(n_voxel=(192, 192, 192)), seed)  # a ligament is 0.4 mm thick
    roots = part(fine, "dentin")
    roots[int(192 * 0.42) : int(192 * 0.58)] = False  # crowns
    shell = ndimage.binary_dilation(roots) & ~part(fine, "dentin", "enamel")
    assert shares(fine, shell)["soft_tissue"] > 0.7


@SEEDED
def test_the_mouth_is_open_to_the_throat_and_lined(seed: int) -> None:
    phantom = body(Jaw, seed)
    gas, _ = ndimage.label(phantom.labels == 0)
    sizes = np.bincount(gas.ravel())
    sizes[[0, gas[0, 0, 0]]] = 0
    largest = gas == np.argmax(sizes)
    assert largest.sum() * np.prod(phantom.d_voxel) > 5000  # mm3: the mouth
    assert all(largest[int(N * level), : int(N * 0.24)].any() for level in (0.2, 0.5, 0.8))  # the throat
    assert largest[:, int(N * 0.7) :].any()  # before the teeth
    inner = (gas > 0) & (gas != gas[0, 0, 0])
    bare = shares(phantom, ndimage.binary_dilation(inner) & ~inner)
    assert bare["soft_tissue"] + bare["enamel"] + bare["dentin"] > 0.97
    assert bare["cortical_bone"] + bare["spongiosa"] + bare["blood"] < 0.001
    tongue = np.zeros_like(inner)
    middle = slice(int(N * 0.45), int(N * 0.55))
    tongue[int(N * 0.38) : int(N * 0.5), int(N * 0.35) : int(N * 0.55), middle] = True
    made_of = shares(phantom, tongue & (phantom.labels > 0))
    assert made_of["muscle"] > 0.6 and made_of["adipose"] > 0.05  # with a septum of fat


@SEEDED
def test_metal_in_a_jaw_stands_apart_and_in_bone(seed: int) -> None:
    phantom = body(Jaw, seed, fillings=5, gold_crowns=2, bridges=1)
    pieces = {s.name: cells(phantom, [s]) for s in phantom.solids if not s.name.startswith("abutment")}
    for name, inside in pieces.items():
        if name.startswith("implant"):
            held = shares(phantom, inside)
            assert sum(held[m] for m in (*BONES, "adipose", "dentin", "enamel")) > 0.95, name
        for other, there in pieces.items():
            assert name == other or (inside & there).sum() <= 0.05 * min(inside.sum(), there.sum()), (name, other)


@SEEDED
def test_a_plug_lies_where_the_artery_enters_the_kidney(seed: int) -> None:
    plain, full = body(Spine, seed), body(Spine, seed, plug="W")
    assert np.array_equal(plain.labels, full.labels) and full.solids[:-1] == plain.solids
    plug = full.solids[-1]
    assert (plug.material, plug.metal) == ("W", True)
    inside = cells(full, [plug])
    assert part(full, "adipose", "blood", "soft_tissue", "kidney")[inside].all()
    grown = ndimage.binary_dilation(inside, iterations=2)
    assert part(full, "kidney")[grown].any() and part(full, "blood")[grown].any()
    assert body(Spine, seed, metal="none", plug="W").solids == ()


@SEEDED
@KINDS
def test_a_body_is_as_tall_as_it_says(kind: type[Hip] | type[Spine], seed: int) -> None:
    phantom = body(kind, seed)
    half = kind.height * SIZE / 2
    z = (np.arange(N) + 0.5) * SIZE / N - SIZE / 2
    for filled in (phantom.labels > 0, cells(phantom, list(phantom.solids))):
        assert np.abs(z[filled.any((1, 2))]).max() <= half
    assert np.abs(z[phantom.labels.any((1, 2))]).max() > half - SIZE / N


def test_the_second_metal_is_checked_and_told() -> None:
    for kind, key in ((Hip, "head"), (Spine, "rods"), (Spine, "plug")):
        with pytest.raises(InputError, match=f"^{key}: unknown material"):
            kind(**{key: "CoCrr"})
        assert any(s.material == "W" for s in body(kind, 1, **{key: "W"}).solids)


def test_amalgam_lies_between_its_metals() -> None:
    energies = np.array([40.0, 60.0, 100.0])
    mercury, silver, amalgam = (attenuation(m, energies) for m in ("Hg", "Ag", "amalgam"))
    assert sum(material("amalgam").mass_fractions.values()) == pytest.approx(1)
    assert (amalgam > 0.5 * np.minimum(mercury, silver)).all() and (amalgam < np.maximum(mercury, silver)).all()
