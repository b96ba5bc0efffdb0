"""The paper's tables as data: their layout, the paper's own figures, and what is run here for each cell.

`tables.toml` holds them. A table is printed with a pair of columns, "paper" and "here", for each
of the paper's, as Markdown or as LaTeX (booktabs).
"""

import re
import shlex
from dataclasses import dataclass, replace
from importlib import resources
from typing import Any, Literal

import msgspec

from ctsim.benchmarks.engine import latex
from ctsim.benchmarks.engine.texts import escape, ranked
from ctsim.benchmarks.methods import Method
from ctsim.benchmarks.scores.columns import COLUMNS, Metric
from ctsim.benchmarks.studies.paper.scenes import title
from ctsim.errors import InputError

Form = Literal["md", "tex"]
SIDES = ("paper", "here")
NONE = "–"
MARKS: dict[Form, dict[str, str]] = {
    "md": {"best": "**{}**", "second": "<u>{}</u>", "": "{}"},
    "tex": {"best": r"\textbf{{{}}}", "second": r"\underline{{{}}}", "": "{}"},
}
_TIME = re.compile(r"(?:(\d+)h )?(?:(\d+)m )?(\d+)s")


class What(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a table, a column or a row says of its runs."""

    suite: str = ""
    scene: str = ""
    method: str = ""
    set: dict[str, Any] = {}


class Heading(What, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A column of the paper; columns of one `group` stand under a common title."""

    title: str
    metric: Literal["psnr3d", "ssim3d", "wall"]
    group: str = ""

    @property
    def column(self) -> Metric:
        """How its metric is shown."""
        return COLUMNS["cost" if self.metric == "wall" else "paper"][self.metric]


class Row(What, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A row: what stands in its first columns, and the paper's figures as printed, "" or nothing where it has none."""

    stubs: tuple[str, ...]
    figures: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Planned:
    """What is run for a cell."""

    suite: str
    scene: str
    method: str
    params: dict[str, Any]

    @property
    def place(self) -> str:
        """The scene as tables call it."""
        return title((self.suite, self.scene))

    @property
    def label(self) -> str:
        """The label that its records have."""
        return Method(name=self.method, target="", inputs="", params={}, overrides=self.params).label

    @property
    def flags(self) -> str:
        """The flags of `run-benchmark` that run it."""
        texts = {k: v if isinstance(v, str) else msgspec.json.encode(v).decode() for k, v in self.params.items()}
        settings = [shlex.quote(f"{self.method}.{k}={v}") for k, v in sorted(texts.items())]
        return " --set ".join([f"--method {self.method}", *settings])


class Table(What, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One of the paper's tables; `rank` says which cells compete, see the file.

    Raises InputError where a row has more or fewer cells than the table, or a cell has no suite, scene or method.
    """

    number: int
    label: str
    title: str
    stubs: tuple[str, ...]
    columns: tuple[Heading, ...]
    rows: tuple[Row, ...]
    rank: Literal["down", "across", ""] = ""
    note: str = ""

    def __post_init__(self) -> None:
        for row in self.rows:
            where = f"table {self.number}, row {' '.join(row.stubs)}"
            if len(row.stubs) != len(self.stubs) or len(row.figures) not in (0, len(self.columns)):
                raise InputError(
                    f"{where}: expected {len(self.stubs)} stubs and {len(self.columns)} figures or none, "
                    f"got {len(row.stubs)} and {len(row.figures)}"
                )
            for column in self.columns:
                planned = self.planned(row, column)
                if not (planned.suite and planned.scene and planned.method):
                    raise InputError(f"{where}, column {column.title}: expected suite, scene and method")

    def planned(self, row: Row, column: Heading) -> Planned:
        """Return what is run for a cell."""
        return Planned(
            suite=row.suite or column.suite or self.suite,
            scene=row.scene or column.scene or self.scene,
            method=row.method or column.method or self.method,
            params={**self.set, **column.set, **row.set},
        )

    def plan(self) -> list[list[Planned]]:
        """Return what is run for each cell [row][column]."""
        return [[self.planned(row, column) for column in self.columns] for row in self.rows]

    def printed(self, k: int) -> list[str]:
        """Return the paper's figures in column `k`."""
        return [row.figures[k] for row in self.rows if row.figures and row.figures[k]]

    def digits(self, k: int) -> int:
        """Return the decimals of column `k`: as many as the paper prints, in a column of ours the metric's own."""
        return max((len(text.partition(".")[2]) for text in self.printed(k)), default=self.columns[k].column.digits)

    def sides(self, k: int) -> tuple[str, ...]:
        """Return under which titles column `k` is printed."""
        return SIDES if self.printed(k) else SIDES[1:]


class Paper(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The paper and its tables."""

    source: str
    table: tuple[Table, ...]


def load() -> Paper:
    """Read the bundled file."""
    text = (resources.files("ctsim.benchmarks.studies.paper") / "tables.toml").read_text(encoding="utf-8")
    return msgspec.toml.decode(text, type=Paper)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """A cell: the number to rank by, if it has one, its text, and its place, "best", "second" or ""."""

    number: float | None = None
    text: str = NONE
    place: str = ""


def printed(text: str) -> Cell:
    """Return a figure of the paper as a cell; a time is ranked by its seconds."""
    if not text:
        return Cell()
    return Cell(number=seconds(text) if text.endswith("s") else float(text), text=text)


def seconds(text: str) -> float:
    """Return the seconds of a time such as "1h 35m 58s"."""
    found = _TIME.fullmatch(text)
    if found is None:
        raise InputError(f"a time must be like '1h 35m 58s', got {text!r}")
    h, m, s = (int(part or 0) for part in found.groups())
    return float(3600 * h + 60 * m + s)


def duration(s: float) -> str:
    """Write seconds as the paper does, below ten of them with a tenth."""
    if s < 9.95:
        return f"{s:.1f}s"
    minutes, rest = divmod(round(s), 60)
    hours, minutes = divmod(minutes, 60)
    if hours:
        return f"{hours}h {minutes:02d}m {rest:02d}s"
    return f"{minutes}m {rest:02d}s" if minutes else f"{rest}s"


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheet:
    """A table that is filled: for each side ("paper", "here") the cells [row][column]; and what stands around it."""

    table: Table
    caption: str
    cells: dict[str, list[list[Cell]]]
    notes: list[str]

    def ranked(self) -> "Sheet":
        """Return the sheet with the best and the second of each side marked."""
        return replace(self, cells={side: _ranked(self.table, grid) for side, grid in self.cells.items()})


def _ranked(table: Table, grid: list[list[Cell]]) -> list[list[Cell]]:
    """Mark the best and the second among the cells that compete, which those of different scenes never do."""
    groups: dict[tuple[Any, ...], list[tuple[int, int]]] = {}
    for i, row in enumerate(table.rows if table.rank else ()):
        for k, column in enumerate(table.columns):
            key = (column.metric, table.planned(row, column).place, i if table.rank == "across" else k)
            groups.setdefault(key, []).append((i, k))
    out = [list(row) for row in grid]
    for group in groups.values():
        better = table.columns[group[0][1]].column.better
        for n, place in ranked([grid[i][k].number for i, k in group], better).items():
            i, k = group[n]
            out[i][k] = replace(grid[i][k], place=place)
    return out


def render(sheet: Sheet, form: Form) -> str:
    """Render a filled table."""
    sides = [sheet.table.sides(k) for k in range(len(sheet.table.columns))]
    body = [
        [escape(stub, form) if form == "md" else latex.prose(stub) for stub in row.stubs]
        + [_text(sheet.cells[side][i][k], form) for k in range(len(sides)) for side in sides[k]]
        for i, row in enumerate(sheet.table.rows)
    ]
    return _markdown(sheet, body) if form == "md" else _latex(sheet, body)


def _text(cell: Cell, form: Form) -> str:
    return MARKS[form][cell.place].format(escape(cell.text, form))


def _markdown(sheet: Sheet, body: list[list[str]]) -> str:
    table = sheet.table
    titles = [f"{c.group}: {c.title}" if c.group else c.title for c in table.columns]
    heads = [*table.stubs, *(f"{title}, {side}" for k, title in enumerate(titles) for side in table.sides(k))]
    rule = "|" + "---|" * len(table.stubs) + "---:|" * (len(heads) - len(table.stubs))
    lines = ["| " + " | ".join(escape(t, "md") for t in heads) + " |", rule]
    lines += ["| " + " | ".join(line) + " |" for line in body]
    notes = "".join(f"- {note}\n" for note in sheet.notes)
    title = f"## Table {table.number}. {table.title}"
    return f"{title}\n\n{sheet.caption}\n\n" + "\n".join(lines) + "\n" + (f"\n{notes}" if notes else "")


def _latex(sheet: Sheet, body: list[list[str]]) -> str:
    table, n_stubs = sheet.table, len(sheet.table.stubs)
    head: list[str] = []
    sides = [table.sides(k) for k in range(len(table.columns))]
    if any(column.group for column in table.columns):
        head += latex.spanning(n_stubs, [(c.group, len(s)) for c, s in zip(table.columns, sides, strict=True)])
    head += latex.spanning(n_stubs, [(c.title, len(s)) for c, s in zip(table.columns, sides, strict=True)], merge=False)
    head.append(latex.row([*(latex.prose(stub) for stub in table.stubs), *(side for pair in sides for side in pair)]))
    return latex.table(
        latex.prose(f"{table.title}. {sheet.caption}"),
        "l" * n_stubs + "r" * sum(map(len, sides)),
        head,
        [latex.row(line) for line in body],
        label=f"tab:paper-{table.number}",
        notes=[latex.prose(note) for note in sheet.notes],
    )
