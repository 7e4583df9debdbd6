"""ASAP's, PBHC's and HumanoidVerse's pickle: ``root_trans_offset [T, 3]``, ``root_rot [T, 4]`` (xyzw), ``dof [T, N]``.

``pose_aa [T, B, 3]`` has the same joints as rotation vectors, root first. A hinge's vector lies on its axis, so these
axes prove which joints a file with fewer than the robot's holds.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from fmpjax.motion.clip import Fact
from fmpjax.motion.readers.pickled import numbers
from fmpjax.motion.readers.recording import (
    WITHOUT,
    Columns,
    Options,
    Recording,
    assemble,
    by_order,
    kept_joints,
    match,
    positive,
    table,
)
from fmpjax.robots import Robot

NAME = "HumanoidVerse"
MARKS = ("root_trans_offset", "root_rot", "dof", "fps")
ALIGNED = 0.99  # cosine between a joint's axis and the file's
TURNED = 1e-3  # rad; a joint that turns less shows no axis


def read(file: Path, content: Mapping, robot: Robot, options: Options) -> Recording:
    """The recording in a motion of HumanoidVerse's family."""
    position = table(file, "root_trans_offset", numbers(file, "root_trans_offset", content["root_trans_offset"], 3), 3)
    rotation = table(file, "root_rot", numbers(file, "root_rot", content["root_rot"], 4), 4)
    value = numbers(file, "dof", content["dof"], robot.joint_count)
    value = value[..., 0] if value.ndim == 3 and value.shape[-1] == 1 else value
    joints = table(file, "dof", value, -1)
    columns = _by_axes(file, content.get("pose_aa"), joints, robot, options)
    return assemble(
        file,
        robot,
        options,
        Fact("format", "HumanoidVerse (ASAP, PBHC)", "its names"),
        position=position,
        rotation=rotation,
        order="xyzw",
        joints=joints,
        columns=columns or match(file, None, joints.shape[1], robot, options, "dof"),
        rate=positive(file, "fps", content["fps"]),
        rate_from="the file",
        name="root_rot row",
    )


def _by_axes(file: Path, vectors, joints: np.ndarray, robot: Robot, options: Options) -> Columns | None:
    """The columns by the axes of ``pose_aa``, or None where they prove nothing."""
    count = joints.shape[1]
    if options.without or count == robot.joint_count or not isinstance(vectors, np.ndarray) or vectors.ndim != 3:
        return None
    if vectors.shape[0] != len(joints) or vectors.shape[1] <= count or vectors.shape[2] != 3 or not len(joints):
        return None
    vectors = vectors[:, 1 : 1 + count].astype(np.float64)
    row, column = np.argmax(np.abs(joints), axis=0), np.arange(count)
    angle = joints[row, column]
    axis = vectors[row, column] / np.where(np.abs(angle) > TURNED, angle, np.inf)[:, None]
    shown = np.abs(angle) > TURNED
    fits = []
    for words in WITHOUT:
        kept = kept_joints(robot, words)
        if len(kept) == count and np.all(np.sum(robot.joint_axis[kept] * axis, axis=1)[shown] > ALIGNED):
            fits.append(kept)
    if len(fits) != 1 or not shown.any():
        return None
    return by_order(robot, fits[0], np.arange(count), options, "the axes in pose_aa tell which")
