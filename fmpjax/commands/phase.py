"""The time in the clip: the policy is told where it should be, and a step earns by being there."""

import jax
import jax.numpy as jnp

from fmpjax.commands.base import Command, Told
from fmpjax.errors import UserError
from fmpjax.frames import FrameLayout
from fmpjax.motion import MotionLibrary
from fmpjax.motion.edit import loops
from fmpjax.robots import Robot

HARMONICS = (1, 2)  # of the clip's duration, whose sines and cosines the networks see beside the share that is over
# Share and sharpness of each part of the reward: of the mean squared error of joints (rad²), joint velocities
# (rad²/s²), root height (m²), and of the root's axes (of unit vectors). [D: chosen on ten seconds of a dance]
JOINTS, JOINT_VELOCITIES, HEIGHT, TILT = (0.5, 30.0), (0.2, 0.5), (0.15, 40.0), (0.15, 5.0)


def make(robot: Robot, library: MotionLibrary, frames: jax.Array, stride: int) -> Command:
    """The row of the demonstration that the robot should be at.

    An episode begins at its reset's row. A clip that loops begins again at its end; with any other one the episode ends
    there, as a time-out. The default pose begins the clip. The networks see the time, and the joint angles that the
    robot should have at the next step, less the clip's mean.

    Args:
      robot: whose frames are read.
      library: the only demonstration.
      frames: ``[M + 1, F]`` compact frames of the table's rows.
      stride: rows per control step.

    Raises:
      UserError: there are several demonstrations.
    """
    if len(library.clips) > 1:
        raise UserError(f"command.kind is 'phase' and the run has {len(library.clips)} motions: expected one")
    last, layout = len(library.qpos) - 1, FrameLayout.of(robot)
    table, again = jnp.asarray(frames), loops(library.clips[0])
    pose = jnp.asarray(library.qpos[:, 7:] - library.qpos[:, 7:].mean(0), jnp.float32)

    def begin(rows, drawn):
        return jnp.where(rows >= (last if again else last + 1), 0, rows)  # of a loop the last row is the first one

    def following(row):
        return (row + stride) % last if again else jnp.minimum(row + stride, last)

    def advance(row, drawn, frame):
        return Told(following(row), (row + stride >= last) & (not again), reward(row, frame))

    def observe(row):
        share = row / last
        angles = 2.0 * jnp.pi * share[..., None] * jnp.array(HARMONICS)
        # From the time alone, a small network learns a dance of ten seconds slowly: it would have to store the poses.
        return jnp.concatenate([share[..., None], jnp.sin(angles), jnp.cos(angles), pose[following(row)]], axis=-1)

    def reward(row, frame):
        wanted = table[following(row)]
        # 2 - 2 cos of the angle between is its square, for the errors that matter.
        product = frame * wanted
        cosine = product[..., layout.cosine] + product[..., layout.sine]
        off = frame - wanted
        errors = (
            (JOINTS, jnp.mean(2.0 - 2.0 * cosine, axis=-1)),
            (JOINT_VELOCITIES, jnp.mean(off[..., layout.joint_velocity] ** 2, axis=-1)),
            (HEIGHT, off[..., layout.root][..., 2] ** 2),
            (TILT, jnp.sum(layout.axis_heights(off) ** 2, axis=-1)),
        )
        return sum(share * jnp.exp(-sharpness * error) for (share, sharpness), error in errors)

    size = 1 + 2 * len(HARMONICS) + robot.joint_count
    return Command(size, lambda key, shape: (), begin, advance, observe, wanted=following)
