"""The scripts in examples/ run, at the smallest size, and show what their docstrings say."""

import importlib.util
import json

import numpy as np
import pytest

from fmpjax import priors
from tests.helpers import ROOT, TINY


def example(name):
    """The script as a module, not run as a program."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "examples" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_score_of_the_toy_points_to_the_nearer_side_and_is_lowest_between():
    score = example("transport_score").toy()
    x = np.array([[-1.0], [-0.5], [0.0], [0.5], [1.0]])
    value, slope = np.asarray(score.score(x)), np.asarray(score.gradient(x))[:, 0]
    assert value[2] < min(value[0], value[4])
    assert slope[1] < 0 < slope[3]


@pytest.mark.slow
def test_the_score_of_windows_prefers_the_demonstration_to_itself_backward():
    scores = example("transport_score").windows()
    assert scores["slow_walk"] == 0.0 < scores["walk"]
    assert scores["walk, backward"] < scores["walk"]


@pytest.mark.slow
def test_a_policy_is_trained_filmed_exported_and_used(tmp_path, capsys):
    targets = example("train_film_export").main("smoke", tmp_path, **TINY)
    assert targets.shape == (29,) and np.isfinite(targets).all()
    said = capsys.readouterr().out
    assert {"curves.png", "evaluation.json", "frames.png", "policy.mp4"} <= set(said.split())


@pytest.mark.slow
def test_the_example_prior_trains(tmp_path, monkeypatch):
    monkeypatch.setattr(priors, "_REGISTRY", dict(priors._REGISTRY))
    fmpjax = example("own_prior").fmpjax
    run = fmpjax.train(preset="smoke", method="nearest", folder=tmp_path / "run", **TINY)
    assert run.config.method == "nearest"
    evaluation = json.loads((run.folder / "evaluation.json").read_text())
    assert evaluation["episodes"] == TINY["evaluation_episodes"]
