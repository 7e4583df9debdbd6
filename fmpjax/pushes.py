"""The pushes of played episodes: to which side each one went, and after which of them the robot fell."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fmpjax import rotations

SIDES = ("ahead", "left", "back", "right")  # quadrants about the robot's heading before the push


class Push(NamedTuple):
    """One push of an episode."""

    episode: int
    step: int  # before which it came
    side: str  # of `SIDES`
    speed: float  # m/s, horizontal
    fell: bool  # whether the episode ended in a fall before the next push


class Side(NamedTuple):
    """All pushes to one side."""

    side: str
    pushes: int
    falls: int  # after them


def pushes_of(qpos: np.ndarray, length: np.ndarray, fell: np.ndarray, added: np.ndarray) -> list[Push]:
    """The pushes of N episodes, one episode after the other.

    Args:
      qpos: ``[T, N, 7 + J]`` after each step.
      length: ``[N]`` steps survived.
      fell: ``[N]`` bool.
      added: ``[T, N, 6]`` what was added to the root's velocity before each step.
    """
    pushes = []
    for episode in range(len(length)):
        planar = added[: length[episode], episode, :2].astype(np.float64)
        steps = np.flatnonzero(planar.any(axis=-1))
        before = qpos[np.maximum(steps - 1, 0), episode, 3:7].astype(np.float64)
        turned = np.arctan2(planar[steps, 1], planar[steps, 0]) - rotations.yaw(before)
        for i, (step, angle) in enumerate(zip(steps, turned, strict=True)):
            side, last = SIDES[round(angle / (np.pi / 2)) % 4], i == len(steps) - 1
            speed = float(np.linalg.norm(planar[step]))
            pushes.append(Push(episode, int(step), side, speed, bool(last and fell[episode])))
    return pushes


def by_side(pushes: Sequence[Push]) -> list[Side]:
    """How many pushes went to each side, and how many of them a fall followed."""
    sides = {side: [push.fell for push in pushes if push.side == side] for side in SIDES}
    return [Side(side, len(fell), sum(fell)) for side, fell in sides.items()]


def sides_text(sides: Sequence[Side]) -> str:
    """A line for people: the share of the pushes to each side that a fall followed."""
    parts = [f"{s.side} {100 * s.falls / s.pushes:.0f} % of {s.pushes}" for s in sides if s.pushes]
    return "fell after pushes " + ", ".join(parts)
