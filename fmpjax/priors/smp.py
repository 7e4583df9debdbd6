"""Score-Matching Motion Priors, as in MimicKit: a diffusion model of the demonstration's windows, then frozen.

The model is pretrained before the policy (`MotionPrior.pretraining`); a state that is not is pretrained in its first
update. The state holds the iteration, so a run that resumes does not pretrain again. The reward falls with the error of
the noise that the model finds in a noised window, relative to the mean error of the policy's windows so far.

Where this departs from the source: windows are FMP's, with joint velocities and at the control rate, standardized by
FMP's deviations, and ``smp.network`` may be ``small``. Coordinates that are twice in the full window count once. The
running mean includes the rollout that is scored.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen

from fmpjax import learning, sharding
from fmpjax.config import SMP_NETWORKS, Config
from fmpjax.priors.base import Expert, MotionPrior, Pretraining, Rollout, flatten, known_reward

# Settings on which the pretrained model depends.
PRETRAINED_BY = (
    *("network", "noise_steps", "iterations", "batch", "learning_rate", "weight_decay", "clip_norm", "average"),
)


class SMPState(NamedTuple):
    """State of the prior between rollouts."""

    params: Any
    average: Any  # of the parameters over iterations; it scores
    optimizer: optax.OptState
    iteration: jax.Array  # scalar int32, of the pretraining
    loss: jax.Array  # scalar, running mean of the pretraining's loss
    error: jax.Array  # [K] running mean of the policy's error at each noise step
    seen: jax.Array  # scalar float32, windows in that mean


def schedule(steps: int) -> np.ndarray:
    """Share of the signal's variance left after each noise step, ``[steps]``, by a squared cosine."""
    at = np.cos((np.arange(steps + 1) / steps + 0.008) / 1.008 * np.pi / 2) ** 2
    return np.cumprod(1.0 - np.minimum(1.0 - at[1:] / at[:-1], 0.999))


class Denoiser(linen.Module):
    """The noise ``[n, D]`` in noised windows ``[n, D]``: a transformer over frames, modulated by the noise step."""

    horizon: int
    layers: int
    heads: int
    head_width: int

    @linen.compact
    def __call__(self, x, step):
        """``step [n]`` is an index of the noise schedule."""
        width = self.heads * self.head_width
        frames = x.reshape(len(x), self.horizon, -1)
        place = self.param("place", linen.initializers.normal(0.02), (self.horizon, width))
        tokens = linen.Dense(width)(frames) + place
        frequency = jnp.exp(-jnp.log(1e4) * jnp.arange(width // 2) / (width // 2))
        angle = step[:, None] * frequency
        time = linen.Dense(width)(jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], -1))
        time = linen.silu(linen.Dense(width)(linen.silu(time)))[:, None]

        def modulation(count):
            # Zero at the start: every block begins as the identity.
            return jnp.split(linen.Dense(count * width, kernel_init=linen.initializers.zeros)(time), count, axis=-1)

        def norm(y, shift, scale):
            return linen.LayerNorm(use_bias=False, use_scale=False)(y) * (1 + scale) + shift

        for _ in range(self.layers):
            shift, scale, gate, shift_two, scale_two, gate_two = modulation(6)
            tokens += gate * linen.MultiHeadDotProductAttention(self.heads)(norm(tokens, shift, scale))
            y = norm(tokens, shift_two, scale_two)
            gated = linen.silu(linen.Dense(4 * width)(y)) * linen.Dense(4 * width)(y)
            tokens += gate_two * linen.Dense(width)(gated)
        tokens = norm(tokens, *modulation(2))
        return linen.Dense(frames.shape[-1], kernel_init=linen.initializers.zeros)(tokens).reshape(x.shape)


def noised(x: jax.Array, noise: jax.Array, signal: jax.Array) -> jax.Array:
    """Standardized windows ``[n, D]`` with noise, where ``signal [n, 1]`` is the share of variance left."""
    return jnp.sqrt(signal) * x + jnp.sqrt(1.0 - signal) * noise


def denoising_error(denoise, x: jax.Array, noise: jax.Array, step: jax.Array, signal: jax.Array) -> jax.Array:
    """Mean squared error ``[n]`` of the noise that ``denoise(noised [n, D], step [n])`` finds at one noise step."""
    found = denoise(noised(x, noise, signal), jnp.full(len(x), step))
    return jnp.mean((found - noise) ** 2, axis=-1)


def make(expert: Expert, config: Config) -> MotionPrior:
    """Score-Matching Motion Prior: how well a frozen diffusion model of the demonstration denoises a window."""
    # long: the functions of a prior close over its settings
    settings = config.smp
    network = Denoiser(expert.horizon, *SMP_NETWORKS[settings.network])
    optimizer = optax.chain(
        optax.clip_by_global_norm(settings.clip_norm),
        optax.adamw(settings.learning_rate, weight_decay=settings.weight_decay),
    )
    left = jnp.asarray(schedule(settings.noise_steps), jnp.float32)
    score_steps = jnp.asarray(settings.score_steps)

    def init(key):
        params = network.init(key, expert.windows[:1], jnp.zeros(1))
        zero, count = jnp.float32(0.0), len(settings.score_steps)
        return SMPState(params, params, optimizer.init(params), jnp.int32(0), zero, jnp.zeros(count), zero)

    def pretrain(state: SMPState, key, until):
        """The state at an iteration, the sum of the losses and how many updates were left out on the way."""

        def step(carry):
            state, total, skipped = carry
            rows_key, step_key, noise_key = jax.random.split(jax.random.fold_in(key, state.iteration), 3)
            x = expert.draw(rows_key, (settings.batch,)) / expert.weight
            at = jax.random.randint(step_key, (settings.batch,), 0, settings.noise_steps)
            noise = jax.random.normal(noise_key, x.shape)

            def loss(params):
                found: Any = network.apply(params, noised(x, noise, left[at][:, None]), at)
                return jnp.abs(found - noise).mean()

            value, gradients = jax.value_and_grad(loss)(state.params)
            taken = learning.step_if_finite(optimizer, state.params, state.optimizer, value, gradients)
            newest = 1.0 - settings.average
            share = jnp.maximum(1.0 / (state.iteration + 1), newest)
            running = jnp.where(taken.finite, learning.toward(state.loss, value, share), state.loss)
            state = state._replace(
                params=taken.params,
                average=learning.toward(state.average, taken.params, newest),
                optimizer=taken.optimizer,
                iteration=state.iteration + 1,
                loss=running,
            )
            return state, total + jnp.where(taken.finite, value, 0.0), skipped + ~taken.finite

        # A loop that may make no round, not a branch: over several seeds at once a branch would take both ways.
        begin = state, jnp.float32(0.0), jnp.int32(0)
        return jax.lax.while_loop(lambda carry: carry[0].iteration < until, step, begin)

    def errors(state: SMPState, x, key):
        """Errors ``[K, n]`` at each noise step of features ``[n, D]``, each step with a noise of its own."""
        denoise = lambda y, step: network.apply(state.average, y, step)  # noqa: E731

        def at(inputs):
            step, key = inputs

            def one(window, noise):
                return denoising_error(denoise, window[None] / expert.weight, noise[None], step, left[step])[0]

            return sharding.spread(one, settings.score_batch)(x, jax.random.normal(key, x.shape))

        return jax.lax.map(at, (score_steps, jax.random.split(key, len(score_steps))))

    def exponent(state: SMPState, error):
        """Logarithm of the reward, ``[n]``, of errors ``[K, n]``."""
        return -settings.decay * (error / jnp.maximum(state.error, settings.error_floor)[:, None]).mean(0)

    def score(state: SMPState, x):
        """The exponent, with the same noise for all calls."""
        return exponent(state, errors(state, x, jax.random.PRNGKey(0)))

    def update(state: SMPState, rollout: Rollout, key):
        pretrain_key, noise_key = jax.random.split(key)
        state, _, skipped = pretrain(state, pretrain_key, settings.iterations)
        pool = flatten(rollout, expert.windows[0])
        both = errors(state, jnp.concatenate([pool, expert.windows]), noise_key)
        error, demonstration = both[:, : len(pool)], both[:, len(pool) :]
        share = jnp.where(state.seen < settings.mean_samples, len(pool) / (state.seen + len(pool)), 0.0)
        state = state._replace(
            error=learning.toward(state.error, error.mean(1), share),
            seen=jnp.where(share > 0, state.seen + len(pool), state.seen),
        )
        scores = exponent(state, error)
        reward = settings.scale * jnp.exp(scores).reshape(rollout.valid.shape)
        reward = known_reward(reward, rollout.valid)
        summary = {
            **learning.score_metrics(*learning.median_and_spread(scores), exponent(state, demonstration)),
            "pretraining_loss": state.loss,
            "denoising_error": error.mean(),
            "expert_error": demonstration.mean(),
            "skipped": skipped.astype(jnp.float32),
        }
        return state, reward, summary

    def advance(state: SMPState, key, until):
        after, total, skipped = pretrain(state, key, until)
        # NaN where every update was left out.
        return after, {"loss": total / (after.iteration - state.iteration - skipped), "skipped": skipped}

    def put(state: SMPState, learned):
        average, loss = learned
        return state._replace(params=average, average=average, iteration=jnp.int32(settings.iterations), loss=loss)

    pretraining = Pretraining(
        iterations=settings.iterations,
        settings={f"smp.{name}": getattr(settings, name) for name in PRETRAINED_BY},
        advance=advance,
        finished=lambda state: state.iteration >= settings.iterations,
        learned=lambda state: (state.average, state.loss),
        put=put,
    )
    return MotionPrior(init, update, score, pretraining)
