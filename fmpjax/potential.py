"""The three-head scalar potential and its derivatives (section III-C of the paper).

U^k(x, tau) = -|x|^2 / 2 + a_k . x + residual_k(sqrt(d) x, tau) for k in (expert, self 1, self 2), and the score that
the reward reads, S(x) = U^E(x, 0) - (U^P1(x, 0) + U^P2(x, 0)) / 2, in which the quadratic terms cancel.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

HEADS = 3
SCORE_CONTRAST = np.array([1.0, -0.5, -0.5], np.float32)  # weights of the heads in the score


class Params(NamedTuple):
    """Parameters of the potential; ``x`` has D coordinates."""

    linear: jax.Array  # [3, D]
    weights: tuple[jax.Array, ...]  # [D + 4, h], [h, h'], ..., [h'', 3]
    biases: tuple[jax.Array, ...]


def init(key: jax.Array, size: int, dimension: float, hidden: Sequence[int]) -> Params:
    """Initial parameters for ``size`` coordinates that stand for ``dimension`` features.

    The trunk starts as LeCun's for the full features; the linear terms and the last layer start at zero, so that the
    potential begins as the quadratic and the score as zero.
    """
    sizes = (size + 4, *hidden)
    keys = jax.random.split(key, len(hidden))
    fan_in = (dimension, *hidden[:-1])
    weights = [
        jax.random.normal(k, (i, o)) / jnp.sqrt(f)
        for k, i, o, f in zip(keys, sizes[:-1], sizes[1:], fan_in, strict=True)
    ]
    weights.append(jnp.zeros((hidden[-1], HEADS)))
    return Params(jnp.zeros((HEADS, size)), tuple(weights), tuple(jnp.zeros(w.shape[1]) for w in weights))


def heads(
    params: Params, x: Float[jax.Array, "n D"], tau: Float[jax.Array, " n"], dimension: jax.Array | float
) -> Float[jax.Array, "n 3"]:
    """All three potentials ``[n, 3]`` at ``x [n, D]`` and flow times ``tau [n]``."""
    time = jnp.stack([tau, tau**2, jnp.sin(jnp.pi * tau), jnp.cos(jnp.pi * tau)], axis=-1)
    # Splitting the first layer spares a concatenated copy of x.
    size = x.shape[-1]
    first = params.weights[0]
    h = jnp.sqrt(dimension) * (x @ first[:size]) + time @ first[size:] + params.biases[0]
    for weight, bias in zip(params.weights[1:], params.biases[1:], strict=True):
        h = jax.nn.silu(h) @ weight + bias
    return h + x @ params.linear.T - 0.5 * jnp.sum(x * x, axis=-1, keepdims=True)


def contrast(
    params: Params,
    x: Float[jax.Array, "n D"],
    tau: Float[jax.Array, " n"],
    weights: Float[jax.Array, "n 3"],
    dimension: jax.Array | float,
) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n D"]]:
    """Weighted sums of heads and their gradients in x.

    Args:
      weights: ``[n, 3]`` weight of each head for each point.

    Returns:
      Values ``[n]`` and gradients ``[n, D]``.
    """
    values, pull_back = jax.vjp(lambda y: jnp.sum(heads(params, y, tau, dimension) * weights, axis=-1), x)
    (gradients,) = pull_back(jnp.ones_like(values))
    return values, gradients


def score(params: Params, x: Float[jax.Array, "n D"], dimension: jax.Array | float) -> Float[jax.Array, " n"]:
    """The learned score S(x), ``[n]``, at flow time zero."""
    return heads(params, x, jnp.zeros(x.shape[:-1], x.dtype), dimension) @ SCORE_CONTRAST


def score_and_gradient(
    params: Params, x: Float[jax.Array, "n D"], dimension: jax.Array | float
) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n D"]]:
    """S(x) ``[n]`` and its gradient ``[n, D]``."""
    weights = jnp.broadcast_to(jnp.asarray(SCORE_CONTRAST, x.dtype), (*x.shape[:-1], HEADS))
    return contrast(params, x, jnp.zeros(x.shape[:-1], x.dtype), weights, dimension)
