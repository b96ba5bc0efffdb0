"""Methods of mbirtorch: their geometry is ours, and a scan that they cannot take is refused in one sentence."""

import dataclasses
import importlib
import importlib.util

import msgspec
import numpy as np
import pytest
import torch

from ctsim.baselines import external
from ctsim.benchmarks.methods import EXTERNAL, TABLE, find
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.reconstruct.fdk import fdk
from ctsim.reconstruct.projector import forward_columns
from ctsim.types import Scan, Status

GEOMETRY = Geometry(
    dso=250.0, dsd=500.0, n_voxel=(12, 22, 26), d_voxel=(1.0, 1.0, 1.0), n_detector=(32, 60), d_detector=(1.2, 1.1),
    n_views=40, start_deg=20.0,
)  # fmt: skip
installed = pytest.mark.skipif(importlib.util.find_spec("mbirtorch") is None, reason="mbirtorch is not installed")


def body():
    """An object without any symmetry, 1/mm [z, y, x]."""
    values = np.zeros(GEOMETRY.n_voxel, np.float32)
    values[2:9, 4:17, 7:20] = 0.02
    values[3:5, 6:8, 9:18] = 0.05
    values[7:9, 13:16, 8:11] = 0.08
    return values


def projected(geometry):
    return forward_columns(np.ascontiguousarray(body().transpose(1, 2, 0)), geometry, slice(None))


def scan(geometry=GEOMETRY):
    counts = 1e5 * np.exp(-projected(geometry))
    return Scan(
        geometry=geometry, counts=torch.from_numpy(counts.astype(np.float32)),
        flat=torch.full(geometry.n_detector, 1e5), dark=0.0, i0=1e5, e_max=100.0,
    )  # fmt: skip


MOVED = {
    "centred": {},
    "detector along v": {"off_detector": (3.0, 0.0)},
    "detector along u": {"off_detector": (0.0, 4.0)},
    "grid along z": {"off_origin": (2.0, 0.0, 0.0)},
}


@installed
@pytest.mark.parametrize("change", MOVED.values(), ids=MOVED.keys())
def test_its_fdk_is_ours(change):
    geometry = msgspec.structs.replace(GEOMETRY, **change)
    p = projected(geometry)
    package = importlib.import_module("mbirtorch")
    model = external._model(package, geometry, external.Settings(compiled=False))
    theirs = np.asarray(model.recon_direct(p)).transpose(2, 1, 0)
    ours = fdk(torch.from_numpy(p), geometry).numpy()
    assert np.corrcoef(theirs.ravel(), ours.ravel())[0, 1] > 0.98
    gain = float((theirs * ours).sum() / (ours * ours).sum())
    assert gain == pytest.approx(1, abs=0.05)


@installed
@pytest.mark.filterwarnings("ignore:split_index")  # so few slices are not done in two halves
@pytest.mark.parametrize("name", EXTERNAL)
def test_a_few_iterations_come_close_and_are_the_same_again(name):
    few = {"iterations": 2, "compiled": False} | ({"passes": 1} if name == "mbir-mar" else {})
    method, given = find(name, few), scan()
    one, again = method.reconstruct(given), method.reconstruct(given)
    assert torch.equal(one.values, again.values)
    assert one.status is Status.OK and one.details["package"].startswith("mbirtorch 0.")
    assert one.values.shape == GEOMETRY.n_voxel and one.values.dtype == torch.float32
    assert np.corrcoef(one.values.numpy().ravel(), body().ravel())[0, 1] > 0.9


def test_they_are_a_class_of_their_own():
    assert not set(EXTERNAL) & set(TABLE)
    assert {find(name).inputs for name in EXTERNAL} == {"counts only, external"}
    with pytest.raises(InputError, match="did you mean mbir"):
        find("mbirr")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"poses": tuple(map(tuple, GEOMETRY.pose_array().tolist()))}, "circular orbits only"),
        ({"d_voxel": (1.0, 1.0, 1.1)}, "cubic voxels"),
        ({"off_origin": (0.0, 1.0, 0.0)}, "around the axis"),
    ],
)
def test_scans_that_the_package_cannot_take_are_skipped(change, said):
    given = dataclasses.replace(scan(), geometry=msgspec.structs.replace(GEOMETRY, **change))
    assert said in (find("mbir").skip(given) or "")
    with pytest.raises(InputError, match=said):
        external._model(None, given.geometry, external.Settings())


def test_without_the_package_one_sentence_says_how_to_install_it(monkeypatch):
    def missing(name):
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr(external.importlib, "import_module", missing)
    with pytest.raises(InputError, match=r"needs mbirtorch; pip install 'ctsim\[peers-methods\]' installs it"):
        external.mbir(scan())
