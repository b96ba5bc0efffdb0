"""What --dry-run prints of work that is left: its parts, the seconds expected of each, and their sum."""

from collections.abc import Sequence

from ctsim.human import human_time

Row = tuple[str, str, float | None]
"""A name, more about it, and the seconds expected, None where nothing tells."""


def listing(rows: Sequence[Row], n_listed: int, unit: str, how: str) -> str:
    """Return a line for each row, and the sum: how many `unit` of all, by what (`how`), and what has never run."""
    wide = max((len(name) for name, *_ in rows), default=0)
    long = max((len(more) for _, more, _ in rows), default=0)
    lines = [
        f"{name:{wide}}  {more:{long}}  {'unknown' if seconds is None else human_time(seconds)}"
        for name, more, seconds in rows
    ]
    unknown = dict.fromkeys(name for name, _, seconds in rows if seconds is None)
    total = human_time(sum(seconds for *_, seconds in rows if seconds is not None))
    lines.append(
        f"total: {len(rows)} of {n_listed} {unit}, {total} {how}"
        + (f"; never run: {', '.join(unknown)}" if unknown else "")
    )
    return "\n".join(lines) + "\n"
