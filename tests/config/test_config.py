"""The presets: the paper's numbers to the letter, and every one of them trains."""

import json
import re
import typing
from pathlib import Path

import jax
import numpy as np
import pytest

from fmpjax import cli, motion
from fmpjax import config as configuration
from fmpjax.config import explaining, reading
from fmpjax.errors import UserError
from fmpjax.trainer import Trainer
from tests.helpers import ROOT


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
    with pytest.raises(UserError, match="unknown preset 'huge': expected one of smoke, laptop, robust, robot, paper"):
        configuration.preset("huge")


# --- types where the numbers stand -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", configuration.PRESETS)
def test_presets_are_what_their_types_allow(name):
    config = configuration.preset(name)
    assert configuration.validate(config) is config
    assert configuration.from_json(configuration.to_json(config)) == config
    assert hash(config) == hash(configuration.preset(name))


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("ppo.hidden", "8,0", "whole numbers of at least 1, with commas between"),
        ("ppo.hidden", 8, "whole numbers of at least 1, with commas between"),
        ("prior.flow_weight", -1.0, "a number of at least 0"),
        ("prior.query_share", 0.0, "a number above 0 and at most 1"),
        ("ppo.momentum", 1.0, "a number of at least 0 and below 1"),
        ("physics.iterations", "0", "a whole number of at least 1"),
        ("features.history", 65, "a whole number of at least 2 and at most 64"),
        ("evaluations", "0.5,1.5", "numbers above 0 and at most 1, with commas between"),
        ("smp.score_steps", "", "one or more whole numbers of at least 0, with commas between"),
        ("wail.optimizer", "lion", "one of adam, sgd"),
        ("ppo.orthogonal", 2, "true or false"),
        ("env.count", True, "a whole number of at least 1"),
        ("env.count", None, "a whole number of at least 1"),
        ("motion", 3, "text"),
        ("ppo.fall_value", "nan", "a number"),
    ],
)
def test_a_value_outside_its_type_is_refused_with_the_type_in_words(key, value, expected):
    with pytest.raises(UserError) as refused:
        configuration.preset("laptop", **{key: value})
    assert str(refused.value) == f"setting {key} is {value!r}: expected {expected}"


def test_values_of_a_configuration_made_by_hand_are_checked():
    config = configuration.Config(env=configuration.EnvConfig(count=-1))
    with pytest.raises(UserError, match="setting env.count is -1: expected a whole number of at least 1"):
        configuration.validate(config)


def test_values_are_taken_as_people_and_numpy_write_them():
    config = configuration.preset(
        "laptop",
        transitions="1_000_000",
        motion=Path("walks") / "mine.npz",
        evaluations=np.array([0.5, 1.0]),
        **{"env.count": np.int64(64), "ppo.hidden": "(32, 16)", "ppo.clip": " 1e-1", "chunk": 5.0},
    )
    assert config.transitions == 1_000_000 and config.motion == "walks/mine.npz"
    assert (config.env.count, config.ppo.hidden, config.ppo.clip, config.chunk) == (64, (32, 16), 0.1, 5)
    assert config.evaluations == (0.5, 1.0)
    plain = [config.env.count, config.chunk, *config.evaluations]
    assert [type(value) for value in plain] == [int, int, float, float]


def test_networks_of_the_diffusion_model_are_its_choices():
    assert set(configuration.SMP_NETWORKS) == set(typing.get_args(reading.types(configuration.SMPConfig)["network"]))


def test_a_command_of_another_kind_is_refused():
    configuration.CommandConfig(kind="phase").require("phase")
    with pytest.raises(UserError, match="^the run's command.kind is 'none': expected 'phase'$"):
        configuration.CommandConfig().require("phase")


# --- explanations ----------------------------------------------------------------------------------------------------


def test_every_setting_has_a_meaning_and_a_known_source():
    known = explaining.settings()
    assert list(known) == list(configuration.flatten(configuration.Config()))
    for setting in known.values():
        assert re.search("[a-z]{3}", re.sub(r"\[.*?\]", "", setting.meaning)), setting
        sources = re.findall(r"\[([A-Z])", setting.meaning)
        assert (sources or setting.key == "preset") and set(sources) <= set(explaining.SOURCES), setting


def test_a_meaning_is_the_comment_of_the_class_that_sets_the_default():
    known = explaining.settings()
    assert known["env.count"].meaning == "number of parallel environments [P]"
    above = "shares of the budget at which the policy is evaluated [P]"
    assert known["evaluations"].meaning.startswith(above)
    assert known["wail.updates"].meaning != known["amp.updates"].meaning == known["gail.updates"].meaning
    assert known["prior.updates"].values == {"paper": 128, "robot": 3, "robust": 3, "laptop": 3, "smoke": 2}


def test_a_preset_that_pushes_keeps_its_pushes_with_a_velocity_command():
    for name, speed in (("laptop", (0.0, 0.4)), ("robust", (0.0, 1.0)), (None, (0.0, 0.4))):
        changes = configuration.commanded("velocity", {"seed": 3}, name)
        made = configuration.preset(name or "laptop", **changes)
        assert made.disturbance.push_speed == speed and made.disturbance.push_interval and made.seed == 3
    assert configuration.preset("robot").disturbance == configuration.preset("robust").disturbance
    own = configuration.commanded("velocity", {"disturbance.push_interval": (1.0, 3.0)})
    assert configuration.preset("laptop", **own).disturbance.push_turn == 0.0
    harder = configuration.commanded("velocity", {"disturbance.push_speed": (0.0, 0.6)})
    assert configuration.preset("laptop", **harder).disturbance.push_interval == (2.0, 4.0)


def test_a_section_or_a_setting_is_explained(capsys):
    cli.main(["settings", "pwil"])
    printed = capsys.readouterr().out
    assert "pwil.scale = 5.0\n    alpha, reward of a perfect step [L]\n    a number above 0\n" in printed
    assert "[L] PWIL" in printed and "ppo." not in printed
    cli.main(["settings", "env.count"])
    printed = capsys.readouterr().out
    assert (
        printed.startswith("env.count = 1024 (128 in robot, robust and laptop, 16 in smoke)\n")
        and "env.reset" not in printed
    )
    assert "prior.query_share = 0.75 (1.0 in robot, robust, laptop and smoke)\n" in explaining.text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["priors"], "unknown section 'priors': did you mean 'prior'?"),
        (["ppo.discont"], "unknown section 'ppo.discont': did you mean 'ppo.discount'?"),
        (["xyz"], "unknown section 'xyz': expected one of physics, env, "),
        (["ppo", "--markdown"], "--markdown prints all settings: expected no section, not 'ppo'"),
    ],
)
def test_an_unknown_section_is_named(capsys, arguments, words):
    with pytest.raises(SystemExit) as ended:
        cli.main(["settings", *arguments])
    assert ended.value.code == 2 and capsys.readouterr().err.startswith(f"fmpjax: {words}")


def test_the_page_of_settings_is_what_the_command_prints(capsys):
    cli.main(["settings", "--markdown"])
    page = ROOT / "docs" / "settings.md"
    assert capsys.readouterr().out == page.read_text(), "run: fmpjax settings --markdown > docs/settings.md"
