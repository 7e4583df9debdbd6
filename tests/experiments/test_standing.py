"""The measurements of `fmpjax.experiments.standing`, on moments whose figures are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import ppo, runs
from fmpjax.experiments import standing
from fmpjax.trainer import Trainer
from tests.helpers import tiny

STEPS, COUNT = 250, 20


def moments(speed, reward, fell, timed_out=None):
    shape = (STEPS, COUNT)
    full = lambda x: jnp.broadcast_to(jnp.asarray(x), shape)  # noqa: E731
    nothing = jnp.zeros(0)
    reward = full(reward).astype(jnp.float32)
    never = jnp.zeros(shape, bool)
    batch = ppo.Batch(
        nothing, nothing, nothing, nothing, nothing, reward, full(fell), never if timed_out is None else full(timed_out)
    )
    return standing.Moments(nothing, nothing, full(speed), reward, jnp.full_like(reward, reward.mean()), batch)


def test_behaviors_in_closed_form():
    """Half of the environments stand for ever at reward 1, half walk at 1.4 and fall every 100 steps.

    Of 100 walking moments 50 have a fall within the next 50 steps: a hazard of 1 - 0.5^(1/50) a step, and a return of
    1.4 / (1 - 0.97 * 0.5^(1/50)) = 32.4 against 1 / 0.03 = 33.3 for standing.
    """
    walking = np.arange(COUNT) % 2 == 1
    fell = walking & ((np.arange(STEPS)[:, None] + 1) % 100 == 0)
    row = standing.behaviors(moments(np.where(walking, 0.6, 0.05), np.where(walking, 1.4, 1.0), fell))
    assert (row["standing_share"], row["walking_share"]) == (0.5, 0.5)
    assert row["standing_reward"] == pytest.approx(1.0)
    assert row["walking_reward"] == pytest.approx(1.4)
    assert row["standing_falls_in_1s"] == 0.0
    # A moment that falls itself is no longer going on: 99 of 100 count.
    assert row["walking_falls_in_1s"] == pytest.approx(50 / 99, abs=0.01)
    assert row["standing_return_0.97"] == pytest.approx(1 / 0.03)
    assert row["walking_return_0.97"] == pytest.approx(1.4 / (1 - 0.97 * 0.5**0.02), rel=0.01)
    assert row["walking_return_0.99"] < row["standing_return_0.99"]


def test_moments_cut_short_by_a_time_out_do_not_count():
    """Episodes of 30 steps that never fall say nothing of the next 50, one that falls after ten says that it falls."""
    steps = np.arange(STEPS)[:, None]
    cut = np.broadcast_to((steps + 1) % 30 == 0, (STEPS, COUNT))
    row = standing.behaviors(moments(0.0, 1.0, np.zeros((STEPS, COUNT), bool), cut))
    assert np.isnan(row["standing_falls_in_1s"])
    fell = np.broadcast_to((steps + 1) % 30 == 10, (STEPS, COUNT))
    row = standing.behaviors(moments(0.0, 1.0, fell, cut))
    assert row["standing_falls_in_1s"] == 1.0


def test_returns_of_a_constant_reward():
    """1 / (1 - gamma) without falls, and (1 - gamma^k) / (1 - gamma) with a fall k steps ahead."""
    fell = np.zeros((STEPS, COUNT), bool)
    fell[100] = True
    returns = np.asarray(standing._returns(jnp.ones((STEPS, COUNT)), moments(0.0, 1.0, fell).batch, 0.97))
    np.testing.assert_allclose(returns[101:], 1 / 0.03, rtol=1e-4)
    np.testing.assert_allclose(returns[100], 1.0, rtol=1e-5)
    np.testing.assert_allclose(returns[91], (1 - 0.97**10) / 0.03, rtol=1e-4)


@pytest.mark.slow
def test_a_look_at_a_run(tmp_path):
    """All figures of a real, if tiny, run are there; shares are shares; a longer fit follows the transport better."""
    config = tiny(**{"env.count": 16, "ppo.rollout_steps": 16, "ppo.critic_batch": 4, "ppo.actor_batch": 4})
    trainer = Trainer(config, runs.load_motion(config))
    state = jax.jit(trainer.iteration)(trainer.init())[0]
    seen, figures = standing._examine(trainer, state, jax.random.PRNGKey(0))
    assert seen.speed.shape == (standing.ROLLOUTS * 16, 16)
    # Episodes begin in mid-stride: the first windows move as the demonstration does.
    assert 0.5 < float(seen.speed[0].mean()) < 1.2
    assert all(np.isfinite(float(value)) for value in figures.values())
    shares = [float(v) for k, v in figures.items() if k.startswith("gradient_share_") and not k.endswith("floored")]
    assert sum(shares) == pytest.approx(1.0, abs=1e-4)
    assert -1 <= figures["gradient_agreement"] <= 1
    assert 0 <= figures["return_survival_share"] <= 1
    assert figures["128_updates_gradient_cosine"] > figures["online_gradient_cosine"]
    row = standing.behaviors(seen)
    assert row["standing_share"] + row["walking_share"] <= 1.0
    tracking = standing.track(trainer)
    assert 0.01 < tracking["joint_error"] < tracking["worst_joint_error"] < 1.0
    assert 10 < tracking["open_loop_steps"] < 200
