"""A volume that was made elsewhere: FDK's own gets FDK's row, and what does not fit its scan is refused."""

import numpy as np
import pytest
import SimpleITK as sitk
import tifffile
from run_records import run_methods

from ctsim.benchmarks import cli, methods
from ctsim.benchmarks.studies.methods import records
from ctsim.benchmarks.studies.methods.volumes import read_volume
from ctsim.benchmarks.submit import Flags
from ctsim.benchmarks.submit.work import submit
from ctsim.dataset.store import open_scan
from ctsim.errors import InputError
from ctsim.io.volumes import metaimage, nifti
from ctsim.io.volumes.placed import Placed


@pytest.fixture(scope="module")
def fdk(smallest, tmp_path_factory):
    """FDK on the smallest scan and on its twin: the results folder, its records, and both volumes."""
    results = tmp_path_factory.mktemp("fdk")
    run_methods([open_scan(smallest / "smallest")], [methods.find("fdk")], results)
    found = {r.run.variant: r for r in records.read(results)}
    return results, found, {variant: read_volume(results / r.volume) for variant, r in found.items()}


def write(path, values, stored):
    grid = stored.geometry
    if path.name.endswith(".tif"):
        tifffile.imwrite(path, values)
    elif path.name.endswith(".npy"):
        np.save(path, values)
    elif path.name.endswith(".nrrd"):
        image = sitk.GetImageFromArray(values)
        image.SetSpacing(grid.d_voxel[::-1])
        sitk.WriteImage(image, str(path))
    else:
        writer = nifti if ".nii" in path.name else metaimage
        writer.write_volume(path, Placed(values=values, spacing=grid.d_voxel, centre=grid.off_origin))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("end", [".tif", ".npy", ".nii", ".nii.gz", ".mha", ".nrrd"])
def test_fdks_own_volume_gets_fdks_row(smallest, fdk, tmp_path, end):
    _, theirs, volumes = fdk
    stored = open_scan(smallest / "smallest")
    paths = {variant: write(tmp_path / f"{variant}{end}", values, stored) for variant, values in volumes.items()}
    given = Flags(
        data=smallest, results=tmp_path / "r", volume=paths["metal"], scene="smallest", name="mine",
        twin=paths["metal_free"], seconds=12.5, cite="doi:10.1000/1",
    )  # fmt: skip
    found = {r.run.variant: r for r in submit(given)}
    assert found.keys() == theirs.keys()
    for variant, record in found.items():
        assert record.scores == theirs[variant].scores  # every number of every protocol, to the last digit
        assert (record.run.method, record.label, record.status) == ("submitted", "mine (submitted)", "ok")
    cost = found["metal"].cost
    assert (cost.wall, cost.device, cost.cpu, cost.peak_bytes) == (12.5, "stated", None, None)
    assert found["metal_free"].cost is None


@pytest.mark.slow
def test_the_command_adds_a_marked_row(smallest, fdk, tmp_path, capsys, monkeypatch):
    results, _, volumes = fdk
    path = write(tmp_path / "v.npy", volumes["metal"], open_scan(smallest / "smallest"))
    words = ["score", smallest, results, path, "--scene", "smallest", "--name", "mine", "--seconds", "3"]
    monkeypatch.setattr("sys.argv", ["run-benchmark", *map(str, words)])
    assert cli.run_benchmark() == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "mine (submitted)" in said and "not measured but stated: the seconds of mine (submitted)" in said
    table = (results / "table.md").read_text(encoding="utf-8")
    assert "mine (submitted)" in table and "not measured but stated" in table


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"scene": "smalest"}, "smallest"),
        ({"name": "fdk"}, "is a method of ctsim"),
        ({"name": "a[b]"}, "expected up to 60 letters"),
        ({"seconds": -1.0}, "must be positive"),
        ({"inputs": " "}, "--inputs ' ': expected a text such as"),
        ({"inputs": "counts | mask"}, "--inputs 'counts | mask': expected"),
        ({"inputs": "counts\nonly"}, "up to 60 letters, digits"),
        ({"cite": "doi:1\n2"}, "--cite 'doi:1\\n2': expected one line"),
        ({"cite": "a" * 301}, "up to 300 characters"),
        ({"unit": "hu"}, "looks like 1/mm"),
    ],
)
def test_wrong_flags_are_one_sentence(smallest, fdk, tmp_path, change, said):
    path = write(tmp_path / "v.npy", fdk[2]["metal"], open_scan(smallest / "smallest"))
    given = {"data": smallest, "results": tmp_path, "volume": path, "scene": "smallest", "name": "mine", **change}
    with pytest.raises(InputError, match=r"^[^\n]*$") as caught:
        submit(Flags(**given))
    assert said in str(caught.value)


def test_results_are_a_folder(smallest, tmp_path, capsys, monkeypatch):
    volume = tmp_path / "v.npy"
    volume.write_bytes(b"1")
    words = ["score", smallest, volume, volume, "--scene", "smallest", "--name", "mine"]
    monkeypatch.setattr("sys.argv", ["run-benchmark", *map(str, words)])
    assert cli.run_benchmark() == 2
    assert f"RESULTS: {volume} is a file, expected a folder" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_another_spacing_is_refused(smallest, fdk, tmp_path):
    stored, path = open_scan(smallest / "smallest"), tmp_path / "v.mha"
    twice = tuple(2 * d for d in stored.geometry.d_voxel)
    metaimage.write_volume(path, Placed(values=fdk[2]["metal"], spacing=twice, centre=(0.0, 0.0, 0.0)))
    with pytest.raises(InputError, match=r"v.mha has voxels of .* mm \(z × y × x\), the scan's grid"):
        submit(Flags(data=smallest, results=tmp_path, volume=path, scene="smallest", name="mine"))
