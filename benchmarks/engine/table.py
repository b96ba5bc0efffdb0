"""Tables: columns and cells, declared once, rendered as Markdown, LaTeX, HTML and CSV."""

import csv
import html
import io
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from ctsim.benchmarks.engine import latex
from ctsim.benchmarks.engine.texts import escape, harmless, one_line, ranked

Better = Literal["", "max", "min", "one"]


class Cell(NamedTuple):
    """The text of a cell, and the number to rank it by where it has one."""

    text: str
    number: float | None = None


class Column(NamedTuple):
    """A column: title, the group it stands in, whether it holds numbers, and which number is best.

    `better` is "max", "min", "one" (nearest to 1), or "" for a column without ranks. Neighbouring columns that are
    parts of one, such as "paper" and "here", have its title and a `part` each.
    """

    title: str
    group: str = ""
    number: bool = False
    better: Better = ""
    part: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Table:
    """Rows of cells under columns, with a title, a caption and notes.

    `rank_within` is the number of the column whose cells part the rows into classes that compete; None for no ranks.
    """

    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    title: str = ""
    caption: str = ""
    notes: Sequence[str] = ()
    rank_within: int | None = None

    def places(self) -> dict[tuple[int, int], str]:
        """Return {(row, column): "best" or "second"} within each class."""
        if self.rank_within is None:
            return {}
        classes: dict[str, list[int]] = {}
        for i, row in enumerate(self.rows):
            classes.setdefault(row[self.rank_within].text, []).append(i)
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
        """Return the table as HTML; a cell with a number has it in `data-number`, by which a page sorts."""
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
        """Return a line of heads, or two where columns stand in groups; each column's own has its number."""
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
        """Return columns and cells as CSV that no spreadsheet takes for formulas."""
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(harmless(_title(c)) for c in self.columns)
        writer.writerows([_csv(cell.text) for cell in row] for row in self.rows)
        return out.getvalue()

    def latex(self, label: str = "", *, footnotes: bool = False) -> str:
        """Return a table environment by booktabs, its notes as comments below it, or as `footnotes` within it."""
        marks = {"best": r"\textbf{{{}}}", "second": r"\underline{{{}}}"}
        groups = [(c.group, 1) for c in self.columns]
        head = latex.spanning(0, groups) if any(c.group for c in self.columns) else []
        if any(c.part for c in self.columns):
            whole = itertools.groupby(self.columns, lambda c: (c.group, c.title if c.part else ""))
            head += latex.spanning(0, [(title, len(list(of))) for (_, title), of in whole], merge=False)
        head.append(latex.row([latex.prose(c.part or c.title) for c in self.columns]))
        body = [latex.row(row) for row in self._marked(lambda text: escape(text, "tex"), marks)]
        columns = "".join("r" if c.number else "l" for c in self.columns)
        notes = [latex.prose(note) for note in self.notes if footnotes]
        text = latex.table(latex.prose(self.caption or self.title), columns, head, body, label=label, notes=notes)
        return text if footnotes else text + "".join(map(latex.comment, self.notes))

    def _marked(self, write: Callable[[str], str], marks: dict[str, str]) -> list[list[str]]:
        """Return the texts of all cells, written for a format, with the marks of the best and the second."""
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


def _title(column: Column) -> str:
    title = f"{column.title}, {column.part}" if column.part else column.title
    return f"{column.group}: {title}" if column.group else title


def _html(text: str) -> str:
    return html.escape(one_line(text))


def html_prose(text: str) -> str:
    """Return prose as HTML; what stands in backquotes is code."""
    parts = _html(text).split("`")
    return "".join(f"<code>{part}</code>" if n % 2 else part for n, part in enumerate(parts))


def _kind(column: Column) -> str:
    return ' class="num"' if column.number else ""


def _csv(text: str) -> str:
    """Return a cell of CSV; a number below zero is no formula."""
    try:
        float(text)
    except ValueError:
        return harmless(text)
    return text.strip()


def _markdown_row(cells: Any) -> str:
    return "| " + " | ".join(cells) + " |\n"
