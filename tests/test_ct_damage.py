"""Damaged and hostile CT files: one sentence each, no file outside of the folder, no memory that the file does not pay.

Every reader gets 500 files: bytes flipped, cut short, shifted, and numbers of the header replaced.
"""

import gzip
import io
import re
import subprocess
import sys
import tracemalloc
import zlib

import numpy as np
import pydicom
import pytest
import tifffile
from ct_files import SPACING, corner, stored, write

from ctsim.benchmarks import make_dataset
from ctsim.dataset.arrayfile import PLAIN
from ctsim.errors import InputError
from ctsim.phantoms.ct_file import read_hu, settle

FILES = 500
ROOM = 2**24  # bytes: the files have some kB, and a piece of a compressed stream is 1 MB
NUMBERS = (b"0", b"-1", b"nan", b"1e9", b"65535", b"2147483647", b"99999999999999999999", b"../../etc/passwd", b"")
WORDS = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 0x7FF8000000000000)
opened: list[str] | None = None


def _watch(event, arguments):
    if opened is not None and event == "open":
        opened.append(str(arguments[0]))


sys.addaudithook(_watch)


def damaged(data: bytes, rng: np.random.Generator, text: int) -> bytes:
    """Return a file with one damage; its first `text` bytes are a header, which is hit more often."""
    out, kind = bytearray(data), rng.integers(6)
    at = int(rng.integers(min(text, len(out)) if rng.random() < 0.7 else len(out)))
    if kind == 0:
        for place in (at + rng.integers(0, 32, rng.integers(1, 9))).clip(0, len(out) - 1):
            out[place] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del out[at:]
    elif kind == 2:
        del out[at : at + int(rng.integers(1, 9))]
    elif kind == 3:
        out[at:at] = rng.bytes(int(rng.integers(1, 9)))
    elif kind == 4:
        size = int(rng.choice([1, 2, 4, 8]))
        at -= at % size
        out[at : at + size] = (WORDS[rng.integers(len(WORDS))] & (256**size - 1)).to_bytes(
            size, rng.choice(["little", "big"])
        )
    elif found := list(re.finditer(rb"[-+.\w]+", data[:text])):
        hit = found[rng.integers(len(found))]
        out[hit.start() : hit.end()] = NUMBERS[rng.integers(len(NUMBERS))]
    return bytes(out)


def read(path) -> str:
    """Read a file as a CT; return what is wrong with it, empty if nothing is."""
    spacing = SPACING if path.suffix in (".tif", ".npy") else None
    try:
        hu = read_hu(settle(str(path), spacing, None))
    except InputError as error:
        return str(error)
    assert hu.ndim == 3 and np.isfinite(hu).all()
    return ""


def whole(folder, kind):
    """Write the undamaged CT; return its path and the file that is to be damaged."""
    if kind == ".npy":
        np.save(folder / "ct.npy", corner())
        return folder / "ct.npy", folder / "ct.npy"
    if kind == ".tif":
        tifffile.imwrite(folder / "ct.tif", corner(), photometric="minisblack", compression="zlib")
        return folder / "ct.tif", folder / "ct.tif"
    path = write(folder, kind, *stored(corner((3, 7, 11) if kind == "dicom" else (5, 7, 11))))
    return path, path / "IM37" if kind == "dicom" else path


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dicom", ".nii", ".nii.gz", ".mha", ".mhd", ".nrrd", ".nhdr", ".tif", ".npy"])
def test_a_damaged_file_is_read_or_refused_in_one_sentence(tmp_path, capfd, kind):
    global opened
    path, victim = whole(tmp_path, kind)
    assert read(path) == ""
    data, rng = victim.read_bytes(), np.random.default_rng(20)
    header = {".nii": 352, ".nii.gz": 352, "dicom": len(data) - 200, ".npy": 128, ".tif": 400}.get(kind, 600)
    said = set()
    tracemalloc.start()
    try:
        for number in range(FILES):
            if kind == ".nii.gz" and number % 2:  # within the stream, past its checksum
                victim.write_bytes(gzip.compress(damaged(gzip.decompress(data), rng, header), 1))
            else:
                victim.write_bytes(damaged(data, rng, header))
            opened = []
            tracemalloc.reset_peak()
            sentence = read(path)
            assert tracemalloc.get_traced_memory()[1] < ROOM, (number, sentence)
            assert sentence.isprintable() and len(sentence) < 600
            assert not sentence or re.match(r"path: .*ct|path: .*slices|rescale: |spacing: ", sentence)
            strangers = [p for p in opened if not p.startswith(str(tmp_path)) and not p.endswith((".py", ".pyc"))]
            assert not strangers, (number, strangers)
            said.add(re.sub(r"[-\d.]+", "0", sentence.replace(str(tmp_path), ""))[:80])
    finally:
        opened = None
        tracemalloc.stop()
    assert len(said) > 3  # damage of several kinds was met
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["../secret.raw", "/etc/passwd", "sub/ct.raw", "..", "", "a\\b.raw", "link.raw"])
def test_no_header_leads_out_of_its_folder(tmp_path, name):
    inner = tmp_path / "inner"
    inner.mkdir()
    (tmp_path / "secret.raw").write_bytes(corner().tobytes())
    (inner / "link.raw").symlink_to(tmp_path / "secret.raw")
    for kind, key in ((".mhd", "ElementDataFile = "), (".nhdr", "data file: ")):
        path = write(inner, kind, *stored(corner()))
        text = path.read_text()
        path.write_text(re.sub(f"{key}.*", lambda _, key=key: key + name, text))
        assert re.search("names .* as its data|is no MetaImage|several files|no such file", read(path)), read(path)


def test_no_tiff_opens_another_file(tmp_path):
    """An OME-TIFF may say that its planes are in another file."""
    global opened
    secret = tmp_path / "secret.ome.tif"
    tifffile.imwrite(secret, corner()[:1], photometric="minisblack")
    inner = tmp_path / "inner"
    inner.mkdir()
    xml = (
        '<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="urn:uuid:1"><Image ID="Image:0">'
        '<Pixels ID="Pixels:0" DimensionOrder="XYZCT" Type="int16" SizeX="11" SizeY="7" SizeZ="2" SizeC="1" SizeT="1">'
        '<TiffData FirstZ="0" IFD="0" PlaneCount="1"><UUID FileName="ct.tif">urn:uuid:1</UUID></TiffData>'
        '<TiffData FirstZ="1" IFD="0" PlaneCount="1"><UUID FileName="../secret.ome.tif">urn:uuid:2</UUID></TiffData>'
        "</Pixels></Image></OME>"
    )
    tifffile.imwrite(inner / "ct.tif", corner()[:1], photometric="minisblack", description=xml, metadata=None)
    try:
        opened = []
        read(inner / "ct.tif")
        assert not [p for p in opened if "secret" in p]
    finally:
        opened = None


def bombs():
    size = (PLAIN // 2 + 1, 1, 2)  # int16: just more than is decoded whatever the file's size
    zeros = bytes(2 * np.prod(size))
    head = (
        "NRRD0005\ntype: int16\ndimension: 3\nspace: LPS\nspace directions: (1,0,0) (0,1,0) (0,0,1)\nendian: little\n"
    )
    sizes = f"sizes: {size[2]} {size[1]} {size[0]}\nencoding: gzip\n\n"
    yield "ct.nrrd", (head + sizes).encode() + gzip.compress(zeros, 1)
    meta = f"ObjectType = Image\nNDims = 3\nCompressedData = True\nDimSize = {size[2]} {size[1]} {size[0]}\n"
    meta += "ElementSpacing = 1 1 1\nElementType = MET_SHORT\nElementDataFile = LOCAL\n"
    yield "ct.mha", meta.encode() + zlib.compress(zeros, 1)
    # a small header in front of a large stream: no more of it is decoded than the header declares
    yield "more.nrrd", (head + "sizes: 2 2 2\nencoding: gzip\n\n").encode() + gzip.compress(zeros, 1)
    yield "more.mha", meta.replace(f"{size[2]} {size[1]} {size[0]}", "2 2 2").encode() + zlib.compress(zeros, 1)


@pytest.mark.slow
def test_a_bomb_does_not_go_off(tmp_path):
    for name, data in bombs():
        path = tmp_path / name
        path.write_bytes(data)
        tracemalloc.start()
        said = read(path)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert peak < ROOM, name
        assert re.search("would decode to 537 MB|holds more voxels than its header declares", said), said


def test_a_deflated_slice_is_not_inflated(tmp_path):
    path = write(tmp_path, "dicom", *stored(corner()))
    one = pydicom.dcmread(path / "IM37")
    one.file_meta.TransferSyntaxUID = "1.2.840.10008.1.2.1.99"
    one.save_as(path / "IM37")
    assert "is compressed ('Deflated Explicit VR Little Endian')" in read(path)


def test_a_decoder_says_nothing_of_its_own(tmp_path):
    """tifffile logs what it finds wrong; a process that sets up no logging would print that before our sentence."""
    whole = io.BytesIO()
    tifffile.imwrite(whole, corner(), photometric="minisblack")
    path, code = tmp_path / "ct.tif", "import sys\nfrom ctsim.dataset.arrayfile import read_array\nread_array(PATH)"
    for cut in (-700, 300):
        path.write_bytes(whole.getvalue()[:cut])
        told = code.replace("PATH", f"__import__('pathlib').Path({str(path)!r})")
        found = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=False)
        *_, last = found.stderr.splitlines()
        assert found.stderr.startswith("Traceback") and last.startswith(f"ctsim.errors.InputError: {path} ")


def test_the_command_ends_with_2(tmp_path, capsys):
    (tmp_path / "ct.nrrd").write_bytes(b"NRRD0005\n")
    (tmp_path / "scene.toml").write_text(
        f'name = "a"\nphantom = {{ recipe = "ct_volume", path = "{tmp_path}/ct.nrrd" }}\n'
    )
    assert make_dataset.main([str(tmp_path / "scene.toml"), str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "has no field 'type', which an NRRD volume needs" in said
