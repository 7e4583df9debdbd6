"""GMR's ``.pkl``: ``fps``, ``root_pos [T, 3]`` (m), ``root_rot [T, 4]`` (xyzw), ``dof_pos [T, J]`` (rad).

Joints are in the model's order; what else is in the file is not read.
"""

from pathlib import Path

from fmpjax.motion.readers.pickled import numbers
from fmpjax.motion.readers.recording import Recording, assemble, positive, table
from fmpjax.robots import Robot

NAME = "GMR"
MARKS = ("fps", "root_pos", "root_rot", "dof_pos")


def read(file: Path, content: dict[str, object], robot: Robot) -> Recording:
    """The recording in a GMR motion."""
    columns = {"root_pos": 3, "root_rot": 4, "dof_pos": robot.joint_count}
    position, rotation_xyzw, joints = (
        table(file, name, numbers(file, name, content[name], n), n) for name, n in columns.items()
    )
    rotation_wxyz = rotation_xyzw[:, [3, 0, 1, 2]]
    return assemble(file, "root_rot", position, rotation_wxyz, joints, positive(file, "fps", content["fps"]))
