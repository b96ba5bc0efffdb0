"""Shards for training: what is in them is the scan, and the PyTorch dataset gives it to any worker."""

import pickle
import shutil
from pathlib import Path

import h5py
import msgspec
import numpy as np
import pytest
import scan_files
import torch
from closed_scans import GEOMETRY, counts_of
from closed_scans import line_integrals as integrals_of
from torch.utils.data import DataLoader

from ctsim.benchmarks.importing import Flags
from ctsim.benchmarks.importing.work import bring
from ctsim.benchmarks.make_dataset import main as make_dataset
from ctsim.benchmarks.shards.work import main
from ctsim.dataset.manifest import read_index
from ctsim.dataset.store import open_scan
from ctsim.errors import InputError
from ctsim.io import shards
from ctsim.reconstruct.fdk import reconstruct
from ctsim.reconstruct.log import line_integrals
from ctsim.torch import Scans

SUITE = """
[defaults]
truth.trace = true
[defaults.scanner]
n_views = 7
n_detector = [8, 10]
n_voxel = [5, 6, 9]
[[scene]]
name = "rods"
count = 6
scans_each = 2
split = { train = 0.5, test = 0.5 }
phantom = { recipe = "validation", n_voxel = [16, 16, 16] }
[[scene]]
name = "bare"
phantom = { recipe = "validation", metal = "none", n_voxel = [16, 16, 16] }
[[scene]]
name = "slice"
phantom = { recipe = "validation", n_voxel = [16, 16, 16] }
scanner = { n_detector = [1, 12], n_voxel = [1, 6, 9] }
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    found = tmp_path_factory.mktemp("training")
    (found / "s.toml").write_text(SUITE)
    assert make_dataset([str(found / "s.toml"), str(found / "data")]) == 0
    assert main([str(found / "data"), str(found / "out"), "--scans-per-shard", "2"]) == 0
    return found


def test_every_scan_is_in_one_shard_of_its_split(folder):
    index = read_index(folder / "data")
    of = shards.shards_of(folder / "out")
    found = {path.name: [e.name for e in one.scans] for path, one in of.items()}
    assert sorted(name for names in found.values() for name in names) == sorted(index)
    for path, names in found.items():
        assert len(names) <= 2
        assert {index[n].about.split if index[n].about else "all" for n in names} == {path.rpartition("-")[0]}


def test_a_split_of_another_folder_is_refused(folder, tmp_path):
    shutil.copytree(folder / "data", tmp_path / "data")
    index = tmp_path / "data" / "index.jsonl"
    index.write_text(index.read_text().replace('"split":"train"', '"split":"../train"'))
    with pytest.raises(InputError, match=r"names the split '\.\./train', expected"):
        main([str(tmp_path / "data"), str(tmp_path / "out" / "shards")])
    assert not list(tmp_path.rglob("*.h5"))


def test_arrays_are_those_of_the_scan(folder):
    stored = open_scan(folder / "data/rods-00001")
    assert stored.metal_free is not None
    want = {
        "p": line_integrals(stored.scan, slice(None))[0],
        "twin_p": line_integrals(stored.metal_free.scan, slice(None))[0],
        "fdk": reconstruct(stored.scan).values,
        "twin": reconstruct(stored.metal_free.scan).values,
        "reference": torch.from_numpy(stored.reference("effective")),
        "metal": torch.from_numpy(stored.metal).float(),
        "trace": torch.from_numpy(stored.array("trace")).float(),
    }
    whole = Scans(folder / "out", shards.ITEMS)
    (k,) = (k for k in range(len(whole)) if whole.where(k)[0] == "rods-00001")
    assert whole[k].keys() == want.keys() and whole.where(k) == ("rods-00001", "validation-0", 0)
    for item, array in want.items():
        assert whole[k][item].dtype == torch.float32
        torch.testing.assert_close(whole[k][item], array, rtol=0, atol=0)
    assert want["trace"].any() and not torch.equal(want["fdk"], want["twin"])
    (path,) = (
        p for p in shards.shards_of(folder / "out") if "rods-00001" in [e.name for e in shards.contents(p).scans]
    )
    with h5py.File(path) as file:
        assert file["rods-00001"].attrs["scene"] == (stored.folder / "scene.toml").read_text()


def test_a_scan_without_metal_is_its_own_twin(folder):
    scans = Scans(folder / "out", shards.ITEMS)
    (bare,) = (scans[k] for k in range(len(scans)) if scans.where(k)[0] == "bare")
    assert torch.equal(bare["fdk"], bare["twin"]) and torch.equal(bare["p"], bare["twin_p"]) and not bare["trace"].any()


@pytest.mark.parametrize(("plane", "axis"), [("z", 0), ("y", 1), ("x", 2)])
def test_slices_are_those_of_the_volume(folder, plane, axis):
    whole, slices = (Scans(folder / "out", ("fdk", "metal"), plane=p, split="train") for p in (None, plane))
    size = (5, 6, 9)[axis]
    assert len(slices) == size * len(whole)
    for k in (0, size - 1, size, -1):
        name, _, at = slices.where(k)
        scan = k % len(slices) // size
        assert name == whole.where(scan)[0] and at == k % size
        for item in ("fdk", "metal"):
            assert torch.equal(slices[k][item], whole[scan][item].select(axis, at))


def test_a_slice_scan_gives_its_sinogram_with_its_image(folder):
    with h5py.File(folder / "out/all-00000.h5") as file:
        p, fdk = np.array(file["slice/p"]), np.array(file["slice/fdk"])
    only = Scans(folder / "out", ("p", "fdk", "twin"), split="")
    assert {len(only[k]["p"].shape) for k in range(len(only))} == {3}
    with pytest.raises(InputError, match="has 8 rows and 5 slices"):
        Scans(folder / "out", ("p", "fdk"), plane="z")
    alone = folder / "alone"
    if not alone.exists():
        alone.mkdir()
        with h5py.File(folder / "out/all-00000.h5") as file:
            arrays = {item: np.array(array) for item, array in file["slice"].items()}
        shards.write(alone / "a.h5", [(shards.Entry(name="slice", content_hash="c"), arrays, "")])
    scans = Scans(alone, ("p", "trace", "fdk", "reference", "twin"), plane="z")
    assert len(scans) == 1
    assert np.array_equal(scans[0]["p"], p[:, 0]) and np.array_equal(scans[0]["fdk"], fdk[0])
    with pytest.raises(InputError, match="projections go with plane = 'z'"):
        Scans(alone, ("p", "fdk"), plane="x")


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_workers_read_what_the_process_reads(folder, method):
    scans = Scans(folder / "out", ("fdk", "twin", "metal"), plane="z", split="train")
    first = scans[0]["fdk"].clone()  # the files are open when workers are forked
    context = torch.multiprocessing.get_context(method)
    loader = DataLoader(scans, batch_size=4, num_workers=2, multiprocessing_context=context)
    found = torch.cat([batch["fdk"] for batch in loader])
    assert torch.equal(found, torch.stack([scans[k]["fdk"] for k in range(len(scans))])) and torch.equal(
        found[0], first
    )


def test_it_pickles_without_its_files(folder):
    scans = Scans(folder / "out", ("fdk",))
    before = scans[1]["fdk"]
    data = pickle.dumps(scans)
    assert len(data) < 20_000 and torch.equal(pickle.loads(data)[1]["fdk"], before)


def test_no_individual_of_training_is_in_the_test(folder):
    names = [
        {scans.where(k)[1] for k in range(len(scans))}
        for scans in (Scans(folder / "out", ("fdk",), split=split) for split in ("train", "test"))
    ]
    assert all(names) and not names[0] & names[1]


def test_shards_that_are_there_are_kept_and_damaged_ones_made_again(folder, capsys):
    first, second = list(shards.shards_of(folder / "out"))[:2]
    before = [path.stat().st_mtime_ns for path in (first, second)]
    data = first.read_bytes()
    first.write_bytes(data[:1000])
    with pytest.raises(InputError, match="is no shard"):
        Scans(folder / "out")
    assert main([str(folder / "data"), str(folder / "out"), "--scans-per-shard", "2"]) == 0
    assert first.stat().st_mtime_ns != before[0] and second.stat().st_mtime_ns == before[1]
    assert "8 scans in" in capsys.readouterr().out
    assert len(shards.contents(first).scans) == 2


def test_a_folder_that_lacks_a_shard_is_no_training_set(folder, tmp_path):
    """An interrupted run leaves some of the shards; scans that come later make more, unknown to the first ones."""
    shutil.copytree(folder / "out", tmp_path / "out")
    (lost := next((tmp_path / "out").glob("train-00000.h5"))).rename(tmp_path / "lost.h5")
    with pytest.raises(InputError, match=r"holds 1 of 2 shards of train; make-dataset shards writes the others"):
        Scans(tmp_path / "out")
    (tmp_path / "lost.h5").rename(lost)
    data, out = str(folder / "data"), str(tmp_path / "out")
    for path in (tmp_path / "out").glob("train-*.h5"):
        with h5py.File(path, "r+") as file:  # as if there had been one, or three
            file.attrs["contents"] = file.attrs["contents"].replace('"of":2', f'"of":{1 if path == lost else 3}')
    assert main([data, out, "--scans-per-shard", "2"]) == 0
    assert [shards.contents(p).of for p in sorted((tmp_path / "out").glob("train-*.h5"))] == [1, 2]
    assert len(Scans(tmp_path / "out")) == 8


def test_a_shard_of_other_scans_or_items_is_not_taken_for_one_of_these(folder, tmp_path):
    data, out = str(folder / "data"), tmp_path / "out"
    assert main([data, str(out), "--items", "metal"]) == 0
    assert main([data, str(out)]) == 0  # all items now
    assert Scans(out, ("p", "metal"))[0].keys() == {"p", "metal"}
    (other := out / "train-00007.h5").write_bytes((out / "train-00000.h5").read_bytes())
    with pytest.raises(InputError, match=r"train-00000\.h5 and train-00007\.h5 both hold rods"):
        Scans(out)
    with pytest.raises(InputError, match=r"train-00007\.h5: is not among the shards"):
        main([data, str(out)])
    other.unlink()
    assert main([data, str(out)]) == 0


def test_a_damaged_array_is_named(folder, tmp_path):
    shutil.copytree(folder / "out", tmp_path / "out")
    path = next(iter(shards.shards_of(tmp_path / "out")))
    with h5py.File(path) as file:
        name = shards.contents(path).scans[0].name
        chunk = file[name]["fdk"].id.get_chunk_info(2)
    data = bytearray(path.read_bytes())
    data[chunk.byte_offset + chunk.size // 2] ^= 4
    path.write_bytes(data)
    scans = Scans(tmp_path / "out", ("fdk",))
    at = next(k for k in range(len(scans)) if scans.where(k)[0] == name)
    with pytest.raises(InputError, match=rf"{path}: fdk of {name} is damaged; delete the file"):
        scans[at]


def test_a_measured_scan_has_what_is_known_of_it(tmp_path):
    few = msgspec.structs.replace(GEOMETRY, n_views=6)
    bring(Flags(scan=scan_files.skyscan(tmp_path / "scan", counts_of(integrals_of(few)), few), out=tmp_path / "data"))
    assert main([str(tmp_path / "data"), str(tmp_path / "out")]) == 0
    (entry,) = shards.contents(next(iter(shards.shards_of(tmp_path / "out")))).scans
    assert {*entry.shapes} == {"p", "fdk"}
    with pytest.raises(InputError, match=r"--items reference: .*data/rods is a measured scan without it"):
        main([str(tmp_path / "data"), str(tmp_path / "none"), "--items", "p", "reference"])
    assert not (tmp_path / "none").exists()


def test_a_shard_that_went_away_is_one_sentence(folder, tmp_path):
    shutil.copytree(folder / "out", tmp_path / "out")
    scans = Scans(tmp_path / "out", ("fdk",))
    for path in (tmp_path / "out").glob("*.h5"):
        path.unlink()
    with pytest.raises(InputError, match="cannot be opened any more"):
        scans[0]


def test_contents_that_are_no_text_are_damage(folder, tmp_path):
    path = tmp_path / "train-00000.h5"
    with h5py.File(path, "w") as file:
        file.attrs["contents"] = np.bytes_(b'{"format": \xff}')
    with pytest.raises(InputError, match="is no shard"):
        Scans(tmp_path)


def test_what_is_not_there_is_one_sentence(folder, tmp_path):
    for call, said in (
        (lambda: Scans(tmp_path), "holds no shards"),
        (lambda: Scans(folder / "out", ("fdkk",)), "items: 'fdkk' is unknown"),
        (
            lambda: Scans(folder / "out", "fdk"),
            r"items: expected a tuple of names, such as \('fdk',\), got the text 'fdk'",
        ),
        (
            lambda: Scans(folder / "out", ("p",), plane="y"),
            r"plane = 'y' cuts volumes, but 'p' holds projections, .*; expected plane = None, or items without them",
        ),
        (lambda: Scans(folder / "out", ()), "items: expected at least one"),
        (lambda: Scans(folder / "out", plane="w"), "plane must be 'z', 'y', 'x' or None"),
        (lambda: Scans(folder / "out", split="val"), "no scan in split 'val', expected test, train"),
        (lambda: main([str(folder / "data"), str(tmp_path), "--items", "fdkk"]), "--items fdkk: expected some of p"),
        (lambda: main([str(folder / "data"), str(tmp_path), "--scans-per-shard", "0"]), "expected 1 or more"),
        (lambda: main([str(folder / "data"), str(folder / "s.toml")]), "s.toml: is a file, expected a folder"),
    ):
        with pytest.raises(InputError, match=said):
            call()
    with pytest.raises(IndexError):
        Scans(folder / "out")[10**6]
