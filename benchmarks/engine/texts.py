"""Small helpers of the tables: escaping for Markdown, LaTeX, CSV and pictures, and who is best and second."""

import math
from collections.abc import Callable, Sequence
from typing import Literal

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
    "·": r"$\cdot$",
}


_LINE = dict.fromkeys((*range(0x20), *range(0x7F, 0xA0), 0x2028, 0x2029), " ")
"""Control characters, which hold every end of a line that any reader of text knows, and Unicode's own two."""

_ESCAPED = {"md": str.maketrans({**_LINE, "|": "\\|"}), "tex": str.maketrans({**_LINE, **_TEX})}
_FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠")


def one_line(text: str) -> str:
    """Return a text without an end of a line and other control characters: each becomes a space."""
    return text.translate(_LINE)


def escape(text: str, form: Literal["md", "tex"]) -> str:
    """Escape what Markdown's tables or LaTeX would take as markup; the text becomes one line."""
    return text.translate(_ESCAPED[form])


def pictured(text: object) -> str:
    """Escape what matplotlib would take as mathematics, so that it draws the very text."""
    return str(text).replace("$", r"\$")


def harmless(text: str) -> str:
    """Return a text as a cell of CSV that no spreadsheet takes for a formula, on one line."""
    text = one_line(text)
    return f"'{text}" if text.lstrip().startswith(_FORMULA) else text


def ranked(numbers: Sequence[float | None], better: str) -> dict[int, str]:
    """Return {index: "best" or "second"}; equal numbers share a place, and a lone number has none, nor has NaN.

    `better` is "max", "min", "one" (nearest to 1), or "" for no ranking.
    """
    numbers = [None if n is None or math.isnan(n) else n for n in numbers]
    keys: dict[str, Callable[[float], float]] = {"max": lambda v: -v, "min": lambda v: v, "one": lambda v: abs(v - 1)}
    if better not in keys or sum(n is not None for n in numbers) < 2:
        return {}
    found = {i: keys[better](n) for i, n in enumerate(numbers) if n is not None}
    places = dict(zip(sorted(set(found.values())), ("best", "second"), strict=False))
    return {i: places[n] for i, n in found.items() if n in places}
