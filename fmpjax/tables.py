"""Tables for people: lines of a terminal, Markdown and LaTeX. Cells are texts."""

from collections.abc import Iterable, Sequence


def lines(layout: str, rows: Iterable[Sequence[str]]) -> str:
    """One line per row, its cells in the places of a format string such as ``"{:<12}{:>8}"``, blanks at the end cut."""
    return "\n".join(layout.format(*row).rstrip() for row in rows)


def aligned(rows: Sequence[Sequence[str]], texts: int = 1) -> str:
    """The same, columns as wide as their cells: the first ``texts`` flush left, the others, numbers, flush right."""
    widths = [max(1, *map(len, column)) for column in zip(*rows, strict=True)]
    places = [f"{{:{'<' if i < texts else '>'}{width}}}" for i, width in enumerate(widths)]
    return lines("  " + "  ".join(places), rows)


def row(cells: Iterable[str]) -> str:
    """One row of a table in Markdown."""
    return f"| {' | '.join(cells)} |"


def markdown(headings: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1) -> str:
    """A table in Markdown: the first ``texts`` columns flush left, the others, numbers, flush right."""
    rule = ["---"] * texts + ["---:"] * (len(headings) - texts)
    return "\n".join(map(row, (headings, rule, *rows)))


def latex(headings: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1) -> str:
    """A table in LaTeX (booktabs), columns flush as in `markdown`."""

    def line(cells):
        escaped = (
            c.replace("%", r"\%").replace("°", r"$^\circ$").replace("±", r"$\pm$").replace("–", "--") for c in cells
        )
        return " & ".join(escaped) + r" \\"

    body = [line(headings), r"\midrule", *map(line, rows)]
    columns = "l" * texts + "r" * (len(headings) - texts)
    return "\n".join([rf"\begin{{tabular}}{{{columns}}}", r"\toprule", *body, r"\bottomrule", r"\end{tabular}"])
