"""The measured pages of the documentation: what writes each, and which sources its numbers depend on.

    python -m ctsim.benchmarks.tools.measured PAGE RESULTS docs/measured

PAGE is skipping, stability, speed, pareto or ablation. The study's own table in RESULTS, which names commit and
machine, becomes the page, under a title and the command that measures it. `run-benchmark report RESULTS --markdown
docs/measured/results.md` writes the page of the results.
"""

import dataclasses
import json
import re
import sys
from pathlib import Path

from ctsim.benchmarks.cli import guarded
from ctsim.errors import InputError

SIMULATOR = ("ctsim/", "phantoms/")
METHODS = (*SIMULATOR, "reconstruct/", "baselines/")
COMMIT = re.compile(r"\bcommits? ((?:[0-9a-f]{7,40}(?:, | and )?)+)")
WITHIN = re.compile(r"\(`[^)]*? ([0-9a-f]{7,40})\)")  # as in "commit X (`nmar` Y)"


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Page:
    """A measured page: its title, the command that measures it, the file that command writes, and its sources.

    `sources` are files, or folders ending in "/", from the repository's root. `file` is None where the
    page is written elsewhere, as by `run-benchmark report`, or collected by hand.
    """

    title: str
    command: str
    sources: tuple[str, ...]
    file: str | None = None
    explained: str = ""


def _of(study: str, title: str, explained: str, *sources: str, words: str = "results/") -> Page:
    """Return the page of a study, which writes a file of its name."""
    command = f"run-benchmark {study} {words}"
    return Page(title=title, command=command, sources=sources, file=f"{study}.md", explained=explained)


STUDIES, SUITES = "benchmarks/studies/", "benchmarks/suites/"
PAGES: dict[str, Page] = {
    "results": Page(
        title="Results",
        command="run-benchmark report quick --markdown docs/measured/results.md --also core",
        sources=(*METHODS, "benchmarks/scores/", f"{SUITES}quick.toml", f"{SUITES}core.toml",
                 f"{SUITES}core-scatter.toml", f"{SUITES}real.toml"),
    ),
    "methods": Page(
        title="Methods: settings and experiments",
        command="run-benchmark pareto results/ --suite benchmarks/suites/tune-settings.toml --part methods",
        sources=(*METHODS, "benchmarks/scores/", SUITES),
    ),
    "pareto": _of(
        "pareto", "Run time against error", "run-time.md",
        *METHODS, f"{STUDIES}pareto/", f"{SUITES}pareto.toml",
    ),
    "ablation": _of(
        "ablation", "Ablations of the published splat method", "splats.md",
        *SIMULATOR, "reconstruct/splat/", f"{STUDIES}ablation.py", f"{SUITES}ablation.toml", words="data/ results/",
    ),
    "skipping": _of(
        "skipping", "What is left out", "skipping.md",
        *METHODS, f"{STUDIES}skipping/", words="results/ --repeats 3",
    ),
    "speed": _of(
        "peers", "Speed and error of ctsim, RTK and XCIST", "peers.md",
        *SIMULATOR, "reconstruct/fdk.py", f"{STUDIES}peers/",
    ),
    "stability": _of(
        "stress", "Numerical stability", "stability.md",
        *METHODS, f"{STUDIES}stress/", f"{SUITES}stress.toml",
    ),
}  # fmt: skip


def commits_of(text: str) -> list[str]:
    """Return the commits that a page names, in their order, each once."""
    found = [c for group in COMMIT.findall(text) for c in re.findall(r"[0-9a-f]{7,40}", group)]
    return list(dict.fromkeys(found + WITHIN.findall(text)))


def page_named(name: str) -> Page:
    """Return a page's declaration. Raises InputError for a page that has none."""
    if name not in PAGES:
        raise InputError(f"there is no measured page {name!r}: expected one of {', '.join(PAGES)}")
    return PAGES[name]


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
    sys.exit(guarded("measured", "ctsim.benchmarks.tools.measured", sys.argv[1:]))
