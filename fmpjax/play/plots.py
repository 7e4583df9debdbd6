"""Curves of the last seconds: speed, turning, feet on the floor, the motion prior's score."""

from collections.abc import Sequence

import numpy as np
import viser
from viser import uplot

from fmpjax.play.player import KEPT, Player
from fmpjax.play.session import Session

COLORS = ("#2a6fb0", "#c8553d", "#3a8a6b", "#9b6fb0", "#b08a2a", "#555555")
TOLD = "#888888"
HEIGHT = 140  # px


class Chart:
    """Lines over the time of the session."""

    def __init__(self, gui: viser.GuiApi, title: str, names: Sequence[str], colors: Sequence[str], **options):
        """An empty chart with a line per name."""
        lines = [
            uplot.Series(label=name, stroke=color, width=1.5, **({"dash": (6, 4)} if color == TOLD else {}))
            for name, color in zip(names, colors, strict=True)
        ]
        self.names = list(names)
        self._handle = gui.add_uplot(
            (np.zeros(1),) * (1 + len(lines)),
            (uplot.Series(label="s"), *lines),
            title=title,
            scales={"x": uplot.Scale(time=False), "y": uplot.Scale(**options)},
            legend=uplot.Legend(show=len(lines) > 1, live=False),
            cursor=uplot.Cursor(show=False),
            height=HEIGHT,
        )

    def draw(self, times: np.ndarray, *lines: np.ndarray) -> None:
        """Show lines ``[T]`` over the times ``[T]`` (s); nothing of fewer than two points."""
        if len(times) > 1:
            self._handle.data = (times, *(np.asarray(line, float) for line in lines))


class Plots:
    """The curves of a session."""

    def __init__(self, gui: viser.GuiApi, session: Session, *, scored: bool):
        """Empty charts; ``scored`` says whether there is a motion prior whose score is drawn."""
        self._session, players = session, session.players
        labels, colors = [player.label for player in players], [COLORS[i % len(COLORS)] for i in range(len(players))]
        steered = any(player.steered for player in players)
        told, gray = (["told"], [TOLD]) if steered else ([], [])
        self.speed = Chart(gui, "speed ahead, m/s", labels + told, colors + gray)
        self.turn = Chart(gui, "turning to the left, rad/s", labels + told, colors + gray) if steered else None
        feet = _foot_names(players[0])
        title = "load on the feet" + (f" of {labels[0]}" if len(players) > 1 else "") + ", of the weight"
        self.feet = Chart(gui, title, feet, COLORS[: len(feet)], range=(0.0, 2.5)) if feet else None
        self.score = (
            Chart(gui, "the motion prior's score", [*labels, "demonstration"], [*colors, TOLD]) if scored else None
        )
        self._scores: list[tuple[float, ...]] = []

    def add_score(self, time: float, scores: Sequence[float], demonstration: float) -> None:
        """Remember the score of each player at a time (s), NaN where there is none, and the demonstration's."""
        # A new list, for another thread may be drawing the old one.
        self._scores = [*(kept for kept in self._scores if kept[0] > time - KEPT), (time, *scores, demonstration)]

    def update(self) -> None:
        """Draw the last seconds."""
        with self._session.frozen():
            rows = [list(player.rows) for player in self._session.players]
        count = min(map(len, rows))
        if count < 2:
            return
        rows = [kept[-count:] for kept in rows]
        times = np.array([row.time for row in rows[0]])
        velocity = np.array([[row.velocity for row in kept] for kept in rows])  # [P, T, 3]
        command = np.array([row.command for row in rows[0]])
        told = self.turn is not None
        self.speed.draw(times, *velocity[..., 0], *([command[:, 0]] if told else []))
        if self.turn is not None:
            self.turn.draw(times, *velocity[..., 2], command[:, 2])
        if self.feet is not None:
            model = self._session.players[0].simulation.model
            weight = model.body_subtreemass[0] * np.linalg.norm(model.opt.gravity)
            load = np.array([row.load for row in rows[0]]) / max(weight, 1e-9)
            self.feet.draw(times, *load.T[: len(self.feet.names)])
        if self.score is not None and self._scores:
            self.score.draw(*np.array(self._scores).T)


def _foot_names(player: Player) -> list[str]:
    model = player.simulation.model
    return [model.body(body).name.removesuffix("_link").replace("_", " ") for body in player.feet]
