"""What is measured of a trained cell beside its evaluations: falls under disturbances, and what its reward prefers.

Both are of the newest policy, as the scores at equal transitions are.
"""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fmpjax import priors
from fmpjax.experiments.common.cells import Cell
from fmpjax.experiments.common.work import RUN, Measure

DISTURBANCES = ("push", "delay", "friction", "together")  # of `fmpjax evaluate --robust`, each at two or three sizes
EPISODES = 64  # of each size
ROBUST, RANKING = "robustness-last.json", "ranking-learned-last.json"


def of(cell: Cell, *, smoke: bool = False) -> Cell:
    """The cell with its measurements; a method that scores no window by itself has no ranking."""
    robust = ("evaluate", RUN, "--robust", "--last", "--episodes", str(8 if smoke else EPISODES))
    found = [Measure(ROBUST, (*robust, "--disturbances", *DISTURBANCES))]
    if not priors.follows(cell.config.method):
        found.append(Measure(RANKING, ("experiment", "ranking", "--run", RUN, "--last", "--learned")))
    return dataclasses.replace(cell, measures=tuple(found))


def robust(cell: Cell, folder: Path) -> list[dict[str, Any]]:
    """A line for each disturbance and size, for a CSV file; none where they were not measured."""
    found = _read(folder / cell.name / ROBUST).get("cells", [])
    return [_where(cell) | {key: value for key, value in line.items() if key != "sides"} for line in found]


def ranking(cell: Cell, folder: Path) -> list[dict[str, Any]]:
    """A line for each copy of the demonstration, for a CSV file; none where it was not measured."""
    found = _read(folder / cell.name / RANKING).get("windows", {})
    return [_where(cell) | {"windows": name} | line for name, line in found.items()]


def scores(robust: Sequence[Mapping[str, Any]], ranking: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The scores that the lines of a cell give, NaN where there are none.

    Falls are per cent of the episodes, all sizes of a disturbance together. ``preferred`` is how often the reward
    prefers a window of the demonstration to one of a spoiled copy, per cent, the mean over the copies.
    """
    falls = {}
    for name in DISTURBANCES:
        lines = [line for line in robust if line["disturbance"] == name]
        episodes = sum(line["episodes"] for line in lines)
        falls[f"falls_{name}"] = 100.0 * sum(line["falls"] for line in lines) / episodes if episodes else math.nan
    beaten = [line["beaten"] for line in ranking if line["windows"] not in ("demonstration", "pool")]
    return falls | {"preferred": 100.0 * float(np.mean(beaten)) if beaten else math.nan}


def _where(cell: Cell) -> dict[str, Any]:
    config = cell.config
    return {"method": config.method, "reset": config.env.reset, "motion": cell.variant, "seed": config.seed}


def _read(path: Path) -> Mapping[str, Any]:
    return json.loads(path.read_text()) if path.exists() else {}
