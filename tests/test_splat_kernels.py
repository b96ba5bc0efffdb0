"""The benchmark of the splat projectors: all its rows, and errors that a projector may have."""

import pytest

from ctsim.benchmarks.tools import splat_kernels
from ctsim.phantoms.scanners import preset


def test_every_contender_has_a_row_and_is_near_the_exact_form(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(splat_kernels, "ROUNDS", 1)
    monkeypatch.setattr(splat_kernels, "N_SPLATS", 300)
    monkeypatch.setattr(splat_kernels, "CORE", preset("ideal", 48, (32, 32), (16, 16, 16), 60.0).geometry)
    assert splat_kernels.main([str(tmp_path / "new")]) == 0
    text = (tmp_path / "new" / "splat_kernels.md").read_text(encoding="utf-8")
    assert capsys.readouterr().out == text
    rows = [[c.strip() for c in line.strip("|").split("|")] for line in text.splitlines() if line.startswith("| ")][1:]
    errors = {row[1]: float(row[4]) for row in rows if row[4] != "–"}
    assert [row[1] for row in rows if row[4] == "–"] == ["EWA gradient"]
    assert errors.pop("exact forward") == 0
    assert set(errors) == {"EWA forward"} | {
        f"{way}, {what}" for way in ("by columns", "splat by splat") for what in ("forward", "adjoint")
    }
    assert all(0 < error < 1e-3 for error in errors.values())
    assert all(float(row[2]) > 0 and float(row[3]) > 0 for row in rows)


def test_a_folder_must_be_named():
    with pytest.raises(splat_kernels.InputError, match="expected OUT"):
        splat_kernels.main([])
