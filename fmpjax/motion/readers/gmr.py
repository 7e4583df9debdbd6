"""GMR's ``.pkl``: ``fps``, ``root_pos [T, 3]`` (m), ``root_rot [T, 4]`` (xyzw), ``dof_pos [T, J]`` (rad).

Joints are in the model's order unless the file has ``joint_names`` or ``dof_names``; what else it has is not read.
"""

from collections.abc import Mapping
from pathlib import Path

from fmpjax.motion.clip import Fact
from fmpjax.motion.readers.pickled import numbers
from fmpjax.motion.readers.recording import Options, Recording, assemble, match, positive, table, texts
from fmpjax.robots import Robot

NAME = "GMR"
MARKS = ("fps", "root_pos", "root_rot", "dof_pos")
JOINT_NAMES = ("joint_names", "dof_names")


def read(file: Path, content: Mapping, robot: Robot, options: Options) -> Recording:
    """The recording in a GMR motion."""
    position = table(file, "root_pos", numbers(file, "root_pos", content["root_pos"], 3), 3)
    rotation = table(file, "root_rot", numbers(file, "root_rot", content["root_rot"], 4), 4)
    value = numbers(file, "dof_pos", content["dof_pos"], robot.joint_count)
    value = value[..., 0] if value.ndim == 3 and value.shape[-1] == 1 else value
    joints = table(file, "dof_pos", value, -1)
    key = next((key for key in JOINT_NAMES if key in content), None)
    names = None if key is None else texts(file, key, content[key])
    return assemble(
        file,
        robot,
        options,
        Fact("format", "GMR", "its names"),
        position=position,
        rotation=rotation,
        order="xyzw",
        joints=joints,
        columns=match(file, names, joints.shape[1], robot, options, "dof_pos"),
        rate=positive(file, "fps", content["fps"]),
        rate_from="the file",
        name="root_rot row",
    )
