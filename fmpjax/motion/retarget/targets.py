"""Where a robot's landmarks shall be: the source's joints, scaled to the robot."""

from typing import NamedTuple

import mujoco
import numpy as np

from fmpjax import rotations
from fmpjax.motion.retarget import feet
from fmpjax.motion.retarget.axes import upright
from fmpjax.motion.retarget.landmarks import JOINT_NAMES, SIDES
from fmpjax.robots import Robot


class Targets(NamedTuple):
    """Where the robot's landmarks shall be in each of ``T`` frames."""

    position: dict[str, np.ndarray]  # [T, 3] m, by landmark
    rotation_wxyz: dict[str, np.ndarray]  # [T, 4], by landmark
    contact: np.ndarray  # [T, 2] bool, left and right foot


def rest_positions(robot: Robot) -> dict[str, np.ndarray]:
    """Positions ``[3]`` (m) of the landmarks in the default pose, seen from the pelvis."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.default_qpos
    mujoco.mj_kinematics(robot.model, data)
    return {
        part: data.xpos[body + 1] - data.xpos[robot.landmarks["pelvis"] + 1] for part, body in robot.landmarks.items()
    }


def leg_length(position: dict[str, np.ndarray]) -> float:
    """Mean length of both legs from hip to ankle."""
    bones = [(f"{side}_{a}", f"{side}_{b}") for side in SIDES for a, b in (("hip", "knee"), ("knee", "ankle"))]
    return 2 * float(np.mean([np.linalg.norm(position[a] - position[b], axis=-1) for a, b in bones]))


def targets_of(
    robot: Robot, rest: dict, position: dict[str, np.ndarray], rotation_wxyz: dict[str, np.ndarray], rate: float
) -> Targets:
    """The robot's targets from the source's joints, which are scaled to the robot."""
    spine = sum(position[f"{side}_shoulder"] - position[f"{side}_hip"] for side in SIDES)
    turned = {
        part: upright(rotation_wxyz[part], spine, position[f"left_{ends}"] - position[f"right_{ends}"])
        for part, ends in (("pelvis", "hip"), ("chest", "shoulder"))
    }
    heel, toe, floor = feet.contacts(position, rate)
    middle = (position["left_hip"] + position["right_hip"]) / 2
    hips = (rest["left_hip"] + rest["right_hip"]) / 2
    ankle_height = {side: -feet.sole_height(robot, side, np.array([1.0, 0.0, 0.0, 0.0])) for side in SIDES}
    lift = np.array([0.0, 0.0, np.mean(list(ankle_height.values())) - floor["ankle"]])
    at = {"pelvis": middle + lift - rotations.rotate(turned["pelvis"], hips)}
    at["chest"] = at["pelvis"] + rotations.rotate(turned["pelvis"], rest["chest"])
    for i, side in enumerate(SIDES):
        part = {name: f"{side}_{name}" for name in JOINT_NAMES}
        hip = at["pelvis"] + rotations.rotate(turned["pelvis"], rest[part["hip"]])
        at[part["knee"]] = _along(hip, position, rest, part["hip"], part["knee"])
        shoulder = at["chest"] + rotations.rotate(turned["chest"], rest[part["shoulder"]] - rest["chest"])
        at[part["elbow"]] = _along(shoulder, position, rest, part["shoulder"], part["elbow"])
        at[part["wrist"]] = _along(at[part["elbow"]], position, rest, part["elbow"], part["wrist"])
        ankle = position[part["ankle"]]
        foot_wxyz = feet.foot_orientation(
            rotation_wxyz[part["ankle"]], position[part["toe"]] - ankle, heel[:, i] & toe[:, i], rate
        )
        # Legs keep their direction where the robot's hips are wider than the human's.
        free = ankle + (hip - position[part["hip"]]) * [1, 1, 0]
        at[part["ankle"]] = feet.planted(robot, side, free + lift, foot_wxyz, heel[:, i] | toe[:, i], rate)
        turned[part["ankle"]] = foot_wxyz
    return Targets(at, turned, heel | toe)


def _along(start: np.ndarray, position: dict, rest: dict, near: str, far: str) -> np.ndarray:
    """The end ``[T, 3]`` of the robot's segment from ``near`` to ``far`` that points as the human's does."""
    segment = position[far] - position[near]
    length = np.linalg.norm(rest[far] - rest[near])
    return start + length * segment / np.linalg.norm(segment, axis=-1, keepdims=True)
