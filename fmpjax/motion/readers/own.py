"""This package's ``.npz``: ``qpos [T, 7 + J]`` with the quaternion wxyz, ``rate`` (Hz), ``robot``."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion.clip import Fact
from fmpjax.motion.readers.recording import Options, Recording, assemble, by_order, positive, table, texts
from fmpjax.robots import Robot

NAME = "fmpjax"
MARKS = ("qpos", "rate", "robot")


def read(file: Path, content: Mapping, robot: Robot, options: Options) -> Recording:
    """The recording in a file written by `fmpjax.motion.save`; also of another robot with the same joints."""
    stored = "".join(texts(file, "robot", content["robot"])[:1])
    if not robot.takes(stored):
        raise UserError(f"{file}: the motion is for robot {stored[:60]!r}, expected {robot.name!r}")
    what = f"root xyz, quaternion wxyz, {robot.joint_count} joints of robot {robot.name!r}"
    qpos = table(file, "qpos", content["qpos"], 7 + robot.joint_count, what=what)
    everything = np.arange(robot.joint_count)
    return assemble(
        file,
        robot,
        options,
        Fact("format", "fmpjax's .npz", "its arrays"),
        position=qpos[:, :3],
        rotation=qpos[:, 3:7],
        order="wxyz",
        joints=qpos[:, 7:],
        columns=by_order(robot, everything, everything, Options(), "the format's"),
        rate=positive(file, "rate", content["rate"]),
        rate_from="the file",
        name="qpos row",
        robot_from="the file" if stored == robot.name else f"as asked; the file's, {stored}, has the same joints",
    )
