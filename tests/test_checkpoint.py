"""A kept fit goes on from what was written or not at all."""

import hashlib
import io
import random
import zipfile

import numpy as np
import pytest
from test_splat_published import sphere

from ctsim.errors import InputError
from ctsim.reconstruct.splat.checkpoint import Checkpoint
from ctsim.reconstruct.splat.fast import Settings, reconstruct
from ctsim.reconstruct.splat.published import fit_published
from ctsim.reconstruct.splat.published_settings import Settings as Published

STATE = {"u": np.linspace(0, 1, 50, dtype=np.float32), "numbers": np.arange(3), "empty": np.zeros(0)}


def test_what_was_written_is_read_and_then_removed(tmp_path):
    kept = Checkpoint(folder=tmp_path / "new", identity="a")
    assert kept.read() is None
    kept.write(STATE)
    found = kept.read()
    assert found is not None and found.keys() == STATE.keys()
    assert all(found[k].dtype == v.dtype and np.array_equal(found[k], v) for k, v in STATE.items())
    kept.remove()
    assert kept.read() is None


def test_any_damage_is_refused_in_one_sentence(tmp_path):
    kept = Checkpoint(folder=tmp_path, identity="a")
    kept.write(STATE)
    whole, rng = kept.path.read_bytes(), random.Random(4)
    flipped = []
    for at in rng.sample(range(len(whole)), 300):
        flipped.append(whole[:at] + bytes([whole[at] ^ (1 << rng.randrange(8))]) + whole[at + 1 :])
    cut = [whole[:n] for n in (0, 1, 31, 32, 33, len(whole) // 2, len(whole) - 1)]
    for damaged in [*flipped, *cut, whole + b"\0", whole[1:], b"PK" * 99]:
        kept.path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"is damaged .*: delete it to start again") as caught:
            kept.read()
        assert str(kept.path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_file_without_a_checksum_is_refused(tmp_path):
    kept = Checkpoint(folder=tmp_path, identity="a")
    np.savez(kept.path, **STATE)  # as versions before wrote it
    with pytest.raises(InputError, match="or an earlier version wrote it"):
        kept.read()


def rewritten(folder, change) -> None:
    """Change the arrays of the only checkpoint, with a checksum that fits."""
    (path,) = folder.iterdir()
    kept = Checkpoint(folder=folder, identity=path.stem)
    state = kept.read()
    assert state is not None
    kept.write(change(state))


def test_arrays_changed_by_hand_are_not_gone_on_from(tmp_path):
    reconstruct(sphere(), Settings(checkpoints=str(tmp_path), passes=(1, 1), seconds=0.0))
    (path,) = tmp_path.iterdir()
    with np.load(io.BytesIO(path.read_bytes())) as file:
        arrays = dict(file)
    arrays["u0"][:] = np.nan
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="delete it"):
        reconstruct(sphere(), Settings(checkpoints=str(tmp_path), passes=(1, 1)))


@pytest.mark.parametrize("name", ["level", "seconds", "support", "u0", "dual0", "curvature0", "numbers", "reals"])
@pytest.mark.parametrize("how", ["empty", "missing", "one"])
def test_a_state_that_is_none_of_a_fit_is_refused(tmp_path, name, how):
    reconstruct(sphere(), Settings(checkpoints=str(tmp_path), passes=(1, 1), seconds=0.0))
    value = {"empty": np.zeros(0, np.uint8), "one": np.ones((1, 1), np.uint8)}.get(how)
    rewritten(tmp_path, lambda s: {k: v for k, v in (s | {name: value}).items() if v is not None})
    with pytest.raises(InputError, match="delete it"):
        reconstruct(sphere(), Settings(checkpoints=str(tmp_path), passes=(1, 1)))


@pytest.mark.parametrize("how", [None, np.ones((1, 1), np.uint8)])
def test_a_state_of_other_fine_voxels_is_refused(tmp_path, how):
    reconstruct(sphere(), Settings(checkpoints=str(tmp_path), passes=(1, 1), seconds=0.0))
    rewritten(tmp_path, lambda s: {k: v for k, v in (s | {"fine": how}).items() if v is not None})
    with pytest.raises(InputError, match="delete it"):
        reconstruct(sphere(), Settings(checkpoints=str(tmp_path), passes=(1, 1)))


@pytest.mark.parametrize("name", ["run.numbers", "run.reals", "moments.steps", "pulls", "parameters.positions"])
@pytest.mark.parametrize("how", ["empty", "missing"])
def test_a_state_that_is_none_of_a_published_fit_is_refused(tmp_path, name, how):
    settings = Published(steps=30, checkpoints=str(tmp_path), seconds=0.0)
    fit_published(sphere(), settings)
    rewritten(tmp_path, lambda s: {k: v for k, v in (s | {name: np.zeros(0)}).items() if how == "empty" or k != name})
    with pytest.raises(InputError, match="delete it"):
        fit_published(sphere(), Published(steps=30, checkpoints=str(tmp_path)))


def test_the_checksum_is_sha_256_of_all_before_it(tmp_path):
    kept = Checkpoint(folder=tmp_path, identity="a")
    kept.write(STATE)
    whole = kept.path.read_bytes()
    assert hashlib.sha256(whole[:-32]).digest() == whole[-32:]


def test_a_checkpoint_that_declares_more_than_it_holds_is_refused_before_room_is_made(tmp_path):
    """Its checksum fits, as of a file that somebody made: 8 TB of zeros are never asked for."""
    header, bytes_of = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with zipfile.ZipFile(bytes_of, "w") as file:
        file.writestr("x.npy", header.getvalue())
    kept = Checkpoint(folder=tmp_path, identity="it")
    kept.path.write_bytes(bytes_of.getvalue() + hashlib.sha256(bytes_of.getvalue()).digest())
    with pytest.raises(InputError, match=r"damaged .*ends before its array of shape"):
        kept.read()
