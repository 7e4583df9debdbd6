"""Where the soles of a clip are, and how far they slide over the floor."""

import mujoco
import numpy as np

from fmpjax.robots import Robot


def sole_points(robot: Robot, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World centres of the sole spheres ``[T, P, 3]`` and rotation matrices of their bodies ``[T, P, 3, 3]``."""
    data = mujoco.MjData(robot.model)
    position = np.zeros((len(qpos), len(robot.sole_body), 3))
    rotation = np.zeros((*position.shape, 3))
    for i, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.model, data)
        rotation[i] = data.xmat[robot.sole_body + 1].reshape(-1, 3, 3)
        position[i] = data.xpos[robot.sole_body + 1]
    return position + np.einsum("tpij,pj->tpi", rotation, robot.sole_point), rotation


def slides(robot: Robot, points: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Way (m) over the floor of each sphere's lowest point from sample to sample, ``[T - 1, P]``; rolling is none."""
    turn = rotation[1:] @ np.swapaxes(rotation[:-1], -1, -2)
    # Rotation vector of a small turn; the bottom of the sphere moves by the turn crossed with minus the radius.
    vector = 0.5 * np.stack([turn[..., 2, 1] - turn[..., 1, 2], turn[..., 0, 2] - turn[..., 2, 0]], axis=-1)
    rolled = robot.sole_radius[:, None] * np.stack([-vector[..., 1], vector[..., 0]], axis=-1)
    return np.linalg.norm(points[1:, :, :2] - points[:-1, :, :2] + rolled, axis=-1)


def slip(robot: Robot, points: np.ndarray, rotation: np.ndarray, touch: np.ndarray) -> float:
    """Greatest distance (m) that a point slides over the floor while it touches (``touch [T, P]``) without a break."""
    worst, run = 0.0, np.zeros(points.shape[1])
    for distance, both in zip(slides(robot, points, rotation), touch[1:] & touch[:-1], strict=True):
        run = np.where(both, run + distance, 0.0)
        worst = max(worst, float(run.max()))
    return worst
