"""Proximal policy optimisation (section IV-A of the paper; the settings are MimicKit's).

Networks, the action distribution and the running observation statistics are Brax's. An update fits the critic to
TD(lambda) returns first and then improves the actor, each for its own number of epochs.
"""

import contextlib
import io
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import linen

with contextlib.redirect_stdout(io.StringIO()):  # where MJX, which Brax imports, says that Warp is not installed
    from brax.training import distribution, networks
    from brax.training.acme import running_statistics
    from brax.training.types import UInt64

from fmpjax import sharding
from fmpjax.acting import Policy
from fmpjax.config import PPOConfig


class PPOState(NamedTuple):
    """Everything that learns, but for the prior."""

    actor: Any
    critic: Any
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    normalizer: running_statistics.RunningStatisticsState
    rate: jax.Array  # scalar, learning rate of both


class Batch(NamedTuple):
    """A rollout as PPO sees it, ``[T, N, ...]``."""

    observation: jax.Array
    next_observation: jax.Array
    action: jax.Array
    mean: jax.Array  # of the policy that acted
    deviation: jax.Array
    reward: jax.Array
    fell: jax.Array
    timed_out: jax.Array
    age: jax.Array | None = None  # [T, N] int, steps of the episode up to and including this one


class PPO:
    """Pure functions of the networks that a configuration describes.

    Args:
      clock: steps of the longest episode, where the critic also observes the share of them that is over. A reward that
        depends on an episode's past needs it. 0 for a critic that observes what the policy does.
    """

    def __init__(self, observation_size: int, action_size: int, config: PPOConfig, clock: int = 0):
        self.config, self.clock = config, clock
        self.observation_size, self.action_size = observation_size, action_size
        activation = elu if config.activation == "elu" else getattr(linen, config.activation)
        initializers = jax.nn.initializers
        # Otherwise uniform within 1 / sqrt(inputs), PyTorch's way.
        uniform = initializers.variance_scaling(1 / 3, "fan_in", "uniform")
        kernel = initializers.orthogonal(2.0**0.5) if config.orthogonal else uniform

        def normalize(observation, statistics):
            return running_statistics.normalize(observation, statistics, max_abs_value=config.normalizer_clip)

        bound = config.mean_init
        self._policy = networks.make_policy_network(
            action_size,
            observation_size,
            preprocess_observations_fn=normalize,
            hidden_layer_sizes=config.hidden,
            activation=activation,
            kernel_init=kernel,
            distribution_type="normal",
            noise_std_type="log",
            init_noise_std=config.deviation,
            mean_kernel_init=lambda key, shape, dtype=jnp.float32: jax.random.uniform(key, shape, dtype, -bound, bound),
        )

        def normalize_timed(observation, statistics):
            observed, over = observation[..., :observation_size], observation[..., observation_size:]
            return jnp.concatenate([normalize(observed, statistics), over], axis=-1)

        self._value = networks.make_value_network(
            observation_size + bool(clock),
            preprocess_observations_fn=normalize_timed if clock else normalize,
            hidden_layer_sizes=config.hidden,
            activation=activation,
            kernel_init=kernel,
        )
        self._distribution = distribution.NormalDistribution(action_size)
        direction = optax.scale_by_adam() if config.optimizer == "adam" else optax.trace(config.momentum)
        clip = [optax.clip_by_global_norm(config.clip_norm)] if config.clip_norm else []
        self._optimizer = optax.chain(*clip, direction)

    def init(self, key: jax.Array, observations: jax.Array | None = None) -> PPOState:
        """Initial state; ``observations [M, O]`` start the running statistics where the configuration asks for it."""
        actor_key, critic_key = jax.random.split(key)
        actor, critic = self._policy.init(actor_key), self._value.init(critic_key)
        normalizer = running_statistics.init_state(jnp.zeros(self.observation_size))
        if self.config.normalizer_from_clip and observations is not None:
            normalizer = self.observe(normalizer, jnp.asarray(observations))
        optimizer = self._optimizer
        rate = jnp.float32(self.config.learning_rate)
        return PPOState(actor, critic, optimizer.init(actor), optimizer.init(critic), normalizer, rate)

    def observe(self, normalizer, observations: jax.Array):
        """Running statistics after ``observations [..., O]``."""
        flat = observations.reshape(-1, observations.shape[-1])
        normalizer = running_statistics.update(normalizer, flat, std_min_value=self.config.normalizer_floor)
        cap = self.config.normalizer_count
        if not cap:
            return normalizer
        # A capped count keeps the statistics following the policy: old observations fade at the rate of new ones.
        count = normalizer.count.hi.astype(jnp.float32) * 2.0**32 + normalizer.count.lo.astype(jnp.float32)
        fade = jnp.minimum(1.0, cap / jnp.maximum(count, 1.0))
        count = UInt64(normalizer.count.hi * 0, jnp.minimum(normalizer.count.lo, jnp.uint32(cap)))
        return normalizer.replace(count=count, summed_variance=normalizer.summed_variance * fade)

    def policy(self, actor, normalizer, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mean and deviation ``[..., J]`` of the action distribution."""
        mean, deviation = self._policy.apply(normalizer, actor, observation)
        return mean, deviation if self.config.learn_deviation else jax.lax.stop_gradient(deviation)

    def act(self, state: PPOState, deterministic: bool = False) -> Policy:
        """The policy as the environment calls it."""

        def draw(key, shape):
            return key if deterministic else jax.random.normal(key, (*shape, self.action_size))

        def act(observation, noise):
            mean, deviation = self.policy(state.actor, state.normalizer, observation)
            action = mean if deterministic else mean + deviation * noise
            return action, {"mean": mean, "deviation": deviation}

        return Policy(act, draw)

    def value(self, state: PPOState, observation: jax.Array, age: jax.Array | None = None) -> jax.Array:
        """Value estimates ``[...]`` after ``age [...]`` steps of an episode, which only a critic with a clock reads."""
        return self._value.apply(state.normalizer, state.critic, self._critic_input(observation, age))

    def _critic_input(self, observation, age):
        return jnp.concatenate([observation, age[..., None] / self.clock], axis=-1) if self.clock else observation

    def update(self, state: PPOState, batch: Batch, key: jax.Array) -> tuple[PPOState, dict[str, jax.Array]]:
        """One PPO update from a rollout."""
        config = self.config
        before = None if batch.age is None else batch.age - 1
        value = self.value(state, batch.observation, before)
        next_value = self.value(state, batch.next_observation, batch.age)
        advantage = generalized_advantage(
            batch.reward,
            value,
            next_value,
            batch.fell,
            batch.timed_out,
            config.discount,
            config.gae_lambda,
            config.fall_value,
        )
        returns = advantage + value
        spread = jnp.maximum(advantage.std(), 1e-5)
        gain = jnp.clip((advantage - advantage.mean()) / spread, -config.advantage_clip, config.advantage_clip)
        return_variance = returns.var()
        flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), sharding.gather((batch, returns, gain)))
        critic_key, actor_key = jax.random.split(key)

        def critic_loss(params, sample):
            samples, target, _ = sample
            seen = self._critic_input(samples.observation, None if samples.age is None else samples.age - 1)
            error = self._value.apply(state.normalizer, params, seen) - target
            # Adam with a clipped norm needs a loss of order one; plain SGD takes MimicKit's loss as it is.
            scale = 0.5 / (1.0 + return_variance) if config.optimizer == "adam" else 1.0
            return scale * jnp.mean(error**2), {}

        critic, critic_optimizer, critic_stats = self._epochs(
            critic_loss, state.critic, state.critic_optimizer, state.rate, flat, critic_key,
            config.critic_epochs, config.critic_batch,
        )  # fmt: skip

        def actor_loss(params, sample):
            samples, _, gain = sample
            mean, deviation = self.policy(params, state.normalizer, samples.observation)
            log_ratio = self._distribution.log_prob((mean, deviation), samples.action) - self._distribution.log_prob(
                (samples.mean, samples.deviation), samples.action
            )
            ratio = jnp.exp(log_ratio)
            clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
            surrogate = -jnp.mean(jnp.minimum(ratio * gain, clipped * gain))
            bound = jnp.mean(jnp.sum(jnp.maximum(jnp.abs(mean) - 1.0, 0.0) ** 2, axis=-1))
            kl = self._distribution.create_dist((mean, deviation)).kl_divergence(
                self._distribution.create_dist((samples.mean, samples.deviation))
            )
            stats = {
                "kl": jnp.mean(kl),
                "clipped": jnp.mean((jnp.abs(ratio - 1.0) > config.clip).astype(ratio.dtype)),
                "bound_penalty": bound,
            }
            return surrogate + config.bound_penalty * bound, stats

        actor, actor_optimizer, actor_stats = self._epochs(
            actor_loss, state.actor, state.actor_optimizer, state.rate, flat, actor_key,
            config.actor_epochs, config.actor_batch,
        )  # fmt: skip
        if config.learn_deviation:
            actor = _floor_deviation(actor, config.least_deviation)

        new_state = PPOState(
            actor,
            critic,
            actor_optimizer,
            critic_optimizer,
            self.observe(state.normalizer, batch.observation),
            adapt_rate(state.rate, actor_stats["kl"], config.target_kl),
        )
        metrics = {
            "rate": new_state.rate,
            "kl": actor_stats["kl"],
            "clipped": actor_stats["clipped"],
            "bound_penalty": actor_stats["bound_penalty"],
            "actor_loss": actor_stats["loss"],
            "critic_loss": critic_stats["loss"],
            "actor_gradient_norm": actor_stats["gradient_norm"],
            "critic_gradient_norm": critic_stats["gradient_norm"],
            "skipped": actor_stats["skipped"] + critic_stats["skipped"],
            "deviation": batch.deviation.mean(),
            "value": value.mean(),
            "advantage_deviation": spread,
            "explained_variance": 1.0 - jnp.mean((returns - value) ** 2) / jnp.maximum(return_variance, 1e-8),
        }
        return new_state, metrics

    def _epochs(self, loss, params, optimizer_state, rate, flat, key, epochs: int, batch: int):
        """Minibatch descent of ``loss``; statistics are means over the last epoch, skips are counted over all."""
        count = len(flat[1])
        minibatches = self.config.rollout_steps // batch
        grad = jax.value_and_grad(loss, has_aux=True)

        def descend(carry, indices):
            params, optimizer_state = carry
            sample = sharding.split(jax.tree.map(lambda x: x[indices], flat))
            (value, stats), gradients = grad(params, sample)
            norm = optax.global_norm(gradients)
            direction, new_optimizer_state = self._optimizer.update(gradients, optimizer_state)
            new_params = jax.tree.map(lambda p, d: p - rate * d, params, direction)
            finite = jnp.isfinite(value) & jnp.isfinite(norm)
            carry = jax.tree.map(lambda new, old: jnp.where(finite, new, old), (new_params, new_optimizer_state), carry)
            stats = stats | {"loss": value, "gradient_norm": norm, "skipped": (~finite).astype(jnp.float32)}
            return carry, stats

        order = jax.vmap(lambda k: permutation(k, count))(jax.random.split(key, epochs))
        order = order.reshape(epochs * minibatches, -1)
        (params, optimizer_state), stats = jax.lax.scan(descend, (params, optimizer_state), order)
        summary = {name: values[-minibatches:].mean() for name, values in stats.items()}
        summary["skipped"] = stats["skipped"].sum()
        return params, optimizer_state, summary


@jax.custom_jvp
def elu(x: jax.Array) -> jax.Array:
    """Exponential linear unit; its derivative comes from its value, so the exponential is taken once."""
    return jnp.where(x > 0, x, jnp.exp(jnp.minimum(x, 0.0)) - 1.0)


@elu.defjvp
def _elu_jvp(primals, tangents):
    y = elu(*primals)
    return y, tangents[0] * jnp.where(y > 0, 1.0, y + 1.0)


def permutation(key: jax.Array, count: int) -> jax.Array:
    """A random order of ``count`` rows, by one sort of random numbers whose last bits are the rows.

    `jax.random.permutation` sorts pairs, and twice. Rows that share their random bits, one in five of 32,768, keep the
    order among themselves that they have in the rollout.
    """
    bits = (count - 1).bit_length()
    drawn = jax.random.bits(key, (count,)) >> bits << bits
    return (jnp.sort(drawn | jnp.arange(count, dtype=jnp.uint32)) & (2**bits - 1)).astype(jnp.int32)


def generalized_advantage(
    reward, value, next_value, fell, timed_out, discount: float, gae_lambda: float, fall_value: float = 0.0
):
    """Advantages ``[T, N]``.

    ``next_value`` is of the true next observation: a time-out bootstraps from it, a fall is worth ``fall_value``, and
    neither lets the next episode's advantage leak in. Advantage plus value is the TD(lambda) return.
    """
    delta = reward + discount * jnp.where(fell, fall_value, next_value) - value
    carry_on = discount * gae_lambda * (~(fell | timed_out))

    def backward(later, step):
        delta, carry_on = step
        advantage = delta + carry_on * later
        return advantage, advantage

    _, advantage = jax.lax.scan(backward, jnp.zeros_like(delta[0]), (delta, carry_on), reverse=True)
    return advantage


def adapt_rate(rate: jax.Array, kl: jax.Array, target: float) -> jax.Array:
    """Learning rate over 1.5 where the KL divergence is above twice the target, times 1.5 below half of it."""
    if not target:
        return rate
    factor = jnp.where(kl > 2.0 * target, 1 / 1.5, jnp.where(kl < 0.5 * target, 1.5, 1.0))
    return jnp.clip(rate * factor, 1e-5, 1e-2)


def _floor_deviation(actor, least: float):
    """The actor with its learned log-deviations at least log(least)."""

    def floor(path, leaf):
        named = any("std_logparam" in str(getattr(part, "key", part)) for part in path)
        return jnp.maximum(leaf, jnp.log(least)) if named else leaf

    return jax.tree_util.tree_map_with_path(floor, actor)
