"""LocoMuJoCo's ``.npz``: ``qpos [T, nq]``, ``joint_names``, ``frequency`` (Hz), ``split_points``.

The first joint is the free root (xyz m, quaternion wxyz), the others are hinges (rad) in the order of their names;
joints that the robot does not have are left out. ``split_points`` bound the trajectories in the file; it must be one.
"""

from pathlib import Path

from fmpjax.errors import UserError
from fmpjax.motion.readers.archive import Arrays
from fmpjax.motion.readers.recording import Recording, assemble, order_by_name, positive, table
from fmpjax.robots import Robot

NAME = "LocoMuJoCo"
MARKS = ("qpos", "joint_names", "frequency")


def read(file: Path, content: Arrays, robot: Robot) -> Recording:
    """The recording in a LocoMuJoCo trajectory."""
    names = content["joint_names"].ravel().tolist()
    qpos = table(file, "qpos", content["qpos"], 6 + len(names), what=f"a free root and {len(names) - 1} hinges")
    if "split_points" in content and content["split_points"].size > 2:
        raise UserError(f"{file}: the file holds {content['split_points'].size - 1} trajectories, expected one")
    joints = qpos[:, 7 + order_by_name(file, names[1:], robot)]
    return assemble(file, "qpos", qpos[:, :3], qpos[:, 3:7], joints, positive(file, "frequency", content["frequency"]))
