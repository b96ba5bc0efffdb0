"""Tables in LaTeX, by booktabs."""

import itertools
from collections.abc import Sequence

from ctsim.benchmarks.engine.texts import escape, one_line


def comment(text: str) -> str:
    """Return a text as a comment, which ends where its one line does."""
    return f"% {' '.join(one_line(text).split())}\n"


def prose(text: str) -> str:
    """Escape prose: a pair of hyphens is a flag and no dash, and what stands in backquotes is typewriter."""
    parts = ["-{}-".join(escape(piece, "tex") for piece in part.split("--")) for part in text.split("`")]
    return "".join(rf"\texttt{{{part}}}" if n % 2 else part for n, part in enumerate(parts))


def row(cells: Sequence[str]) -> str:
    """Return a table's line of cells that are LaTeX already."""
    return " & ".join(cells) + r" \\"


def spanning(n_stubs: int, titles: Sequence[tuple[str, int]], *, merge: bool = True) -> list[str]:
    """Return a head line of titles over so many columns each, after `n_stubs` empty ones, and the rules below them.

    Neighbouring equal titles span their columns together, unless not to `merge`; columns without one have no rule.
    """
    if merge:
        grouped = itertools.groupby(titles, key=lambda t: t[0])
        titles = [(title, sum(n for _, n in group)) for title, group in grouped]
    cells, rules, first = [""] * n_stubs, "", n_stubs + 1
    for title, n in titles:
        cells += [rf"\multicolumn{{{n}}}{{c}}{{{prose(title)}}}"] if title else [""] * n
        rules += rf"\cmidrule(lr){{{first}-{first + n - 1}}}" if title else ""
        first += n
    return [row(cells), rules]


def table(
    caption: str, columns: str, head: Sequence[str], body: Sequence[str], *, label: str = "", notes: Sequence[str] = ()
) -> str:
    """Return a table environment; everything given is LaTeX, `head` and `body` are whole lines."""
    lines = [
        r"\begin{table}",
        r"\centering",
        rf"\caption{{{caption}}}",
        *([rf"\label{{{label}}}"] if label else []),
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        *head,
        r"\midrule",
        *body,
        r"\bottomrule",
        r"\end{tabular}",
        *(rf"\par\footnotesize {note}" for note in notes),
        r"\end{table}",
    ]
    return "\n".join(lines) + "\n"
