"""Proximal policy optimization (section IV-A of the paper; the settings are MimicKit's).

Hidden layers, the critic, the action distribution and the running statistics of observations are Brax's. An update fits
the critic to TD(lambda) returns first and then improves the actor, each for its own number of epochs.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen

from fmpjax import learning, machine, sharding
from fmpjax.acting import ActionRule, Seen, of_actor, of_critic
from fmpjax.config import PPOConfig
from fmpjax.mirror import Mirror

machine.import_mjx()  # which Brax imports

from brax.training import distribution  # noqa: E402 - after MJX
from brax.training.acme import running_statistics  # noqa: E402
from brax.training.acme.running_statistics import RunningStatisticsState  # noqa: E402
from brax.training.networks import MLP  # noqa: E402
from brax.training.types import UInt64  # noqa: E402


class PPOState(NamedTuple):
    """Everything that learns, except the prior."""

    actor: Any
    critic: Any
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    normalizer: RunningStatisticsState  # of the observations, `Seen` where the critic sees more
    rate: jax.Array  # scalar, learning rate of both


class Batch(NamedTuple):
    """A rollout as PPO sees it, ``[T, N, ...]``."""

    observation: Any  # an array, or `Seen` where the critic sees more than the actor
    next_observation: Any  # likewise, of which only the critic's part is read
    action: jax.Array
    mean: jax.Array  # of the policy that acted
    deviation: jax.Array
    reward: jax.Array
    fell: jax.Array
    timed_out: jax.Array
    age: jax.Array | None = None  # [T, N] int, steps of the episode up to and including this one


class Actor(linen.Module):
    """Mean and deviation ``[..., J]`` of the action distribution, of normalized observations ``[..., O]``.

    The deviation is one learned number per joint, whatever is observed. With an estimator the third output is what it
    estimates, ``[..., E]``; the policy sees that, too, and does not train it.
    """

    size: int  # J
    hidden: Sequence[int]
    activation: Callable[[jax.Array], jax.Array]
    kernel_init: learning.Initializer  # of the hidden layers
    mean_init: float  # bound of the last layer's weights
    deviation: float  # initial
    estimator: Sequence[int] = ()  # hidden layers of the estimator
    estimates: int = 0  # E
    inputs: Sequence[int] = ()  # columns of the observation that the policy sees beside the estimates; none: all

    @linen.compact
    def __call__(self, x):
        estimate = None
        if self.estimates:
            sensed = MLP(self.estimator, self.activation, self.kernel_init, activate_final=True, name=_ESTIMATOR)(x)
            estimate = linen.Dense(self.estimates, name=_ESTIMATE)(sensed)
            x = x[..., np.array(self.inputs)] if self.inputs else x
            x = jnp.concatenate([x, jax.lax.stop_gradient(estimate)], axis=-1)
        x = MLP(self.hidden, self.activation, self.kernel_init, activate_final=True, name=_TRUNK)(x)
        mean = linen.Dense(self.size, kernel_init=learning.uniform(self.mean_init), name=_MEAN)(x)
        start = lambda key: {"log_value": jnp.full((self.size,), jnp.log(self.deviation))}  # noqa: E731
        deviation = jnp.exp(self.param(_DEVIATION, start)["log_value"])
        return mean, jnp.broadcast_to(deviation, mean.shape), estimate


# The actor's parameters; checkpoints hold these names.
_TRUNK, _MEAN, _DEVIATION = "MLP_0", "Dense_0", "std_logparam"
_ESTIMATOR, _ESTIMATE = "estimator", "estimate"


class PPO:
    """Pure functions of the networks that a configuration describes.

    Args:
      observation_size: numbers of an observation; `Seen` of two where the critic sees more than the actor.
      action_size: J.
      config: of the networks and their updates.
      clock: steps of the longest episode, where the critic also observes the share of them that is over. A reward that
        depends on an episode's past needs it. 0 for a critic that observes what the policy does.
      mirror: of observations and actions, where the loss asks for a policy that does the same on both sides.
      estimated: E columns of the critic's observation that the actor estimates, where the configuration asks for it.
      inputs: columns of its own observation that the policy then sees beside the estimates; all for none.
    """

    def __init__(
        self,
        observation_size: int | Seen,
        action_size: int,
        config: PPOConfig,
        clock: int = 0,
        mirror: Mirror | None = None,
        estimated: Sequence[int] = (),
        inputs: Sequence[int] = (),
    ):
        self.config, self.clock, self.mirror = config, clock, mirror
        self.estimated = np.array(estimated if config.estimator else (), int)
        self.inputs = tuple(inputs) if config.estimator else ()
        self.observation_size, self.action_size = observation_size, action_size
        activation, initializers = learning.activation(config.activation), jax.nn.initializers
        # Otherwise uniform within 1 / sqrt(inputs), PyTorch's way.
        uniform = initializers.variance_scaling(1 / 3, "fan_in", "uniform")
        kernel = initializers.orthogonal(2.0**0.5) if config.orthogonal else uniform
        self._actor = Actor(
            action_size, config.hidden, activation, kernel, config.mean_init, config.deviation,
            config.estimator, len(self.estimated), self.inputs,
        )  # fmt: skip
        self._critic = MLP((*config.hidden, 1), activation, kernel)
        self._distribution = distribution.NormalDistribution(action_size)
        clip = [optax.clip_by_global_norm(config.clip_norm)] if config.clip_norm else []
        self._optimizer = optax.chain(*clip, learning.direction(config.optimizer, config.momentum))

    def init(self, key: jax.Array, observations: Any = None) -> PPOState:
        """Initial state; ``observations [M, O]`` start the running statistics where the configuration asks for it."""
        actor_key, critic_key = jax.random.split(key)
        size = self.observation_size
        actor = self._actor.init(actor_key, jnp.zeros((1, of_actor(size))))
        critic = self._critic.init(critic_key, jnp.zeros((1, of_critic(size) + bool(self.clock))))
        normalizer = running_statistics.init_state(jax.tree.map(jnp.zeros, size))
        if self.config.normalizer_from_clip and observations is not None:
            normalizer = self.observe(normalizer, jax.tree.map(jnp.asarray, observations))
        optimizer = self._optimizer
        rate = jnp.float32(self.config.learning_rate)
        return PPOState(actor, critic, optimizer.init(actor), optimizer.init(critic), normalizer, rate)

    def observe(self, normalizer: RunningStatisticsState, observations: Any) -> RunningStatisticsState:
        """Running statistics after ``observations [..., O]``."""
        flat = jax.tree.map(lambda x: x.reshape(-1, x.shape[-1]), observations)
        normalizer = running_statistics.update(normalizer, flat, std_min_value=self.config.normalizer_floor)
        return capped(normalizer, self.config.normalizer_count) if self.config.normalizer_count else normalizer

    def _normalized(self, normalizer: RunningStatisticsState, observation: Any, part: Callable) -> jax.Array:
        """What a network sees: its ``part`` of an observation, `of_actor` or `of_critic`, in units of its spread."""
        mean, deviation = part(normalizer.mean), part(normalizer.std)
        return learning.standardize(part(observation), mean, deviation, self.config.normalizer_clip)

    def _mirrored(self, normalizer: RunningStatisticsState, observation: Any) -> tuple[jax.Array, jax.Array] | None:
        """Mirror images of observations ``[M, O]``, and how much each counts in the mirror loss ``[M]``.

        States that are their own mirror image do not. Such a robot stands with its feet side by side. Asked for
        symmetric actions there, it lifts both heels at once and falls; which foot steps first is for the policy to
        choose.
        """
        if self.mirror is None:
            return None
        seen, width = of_actor(observation), self.config.mirror_width
        image = self.mirror.observation(seen)
        if not width:
            return image, jnp.ones(image.shape[:-1], image.dtype)
        apart = self._normalized(normalizer, image, of_actor) - self._normalized(normalizer, seen, of_actor)
        square = jnp.mean(apart**2, axis=-1)
        return image, square / (square + width**2)

    def policy(self, actor, normalizer: RunningStatisticsState, observation: Any) -> tuple[jax.Array, jax.Array]:
        """Mean and deviation ``[..., J]`` of the action distribution."""
        mean, deviation, _ = self._outputs(actor, normalizer, observation)
        return mean, deviation

    def _outputs(self, actor, normalizer: RunningStatisticsState, observation: Any):
        output: Any = self._actor.apply(actor, self._normalized(normalizer, observation, of_actor))
        mean, deviation, estimate = output
        return mean, deviation if self.config.learn_deviation else jax.lax.stop_gradient(deviation), estimate

    def act(self, state: PPOState, deterministic: bool = False) -> ActionRule:
        """The policy as the environment calls it."""

        def draw(key, shape):
            return key if deterministic else jax.random.normal(key, (*shape, self.action_size))

        def act(observation, noise):
            mean, deviation = self.policy(state.actor, state.normalizer, observation)
            action = mean if deterministic else mean + deviation * noise
            return action, {"mean": mean, "deviation": deviation}

        return ActionRule(act, draw)

    def layers(self, actor) -> list[tuple[np.ndarray, np.ndarray]]:
        """Kernel ``[in, out]`` and bias ``[out]`` of each layer of the actor, the last of which gives the mean."""
        return _layers(actor["params"], _TRUNK, _MEAN)

    def estimator_layers(self, actor) -> list[tuple[np.ndarray, np.ndarray]]:
        """The same of the estimator, whose last layer gives what the first layer of the actor sees beside the rest."""
        return _layers(actor["params"], _ESTIMATOR, _ESTIMATE) if self.estimated.size else []

    def value(self, state: PPOState, observation: Any, age: jax.Array | None = None) -> jax.Array:
        """Value estimates ``[...]`` after ``age [...]`` steps of an episode, which only a critic with a clock reads."""
        return self._values(state.critic, state.normalizer, observation, age)

    def _values(self, critic, normalizer: RunningStatisticsState, observation, age):
        x = self._normalized(normalizer, observation, of_critic)
        if self.clock:
            x = jnp.concatenate([x, age[..., None] / self.clock], axis=-1)
        return jnp.squeeze(self._critic.apply(critic, x), axis=-1)

    def update(
        self, state: PPOState, batch: Batch, key: jax.Array, settling: jax.Array | bool = False
    ) -> tuple[PPOState, dict[str, jax.Array]]:
        """One PPO update from a rollout; ``settling`` says whether the run is in its last part, `PPOConfig.settle`."""
        # long: the two losses close over the rollout and its targets
        config = self.config
        discount, gae_lambda, target_kl = self._horizon(settling)
        before = None if batch.age is None else batch.age - 1
        value = self.value(state, batch.observation, before)
        next_value = self.value(state, batch.next_observation, batch.age)
        advantage = generalized_advantage(
            batch.reward,
            value,
            next_value,
            batch.fell,
            batch.timed_out,
            discount,
            gae_lambda,
            config.fall_value,
        )
        returns = advantage + value
        spread = jnp.maximum(advantage.std(), 1e-5)
        gain = jnp.clip((advantage - advantage.mean()) / spread, -config.advantage_clip, config.advantage_clip)
        return_variance = returns.var()
        whole = sharding.gather((batch, returns, gain))
        flat, targets, gains = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), whole)
        mirrored = self._mirrored(state.normalizer, flat.observation)
        critic_key, actor_key = jax.random.split(key)

        def critic_loss(params, sample):
            samples, target = sample
            age = None if samples.age is None else samples.age - 1
            error = self._values(params, state.normalizer, samples.observation, age) - target
            # Adam with a clipped norm needs a loss of order one; plain SGD takes MimicKit's loss as it is.
            scale = 0.5 / (1.0 + return_variance) if config.optimizer == "adam" else 1.0
            return scale * jnp.mean(error**2), {}

        critic, critic_optimizer, critic_stats = self._epochs(
            critic_loss, state.critic, state.critic_optimizer, state.rate, (flat, targets), critic_key,
            config.critic_epochs, config.critic_batch,
        )  # fmt: skip

        def actor_loss(params, sample):
            samples, gain, mirrored = sample
            mean, deviation, estimate = self._outputs(params, state.normalizer, samples.observation)
            new, old = (mean, deviation), (samples.mean, samples.deviation)
            log_prob = self._distribution.log_prob
            ratio = jnp.exp(log_prob(new, samples.action) - log_prob(old, samples.action))
            clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
            surrogate = -jnp.mean(jnp.minimum(ratio * gain, clipped * gain))
            bound = jnp.mean(jnp.sum(jnp.maximum(jnp.abs(mean) - 1.0, 0.0) ** 2, axis=-1))
            kl = self._distribution.create_dist(new).kl_divergence(self._distribution.create_dist(old))
            stats = {
                "kl": jnp.mean(kl),
                "clipped": jnp.mean((jnp.abs(ratio - 1.0) > config.clip).astype(ratio.dtype)),
                "bound_penalty": bound,
            }
            loss = surrogate + config.bound_penalty * bound
            if self.mirror is not None:
                image, weight = mirrored
                other, _ = self.policy(params, state.normalizer, image)
                off = jnp.mean(weight * jnp.sum((other - self.mirror.action(mean)) ** 2, axis=-1))
                loss, stats = loss + config.mirror * off, stats | {"asymmetry": off}
            if self.estimated.size:
                truth = self._normalized(state.normalizer, samples.observation, of_critic)[..., self.estimated]
                error = (estimate - truth) ** 2
                loss, stats = loss + 0.5 * jnp.mean(jnp.sum(error, axis=-1)), stats | {"estimate_error": error.mean()}
            return loss, stats

        actor, actor_optimizer, actor_stats = self._epochs(
            actor_loss, state.actor, state.actor_optimizer, state.rate, (flat, gains, mirrored), actor_key,
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
            adapt_rate(state.rate, actor_stats["kl"], target_kl),
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
        metrics |= {name: actor_stats[name] for name in ("asymmetry", "estimate_error") if name in actor_stats}
        return new_state, metrics

    def _horizon(self, settling: jax.Array | bool) -> tuple[Any, Any, Any]:
        """Discount, lambda and KL divergence of an update; a rate that is constant stays so."""
        config = self.config
        usual = config.discount, config.gae_lambda, config.target_kl
        if not config.settle:
            return usual
        last = config.settle_discount, config.settle_gae_lambda, config.settle_target_kl
        discount, gae_lambda, target_kl = (jnp.where(settling, *pair) for pair in zip(last, usual, strict=True))
        return discount, gae_lambda, target_kl if config.target_kl else 0.0

    def _epochs(self, loss, params, optimizer_state, rate, flat, key, epochs: int, batch: int):
        """Minibatch descent of ``loss``; statistics are means over the last epoch, skips are counted over all."""
        count = len(flat[1])
        minibatches = self.config.rollout_steps // batch
        grad = jax.value_and_grad(loss, has_aux=True)

        def descend(carry, indices):
            params, optimizer_state = carry
            sample = sharding.split(jax.tree.map(lambda x: x[indices], flat))
            (value, stats), gradients = grad(params, sample)
            step = learning.step_if_finite(self._optimizer, params, optimizer_state, value, gradients, rate)
            stats = stats | {"loss": value, "gradient_norm": step.gradient_norm, "skipped": step.skipped}
            return (step.params, step.optimizer), stats

        order = jax.vmap(lambda k: learning.permutation(k, count))(jax.random.split(key, epochs))
        order = order.reshape(epochs * minibatches, -1)
        (params, optimizer_state), stats = jax.lax.scan(descend, (params, optimizer_state), order)
        summary = {name: values[-minibatches:].mean() for name, values in stats.items()}
        summary["skipped"] = stats["skipped"].sum()
        return params, optimizer_state, summary


def _layers(parameters, trunk: str, last: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Kernel and bias of each hidden layer of ``trunk``, and of the layer ``last``."""
    hidden = parameters[trunk]
    layers = [*(hidden[f"hidden_{i}"] for i in range(len(hidden))), parameters[last]]
    return [(np.asarray(layer["kernel"]), np.asarray(layer["bias"])) for layer in layers]


def capped(statistics: RunningStatisticsState, most: int) -> RunningStatisticsState:
    """The statistics with a count of at most ``most``, so that old rows fade at the rate of new ones."""
    count = statistics.count.hi.astype(jnp.float32) * 2.0**32 + statistics.count.lo.astype(jnp.float32)
    fade = jnp.minimum(1.0, most / jnp.maximum(count, 1.0))
    count = UInt64(statistics.count.hi * 0, jnp.minimum(statistics.count.lo, jnp.uint32(most)))
    faded = jax.tree.map(lambda x: x * fade, statistics.summed_variance)
    return statistics.replace(count=count, summed_variance=faded)


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


def adapt_rate(rate: jax.Array, kl: jax.Array, target: jax.Array | float) -> jax.Array:
    """Learning rate over 1.5 where the KL divergence is above twice the target, times 1.5 below half of it.

    Where the target is the number 0, the rate stays as it is.
    """
    if isinstance(target, float) and not target:
        return rate
    factor = jnp.where(kl > 2.0 * target, 1 / 1.5, jnp.where(kl < 0.5 * target, 1.5, 1.0))
    return jnp.clip(rate * factor, 1e-5, 1e-2)


def _floor_deviation(actor, least: float):
    """The actor with its learned log-deviations at least log(least)."""
    parameters = actor["params"]
    floored = jax.tree.map(lambda value: jnp.maximum(value, jnp.log(least)), parameters[_DEVIATION])
    return {**actor, "params": {**parameters, _DEVIATION: floored}}
