"""Both jaws of a dental specimen: arches of bone, 28 teeth with roots, cheeks, lips and tongue.

The arch has about two thirds of an adult's width in the 60 mm cube. Front is +y, up is +z; the teeth meet at z = 0.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ctsim.errors import InputError
from ctsim.phantoms.fields import Canvas, Field, LabelGrid, Mask, Noise
from ctsim.phantoms.inserts import Inserts, count, diameter, inserts
from ctsim.phantoms.recipe import Recipe, assemble
from ctsim.solids import BOX, Primitive, Solid, Vector
from ctsim.types import Phantom

MATERIALS = ("air", "soft_tissue", "cortical_bone", "dentin", "enamel")
AIR, SOFT, BONE, DENTIN, ENAMEL = range(5)
SHRINK = 0.9  # of a relative unit to half the cube's edge
CENTRE = -0.32  # y of the half ellipse's centre that the dental arch is
MOUTH_BOX = ((-0.9, -0.7, -0.5), (0.9, 0.9, 0.5))


class Teeth(Recipe, frozen=True, kw_only=True, tag="teeth"):
    """Jaws with implant screws and crowns (Ti by default).

    Second molars stand partly inside first ones, so that metal of both may overlap; `jaw` gives each tooth its place.
    """

    metal: str = "Ti"
    crowns: int = 2
    """How many inserts are metal crowns; the others are implant screws."""
    missing: int = 1
    """Missing teeth, which leave gaps."""
    fillings: int = 0
    """Amalgam fillings in molars and premolars of both jaws."""
    gold_crowns: int = 0
    """Crowns of gold on upper teeth."""
    bridges: int = 0
    """Bridges of CoCr, each over three upper teeth of one side."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        Recipe.__post_init__(self)
        self.within("crowns", 0, 16)
        self.within("missing", 0, 14)
        self.within("fillings", 0, 12)
        self.within("gold_crowns", 0, 4)
        self.within("bridges", 0, 2)


class Kind(NamedTuple):
    """A tooth's half widths along and across the arch, crown height, root length (relative), roots."""

    along: float
    across: float
    crown: float
    root: float
    roots: int


KINDS = (  # from the midline backwards: two incisors, canine, two premolars, two molars
    Kind(0.095, 0.085, 0.250, 0.36, 1),
    Kind(0.092, 0.088, 0.240, 0.36, 1),
    Kind(0.105, 0.110, 0.255, 0.44, 1),
    Kind(0.108, 0.125, 0.215, 0.38, 1),
    Kind(0.110, 0.130, 0.205, 0.38, 1),
    Kind(0.150, 0.150, 0.195, 0.36, 2),
    Kind(0.145, 0.148, 0.185, 0.33, 2),
)


class Tooth(NamedTuple):
    """Where a tooth stands: kind, neck (x, y, z), frame rows (along, across, up to the crown), slot."""

    kind: Kind
    neck: NDArray[np.float64]
    frame: NDArray[np.float64]
    slot: int


def teeth(grid: LabelGrid, rng: np.random.Generator, params: Teeth) -> Phantom:
    """Draw the jaws; metal: implants under crowns of their own, crowns over whole teeth, and restorations."""
    body, metal = rng.spawn(2)
    canvas = Canvas(grid, shrink=SHRINK)
    _soft(canvas, body)
    spongy = Noise(body, 56)
    solids = dentition(canvas, body, metal, params, lambda jaw: _bone(canvas, jaw, spongy))
    return assemble(canvas.whole, grid, MATERIALS, solids)


def dentition(
    canvas: Canvas,
    body: np.random.Generator,
    metal: np.random.Generator,
    params: Teeth,
    bone: Callable[[int], None],
    *,
    fit: float = 1.0,
) -> list[Solid]:
    """Paint the teeth of both jaws, each into what `bone` draws of its jaw, −1 or 1; return the metal.

    Numbers for the body and for the metal are drawn from generators of their own. `fit` is a tooth's width along the
    arch over that of `KINDS`. Labels are those of `MATERIALS`.
    """
    rows = [_row(body, jaw, fit) for jaw in (-1, 1)]
    present: list[dict[int, Tooth]] = []
    for jaw, row in zip((-1, 1), rows, strict=True):
        bone(jaw)
        gone = body.permutation(14)[: params.missing]
        implants, _ = _sites(params) if jaw < 0 else ([], [])
        present.append({t.slot: t for t in row if t.slot not in gone or (jaw < 0 and t.slot in SITES)})
        for tooth in present[-1].values():
            _tooth(canvas, tooth, body, rootless=tooth.slot in implants)
    solids = _metal(metal, params, canvas.unit, rows[0])
    if params.metal != "none":
        solids += _restorations(params, canvas.unit, present, rows[1])
    return solids


def _arch(t: Field | float) -> tuple[Field, Field]:
    """Point of the arch's midline (x, y) at t in [−1, 1]: half an ellipse with straightened ends."""
    angle = np.asarray(t) * 1.42
    return 0.56 * np.sin(angle) * (1 + 0.10 * np.abs(np.sin(angle)) ** 3), CENTRE + 0.98 * np.cos(angle)


def arch_gap(x: Field, y: Field) -> Field:
    """Distance to the arch's midline, signed: positive on the cheek side."""
    px, py = _arch(np.linspace(-1.12, 1.12, 240))
    shape = np.broadcast_shapes(x.shape, y.shape)
    at = np.stack([np.broadcast_to(x, shape).ravel(), np.broadcast_to(y, shape).ravel()], 1)
    gap, nearest = KDTree(np.stack([px, py], 1)).query(at)
    inner = np.hypot(at[:, 0], at[:, 1] - CENTRE) < np.hypot(px[nearest], py[nearest] - CENTRE)
    return np.where(inner, -gap, gap).reshape(shape).astype(np.float32)


def _soft(canvas: Canvas, rng: np.random.Generator) -> None:
    """Face with lips and cheeks, the mouth's air, gums and tongue."""
    wobble = Noise(rng, 4)

    def face(x: Field, y: Field, z: Field) -> Mask:
        return (section(x, y) ** 8 + np.abs(z / 0.97) ** 8) ** np.float32(1 / 8) + 0.012 * wobble(x, y, z) < 0.98

    canvas.fill(SOFT, face)
    canvas.fill(AIR, lambda x, y, z: mouth(x, y, z, wobble), MOUTH_BOX)
    canvas.fill(SOFT, lambda x, y, z: tongue(x, y, z, wobble) <= 1)
    canvas.ellipsoid(AIR, (0.0, -0.14, 0.82), (0.2, 0.5, 0.05))  # floor of the nose


def section(x: Field, y: Field) -> Field:
    """Level of the face's section; 1 on its edge."""
    power = np.where(y > 0.04, np.float32(2.1), np.float32(2.6))  # the cheeks are broader than the lips
    return (np.abs(x / 0.95) ** 2.6 + np.abs((y - 0.04) / 0.93) ** power) ** np.float32(1 / 2.5)


def tongue(x: Field, y: Field, z: Field, wobble: Noise) -> Field:
    """Level of the tongue; 1 on its edge."""
    return (x / 0.40) ** 2 + ((y + 0.06) / 0.52) ** 2 + ((z + 0.18 - 0.1 * wobble(x, y, z)) / 0.27) ** 2


def mouth(x: Field, y: Field, z: Field, wobble: Noise) -> Mask:
    """Tell points of the open mouth: before the teeth, under the vaulted palate, back to the throat."""
    gap = arch_gap(x, y)
    before = np.clip(gap, 0, None) / 0.175
    vault = np.sin(np.pi / 2 * np.clip((-gap - 0.1) / 0.4, 0, 1))
    height = 0.28 + np.where(z > 0, np.float32(0.16), np.float32(0.06)) * vault
    throat = -0.56 + 0.25 * x**2 + 0.03 * wobble(x, y, z)
    behind = np.clip((-0.19 - y) / (-0.19 - throat), 0, None)
    return before**4 + (z / height) ** 4 + behind**4 <= 1


def _bone(canvas: Canvas, jaw: int, spongy: Noise) -> None:
    """Alveolar bone under the gum: a compact shell round a spongy core."""
    box = ridge_box(jaw)
    canvas.fill(SOFT, lambda x, y, z: ridge(x, y, z, jaw) <= 1.12, box, over=(AIR,))  # gum
    canvas.fill(BONE, lambda x, y, z: ridge(x, y, z, jaw) <= 1, box)
    canvas.fill(
        SOFT,
        lambda x, y, z: (ridge(x, y, z, jaw) <= 0.80) & (spongy(x, y, z) > -0.45),
        box,
        over=(BONE,),
    )


def ridge(x: Field, y: Field, z: Field, jaw: int) -> Field:
    """Level of the alveolar bone of the lower (−1) or upper (1) jaw; 1 on its edge."""
    h = jaw * z  # height above the occlusal plane into this jaw
    width = np.float32(0.165) + 0.03 * np.clip((h - 0.3) / 0.4, 0, 1)
    across = arch_gap(x, y) / width
    return (np.abs(across) ** 4 + np.abs((h - 0.555) / 0.32) ** 4) ** np.float32(0.25)


def ridge_box(jaw: int) -> tuple[Vector, Vector]:
    """Return the corners of a box about an alveolar bone and its gum."""
    return (-0.92, -0.92, -0.95 if jaw < 0 else 0.18), (0.92, 0.95, -0.18 if jaw < 0 else 0.95)


def _row(rng: np.random.Generator, jaw: int, fit: float) -> list[Tooth]:
    """Stand 14 teeth side by side along the arch, with a little disorder; the last ones share its end if they must."""
    fine = np.linspace(-1.12, 1.12, 2001)
    length = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(np.stack(_arch(fine)), axis=1)))])
    middle = np.interp(0.0, fine, length)
    scale = fit * (0.92 if jaw < 0 else 1.0)  # lower teeth are narrower
    teeth = []
    for side in (-1, 1):
        at = 0.0
        for k, kind in enumerate(KINDS):
            kind = kind._replace(along=kind.along * scale)
            t = np.interp(middle + side * (at + kind.along), length, fine)
            at += 2 * kind.along * 1.015
            x, y = _arch(t)
            ahead = np.subtract(_arch(t + 1e-3), _arch(t - 1e-3))
            along = np.array([*(ahead / np.linalg.norm(ahead)), 0.0])
            lean, turn = rng.uniform(-0.05, 0.05, 2)
            up = np.array([0.0, 0.0, -float(jaw)]) + lean * along
            up /= np.linalg.norm(up)
            across = np.cross(up, along)
            across /= np.linalg.norm(across)
            along = np.cross(across, up)
            frame = np.stack([along + turn * across, across - turn * along, up])
            frame[:2] /= np.linalg.norm(frame[:2], axis=1, keepdims=True)
            neck = np.array([float(x), float(y), jaw * (kind.crown + 0.012)])
            teeth.append(Tooth(kind, neck, frame, k if side > 0 else 7 + k))
    return teeth


def _tooth(canvas: Canvas, tooth: Tooth, rng: np.random.Generator, *, rootless: bool) -> None:
    """Paint roots of dentin with canals, a dentin crown with pulp, and the enamel cap with cusps."""
    kind, neck, frame = tooth.kind, tooth.neck, tooth.frame
    bend = rng.uniform(-0.04, 0.04, 3)
    if not rootless:
        _roots(canvas, tooth, bend)

    def crown(shrink: float) -> Callable[[Field, Field, Field], Mask]:
        a, b = kind.along - shrink, kind.across - shrink
        top = kind.crown - 1.4 * shrink

        def inside(x: Field, y: Field, z: Field) -> Mask:
            px, py, pz = x - np.float32(neck[0]), y - np.float32(neck[1]), z - np.float32(neck[2])
            p, q, h = (row[0] * px + row[1] * py + row[2] * pz for row in frame.astype(np.float32))
            up = np.clip(h / kind.crown, 0, 1)
            if kind.roots == 1 and kind.across < 0.12:  # a blade: wide in front, thin at its edge
                wide, deep = 0.72 + 0.28 * up, 0.95 - 0.62 * up
                lid = top
            else:  # a table with cusps and a fissure between them
                wide, deep = 0.80 + 0.20 * np.sin(2.2 * up), 0.86 + 0.14 * np.sin(2.4 * up)
                cusps = np.cos(np.pi * p / a * (1 if kind.roots > 1 else 0.6)) * np.cos(np.pi * q / b)
                lid = top - 0.022 + 0.03 * np.abs(cusps - 0.3)
            round_ = np.abs(p / (a * wide)) ** 2.8 + np.abs(q / (b * deep)) ** 2.8
            return (round_ <= 1) & (h <= lid) & (h > -0.03 if shrink else h > 0)

        return inside

    box = (neck - 0.34, neck + 0.34)
    canvas.fill(ENAMEL, crown(0.0), box)
    canvas.fill(DENTIN, crown(0.024), box)
    if not rootless:
        chamber = neck + 0.25 * kind.crown * frame[2]
        canvas.ellipsoid(SOFT, chamber, (0.34 * kind.along, 0.30 * kind.across, 0.30 * kind.crown), frame)


def _roots(canvas: Canvas, tooth: Tooth, bend: NDArray[np.float64]) -> None:
    kind, neck, frame = tooth.kind, tooth.neck, tooth.frame
    steps = np.linspace(0, 1, 9)
    for k in range(kind.roots):
        spread = 0.0 if kind.roots == 1 else (2 * k - 1) * 0.55 * kind.along
        foot = neck + spread * frame[0] + 0.3 * spread * frame[0] + bend * [1, 1, 0] - kind.root * frame[2]
        start = neck + 0.6 * spread * frame[0] + 0.04 * frame[2]
        path = start + steps[:, None] * (foot - start) + (steps * (1 - steps))[:, None] * 0.3 * spread * frame[0]
        thick = (0.80 if kind.roots == 1 else 0.46) * min(kind.along, kind.across) * (1 - 0.68 * steps**1.5)
        canvas.tube(SOFT, path, thick + 0.014, over=(BONE,))  # the ligament
        canvas.tube(DENTIN, path, thick)
        canvas.tube(SOFT, path[:-1], 0.20 * thick[:-1] + 0.006, over=(DENTIN,))


SITES: tuple[int, ...] = (5, 12, 3, 10, 6, 4, 13, 11)  # slots of the lower jaw that can carry inserts, in order of use


def _sites(params: Teeth) -> tuple[list[int], list[int]]:
    """Slots of implants and of crowns, from the settings alone, so that twins agree."""
    total = min(4 if params.n_inserts is None else params.n_inserts, len(SITES))
    crowned = min(params.crowns, total)
    slots = list(SITES[:total])
    return slots[: total - crowned], slots[total - crowned :]


def _metal(rng: np.random.Generator, params: Teeth, unit: float, row: list[Tooth]) -> list[Solid]:
    if count(params, 4) == 0:
        return []
    make, d = inserts(params, unit), diameter(params, 4.2, unit)
    implants, crowns = _sites(params)
    by_slot = {tooth.slot: tooth for tooth in row}
    solids: list[Solid] = []
    for slot in implants:
        tooth = by_slot[slot]
        length = 0.42 * unit * rng.uniform(0.9, 1.1)
        solids.append(make.screw(f"implant{slot}", tooth.neck + 0.02 * tooth.frame[2], -tooth.frame[2], d, length))
        foot, top = tooth.neck, tooth.neck + 0.6 * tooth.kind.crown * tooth.frame[2]
        solids.append(make.rod(f"abutment{slot}", foot, top, 0.62 * d, round_ends=False))
    for slot in crowns:
        solids.append(_crown(make, f"crown{slot}", by_slot[slot]))
    return solids


def _crown(make: Inserts, name: str, tooth: Tooth) -> Solid:
    kind = tooth.kind
    centre = tooth.neck + 0.55 * kind.crown * tooth.frame[2]
    radii = (0.98 * kind.along * make.unit, 0.98 * kind.across * make.unit, 0.50 * kind.crown * make.unit)
    return make.ellipsoid(name, centre, radii, tooth.frame[2])


BRIDGED = ((3, 4, 5), (10, 11, 12))  # upper slots, of which the middle one may be a gap
GILDED = (13, 6, 9, 2, 5, 12)  # upper slots that can carry a gold crown, in order of use
FILLED = (6, 13, 4, 11, 5, 12, 3, 10)  # slots of either jaw that can be filled, in order of use


def _restorations(params: Teeth, unit: float, present: list[dict[int, Tooth]], upper: list[Tooth]) -> list[Solid]:
    """Return bridges, gold crowns and fillings, each on teeth that carry no other metal.

    `present` are the teeth of the lower and of the upper jaw by slot.
    """
    cobalt, gold, amalgam = (Inserts(material, unit) for material in ("CoCr", "Au", "amalgam"))
    lower_used = {slot for slots in _sites(params) for slot in slots}
    upper_used = {slot for trio in BRIDGED[: params.bridges] for slot in trio}
    by_slot = {tooth.slot: tooth for tooth in upper}
    solids = [_bridge(cobalt, f"bridge{k}", [by_slot[slot] for slot in BRIDGED[k]]) for k in range(params.bridges)]
    free = [present[1][slot] for slot in GILDED if slot in present[1] and slot not in upper_used]
    _enough("gold_crowns", params.gold_crowns, len(free))
    crowned = free[: params.gold_crowns]
    solids += [_crown(gold, f"gold{tooth.slot}", tooth) for tooth in crowned]
    upper_used |= {tooth.slot for tooth in crowned}
    teeth = [
        (name, jaw[slot])
        for slot in FILLED
        for name, jaw, used in (("upper", present[1], upper_used), ("lower", present[0], lower_used))
        if slot in jaw and slot not in used
    ]
    _enough("fillings", params.fillings, len(teeth))
    for name, tooth in teeth[: params.fillings]:
        kind = tooth.kind
        centre = tooth.neck + 0.80 * kind.crown * tooth.frame[2]  # its top a little under the cusps
        edges = (1.1 * kind.along * unit, 0.75 * kind.across * unit, 0.34 * kind.crown * unit)
        spin = _spin(tooth)
        solids.append(amalgam.box(f"filling-{name}{tooth.slot}", centre, edges, tooth.frame[2], spin))
    return solids


def _enough(key: str, wanted: int, found: int) -> None:
    if wanted > found:
        raise InputError(f"{key}: {wanted} are asked for, but only {found} teeth are there and free of other metal")


def _spin(tooth: Tooth) -> float:
    """Return the turn about its axis that lays a box's first edge along the arch."""
    first, second, _ = Primitive(kind=BOX, centre=(0, 0, 0), params=(1, 1, 1), axis=_vector(tooth.frame[2])).rotation()
    return float(np.arctan2(tooth.frame[0] @ second, tooth.frame[0] @ first))


def _vector(at: NDArray[np.float64]) -> Vector:
    x, y, z = (float(c) for c in at)
    return x, y, z


def _bridge(make: Inserts, name: str, row: list[Tooth]) -> Solid:
    """Return crowns over neighbouring teeth and the bars between them, as one piece of metal."""
    crowns = [_crown(make, name, tooth) for tooth in row]
    middles = np.array([tooth.neck + 0.5 * tooth.kind.crown * tooth.frame[2] for tooth in row])
    bar = make.wire(name, middles, 0.9 * min(tooth.kind.crown for tooth in row) * make.unit)
    pieces = tuple(p for solid in (*crowns, bar) for p in solid.primitives)
    return Solid(name=name, material=make.material, primitives=pieces, metal=True)
