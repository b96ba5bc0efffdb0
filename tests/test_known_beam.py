"""A method that is told the spectrum is told that of the scan."""

import msgspec
import pytest
from conftest import SMALLEST
from run_records import run_methods

from ctsim.api import reconstruct_scan
from ctsim.benchmarks import make_dataset, methods
from ctsim.benchmarks.known_beam import NO_BOWTIE, NOT_TOLD
from ctsim.benchmarks.studies.methods import plan, records
from ctsim.benchmarks.studies.methods.study import main
from ctsim.dataset.store import list_scans, open_scan
from ctsim.phantoms.dataset import scene_of

TUBE = "[scanner.tube]\nkvp = 70.0\nfilters = [{ material = 'Cu', thickness = 0.2 }]\n"
DETECTOR = "[scanner.detector]\nkind = 'csi'\nthickness = 0.6\n"
BOWTIE = "[scanner.tube.bowtie]\ncenter = 1.0\nedge = 9.0\nhalf_angle_deg = 15.0\n"
CU = [{"material": "Cu", "thickness": 0.2}]


def made(folder, more):
    (folder / "scene.toml").write_text(SMALLEST + more, encoding="utf-8")
    assert make_dataset.main([str(folder / "scene.toml"), str(folder / "data")]) == 0
    return folder / "data"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A scan of another tube and another screen than the simulator's defaults."""
    return made(tmp_path_factory.mktemp("beam"), TUBE + DETECTOR)


@pytest.fixture(scope="module")
def stored(data):
    return open_scan(list_scans(data)[0])


def told_of(stored):
    scanner = scene_of(stored).resolve()  # pyright: ignore[reportAttributeAccessIssue]
    return {"tube": msgspec.to_builtins(scanner.tube), "detector": msgspec.to_builtins(scanner.detector)}


def test_the_command_tells_the_beam_of_the_scan_and_resumes(data, tmp_path, stored):
    results = tmp_path / "results"
    command = [str(data), str(results), "--method", "ibhc", "--method", "water-precorrection"]
    assert main(command) == 0
    found = records.read(results)
    assert {r.label for r in found} == {"ibhc", "water-precorrection"} and len(found) == 4
    for record in found:
        assert record.details["tube"]["kvp"] == 70.0 and record.details["tube"]["filters"] == CU
        assert (record.details["detector"]["kind"], record.details["detector"]["thickness"]) == ("csi", 0.6)
        assert record.run.params["tube"] == record.details["tube"] and "limitation" not in record.details
    assert main(command) == 0 and len(records.read(results)) == 4
    # what is told is part of the run: a record of a run that was not told is another one
    job = plan.jobs([stored], [methods.find("ibhc")], anchor=False)[0]
    untold = msgspec.structs.replace(job.task, settings=msgspec.structs.replace(job.task.settings, params={}))
    assert untold.identity != job.task.identity in {r.identity for r in found}


def test_a_volume_is_that_of_the_tables_given(stored):
    found, given = reconstruct_scan(stored, "ibhc"), reconstruct_scan(stored, "ibhc", **told_of(stored))
    assert (found.values == given.values).all() and found.details == given.details
    bare = reconstruct_scan(stored.scan, "ibhc")
    assert NOT_TOLD in bare.details["limitation"] and not (bare.values == found.values).all()


@pytest.mark.parametrize(
    ("name", "given", "told"),
    [("ibhc", {}, True), ("polyner", {}, True), ("splat", {"response": "known"}, True), ("splat", {}, False),
     ("field", {"response": "known"}, True), ("fdk", {}, False), ("ibhc", {"tube": {"kvp": 60.0}}, False),
     ("ibhc", {"detector": {"kind": "csi"}}, False)],
)  # fmt: skip
def test_only_what_needs_the_spectrum_and_has_none_is_told(name, given, told, stored):
    method = methods.find(name, given)
    fitted = plan.fitted(method, stored)
    assert fitted.label == method.label and fitted.overrides == method.overrides
    assert fitted.told == (told_of(stored) if told else {}) and fitted.params == method.params | fitted.told
    for job in plan.jobs([stored], [method], anchor=True):
        assert plan.job_of(job.task).task.identity == job.task.identity  # a worker is told the same


def test_of_a_bow_tie_or_without_a_scene_there_is_a_limitation(tmp_path):
    data = made(tmp_path, TUBE + BOWTIE)
    stored = open_scan(list_scans(data)[0])
    records = run_methods([stored], [methods.find("ibhc")], tmp_path / "results", anchor=False)
    assert records[0].details["tube"]["filters"] == CU and records[0].details["limitation"] == NO_BOWTIE
    (list_scans(data)[0] / "scene.toml").unlink()
    details = reconstruct_scan(stored, "ibhc").details
    assert details["limitation"] == f"{NOT_TOLD}: the scan comes without scene.toml"
    assert list(details["tube"]["filters"]) == [{"material": "Al", "thickness": 0.5}]
