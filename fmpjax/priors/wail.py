"""Wasserstein Adversarial Imitation Learning (arXiv 1906.08113), with the gradient penalty of WGAN-GP.

A critic without a sigmoid maximizes the difference of its means over the demonstration's windows and the policy's. Its
level is free and its scale moves with the policy, so the reward is centered on the rollout's mean and divided by a
running deviation. That alone would be negative for half of the windows. A fall ends the rewards, so a policy that earns
negative ones learns to fall: a sigmoid maps the standardized score to (0, 2). The loss stays that of the plain critic.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from fmpjax import learning
from fmpjax.config import Config, WAILConfig
from fmpjax.priors import adversary
from fmpjax.priors.base import Expert, MotionPrior, Rollout, flatten


class WAILState(NamedTuple):
    """State of the prior between rollouts."""

    critic: adversary.State
    variance: jax.Array  # scalar, running variance of the critic's values within a rollout
    rollouts: jax.Array  # scalar int32


def loss(apply, params, agent: jax.Array, demonstration: jax.Array, key: jax.Array, config: WAILConfig):
    """E D(agent) - E D(demonstration), and the penalty on slopes off 1 at random interpolates; and statistics.

    Both are normalized windows, ``[n, D]``, the agent's possibly a multiple as many.
    """
    pairs = min(len(agent), len(demonstration))
    share_key, pair_key = jax.random.split(key)
    share = jax.random.uniform(share_key, (pairs, 1))
    between = share * jax.random.permutation(pair_key, agent)[:pairs] + (1 - share) * demonstration[:pairs]
    gradient = jax.grad(lambda x: apply(params, x).sum())(between)
    # The norm has no derivative at 0, where a network with dead units may start.
    slope = jnp.sqrt(jnp.sum(gradient**2, axis=-1) + 1e-12)
    penalty = jnp.mean((slope - 1.0) ** 2)
    difference = apply(params, demonstration).mean() - apply(params, agent).mean()
    stats = {"critic_difference": difference, "gradient_penalty": penalty, "critic_slope": slope.mean()}
    return -difference + config.gradient_penalty * penalty, stats


def make(expert: Expert, config: Config) -> MotionPrior:
    """Wasserstein Adversarial Imitation Learning: a critic of slope one, whose values are standardized."""
    settings = config.wail
    critic = adversary.make(expert, settings, lambda *arguments: loss(*arguments, settings))
    newest = learning.newest_share(settings.deviation_half_life)

    def init(key):
        return WAILState(critic.init(key), jnp.float32(0.0), jnp.int32(0))

    def update(state: WAILState, rollout: Rollout, key):
        pool = flatten(rollout, expert.windows[0])
        values = critic.score(state.critic, pool)
        grid = values.reshape(rollout.valid.shape)
        known = rollout.valid & jnp.isfinite(grid)
        count = jnp.maximum(known.sum(), 1)
        mean = jnp.where(known, grid, 0.0).sum() / count
        fresh = jnp.where(known, (grid - mean) ** 2, 0.0).sum() / count
        # A plain mean until the running one has as many rollouts as it remembers.
        share = jnp.maximum(newest, 1.0 / (state.rollouts + 1))
        variance = learning.toward(state.variance, fresh, share)
        deviation = jnp.maximum(jnp.sqrt(variance), settings.deviation_floor)
        reward = jnp.where(known, 2.0 * jax.nn.sigmoid((grid - mean) / deviation), 0.0)
        fitted, summary = critic.fit(state.critic, pool, values, key)
        summary = {**summary, "reward_deviation": deviation}
        return WAILState(fitted, variance, state.rollouts + 1), reward, summary

    return MotionPrior(init, update, lambda state, x: critic.score(state.critic, x))
