"""Adversarial Motion Priors, as MimicKit trains them (the paper's discriminator baseline).

A discriminator tells the rollout's windows, present and replayed, from the demonstration's. The rollout is scored with
the discriminator that the previous rollouts left, and only then is the discriminator trained.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen

from fmpjax import sharding
from fmpjax.config import AMPConfig, Config
from fmpjax.priors.base import Expert, MotionPrior, Rollout, flatten


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


class AMPState(NamedTuple):
    """State of the prior between rollouts."""

    params: Any
    optimizer: optax.OptState
    normalizer: Normalizer
    replay: Replay


class Discriminator(linen.Module):
    """Logit ``[n]`` of normalised windows ``[n, D]``; positive means demonstration.

    Weights start uniform within 1 / sqrt(inputs), of the first layer those of the full window.
    """

    hidden: tuple[int, ...]
    logit_init: float
    dimension: float  # d, coordinates of the full window

    @linen.compact
    def __call__(self, x):
        inputs = self.dimension
        for width in self.hidden:
            x = linen.relu(linen.Dense(width, kernel_init=_uniform(1 / math.sqrt(inputs)))(x))
            inputs = width
        return linen.Dense(1, kernel_init=_uniform(self.logit_init), name="logit")(x)[..., 0]


def _uniform(bound: float):
    return lambda key, shape, dtype=jnp.float32: jax.random.uniform(key, shape, dtype, -bound, bound)


def cap(config: AMPConfig) -> float:
    """The largest reward, -2 log of the least probability of being told apart."""
    return -2.0 * math.log(config.least_probability)


def reward_of(logit: jax.Array, config: AMPConfig) -> jax.Array:
    """Reward -2 log(1 - sigmoid(logit)), capped."""
    return jnp.minimum(2.0 * jax.nn.softplus(logit), cap(config))


def update_normalizer(state: Normalizer, agent: jax.Array, demonstration: jax.Array) -> Normalizer:
    """The normaliser after windows ``[n, D]`` of each kind; the two count alike whatever their numbers."""
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


def loss(apply, params, agent: jax.Array, demonstration: jax.Array, config: AMPConfig):
    """Cross entropy, gradient penalty on both sides and logit penalty at normalised windows; and statistics."""

    def logits_and_slopes(x):
        logit, pull_back = jax.vjp(lambda y: apply(params, y), x)
        return logit, jnp.mean(jnp.sum(pull_back(jnp.ones_like(logit))[0] ** 2, axis=-1))

    agent_logit, agent_slope = logits_and_slopes(agent)
    expert_logit, expert_slope = logits_and_slopes(demonstration)
    # -log(1 - sigmoid(l)) = softplus(l) and -log sigmoid(l) = softplus(-l).
    entropy = 0.5 * (jax.nn.softplus(agent_logit).mean() + jax.nn.softplus(-expert_logit).mean())
    slope = 0.5 * (agent_slope + expert_slope)
    kernel = params["params"]["logit"]["kernel"]
    total = entropy + config.gradient_penalty * slope + config.logit_penalty * jnp.sum(kernel**2)
    stats = {
        "discriminator_loss": entropy,
        "gradient_penalty": slope,
        "agent_accuracy": jnp.mean(agent_logit < 0, dtype=jnp.float32),
        "expert_accuracy": jnp.mean(expert_logit > 0, dtype=jnp.float32),
    }
    return total, stats


def make(expert: Expert, config: Config) -> MotionPrior:
    """Adversarial Motion Prior: a discriminator between all windows of the demonstration and the policy's."""
    settings = config.amp
    network = Discriminator(settings.hidden, settings.logit_init, expert.dimension)
    size = expert.windows.shape[-1]
    if settings.optimizer == "adam":
        direction = optax.scale_by_adam()
    else:
        direction = optax.trace(settings.momentum)
    optimizer = optax.chain(
        optax.add_decayed_weights(settings.weight_decay), direction, optax.scale(-settings.learning_rate)
    )
    # A feature over its weight is a standardised coordinate. Coordinates that stand twice in the full window stand once
    # here, root two times as large, so that the gradient penalty is the full window's.
    multiplicity = jnp.sqrt(expert.dimension) * expert.weight

    def normalize(normalizer: Normalizer, x):
        deviation = jnp.sqrt(jnp.maximum(normalizer.variance, settings.normalizer_floor**2))
        z = (x / expert.weight - normalizer.mean) / deviation
        return jnp.clip(z, -settings.normalizer_clip, settings.normalizer_clip) * multiplicity

    def init(key):
        params = network.init(key, jnp.zeros((1, size)))
        normalizer = Normalizer(jnp.float32(0.0), jnp.zeros(size), jnp.ones(size))
        replay = Replay(jnp.zeros((settings.replay, size), jnp.float16), jnp.int32(0), jnp.int32(0))
        return AMPState(params, optimizer.init(params), normalizer, replay)

    def score(state: AMPState, x):
        return network.apply(state.params, normalize(state.normalizer, x))

    def update(state: AMPState, rollout: Rollout, key):
        pool = flatten(rollout, expert.windows[0])
        order_key, seen_key, replay_key, store_key = jax.random.split(key, 4)
        logits = score(state, pool)
        reward = reward_of(logits, settings).reshape(rollout.valid.shape)
        reward = jnp.where(rollout.valid & jnp.isfinite(reward), reward, 0.0)

        replay = store(state.replay, pool, settings.replay_new, store_key)

        def step(carry, inputs):
            params, optimizer_state = carry
            rows, key = inputs
            agent_key, expert_key = jax.random.split(key)
            current = sharding.split(pool[rows])
            old = replay.windows[jax.random.randint(agent_key, rows.shape, 0, replay.count)].astype(pool.dtype)
            agent = normalize(state.normalizer, jnp.concatenate([current, old]))
            demonstration = normalize(state.normalizer, expert.draw(expert_key, rows.shape))
            (total, stats), gradients = jax.value_and_grad(
                lambda p: loss(network.apply, p, agent, demonstration, settings), has_aux=True
            )(params)
            updates, new_optimizer_state = optimizer.update(gradients, optimizer_state, params)
            finite = jnp.isfinite(total) & jnp.isfinite(optax.global_norm(gradients))
            new = (optax.apply_updates(params, updates), new_optimizer_state)
            carry = jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, (params, optimizer_state))
            return carry, stats | {"skipped": (~finite).astype(jnp.float32)}

        # Passes over the rollout in random order, as many as the updates need.
        needed = settings.updates * settings.minibatch
        passes = -(-needed // len(pool))
        order = jax.vmap(lambda k: jax.random.permutation(k, len(pool)))(jax.random.split(order_key, passes))
        rows = order.reshape(-1)[:needed].reshape(settings.updates, settings.minibatch)
        (params, optimizer_state), stats = jax.lax.scan(
            step, (state.params, state.optimizer), (rows, jax.random.split(replay_key, settings.updates))
        )
        # What scored and was fitted saw one normaliser; the next rollout is scored with the next.
        seen = expert.draw(seen_key, (len(pool),))
        normalizer = update_normalizer(state.normalizer, pool / expert.weight, seen / expert.weight)
        low, middle, high = jnp.quantile(logits, jnp.array([0.25, 0.5, 0.75]))
        summary = {name: values.mean() for name, values in stats.items()}
        summary |= {
            "skipped": stats["skipped"].sum(),
            "score_median": middle,
            "score_spread": high - low,
            "expert_margin": (score(state, expert.windows).mean() - middle) / jnp.maximum(high - low, 1e-6),
            "replayed": replay.count.astype(jnp.float32),
        }
        return AMPState(params, optimizer_state, normalizer, replay), reward, summary

    return MotionPrior(init, update, score)
