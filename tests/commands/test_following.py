"""Figures of policies that follow the time in a clip."""

import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import cli, following, robots, runs
from fmpjax.config import preset
from fmpjax.errors import UserError
from fmpjax.frames import FrameLayout
from fmpjax.motion import MotionClip
from fmpjax.trainer import Trainer
from tests.helpers import TINY, settings

JOINTS = np.arange(6)


def played(steps=100, count=2):
    """Two episodes that do exactly what the clip does, a swing of the joints while the root moves ahead."""
    time = np.arange(1, steps + 1)[:, None] / 50.0
    qpos = np.zeros((steps, count, 7 + 8))
    qpos[..., 0], qpos[..., 2] = time, 0.8
    qpos[..., 7:] = np.sin(2.0 * np.pi * time)[..., None]
    points = np.ones((steps, count, 3, 3))
    share = np.broadcast_to(time / time[-1], (steps, count))
    counts = np.ones((steps, count), bool)
    return following.Played(qpos, qpos.copy(), points, points.copy(), share, counts, np.zeros(count, bool))


def figures(episodes, begun=(0.0, 0.0)):
    return following.figures(episodes, np.array(begun), JOINTS, 50.0, 2.0)


def test_the_clip_itself_has_no_error():
    found = figures(played())
    assert (found.finished, found.episodes, found.excursion) == (2, 2, 1.0)
    errors = found.joint_error, found.key_point_error, found.height_error, found.root_error
    assert errors == (0.0, 0.0, 0.0, 0.0) and sum(found.part_falls) == 0
    assert found.part_finished[0] == 1.0 and np.isnan(found.part_finished[1])


def test_errors_are_means_over_the_steps_played():
    one = played()
    one.qpos[:, 0, 7:] *= 0.5  # half of the swing
    one.qpos[:, 1, :3] += (0.3, 0.4, -0.1)
    one.points[:, 0] += (0.0, 0.2, 0.0)
    found = figures(one)
    swing = np.abs(np.sin(2.0 * np.pi * np.arange(1, 101) / 50.0)).mean()
    assert found.joint_error == pytest.approx(0.25 * swing)
    assert found.key_point_error == pytest.approx(0.1)
    assert found.height_error == pytest.approx(0.05)
    assert found.root_error == pytest.approx(np.sqrt(0.09 + 0.16 + 0.01) / 2)
    assert found.excursion == pytest.approx(0.75)


def test_a_fall_counts_where_it_happens_and_ends_what_is_measured():
    one = played()
    one.fell[1] = True
    one.counts[52:, 1] = False  # falls on the 52nd step of 100
    one.qpos[52:, 1, 7:] += 9.0  # what comes after it does not count
    found = figures(one, begun=(0.0, 0.3))
    assert found.finished == 1 and found.joint_error == 0.0
    assert [i for i, falls in enumerate(found.part_falls) if falls] == [10]
    assert (found.part_finished[0], found.part_finished[6]) == (1.0, 0.0)
    assert found.excursion == 1.0  # of the other episode


def test_key_points_are_in_the_own_heading():
    """A robot that faces +y, with a point ahead of it and one to its left, above."""
    robot = robots.load("unitree_g1")
    layout = FrameLayout.of(robot)
    frame = np.zeros((2, layout.size), np.float32)
    frame[:, layout.rotation] = [0, 1, 0, 0, 0, 1]
    frame[:, layout.key_points.start : layout.key_points.start + 6] = [0, 2, 0.5, -3, 0, 0.7]
    found = following._points(SimpleNamespace(robot=robot), jnp.asarray(frame))
    np.testing.assert_allclose(found[0, :2], [[2, 0, 0.5], [0, 3, 0.7]], atol=1e-6)


@pytest.mark.parametrize("loops", [True, False])
def test_what_is_wanted_is_the_frame_after_the_step(monkeypatch, walk, loops):
    """A robot that is put on the clip's next frame at each step has no error, and one on the frame before has.

    A clip that loops is compared until it begins again.
    """
    clip = walk if loops else MotionClip.from_qpos("part", walk.robot, walk.rate, walk.qpos[:120])
    trainer = Trainer(preset("smoke", **TINY, **{"command.kind": "phase"}), clip)
    last = len(clip) - 1
    frames, qpos = trainer.env.clip_frames, jnp.asarray(trainer.env.library.qpos, jnp.float32)

    def play(late):
        def step(trainer, env, policy, now, alive, drawn):
            command, over, _ = env.command.advance(now.command, None, now.observed.frame)
            row = jnp.where(command < now.command, last, command) - late
            observed = now.observed._replace(frame=frames[row])
            physics = now.physics._replace(qpos=qpos[row])
            now = now._replace(command=command, observed=observed, physics=physics)
            return SimpleNamespace(now=now, alive=alive & ~over, fell=jnp.zeros_like(alive))

        monkeypatch.setattr(following.frozen, "step", step)
        following._play.clear_cache()
        return following.measure(
            trainer, trainer.ppo.init(jax.random.PRNGKey(0), trainer.env.clip_observations), episodes=3
        )

    right, late = play(0), play(1)
    following._play.clear_cache()
    assert right.finished == 3 and right.seconds == pytest.approx(clip.duration)
    assert max(right.joint_error, right.root_error, right.height_error, right.key_point_error) < 1e-6  # float32's
    assert right.excursion == pytest.approx(1.0, abs=1e-6)
    assert late.joint_error > 1e-3 and late.root_error == pytest.approx(0.86 / 50, rel=0.1)


@pytest.mark.slow
def test_a_run_that_is_told_the_time_is_measured(tmp_path, capsys):
    folder = tmp_path / "run"
    command = ["train", "--preset", "smoke", "--motion", "walk", "--command", "phase", "--run", str(folder)]
    cli.main([*command, "--no-pictures", *settings(TINY)])
    capsys.readouterr()
    cli.main(["evaluate", str(folder), "--commands", "--episodes", "5"])
    assert "reach the clip's end" in capsys.readouterr().out
    found = json.loads((folder / "following.json").read_text())
    assert found["episodes"] == 5 and sum(found["part_falls"]) == 5 - found["finished"]
    # Begun on the clip, and an untrained policy's first steps stay near it.
    assert 0 < found["joint_error"] < 1 and 0 < found["root_error"] < 3
    assert (folder / "following.png").stat().st_size > 5_000
    trainer, _ = runs.Run.open(folder).policy()
    assert found["seconds"] == pytest.approx(trainer.clip.duration)


@pytest.mark.slow
def test_a_run_without_a_phase_is_not_followed(walk):
    with pytest.raises(UserError, match="the run's command.kind is 'none': expected 'phase'"):
        following.measure(Trainer(preset("smoke", **TINY), walk), None)
