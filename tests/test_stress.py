"""The stress suite: every case on the smallest grids, and that a case whose remedy is taken out is reported."""

import dataclasses
import functools
import sys

import msgspec
import numba
import numpy as np
import pytest
import torch
from stress_ends import ENDS, Ends, Threads, catalogue

from ctsim import look
from ctsim.baselines.known_spectrum import Beam
from ctsim.beam.quadrature import gauss_rule
from ctsim.beam.spectrum import Tube
from ctsim.benchmarks.engine import study as engine
from ctsim.benchmarks.methods import CONTROLS, TABLE, find
from ctsim.benchmarks.oracles import upright_chord
from ctsim.benchmarks.studies.stress import kernels, study, worker
from ctsim.benchmarks.studies.stress import methods as stress_methods
from ctsim.benchmarks.studies.stress.scans import Findings, carry_out, example, few_views, lengths
from ctsim.benchmarks.studies.stress.suite import Machine, Rod, Scene, load
from ctsim.detector.noise import Noise
from ctsim.errors import InputError
from ctsim.geometry import Geometry
from ctsim.kernels.lanes import WIDTH
from ctsim.reconstruct import log, starved
from ctsim.reconstruct.log import line_integrals
from ctsim.reconstruct.splat import course, level, ordered, part
from ctsim.reconstruct.splat.descent.learner import seed_splats
from ctsim.reconstruct.splat.descent.loss import l1_ssim
from ctsim.reconstruct.splat.descent.objective import SSIM_RANGE, Objective
from ctsim.reconstruct.splat.project import Projector
from ctsim.reconstruct.splat.published_settings import Settings

SMALLEST = 12
SUBJECTS = [study.label(*method) for method in study.subjects()]
ROWS = study.catalogue()
METHODS = [row for row in ROWS.values() if row.method is not None]
# every scene meets an eighth of the methods here and every method an eighth of the scenes; the command runs all
SOME = [row for k, row in enumerate(METHODS) if (k // len(SUBJECTS) + k % len(SUBJECTS)) % 8 == 0]
CASES = [*(row for row in ROWS.values() if row not in METHODS), *SOME]


def judged(row, side=SMALLEST):
    return carry_out(functools.partial(worker.run, row, side))[0]


@pytest.mark.slow
@pytest.mark.parametrize("row", CASES, ids=lambda row: f"{row.case}-{row.subject}")
def test_a_case_is_as_expected(row):
    found = judged(row)
    assert found.said and not found.wrong, str(found)


def test_every_method_and_kernel_has_its_cases():
    assert {subject for _, subject in ROWS} == {"simulator", "splat kernels", *SUBJECTS}
    assert [find(*method).label for method in study.subjects()] == SUBJECTS
    assert {name for name, _ in study.subjects()} == {
        name for name, (_, inputs) in TABLE.items() if inputs not in CONTROLS
    }
    assert {row.subject for row in SOME} == set(SUBJECTS)
    assert {row.case for row in SOME} == {*(scene.name for scene in load() if scene.methods), "threads"}


def test_a_case_is_the_same_for_all_its_subjects():
    """Scenes of one name must be one scan: the table says what it is once."""
    scenes, whats = {scene.name: scene for scene in load()}, {}
    for row in ROWS.values():
        whats.setdefault(row.case, set()).add(row.what)
        assert row.scene is None or row.scene == scenes[row.case]
    assert [case for case, what in whats.items() if len(what) > 1] == []
    assert {case for case, subject in ROWS if subject == "simulator"} == {
        *(name for name, scene in scenes.items() if scene.simulated), "flat-solids", "float64", "threads",
    }  # fmt: skip
    assert {*kernels.CHECKS} == {*study.CHECKS} < {*scenes}
    no_scenes = {name for name, row in ROWS.items() if row.scene is None and row.method is None}
    assert no_scenes == {*worker.PROGRAMS} == {(c, subject) for subject, own in study.PROGRAMS.items() for c, *_ in own}


# --- closed forms ------------------------------------------------------------------------------------


def test_rods_that_lie_in_each_other_share_the_rays_by_paint_order():
    """Later rods take what they cross; within each other that is a difference of their own chords."""
    (scene,) = [scene for scene in load() if scene.name == "nested-solids"]
    of = few_views(scene, SMALLEST).geometry
    found = lengths(scene, of)
    alone = [np.stack([upright_chord(of, view, rod.solid()) for view in range(of.n_views)]) for rod in scene.all_rods]
    # the discriminant is off by a few roundings of (250 mm)², 6e-11 mm², so its root, here 0.5 mm and more, by as much
    for outer, inner, rod in zip(alone, [*alone[1:], 0 * alone[0]], scene.all_rods, strict=True):
        assert np.allclose(found[rod.material], outer - inner, rtol=0, atol=1e-9), rod.material
    assert all(chord.max() > 1 for chord in alone)


def test_crossing_rods_belong_to_the_later_one():
    """A rod of 40 mm through a disc of 10 mm: along the horizontal central ray the disc is what the rod leaves."""
    disc, thin = Rod(material="Ti", radius=9.0, height=10.0), Rod(material="Fe", radius=4.0, height=40.0)
    of = Machine(geometry=msgspec.structs.replace(Machine().geometry, n_detector=(3, 3), n_views=1)).resolve(8).geometry
    for order, chords in (((disc, thin), (10.0, 8.0)), ((thin, disc), (18.0, 0.0))):
        found = lengths(Scene(name="own", what="own", rods=order), of)
        assert [found[m][0, 1, 1] for m in ("Ti", "Fe")] == pytest.approx(chords, abs=1e-9)


# --- a case whose remedy is taken out ----------------------------------------------------------------


def test_without_a_floor_under_the_counts_the_dark_scan_is_reported(monkeypatch):
    monkeypatch.setattr(log, "count_floor", lambda scan: 0.0)
    for subject in ("fdk", "sirt"):
        assert "NOT EXPECTED" in str(judged(ROWS["all-zero-counts", subject]))


def test_without_as_many_energies_as_it_takes_the_scan_is_reported(monkeypatch):
    monkeypatch.setattr(look, "energy_rule", lambda spectrum, detector, *_: gauss_rule(spectrum, detector, 2))
    (wrong,) = judged(ROWS["k-edge", "simulator"]).wrong
    assert "|ΔP|" in wrong and "limit" in wrong


def test_a_volume_that_depends_on_the_number_of_threads_is_reported(monkeypatch):
    threads = [0]
    monkeypatch.setattr(numba, "set_num_threads", threads.append)
    monkeypatch.setattr("numba.config.NUMBA_NUM_THREADS", 2)
    volume = type("Volume", (), {"values": property(lambda self: torch.full((3,), threads[-1]))})
    monkeypatch.setattr(stress_methods, "_volume", lambda method, scan: volume())
    (wrong,) = judged(ROWS["threads", "fdk"]).wrong
    assert "differ" in wrong


# --- how rows end ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_hang_a_crash_and_a_warning_are_failed_rows_and_the_rest_goes_on(tmp_path, capsys):
    assert engine.main(Ends(), [str(tmp_path), "--short"]) == 1
    records = {r.task.case: r.found[0] for r in Ends().store(study.Flags(results=tmp_path)).read()}
    assert {*records} == {run.__name__ for run in ENDS}
    for run, (ok, words) in ENDS.items():
        outcome = records[run.__name__]
        assert outcome.ok is ok and words.replace("12", "16") in outcome.words, outcome
        assert ok or "NOT EXPECTED" in outcome.words
    assert records["hanging"].status == "timeout" and "1 of 7 rows are as expected" in capsys.readouterr().out


def test_the_process_can_have_two_threads_and_a_row_has_those_that_there_are(monkeypatch, tmp_path):
    monkeypatch.setattr(study.host, "threads", lambda: 1)
    given = study.Flags(results=tmp_path)
    stress = Threads()
    with engine._measuring(stress, given) as record:
        (task,) = [t for t in stress.tasks(given) if t.case == "fine"]
        assert record(task).found[0].found == "1 of 2 threads"


def test_an_infinite_value_and_a_missing_refusal_are_found():
    found = Findings()
    found.finite("the volume", np.array([1.0, np.inf]))
    found.refused("wrong", lambda: None)
    found.refused("number", lambda: stress_methods.find("nosuch"))
    assert [bool(w) for w in found.wrong] == [True] * 3 and "1 of 2" in found.wrong[0]


class Here(Ends):
    """Three rows, carried out in this process and counted."""

    isolated, ran, sources = False, 0, "these"

    def rows(self, given):
        return catalogue("fine", "wrong", "raising", code=Here.sources)

    def limit(self, task, given):
        return None

    def measure(self, task, given):
        Here.ran += 1
        return super().measure(task, given)


@pytest.fixture
def command(tmp_path):
    Here.ran, Here.sources = 0, "these"
    return lambda *words: engine.main(Here(), [str(tmp_path / "out"), "--short", *words])


def test_the_command_says_what_is_wrong_and_runs_again_what_failed(command, tmp_path, capsys):
    assert command() == 1 and Here.ran == 3
    assert "NOT AS EXPECTED: raising, test: NOT EXPECTED: ValueError" in capsys.readouterr().out
    text = (tmp_path / "out" / "stress.md").read_text(encoding="utf-8")
    assert "1 of 3 rows are as expected" in text and "| wrong | test | e | NOT EXPECTED: a number nan" in text
    assert command() == 1 and Here.ran == 5
    assert command("--case", "fine") == 0 and Here.ran == 5
    with pytest.raises(InputError, match="--case 'fina': expected one of fine, wrong, raising"):
        command("--case", "fina")
    Here.sources = "other"
    assert command() == 1 and Here.ran == 8


def test_a_row_that_crashes_after_it_was_as_expected_is_shown_so(command, monkeypatch):
    assert command("--case", "fine") == 0
    lost = study.Judged(ok=False, status="error", reason="the process died")
    monkeypatch.setattr(Here, "measure", lambda self, task, given: [lost])
    assert command("--case", "fine", "--force") == 1


@pytest.mark.slow
@pytest.mark.parametrize("kvp", [20.0, 33.3, 90.0, 300.0])
def test_a_scan_finds_the_table_of_its_tube(kvp):
    given = scan_of(tube=Tube(kvp=kvp)).scan
    assert Beam.of(given, None, None).tube.kvp == kvp


# --- hazards of splats that other tests do not show --------------------------------------------------


def scan_of(*rods, side=SMALLEST, **scanner):
    return example(Scene(name="own", what="own", rods=rods or None, scanner=Machine(**scanner)), side)


def error(given):
    return given.error(find("splat").reconstruct(given.scan).values.numpy())


def everywhere(monkeypatch, name, value):
    """Replace a function of the splat package in every module of it that has it."""
    for module in [
        m for key, m in sys.modules.items() if key.startswith("ctsim.reconstruct.splat") and hasattr(m, name)
    ]:
        monkeypatch.setattr(module, name, value)


@pytest.mark.slow
def test_dead_pixels_are_left_out_by_weight_0(monkeypatch):
    """A pixel that never sees anything has P = 0, as an open one: counted in, it carves the object away."""
    given = scan_of(noise=Noise(dead_fraction=0.02))
    masked = error(given)
    weighed, told = level.weighted, starved.weights_and_bounds
    everywhere(monkeypatch, "weighted", lambda g, p, valid, *s: weighed(g, p, np.ones_like(valid), *s))
    everywhere(monkeypatch, "weights_and_bounds", lambda scan, p, valid, *s: told(scan, p, np.ones_like(valid), *s))
    everywhere(monkeypatch, "doubt_edges", lambda *given: None)  # it takes a dead pixel for an edge: 0.13
    filled = error(given)
    monkeypatch.setattr(log.Filling, "of", lambda dead: None)
    # 0.08, 0.11 and 0.64: what is carved away scores as an empty volume does, or worse
    assert masked < filled < 0.2 < error(given)


@pytest.mark.slow
def test_dead_pixels_are_interpolated_for_methods_without_weights(monkeypatch):
    given, bare = scan_of(noise=Noise(dead_fraction=0.02)), scan_of(noise=Noise())
    found = {name: [given.error(find(name).reconstruct(given.scan).values.numpy())] for name in ("fdk", "sirt")}
    whole = {name: bare.error(find(name).reconstruct(bare.scan).values.numpy()) for name in found}
    monkeypatch.setattr(log.Filling, "of", lambda dead: None)
    for name, errors in found.items():
        errors.append(given.error(find(name).reconstruct(given.scan).values.numpy()))
        lost = errors[1] - whole[name]  # the grid of 12 voxels makes most of either error
        assert lost > 0.05 * whole[name] and abs(errors[0] - whole[name]) < 0.2 * lost, (name, errors, whole)


@pytest.mark.slow
def test_starved_rays_count_for_little(monkeypatch):
    """Iron at a thousand photons: rays behind it say nothing but noise, at unit weight as loudly as the others."""
    given = scan_of("water", "bone", Rod(material="Fe", radius=5.0, at=(9.0, 2.0)), i0=1e3)
    weighted, weighed = error(given), level.weighted

    def unweighted(g, p, valid, *scatter):
        return dataclasses.replace(weighed(g, p, valid, *scatter), weights=valid.astype(np.float32))

    everywhere(monkeypatch, "weighted", unweighted)
    everywhere(monkeypatch, "weights_and_bounds", lambda scan, p, valid, *s: valid.astype(np.float32))
    everywhere(monkeypatch, "doubt_edges", lambda *given: None)
    assert 1.4 * weighted < error(given)  # 0.16 and 0.29


@pytest.mark.slow
def test_ssim_has_one_range_for_all_views():
    """With a range of its own a view of air and noise would weigh as much as one of iron."""
    given = scan_of("water", Rod(material="Fe", radius=5.0))
    objective = Objective.of(given.scan, Settings())
    assert objective.greatest == objective.p[objective.valid].max() > 4
    noise = np.random.Generator(np.random.Philox(key=1)).normal(0, 0.01, (24, 24)) / objective.unit
    (shared, _), (own, _) = (l1_ssim(np.zeros_like(noise), noise, r) for r in (SSIM_RANGE, noise.max()))
    assert 20 * shared < own and own > 0.2


def test_seeds_lie_in_the_middle_of_voxels(monkeypatch):
    """A shift by half a voxel, as R²-Gaussian's seeding has it, moves their mean off a centred object's axis."""
    given = scan_of("water")
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
    given, precondition, diagonals = scan_of("water", side=8).scan, part.Part._precondition, {}
    monkeypatch.setattr(ordered, "surface", lambda own: np.zeros_like(own.lattice.support))  # what diverges is no metal
    begin, weights_of = course.Course._fit, {}

    def noting(self, *args):
        fit = begin(self, *args)
        weights_of[id(fit.parts[0])] = fit.data.weights
        return fit

    monkeypatch.setattr(course.Course, "_fit", noting)

    def misfit():
        return find("splat", {"passes": (6, 6), "tv": 0.0}).reconstruct(given).details["misfit"]

    def diagonal(own):
        """Σ w·a² of every splat, a its line integrals at density 1, in the unit of the fit's gradient."""
        shapes = own.lattice.splats(np.ones((len(own.lattice), 1), np.float32)).shapes()
        view, ones, weights = Projector(geometry=own.geometry), np.ones((1, 1), np.float32), weights_of[id(own)]
        images = (view.forward(shapes[:, k : k + 1].copy(), ones)[:, 0, :, :-WIDTH] for k in range(shapes.shape[1]))
        return np.array([(weights * image**2).sum() for image in images]) / own.lattice.unit

    def jacobi(own, sums, length, share, metal):
        if id(own) not in diagonals:
            diagonals[id(own)] = diagonal(own)
        held, measured = np.maximum(own.u, np.float32(part.FAINT * own.curve.water)), own.curvature
        slopes = share * own.curve.transpose(own.u, np.ones_like(measured))  # of a curvature by both densities alike
        own.curvature = (held * diagonals[id(own)] / slopes)[:, None].repeat(2, 1).astype(np.float32)
        precondition(own, sums, length, share, metal)
        own.curvature = measured

    falling = misfit()
    monkeypatch.setattr(part.Part, "_precondition", jacobi)
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
        method = find("splat", {"passes": (1, 0), "filtration": 0.5})
        method.reconstruct(scan_of("water", side=8, tube=Tube(kvp=kvp)).scan)
    assert began == [True] * 6


# --- tables from records ------------------------------------------------------------------------------


def test_the_table_names_rows_of_other_sources_and_shows_one_size_of_grids(command, tmp_path, capsys):
    command()
    first = (tmp_path / "out" / "stress.md").read_bytes()
    capsys.readouterr()
    assert command("--table") == 1 and not capsys.readouterr().err
    Here.sources = "other"
    assert command("--table") == 1 and Here.ran == 3
    assert (tmp_path / "out" / "stress.md").read_bytes() == first
    assert "3 of 3 rows are of other sources" in capsys.readouterr().err
    with pytest.raises(InputError, match="there are no records to show"):
        engine.main(Here(), [str(tmp_path / "out"), "--table"])  # of the larger grids
