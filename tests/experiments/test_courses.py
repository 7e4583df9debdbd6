"""How the benchmark's cells learned, from tables whose means are known."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from fmpjax.experiments.common import courses
from fmpjax.logs import MetricsLog


def cell(folder, method="fmp", seed=0, margins=(1.0, 3.0, 5.0, 9.0), **columns):
    """Four rows of metrics; the second and the fourth are evaluated."""
    name = f"{method}-dataset-walk/seed{seed}"
    (folder / name).mkdir(parents=True)
    names = ["fit/expert_margin", *(f"fit/{key}" for key in columns)]
    names += ["train/falls", "eval/quality", "eval/falls", "eval/episodes"]
    log = MetricsLog(folder / name, names)
    for i, margin in enumerate(margins):
        figures = {"fit/expert_margin": margin, "train/falls": math.nan if i == 0 else 0.1 * i}
        figures |= {f"fit/{key}": values[i] for key, values in columns.items()}
        if i % 2:
            figures |= {"eval/quality": 0.2 * i, "eval/falls": 64.0, "eval/episodes": 256.0}
        log.write(i + 1, 1000 * (i + 1), 10.0 * (i + 1), figures)
    log.close()
    config = SimpleNamespace(method=method, seed=seed, env=SimpleNamespace(reset="dataset"))
    return SimpleNamespace(name=name, variant="walk", config=config)


def test_a_course_has_means_since_the_evaluation_before(tmp_path):
    first, last = courses.course(cell(tmp_path, agent_accuracy=(0.5, 0.6, 0.9, 1.0)), tmp_path)
    assert (first["method"], first["reset"], first["motion"], first["seed"]) == ("fmp", "dataset", "walk", 0)
    assert (first["transitions"], last["transitions"], last["seconds"]) == (2000, 4000, 40.0)
    assert (first["quality"], last["quality"], first["falls"]) == (0.2, pytest.approx(0.6), 25.0)
    assert (first["expert_margin"], last["expert_margin"]) == (2.0, 7.0)
    assert (first["agent_accuracy"], last["agent_accuracy"]) == (pytest.approx(0.55), pytest.approx(0.95))
    # Of a rollout in which no episode ended nothing is known, and a method without a discriminator has no accuracy.
    assert (first["training_falls"], last["training_falls"]) == (pytest.approx(0.1), pytest.approx(0.25))
    assert math.isnan(first["discriminator_loss"]) and math.isnan(first["training_reward"])


def test_courses_are_drawn_for_methods_that_have_different_figures(tmp_path, monkeypatch):
    """A curve for each figure of each cell and one for their mean; none for what a method does not have."""
    planned = [cell(tmp_path, seed=seed) for seed in (0, 1)]
    planned += [cell(tmp_path, "amp", seed, agent_accuracy=(0.5, 0.6, 0.9, 1.0)) for seed in (0, 1)]
    planned.append(cell(tmp_path, "pwil", margins=(math.nan,) * 4))
    rows = [row for each in planned for row in courses.course(each, tmp_path)]
    drawn = []
    with monkeypatch.context() as patch:
        patch.setattr(courses.Figure, "savefig", lambda figure, path: drawn.append(figure))
        courses.draw(rows, tmp_path / "courses.png")
    curves = [len(panel.lines) for panel in drawn[0].axes]
    assert curves == [6, 9, 4, 3, 3, 0]  # quality and falls, of amp also the accuracy; the margin
    (mean,) = (line for line in drawn[0].axes[1].lines if line.get_linewidth() > 1 and line.get_color() == "C0")
    np.testing.assert_allclose(mean.get_xydata(), [[0.002, 0.2], [0.004, 0.6]])
    assert courses.draw(rows, tmp_path / "courses.png").stat().st_size > 5_000
