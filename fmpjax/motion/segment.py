"""Stretches of a long recording that can be trained: walking, running, turning, dancing, standing; falls left out.

Each sample gets a kind from what its neighborhood of `WINDOW` s does; stretches of one kind that last long enough are
measured by `check`. Speeds scale with the robot's hip height by the Froude number, so the limits serve every robot.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, uniform_filter1d

from fmpjax import rotations, tables
from fmpjax.errors import UserError
from fmpjax.motion import check
from fmpjax.motion.clip import MotionClip
from fmpjax.motion.soles import sole_points
from fmpjax.robots import Robot

KINDS = ("standing", "dancing", "walking", "turning", "running")
MOVING = ("walking", "turning", "running")
DOWN, BROKEN = "down", "broken"  # kinds that are left out
WINDOW = 1.0  # s
LEAST = 2.0  # s of a stretch, by default
LOW, TILTED = 0.65, 0.5  # of the default pose's root height, and cosine of tilt, below which the robot is down
SETTLE = 0.5  # s around a fall that are left out with it
# Froude numbers v²/(g h) from which a robot walks, runs where it flies, and runs: 0.25, 1.0 and 2.0 m/s on a G1.
WALKS, FLIES, RUNS = 0.008, 0.13, 0.52
FLIGHT, OFF = 0.05, 0.015  # share of the time in which both soles are higher than so many m
TURNS = 0.3  # rad/s
BACK, ASIDE = 0.1, 0.3  # m/s backward and to the side, means over `WINDOW`, up to which a stretch goes forward
MOVES = 0.6  # rad/s, root mean square over the joints


class Stretch(NamedTuple):
    """Samples of one kind and how they do."""

    rows: slice  # of the clip
    first: int  # row of the file
    last: int  # likewise, included
    kind: str
    clip: MotionClip
    speed: float  # m/s, mean over the floor
    turning: float  # rad/s, mean, to the left
    verdict: str  # of `check`
    fault: str  # the first thing that is wrong, or nothing


def segment(robot: Robot, clip: MotionClip, least: float = LEAST, offset: int = 0) -> tuple[list[Stretch], np.ndarray]:
    """The stretches of a clip that last ``least`` s or more, and the kind of every sample ``[T]``.

    ``offset`` is the file's row that is the clip's first.

    Raises:
      UserError: ``least`` is not a second or more.
    """
    if not 1.0 <= least < np.inf:
        raise UserError(f"--least is {least:g}: expected at least 1 s, which training needs")
    kind = _merged(kinds(robot, clip), least * clip.rate)
    edges = np.flatnonzero(kind[1:] != kind[:-1]) + 1
    found = []
    for first, end in zip([0, *edges], [*edges, len(kind)], strict=True):
        if kind[first] in KINDS and (end - 1 - first) / clip.rate >= least:
            found.append(_measured(robot, clip, int(first), int(end) - 1, str(kind[first]), offset))
    return found, kind


def _merged(kind: np.ndarray, least: float) -> np.ndarray:
    """Kinds ``[T]`` in which neighbors that move and are shorter than ``least`` samples are one stretch.

    A walk that turns every second is a turn; what walks and runs in turn is what it does most.
    """
    out = kind.copy()
    edges = [0, *(np.flatnonzero(kind[1:] != kind[:-1]) + 1), len(kind)]
    group: list[int] = []  # edges of the neighbors so far
    for first, end in [*itertools.pairwise(edges), (len(kind), len(kind))]:
        short = end - first <= least and first < len(kind) and kind[first] in MOVING
        if short:
            group = group or [first]
            group.append(end)
            continue
        if len(group) > 2:
            part = kind[group[0] : group[-1]]
            share = [np.mean(part == name) for name in MOVING]
            most = MOVING[int(np.argmax(share))]
            out[group[0] : group[-1]] = "turning" if most != "running" and "turning" in part else most
        group = []
    return out


def kinds(robot: Robot, clip: MotionClip) -> np.ndarray:
    """The kind of every sample, ``[T]``."""
    size = max(3, round(WINDOW * clip.rate))

    def mean(values: np.ndarray) -> np.ndarray:
        return uniform_filter1d(values.astype(float), size, axis=0, mode="nearest")

    way = mean(clip.qvel[:, :2])
    froude = np.sum(way**2, axis=1) / (9.81 * robot.default_qpos[2])
    turn = np.abs(mean(np.gradient(clip.yaw) * clip.rate))
    points, _ = sole_points(robot, clip.qpos)
    lowest = (points[..., 2] - robot.sole_radius).min(axis=1)
    flight = mean(lowest > OFF) > FLIGHT
    moves = np.sqrt(mean(np.mean(clip.qvel[:, 6:] ** 2, axis=1)))
    kind = np.select(
        [(froude > RUNS) | (froude > FLIES) & flight, turn > TURNS, froude > WALKS, moves > MOVES],
        ["running", "turning", "walking", "dancing"],
        "standing",
    )
    # The kind that is most frequent around: a step that is slower ends no walk.
    share = np.stack([mean(kind == name) for name in KINDS])
    kind = np.array(KINDS)[np.argmax(share, axis=0)].astype("U8")
    down = (clip.qpos[:, 2] - lowest < LOW * robot.default_qpos[2]) | (rotations.up(clip.qpos[:, 3:7]) < TILTED)
    kind[binary_dilation(down, iterations=max(1, round(SETTLE * clip.rate)))] = DOWN
    kind[_jumps(clip)] = BROKEN
    return kind


def _jumps(clip: MotionClip) -> np.ndarray:
    """Samples ``[T]`` at which joints or the root jump, by the figures of `check`."""
    broken = np.zeros(len(clip), bool)
    speed = np.abs(np.diff(clip.qpos[:, 7:], axis=0)).max(axis=1) * clip.rate
    broken[1:] |= ~(speed < check.RANGES["joint speed"].broken)
    for name, part in (("joint acceleration", clip.qpos[:, 7:]), ("root acceleration", clip.qpos[:, :3])):
        second = np.diff(part, 2, axis=0) * clip.rate**2
        size = np.linalg.norm(second, axis=1) if part.shape[1] == 3 else np.abs(second).max(axis=1)
        broken[1:-1] |= ~(size < check.RANGES[name].broken)
    return broken


def _measured(robot: Robot, clip: MotionClip, first: int, last: int, kind: str, offset: int) -> Stretch:
    rows = clip.qpos[first : last + 1]
    part = MotionClip.from_qpos(f"{clip.name}-{kind}-{first + offset}", clip.robot, clip.rate, rows)
    faults = check.faults(robot, part)
    broken = any(" is broken: " in fault for fault in faults)
    speed = float(np.linalg.norm(np.diff(rows[:, :2], axis=0), axis=1).mean() * clip.rate)
    verdict = "broken" if broken else "odd" if faults else "good"
    turning, fault, found = part.turning, faults[0] if faults else "", slice(first, last + 1)
    return Stretch(found, first + offset, last + offset, kind, part, speed, turning, verdict, fault)


def forward(clip: MotionClip) -> bool:
    """Whether a clip stands, or walks and turns ahead: never backward or to a side for a second."""
    width = min(len(clip), max(1, round(WINDOW * clip.rate)))
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(clip.heading_velocities[:, :2], axis=0)])
    ahead, left = ((sums[width:] - sums[:-width]) / width).T
    return bool(ahead.min() > -BACK and abs(left).max() < ASIDE)


def table(clip: MotionClip, found: list[Stretch], kind: np.ndarray) -> str:
    """The stretches as lines of text, and what of the clip is in none."""
    rows = [
        (
            f"{s.first}:{s.last}", f"{(s.last - s.first) / clip.rate:.1f}", s.kind, f"{s.speed:.2f}",
            f"{s.turning:.2f}", s.verdict, s.fault,
        )
        for s in found
    ]  # fmt: skip
    headings = ("rows", "seconds", "kind", "m/s", "rad/s", "verdict", "")
    lines = [tables.lines("{:<16}{:<9}{:<10}{:<7}{:<8}{:<8}{}", [headings, *rows])]
    inside = sum(s.last - s.first + 1 for s in found) / clip.rate
    down, broken = (float(np.count_nonzero(kind == k)) / clip.rate for k in (DOWN, BROKEN))
    rest = len(clip) / clip.rate - inside - down - broken
    lines.append(
        f"left out: {down:.1f} s on the ground or falling, {broken:.2f} s of jumps, {max(rest, 0):.1f} s in pieces "
        "that are too short"
    )
    return "\n".join(lines)
