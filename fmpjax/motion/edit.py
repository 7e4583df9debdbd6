"""Clips made from a clip: its mirror image, turned to a heading, closed to a loop, put right."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from fmpjax import rotations
from fmpjax.errors import UserError
from fmpjax.motion.clip import MotionClip, resample
from fmpjax.motion.readers.recording import MOST_SAMPLES
from fmpjax.motion.soles import sole_points
from fmpjax.robots import CONTACT_DEPTH, Robot

BLEND = 0.4  # s, over which a loop is closed
CLOSED = 0.3  # rad between the last pose and the first of a motion that loops
LOW = 5  # per cent of the samples may have the lowest sole below the floor after a shift
SIDES = {"left_": "right_", "right_": "left_"}


def mirrored(robot: Robot, clip: MotionClip) -> MotionClip:
    """The clip's reflection in the plane y = 0: left joints move as the right ones did."""
    order, sign = joint_mirror(robot)
    qpos = clip.qpos * np.concatenate([[1, -1, 1], [1, -1, 1, -1], np.ones(robot.joint_count)])
    qpos[:, 7:] = sign * clip.qpos[:, 7 + order]
    return _with(clip, qpos)


def joint_mirror(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """For each joint the index of its mirror image ``[J]`` and the sign of the angle there ``[J]``.

    A turn is an axial vector: reflected in y = 0 it keeps its y component and changes its x and z components.

    Raises:
      UserError: a joint has no partner, or the axes of two partners are not mirror images.
    """
    index = {name: i for i, name in enumerate(robot.joint_names)}
    order = np.zeros(robot.joint_count, int)
    for name, i in index.items():
        if partner(name) not in index:
            raise UserError(f"robot {robot.name!r} has no joint {partner(name)!r}, the mirror image of {name!r}")
        order[i] = index[partner(name)]
    sign = np.sum(robot.joint_axis[order] * robot.joint_axis * [-1, 1, -1], axis=1)
    odd = np.flatnonzero(np.abs(np.abs(sign) - 1) > 1e-6)
    if len(odd):
        raise UserError(f"robot {robot.name!r} is not symmetric at joint {robot.joint_names[odd[0]]!r}")
    return order, np.round(sign)


def partner(name: str) -> str:
    """The name of the joint or body on the other side; of one in the middle its own."""
    side = next((side for side in SIDES if name.startswith(side)), "")
    return SIDES.get(side, "") + name.removeprefix(side)


def headed(clip: MotionClip, heading: float) -> MotionClip:
    """The clip turned about the vertical through its first root position so that it travels to ``heading`` (rad)."""
    way = clip.qpos[-1, :2] - clip.qpos[0, :2]
    if np.linalg.norm(way) < 0.1:
        raise UserError(f"motion {clip.name!r} ends {np.linalg.norm(way):.2g} m from its start: it has no heading")
    angle = heading - np.arctan2(way[1], way[0])
    turn = rotations.exp_map(np.array([0.0, 0.0, angle]))
    qpos = clip.qpos.copy()
    qpos[:, :3] = clip.qpos[0, :3] + rotations.rotate(turn, clip.qpos[:, :3] - clip.qpos[0, :3])
    qpos[:, 3:7] = rotations.multiply(turn, clip.qpos[:, 3:7])
    return _with(clip, qpos)


def loop_target(clip: MotionClip) -> np.ndarray:
    """What the last sample ``[7 + J]`` would be in a loop: the first one, moved over the floor and turned about z."""
    target, last = clip.qpos[0].copy(), clip.qpos[-1]
    target[:2] = last[:2]
    turned = rotations.yaw(last[3:7]) - rotations.yaw(target[3:7])
    target[3:7] = rotations.multiply(rotations.exp_map(np.array([0.0, 0.0, turned])), target[3:7])
    return target


def loop_gap(clip: MotionClip) -> float:
    """The greatest angle between the last pose and the first, of the joints and of the root's tilt, rad."""
    target, last = loop_target(clip), clip.qpos[-1]
    tilt = np.linalg.norm(rotations.log_map(rotations.multiply(rotations.conjugate(last[3:7]), target[3:7])))
    return float(max(tilt, np.abs(last[7:] - target[7:]).max()))


def loops(clip: MotionClip) -> bool:
    """Whether the clip ends in the pose that it begins with, so that it can go on from there."""
    return loop_gap(clip) <= CLOSED


def looped(clip: MotionClip) -> MotionClip:
    """The clip with its end bent toward its start: over the last `BLEND` s the gap is taken off, smoothly."""
    target, last = loop_target(clip), clip.qpos[-1]
    time = np.arange(len(clip)) / clip.rate
    share = np.clip(1 - (clip.duration - time) / min(BLEND, clip.duration), 0, 1)[:, None]
    share = share * share * (3 - 2 * share)
    gap = rotations.log_map(rotations.multiply(rotations.conjugate(last[3:7]), target[3:7]))
    qpos = clip.qpos + share * (target - last)
    qpos[:, 3:7] = rotations.multiply(clip.qpos[:, 3:7], rotations.exp_map(share * gap))
    return _with(clip, qpos)


def repeated(clip: MotionClip, times: int) -> MotionClip:
    """The clip ``times`` times in a row, each copy where the one before has ended, after its ends are made to meet.

    Raises:
      UserError: the result has more samples than a motion may have.
    """
    if (len(clip) - 1) * times >= MOST_SAMPLES:
        raise UserError(f"--repeat is {times}: {len(clip)} samples that many times are more than {MOST_SAMPLES}")
    closed, turn = looped(clip).qpos, np.array([1.0, 0.0, 0.0, 0.0])
    pieces, place = [closed[:1]], closed[0, :3]
    step = closed[1:] - np.concatenate([closed[0, :3], np.zeros(clip.qpos.shape[1] - 3)])
    turned = rotations.yaw(closed[-1, 3:7]) - rotations.yaw(closed[0, 3:7])
    about = rotations.exp_map(np.array([0.0, 0.0, turned]))
    for _ in range(times):
        piece = step.copy()
        piece[:, :3] = place + rotations.rotate(turn, step[:, :3])
        piece[:, 3:7] = rotations.multiply(turn, step[:, 3:7])
        pieces.append(piece)
        place, turn = piece[-1, :3], rotations.multiply(turn, about)
    return _with(clip, np.concatenate(pieces))


def faster(clip: MotionClip, factor: float) -> MotionClip:
    """The clip played ``factor`` times as fast, at the same rate.

    Raises:
      UserError: the factor is not between a quarter and four, or fewer than two samples are left.
    """
    if not 0.25 <= factor <= 4:
        raise UserError(f"--speed is {factor:g}: expected a factor from 0.25 to 4")
    qpos = resample(clip.qpos, clip.rate * factor, clip.rate)
    if len(qpos) < 2:
        raise UserError(f"motion {clip.name!r} has {len(qpos)} sample at {factor:g} times its speed: expected two")
    return _with(clip, qpos)


def joined(clips: Sequence[MotionClip]) -> MotionClip:
    """Clips of one rate on end: each begins where the one before has ended, heading there, bent over `BLEND` s to meet.

    The meeting pose is the earlier clip's last one; the later clip's first `BLEND` s go over to its own poses.
    """
    pieces = [clips[0].qpos]
    for clip in clips[1:]:
        last, qpos = pieces[-1][-1], clip.qpos.copy()
        turn = rotations.exp_map(np.array([0.0, 0.0, rotations.yaw(last[3:7]) - rotations.yaw(qpos[0, 3:7])]))
        qpos[:, :3] = rotations.rotate(turn, qpos[:, :3] - qpos[0, :3] * [1, 1, 0]) + last[:3] * [1, 1, 0]
        qpos[:, 3:7] = rotations.multiply(turn, qpos[:, 3:7])
        share = np.clip(1 - np.arange(len(clip)) / clip.rate / min(BLEND, clip.duration), 0, 1)[:, None]
        share = share * share * (3 - 2 * share)
        gap = rotations.log_map(rotations.multiply(rotations.conjugate(qpos[0, 3:7]), last[3:7]))
        turned = rotations.multiply(qpos[:, 3:7], rotations.exp_map(share * gap))
        qpos += share * (last - qpos[0])
        qpos[:, 3:7] = turned
        pieces.append(qpos[1:])
    return _with(clips[0], np.concatenate(pieces))


def fixed(robot: Robot, clip: MotionClip) -> tuple[MotionClip, list[str]]:
    """The clip within the joints' limits and with its soles on the floor, and sentences that say what was changed."""
    said, qpos = [], clip.qpos.copy()
    qpos[:, 7:] = np.clip(qpos[:, 7:], robot.joint_low, robot.joint_high)
    moved = np.abs(qpos[:, 7:] - clip.qpos[:, 7:])
    for joint in np.flatnonzero(moved.max(axis=0)):
        samples, most = np.count_nonzero(moved[:, joint]), moved[:, joint].max()
        said.append(f"{robot.joint_names[joint]} clipped in {samples} samples, by {most:.3f} rad at most")
    points, _ = sole_points(robot, qpos)
    shift = -CONTACT_DEPTH - float(np.percentile((points[..., 2] - robot.sole_radius).min(axis=1), LOW))
    if abs(shift) > 1e-4:
        qpos[:, 2] += shift
        said.append(f"moved {'up' if shift > 0 else 'down'} by {abs(shift) * 1000:.1f} mm")
    return _with(clip, qpos), said


def _with(clip: MotionClip, qpos: np.ndarray) -> MotionClip:
    made = MotionClip.from_qpos(clip.name, clip.robot, clip.rate, qpos)
    return dataclasses.replace(made, reading=clip.reading)
