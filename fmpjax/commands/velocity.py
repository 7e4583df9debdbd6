"""A commanded velocity in the heading frame: ahead, to the left, turning to the left."""

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls

from fmpjax.commands.base import Command, Told
from fmpjax.config import CommandConfig
from fmpjax.frames import FrameLayout
from fmpjax.motion import MotionClip, MotionLibrary
from fmpjax.robots import Robot

AVERAGED = 1.0  # s, over which a demonstration's own velocity is its mean: about one stride
TOLERANCE = 0.1  # m/s and rad/s together, by which a command may be beyond the demonstrations before it is worth a line


class Velocity(NamedTuple):
    """Commands of N environments."""

    value: jax.Array  # [N, 3] m/s ahead, m/s to the left, rad/s to the left
    left: jax.Array  # [N] int32, control steps for which it is still held
    off: jax.Array  # [N, 3] running mean of the errors, in the same units
    goal: Any = ()  # [N, 3] what the value moves toward; nothing where it changes at once


def make(config: CommandConfig, rate: float, robot: Robot, library: MotionLibrary) -> Command:
    """Velocities between those of the demonstrations, or of the configured ranges; each is held for a random time.

    Of the demonstrations' velocities, half of the commands are one of them, and half lie between two. An episode begins
    with the velocity that its demonstration has there. The default pose stands.

    The running mean of the errors determines what a step earns. In a walk the root turns and surges back and forth with
    every stride, by more than an error that matters: a reward of the present error would hardly depend on how well the
    policy obeys. The networks see the running mean, since without it they cannot tell what a step will earn.

    With `CommandConfig.ramp` the commanded velocity moves to a new one as fast as a robot can be expected to.

    Args:
      config: of the command.
      rate: control steps per second, Hz.
      robot: whose frames are read.
      library: the demonstrations, at the rate of their table's rows.
    """
    # long: draws, start, step and reward of one command, which share its numbers
    table = jnp.asarray(np.concatenate([*map(velocities, library.clips), np.zeros((1, 3))]), jnp.float32)
    starts, lengths, weights = (jnp.asarray(x) for x in (library.starts, library.lengths, library.weights))

    def own(key, shape):
        clip_key, row_key = jax.random.split(key)
        clip = jax.random.choice(clip_key, len(library.clips), shape, p=weights)
        return table[starts[clip] + jax.random.randint(row_key, shape, 0, lengths[clip])]

    shortest, longest = (max(1, round(seconds * rate)) for seconds in config.hold)
    newest = min(1.0, 1.0 / (rate * config.average))
    ranges = None if config.ranges is None else jnp.asarray(config.ranges, jnp.float32)
    layout, most = FrameLayout.of(robot), change(config.ramp, rate)

    def draw(key, shape):
        value_key, other_key, zero_key, hold_key = jax.random.split(key, 4)
        if ranges is None:
            between = jnp.maximum(jax.random.uniform(other_key, (*shape, 1), minval=-1.0), 0.0)
            one, other = own(value_key, shape), own(jax.random.fold_in(other_key, 1), shape)
            value = one + between * (other - one)
        else:
            value = jax.random.uniform(value_key, (*shape, 3), minval=ranges[:, 0], maxval=ranges[:, 1])
        zero = jax.random.uniform(zero_key, shape) < config.zero
        hold = jax.random.randint(hold_key, shape, shortest, longest + 1)
        return Velocity(jnp.where(zero[..., None], 0.0, value), hold, jnp.zeros_like(value))

    def begin(rows, drawn):
        value = table[rows]
        return Velocity(value, drawn.left, jnp.zeros_like(drawn.value), () if most is None else value)

    def advance(state, drawn, frame):
        error = compressed(layout.heading_velocity(frame) - state.value, config.error_scale)
        off = state.off + newest * (error - state.off)
        never = jnp.zeros(state.left.shape, bool)
        left, goal = state.left, state.value if most is None else state.goal
        if drawn is not None:
            over = left <= 1
            left, goal = jnp.where(over, drawn.left, left - 1), jnp.where(over[..., None], drawn.value, goal)
        if most is None:
            return Told(Velocity(goal, left, off), never, reward(off))
        value = state.value + jnp.clip(goal - state.value, -most, most)
        return Told(Velocity(value, left, off, goal), never, reward(off))

    def reward(off):
        # Unlike a Gaussian's, the slope does not vanish for errors many widths large.
        linear = 1.0 / (1.0 + (off[..., :2] ** 2).sum(-1) / config.speed_width**2)
        turning = 1.0 / (1.0 + (off[..., 2] / config.turn_width) ** 2)
        return linear * turning  # in a sum, a robot that stands would earn most of what turning on the spot does

    return Command(3, draw, begin, advance, lambda state: state.value, lambda state: state.off)


def change(ramp: Sequence[float], rate: float) -> np.ndarray | None:
    """The largest change of a command in one control step, ``[3]`` m/s, m/s, rad/s; None where there is no limit."""
    return np.array([ramp[0], ramp[0], ramp[1]], np.float32) / rate if ramp else None


def ramped(commands: np.ndarray, ramp: Sequence[float], rate: float) -> np.ndarray:
    """Commands ``[T, ..., 3]`` of T control steps as a policy is told them, which begins with the first."""
    most = change(ramp, rate)
    if most is None:
        return commands
    told = [commands[0]]
    for command in commands[1:]:
        told.append(told[-1] + np.clip(command - told[-1], -most, most))
    return np.stack(told)


def compressed(error: jax.Array, scale: float) -> jax.Array:
    """Errors as they count in the running mean: small ones as they are, large ones by their logarithm.

    After a large change of the command only a leap would bring the mean of the whole error back to zero. Where errors
    were cut off, none of the steps toward a velocity that is far off would earn more than the one before.
    """
    return jnp.sign(error) * scale * jnp.log1p(jnp.abs(error) / scale)


def extent(config: CommandConfig, library: MotionLibrary) -> np.ndarray:
    """Lowest and highest commanded velocity, ``[2, 3]`` (m/s, m/s, rad/s), zero included; of clips their means."""
    own = np.stack([velocities(clip).mean(0) for clip in library.clips]).round(2)
    spans = own if config.ranges is None else np.transpose(config.ranges)
    return np.stack([np.minimum(spans.min(0), 0.0), np.maximum(spans.max(0), 0.0)])


def corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The eight commands ``[8, 3]`` at the ends of ranges ``[3]`` (m/s, m/s, rad/s)."""
    return np.array(list(itertools.product(*zip(low, high, strict=True))))


def told(config: CommandConfig) -> np.ndarray:
    """The commands ``[C, 3]`` furthest out that a training gives beside the demonstrations' own and those between."""
    ends = np.zeros((0, 3)) if config.ranges is None else corners(*np.transpose(config.ranges))
    return np.concatenate([ends, np.zeros((int(config.zero > 0), 3))])


def beyond(commands: np.ndarray, library: MotionLibrary) -> str | None:
    """A sentence where one of ``commands [C, 3]`` (m/s, m/s, rad/s) is neither a motion's nor between some; else None.

    Of the demonstrations count the mean velocities over one second about each sample, and all means of these.
    """
    own = [velocities(clip) for clip in library.clips]
    rows = np.unique(np.concatenate(own).round(2), axis=0)
    off = np.array([_distance(command, rows) for command in commands])
    if off.max(initial=0.0) <= TOLERANCE:
        return None
    command = commands[off.argmax()]
    nearest = [each[np.linalg.norm(each - command, axis=1).argmin()] for each in own]
    best = int(np.linalg.norm(np.array(nearest) - command, axis=1).argmin())
    return (
        f"commands reach {_said(command)}, beyond what the motions show: the nearest motion, "
        f"{library.clips[best].name}, moves at {_said(nearest[best])}"
    )


def _distance(command: np.ndarray, rows: np.ndarray) -> float:
    """Distance of a command ``[3]`` to the nearest mean, by any weights, of ``rows [M, 3]``."""
    heavy = 1e4  # so that the weights sum to one
    weights, _ = nnls(np.concatenate([rows.T, np.full((1, len(rows)), heavy)]), np.append(command, heavy))
    return float(np.linalg.norm(weights @ rows - command))


def _said(velocity: np.ndarray) -> str:
    ahead, left, turn = velocity.round(2) + 0.0  # no -0.00
    return f"{ahead:.2f} m/s ahead, {left:.2f} m/s and {turn:.2f} rad/s to the left"


def velocities(clip: MotionClip) -> np.ndarray:
    """A clip's velocity in its own heading, ``[T, 3]`` (m/s, m/s, rad/s): means over a second about each sample."""
    own = clip.heading_velocities
    width = min(len(own), max(1, round(AVERAGED * clip.rate)))
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(own, axis=0)])
    first = np.clip(np.arange(len(own)) - width // 2, 0, len(own) - width)
    return (sums[first + width] - sums[first]) / width
