"""Learning curves, from the tables that runs and experiments write."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from fmpjax.errors import UserError

# The panels, in order: how long it lives, how it moves, what was fitted, how it learns. TensorBoard has every metric.
TITLES = {
    "train/episode_length": "episode length, steps",
    "env/cap": "episode cap, steps",
    "train/falls": "share of episodes that fall",
    "train/speed": "speed in training, m/s",
    "eval/late_speed": "evaluation: late speed, m/s",
    "eval/excursion": "evaluation: excursion",
    "eval/falls": "evaluation: falls",
    "eval/discrepancy": "evaluation: Sinkhorn, paper's features",
    "eval/sinkhorn": "evaluation: Sinkhorn, run's features",
    "fit/value_loss": "value loss",
    "fit/endpoint_loss": "endpoint loss",
    "fit/flow_loss": "flow loss",
    "fit/score_spread": "score spread (IQR)",
    "ppo/kl": "KL divergence",
    "ppo/deviation": "action deviation",
    "ppo/explained_variance": "explained variance",
    "fit/expert_margin": "demonstration's margin, spreads",
    "pretraining/loss": "pretraining: loss",
}
COLUMNS = 4
SPARSE = 0.5  # a curve with values in fewer rows than this is drawn as points
COLORS = {"train": "#2a6fb0", "eval": "#c8553d", "fit": "#3a8a6b", "ppo": "#7a5ba6"}
OTHER_COLOR = "#5b6673"


def learning_curves(csv_path: str | Path, png_path: str | Path) -> Path:
    """Draw a run's main metrics over its transitions as small panels of one PNG; returns its path.

    Thin lines are the values, thick ones their running mean. Columns that are missing or empty are left out.

    Raises:
      UserError: the table cannot be read or has no metrics, or the picture cannot be written.
    """
    csv_path, png_path = Path(csv_path), Path(png_path)
    table = _read(csv_path)
    names = [name for name in TITLES if name in table and np.isfinite(table[name]).any()]
    if not names:
        raise UserError(f"{csv_path} has no metrics to draw: expected rows with columns such as {next(iter(TITLES))}")
    across, label = _horizontal(table)
    columns = min(COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure = Figure((3.2 * columns, 2.1 * rows + 0.2), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for panel, name in zip(panels.flat, names, strict=False):
        _draw(panel, name, across, table[name])
    for panel in panels.flat[len(names) :]:
        panel.set_visible(False)
    for column in range(columns):
        lowest = panels[(len(names) - 1 - column) // columns, column]
        lowest.set_xlabel(label, fontsize=8)
        lowest.tick_params(labelbottom=True)
    try:
        png_path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(png_path, format="png")
    except OSError as error:
        raise UserError(f"cannot write {png_path}: {error.strerror or error}") from error
    return png_path


def comparison(
    png_path: str | Path, tables: Mapping[str, str | Path], panels: Mapping[str, Sequence[str]], columns: int = 4
) -> Path:
    """Draw columns of several tables over their transitions, a color for each table; returns the PNG's path.

    Args:
      png_path: picture to write.
      tables: CSV file of each label.
      panels: columns to draw in the panel of each title; the first is solid, the second dashed, the third dotted.
      columns: panels in a row.

    Raises:
      UserError: a table cannot be read, or the picture cannot be written.
    """
    png_path = Path(png_path)
    read = {label: _read(Path(path)) for label, path in tables.items()}
    rows = -(-len(panels) // columns)
    figure = Figure((3.2 * columns, 2.3 * rows + 0.4), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False)
    for panel, (title, names) in zip(grid.flat, panels.items(), strict=False):
        for index, table in enumerate(read.values()):
            across, label = _horizontal(table)
            for name, style in zip(names, ("-", "--", ":"), strict=False):
                if name not in table:
                    continue
                known = np.isfinite(table[name])
                marker = "o" if known.mean() < SPARSE or known.sum() < 30 else ""
                panel.plot(across[known], table[name][known], style, color=f"C{index}", linewidth=1.3, marker=marker,
                           markersize=2.5)  # fmt: skip
            panel.set_xlabel(label, fontsize=8)
        panel.set_title(title, fontsize=9, loc="left")
        panel.tick_params(labelsize=7, length=2)
        panel.grid(alpha=0.25, linewidth=0.5)
        panel.spines[["top", "right"]].set_visible(False)
    for panel in grid.flat[len(panels) :]:
        panel.set_visible(False)
    handles = [Line2D([], [], color=f"C{index}", label=label) for index, label in enumerate(read)]
    figure.legend(handles=handles, loc="outside upper center", ncols=min(6, len(handles)), fontsize=8, frameon=False)
    try:
        png_path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(png_path, format="png")
    except OSError as error:
        raise UserError(f"cannot write {png_path}: {error.strerror or error}") from error
    return png_path


def _draw(panel, name: str, across: np.ndarray, values: np.ndarray) -> None:
    color = COLORS.get(name.split("/")[0], OTHER_COLOR)
    known = np.isfinite(values)
    x, y = across[known], values[known]
    if known.mean() < SPARSE or len(y) < 3:
        panel.plot(x, y, color=color, linewidth=1.2, marker="o", markersize=3.5)
    else:
        panel.plot(x, y, color=color, linewidth=0.7, alpha=0.35)
        panel.plot(x, _running_mean(y, max(1, len(y) // 50)), color=color, linewidth=1.6)
    panel.set_title(TITLES[name], fontsize=9, loc="left")
    panel.tick_params(labelsize=7, length=2)
    panel.grid(alpha=0.25, linewidth=0.5)
    panel.spines[["top", "right"]].set_visible(False)
    panel.margins(x=0.02)
    size = np.abs(y).max(initial=0.0)
    if len(y) and np.ptp(y) < 1e-6 * size:  # a constant: its rounding would fill the panel
        panel.set_ylim(y[0] - 0.1 * size, y[0] + 0.1 * size)


def _running_mean(y: np.ndarray, half: int) -> np.ndarray:
    """Mean of ``y [n]`` over ``half`` neighbors on either side, fewer at the ends."""
    total = np.concatenate([[0.0], np.cumsum(y)])
    low = np.maximum(np.arange(len(y)) - half, 0)
    high = np.minimum(np.arange(len(y)) + half + 1, len(y))
    return (total[high] - total[low]) / (high - low)


def _horizontal(table: dict[str, np.ndarray]) -> tuple[np.ndarray, str]:
    """Values and label of the horizontal axis: transitions where the table has them, else iterations or rows."""
    if np.isfinite(table.get("transitions", np.nan)).any():
        return table["transitions"] / 1e6, "million transitions"
    if np.isfinite(table.get("iteration", np.nan)).any():
        return table["iteration"], "iteration"
    return np.arange(len(next(iter(table.values()))), dtype=float), "row"


def _read(path: Path) -> dict[str, np.ndarray]:
    """Columns of the table, ``[rows]`` each; NaN where a cell is empty or, in a run's last row, not yet written."""
    try:
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"cannot read {path}: {reason}") from error
    return {name: np.array([_number(row[name]) for row in rows]) for name in reader.fieldnames or ()}


def _number(cell: str | None) -> float:
    try:
        return float(cell or "nan")
    except ValueError:
        return np.nan
