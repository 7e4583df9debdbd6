"""Scores of the cells of a benchmark: of each cell's evaluation at equal transitions, and of that at equal wall time.

A run's history has both, since every evaluation says how many transitions and how many seconds of training it is after.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from fmpjax.config import Config
from fmpjax.experiments.common import measured, table
from fmpjax.experiments.common.cells import Cell
from fmpjax.experiments.common.measured import DISTURBANCES
from fmpjax.experiments.common.table import Row
from fmpjax.metrics import pace_error

WALKS_WITHIN = 0.2  # relative error of the pace at most, of a policy that walks; none of its episodes may fall


class Score(NamedTuple):
    """A figure by which methods are compared."""

    name: str
    heading: str  # with its unit
    digits: int
    better: int  # 1 where more is better, -1 where less is


_SAID = ("falls, pushed", "delayed", "slipping", "all together")
_SIZED = {f"falls_at_{size:g}": size for size in Config().evaluation_noise}  # rad, of the starts
SCORES = (
    Score("quality", "quality", 3, 1),
    Score("walks", "walks, %", 0, 1),
    Score("time_to_walk", "walks after, M", 2, -1),
    Score("falls", "falls, %", 1, -1),
    *(Score(name, f"at {size:g} rad, %", 1, -1) for name, size in _SIZED.items()),
    Score("pace_error", "pace error", 3, -1),
    Score("excursion_error", "excursion error", 3, -1),
    Score("amplitude_error", "amp. error, °", 2, -1),
    Score("sinkhorn", "Sinkhorn", 3, -1),
    Score("foot_slip", "foot slip, m/s", 3, -1),
    Score("action_rate", "action rate, rad/s", 2, -1),
    Score("joint_jerk", "joint jerk, rad/s³", 0, -1),
    Score("power", "power, W", 0, -1),
    *(Score(f"falls_{name}", f"{said}, %", 1, -1) for name, said in zip(DISTURBANCES, _SAID, strict=True)),
    Score("preferred", "preferred, %", 0, 1),
)
BUDGETS = ("transitions", "seconds")  # what is equal


class History(NamedTuple):
    """A finished cell: its evaluations and what else its scores need."""

    cell: Cell
    rows: list[Row]
    still: float  # degrees, amplitude error of a robot that holds still: the demonstration's own joint ranges
    machines: frozenset[str]  # that trained it
    measured: Mapping[str, float] = MappingProxyType({})  # scores of the newest policy alone, of `measured.scores`


class Result(NamedTuple):
    """The scores of one cell at one budget."""

    method: str
    reset: str
    motion: str
    seed: int
    budget: str  # what is equal: transitions or seconds
    transitions: int
    seconds: float  # of training
    scores: dict[str, float]
    walk_transitions: float  # until it first walks; NaN where it does not
    walk_seconds: float

    def line(self) -> dict[str, Any]:
        """A line of the CSV file."""
        return {k: v for k, v in self._asdict().items() if k != "scores"} | self.scores


def read(cell: Cell, folder: Path) -> History:
    """The history of a finished cell."""
    run = folder / cell.name
    made = json.loads((run / "provenance.json").read_text())
    ranges = json.loads((run / "evaluation.json").read_text())["expert_ranges"]
    machines = frozenset(map(_machine, (made, *made.get("resumed", []))))
    extra = measured.scores(measured.robust(cell, folder), measured.ranking(cell, folder))
    return History(cell, table.evaluations(cell, folder), float(np.mean(ranges)), machines, extra)


def _machine(made: Mapping[str, Any]) -> str:
    """The kind of machine that a provenance names; those of earlier versions do not have the processor."""
    return ", ".join(str(made[key]) for key in ("device", "processor") if key in made)


def walks(row: Row) -> bool:
    """Whether no episode of an evaluation falls and its pace is within a fifth of the demonstration's."""
    return row.figure("falls") == 0 and pace_error(row.figures) <= WALKS_WITHIN


def time_to_walk(rows: Sequence[Row]) -> tuple[float, float]:
    """Transitions, and seconds of training, until the first evaluation that walks; NaN where none does."""
    return next(((float(row.transitions), row.seconds) for row in rows if walks(row)), (math.nan, math.nan))


def scores(row: Row, still: float, walked: float = math.nan) -> dict[str, float]:
    """The scores of one evaluation, by name.

    A pace, an excursion or an amplitude that no episode lasts long enough to have is that of a robot that holds still,
    so that a method gains nothing by falling early. The other scores are NaN where they are not defined.

    Args:
      row: of a cell.
      still: amplitude error of a robot that holds still, degrees.
      walked: transitions until the cell first walked; of one that did not, those until now count.
    """
    excursion, amplitude = row.figure("excursion"), row.figure("amplitude_mae")
    return {
        "quality": row.figure("quality"),
        "walks": 100.0 * walks(row),
        "time_to_walk": 1e-6 * (row.transitions if math.isnan(walked) else walked),
        "falls": row.figure("falls"),
        **{name: row.figure(name) for name in _SIZED},
        "pace_error": pace_error(row.figures),
        "excursion_error": 1.0 if math.isnan(excursion) else abs(excursion - 1.0),
        "amplitude_error": still if math.isnan(amplitude) else amplitude,
        "sinkhorn": row.figure("discrepancy"),
        "foot_slip": row.figure("contact_foot_speed"),
        "action_rate": row.figure("action_rate"),
        "joint_jerk": row.figure("joint_jerk"),
        "power": row.figure("power"),
    }


def machines(histories: Sequence[History]) -> list[str]:
    """The kinds of machine that trained the cells; wall times of several kinds do not compare."""
    return sorted({machine for history in histories for machine in history.machines})


def results(histories: Sequence[History]) -> list[Result]:
    """The scores of every cell at equal transitions and, where one kind of machine trained all, at equal wall time.

    At equal transitions the last evaluation counts. At equal wall time it is, for each motion and reset, the last one
    that is no later than the end of the fastest method, all of its seeds included.
    """
    found = [_result(history, history.rows[-1], "transitions") for history in histories]
    if len(machines(histories)) != 1:
        return found
    limits = _limits(histories)
    for history in histories:
        within = [row for row in history.rows if row.seconds <= limits[_where(history)]]
        found.append(_result(history, within[-1] if within else history.rows[0], "seconds"))
    return found


def _result(history: History, row: Row, budget: str) -> Result:
    walked = time_to_walk([each for each in history.rows if each.transitions <= row.transitions])
    newest = row.transitions == history.rows[-1].transitions
    extra = {name: value if newest else math.nan for name, value in history.measured.items()}
    return Result(
        row.method, row.reset, row.variant, row.seed, budget, row.transitions, row.seconds,
        scores(row, history.still, walked[0]) | extra, *walked,
    )  # fmt: skip


def _where(history: History) -> tuple[str, str]:
    return history.cell.variant, history.cell.config.env.reset


def _limits(histories: Sequence[History]) -> Mapping[tuple[str, str], float]:
    """Seconds of training that are equal, for each motion and reset."""
    spent: dict[tuple[str, str], dict[str, list[float]]] = {}
    for history in histories:
        methods = spent.setdefault(_where(history), {})
        methods.setdefault(history.cell.config.method, []).append(history.rows[-1].seconds)
    return {where: min(map(max, methods.values())) for where, methods in spent.items()}
