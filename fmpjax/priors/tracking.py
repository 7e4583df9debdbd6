"""DeepMimic's reward (arXiv 1804.02717) in MimicKit's form: how near a step is to the demonstration at the same time.

Nothing is learned. The reward is a sum of exponentials of squared errors, 1 for a step without any. It is compared with
the other rewards as a bound on how well the clip can be followed at all.

As in MimicKit where the policy is told a phase and no place, the root's x, y and heading are not compared.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from fmpjax import learning
from fmpjax.config import Config, TrackingConfig
from fmpjax.frames import FrameLayout
from fmpjax.priors.base import Expert, MotionPrior, Rollout, followed, known_reward, unscored


class Errors(NamedTuple):
    """Squared errors of frames, each ``[...]``."""

    joint: jax.Array  # rad^2, sum over the joints
    joint_velocity: jax.Array  # (rad/s)^2, sum over the joints
    height: jax.Array  # m^2, of the root
    tilt: jax.Array  # rad^2, of the root's rotation
    velocity: jax.Array  # (m/s)^2, of the root
    angular_velocity: jax.Array  # (rad/s)^2, of the root
    key_point: jax.Array  # m^2, sum over the key points less the root


def errors(frame: jax.Array, wanted: jax.Array, layout: FrameLayout) -> Errors:
    """Errors ``[...]`` between compact frames ``[..., F]`` whose vectors are in the same axes."""
    off = frame - wanted

    def square(part: slice) -> jax.Array:
        return jnp.sum(off[..., part] ** 2, axis=-1)

    chords = off[..., layout.cosine] ** 2 + off[..., layout.sine] ** 2
    # Of rotations the sum of all nine squared differences is 8 sin^2 of half the angle.
    turned = (_axes(frame[..., layout.rotation]) - _axes(wanted[..., layout.rotation])) ** 2
    return Errors(
        joint=jnp.sum(_angle(chords) ** 2, axis=-1),
        joint_velocity=square(layout.joint_velocity),
        height=square(layout.root),
        tilt=_angle(jnp.sum(turned, axis=-1) / 2.0) ** 2,
        velocity=square(layout.velocity),
        angular_velocity=square(layout.angular_velocity),
        key_point=square(layout.key_points),
    )


def _angle(chord: jax.Array) -> jax.Array:
    """Angle (rad) of the squared chord between two points of the unit circle, 4 sin^2 of half the angle."""
    return 2.0 * jnp.arcsin(jnp.minimum(jnp.sqrt(chord) / 2.0, 1.0))


def _axes(rotation: jax.Array) -> jax.Array:
    """The three axes, ``[..., 9]``, of a 6D rotation, which has the first and the third."""
    x, z = jnp.split(rotation, 2, axis=-1)
    return jnp.concatenate([x, jnp.cross(z, x), z], axis=-1)


def reward_of(found: Errors, settings: TrackingConfig) -> jax.Array:
    """Reward ``[...]`` of errors."""
    of_root = found.height + settings.turn_share * found.tilt
    of_velocity = found.velocity + settings.turn_share * found.angular_velocity
    return (
        settings.joint_weight * jnp.exp(-settings.joint_decay * found.joint)
        + settings.joint_velocity_weight * jnp.exp(-settings.joint_velocity_decay * found.joint_velocity)
        + settings.root_weight * jnp.exp(-settings.root_decay * of_root)
        + settings.root_velocity_weight * jnp.exp(-settings.root_velocity_decay * of_velocity)
        + settings.key_point_weight * jnp.exp(-settings.key_point_decay * found.key_point)
    )


def make(expert: Expert, config: Config) -> MotionPrior:
    """DeepMimic's tracking reward: errors at each time of the clip, no network."""
    settings, layout = config.tracking, expert.layout
    if layout is None:
        raise ValueError("expert without a layout: expected one, which says where the parts of a frame are")
    counts = {"joint": _width(layout.cosine), "joint_velocity": _width(layout.joint_velocity)}
    counts |= {"key_point": _width(layout.key_points) // 3}

    def update(state, rollout: Rollout, key):
        found = errors(*followed(rollout), layout)
        reward = reward_of(found, settings)
        reward = known_reward(reward, rollout.valid)
        known = jnp.maximum(rollout.valid.sum(), 1)
        # States that are not finite count as errors of zero in these sums.
        summary = {
            f"{name}_error": jnp.sqrt(squares.sum() / known / counts.get(name, 1))
            for name, squares in found._asdict().items()
        }
        return state, reward, {**learning.score_metrics(*learning.median_and_spread(reward)), **summary}

    return MotionPrior(lambda key: (), update, unscored("tracking"))


def _width(part: slice) -> int:
    return part.stop - part.start
