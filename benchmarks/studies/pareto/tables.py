"""What `run-benchmark pareto` found, as Markdown: the front, the knees, where the defaults lie, and every point."""

from collections.abc import Iterator, Sequence

from ctsim.benchmarks.studies.pareto.front import beaten_by, faster, front
from ctsim.benchmarks.studies.pareto.records import (
    ERROR,
    NEAR,
    Part,
    Point,
    Timed,
    at_knee,
    enough,
    failures,
    points,
    recommended,
)

HEADS: dict[Part, dict[str, str]] = {
    "simulator": {
        "rms": "relative RMS of P",
        "worst": "worst |ΔP|",
        "off_edges": "worst |ΔP| off the edges",
    },
    "methods": {"rmse": "RMSE (1/mm)", "psnr3d": "PSNR3D (dB)"},
}
LOWER: dict[Part, tuple[str, ...]] = {"simulator": ("rms", "worst", "off_edges"), "methods": ("rmse",)}
"""The values that fronts can be drawn in: smaller is better."""
ABOUT: dict[Part, str] = {
    "simulator": "P = −ln(signal/open) without noise, against up to 2¹⁴ exact rays a pixel and the whole spectrum",
    "methods": "protocol `tissue`: effective spectrum, inside the body dilated by 4, outside the metal dilated by 2",
}


def summary(found: Sequence[Timed]) -> str:
    """Render the fronts, the defaults and each curve's knee; what failed or was skipped stands below."""
    out: list[str] = []
    about = ""
    for group in groups(points(found)):
        part, scene = group[0].setting.part, group[0].setting.scene
        mine = [t for t in found if (t.setting.part, t.setting.scene) == (part, scene)]
        if (head := f"{_provenance(mine)} Error of {part}: {ABOUT[part]}.") != about:
            out += [head, ""]
            about = head
        defaults = [*_defaults(group), ""] if len(LOWER[part]) > 1 else []
        out += [*_front(group), "", *defaults, *_curves(group), ""]
    bad = failures(found)
    if bad:
        out += ["| not measured | setting | status | reason |", "|---|---|---|---|"]
        out += [_row(t.setting.curve, t.setting.label, t.status, t.reason) for t in bad]
    return "\n".join(out).rstrip() + "\n"


def every_point(found: Sequence[Timed]) -> str:
    """Render all points, each with the errors in which it is on its group's front."""
    out: list[str] = []
    for group in groups(points(found)):
        part = group[0].setting.part
        out += ["", f"### {_title(group)}: every point", ""]
        out += _head("curve", "setting", "s", "slowest", *HEADS[part].values(), "on the front in")
        out += [
            _row(p.setting.curve, _named(p), _s(p), f"{max(p.seconds):.3g}", *_values(p), on)
            for p, on in zip(group, _fronts(group), strict=True)
        ]
    return "\n".join(out) + "\n"


def groups(every: Sequence[Point]) -> list[list[Point]]:
    """Part the points into those that may be compared: one part, scene and group."""
    held: dict[tuple[str, str, str], list[Point]] = {}
    for p in every:
        held.setdefault((p.setting.part, p.setting.scene, p.setting.group), []).append(p)
    return list(held.values())


def curves(group: Sequence[Point]) -> dict[str, list[Point]]:
    """Part a group's points by method or kind of choice."""
    return {c: [p for p in group if p.setting.curve == c] for c in dict.fromkeys(p.setting.curve for p in group)}


def _title(group: Sequence[Point]) -> str:
    setting = group[0].setting
    where = f" ({setting.data})" if setting.part == "simulator" else ""
    return f"{setting.part}, {setting.scene}: {setting.group}{where}"


def _front(group: Sequence[Point]) -> Iterator[str]:
    """Yield the table of the group's front in its main error, and what is recommended."""
    part, corner = group[0].setting.part, at_knee(group)
    yield f"### {_title(group)}"
    yield ""
    yield f"The front, in {HEADS[part][ERROR[part]]}:"
    yield ""
    yield from _head("curve", "setting", "s", *HEADS[part].values(), "")
    for k in front([p.pair for p in group]):
        p = group[k]
        yield _row(p.setting.curve, _named(p), _s(p), *_values(p), "knee" if p is corner else "")
    yield ""
    yield f"Recommended: {_short(recommended(group))}."


def _defaults(group: Sequence[Point]) -> Iterator[str]:
    """Yield a line for every default: on the front, or what beats it, in an error alone and in all at once."""
    part = group[0].setting.part
    keys = LOWER[part]
    for p in group:
        if p.default:
            alone, joint = (_verdict(group, p, of) for of in (keys[:1], keys))
            yield f"- Default {_short(p)}: in {HEADS[part][keys[0]]} {alone}; in all errors at once {joint}."


def _verdict(group: Sequence[Point], p: Point, keys: Sequence[str]) -> str:
    better = [q for q in group if q is not p and _beats(q, p, keys)]
    if not better:
        return "on the front"
    clear = [q for q in better if _clearly(q, p, keys)]
    best = min(clear or better, key=lambda q: q.pair)
    where = "off the front" if clear else "on the front within the spread of the rounds"
    heads = HEADS[p.setting.part]
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


def _curves(group: Sequence[Point]) -> Iterator[str]:
    """Yield the table of each curve's default, its knee, and what is near its least error."""
    part = group[0].setting.part
    name, near = HEADS[part][ERROR[part]], f"within {NEAR:.0%} of its least error"
    yield from _head("curve", "default", "s", name, "beaten by", "knee", "s", name, near, "s", name)
    for curve, mine in curves(group).items():
        default = next((p for p in mine if p.default), None)
        rival = "–" if default is None else _rival(group, default)
        yield _row(curve, *_cells(default), rival, *_cells(at_knee(mine)), *_cells(enough(mine)))


def _rival(group: Sequence[Point], p: Point) -> str:
    best, share = beaten_by([q.pair for q in group], group.index(p))
    return "–" if group[best] is p else f"{_short(group[best])}, in {share:.2f} of the time"


def _cells(p: Point | None) -> tuple[str, str, str]:
    return ("–", "–", "–") if p is None else (p.label, _s(p), f"{p.pair[1]:.2e}")


def _fronts(group: Sequence[Point]) -> list[str]:
    """Return for each point the names of the errors in which it is on the front."""
    keys = LOWER[group[0].setting.part]
    on = {key: set(front(_pairs(group, key))) for key in keys}
    return [", ".join(HEADS[p.setting.part][key] for key in keys if k in on[key]) for k, p in enumerate(group)]


def _pairs(group: Sequence[Point], key: str) -> list[tuple[float, float]]:
    return [(p.pair[0], p.values[key]) for p in group]


def _named(p: Point) -> str:
    return f"{p.label} (default)" if p.default else p.label


def _short(p: Point) -> str:
    return f"{p.setting.curve}, {p.label}"


def _s(p: Point) -> str:
    return f"{p.pair[0]:.3g}"


def _values(p: Point) -> list[str]:
    shown = {"psnr3d": "{:.2f}", "rmse": "{:.3e}"}
    values = ((key, p.values.get(key)) for key in HEADS[p.setting.part])
    return ["–" if v is None else shown.get(key, "{:.1e}").format(v) for key, v in values]


def _head(*names: str) -> list[str]:
    right = {"s", "slowest", *(name for heads in HEADS.values() for name in heads.values())}
    return [_row(*names), "|" + "|".join("--:" if name in right else "---" for name in names) + "|"]


def _row(*cells: str) -> str:
    return "| " + " | ".join(cell.replace("|ΔP|", "\\|ΔP\\|") for cell in cells) + " |"


def _provenance(found: Sequence[Timed]) -> str:
    last = found[-1]
    h, changed = last.host, "+changes" if last.commit.endswith("+changes") else ""
    counts = sorted({len(p.seconds) for p in points(found)})
    of = "–".join(map(str, dict.fromkeys((*counts[:1], *counts[-1:]))))
    threads = f"{h.threads} thread{'s' * (h.threads > 1)}"
    return (
        f"{last.time}, commit {last.commit[:12]}{changed}, {h.cpu}, {h.cores} cores, {threads}, Python {h.python}, "
        f"numba {h.versions.get('numba', '?')}. Seconds are "
        + (f"medians of {of} interleaved runs." if counts[-1:] > [1] else "those of one run.")
    )
