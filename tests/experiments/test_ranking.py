"""A reward fitted where the pool stands must prefer the demonstration to its frozen and slowed copies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import cli, features, motion, priors
from fmpjax import config as configuration
from fmpjax.errors import UserError
from fmpjax.experiments import ranking
from fmpjax.frames import FrameLayout
from fmpjax.trainer import Trainer


@pytest.fixture(scope="module")
def trainer():
    config = configuration.preset("laptop", **{"env.count": 16})
    return Trainer(config, motion.load("walk", rate=config.control_rate))


def standing_pool(trainer, count=1024, seed=0):
    """Windows ``[8, count / 8, D]`` of a robot that stands about the default pose and sways a little."""
    rng, horizon = np.random.default_rng(seed), trainer.env.horizon
    robot = trainer.robot
    pose = np.tile(robot.default_qpos, (count, horizon, 1))
    pose[..., 7:] += rng.normal(0, 0.05, (count, 1, robot.joint_count))
    velocity = rng.normal(0, 0.05, (count, 1, 6 + robot.joint_count)) * np.ones((1, horizon, 1))
    pose[..., 7:] += velocity[..., 6:] * (np.arange(horizon) / trainer.clip.rate)[None, :, None]
    frames = features.observe(robot, jnp.float32(pose), jnp.float32(velocity), "compact").frame
    return trainer.feature_map(frames).reshape(8, count // 8, -1)


def test_copies_are_what_they_say(trainer):
    copies = ranking.copies(trainer)
    demonstration = copies["demonstration"]
    assert np.allclose(demonstration, trainer.expert.windows, atol=1e-5)
    # Halving the speed doubles the samples; a shuffle keeps every window's coordinates but for x and y.
    assert len(copies["slowed to half"]) == 2 * len(trainer.clip) - 1 - trainer.env.horizon + 1
    frames = copies["frozen"].reshape(len(copies["frozen"]), trainer.env.horizon, -1)
    undone = frames / np.asarray(trainer.feature_map.weight) * np.asarray(trainer.feature_map.deviation)
    speed = undone + np.asarray(trainer.feature_map.mean)
    index = FrameLayout.of(trainer.robot).velocity.start
    unclipped = np.abs(frames / np.asarray(trainer.feature_map.weight))[..., index] < float(trainer.feature_map.clip)
    assert unclipped.any() and np.allclose(speed[..., index][unclipped], 0, atol=1e-4)


@pytest.mark.slow
def test_demonstration_beats_frozen_and_slowed_copies_when_the_pool_stands(trainer):
    result = ranking.rank(trainer, standing_pool(trainer), jax.random.PRNGKey(0), updates=128)
    print(ranking.table(result))
    good = result["demonstration"]
    for name in ("frozen", "slowed to half"):
        assert good["margin"] > result[name]["margin"], name
        assert result[name]["beaten"] > 0.75, name
    # The pool itself is the worst place to be: its median is the zero of the margin.
    assert good["margin"] > 1.0


@pytest.mark.parametrize("method", ["amp", "pwil"])
def test_a_learned_reward_of_any_method_is_ranked(method):
    """An untrained discriminator and a greedy coupling: the second prefers the demonstration by its definition."""
    config = configuration.preset("laptop", **{"env.count": 16, "method": method})
    trainer = Trainer(config, motion.load("walk", rate=config.control_rate))
    windows = standing_pool(trainer, 64)
    valid = jnp.ones(windows.shape[:2], bool)
    state = trainer.prior.init(jax.random.PRNGKey(0))
    result = ranking.rank_learned(trainer, state, windows, valid)
    assert set(result) == {*ranking.copies(trainer), "pool"} and "reward" not in result["frozen"]
    # A window against itself is a coin's toss.
    assert result["demonstration"]["beaten"] == pytest.approx(0.5, abs=0.03)
    if method == "pwil":
        assert all(result[name]["beaten"] > 0.9 for name in ("frozen", "reversed", "noisy (0.1 rad, 1 rad/s)"))
        assert result["demonstration"]["margin"] > result["frozen"]["margin"] > 0
    assert "frozen" in ranking.table(result)


def test_two_rewards_at_once_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        cli.main(["experiment", "ranking", "--run", str(tmp_path), "--start", "--learned"])
    assert "--start and --learned are two rewards: expected one of them" in capsys.readouterr().err


def test_only_a_potential_is_ranked():
    with pytest.raises(UserError, match="method is 'amp': expected one that fits a potential, fmp, endpoint, value"):
        priors.check_potential("amp")
