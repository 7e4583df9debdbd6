"""Adversarial Differential Discriminators (arXiv 2505.04961), as MimicKit trains them.

A discriminator sees the difference between the demonstration's frame at the commanded time and the robot's. Its only
positive sample is the zero vector: a step without any error. Its negative samples are the differences of the policy,
present and replayed, and the gradient penalty is taken at these alone. Each coordinate is divided by the running mean
of its magnitude, so no weights between errors have to be chosen. The reward is AMP's.

Frames are FMP's, without x and y and in the axes of its features. Only the newest frame is compared, as in MimicKit.
"""

import jax
import jax.numpy as jnp

from fmpjax import learning
from fmpjax.config import Config
from fmpjax.priors import adversary, amp
from fmpjax.priors.base import Expert, MotionPrior, Rollout, followed, unscored


def perfect(expert: Expert) -> Expert:
    """The zero difference as a demonstration of one window of one frame."""
    size = len(expert.weight) // expert.horizon
    # The same multiplicities, over the coordinates of one full frame.
    weight = expert.weight[-size:] * expert.horizon**0.5
    return Expert(jnp.zeros((1, size)), expert.dimension / expert.horizon, weight, 1)


def update_scale(state: adversary.Normalizer, differences: jax.Array, _) -> adversary.Normalizer:
    """The normalizer after differences ``[n, F]``: its deviation is their mean magnitude so far, its mean stays 0."""
    total = state.count + len(differences)
    magnitude = learning.toward(jnp.sqrt(state.variance), jnp.abs(differences).mean(0), len(differences) / total)
    return adversary.Normalizer(total, state.mean, magnitude**2)


def make(expert: Expert, config: Config) -> MotionPrior:
    """Adversarial Differential Discriminator: tells the policy's errors at each time of the clip from none."""
    settings, zero = config.add, perfect(expert)

    def loss(apply, params, differences, demonstration, key):
        # The rows of the demonstration are all alike.
        return adversary.cross_entropy(apply, params, differences, demonstration[:1], settings, both=False)

    differential = adversary.discriminator(
        zero, settings, lambda logit: amp.reward_of(logit, settings), loss, update_scale
    )

    def update(state: adversary.State, rollout: Rollout, key):
        reached, wanted = followed(rollout)
        return differential.update(state, rollout._replace(features=(wanted - reached) * zero.weight), key)

    return MotionPrior(differential.init, update, unscored("add"))
