"""Forward kinematics of a batch of configurations, on the device.

Body poses follow from the hinges by pointer doubling: after round r every body knows its pose relative to its
ancestor 2^r levels up, so a tree of depth D takes log2(D) rounds of batched quaternion products. That compiles in a
second, where an unrolled chain of 30 bodies takes minutes.
"""

from functools import partial
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


@partial(jax.jit, static_argnames=("robot",), inline=True)
def body_poses(robot: Robot, qpos: jax.Array) -> BodyPoses:
    """Body poses of ``qpos [..., 7 + J]`` (root xyz m, root quaternion wxyz, joints rad)."""
    state = jnp.moveaxis(qpos, -1, 0)  # components first: a kernel then reads and writes whole rows

    def column(constant: np.ndarray) -> np.ndarray:  # [B, k] -> [k, B, 1...]
        return constant.T.reshape(*constant.T.shape, *[1] * (qpos.ndim - 1)).astype(qpos.dtype)

    # Each body but the first against its parent: a turn about the hinge, if it has one, after the body's own rotation.
    hinged, joint = robot.body_joint[1:] >= 0, np.maximum(robot.body_joint[1:], 0)
    rest_wxyz, axis = robot.body_rotation_wxyz[1:], np.where(hinged[:, None], robot.joint_axis[joint], 0.0)
    turn_wxyz = rotations.multiply(rest_wxyz, np.concatenate([np.zeros((len(axis), 1)), axis], axis=1))
    half = state[7 + joint] / 2
    if not hinged.all():
        half = half * column(hinged[:, None])[0]
    local_wxyz = jnp.cos(half) * column(rest_wxyz) + jnp.sin(half) * column(turn_wxyz)
    local_position = jnp.broadcast_to(column(robot.body_position[1:]), (3, *half.shape))
    root = jnp.concatenate([state[3:7], state[:3]])
    parts = jnp.concatenate([root[:, None], jnp.concatenate([local_wxyz, local_position])], axis=1)

    ancestor = robot.body_parent.copy()
    while (ancestor >= 0).any():
        # Only bodies that still have an ancestor move on; the others are already in world axes.
        moving = np.flatnonzero(ancestor >= 0)
        parts = parts.at[:, moving].set(_composed(parts[:, ancestor[moving]], parts[:, moving]))
        ancestor = np.where(ancestor >= 0, ancestor[np.maximum(ancestor, 0)], -1)
    return BodyPoses(_components_last(parts[4:]), _components_last(parts[:4]))


def _composed(outer: jax.Array, inner: jax.Array) -> jax.Array:
    """Poses ``[7, ...]`` that are told in the frames of other poses, told in the frames of those."""
    rotation_wxyz = rotations.multiplied(outer[:4], inner[:4])
    moved = rotations.rotated(outer[:4], inner[4:])
    return jnp.stack([*rotation_wxyz, *(a + b for a, b in zip(outer[4:], moved, strict=True))])


def _components_last(parts: jax.Array) -> jax.Array:
    return jnp.moveaxis(parts, (1, 0), (-2, -1))


def points(poses: BodyPoses, body: np.ndarray, offset: np.ndarray) -> jax.Array:
    """World positions ``[..., n, 3]`` of points at ``offset [n, 3]`` (m) in the bodies ``body [n]``."""
    rotation_wxyz, origin = (jnp.moveaxis(x, (-2, -1), (1, 0))[:, body] for x in (poses.rotation_wxyz, poses.position))
    there = offset.T.reshape(3, len(body), *[1] * (origin.ndim - 2)).astype(origin.dtype)
    moved = rotations.rotated(rotation_wxyz, there)
    return _components_last(jnp.stack([a + b for a, b in zip(origin, moved, strict=True)]))


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
