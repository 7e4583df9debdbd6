"""Quality figures of a steady walk."""

import numpy as np

from fmpjax.motion.balance import ground_force
from fmpjax.motion.clip import MotionClip
from fmpjax.motion.path import turned
from fmpjax.motion.soles import slip, sole_points
from fmpjax.robots import Robot


def measure(robot: Robot, clip: MotionClip, *, contact: float = 0.001) -> dict[str, float]:
    """Quality figures of a steady walk.

    A sole point is in contact while its lowest point is less than ``contact`` (m) above the floor.

    Returns:
      ``speed``, ``sideways``: mean velocity of the root ahead and to the left in its own heading, which the swing of
      the pelvis is no part of, m/s. ``turn``: mean, positive to the left, rad/s.
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
    strides = sum(max(0, len(at) - 1) for at in landings)
    yaw, turn = clip.yaw, clip.turning
    heading = turn * np.arange(len(clip)) / clip.rate
    heading = heading + np.mean((yaw - heading)[:-1])  # the last sample is the first one of another stride
    step = turned(np.diff(clip.qpos[:, :2], axis=0), -(heading[1:] + heading[:-1]) / 2)
    sideways = np.cumsum(step[:, 1] - step[:, 1].mean())
    return {
        "speed": float(step[:, 0].mean() * clip.rate),
        "sideways": float(step[:, 1].mean() * clip.rate),
        "turn": turn,
        "cadence": float(2 * strides * clip.rate / max(1, sum(at[-1] - at[0] for at in landings if len(at)))),
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
    push = turned(ground_force(robot, clip.qpos, clip.rate, np.zeros(2))[0], -heading)[inside]
    near = height[inside, :, None] < 0.01
    spread = turned(points[..., :2], -heading[:, None])[inside]
    low = np.where(near, spread, np.inf).min(axis=1)
    high = np.where(near, spread, -np.inf).max(axis=1)
    return float(np.sqrt(np.mean(np.sum((push - np.clip(push, low, high)) ** 2, axis=1))))
