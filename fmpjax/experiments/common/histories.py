"""Windows that frozen policies execute: a pool as training would see it, and samples soon after a reset."""

import math
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax.env import EnvState
from fmpjax.errors import UserError
from fmpjax.features import FeatureMap
from fmpjax.frames import FrameLayout
from fmpjax.ppo import PPOState
from fmpjax.trainer import Trainer, TrainState

SOON = (0.34, 0.64)  # s after a reset, from which executed histories are drawn [P]


class Pool(NamedTuple):
    """Windows of T steps in N environments."""

    features: jax.Array  # [T, N, D]
    valid: jax.Array  # [T, N] bool
    speed: float  # m/s, mean forward speed


def policy(run: Path, *, best: bool) -> tuple[Trainer, TrainState]:
    """Parts and state of the run in a folder, its best or its newest.

    Raises:
      UserError: it is no run, or has no policy yet.
    """
    from fmpjax import runs

    return runs.Run.open(run).policy(best=best)


def _start(trainer: Trainer, key: jax.Array, count: int) -> EnvState:
    """``count`` environments at fresh resets, episodes at full length."""
    env = trainer.env
    return env.start_at(env.reset_rows(key, count))._replace(cap=jnp.float32(trainer.config.env.episode_steps))


def pool(
    trainer: Trainer,
    policy: PPOState,
    feature_map: FeatureMap,
    key: jax.Array,
    steps: int = 256,
    last: int = 32,
    count: int | None = None,
) -> Pool:
    """Windows of the last ``last`` of ``steps`` control steps in ``count`` environments, the run's own by default.

    Actions are sampled, and falls reset at once, as in training.
    """
    state = _start(trainer, key, count or trainer.config.env.count)
    play = jax.jit(lambda state, key: trainer.env.rollout(state, trainer.ppo.act(policy), key, last))
    for chunk_key in jax.random.split(key, max(1, steps // last)):
        before = state
        state, record = play(state, chunk_key)
    speed = float(record.frame[..., FrameLayout.of(trainer.robot).velocity.start].mean())
    return Pool(feature_map(trainer.env.frame_table(before, record)[record.window]), ~record.nonfinite, speed)


class Cohort(NamedTuple):
    """Histories of as many environments."""

    features: jax.Array  # [n, D]
    speed: float  # m/s, mean forward speed of their windows


def soon_after_reset(
    trainer: Trainer, policy: PPOState, feature_map: FeatureMap, key: jax.Array, count: int, name: str
) -> Cohort:
    """Up to ``count`` histories 0.34 to 0.64 s after a reset, one per environment, all of their frames executed.

    Twice as many environments are played with sampled actions, each for a random time; those that have fallen by then
    are left out.

    Args:
      feature_map: of the study, which may be another run's.
      name: of the cohort, for the error's sentence.

    Raises:
      UserError: a history is longer than the time since the reset, or every environment had fallen.
    """
    rate, horizon = trainer.config.control_rate, trainer.env.horizon
    first, last = math.ceil(SOON[0] * rate - 1e-9), math.floor(SOON[1] * rate + 1e-9)
    if first < horizon:
        raise UserError(
            f"a history of {horizon} frames needs {horizon} steps: expected at most {first}, the steps from a reset "
            f"to {SOON[0]} s at {rate:g} Hz"
        )
    start_key, play_key, age_key = jax.random.split(key, 3)
    before = _start(trainer, start_key, 2 * count)
    play = jax.jit(lambda state, key: trainer.env.rollout(state, trainer.ppo.act(policy), key, last)[1])
    record = play(before, play_key)
    age = jax.random.randint(age_key, (2 * count,), first, last + 1)
    column = np.arange(2 * count)
    standing = np.asarray(~jnp.cumsum(record.fell, axis=0).astype(bool)[age - 1, column])
    kept = column[standing][:count]
    if not len(kept):
        raise UserError(
            f"the {name} cohort is empty: all {2 * count} episodes fell before {SOON[1]} s, expected a policy that "
            "stays up"
        )
    frames = trainer.env.frame_table(before, record)[record.window[age[kept] - 1, kept]]
    speed = float(frames[..., FrameLayout.of(trainer.robot).velocity.start].mean())
    return Cohort(feature_map(frames), speed)
