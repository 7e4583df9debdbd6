"""A table of a CSV file in a page: its reader sorts it by any column and filters it by those of few texts.

The script is in the page, which needs nothing else. Without scripts the whole table is there.
"""

import csv
import html
from collections.abc import Mapping, Sequence
from pathlib import Path

from fmpjax.errors import UserError

FILTERED = ("method", "reset", "motion", "seed", "budget")  # columns that a reader filters by
SCRIPT = Path(__file__).with_suffix(".js")
STYLE = """
.explorer th button { font: inherit; font-weight: 600; background: none; border: 0; padding: 0; cursor: pointer }
.explorer th[aria-sort="ascending"] button::after { content: " ▲" }
.explorer th[aria-sort="descending"] button::after { content: " ▼" }
.explorer label { margin-right: 1rem; font-size: .85rem } .explorer output { color: #5b6673; font-size: .85rem }
.explorer .wide { max-height: 36rem; overflow: auto }
"""


def read(path: Path) -> list[dict[str, str]]:
    """The lines of a CSV file.

    Raises:
      UserError: it cannot be read, or has no lines.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path} cannot be read ({error}): expected the table that the benchmark writes") from None
    if not lines or any(None in line or None in line.values() for line in lines):
        raise UserError(f"{path} has no lines, or lines of different lengths: expected the benchmark's table")
    return lines


def page(lines: Sequence[Mapping[str, str]]) -> str:
    """The table and what filters it, as a part of a page that holds `STYLE` and `script` once."""
    columns = list(lines[0])
    filters = [_filter(lines, column, columns.index(column)) for column in FILTERED if column in columns]
    headings = "".join(f'<th scope="col"><button type="button">{html.escape(name)}</button></th>' for name in columns)
    body = "\n".join(f"<tr>{''.join(map(_cell, line.values()))}</tr>" for line in lines)
    return (
        f'<div class="explorer"><p>{"".join(filters)}<output></output></p>\n'
        f'<div class="wide"><table><thead><tr>{headings}</tr></thead>\n<tbody>\n{body}\n</tbody></table></div></div>'
    )


def script() -> str:
    """What sorts and filters all tables of a page."""
    return f"<script>\n{SCRIPT.read_text()}</script>"


def _filter(lines: Sequence[Mapping[str, str]], column: str, index: int) -> str:
    options = "".join(f"<option>{html.escape(value)}</option>" for value in dict.fromkeys(x[column] for x in lines))
    select = f'<select data-column="{index}"><option value="">all</option>{options}</select>'
    return f"<label>{html.escape(column)} {select}</label>"


def _cell(value: str) -> str:
    try:
        shown = value if value.lstrip("-").isdigit() else f"{float(value):.4g}"
    except ValueError:
        shown = value or "–"
    return f'<td data-value="{html.escape(value)}">{html.escape(shown)}</td>'
