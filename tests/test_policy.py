"""The exported policy against the networks that it was taken from."""

import jax
import numpy as np
import pytest

from fmpjax import motion, policy
from fmpjax.errors import UserError
from fmpjax.trainer import Trainer
from tests.helpers import tiny


@pytest.mark.parametrize(
    ("observation", "action", "activation"),
    [
        ("compact", "residual", "elu"),
        ("full", "absolute", "relu"),
        ("compact", "absolute", "swish"),
        ("full", "residual", "tanh"),
    ],
)
def test_numpy_says_what_the_networks_say(tmp_path, observation, action, activation):
    changes = {"env.observation": observation, "env.action": action, "ppo.activation": activation}
    trainer = Trainer(tiny(**changes, **{"ppo.hidden": (16, 12), "ppo.mean_init": 0.5}), motion.load("walk"))
    state = trainer.init().ppo
    observations = trainer.env.clip_observations[::20]
    # The running statistics of a policy that has seen something else than the clip alone.
    state = state._replace(normalizer=trainer.ppo.observe(state.normalizer, 2.0 * observations))
    actions, _ = trainer.ppo.act(state, deterministic=True)(observations, jax.random.PRNGKey(0))
    loaded = policy.load(policy.save(tmp_path / "policy.npz", policy.of(trainer, state)))
    targets = loaded(observations)
    np.testing.assert_allclose(targets, trainer.env.actions(actions), atol=2e-5)
    assert targets.std(0).max() > 1e-3
    np.testing.assert_allclose(loaded(observations[3]), targets[3], atol=1e-6)
    assert loaded.joint_names == tuple(trainer.robot.joint_names)
    assert (loaded.observation, loaded.activation, loaded.rate) == (observation, activation, 50.0)


@pytest.mark.parametrize("content", [None, b"not an archive", b"PK\x03\x04 cut off", "other"])
def test_what_is_no_policy_is_refused(tmp_path, content):
    path = tmp_path / "policy.npz"
    if content == "other":
        np.savez(path, qpos=np.zeros(3))
    elif content:
        path.write_bytes(content)
    with pytest.raises(UserError, match=r"policy.npz is not a policy .*: expected policy.npz as `fmpjax export`"):
        policy.load(path)


@pytest.fixture
def small():
    """A policy of three observations and two joints."""
    return policy.Policy(
        joint_names=("hip", "knee"), observation="compact", rate=50.0, activation="relu",
        kernels=(np.ones((3, 4)), np.ones((4, 2))), biases=(np.zeros(4), np.zeros(2)),
        mean=np.zeros(3), deviation=np.ones(3), clip=10.0,
        center=np.zeros(2), scale=np.ones(2), low=np.full(2, -1.0), high=np.ones(2),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("shape", "has"), [((2,), "2 numbers"), ((4,), "4 numbers"), ((3, 1), "1 numbers"), ((), "no numbers")]
)
def test_an_observation_of_another_length_is_named(small, shape, has):
    with pytest.raises(
        UserError, match=f"the observation has {has}: expected 3, for the observation 'compact' of this policy"
    ):
        small(np.zeros(shape))
    assert small([0.0, 0.0, 0.0]).shape == (2,)


def test_a_policy_is_printed_short(small):
    assert repr(small) == str(small)
    assert repr(small) == "Policy(3 compact observations -> 2 joint targets, layers [4, 2], relu, 50 Hz)"
