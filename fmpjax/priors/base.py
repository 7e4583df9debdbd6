"""The interface of every motion prior: pure functions, as in optax."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from fmpjax import learning, sharding, transport
from fmpjax.config import PriorConfig
from fmpjax.errors import UserError
from fmpjax.frames import FrameLayout

PriorState = Any
Metrics = Mapping[str, jax.Array]


class Rollout(NamedTuple):
    """What a prior sees of a rollout of T steps in N environments."""

    features: jax.Array  # [T, N, D] features of the windows that end with the post-step, pre-reset states
    valid: jax.Array  # [T, N] bool, false where the state was not finite
    start: jax.Array | None = None  # [T, N] bool, true at an episode's first step; None where nothing asks for it
    # [T, N, F] compact frames after the steps, x and y 0, in the features' axes; None unless the method follows
    frame: jax.Array | None = None
    wanted: jax.Array | None = None  # [T, N, F] the demonstration's at the commanded time, likewise
    label: jax.Array | None = None  # [T, N] int32, the demonstration that was commanded; None unless it is labeled


class Expert(NamedTuple):
    """The demonstrations as a prior sees them, in the fixed features."""

    windows: jax.Array  # [W, D] every window
    dimension: float  # d, coordinates of the full features that the D stand for
    weight: jax.Array  # [D] feature of a standardized coordinate: root of its multiplicity over sqrt(d)
    horizon: int  # frames in a window, oldest first, D / horizon coordinates each
    share: jax.Array | None = None  # [W] how often each window is drawn, summing to one; evenly where None
    layout: FrameLayout | None = None  # of a frame's coordinates; None where nothing asks for it

    def bank_rows(self, key: jax.Array, size: int) -> jax.Array:
        """Rows of `windows` that make an expert bank, ``[size]`` int32.

        They are spread evenly over the demonstrations, and repeat where there are fewer windows than ``size``. An even
        spread is a stratified draw: it has the uniform draw's mean and less variance.
        """
        offset, count = jax.random.uniform(key), len(self.windows)
        if self.share is None:
            return jnp.floor((jnp.arange(size) + offset) * count / size).astype(jnp.int32)
        rows = jnp.searchsorted(jnp.cumsum(self.share), (jnp.arange(size) + offset) / size, side="right")
        return jnp.minimum(rows, count - 1).astype(jnp.int32)

    def draw(self, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        """Windows ``[*shape, D]``, drawn with replacement."""
        if self.share is None:
            return self.windows[jax.random.randint(key, shape, 0, len(self.windows))]
        return self.windows[jax.random.choice(key, len(self.windows), shape, p=self.share)]


class Pretraining(NamedTuple):
    """What a prior learns of the demonstration before any policy: the same for all runs, so it is kept for the next.

    A state that is not pretrained is pretrained in its first update.
    """

    iterations: int
    settings: Mapping[str, Any]  # all that it depends on beside the demonstration, by name
    # State, key, iteration until which to learn -> state, {"loss": mean per iteration, "skipped": updates left out}
    advance: Callable[[PriorState, jax.Array, jax.Array | int], tuple[PriorState, Metrics]]
    finished: Callable[[PriorState], jax.Array]  # scalar bool
    learned: Callable[[PriorState], Any]  # what is kept, a pytree of arrays
    put: Callable[[PriorState, Any], PriorState]  # the state of a run with what was kept


class MotionPrior(NamedTuple):
    """A learned reward.

    ``init(key)``, ``update(state, rollout, key) -> (state, reward [T, N], metrics)``, ``score(state, features)``.
    ``update`` decides its own order: transport priors fit and then score, a discriminator scores and then fits.
    """

    init: Callable[[jax.Array], PriorState]
    update: Callable[[PriorState, Rollout, jax.Array], tuple[PriorState, jax.Array, Metrics]]
    score: Callable[[PriorState, jax.Array], jax.Array]  # of features [n, D], higher is better, before normalization
    pretraining: Pretraining | None = None


def flatten(rollout: Rollout, stand_in: Float[jax.Array, " D"]) -> Float[jax.Array, "N D"]:
    """All windows of a rollout, ``[T * N, D]``; ``stand_in [D]`` takes the place of those that are not finite."""
    features = jnp.where(rollout.valid[..., None], rollout.features, stand_in)
    return sharding.split(features.reshape(-1, features.shape[-1]))


def followed(rollout: Rollout) -> tuple[Float[jax.Array, "T N F"], Float[jax.Array, "T N F"]]:
    """The frames of a rollout and those that were wanted; where a state was not finite, the wanted one twice."""
    if rollout.frame is None or rollout.wanted is None:
        raise ValueError("rollout without frames: expected those that were reached and those that were wanted")
    return jnp.where(rollout.valid[..., None], rollout.frame, rollout.wanted), rollout.wanted


def unscored(method: str) -> Callable[[PriorState, jax.Array], jax.Array]:
    """The score of a method that compares each step with the demonstration at the same time: it refuses."""

    def score(state, x):
        raise UserError(f"method {method} scores a step by the time in the clip: a window alone has no score")

    return score


class Coupling(NamedTuple):
    """A source bank and its transport."""

    source: jax.Array  # [n, D]
    cross_cost: jax.Array  # [n, m]
    self_cost: jax.Array  # [n, n]
    solution: transport.Solve


def couple(
    source: Float[jax.Array, "n D"],
    expert: Float[jax.Array, "m D"],
    dimension: jax.Array | float,
    config: PriorConfig,
) -> Coupling:
    """Transport of a source bank ``[n, D]`` to the expert bank ``[m, D]`` and to itself."""
    cross, itself = transport.squared_cost(source, expert), transport.squared_cost(source, source)
    epsilon = transport.entropy_coefficient(cross, dimension, config.epsilon_fraction)
    solution = transport.solve(
        cross, itself, epsilon, threshold=config.sinkhorn_threshold, max_iterations=config.sinkhorn_iterations
    )
    return Coupling(source, cross, itself, solution)


def couple_draws(
    keys: jax.Array,
    pool: Float[jax.Array, "N D"],
    expert: Float[jax.Array, "m D"],
    dimension: jax.Array | float,
    config: PriorConfig,
) -> Coupling:
    """Source banks drawn from a pool ``[N, D]``, one per key ``[k]``, and the transport of each, ``[k, ...]``.

    No solve depends on another, nor on what is fitted to it: devices share them, and an accelerator, which waits for
    launches rather than for arithmetic, solves its own at once.
    """
    rows = jax.vmap(lambda key: jax.random.randint(key, (config.bank,), 0, len(pool)))(keys)
    batch = config.parallel_solves or (1 if jax.default_backend() == "cpu" else len(keys))
    solve = sharding.spread(lambda source: couple(source, expert, dimension, config), batch)
    return solve(sharding.gather(pool[rows]))


class Reward(NamedTuple):
    """A reward and the statistics that normalized it."""

    reward: jax.Array  # [T, N]
    median: jax.Array
    spread: jax.Array  # interquartile range


def median_reward(score: Float[jax.Array, "*shape"], valid: Bool[jax.Array, "*shape"], spread_floor: float) -> Reward:
    """Reward 2 sigmoid((S - median) / max(IQR, floor)) over the rollout's valid windows (eq. reward), 0 elsewhere."""
    median, spread = learning.median_and_spread(jnp.where(valid, score, jnp.nan), jnp.nanquantile)
    reward = 2.0 * jax.nn.sigmoid((score - median) / jnp.maximum(spread, spread_floor))
    return Reward(known_reward(reward, valid), median, spread)


def known_reward(reward: Float[jax.Array, "*shape"], valid: Bool[jax.Array, "*shape"]) -> Float[jax.Array, "*shape"]:
    """The reward, and 0 for steps that are not valid or whose reward is not finite."""
    return jnp.where(valid & jnp.isfinite(reward), reward, 0.0)
