"""List which measured pages describe older code than today's.

    python -m ctsim.benchmarks.tools.freshness [docs/measured]

Every measured page names the commit at which it was measured; the oldest one counts. `measured.PAGES` declares the
sources that its numbers depend on. The report lists how many of those have changed between that commit and HEAD,
and which of them hold another default: a field of a settings type, a constant, a key of a suite. Moved files, comments,
docstrings and imports do not count. It is a report, not a check: the exit code is 0.
"""

import ast
import contextlib
import dataclasses
import subprocess
import sys
import tomllib
from pathlib import Path

from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.tools.measured import commits_of, page_named
from ctsim.errors import InputError

FOLDER = Path("docs/measured")
FEW = 4


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Age:
    """How old a page is: `changed` sources since its `commit`, `settings` among them with another default."""

    page: str
    commit: str
    date: str = ""
    changed: tuple[str, ...] = ()
    settings: tuple[str, ...] = ()

    @property
    def state(self) -> str:
        """The verdict in two words."""
        if not self.date:
            return "commit unknown"
        return "other defaults" if self.settings else "other code" if self.changed else "fresh"


def main(arguments: list[str]) -> int:
    """Print the report; return 0."""
    if len(arguments) > 1:
        raise InputError("expected at most one folder of measured pages")
    folder = Path(arguments[0]) if arguments else FOLDER
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected one of measured pages")
    sys.stdout.write(report([age_of(path) for path in sorted(folder.glob("*.md"))]))
    return 0


def age_of(page: Path) -> Age:
    """Compare the sources of a page at its oldest commit with those at HEAD.

    Raises InputError where a page has no declaration, so that none is forgotten.
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
    """Return the sources that compute something else, and whether they hold another value of a setting."""
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
    """Return what git prints. Raises InputError with its words where it fails."""
    command = ["git", "-C", str(where), *arguments]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", errors="replace", check=False)
    if done.returncode:
        raise InputError(f"git {arguments[0]}: {' '.join(done.stderr.split())}")
    return done.stdout


def _tried(where: Path, *arguments: str) -> str:
    """Return what git prints; nothing where it fails, as for a file that was not there."""
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
    sys.exit(guarded("freshness", "ctsim.benchmarks.tools.freshness", sys.argv[1:]))
