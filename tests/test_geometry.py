"""Geometry and scanner: what no machine has is refused by the name of the key and the number of the view."""

import msgspec
import numpy as np
import pytest

from ctsim.beam.spectrum import Bowtie, Tube
from ctsim.errors import InputError
from ctsim.geometry import Geometry, few_views
from ctsim.types import Scanner

GEOMETRY = Geometry(
    dso=200.0,
    dsd=400.0,
    n_voxel=(5, 7, 11),
    d_voxel=(0.5, 0.4, 0.25),
    n_detector=(5, 8),
    d_detector=(0.2, 0.25),
    n_views=3,
)


def with_(**changes) -> Geometry:
    return msgspec.structs.replace(GEOMETRY, **changes)


def posed(changes: dict[int, float], view: int = 1) -> tuple[tuple[float, ...], ...]:
    """The orbit's poses with some of one view's twelve numbers replaced."""
    poses = GEOMETRY.pose_array()
    for column, value in changes.items():
        poses[view, column] = value
    return tuple(tuple(float(x) for x in row) for row in poses)


@pytest.mark.parametrize("off", [0.5, 1.0, 1.5])
def test_a_full_turn_covers_half_the_detector_more_or_nothing(off: float) -> None:
    # half a detector of 2 mm is 1 mm: from there on no view sees the axis, and a ring is no field of view
    turn, short = with_(off_detector=(0.0, off)), with_(off_detector=(0.0, off), arc_deg=200.0)
    edge = 1.0 + off if off < 1.0 else 0.0
    assert turn.fov_radius == pytest.approx(200 * np.sin(np.arctan(edge / 400)))
    assert short.fov_radius == pytest.approx(200 * np.sin(np.arctan(max(1.0 - off, 0) / 400)))


def test_a_full_turn_that_is_listed_covers_as_much() -> None:
    # as importers write it: unevenly, the other way round, from anywhere on
    given = np.cumsum([3.0, *([7.0, 5.0] * 29), 6.0, 3.0])[::-1] + 100
    turn = with_(off_detector=(0.0, 0.5), n_views=len(given), angles_deg=tuple(given.tolist()))
    assert turn.fov_radius == with_(off_detector=(0.0, 0.5)).fov_radius
    part = with_(off_detector=(0.0, 0.5), n_views=30, angles_deg=tuple(given[:30].tolist()))
    assert not part.is_full_turn and part.fov_radius == with_(off_detector=(0.0, 0.5), arc_deg=200.0).fov_radius
    once = with_(n_views=1, angles_deg=(10.0,))
    assert not once.is_full_turn


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({0: np.nan}, "finite"),
        ({3: 1e301}, "within"),
        ({6: 0.0, 7: 0.0, 8: 0.0}, "u step"),
        ({9: 0.0, 10: 0.0, 11: 0.0}, "v step"),
        ({6: 0.0, 7: 0.0, 8: 0.2}, "parallel"),
        ({0: -99.0, 1: 170.0, 3: -99.0, 4: 170.0, 5: 3.0}, "plane"),  # 3 mm above the source, along v
        ({0: 7e5, 3: -7e5}, "1e+06 mm"),
    ],
)
def test_impossible_poses_are_refused_by_their_view(changes: dict[int, float], said: str) -> None:
    assert with_(poses=posed({})).poses
    with pytest.raises(InputError, match=r"poses\[1\]") as caught:
        with_(poses=posed(changes))
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_no_ray_is_longer_than_the_kernels_hold() -> None:
    # a detector of 2·a mm square, a = 0.7e6: its corners are hypot(dsd, a, a) ≈ sqrt(2)·a = 0.99e6 mm away
    for d_detector, dsd in (((1.4e6 / 5, 1.4e6 / 8), 400.0), ((0.2, 0.25), 9.9e5)):
        assert with_(d_detector=d_detector, dsd=dsd)
    for d_detector, dsd in (((1.43e6 / 5, 1.43e6 / 8), 400.0), ((0.2, 0.25), 1e6)):
        with pytest.raises(InputError, match=r"d_detector.*1e\+06 mm"):
            with_(d_detector=d_detector, dsd=dsd)


@pytest.mark.parametrize(
    "changes",
    [
        {"n_views": 10**6 + 1},
        {"n_detector": (2**14, 2**14 + 1)},
        {"n_detector": (9999999, 9999999)},
        {"n_voxel": (4096, 2048, 2049)},
        {"angles_deg": (0.0, 1e7, 2.0)},
    ],
)
def test_absurd_numbers_are_refused_by_name(changes: dict) -> None:
    assert with_(n_views=10**6, n_detector=(2**14, 2**14), n_voxel=(4096, 2048, 2048)).n_views
    with pytest.raises(InputError, match=next(iter(changes))):
        with_(**changes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        *(({"n_views": v}, "a whole number") for v in (1.5, 3.0, "3", None, True, (3,), 0.5j)),
        *(
            ({"n_voxel": v}, r"3 whole numbers \(z, y, x\)")
            for v in (8, (8, 8), (8.5, 8, 8), "abc", ((8, 8, 8),), None)
        ),
        *(({"n_detector": v}, r"2 whole numbers \(v, u\)") for v in (8, (8, 8.0), (8, 8, 8), [True, "8"])),
        *(({name: v}, "a number") for name in ("dso", "dsd", "start_deg", "arc_deg") for v in ("1", (), (1.0,), 1j)),
        ({"dso": None}, "a number"),
        ({"dso": 10**400}, "a number"),
        *(
            ({name: v}, r"3 numbers \(z, y, x\)")
            for name in ("d_voxel", "off_origin")
            for v in (1.0, (1.0, 1.0), "abc")
        ),
        *(
            ({name: v}, r"2 numbers \(v, u\)")
            for name in ("d_detector", "off_detector")
            for v in (1.0, (1.0,), [[1], [2]])
        ),
        *(
            ({"angles_deg": v}, "a number for each view")
            for v in (4.0, "abc", (0, "a", 1), (0.0, None, 1.0), ((1, 2),) * 3)
        ),
        *(({"poses": v}, "12 numbers for each view") for v in (4.0, "abc", (("a",) * 12,) * 3, (((1.0,),) * 12,) * 3)),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else None,
)
def test_a_wrong_type_or_length_is_refused_by_name(changes: dict, said: str) -> None:
    with pytest.raises(InputError, match=f"^{next(iter(changes))}: expected {said}, got ") as caught:
        with_(**changes)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 200


def test_rows_of_poses_are_refused_by_their_view() -> None:
    rows = posed({})
    for row, said in ((3.0, "expected 12 numbers, got 3.0"), ("abc", "expected 12 numbers, got 'abc'")):
        with pytest.raises(InputError, match=rf"^poses\[1\]: {said}"):
            with_(poses=(rows[0], row, rows[2]))
    with pytest.raises(InputError, match=r"^poses\[1\] has 11 numbers"):
        with_(poses=(rows[0], rows[1][:11], rows[2]))


def test_lists_and_numbers_of_numpy_are_those_of_python() -> None:
    given = {name: np.array(getattr(GEOMETRY, name)) for name in ("n_voxel", "d_voxel", "n_detector", "d_detector")}
    given |= {"n_views": np.int64(3), "dso": np.float32(200), "dsd": 400, "off_origin": [0, 0, 0]}
    made = with_(**given)
    assert made == GEOMETRY and hash(made) == hash(GEOMETRY)
    assert msgspec.json.decode(msgspec.json.encode(made), type=Geometry) == GEOMETRY
    angles = with_(angles_deg=np.arange(3.0))
    assert angles == with_(angles_deg=[0, 1, 2]) == with_(angles_deg=(0.0, 1.0, 2.0)) and hash(angles)
    poses = with_(poses=GEOMETRY.pose_array())
    assert poses == with_(poses=[list(row) for row in posed({})]) == with_(poses=posed({})) and hash(poses)
    for one in (tuple(np.arange(3.0)), list(np.arange(3.0, dtype=np.float32)), tuple(np.arange(3)), [0, 1.0, 2]):
        made = with_(angles_deg=one)
        assert made == angles and hash(made) and msgspec.json.decode(msgspec.json.encode(made), type=Geometry) == angles
    rows = GEOMETRY.pose_array()
    for many in (list(rows), tuple(map(tuple, rows)), tuple(rows), [list(row) for row in rows]):
        made = with_(poses=many)
        assert made == poses and hash(made) and msgspec.json.decode(msgspec.json.encode(made), type=Geometry) == poses


@pytest.mark.parametrize(
    "tube", [Tube(heel=True), Tube(bowtie=Bowtie(center=1.0, edge=20.0, half_angle_deg=20.0))], ids=["heel", "bowtie"]
)
def test_heel_and_bowtie_need_a_circular_orbit(tube: Tube) -> None:
    assert Scanner(geometry=GEOMETRY, tube=tube) and Scanner(geometry=with_(poses=posed({})))
    with pytest.raises(InputError, match=r"tube\.bowtie and tube\.falloff need a circular orbit.*geometry\.poses"):
        Scanner(geometry=with_(poses=posed({})), tube=tube)


def test_few_views_are_evenly_spaced_and_no_more_than_there_are():
    assert few_views(9, 3).tolist() == [0, 4, 8]
    assert few_views(11, 4).tolist() == [0, 3, 7, 10]
    assert few_views(5, 12).tolist() == [0, 1, 2, 3, 4]
    assert few_views(1, 8).tolist() == few_views(7, 1).tolist() == [0]
