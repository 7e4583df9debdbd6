"""MimicKit's ``.pkl``: ``fps``, ``loop_mode`` (not used) and ``frames [T, 3 + 3 + J]``.

A frame is the root position (m), the root rotation as a rotation vector (axis times angle, rad) and the joints (rad) in
the model's order.
"""

from pathlib import Path

from fmpjax import rotations
from fmpjax.motion.readers.pickled import numbers
from fmpjax.motion.readers.recording import Recording, assemble, positive, table
from fmpjax.robots import Robot

NAME = "MimicKit"
MARKS = ("fps", "frames")


def read(file: Path, content: dict[str, object], robot: Robot) -> Recording:
    """The recording in a MimicKit motion."""
    columns = 6 + robot.joint_count
    what = f"root xyz, rotation vector, {robot.joint_count} joints of robot {robot.name!r}"
    frames = table(file, "frames", numbers(file, "frames", content["frames"], columns), columns, what=what)
    turn = rotations.exp_map(frames[:, 3:6])
    return assemble(file, "frames", frames[:, :3], turn, frames[:, 6:], positive(file, "fps", content["fps"]))
