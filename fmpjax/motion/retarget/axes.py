"""Orientations of a body whose joint names its axes otherwise."""

import mujoco
import numpy as np

from fmpjax import rotations


def upright(rotation_wxyz: np.ndarray, up: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Orientation ``[T, 4]`` of a joint's body, x ahead and z up, where the joint's own axes may be named otherwise.

    Which of the joint's axes is which is read from where ``up`` and ``left`` ``[T, 3]`` are on average.
    """
    inverse = rotations.conjugate(rotation_wxyz)
    axes = np.zeros((3, 3))
    for column, direction in ((2, up), (1, left)):
        mean = rotations.rotate(inverse, direction).mean(axis=0)
        mean = np.where(axes.any(axis=1), 0.0, mean)
        nearest = np.argmax(np.abs(mean))
        axes[nearest, column] = np.copysign(1.0, mean[nearest])
    axes[:, 0] = np.cross(axes[:, 1], axes[:, 2])
    return rotations.multiply(rotation_wxyz, quaternion_wxyz(axes))


def quaternion_wxyz(axes: np.ndarray) -> np.ndarray:
    """Quaternion of a rotation matrix ``[3, 3]``."""
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, axes.reshape(9))
    return out
