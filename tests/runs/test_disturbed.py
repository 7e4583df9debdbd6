"""A run with every disturbance: stopped and resumed, several seeds at once, split over devices."""

import jax
import numpy as np
import pytest

from fmpjax import motion, runs, sharding
from fmpjax.checkpoint import Checkpoints
from fmpjax.trainer import Trainer, stack, unstack
from tests.helpers import TINY, disturbed

pytestmark = pytest.mark.slow
DEVICES = 2
SHORT = {"transitions": 4 * TINY["transitions"] // 10, "evaluations": (1.0,)}  # two chunks of two iterations


@pytest.fixture(scope="module")
def trainer():
    return Trainer(disturbed(chunk=1, motion="walk"), motion.load("walk"))


@pytest.fixture(scope="module")
def program(trainer):
    """One iteration."""
    return trainer.compile(trainer.init())


def leaves(tree):
    return {jax.tree_util.keystr(path): np.asarray(x) for path, x in jax.tree_util.tree_flatten_with_path(tree)[0]}


def assert_close(one, other):
    for name, leaf in leaves(one).items():
        np.testing.assert_allclose(leaves(other)[name], leaf, rtol=2e-3, atol=2e-3, err_msg=name)


def test_a_resume_is_exact(tmp_path):
    """Pushes, delays, noise and the robots' bodies are part of the checkpoint."""
    whole = runs.Run.create(tmp_path / "whole", disturbed(motion="walk", **SHORT))
    halves = runs.Run.create(tmp_path / "halves", disturbed(motion="walk", **SHORT))
    assert runs.train(whole) is runs.End.BUDGET
    assert runs.train(halves, minutes=1e-6) is runs.End.TIME
    assert Checkpoints(halves.folder).latest() == 2
    assert runs.train(halves, resume=True) is runs.End.BUDGET
    shapes = whole.trainer().shapes()
    one, other = (leaves(Checkpoints(run.folder).restore(shapes)) for run in (whole, halves))
    assert int(one[".iteration"]) == 4 and any(".disturbed.episode" in name for name in one)
    for name, leaf in one.items():
        np.testing.assert_array_equal(other[name], leaf, err_msg=name)


def test_environments_split_over_devices_are_those_of_one(trainer, program):
    one, metrics = program(trainer.init())
    split = trainer.place(trainer.init(), sharding.mesh(DEVICES))
    other, split_metrics = trainer.compile(split)(split)
    assert other.env.disturbed.bias.addressable_shards[0].data.shape[0] == TINY["env.count"] // DEVICES
    assert_close(metrics, split_metrics)
    assert_close(one, other)


def test_seeds_at_once_are_the_seeds_alone(trainer, program):
    group = stack([trainer.init(seed) for seed in range(2)])
    after, _ = trainer.compile(group)(group)
    alone = program(trainer.init(1))[0]
    assert_close(alone, unstack(after)[1])
    bodies = [name for name, leaf in leaves(alone).items() if "disturbed.body" in name and leaf.any()]
    assert bodies and all(np.any(leaves(unstack(after)[0])[name] != leaves(alone)[name]) for name in bodies)
