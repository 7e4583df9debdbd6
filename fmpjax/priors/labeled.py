"""Labeled transport: one prior per motion, for windows in which the policy was told that motion.

Without it, a prior compares all windows of a rollout with all demonstrations, and a policy earns as much by any of the
motions. Here it can earn only by moving as the demonstration of its command does.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax.errors import UserError
from fmpjax.priors.base import Expert, MotionPrior, Rollout

COUNTS = ("skipped", "unconverged")  # metrics that are sums; the others are means over the motions that were told


def make(build: Callable[[Expert], MotionPrior], expert: Expert, label: np.ndarray) -> MotionPrior:
    """A prior of ``L`` priors, whose state holds those of all labels along a new first axis.

    Args:
      build: makes the prior of one label from its windows. It must treat each window by itself.
      expert: the windows of all labels.
      label: ``[W]`` ints from 0 to L - 1, the label of each window.
    """
    labels = np.arange(label.max() + 1)
    most = max((label == each).sum() for each in labels)
    # As many windows of each label, so that one program serves all: those of a short motion stand there repeatedly.
    rows = [np.flatnonzero(label == each) for each in labels]
    rows = jnp.asarray(np.stack([each[np.arange(most) * len(each) // most] for each in rows]))

    def part(own_rows):
        return build(expert._replace(windows=expert.windows[own_rows], share=None))

    def init(key):
        return jax.lax.map(lambda given: part(given[0]).init(given[1]), (rows, jax.random.split(key, len(labels))))

    def update(state, rollout: Rollout, key):
        assert rollout.label is not None
        told = jnp.where(rollout.valid, rollout.label, -1)
        features = rollout.features.reshape(-1, rollout.features.shape[-1])

        def one(given):
            each, own_rows, old, own_key = given
            mine = told == each
            own, count = _repeated(mine.ravel())
            seen = Rollout(features[own].reshape(rollout.features.shape), jnp.full(mine.shape, count > 0))
            new, reward, metrics = part(own_rows).update(old, seen, own_key)
            new = jax.tree.map(lambda new, old: jnp.where(count > 0, new, old), new, old)
            # A window that stands there repeatedly is given its reward as often.
            earned = jnp.zeros(mine.size).at[own].set(reward.ravel()).reshape(mine.shape)
            return new, jnp.where(mine, earned, 0.0), metrics, count > 0

        keys = jax.random.split(key, len(labels))
        state, rewards, metrics, was_told = jax.lax.map(one, (jnp.asarray(labels), rows, state, keys))
        number = jnp.maximum(was_told.sum(), 1)
        sums = {name: jnp.where(was_told, values, 0.0).sum() for name, values in metrics.items()}
        summary = {name: total if name in COUNTS else total / number for name, total in sums.items()}
        return state, rewards.sum(0), summary

    def score(state, x):
        raise UserError("with command.labeled each motion has a score of its own: expected one score")

    return MotionPrior(init, update, score)


def _repeated(mine: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Indices ``[N]`` of the true ones of ``mine [N]``, one after the other again and again, and their number."""
    (index,) = jnp.nonzero(mine, size=len(mine), fill_value=0)
    count = mine.sum()
    return index[jnp.arange(len(mine)) % jnp.maximum(count, 1)], count
