"""The numbers of records: mean and spread over the noise seeds of every metric, as all tables show them.

Nothing is computed anew. They are made once for all tables of a command; pandas is loaded for `summary` alone. A large
table has a million of them: they are plain tuples, which the collector of garbage need not follow.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from ctsim.benchmarks.engine.texts import harmless
from ctsim.benchmarks.scores.columns import COLUMNS
from ctsim.benchmarks.scores.compare import COMPARED, Row, derived
from ctsim.benchmarks.studies.methods.records import RunRecord, latest

if TYPE_CHECKING:
    import pandas as pd

Key = tuple[str, str, str, str, str, str]
"""Scene, variant, method, inputs, protocol and metric; a run without any number has protocol and metric ""."""

Number = tuple[float | None, float | None, int, str, str, bool]
"""Mean, std (ddof 1, of two seeds and more) and n over the seeds that have the metric; status; which of the method's
volumes was scored; whether no seed has it because the volumes are the reference itself."""

Numbers = dict[Key, Number]


def numbers(shown: Sequence[RunRecord]) -> Numbers:
    """Return the numbers of records that `records.latest` kept, in their order, those derived from them last."""
    found: Numbers = {}
    seeds: dict[Key, list[Number]] = {}
    compared: list[Row] = []

    def add(key: Key, value: float | None, status: str, volume: str = "", identical: bool = False) -> None:
        number = (value, None, int(value is not None), status, volume, identical)
        first = found.setdefault(key, number)
        if first is not number and key in seeds:
            seeds[key].append(number)
        elif first is not number:
            seeds[key] = [first, number]

    for record in shown:
        run, label, inputs, status = record.run, record.label, record.inputs, record.status
        scene, variant = run.scene, run.variant
        for protocol, score in record.scores.items():
            wanted, volume, identical = COMPARED.get(protocol, ()), score.volume, score.identical
            for metric, value in score.values.items():
                add((scene, variant, label, inputs, protocol, metric), value, status, volume, identical)
                if metric in wanted:
                    said = (status, volume, identical)
                    compared.append(Row(scene, run.seed, variant, label, inputs, protocol, metric, value, *said))
        for metric in COLUMNS["cost"] if record.cost is not None else ():
            add((scene, variant, label, inputs, "cost", metric), float(getattr(record.cost, metric)), status)
        if record.cost is None and not any(score.values for score in record.scores.values()):
            add((scene, variant, label, inputs, "", ""), None, status)
    for row in derived(compared):
        key = (row.scene, row.variant, row.method, row.inputs, row.protocol, row.metric)
        add(key, row.value, row.status, row.volume, row.identical)
    return found | {key: _over(group) for key, group in seeds.items()}


def _over(seeds: list[Number]) -> Number:
    """Return the number over seeds of those of each."""
    values = [value for value, *_ in seeds if value is not None]
    _, _, _, status, volume, identical = zip(*seeds, strict=True)
    return (
        _mean(values) if values else None,
        _std(values) if len(values) > 1 else None,
        len(values),
        ", ".join(dict.fromkeys(status)),
        ", ".join(dict.fromkeys(volume)),
        all(identical),
    )


def _mean(values: list[float]) -> float:
    """Return the mean; the others are summed before the first is added, as in pandas, down to the last bit."""
    total = 0.0
    for value in values[1:]:
        total += value
    mean = (values[0] + total) / len(values)
    return mean if math.isfinite(mean) else math.fsum(v / len(values) for v in values)


def _std(values: list[float]) -> float:
    """Return the standard deviation by Welford's recurrence; infinite where the squares are."""
    mean, squares = 0.0, 0.0
    for n, value in enumerate(values, 1):
        before = mean
        mean += (value - before) / n
        squares += (value - mean) * (value - before)
    return math.sqrt(squares / (len(values) - 1)) if 0 <= squares < math.inf else math.inf


class _Cells(dict[str, str]):
    """Texts as cells of CSV, each looked at once; a text that a spreadsheet would compute is no formula any more."""

    def __missing__(self, text: str) -> str:
        cell = harmless(text)
        quoted = '"' + cell.replace('"', '""') + '"'
        self[text] = cell = quoted if any(c in cell for c in ',"') else cell
        return cell


def csv_text(found: Numbers) -> str:
    """Return the numbers as CSV."""
    cells, lines = _Cells(), [",".join(_COLUMNS)]
    for (scene, variant, method, inputs, protocol, metric), number in found.items():
        mean, std, n, status, volume, identical = number
        who = f"{cells[scene]},{cells[variant]},{cells[method]},{cells[inputs]},{cells[protocol]},{cells[metric]}"
        values = f"{'' if mean is None else repr(mean)},{'' if std is None else repr(std)},{n}"
        lines.append(f"{who},{values},{cells[status]},{cells[volume]},{identical}")
    return "\n".join([*lines, ""])


_COLUMNS = (
    *("scene", "variant", "method", "inputs", "protocol", "metric"),
    *("mean", "std", "n", "status", "volume", "identical"),
)


def summary(records: Sequence[RunRecord]) -> "pd.DataFrame":
    """Return the numbers of the latest records as table.csv holds them, a row each."""
    import pandas as pd

    found = numbers(latest(records))
    frame = pd.DataFrame([(*key, *number) for key, number in found.items()], columns=pd.Index(_COLUMNS))
    for name in ("mean", "std"):
        frame[name] = pd.to_numeric(frame[name])
    return frame
