"""What a diagnosis reads of a run: the rows of ``metrics.csv``, the configuration and one evaluation."""

import dataclasses
import json
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fmpjax import config as configuration
from fmpjax.config import Config
from fmpjax.errors import UserError
from fmpjax.logs import MetricsLog

RECENT = 10  # rows that a training figure is the mean of: a million transitions of `laptop`


class Missing(KeyError):
    """A figure that a history does not have, or that is not defined in it."""


@dataclasses.dataclass(frozen=True)
class History:
    """What a diagnosis reads. ``history["eval/NAME"]`` is of the evaluation, any other a mean over the recent rows."""

    rows: Sequence[Mapping[str, Any]]  # of metrics.csv, oldest first; values are numbers, texts of numbers or empty
    config: Config
    evaluation: Mapping[str, Any]  # as in evaluation.json; empty where there is none yet
    source: str = "the newest evaluation"  # where the evaluation is from

    def __getitem__(self, name: str) -> float:
        """The figure called ``name`` in the units of its column.

        Raises:
          Missing: the history has no such figure.
        """
        if name.startswith("eval/"):
            value = number(name, self.evaluation.get(name.removeprefix("eval/")))
            return _defined(name, value)
        return self.mean(name, self.recent)

    @property
    def recent(self) -> Sequence[Mapping[str, Any]]:
        """The last rows. The first one of a run is left out where there are others: it is of an untrained policy."""
        return self.rows[1:][-RECENT:] or self.rows

    def mean(self, name: str, rows: Sequence[Mapping[str, Any]]) -> float:
        """Mean of a column over those of ``rows`` that have it."""
        values = [number(name, row.get(name)) for row in rows]
        values = [value for value in values if not math.isnan(value)]
        return _defined(name, statistics.fmean(values) if values else math.nan)

    @property
    def progress(self) -> float:
        """Share of the budget behind the last row."""
        return number("transitions", self.rows[-1].get("transitions")) / self.config.transitions


def number(name: str, value: Any) -> float:
    """A cell as a number; NaN where it is empty."""
    if value is None or value == "":
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError):
        raise UserError(f"{name} of the run's figures is {value!r}: expected a number") from None


def _defined(name: str, value: float) -> float:
    if math.isnan(value):
        raise Missing(name)
    return value


def read(folder: Path, *, last: bool = False) -> History:
    """The history in a run folder or in a folder of exported results.

    Args:
      folder: holds ``config.json`` and ``metrics.csv``; ``evaluation.json``, the best policy's, where there is one.
      last: take the newest evaluation of ``metrics.csv`` in place of ``evaluation.json``.

    Raises:
      UserError: a file is missing or broken.
    """
    if not (folder / "config.json").is_file():
        raise UserError(f"{folder} is not a run folder: expected config.json in it")
    config = configuration.read(folder / "config.json")
    rows = MetricsLog.read(folder / "metrics.csv")
    if not rows:
        raise UserError(f"{folder / 'metrics.csv'} has no rows: expected the metrics of a run that has begun to train")
    path = folder / "evaluation.json"
    if last or not path.exists():
        return History(rows, config, newest(rows))
    try:
        evaluation = json.loads(path.read_text())
    except ValueError:
        evaluation = None
    if not isinstance(evaluation, dict):
        raise UserError(f"{path} is not valid JSON: expected the figures of an evaluation")
    return History(rows, config, evaluation, f"{path.name} (the best policy)")


def newest(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of the newest evaluation in the rows, by name; none where there is none."""
    for row in reversed(rows):
        if row.get("eval/quality") not in (None, ""):
            return {name.removeprefix("eval/"): value for name, value in row.items() if name.startswith("eval/")}
    return {}
