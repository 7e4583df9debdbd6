"""Shares with their intervals, as bars in groups."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fmpjax.viz.pictures import saved

Bar = tuple[str, float, float, float]  # what it is of, the share, and the ends of its interval


def draw(path: Path, groups: Sequence[tuple[str, Sequence[Bar]]], title: str) -> Path:
    """Draw groups of bars one below the other, each bar with its interval and its share in percent; the path written.

    Args:
      path: of the picture, .png.
      groups: by name, in the order from above.
      title: of the picture.

    Raises:
      UserError: it cannot be written.
    """
    count = sum(len(bars) for _, bars in groups)
    figure = Figure((7.0, 1.0 + 0.19 * count + 0.1 * len(groups)), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes, place, ticks = figure.subplots(), 0.0, []
    for i, (name, bars) in enumerate(groups):
        for label, share, low, high in bars:
            errors = [[100 * (share - low)], [100 * (high - share)]]
            axes.barh(place, 100 * share, xerr=errors, height=0.8, color=f"C{i % 10}", ecolor="0.35", capsize=2)
            axes.text(101, place, f"{100 * share:.1f}", va="center", fontsize=7)
            ticks.append((place, f"{name}  {label}".strip()))
            place += 1.0
        place += 0.6
    axes.set_yticks([at for at, _ in ticks], [text for _, text in ticks], fontsize=7)
    axes.set_ylim(place - 0.6, -0.8)
    axes.set_xlim(0, 100)
    axes.set_xlabel("falls, % of the episodes, with 95 % intervals", fontsize=8)
    axes.tick_params(axis="x", labelsize=7)
    axes.set_title(title, fontsize=9, loc="left", pad=10)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return saved(figure, path)
