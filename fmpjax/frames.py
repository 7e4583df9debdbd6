"""Where each quantity is in a compact frame. Only this file knows the order."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fmpjax.robots import Robot


class FrameLayout(NamedTuple):
    """Slices of the last axis of compact frames ``[..., F]``, in their order."""

    root: slice  # m, absolute; in a relative window x and y are relative to the newest frame
    rotation: slice  # 6D rotation of the root
    cosine: slice  # of the joint angles
    sine: slice
    key_points: slice  # m, x, y and z of each key point less the root
    velocity: slice  # m/s, of the root in world axes
    angular_velocity: slice  # rad/s, of the root in world axes
    joint_velocity: slice  # rad/s

    @classmethod
    def of(cls, robot: Robot) -> "FrameLayout":
        """The layout of a robot's frames."""
        joints = robot.joint_count
        return cls(*_slices(3, 6, joints, joints, 3 * len(robot.key_body), 3, 3, joints))

    @property
    def size(self) -> int:
        """F, numbers in a frame."""
        return self[-1].stop

    def axis_heights(self, frames: Float[Any, "*batch F"]) -> Float[Any, "*batch 2"]:
        """The heights of the root's x and z axes, unit vectors: the part of its rotation that no turning changes."""
        return frames[..., self.rotation][..., 2::3]

    def heading_velocity(self, frames: Float[Any, "*batch F"]) -> Float[jax.Array, "*batch 3"]:
        """The root's velocity in the heading frame: m/s ahead, m/s and rad/s to the left."""
        velocity, turning = headed(frames[..., FORWARD], frames[..., self.velocity]), frames[..., self.angular_velocity]
        return jnp.concatenate([velocity[..., :2], turning[..., 2:]], axis=-1)

    @classmethod
    def join(cls, **parts: Float[jax.Array, "*batch _"]) -> Float[jax.Array, "*batch F"]:
        """Frames ``[..., F]`` of their parts, each given by its field's name."""
        return jnp.concatenate([parts[name] for name in cls._fields], axis=-1)


def headed(forward: Float[jax.Array, "*#batch 2"], vectors: Float[jax.Array, "*#batch n"]) -> Float[jax.Array, "... n"]:
    """Vectors ``[..., n]``, three numbers each, in axes of which x points along ``forward [..., 2]`` and z stays."""
    cosine, sine = jnp.split(forward / jnp.maximum(jnp.linalg.norm(forward, axis=-1, keepdims=True), 1e-6), 2, axis=-1)
    x, y, z = (vectors[..., i::3] for i in range(3))
    return jnp.stack([x * cosine + y * sine, y * cosine - x * sine, z], axis=-1).reshape(vectors.shape)


def _slices(*widths: int) -> list[slice]:
    ends = np.cumsum(widths).tolist()
    return [slice(end - width, end) for end, width in zip(ends, widths, strict=True)]


# The same in every robot's frames.
PLANAR = slice(0, 2)  # x and y of the root
FORWARD = slice(3, 5)  # x and y of the root's x axis, the way that it faces
