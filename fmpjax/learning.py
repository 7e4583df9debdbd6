"""What the policy and the priors learn with: networks, optimizer steps, running means, summaries of scores."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen
from jaxtyping import Float, Int

Initializer = Callable[..., jax.Array]

# --- networks --------------------------------------------------------------------------------------------------------


class MLP(linen.Module):
    """Dense layers, an activation after each but the last."""

    widths: Sequence[int]
    kernel_inits: Sequence[Initializer]  # of each layer
    activation: Callable[[jax.Array], jax.Array]
    names: Sequence[str] = ()  # of the layers' parameters; hidden_0, hidden_1 and so on by default

    @linen.compact
    def __call__(self, x):
        """Output ``[..., widths[-1]]`` of ``x [..., I]``."""
        names = self.names or [f"hidden_{i}" for i in range(len(self.widths))]
        last = len(self.widths) - 1
        for i, (width, init, name) in enumerate(zip(self.widths, self.kernel_inits, names, strict=True)):
            x = linen.Dense(width, kernel_init=init, name=name)(x)
            if i < last:
                x = self.activation(x)
        return x


def uniform(bound: float) -> Initializer:
    """Weights uniform between plus and minus the bound."""
    return lambda key, shape, dtype=jnp.float32: jax.random.uniform(key, shape, dtype, -bound, bound)


def activation(name: str) -> Callable[[jax.Array], jax.Array]:
    """The activation that a configuration names."""
    return elu if name == "elu" else getattr(linen, name)


@jax.custom_jvp
def elu(x: jax.Array) -> jax.Array:
    """Exponential linear unit; its derivative comes from its value, so the exponential is taken once."""
    return jnp.where(x > 0, x, jnp.exp(jnp.minimum(x, 0.0)) - 1.0)


@elu.defjvp
def _elu_jvp(primals, tangents):
    y = elu(*primals)
    return y, tangents[0] * jnp.where(y > 0, 1.0, y + 1.0)


# --- steps -----------------------------------------------------------------------------------------------------------


def direction(optimizer: str, momentum: float) -> optax.GradientTransformation:
    """What a learning rate scales: Adam's direction, or for ``sgd`` the gradient with momentum."""
    return optax.scale_by_adam() if optimizer == "adam" else optax.trace(momentum)


class Step(NamedTuple):
    """What a step of an optimizer leaves."""

    params: Any
    optimizer: optax.OptState
    finite: jax.Array  # scalar bool, whether the step was taken
    gradient_norm: jax.Array  # scalar

    @property
    def skipped(self) -> jax.Array:
        """1.0 where the step was not taken, else 0.0."""
        return (~self.finite).astype(jnp.float32)


def step_if_finite(
    optimizer: optax.GradientTransformation,
    params: Any,
    state: optax.OptState,
    loss: jax.Array,
    gradients: Any,
    rate: jax.Array | float | None = None,
) -> Step:
    """A step of the optimizer, which is not taken where the loss or the gradients' norm is not finite.

    Args:
      optimizer: gives what is added to the parameters, or with a rate the direction to descend in.
      params: of the network.
      state: of the optimizer.
      loss: scalar.
      gradients: of the loss.
      rate: scalar, a learning rate that changes while training.
    """
    norm = optax.global_norm(gradients)
    updates, new_state = optimizer.update(gradients, state, params)
    if rate is not None:
        updates = jax.tree.map(lambda d: -(rate * d), updates)
    finite = jnp.isfinite(loss) & jnp.isfinite(norm)
    new = optax.apply_updates(params, updates), new_state
    kept = jax.tree.map(lambda new, old: jnp.where(finite, new, old), new, (params, state))
    return Step(*kept, finite, norm)


def permutation(key: jax.Array, count: int) -> Int[jax.Array, " n"]:
    """A random order of ``count`` rows, by one sort of random numbers whose last bits are the rows.

    `jax.random.permutation` sorts pairs, and twice. Rows that share their random bits, one in five of 32,768, keep the
    order among themselves that they have in the rollout.
    """
    bits = (count - 1).bit_length()
    drawn = jax.random.bits(key, (count,)) >> bits << bits
    return (jnp.sort(drawn | jnp.arange(count, dtype=jnp.uint32)) & (2**bits - 1)).astype(jnp.int32)


# --- running means ---------------------------------------------------------------------------------------------------


def toward(old: Any, new: Any, share: jax.Array | float) -> Any:
    """Running means after ``new``, which counts for ``share`` of them; pytrees of arrays."""
    return jax.tree.map(lambda a, b: a + share * (b - a), old, new)


def newest_share(half_life: float) -> float:
    """Share of the newest of a running mean in which the share of an old one halves after ``half_life`` updates."""
    return 1.0 - 0.5 ** (1.0 / half_life)


def standardize(
    x: Float[jax.Array, "*batch n"], mean: Float[jax.Array, " n"], deviation: Float[jax.Array, " n"], clip: float
) -> Float[jax.Array, "*batch n"]:
    """``(x - mean) / deviation``, clipped to the magnitude ``clip``."""
    return jnp.clip((x - mean) / deviation, -clip, clip)


# --- scores ----------------------------------------------------------------------------------------------------------


def median_and_spread(
    x: Float[jax.Array, "..."], quantile: Callable[..., jax.Array] = jnp.quantile
) -> tuple[Float[jax.Array, ""], Float[jax.Array, ""]]:
    """Median and interquartile range of all numbers of ``x``; `jnp.nanquantile` leaves out those that are NaN."""
    low, middle, high = quantile(x, jnp.array([0.25, 0.5, 0.75]))
    return middle, high - low


def score_metrics(
    median: Float[jax.Array, ""],
    spread: Float[jax.Array, ""],
    demonstration: Float[jax.Array, " m"] | None = None,
    floor: float = 1e-6,
) -> Mapping[str, jax.Array]:
    """The metrics that every prior gives of its scores.

    Args:
      median: of the rollout's scores.
      spread: their interquartile range.
      demonstration: ``[m]``, scores of the demonstration's windows, where the prior has them at hand.
      floor: least spread by which the demonstration's margin over the median is divided.
    """
    metrics = {"score_median": median, "score_spread": spread}
    if demonstration is not None:
        metrics["expert_margin"] = (demonstration.mean() - median) / jnp.maximum(spread, floor)
    return metrics
