"""One stride of a steady walk: prescribed feet, pelvis and arms, inverse kinematics, balance by iteration.

The feet are given. A foot lands on the edge of its heel, rolls flat, stands, rolls over the edge of its toe and swings;
backward it is the toe's edge first and the heel's last. Edges roll without sliding. The legs follow by inverse
kinematics. The path of the pelvis over the floor is then found so that the zero-moment point - where the ground must
push for the motion to be possible - goes from foot to foot and along each foot. A pendulum relates the two well enough
to correct one by the error of the other, harmonic by harmonic.

A walk that turns goes along an arc. Each foot stands as on a straight line, only the line's direction is the arc's
where the foot lands. Seen from a frame that moves along the arc and turns with it, every stride is the same: there the
balance is found in the same way.

Phases are fractions of a stride and start at the left foot's landing; of a straight walk, the right leg is the left
one's mirror image half a stride later.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BPoly

from fmpjax import rotations
from fmpjax.errors import UserError
from fmpjax.motion.balance import GRAVITY, zero_moment_point
from fmpjax.motion.legs import Leg
from fmpjax.motion.path import arc, heading_wxyz, turned
from fmpjax.motion.style import Style
from fmpjax.robots import Robot

HARMONICS = 7  # of the path of the pelvis over the floor
ITERATIONS = 8  # of the balance


class Stride:
    """One stride as functions of the phase; the path of the pelvis over the floor is a Fourier series.

    The walker's frame moves along the path, ``way [2]`` m and ``angle`` rad a stride of ``period`` s; at phase 0 it is
    the world's. The pelvis faces where the frame did ``lag`` of a stride ago. The style has every number.

    Raises:
      UserError: the robot's legs do not have six hinges, or it has no joint that its walk moves.
    """

    def __init__(self, robot: Robot, way: np.ndarray, angle: float, period: float, style: Style, lag: float = 0.0):
        self.robot, self.style, self.period, self.angle, self.lag = robot, style, period, angle, lag
        self.way = np.asarray(way, float)
        self.stands = not (self.way.any() or angle or style.swing_lift)
        self.legs = [Leg(robot, body) for body in robot.feet]
        joints = robot.gait.get("joints", {})
        missing = [name for name in joints.values() if name not in robot.joint_names]
        if missing:
            raise UserError(f"robot {robot.name!r} has no joint {missing[0]!r}, which its walk moves")
        self.parts = [(part, 7 + robot.joint_names.index(name)) for part, name in joints.items()]
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
        # Of a foot with its outer edge up: one edge of the sole lands first, or leaves last, as its side may be.
        still, rate = [0.0, 0.0, 0.0], abs(s.bank) / s.flat
        ahead = BPoly.from_derivatives(
            [0.0, s.flat, s.toe_off, 1.0], [[abs(s.bank), -rate, 0.0], still, still, [abs(s.bank), -rate, 0.0]]
        )
        rate = abs(s.bank) / (s.toe_off - s.heel_off)
        behind = BPoly.from_derivatives(
            [0.0, s.heel_off, s.toe_off, 1.0], [still, still, [abs(s.bank), rate, 0.0], still]
        )
        self.bank = (ahead, behind) if s.bank > 0 else (behind, ahead)
        # From where a foot stands to where it stands next, for either foot, in the frame of the former.
        self.swing = []
        for side, sign in enumerate((1, -1)):
            aside = np.array([0.0, sign * s.half_width])
            off, on = self._standing(side, s.toe_off), self._standing(side, 1.0)
            for value in on:
                value[:2] = turned(value[:2], angle)
            on[0][:2] += arc(self.way, angle) + turned(aside, angle) - aside
            self.swing.append(BPoly.from_derivatives([s.toe_off, 1.0], [off, on]))
        self.swing_heading = BPoly.from_derivatives([s.toe_off, 1.0], [[0.0, 0.0, 0.0], [angle, 0.0, 0.0]])

    def _standing(self, side: int, phase: float) -> list[np.ndarray]:
        """Position ``[3]`` of a foot that stands with its center at the origin, and two derivatives by phase."""
        h = 1e-4
        near = (phase + np.array([-h, 0.0, h])) % 1.0
        a, b, c = self._rolled(side, self.pitch(near), self.bank[side](near))
        return [b, (c - a) / (2 * h), (a - 2 * b + c) / h**2]

    def _rolled(self, side: int, pitch: np.ndarray, bank: np.ndarray) -> np.ndarray:
        """Position ``[N, 3]`` of the foot's body, in the frame where it stands, when the sole has rolled on its edges.

        The edge that touches has a radius, so its center moves on by radius times angle.
        """
        leg, sign, zero = self.legs[side], 1 - 2 * side, np.zeros_like(pitch)
        x, y, z = (np.where(pitch[:, None] < 0, leg.heel, leg.toe) * [1.0, -sign, 1.0]).T
        bank = sign * bank
        # Written out, not by quaternions: second differences of this would show the rounding of more operations.
        up, over = np.sin(bank) * y + np.cos(bank) * z, np.cos(bank) * y - np.sin(bank) * z
        c, s = np.cos(pitch), np.sin(pitch)
        center = np.stack([x + leg.radius * pitch, y - leg.radius * bank, zero + leg.radius], axis=-1)
        return center - np.stack([c * x + s * up, over, c * up - s * x], axis=-1)

    def place(self, phase: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """The walker's frame: its origin, world ``[..., 2]`` m, and its heading ``[...]`` rad; any phase ``[...]``."""
        phase = np.asarray(phase)
        return arc(phase[..., None] * self.way, phase * self.angle), phase * self.angle

    def foot_poses(self, side: int, phase: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World positions ``[N, 3]`` (m) and wxyz orientations ``[N, 4]`` of the left (0) or right (1) foot; any phase.

        The left foot's center lands beside the walker's frame of phase 0, the right one's of phase 1/2.
        """
        s, sign = self.style, 1 - 2 * side
        strides, phase = np.divmod(phase - 0.5 * side, 1.0)
        pitch, bank, stands = self.pitch(phase), self.bank[side](phase), phase <= s.toe_off
        part = np.where(stands, 0.0, (phase - s.toe_off) / (1 - s.toe_off))
        swinging = self.swing[side](np.maximum(phase, s.toe_off))
        swinging[:, 2] += s.swing_lift * 16 * part**2 * (1 - part) ** 2
        position = np.where(stands[:, None], self._rolled(side, pitch, bank), swinging)
        heading = np.where(stands, 0.0, self.swing_heading(np.maximum(phase, s.toe_off)))
        origin, direction = self.place(strides + 0.5 * side)
        position[:, :2] = origin + turned(position[:, :2] + [0.0, sign * s.half_width], direction)
        turn_wxyz = heading_wxyz(direction + heading + sign * s.toe_out)
        return position, rotations.multiply(turn_wxyz, _rolled_wxyz(pitch, sign * bank))

    def upper(self, phase: np.ndarray) -> np.ndarray:
        """``qpos [N, 7 + J]`` in the walker's frame: all but the legs and the pelvis's place over the floor."""
        s = self.style
        qpos = np.zeros((len(phase), self.robot.model.nq))
        forward = np.cos(2 * np.pi * phase)  # 1 when the left foot lands, -1 when the right does
        stance = np.cos(2 * np.pi * (phase - 0.5 * (s.toe_off - 0.5) - 0.25))  # 1 in the left foot's mid-stance
        qpos[:, 2] = s.pelvis_height + s.pelvis_bob * (2 * stance**2 - 1)
        yaw, roll = -s.pelvis_yaw * forward, s.pelvis_roll * stance
        turn_wxyz = [rotations.exp_map(v[:, None] * axis) for v, axis in ((yaw, [0, 0, 1]), (roll, [1, 0, 0]))]
        lean_wxyz = rotations.exp_map(np.array([0.0, s.pelvis_pitch, 0.0]))
        qpos[:, 3:7] = rotations.multiply(rotations.multiply(*turn_wxyz), lean_wxyz)
        angles = {
            "waist_yaw": s.torso_yaw * forward - yaw,
            "waist_roll": -roll,
            "waist_pitch": s.torso_pitch - s.pelvis_pitch,
        }
        for side, sign in (("left", 1.0), ("right", -1.0)):
            back = sign * forward
            angles[f"{side}_shoulder_pitch"] = s.arm_center + s.arm_swing * back
            angles[f"{side}_shoulder_roll"] = sign * s.arm_out
            angles[f"{side}_elbow"] = s.elbow + s.elbow_swing * back
        for part, column in self.parts:
            qpos[:, column] = angles[part]
        return qpos

    def pressure(self, phase: np.ndarray) -> np.ndarray:
        """Where the ground shall push, world ``[N, 2]`` m: along the standing foot, across in double support."""
        s = self.style
        if self.stands:
            return np.tile([(s.pressure_start + s.pressure_end) / 2, 0.0], (len(phase), 1))
        steps, within = np.divmod(phase, 0.5)
        double = s.toe_off - 0.5
        alone = (within - double) / (0.5 - double)
        one = self._under(steps, s.pressure_start + np.maximum(alone, 0) * (s.pressure_end - s.pressure_start))
        across = np.minimum(within / double, 1.0)[:, None]
        across = across * across * (3 - 2 * across)
        last, present = self._under(steps - 1, s.pressure_end), self._under(steps, s.pressure_start)
        return np.where(within[:, None] >= double, one, last + across * (present - last))

    def _under(self, step: np.ndarray, along: ArrayLike) -> np.ndarray:
        """World points ``[N, 2]`` under the feet of steps ``[N]`` (even ones are the left's), ``along`` them (m)."""
        across = (1 - 2 * (step % 2)) * (self.style.half_width - self.style.pressure_inward)
        origin, direction = self.place(0.5 * step)
        return origin + turned(np.stack(np.broadcast_arrays(along, across), axis=-1), direction)

    def solve(self, samples: int, iterations: int = ITERATIONS) -> tuple[np.ndarray, np.ndarray]:
        """The stride, balanced better with each iteration.

        Returns:
          Configurations ``[N, 7 + J]`` over one stride; the next one is the same, a stride further along the path. And
          the mean place of the pelvis in the walker's frame ``[2]``, m.

        Raises:
          OutOfReach: a foot is.
        """
        phase = np.arange(samples) / samples
        origin, heading = self.place(phase)
        wanted = turned(self.pressure(phase) - origin, -heading)
        qpos = self.upper(phase)
        qpos[:, 3:7] = rotations.multiply(heading_wxyz(heading - self.lag * self.angle), qpos[:, 3:7])
        omega2 = GRAVITY / (0.87 * self.style.pelvis_height)  # the mass is about so high; iterating mends the rest
        frequency = np.fft.rfftfreq(samples, 1 / samples)
        gain = 1 / (1 + (2 * np.pi * frequency / self.period) ** 2 / omega2)
        gain[frequency > HARMONICS] = 0.0
        path = np.fft.irfft(np.fft.rfft(wanted, axis=0) * gain[:, None], samples, axis=0)
        feet = [self.foot_poses(side, phase) for side in (0, 1)]
        for _ in range(iterations):
            qpos[:, :2] = origin + turned(path, heading)
            self._solve_legs(qpos, feet)
            found = zero_moment_point(self.robot, qpos, samples / self.period, self.way, self.angle)
            error = np.fft.rfft(wanted - turned(found - origin, -heading), axis=0) * gain[:, None]
            path = path + np.fft.irfft(error, samples, axis=0)
        qpos[:, :2] = origin + turned(path, heading)
        self._solve_legs(qpos, feet)
        return qpos, path.mean(axis=0)

    def _solve_legs(self, qpos: np.ndarray, feet: list[tuple[np.ndarray, np.ndarray]]) -> None:
        for leg, poses in zip(self.legs, feet, strict=True):
            for row, position, orientation_wxyz in zip(qpos, *poses, strict=True):
                leg.reach(row, position, orientation_wxyz)

    def room(self, samples: int) -> float:
        """Least distance (m) between the midlines of the two soles over the floor, less the soles' width."""
        phase, lines = np.arange(samples) / samples, []
        for side, leg in enumerate(self.legs):
            position, orientation_wxyz = self.foot_poses(side, phase)
            heel, toe = leg.heel * [1, 0, 1], leg.toe * [1, 0, 1]
            points = heel + np.linspace(0, 1, 8)[:, None] * (toe - heel)
            lines.append((position[:, None] + rotations.rotate(orientation_wxyz[:, None], points))[..., :2])
        gap = np.linalg.norm(lines[0][:, :, None] - lines[1][:, None, :], axis=-1)
        return float(gap.min()) - 2 * self.legs[0].half_width


def _rolled_wxyz(pitch: np.ndarray, bank: np.ndarray) -> np.ndarray:
    """Orientation ``[N, 4]`` of a sole that has rolled about its y axis and then about its x axis."""
    over_wxyz = rotations.exp_map(pitch[:, None] * [0.0, 1.0, 0.0])
    return rotations.multiply(over_wxyz, rotations.exp_map(bank[:, None] * [1.0, 0.0, 0.0]))
