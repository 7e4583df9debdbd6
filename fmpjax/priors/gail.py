"""Generative Adversarial Imitation Learning (arXiv 1606.03476): AMP's network, trained on the present rollout alone."""

import jax

from fmpjax.config import Config
from fmpjax.priors import adversary
from fmpjax.priors.base import Expert, MotionPrior


def make(expert: Expert, config: Config) -> MotionPrior:
    """Generative Adversarial Imitation Learning: AMP's network, no penalties, reward -log(1 - sigmoid(D))."""
    # softplus(l) = -log(1 - sigmoid(l)).
    return adversary.discriminator(expert, config.gail, jax.nn.softplus)
