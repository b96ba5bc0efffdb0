"""Tables in four formats: what each takes as markup is escaped, and the best of a class is marked."""

import csv
import html
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from ctsim.benchmarks.engine.table import (
    Cell,
    Column,
    Table,
    ranked,
    simple,
    tex_comment,
    tex_prose,
    tex_row,
    tex_spanning,
)

ODD = "a|b $x_1$ 5% & <i>#{}~^\\ \"q\" 'r' µ"
CONTROLS = "".join(map(chr, (*range(0x20), *range(0x7F, 0xA0)))) + "\u2028\u2029"


def table(*rows, better="max", **more) -> Table:
    """Return a table of methods whose rows are (class, name, number)."""
    columns = [Column("class"), Column("name"), Column("PSNR", "image", number=True, better=better)]
    cells = [[Cell(of), Cell(name), Cell("–" if n is None else f"{n:g}", n)] for of, name, n in rows]
    return Table(columns=columns, rows=cells, rank_within=0, **more)


PLAIN = table(("a", "one", 1.0), ("a", "two", 2.0), ("b", "three", 3.0), ("a", "four", 0.5))


class Parsed(HTMLParser):
    """The texts, tags and attributes of a page."""

    def __init__(self, text):
        super().__init__()
        self.texts, self.open, self.numbers, self.tags = [], [], [], set()
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.open.append(tag)
        self.tags.add(tag)
        self.numbers += [value for name, value in attrs if name == "data-number"]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if data.strip():
            self.texts.append(data)


def csv_rows(text):
    return list(csv.reader(io.StringIO(text)))


# --- the formats -------------------------------------------------------------------------------------------


def test_markdown():
    named = table(("a", "one", 1.0), ("a", "two", 2.0), title="Scores", caption="In dB.", notes=("First.", "Second."))
    assert named.markdown() == (
        "## Scores\n"
        "\n"
        "In dB.\n"
        "\n"
        "| class | name | image: PSNR |\n"
        "|---|---|---:|\n"
        "| a | one | <u>1</u> |\n"
        "| a | two | **2** |\n"
        "\n"
        "- First.\n"
        "- Second.\n"
    )
    assert PLAIN.markdown().startswith("| class |")


def test_latex_as_booktabs_prints_it():
    columns = [Column("Method"), Column("PSNR", "Lung", True, "max"), Column("RMSE", "Lung", True, "min"), Column("s")]
    rows = [
        [Cell("ours"), Cell("30.1", 30.1), Cell("2", 2.0), Cell("5%")],
        [Cell("theirs"), Cell("29.9", 29.9), Cell("3", 3.0), Cell("7%")],
    ]
    found = Table(columns=columns, rows=rows, caption="Both & all.", notes=["made by --table"], rank_within=3)
    # classes of one row each: no ranks
    assert found.latex("tab:all") == (
        "\\begin{table}\n"
        "\\centering\n"
        "\\caption{Both \\& all.}\n"
        "\\label{tab:all}\n"
        "\\begin{tabular}{lrrl}\n"
        "\\toprule\n"
        " & \\multicolumn{2}{c}{Lung} &  \\\\\n"
        "\\cmidrule(lr){2-3}\n"
        "Method & PSNR & RMSE & s \\\\\n"
        "\\midrule\n"
        "ours & 30.1 & 2 & 5\\% \\\\\n"
        "theirs & 29.9 & 3 & 7\\% \\\\\n"
        "\\bottomrule\n"
        "\\end{tabular}\n"
        "\\end{table}\n"
        "% made by --table\n"
    )
    text = PLAIN.latex()
    assert "\\textbf{2}" in text and "\\underline{1}" in text and "\\label" not in text and "{llr}" in text


def test_groups_over_columns():
    head, rules = tex_spanning([(title, 1) for title in ("", "A", "A", "", "", "B & C", "A")])
    assert head == tex_row(
        ["", r"\multicolumn{2}{c}{A}", "", "", r"\multicolumn{1}{c}{B \& C}", r"\multicolumn{1}{c}{A}"]
    )
    assert rules == r"\cmidrule(lr){2-3}\cmidrule(lr){6-6}\cmidrule(lr){7-7}"


def test_html():
    named = table(("a", "one", 1.0), ("a", "two", None), ("a", "three", 2.5), title="T", caption="C", notes=("N",))
    assert named.html() == (
        "<h2>T</h2>\n<p>C</p>\n"
        '<div class="wide"><table>\n<thead><tr>'
        '<th rowspan="2" scope="col" data-column="0">class</th><th rowspan="2" scope="col" data-column="1">name</th>'
        '<th class="group" scope="colgroup" colspan="1">image</th></tr>'
        '<tr><th class="num" scope="col" data-column="2">PSNR</th></tr></thead>\n<tbody>\n'
        '<tr><td>a</td><td>one</td><td class="num" data-number="1.0"><u>1</u></td></tr>\n'
        '<tr><td>a</td><td>two</td><td class="num">–</td></tr>\n'
        '<tr><td>a</td><td>three</td><td class="num" data-number="2.5"><strong>2.5</strong></td></tr>\n'
        "</tbody>\n</table></div>\n<ul>\n<li>N</li>\n</ul>\n"
    )
    assert PLAIN.html().startswith('<div class="wide"><table>') and PLAIN.html().endswith("</table></div>\n")
    head = '<tr><th scope="col" data-column="0">a</th><th class="num" scope="col" data-column="1">b</th></tr>'
    assert f"<thead>{head}</thead>" in simple(["a", "b"], [[1, 2]], numbers=("b",)).html()


def test_code_in_prose_is_code_on_a_page():
    found = simple(["`a`"], [["`b`"]], caption="By `x <y> --z`, <i>.", notes=["`n`"]).html()
    assert "<p>By <code>x &lt;y&gt; --z</code>, &lt;i&gt;.</p>" in found and "<li><code>n</code></li>" in found
    assert ">`a`<" in found and ">`b`<" in found


def test_the_parts_of_a_column_stand_under_its_title():
    columns = [Column("Method")] + [
        Column(title, group, True, part=part)
        for group, title in (("Lung", "SSIM"), ("Lung", "PSNR"), ("Teeth", "PSNR"))
        for part in ("paper", "here")
    ]
    found = Table(columns=columns, rows=[[Cell("a"), *[Cell("1")] * 6]], caption="C", notes=["by `a --b`"])
    assert found.markdown().startswith("C\n\n| Method | Lung: SSIM, paper | Lung: SSIM, here | Lung: PSNR, paper |")
    # of two groups, PSNR stays two
    titles = " & ".join(rf"\multicolumn{{2}}{{c}}{{{title}}}" for title in ("SSIM", "PSNR", "PSNR"))
    assert (
        "\\toprule\n"
        " & \\multicolumn{4}{c}{Lung} & \\multicolumn{2}{c}{Teeth} \\\\\n"
        "\\cmidrule(lr){2-5}\\cmidrule(lr){6-7}\n"
        f" & {titles} \\\\\n"
        "\\cmidrule(lr){2-3}\\cmidrule(lr){4-5}\\cmidrule(lr){6-7}\n"
        "Method & paper & here & paper & here & paper & here \\\\\n"
    ) in found.latex()
    assert found.latex().endswith("\\end{table}\n% by `a --b`\n")
    note = "\\end{tabular}\n\\par\\footnotesize by \\texttt{a -{}-b}\n\\end{table}\n"
    assert found.latex(footnotes=True).endswith(note)
    assert ">SSIM, paper</th>" in found.html()


def test_csv():
    assert PLAIN.csv() == "class,name,image: PSNR\na,one,1\na,two,2\nb,three,3\na,four,0.5\n"


@pytest.mark.parametrize("kind", [float, np.float32, np.float64, int])
def test_numbers_of_any_kind_can_be_sorted_by(kind):
    text = table(("a", "one", kind(2)), ("a", "two", kind(3))).html()
    assert [float(number) for number in Parsed(text).numbers] == [2.0, 3.0]


# --- what stands in cells ----------------------------------------------------------------------------------


@pytest.mark.parametrize("text", [ODD, CONTROLS.join(ODD), "\x00", "|", "\n", "", "a\r\nb"])
def test_no_text_breaks_a_table(text):
    found = Table(
        columns=[Column(text, text), Column(text)],
        rows=[[Cell(text), Cell("x")]],
        title=text,
        caption=text,
        notes=[text],
    )
    for written in (found.markdown(), found.html(), found.csv(), found.latex()):
        assert not set(written) & set(CONTROLS) - {"\n"}
    lines = found.markdown().split("\n")
    rows = [line for line in lines if line.startswith("|")]
    assert len(rows) == 3
    assert {len(re.findall(r"(?<!\\)\|", row)) for row in rows} == {3}
    assert len(lines) == 1 + sum(map(bool, (text, text))) * 2 + 3 + 2
    assert len(csv_rows(found.csv())) == 2 and {len(row) for row in csv_rows(found.csv())} == {2}
    assert not Parsed(found.html()).tags & {"i"}
    # a comment that ended early would be typeset
    assert found.latex().split("\n")[-3] == r"\end{table}" and found.latex().split("\n")[-2].startswith("%")


def test_each_format_escapes_its_own():
    odd = simple([ODD], [[ODD]])
    assert odd.markdown().count(ODD.replace("|", "\\|")) == 2
    assert Parsed(odd.html()).texts == [ODD, ODD]
    assert csv_rows(odd.csv()) == [[ODD], [ODD]]
    cell = (
        r"a\textbar{}b \$x\_1\$ 5\% \& $<$i$>$\#\{\}\textasciitilde{}\textasciicircum{}\textbackslash{}"
        " \"q\" 'r' µ \\\\"
    )
    assert cell in odd.latex().split("\n")


def test_a_line_break_in_any_text_is_a_space():
    odd = simple(["a\nb"], [["c\r\nd"]], title="e\nf", caption="g\u2028h", notes=["i\x0bj"])
    for text in (odd.markdown(), html.unescape(odd.html()), odd.csv(), odd.latex()):
        for one, other in ("ab", "cd"):
            assert re.search(f"{one} +{other}", text), text
    assert "## e f\n" in odd.markdown() and "<h2>e f</h2>" in odd.html() and "\\caption{g h}" in odd.latex()


@pytest.mark.parametrize("text", ["=1+1", "+A1", "-A1", "--1", "@A1", " =1", "\t=1", "＝1", "\n@x"])
def test_no_spreadsheet_takes_a_text_for_a_formula(text):
    (head,), (cell,) = csv_rows(simple([text], [[text]]).csv())
    assert head == cell == f"'{text.translate(dict.fromkeys(range(32), ' '))}"


@pytest.mark.parametrize("text", ["-1", "-0.25", "+3", "-1e-05"])
def test_a_number_below_zero_stays_a_number(text):
    assert csv_rows(simple(["n"], [[text]]).csv())[1] == [text]


def test_prose_in_latex():
    assert tex_prose("`a_b --c` & d--e") == r"\texttt{a\_b -{}-c} \& d-{}-e"
    assert tex_comment("a\nb  c%") == "% a b c%\n"


# --- ranks -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("numbers", "better", "places"),
    [
        ([1.0, 3.0, 2.0], "max", {1: "best", 2: "second"}),
        ([1.0, 3.0, 2.0], "min", {0: "best", 2: "second"}),
        ([0.5, 1.4, 1.1], "one", {2: "best", 1: "second"}),
        ([1.0, 1.0, 2.0, 2.0, 3.0], "min", {0: "best", 1: "best", 2: "second", 3: "second"}),
        ([0.5, 1.5], "one", {0: "best", 1: "best"}),
        ([2.0, None, 1.0], "max", {0: "best", 2: "second"}),
        ([2.0], "max", {}),
        ([2.0, None], "max", {}),
        ([], "max", {}),
        ([1.0, 2.0], "", {}),
        ([np.nan, 2.0, 1.0], "max", {1: "best", 2: "second"}),
        ([1.0, np.nan, 2.0], "min", {0: "best", 2: "second"}),
        ([np.nan, 2.0], "max", {}),
        ([np.inf, 2.0], "max", {0: "best", 1: "second"}),  # PSNR of what is exact
    ],
)
def test_ranks(numbers, better, places):
    assert ranked(numbers, better) == places


def test_only_a_class_competes():
    assert PLAIN.places() == {(1, 2): "best", (0, 2): "second"}  # b has one row
    assert table(("a", "one", 1.0), ("b", "two", 2.0)).places() == {}
    both = table(("a", "one", 1.0), ("b", "x", 9.0), ("a", "two", 2.0), ("b", "y", 8.0), better="min")
    assert both.places() == {(0, 2): "best", (2, 2): "second", (3, 2): "best", (1, 2): "second"}


def test_a_table_without_classes_has_no_ranks():
    found = Table(columns=PLAIN.columns, rows=PLAIN.rows)
    assert found.places() == {} and "**" not in found.markdown()


def test_a_mark_in_a_text_is_no_format():
    found = Table(
        columns=[Column("a", better="max")], rows=[[Cell("{0} {x}", 2.0)], [Cell("{}", 1.0)]], rank_within=None
    )
    assert "{0} {x}" in found.markdown()
    ranks = Table(
        columns=[Column("c"), Column("a", better="max")],
        rows=[[Cell(""), Cell("{0} {x}", 2.0)], [Cell(""), Cell("{}", 1.0)]],
        rank_within=0,
    )
    assert "**{0} {x}**" in ranks.markdown() and "<u>{}</u>" in ranks.html()


# --- nothing -----------------------------------------------------------------------------------------------


def test_a_table_without_rows_is_its_head():
    empty = table(title="T")
    assert empty.markdown() == "## T\n\n| class | name | image: PSNR |\n|---|---|---:|\n"
    assert empty.csv() == "class,name,image: PSNR\n" and "<tbody>\n</tbody>" in empty.html()
    lines = empty.latex().split("\n")
    assert lines[lines.index(r"\midrule") + 1] == r"\bottomrule" and empty.places() == {}


def test_a_simple_table_writes_what_it_is_given():
    found = simple(["name", "n"], [["a", 1], [None, 2.5]], numbers=("n",), caption="c")
    assert found.csv() == "name,n\na,1\nNone,2.5\n" and "|---|---:|" in found.markdown()
