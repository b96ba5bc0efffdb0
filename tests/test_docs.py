"""What the pages say is true: examples run, links lead somewhere, suites and recipes exist."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import tifffile
import tyro
from ct_files import stored, write_slices

from ctsim.dataset.store import list_scans

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.M | re.S)
BLOCKS = [
    pytest.param(kind, text, id=f"{page.relative_to(ROOT)}-{number}")
    for page in PAGES
    for number, (kind, text) in enumerate(BLOCK.findall(page.read_text(encoding="utf-8")))
]
MARKED = [p for p in BLOCKS if p.values[0] in ("python", "toml")]


def test_there_are_examples():
    assert {p.values[0] for p in BLOCKS} >= {"python", "toml", "bash"}
    assert {page.parent.name for page in PAGES} >= {"tutorials", "how-to", "explanation", "reference", "measured"}


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "text"), MARKED)
def test_an_example_works(kind, text, smallest, tmp_path, monkeypatch):
    """Python runs where data/ holds a dataset, whose scan lung-Fe is, too; TOML is read as scenes and built."""
    (tmp_path / "data").mkdir()
    for path in smallest.iterdir():
        (tmp_path / "data" / path.name).symlink_to(path)
    (tmp_path / "data" / "lung-Fe").symlink_to(list_scans(smallest)[0])
    tifffile.imwrite(tmp_path / "head.tif", np.full((50, 150, 150), 1074, np.uint16))
    if '"head"' in text:
        head = np.full((50, 150, 150), 50, np.int16)
        head[:, :2] = -1000  # the air around it
        write_slices(tmp_path / "head", *stored(head, spacing=(2.4, 0.8, 0.8)))
    monkeypatch.chdir(tmp_path)
    if kind == "python":
        exec(compile(text, "example", "exec"), {"__name__": "example"})
    else:
        from ctsim.phantoms.scene import build, parse_suite

        scenes = [scene for scene in parse_suite(text) if not (scene.drawn and scene.drawn.index)]
        assert all(build(scene).labels.any() for scene in scenes)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_to_files(page):
    for link in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not link.startswith(("http://", "https://", "mailto:")):
            assert (page.parent / link).exists(), link


def test_the_changes_link_to_no_page():
    """The site shows them from another folder, where such a link leads nowhere."""
    assert not re.findall(r"\]\((?!https?://)[^)]*\)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))


def commands(text: str) -> list[str]:
    """List what a page has the user type: lines of bash, indented lines, and code within the text."""
    prose = BLOCK.sub("", text)
    typed = [block for kind, block in BLOCK.findall(text) if kind == "bash"]
    typed += re.findall(r"^    ((?:make-dataset|run-benchmark)\b.*)$", prose, re.M)
    typed += [" ".join(code.split()) for code in re.findall(r"`((?:make-dataset|run-benchmark)\s[^`]*)`", prose)]
    return [line for block in typed for line in re.split(r"\n|&&", block.replace("\\\n", " "))]


def arguments_of(name: str, words: list[str]) -> tuple[type, list[str]] | None:
    """Return the form and the words of a command of ours, None for another, and where it is but named."""
    from ctsim.benchmarks.tools.reference import forms

    name = name.rpartition("/")[2]
    if name not in ("make-dataset", "run-benchmark"):
        return None
    if words and f"{name} {words[0]}" in forms():
        name, words = f"{name} {words[0]}", words[1:]
    return (forms()[name], words) if any(not word.startswith("-") for word in words) else None


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_in_the_pages_are_understood(page):
    """Every make-dataset and run-benchmark line parses: its flags exist."""
    for line in commands(page.read_text(encoding="utf-8")):
        name, *words = shlex.split(line, comments=True) or [""]
        if (understood := arguments_of(name, words)) is not None:
            tyro.cli(understood[0], args=understood[1])


def test_commands_are_found_wherever_they_stand():
    code = "`run-benchmark data/ results/\n--such`"
    block = "```bash\nmake-dataset core \\\n  d/\n```"
    found = commands(f"So {code}.\n\n    run-benchmark pareto out/\n\n{block}\n")
    assert [" ".join(line.split()) for line in found if line] == [
        "make-dataset core d/",
        "run-benchmark pareto out/",
        "run-benchmark data/ results/ --such",
    ]
    assert sum(len(commands(page.read_text(encoding="utf-8"))) for page in PAGES) > 80


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 130


OVERUSED = re.compile(r"\b(beside|so many|whatever|anew|held against|those that)\b", re.I)
WRITTEN = [page for page in PAGES if page.name != "CHANGELOG.md" and page.parent.name != "measured"]


@pytest.mark.parametrize("page", WRITTEN, ids=lambda p: str(p.relative_to(ROOT)))
def test_the_prose_avoids_words_that_we_overused(page):
    """Words of ours that readers stumble over, 92 times "beside" in one version; pages from the types are not prose."""
    text = page.read_text(encoding="utf-8")
    if not text.startswith("<!-- Generated"):
        assert not OVERUSED.findall(text)


def test_the_readme_names_every_recipe_and_suite():
    from ctsim.benchmarks.suites import bundled
    from ctsim.phantoms.recipes import NAMES

    text = (ROOT / "README.md").read_text(encoding="utf-8")
    suites = bundled()
    assert suites
    for name in (*NAMES, *suites):
        assert f"`{name}`" in text, name
