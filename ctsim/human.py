"""Sizes, times and names for people."""

import difflib
from collections.abc import Iterable

_MANY = 20  # names, beyond which a sentence gives but some


def human_bytes(size: float) -> str:
    """Return a size with a decimal unit, such as 113 MB."""
    for unit in ("B", "kB", "MB", "GB"):
        if size < 999.5:
            return f"{size:.3g} {unit}"
        size /= 1000
    return f"{size:.3g} TB"


def human_time(seconds: float) -> str:
    """Return a duration in the unit that reads best, such as 41 s or 3.5 h."""
    if seconds < 99.5:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.0f} min" if seconds < 5970 else f"{seconds / 3600:.1f} h"


def human_choice(names: Iterable[str], given: str) -> str:
    """Return the names that there are, in a row; of many their number and those nearest to the one given."""
    names = list(names)
    if len(names) <= _MANY:
        return ", ".join(names)
    near = difflib.get_close_matches(given, names, n=5)
    return f"{len(names)}, {'nearest' if near else 'such as'} {', '.join(near or names[:5])}"
