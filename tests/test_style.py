"""Distance of played episodes from the demonstrations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from fmpjax import features, rotations
from fmpjax.config import preset
from fmpjax.style import StyleDistance
from fmpjax.trainer import Trainer


@pytest.fixture(scope="module")
def trainer(walk):
    return Trainer(preset("smoke", **{"env.count": 4}), walk)


@pytest.fixture(scope="module")
def distance(trainer):
    return StyleDistance(trainer)


def test_the_demonstration_is_at_no_distance_wherever_it_faces(trainer, distance, robot, walk):
    turned = walk.qpos.copy(), walk.qvel.copy()
    turn_wxyz = np.array([np.cos(0.6), 0.0, 0.0, np.sin(0.6)])
    turned[0][:, :3] = rotations.rotate(turn_wxyz, turned[0][:, :3]) + [3.0, -2.0, 0.0]
    turned[0][:, 3:7] = rotations.multiply(turn_wxyz, turned[0][:, 3:7])
    turned[1][:, :3] = rotations.rotate(turn_wxyz, turned[1][:, :3])
    for qpos, qvel in ((walk.qpos, walk.qvel), turned):
        frames = features.observe(robot, jnp.asarray(qpos), jnp.asarray(qvel), "compact").frame[:, None]
        # Windows of the table begin after the first ones of the clip.
        late = frames[trainer.env.first_row :]
        assert distance(late, np.ones(late.shape[:2], bool)) == pytest.approx(0.0, abs=0.02)


def test_it_is_that_of_the_nearest_window(trainer, distance):
    frames = trainer.env.clip_frames[:60, None] + 0.3 * jax.random.normal(jax.random.PRNGKey(0), (60, 3, 117))
    found = distance(frames, np.ones((60, 3), bool))
    horizon, windows = trainer.env.horizon, []
    for first in range(0, 60 - horizon + 1, 25):
        windows.append(distance._map(jnp.swapaxes(frames[first : first + horizon], 0, 1)))
    expert = distance._map(trainer.env.clip_windows())
    nearest = [cdist(window, expert).min(1) for window in windows]
    np.testing.assert_allclose(found, np.mean(nearest, 0), rtol=1e-3)
    assert (found > 0.1).all()


def test_only_whole_windows_count(trainer, distance):
    frames = trainer.env.clip_frames[:60, None].repeat(2, 1)
    frames = frames.at[5:, 0].add(1.0)
    counts = np.ones((60, 2), bool)
    counts[5:, 0] = False
    gone, stays = distance(frames, counts)
    assert np.isnan(gone) and stays < 0.02
