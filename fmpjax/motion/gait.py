"""A walk of our own for the Unitree G1: prescribed feet, pelvis and arms, inverse kinematics, balance by iteration.

The feet are given. A foot lands on the edge of its heel, rolls flat, stands, rolls over the edge of its toe and swings;
edges roll without sliding. The legs follow by inverse kinematics. The path of the pelvis over the floor is then found
so that the zero-moment point - where the ground must push for the motion to be possible - goes from foot to foot and
from heel to toe. A pendulum relates the two well enough to correct one by the error of the other, harmonic by harmonic.

Phases are fractions of a stride and start at the left heel's landing; the right leg is the left one's mirror image half
a stride later. Run ``python -m fmpjax.motion.gait --out motions/walk.npz`` to write the bundled file.
"""

import argparse
import dataclasses
import math

import mujoco
import numpy as np
from scipy.interpolate import BPoly

from fmpjax import robots, rotations
from fmpjax.errors import UserError
from fmpjax.motion.clip import MotionClip
from fmpjax.motion.formats import save
from fmpjax.motion.soles import slip, sole_points
from fmpjax.robots import Robot

GRAVITY = 9.81  # m/s^2


@dataclasses.dataclass(frozen=True)
class Style:
    """How the walk looks; lengths m, angles rad, phases as fractions of a stride."""

    cadence: float = 1.85  # steps/s; rounded so that half a stride is a whole number of samples
    half_width: float = 0.085  # of each foot's centre from the line of travel
    toe_out: float = 0.04
    # The foot's pitch, positive with the toe down.
    landing_pitch: float = -0.288
    lowest_pitch: float = -0.356  # in late swing
    highest_pitch: float = 0.75  # about toe-off
    flat: float = 0.087  # the sole is flat from here
    heel_off: float = 0.395  # to here
    toe_off: float = 0.562
    highest_at: float = 0.604
    lowest_at: float = 0.962
    swing_lift: float = 0.0355  # added to the swing foot's height at its middle
    pelvis_height: float = 0.764  # mean
    pelvis_bob: float = 0.0165  # half of the vertical travel, highest in mid-stance
    pelvis_yaw: float = 0.07
    pelvis_roll: float = 0.04
    pelvis_pitch: float = 0.04
    torso_yaw: float = 0.05  # against the pelvis
    torso_pitch: float = 0.03
    arm_swing: float = 0.32  # shoulder pitch, each way
    arm_centre: float = 0.12  # shoulder pitch, positive backward
    arm_out: float = 0.18  # shoulder roll
    elbow: float = 1.15  # pi / 2 is a straight arm
    elbow_swing: float = 0.15
    # The zero-moment point in the foot's frame, along the foot, at the start and end of single support.
    pressure_start: float = -0.008
    pressure_end: float = 0.099
    pressure_inward: float = 0.01  # toward the other foot


def synthesize(
    robot: Robot, *, speed: float = 0.85, duration: float = 8.0, rate: float = 50.0, style: Style = Style()
) -> MotionClip:
    """A steady walk along +x from the origin.

    Args:
      robot: a robot with the G1's joints.
      speed: m/s.
      duration: upper bound, s; the clip holds as many whole strides as fit, and the sample that closes the last.
      rate: samples per second, Hz.
      style: how the walk looks.

    Raises:
      UserError: a number is not positive, a joint is missing, no stride fits, or a foot is out of the leg's reach.
    """
    for name, value, unit in (("speed", speed, "m/s"), ("rate", rate, "Hz"), ("duration", duration, "s")):
        if not (math.isfinite(value) and value > 0):
            raise UserError(f"{name} is {value}, expected a positive number of {unit}")
    samples = 2 * max(1, round(rate / style.cadence))
    strides = int(duration * rate / samples + 1e-9)
    if strides < 1:
        raise UserError(f"duration is {duration} s, expected at least one stride of {samples / rate:.2f} s")
    stride = _Stride(robot, speed, samples / rate, style)
    cycle = stride.solve(samples)
    qpos = np.concatenate([np.tile(cycle, (strides, 1)), cycle[:1]])
    count = np.repeat(np.arange(strides + 1), samples)[: len(qpos)]
    qpos[:, 0] += count * speed * samples / rate - cycle[0, 0]
    return MotionClip.from_qpos("walk", robot.name, rate, qpos)


class _Stride:
    """One stride as functions of the phase; the path of the pelvis over the floor is a Fourier series."""

    harmonics = 7
    iterations = 8

    def __init__(self, robot: Robot, speed: float, period: float, style: Style):
        self.robot, self.style, self.period, self.length = robot, style, period, speed * period
        self.data = mujoco.MjData(robot.model)
        feet = list(dict.fromkeys(robot.sole_body.tolist()))
        if len(feet) != 2:
            raise UserError(f"robot {robot.name!r} has {len(feet)} feet, expected two")
        self.legs = [_Leg(robot, self.data, body) for body in feet]
        self.joint = {name: 7 + i for i, name in enumerate(robot.joint_names)}
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
        off, on = self._standing(s.toe_off, 0.0), self._standing(1.0, self.length)
        self.swing = BPoly.from_derivatives([s.toe_off, 1.0], [off, on])

    def _standing(self, phase: float, origin: float) -> list[np.ndarray]:
        """Position ``[3]`` of a foot that stands with its centre ``origin`` ahead, and two derivatives by phase."""
        h = 1e-4
        a, b, c = (self._rolled(float(self.pitch((phase + d) % 1.0)), origin) for d in (-h, 0.0, h))
        return [b, (c - a) / (2 * h), (a - 2 * b + c) / h**2]

    def _rolled(self, pitch: float, origin: float) -> np.ndarray:
        """Position ``[3]`` of the foot's body, in the foot's heading, when the sole has rolled to ``pitch``.

        The edge that touches has a radius, so its centre moves on by radius times angle.
        """
        edge = self.legs[0].heel if pitch < 0 else self.legs[0].toe
        radius = self.legs[0].radius
        centre = np.array([origin + edge[0] + radius * pitch, 0.0, radius])
        c, s = np.cos(pitch), np.sin(pitch)
        return centre - np.array([c * edge[0] + s * edge[2], 0.0, c * edge[2] - s * edge[0]])

    def foot(self, phase: float) -> tuple[np.ndarray, float]:
        """Position ``[3]`` of the foot that lands with its centre at x = 0 at phase 0, and its pitch; any phase."""
        turns, phase = np.divmod(phase, 1.0)
        pitch = float(self.pitch(phase))
        if phase <= self.style.toe_off:
            position = self._rolled(pitch, 0.0)
        else:
            position = self.swing(phase)
            s = (phase - self.style.toe_off) / (1 - self.style.toe_off)
            position = position + [0.0, 0.0, self.style.swing_lift * 16 * s**2 * (1 - s) ** 2]
        return position + [turns * self.length, 0.0, 0.0], pitch

    def foot_pose(self, side: int, phase: float) -> tuple[np.ndarray, np.ndarray]:
        """World position ``[3]`` and wxyz orientation of the left (0) or right (1) foot."""
        sign = 1 - 2 * side
        position, pitch = self.foot(phase - 0.5 * side)
        position = position + [0.5 * side * self.length, sign * self.style.half_width, 0.0]
        heading = rotations.exp_map(np.array([0.0, 0.0, sign * self.style.toe_out]))
        return position, rotations.multiply(heading, rotations.exp_map(np.array([0.0, pitch, 0.0])))

    def upper(self, phase: float) -> np.ndarray:
        """``qpos [7 + J]`` with everything but the legs and the pelvis' place over the floor."""
        s, j = self.style, self.joint
        qpos = np.zeros(self.robot.model.nq)
        forward = np.cos(2 * np.pi * phase)  # 1 when the left foot lands, -1 when the right does
        stance = np.cos(2 * np.pi * (phase - 0.5 * (s.toe_off - 0.5) - 0.25))  # 1 in the left foot's mid-stance
        qpos[2] = s.pelvis_height + s.pelvis_bob * (2 * stance**2 - 1)
        yaw, roll = -s.pelvis_yaw * forward, s.pelvis_roll * stance
        turn = [rotations.exp_map(v) for v in (np.array([0, 0, yaw]), np.array([roll, 0, 0]))]
        turn.append(rotations.exp_map(np.array([0.0, s.pelvis_pitch, 0.0])))
        qpos[3:7] = rotations.multiply(rotations.multiply(turn[0], turn[1]), turn[2])
        try:
            qpos[j["waist_yaw_joint"]] = s.torso_yaw * forward - yaw
            qpos[j["waist_roll_joint"]] = -roll
            qpos[j["waist_pitch_joint"]] = s.torso_pitch - s.pelvis_pitch
            for side, sign in (("left", 1.0), ("right", -1.0)):
                back = sign * forward
                qpos[j[f"{side}_shoulder_pitch_joint"]] = s.arm_centre + s.arm_swing * back
                qpos[j[f"{side}_shoulder_roll_joint"]] = sign * s.arm_out
                qpos[j[f"{side}_elbow_joint"]] = s.elbow + s.elbow_swing * back
        except KeyError as missing:
            raise UserError(f"robot {self.robot.name!r} has no joint {missing}, which the walk moves") from None
        return qpos

    def pressure(self, phase: float) -> np.ndarray:
        """Where the ground shall push, world ``[2]``: along the standing foot, across in double support."""
        s = self.style
        turns, within = np.divmod(phase, 0.5)
        side = int(turns) % 2
        double = s.toe_off - 0.5
        sign = 1 - 2 * side
        across = sign * (s.half_width - s.pressure_inward)
        if within >= double:
            share = (within - double) / (0.5 - double)
            along = s.pressure_start + share * (s.pressure_end - s.pressure_start)
        else:
            share = within / double
            share = share * share * (3 - 2 * share)
            last = s.pressure_end - 0.5 * self.length
            along = last + share * (s.pressure_start - last)
            across *= 2 * share - 1
        return np.array([0.5 * turns * self.length + along, across])

    def solve(self, samples: int) -> np.ndarray:
        """Configurations ``[N, 7 + J]`` over one stride; the next one is the same, a stride's length ahead."""
        phase = np.arange(samples) / samples
        advance = np.outer(phase * self.length, [1.0, 0.0])
        wanted = np.array([self.pressure(p) for p in phase]) - advance
        qpos = np.array([self.upper(p) for p in phase])
        omega2 = GRAVITY / (0.87 * self.style.pelvis_height)  # the centre of mass is lower than the pelvis' top
        frequency = np.fft.rfftfreq(samples, 1 / samples)
        gain = 1 / (1 + (2 * np.pi * frequency / self.period) ** 2 / omega2)
        gain[frequency > self.harmonics] = 0.0
        path = np.fft.irfft(np.fft.rfft(wanted, axis=0) * gain[:, None], samples, axis=0)
        for _ in range(self.iterations):
            qpos[:, :2] = path + advance
            self._solve_legs(qpos, phase)
            found = zero_moment_point(self.robot, qpos, samples / self.period, self.length) - advance
            error = np.fft.rfft(wanted - found, axis=0) * gain[:, None]
            path = path + np.fft.irfft(error, samples, axis=0)
        qpos[:, :2] = path + advance
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
        self.joints = np.array(joints[::-1])
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


def zero_moment_point(robot: Robot, qpos: np.ndarray, rate: float, advance: float) -> np.ndarray:
    """Where the ground pushes, ``[N, 2]`` m, through one period ``qpos [N, 7 + J]`` that moves on by ``advance`` m."""
    return _ground_force(robot, qpos, rate, advance)[0]


def _ground_force(robot: Robot, qpos: np.ndarray, rate: float, advance: float) -> tuple[np.ndarray, np.ndarray]:
    """Zero-moment point ``[N, 2]`` and total ground force ``[N, 3]`` (N) of a periodic motion."""
    model, data = robot.model, mujoco.MjData(robot.model)
    before, after = np.roll(qpos, 1, axis=0), np.roll(qpos, -1, axis=0)
    before[0, 0] -= advance
    after[-1, 0] += advance
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
    """Quality figures of a straight walk.

    A sole point is in contact while its lowest point is less than ``contact`` (m) above the floor.

    Returns:
      ``speed``: net, m/s. ``cadence``: steps/s. ``height_min``, ``height_max``: of the root, m.
      ``range_left_hip`` and so on: travel of the sagittal joints, deg.
      ``slip``: greatest way (m) that a touching point slides over the floor in one step; rolling is not sliding.
      ``penetration``: greatest depth of a sole point in the floor, m.
      ``gap``: greatest height of the lowest sole point, m; a walk has no flight.
      ``clearance``: least height of a foot in the middle half of its swing, m.
      ``limit_margin``: least distance of a joint to its limit, rad.
      ``joint_speed`` (rad/s) and ``joint_acceleration`` (rad/s^2): greatest of any joint.
      ``double_support``: share of the time with both feet in contact.
      ``lateral``: half of the root's sideways travel, m.
      ``balance``: root mean square distance (m) of the zero-moment point from the box around the points on the floor.
    """
    feet = list(dict.fromkeys(robot.sole_body.tolist()))
    points, rotation = sole_points(robot, clip.qpos)
    height = points[:, :, 2] - robot.sole_radius
    touch = height < contact
    down = np.stack([touch[:, robot.sole_body == foot].any(axis=1) for foot in feet], axis=1)
    joints = clip.qpos[:, 7:]
    sagittal = np.degrees(np.ptp(joints[:, robot.sagittal_joints], axis=0))
    names = [f"range_{side}_{joint}" for side in ("left", "right") for joint in ("hip", "knee", "ankle")]
    landings = [np.flatnonzero(down[1:, i] & ~down[:-1, i]) + 1 for i in range(2)]
    strides = sum(len(at) - 1 for at in landings)
    return {
        "speed": float((clip.qpos[-1, 0] - clip.qpos[0, 0]) / clip.duration),
        "cadence": 2 * strides * clip.rate / max(1, sum(at[-1] - at[0] for at in landings if len(at))),
        "height_min": float(clip.qpos[:, 2].min()),
        "height_max": float(clip.qpos[:, 2].max()),
        **dict(zip(names, sagittal.tolist(), strict=True)),
        "slip": slip(robot, points, rotation, touch),
        "penetration": float(max(0.0, -height.min())),
        "gap": float(height.min(axis=1).max()),
        "clearance": _clearance(height, [robot.sole_body == foot for foot in feet], down),
        "limit_margin": float(np.minimum(joints - robot.joint_low, robot.joint_high - joints).min()),
        "joint_speed": float(np.abs(clip.qvel[:, 6:]).max()),
        # One-sided velocities at the ends would pass for jumps.
        "joint_acceleration": float(np.abs(np.diff(clip.qvel[1:-1, 6:], axis=0)).max() * clip.rate),
        "double_support": float(down.all(axis=1).mean()),
        "lateral": float(np.ptp(clip.qpos[:, 1]) / 2),
        "balance": _balance(robot, clip, points, height),
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


def _balance(robot: Robot, clip: MotionClip, points: np.ndarray, height: np.ndarray) -> float:
    """Root mean square distance (m) of the zero-moment point from the box around the sole points near the floor."""
    inside = slice(2, len(clip.qpos) - 2)
    push = _ground_force(robot, clip.qpos, clip.rate, 0.0)[0][inside]
    near = height[inside, :, None] < 0.01
    low = np.where(near, points[inside, :, :2], np.inf).min(axis=1)
    high = np.where(near, points[inside, :, :2], -np.inf).max(axis=1)
    return float(np.sqrt(np.mean(np.sum((push - np.clip(push, low, high)) ** 2, axis=1))))


def main() -> None:
    """Write the bundled walk."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--out", required=True, help="file to write, .npz")
    parser.add_argument("--robot", default="unitree_g1")
    parser.add_argument("--speed", type=float, default=0.85, help="m/s")
    parser.add_argument("--duration", type=float, default=8.0, help="s")
    arguments = parser.parse_args()
    robot = robots.load(arguments.robot)
    save(synthesize(robot, speed=arguments.speed, duration=arguments.duration), arguments.out)


if __name__ == "__main__":
    main()
