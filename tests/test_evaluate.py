"""Evaluations from perturbed starts, on a physics of a line: who starts too far off its pose lies down at once."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from fmpjax import evaluate, jsons, motion
from fmpjax.config import preset
from fmpjax.errors import UserError
from fmpjax.evaluate import Episodes, Evaluator, Start
from fmpjax.trainer import Trainer

SMALL = {"env.episode_steps": 60, "env.last_cap": 60, "ppo.hidden": (8,), "prior.hidden": (8,)}


class Careful:
    """Nothing moves, but a robot whose first joint is more than ``limit`` rad off lies on the floor."""

    name = "careful"

    def __init__(self, pose, limit):
        self.pose, self.limit = pose, limit

    def step(self, state, targets):
        off = abs(state.qpos[:, 7] - self.pose) > self.limit
        return state._replace(qpos=state.qpos.at[:, 2].multiply(1.0 - off))


def trainer_of(limit=5e-3, **changes):
    config = preset("smoke", **SMALL | changes)
    trainer = Trainer(config, motion.load("walk", rate=config.control_rate))
    trainer.env.physics = Careful(trainer.robot.default_qpos[7].astype(np.float32), limit)
    return trainer


@pytest.fixture(scope="module")
def fixed():
    return trainer_of(**{"env.reset": "fixed"})


@pytest.fixture(scope="module")
def evaluator(fixed):
    return Evaluator(fixed, 40)


def test_falls_from_the_fixed_pose_at_every_size_of_noise(fixed, evaluator):
    """The first joint is off by 0, by up to some 3e-3 and by up to 3e-2 rad; beyond 5e-3 is a fall."""
    programs = Evaluator._play._cache_size()
    played = evaluator.play(fixed.init().ppo)
    none, few, many = played.starts
    assert none == Start(0.0, 1, 0) and few == Start(1e-3, 40, 0)
    assert (many.noise, many.episodes) == (1e-2, 14) and 0 < many.falls < 14
    # The headline's episodes are those at 1e-3 rad.
    assert played.qpos.shape[:2] == (60, 40) and played.length.shape == (40,)
    np.testing.assert_allclose(played.start_qpos, evaluator.start().physics.qpos[:40], atol=1e-7)
    result = evaluator.measure(played)
    assert (result.noise, result.episodes, result.falls, result.starts) == (1e-3, 40, 0, played.starts)
    # Nothing moves, so the policy asks for one pose; the starts' velocities stay, at which its servos work.
    asked = fixed.env.actions(np.float32(0.0))
    assert played.targets.shape == (60, 40, len(asked)) and not np.ptp(played.targets, axis=0).any()
    np.testing.assert_allclose(played.targets[0], np.tile(asked, (40, 1)), atol=0.2)
    assert (result.action_rate, result.joint_jerk) == (0.0, 0.0) and 0.0 < result.power < 2.0
    shown = evaluate.table(result)
    assert "0 of 40  joint noise of 0.001 rad at the start" in shown and f"{many.falls} of 14" in shown
    # Columns are named before anything is played.
    assert set(result.as_dict()) == set(evaluate.names(fixed.config))
    assert {"falls_at_0", "episodes_at_0.001", "falls_at_0.01"} <= set(result.as_dict())
    # Of many motions the table names those with the most falls.
    shares = tuple(evaluate.Share(f"clip{i}", 2, i % 2, 1.0, 2, 1.0) for i in range(30))
    shown = evaluate.table(dataclasses.replace(result, motions=shares))
    assert shown.count("from clip") == evaluate.LISTED and "from clip0 " not in shown and "from clip1 " in shown
    assert "and 18 more motions" in shown
    found = strict(result.to_json())
    assert found["starts"][1] == {"noise": 0.001, "episodes": 40, "falls": 0} and found["noise"] == 0.001
    # Another policy starts from the same states, in the same program.
    assert evaluator.play(fixed.init(1).ppo).starts == played.starts
    assert Evaluator._play._cache_size() == programs + 1


def test_starts_are_as_far_off_as_the_noise_says(fixed, evaluator):
    state = evaluator.start()
    off = np.asarray(state.physics.qpos - fixed.robot.default_qpos.astype(np.float32))
    fast = np.asarray(state.physics.qvel)
    assert not off[:, :7].any() and not fast[:, :6].any()
    for part, noise in ((slice(0, 40), 1e-3), (slice(41, 55), 1e-2)):
        assert off[part, 7:].std() == pytest.approx(noise, rel=0.15)
        assert fast[part, 6:].std() == pytest.approx(10 * noise, rel=0.15)
    assert not off[40].any() and not fast[40].any()
    # Every evaluation starts from the same states.
    np.testing.assert_array_equal(Evaluator(fixed, 40).start().physics.qpos, state.physics.qpos)


def test_demonstration_states_are_the_headline_as_they_are():
    trainer = trainer_of()
    evaluator = Evaluator(trainer, 7)
    qpos = np.asarray(evaluator.start().physics.qpos)
    rows = evaluator.rows[:7]
    np.testing.assert_array_equal(qpos[:7], trainer.clip.qpos[rows].astype(np.float32))
    assert evaluator.noise == 0.0 and len(set(rows)) > 3
    # The other sizes start from the first of the same moments.
    np.testing.assert_array_equal(evaluator.rows[7:], [*rows[:3], *rows[:3]])
    assert (qpos[7:] != trainer.clip.qpos[evaluator.rows[7:]].astype(np.float32))[:, 7:].all()


def test_obedience_is_the_mean_reward_of_the_command_before_a_fall():
    """Nothing moves, so each episode's error stays what it is at the start; who is off its pose falls in one step."""
    trainer = trainer_of(**{"command.kind": "velocity", "evaluation_noise": (0.0,)})
    evaluator, state = Evaluator(trainer, 5), trainer.init().ppo
    start, expected = evaluator.start(), []
    off = np.abs(np.asarray(start.physics.qpos)[:, 7] - trainer.env.physics.pose)
    trainer.env.physics.limit = float(np.median(off))
    told = start.command
    for _ in range(60):
        told, _, earned = trainer.env.command.advance(told, None, start.observed.frame)
        expected.append(np.asarray(earned))
    played = evaluator.play(state)
    up = ~played.fell
    assert 0 < up.sum() < 5 and (played.length[up] == 60).all() and (played.length[~up] == 1).all()
    np.testing.assert_allclose(played.obedience[up], np.mean(expected, axis=0)[up], rtol=1e-5)
    np.testing.assert_allclose(played.obedience[~up], expected[0][~up], rtol=1e-5)
    found = evaluator.measure(played)
    assert found.obedience == pytest.approx(played.obedience.mean())
    # A command says the pace itself, so the demonstration's does not count.
    assert found.score == pytest.approx(up.mean() * found.obedience)
    assert set(found.as_dict()) == set(evaluate.names(trainer.config)) >= {"obedience", "score"}
    assert "obedience" in evaluate.table(found)


@pytest.mark.parametrize(
    ("reset", "noise", "expected"),
    [
        ("dataset", (0.0, 1e-3, 1e-2), {0.0: 256, 1e-3: 86, 1e-2: 86}),
        ("fixed", (0.0, 1e-3, 1e-2), {1e-3: 256, 0.0: 1, 1e-2: 86}),
        ("fixed", (1e-2, 0.0, 1e-3), {1e-3: 256, 0.0: 1, 1e-2: 86}),
        ("fixed", (0.0,), {0.0: 1}),
        ("dataset", (1e-2,), {1e-2: 256}),
    ],
)
def test_episodes_at_each_size(reset, noise, expected):
    config = preset("laptop", **{"env.reset": reset, "evaluation_noise": noise})
    assert list(evaluate.episodes_of(config, 256).items())[0] == next(iter(expected.items()))
    assert evaluate.episodes_of(config, 256) == expected
    # No more than twice what one size costs.
    assert sum(expected.values()) <= 2 * 256


@pytest.mark.parametrize(
    ("noise", "expected"),
    [
        ("", "one or more numbers of at least 0"),
        ("0,-0.1", "one or more numbers of at least 0"),
        ("0,0.001,0.001", "each size once"),
    ],
)
def test_bad_sizes_of_noise(noise, expected):
    with pytest.raises(UserError, match=f"setting evaluation_noise is .*: expected {expected}"):
        preset("smoke", evaluation_noise=noise)


@pytest.mark.parametrize("key", ["evaluation_noise", "ppo.fall_value", "features.clip"])
def test_settings_are_finite(key):
    with pytest.raises(UserError, match=f"setting {key} is 'inf': expected"):
        preset("smoke", **{key: "inf"})


def strict(text):
    """What a reader of JSON that knows no NaN makes of it."""

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_a_policy_that_falls_at_once_gives_strict_json(fixed, evaluator):
    played = walking(fixed, np.zeros(4), steps=60)
    played = played._replace(length=np.ones(4, int), fell=np.ones(4, bool))
    result = evaluator.measure(played)
    assert result.falls == 4 and result.mean_length == 1.0
    found = strict(result.to_json())
    assert found["late_speed"] is None and found["joint_ranges"] == [None] * 6 and found["discrepancy"] > 0


def test_json_has_neither_nan_nor_infinity():
    nan, inf = float("nan"), float("inf")
    text = jsons.dumps({"a": nan, "b": [1.5, (inf, {"c": -inf, "d": np.float64("nan")})], "e": "NaN"})
    assert strict(text) == {"a": None, "b": [1.5, [None, {"c": None, "d": None}]], "e": "NaN"}


# --- figures ---------------------------------------------------------------------------------------------------------


def walking(trainer, speed, steps=300):
    """Episodes that carry the default pose forward, each at its speed (m/s)."""
    robot, count = trainer.robot, len(speed)
    start = np.tile(robot.default_qpos.astype(np.float32), (count, 1))
    qpos = np.tile(start, (steps, 1, 1))
    qpos[..., 0] += np.arange(1, steps + 1)[:, None] / 50.0 * speed
    qvel = np.zeros((steps, count, 6 + robot.joint_count), np.float32)
    frame = trainer.env._table.frame[-1]
    history = np.tile(frame, (count, trainer.env.horizon, 1))
    nobody = np.zeros(count, bool)
    return Episodes(qpos, qvel, np.full(count, steps), nobody, start, history, np.zeros(count, int))


def test_late_speed_is_of_the_detailed_episodes(fixed, evaluator):
    """64 at 0.5 m/s, 36 further ones at 3 m/s, which do not count."""
    result = evaluator.measure(walking(fixed, np.repeat([0.5, 3.0], [64, 36])))
    assert result.late_n == 64 and result.late_speed == pytest.approx(0.5, abs=1e-4)
    assert result.path_speed == pytest.approx(0.5, abs=1e-4) and result.pace == result.late_speed
    assert result.late_deviation == pytest.approx(0, abs=1e-4)
    assert result.episodes == 100 and result.displacement == pytest.approx((64 * 0.5 + 36 * 3.0) / 100 * 6.0, rel=1e-3)


def test_in_heading_axes_the_pace_is_along_the_own_heading(fixed, evaluator, monkeypatch):
    """Pushed aside for good: from the first step on it faces and walks to the left."""
    played = walking(fixed, np.full(3, 0.5))
    played.qpos[..., 1], played.qpos[..., 0] = played.qpos[..., 0].copy(), played.qpos[..., 1].copy()
    played.qpos[..., 3:7] = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    assert evaluator.measure(played).pace == pytest.approx(0.0, abs=1e-4)
    features = dataclasses.replace(fixed.config.features, axes="heading")
    monkeypatch.setattr(fixed, "config", dataclasses.replace(fixed.config, features=features))
    found = evaluator.measure(played)
    assert found.pace == pytest.approx(0.5, abs=1e-4) and found.late_speed == pytest.approx(0.0, abs=1e-4)


def test_work_is_of_the_detailed_episodes_and_undefined_without_their_targets(fixed, evaluator):
    """Targets 0.2 rad off the pose while one joint turns at 1 rad/s, in 64 episodes of 65."""
    played = walking(fixed, np.zeros(65))
    played.qvel[:, :64, 6], played.qvel[:, 64, 6] = 1.0, 50.0
    lacking = evaluator.measure(played)
    assert lacking.joint_jerk == 0.0 and np.isnan([lacking.action_rate, lacking.power]).all()
    robot = fixed.robot
    result = evaluator.measure(played._replace(targets=played.qpos[:, :64, 7:] + 0.2))
    torque = np.clip(0.2 * robot.stiffness[0] - robot.damping[0], -robot.effort[0], robot.effort[0])
    assert result.power == pytest.approx(abs(torque), rel=1e-4) and result.action_rate == pytest.approx(0, abs=1e-4)


def test_discrepancy_is_in_the_papers_features_whatever_the_runs_are(fixed, evaluator):
    """A run of other floors and axes and one of the paper's have one figure."""
    paper = {"features.deviation_floor": 1e-4, "features.angular_velocity_floor": 1e-4}
    other = {"features.axes": "heading", "features.deviation_floor": 0.5}
    played, first = walking(fixed, np.full(3, 0.5)), slice(0, 3)
    found = evaluator._discrepancy(played, first)
    changed = trainer_of(**{"env.reset": "fixed"} | other)
    assert Evaluator(changed, 3)._discrepancy(played, first) == found > 0
    windows = fixed.env.clip_windows()[:5]
    np.testing.assert_array_equal(evaluator._feature_map(windows), trainer_of(**paper).feature_map(windows))
    assert np.any(evaluator._feature_map(windows) != fixed.feature_map(windows))


def test_a_demonstration_share_says_how_many_speeds_are_behind_it(fixed):
    clips = [SimpleNamespace(name=name) for name in ("one", "two")]
    other = SimpleNamespace(trainer=SimpleNamespace(library=SimpleNamespace(clips=clips), config=preset("smoke")))
    played = walking(fixed, np.zeros(70))._replace(clip=np.repeat([0, 1], [60, 10]), fell=np.arange(70) >= 68)
    shares = Evaluator._shares(other, played, np.repeat([0.5, 0.75], [60, 4]), [0.8, 0.9])
    assert [tuple(share) for share in shares] == [("one", 60, 0, 0.5, 60, 0.8), ("two", 10, 2, 0.75, 4, 0.9)]
