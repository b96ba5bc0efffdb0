"""Files from elsewhere: what they declare is judged before it is decoded, and is one sentence where it cannot be."""

import zipfile

import numpy as np
import pytest
import tifffile

from ctsim.benchmarks.studies.methods.volumes import read_volume, write_volume
from ctsim.dataset import arrayfile
from ctsim.dataset.arrayfile import read_array, read_arrays
from ctsim.errors import InputError

BLOCK = np.arange(60, dtype=np.int16).reshape(3, 4, 5)


@pytest.fixture
def never_decoded(monkeypatch):
    """Fail where pixels are decoded."""

    def decode(*_, **__):
        pytest.fail("the file was decoded")

    for owner, name in ((tifffile.TiffPageSeries, "asarray"), (tifffile.TiffFile, "asarray"), (np, "load")):
        monkeypatch.setattr(owner, name, decode)


def header(path, shape, dtype="<f4", data=b""):
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
        file.write(data)
    return path


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_what_is_plausible_is_read_as_it_is(tmp_path, compression):
    tifffile.imwrite(tmp_path / "a.tif", BLOCK, compression=compression, photometric="minisblack")
    np.save(tmp_path / "a.npy", np.asfortranarray(BLOCK))
    for name in ("a.tif", "a.npy"):
        for shape in (None, BLOCK.shape):
            np.testing.assert_array_equal(read_array(tmp_path / name, shape), BLOCK)


@pytest.mark.parametrize("bigtiff, order", [(False, "<"), (False, ">"), (True, "<"), (True, ">")])
def test_a_tiff_that_is_cut_off_between_pages_is_refused(tmp_path, bigtiff, order, caplog):
    """Before tifffile opens it, which would give what is left and log the rest."""
    path = tmp_path / "a.tif"
    slices = np.arange(6 * 32 * 32, dtype=np.int16).reshape(6, 32, 32)
    tifffile.imwrite(path, slices, bigtiff=bigtiff, byteorder=order, photometric="minisblack", metadata=None)
    np.testing.assert_array_equal(read_array(path), slices)
    whole = path.read_bytes()
    with tifffile.TiffFile(path) as file:
        offsets = [page.offset for page in file.pages]
    for end in (offsets[3], offsets[3] + 1, offsets[-1] + 9):
        path.write_bytes(whole[:end])
        with pytest.raises(InputError, match=r"^\S+a\.tif ends before its pages do$"):
            read_array(path)
        with pytest.raises(InputError, match="ends before its pages do"):
            arrayfile.describe_array(path)
    assert not caplog.records


def test_pages_that_lead_back_to_the_first_end_somewhere(tmp_path):
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((2, 8, 8), np.uint8), photometric="minisblack", metadata=None)
    with tifffile.TiffFile(path) as file:
        first, last = (page.offset for page in file.pages)
    data = bytearray(path.read_bytes())
    n_tags = int.from_bytes(data[last : last + 2], "little")
    at = last + 2 + 12 * n_tags
    data[at : at + 4] = first.to_bytes(4, "little")
    path.write_bytes(data)
    with path.open("rb") as file:
        assert arrayfile._holds_its_pages(file)


def test_a_small_file_that_decodes_to_much_is_refused_before(tmp_path, never_decoded):
    """300 MB of zeros in 0.3 MB."""
    path = tmp_path / "zeros.tif"
    pages = (np.zeros((1024, 1024), np.uint8) for _ in range(300))
    tifffile.imwrite(path, pages, shape=(300, 1024, 1024), dtype=np.uint8, compression="zlib", photometric="minisblack")
    assert path.stat().st_size < 2**20
    with pytest.raises(InputError, match=r"zeros\.tif has .* kB and would decode to 315 MB, as no CT does"):
        read_array(path)
    with pytest.raises(InputError, match=r"holds uint8 of shape \(300, 1024, 1024\), expected \(3, 4, 5\)"):
        read_array(path, (3, 4, 5))


def test_a_mask_may_be_small_for_its_size(tmp_path, monkeypatch):
    """Its shape is known: it can be as empty as it likes."""
    monkeypatch.setattr(arrayfile, "PLAIN", 1000)
    tifffile.imwrite(tmp_path / "a.tif", np.zeros((64, 64, 64), np.uint8), compression="zlib", rowsperstrip=64)
    with pytest.raises(InputError, match="as no CT does"):
        monkeypatch.setattr(arrayfile, "TIMES", 1)
        read_array(tmp_path / "a.tif")
    assert not read_array(tmp_path / "a.tif", (64, 64, 64)).any()


@pytest.mark.parametrize(
    ("shape", "dtype", "said"),
    [
        ((2000, 2000, 2000), "<f4", "declares 8000000000 values of shape .*, expected at most 2147483648"),
        ((10**12, 10**12, 10**12), "<u1", "expected at most"),
        ((100, 100, 100), "<f4", "ends before its array of shape"),
        ((100, 100), "<f4", r"holds float32 of shape \(100, 100\), expected one array of numbers \[z, y, x\]"),
        ((3, 4, 5), "|O", "holds object of shape"),
    ],
)
def test_a_header_of_more_than_there_is_is_refused_before(tmp_path, never_decoded, shape, dtype, said):
    with pytest.raises(InputError, match=said):
        read_array(header(tmp_path / "a.npy", shape, dtype, b"x" * 50))


@pytest.mark.parametrize("name", ["a.npy", "a.tif"])
@pytest.mark.parametrize("data", [b"", b"no array", b"II*\0\x08\0\0\0", b"\x93NUMPY\x01\0"])
def test_what_is_no_array_is_one_sentence(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=r"a\.(npy|tif) is no TIFF stack or \.npy array: ") as caught:
        read_array(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_archives_hold_no_more_than_they_are(tmp_path, never_decoded):
    np.savez_compressed(tmp_path / "small.npz", a=np.zeros(10**6))
    with pytest.raises(ValueError, match=r"a\.npy is compressed"):
        read_arrays(tmp_path / "small.npz")
    header(tmp_path / "a.npy", (10**12,), "<f8", b"x" * 50)
    with zipfile.ZipFile(tmp_path / "empty.npz", "w") as file:
        file.write(tmp_path / "a.npy", "a.npy")
    with pytest.raises(ValueError, match=r"a\.npy ends before its array"):
        read_arrays(tmp_path / "empty.npz")
    (tmp_path / "none.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match="not a zip file"):
        read_arrays(tmp_path / "none.npz")


def test_a_kept_volume_is_not_compressed(tmp_path):
    values = np.linspace(0, 1, 60, dtype=np.float32).reshape(3, 4, 5)
    write_volume(tmp_path / "a.tif", values)
    np.testing.assert_array_equal(read_volume(tmp_path / "a.tif"), values)
    tifffile.imwrite(tmp_path / "a.tif", values, compression="zlib", photometric="minisblack")
    with pytest.raises(InputError, match="cannot be read"):
        read_volume(tmp_path / "a.tif")
    with pytest.raises(InputError, match="there is no such volume"):
        read_volume(tmp_path / "b.tif")
