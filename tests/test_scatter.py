import pytest

from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.scatter import Scatter, constant_fraction, open_fraction


def geometry(dso, dsd):
    grid = {"n_voxel": (5, 7, 11), "d_voxel": (1.0, 1.0, 1.0), "n_detector": (5, 7), "d_detector": (1.0, 1.0)}
    return Geometry(dso=dso, dsd=dsd, n_views=3, **grid)


@pytest.mark.parametrize(
    ("dso", "dsd", "low", "high"),
    [(180.0, 360.0, 0.014, 0.020), (250.0, 750.0, 0.008, 0.010), (1000.0, 1500.0, 0.003, 0.004)],
)
def test_constant_fraction_meets_the_monte_carlo_anchors(dso, dsd, low, high):
    assert low <= constant_fraction(geometry(dso, dsd)) <= high


def test_a_larger_air_gap_has_less_scatter():
    fractions = [constant_fraction(geometry(500.0, dsd)) for dsd in (550.0, 700.0, 1000.0, 2000.0)]
    assert fractions == sorted(fractions, reverse=True)


def test_a_detector_at_the_object_stays_within_what_can_be_given():
    assert 1 < constant_fraction(geometry(500.0, 500.0001)) < 10


def test_level_and_fraction_decide():
    scanner = geometry(250.0, 750.0)
    assert open_fraction(Scatter(), scanner) == 0
    assert open_fraction(Scatter(level=1), scanner) == constant_fraction(scanner)
    assert open_fraction(Scatter(level=1, fraction=0.25), scanner) == 0.25
    assert open_fraction(Scatter(level=1, fraction=0.0), scanner) == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"level": 2}, "level must be 0, 1 or 3"),
        ({"level": 1, "fraction": 10.0}, "within"),
        ({"level": 1, "fraction": -0.1}, "within"),
        ({"level": 1, "fraction": float("nan")}, "within"),
        ({"fraction": 0.1}, "needs scatter.level = 1"),
    ],
)
def test_impossible_settings_are_refused_by_name(arguments, words):
    with pytest.raises(InputError, match=words):
        Scatter(**arguments)
