"""Named solids: volumes and extents in closed form, and refusals."""

import math

import numpy as np
import pytest

from ctsim.errors import InputError
from ctsim.phantoms import shapes
from ctsim.solids import Solid, pack
from ctsim.tracer.kernels import solids_cpu

TILT = (0.3, -0.5, 0.7)


def contains(solid: Solid, point) -> bool:
    return any(solids_cpu.inside(row, *map(float, point)) for row in pack([solid], (solid.material,)))


def along(solid: Solid, origin, direction) -> float:
    """Length of the union of the solid's intervals along a ray."""
    out, spans = np.zeros(4), []
    for row in pack([solid], (solid.material,)):
        n = solids_cpu.intersect(row, *map(float, origin), *map(float, direction), out)
        spans += [tuple(out[2 * i : 2 * i + 2]) for i in range(n)]
    total, end = 0.0, -math.inf
    for t0, t1 in sorted(spans):
        total += max(t1 - max(t0, end), 0.0)
        end = max(end, t1)
    return total


def volume(solid: Solid, reach: float, n: int = 101) -> float:
    grid = (np.arange(n) + 0.5) / n * 2 * reach - reach
    return sum(along(solid, (-200.0, y, z), (1, 0, 0)) for y in grid for z in grid) * (2 * reach / n) ** 2


VOLUMES = [
    (shapes.sphere("a", "Fe", 2.0), 4 / 3 * math.pi * 8),
    (shapes.ellipsoid("a", "Fe", (1.0, 2.0, 3.0), axis=TILT), 8 * math.pi),
    (shapes.cylinder("a", "Fe", (1.5, 4.0), axis=TILT), math.pi * 2.25 * 4),
    (shapes.capsule("a", "Fe", (1.0, 5.0), axis=TILT), math.pi * 3 + 4 / 3 * math.pi),
    (shapes.cone("a", "Fe", (1.5, 0.5, 4.0), axis=TILT), math.pi / 3 * 4 * (2.25 + 0.75 + 0.25)),
    (shapes.box("a", "Fe", (1.0, 2.0, 3.0), axis=TILT, spin=0.4), 6.0),
    (shapes.torus("a", "Fe", (2.0, 0.7), axis=TILT), 2 * math.pi**2 * 2 * 0.49),
    # a half ball, the half that the shank enters less the shank's bore (a cap and a cylinder), shank and point
    (
        shapes.pin("a", "Fe", (2.0, 1.2), (2.0, 1.5), axis=TILT),
        math.pi * (2 / 3 + 2 / 3 * 0.8**3 + 0.36 * (2.0 + 0.5)),
    ),
    # head, then per turn two frusta between core and outer
    (
        shapes.screw("a", "Ti", (4.0, 2.0, 1.0), (0.5, 2.0, 1.0), axis=TILT),
        math.pi * (4 * 0.5 + 2 / 3 * (1 + 0.5 + 0.25)),
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("solid", "expected"), VOLUMES)
def test_volume_has_its_closed_form(solid, expected):
    # Midpoint rule over 101² chords: 1 % bounds its error for all of these; a wrong size is off by far more.
    assert volume(solid, 3.6) == pytest.approx(expected, rel=1e-2)
    assert solid.metal and solid.name == "a"


def test_placement():
    rod = shapes.cylinder("rod", "Fe", (0.5, 4.0), centre=(1.0, 2.0, 3.0), axis=(0, 1, 0), metal=False)
    assert not rod.metal
    assert contains(rod, (1, 3.99, 3)) and not contains(rod, (1, 4.01, 3)) and not contains(rod, (1, 2, 3.51))
    cone = shapes.cone("c", "Fe", (0.0, 2.0, 4.0))
    assert contains(cone, (1.9, 0, 1.99)) and not contains(cone, (1.9, 0, -1.99))
    pin = shapes.pin("p", "Fe", (2.0, 1.0), (3.0, 1.0), centre=(0, 0, 5.0), axis=(0, 0, -1))
    assert contains(pin, (0.49, 0, 2.01)) and contains(pin, (0, 0, 1.01)) and not contains(pin, (0, 0, 0.99))
    assert contains(pin, (0, 0, 5.99)) and contains(pin, (0.99, 0, 5.0)) and not contains(pin, (0.51, 0, 3.9))


def test_rivet():
    rivet = shapes.rivet("r", "Al", (3.0, 1.0, 2.0), (0.8, 4.0, 0.6), axis=(0, 0, 2.0))
    assert along(rivet, (0, 0, -50), (0, 0, 1)) == pytest.approx(5.4, abs=1e-9)
    widths = [along(rivet, (-50, 0, z), (1, 0, 0)) for z in (0, 2, 4)]
    assert widths == pytest.approx([3.0, 1.0, 2.0], abs=1e-9)


def test_screw_has_its_thread():
    screw = shapes.screw("s", "Ti", (4.0, 2.0, 1.0), (0.5, 3.2, 1.0))  # 3 turns: 3.2 mm hold 3.2 pitches
    # just beyond each join: the face itself belongs to either piece or, by rounding, to none
    heights = np.array([0.25, 0.5, 0.5 + 3.2 / 6, 0.5 + 3.2 / 4, 0.5 + 3.2 / 3, 0.5 + 3.2 / 2, 3.7 - 2e-9]) + 1e-9
    widths = [along(screw, (-50, 0, z), (1, 0, 0)) for z in heights]
    np.testing.assert_allclose(widths, [4, 1, 2, 1.5, 1, 2, 1], atol=1e-6)
    assert along(screw, (0, 0, -50), (0, 0, 1)) == pytest.approx(3.7, abs=1e-9)


@pytest.mark.parametrize("taper", [0.5, 0.0])
def test_screw_narrows_to_its_tip(taper):
    screw = shapes.screw("s", "Ti", (4.0, 2.0, 1.0), (0.5, 3.0, 1.0), taper=taper)
    # crests at 1/6, 1/2 and 5/6 of the shank, where the diameter has fallen by that part of 1 - taper
    parts = (1 / 6, 1 / 2, 5 / 6)
    crests = [along(screw, (-50, 0, 0.5 + 3 * part + 1e-9), (1, 0, 0)) for part in parts]
    assert crests == pytest.approx([2 * (1 - (1 - taper) * part) for part in parts], abs=1e-8)
    assert along(screw, (-50, 0, 3.5 - 1e-9), (1, 0, 0)) == pytest.approx(taper * 1.0, abs=1e-6)


def test_wire_joins_its_points():
    wire = shapes.wire("w", "Fe", [(0, 0, 0), (5, 0, 0), (5, 4, 0)], 0.3)
    assert len(wire.primitives) == 2
    assert along(wire, (-50, 0, 0), (1, 0, 0)) == pytest.approx(5.6, abs=1e-9)
    assert along(wire, (5, -50, 0), (0, 1, 0)) == pytest.approx(4.6, abs=1e-9)
    assert contains(wire, (5.2, -0.2, 0)) and not contains(wire, (5.25, -0.25, 0))  # round joint


@pytest.mark.parametrize("sagitta", [0.1, 0.01])
def test_helix_stays_within_its_sagitta(sagitta):
    centre, (coil, radius, length), turns = np.array([1.0, -2.0, 3.0]), (5.0, 0.4, 8.0), 2.5
    helix = shapes.helix("h", "Fe", (coil, coil, radius, length), turns, centre=tuple(centre), sagitta=sagitta)
    middles = np.array([p.centre for p in helix.primitives]) - centre
    inward = coil - np.hypot(middles[:, 0], middles[:, 1])
    assert 0 < inward.max() <= sagitta * (1 + 1e-9)
    assert inward.max() > sagitta / 2  # no more pieces than needed
    angles = 2 * math.pi * turns * (middles[:, 2] / length + 0.5)
    turned = np.cos(angles) * middles[:, 0] + np.sin(angles) * middles[:, 1]
    np.testing.assert_allclose(turned, coil, atol=sagitta * 1.001)
    assert abs(middles[:, 2]).max() < length / 2


def test_helix_widens_from_end_to_end():
    helix = shapes.helix("h", "Fe", (2.0, 5.0, 0.4, 8.0), 2.0)
    first, *_, last = (np.array(p.centre) for p in helix.primitives)
    # the first and last middles lie half a piece from the ends: 3 mm over 2n pieces, and the sagitta inside
    slack = 3 / (2 * len(helix.primitives)) + 0.01
    assert math.hypot(*first[:2]) == pytest.approx(2.0, abs=slack) and first[2] < 0
    assert math.hypot(*last[:2]) == pytest.approx(5.0, abs=slack) and last[2] > 0


@pytest.mark.parametrize(
    "make",
    [
        lambda: shapes.sphere("a", "Fe", 0.0),
        lambda: shapes.sphere("a", "Fe", math.nan),
        lambda: shapes.ellipsoid("a", "Fe", (1.0, -1.0, 1.0)),
        lambda: shapes.cylinder("a", "Fe", (1.0, 0.0)),
        lambda: shapes.cylinder("a", "Fe", (1.0, 1.0), axis=(0, 0, 0)),
        lambda: shapes.cylinder("a", "Fe", (1.0, 1.0), centre=(0, math.inf, 0)),
        lambda: shapes.capsule("a", "Fe", (1.0, 1.9)),
        lambda: shapes.cone("a", "Fe", (0.0, 0.0, 1.0)),
        lambda: shapes.cone("a", "Fe", (1.0, -0.1, 1.0)),
        lambda: shapes.box("a", "Fe", (1.0, 1.0, math.inf)),
        lambda: shapes.torus("a", "Fe", (1.0, 1.0)),
        lambda: shapes.wire("a", "Fe", [(0, 0, 0)], 1.0),
        lambda: shapes.wire("a", "Fe", [(0, 0, 0), (0, 0, 0)], 1.0),
        lambda: shapes.wire("a", "Fe", [(0, 0, 0), (0, 0, math.nan)], 1.0),
        lambda: shapes.helix("a", "Fe", (5.0, 5.0, 0.4, 8.0), 2.0, sagitta=0.0),
        lambda: shapes.helix("a", "Fe", (5.0, 5.0, 0.4, 8.0), 1e9),
        lambda: shapes.helix("a", "Fe", (5.0, 5.0, 0.4, -8.0), 2.0),
        lambda: shapes.screw("a", "Fe", (4.0, 1.0, 2.0), (1.0, 5.0, 1.0)),
        lambda: shapes.screw("a", "Fe", (4.0, 2.0, 1.0), (1.0, 0.5, 1.0)),
        lambda: shapes.screw("a", "Fe", (4.0, 2.0, 1.0), (1.0, 5.0, 1.0), axis=(0, 0, 0)),
        lambda: shapes.screw("a", "Fe", (4.0, 2.0, 1.0), (1.0, 5.0, 1e-4)),
        lambda: shapes.screw("a", "Fe", (4.0, 2.0, 1.0), (1.0, 5.0, 1.0), taper=1.1),
        lambda: shapes.helix("a", "Fe", (0.0, 5.0, 0.4, 8.0), 2.0),
        lambda: shapes.rivet("a", "Fe", (1.0, 1.0, 2.0), (1.0, 1.0, 1.0)),
        lambda: shapes.rivet("a", "Fe", (2.0, 1.0, 1.0), (1.0, 1.0, 1.0)),
        lambda: shapes.pin("a", "Fe", (2.0, 1.0), (1.0, 0.0)),
        lambda: shapes.pin("a", "Fe", (1.0, 1.0), (1.0, 1.0)),
    ],
)
def test_unusable_sizes_are_refused(make):
    with pytest.raises(InputError):
        make()
