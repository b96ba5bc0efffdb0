"""The generated reference pages are what the types say today."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import pytest
import tyro

from ctsim.benchmarks.methods import TABLE, find, parameters, resolve
from ctsim.benchmarks.tools import reference
from ctsim.benchmarks.tools.reference import COMMAND, main, pages

FOLDER = Path(__file__).parents[1] / "docs" / "reference"


@pytest.mark.parametrize("name", ["commands.md", "scene-keys.md", "methods.md", "python.md", "suites.md"])
def test_a_committed_page_is_up_to_date(name):
    assert (FOLDER / name).read_text(encoding="utf-8") == pages()[name], f"run `{COMMAND}`"


def test_no_page_names_this_machine():
    for name, page in pages().items():
        assert str(FOLDER.parents[1]) not in page and str(Path.home()) + "/" not in page, name


def test_the_command_writes_every_page(tmp_path, capsys):
    assert main([str(tmp_path / "new")]) == 0
    assert {p.name: p.read_text(encoding="utf-8") for p in (tmp_path / "new").iterdir()} == pages()
    assert capsys.readouterr().out.count(".md\n") == len(pages())


@dataclasses.dataclass(frozen=True)
class Form:
    """Do one thing.

    And say why.
    """

    where: tyro.conf.Positional[Path]
    """Where it is done."""
    dry_run: tyro.conf.FlagCreatePairsOff[bool] = False
    """Only say so."""
    keep: bool = True
    name: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """Whose; a | b."""
    seconds: float | None = None
    size: Literal["core", "small"] = "core"


def test_a_command_is_described_by_its_dataclass():
    said = reference.command("do-it", Form).splitlines()
    assert said[0] == "## do-it" and "do-it WHERE [flags]" in said and "And say why." in said
    assert [line for line in said if line.startswith("| `")] == [
        "| `WHERE` |  |  | Where it is done. |",
        "| `--dry-run` |  | off | Only say so. |",
        "| `--keep`, `--no-keep` |  | on |  |",
        "| `--name` | `NAME`, may be repeated |  | Whose; a \\| b. |",
        "| `--seconds` | number |  |  |",
        '| `--size` | `"core"` or `"small"` | `"core"` |  |',
    ]


def test_every_flag_of_a_command_is_one_that_tyro_takes(capsys):
    for name, form in reference.forms().items():
        with pytest.raises(SystemExit):
            tyro.cli(form, args=["--help"])
        shown, section = capsys.readouterr().out, reference.command(name, form)
        for item in dataclasses.fields(form):
            flag = f"--{item.name.replace('_', '-')}"
            assert (flag in shown) == (f"`{flag}`" in section), (name, flag)


def test_every_method_has_its_parameters_with_their_defaults():
    page = pages()["methods.md"]
    for name in TABLE:
        section = page.partition(f"\n## {name}\n")[2].partition("\n## ")[0]
        assert section, name
        for key, value in find(name).params.items():
            default = "none" if value is None else reference.code(value)
            (row,) = (row for row in section.splitlines() if row.startswith(f"| `{key}` |"))
            parameter = parameters(name, resolve(find(name).target))[key]
            assert all(said in row for said in (default, parameter.expected, parameter.meaning)), (name, key)


def test_types_are_named_in_words():
    class Inner(msgspec.Struct):
        key: int

    named = {
        "integer (≥ 1, ≤ 5)": Annotated[int, msgspec.Meta(ge=1, le=5)],
        "[number, text]": tuple[float, str],
        "[2 × number (> 0)]": tuple[Annotated[float, msgspec.Meta(gt=0)], Annotated[float, msgspec.Meta(gt=0)]],
        "list of integer": tuple[int, ...],
        "number or text": float | str | None,
        "table": Inner,
        "[inner](#inner)": Inner,
    }
    for words, kind in named.items():
        links = {Inner: "[inner](#inner)"} if words.startswith("[inner") else {}
        assert reference.kind_name(kind, links) == words
