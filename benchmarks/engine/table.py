"""Tables: columns and cells, declared once, rendered as Markdown, LaTeX, HTML and CSV."""

import csv
import html
import io
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

Better = Literal["", "max", "min", "one"]
_TEX = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    "–": "--",
    "−": "$-$",
    "≤": r"$\leq$",
    "<": "$<$",
    ">": "$>$",
    "|": r"\textbar{}",
    "μ": r"$\mu$",
    "γ": r"$\gamma$",
    "²": "$^2$",
    "³": "$^3$",
    "×": r"$\times$",
    "°": r"$^\circ$",
    "†": r"$^\dagger$",
    "·": r"$\cdot$",
}
_LINE = dict.fromkeys((*range(0x20), *range(0x7F, 0xA0), 0x2028, 0x2029), " ")
"""Control characters, line ends among them, and Unicode's line and paragraph separators."""
_ESCAPED = {"md": str.maketrans({**_LINE, "|": "\\|"}), "tex": str.maketrans({**_LINE, **_TEX})}
_FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠")


class Cell(NamedTuple):
    """The text of a cell, and the number to rank it by where it has one."""

    text: str
    number: float | None = None


class Column(NamedTuple):
    """A column: its title and group, whether it holds numbers, and which number is best.

    `better` is "max", "min", "one" (nearest to 1), or "" for a column without ranks. Neighbouring columns
    with one title, such as "paper" and "here", differ in `part`.
    """

    title: str
    group: str = ""
    number: bool = False
    better: Better = ""
    part: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows of cells under columns, with a title, a caption and notes.

    Rows are ranked within classes: those with equal text in the column number `rank_within`; None for no ranks.
    Classes in `unranked` have none.
    """

    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    title: str = ""
    caption: str = ""
    notes: Sequence[str] = ()
    rank_within: int | None = None
    unranked: Sequence[str] = ()

    def places(self) -> dict[tuple[int, int], str]:
        """Return {(row, column): "best" or "second"} within each class."""
        if self.rank_within is None:
            return {}
        classes: dict[str, list[int]] = {}
        for i, row in enumerate(self.rows):
            if (name := row[self.rank_within].text) not in self.unranked:
                classes.setdefault(name, []).append(i)
        found: dict[tuple[int, int], str] = {}
        for k, column in enumerate(self.columns):
            for group in classes.values() if column.better else ():
                ranks = ranked([self.rows[i][k].number for i in group], column.better)
                found |= {(group[i], k): place for i, place in ranks.items()}
        return found

    def markdown(self) -> str:
        """Return the table as Markdown; the best of each class is bold, the second underlined."""
        marks = {"best": "**{}**", "second": "<u>{}</u>"}
        lines = [_markdown_row(escape(_title(c), "md") for c in self.columns)]
        lines.append("|" + "|".join("---:" if c.number else "---" for c in self.columns) + "|\n")
        lines += [_markdown_row(row) for row in self._marked(lambda text: escape(text, "md"), marks)]
        parts = [f"## {one_line(self.title)}\n"] * bool(self.title) + [f"{escape(self.caption, 'md')}\n"] * bool(
            self.caption
        )
        parts.append("".join(lines))
        parts += ["".join(f"- {escape(note, 'md')}\n" for note in self.notes)] * bool(self.notes)
        return "\n".join(parts)

    def html(self) -> str:
        """Return the table as HTML; `data-number` holds a cell's number, by which a page sorts."""
        marks = {"best": "<strong>{}</strong>", "second": "<u>{}</u>"}
        lines = []
        for row, texts in zip(self.rows, self._marked(_html, marks), strict=True):
            kinds = (
                _kind(column) + ("" if cell.number is None else f' data-number="{float(cell.number)!r}"')
                for column, cell in zip(self.columns, row, strict=True)
            )
            lines.append("<tr>" + "".join(f"<td{k}>{t}</td>" for k, t in zip(kinds, texts, strict=True)) + "</tr>\n")
        notes = "".join(f"<li>{html_prose(note)}</li>\n" for note in self.notes)
        return (
            (f"<h2>{_html(self.title)}</h2>\n" if self.title else "")
            + (f"<p>{html_prose(self.caption)}</p>\n" if self.caption else "")
            + f'<div class="wide"><table>\n<thead>{self._html_head()}</thead>\n<tbody>\n{"".join(lines)}</tbody>\n'
            + "</table></div>\n"
            + (f"<ul>\n{notes}</ul>\n" if notes else "")
        )

    def _html_head(self) -> str:
        """Return one line of heads, or two where columns have groups; `data-column` is a column's number."""
        grouped = any(column.group for column in self.columns)
        upper, lower = "", ""
        for group, members in itertools.groupby(enumerate(self.columns), lambda member: member[1].group):
            span = ' rowspan="2"' if grouped and not group else ""
            heads = [
                f'<th{_kind(c)}{span} scope="col" data-column="{k}">{_html(_title(c._replace(group="")))}</th>'
                for k, c in members
            ]
            if group:
                upper += f'<th class="group" scope="colgroup" colspan="{len(heads)}">{_html(group)}</th>'
                lower += "".join(heads)
            else:
                upper += "".join(heads)
        return f"<tr>{upper}</tr>" + (f"<tr>{lower}</tr>" if grouped else "")

    def csv(self) -> str:
        """Return the table as CSV; no cell is a formula to a spreadsheet."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(harmless(_title(c)) for c in self.columns)
        writer.writerows([_csv(cell.text) for cell in row] for row in self.rows)
        return out.getvalue()

    def latex(self, label: str = "", *, footnotes: bool = False) -> str:
        """Return a booktabs table; its notes are comments below it, or `footnotes` within it."""
        marks = {"best": r"\textbf{{{}}}", "second": r"\underline{{{}}}"}
        head = tex_spanning([(c.group, 1) for c in self.columns]) if any(c.group for c in self.columns) else []
        if any(c.part for c in self.columns):
            whole = itertools.groupby(self.columns, lambda c: (c.group, c.title if c.part else ""))
            head += tex_spanning([(title, len(list(of))) for (_, title), of in whole], merge=False)
        lines = [
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{tex_prose(self.caption or self.title)}}}",
            *([rf"\label{{{label}}}"] if label else []),
            rf"\begin{{tabular}}{{{''.join('r' if c.number else 'l' for c in self.columns)}}}",
            r"\toprule",
            *head,
            tex_row([tex_prose(c.part or c.title) for c in self.columns]),
            r"\midrule",
            *(tex_row(row) for row in self._marked(lambda text: escape(text, "tex"), marks)),
            r"\bottomrule",
            r"\end{tabular}",
            *(rf"\par\footnotesize {tex_prose(note)}" for note in self.notes if footnotes),
            r"\end{table}",
        ]
        return "\n".join(lines) + "\n" + "".join(tex_comment(note) for note in self.notes if not footnotes)

    def _marked(self, write: Callable[[str], str], marks: dict[str, str]) -> list[list[str]]:
        """Return the texts of all cells, escaped by `write`, the best and the second marked."""
        places = self.places()
        return [
            [
                marks[places[i, k]].format(write(cell.text)) if (i, k) in places else write(cell.text)
                for k, cell in enumerate(row)
            ]
            for i, row in enumerate(self.rows)
        ]


def simple(columns: Sequence[str], rows: Sequence[Sequence[Any]], *, numbers: Sequence[str] = (), **more: Any) -> Table:
    """Return a table of texts: `columns` are titles, `numbers` those of columns aligned to the right."""
    heads = [Column(title, number=title in numbers) for title in columns]
    return Table(columns=heads, rows=[[Cell(str(cell)) for cell in row] for row in rows], **more)


def ranked(numbers: Sequence[float | None], better: str) -> dict[int, str]:
    """Return {index: "best" or "second"}; equal numbers share a place, a lone number and NaN have none.

    `better` is "max", "min", "one" (nearest to 1), or "" for no ranking.
    """
    numbers = [None if n is None or math.isnan(n) else n for n in numbers]
    keys: dict[str, Callable[[float], float]] = {"max": lambda v: -v, "min": lambda v: v, "one": lambda v: abs(v - 1)}
    if better not in keys or sum(n is not None for n in numbers) < 2:
        return {}
    found = {i: keys[better](n) for i, n in enumerate(numbers) if n is not None}
    places = dict(zip(sorted(set(found.values())), ("best", "second"), strict=False))
    return {i: places[n] for i, n in found.items() if n in places}


def one_line(text: str) -> str:
    """Replace line ends and other control characters by spaces."""
    return text.translate(_LINE)


def escape(text: str, form: Literal["md", "tex"]) -> str:
    """Escape the markup of Markdown tables or LaTeX; the text becomes one line."""
    return text.translate(_ESCAPED[form])


def pictured(text: object) -> str:
    """Escape matplotlib's mathematics, so that it draws the text as it is."""
    return str(text).replace("$", r"\$")


def harmless(text: str) -> str:
    """Return a text as one line of CSV that no spreadsheet takes for a formula."""
    text = one_line(text)
    return f"'{text}" if text.lstrip().startswith(_FORMULA) else text


def html_prose(text: str) -> str:
    """Return prose as HTML; text in backquotes is code."""
    parts = _html(text).split("`")
    return "".join(f"<code>{part}</code>" if n % 2 else part for n, part in enumerate(parts))


def tex_comment(text: str) -> str:
    """Return a text as a LaTeX comment of one line."""
    return f"% {' '.join(one_line(text).split())}\n"


def tex_prose(text: str) -> str:
    """Escape prose for LaTeX: `--` stays two hyphens, text in backquotes is typewriter."""
    parts = ["-{}-".join(escape(piece, "tex") for piece in part.split("--")) for part in text.split("`")]
    return "".join(rf"\texttt{{{part}}}" if n % 2 else part for n, part in enumerate(parts))


def tex_row(cells: Sequence[str]) -> str:
    """Return a table's row of cells that are LaTeX already."""
    return " & ".join(cells) + r" \\"


def tex_spanning(titles: Sequence[tuple[str, int]], *, merge: bool = True) -> list[str]:
    """Return a head line of (title, number of columns), and the rules below the titles; "" has no rule.

    `merge` lets equal neighbours share one title.
    """
    if merge:
        grouped = itertools.groupby(titles, key=lambda t: t[0])
        titles = [(title, sum(n for _, n in group)) for title, group in grouped]
    cells, rules, first = [], "", 1
    for title, n in titles:
        cells += [rf"\multicolumn{{{n}}}{{c}}{{{tex_prose(title)}}}"] if title else [""] * n
        rules += rf"\cmidrule(lr){{{first}-{first + n - 1}}}" if title else ""
        first += n
    return [tex_row(cells), rules]


def _title(column: Column) -> str:
    title = f"{column.title}, {column.part}" if column.part else column.title
    return f"{column.group}: {title}" if column.group else title


def _html(text: str) -> str:
    return html.escape(one_line(text))


def _kind(column: Column) -> str:
    return ' class="num"' if column.number else ""


def _csv(text: str) -> str:
    """Return a cell of CSV; a negative number is no formula."""
    try:
        float(text)
    except ValueError:
        return harmless(text)
    return text.strip()


def _markdown_row(cells: Any) -> str:
    return "| " + " | ".join(cells) + " |\n"
