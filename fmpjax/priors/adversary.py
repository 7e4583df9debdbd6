"""What the adversarial priors share: network, normalizer, replay and updates.

A network tells the rollout's windows, present and replayed, from the demonstration's. The rollout is scored with the
network that the previous rollouts left, and only then is the network trained.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen

from fmpjax import learning, sharding
from fmpjax.config import AdversaryConfig
from fmpjax.priors.base import Expert, Metrics, MotionPrior, Rollout, flatten, known_reward


class Normalizer(NamedTuple):
    """Running mean and variance of all windows seen, agent's and demonstration's half and half."""

    count: jax.Array  # scalar
    mean: jax.Array  # [D]
    variance: jax.Array  # [D]


class Replay(NamedTuple):
    """Windows of earlier rollouts in half precision: relative error 5e-4, half the memory."""

    windows: jax.Array  # [R, D] float16
    head: jax.Array  # scalar int32, where the next window goes
    count: jax.Array  # scalar int32, windows held


class State(NamedTuple):
    """State of the adversary between rollouts."""

    params: Any
    optimizer: optax.OptState
    normalizer: Normalizer
    replay: Replay | None  # None where the settings ask for no replay: a checkpoint holds no empty array


def network(hidden: tuple[int, ...], logit_init: float, dimension: float) -> learning.MLP:
    """One number ``[n, 1]`` per normalized window ``[n, D]``; larger means more like the demonstration.

    Weights start uniform within 1 / sqrt(inputs), of the first layer those of the full window.

    Args:
      hidden: widths of the hidden layers.
      logit_init: bound of the last layer's weights.
      dimension: d, coordinates of the full window.
    """
    bounds = [1 / math.sqrt(inputs) for inputs in (dimension, *hidden)]
    bounds[-1] = logit_init
    return learning.MLP(
        widths=(*hidden, 1),
        kernel_inits=[learning.uniform(bound) for bound in bounds],
        activation=linen.relu,
        names=(*(f"Dense_{i}" for i in range(len(hidden))), "logit"),
    )


def update_normalizer(state: Normalizer, agent: jax.Array, demonstration: jax.Array) -> Normalizer:
    """The normalizer after windows ``[n, D]`` of each kind; the two count alike whatever their numbers."""
    mean = 0.5 * (agent.mean(0) + demonstration.mean(0))
    square = 0.5 * (((agent - mean) ** 2).mean(0) + ((demonstration - mean) ** 2).mean(0))
    fresh = jnp.float32(len(agent) + len(demonstration))
    total = state.count + fresh
    share = fresh / total
    shift = mean - state.mean
    # Chan's formula for the variance of two groups together.
    variance = (1 - share) * state.variance + share * square + share * (1 - share) * shift**2
    return Normalizer(total, state.mean + share * shift, variance)


def store(replay: Replay, windows: jax.Array, new: int, key: jax.Array) -> Replay:
    """Replay with windows ``[n, D]`` put in: all until it is full, then ``new`` random ones; the oldest make room."""
    size = len(replay.windows)
    shuffled = jax.random.permutation(key, windows).astype(replay.windows.dtype)[:size]
    order = jnp.arange(len(shuffled))
    filling = replay.count < size
    # Rows sent to `size` are dropped.
    rows = jnp.where(filling | (order < new), (replay.head + order) % size, size)
    stored = jnp.where(filling, len(shuffled), min(new, len(shuffled)))
    return Replay(
        replay.windows.at[rows].set(shuffled, mode="drop"),
        ((replay.head + stored) % size).astype(jnp.int32),
        jnp.minimum(replay.count + stored, size).astype(jnp.int32),
    )


def cross_entropy(
    apply, params, agent: jax.Array, demonstration: jax.Array, config: AdversaryConfig, *, both: bool = True
):
    """Cross entropy, gradient penalty and logit penalty at normalized windows; and statistics.

    The gradient penalty is taken on ``both`` sides, or on the policy's alone.
    """

    def logits_and_slopes(x):
        logit, pull_back = jax.vjp(lambda y: apply(params, y), x)
        return logit, jnp.mean(jnp.sum(pull_back(jnp.ones_like(logit))[0] ** 2, axis=-1))

    agent_logit, agent_slope = logits_and_slopes(agent)
    expert_logit, expert_slope = logits_and_slopes(demonstration)
    # -log(1 - sigmoid(l)) = softplus(l) and -log sigmoid(l) = softplus(-l).
    entropy = 0.5 * (jax.nn.softplus(agent_logit).mean() + jax.nn.softplus(-expert_logit).mean())
    slope = 0.5 * (agent_slope + expert_slope) if both else agent_slope
    kernel = params["params"]["logit"]["kernel"]
    total = entropy
    if config.gradient_penalty:
        total += config.gradient_penalty * slope
    total += config.logit_penalty * jnp.sum(kernel**2)
    stats = {
        "discriminator_loss": entropy,
        "gradient_penalty": slope,
        "agent_accuracy": jnp.mean(agent_logit < 0, dtype=jnp.float32),
        "expert_accuracy": jnp.mean(expert_logit > 0, dtype=jnp.float32),
    }
    return total, stats


# apply, params, agent [n, D], demonstration [m, D], key -> loss, statistics
Loss = Callable[..., tuple[jax.Array, dict[str, jax.Array]]]


class Adversary(NamedTuple):
    """A network and its training."""

    init: Callable[[jax.Array], State]
    score: Callable[[State, jax.Array], jax.Array]  # the network's number [n] of windows [n, D]
    # State, windows [n, D] of a rollout, their scores [n], key -> state, metrics
    fit: Callable[[State, jax.Array, jax.Array, jax.Array], tuple[State, Metrics]]


# Normalizer, windows [n, D] of the policy and [m, D] of the demonstration -> normalizer
Follow = Callable[[Normalizer, jax.Array, jax.Array], Normalizer]


def make(expert: Expert, settings: AdversaryConfig, loss: Loss, follow: Follow = update_normalizer) -> Adversary:
    """The network that minimizes ``loss`` between the windows of the demonstration and the policy's.

    ``follow`` takes the normalizer from a rollout to the next.
    """
    # long: the functions of a prior close over its settings
    net, size = network(settings.hidden, settings.logit_init, expert.dimension), expert.windows.shape[-1]
    optimizer = optax.chain(
        optax.add_decayed_weights(settings.weight_decay),
        learning.direction(settings.optimizer, settings.momentum),
        optax.scale(-settings.learning_rate),
    )
    # A feature over its weight is a standardized coordinate. Coordinates that are twice in the full window are once
    # here, root two times as large, so that the gradient penalty is the full window's.
    multiplicity = jnp.sqrt(expert.dimension) * expert.weight

    def normalize(normalizer: Normalizer, x):
        deviation = jnp.sqrt(jnp.maximum(normalizer.variance, settings.normalizer_floor**2))
        z = learning.standardize(x / expert.weight, normalizer.mean, deviation, settings.normalizer_clip)
        return z * multiplicity

    def apply(params, x):
        output: Any = net.apply(params, x)
        return output[..., 0]

    def init(key):
        params = net.init(key, jnp.zeros((1, size)))
        normalizer = Normalizer(jnp.float32(0.0), jnp.zeros(size), jnp.ones(size))
        replay = None
        if settings.replay:
            replay = Replay(jnp.zeros((settings.replay, size), jnp.float16), jnp.int32(0), jnp.int32(0))
        return State(params, optimizer.init(params), normalizer, replay)

    def score(state: State, x):
        return apply(state.params, normalize(state.normalizer, x))

    def fit(state: State, pool, scores, key):
        order_key, seen_key, replay_key, store_key = jax.random.split(key, 4)
        replay = None if state.replay is None else store(state.replay, pool, settings.replay_new, store_key)

        def step(carry, inputs):
            params, optimizer_state = carry
            rows, key = inputs
            agent_key, expert_key = jax.random.split(key)
            agent = sharding.split(pool[rows])
            if replay is not None:
                old = replay.windows[jax.random.randint(agent_key, rows.shape, 0, replay.count)].astype(pool.dtype)
                agent = jnp.concatenate([agent, old])
            agent = normalize(state.normalizer, agent)
            demonstration = normalize(state.normalizer, expert.draw(expert_key, rows.shape))
            (total, stats), gradients = jax.value_and_grad(
                lambda p: loss(apply, p, agent, demonstration, jax.random.fold_in(key, 1)), has_aux=True
            )(params)
            taken = learning.step_if_finite(optimizer, params, optimizer_state, total, gradients)
            return (taken.params, taken.optimizer), stats | {"skipped": taken.skipped}

        # Passes over the rollout in random order, as many as the updates need.
        needed = settings.updates * settings.minibatch
        passes = -(-needed // len(pool))
        order = jax.vmap(lambda k: jax.random.permutation(k, len(pool)))(jax.random.split(order_key, passes))
        rows = order.reshape(-1)[:needed].reshape(settings.updates, settings.minibatch)
        (params, optimizer_state), stats = jax.lax.scan(
            step, (state.params, state.optimizer), (rows, jax.random.split(replay_key, settings.updates))
        )
        # What scored and was fitted saw one normalizer; the next rollout is scored with the next.
        seen = expert.draw(seen_key, (len(pool),))
        normalizer = follow(state.normalizer, pool / expert.weight, seen / expert.weight)
        summary = {name: values.mean() for name, values in stats.items()} | {"skipped": stats["skipped"].sum()}
        summary |= learning.score_metrics(*learning.median_and_spread(scores), score(state, expert.windows))
        if replay is not None:
            summary["replayed"] = replay.count.astype(jnp.float32)
        return State(params, optimizer_state, normalizer, replay), summary

    return Adversary(init, score, fit)


def discriminator(
    expert: Expert,
    settings: AdversaryConfig,
    reward_of: Callable[[jax.Array], jax.Array],
    loss: Loss | None = None,
    follow: Follow = update_normalizer,
) -> MotionPrior:
    """A prior whose adversary minimizes ``loss`` or `cross_entropy` and whose reward depends on the logit alone."""

    def entropy(apply, params, agent, demonstration, key):
        return cross_entropy(apply, params, agent, demonstration, settings)

    adversary = make(expert, settings, loss or entropy, follow)

    def update(state: State, rollout: Rollout, key):
        pool = flatten(rollout, expert.windows[0])
        logits = adversary.score(state, pool)
        reward = reward_of(logits).reshape(rollout.valid.shape)
        reward = known_reward(reward, rollout.valid)
        state, summary = adversary.fit(state, pool, logits, key)
        return state, reward, summary

    return MotionPrior(adversary.init, update, adversary.score)
