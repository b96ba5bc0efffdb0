"""`run-benchmark validate`: every case holds in its short form, and none holds with a fault in what it checks."""

import dataclasses
import hashlib
import math
import pickle
from typing import get_args

import msgspec
import pytest

from ctsim.beam.quadrature import gauss_rule
from ctsim.benchmarks.engine.record import latest
from ctsim.benchmarks.studies.validate import cases, closed, figure, paper, published, recovered, scatter, transport
from ctsim.benchmarks.studies.validate import study as validate
from ctsim.benchmarks.studies.validate.finding import Check, Curves, check

CASES = get_args(validate.Case)


def found(folder):
    """Return what was found last of every case: {case: checks}."""
    study = validate.Validate()
    return {r.task.case: r.found for r in latest(study.store(validate.Flags(results=folder)).read())}


FOLLOWED = (paper, "scatter_series"), (scatter, "scatter_series"), (scatter, "long_run")


@pytest.fixture(scope="module")
def followed():
    """Functions that follow photons, each of which remembers what it returned for which arguments."""

    def remembering(real):
        known = {}

        def call(*given, **more):
            key = hashlib.sha256(pickle.dumps((given, sorted(more.items())))).digest()
            if key not in known:
                known[key] = real(*given, **more)
            return known[key]

        return call

    return {(module, name): remembering(getattr(module, name)) for module, name in FOLLOWED}


@pytest.fixture
def here(monkeypatch, followed):
    """Cases are measured in this process, where they can be replaced."""
    monkeypatch.setattr(validate.Validate, "isolated", False)
    for (module, name), remembering in followed.items():
        monkeypatch.setattr(module, name, remembering)


def test_every_case_has_a_group_and_is_declared():
    assert tuple(case for group in validate.GROUPS.values() for case in group) == CASES == tuple(cases.CASES)
    assert validate.GROUPS.keys() == validate.ABOUT.keys()
    assert set(validate.SECONDS) == set(CASES)


@pytest.mark.slow
def test_the_short_form_holds(tmp_path, here):
    assert validate.main([str(tmp_path), "--short"]) == 0
    checks = found(tmp_path)
    assert tuple(checks) == CASES
    judged = [c for of in checks.values() for c in of if c.tolerance is not None]
    assert len(judged) > 70 and all(c.source and c.why for c in judged)
    assert {c.verdict for c in judged} == {"yes", "not held, known"}
    known = [c.quantity for c in judged if c.verdict == "not held, known"]
    assert len(known) == 4 and all("of counts" in quantity for quantity in known)
    text = (tmp_path / "validate.md").read_text(encoding="utf-8")
    assert all(f"| {case} |" in text for case in CASES) and all(f"## {group}" in text for group in validate.GROUPS)
    assert all((tmp_path / f"validate-{group}.png").stat().st_size > 5000 for group in validate.GROUPS)


# --- a fault for each case -------------------------------------------------------------------------------


def times(factor):
    """Return a function that makes another one's result larger."""
    return lambda real: lambda *given, **more: factor * real(*given, **more)


def weaker_filter(real):
    """Behind a tenth less filter."""

    def made(tube):
        (sheet,) = tube.filters
        thin = msgspec.structs.replace(sheet, thickness=0.9 * sheet.thickness)
        return real(msgspec.structs.replace(tube, filters=(thin,)))

    return made


def fewer_nodes(real):
    return lambda source, detector, *given: gauss_rule(source, detector, 6)


def wider_noise(real):
    """A quarter more variance."""
    return lambda m1, m2, **more: real(m1, 1.25 * m2, **more)


def more_energy(real):
    """Each deposit 6 % too large, as photons of 60 keV would leave."""

    def made(*given, **more):
        deposit, error = real(*given, **more)
        return 1.06 * deposit, error

    return made


def more_scatter(real):
    """Scatter that is a fifth too strong in every stream but the paper's reference."""

    def made(*given, stream, **more):
        series = real(*given, stream=stream, **more)
        factor = 1.0 if stream == "other" else 1.2
        return dataclasses.replace(series, coefficients=factor * series.coefficients)

    return made


FAULTS = {
    "attenuation": (published.materials, "mass_attenuation", times(1.002)),
    "absorption": (published.materials, "mass_energy_transfer", times(1.005)),
    "spectra": (published, "spectrum", weaker_filter),
    "energies": (closed, "energy_rule", fewer_nodes),
    "chords": (closed, "path_lengths", times(1 + 1e-6)),
    "primary": (transport, "path_lengths", times(1.05)),
    "noise": (closed, "detect", wider_noise),
    "tg195-1": (published.materials, "attenuation", times(1.005)),
    "tg195-2": (transport, "absorbed_energy", more_energy),
    "tg195-4": (transport, "absorbed_energy", more_energy),
    "lung-Fe": (scatter, "scatter_series", more_scatter),
    "teeth-Ti": (scatter, "scatter_series", more_scatter),
    "head": (scatter, "scatter_series", more_scatter),
    "recovered": (recovered, "fdk", times(1.01)),
    "paper": (paper, "scatter_series", more_scatter),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_a_fault_is_seen(tmp_path, here, monkeypatch, case):
    module, name, fault = FAULTS[case]
    if case == "recovered":  # which takes a minute, and is known to be wrong
        monkeypatch.setattr(recovered, "of_counts", lambda scene: [])
    monkeypatch.setattr(module, name, fault(getattr(module, name)))
    assert validate.main([str(tmp_path), "--short", "--case", case]) == 1
    assert "NO" in [c.verdict for c in found(tmp_path)[case]]


@pytest.mark.slow
def test_more_noise_in_the_papers_image_is_seen(tmp_path, here, monkeypatch):
    monkeypatch.setattr(paper, "detect", wider_noise(paper.detect))
    assert validate.main([str(tmp_path), "--short", "--case", "paper"]) == 1
    assert "NO" in [c.verdict for c in found(tmp_path)["paper"] if "noise alone" in c.quantity]


# --- what a check says -----------------------------------------------------------------------------------


def test_a_check_judges_itself():
    assert check("q", 1.05, 1.0, tolerance=0.06).verdict == "yes"
    assert check("q", 0.95, 1.0, tolerance=0.06).verdict == "yes"
    far = check("q", 1.07, 1.0, tolerance=0.06)
    assert far.verdict == "NO" and not far.ok
    known = check("q", 1.07, 1.0, tolerance=0.06, known=True)
    assert known.verdict == "not held, known" and known.ok
    assert check("q", 10.5, 10.0, tolerance=0.6, relative=False).verdict == "yes"
    assert check("q", 10.5, 10.0, tolerance=0.4, relative=False).verdict == "NO"
    stated = check("q", 5.0, 1.0)
    assert stated.verdict == "–" and stated.ok
    for bad in (math.nan, math.inf):
        assert not check("q", bad, 1.0, tolerance=0.1).ok and not check("q", bad, 1.0).ok


def test_what_is_no_check_is_refused():
    with pytest.raises(ValueError, match="not 0"):
        Check(ours=1.0, reference=0.0)
    with pytest.raises(ValueError, match="negative"):
        Check(ours=1.0, reference=1.0, tolerance=-0.1)
    with pytest.raises(ValueError, match="as many"):
        Curves(title="", across="", up="", x=(1.0, 2.0), lines={"a": (1.0,)})


def test_a_figure_shows_every_check_with_a_tolerance_and_all_curves():
    curves = Curves(title="$t", across="x", up="y", x=(0.0, 1.0), lines={"a": (0.0, 1.0), "b": (1.0, 2.0)})
    checks = [
        check("near", 1.01, 1.0, tolerance=0.1, curves=(curves,)),
        check("far", 9.0, 1.0, tolerance=0.1, curves=(msgspec.structs.replace(curves, lines={"c": (5.0, 6.0)}),)),
        check("stated", 9.0, 1.0),
    ]
    dots, lines = figure.figure(checks, "group").axes
    assert [label.get_text() for label in dots.get_yticklabels()] == ["near", "far"]
    assert [line.get_label() for line in lines.get_lines()] == ["a", "b", "c"]
    assert figure.figure([], "nothing").axes


def test_the_published_numbers_are_whole():
    numbers = published.numbers()
    for table in (numbers.nist.attenuation, numbers.nist.absorption):
        assert all(len(values) == len(numbers.nist.energies) for values in table.values())
    assert len(numbers.tg195.radiography.cubes) == len(transport.CUBES) == 9
