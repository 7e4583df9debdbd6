"""Walks of our own: from a velocity to a motion.

`make` finds one stride at a commanded velocity: how it looks (`fmpjax.motion.style`), how fast the steps are and how
high the pelvis is, so that the legs reach the feet with bent knees (`fmpjax.motion.stride`). `LIBRARY` has the
arguments of the bundled motions; ``fmpjax motion synthesize`` is the command.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from fmpjax import robots
from fmpjax.errors import UserError
from fmpjax.motion.balance import zero_moment_point
from fmpjax.motion.clip import MotionClip
from fmpjax.motion.formats import MOST_SAMPLES
from fmpjax.motion.gait_figures import measure
from fmpjax.motion.legs import Leg, OutOfReach
from fmpjax.motion.path import moved, turned
from fmpjax.motion.stride import Stride
from fmpjax.motion.style import FASTEST, OPEN, Command, Style, effort, fitted
from fmpjax.robots import CONTACT_DEPTH, Robot

__all__ = ["LIBRARY", "Command", "Gait", "OutOfReach", "Style", "make", "measure", "synthesize", "zero_moment_point"]

BENT = 0.19  # rad, least angle of a knee at the robot's own speed; a straight knee makes the joints race
MARGIN = 0.04  # rad, least distance of a leg's joint to its limit
LOWEST = 0.88  # of the height of the pelvis in the robot's own walk
GAP = 0.04  # m, between the soles where one passes the other
TRIAL = 48  # samples of a stride that is tried
TRIES = (0.0, 0.5, 1.0)  # cadences between the fitting one and the fastest
SCALES = 6  # halvings, to tell how much of a command is within reach

# The bundled motions by robot, as keywords of `synthesize`.
LIBRARY = {"strider": {"walk": {}}}
LIBRARY["unitree_g1"] = {
    "walk": {},
    "slow_walk": {
        "speed": 0.5,
        "style": Style(
            cadence=1.4,
            landing_pitch=-0.2,
            lowest_pitch=-0.25,
            highest_pitch=0.6,
            heel_off=0.42,
            toe_off=0.59,
            highest_at=0.63,
            swing_lift=0.03,
            pelvis_yaw=0.05,
            arm_swing=0.2,
            elbow_swing=0.1,
        ),
    },
    "fast_walk": {
        "speed": 1.1,
        "style": Style(
            cadence=2.1,
            landing_pitch=-0.32,
            lowest_pitch=-0.39,
            heel_off=0.38,
            highest_at=0.62,
            pelvis_height=0.735,
            pelvis_bob=0.02,
            pelvis_yaw=0.1,
            arm_swing=0.42,
        ),
    },
    "turn_left": {"speed": 0.7, "turn": 0.5, "style": Style(pelvis_height=0.755)},
    "turn_right": {"speed": 0.7, "turn": -0.5, "style": Style(pelvis_height=0.755)},
}


@dataclasses.dataclass(frozen=True, eq=False)
class Gait:
    """One stride of a steady walk, which the next ones repeat further along the path.

    ``qpos [N, 7 + J]`` holds the stride's configurations at ``rate`` (Hz). A stride moves the walk on by ``way [2]``
    (m) and turns it by ``angle`` (rad). ``style`` has every number; ``chosen`` names those that are neither given nor
    the robot's own.
    """

    robot: Robot
    command: Command
    rate: float
    style: Style
    chosen: tuple[str, ...]
    way: np.ndarray
    angle: float
    qpos: np.ndarray

    def clip(self, duration: float) -> MotionClip:
        """As many whole strides as fit into ``duration`` (s), and the sample that closes the last.

        Raises:
          UserError: the duration is not positive, is too long, or no stride fits.
        """
        if not (math.isfinite(duration) and duration > 0):
            raise UserError(f"duration is {duration}, expected a positive number of s")
        if duration * self.rate > MOST_SAMPLES:
            most = f"{MOST_SAMPLES / self.rate:g} s at {self.rate:g} Hz"
            raise UserError(f"duration is {duration} s, expected at most {most}")
        strides = int(duration * self.rate / len(self.qpos) + 1e-9)
        if strides < 1:
            period = len(self.qpos) / self.rate
            raise UserError(f"duration is {duration} s, expected at least one stride of {period:.2f} s")
        rows = [moved(self.qpos, i * self.way, i * self.angle) for i in range(strides + 1)]
        qpos = np.concatenate([*rows[:-1], rows[-1][:1]])
        qpos[:, 0] -= self.qpos[0, 0]
        qpos[:, 2] -= CONTACT_DEPTH  # what a stride puts on the floor bears there, whatever rounding does
        return MotionClip.from_qpos("walk", self.robot.name, self.rate, qpos)

    def said(self) -> str:
        """The chosen numbers in words."""
        if not self.chosen:
            said, own = "the robot's own style except for the given numbers", OPEN.on(self.robot).cadence
            fitting = fitted(self.robot, self.command).cadence
            if self.style.cadence != own or math.isclose(own, fitting, rel_tol=0.05):
                return said
            return f"{said}: its cadence is {own:.4g} steps/s, where {fitting:.4g} fits the speed (--style.cadence)"
        return "chosen: " + ", ".join(f"{name} {getattr(self.style, name) + 0.0:.4g}" for name in self.chosen)


def synthesize(
    robot: Robot,
    *,
    speed: float | None = None,
    sideways: float = 0.0,
    turn: float = 0.0,
    duration: float = 8.0,
    rate: float = 50.0,
    style: Style = OPEN,
) -> MotionClip:
    """A steady walk from the origin, along +x at first; all zero is standing.

    Args:
      robot: a robot with two legs of six hinges; of waist and arms it moves the joints that its ``robot.toml`` names.
      speed: ahead, m/s, negative backward; the robot's own by default.
      sideways: to the left, m/s.
      turn: to the left, rad/s.
      duration: upper bound, s; the clip holds as many whole strides as fit, and the sample that closes the last.
      rate: samples per second, Hz.
      style: how the walk looks; `make` says what becomes of numbers that it leaves open.

    Raises:
      UserError: what `make` refuses, or no stride fits.
    """
    speed = robot.gait.get("speed", 0.0) if speed is None else speed
    return make(robot, Command(speed, sideways, turn), rate=rate, style=style).clip(duration)


def make(robot: Robot, command: Command, *, rate: float = 50.0, style: Style = OPEN) -> Gait:
    """The gait at a commanded velocity.

    Numbers of the style that are given stay. Where some are given and the robot's own complete them to a walk straight
    ahead or along an arc, that walk is taken, and the command is the velocity of the path on which the feet are. Else
    the others are those of `style.fitted`, and what the legs want: the highest pelvis with bent knees, where that is
    not possible a higher cadence, and feet far enough apart to pass each other. The command then is the mean velocity
    of the pelvis in its own heading.

    Raises:
      UserError: the robot has no walk, or not two legs of six hinges; a number is not finite or not positive or the
        style's phases are out of order; the command is out of the legs' reach.
    """
    if not robot.gait:
        raise UserError(f"robot {robot.name!r} has no [gait] in its robot.toml, so it has no walk{_others(robot)}")
    _check(robot, command, rate, style)
    if style.named() and command.speed > 0 and not command.sideways:
        own = style.on(robot)
        samples = 2 * max(1, round(rate / own.cadence))
        period = samples / rate
        stride = Stride(robot, np.array([command.speed * period, 0.0]), command.turn * period, period, own)
        try:
            return Gait(robot, command, rate, own, (), stride.way, stride.angle, stride.solve(samples)[0])
        except OutOfReach:
            pass
    found = _find(robot, command, rate, style)
    if found is None:
        raise OutOfReach(_refusal(robot, command, rate, style))
    for _ in range(2):  # the second corrects the path by the better balance of the first
        stride = found.stride(robot, command)
        qpos, pelvis = stride.solve(found.samples)
        if not command.turn:
            break
        found = found._replace(pelvis=pelvis)
    own, given = OPEN.on(robot), style.named()
    chosen = [
        name
        for name, value in dataclasses.asdict(stride.style).items()
        if name not in given and not math.isclose(value, getattr(own, name), rel_tol=1e-9)
    ]
    return Gait(robot, command, rate, stride.style, tuple(chosen), stride.way, stride.angle, qpos)


def _others(robot: Robot) -> str:
    """Which robots' walks it takes instead, for a message."""
    others = [name for name in robots.available() if name != robot.name and robot.takes(name)]
    return f"; it takes the walks of {', '.join(others)}" if others else ""


def _check(robot: Robot, command: Command, rate: float, style: Style) -> None:
    """Refuse numbers that no walk has, and entries of ``robot.toml`` that would not be read."""
    if unknown := sorted(set(robot.gait) - {"speed", "joints", *dataclasses.asdict(style)}):
        raise UserError(
            f"the [gait] of robot {robot.name!r} has {unknown[0]!r}: expected 'speed', 'joints' and the fields of "
            "fmpjax.motion.style.Style"
        )
    own = style.on(robot)
    for name, value, unit in (
        ("the [gait] speed of robot " + repr(robot.name), robot.gait.get("speed", 0.0), "m/s"),
        ("rate", rate, "Hz"),
        ("cadence", own.cadence, "steps/s"),
        ("pelvis_height", own.pelvis_height, "m"),
    ):
        if not (math.isfinite(value) and value > 0):
            raise UserError(f"{name} is {value}, expected a positive number of {unit}")
    for name, value in (*command._asdict().items(), *dataclasses.asdict(own).items()):
        if not math.isfinite(value):
            raise UserError(f"{name} is {value}, expected a finite number")
    fit = fitted(robot, command, style)
    for s in (own, fit):
        if not (0 < s.flat < s.heel_off < 0.5 < s.toe_off < s.highest_at < s.lowest_at < 1):
            raise UserError(
                f"the style's phases are flat {s.flat}, heel_off {s.heel_off}, toe_off {s.toe_off}, highest_at "
                f"{s.highest_at}, lowest_at {s.lowest_at}: expected increasing numbers between 0 and 1, of which the "
                "first two are below 0.5"
            )


class _Found(NamedTuple):
    """A style with its period, and where the pelvis is on average in the walker's frame ``[2]`` (m)."""

    style: Style
    samples: int
    period: float  # s
    pelvis: np.ndarray

    def stride(self, robot: Robot, command: Command) -> Stride:
        """A stride on such a path that the pelvis has the commanded velocity in its own heading.

        The pelvis faces where the feet that stand do on average: a foot lags behind the body that turns over it.
        """
        lag = self.style.toe_off / 2 if command.turn else 0.0
        velocity = turned(np.array([command.speed, command.sideways]), -lag * command.turn * self.period)
        velocity = velocity + command.turn * np.array([self.pelvis[1], -self.pelvis[0]])
        return Stride(robot, velocity * self.period, command.turn * self.period, self.period, self.style, lag)


def _find(robot: Robot, command: Command, rate: float, style: Style, tries: tuple[float, ...] = TRIES) -> _Found | None:
    """The slowest fitting steps and the highest pelvis with which the legs reach the feet; None where none do."""
    # A command and its mirror image get the same numbers, though the robot's masses are not quite symmetric.
    if command.turn < 0 or (command.turn == 0 and command.sideways < 0):
        other = style if style.bank is None else dataclasses.replace(style, bank=-style.bank)
        found = _find(robot, Command(command.speed, -command.sideways, -command.turn), rate, other, tries)
        if found is None:
            return None
        return found._replace(
            style=dataclasses.replace(found.style, bank=-found.style.bank), pelvis=found.pelvis * [1, -1]
        )
    fit, given = fitted(robot, command, style), style.named()
    legs = [Leg(robot, foot) for foot in robot.feet]
    slowest = fit.cadence
    for part in tries if "cadence" not in given and slowest < FASTEST else (0.0,):
        cadence = slowest + part * (FASTEST - slowest)
        samples = 2 * max(1, round(rate / cadence))
        period = samples / rate
        wide = 2 * legs[0].half_width + GAP + (abs(command.sideways) + legs[0].toe[0] * abs(command.turn)) * period / 2
        free = {"cadence": cadence, "half_width": max(fit.half_width, wide / 2)}
        free = {name: value for name, value in free.items() if name not in given}
        pelvis = -fit.toe_off / 2 * period * np.array([command.speed, command.sideways])
        found = _Found(dataclasses.replace(fit, **free), samples, period, pelvis)
        found = _highest(robot, command, found, "pelvis_height" in given)
        if found is not None:
            return found
    return None


def _highest(robot: Robot, command: Command, found: _Found, fixed: bool) -> _Found | None:
    """The same with the highest pelvis, to the millimeter, at which the knees are bent enough; None where none is."""
    joints = np.concatenate([Leg(robot, foot).joints for foot in robot.feet])
    bent = 0.0 if fixed else BENT * max(1.0, effort(robot, command)) ** 2
    top = found.style.pelvis_height
    passed: dict[int, tuple[_Found, np.ndarray]] = {}

    def bends(lower: int) -> bool:
        nonlocal found
        style = dataclasses.replace(found.style, pelvis_height=round(top - lower / 1000, 6) if lower else top)
        found = found._replace(style=style)
        try:
            qpos, pelvis = found.stride(robot, command).solve(TRIAL, 1)
        except OutOfReach:
            return False
        found = found._replace(pelvis=pelvis)
        passed[lower] = found, qpos[:, 7:]
        return np.abs(qpos[:, 7 + robot.sagittal_joints[[1, 4]]]).min() >= bent

    low = 0
    if not bends(0):
        high, low = 0, 0 if fixed else int(1000 * top * (1 - LOWEST))
        if fixed or not bends(low):
            return None
        while low - high > 1:
            middle = (low + high) // 2
            high, low = (high, middle) if bends(middle) else (middle, low)
    found, angles = passed[low]
    margin = np.minimum(angles - robot.joint_low, robot.joint_high - angles)[:, joints].min()
    return found if margin >= MARGIN and found.stride(robot, command).room(TRIAL) >= 0 else None


def _refusal(robot: Robot, command: Command, rate: float, style: Style) -> str:
    """What is wrong with a command out of reach: how much of it is within."""
    high, low = min(1.0, 8 / effort(robot, command)) if any(command) else 0.0, 0.0
    for _ in range(SCALES if high else 0):
        middle = (low + high) / 2
        part = Command(*(middle * value for value in command))
        low, high = (low, middle) if _find(robot, part, rate, style, TRIES[-1:]) is None else (middle, high)

    def words(scale: float) -> str:
        parts = zip(("speed", "sideways", "turn"), ("m/s", "m/s", "rad/s"), command, strict=True)
        return ", ".join(f"{name} {scale * value:.2g} {unit}" for name, unit, value in parts if value)

    if not low:
        what = words(1) or "standing"
        return f"{what} is out of the legs' reach with this style: expected numbers nearer the robot's own"
    return f"{words(1)} is out of the legs' reach: expected at most about {words(low)}"
