"""Figures of policies that are told one of several motions."""

import json

import numpy as np
import pytest

from fmpjax import cli, motion, performing, runs
from fmpjax.errors import UserError
from fmpjax.motion import MotionLibrary
from fmpjax.trainer import Trainer
from tests.helpers import TINY, settings, tiny

NAMES = ("walk", "turn_left", "fast_walk")


@pytest.fixture(scope="module")
def trainer():
    library = MotionLibrary(tuple(map(motion.load, NAMES)), (1.0, 1.0, 1.0))
    return Trainer(tiny(motion=",".join(NAMES), **{"command.kind": "motion"}), library)


def test_episodes_begin_as_what_they_are_told(trainer):
    told = np.tile(np.repeat([0, 1, 2], 8), (4, 1))
    played = performing.play(trainer, trainer.init().ppo, told, np.random.default_rng(0))
    assert played.alive.all() and not played.fell.any()
    assert (played.nearest == told).mean() > 0.8


def test_what_is_performed_is_counted(trainer, monkeypatch):
    """A robot that turns whatever it is told, but walks when told to walk; every fourth episode falls after 5 s."""

    def play(trainer, state, told, rng):
        nearest = np.where(told == 0, 0, 1)
        alive = np.ones(told.shape, bool)
        alive[250:, ::4] = False
        return performing.Played(nearest, alive, ~alive[-1])

    monkeypatch.setattr(performing, "play", play)
    found = performing.measure(trainer, None, episodes=40, each=8)
    assert found.motions == NAMES
    assert found.performed == ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0))
    assert found.correct == pytest.approx(2 / 3)
    assert (found.episodes, found.falls, found.motion_falls) == (24, 6, (2, 2, 2))
    assert (found.changing_episodes, found.changing_falls) == (40, 10)
    assert 0.5 < found.changing_correct < 0.8  # two of three motions, drawn evenly
    lines = performing.table(found).splitlines()
    assert "67 %" in lines[0] and "0 %" in lines[3] and "2 falls of 8" in lines[3]
    assert json.loads(found.to_json())["changing_falls"] == 10


def test_a_run_with_another_command_is_refused():
    trainer = Trainer(tiny(), motion.load("walk"))
    with pytest.raises(UserError, match=r"the run's command\.kind is 'none': expected 'motion'"):
        performing.measure(trainer, None)


@pytest.mark.slow
def test_the_command_line_evaluates_a_run(tmp_path, capsys):
    run = tmp_path / "run"
    options = ["--preset", "smoke", "--command", "motion", "--motion", "walk,turn_left", "--no-pictures"]
    cli.main(["train", "--run", str(run), *options, *settings(TINY)])
    cli.main(["evaluate", str(run), "--commands", "--episodes", "4"])
    assert "performs the motion that it is told" in capsys.readouterr().out
    found = json.loads((run / "performing.json").read_text())
    assert found["motions"] == ["walk", "turn_left"] and found["changing_episodes"] == 4
    assert (run / "performing.png").stat().st_size > 1000
    names = [path.name for path in runs.export(runs.Run.open(run), tmp_path / "out")]
    assert {"performing.json", "performing.png"} <= set(names)
