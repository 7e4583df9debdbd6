"""Tables for people, by cells whose places are known."""

from fmpjax import tables

ROWS = [("name", "value"), ("a", "1.0 ± 0.1"), ("longer", "")]


def test_lines_of_a_terminal():
    assert tables.lines("{:<8}{:>6}!", [("a", "1")]) == "a            1!"
    # Blanks at the end are cut.
    assert tables.lines("{:<8}{}", [("a", "b"), ("a", "")]) == "a       b\na"
    assert tables.aligned(ROWS) == "  name        value\n  a       1.0 ± 0.1\n  longer"
    assert tables.aligned(ROWS, texts=2) == "  name    value\n  a       1.0 ± 0.1\n  longer"


def test_markdown():
    assert tables.markdown(ROWS[0], ROWS[1:]) == "| name | value |\n| --- | ---: |\n| a | 1.0 ± 0.1 |\n| longer |  |"


def test_latex():
    text = tables.latex(("method", "falls, %"), [("FMP", "1.0 ± 0.1"), ("AMP", "–")])
    assert text.splitlines() == [
        r"\begin{tabular}{lr}", r"\toprule", r"method & falls, \% \\", r"\midrule", r"FMP & 1.0 $\pm$ 0.1 \\",
        r"AMP & -- \\", r"\bottomrule", r"\end{tabular}",
    ]  # fmt: skip
