"""The tables of `run-benchmark pareto`: fronts, where the defaults lie, and every point."""

from collections.abc import Iterable, Iterator, Sequence

from ctsim.benchmarks.engine.record import Record
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.studies.pareto.finding import (
    LOWER,
    NEAR,
    Part,
    Point,
    TimedRun,
    enough,
    faster,
    front,
    groups,
    knee,
    parted,
    points,
    recommended,
    rivals,
)

HEADS: dict[Part, dict[str, str]] = {
    "simulator": {"rms": "relative RMS of P", "worst": "worst |ΔP|", "off_edges": "worst |ΔP| off the edges"},
    "methods": {"rmse": "RMSE (1/mm)", "psnr3d": "PSNR3D (dB)", "aligned": "aligned (dB)"},
}
FORMS = {"rmse": ".3e", "psnr3d": ".2f", "aligned": ".2f"}  # of values; else .1e
ABOUT: dict[Part, str] = {
    "simulator": "P = −ln(signal/open) without noise, against up to 2¹⁴ exact rays a pixel and the whole spectrum",
    "methods": "protocol `tissue`: effective spectrum, inside the body dilated by 4, outside the metal dilated by 2",
}
NUMBERS = ("s", "slowest", *(name for heads in HEADS.values() for name in heads.values()))


def summary(records: Sequence[Record[TimedRun]]) -> list[Table]:
    """Return the front and the curves of each group, and what failed or was skipped."""
    tables = [table for group in groups(points(records)) for table in (_front(group), _curves(group))]
    bad = [(r.task.settings["curve"], r.task.settings["label"], r.found[0]) for r in records if not r.finished]
    rows = [(curve, label, run.status, run.reason) for curve, label, run in bad]
    return tables + [simple(("not measured", "setting", "status", "reason"), rows)] * bool(rows)


def every_point(records: Sequence[Record[TimedRun]]) -> list[Table]:
    """Return a table of all points of each group, each with the errors in which it is on its group's front."""
    tables = []
    for group in groups(points(records)):
        heads = _heads(group)
        fronts = {heads[error]: front(group, error) for error in LOWER[group[0].part]}
        rows = [
            (
                *(p.curve, _named(p), _s(p), f"{max(p.seconds):.3g}", *_values(p, heads)),
                ", ".join(head for head, on in fronts.items() if p in on),
            )
            for p in group
        ]
        columns = ("curve", "setting", "s", "slowest", *heads.values(), "on the front in")
        tables.append(simple(columns, rows, numbers=NUMBERS, title=f"{_title(group)}: every point"))
    return tables


def _title(group: Sequence[Point]) -> str:
    task = group[0].task
    where = f" ({task.data})" if task.part == "simulator" else ""
    return f"{task.part}, {task.case}: {group[0].group}{where}"


def _heads(group: Sequence[Point]) -> dict[str, str]:
    """Return the titles of the values, without those of a protocol that was not asked for."""
    scored = {name for p in group for name in p.values}
    return {name: head for name, head in HEADS[group[0].part].items() if name != "aligned" or name in scored}


def _front(group: Sequence[Point]) -> Table:
    """Return the table of the group's front in its main error; what is recommended and the defaults stand below."""
    part, heads, corner = group[0].part, _heads(group), knee(group)
    rounds = sorted({len(p.seconds) for p in group})
    of = "–".join(map(str, dict.fromkeys((rounds[0], rounds[-1]))))
    seconds = f"medians of {of} interleaved runs" if rounds[-1] > 1 else "those of one run"
    return simple(
        ("curve", "setting", "s", *heads.values(), ""),
        [(p.curve, _named(p), _s(p), *_values(p, heads), "knee" if p is corner else "") for p in front(group)],
        numbers=NUMBERS,
        title=_title(group),
        caption=f"On {group[0].task.machine}. Seconds are {seconds}. Error: {ABOUT[part]}. "
        f"The front, in {heads[LOWER[part][0]]}:",
        notes=[f"Recommended: {_short(recommended(group))}.", *(_defaults(group) if len(LOWER[part]) > 1 else ())],
    )


def _defaults(group: Sequence[Point]) -> Iterator[str]:
    """Yield a line for every default: on the front, or what beats it, in an error alone and in all at once."""
    part = group[0].part
    errors = LOWER[part]
    for p in (p for p in group if p.default):
        alone, joint = (_verdict(group, p, of) for of in (errors[:1], errors))
        yield f"Default {_short(p)}: in {HEADS[part][errors[0]]} {alone}; in all errors at once {joint}."


def _verdict(group: Sequence[Point], p: Point, errors: Sequence[str]) -> str:
    better = rivals(group, p, errors)
    if not better:
        return "on the front"
    # faster beyond the spread of the rounds, or with an error that is far less
    clear = [q for q in better if faster(q.seconds, p.seconds) or any(_far(q, p, error) for error in errors)]
    best = min(clear or better, key=lambda q: q.pair)
    where = "off the front" if clear else "on the front within the spread of the rounds"
    less = [f"{best.values[e] / p.values[e]:.2f} of the {HEADS[p.part][e]}" for e in errors if _far(best, p, e)]
    return f"{where} ({_short(best)} has {' and '.join([f'{best.pair[0] / p.pair[0]:.2f} of the time', *less])})"


def _far(q: Point, p: Point, error: str) -> bool:
    """Whether an error of `q` is less than that of `p` by more than hardly matters."""
    return q.values[error] * (1 + NEAR) < p.values[error]


def _curves(group: Sequence[Point]) -> Table:
    """Return the table of each curve's default, its knee, and what is near its least error."""
    name = HEADS[group[0].part][LOWER[group[0].part][0]]
    rows = []
    for curve, mine in parted(group, lambda p: p.curve).items():
        default = next((p for p in mine if p.default), None)
        rows.append((curve, *_cells(default), _rival(group, default), *_cells(knee(mine)), *_cells(enough(mine))))
    near = f"within {NEAR:.0%} of its least error"
    columns = ("curve", "default", "s", name, "beaten by", "knee", "s", name, near, "s", name)
    return simple(columns, rows, numbers=NUMBERS)


def _rival(group: Sequence[Point], p: Point | None) -> str:
    """Say which point beats one at the least time."""
    better = [] if p is None else rivals(group, p, LOWER[p.part][:1])
    if p is None or not better:
        return "–"
    best = min(better, key=lambda q: q.pair)
    return f"{_short(best)}, in {best.pair[0] / p.pair[0]:.2f} of the time"


def _cells(p: Point | None) -> tuple[str, str, str]:
    return ("–", "–", "–") if p is None else (p.label, _s(p), f"{p.pair[1]:.2e}")


def _named(p: Point) -> str:
    return f"{p.label} (default)" if p.default else p.label


def _short(p: Point) -> str:
    return f"{p.curve}, {p.label}"


def _s(p: Point) -> str:
    return f"{p.pair[0]:.3g}"


def _values(p: Point, names: Iterable[str]) -> list[str]:
    return [f"{p.values[name]:{FORMS.get(name, '.1e')}}" if name in p.values else "–" for name in names]
