"""The measured pages: how they are written, and which describe older code."""

import subprocess
from pathlib import Path

import pytest

from ctsim.benchmarks.tools import measured
from ctsim.errors import InputError

DOCS = Path(__file__).parents[1] / "docs"
PAGE = measured.Page(title="T", command="make it", sources=("core/", "suites/a.toml"), file="t.md")


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository with one measured page "mine" that depends on core/ and suites/a.toml."""
    monkeypatch.setattr(measured, "PAGES", {"mine": PAGE})
    for name in ("GIT_AUTHOR", "GIT_COMMITTER"):
        monkeypatch.setenv(f"{name}_NAME", "A")
        monkeypatch.setenv(f"{name}_EMAIL", "a@example.org")
    measured.git(tmp_path, "init", "-q")
    for folder in ("core", "suites", "pages"):
        (tmp_path / folder).mkdir()
    (tmp_path / "core" / "a.py").write_text('"""Doc."""\n\nimport os\n\n\nclass S:\n    n: int = 3\n\n\nx = os.sep\n')
    (tmp_path / "suites" / "a.toml").write_text("views = 60\n")
    first = commit(tmp_path)
    (tmp_path / "pages" / "mine.md").write_text(f"2026-01-01, commit {first}, a machine\n")
    commit(tmp_path)
    return tmp_path


def commit(root):
    measured.git(root, "add", "-A")
    measured.git(root, "commit", "-qm", "change")
    return measured.git(root, "rev-parse", "--short=12", "HEAD").strip()


def found(root):
    return measured.age_of(root / "pages" / "mine.md")


def test_a_page_is_fresh_while_its_sources_compute_the_same(repository):
    assert found(repository).state == "fresh"
    (repository / "other.py").write_text("n = 4\n")
    path = repository / "core" / "a.py"
    path.write_text(path.read_text().replace("Doc.", "Better.").replace("import os", "import os  # why"))
    measured.git(repository, "mv", "core/a.py", "core/b.py")
    commit(repository)
    assert found(repository).state == "fresh"


@pytest.mark.parametrize(
    ("path", "old", "new", "state"),
    [
        ("core/a.py", "os.sep", "os.linesep", "other code"),
        ("core/a.py", "n: int = 3", "n: int = 4", "other defaults"),
        ("suites/a.toml", "60", "90", "other defaults"),
        ("suites/a.toml", "views", "# said\nviews", "fresh"),
    ],
)
def test_a_change_of_a_source_shows(repository, path, old, new, state):
    (repository / path).write_text((repository / path).read_text().replace(old, new))
    commit(repository)
    age = found(repository)
    assert age.state == state and (age.changed == (path,)) == (state != "fresh")
    assert age.settings == ((path,) if state == "other defaults" else ())


def test_the_oldest_commit_counts_and_a_strange_one_is_said(repository):
    page = repository / "pages" / "mine.md"
    first = measured.commits_of(page.read_text())[0]
    (repository / "core" / "a.py").write_text("n = 1\n")
    page.write_text(f"commit {commit(repository)}, {first}\n")
    assert found(repository).commit == first
    page.write_text("commit 0123456789ab\n")
    assert found(repository).state == "commit unknown"


def test_the_report_lists_every_page_and_ends_well(repository, capsys, monkeypatch):
    monkeypatch.chdir(repository)
    assert measured.main(["freshness", "pages"]) == 0
    head, row = capsys.readouterr().out.splitlines()
    assert head.split()[:2] == ["page", "state"] and row.split()[:2] == ["mine", "fresh"]


def test_a_page_without_a_declaration_is_refused(repository):
    (repository / "pages" / "new.md").write_text("commit 0123456789ab\n")
    with pytest.raises(InputError, match="no measured page 'new'"):
        measured.main(["freshness", str(repository / "pages")])


def test_every_measured_page_is_declared_and_names_a_commit():
    texts = {path.stem: path.read_text(encoding="utf-8") for path in (DOCS / "measured").glob("*.md")}
    assert set(texts) == set(measured.PAGES)
    for name, text in texts.items():
        assert measured.commits_of(text), name
        assert text.startswith(f"# {measured.PAGES[name].title}"), name
    for page in measured.PAGES.values():
        for source in page.sources:
            assert (DOCS.parent / source).exists(), source
        assert not page.explained or (DOCS / "explanation" / page.explained).is_file(), page.explained


def test_commits_are_found_as_studies_write_them():
    said = (
        "x, commit b669e20a1df2 (`nmar` and `bhc-poly` 7cbee5388662), AMD; at commit 4051706b4a9f, 7cbee5388662 on AMD"
    )
    assert measured.commits_of(said) == ["b669e20a1df2", "4051706b4a9f", "7cbee5388662"]


def test_a_study_s_table_becomes_a_page(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(measured, "PAGES", {"mine": PAGE})
    (tmp_path / "t.md").write_text("# Title of its own\n\n2026, commit 0123456789ab, AMD\n\n| a |\n|---|\n| 1 |\n")
    assert measured.main(["mine", str(tmp_path), str(tmp_path / "docs")]) == 0
    text = (tmp_path / "docs" / "mine.md").read_text()
    assert text.startswith("# T: measured\n\nMade by `make it`, then `") and text.endswith("| 1 |\n")
    assert "Title of its own" not in text and "commit 0123456789ab" in text
    (tmp_path / "t.md").write_text("| a |\n")
    with pytest.raises(InputError, match="name a commit"):
        measured.main(["mine", str(tmp_path), str(tmp_path / "docs")])
    (tmp_path / "records.jsonl").write_text('{"commit": "abcdef0123456789"}\n' * 2)
    assert measured.main(["mine", str(tmp_path), str(tmp_path / "docs")]) == 0
    assert "\nMeasured at commit abcdef012345.\n" in (tmp_path / "docs" / "mine.md").read_text()


def test_git_s_errors_are_one_sentence(tmp_path):
    with pytest.raises(InputError, match="git rev-parse: "):
        measured.git(tmp_path, "rev-parse", "--show-toplevel")
    assert subprocess.run(["git", "--version"], capture_output=True, check=False).returncode == 0
