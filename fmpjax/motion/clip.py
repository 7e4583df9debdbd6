"""A motion clip on the host: a robot's configurations and velocities on a regular time grid."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from fmpjax import rotations, tables


class Fact(NamedTuple):
    """One thing that a file was read as, and where that comes from."""

    what: str
    value: str
    why: str


class Reading(NamedTuple):
    """What a file was read as: format, robot, joints, quaternion order, rate; and what could not be proved."""

    facts: tuple[Fact, ...] = ()
    warnings: tuple[str, ...] = ()

    def __str__(self) -> str:
        """One line per fact, then one per warning."""
        facts = [tables.lines("  {:<12}{:<32}{}", self.facts)] if self.facts else []
        return "\n".join([*facts, *(f"  warning: {warning}" for warning in self.warnings)])


@dataclasses.dataclass(frozen=True, eq=False)
class MotionClip:
    """Configurations and velocities of one robot in MuJoCo's order and conventions, ``T`` samples, ``J`` joints.

    ``qpos [T, 7 + J]``: root position (world, m), root quaternion (wxyz), joint angles (rad).
    ``qvel [T, 6 + J]``: root velocity (world, m/s), root angular velocity (body frame, rad/s), joint velocities
    (rad/s).
    """

    name: str
    robot: str
    rate: float  # Hz
    qpos: np.ndarray
    qvel: np.ndarray
    reading: Reading = Reading()  # empty for a clip that comes from no file

    def __len__(self) -> int:
        return len(self.qpos)

    def __repr__(self) -> str:
        length = f"{self.duration:.2f} s, {len(self)} samples at {self.rate:g} Hz"
        return f"MotionClip({self.name} of {self.robot}, {length})"

    @property
    def duration(self) -> float:
        """Time from the first sample to the last, s."""
        return (len(self.qpos) - 1) / self.rate

    @property
    def yaw(self) -> np.ndarray:
        """Heading of the root at each sample, ``[T]`` rad, positive to the left, without jumps by a full turn."""
        return np.unwrap(rotations.yaw(self.qpos[:, 3:7]))

    @property
    def turning(self) -> float:
        """Mean rate at which the heading turns, rad/s, positive to the left."""
        yaw = self.yaw
        return float(yaw[-1] - yaw[0]) / self.duration

    @property
    def heading_velocities(self) -> np.ndarray:
        """Velocity in the own heading at each sample, ``[T, 3]``: m/s ahead, m/s and rad/s to the left."""
        (vx, vy), yaw = self.qvel[:, :2].T, self.yaw
        cosine, sine = np.cos(yaw), np.sin(yaw)
        return np.stack([vx * cosine + vy * sine, vy * cosine - vx * sine, np.gradient(yaw) * self.rate], axis=1)

    @classmethod
    def from_qpos(cls, name: str, robot: str, rate: float, qpos: np.ndarray) -> "MotionClip":
        """A clip from configurations alone: the root quaternion is made continuous, velocities are differences."""
        qpos = np.array(qpos, np.float64)
        qpos[:, 3:7] = continuous(qpos[:, 3:7])
        return cls(name, robot, float(rate), qpos, velocities(qpos, rate))


def refined(clip: MotionClip, parts: int) -> MotionClip:
    """The clip with every interval between two samples cut into ``parts``: ``(T - 1) parts + 1`` samples.

    Every ``parts``-th sample is the clip's own. Between them positions, joints and velocities change linearly, the
    root's orientation along the shorter arc.
    """
    if parts == 1:
        return clip
    at = np.arange((len(clip) - 1) * parts + 1)
    left = np.minimum(at // parts, len(clip) - 2)
    fraction = ((at - left * parts) / parts)[:, None]

    def between(samples: np.ndarray) -> np.ndarray:
        return samples[left] + fraction * (samples[left + 1] - samples[left])

    qpos = between(clip.qpos)
    qpos[:, 3:7] = rotations.slerp(clip.qpos[left, 3:7], clip.qpos[left + 1, 3:7], fraction)
    qpos[::parts] = clip.qpos
    return dataclasses.replace(clip, rate=clip.rate * parts, qpos=qpos, qvel=between(clip.qvel))


def continuous(q_wxyz: np.ndarray) -> np.ndarray:
    """Unit quaternions ``[T, 4]`` with signs that never flip between samples; the first has ``w >= 0``."""
    q = q_wxyz / np.linalg.norm(q_wxyz, axis=-1, keepdims=True)
    flips = np.where(np.sum(q[1:] * q[:-1], axis=-1) < 0, -1.0, 1.0)
    first = -1.0 if q[0, 0] < 0 else 1.0
    return q * (first * np.concatenate([[1.0], np.cumprod(flips)]))[:, None]


def sample_count(rows: int, source_rate: float, rate: float) -> int:
    """Number of samples at ``rate`` from the first of ``rows`` source rows to the last one, both included."""
    # The slack keeps a last sample that falls on the grid from being lost to rounding.
    return max(0, math.floor(min((rows - 1) * rate / source_rate, 1e15) + 1e-6) + 1)  # tiny rates give infinity


def resample(qpos: np.ndarray, source_rate: float, rate: float) -> np.ndarray:
    """Put ``qpos [T, 7 + J]`` at ``source_rate`` on the grid of ``rate`` (Hz): ``[N, 7 + J]``.

    The root position and the joints are interpolated linearly, the root orientation along the shorter arc. Times run
    from the first source row to the last; the last is a sample where it falls on the grid (211 rows at 30 Hz give 351
    samples at 50 Hz).
    """
    qpos = np.array(qpos, np.float64)
    qpos[:, 3:7] = continuous(qpos[:, 3:7])
    if len(qpos) == 1 or source_rate == rate:
        return qpos
    position = np.arange(sample_count(len(qpos), source_rate, rate)) * (source_rate / rate)
    left = np.minimum(position.astype(int), len(qpos) - 2)
    fraction = np.minimum(position - left, 1.0)[:, None]
    before, after = qpos[left], qpos[left + 1]
    out = before + fraction * (after - before)
    out[:, 3:7] = continuous(rotations.slerp(before[:, 3:7], after[:, 3:7], fraction))
    return out


def velocities(qpos: np.ndarray, rate: float) -> np.ndarray:
    """Finite differences of ``qpos [T, 7 + J]`` at ``rate`` (Hz): ``[T, 6 + J]``, ``T >= 2``.

    Central in the interior, one-sided at both ends. The root's angular velocity is the logarithm of the relative
    rotation, in the body frame.
    """
    t = np.arange(len(qpos))
    before, after = np.maximum(t - 1, 0), np.minimum(t + 1, len(qpos) - 1)
    per_second = (rate / (after - before))[:, None]
    turn = rotations.multiply(rotations.conjugate(qpos[before, 3:7]), qpos[after, 3:7])
    difference = qpos[after] - qpos[before]
    return per_second * np.concatenate([difference[:, :3], rotations.log_map(turn), difference[:, 7:]], axis=1)
