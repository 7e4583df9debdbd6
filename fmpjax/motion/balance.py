"""Where and how hard the ground must push for a steady motion to be possible."""

import mujoco
import numpy as np

from fmpjax.motion.path import moved
from fmpjax.robots import Robot

GRAVITY = 9.81  # m/s^2


def zero_moment_point(robot: Robot, qpos: np.ndarray, rate: float, way: np.ndarray, angle: float = 0.0) -> np.ndarray:
    """Where the ground pushes, ``[N, 2]`` m, through one period ``qpos [N, 7 + J]`` of a steady motion.

    ``rate`` is in Hz. A period moves the motion on by ``way [2]`` (m) and turns it by ``angle`` (rad).
    """
    return ground_force(robot, qpos, rate, way, angle)[0]


def ground_force(
    robot: Robot, qpos: np.ndarray, rate: float, way: np.ndarray, angle: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Zero-moment point ``[N, 2]`` (m) and total ground force ``[N, 3]`` (N) of the same."""
    model, data = robot.model, mujoco.MjData(robot.model)
    before, after = np.roll(qpos, 1, axis=0), np.roll(qpos, -1, axis=0)
    before[0] = moved(before[0], -way, -angle)
    after[-1] = moved(after[-1], way, angle)
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
