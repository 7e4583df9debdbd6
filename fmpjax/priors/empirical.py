"""16-bank score: the average of transport scores of fresh source banks, with no network (section IV-A of the paper).

It tests what the neural potential adds: the reward is the teacher's own average, normalized as FMP's is.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from fmpjax import learning, transport
from fmpjax.config import Config
from fmpjax.priors.base import Expert, MotionPrior, Rollout, couple_draws, flatten, median_reward


class EmpiricalState(NamedTuple):
    """The source banks of the last rollout, solved."""

    bank: jax.Array  # [m] int32, rows of the demonstration's windows, drawn once
    source: jax.Array  # [k, n, D]
    self_dual: jax.Array  # [k, n]
    expert_dual: jax.Array  # [k, m]
    epsilon: jax.Array  # [k]


def make(expert: Expert, config: Config) -> MotionPrior:
    """Mean transport score of several source banks, 16 in the paper, with no network.

    Their number is ``config.prior.score_banks``.
    """
    settings, windows = config.prior, expert.windows

    def init(key):
        bank_key, _ = jax.random.split(key)  # FMP's bank
        # Source banks of one window of the demonstration, until there is a rollout.
        count, size = settings.score_banks, settings.bank
        source = jnp.broadcast_to(windows[0], (count, size, windows.shape[-1]))
        zeros = jnp.zeros((count, size))
        return EmpiricalState(expert.bank_rows(bank_key, size), source, zeros, zeros, jnp.ones(count))

    def score(state: EmpiricalState, x):
        to_expert = transport.squared_cost(x, windows[state.bank])  # in every source bank's score

        def one(total, solved):
            source, self_dual, expert_dual, epsilon = solved
            expert_value, _ = transport.extension(to_expert, expert_dual, epsilon)
            source_value, _ = transport.extension(transport.squared_cost(x, source), self_dual, epsilon)
            return total + expert_value - source_value, None

        total, _ = jax.lax.scan(one, jnp.zeros(x.shape[:1]), state[1:])
        return total / len(state.epsilon)

    def update(state: EmpiricalState, rollout: Rollout, key):
        bank, pool = windows[state.bank], flatten(rollout, windows[0])

        keys = jax.random.split(key, settings.score_banks)
        coupled = couple_draws(keys, pool, bank, expert.dimension, settings)
        solutions = coupled.solution
        state = EmpiricalState(
            state.bank, coupled.source, solutions.self_dual, solutions.expert_dual, solutions.epsilon
        )
        scores = score(state, pool).reshape(rollout.valid.shape)
        result = median_reward(scores, rollout.valid, settings.spread_floor)
        summary = {
            **learning.score_metrics(result.median, result.spread, score(state, bank), settings.spread_floor),
            "epsilon": solutions.epsilon.mean(),
            "sinkhorn_iterations": solutions.iterations.max(-1).mean(),
            "unconverged": (~solutions.converged).sum().astype(jnp.float32),
        }
        return state, result.reward, summary

    return MotionPrior(init, update, score)
