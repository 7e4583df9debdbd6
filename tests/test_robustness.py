"""The evaluation under disturbances: its cases, its intervals, what it plays, and the command."""

import json

import numpy as np
import pytest

from fmpjax import cli, robustness, runs
from fmpjax.config import Config, DisturbanceConfig, preset
from fmpjax.errors import UserError
from fmpjax.trainer import Trainer
from fmpjax.viz import bars
from tests.helpers import tiny


def test_intervals_are_wilsons():
    # By Wilson's formula, computed by hand for 10 of 100 with z = 1.96.
    np.testing.assert_allclose(robustness.wilson(10, 100), (0.0552, 0.1744), atol=1e-4)
    low, high = robustness.wilson(0, 256)
    assert low == 0 and high == pytest.approx(1.959964**2 / (256 + 1.959964**2))
    assert robustness.wilson(256, 256)[1] == 1.0


def test_each_disturbance_is_alone_at_three_sizes_and_all_are_together():
    found = robustness.cases(preset("laptop"))
    names = [case.disturbance for case in found]
    assert names[0] == "none" and found[0].config == DisturbanceConfig() and names[-2:] == ["together"] * 2
    alone = set(names) - {"none", "together"}
    assert all(names.count(name) == 3 for name in alone) and len(alone) == 14
    delays = [case for case in found if case.disturbance == "delay"]
    assert [case.size for case in delays] == ["10 ms", "20 ms", "40 ms"]
    assert [case.config.delay for case in delays] == [(1, 1), (2, 2), (4, 4)]
    for case in found:
        case.config.check()
    # The paper's physics has four physics steps of 5 ms per control step.
    paper = [case.size for case in robustness.cases(Config()) if case.disturbance == "delay"]
    assert paper == ["10 ms", "20 ms", "40 ms"]
    assert robustness.cases(preset("laptop"))[-2].config == robustness.MJLAB


def test_a_picture_of_the_cells(tmp_path):
    cell = robustness.Cell("push", "1 m/s", 4, 1, 0.05, 0.7, 3.0, 0.8, 3, 1.0, 3)
    none = cell._replace(disturbance="none", size="", falls=0, low=0.0, speed=float("nan"))
    found = robustness.Robustness((none, cell), 10.0, 0.8)
    groups = robustness.bars(found)
    assert groups == [("none", [("", 0.0, 0.0, 0.7)]), ("push", [("1 m/s", 0.25, 0.05, 0.7)])]
    assert bars.draw(tmp_path / "robustness.png", groups, "a run").stat().st_size > 5000
    assert json.loads(found.to_json())["cells"][0]["speed"] is None
    text = robustness.table(found.cells)
    assert "1 of 4" in text and "undefined" in text and "5.0-70.0 %" in text


@pytest.mark.slow
@pytest.mark.parametrize("name", ["laptop", "robot"])
def test_any_policy_is_played_under_any_disturbance(walk, name):
    changes = {} if name == "laptop" else {"env.observation": "deployable", "command.kind": "velocity"}
    trainer = Trainer(tiny(**changes), walk)
    player, uneven = robustness.Player(trainer, 6), robustness.Player(trainer, 6, uneven=True)
    state, programs = trainer.init(0).ppo, robustness.Player._second._cache_size()
    calm = player.play(state, DisturbanceConfig())
    steps = trainer.config.env.episode_steps
    assert calm.qpos.shape == (steps, 6, 7 + trainer.robot.joint_count)
    assert (calm.length <= steps).all() and ((calm.length == steps) | calm.fell).all()
    assert calm.pushes.shape == (steps, 6, 6) and not calm.pushes.any()
    again = player.play(state, DisturbanceConfig())
    for a, b in zip(calm, again, strict=True):
        np.testing.assert_array_equal(a, b)
    for case in robustness.cases(trainer.config)[1::3]:
        played = (uneven if case.config.step_height else player).play(state, case.config)
        # Torques of a policy that has learned nothing may stay below any limit.
        assert case.disturbance == "motor strength" or np.abs(played.qpos - calm.qpos).max() > 1e-6, case
        if case.size == "0.25 m/s":
            sizes = np.linalg.norm(played.pushes, axis=-1)
            np.testing.assert_allclose(sizes[sizes > 0], 0.25, rtol=1e-5)
            # A push every two seconds, the first one at any time of the first two, none after the end.
            limit = np.ceil((played.length / trainer.config.control_rate + robustness.EVERY) / robustness.EVERY)
            assert ((sizes > 0).sum(axis=0) <= limit).all() and sizes.any()
            assert all(not sizes[end:, i].any() for i, end in enumerate(played.length))
    assert robustness.Player._second._cache_size() == programs + 2, "a program serves all cases of a kind of ground"


@pytest.mark.slow
def test_the_command_writes_figures_and_a_picture(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(robustness, "cases", lambda config: robustness_cases(config)[:2])
    run = runs.Run.create(tmp_path / "run", tiny())
    runs.train(run)
    cli.main(["render", str(run.folder), "--push", "0.5", "--seconds", "0.3"])
    assert "pushed." in capsys.readouterr().out and list(run.folder.glob("pushed.*"))[0].stat().st_size > 1000
    with pytest.raises(SystemExit):
        cli.main(["render", str(run.folder), "--push", "-1"])
    assert "--push is -1: expected a speed above 0" in capsys.readouterr().err
    cli.main(["evaluate", str(run.folder), "--robust", "--episodes", "4"])
    figures = json.loads((run.folder / "robustness.json").read_text())
    assert [cell["disturbance"] for cell in figures["cells"]] == ["none", "push"]
    assert (run.folder / "robustness.png").exists() and "0.25 m/s" in capsys.readouterr().out


robustness_cases = robustness.cases


def test_disturbances_are_chosen_by_name():
    config = preset("laptop")
    found = robustness.chosen(config, ("together", "push"))
    assert [case.disturbance for case in found] == ["push"] * 3 + ["together"] * 2
    assert robustness.chosen(config, ()) == robustness.cases(config)
    with pytest.raises(UserError, match="unknown disturbance 'wind': expected some of 'none', 'push', 'push, turning'"):
        robustness.chosen(config, ("wind",))


def test_ground_that_cannot_be_uneven_leaves_its_cases_out_unless_they_are_named(walk, monkeypatch):
    trainer, lines = Trainer(tiny(), walk), []

    def refuse(trainer, episodes, uneven):
        assert uneven, "no case on level ground is wanted"
        raise UserError("no plane")

    monkeypatch.setattr(robustness, "Player", refuse)
    monkeypatch.setattr(robustness, "cases", lambda config: [c for c in robustness_cases(config) if c[0] == "steps"])
    found = robustness.measure(trainer, trainer.shapes().ppo, episodes=2, note=lines.append)
    assert found.cells == () and lines == ["  without steps: no plane"]
    with pytest.raises(UserError, match="no plane"):
        robustness.measure(trainer, trainer.shapes().ppo, episodes=2, disturbances=["steps"])


def test_disturbances_without_their_evaluation_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        cli.main(["evaluate", str(tmp_path), "--disturbances", "push"])
    assert "--disturbances goes with --robust" in capsys.readouterr().err


def test_two_evaluations_at_once_are_refused(tmp_path, capsys):
    with pytest.raises(SystemExit):
        cli.main(["evaluate", str(tmp_path), "--robust", "--commands"])
    assert "--commands and --robust are two evaluations: expected one of them" in capsys.readouterr().err
