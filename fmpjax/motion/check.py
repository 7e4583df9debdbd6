"""Whether a clip is fit to learn from: figures with healthy ranges, and a verdict for each."""

import copy
import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.signal import savgol_filter

from fmpjax import rotations, tables
from fmpjax.motion.clip import MotionClip
from fmpjax.motion.edit import loop_gap, loops
from fmpjax.motion.soles import slides, sole_points
from fmpjax.robots import Robot

CONTACT = 0.01  # m, a sole point below this height counts as standing
BEARING = 0.03  # m, a sole point at this height bears nothing, one on the floor its share
DAMPING = 1e-3  # keeps forces finite where few points are near the floor
PIECE, LEAST_PIECE = 5000, 10  # samples that are checked at once, for memory, and that are worth it
MOST_TORQUES = 20_000  # samples of a clip whose torques are measured, for time
MOST_PACE = 60.0  # s in which strides are looked for
WAY = 0.5  # m; a root that ends nearer to its start has no way
TURNED, HEADED = np.radians(45), np.radians(20)  # from where a motion turns, or heads off +x
STEADY = 0.9  # correlation of a gait with itself a stride later
SLOW, FAST = 0.55, 1.8  # of the speed that strides suggest: walks and runs at their own rate are within
SMOOTHING = 0.07  # s, half of the window over which accelerations are fitted for the torques


class Range(NamedTuple):
    """A figure's unit, its healthy range, and from where on the clip is broken."""

    unit: str
    low: float
    high: float
    broken: float = np.inf


RANGES = {
    "duration": Range("s", 1.0, np.inf),
    "speed": Range("m/s", 0.0, 4.0, 12.0),
    "limit excess": Range("rad", 0.0, 0.02, 0.2),
    "joint speed": Range("rad/s", 0.0, 20.0, 60.0),
    "joint acceleration": Range("rad/s²", 0.0, 600.0, 2500.0),
    "root acceleration": Range("m/s²", 0.0, 40.0, 200.0),
    "root turn": Range("rad/s", 0.0, 10.0, 30.0),
    "tilt": Range("deg", 0.0, 45.0, 120.0),
    "heading": Range("deg", -np.inf, np.inf),
    "turning": Range("rad/s", -np.inf, np.inf),
    "flips": Range("", 0, 0),
    "foot slip": Range("m/s", 0.0, 0.3, 1.0),
    "penetration": Range("m", 0.0, 0.02, 0.08),
    "float": Range("m", 0.0, 0.02, 0.10),
    "torque": Range("of the limit", 0.0, 1.25, 4.0),
    "loop gap": Range("rad", 0.0, np.inf),
}


_VERDICTS = ("good", "odd", "broken")


class Figure(NamedTuple):
    """One figure of a clip; ``where`` names the joint or the time of the worst value."""

    name: str
    value: float
    where: str = ""

    @property
    def verdict(self) -> str:
        """``good``, ``odd`` (outside the healthy range) or ``broken``."""
        span = RANGES[self.name]
        if not self.value < span.broken:
            return "broken"
        return "good" if span.low <= self.value <= span.high else "odd"


def check(robot: Robot, clip: MotionClip, flips: int = 0) -> list[Figure]:
    """The figures of a clip of any length, in the order of `RANGES`; a long one is measured in pieces, for memory.

    ``duration``; ``speed``, the root's mean over the floor; ``limit excess`` of a joint beyond its limit; greatest
    ``joint speed`` and, from second differences, ``joint acceleration``, ``root acceleration``; ``root turn``, its
    greatest angular velocity; ``tilt`` of the root from upright, exceeded half of the time; ``heading`` of its way from
    start to end, from +x to the left, or of its x axis where it stays; ``turning``, mean rate of its heading to the
    left; ``flips`` of the root quaternion's sign in the file; ``foot slip``, the mean speed over
    the floor of sole points below `CONTACT`; ``penetration``, greatest; ``float``, the height of the lowest sole point
    that is undercut a tenth of the time; ``torque``, the greatest share of a motor's limit, exceeded 1 % of the time;
    ``loop gap``, the greatest angle between the last pose and the first.

    ``foot slip``, ``float`` and ``torque`` are those of the worst piece of `PIECE` samples. Of more than `MOST_TORQUES`
    samples, torques are measured at every second, third, ... one.
    """
    found, every = _whole(clip, flips), -(-len(clip) // MOST_TORQUES)
    for first in range(0, max(1, len(clip) - 1), PIECE - 1):
        rows = slice(first, first + PIECE)
        piece = clip if len(clip) <= PIECE else dataclasses.replace(clip, qpos=clip.qpos[rows], qvel=clip.qvel[rows])
        if len(piece) < LEAST_PIECE < len(clip):
            continue
        for figure in _measured(robot, piece, first / clip.rate, every):
            known = found.setdefault(figure.name, figure)
            if not figure.value <= known.value:  # more, or not a number
                found[figure.name] = figure
    return [found[name] for name in RANGES]


def _whole(clip: MotionClip, flips: int) -> dict[str, Figure]:
    """Figures that only the whole clip has, by name."""
    facing = float(np.degrees(rotations.yaw(np.asarray(clip.qpos[0, 3:7]))))
    figures = (
        Figure("duration", clip.duration),
        Figure("speed", float(np.linalg.norm(np.diff(clip.qpos[:, :2], axis=0), axis=1).mean() * clip.rate)),
        Figure("tilt", float(np.degrees(np.median(np.arccos(np.clip(rotations.up(clip.qpos[:, 3:7]), -1, 1)))))),
        Figure("heading", float(np.degrees(heading(clip))), f"faces {facing:.0f}°"),
        Figure("turning", clip.turning, f"{np.degrees(spread(clip)):.0f}° at most from the first heading"),
        Figure("flips", flips, "taken out on reading" if flips else ""),
        Figure("loop gap", loop_gap(clip)),
    )
    return {figure.name: figure for figure in figures}


def _measured(robot: Robot, clip: MotionClip, start: float, every: int) -> list[Figure]:
    """The other figures of a piece that begins at ``start`` s, torques at every ``every``-th sample."""
    joints, rate = clip.qpos[:, 7:], clip.rate
    names, times = robot.joint_names, start + np.arange(len(clip)) / rate
    points, rotation = sole_points(robot, clip.qpos)
    height = points[..., 2] - robot.sole_radius
    lowest = height.min(axis=1)
    standing = (height[1:] < CONTACT) & (height[:-1] < CONTACT)
    slide = slides(robot, points, rotation)[standing] * rate
    share = torques(robot, clip, points, height, every) / robot.effort
    greatest = np.percentile(share.max(axis=1), 99)

    def worst(name: str, values: np.ndarray, first: int = 0) -> Figure:
        row, column = np.unravel_index(np.argmax(values), values.shape)
        what = f"{names[column]} at " if values.shape[1] == len(names) else "at "
        return Figure(name, float(values[row, column]), f"{what}{times[row + first]:.2f} s")

    excess = np.maximum(0, np.maximum(robot.joint_low - joints, joints - robot.joint_high))
    limit = worst("limit excess", excess)
    return [
        limit if limit.value else Figure("limit excess", 0.0),
        worst("joint speed", np.abs(np.diff(joints, axis=0)) * rate),
        worst("joint acceleration", np.abs(np.diff(joints, 2, axis=0)) * rate**2, 1),
        worst("root acceleration", np.linalg.norm(np.diff(clip.qpos[:, :3], 2, axis=0), axis=1)[:, None] * rate**2, 1),
        worst("root turn", np.linalg.norm(clip.qvel[:, 3:6], axis=1)[:, None]),
        Figure("foot slip", float(slide.mean()) if len(slide) else 0.0, "" if len(slide) else "nothing stands"),
        worst("penetration", np.maximum(0.0, -lowest)[:, None]),
        Figure("float", float(max(0.0, np.percentile(lowest, 10)))),
        Figure("torque", float(greatest), names[int(np.argmax(np.percentile(share, 99, axis=0)))]),
    ]


def heading(clip: MotionClip) -> float:
    """Direction (rad from +x) of the root's way from start to end, or of its first x axis where the way is short."""
    way = clip.qpos[-1, :2] - clip.qpos[0, :2]
    return float(np.arctan2(way[1], way[0]) if np.linalg.norm(way) > WAY else rotations.yaw(clip.qpos[0, 3:7]))


def spread(clip: MotionClip) -> float:
    """Greatest angle (rad) of the root's heading from that of the first sample."""
    return float(np.abs(clip.yaw - clip.yaw[0]).max())


def unsuited(robot: Robot, clip: MotionClip, *, axes: str, reset: str, seconds: float) -> list[str]:
    """Sentences on what does not fit the settings of a run, each with what helps.

    Args:
      axes: ``features.axes``, "world" or "heading".
      reset: ``env.reset``, "dataset" or "fixed".
      seconds: length of an evaluation's episode, s.
    """
    said = []
    turned, rate, ahead = spread(clip), clip.turning, heading(clip)
    if axes == "world" and turned > TURNED:
        said.append(
            f"the heading turns by {np.degrees(turned):.0f}° ({rate:.2f} rad/s on average), and windows are in the "
            "world's axes: --set features.axes=heading learns turns"
        )
    elif axes == "world" and reset == "fixed" and abs(ahead) > HEADED:
        said.append(
            f"the motion heads {np.degrees(ahead):.0f}° from +x, and episodes start in the fixed pose, which looks "
            "along +x: `fmpjax motion import --heading 0` turns the motion"
        )
    if clip.duration < seconds and not loops(clip):
        said.append(
            f"the motion lasts {clip.duration:.1f} s and does not loop, and an evaluation lasts {seconds:g} s: "
            "it does not say what the policy should do after that"
        )
    doubt = doubtful_rate(robot, clip)
    return said if doubt is None else [*said, doubt]


def doubtful_rate(robot: Robot, clip: MotionClip) -> str | None:
    """A sentence where the file has no rate and the strides suggest another one than was assumed."""
    if not any(fact.what == "rate" and fact.why.startswith("assumed") for fact in clip.reading.facts):
        return None
    ratio, stride = pace(robot, clip)
    if SLOW < ratio < FAST:
        return None
    return (
        f"strides of {stride:.2f} m are usually {'faster' if ratio < 1 else 'slower'}, and the file has no "
        "rate: check it, and give it by --fps"
    )


def pace(robot: Robot, clip: MotionClip) -> tuple[float, float]:
    """The speed in relation to what legs of such a length do with such strides, and a stride (m); (1, 0) if unknown.

    Animals of all sizes make strides of 2.3 hip heights times the Froude number to the power 0.3 (Alexander 1976).
    Lengths do not depend on a file's rate, so a wrong rate shows.
    """
    left, right = robot.sagittal_joints[0], robot.sagittal_joints[3]
    rows = slice(0, int(MOST_PACE * clip.rate))
    swing = clip.qpos[rows, 7 + left] - clip.qpos[rows, 7 + right]
    swing = swing - swing.mean()
    lags = np.arange(int(0.3 * clip.rate), min(int(3 * clip.rate), len(swing) * 2 // 3))
    if len(lags) < 3 or swing.std() < 0.1:
        return 1.0, 0.0
    alike = np.array([np.corrcoef(swing[:-lag], swing[lag:])[0, 1] for lag in lags])
    peaks = np.flatnonzero((alike[1:-1] >= alike[:-2]) & (alike[1:-1] >= alike[2:]) & (alike[1:-1] > STEADY)) + 1
    if not len(peaks):
        return 1.0, 0.0
    speed = np.linalg.norm(np.diff(clip.qpos[rows, :2], axis=0), axis=1).mean() * clip.rate
    hip, stride = robot.default_qpos[2], speed * lags[peaks[0]] / clip.rate
    if stride < 0.5 * hip:
        return 1.0, 0.0
    return speed / (np.sqrt(9.81 * hip) * (stride / (2.3 * hip)) ** (1 / 0.6)), stride


def faults(robot: Robot, clip: MotionClip) -> list[str]:
    """A sentence per figure that is not good, broken ones first."""
    figures = sorted(check(robot, clip), key=lambda figure: -_VERDICTS.index(figure.verdict))
    return [
        f"{f.name} is {f.verdict}: {_value(f)}, healthy {_healthy(f)}{f' ({f.where})' if f.where else ''}"
        for f in figures
        if f.verdict != "good"
    ]


def flips(q_wxyz: np.ndarray) -> int:
    """How often the sign of quaternions ``[T, 4]`` changes between samples that are the same orientation nearly."""
    return int(np.count_nonzero(np.sum(q_wxyz[1:] * q_wxyz[:-1], axis=1) < 0))


def torques(robot: Robot, clip: MotionClip, points: np.ndarray, height: np.ndarray, every: int = 1) -> np.ndarray:
    """Motor torques that the motion asks for at every ``every``-th sample, magnitudes ``[S, J]`` N m.

    Inverse dynamics gives the wrench that must act on the root, and torques as if it did. The floor gives that wrench
    instead: the least forces at sole points near the floor (``points [T, P, 3]``, ``height [T, P]`` m) that sum to it,
    each weighted by its nearness. Forces may pull and know no friction, and what nothing near the floor can give is
    left out: an estimate, good enough to tell a motor's limit from a multiple of it. Velocities are fitted by parabolas
    over twice `SMOOTHING`, or the interpolation between frames would pass for jolts.
    """
    model, data = copy.copy(robot.model), mujoco.MjData(robot.model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    window = min(2 * max(2, round(SMOOTHING * clip.rate)) + 1, len(clip) - 1 + len(clip) % 2)
    speed = savgol_filter(clip.qvel, window, 2, axis=0)[::every]
    acceleration = savgol_filter(clip.qvel, window, 2, deriv=1, delta=1 / clip.rate, axis=0)[::every]
    qpos, height = clip.qpos[::every], height[::every]
    bottom = points[::every] - [0.0, 0.0, 1.0] * robot.sole_radius[:, None]
    needed = np.zeros((len(qpos), model.nv))
    bodies, which = np.unique(robot.sole_body + 1, return_inverse=True)
    place = np.zeros((len(qpos), len(bodies), 3))
    moves, turns = (np.zeros((len(qpos), len(bodies), 3, model.nv)) for _ in range(2))
    for i in range(len(qpos)):
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos[i], speed[i], acceleration[i]
        mujoco.mj_inverse(model, data)
        needed[i] = data.qfrc_inverse
        place[i] = data.xpos[bodies]
        for b, body in enumerate(bodies):
            mujoco.mj_jacBody(model, data, moves[i, b], turns[i, b], body)
    # A point moves with its body and by the body's turn crossed with where it is from the body.
    arm = (bottom - place[:, which])[..., None]
    jacobian = moves[:, which] + np.cross(turns[:, which], arm, axis=2)
    weight = np.repeat(np.clip(1 - height / BEARING, 0, 1), 3, axis=1)[:, :, None]
    jacobian = jacobian.reshape(len(qpos), -1, model.nv)
    root = jacobian[:, :, :6]
    gram = np.swapaxes(root, 1, 2) @ (weight * root) + DAMPING * np.eye(6)
    force = weight * (root @ np.linalg.solve(gram, needed[:, :6, None]))
    return np.abs(needed[:, 6:] - (np.swapaxes(jacobian[:, :, 6:], 1, 2) @ force)[..., 0])


def _value(figure: Figure) -> str:
    return f"{figure.value:.3g} {RANGES[figure.name].unit}"


def _healthy(figure: Figure) -> str:
    span = RANGES[figure.name]
    if not np.isfinite(span.low):
        return "any"
    return f"{span.low:g} to {span.high:g}" if np.isfinite(span.high) else f"from {span.low:g}"


def table(figures: list[Figure]) -> str:
    """The figures as lines of text: value, healthy range, verdict."""
    rows = [(f.name, _value(f), _healthy(f), f.verdict, f.where) for f in figures]
    return tables.lines("{:<19}{:<20}{:<12}{:<8}{}", [("figure", "value", "healthy", "verdict", ""), *rows])
