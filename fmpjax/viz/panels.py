"""Small line plots side by side, for the experiments' figures."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fmpjax.errors import UserError


class Line(NamedTuple):
    """A curve; labels that several panels share are in the legend once."""

    x: Sequence[float]
    y: Sequence[float]
    color: str
    style: str = "-"  # as matplotlib has them; "" for markers alone
    marker: str = ""
    hollow: bool = False  # markers with white inside


class Panel(NamedTuple):
    """One plot of lines by label."""

    title: str
    across: str  # label of the horizontal axis
    lines: Mapping[str, Line]
    logarithmic: bool = False  # horizontally


def draw(path: Path, panels: Sequence[Panel], *, width: float = 3.6, height: float = 3.0) -> Path:
    """Draw the panels in a row, the legend above; returns the picture's path.

    Raises:
      UserError: it cannot be written.
    """
    figure = Figure((width * len(panels), height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    handles = {}
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        for label, line in panel.lines.items():
            (handles[label],) = axes.plot(
                line.x, line.y, linestyle=line.style or "none", color=line.color, marker=line.marker, linewidth=1.5,
                markersize=5, markerfacecolor="white" if line.hollow else line.color, zorder=3 if line.hollow else 2,
            )  # fmt: skip
        axes.set_title(panel.title, fontsize=9, loc="left")
        axes.set_xlabel(panel.across, fontsize=8)
        axes.set_xscale("log" if panel.logarithmic else "linear")
        axes.tick_params(labelsize=7, length=2)
        axes.grid(alpha=0.25, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    figure.legend(
        handles.values(), handles, loc="outside upper center", ncols=min(5, len(handles)), fontsize=8, frameon=False
    )
    partial = path.with_name(path.name + ".partial")
    try:
        figure.savefig(partial, format="png")
        partial.replace(path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}") from error
    return path
