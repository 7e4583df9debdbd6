"""Primal Wasserstein Imitation Learning (arXiv 2006.04678): a greedy coupling along each episode, nothing learned.

Every episode has the demonstration's windows as atoms of equal mass. A step moves its own mass to the nearest atoms
that still have some, and what it took is gone until the episode ends. The reward falls with the distance that the mass
moved. Only windows are compared, not actions. They are FMP's features, standardized by its deviations.

The reward depends on the episode's past. The critic is told how much of the longest episode is over; the policy is not.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from fmpjax import learning, sharding, transport
from fmpjax.config import Config
from fmpjax.priors.base import Expert, MotionPrior, Rollout, known_reward


class PWILState(NamedTuple):
    """What the atoms of each environment's episode still hold."""

    mass: jax.Array  # [N, W]


def couple(distance: jax.Array, mass: jax.Array, step: jax.Array | float) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Move ``step`` of mass to the nearest atoms.

    Args:
      distance: ``[N, W]`` to each atom.
      mass: ``[N, W]`` that the atoms hold.

    Returns:
      Sums of mass times distance ``[N]``; what the atoms still hold, ``[N, W]``; what found no place, ``[N]``, which is
      0 unless all atoms are empty.
    """
    rows = jnp.arange(len(mass))

    def take(carry):
        cost, mass, left, _ = carry
        nearest = jnp.argmin(jnp.where(mass > 0, distance, jnp.inf), axis=-1)
        taken = jnp.minimum(mass[rows, nearest], left)
        left = left - taken
        carry = cost + taken * distance[rows, nearest], mass.at[rows, nearest].add(-taken), left
        return *carry, (left > 0) & (taken > 0)

    # Earlier steps leave remainders in many atoms, so W / T + 1 rounds are not enough. Each round empties an atom or
    # ends, so there are at most W + 1.
    full = jnp.full(len(mass), step, mass.dtype)
    start = (jnp.zeros_like(full), mass, full, jnp.ones(len(mass), bool))
    return jax.lax.while_loop(lambda carry: carry[-1].any(), take, start)[:3]


def make(expert: Expert, config: Config) -> MotionPrior:
    """Primal Wasserstein Imitation Learning: each episode's greedy coupling to the demonstration, no network."""
    settings, windows = config.pwil, expert.windows
    steps = config.env.longest_episode
    step_mass = 1.0 / steps - settings.slack
    full = jnp.full(len(windows), 1.0 / len(windows)) if expert.share is None else expert.share
    full = full.astype(jnp.float32)

    def distances(x):
        # Features hold 1 / sqrt(d) already, so this is the standardized windows' distance over sqrt(d).
        return jnp.sqrt(2.0 * transport.squared_cost(x, windows))

    def exponent(cost):
        return -settings.decay * steps * cost

    def init(key):
        return PWILState(jnp.broadcast_to(full, (config.env.count, len(windows))))

    def score(state: PWILState, x):
        """The exponent of an episode's first step, when all atoms are full."""
        return exponent(couple(distances(x), jnp.broadcast_to(full, (len(x), len(windows))), step_mass)[0])

    def update(state: PWILState, rollout: Rollout, key):
        if rollout.start is None or rollout.valid.shape[1] != len(state.mass):
            raise ValueError(
                f"rollout of shape {rollout.valid.shape} {'without' if rollout.start is None else 'with'} starts: "
                f"expected one with starts of {len(state.mass)} environments"
            )
        features = jnp.where(rollout.valid[..., None], rollout.features, windows[0])

        def step(mass, inputs):
            x, start = inputs
            mass = jnp.where(start[:, None], full, mass)
            cost, mass, left = couple(distances(x), mass, step_mass)
            return mass, (cost, left, mass.sum(-1))

        mass, (cost, left, held) = jax.lax.scan(
            step, sharding.split(state.mass), (sharding.split(features, axis=1), rollout.start)
        )
        scores = exponent(cost)
        reward = settings.scale * jnp.exp(scores)
        # A step that finds too little mass earns nothing: what it moved does not tell how far off it is.
        reward = known_reward(reward, rollout.valid & (left == 0))
        summary = {
            **learning.score_metrics(*learning.median_and_spread(scores)),
            "coupling_distance": cost.mean() / step_mass,
            "mass_held": held.mean(),
        }
        return PWILState(mass), reward, summary

    return MotionPrior(init, update, score)
