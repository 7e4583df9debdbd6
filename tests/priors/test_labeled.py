"""One prior per motion: each learns from the steps that were told its motion, and rewards only those."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import config, motion, priors
from fmpjax.errors import UserError
from fmpjax.priors import Rollout, labeled
from fmpjax.trainer import Trainer
from tests.helpers import COUNT, STEPS, expert_of, tiny

CENTERS = np.array([[2.0, 0.0], [-2.0, 0.0], [0.0, 3.0]])
LABEL = np.repeat([0, 1, 2], [20, 33, 7])


@pytest.fixture(scope="module")
def experts():
    rng = np.random.default_rng(0)
    return expert_of(CENTERS[LABEL] + 0.1 * rng.normal(size=(len(LABEL), 2)))


@pytest.fixture(scope="module")
def made(experts):
    settings = tiny()
    return labeled.make(lambda expert: priors.make("fmp", expert, settings), experts, LABEL), settings


def rollout(points, label, valid=None):
    valid = np.ones((STEPS, COUNT), bool) if valid is None else valid
    return Rollout(jnp.asarray(points, jnp.float32), jnp.asarray(valid), label=jnp.asarray(label, jnp.int32))


def test_each_motion_is_learned_as_by_itself(made, experts):
    """State, reward and metrics are those of a prior with this motion alone and the steps that were told it."""
    prior, settings = made
    rng = np.random.default_rng(1)
    label, points = rng.integers(0, 2, (STEPS, COUNT)), rng.normal(size=(STEPS, COUNT, 2))  # nothing told the third
    valid = rng.uniform(size=label.shape) < 0.9
    keys = jax.random.split(jax.random.PRNGKey(3), 3)
    state = jax.jit(prior.init)(jax.random.PRNGKey(2))
    new, reward, metrics = jax.jit(prior.update)(state, rollout(points, label, valid), jax.random.PRNGKey(3))
    assert (np.asarray(reward)[~valid] == 0).all() and (np.asarray(reward)[valid] > 0).all()
    losses = []
    for each in range(2):
        # As many windows as the longest motion has: 33.
        rows = np.flatnonzero(LABEL == each)
        alone = priors.make("fmp", expert_of(experts.windows[rows[np.arange(33) * len(rows) // 33]]), settings)
        mine = ((label == each) & valid).ravel()
        own = np.resize(np.flatnonzero(mine), mine.size)
        seen = Rollout(jnp.asarray(points.reshape(-1, 2)[own], jnp.float32).reshape(STEPS, COUNT, 2), jnp.asarray(
            np.ones((STEPS, COUNT), bool)))  # fmt: skip
        before = jax.tree.map(lambda x, each=each: x[each], state)
        expected, earned, figures = jax.jit(alone.update)(before, seen, keys[each])
        after = jax.tree.map(lambda x, each=each: x[each], new)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=1e-5), after, expected)
        first = np.asarray(earned).ravel()[: mine.sum()]
        np.testing.assert_allclose(np.asarray(reward).ravel()[mine], first, rtol=1e-3, atol=1e-4)
        losses.append(float(figures["value_loss"]))
    for a, b in zip(jax.tree.leaves(new), jax.tree.leaves(state), strict=True):
        np.testing.assert_array_equal(a[2], b[2])  # what nothing was told has learned nothing
    np.testing.assert_allclose(metrics["value_loss"], np.mean(losses), rtol=1e-4)


def test_a_policy_earns_only_by_the_motion_that_it_is_told(made):
    """Half of the steps are at each of two motions; told that one they earn more than told the other."""
    prior, _ = made
    rng = np.random.default_rng(2)
    place, label = (np.arange(STEPS)[:, None] % 2) + np.zeros((1, COUNT), int), rng.integers(0, 2, (STEPS, COUNT))
    points = CENTERS[place] + 0.1 * rng.normal(size=(STEPS, COUNT, 2))
    state, update = jax.jit(prior.init)(jax.random.PRNGKey(0)), jax.jit(prior.update)
    for i in range(60):
        state, reward, _ = update(state, rollout(points, label), jax.random.PRNGKey(i))
    reward, obeyed = np.asarray(reward), place == label
    for each in range(2):
        assert reward[obeyed & (label == each)].min() > reward[~obeyed & (label == each)].max() + 0.3


def test_a_run_trains_with_a_prior_per_motion():
    asked = {"command.kind": "motion", "command.labeled": True, "command.combine": "prior", "motion": "walk,turn_left"}
    trainer = Trainer(tiny(**asked), motion.load_library("walk,turn_left"))
    state = trainer.init()
    new, metrics = jax.jit(trainer.iteration)(state)
    assert {np.shape(x)[0] for x in jax.tree.leaves(new.prior)} == {2}
    assert np.isfinite(float(metrics["fit/value_loss"])) and float(metrics["command/prior_reward"]) > 0
    leaves = zip(jax.tree.leaves(new.prior), jax.tree.leaves(state.prior), strict=True)
    assert any(not np.array_equal(after, before) for after, before in leaves)
    with pytest.raises(UserError, match="each motion has a score of its own"):
        trainer.prior.score(new.prior, trainer.prior_expert.windows)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"command.kind": "velocity"}, "command.labeled is true and command.kind 'velocity': expected 'motion'"),
        ({"command.kind": "motion", "method": "pwil"}, "command.labeled is true and method 'pwil'"),
        ({"command.kind": "motion", "method": "smp"}, "command.labeled is true and method 'smp'"),
    ],
)
def test_what_has_no_labels_is_refused(changes, words):
    with pytest.raises(UserError, match=words):
        config.validate(tiny(**{"command.labeled": True} | changes))
