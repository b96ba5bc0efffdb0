"""The Markdown of the tables as HTML: headings, paragraphs, lists, tables, bold, underline, code.

One renderer decides what a table holds; a page shows the same cells. Tables can be sorted by `page.js`.
"""

import html
import itertools
import re

_CELL = re.compile(r"(?<!\\)\|")
_RULE = re.compile(r"[|:\- ]+")


def to_html(text: str) -> str:
    """Render the blocks of `text` one after another."""
    return "\n".join(_block(lines) for lines in _blocks(text))


def sections(text: str) -> dict[str, str]:
    """Return {title: text below it} of the headings `## title`."""
    parts = re.split(r"^## (.+)\n", text, flags=re.M)
    return {title.strip(): body.strip("\n") for title, body in zip(parts[1::2], parts[2::2], strict=True)}


def inline(text: str) -> str:
    """Escape a line and render its bold, underlined and code spans."""
    text = html.escape(text.replace(r"\|", "|"), quote=False)
    text = re.sub(r"&lt;u&gt;(.*?)&lt;/u&gt;", r"<u>\1</u>", text)
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    return re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", text)


def _blocks(text: str) -> list[list[str]]:
    """Split into blocks of lines of one kind."""
    found: list[list[str]] = []
    last = ""
    for line in text.splitlines():
        kind = "" if not line.strip() else line[0] if line[0] in "#|-" else "p"
        if kind and kind == last and kind != "#":
            found[-1].append(line)
        elif kind:
            found.append([line])
        last = kind
    return found


def _block(lines: list[str]) -> str:
    first = lines[0]
    if first.startswith("#"):
        level = len(first) - len(first.lstrip("#"))
        return f"<h{level}>{inline(first[level:].strip())}</h{level}>"
    if first.startswith("- "):
        return "<ul>" + "".join(f"<li>{inline(line[2:])}</li>" for line in lines) + "</ul>"
    if first.startswith("|") and len(lines) > 1 and _RULE.fullmatch(lines[1]):
        return _table(lines)
    return f"<p>{inline(' '.join(lines))}</p>"


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in _CELL.split(line.strip())[1:-1]]


def _table(lines: list[str]) -> str:
    """Render a table whose columns "scene: metric" stand together under their scene; short rows are filled up."""
    head, rule, *rows = map(_cells, lines)
    numeric = [mark.endswith(":") for mark in rule]
    groups = [
        title.partition(": ") if number else ("", "", title) for title, number in zip(head, numeric, strict=False)
    ]
    body = []
    for row in rows:
        kinds = ((' class="num"' if number else "") for number in numeric)
        cells = row + [""] * (len(head) - len(row))
        body.append("".join(f"<td{kind}>{inline(cell)}</td>" for kind, cell in zip(kinds, cells, strict=False)))
    return (
        '<div class="wide"><table><thead>'
        + _head(groups, numeric)
        + "</thead><tbody>"
        + "".join(f"<tr>{row}</tr>" for row in body)
        + "</tbody></table></div>"
    )


def _head(groups: list[tuple[str, str, str]], numeric: list[bool]) -> str:
    """Return one or two rows of heads; each column's own is a button that sorts."""
    grouped = any(colon for _, colon, _ in groups)
    upper, lower = [], []
    for (group, colon), members in itertools.groupby(enumerate(groups), lambda item: item[1][:2]):
        heads = []
        for column, (first, mark, rest) in members:
            title = rest if mark else first or rest
            kind = ' class="num"' if numeric[column] else ""
            span = ' rowspan="2"' if grouped and not mark else ""
            button = f'<button type="button">{inline(title)}</button>'
            heads.append(f'<th{kind}{span} scope="col" data-column="{column}">{button}</th>')
        if colon:
            upper.append(f'<th class="group" scope="colgroup" colspan="{len(heads)}">{inline(group)}</th>')
            lower += heads
        else:
            upper += heads
    return f"<tr>{''.join(upper)}</tr>" + (f"<tr>{''.join(lower)}</tr>" if grouped else "")
