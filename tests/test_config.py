"""The presets: the paper's numbers to the letter, and every one of them trains."""

import json

import jax
import numpy as np
import pytest

from fmpjax import config as configuration
from fmpjax import motion
from fmpjax.errors import UserError
from fmpjax.trainer import Trainer


def test_paper_preset_is_the_paper():
    paper = configuration.flatten(configuration.preset("paper"))
    expected = {
        "robot": "unitree_g1_29dof",
        "precision": "float32",
        "env.count": 1024,
        "env.early_frames": True,
        "env.episode_steps": 500,
        "env.first_cap": 500,
        "features.history": 10,
        "features.clip": 10.0,
        "prior.bank": 256,
        "prior.minibatch": 256,
        "prior.updates": 128,
        "prior.hidden": (256, 256),
        "prior.learning_rate": 3e-4,
        "prior.clip_norm": 10.0,
        "prior.average_half_life": 16.0,
        "prior.average_restarts": True,
        "prior.value_scale": 0.1,
        "prior.epsilon_fraction": 0.1,
        "prior.query_is_bank": False,
        "ppo.rollout_steps": 32,
        "ppo.hidden": (1024, 512),
        "ppo.optimizer": "sgd",
        "ppo.learning_rate": 1e-4,
        "ppo.momentum": 0.9,
        "ppo.discount": 0.99,
        "ppo.gae_lambda": 0.95,
        "ppo.clip": 0.2,
        "ppo.deviation": 0.05,
        "ppo.learn_deviation": False,
        "ppo.critic_epochs": 2,
        "ppo.critic_batch": 2,
        "ppo.actor_epochs": 5,
        "ppo.actor_batch": 4,
        "ppo.advantage_clip": 4.0,
        "ppo.bound_penalty": 10.0,
    }
    assert {key: paper[key] for key in expected} == expected
    config = configuration.preset("paper")
    assert (config.iterations, config.iterations * config.transitions_per_iteration) == (1526, 50_003_968)
    assert int(config.prior.query_share * config.env.count) == 768
    assert config.control_rate == pytest.approx(50) and config.physics.timestep == 0.005
    assert [round(share * 50) for share in config.evaluations] == [5, 10, 20, 30, 40, 50]


def test_an_older_file_means_what_it_meant():
    """Settings that came later are, in a file without them, what the program did before they came."""
    older = json.loads(configuration.to_json(configuration.preset("paper", robot="unitree_g1")))
    for key in ("precision", "env.demonstration_parts", "env.early_frames", "evaluation_noise"):
        del older[key]
    read = configuration.from_json(json.dumps(older))
    assert (read.precision, read.env.demonstration_parts, read.env.early_frames) == ("default", 1, False)
    assert read.evaluation_noise == (0.0,)


@pytest.mark.parametrize("text", ["[]", "3", "null", "{"])
def test_a_file_that_is_no_object_is_refused(tmp_path, text):
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(UserError, match="config.json is not valid JSON: expected a run's configuration"):
        configuration.read(tmp_path / "config.json")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper", "laptop"])
def test_preset_trains_at_a_small_size(name):
    changes = {"env.count": 8, "chunk": 1, "prior.bank": 32, "prior.minibatch": 32, "prior.updates": 2}
    config = configuration.preset(name, **changes, **{"physics.backend": "native"})
    trainer = Trainer(config, motion.load("walk", rate=config.control_rate))
    state = trainer.init()
    new_state, metrics = jax.jit(trainer.iteration)(state)
    undefined = {n for n, v in metrics.items() if not np.isfinite(v)} - {"train/episode_length", "train/falls"}
    assert not undefined
    before, after = jax.tree.leaves(state.ppo.actor), jax.tree.leaves(new_state.ppo.actor)
    assert any(not np.array_equal(a, b) for a, b in zip(before, after, strict=True))
    assert state.env.observed.actor.shape[-1] == {"paper": 237, "laptop": 86}[name]


def test_settings_are_read_by_their_type():
    config = configuration.preset("laptop", **{"env.count": "64", "ppo.hidden": "32,16", "prior.query_is_bank": "true"})
    assert (config.env.count, config.ppo.hidden, config.prior.query_is_bank) == (64, (32, 16), True)
    assert configuration.from_json(configuration.to_json(config)) == config


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"ppo.discont": 0.9}, "did you mean 'ppo.discount'"),
        ({"env.count": "many"}, "env.count is 'many'"),
        ({"env.count": 1.5}, "env.count is 1.5"),
        ({"env.count": 0}, "env.count is 0"),
        ({"env.reset": "anywhere"}, "expected one of dataset, fixed"),
        ({"ppo.discount": 1.5}, "ppo.discount is 1.5"),
        ({"ppo.actor_batch": 5}, "ppo.actor_batch is 5"),
        ({"prior.minibatch": 8, "prior.query_is_bank": True}, "prior.query_is_bank"),
    ],
)
def test_bad_settings_are_named(changes, words):
    with pytest.raises(UserError, match=words.replace("(", r"\(")):
        configuration.preset("laptop", **changes)


def test_unknown_preset():
    with pytest.raises(UserError, match="unknown preset 'huge': expected one of smoke, laptop, paper"):
        configuration.preset("huge")
