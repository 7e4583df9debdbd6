"""This package's ``.npz``: ``qpos [T, 7 + J]`` with the quaternion wxyz, ``rate`` (Hz), ``robot``."""

from pathlib import Path

from fmpjax.errors import UserError
from fmpjax.motion.readers.archive import Arrays
from fmpjax.motion.readers.recording import Recording, assemble, positive, table
from fmpjax.robots import Robot

NAME = "fmpjax"
MARKS = ("qpos", "rate", "robot")


def read(file: Path, content: Arrays, robot: Robot) -> Recording:
    """The recording in a file written by `fmpjax.motion.save`."""
    stored = "".join(content["robot"].ravel()[:1].astype(str))
    if not robot.takes(stored):
        raise UserError(f"{file}: the motion is for robot {stored[:60]!r}, expected {robot.name!r}")
    what = f"root xyz, quaternion wxyz, {robot.joint_count} joints of robot {robot.name!r}"
    qpos = table(file, "qpos", content["qpos"], 7 + robot.joint_count, what=what)
    rate = positive(file, "rate", content["rate"])
    return assemble(file, "qpos", qpos[:, :3], qpos[:, 3:7], qpos[:, 7:], rate)
