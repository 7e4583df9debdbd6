"""What changes along a clip."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fmpjax.viz.pictures import saved


def draw(path: Path, seconds: float, curves: Mapping[str, Sequence[float]]) -> Path:
    """Draw curves by title, one below the other, over a clip's equal parts; the path written.

    Args:
      path: of the picture, .png.
      seconds: length of the clip.
      curves: by title; what is not a number is left out.

    Raises:
      UserError: it cannot be written.
    """
    figure = Figure((6.5, 1.6 * len(curves)), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    all_axes = figure.subplots(len(curves), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (title, values) in zip(all_axes, curves.items(), strict=True):
        edges = np.linspace(0.0, seconds, len(values) + 1)
        axes.stairs(np.asarray(values, float), edges, fill=True, alpha=0.35)
        axes.stairs(np.asarray(values, float), edges, baseline=None, color="C0")
        axes.set_title(title, fontsize=9, loc="left")
        axes.set_ylim(bottom=0.0)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.25, linewidth=0.5)
    all_axes[-1].set_xlabel("time in the clip, s", fontsize=8)
    return saved(figure, path)
