"""The transport score averaged over independent source banks (eq. mean of the paper), and what agrees with it.

Scores mean something up to a constant alone: they are compared centered.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from fmpjax import transport
from fmpjax.config import PriorConfig


class Reference(NamedTuple):
    """Score and gradient at queries, of a reference or of whatever is compared with one."""

    score: jax.Array  # [q] up to a constant
    gradient: jax.Array  # [q, D]

    def at(self, rows: slice) -> "Reference":
        return Reference(self.score[rows], self.gradient[rows])


def reference(
    pool: jax.Array,
    expert: jax.Array,
    query: jax.Array,
    dimension: jax.Array,
    config: PriorConfig,
    key: jax.Array,
    banks: int,
) -> Reference:
    """Mean transport score of ``banks`` fresh source banks of ``pool [n, D]`` at ``query [q, D]``.

    Banks are solved far tighter than those that supervise a fit, one after another in one compiled loop: their sums
    are kept, so that memory does not grow with their number.

    Args:
      expert: ``[m, D]`` expert bank.
      dimension: d, coordinates of the full features that the D stand for.
    """

    def add(total: Reference, key):
        source = pool[jax.random.randint(key, (config.bank,), 0, len(pool))]
        cross = transport.squared_cost(source, expert)
        epsilon = transport.entropy_coefficient(cross, dimension, config.epsilon_fraction)
        fitted = transport.fit_score(source, expert, epsilon=epsilon, threshold=1e-4, max_iterations=1000)
        score = fitted.score(query)
        return Reference(total.score + score - score.mean(), total.gradient + fitted.gradient(query)), None

    nothing = Reference(jnp.zeros(len(query), query.dtype), jnp.zeros_like(query))
    total, _ = jax.lax.scan(add, nothing, jax.random.split(key, banks))
    return Reference(total.score / banks, total.gradient / banks)


def spread(score: jax.Array) -> jax.Array:
    """Interquartile range of ``score [q]``."""
    return jnp.subtract(*jnp.quantile(score, jnp.array([0.75, 0.25])))


def correlation(a: jax.Array, b: jax.Array) -> jax.Array:
    """Pearson's correlation of scores ``[q]``."""
    a, b = a - a.mean(), b - b.mean()
    return jnp.sum(a * b) / jnp.maximum(jnp.linalg.norm(a) * jnp.linalg.norm(b), 1e-30)


def cosine(a: jax.Array, b: jax.Array) -> jax.Array:
    """Mean cosine of gradients ``[q, D]``."""
    norms = jnp.linalg.norm(a, axis=-1) * jnp.linalg.norm(b, axis=-1)
    return jnp.mean(jnp.sum(a * b, axis=-1) / jnp.maximum(norms, 1e-12))


def centered_error(a: jax.Array, b: jax.Array) -> jax.Array:
    """Root-mean-square difference of scores ``[q]``, either less its mean."""
    return jnp.std(a - b)
