"""Walks of our own: prescribed feet, pelvis and arms, inverse kinematics, balance by iteration.

The feet are given. A foot lands on the edge of its heel, rolls flat, stands, rolls over the edge of its toe and swings;
edges roll without sliding. The legs follow by inverse kinematics. The path of the pelvis over the floor is then found
so that the zero-moment point - where the ground must push for the motion to be possible - goes from foot to foot and
from heel to toe. A pendulum relates the two well enough to correct one by the error of the other, harmonic by harmonic.

A walk that turns goes along an arc. Each foot stands as on a straight line, only the line's direction is the arc's
where the foot lands. Seen from a frame that moves along the arc and turns with it, every stride is the same: there the
balance is found in the same way.

Phases are fractions of a stride and start at the left heel's landing; of a straight walk, the right leg is the left
one's mirror image half a stride later. `LIBRARY` has the arguments of the bundled motions;
``fmpjax motion synthesize`` is the command.
"""

import dataclasses
import math
from typing import Annotated

import mujoco
import numpy as np
import tyro
from scipy.interpolate import BPoly

from fmpjax import rotations
from fmpjax.errors import UserError
from fmpjax.motion.clip import MotionClip
from fmpjax.motion.formats import MOST_SAMPLES
from fmpjax.motion.soles import slip, sole_points
from fmpjax.robots import Robot

GRAVITY = 9.81  # m/s^2


@dataclasses.dataclass(frozen=True)
class Style:
    """How the walk looks; lengths m, angles rad, phases as fractions of a stride. None leaves it to the robot."""

    cadence: float | None = None  # steps/s; rounded so that half a stride is a whole number of samples
    half_width: float | None = None  # of each foot's centre from the line of travel
    toe_out: float | None = None
    # The foot's pitch, positive with the toe down.
    landing_pitch: float | None = None
    lowest_pitch: float | None = None  # in late swing
    highest_pitch: float | None = None  # about toe-off
    flat: float | None = None  # the sole is flat from here
    heel_off: float | None = None  # to here
    toe_off: float | None = None
    highest_at: float | None = None
    lowest_at: float | None = None
    # Added to the swing foot's height at its middle.
    swing_lift: Annotated[float | None, tyro.conf.arg(aliases=["--step-height"])] = None
    pelvis_height: float | None = None  # mean
    pelvis_bob: float | None = None  # half of the vertical travel, highest in mid-stance
    pelvis_yaw: float | None = None
    pelvis_roll: float | None = None
    pelvis_pitch: float | None = None
    torso_yaw: float | None = None  # against the pelvis
    torso_pitch: float | None = None
    arm_swing: float | None = None  # shoulder pitch, each way
    arm_centre: float | None = None  # shoulder pitch, positive backward
    arm_out: float | None = None  # shoulder roll
    elbow: float | None = None
    elbow_swing: float | None = None
    # The zero-moment point in the foot's frame, along the foot, at the start and end of single support.
    pressure_start: float | None = None
    pressure_end: float | None = None
    pressure_inward: float | None = None  # toward the other foot

    def on(self, robot: Robot) -> "Style":
        """The style with what it leaves open as ``robot.toml`` has it, or zero where that is silent."""
        named = {name: value for name, value in dataclasses.asdict(self).items() if value is not None}
        own = {name: robot.gait.get(name, 0.0) for name in dataclasses.asdict(self)}
        return Style(**(own | named))


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


def synthesize(
    robot: Robot,
    *,
    speed: float | None = None,
    turn: float = 0.0,
    duration: float = 8.0,
    rate: float = 50.0,
    style: Style = Style(),
) -> MotionClip:
    """A steady walk from the origin, along +x at first.

    Args:
      robot: a robot with two legs of six hinges; of waist and arms it moves the joints that its ``robot.toml`` names.
      speed: along the path, m/s; the robot's own by default.
      turn: of the path's direction, positive to the left, rad/s.
      duration: upper bound, s; the clip holds as many whole strides as fit, and the sample that closes the last.
      rate: samples per second, Hz.
      style: how the walk looks; what it leaves open is as `Robot.gait` has it.

    Raises:
      UserError: the robot has no walk, or not two legs of six hinges; a number is not positive or the style's phases
        are out of order; no stride fits, or a foot is out of the leg's reach.
    """
    if not robot.gait:
        raise UserError(f"robot {robot.name!r} has no [gait] in its robot.toml, which says how it walks")
    speed = robot.gait.get("speed", 0.0) if speed is None else speed
    style = style.on(robot)
    for name, value, unit in (
        ("speed", speed, "m/s"),
        ("rate", rate, "Hz"),
        ("duration", duration, "s"),
        ("cadence", style.cadence, "steps/s"),
    ):
        if not (math.isfinite(value) and value > 0):
            raise UserError(f"{name} is {value}, expected a positive number of {unit}")
    for name, value in (("turn", turn), *dataclasses.asdict(style).items()):
        if not math.isfinite(value):
            raise UserError(f"{name} is {value}, expected a finite number")
    if not (0 < style.flat < style.heel_off < 0.5 < style.toe_off < style.highest_at < style.lowest_at < 1):
        raise UserError(
            f"the style's phases are flat {style.flat}, heel_off {style.heel_off}, toe_off {style.toe_off}, "
            f"highest_at {style.highest_at}, lowest_at {style.lowest_at}: expected growing numbers between 0 and 1, "
            "of which the first two are below 0.5"
        )
    if duration * rate > MOST_SAMPLES:
        raise UserError(f"duration is {duration} s, expected at most {MOST_SAMPLES / rate:g} s at {rate:g} Hz")
    samples = 2 * max(1, round(rate / style.cadence))
    strides = int(duration * rate / samples + 1e-9)
    if strides < 1:
        raise UserError(f"duration is {duration} s, expected at least one stride of {samples / rate:.2f} s")
    period = samples / rate
    cycle = _Stride(robot, speed * period, turn * period, period, style).solve(samples)
    rows = [_moved(cycle, i * speed * period, i * turn * period) for i in range(strides + 1)]
    qpos = np.concatenate([*rows[:-1], rows[-1][:1]])
    qpos[:, 0] -= cycle[0, 0]
    return MotionClip.from_qpos("walk", robot.name, rate, qpos)


def _arc(length: float, angle: float) -> np.ndarray:
    """End ``[..., 2]`` of an arc from the origin along +x: ``length [...]`` m that turn by ``angle [...]`` rad."""
    chord = length * np.sinc(angle / (2 * np.pi))
    return np.stack([chord * np.cos(angle / 2), chord * np.sin(angle / 2)], axis=-1)


def _turned(points: np.ndarray, angle: float) -> np.ndarray:
    """Points ``[..., 2]`` turned about the origin by ``angle [...]`` (rad)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = points[..., 0], points[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def _heading_wxyz(angle: float) -> np.ndarray:
    """Quaternion ``[..., 4]`` of a turn about z by ``angle [...]`` (rad)."""
    half = np.asarray(angle) / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def _moved(qpos: np.ndarray, advance: float, angle: float) -> np.ndarray:
    """Configurations ``[..., 7 + J]`` moved along the arc of length ``advance`` (m) that turns by ``angle`` (rad)."""
    qpos = qpos.copy()
    qpos[..., :2] = _arc(advance, angle) + _turned(qpos[..., :2], angle)
    qpos[..., 3:7] = rotations.multiply(_heading_wxyz(angle), qpos[..., 3:7])
    return qpos


class _Stride:
    """One stride as functions of the phase; the path of the pelvis over the floor is a Fourier series.

    The walker's frame moves along the path, ``length`` m and ``angle`` rad a stride; at phase 0 it is the world's.
    """

    harmonics = 7
    iterations = 8

    def __init__(self, robot: Robot, length: float, angle: float, period: float, style: Style):
        self.robot, self.style, self.period, self.length, self.angle = robot, style, period, length, angle
        self.data = mujoco.MjData(robot.model)
        self.legs = [_Leg(robot, self.data, body) for body in robot.feet]
        moved = robot.gait.get("joints", {})
        missing = [name for name in moved.values() if name not in robot.joint_names]
        if missing:
            raise UserError(f"robot {robot.name!r} has no joint {missing[0]!r}, which its walk moves")
        self.parts = [(part, 7 + robot.joint_names.index(name)) for part, name in moved.items()]
        s = style
        # Value, rate and acceleration at each knot; flat while the sole stands.
        landing_rate = -s.landing_pitch / s.flat
        self.pitch = BPoly.from_derivatives(
            [0.0, s.flat, s.heel_off, s.highest_at, s.lowest_at, 1.0],
            [
                [s.landing_pitch, landing_rate, 0.0],
                [0.0, 0.0, 0.0],
                [0.0, 0.0, 0.0],
                [s.highest_pitch, 0.0],
                [s.lowest_pitch, 0.0],
                [s.landing_pitch, landing_rate, 0.0],
            ],
        )
        # From where a foot stands to where it stands next, for either foot, in the frame of the former.
        self.swing = []
        for sign in (1, -1):
            aside = np.array([0.0, sign * s.half_width])
            next_place = _arc(length, angle) + _turned(aside, angle) - aside
            off, on = self._standing(s.toe_off), self._standing(1.0)
            for value in on:
                value[:2] = _turned(value[:2], angle)
            on[0][:2] += next_place
            self.swing.append(BPoly.from_derivatives([s.toe_off, 1.0], [off, on]))
        self.swing_heading = BPoly.from_derivatives([s.toe_off, 1.0], [[0.0, 0.0, 0.0], [angle, 0.0, 0.0]])

    def _standing(self, phase: float) -> list[np.ndarray]:
        """Position ``[3]`` of a foot that stands with its centre at the origin, and two derivatives by phase."""
        h = 1e-4
        a, b, c = (self._rolled(float(self.pitch((phase + d) % 1.0))) for d in (-h, 0.0, h))
        return [b, (c - a) / (2 * h), (a - 2 * b + c) / h**2]

    def _rolled(self, pitch: float) -> np.ndarray:
        """Position ``[3]`` of the foot's body, in the frame where it stands, when the sole has rolled to ``pitch``.

        The edge that touches has a radius, so its centre moves on by radius times angle.
        """
        edge = self.legs[0].heel if pitch < 0 else self.legs[0].toe
        radius = self.legs[0].radius
        centre = np.array([edge[0] + radius * pitch, 0.0, radius])
        c, s = np.cos(pitch), np.sin(pitch)
        return centre - np.array([c * edge[0] + s * edge[2], 0.0, c * edge[2] - s * edge[0]])

    def place(self, phase: float) -> tuple[np.ndarray, float]:
        """The walker's frame: its origin, world ``[..., 2]``, and its heading, rad; any phase ``[...]``."""
        return _arc(phase * self.length, phase * self.angle), phase * self.angle

    def foot_pose(self, side: int, phase: float) -> tuple[np.ndarray, np.ndarray]:
        """World position ``[3]`` and wxyz orientation of the left (0) or right (1) foot; any phase.

        The left foot's centre lands beside the walker's frame of phase 0, the right one's of phase 1/2.
        """
        s, sign = self.style, 1 - 2 * side
        strides, phase = np.divmod(phase - 0.5 * side, 1.0)
        pitch, heading = float(self.pitch(phase)), 0.0
        if phase <= s.toe_off:
            position = self._rolled(pitch)
        else:
            share = (phase - s.toe_off) / (1 - s.toe_off)
            position = self.swing[side](phase) + [0.0, 0.0, s.swing_lift * 16 * share**2 * (1 - share) ** 2]
            heading = float(self.swing_heading(phase))
        origin, direction = self.place(strides + 0.5 * side)
        position[:2] = origin + _turned(position[:2] + [0.0, sign * s.half_width], direction)
        turn_wxyz = _heading_wxyz(direction + heading + sign * s.toe_out)
        return position, rotations.multiply(turn_wxyz, rotations.exp_map(np.array([0.0, pitch, 0.0])))

    def upper(self, phase: float) -> np.ndarray:
        """``qpos [7 + J]`` in the walker's frame with everything but the legs and the pelvis' place over the floor."""
        s = self.style
        qpos = np.zeros(self.robot.model.nq)
        forward = np.cos(2 * np.pi * phase)  # 1 when the left foot lands, -1 when the right does
        stance = np.cos(2 * np.pi * (phase - 0.5 * (s.toe_off - 0.5) - 0.25))  # 1 in the left foot's mid-stance
        qpos[2] = s.pelvis_height + s.pelvis_bob * (2 * stance**2 - 1)
        yaw, roll = -s.pelvis_yaw * forward, s.pelvis_roll * stance
        turn = [rotations.exp_map(v) for v in (np.array([0, 0, yaw]), np.array([roll, 0, 0]))]
        turn.append(rotations.exp_map(np.array([0.0, s.pelvis_pitch, 0.0])))
        qpos[3:7] = rotations.multiply(rotations.multiply(turn[0], turn[1]), turn[2])
        angles = {
            "waist_yaw": s.torso_yaw * forward - yaw,
            "waist_roll": -roll,
            "waist_pitch": s.torso_pitch - s.pelvis_pitch,
        }
        for side, sign in (("left", 1.0), ("right", -1.0)):
            back = sign * forward
            angles[f"{side}_shoulder_pitch"] = s.arm_centre + s.arm_swing * back
            angles[f"{side}_shoulder_roll"] = sign * s.arm_out
            angles[f"{side}_elbow"] = s.elbow + s.elbow_swing * back
        for part, column in self.parts:
            qpos[column] = angles[part]
        return qpos

    def pressure(self, phase: float) -> np.ndarray:
        """Where the ground shall push, world ``[2]``: along the standing foot, across in double support."""
        s = self.style
        steps, within = np.divmod(phase, 0.5)
        double = s.toe_off - 0.5
        if within >= double:
            share = (within - double) / (0.5 - double)
            return self._under(steps, s.pressure_start + share * (s.pressure_end - s.pressure_start))
        share = within / double
        share = share * share * (3 - 2 * share)
        last, present = self._under(steps - 1, s.pressure_end), self._under(steps, s.pressure_start)
        return last + share * (present - last)

    def _under(self, step: float, along: float) -> np.ndarray:
        """World point ``[2]`` under the foot of the given step (even steps are the left foot's), ``along`` it (m)."""
        across = (1 - 2 * (int(step) % 2)) * (self.style.half_width - self.style.pressure_inward)
        origin, direction = self.place(0.5 * step)
        return origin + _turned(np.array([along, across]), direction)

    def solve(self, samples: int) -> np.ndarray:
        """Configurations ``[N, 7 + J]`` over one stride; the next one is the same, a stride further along the path."""
        phase = np.arange(samples) / samples
        origin, heading = self.place(phase)
        wanted = _turned(np.array([self.pressure(p) for p in phase]) - origin, -heading)
        qpos = np.array([self.upper(p) for p in phase])
        qpos[:, 3:7] = rotations.multiply(_heading_wxyz(heading), qpos[:, 3:7])
        omega2 = GRAVITY / (0.87 * self.style.pelvis_height)  # the mass is about so high; iterating mends the rest
        frequency = np.fft.rfftfreq(samples, 1 / samples)
        gain = 1 / (1 + (2 * np.pi * frequency / self.period) ** 2 / omega2)
        gain[frequency > self.harmonics] = 0.0
        path = np.fft.irfft(np.fft.rfft(wanted, axis=0) * gain[:, None], samples, axis=0)
        for _ in range(self.iterations):
            qpos[:, :2] = origin + _turned(path, heading)
            self._solve_legs(qpos, phase)
            found = zero_moment_point(self.robot, qpos, samples / self.period, self.length, self.angle)
            error = np.fft.rfft(wanted - _turned(found - origin, -heading), axis=0) * gain[:, None]
            path = path + np.fft.irfft(error, samples, axis=0)
        qpos[:, :2] = origin + _turned(path, heading)
        self._solve_legs(qpos, phase)
        return qpos

    def _solve_legs(self, qpos: np.ndarray, phase: np.ndarray) -> None:
        for row, at in zip(qpos, phase, strict=True):
            for side, leg in enumerate(self.legs):
                leg.reach(row, *self.foot_pose(side, at))


class _Leg:
    """Inverse kinematics of the hinges between the root and one foot, by Newton's method."""

    def __init__(self, robot: Robot, data: mujoco.MjData, foot: int):
        self.robot, self.data, self.body = robot, data, foot + 1
        joints, body = [], foot
        while body > 0:
            joints.append(robot.body_joint[body])
            body = robot.body_parent[body]
        self.joints = np.array([joint for joint in joints[::-1] if joint >= 0])
        if len(self.joints) != 6:
            raise UserError(f"robot {robot.name!r} has {len(self.joints)} hinges in a leg: a walk needs six")
        own = robot.sole_body == foot
        points = robot.sole_point[own]
        self.radius = float(robot.sole_radius[own][0])
        # Edges of the sole in the foot's body; y is dropped because the edges are parallel to it.
        self.heel = points[np.argmin(points[:, 0])] * [1, 0, 1]
        self.toe = points[np.argmax(points[:, 0])] * [1, 0, 1]
        self.angles = robot.default_qpos[7 + self.joints]

    def reach(self, qpos: np.ndarray, position: np.ndarray, orientation_wxyz: np.ndarray) -> None:
        """Put the leg's angles into ``qpos [7 + J]`` so that the foot has the pose; starts from the last solution."""
        model, data = self.robot.model, self.data
        data.qpos[:] = qpos
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        columns = 6 + self.joints
        angles = self.angles.copy()
        for _ in range(30):
            data.qpos[7 + self.joints] = angles
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            turn = rotations.multiply(orientation_wxyz, rotations.conjugate(data.xquat[self.body]))
            error = np.concatenate([position - data.xpos[self.body], rotations.log_map(turn)])
            if np.abs(error).max() < 1e-10:
                break
            mujoco.mj_jacBody(model, data, linear, angular, self.body)
            step = np.linalg.solve(np.concatenate([linear, angular])[:, columns], error)
            # Long steps cross the straight knee and come back bent the wrong way.
            angles = angles + step * min(1.0, 0.3 / np.abs(step).max())
        else:
            raise UserError(
                "the walk's feet are out of the legs' reach: expected a lower pelvis, a lower speed or a higher cadence"
            )
        self.angles = angles
        qpos[7 + self.joints] = angles


def zero_moment_point(robot: Robot, qpos: np.ndarray, rate: float, advance: float, angle: float = 0.0) -> np.ndarray:
    """Where the ground pushes, ``[N, 2]`` m, through one period ``qpos [N, 7 + J]`` of a steady motion.

    A period moves it on by ``advance`` m along the path and turns it by ``angle`` rad.
    """
    return _ground_force(robot, qpos, rate, advance, angle)[0]


def _ground_force(
    robot: Robot, qpos: np.ndarray, rate: float, advance: float, angle: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Zero-moment point ``[N, 2]`` and total ground force ``[N, 3]`` (N) of a steady motion."""
    model, data = robot.model, mujoco.MjData(robot.model)
    before, after = np.roll(qpos, 1, axis=0), np.roll(qpos, -1, axis=0)
    before[0] = _moved(before[0], -advance, -angle)
    after[-1] = _moved(after[-1], advance, angle)
    point, force, out = np.zeros((len(qpos), 2)), np.zeros((len(qpos), 3)), np.zeros(model.nv)
    back, ahead = np.zeros(model.nv), np.zeros(model.nv)
    for i, (a, b, c) in enumerate(zip(before, qpos, after, strict=True)):
        mujoco.mj_differentiatePos(model, back, 1 / rate, a, b)
        mujoco.mj_differentiatePos(model, ahead, 1 / rate, b, c)
        data.qpos[:], data.qvel[:], data.qacc[:] = b, (back + ahead) / 2, (ahead - back) * rate
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_rne(model, data, 1, out)
        force[i] = out[:3]
        moment = data.xmat[1].reshape(3, 3) @ out[3:6]
        point[i, 0] = b[0] - (moment[1] + b[2] * out[0]) / out[2]
        point[i, 1] = b[1] + (moment[0] - b[2] * out[1]) / out[2]
    return point, force


def measure(robot: Robot, clip: MotionClip, *, contact: float = 0.002) -> dict[str, float]:
    """Quality figures of a steady walk that starts along +x.

    A sole point is in contact while its lowest point is less than ``contact`` (m) above the floor.

    Returns:
      ``speed``: mean along the path, m/s. ``turn``: mean, positive to the left, rad/s.
      ``cadence``: steps/s. ``height_min``, ``height_max``: of the root, m.
      ``range_left_hip`` and so on: travel of the sagittal joints, deg.
      ``slip``: greatest way (m) that a touching point slides over the floor in one step; rolling is not sliding.
      ``penetration``: greatest depth of a sole point in the floor, m.
      ``gap``: greatest height of the lowest sole point, m; a walk has no flight.
      ``clearance``: least height of a foot in the middle half of its swing, m.
      ``limit_margin``: least distance of a joint to its limit, rad.
      ``joint_speed`` (rad/s) and ``joint_acceleration`` (rad/s^2): greatest of any joint.
      ``double_support``: share of the time with both feet in contact.
      ``lateral``: half of the root's sideways travel about its path, m.
      ``balance``: root mean square distance (m) of the zero-moment point from the box, along and
      across the path, around the points on the floor.
    """
    points, rotation = sole_points(robot, clip.qpos)
    height = points[:, :, 2] - robot.sole_radius
    touch = height < contact
    down = np.stack([touch[:, robot.sole_body == foot].any(axis=1) for foot in robot.feet], axis=1)
    joints = clip.qpos[:, 7:]
    sagittal = np.degrees(np.ptp(joints[:, robot.sagittal_joints], axis=0))
    names = [f"range_{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle")]
    landings = [np.flatnonzero(down[1:, i] & ~down[:-1, i]) + 1 for i in range(2)]
    strides = sum(len(at) - 1 for at in landings)
    yaw = np.unwrap(rotations.yaw(clip.qpos[:, 3:7]))
    turn = float(yaw[-1] - yaw[0]) / clip.duration
    heading = turn * np.arange(len(clip)) / clip.rate
    step = _turned(np.diff(clip.qpos[:, :2], axis=0), -(heading[1:] + heading[:-1]) / 2)
    sideways = np.cumsum(step[:, 1] - step[:, 1].mean())
    return {
        "speed": float(step[:, 0].mean() * clip.rate),
        "turn": turn,
        "cadence": 2 * strides * clip.rate / max(1, sum(at[-1] - at[0] for at in landings if len(at))),
        "height_min": float(clip.qpos[:, 2].min()),
        "height_max": float(clip.qpos[:, 2].max()),
        **dict(zip(names, sagittal.tolist(), strict=True)),
        "slip": slip(robot, points, rotation, touch),
        "penetration": float(max(0.0, -height.min())),
        "gap": float(height.min(axis=1).max()),
        "clearance": _clearance(height, [robot.sole_body == foot for foot in robot.feet], down),
        "limit_margin": float(np.minimum(joints - robot.joint_low, robot.joint_high - joints).min()),
        "joint_speed": float(np.abs(clip.qvel[:, 6:]).max()),
        # One-sided velocities at the ends would pass for jumps.
        "joint_acceleration": float(np.abs(np.diff(clip.qvel[1:-1, 6:], axis=0)).max() * clip.rate),
        "double_support": float(down.all(axis=1).mean()),
        "lateral": float(np.ptp(sideways) / 2),
        "balance": _balance(robot, clip, points, height, heading),
    }


def _clearance(height: np.ndarray, feet: list[np.ndarray], down: np.ndarray) -> float:
    """Least height (m) of a foot's lowest point in the middle half of its swings."""
    least = np.inf
    for foot, stands in zip(feet, down.T, strict=True):
        edges = np.flatnonzero(np.diff(stands.astype(int)))
        for lift, land in zip(edges[:-1], edges[1:], strict=True):
            if stands[lift]:
                quarter = (land - lift) // 4
                least = min(least, float(height[lift + quarter : land - quarter + 1, foot].min()))
    return least


def _balance(robot: Robot, clip: MotionClip, points: np.ndarray, height: np.ndarray, heading: np.ndarray) -> float:
    """Root mean square distance (m) of the zero-moment point from the box around the sole points near the floor.

    The box is along ``heading [T]`` (rad).
    """
    inside = slice(2, len(clip.qpos) - 2)
    push = _turned(_ground_force(robot, clip.qpos, clip.rate, 0.0)[0], -heading)[inside]
    near = height[inside, :, None] < 0.01
    spread = _turned(points[..., :2], -heading[:, None])[inside]
    low = np.where(near, spread, np.inf).min(axis=1)
    high = np.where(near, spread, -np.inf).max(axis=1)
    return float(np.sqrt(np.mean(np.sum((push - np.clip(push, low, high)) ** 2, axis=1))))
