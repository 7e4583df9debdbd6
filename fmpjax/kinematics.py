"""Forward kinematics of a batch of configurations, on the device.

Body poses follow from the hinges by pointer doubling: after round r every body knows its pose relative to its
ancestor 2^r levels up, so a tree of depth D takes log2(D) rounds of batched quaternion products. That compiles in a
second, where an unrolled chain of 30 bodies takes minutes.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import rotations
from fmpjax.robots import Robot


class BodyPoses(NamedTuple):
    """World poses of the robot's bodies."""

    position: jax.Array  # [..., B, 3] m, body origins
    rotation_wxyz: jax.Array  # [..., B, 4]


def body_poses(robot: Robot, qpos: jax.Array) -> BodyPoses:
    """Body poses of ``qpos [..., 7 + J]`` (root xyz m, root quaternion wxyz, joints rad)."""
    dtype = qpos.dtype
    bodies = len(robot.body_parent)
    hinged = robot.body_joint >= 0
    axis = np.zeros((bodies, 3))
    axis[hinged] = robot.joint_axis[robot.body_joint[hinged]]
    half = jnp.where(hinged, qpos[..., 7 + np.maximum(robot.body_joint, 0)], 0.0)[..., None] / 2
    hinge_wxyz = jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis.astype(dtype)], axis=-1)
    local_wxyz = rotations.multiply(jnp.asarray(robot.body_rotation_wxyz, dtype), hinge_wxyz)
    rotation_wxyz = local_wxyz.at[..., 0, :].set(qpos[..., 3:7])
    position = jnp.broadcast_to(jnp.asarray(robot.body_position, dtype), (*qpos.shape[:-1], bodies, 3))
    position = position.at[..., 0, :].set(qpos[..., :3])

    ancestor = robot.body_parent.copy()
    while (ancestor >= 0).any():
        # Only bodies that still have an ancestor move on; the others already stand in the world.
        moving = np.flatnonzero(ancestor >= 0)
        above_wxyz = rotation_wxyz[..., ancestor[moving], :]
        below = position[..., moving, :]
        new_position = position[..., ancestor[moving], :] + rotations.rotate(above_wxyz, below)
        new_wxyz = rotations.multiply(above_wxyz, rotation_wxyz[..., moving, :])
        position = position.at[..., moving, :].set(new_position)
        rotation_wxyz = rotation_wxyz.at[..., moving, :].set(new_wxyz)
        ancestor = np.where(ancestor >= 0, ancestor[np.maximum(ancestor, 0)], -1)
    return BodyPoses(position, rotation_wxyz)


def points(poses: BodyPoses, body: np.ndarray, offset: np.ndarray) -> jax.Array:
    """World positions ``[..., n, 3]`` of points at ``offset [n, 3]`` (m) in the bodies ``body [n]``."""
    return poses.position[..., body, :] + rotations.rotate(
        poses.rotation_wxyz[..., body, :], jnp.asarray(offset, poses.position.dtype)
    )


def key_points(robot: Robot, poses: BodyPoses) -> jax.Array:
    """Key points in the world, ``[..., K, 3]`` m."""
    return points(poses, robot.key_body, robot.key_offset)


def fallen(robot: Robot, poses: BodyPoses) -> jax.Array:
    """Whether any fall sphere or capsule reaches the floor, ``[...]`` bool.

    A capsule touches a plane where an end of its axis comes within the radius, so the test is exact.
    """
    ends = points(poses, np.repeat(robot.fall_body, 2), robot.fall_ends.reshape(-1, 3))
    return (ends[..., 2] < np.repeat(robot.fall_radius, 2).astype(ends.dtype)).any(-1)


def sole_heights(robot: Robot, poses: BodyPoses) -> jax.Array:
    """Heights of the sole points above the floor, ``[..., P]`` m."""
    return points(poses, robot.sole_body, robot.sole_point)[..., 2] - robot.sole_radius.astype(poses.position.dtype)
