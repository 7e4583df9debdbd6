"""Figures of policies that follow the time in a clip."""

import json

import numpy as np
import pytest

from fmpjax import cli, following, runs
from fmpjax.config import preset
from fmpjax.errors import UserError
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


@pytest.mark.slow
def test_a_run_that_is_told_the_time_is_measured(tmp_path, capsys):
    folder = tmp_path / "run"
    command = ["train", "--preset", "smoke", "--motion", "walk", "--command", "phase", "--run", str(folder)]
    cli.main([*command, *settings(TINY)])
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
