"""A human's motion on a robot: motion capture (BVH, SMPL) by inverse kinematics.

The skeleton is scaled to the robot's legs. Trunk, thighs and arms point as the human's do; a limb has the robot's own
length. A foot that stands in the source stands in the result: its sole lies on the floor and rolls over heel or toe
without sliding. The source is taken to walk on one level floor.

What is measured over the motion (its floor, the axes of its joints, its size) is measured over the whole file, so a
part of it is the same whichever frame is the first.

Landmarks are the parts of the body that a robot names in ``robot.toml``. Poses are in the robot's axes: x ahead, y to
the left, z up. `fmpjax motion retarget` is the command.
"""

from fmpjax.motion.retarget.command import convert, odd_start, read
from fmpjax.motion.retarget.fit import Retargeted, retarget
from fmpjax.motion.retarget.landmarks import AXES, JOINT_NAMES, SIDES, joints, read_skeleton
from fmpjax.motion.retarget.targets import Targets

__all__ = [
    "AXES",
    "JOINT_NAMES",
    "SIDES",
    "Retargeted",
    "Targets",
    "convert",
    "joints",
    "odd_start",
    "read",
    "read_skeleton",
    "retarget",
]
