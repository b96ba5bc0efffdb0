"""The stress suite: every case on the smallest grids, and that a case whose remedy is taken out is reported."""

import dataclasses
import sys

import numpy as np
import pytest
from stress_ends import ENDS, catalogue

from ctsim import plan
from ctsim.baselines.known_spectrum import Beam
from ctsim.benchmarks.methods import TABLE, find
from ctsim.benchmarks.studies.stress import chain as stress_chain
from ctsim.benchmarks.studies.stress import methods as stress_methods
from ctsim.benchmarks.studies.stress import simulator as stress_simulator
from ctsim.benchmarks.studies.stress import splats as stress_splats
from ctsim.benchmarks.studies.stress import study as stress
from ctsim.benchmarks.studies.stress import tables as stress_records
from ctsim.benchmarks.studies.stress.cases import Findings, carry_out
from ctsim.benchmarks.studies.stress.scans import BONE, USUAL, WATER, example, geometry, in_air, rod
from ctsim.benchmarks.studies.stress.suite import load
from ctsim.benchmarks.studies.stress.worker import Worker
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.noise import Noise
from ctsim.quadrature import gauss_rule
from ctsim.reconstruct import log
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.splat import course, level, ordered
from ctsim.reconstruct.splat.kernels.lanes import WIDTH
from ctsim.reconstruct.splat.learner import seed_splats
from ctsim.reconstruct.splat.loss import l1_ssim
from ctsim.reconstruct.splat.objective import Objective
from ctsim.reconstruct.splat.project import Projector
from ctsim.reconstruct.splat.published_settings import Settings
from ctsim.spectrum import Tube
from ctsim.types import Scanner

SMALLEST = 12
SUBJECTS = [method.label for method in stress_methods.subjects()]
# every scene meets a third of the methods here and every method a third of the scenes; the command runs all
METHODS = [c for k, c in enumerate(stress_methods.cases()) if (k // len(SUBJECTS) + k % len(SUBJECTS)) % 3 == 0]
CASES = [*stress_simulator.cases(), *stress_splats.cases(), *stress_chain.cases(), *METHODS]


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c.name}-{c.subject}")
def test_a_case_is_as_expected(case):
    outcome = carry_out(case, SMALLEST)
    assert outcome.ok, outcome.found


def test_every_method_and_kernel_has_its_cases():
    by_subject = {}
    for case in stress.catalogue():
        by_subject.setdefault(case.subject, []).append(case.name)
    assert set(by_subject) == {"simulator", "splat kernels", *SUBJECTS} and {*TABLE} < {*SUBJECTS}
    assert all(len(names) == len(set(names)) for names in by_subject.values())
    assert {case.subject for case in METHODS} == set(SUBJECTS)
    assert {case.name for case in METHODS} == {*(scene.name for scene in load()), "threads"}


# --- a case whose remedy is taken out ----------------------------------------------------------------


def case_of(name, subject):
    (found,) = [c for c in stress.catalogue() if (c.name, c.subject) == (name, subject)]
    return found


def test_without_a_floor_under_the_counts_the_dark_scan_is_reported(monkeypatch):
    monkeypatch.setattr(log, "count_floor", lambda scan: 0.0)
    for subject in ("fdk", "sirt"):
        outcome = carry_out(case_of("all-zero-counts", subject), SMALLEST)
        assert not outcome.ok and "NOT EXPECTED" in outcome.found


def test_without_as_many_energies_as_it_takes_the_scan_is_reported(monkeypatch):
    monkeypatch.setattr(plan, "energy_rule", lambda spectrum, detector, *_: gauss_rule(spectrum, detector, 2))
    outcome = carry_out(case_of("k-edge", "simulator"), SMALLEST)
    assert not outcome.ok and "|ΔP|" in outcome.found and "limit" in outcome.found


def test_a_volume_that_depends_on_the_number_of_threads_is_reported(monkeypatch):
    results = iter([np.zeros(3), np.ones(3)])
    monkeypatch.setattr(stress_methods, "on_threads", lambda n, call: next(results))
    monkeypatch.setattr(stress_methods, "thread_counts", lambda: [1, 2])
    outcome = carry_out(case_of("threads", "fdk"), SMALLEST)
    assert not outcome.ok and "differ" in outcome.found


# --- how rows end ------------------------------------------------------------------------------------


def test_a_hang_a_crash_and_a_warning_are_failed_rows_and_the_rest_goes_on():
    ends = {run.__name__: end for run, end in ENDS.items()}
    with Worker("stress_ends", 60.0, "asked") as worker:
        for case in catalogue("asked"):
            worker.seconds = 1.0 if case.name == "hanging" else 60.0
            outcome = worker.run(case, 12)
            ok, words = ends[case.name]
            assert outcome.ok is ok and words in outcome.found, outcome
            assert ok or "NOT EXPECTED" in outcome.found


def test_an_infinite_value_and_a_missing_refusal_are_found():
    found = Findings()
    found.finite("the volume", np.array([1.0, np.inf]))
    found.refused("wrong", lambda: None)
    found.refused("number", lambda: stress_methods.find("nosuch"))
    assert [bool(w) for w in found.wrong] == [True] * 3 and "1 of 2" in found.wrong[0]


class Here:
    """Carries out cases in this process, and counts them."""

    ran = 0

    def __init__(self, *_):
        pass

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def run(self, case, side):
        Here.ran += 1
        return carry_out(case, side)


@pytest.fixture
def command(monkeypatch, tmp_path):
    monkeypatch.setattr("ctsim.benchmarks.studies.stress.worker.Worker", Here)
    monkeypatch.setattr(stress, "catalogue", lambda *_: catalogue()[:3])
    Here.ran = 0
    return lambda *words: stress.main([str(tmp_path / "out"), "--short", *words])


def test_the_command_says_what_is_wrong_and_runs_only_what_is_missing(command, tmp_path, capsys):
    assert command("--dry-run") == 0 and "3 of 3 rows" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    assert command() == 1 and Here.ran == 3
    assert "NOT AS EXPECTED: raising, test: NOT EXPECTED: ValueError" in capsys.readouterr().out
    text = (tmp_path / "out" / "stress.md").read_text(encoding="utf-8")
    assert "1 of 3 rows are as expected" in text and "| wrong | test | w | e | NOT EXPECTED: a number nan" in text
    with (tmp_path / "out" / "stress.jsonl").open("ab") as file:
        file.write(b'{"identity": "torn')  # as a power cut leaves it
    assert command() == 1 and Here.ran == 5  # what failed is tried again
    assert command("--case", "fine") == 0 and Here.ran == 5
    assert command("--case", "fine", "--force") == 0 and Here.ran == 6
    assert len(stress_records.read(tmp_path / "out" / "stress.jsonl")) == 6
    with pytest.raises(InputError, match="did you mean fine"):
        command("--case", "fina")
    with pytest.raises(InputError, match="seconds must be positive"):
        command("--seconds", "0")
    (tmp_path / "out" / "stress.jsonl").write_bytes(b"{}\n")
    with pytest.raises(InputError, match="line 1: expected a row"):
        command()


def test_changed_code_or_expectations_are_run_anew():
    case = catalogue()[0]
    known = stress_records.identity_of(case, 12)
    others = [dataclasses.replace(case, code="new"), dataclasses.replace(case, expected="better")]
    assert len({known, stress_records.identity_of(case, 13), *(stress_records.identity_of(c, 12) for c in others)}) == 4


@pytest.mark.parametrize("kvp", [20.0, 33.3, 90.0, 300.0])
def test_a_scan_finds_the_table_of_its_tube(kvp):
    given = scan_of(tube=Tube(kvp=kvp)).scan
    assert Beam.of(given, None, None).tube.kvp == kvp


# --- hazards of splats that other tests do not show --------------------------------------------------


def scan_of(*solids, side=SMALLEST, **scanner):
    return example(Scanner(geometry=geometry(side), **scanner), in_air(solids or USUAL))


def error(given):
    return given.error(find("splat").reconstruct(given.scan, "cpu").values.numpy())


def everywhere(monkeypatch, name, value):
    """Replace a function of the splat package in every module of it that has it."""
    for module in [
        m for key, m in sys.modules.items() if key.startswith("ctsim.reconstruct.splat") and hasattr(m, name)
    ]:
        monkeypatch.setattr(module, name, value)


def test_dead_pixels_are_left_out_by_weight_0(monkeypatch):
    """A pixel that never sees anything has P = 0, as an open one: counted in, it carves the object away."""
    given = scan_of(noise=Noise(dead_fraction=0.02))
    masked = error(given)
    weighed = level.weighted
    everywhere(monkeypatch, "weighted", lambda g, p, valid, *s: weighed(g, p, np.ones_like(valid), *s))
    # 0.14 and 0.45: what is carved away scores as an empty volume does
    assert masked < 0.2 < 2 * masked < error(given)


def test_starved_rays_count_for_little(monkeypatch):
    """Iron at a thousand photons: rays behind it say nothing but noise, at unit weight as loudly as the others."""
    given = scan_of(WATER, BONE, rod("Fe", 5.0, at=(9.0, 2.0)), i0=1e3)
    weighted, weighed = error(given), level.weighted

    def unweighted(g, p, valid, *scatter):
        return dataclasses.replace(weighed(g, p, valid, *scatter), weights=valid.astype(np.float32))

    everywhere(monkeypatch, "weighted", unweighted)
    assert 1.4 * weighted < error(given)  # 0.16 and 0.29


def test_ssim_has_one_range_for_all_views():
    """With a range of its own a view of air and noise would weigh as much as one of iron."""
    given = scan_of(WATER, rod("Fe", 5.0))
    objective = Objective.of(given.scan, Settings())
    assert objective.data_range == objective.p[objective.valid].max() > 4
    noise = np.random.Generator(np.random.Philox(key=1)).normal(0, 0.01, (24, 24))
    (shared, _), (own, _) = (l1_ssim(np.zeros_like(noise), noise, r) for r in (objective.data_range, noise.max()))
    assert shared < 0.01 < 20 * shared < own


def test_seeds_lie_in_the_middle_of_voxels(monkeypatch):
    """A shift by half a voxel, as R²-Gaussian's seeding has it, moves their mean off a centred object's axis."""
    given = scan_of(WATER)
    p, _ = line_integrals(given.scan, slice(None))
    settings = Settings()
    response = settings.make_response(90.0)

    def off_axis():
        seeds = seed_splats(p.numpy(), given.scan.geometry, settings, response)
        mean = np.average(seeds.positions, axis=0, weights=seeds.densities[:, 0])
        return float(np.linalg.norm(mean[:2])) / given.scan.geometry.d_voxel[1]

    assert off_axis() < 0.1
    centres = Geometry.voxel_centres
    monkeypatch.setattr(
        Geometry, "voxel_centres", lambda g: tuple(a + d / 2 for a, d in zip(centres(g), g.d_voxel, strict=True))
    )
    assert off_axis() > 0.4


def test_the_step_is_that_of_a_majoriser(monkeypatch):
    """The Hessian's own diagonal is none: a ray's splats all make up for what it lacks, each on its own."""
    monkeypatch.setattr(ordered, "LEAST_SUBSETS", 1)  # one subset of all views: plain descent
    monkeypatch.setattr(ordered, "SUBSET", 16)
    given, move, diagonals = scan_of(WATER, side=8).scan, ordered.Fit._move, {}

    def misfit():
        return find("splat", {"passes": (6, 6), "tv": 0.0}).reconstruct(given, "cpu").details["misfit"]

    def diagonal(fit):
        """Σ w·a² of every splat, a its line integrals at density 1, in the unit of the fit's gradient."""
        shapes = fit.lattice.splats(np.ones((len(fit.lattice), 1), np.float32)).shapes()
        view, ones, weights = Projector(geometry=fit.data.geometry), np.ones((1, 1), np.float32), fit.data.weights
        images = (view.forward(shapes[:, k : k + 1].copy(), ones)[:, 0, :, :-WIDTH] for k in range(shapes.shape[1]))
        return np.array([(weights * image**2).sum() for image in images]) / fit.lattice.unit

    def jacobi(fit, gradient, curvature, n_views):
        if id(fit) not in diagonals:
            diagonals[id(fit)] = diagonal(fit)
        held = np.maximum(fit.u, np.float32(ordered.FAINT * fit.curve.water))
        move(fit, gradient, (held * diagonals[id(fit)]).astype(np.float32), n_views)

    falling = misfit()
    monkeypatch.setattr(ordered.Fit, "_move", jacobi)
    found = misfit()
    assert diagonals and falling < 0.06 and found > 3 * falling, (falling, found)


def test_a_fit_begins_on_one_side_of_waters_kink(monkeypatch):
    """Water is a knot of the materials' curve: rounded to either side of it, all splats take another first step."""
    began, fit = [], course.Course._fit

    def spied(self, k, support, start):
        began.append(start[support].max() < self.curve.water)
        return fit(self, k, support, start)

    monkeypatch.setattr(course.Course, "_fit", spied)
    for kvp in (60.0, 70.0, 80.0, 90.0, 100.0, 110.0):
        find("splat", {"passes": (1, 0)}).reconstruct(scan_of(WATER, side=8, tube=Tube(kvp=kvp)).scan, "cpu")
    assert began == [True] * 6


def test_the_table_is_rendered_from_the_newest_records_alone(command, tmp_path, monkeypatch, capsys):
    with pytest.raises(InputError, match="there are no such records; run without --table first"):
        command("--table")
    assert not (tmp_path / "out").exists()
    command()
    (tmp_path / "out" / "stress.md").rename(tmp_path / "first.md")
    capsys.readouterr()
    assert command("--table") == 1 and Here.ran == 3 and not capsys.readouterr().err
    assert (tmp_path / "out" / "stress.md").read_bytes() == (tmp_path / "first.md").read_bytes()
    assert command("--table", "--case", "fine") == 0
    # other sources change nothing of what was found, and are named
    others = [dataclasses.replace(case, code="other") for case in catalogue()[:3]]
    monkeypatch.setattr(stress, "catalogue", lambda *_: others)
    capsys.readouterr()
    assert command("--table") == 1 and Here.ran == 3
    assert (tmp_path / "out" / "stress.md").read_bytes() == (tmp_path / "first.md").read_bytes()
    assert "3 of 3 rows are of other sources" in capsys.readouterr().err
    with pytest.raises(InputError, match="no such records"):
        stress.main([str(tmp_path / "out"), "--table"])  # of the larger grids


def test_rows_of_other_machines_are_taken_over_and_shown(command, tmp_path, capsys):
    command()
    here, there = tmp_path / "out", tmp_path / "there"
    here.rename(there)
    capsys.readouterr()
    with pytest.raises(InputError, match="--dry-run writes nothing"):
        command("--collect", str(there), "--dry-run")
    assert not here.exists()
    assert command("--collect", str(there)) == 1 and Here.ran == 3
    assert f"{there}: 3 records taken over" in capsys.readouterr().err
    assert (here / "stress.md").read_bytes() == (there / "stress.md").read_bytes()
    assert command("--case", "fine") == 0 and Here.ran == 3  # it is here now
    with pytest.raises(InputError, match=r"there are no records, expected a folder with stress\.jsonl"):
        command("--collect", str(tmp_path))
