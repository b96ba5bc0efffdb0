"""Small helpers of the tables: escaping for Markdown and LaTeX, and who is best and second."""

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
    ">": "$>$",
    "μ": r"$\mu$",
    "γ": r"$\gamma$",
    "²": "$^2$",
    "³": "$^3$",
    "×": r"$\times$",
    "°": r"$^\circ$",
    "·": r"$\cdot$",
}


def escape(text: str, form: Literal["md", "tex"]) -> str:
    """Escape what Markdown's tables or LaTeX would take as markup."""
    if form == "md":
        return text.replace("|", "\\|").replace("\n", " ")
    return "".join(_TEX.get(c, c) for c in text)


def ranked(numbers: list[float | None], better: str) -> dict[int, str]:
    """Return {index: "best" or "second"}; equal numbers share a place, and a lone number has none.

    `better` is "max", "min", "one" (nearest to 1), or "" for no ranking.
    """
    keys = {"max": lambda v: -v, "min": lambda v: v, "one": lambda v: abs(v - 1)}
    if better not in keys or sum(n is not None for n in numbers) < 2:
        return {}
    key = keys[better]
    places = sorted({key(n) for n in numbers if n is not None})[:2]
    found = {i: places.index(key(n)) for i, n in enumerate(numbers) if n is not None and key(n) in places}
    return {i: ("best", "second")[place] for i, place in found.items()}
