"""What the command lines show, and how they end."""

import importlib
import os
import pkgutil
import re
import subprocess
import sys

import pytest

import fmpjax
from fmpjax import cli, config, experiments, motion, priors, robots
from fmpjax.experiments.common import results


def _experiments():
    for found in pkgutil.iter_modules(experiments.__path__):
        module = importlib.import_module(f"fmpjax.experiments.{found.name}")
        if hasattr(module, "main") or hasattr(module, "COMMANDS"):
            yield found.name, module


PROGRAMS = {"fmpjax": cli.main} | {
    name: lambda arguments, module=module: results.entry(getattr(module, "COMMANDS", None) or module.main, arguments)
    for name, module in _experiments()
}


@pytest.fixture
def shown(capsys, monkeypatch):
    """A function from a program and arguments that end it to what it printed."""
    monkeypatch.setenv("COLUMNS", "100")

    def run(program, *arguments):
        with pytest.raises(SystemExit) as exit_:
            PROGRAMS[program](list(arguments))
        assert exit_.value.code == 0
        return capsys.readouterr().out

    return run


def _process(*arguments, **options):
    environment = os.environ | options.pop("env", {})
    return subprocess.Popen([sys.executable, *arguments], env=environment, text=True, **options)


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_command_has_a_sentence_and_no_default_is_none(shown, program):
    sentences, paths = {}, [()]
    while paths:
        path = paths.pop()
        text = shown(program, *path, "--help")
        usage, sentence, tables = text.split("\n\n", 2)
        sentences[path] = sentence
        assert re.fullmatch(r"[A-Z`].*\.", sentence, re.DOTALL), (path, sentence)
        assert "None" not in text, (path, text)
        commands = re.search(r"\{([a-z0-9_,-]+)\}\s*$", usage)
        for name in commands[1].split(",") if commands else ():
            paths.append((*path, name))
            assert re.search(rf"^\W+{name} +[A-Z]", tables, re.MULTILINE), (path, name, tables)
    assert len(set(sentences.values())) == len(sentences)
    assert "Union" not in "".join(sentences.values())
    if program == "fmpjax":
        assert ("motion", "check") in sentences and len(sentences) > 14


def test_every_study_is_listed_by_the_sentence_of_its_own_help(shown):
    assert list(experiments.STUDIES) == [name for name, _ in _experiments()]
    listed = " ".join(re.sub("[│\n]", " ", shown("fmpjax", "experiment", "--help")).split())
    for name, sentence in experiments.STUDIES.items():
        assert f" {name} {sentence}" in listed
        usage, own, _ = shown("fmpjax", "experiment", name, "--help").split("\n\n", 2)
        assert usage.startswith(f"usage: fmpjax experiment {name} ")
        assert " ".join(own.split()) == sentence


def test_the_list_of_studies_imports_none_of_them():
    """In a process of its own: here they are imported."""
    looked = "from fmpjax import cli\ntry: cli.main(['experiment', '--help'])\nexcept SystemExit: pass\nimport sys\n"
    looked += "print([name for name in sys.modules if name.startswith('fmpjax.experiments.')])"
    assert _process("-c", looked, stdout=subprocess.PIPE).communicate(timeout=120)[0].endswith("\n[]\n")


def test_help_names_the_defaults_of_training(shown):
    text = " ".join(re.sub("[│\n]", " ", shown("fmpjax", "train", "--help")).split())
    text = re.sub(r"(\d,) (\d{3})", r"\1\2", text)  # a line may end within a number
    for option, value in {
        "method STR": "fmp", "motion STR": "walk in smoke, laptop, robust and paper, gaits in robot",
        "robot STR": "unitree_g1 in smoke, laptop, robust and robot, unitree_g1_29dof in paper",
        "reset STR": "dataset", "seed INT": "0",
        "preset STR": "laptop on a CPU, paper on an accelerator",
        "transitions INT": "10,240 in smoke, 6,000,000 in laptop, 16,000,000 in robust and robot, 50,003,968 in paper",
    }.items():  # fmt: skip
        assert re.search(rf"--{option} [^(]*(\([^d][^(]*)*\(default: {value}\)", text), option


def test_none_is_no_value(capsys):
    with pytest.raises(SystemExit) as exit_:
        cli.main(["train", "--seed", "None"])
    assert exit_.value.code == 2
    assert "--seed" in capsys.readouterr().err


def test_version(capsys):
    cli.main(["--version"])
    assert capsys.readouterr().out == f"fmpjax {fmpjax.__version__}\n"


def test_the_package_is_the_command(capfd):
    assert _process("-m", "fmpjax", "--version").wait(timeout=120) == 0
    assert capfd.readouterr().out == f"fmpjax {fmpjax.__version__}\n"


def test_list_describes_everything(capsys):
    cli.main(["list"])
    groups, title = {}, None
    for line in capsys.readouterr().out.splitlines():
        assert len(line) <= 120
        if not line.startswith(" "):
            title = line.rstrip(":")
            continue
        name, _, text = line.strip().partition("  ")
        groups.setdefault(title, {})[name] = text.strip()
    expected = {
        "methods": priors.METHODS,
        "presets": config.PRESETS,
        "robots": robots.available(),
        "motions": [*motion.bundled(), *motion.folders()],
    }
    assert {title: list(found) for title, found in groups.items()} == {k: list(names) for k, names in expected.items()}
    texts = [text for found in groups.values() for text in found.values()]
    assert all(len(text) > 10 for text in texts) and len(set(texts)) == len(texts)
    assert "unitree_g1, 0.86 m/s" in groups["motions"]["walk"]
    assert "turning left at 0.50 rad/s" in groups["motions"]["turn_left"]


def test_a_robot_without_a_description_is_described_by_its_figures(tmp_path, monkeypatch):
    folder = tmp_path / "strider"
    folder.mkdir()
    own = robots.resources.folder("robots") / "strider"
    (folder / "robot.xml").write_text((own / "robot.xml").read_text())
    (folder / "robot.toml").write_text(re.sub("^description.*\n", "", (own / "robot.toml").read_text(), flags=re.M))
    assert re.fullmatch(r"12 joints, \d+ kg", robots._read("strider", folder / "robot.xml").description)


def test_a_reader_that_has_gone_ends_a_command_in_silence():
    """A pipe that nobody reads: help, a command's own output, an experiment, a sentence on a closed stderr."""
    read, write = os.pipe()
    os.close(read)
    try:
        quiet = {"stdout": write, "stderr": subprocess.PIPE}
        started = [
            _process("-m", "fmpjax.cli", "--help", **quiet),
            _process("-m", "fmpjax.cli", "config", **quiet),
            _process("-m", "fmpjax.cli", "motion", "check", "walk", **quiet),
            _process("-m", "fmpjax.experiments.curvature", "--help", **quiet),
        ]
        deaf = _process("-m", "fmpjax.cli", "config", "nope", stdout=write, stderr=write)
        for process in started:
            assert process.communicate(timeout=120)[1] == "", process.args
            assert process.returncode == 1
        assert deaf.wait(timeout=120) == 1
    finally:
        os.close(write)


def test_a_broken_pipe_that_is_not_the_output_is_shown():
    """A child process that dies, for example, must not end a command in silence."""
    broken = "from fmpjax import shell\nwith shell.ending(): raise BrokenPipeError('of a child')"
    process = _process("-c", broken, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.communicate(timeout=120)[1].endswith("BrokenPipeError: of a child\n")
    assert process.returncode == 1


@pytest.mark.parametrize("program", ["fmpjax", "curvature"])
def test_windows_is_refused_in_one_sentence(capsys, monkeypatch, program):
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(SystemExit) as exit_:
        PROGRAMS[program](["--help"])
    assert exit_.value.code == 2
    printed = capsys.readouterr()
    assert printed.err == ("fmpjax: Windows is not supported: use Linux, macOS or WSL (Windows Subsystem for Linux)\n")
    assert printed.out == ""
