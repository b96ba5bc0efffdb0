"""Tables of `run-benchmark pareto`: the fronts, the knees, where the defaults lie, and every point."""

from collections.abc import Iterator, Sequence

from ctsim.benchmarks.engine.record import Record
from ctsim.benchmarks.engine.table import Table, simple
from ctsim.benchmarks.studies.pareto.finding import (
    LOWER,
    NEAR,
    Part,
    Point,
    Run,
    at_knee,
    curves,
    enough,
    groups,
    points,
    recommended,
)
from ctsim.benchmarks.studies.pareto.front import beaten_by, faster, front

HEADS: dict[Part, dict[str, str]] = {
    "simulator": {"rms": "relative RMS of P", "worst": "worst |ΔP|", "off_edges": "worst |ΔP| off the edges"},
    "methods": {"rmse": "RMSE (1/mm)", "psnr3d": "PSNR3D (dB)"},
}
ABOUT: dict[Part, str] = {
    "simulator": "P = −ln(signal/open) without noise, against up to 2¹⁴ exact rays a pixel and the whole spectrum",
    "methods": "protocol `tissue`: effective spectrum, inside the body dilated by 4, outside the metal dilated by 2",
}
NUMBERS = ("s", "slowest", *(name for heads in HEADS.values() for name in heads.values()))


def summary(records: Sequence[Record[Run]]) -> list[Table]:
    """Return the front and the curves of each group, and what failed or was skipped."""
    tables = [table for group in groups(points(records)) for table in (_front(group), _curves(group))]
    bad = [(r.task.settings["curve"], r.task.settings["label"], r.found[0]) for r in records if not r.finished]
    rows = [(curve, label, run.status, run.reason) for curve, label, run in bad]
    return tables + [simple(("not measured", "setting", "status", "reason"), rows)] * bool(rows)


def every_point(records: Sequence[Record[Run]]) -> list[Table]:
    """Return a table of all points of each group, each with the errors in which it is on its group's front."""
    tables = []
    for group in groups(points(records)):
        heads = HEADS[group[0].part]
        on = {heads[key]: front([(p.pair[0], p.values[key]) for p in group]) for key in LOWER[group[0].part]}
        best = [", ".join(head for head, those in on.items() if k in those) for k in range(len(group))]
        rows = [
            (p.curve, _named(p), _s(p), f"{max(p.seconds):.3g}", *_values(p), where)
            for p, where in zip(group, best, strict=True)
        ]
        columns = ("curve", "setting", "s", "slowest", *heads.values(), "on the front in")
        tables.append(simple(columns, rows, numbers=NUMBERS, title=f"{_title(group)}: every point"))
    return tables


def _title(group: Sequence[Point]) -> str:
    task = group[0].task
    where = f" ({task.data})" if task.part == "simulator" else ""
    return f"{task.part}, {task.case}: {group[0].group}{where}"


def _front(group: Sequence[Point]) -> Table:
    """Return the table of the group's front in its main error; what is recommended and the defaults stand below."""
    part, corner, rounds = group[0].part, at_knee(group), sorted({len(p.seconds) for p in group})
    of = "–".join(map(str, dict.fromkeys((rounds[0], rounds[-1]))))
    seconds = f"medians of {of} interleaved runs" if rounds[-1] > 1 else "those of one run"
    rows = [
        (p.curve, _named(p), _s(p), *_values(p), "knee" if p is corner else "")
        for p in (group[k] for k in front([p.pair for p in group]))
    ]
    return simple(
        ("curve", "setting", "s", *HEADS[part].values(), ""),
        rows,
        numbers=NUMBERS,
        title=_title(group),
        caption=f"On {group[0].task.machine}. Seconds are {seconds}. Error: {ABOUT[part]}. "
        f"The front, in {HEADS[part][LOWER[part][0]]}:",
        notes=[f"Recommended: {_short(recommended(group))}.", *(_defaults(group) if len(LOWER[part]) > 1 else ())],
    )


def _defaults(group: Sequence[Point]) -> Iterator[str]:
    """Yield a line for every default: on the front, or what beats it, in an error alone and in all at once."""
    part = group[0].part
    keys = LOWER[part]
    for p in group:
        if p.default:
            alone, joint = (_verdict(group, p, of) for of in (keys[:1], keys))
            yield f"Default {_short(p)}: in {HEADS[part][keys[0]]} {alone}; in all errors at once {joint}."


def _verdict(group: Sequence[Point], p: Point, keys: Sequence[str]) -> str:
    better = [q for q in group if q is not p and _beats(q, p, keys)]
    if not better:
        return "on the front"
    clear = [q for q in better if _clearly(q, p, keys)]
    best = min(clear or better, key=lambda q: q.pair)
    where = "off the front" if clear else "on the front within the spread of the rounds"
    heads = HEADS[p.part]
    less = [f"{best.values[k] / p.values[k]:.2f} of the {heads[k]}" for k in keys if _far(best.values[k], p.values[k])]
    return f"{where} ({_short(best)} has {' and '.join([f'{best.pair[0] / p.pair[0]:.2f} of the time', *less])})"


def _beats(q: Point, p: Point, keys: Sequence[str]) -> bool:
    """Whether `q` is no slower than `p` and no worse in any error, and better in one of these."""
    pairs = [(q.pair[0], p.pair[0]), *((q.values[key], p.values[key]) for key in keys)]
    return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def _clearly(q: Point, p: Point, keys: Sequence[str]) -> bool:
    """Whether `q`, which beats `p`, is faster beyond the spread of their rounds, or has an error that is far less."""
    return faster(q.seconds, p.seconds) or any(_far(q.values[key], p.values[key]) for key in keys)


def _far(less: float, error: float) -> bool:
    return less * (1 + NEAR) < error


def _curves(group: Sequence[Point]) -> Table:
    """Return the table of each curve's default, its knee, and what is near its least error."""
    name = HEADS[group[0].part][LOWER[group[0].part][0]]
    rows = []
    for curve, mine in curves(group).items():
        default = next((p for p in mine if p.default), None)
        rival = "–" if default is None else _rival(group, default)
        rows.append((curve, *_cells(default), rival, *_cells(at_knee(mine)), *_cells(enough(mine))))
    near = f"within {NEAR:.0%} of its least error"
    columns = ("curve", "default", "s", name, "beaten by", "knee", "s", name, near, "s", name)
    return simple(columns, rows, numbers=NUMBERS)


def _rival(group: Sequence[Point], p: Point) -> str:
    best, share = beaten_by([q.pair for q in group], group.index(p))
    return "–" if group[best] is p else f"{_short(group[best])}, in {share:.2f} of the time"


def _cells(p: Point | None) -> tuple[str, str, str]:
    return ("–", "–", "–") if p is None else (p.label, _s(p), f"{p.pair[1]:.2e}")


def _named(p: Point) -> str:
    return f"{p.label} (default)" if p.default else p.label


def _short(p: Point) -> str:
    return f"{p.curve}, {p.label}"


def _s(p: Point) -> str:
    return f"{p.pair[0]:.3g}"


def _values(p: Point) -> list[str]:
    shown = {"psnr3d": "{:.2f}", "rmse": "{:.3e}"}
    values = ((key, p.values.get(key)) for key in HEADS[p.part])
    return ["–" if v is None else shown.get(key, "{:.1e}").format(v) for key, v in values]
