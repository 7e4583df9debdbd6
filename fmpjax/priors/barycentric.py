"""Barycentric OT: distance to the mean of the matched expert successors (eq. bary of the paper).

Histories are matched on all frames but the newest; the newest is rewarded for its closeness to the mean of the newest
frames of the expert windows it was matched to. Fresh expert banks, no self term, nothing learned.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from fmpjax import learning, sharding, transport
from fmpjax.config import Config, PriorConfig
from fmpjax.frames import PLANAR
from fmpjax.priors.base import Expert, MotionPrior, Rollout, flatten, known_reward


class BarycentricState(NamedTuple):
    """The expert bank of the last update, and its dual against the source bank."""

    condition: jax.Array  # [m, C]
    successor: jax.Array  # [m, F]
    dual: jax.Array  # [m]
    epsilon: jax.Array  # scalar


def split(windows: jax.Array, horizon: int) -> tuple[jax.Array, jax.Array]:
    """What is matched, ``[n, (H - 1)(F - 2)]``, and what is scored, ``[n, F]``, of features ``[n, H F]``.

    The planar position of the preceding frames is left out: it is relative to the newest frame, and would tell where
    that frame is.
    """
    frames = windows.reshape(len(windows), horizon, -1)
    return frames[:, :-1, PLANAR.stop :].reshape(len(windows), -1), frames[:, -1]


def match(
    source: jax.Array, condition: jax.Array, expert: Expert, config: PriorConfig
) -> tuple[jax.Array, jax.Array, transport.Solve]:
    """Transport of a source bank's conditions ``[n, C]`` to those of an expert bank, ``[m, C]``.

    Returns:
      The expert bank's dual ``[m]``, the entropy coefficient, and the whole solution, which tells of its convergence.
    """
    cost = transport.squared_cost(source, condition)

    def solve(cost):
        # The self problem is not used; a one-point one costs nothing.
        return transport.solve(
            cost,
            jnp.zeros((1, 1)),
            transport.entropy_coefficient(cost, expert.dimension, config.epsilon_fraction),
            threshold=config.sinkhorn_threshold,
            max_iterations=config.sinkhorn_iterations,
        )

    solution = sharding.alone(solve)(cost)
    return solution.expert_dual, solution.epsilon, solution


def target(state: BarycentricState, condition: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Barycentric targets ``[n, F]`` of conditions ``[n, C]``, and the matching probabilities ``[n, m]``."""
    cost = transport.squared_cost(condition, state.condition)
    _, probability = transport.extension(cost, state.dual, state.epsilon)
    return transport.barycenter(probability, state.successor), probability


def make(expert: Expert, config: Config) -> MotionPrior:
    """Distance to the mean of the demonstration's matched windows, with no network.

    Its temperature is ``config.prior.temperature``.
    """
    settings = config.prior
    # Features are standardized coordinates times weight; d_g counts those of one full frame.
    per_frame = expert.dimension / expert.horizon
    scale = expert.dimension / (per_frame * settings.temperature)

    def init(key):
        rows = expert.bank_rows(key, settings.bank)
        condition, successor = split(expert.windows[rows], expert.horizon)
        return BarycentricState(condition, successor, jnp.zeros(len(condition)), jnp.float32(1.0))

    def score(state: BarycentricState, x):
        """The exponent, minus the squared distance over d_g T."""
        condition, successor = split(x, expert.horizon)
        goal, _ = target(state, condition)
        return -scale * jnp.sum((successor - goal) ** 2, axis=-1)

    def update(state: BarycentricState, rollout: Rollout, key):
        pool = flatten(rollout, expert.windows[0])
        source_key, expert_key = jax.random.split(key)
        source = sharding.split(pool[jax.random.randint(source_key, (settings.bank,), 0, len(pool))])
        condition, successor = split(expert.draw(expert_key, (settings.bank,)), expert.horizon)
        dual, epsilon, solution = match(split(source, expert.horizon)[0], condition, expert, settings)
        state = BarycentricState(condition, successor, dual, epsilon)
        scores = score(state, pool)
        reward = 2.0 * jnp.exp(scores).reshape(rollout.valid.shape)
        reward = known_reward(reward, rollout.valid)
        _, probability = target(state, split(source, expert.horizon)[0])
        summary = {
            **learning.score_metrics(*learning.median_and_spread(scores)),
            "effective_atoms": (1.0 / jnp.sum(probability**2, axis=-1)).mean(),
            "epsilon": epsilon,
            "sinkhorn_iterations": solution.iterations[0].astype(jnp.float32),
            "unconverged": (~solution.converged[0]).astype(jnp.float32),
        }
        return state, reward, summary

    return MotionPrior(init, update, score)
