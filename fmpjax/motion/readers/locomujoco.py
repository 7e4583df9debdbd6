"""LocoMuJoCo's ``.npz``: ``qpos [T, nq]``, ``joint_names``, ``frequency`` (Hz), ``split_points``.

The first joint is the free root (xyz m, quaternion wxyz), the others are hinges (rad) in the order of their names;
joints that the robot does not have are left out. ``split_points`` bound the trajectories in the file; it must be one.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion.clip import Fact
from fmpjax.motion.readers.recording import Options, Recording, assemble, by_name, positive, table, texts
from fmpjax.robots import Robot

NAME = "LocoMuJoCo"
MARKS = ("qpos", "joint_names", "frequency")


def read(file: Path, content: Mapping, robot: Robot, options: Options) -> Recording:
    """The recording in a LocoMuJoCo trajectory."""
    names = texts(file, "joint_names", content["joint_names"])
    qpos = table(file, "qpos", content["qpos"], 6 + len(names), what=f"a free root and {len(names) - 1} hinges")
    points = content.get("split_points")
    if isinstance(points, np.ndarray) and points.size > 2:
        raise UserError(f"{file}: the file holds {points.size - 1} trajectories, expected one")
    return assemble(
        file,
        robot,
        options,
        Fact("format", "LocoMuJoCo", "its names"),
        position=qpos[:, :3],
        rotation=qpos[:, 3:7],
        order="wxyz",
        joints=qpos[:, 7:],
        columns=by_name(file, names[1:], robot),
        rate=positive(file, "frequency", content["frequency"]),
        rate_from="the file",
        name="qpos row",
    )
