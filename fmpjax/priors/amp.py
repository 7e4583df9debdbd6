"""Adversarial Motion Priors, as MimicKit trains them (the paper's discriminator baseline)."""

import math

import jax
import jax.numpy as jnp

from fmpjax.config import AMPConfig, Config
from fmpjax.priors import adversary
from fmpjax.priors.base import Expert, MotionPrior


def cap(config: AMPConfig) -> float:
    """The largest reward, -2 log of the least probability of being told apart."""
    return -2.0 * math.log(config.least_probability)


def reward_of(logit: jax.Array, config: AMPConfig) -> jax.Array:
    """Reward -2 log(1 - sigmoid(logit)), capped."""
    return jnp.minimum(2.0 * jax.nn.softplus(logit), cap(config))


def make(expert: Expert, config: Config) -> MotionPrior:
    """Adversarial Motion Prior: a discriminator between all windows of the demonstration and the policy's."""
    return adversary.discriminator(expert, config.amp, lambda logit: reward_of(logit, config.amp))
