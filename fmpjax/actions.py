"""What a normalized action means: joint targets."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax.motion import MotionClip, MotionLibrary
from fmpjax.robots import Robot


class ActionMap(NamedTuple):
    """Joint targets (rad) from normalized actions: clip(center + scale * a, low, high); each ``[J]``."""

    center: np.ndarray
    scale: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def __call__(self, action: jax.Array) -> jax.Array:
        return jnp.clip(self.center + self.scale * action, self.low, self.high).astype(action.dtype)

    def clipped(self, action: jax.Array) -> jax.Array:
        """The action within the limits of its targets, as an exported policy gives it."""
        low, high = (self.low - self.center) / self.scale, (self.high - self.center) / self.scale
        return jnp.clip(action, low, high).astype(action.dtype)


def action_map(robot: Robot, motion: MotionClip | MotionLibrary, kind: str) -> ActionMap:
    """The ``absolute`` map around zero, or the ``residual`` map around the demonstrations' mean pose."""
    if kind == "absolute":
        scale = 1.4 * np.maximum(np.abs(robot.joint_low), np.abs(robot.joint_high))
        return ActionMap(np.zeros_like(scale), scale, -scale, scale)
    library = MotionLibrary.of(motion)
    return ActionMap(
        center=library.mean([clip.qpos[:, 7:].mean(0) for clip in library.clips]),
        scale=0.25 * robot.effort / robot.stiffness,
        low=robot.joint_low - 0.3,
        high=robot.joint_high + 0.3,
    )
