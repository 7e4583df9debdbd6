"""The parts of an observation by name, as functions of a `Simulation`."""

from collections.abc import Callable
from typing import Any

import numpy as np


def _joint_rotations(sim) -> np.ndarray:
    """First and last column of each hinge's rotation, ``[rows, 6]``."""
    axis, angle = sim.policy.joint_axes, sim.qpos[7:, None]
    columns = []
    for unit in np.eye(3)[[0, 2]]:
        along = axis * (axis @ unit)[:, None]
        columns.append(np.cos(angle) * (unit - along) + np.sin(angle) * np.cross(axis, unit) + along)
    rows = np.concatenate(columns, -1)
    return rows if (cut := sim.policy.jointless_row) is None else np.insert(rows, cut, [1, 0, 0, 0, 0, 1], axis=0)


def _heading(sim, vectors: np.ndarray) -> np.ndarray:
    """World vectors ``[..., 3]`` in axes of which x points where the root faces."""
    x, y = sim.facing
    return vectors @ np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])


TERMS: dict[str, Callable[[Any], np.ndarray]] = {
    "root_height": lambda sim: sim.qpos[2:3],
    "root_rotation_6d": lambda sim: sim.axes[:, [0, 2]].T,
    "root_linear_velocity": lambda sim: sim.qvel[:3],
    "root_angular_velocity": lambda sim: sim.axes @ sim.qvel[3:6],
    "joint_position": lambda sim: sim.qpos[7:],
    "joint_rotation_6d": _joint_rotations,
    "joint_velocity": lambda sim: sim.qvel[6:],
    "key_points": lambda sim: sim.key_points(),
    "heading_rotation_6d": lambda sim: _heading(sim, sim.axes[:, [0, 2]].T),
    "heading_linear_velocity": lambda sim: _heading(sim, sim.qvel[:3]),
    "heading_angular_velocity": lambda sim: _heading(sim, sim.axes @ sim.qvel[3:6]),
    "heading_key_points": lambda sim: _heading(sim, sim.key_points()),
    # What a robot senses, under the names of Unitree's programs.
    "base_ang_vel": lambda sim: sim.qvel[3:6],
    "projected_gravity": lambda sim: -sim.axes[2],
    "velocity_commands": lambda sim: sim.told,
    "velocity_errors": lambda sim: sim.errors,
    "joint_pos": lambda sim: sim.qpos[7:],
    "joint_pos_rel": lambda sim: sim.qpos[7:] - sim.policy.center,
    "joint_vel_rel": lambda sim: sim.qvel[6:],
    "last_action": lambda sim: sim.action,
}
# What needs more than the file of a policy and a model: the clip whose time the policy is told.
CLIP_TERMS: dict[str, Callable[[Any], np.ndarray]] = {"clip_phase": lambda sim: sim.phase()}
