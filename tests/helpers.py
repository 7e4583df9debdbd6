"""What several tests make: the smallest run, the smallest rollout for a prior, robots that differ from their model."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np

from fmpjax.config import (
    ADDConfig,
    AMPConfig,
    Config,
    EnvConfig,
    GAILConfig,
    PriorConfig,
    SMPConfig,
    WAILConfig,
    preset,
)
from fmpjax.physics import traits
from fmpjax.physics.traits import Traits
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
# Of a result, as the report reads it.
PROVENANCE = {
    "command": "python -m fmpjax.experiments.x", "date": "2026-01-01", "commit": "0123456789abcdef",
    "device": "2 CPU cores", "packages": {"jax": "0.10"}, "uncommitted_changes": False,
}  # fmt: skip
SMALL = Config(
    prior=PriorConfig(bank=32, minibatch=32, updates=1, hidden=(16,), score_banks=3),
    amp=AMPConfig(hidden=(16,), updates=4, minibatch=32, replay=400, replay_new=10, optimizer="adam"),
    gail=GAILConfig(hidden=(16,), updates=4, minibatch=32),
    wail=WAILConfig(hidden=(16,), updates=2, minibatch=32),
    smp=SMPConfig(network="small", iterations=5, batch=8),
    add=ADDConfig(hidden=(16,), updates=4, minibatch=32, replay=400, replay_new=10, optimizer="adam"),
    env=EnvConfig(count=COUNT),
)


def tiny(**changes):
    return preset("smoke", **(TINY | changes))


def disturbed(**changes):
    """The smallest run with all disturbances of the preset `robot`, more often pushed, on uneven ground, that obeys."""
    own = dataclasses.asdict(preset("robot").disturbance) | {"push_interval": (0.04, 0.1), "step_height": 0.02}
    own = {f"disturbance.{name}": value for name, value in own.items()}
    own |= {"env.observation": "deployable", "env.observation_history": 2, "env.first_cap": 5}
    own |= {"command.kind": "velocity", "env.axes": "heading", "features.axes": "heading"}
    return tiny(**(own | changes))


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


def nominal_traits(robot, count):
    """Robots that are as their model says."""
    joints = robot.joint_count
    ones, none = jnp.ones((count, joints)), jnp.zeros((count, joints))
    one, zero = jnp.ones((count, 1)), jnp.zeros((count, 1))
    even = jnp.zeros((count, 2))
    return Traits(one, zero, jnp.zeros((count, 3)), ones, ones, ones, none, ones, even, even)


def other_traits(robot, count):
    """Robots that differ in everything, each in its own way."""
    rng = np.random.default_rng(0)
    shapes = traits.widths(robot.joint_count)
    spans = Traits(
        (0.3, 1.2), (-1, 3), (-0.05, 0.05), (0.8, 1.2), (0.8, 1.2), (0.7, 1), (0.1, 0.2), (1, 1.5), (-0.1, 0.1),
        (-0.01, 0.01),
    )  # fmt: skip
    return Traits(*(jnp.asarray(rng.uniform(*s, (count, w)), jnp.float32) for s, w in zip(spans, shapes, strict=True)))


def small_policy(robot, walk, **changes):
    """An untrained policy of random layers, and what a run has beside it."""
    from fmpjax import deploy, features, policy
    from fmpjax.env import action_map

    settings = tiny(**changes)
    form = features.observation_form(settings)
    size, random = sum(features.observation_terms(robot, form).values()), np.random.default_rng(0)
    estimator = [(size, 8), (8, 4)] if settings.ppo.estimator else []
    inputs = np.array(features.newest_columns(robot, form) if estimator else (), int)
    shapes = [((inputs.size or size) + (4 if estimator else 0), 16), (16, 12), (12, robot.joint_count)]
    made = policy.Policy(
        joint_names=robot.joint_names,
        observation=form,
        rate=settings.control_rate,
        activation=settings.ppo.activation,
        kernels=tuple(random.normal(0, 0.5 / np.sqrt(shape[0]), shape).astype(np.float32) for shape in shapes),
        biases=tuple(random.normal(0, 0.2, shape[1]).astype(np.float32) for shape in shapes),
        mean=random.normal(0, 0.3, size).astype(np.float32),
        deviation=random.uniform(0.5, 2.0, size).astype(np.float32),
        clip=2.0,
        **{k: np.asarray(v, np.float32) for k, v in action_map(robot, walk, settings.env.action)._asdict().items()},
        estimator_kernels=tuple(random.normal(0, shape[0] ** -0.5, shape).astype(np.float32) for shape in estimator),
        estimator_biases=tuple(random.normal(0, 0.2, shape[1]).astype(np.float32) for shape in estimator),
        inputs=inputs,
    )
    origin = deploy.Origin("run", settings, (("walk", 1.0), ("/mine/secret.csv", 0.5)), "abc123", None)
    return SimpleNamespace(config=settings, policy=made, origin=origin, size=size)
