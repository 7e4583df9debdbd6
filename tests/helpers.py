"""What several tests make: the smallest run, and the smallest rollout for a prior."""

from pathlib import Path

import jax.numpy as jnp

from fmpjax.config import AMPConfig, Config, EnvConfig, GAILConfig, PriorConfig, SMPConfig, WAILConfig, preset
from fmpjax.priors import Expert, Rollout

ROOT = Path(__file__).resolve().parents[1]  # of the checkout
# Eight environments, eight steps, five chunks of two iterations: a second of training after the compilation.
TINY = {
    "transitions": 8 * 8 * 10,
    "chunk": 2,
    "evaluations": (0.4, 1.0),
    "evaluation_episodes": 4,
    "env.count": 8,
    "env.first_cap": 20,
    "env.episode_steps": 40,
    "prior.bank": 16,
    "prior.minibatch": 16,
    "prior.hidden": (16, 16),
    "ppo.rollout_steps": 8,
    "ppo.hidden": (16,),
    "ppo.critic_epochs": 2,
    "ppo.actor_epochs": 2,
}

STEPS, COUNT = 8, 32  # of a rollout
SMALL = Config(
    prior=PriorConfig(bank=32, minibatch=32, updates=1, hidden=(16,), score_banks=3),
    amp=AMPConfig(hidden=(16,), updates=4, minibatch=32, replay=400, replay_new=10, optimizer="adam"),
    gail=GAILConfig(hidden=(16,), updates=4, minibatch=32),
    wail=WAILConfig(hidden=(16,), updates=2, minibatch=32),
    smp=SMPConfig(network="small", iterations=5, batch=8),
    env=EnvConfig(count=COUNT),
)


def tiny(**changes):
    return preset("smoke", **(TINY | changes))


def settings(values):
    """The command line's form of settings."""
    text = {k: ",".join(map(str, v)) if isinstance(v, tuple) else v for k, v in values.items()}
    return [word for key, value in text.items() for word in ("--set", f"{key}={value}")]


def expert_of(windows, horizon=1):
    """Windows ``[W, D]`` as the demonstration; every coordinate counts once."""
    windows = jnp.asarray(windows, jnp.float32)
    size = windows.shape[-1]
    return Expert(windows, float(size), jnp.full(size, size**-0.5), horizon)


def rollout_of(points, valid=None):
    points = jnp.asarray(points, jnp.float32)
    valid = jnp.ones((STEPS, COUNT), bool) if valid is None else jnp.asarray(valid)
    return Rollout(points.reshape(STEPS, COUNT, -1), valid, jnp.zeros((STEPS, COUNT), bool))
