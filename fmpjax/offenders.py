"""States from which the physics leaves the finite numbers: what is finite, and the last offender."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax.physics import PhysicsState

# What a state must stay below. No joint or fall of a robot of this size is as fast: such a state has blown up.
_LIMITS = (np.inf, 1e3, np.inf)  # of qpos (m, rad), qvel (m/s, rad/s) and warmstart (m/s², rad/s²)


class Offender(NamedTuple):
    """The last state from which the physics left the finite numbers, kept to be looked at."""

    qpos: jax.Array  # [7 + J]
    qvel: jax.Array  # [6 + J]
    action: jax.Array  # [J] normalized


def offender(sim: PhysicsState, action: jax.Array, finite: jax.Array, before: Offender) -> Offender:
    """Each environment's last offender after a step from ``sim`` that left ``finite [N]`` of them finite."""
    # Each keeps its own, which needs nothing from the others during the rollout.
    here = Offender(sim.qpos, sim.qvel, action)
    return jax.tree.map(lambda new, old: jnp.where(finite[:, None], old, new), here, before)


def last_offender(offenders: Offender, nonfinite: jax.Array, before: Offender) -> Offender:
    """The newest of the offenders ``[N, ...]`` of a rollout, the first of those of one step; else the one before."""
    when = jnp.where(nonfinite, jnp.arange(1, len(nonfinite) + 1)[:, None], 0).max(0)
    last = jnp.argmax(when)
    return jax.tree.map(lambda new, old: jnp.where(when.any(), new[last], old), offenders, before)


def finite(sim: PhysicsState) -> jax.Array:
    """Whether each environment's state is finite and has not blown up, ``[N]`` bool."""
    # One comparison for all columns. It is false for NaN, and for infinity where the limit is infinity.
    limit = np.concatenate([np.full(x.shape[-1], most, np.float32) for x, most in zip(sim, _LIMITS, strict=True)])
    return (jnp.abs(jnp.concatenate(sim, axis=-1)) < limit).all(-1)
