"""What the reward-level experiments share on their way out: tables, verdicts, files, and the way in from the shell."""

import csv
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fmpjax import jsons, machine, shell, tables
from fmpjax.errors import UserError
from fmpjax.shell import Group


class Table(NamedTuple):
    """A table for people: cells are texts, the first column names the line."""

    caption: str
    headings: Sequence[str]
    lines: Sequence[Sequence[str]]


class Verdict(NamedTuple):
    """A result of the paper, what was found here, and whether it holds by these figures."""

    claim: str
    found: str
    holds: bool

    def __str__(self) -> str:
        return f"{self.claim}: {'holds' if self.holds else 'does not hold'} here, {self.found}."


def number(value: float | None, digits: int = 3) -> str:
    """A figure for people; a dash where there is none."""
    return "–" if value is None or math.isnan(value) else f"{value:,.{digits}f}"


def text(table: Table) -> str:
    """The table in columns of a terminal."""
    return f"{table.caption}\n{tables.aligned([table.headings, *table.lines])}"


def markdown(table: Table) -> str:
    """The table in Markdown, its caption above."""
    return f"*{table.caption}*\n\n{tables.markdown(table.headings, table.lines)}"


def check_folder(out: Path) -> None:
    """Raise a `UserError` unless ``out`` is a folder that can be written, or can be made one."""
    nearest = next(place for place in (out, *out.absolute().parents) if place.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        raise UserError(f"--out {out} cannot be written: expected a folder, or a place where one can be made")


def check_file(out: Path) -> None:
    """Raise a `UserError` unless ``out`` can be a file in a folder that can be written, or can be made one."""
    if out.is_dir():
        raise UserError(f"--out {out} is a folder: expected a file to write")
    check_folder(out.parent)


def save(
    out: Path, name: str, record: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], places: Iterable[Path | str]
) -> list[Path]:
    """Write ``NAME.json`` with provenance and ``NAME.csv`` into ``out``; the paths written.

    Args:
      record: what the JSON file holds; what is not a number there becomes null.
      rows: lines of the CSV file; what is missing in one stays empty.
      places: folders and files of this machine, of which only the names are kept.
    """
    from fmpjax import runs

    out.mkdir(parents=True, exist_ok=True)
    written = jsons.dumps({"provenance": runs.provenance(), **record})
    runs.write(out / f"{name}.json", runs.without_places(written, places))
    return [out / f"{name}.json", write_csv(out / f"{name}.csv", rows)]


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write ``rows`` whole or not at all, into a folder that is made if need be; the path written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.partial")
    with partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in rows for key in row)))
        writer.writeheader()
        writer.writerows({k: _cell(v) for k, v in row.items()} for row in rows)
    partial.replace(path)
    return path


def _cell(value: Any) -> Any:
    """A value in a CSV file; empty where a number is not finite."""
    if not isinstance(value, float):
        return value
    return f"{value:.6g}" if math.isfinite(value) else ""


def entry(main: Callable[..., Any] | Group, arguments: Sequence[str] | None = None) -> None:
    """An experiment's command line, or that of several by name: bad input is one sentence and exit code 2."""
    with shell.ending():
        machine.keep_compiled()
        shell.parse(main, shell.program(), arguments)
