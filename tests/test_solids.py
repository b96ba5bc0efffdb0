"""Ray intervals of analytic solids: closed-form chords, the reference, and volumes by Cavalieri."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ctsim.errors import InputError
from ctsim.solids import BOX, CAPSULE, ELLIPSOID, FRUSTUM, TORUS, Primitive, Solid, pack
from ctsim.tracer.kernels import solids_cpu, solids_reference

KINDS = {
    "sphere": (ELLIPSOID, (2.0, 2.0, 2.0)),
    "ellipsoid": (ELLIPSOID, (1.0, 2.5, 4.0)),
    "needle": (ELLIPSOID, (0.01, 0.02, 100.0)),
    "cylinder": (FRUSTUM, (3.0, 1.5, 1.5)),
    "rod": (FRUSTUM, (100.0, 0.01, 0.01)),
    "disc": (FRUSTUM, (0.01, 100.0, 100.0)),
    "cone": (FRUSTUM, (3.0, 0.0, 2.0)),
    "frustum": (FRUSTUM, (1.0, 2.5, 0.5)),
    "flat cone": (FRUSTUM, (0.01, 0.0, 100.0)),
    "capsule": (CAPSULE, (3.0, 1.0)),
    "wire": (CAPSULE, (100.0, 0.05)),
    "ball": (CAPSULE, (0.0, 2.0)),
    "box": (BOX, (1.0, 2.0, 3.5)),
    "sheet": (BOX, (100.0, 0.01, 30.0)),
    "torus": (TORUS, (3.0, 1.0)),
    "ring": (TORUS, (100.0, 0.02)),
    "bun": (TORUS, (1.0, 0.99)),
}
VOLUMES = {
    "sphere": 4 / 3 * math.pi * 8,
    "ellipsoid": 4 / 3 * math.pi * 10,
    "cylinder": math.pi * 1.5**2 * 6,
    "cone": math.pi / 3 * 6 * 4,
    "frustum": math.pi / 3 * 2 * (2.5**2 + 2.5 * 0.5 + 0.5**2),
    "capsule": math.pi * 6 + 4 / 3 * math.pi,
    "box": 56.0,
    "torus": 2 * math.pi**2 * 3,
}


def primitive(name, centre=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), spin=0.0):
    kind, params = KINDS[name]
    return Primitive(kind=kind, params=params, centre=centre, axis=axis, spin=spin)


def intervals(module, row, origin, direction):
    out = np.zeros(4)
    n = module.intersect(row, *map(float, origin), *map(float, direction), out)
    return out[: 2 * n].reshape(-1, 2)


def chord(row, origin, direction):
    return float(np.diff(intervals(solids_cpu, row, origin, direction)).sum())


def rays_at(rng, prim, n, distance=1500.0):
    """Random rays from `distance` mm that pass near the primitive: half of them at points inside its box."""
    towards = rng.normal(size=(n, 3))
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    params = prim.params
    box = {
        ELLIPSOID: params[:3],
        BOX: params[:3],
        FRUSTUM: (max(params[1:]),) * 2 + params[:1],
        CAPSULE: (params[1], params[1], params[0] + params[1]) if prim.kind == CAPSULE else (),
        TORUS: (sum(params[:2]),) * 2 + params[1:2],
    }[prim.kind]
    local = rng.uniform(-1.1, 1.1, (n, 3)) * np.array(box)
    if prim.kind == TORUS:  # most points of a thin ring's box are nowhere near it
        angle, off = rng.uniform(0, 2 * np.pi, n), rng.uniform(-1.2, 1.2, (n, 2)) * params[1]
        rho = params[0] + off[:, 0]
        local[::2] = np.stack([rho * np.cos(angle), rho * np.sin(angle), off[:, 1]], 1)[::2]
    target = local @ prim.rotation() + prim.centre
    origin = target - distance * towards
    return origin, towards


X, Y, Z = np.eye(3)
DIAGONAL = np.array([1.0, 1.0, 0.0]) / math.sqrt(2)
SPACE = np.ones(3) / math.sqrt(3)
H = math.sqrt(0.5)

CHORDS = [
    ("sphere", (0, 0, 0), X, 4.0),
    ("sphere", (0, 1, 0), X, 2 * math.sqrt(3)),
    ("sphere", (0, 2, 0), X, 0.0),
    ("ellipsoid", (0, 0, 0), Z, 8.0),
    ("ellipsoid", (0.6, 0, 0), Y, 4.0),
    ("cylinder", (0, 0, 0), X, 3.0),
    ("cylinder", (1.2, 0, 0), Y, 1.8),
    ("cylinder", (1.4, 0, 0), Z, 6.0),
    ("cylinder", (1.6, 0, 0), Z, 0.0),
    ("cylinder", (0, 0, 0), (H, 0, H), 3 * math.sqrt(2)),
    ("cone", (0, 0, 0), Z, 6.0),  # through the tip
    ("cone", (1, 0, 0), Z, 3.0),
    ("cone", (0, 0, 0), X, 2.0),
    ("cone", (0, 0, -3), X, 0.0),  # touches the tip
    ("frustum", (0, 0, 0), Z, 2.0),
    ("frustum", (1.5, 0, 0), Z, 1.0),
    ("capsule", (0, 0, 0), Z, 8.0),
    ("capsule", (0.6, 0, 0), Z, 6 + 1.6),
    ("capsule", (0, 0, 2), X, 2.0),
    ("capsule", (0, 0, 3.6), X, 1.6),
    ("ball", (0, 0, 1), X, 2 * math.sqrt(3)),
    ("box", (0, 0, 0), X, 2.0),
    ("box", (0.999, 1.999, 0), Z, 7.0),
    ("box", (1.001, 0, 0), Z, 0.0),
    ("box", (0, 0, 0), DIAGONAL, 2 * math.sqrt(2)),
    ("box", (0, 0, 0), SPACE, 2 * math.sqrt(3)),
    ("torus", (0, 0, 0), X, 4.0),  # both sides of the ring
    ("torus", (0, 0, 0), Z, 0.0),  # through the hole
    ("torus", (3, 0, 0), Z, 2.0),
    ("torus", (0, 0, 0.6), X, 3.2),
    ("torus", (0, 3, 0), X, 2 * math.sqrt(7)),
    ("torus", (0, 2, 0), X, 2 * math.sqrt(12)),  # tangent to the inner equator
    ("torus", (0, 4, 0), X, 0.0),  # tangent to the outer equator
    ("torus", (2.4, 0, 0), Z, 1.6),
]


@pytest.mark.parametrize(("name", "point", "direction", "expected"), CHORDS)
@pytest.mark.parametrize("distance", [0.0, 1500.0])
def test_chord_has_its_closed_form(name, point, direction, expected, distance):
    origin = np.asarray(point, float) - distance * np.asarray(direction)
    # At a tangent an error e of the ray's offset makes a chord of sqrt(8·R·e): 3e-6 mm for 3e-13 mm.
    tolerance = 1e-9 if expected else 5e-6
    assert chord(primitive(name).row(1), origin, direction) == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize("module", [solids_cpu, solids_reference])
def test_intervals_start_and_end_on_the_surface(module):
    got = intervals(module, primitive("torus").row(1), (-10, 0, 0), X)
    np.testing.assert_allclose(got, [[6, 8], [12, 14]], atol=1e-12)
    got = intervals(module, primitive("sphere", centre=(1, 2, 3)).row(1), (1, 2, 3), Z)
    np.testing.assert_allclose(got, [[-2, 2]], atol=1e-12)


def agree(row, origin, direction):
    """Chord of both within 1e-6 mm; near a tangent, that of rays within 2e-12 mm of the given one.

    The direction's rounding alone moves the ray by 1500 mm · 1e-16 at the solid. Where the chord
    changes faster than linearly with the offset the two may differ by what that offset does.
    """
    fast = intervals(solids_cpu, row, origin, direction)
    slow = intervals(solids_reference, row, origin, direction)
    if fast.shape == slow.shape and np.allclose(fast, slow, rtol=0, atol=1e-6):
        return True
    total, e = np.diff(fast).sum(), 2e-12
    near = [
        np.diff(intervals(solids_reference, row, np.add(origin, offset), direction)).sum()
        for offset in (e * np.array([i, j, k]) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1))
    ]
    return min(near) - 1e-6 <= total <= max(near) + 1e-6


@pytest.mark.parametrize("name", KINDS)
def test_random_rays_agree_with_the_reference(name):
    rng = np.random.default_rng(sum(map(ord, name)))
    hits = 0
    for axis in [(0, 0, 1), (1, 0, 0), (0.3, -0.5, 0.7)]:
        prim = primitive(name, centre=(3.0, -20.0, 11.0), axis=axis, spin=0.4)
        row = prim.row(1)
        for origin, direction in zip(*rays_at(rng, prim, 60), strict=True):
            assert agree(row, origin, direction), (origin, direction)
            hits += len(intervals(solids_cpu, row, origin, direction)) > 0
    assert hits > 40  # the rays do meet the solid


@pytest.mark.parametrize("name", KINDS)
def test_special_rays_agree_with_the_reference(name):
    """Rays along local axes and diagonals, through centres, edges and near-parallel to every axis."""
    prim = primitive(name)
    row, size = prim.row(1), np.array([*prim.params, 1.0, 1.0])[:3]
    tilts = [0.0, 1e-14, 1e-9, 1e-4]
    for base in (X, Y, Z, -X, -Z, DIAGONAL, SPACE):
        for tilt in tilts:
            direction = base + tilt * np.array([0.3, 0.5, 0.7])
            direction /= np.linalg.norm(direction)
            for scale in (0.0, 0.37, 0.999):
                # Planes of faces themselves are excluded: there "in" or "out" is a matter of convention.
                origin = scale * size * np.array([0.9, 0.8, 0.7]) - 700 * direction
                assert agree(row, origin, direction), (base, tilt, scale)


@pytest.mark.parametrize("name", KINDS)
def test_rays_that_are_done_together_meet_to_the_bit_what_each_meets_alone(name):
    rng, n = np.random.default_rng(8), 45
    prim = primitive(name, centre=(3.0, -20.0, 11.0), axis=(0.3, -0.5, 0.7), spin=0.4)
    row = prim.row(1)
    origin = prim.centre + rng.normal(size=3) * 4 * prim.radius
    aims = prim.centre + rng.uniform(-1.2, 1.2, (n, 3)) * prim.radius
    aims[:3] = origin + row[2:11].reshape(3, 3)  # along its own axes
    middle = prim.centre + row[2:5] * (prim.params[0] if prim.kind == TORUS else 0.0)
    aims[3:9] = middle + rng.normal(size=(6, 3)) * 0.003
    directions = aims - origin
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    local, spans = np.zeros((10, n)), np.full((2, 2, n), np.nan)
    local[:3] = directions.T
    solids_cpu.intersect_rays.compiled(row, n, origin, local, spans)
    pairs = 2 if prim.kind == TORUS else 1
    for i, direction in enumerate(directions):
        together = [spans[k, :, i] for k in range(pairs) if spans[k, 1, i] > spans[k, 0, i]]
        np.testing.assert_array_equal(np.reshape(together, (-1, 2)), intervals(solids_cpu, row, origin, direction))
    assert 4 < sum(spans[0, 1] > spans[0, 0]) < n


@settings(max_examples=150, deadline=None)
@given(
    name=st.sampled_from(sorted(KINDS)),
    seed=st.integers(0, 2**32 - 1),
    scale=st.sampled_from([0.005, 0.1, 1.0]),
)
def test_intervals_are_finite_ordered_and_inside(name, seed, scale):
    rng = np.random.default_rng(seed)
    kind, params = KINDS[name]
    params = tuple(max(p * scale, 0.01) if p else 0.0 for p in params)
    axis = rng.normal(size=3)
    prim = Primitive(kind=kind, params=params, centre=tuple(rng.uniform(-50, 50, 3)), axis=tuple(axis))
    row = prim.row(1)
    origins, directions = rays_at(rng, prim, 20, distance=rng.uniform(0, 1500))
    for origin, direction in zip(origins, directions, strict=True):
        got = intervals(solids_cpu, row, origin, direction)
        assert np.isfinite(got).all()
        assert (np.diff(got.ravel()) > 0).all()
        for t0, t1 in got:
            if t1 - t0 > 1e-6:
                middle = origin + 0.5 * (t0 + t1) * direction
                assert solids_cpu.inside(row, *middle)
                assert solids_reference.inside(row, *middle)
                before, after = origin + (t0 - 1e-3) * direction, origin + (t1 + 1e-3) * direction
                for p in (before, after):
                    t = (p - origin) @ direction
                    if not any(a - 1e-9 <= t <= b + 1e-9 for a, b in got):
                        assert not solids_cpu.inside(row, *p)


@pytest.mark.parametrize("name", VOLUMES)
def test_chords_integrate_to_the_volume(name):
    """Cavalieri: parallel chords over the shadow's plane, midpoint rule on 161² rays, tilted solid.

    The midpoint rule's error for chords ending like a square root is h^1.5 of the edge length: below 0.4 %.
    """
    prim = primitive(name, axis=(0.3, -0.5, 0.7), spin=0.3)
    row, n, reach = prim.row(1), 161, prim.radius
    grid = (np.arange(n) + 0.5) / n * 2 * reach - reach
    total = sum(chord(row, (-50.0, y, z), X) for y in grid for z in grid)
    assert total * (2 * reach / n) ** 2 == pytest.approx(VOLUMES[name], rel=4e-3)


@pytest.mark.parametrize("name", KINDS)
def test_inside_agrees_with_the_reference(name):
    rng = np.random.default_rng(5)
    prim = primitive(name, centre=(1.0, 2.0, -3.0), axis=(0.2, 0.9, -0.4), spin=1.0)
    row = prim.row(1)
    params = np.array([*prim.params, max(prim.params)])[:3]
    points = rng.uniform(-1.3, 1.3, (400, 3)) * params.max() * rng.uniform(0, 1, (400, 1)) + prim.centre
    both = [(solids_cpu.inside(row, *p), solids_reference.inside(row, *p)) for p in points]
    assert all(a == b for a, b in both)


def test_pack_orders_and_drops_flat_primitives():
    flat = Primitive(kind=BOX, centre=(0, 0, 0), params=(1.0, 0.0, 1.0))
    solid = Solid(name="a", material="Fe", primitives=(primitive("sphere"), flat, primitive("box")))
    rows = pack([solid], ("air", "Fe"))
    assert rows[:, 0].tolist() == [ELLIPSOID, BOX]
    assert rows[:, 1].tolist() == [1, 1]
    with pytest.raises(InputError, match="not among"):
        pack([solid], ("air", "Ti"))
    assert pack([], ("air",)).shape == (0, 22)
