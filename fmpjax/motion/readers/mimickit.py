"""MimicKit's ``.pkl``: ``fps``, ``loop_mode`` and ``frames [T, 3 + 3 + J]``.

A frame is the root position (m), the root rotation as a rotation vector (axis times angle, rad) and the joints (rad) in
the model's order. With a ``loop_mode`` of 1 the motion continues from its last frame to its first.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fmpjax import rotations
from fmpjax.errors import UserError
from fmpjax.motion.clip import Fact
from fmpjax.motion.readers.pickled import numbers
from fmpjax.motion.readers.recording import Options, Recording, assemble, match, positive, table
from fmpjax.robots import Robot

NAME = "MimicKit"
MARKS = ("fps", "frames")
LOOPS = 1


def read(file: Path, content: Mapping, robot: Robot, options: Options) -> Recording:
    """The recording in a MimicKit motion."""
    frames = content["frames"]
    wide = len(frames[0]) if isinstance(frames, list) and frames and isinstance(frames[0], list) else 0
    frames = table(file, "frames", numbers(file, "frames", frames, wide or 6 + robot.joint_count), -1)
    count = frames.shape[1] - 6
    if count < 1:
        raise UserError(
            f"{file}: frames have {frames.shape[1]} columns, expected root xyz, rotation vector and "
            f"{robot.joint_count} joints of robot {robot.name!r}"
        )
    return assemble(
        file,
        robot,
        options,
        Fact("format", "MimicKit", "its names"),
        position=frames[:, :3],
        rotation=rotations.exp_map(frames[:, 3:6]),
        order=None,
        joints=frames[:, 6:],
        columns=match(file, None, count, robot, options, "frames"),
        rate=positive(file, "fps", content["fps"]),
        rate_from="the file",
        name="frames row",
        loops=_loops(content.get("loop_mode")),
    )


def _loops(mode) -> bool:
    """Whether a ``loop_mode`` says that the motion wraps; programs write a number or a number's array."""
    return isinstance(mode, int | np.ndarray) and np.size(mode) == 1 and bool(np.all(mode == LOOPS))
