"""What the pages say is true: examples run, links lead somewhere, suites and recipes exist."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import tifffile

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.M | re.S)
BLOCKS = [
    pytest.param(kind, text, id=f"{page.relative_to(ROOT)}-{number}")
    for page in PAGES
    for number, (kind, text) in enumerate(BLOCK.findall(page.read_text(encoding="utf-8")))
]
MARKED = [p for p in BLOCKS if p.values[0] in ("python", "toml")]


def test_there_are_examples():
    assert {p.values[0] for p in BLOCKS} >= {"python", "toml", "bash"}


@pytest.mark.parametrize(("kind", "text"), MARKED)
def test_an_example_works(kind, text, smallest, tmp_path, monkeypatch):
    """Python runs where data/ holds a dataset; TOML is read as scenes, one of head.tif, and every phantom is built."""
    (tmp_path / "data").symlink_to(smallest)
    tifffile.imwrite(tmp_path / "head.tif", np.full((50, 150, 150), 1074, np.uint16))
    monkeypatch.chdir(tmp_path)
    if kind == "python":
        exec(compile(text, "example", "exec"), {"__name__": "example"})
    else:
        from phantoms.scene import build, parse_suite

        assert all(build(scene).labels.any() for scene in parse_suite(text))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_to_files(page):
    for link in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if not link.startswith(("http://", "https://", "mailto:")):
            assert (page.parent / link).exists(), link


def test_commands_in_the_pages_are_understood():
    """Every make-dataset and run-benchmark line parses: its flags exist."""
    import tyro

    from benchmarks.cli_run import Arguments
    from benchmarks.inspector import Arguments as Inspect
    from benchmarks.make_dataset import Options
    from benchmarks.reproduce import Arguments as Reproduce

    parsed = 0
    for kind, text in (p.values for p in BLOCKS):
        for line in re.split(r"\n|&&", text.replace("\\\n", " ")) if kind == "bash" else ():
            name, *words = shlex.split(line, comments=True) or [""]
            form = {"make-dataset": Options, "run-benchmark": Arguments}.get(name.rpartition("/")[2])
            others = {"inspect": Inspect, "reproduce": Reproduce}
            if form is Arguments and words and words[0] in others:
                form, words = others[words[0]], words[1:]
            if form and words[:1] != ["peers"]:
                tyro.cli(form, args=words)
                parsed += 1
    assert parsed >= 4


def test_the_readme_names_every_recipe_and_suite():
    from benchmarks.make_dataset import bundled
    from phantoms.recipes import NAMES

    text = (ROOT / "README.md").read_text(encoding="utf-8")
    suites = bundled()
    assert suites
    for name in (*NAMES, *suites):
        assert f"`{name}`" in text, name
