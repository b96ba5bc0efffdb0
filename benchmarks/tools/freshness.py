"""List which measured pages describe older code than today's.

    python -m ctsim.benchmarks.tools.freshness [docs/measured]

Every measured page names the commit at which it was measured; the oldest one counts. `provenance.PAGES` declares the
sources that its numbers depend on. The report lists how many of those have changed between that commit and HEAD,
and which of them hold another default: a field of a settings type, a constant, a key of a suite. Moved files, comments,
docstrings and imports do not count. It is a report, not a check: the exit code is 0.
"""

import ast
import dataclasses
import subprocess
import sys
import tomllib
from pathlib import Path

from ctsim.benchmarks.cli import guarded
from ctsim.benchmarks.tools.provenance import PAGES, commits_of, measured
from ctsim.errors import InputError

FOLDER = Path("docs/measured")
FEW = 4


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Age:
    """How old a page is: `changed` sources since its `commit`, `settings` among them with another default."""

    page: str
    commit: str
    date: str
    changed: tuple[str, ...]
    settings: tuple[str, ...]
    known: bool = True

    @property
    def state(self) -> str:
        """The verdict in two words."""
        if not self.known:
            return "commit unknown"
        return "other defaults" if self.settings else "other code" if self.changed else "fresh"


def main(arguments: list[str]) -> int:
    """Print the report; return 0."""
    if len(arguments) > 1:
        raise InputError("expected at most one folder of measured pages")
    folder = Path(arguments[0]) if arguments else FOLDER
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected one of measured pages")
    sys.stdout.write(report([age_of(name, text, folder) for name, text in measured(folder).items()]))
    return 0


def age_of(name: str, text: str, folder: Path) -> Age:
    """Compare the sources of a page at its oldest commit with those at HEAD."""
    root = Path(git(folder, "rev-parse", "--show-toplevel").strip())
    named = [c for c in commits_of(text) if _exists(root, c)]
    if not named:
        return Age(
            page=name, commit=", ".join(commits_of(text)) or "none", date="", changed=(), settings=(), known=False
        )
    oldest = max(named, key=lambda c: int(git(root, "rev-list", "--count", f"{c}..HEAD")))
    changed = _changed(root, oldest, PAGES[name].sources)
    return Age(
        page=name,
        commit=oldest,
        date=git(root, "show", "-s", "--format=%cs", oldest).strip(),
        changed=tuple(changed),
        settings=tuple(new for new, old in changed.items() if _other_default(root, oldest, old, new)),
    )


def _changed(root: Path, commit: str, sources: tuple[str, ...]) -> dict[str, str]:
    """Return the sources that compute something else, as today's name → the name then."""
    found = {}
    for line in git(root, "diff", "--name-status", "-M", commit, "HEAD").splitlines():
        status, *names = line.split("\t")
        if status == "R100" or not any(n == s or (s.endswith("/") and n.startswith(s)) for n in names for s in sources):
            continue
        before, after = _text(root, commit, names[0]), _text(root, "HEAD", names[-1])
        if _code(names[0], before) != _code(names[-1], after):
            found[names[-1]] = names[0]
    return found


def _text(root: Path, commit: str, path: str) -> str:
    """Return a file as it was; nothing where it was not there."""
    done = subprocess.run(["git", "-C", root, "show", f"{commit}:{path}"], capture_output=True, check=False)
    return "" if done.returncode else done.stdout.decode("utf-8", errors="replace")


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


def _other_default(root: Path, commit: str, old: str, new: str) -> bool:
    """Tell whether a changed file holds another value of a setting."""
    return _defaults(old, _text(root, commit, old)) != _defaults(new, _text(root, "HEAD", new))


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


def _exists(root: Path, commit: str) -> bool:
    done = subprocess.run(
        ["git", "-C", root, "cat-file", "-e", f"{commit}^{{commit}}"], capture_output=True, check=False
    )
    return done.returncode == 0


def git(where: Path, *arguments: str) -> str:
    """Return what git prints. Raises InputError with its words where it fails."""
    done = subprocess.run(["git", "-C", str(where), *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(f"git {arguments[0]}: {' '.join(done.stderr.split())}")
    return done.stdout


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
    sys.exit(guarded("freshness", __name__, sys.argv[1:]))
