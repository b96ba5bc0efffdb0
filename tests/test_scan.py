"""What a scan may be: the impossible is refused where it is said, not turned into a volume."""

import copy
import dataclasses
import math
import multiprocessing
import pickle

import numpy as np
import pytest
import torch
from test_run import GEOMETRY

from ctsim.errors import InputError
from ctsim.types import READINGS, Scan

GOOD = {
    "geometry": GEOMETRY,
    "counts": torch.full(GEOMETRY.shape, 1000.0),
    "flat": torch.full(GEOMETRY.n_detector, 2000.0),
    "dark": 100.0,
}


def part(fill: float) -> torch.Tensor:
    """An open field of which one pixel is as in `GOOD`."""
    flat = torch.full(GEOMETRY.n_detector, fill)
    flat[3, 4] = 2000.0
    return flat


@pytest.mark.parametrize(
    ("change", "said"),
    [
        *(({"dark": v}, "dark must be a finite number") for v in (math.nan, math.inf, "100", None, True)),
        *(({"geometry": v}, "geometry: expected a ctsim.Geometry, got") for v in ("x", None, {})),
        *(({"floor": v}, "floor: expected a number of counts above 0, got") for v in ("a", (1.0,), True, 0, math.inf)),
        ({"name": 3}, "name: expected a text, got int"),
        *(({"i0": v}, "i0 must be positive") for v in (0, 0.0, -5, math.nan, math.inf, "1e5", True, None)),
        *(({"e_max": v}, "e_max must be positive") for v in (0, -1.0, math.nan, math.inf, "high")),
        *(({"flat": torch.full(GEOMETRY.n_detector, v)}, "flat: no pixel") for v in (0.0, 100.0, math.nan, math.inf)),
        ({"flat": torch.full(GEOMETRY.n_detector, -1.0), "dark": 0.0}, "flat: no pixel"),
        ({"dark": 2000.0}, "flat: no pixel"),
        ({"counts": np.full(GEOMETRY.shape, 1000.0)}, "counts must be a torch.Tensor, got numpy.ndarray; torch.from_"),
        ({"flat": [[2000.0]]}, "flat must be a torch.Tensor, got builtins.list"),
        ({"counts": GOOD["counts"] > 0}, "counts must be real numbers .* got torch.bool"),
        ({"counts": GOOD["counts"].to(torch.complex64)}, "counts must be real numbers .* got torch.complex64"),
        ({"counts": GOOD["counts"].to(torch.bfloat16)}, "counts must be real numbers .* got torch.bfloat16"),
        ({"flat": GOOD["flat"] > 0}, "flat must be real numbers"),
        ({"counts": GOOD["counts"].clone().requires_grad_()}, "counts must not require gradients"),
        ({"counts": GOOD["counts"][:, 1:]}, r"counts: shape \(6, 17, 20\), the geometry says \(6, 18, 20\)"),
        ({"flat": GOOD["flat"][1:]}, "flat: shape"),
        ({"metal": torch.zeros(2, 3, 4)}, "metal: shape"),
        ({"metal": np.zeros(GEOMETRY.n_voxel)}, "metal must be a torch.Tensor"),
        ({"metal": torch.zeros(GEOMETRY.n_voxel, dtype=torch.complex64)}, "metal must be real numbers"),
    ],
    ids=lambda value: value if isinstance(value, str) else "-".join(value),
)
def test_what_cannot_be_is_refused_in_one_sentence(change, said):
    Scan(**GOOD)
    with pytest.raises(InputError, match=said) as caught:
        Scan(**GOOD | change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("dtype", [getattr(torch, name) for name in READINGS], ids=str)
def test_readings_of_every_type_that_numpy_has_are_taken(dtype):
    counts, flat = (torch.full(shape, 100).to(dtype) for shape in (GEOMETRY.shape, GEOMETRY.n_detector))
    assert Scan(geometry=GEOMETRY, counts=counts, flat=flat, dark=np.float32(1), i0=np.int64(7)).counts is counts


@pytest.mark.parametrize("fill", [math.nan, math.inf, 0.0, -5.0])
def test_one_pixel_that_sees_is_enough(fill):
    assert Scan(**GOOD | {"flat": part(fill)}).flat[3, 4] == 2000


@pytest.mark.parametrize("dtype", [getattr(torch, name) for name in READINGS], ids=str)
@pytest.mark.parametrize("same", [lambda scan: pickle.loads(pickle.dumps(scan)), copy.deepcopy], ids=["pickle", "copy"])
def test_a_scan_comes_back_from_a_pickle(dtype, same):
    counts = torch.arange(math.prod(GEOMETRY.shape)).mul(257).reshape(GEOMETRY.shape).to(dtype)  # bits of all bytes
    flat = torch.full(GEOMETRY.n_detector, 100).to(dtype)
    scan = Scan(
        geometry=GEOMETRY, counts=counts, flat=flat, metal=torch.ones(GEOMETRY.n_voxel, dtype=torch.bool), name="a/b"
    )
    found = same(scan)
    for one in dataclasses.fields(Scan):
        was, now = getattr(scan, one.name), getattr(found, one.name)
        assert type(was) is type(now)
        assert np.array_equal(was, now) and was.dtype == now.dtype if isinstance(was, torch.Tensor) else was == now


def total(scan: Scan) -> int:
    return int(scan.counts.double().sum())


def test_a_scan_travels_to_another_process():
    scan = Scan(**GOOD | {"counts": torch.full(GEOMETRY.shape, 60000, dtype=torch.uint16)})
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.apply(total, (scan,)) == total(scan)


def test_counts_are_not_read():
    """A mapped stack of gigabytes opens at once: that no reading has signal is found where they are read."""
    counts = torch.empty(GEOMETRY.shape, device="meta")  # has no data to read
    assert dataclasses.replace(Scan(**GOOD), counts=counts).counts.is_meta


@pytest.mark.parametrize(
    ("p", "geometry", "said"),
    [
        ("x", GEOMETRY, r"p: expected real numbers \[view, v, u\], got str$"),
        (None, GEOMETRY, r"p: expected real numbers \[view, v, u\], got NoneType$"),
        (np.array([["a"]]), GEOMETRY, r"p: expected real numbers \[view, v, u\], got ndarray of <U1$"),
        (np.zeros(GEOMETRY.shape, complex), GEOMETRY, "p must be real numbers .* got torch.complex128"),
        (np.zeros(GEOMETRY.shape)[1:], GEOMETRY, r"p: shape \(5, 18, 20\), the geometry says \(6, 18, 20\)"),
        (torch.zeros(GEOMETRY.shape).requires_grad_(), GEOMETRY, "p must not require gradients"),
        (np.zeros(GEOMETRY.shape), "g", "geometry: expected a ctsim.Geometry, got str"),
    ],
)
def test_line_integrals_that_are_none_are_refused_by_name(p, geometry, said):
    for kept in (np.zeros(GEOMETRY.shape, np.float32), np.zeros(GEOMETRY.shape, int), torch.zeros(GEOMETRY.shape)):
        assert bool((Scan.from_line_integrals(kept, GEOMETRY, e_max=90.0).counts == 1e5).all())
    assert Scan.from_line_integrals(np.zeros(GEOMETRY.shape).tolist(), GEOMETRY, e_max=90.0)
    with pytest.raises(InputError, match=f"^{said}"):
        Scan.from_line_integrals(p, geometry, e_max=90.0)
