"""Heat maps of a policy's obedience over a grid of commands."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
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
        most = float(np.nanmax(values)) if np.isfinite(values).any() else 0.0
        axes.imshow(values, origin="lower", cmap="YlOrRd", vmin=0.0, vmax=most or 1.0, aspect="auto")
        whole = np.all(np.mod(values[np.isfinite(values)], 1) == 0)
        for (i, j), value in np.ndenumerate(values):
            if np.isfinite(value):
                color = "white" if most and value > 0.6 * most else "black"
                text = f"{value:.0f}" if whole else f"{value:.2f}".removeprefix("0")
                axes.text(j, i, text, ha="center", va="center", fontsize=7, color=color)
        axes.set_xticks(range(len(turn)), [f"{value:g}" for value in np.round(turn, 2)], fontsize=7)
        axes.set_yticks(range(len(ahead)), [f"{value:g}" for value in np.round(ahead, 2)], fontsize=7)
        axes.set_xlabel("commanded turning, rad/s", fontsize=8)
        axes.set_ylabel("commanded speed, m/s", fontsize=8)
        axes.set_title(title, fontsize=9, loc="left")
    return saved(figure, path)
