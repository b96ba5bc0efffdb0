"""Write a measured page of the documentation from a folder of results.

    python -m ctsim.benchmarks.tools.measured PAGE RESULTS docs/measured

PAGE is skipping, stability, speed, pareto or ablation. The study's own table in RESULTS, which names commit and
machine, becomes the page, under a title and the command that measures it. `run-benchmark report RESULTS --markdown
docs/measured/results.md` writes the page of the results.
"""

import json
import re
import sys
from pathlib import Path

from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.tools.provenance import Page, commits_of, page_named
from ctsim.errors import InputError


def main(arguments: list[str]) -> int:
    """Write the page; return 0."""
    if len(arguments) != 3:
        raise InputError("expected PAGE, RESULTS and the folder of the measured pages")
    name, results, folder = arguments[0], Path(arguments[1]), Path(arguments[2])
    page = page_named(name)
    if page.file is None:
        raise InputError(f"{name}: no single study writes this page; its head says how it is made")
    text = page_text(name, page, (results / page.file).read_text(encoding="utf-8"), recorded(results))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text, encoding="utf-8")
    sys.stdout.write(f"{folder / f'{name}.md'}\n")
    return 0


def recorded(results: Path) -> list[str]:
    """Return the commits in the records of `run-benchmark`, each once, in their order."""
    path = results / "records.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return list(dict.fromkeys(str(json.loads(line)["commit"])[:12] for line in lines))


def page_text(name: str, page: Page, table: str, commits: list[str]) -> str:
    """Return a page: title, how it was made, and the study's table as it is.

    `commits` are those of the records, for a table that names none. Raises InputError where there are none either.
    """
    if not commits_of(table):
        if not commits:
            raise InputError(f"{name}: neither table nor records name a commit, expected one that the study wrote")
        table = f"Measured at commit {', '.join(commits)}.\n\n{table}"
    body = re.sub(r"^# .*\n+", "", table, flags=re.M)
    explained = f" [What the numbers say](../explanation/{page.explained})." if page.explained else ""
    made = f"Made by `{page.command}`, then `python -m ctsim.benchmarks.tools.measured {name} results/ docs/measured`."
    return f"# {page.title}: measured\n\n{made} Do not edit.{explained}\n\n{body.strip()}\n"


if __name__ == "__main__":
    sys.exit(guarded("measured", __name__, sys.argv[1:]))
