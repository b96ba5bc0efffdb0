"""The paper's tables as data: their layout, the paper's own figures, and what is run here for each cell.

`tables.toml` holds them.
"""

import re
import shlex
from dataclasses import dataclass
from importlib import resources
from typing import Any, Literal

import msgspec

from ctsim.benchmarks.engine.table import Cell
from ctsim.benchmarks.methods import Method
from ctsim.benchmarks.scores.score import COLUMNS, Metric
from ctsim.errors import InputError

NONE = Cell("–")
_TIME = re.compile(r"(?:(\d+)h )?(?:(\d+)m )?(\d+)s")


class What(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The keys of a table, a column or a row about its runs."""

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
    def shown(self) -> Metric:
        """How its metric is shown."""
        return COLUMNS["cost" if self.metric == "wall" else "paper"][self.metric]


class PaperRow(What, frozen=True, kw_only=True, forbid_unknown_fields=True):
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
        return f"{self.suite}/{self.scene}"

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


class PaperTable(What, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One of the paper's tables; `rank` says which cells compete, see the file.

    Raises InputError where a row has more or fewer cells than the table, or a cell has no suite, scene or method.
    """

    number: int
    label: str
    title: str
    stubs: tuple[str, ...]
    columns: tuple[Heading, ...]
    rows: tuple[PaperRow, ...]
    rank: Literal["down", "across", ""] = ""
    note: str = ""

    def __post_init__(self) -> None:
        for row, planned in zip(self.rows, self.plan(), strict=True):
            where = f"table {self.number}, row {' '.join(row.stubs)}"
            if len(row.stubs) != len(self.stubs) or len(row.figures) not in (0, len(self.columns)):
                raise InputError(
                    f"{where}: expected {len(self.stubs)} stubs and {len(self.columns)} figures or none, "
                    f"got {len(row.stubs)} and {len(row.figures)}"
                )
            for column, cell in zip(self.columns, planned, strict=True):
                if not (cell.suite and cell.scene and cell.method):
                    raise InputError(f"{where}, column {column.title}: expected suite, scene and method")

    def plan(self) -> list[list[Planned]]:
        """Return what is run for each cell [row][column]."""
        return [
            [
                Planned(
                    suite=row.suite or column.suite or self.suite,
                    scene=row.scene or column.scene or self.scene,
                    method=row.method or column.method or self.method,
                    params={**self.set, **column.set, **row.set},
                )
                for column in self.columns
            ]
            for row in self.rows
        ]

    def published(self, k: int) -> list[str]:
        """Return the paper's figures in column `k`; none in a column that is ours alone."""
        return [row.figures[k] for row in self.rows if row.figures and row.figures[k]]

    def digits(self, k: int) -> int:
        """Return the decimals of column `k`: as many as the paper prints, in a column of ours the metric's own."""
        return max((len(text.partition(".")[2]) for text in self.published(k)), default=self.columns[k].shown.digits)


class Paper(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The paper and its tables."""

    source: str
    table: tuple[PaperTable, ...]


def load() -> Paper:
    """Read the bundled file."""
    text = (resources.files("ctsim.benchmarks.studies.paper") / "tables.toml").read_text(encoding="utf-8")
    return msgspec.toml.decode(text, type=Paper)


def printed(text: str) -> Cell:
    """Return a figure of the paper as a cell; a time is ranked by its seconds."""
    if not text:
        return NONE
    return Cell(text, seconds(text) if text.endswith("s") else float(text))


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
