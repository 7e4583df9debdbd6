"""Which of several motions: the policy is told one, and a step earns by moving more like it than like the others."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax.commands.base import Command, Told
from fmpjax.config import CommandConfig
from fmpjax.errors import UserError
from fmpjax.frames import FrameLayout
from fmpjax.motion import MotionLibrary
from fmpjax.robots import Robot

FLOOR = 0.05  # of a deviation, in the units of its number, as in `features.deviation_floor`: what hardly moves


class Which(NamedTuple):
    """Commands of N environments."""

    clip: jax.Array  # [N] int32, index of the motion
    left: jax.Array  # [N] int32, control steps for which it is still held
    distance: jax.Array  # [N, C] running mean of the squared distances to the nearest frame of each motion


def make(config: CommandConfig, rate: float, robot: Robot, library: MotionLibrary, frames: jax.Array) -> Command:
    """One of the demonstrations by its index, drawn by their weights; each is held for a random time.

    An episode begins with the motion of its reset's row. The default pose begins with a drawn one.

    Args:
      config: of the command.
      rate: control steps per second, Hz.
      robot: whose frames are read.
      library: the demonstrations, at the rate of their table's rows.
      frames: ``[M + 1, F]`` compact frames of the table's rows.

    Raises:
      UserError: there is only one demonstration.
    """
    count = len(library.clips)
    if count < 2:
        raise UserError("command.kind is 'motion' and the run has one motion: expected two or more")
    layout, last = FrameLayout.of(robot), len(library.qpos) - 1
    moments = np.asarray(posture(jnp.asarray(frames), layout))[:-1]
    scale = 1.0 / np.maximum(moments.std(0), FLOOR) / np.sqrt(moments.shape[1])
    table, clips = jnp.asarray(moments * scale), jnp.asarray(library.clip_of(np.arange(last + 1)), jnp.int32)
    weights = jnp.asarray(library.weights)
    shortest, longest = (max(1, round(seconds * rate)) for seconds in config.hold)
    newest = min(1.0, 1.0 / (rate * config.average))

    def draw(key, shape):
        clip_key, hold_key = jax.random.split(key)
        clip = jax.random.choice(clip_key, count, shape, p=weights).astype(jnp.int32)
        return Which(clip, jax.random.randint(hold_key, shape, shortest, longest + 1), jnp.ones((*shape, count)))

    def begin(rows, drawn):
        return drawn._replace(clip=jnp.where(rows > last, drawn.clip, clips[jnp.minimum(rows, last)]))

    def advance(state, drawn, frame):
        # Of running means, because one frame may be of several motions.
        here = posture(frame, layout) * scale
        squares = (here**2).sum(-1, keepdims=True) - 2.0 * here @ table.T + (table**2).sum(-1)
        nearest = jnp.stack([jnp.where(clips == i, squares, jnp.inf).min(-1) for i in range(count)], axis=-1)
        distance = state.distance + newest * (jnp.maximum(nearest, 0.0) - state.distance)
        earned = reward(distance, state.clip)
        never = jnp.zeros(state.left.shape, bool)
        if drawn is None:
            return Told(state._replace(distance=distance), never, earned)
        over = state.left <= 1
        clip = jnp.where(over, drawn.clip, state.clip)
        return Told(Which(clip, jnp.where(over, drawn.left, state.left - 1), distance), never, earned)

    def reward(distance, clip):
        told = jnp.take_along_axis(distance, clip[..., None], axis=-1)[..., 0]
        others = jnp.where(jnp.arange(count) == clip[..., None], jnp.inf, distance).min(-1)
        return others / jnp.maximum(told + others, 1e-9)

    def observe(state):
        return jax.nn.one_hot(state.clip, count)

    label = lambda state: state.clip  # noqa: E731
    return Command(count, draw, begin, advance, observe, lambda state: state.distance, label=label)


def posture(frame: jax.Array, layout: FrameLayout) -> jax.Array:
    """What of frames ``[..., F]`` does not change with place and heading, ``[..., P]``.

    Heights of the root (m) and of its two axes, cosines and sines of the joint angles, velocity in the heading frame
    (m/s, m/s, rad/s), joint velocities (rad/s).
    """
    parts = (
        frame[..., layout.root][..., 2:],
        layout.axis_heights(frame),
        frame[..., layout.cosine],
        frame[..., layout.sine],
        layout.heading_velocity(frame),
        frame[..., layout.joint_velocity],
    )
    return jnp.concatenate(parts, axis=-1)
