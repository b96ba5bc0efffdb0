"""The axis of rotation is found from opposite views, also through metal, noise and a body wider than the detector."""

import msgspec
import numpy as np
import pytest
import torch
from closed_scans import BEAN, BODY, GEOMETRY, METAL, WIDE, line_integrals

from ctsim.errors import InputError
from ctsim.reconstruct import axis
from ctsim.reconstruct.axis import axis_shift
from ctsim.types import Scan

N_U, PITCH = 48, 1.4
ACCURACY = 0.25  # pixels: what half-moons at edges begin at


def shifted(axis: float, solids, *, views=72, photons=None, **changes) -> Scan:
    """Simulate a scan whose axis is `axis` columns right of the middle, and forget it."""
    true = msgspec.structs.replace(
        GEOMETRY,
        n_detector=(8, N_U),
        d_detector=(PITCH, PITCH),
        n_views=views,
        off_detector=(0.0, -axis * PITCH),
        **changes,
    )
    p = line_integrals(true, solids)
    told = msgspec.structs.replace(true, off_detector=(0.0, 0.0))
    if photons is None:
        return Scan.from_line_integrals(p, told, e_max=90.0)
    counts = np.random.default_rng(4).poisson(photons * np.exp(-p)).astype(np.float32)
    return Scan(geometry=told, counts=torch.from_numpy(counts), flat=torch.full((8, N_U), photons), i0=photons)


@pytest.mark.parametrize("solids", [BODY, BEAN], ids=["body", "bean"])
@pytest.mark.parametrize("more", [(), METAL], ids=["plain", "metal"])
@pytest.mark.parametrize("photons", [None, 1e4, 300.0])
@pytest.mark.parametrize("axis", [3.7, -6.4])
def test_the_axis_is_found(solids, more, photons, axis):
    """Of 300 photons metal lets through 300·exp(−1.5·12): nothing, which the logarithm cuts off."""
    assert abs(axis_shift(shifted(axis, (*solids, *more), photons=photons)) - axis) < ACCURACY


@pytest.mark.parametrize("photons", [None, 300.0])
def test_the_axis_is_found_where_the_body_is_cut_off(photons):
    assert abs(axis_shift(shifted(3.7, (*WIDE, *METAL), photons=photons)) - 3.7) < ACCURACY


@pytest.mark.parametrize("views", [24, 73])
def test_few_and_odd_views_do(views):
    assert abs(axis_shift(shifted(3.7, BODY, views=views)) - 3.7) < ACCURACY


def test_a_turn_that_repeats_its_first_view_and_one_of_other_order_do():
    n = 60
    angles = tuple(k * 6.0 for k in range(n + 1))
    assert abs(axis_shift(shifted(3.7, BODY, views=n + 1, angles_deg=angles)) - 3.7) < ACCURACY
    mixed = tuple(np.random.default_rng(1).permutation(angles[:-1]).tolist())
    assert abs(axis_shift(shifted(3.7, BODY, views=n, angles_deg=mixed)) - 3.7) < ACCURACY


def test_what_has_no_opposite_views_is_refused():
    for changes in ({"arc_deg": 200.0}, {"angles_deg": tuple(float(k * k) for k in range(18))}):
        scan = shifted(0.0, BODY, views=18, **changes)
        with pytest.raises(InputError, match="even views over a full turn"):
            axis_shift(scan)
    poses = tuple(tuple(row) for row in GEOMETRY.pose_array().tolist())
    scan = shifted(0.0, BODY, views=24)
    scan = Scan.from_line_integrals(
        np.zeros(scan.geometry.shape), msgspec.structs.replace(scan.geometry, poses=poses), e_max=90.0
    )
    with pytest.raises(InputError, match="views of this scan are poses"):
        axis_shift(scan)


@pytest.mark.parametrize("photons", [None, 1e4, 50.0])
def test_images_without_an_object_have_no_axis(photons):
    with pytest.raises(InputError, match=r"finds no axis within 20\.16 columns .* where opposite rays agree"):
        axis_shift(shifted(3.7, (), photons=photons))


@pytest.mark.parametrize("half_fan", [18.0, -18.0])
@pytest.mark.parametrize("solids", [BODY, (*BODY, *METAL), BEAN, WIDE], ids=["body", "metal", "bean", "wide"])
def test_the_axis_of_a_half_fan_is_found(solids, half_fan):
    assert abs(axis_shift(shifted(half_fan, solids, photons=1e4)) - half_fan) < ACCURACY


@pytest.mark.parametrize("beyond", [22.0, 26.0, -22.0])
@pytest.mark.parametrize("solids", [BODY, (*BODY, *METAL), BEAN], ids=["body", "metal", "bean"])
def test_an_axis_beyond_the_search_is_not_found_elsewhere(solids, beyond):
    """At the far end of the search only air is compared, which agrees with itself."""
    with pytest.raises(InputError, match=r"finds no axis within 20\.16 columns"):
        axis_shift(shifted(beyond, solids, photons=1e4))


def test_opposite_rays_agree_at_the_axis():
    """At the true shift the costs are left to interpolation: a tenth of those of the mirrored relation of angles."""
    scan = shifted(3.7, BEAN, views=180)
    order, angles = axis._turn(scan.geometry)
    p, weight = axis._middle(scan, order)
    model = axis._Opposite(scan.geometry, angles, p, weight)
    mirrored = axis._Opposite(scan.geometry, angles, p[::-1], weight[::-1])  # the source turns the other way
    assert model.cost(3.7) < 0.1 * mirrored.cost(3.7)
