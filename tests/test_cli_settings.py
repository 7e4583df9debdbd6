"""Settings as options of a command."""

import re

import pytest

from fmpjax import cli, cli_settings, cli_train, config, shell
from fmpjax.config import explaining
from fmpjax.errors import UserError


def _changes(*arguments, named=None):
    options = cli_settings.options("preset", "seed")
    return cli_settings.changes(shell.parse(options, "fmpjax", arguments), (), named or {})


def test_every_setting_is_an_option_that_its_comment_explains(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "90")
    with pytest.raises(SystemExit) as exit_:
        cli.main(["train", "--help"])
    assert exit_.value.code == 0
    text = " ".join(re.sub("[│\n]", " ", capsys.readouterr().out).split())
    text = re.sub(r"(\d,) (\d{3})", r"\1\2", text)  # a line may end within a number
    for key, setting in explaining.settings().items():
        option = f"--{key.replace('_', '-')} "
        assert option in text, key
        if "." in key:
            assert f"{option}VALUE {setting.meaning}; {setting.expected}. (default: " in text, key
    assert "--env.count VALUE number of parallel environments [P]; a whole number of at least 1. (default: 1" in text
    assert " 1,024 in paper)" in text


def test_options_are_the_settings_that_they_name():
    given = _changes(
        *("--env.count", "64"), *("--ppo.hidden", "32,16"), *("--env.early-frames", "false"), *("--env.axes=heading",),
        *("--command.ahead=-0.5,1.2",), *("--evaluation_episodes", "8"),
    )  # fmt: skip
    assert given == {
        "env.count": "64", "ppo.hidden": "32,16", "env.early_frames": "false", "env.axes": "heading",
        "command.ahead": "-0.5,1.2", "evaluation_episodes": "8",
    }  # fmt: skip
    read = config.preset("laptop", **given)
    assert (read.env.count, read.ppo.hidden, read.env.early_frames) == (64, (32, 16), False)
    assert (read.env.axes, read.command.ahead, read.evaluation_episodes) == ("heading", (-0.5, 1.2), 8)
    assert _changes() == {}


def test_a_setting_that_is_given_twice_has_one_value():
    options = cli_settings.options("preset")()
    assert cli_settings.changes(options, ("env.count=8", "env.count=8"), {"seed": 3}) == {"env.count": "8", "seed": 3}
    assert cli_settings.changes(options, ("env.count=8", "env.count=9"), {}) == {"env.count": "9"}
    with pytest.raises(UserError, match=r"setting seed is given in two ways, as 3 and as 4: expected one of them"):
        cli_settings.changes(options, ("seed=4",), {"seed": 3})
    with pytest.raises(UserError, match=r"setting env.reset is given in two ways, as fixed and as dataset"):
        _changes("--env.reset", "dataset", named={"env.reset": "fixed"})
    with pytest.raises(UserError, match=r"--set 'env.count': expected section.field=value"):
        cli_settings.changes(options, ("env.count",), {})


@pytest.mark.parametrize("command", ["train", "pretrain"])
def test_a_wrong_value_of_an_option_is_one_sentence(command, capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main([command, *(["smp"] if command == "pretrain" else []), "--preset", "smoke", "--env.count", "some"])
    assert exit_.value.code == 2
    assert capsys.readouterr().err == ("fmpjax: setting env.count is 'some': expected a whole number of at least 1\n")


def test_a_default_that_depends_on_the_preset_says_so(monkeypatch):
    robots = {"paper": "another"}
    found = lambda name: {"robot": robots.get(name, "unitree_g1"), "method": "fmp"}  # noqa: E731
    monkeypatch.setattr(cli_settings, "_preset", found)
    said = cli_settings.preset_default("robot").help_behavior_hint
    assert said == "(default: unitree_g1 in smoke, laptop, robust and robot, another in paper)"
    assert cli_settings.preset_default("method").help_behavior_hint == "(default: fmp)"


def test_the_options_of_training_override_its_preset():
    train = shell.parse(cli_train.Train, "train", ["--preset", "smoke", "--ppo.discount", "0.98", "--seed", "4"])
    assert train._changes() == {"seed": 4, "ppo.discount": "0.98"}
