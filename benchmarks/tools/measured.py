"""The measured pages of the documentation: what writes each, and which of them describe older code.

    python -m ctsim.benchmarks.tools.measured PAGE RESULTS docs/measured
    python -m ctsim.benchmarks.tools.measured freshness [docs/measured]

The first writes a page: PAGE is detect, skipping, stability, speed, pareto, validation or ablation. The study's own
table in RESULTS, which names commit and machine, becomes the page, under a title and the command that measures it.
`run-benchmark report RESULTS --markdown docs/measured/results.md` writes the page of the results.

The second lists, for every page, how many of its sources have changed between the oldest commit that the page names
and HEAD, and which of them have another default: a field of a settings type, a constant, a key of a suite. Moved files,
comments, docstrings and imports do not count. It is a report, not a check: the exit code is 0.
"""

import ast
import contextlib
import dataclasses
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

from ctsim.benchmarks.cli import guarded
from ctsim.errors import InputError

FOLDER = Path("docs/measured")
FEW = 4  # files that the report names
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


CORRECTED = " ".join(
    [f"--method {name}" for name in ("fdk", "limar", "nmar")]
    + [f"--set {name}.{light}=found" for name in ("fdk", "limar", "nmar") for light in ("panel", "scatter")]
)
"""Methods that get of scatter, lag and glare what `splat` takes off by itself."""
STUDIES, SUITES = "benchmarks/studies/", "benchmarks/suites/"
PAGES: dict[str, Page] = {
    "results": Page(
        title="Results",
        command="run-benchmark report quick --markdown docs/measured/results.md --also headline",
        sources=(*METHODS, "benchmarks/scores/", f"{SUITES}quick.toml", f"{SUITES}headline.toml"),
    ),
    "sensitivity": Page(
        title="Which score sees which fault",
        command="python -m ctsim.benchmarks.tools.sensitivity data/thorax-Fe-s1 docs/measured",
        sources=("benchmarks/scores/", "benchmarks/tools/sensitivity.py"),
    ),
    "assumptions": Page(
        title="What a simulation shares with a method",
        command="python -m ctsim.benchmarks.tools.assumptions results/ docs/measured",
        sources=(*METHODS, "benchmarks/scores/", f"{SUITES}assumptions.toml"),
    ),
    "beams": Page(
        title="Beams that splats are not told",
        command="python -m ctsim.benchmarks.tools.beams docs/measured",
        sources=(*METHODS, "benchmarks/scores/", f"{SUITES}beams.toml"),
        explained="splats.md",
    ),
    "scatter": Page(
        title="Scatter found in scans",
        command="python -m ctsim.benchmarks.tools.scatter docs/measured",
        sources=(*METHODS, "benchmarks/scores/", f"{SUITES}scatter.toml"),
        explained="splats.md",
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
    "detect": _of(
        "detect", "Detection of lesions near metal", "protocols.md",
        *METHODS, "benchmarks/scores/channels.py", "benchmarks/scores/observer.py", f"{STUDIES}detect/",
        f"{SUITES}detect.toml", words=f"results/`, `run-benchmark detect results/ {CORRECTED}",
    ),
    "skipping": _of(
        "skipping", "What is left out", "skipping.md",
        *METHODS, f"{STUDIES}skipping/", words="results/ --repeats 3",
    ),
    "speed": _of(
        "peers", "Speed and error of ctsim, RTK and XCIST", "peers.md",
        *SIMULATOR, "reconstruct/fdk.py", f"{STUDIES}peers/",
    ),
    "validation": _of(
        "validate", "Validation of the physics", "physics.md",
        *SIMULATOR, "reconstruct/fdk.py", "reconstruct/splat/", f"{STUDIES}validate/", f"{SUITES}quick.toml",
    ),
    "stability": _of(
        "stress", "Numerical stability", "stability.md",
        *METHODS, f"{STUDIES}stress/", f"{SUITES}stress.toml",
    ),
}  # fmt: skip


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Age:
    """The age of a page: sources `changed` since its `commit`, and `settings`, those of them with another default."""

    page: str
    commit: str
    date: str = ""
    changed: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()

    @property
    def state(self) -> str:
        """The result in one or two words."""
        if not self.date:
            return "commit unknown"
        return "other defaults" if self.settings else "other code" if self.changed else "fresh"


def commits_of(text: str) -> list[str]:
    """Return the commits that a page names, in their order, each once."""
    found = [c for group in COMMIT.findall(text) for c in re.findall(r"[0-9a-f]{7,40}", group)]
    return list(dict.fromkeys(found + WITHIN.findall(text)))


def page_named(name: str) -> Page:
    """Return a page's declaration. Raises InputError for an unknown page."""
    if name not in PAGES:
        raise InputError(f"there is no measured page {name!r}: expected one of {', '.join(PAGES)}")
    return PAGES[name]


def main(arguments: list[str]) -> int:
    """Write a page, or print the report on all; return 0."""
    if arguments[:1] == ["freshness"]:
        return _freshness(arguments[1:])
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


def _freshness(arguments: list[str]) -> int:
    if len(arguments) > 1:
        raise InputError("expected at most one folder of measured pages")
    folder = Path(arguments[0]) if arguments else FOLDER
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected one of measured pages")
    sys.stdout.write(report([age_of(path) for path in sorted(folder.glob("*.md"))]))
    return 0


def recorded(results: Path) -> list[str]:
    """Return the commits in the records of `run-benchmark`, each once, in their order."""
    path = results / "records.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return list(dict.fromkeys(str(json.loads(line)["commit"])[:12] for line in lines))


def page_text(name: str, page: Page, table: str, commits: list[str]) -> str:
    """Return a page: title, how it was made, and the study's table as it is.

    `commits`, of the records, are for a table that names none. Raises InputError if both are missing.
    """
    if not commits_of(table):
        if not commits:
            raise InputError(f"{name}: neither table nor records name a commit, expected one that the study wrote")
        table = f"Measured at commit {', '.join(commits)}.\n\n{table}"
    body = re.sub(r"^# .*\n+", "", table, flags=re.M)
    explained = f" [What the numbers say](../explanation/{page.explained})." if page.explained else ""
    made = f"Made by `{page.command}`, then `python -m ctsim.benchmarks.tools.measured {name} results/ docs/measured`."
    return f"# {page.title}: measured\n\n{made} Do not edit.{explained}\n\n{body.strip()}\n"


def age_of(page: Path) -> Age:
    """Compare the sources of a page at its oldest commit with those at HEAD.

    Raises InputError for a page without a declaration, so that none is forgotten.
    """
    sources, commits = page_named(page.stem).sources, commits_of(page.read_text(encoding="utf-8"))
    root = Path(git(page.parent, "rev-parse", "--show-toplevel").strip())
    named = [c for c in commits if _tried(root, "cat-file", "-t", c) == "commit\n"]
    if not named:
        return Age(page=page.stem, commit=", ".join(commits) or "none")
    oldest = max(named, key=lambda c: int(git(root, "rev-list", "--count", f"{c}..HEAD")))
    changed = _changed(root, oldest, sources)
    return Age(
        page=page.stem,
        commit=oldest,
        date=git(root, "show", "-s", "--format=%cs", oldest).strip(),
        changed=tuple(changed),
        settings=tuple(name for name, other in changed.items() if other),
    )


def _changed(root: Path, commit: str, sources: tuple[str, ...]) -> dict[str, bool]:
    """Return the sources whose code has changed, and whether a default in them has."""
    found = {}
    for line in git(root, "diff", "--name-status", "-M", commit, "HEAD").splitlines():
        status, *names = line.split("\t")
        if status == "R100" or not any(n == s or (s.endswith("/") and n.startswith(s)) for n in names for s in sources):
            continue
        before = names[0], _tried(root, "show", f"{commit}:{names[0]}")
        after = names[-1], _tried(root, "show", f"HEAD:{names[-1]}")
        if _code(*before) != _code(*after):
            found[names[-1]] = _defaults(*before) != _defaults(*after)
    return found


def _code(path: str, text: str) -> str:
    """Return what a file computes: Python without comments, docstrings and imports, TOML without comments."""
    if path.endswith(".toml"):
        return repr(tomllib.loads(text))
    if not path.endswith(".py"):
        return text
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            node.body = [n for n in body if not (_says(n) or isinstance(n, ast.Import | ast.ImportFrom))]  # pyright: ignore[reportAttributeAccessIssue]
    return ast.dump(tree)


def _says(node: ast.AST) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _defaults(path: str, text: str) -> set[str]:
    """Return "name = value" of a TOML file's keys, or of a module's constants and fields with defaults."""
    if path.endswith(".toml"):
        return {f"{key} = {value!r}" for key, value in tomllib.loads(text).items()}
    if not path.endswith(".py"):
        return set()
    found = set()
    tree = ast.parse(text)
    for node in [*tree.body, *(n for c in tree.body if isinstance(c, ast.ClassDef) for n in c.body)]:
        if isinstance(node, ast.AnnAssign) and node.value is not None and isinstance(node.target, ast.Name):
            found.add(f"{node.target.id} = {ast.unparse(node.value)}")
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id.isupper():
            found.add(f"{node.targets[0].id} = {ast.unparse(node.value)}")
    return found


def git(where: Path, *arguments: str) -> str:
    """Return git's output. Raises InputError with its message if it fails."""
    command = ["git", "-C", str(where), *arguments]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", check=False)
    if done.returncode:
        raise InputError(f"git {arguments[0]}: {' '.join(done.stderr.split())}")
    return done.stdout


def _tried(where: Path, *arguments: str) -> str:
    """Return git's output; "" if it fails, as for a file that did not exist."""
    with contextlib.suppress(InputError):
        return git(where, *arguments)
    return ""


def report(ages: list[Age]) -> str:
    """Return the table as text, the pages that are most out of date first."""
    order = ("commit unknown", "other defaults", "other code", "fresh")
    head = ("page", "state", "commit", "date", "files changed", "defaults changed in")
    rows: list[tuple[str, ...]] = [head]
    for age in sorted(ages, key=lambda a: (order.index(a.state), -len(a.changed), a.page)):
        more = f" and {len(age.settings) - FEW} more" if len(age.settings) > FEW else ""
        few = ", ".join(age.settings[:FEW]) + more
        rows.append((age.page, age.state, age.commit[:12], age.date, str(len(age.changed)), few))
    widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(guarded("measured", "ctsim.benchmarks.tools.measured", sys.argv[1:]))
