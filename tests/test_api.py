"""The public interface: what `import fmpjax` offers, and that it is what its page describes."""

import inspect
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import fmpjax
from fmpjax import runs
from tests.helpers import ROOT

PAGE = (ROOT / "docs" / "api.md").read_text()


def test_the_page_lists_exactly_the_public_names():
    assert re.findall(r"^\| `(\w+)` \| .*\. \|$", PAGE, re.MULTILINE) == fmpjax.__all__


@pytest.mark.parametrize("name", fmpjax.__all__)
def test_a_public_name_is_there_and_documented(name):
    value = getattr(fmpjax, name)
    assert callable(value) and inspect.getdoc(value)
    assert value is vars(fmpjax)[name]  # found at once the next time
    assert name in dir(fmpjax)
    if inspect.isfunction(value):
        assert "return" in value.__annotations__


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'fmpjax' has no attribute 'trian'"):
        _ = fmpjax.trian
    assert not hasattr(fmpjax, "train_all")


def test_import_is_cheap_and_train_is_a_function_whatever_is_imported_first():
    code = (
        "import sys, fmpjax; assert not {'jax', 'scipy', 'matplotlib', 'fmpjax.robots'} & set(sys.modules);"
        "fmpjax.load_robot; fmpjax.preset; fmpjax.UserError; assert 'jax' not in sys.modules;"
        "import fmpjax.trainer, fmpjax.runs; from fmpjax import train; print(train.__module__)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "fmpjax.api\n"


# --- train -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def trained(tmp_path, monkeypatch):
    """Calls of the training and of what follows it, which take no time here; the training ends as ``end`` says."""
    monkeypatch.chdir(tmp_path)
    calls = []

    def train(run, **options):
        calls.append(("train", run.folder, options["resume"], options["minutes"]))
        return train.end

    train.end = runs.End.BUDGET
    monkeypatch.setattr(runs, "train", train)
    monkeypatch.setattr(runs, "finish", lambda run: calls.append(("finish", run.folder)))
    return SimpleNamespace(made=calls, training=train)


def test_train_makes_a_run_trains_it_and_finishes_it(trained, capsys):
    run = fmpjax.train(preset="smoke", motion="slow_walk", folder="one", minutes=2, **{"ppo.discount": 0.5})
    assert isinstance(run, fmpjax.Run) and run.folder == Path("one")
    config = run.config
    assert (config.preset, config.motion, config.ppo.discount) == ("smoke", "slow_walk", 0.5)
    (what, folder, resume, minutes), finished = trained.made
    assert (what, folder, resume) == ("train", run.folder, False) and 1.5 < minutes < 2
    assert finished == ("finish", run.folder)
    assert capsys.readouterr().out.startswith("motion slow_walk, ")


def test_train_takes_a_configuration_and_changes_and_resumes(trained):
    run = fmpjax.train(fmpjax.preset("smoke", seed=3), motion="fast_walk")
    assert (run.config.seed, run.config.motion) == (3, "fast_walk")
    assert re.fullmatch(r"runs/fmp-\d{8}-\d{6}", str(run.folder))
    trained.made.clear()
    trained.training.end = runs.End.SIGNAL
    again = fmpjax.train(folder=run.folder, resume=True)
    assert again.config == run.config
    assert trained.made == [("train", run.folder, True, None)]  # interrupted, so neither evaluated nor filmed


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"minutes": 0}, "minutes is 0: expected more than 0"),
        ({"preset": "smok"}, "unknown preset 'smok': expected one of smoke, laptop, robust, robot, paper"),
        ({"methd": "fmp"}, "unknown setting 'methd': did you mean 'method'"),
        ({"config": "smoke"}, "config is 'smoke' and preset is None: expected a Config or the name of a preset"),
        ({"config": fmpjax.preset("smoke"), "preset": "paper"}, "preset is 'paper': expected a Config or the name of"),
        (
            {"config": fmpjax.preset("smoke"), "command": "velocity"},
            "command and a Config were given",
        ),
        ({"command": "speed"}, "command is 'speed': expected one of none, velocity, phase"),
        ({"method": "fpm"}, "fpm"),
        ({"resume": True}, "resume continues a run with its own settings: expected its folder and no settings"),
        ({"resume": True, "folder": "one", "seed": 1}, "resume continues a run with its own settings"),
        ({"resume": True, "folder": "none"}, "none is not a run folder: expected config.json in it"),
    ],
)
def test_train_refuses_in_a_sentence_and_makes_nothing(trained, tmp_path, arguments, sentence):
    with pytest.raises(fmpjax.UserError, match=re.escape(sentence)):
        fmpjax.train(**arguments)
    assert not trained.made and not list(tmp_path.iterdir())


def test_the_examples_of_the_page_run(trained, monkeypatch):
    monkeypatch.setattr(runs.Run, "policy", lambda run: (run.trainer(), None))  # nothing was trained
    names = {}
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    assert len(blocks) == 4
    for block in blocks:
        exec(compile(block, "docs/api.md", "exec"), names)
    assert [call[0] for call in trained.made] == ["train", "finish"] * 2
    assert names["preference"].shape == (3,)
