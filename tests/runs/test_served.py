"""A run's policies for a page: what a checkpoint gives, what the prior says, and the files of a run that trains."""

import json
import os
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import policy, shell, sim2sim
from fmpjax.checkpoint import _flatten
from fmpjax.cli import COMMANDS
from fmpjax.commands import velocity
from fmpjax.errors import UserError
from fmpjax.play.reader import Reader
from fmpjax.play.source import read_npz
from fmpjax.runs import Run, served
from tests.helpers import disturbed, tiny


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run with the checkpoint of its start."""
    made = Run.create(tmp_path_factory.mktemp("runs") / "run", tiny(motion="walk", **{"command.kind": "velocity"}))
    made.checkpoints.save(made.trainer().init())
    return made


@pytest.fixture
def states(walk):
    return {"qpos": walk.qpos[20:30], "qvel": walk.qvel[20:30]}


def test_a_checkpoint_gives_a_policy_that_says_what_its_robot_is(run, tmp_path):
    path = served.Served(run, tmp_path).policy(0, False)
    wanted, found = policy.of(run.trainer(), run.trainer().init().ppo), policy.load(path)
    observations = np.random.default_rng(0).normal(size=(5, len(wanted.mean)))
    np.testing.assert_allclose(found(observations), wanted(observations), atol=1e-6)
    played = read_npz(path)
    np.testing.assert_allclose(
        played.center + played.scale * played.act(observations[0]), wanted(observations[0]), atol=1e-6
    )
    span = velocity.extent(run.config.command, run.trainer().library)
    assert played.robot == "unitree_g1" and span[1, 0] > 0.8
    np.testing.assert_allclose(played.commands, span)
    sim2sim.Simulation(played, run.trainer().robot.path, model=run.trainer().robot.model)


def test_a_policy_that_senses_like_a_robot_is_that_of_the_state(tmp_path):
    """Its critic sees more, so its statistics have two parts, and its estimator is a network of its own."""
    made = Run.create(tmp_path / "run", disturbed(motion="walk", **{"ppo.estimator": (8,)}))
    trainer = made.trainer()
    state = trainer.init()
    made.checkpoints.save(state)
    given, wanted = policy.load(served.Served(made, tmp_path).policy(0, False)), policy.of(trainer, state.ppo)
    observations = np.random.default_rng(0).normal(size=(3, len(wanted.mean)))
    assert given.estimator_kernels and given.inputs.size == len(wanted.mean) // 2
    np.testing.assert_array_equal(given(observations), wanted(observations))


def test_the_prior_scores_as_in_training(run, tmp_path, states):
    asked = served.Served(run, tmp_path)
    asked.policy(None, False)
    answer = asked.answer({"score": {name: rows.tolist() for name, rows in states.items()}})
    trainer = run.trainer()
    rows = np.arange(20, 30)
    frames = jnp.asarray(trainer.env._table.frame[rows])
    wanted = trainer.prior.score(trainer.init().prior, trainer.prior_map(frames[None]))
    assert answer["score"] == pytest.approx(float(wanted[0]), abs=1e-4) and np.isfinite(answer["demonstration"])


def test_a_checkpoint_of_another_version_is_played_without_its_prior(run, tmp_path, states, monkeypatch):
    leaves = _flatten(run.trainer().init())
    older = {name: leaf for name, leaf in leaves.items() if not name.startswith("prior.")}
    monkeypatch.setattr(run.checkpoints, "_read", lambda iteration, best: (tmp_path, older))
    asked = served.Served(run, tmp_path)
    assert policy.load(asked.policy(0, False)).rate == 50.0
    answer = asked.answer({"score": {name: rows.tolist() for name, rows in states.items()}})
    assert "is of another configuration" in answer["error"]
    with pytest.raises(UserError, match="is of another configuration: it has no ppo.nothing"):
        run.checkpoints.part("ppo.nothing")


def test_what_is_not_there_is_answered_by_a_sentence(run, tmp_path):
    asked = served.Served(run, tmp_path)
    assert "cannot be read" in asked.answer({"policy": 77, "best": False})["error"]
    assert "has no checkpoint in best/" in asked.answer({"policy": None, "best": True})["error"]
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_reader_asks_a_process(run, states, tmp_path):
    reader = Reader(run.folder)
    path = reader.policy(0)
    assert read_npz(path).robot == "unitree_g1"
    score, demonstration = reader.score(states["qpos"], states["qvel"])
    assert np.isfinite([score, demonstration]).all()
    with pytest.raises(UserError, match="cannot be read"):
        reader.policy(77)
    reader.close()
    assert not path.exists()
    with pytest.raises(UserError, match="is closed: expected no more questions"):
        reader.policy(0)
    with pytest.raises(UserError, match=r"run \S*none cannot be read: .*none is not a run folder"):
        Reader(tmp_path / "none").policy(0)


def test_a_run_that_trains_writes_its_policy_now_and_then(run, monkeypatch):
    started, now = [], [100.0]
    page = SimpleNamespace(terminate=lambda: started.append("ended"), wait=lambda: None)
    monkeypatch.setattr(served.subprocess, "Popen", lambda command, **_: started.append(command) or page)
    monkeypatch.setattr(served.time, "monotonic", lambda: now[0])
    session = SimpleNamespace(states=[run.trainer().init()], trainer=run.trainer(), done=0)
    file = run.folder / policy.LIVE
    with served.Live([run], port=8123) as live:
        live.open(session)
        command = ["-m", "fmpjax.cli", "play", str(run.folder), "--checkpoint", "live", "--port", "8123"]
        assert started[0][1:] == [*command, "--parent", str(os.getpid())]
        play = shell.parse(COMMANDS, "fmpjax", started[0][3:])
        assert (play.what, play.checkpoint, play.port, play.parent) == ((run.folder,), "live", 8123, os.getpid())
        assert read_npz(file).robot == "unitree_g1" and policy.metadata(file)["iteration"] == "0"
        session.done, now[0] = 2, 101.0
        live.show(session)
        assert policy.metadata(file)["iteration"] == "0"
        now[0] = 106.0
        live.show(session)
        assert policy.metadata(file)["iteration"] == "2"
    assert started[1:] == ["ended"] and not file.exists()
    assert json.loads((run.folder / "config.json").read_text())  # nothing else has changed
