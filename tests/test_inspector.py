import dataclasses
import math
import sys

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio
from test_metrics import truth

from ctsim.benchmarks import cli
from ctsim.benchmarks.scores.protocol import AT_50KEV, evaluate
from ctsim.benchmarks.studies.inspect import study as inspector
from ctsim.benchmarks.studies.inspect.study import BASE, SINGLE, WHOLE, Convention, Inspected
from ctsim.benchmarks.studies.methods import records
from ctsim.benchmarks.studies.methods.volumes import at_50kev_of, write_volume
from ctsim.reconstruct.fdk import reconstruct as fdk


@pytest.fixture(scope="module")
def case():
    t = truth()
    noise = 0.003 * np.random.default_rng(4).standard_normal(t.metal.shape)
    return (t.references["effective"] + noise).astype(np.float32), t


def score(values, t, convention, at_50kev=None):
    """PSNR, SSIM and data range."""
    found = inspector.score(Inspected(label="fdk", values=values, at_50kev=at_50kev), t, convention)
    return found.psnr, found.ssim, found.data_range


def how(title):
    return next(c for c in (*WHOLE, *(c for group in SINGLE.values() for c in group)) if c.title.startswith(title))


def test_the_protocols_are_among_the_conventions(case):
    scores = evaluate(*case)
    for convention, name in ((BASE, "tissue"), (how("protocol aligned"), "aligned"), (how("protocol paper"), "paper")):
        values = scores[name].values
        assert score(*case, convention) == (values["psnr3d"], values["ssim3d"], scores[name].data_range)
    paper = scores["paper"].values
    assert score(*case, how("range max"))[0] == paper["psnr3d_full_gtmax"]
    assert score(*case, how("R2-Gaussian"))[:2] == (paper["psnr3d_r2"], paper["ssim3d_r2"])
    assert score(*case, how("NAF"))[1] == paper["ssim3d_naf"]
    volume, t = case
    # scikit-image sums squares in float32 for float32 volumes: 1e-7 of the MSE is 4e-7 dB; ten times that
    expected = peak_signal_noise_ratio(t.references["50kev"], volume, data_range=2.0)
    assert score(*case, how("NAF"))[0] == pytest.approx(expected, abs=5e-6)


def test_what_is_held_against_50_kev_is_the_methods_own_volume_there(case):
    volume, t = case
    own = (t.references["50kev"] + np.float32(0.001)).astype(np.float32)
    paper = evaluate(volume, t, at_50kev=own)["paper"].values
    assert score(volume, t, how("protocol paper"), own)[:2] == (paper["psnr3d"], paper["ssim3d"])
    at_50kev = {c.title for c in (*WHOLE, *SINGLE["reference"]) if c.reference == "50kev"}
    tables = (inspector.table(Inspected(label="", values=volume, at_50kev=v), t) for v in (own, None))
    assert {a[1].text for a, b in zip(*(table.rows for table in tables), strict=True) if a != b} == at_50kev


def test_a_range_moves_the_psnr_by_its_ratio(case):
    base, _, base_range = score(*case, BASE)
    for convention in SINGLE["range"]:
        psnr, _, data_range = score(*case, convention)
        assert psnr - base == pytest.approx(20 * math.log10(data_range / base_range), abs=1e-9)
    assert score(*case, how("max of the rec"))[2] == float(case[0].max())
    assert [score(*case, how(t))[2] for t in ("1 (", "2 (")] == [1.0, 2.0]


def test_each_single_row_changes_one_field():
    for what, conventions in SINGLE.items():
        for c in conventions:
            changed = {f for f in Convention.__slots__ if getattr(c, f) != getattr(BASE, f)} - {"title"}
            field = {"range": "data_range", "clipping": "clip"}.get(what, what)
            assert changed - {field} <= ({"data_range"} if c.alignment == "minmax" else set())
            assert field in changed


def test_regions_are_judged_alone(case):
    volume, t = case
    spoilt = np.where(t.metal, 9.0, volume).astype(np.float32)
    assert score(spoilt, t, BASE) == score(volume, t, BASE)
    for title in ("all voxels", "body with", "metal only"):
        assert score(spoilt, t, how(title))[0] < score(volume, t, how(title))[0]


def test_alignments_undo_what_they_say(case):
    _, t = case
    reference = t.references["effective"]
    scaled, moved = reference * np.float32(0.5), reference * np.float32(0.5) + np.float32(0.004)
    # what is left is float32 rounding of values of 0.02: 1e-9 of a range of 0.02 is beyond 120 dB
    assert score(scaled, t, how("one gain"))[0] in (None, pytest.approx(160, abs=40))
    # the body without its metal is one material here: no gain is seen in it, and a constant is all there is
    assert score(moved, t, how("both scaled"))[0] in (None, pytest.approx(160, abs=40))
    assert score(scaled, t, BASE)[0] < 30 and score(moved, t, BASE)[0] < 30


def test_gain_and_offset_are_fitted_together():
    t = truth()
    z = np.arange(t.metal.shape[0], dtype=np.float32)[:, None, None]
    t.references["effective"] += np.where(t.body, 1e-3 * z, 0)
    moved = t.references["effective"] * np.float32(0.5) + np.float32(0.004)
    assert score(moved, t, how("gain and offset"))[0] in (None, pytest.approx(160, abs=40))
    assert score(moved, t, how("one gain"))[0] < 40


def test_clipping_is_closed_form():
    t = truth()
    reference = t.references["effective"]
    volume = np.where(reference == 0, np.float32(-0.01), reference + np.float32(2.0))
    region = t.tissue
    air, body = (region & (reference == 0)).sum() / region.sum(), (region & (reference > 0)).sum() / region.sum()
    data_range = score(volume, t, BASE)[2]

    def psnr(low, high):
        mse = air * low**2 + body * (high - 0.02) ** 2
        return 10 * math.log10(data_range**2 / mse)

    # float32 keeps 2.02 to 1e-7, that is 1e-6 dB
    assert score(volume, t, BASE)[0] == pytest.approx(psnr(0.01, 2.02), abs=1e-5)
    assert score(volume, t, how("negatives"))[0] == pytest.approx(psnr(0, 2.02), abs=1e-5)
    assert score(volume, t, how("to [0, max"))[0] == pytest.approx(psnr(0, 0.5), abs=1e-5)
    assert score(volume, t, how("to [0, 1]"))[0] == pytest.approx(psnr(0, 1.0), abs=1e-5)


def spectral(scan, *, device):
    """FDK, and something else at 50 keV."""
    volume = fdk(scan)
    return dataclasses.replace(volume, at_energy=lambda kev: volume.values * (60 / kev))


def command(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["run-benchmark", *map(str, arguments)])
    code = cli.run_benchmark()
    return code, capsys.readouterr()


@pytest.fixture
def results(smallest, tmp_path, monkeypatch, capsys):
    assert command(monkeypatch, capsys, smallest, tmp_path / "r", "--method", "fdk")[0] == 0
    return tmp_path / "r"


def test_the_command_shows_a_kept_volume_and_writes_the_table(smallest, results, monkeypatch, capsys):
    code, said = command(monkeypatch, capsys, "inspect", smallest, results)
    assert code == 0
    text = (results / "inspect-smallest-fdk.md").read_text(encoding="utf-8")
    assert said.out.startswith(text)
    rows = [line for line in text.splitlines() if line.startswith("| ")][1:]
    assert len(rows) == 1 + sum(map(len, SINGLE.values())) + len(WHOLE)
    (record,) = (r for r in records.read(results) if r.run.variant == "metal")
    tissue = record.scores["tissue"]
    expected = f"| – | protocol tissue | {tissue.data_range:.4g} | {tissue.values['psnr3d']:.2f} | "
    assert rows[0].startswith(expected)
    # without a results folder the method is run, and gives the same table
    code, _ = command(monkeypatch, capsys, "inspect", smallest, "--method", "fdk", "--out", results / "again.md")
    assert code == 0 and (results / "again.md").read_text(encoding="utf-8") == text


def test_the_table_of_a_method_that_knows_energies_agrees_with_its_record(smallest, tmp_path, monkeypatch, capsys):
    chosen = ("--method", "test_inspector:spectral")
    assert command(monkeypatch, capsys, smallest, tmp_path, *chosen, "--no-anchor")[0] == 0
    (record,) = records.read(tmp_path)
    assert record.scores["paper"].volume == AT_50KEV and record.volume is not None
    paper = record.scores["paper"].values["psnr3d"]
    for source in ((tmp_path,), (*chosen, "--out", tmp_path / "made.md")):
        code, said = command(monkeypatch, capsys, "inspect", smallest, *source)
        assert code == 0 and "the method's own volume at 50 keV is scored" in said.out
        (row,) = (line for line in said.out.splitlines() if "| protocol paper |" in line)
        assert f"| {paper:.2f} (" in row
    write_volume(at_50kev_of(tmp_path / record.volume), np.zeros((10, 12, 12), np.float32), "another run")
    assert "the same volume" in command(monkeypatch, capsys, "inspect", smallest, tmp_path)[1].out


def test_errors_are_one_sentence_and_code_2(smallest, results, tmp_path, monkeypatch, capsys):
    cases = [
        ((tmp_path / "nothing", results), "nothing"),
        ((smallest,), "--method"),
        ((smallest, "--method", "fkd"), "did you mean fdk"),
        ((smallest, results, "--method", "nmar"), "keeps volumes of fdk"),
        ((smallest, results, "--scene", "lung"), "--scene 'lung'"),
        ((smallest, tmp_path / "empty"), "no volume"),
    ]
    for arguments, words in cases:
        code, said = command(monkeypatch, capsys, "inspect", *arguments)
        assert code == 2 and said.err.startswith("run-benchmark inspect: ") and said.err.count("\n") == 1, said.err
        assert words in said.err
    path = next((results / "volumes").glob("smallest__fdk.tif"))
    write_volume(path, np.zeros((10, 12, 12), np.float32), "another run")
    code, said = command(monkeypatch, capsys, "inspect", smallest, results)
    assert code == 2 and "not the volume of the last record" in said.err


def test_a_volume_that_has_no_scores_is_refused(case, smallest):
    from ctsim.dataset.store import list_scans, open_scan
    from ctsim.errors import InputError

    stored = open_scan(list_scans(smallest)[0])
    with pytest.raises(InputError, match="shape"):
        inspector.markdown(Inspected(label="fdk", values=case[0]), stored)
    right = np.zeros((10, 12, 12), np.float32)
    with pytest.raises(InputError, match="volume at 50 keV has shape"):
        inspector.markdown(Inspected(label="fdk", values=right, at_50kev=case[0]), stored)
    with pytest.raises(InputError, match="not finite"):
        inspector.markdown(Inspected(label="fdk", values=np.full((10, 12, 12), np.nan)), stored)
