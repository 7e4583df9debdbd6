"""How the cells of a benchmark learned: what their rewards could tell apart, beside what their policies did.

A course has a row for each evaluation. Figures of training and fitting are means since the evaluation before it.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fmpjax.experiments.common.cells import Cell
from fmpjax.experiments.common.table import evaluations, title
from fmpjax.logs import MetricsLog

# What a prior can tell, by its column of `metrics.csv`; a method has some of them.
SIGNS = (
    "expert_margin", "score_spread",
    "discriminator_loss", "agent_accuracy", "expert_accuracy",
    "value_loss", "endpoint_loss", "flow_loss", "value_correlation",
    "critic_difference", "critic_slope", "coupling_distance", "mass_held", "denoising_error", "expert_error",
    "effective_atoms", "joint_error",
)  # fmt: skip
TRAINING = ("falls", "episode_length", "reward", "reward_spread")
_SHARES = {"quality": "quality", "training_falls": "falls in training", "agent_accuracy": "accuracy, policy",
           "expert_accuracy": "accuracy, demonstration"}  # fmt: skip
_COLORS = {"quality": "C0", "training_falls": "C3", "agent_accuracy": "C2", "expert_accuracy": "C4"}


def course(cell: Cell, folder: Path) -> list[dict[str, Any]]:
    """The course of a cell's run, a row an evaluation, for a CSV file.

    ``falls`` are per cent of the episodes, ``training_falls`` a share. What a method does not have is NaN.
    """
    lines, rows, since = MetricsLog.read(folder / cell.name / "metrics.csv"), [], 0
    columns = {name: f"fit/{name}" for name in SIGNS} | {f"training_{name}": f"train/{name}" for name in TRAINING}
    for evaluation in evaluations(cell, folder):
        until = next(i for i, line in enumerate(lines) if int(line["transitions"]) == evaluation.transitions) + 1
        part, since = lines[since:until], until
        rows.append(
            {
                "method": evaluation.method, "reset": evaluation.reset, "motion": evaluation.variant,
                "seed": evaluation.seed, "transitions": evaluation.transitions, "seconds": evaluation.seconds,
                "quality": evaluation.figure("quality"), "falls": evaluation.figure("falls"),
            }
            | {name: _mean(line.get(column) for line in part) for name, column in columns.items()}
        )  # fmt: skip
    return rows


def _mean(values) -> float:
    known = [float(value) for value in values if value]
    finite = [value for value in known if math.isfinite(value)]
    return float(np.mean(finite)) if finite else math.nan


def draw(rows: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """A column of panels for each method: shares from 0 to 1, and the demonstration's margin; the path written.

    Thin lines are cells, thick ones the means of the cells that have as many evaluations as the most.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    figure = Figure((2.3 * len(methods) + 0.6, 4.6), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    grid, handles = figure.subplots(2, len(methods), squeeze=False, sharex=True, sharey="row"), {}
    for (upper, lower), method in zip(grid.T, methods, strict=True):
        cells: dict[tuple, list[Mapping[str, Any]]] = {}
        for row in rows:
            if row["method"] == method:
                cells.setdefault((row["reset"], row["motion"], row["seed"]), []).append(row)
        for name, said in _SHARES.items():
            if (drawn := _curves(upper, list(cells.values()), name, _COLORS[name])) is not None:
                handles[said] = drawn
        _curves(lower, list(cells.values()), "expert_margin", "0.3")
        upper.set_title(title(method), fontsize=9, loc="left")
        lower.set_xlabel("million transitions", fontsize=8)
    grid[0, 0].set_ylabel("share", fontsize=8)
    grid[0, 0].set_ylim(-0.02, 1.02)
    grid[1, 0].set_ylabel("demonstration's margin, spreads", fontsize=8)
    for panel in grid.flat:
        panel.tick_params(labelsize=7, length=2)
        panel.grid(alpha=0.25, linewidth=0.5)
        panel.spines[["top", "right"]].set_visible(False)
    figure.legend(handles.values(), handles, loc="outside upper center", ncols=4, fontsize=8, frameon=False)
    figure.savefig(path)
    return path


def _curves(panel, cells: Sequence[Sequence[Mapping[str, Any]]], name: str, color: str):
    """A figure of each cell over its transitions; the line of their mean, None where none has the figure."""
    have = [cell for cell in cells if any(math.isfinite(row[name]) for row in cell)]
    for cell in have:
        panel.plot(*_line(cell, name), color=color, linewidth=0.6, alpha=0.35)
    longest = [cell for cell in have if len(cell) == max(map(len, have))]
    if not longest:
        return None
    across, values = np.mean([_line(cell, name) for cell in longest], axis=0)
    return panel.plot(across, values, color=color, linewidth=1.6)[0]


def _line(cell: Sequence[Mapping[str, Any]], name: str) -> tuple[list[float], list[float]]:
    return [row["transitions"] / 1e6 for row in cell], [row[name] for row in cell]
