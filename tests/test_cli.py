"""Every bad input is one sentence on stderr and exit code 2, and leaves the disk as it was."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from fmpjax import cli, motion, robots, runs
from fmpjax.config import preset

JOINTS = robots.load("unitree_g1").joint_count
TRAIN = ("train", "--preset", "smoke")


def files(folder):
    """Everything below a folder, with its bytes."""
    return {p: p.read_bytes() if p.is_file() else None for p in sorted(Path(folder).rglob("*"))}


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Run a bad command below ``tmp_path``; the sentence that it earned."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments):
        before = files(tmp_path)
        capsys.readouterr()
        with pytest.raises(SystemExit) as exit_:
            cli.main([str(a) for a in arguments])
        assert exit_.value.code == 2
        error = capsys.readouterr().err
        assert error.startswith("fmpjax: ") and error.endswith("\n") and error.count("\n") == 1, error
        assert files(tmp_path) == before, "a refused command wrote something"
        return error

    return run


@pytest.fixture
def rows():
    """Forty good rows in Unitree's format: xyz, quaternion xyzw, joints."""
    out = np.zeros((40, 7 + JOINTS))
    out[:, 0] = np.linspace(0.0, 1.0, 40)
    out[:, 2], out[:, 6] = 0.75, 1.0
    return out


def write_csv(path, rows):
    path.write_text("\n".join(",".join(f"{v:.6f}" for v in row) for row in rows) + "\n")
    return path


@pytest.fixture
def made(tmp_path):
    """A run that was created and never trained."""
    return runs.Run.create(tmp_path / "run", preset("smoke"))


# --- names and settings ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--method", "nope"], ["unknown method 'nope'", "fmp"]),
        (["--robot", "nope"], ["unknown robot 'nope'", "unitree_g1"]),
        (["--motion", "nope"], ["unknown motion 'nope'", "walk"]),
        (["--motion", "nope.csv"], ["no motion file nope.csv"]),
        (["--reset", "nope"], ["env.reset is 'nope'", "dataset, fixed"]),
        (["--frames", "nope"], ["nope"]),
        (["--frames", "0:100000"], ["frames 0:100000 are outside the file"]),
        (["--transitions", "0"], ["transitions is 0"]),
        (["--seed", "-1"], ["seed is -1"]),
        (["--seed", str(2**40)], [f"seed is {2**40}"]),
        (["--seed", str(2**32 - 1), "--seeds", "2"], [f"seed is {2**32}"]),
        (["--minutes", "-3"], ["--minutes is -3"]),
        (["--minutes", "0"], ["--minutes is 0"]),
        (["--minutes", "nan"], ["--minutes is nan"]),
        (["--set", "nope.nope=1"], ["unknown setting 'nope.nope'"]),
        (["--set", "name=1"], ["unknown setting 'name'"]),
        (["--set", "ppo=1"], ["unknown setting 'ppo'"]),
        (["--set", "ppo.hiden=1"], ["unknown setting 'ppo.hiden'", "did you mean 'ppo.hidden'"]),
        (["--set", "ppo.hidden"], ["'ppo.hidden'", "section.field=value"]),
        (["--set", "ppo.hidden=wide"], ["ppo.hidden is 'wide'", "whole numbers of at least 1, with commas"]),
        (["--set", "env.count=many"], ["env.count is 'many'", "a whole number of at least 1"]),
        (["--set", "env.count=1.5"], ["env.count is '1.5'", "a whole number of at least 1"]),
        (["--set", "env.count=-4"], ["env.count is '-4'", "a whole number of at least 1"]),
        (["--set", "ppo.orthogonal=maybe"], ["ppo.orthogonal is 'maybe'", "true or false"]),
        (["--set", "ppo.learning_rate=nan"], ["ppo.learning_rate is 'nan'"]),
        (["--set", "ppo.actor_batch=5"], ["ppo.actor_batch is 5", "divisor"]),
        (["--resume"], ["--run"]),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) and x[0].startswith("--") else "",
)
def test_bad_setting(refused, arguments, expected):
    error = refused(*TRAIN, "--run", "run", *arguments) if arguments != ["--resume"] else refused("train", "--resume")
    for words in expected:
        assert words in error


@pytest.mark.parametrize("command", [("train", "--preset", "nope"), ("config", "nope")])
def test_unknown_preset(refused, command):
    assert "unknown preset 'nope': expected one of smoke, laptop, robust, robot, paper" in refused(*command)


def test_unknown_experiment(refused):
    assert "unknown experiment 'nope': expected one of ablate, barycenter, benchmark, curvature" in refused(
        "experiment", "nope"
    )


# --- motion files ----------------------------------------------------------------------------------------------------


def test_wrong_column_count(refused, tmp_path, rows):
    error = refused(*TRAIN, "--run", "run", "--motion", write_csv(tmp_path / "a.csv", rows[:, :-1]))
    assert "a.csv" in error and f"{6 + JOINTS} columns, expected {7 + JOINTS}" in error


def test_not_a_number_in_the_file(refused, tmp_path, rows):
    rows[7, 12] = np.nan
    error = refused(*TRAIN, "--run", "run", "--motion", write_csv(tmp_path / "a.csv", rows))
    assert "a.csv: line 8, column 13 is nan" in error


def test_words_in_the_file(refused, tmp_path, rows):
    path = write_csv(tmp_path / "a.csv", rows)
    path.write_text(path.read_text().replace("0.750000", "high", 1))
    assert "line 1, column 3 is 'high'" in refused(*TRAIN, "--run", "run", "--motion", path)


def test_zero_quaternion(refused, tmp_path, rows):
    rows[3, 3:7] = 0.0
    error = refused(*TRAIN, "--run", "run", "--motion", write_csv(tmp_path / "a.csv", rows))
    assert "line 4 has a root quaternion of length 0" in error


def test_too_few_frames(refused, tmp_path, rows):
    error = refused(*TRAIN, "--run", "run", "--motion", write_csv(tmp_path / "a.csv", rows[:5]))
    assert "5 frames at 30 Hz" in error and "at least 11" in error


def test_frame_range_outside_the_file(refused, tmp_path, rows):
    path = write_csv(tmp_path / "a.csv", rows)
    error = refused(*TRAIN, "--run", "run", "--motion", path, "--frames", "10:40")
    assert "frames 10:40 are outside the file, which has rows 0:39" in error


def test_good_file_makes_a_run(tmp_path, rows):
    path = write_csv(tmp_path / "a.csv", rows)
    run = runs.Run.create(tmp_path / "run", preset("smoke", motion=str(path), frames="5:39"))
    assert json.loads((run.folder / "config.json").read_text())["frames"] == "5:39"
    assert len(motion.load(run.folder / "demonstration.npz")) == len(motion.load(path, frames="5:39"))


# --- run folders -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", [("evaluate",), ("render",), ("diagnose",), ("train", "--resume", "--run")])
def test_missing_run(refused, command):
    assert "nowhere is not a run folder: expected config.json in it" in refused(*command, "nowhere")


@pytest.mark.parametrize("command", ["evaluate", "render"])
def test_run_without_checkpoint(refused, made, command):
    error = refused(command, made.folder)
    assert str(made.folder) in error and "has no checkpoint" in error


def test_no_episodes(refused, made):
    assert "--episodes is 0" in refused("evaluate", made.folder, "--episodes", "0")


def test_existing_run_is_not_overwritten(refused, made):
    error = refused(*TRAIN, "--run", made.folder)
    assert "holds a run already" in error and "--resume" in error


def test_unwritable_run_folder(refused, tmp_path):
    (tmp_path / "file").write_text("in the way")
    error = refused(*TRAIN, "--run", tmp_path / "file" / "run")
    assert str(tmp_path / "file" / "run") in error and "cannot be written" in error or "cannot write" in error


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--seed", "7"], "seed 0: it cannot continue with 7"),
        (["--preset", "paper"], "preset 'smoke': it cannot continue as 'paper'"),
        (["--reset", "fixed"], "env.reset 'dataset': it cannot continue with 'fixed'"),
        (["--transitions", "100"], "transitions 10240: it cannot continue with 100"),
        (["--set", "ppo.hidden=8,8"], "ppo.hidden (64, 64): it cannot continue with (8, 8)"),
        (["--set", "nope=1"], "unknown setting 'nope'"),
    ],
)
def test_resume_with_another_option(refused, made, arguments, expected):
    assert expected in refused("train", "--resume", "--run", made.folder, *arguments)


def test_configuration_that_is_not_json(refused, made):
    (made.folder / "config.json").write_text('{"seed": ')
    assert "config.json is not valid JSON" in refused("evaluate", made.folder)
    (made.folder / "config.json").write_text('{"env.count": Infinity}')
    assert "setting env.count is inf: expected a whole number" in refused("evaluate", made.folder)


def test_provenance_that_is_not_json(refused, made):
    for text in ('{"command": ', "[]"):
        (made.folder / "provenance.json").write_text(text)
        assert "provenance.json cannot be read: expected" in refused("export", made.folder, "out")


def test_a_run_is_not_exported_into_itself(refused, made):
    assert "is the run itself: expected another folder" in refused("export", made.folder, made.folder)


@pytest.mark.parametrize("seconds", ["0", "nan", "inf"])
def test_length_of_a_video(refused, made, seconds):
    assert f"--seconds is {seconds}: expected a number above 0" in refused("render", made.folder, "--seconds", seconds)


def test_seeds_of_a_group(refused, tmp_path):
    runs.Run.create(tmp_path / "group" / "seed0", preset("smoke"))
    (tmp_path / "group" / "seed0.log").write_text("of another program")
    resume = ("train", "--resume", "--run", "group")
    assert "setting seed is 'abc': expected a whole number" in refused(*resume, "--set", "seed=abc")
    assert "has 1 seeds: it cannot continue with 2" in refused(*resume, "--seeds", "2")


def test_a_clip_may_have_any_name_and_go(tmp_path, rows, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a,b.csv", "take:2.csv"):
        path = write_csv(tmp_path / name, np.repeat(rows, 2, axis=0))
        run = runs.Run.create(tmp_path / f"run of {name}", preset("smoke", motion=name))
        path.unlink()
        assert runs.Run.open(run.folder).trainer().clip.name == path.stem


# --- the real thing --------------------------------------------------------------------------------------------------


def test_every_setting_is_shown(capsys):
    cli.main(["config", "smoke"])
    shown = dict(line.split(" = ", 1) for line in capsys.readouterr().out.splitlines())
    assert shown["preset"] == "smoke" and shown["ppo.hidden"] == "(64, 64)" and shown["prior.bank"] == "64"


def test_process_says_one_sentence(tmp_path):
    """In a process of its own nothing that the imports say gets between the user and the sentence."""
    command = [sys.executable, "-m", "fmpjax.cli", "train", "--preset", "smoke", "--method", "nope", "--run", "run"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.startswith("fmpjax: unknown method 'nope'") and done.stderr.count("\n") == 1, done.stderr
    assert done.stdout == "", done.stdout
    assert not list(tmp_path.iterdir())


def test_a_device_that_is_not_there(tmp_path):
    """JAX finds its devices once in a process: hence one of its own."""
    command = [sys.executable, "-m", "fmpjax.cli", *TRAIN, "--run", str(tmp_path / "run")]
    done = subprocess.run(
        command, env=os.environ | {"JAX_PLATFORMS": "cuda"}, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("fmpjax: JAX_PLATFORMS is 'cuda', but JAX finds no such device")
    assert not (tmp_path / "run").exists()


def test_figures_and_their_picture_are_written_side_by_side(tmp_path, capsys):
    found, run = SimpleNamespace(to_json=lambda: "{}"), SimpleNamespace(folder=tmp_path)

    def draw(path, *drawn):
        path.write_text(f"{drawn}")
        return path

    cli.Evaluate(tmp_path, last=True)._save(run, "steering", found, draw, "a", 1)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "steering-last.json": "{}\n",
        "steering-last.png": "('a', 1)",
    }
    printed = capsys.readouterr().out
    assert printed == f"wrote {tmp_path}/steering-last.json\nwrote {tmp_path}/steering-last.png\n"
