"""Heat maps of a policy's obedience over a grid of commands, or over motions."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fmpjax.viz.pictures import saved


def draw(path: Path, ahead: Sequence[float], turn: Sequence[float], maps: dict[str, np.ndarray]) -> Path:
    """Draw maps ``[len(ahead), len(turn)]`` by title, each in its own colors, with its numbers; the path written.

    Args:
      path: of the picture, .png.
      ahead: commanded speeds of the rows, m/s.
      turn: commanded turning rates of the columns, rad/s.
      maps: by title; what is not a number stays white.

    Raises:
      UserError: it cannot be written.
    """
    figure = Figure((4.2 * len(maps), 3.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (title, values) in zip(figure.subplots(1, len(maps), squeeze=False)[0], maps.items(), strict=True):
        rows, columns = ([f"{value:g}" for value in np.round(ticks, 2)] for ticks in (ahead, turn))
        _map(axes, values, ("commanded speed, m/s", rows), ("commanded turning, rad/s", columns))
        axes.set_title(title, fontsize=9, loc="left")
    return saved(figure, path)


def draw_motions(path: Path, motions: Sequence[str], performed: Sequence[Sequence[float]]) -> Path:
    """Draw which share of the time each of M motions is performed when each is told, ``[M, M]``; the path written.

    Args:
      path: of the picture, .png.
      motions: names, of the rows that are told and of the columns that are performed.
      performed: shares; what is not a number stays white.

    Raises:
      UserError: it cannot be written.
    """
    size = 2.5 + 0.45 * len(motions)
    figure = Figure((size + 1.0, size), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    _map(axes, np.array(performed, float), ("told", motions), ("performed", motions))
    axes.tick_params(axis="x", rotation=45)
    axes.set_title("share of the time", fontsize=9, loc="left")
    return saved(figure, path)


def _map(axes: Axes, values: np.ndarray, rows: tuple[str, Sequence[str]], columns: tuple[str, Sequence[str]]) -> None:
    """A map with its numbers; rows and columns each have a label and a name for each."""
    most = float(np.nanmax(values)) if np.isfinite(values).any() else 0.0
    axes.imshow(values, origin="lower", cmap="YlOrRd", vmin=0.0, vmax=most or 1.0, aspect="auto")
    whole = np.all(np.mod(values[np.isfinite(values)], 1) == 0)
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            color = "white" if most and value > 0.6 * most else "black"
            text = f"{value:.0f}" if whole else f"{value:.2f}".removeprefix("0")
            axes.text(j, i, text, ha="center", va="center", fontsize=7, color=color)
    axes.set_xticks(range(len(columns[1])), columns[1], fontsize=7)
    axes.set_yticks(range(len(rows[1])), rows[1], fontsize=7)
    axes.set_xlabel(columns[0], fontsize=8)
    axes.set_ylabel(rows[0], fontsize=8)
