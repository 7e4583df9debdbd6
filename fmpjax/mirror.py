"""Mirror images of what a policy observes and does: the robot reflected in its own left-right plane."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax.actions import ActionMap
from fmpjax.errors import UserError
from fmpjax.features import observation_terms
from fmpjax.motion.edit import joint_mirror, partner
from fmpjax.robots import Robot

# Reflection in y = 0. Vectors such as velocities change their y; turns, which are axial vectors, change their x and z.
VECTOR, TURN = (1, -1, 1), (-1, 1, -1)
SIX = VECTOR + VECTOR  # of a 6D rotation, which is the x and the z column of its matrix


class Reflection(NamedTuple):
    """A mirror image ``sign * x[..., order] + shift`` of numbers ``x [..., n]``; each field is ``[n]``."""

    order: np.ndarray
    sign: np.ndarray
    shift: np.ndarray

    def __call__(self, x: jax.Array) -> jax.Array:
        return (jnp.asarray(self.sign) * x[..., self.order] + jnp.asarray(self.shift)).astype(x.dtype)


class Mirror(NamedTuple):
    """The mirror images of observations ``[..., O]`` and of normalized actions ``[..., J]``."""

    observation: Reflection
    action: Reflection


def make(robot: Robot, form: str, actions: ActionMap) -> Mirror:
    """The mirror images for a robot whose policy observes ``form``, as `features.observation_form` gives it.

    Raises:
      UserError: the robot is not symmetric, or the mirror image of a part of the observation is not known.
    """
    joints, sign = joint_mirror(robot)
    names = [robot.model.body(int(body) + 1).name for body in robot.key_body]
    points = [names.index(partner(name)) for name in names]
    rows, cut = np.arange(robot.joint_count + (robot.jointless_row is not None)), robot.jointless_row
    if cut is None:
        rotations = joints
    else:
        row_of = np.delete(rows, cut)  # of each joint
        rotations = rows.copy()
        rotations[row_of] = row_of[joints]
    # The center of the actions is a pose, which may have a mirror image of its own.
    shift = sign * actions.center[joints] - actions.center
    action = Reflection(joints, sign * actions.scale[joints] / actions.scale, shift / actions.scale)
    parts = {
        "root_height": (np.arange(1), np.ones(1)),
        "velocity_commands": (np.arange(3), np.array([1, -1, -1])),
        "velocity_errors": (np.arange(3), np.array([1, -1, -1])),
        "joint_position": (joints, sign),
        "joint_velocity": (joints, sign),
        "joint_rotation_6d": _blocks(rotations, SIX),
        "base_ang_vel": _blocks(np.arange(1), TURN),
        "projected_gravity": _blocks(np.arange(1), VECTOR),
        "joint_pos_rel": (joints, sign, shift),
        "joint_vel_rel": (joints, sign),
        "last_action": action,
    }
    for axes in ("root", "heading"):
        parts[f"{axes}_rotation_6d"] = _blocks(np.arange(1), SIX)
        parts[f"{axes}_linear_velocity"] = _blocks(np.arange(1), VECTOR)
        parts[f"{axes}_angular_velocity"] = _blocks(np.arange(1), TURN)
    for name in ("key_points", "heading_key_points"):
        parts[name] = _blocks(np.array(points), VECTOR)
    found, start = [], 0
    for name, width in observation_terms(robot, form).items():
        if name not in parts:
            raise UserError(f"setting ppo.mirror is not 0: the mirror image of the observation's {name} is not known")
        order, signs, *moved = parts[name]
        for first in range(start, start + width, len(order)):  # more than one where the observation has a history
            found.append((first + order, signs, moved[0] if moved else np.zeros(len(order))))
        start += width
    order, signs, moved = (np.concatenate(each) for each in zip(*found, strict=True))
    return Mirror(Reflection(order, signs.astype(float), moved), action)


def _blocks(order: np.ndarray, sign: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Order and signs of numbers that come in blocks, of which ``order`` names the partners."""
    size = len(sign)
    return (size * order[:, None] + np.arange(size)).ravel(), np.tile(sign, len(order))
