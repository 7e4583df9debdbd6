"""What a policy is told: what is drawn and held, what the networks see, what a step earns, what a run does with it."""

import dataclasses
import json
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import cli, commands, config, features, motion, physics, rotations, runs, steering
from fmpjax.commands import phase, velocity, which
from fmpjax.config import CommandConfig, preset
from fmpjax.env import Env
from fmpjax.errors import UserError
from fmpjax.frames import FrameLayout
from fmpjax.motion import MotionClip, MotionLibrary, gait, library
from fmpjax.sim2sim.observation import TERMS
from fmpjax.trainer import Trainer
from tests.helpers import TINY, settings

RATE = 50.0


def course(robot, speed, turn, seconds=4.0, sideways=0.0):
    """A clip whose root moves at a velocity in its own heading."""
    steps = int(seconds * RATE)
    yaw = turn * np.arange(steps) / RATE
    step = np.stack([speed * np.cos(yaw) - sideways * np.sin(yaw), speed * np.sin(yaw) + sideways * np.cos(yaw)], 1)
    qpos = np.tile(robot.default_qpos, (steps, 1))
    qpos[:, :2] = np.cumsum(step, axis=0) / RATE
    qpos[:, 3:7] = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], axis=1)
    return MotionClip.from_qpos("course", robot.name, RATE, qpos)


@pytest.fixture(scope="module")
def slow_and_left(robot):
    """Two velocities: straight ahead at 0.4 m/s and to the left at 1.0 m/s and 0.5 rad/s."""
    return MotionLibrary((course(robot, 0.4, 0.0), course(robot, 1.0, 0.5)), (0.5, 0.5))


# --- velocities ------------------------------------------------------------------------------------------------------


def test_a_clips_velocity_is_in_its_own_heading(robot):
    found = velocity.velocities(course(robot, 0.7, -0.6, sideways=0.2))
    assert found.shape == (200, 3)
    np.testing.assert_allclose(found, np.tile([0.7, 0.2, -0.6], (200, 1)), atol=0.01)


def test_a_frames_velocity_is_in_the_heading_frame(robot, slow_and_left):
    clip = slow_and_left.clips[1]
    frame = features.observe(robot, jnp.asarray(clip.qpos[100]), jnp.asarray(clip.qvel[100]), "compact").frame
    np.testing.assert_allclose(FrameLayout.of(robot).heading_velocity(frame), [1.0, 0.0, 0.5], atol=0.01)


def test_commands_are_demonstrations_velocities_or_between_two(robot, slow_and_left):
    settings = CommandConfig(kind="velocity", hold=(0.5, 1.0), zero=0.2)
    command = velocity.make(settings, RATE, robot, slow_and_left)
    value, left, *_ = (np.asarray(x) for x in command.draw(jax.random.PRNGKey(0), (20_000,)))
    zero = (value == 0).all(1)
    assert zero.mean() == pytest.approx(0.2, abs=0.01)
    assert left.min() == 25 and left.max() == 50
    # On the line between the two: one of them for half of the commands, and for half of the pairs of the other half.
    part = (value[~zero, 0] - 0.4) / 0.6
    np.testing.assert_allclose(value[~zero, 2], 0.5 * part, atol=0.01)
    ends = (np.abs(part) < 0.01) | (np.abs(part - 1) < 0.01)
    assert ends.mean() == pytest.approx(0.75, abs=0.02) and part.min() > -0.01 and part.max() < 1.01


def test_commands_from_ranges(robot, slow_and_left):
    settings = CommandConfig(kind="velocity", ahead=(-0.5, 1.5), turn=(0.1, 0.3), zero=0.0)
    value = np.asarray(velocity.make(settings, RATE, robot, slow_and_left).draw(jax.random.PRNGKey(0), (5000,)).value)
    np.testing.assert_allclose([value.min(0), value.max(0)], [[-0.5, 0, 0.1], [1.5, 0, 0.3]], atol=0.01)
    np.testing.assert_allclose(velocity.extent(settings, slow_and_left), [[-0.5, 0, 0], [1.5, 0, 0.3]])


def test_commands_that_no_motion_covers_are_told(robot, slow_and_left):
    """A command of a motion, between two or near them is covered; of another one the nearest motion is named."""
    slow, left = slow_and_left.clips
    named = MotionLibrary((dataclasses.replace(slow, name="slow"), dataclasses.replace(left, name="left")), (0.5, 0.5))
    covered = np.array([[0.4, 0, 0], [0.7, 0, 0.25], [1.0, 0, 0.5], [1.05, 0, 0.55]])
    assert velocity.beyond(covered, named) is None and velocity.beyond(np.zeros((0, 3)), named) is None
    assert velocity.beyond(np.array([[0.7, 0.0, 0.25], [1.6, -0.2, 0.5], [1.2, 0, 0.5]]), named) == (
        "commands reach 1.60 m/s ahead, -0.20 m/s and 0.50 rad/s to the left, beyond what the motions show: "
        "the nearest motion, left, moves at 1.00 m/s ahead, 0.00 m/s and 0.50 rad/s to the left"
    )
    # Both ends are motions', and their box has corners that are none's.
    box = velocity.corners(np.array([0.4, 0, 0]), np.array([1.0, 0, 0.6]))
    assert "commands reach 0.40 m/s ahead, 0.00 m/s and 0.60 rad/s to the left" in velocity.beyond(box, named)


def test_the_commands_furthest_out_of_a_training():
    own = CommandConfig(kind="velocity", zero=0.0)
    assert velocity.told(own).shape == (0, 3)
    np.testing.assert_array_equal(velocity.told(dataclasses.replace(own, zero=0.1)), [[0, 0, 0]])
    ranged = velocity.told(dataclasses.replace(own, ahead=(-0.5, 1.5), turn=(0.1, 0.3)))
    ends = [[-0.5, 0, 0.1], [-0.5, 0, 0.3], [1.5, 0, 0.1], [1.5, 0, 0.3]]
    np.testing.assert_array_equal(np.unique(ranged, axis=0), ends)


def test_a_training_and_an_evaluation_warn_of_commands_that_no_motion_covers():
    asked = {"motion": "walk", "command.kind": "velocity", "command.zero": 0.0, "env.axes": "heading"}
    assert "commands reach" not in runs.describe(preset("smoke", **asked))
    far = preset("smoke", **asked, **{"command.ahead": (0.0, 2.0)})
    (line,) = [line for line in runs.describe(far).splitlines() if "commands reach" in line]
    assert line.startswith("  warning: commands reach 2.00 m/s ahead") and "the nearest motion, walk, moves at " in line
    trainer = SimpleNamespace(config=far, env=SimpleNamespace(library=motion.load_library("walk")))
    assert steering.beyond(trainer).startswith("commands reach 2.00 m/s ahead")
    trainer.config = preset("smoke")
    assert steering.beyond(trainer) is None


def test_a_command_is_held_and_then_another(robot, slow_and_left):
    command = velocity.make(CommandConfig(kind="velocity"), RATE, robot, slow_and_left)
    rows = jnp.array([50, 250, 400])  # of the first clip, of the second, and the default pose
    drawn = velocity.Velocity(jnp.full((3, 3), 9.0), jnp.array([3, 1, 2]), jnp.zeros((3, 3)))
    frame = jnp.zeros((3, FrameLayout.of(robot).size))
    state = command.begin(rows, drawn)
    np.testing.assert_allclose(state.value, [[0.4, 0, 0], [1.0, 0, 0.5], [0, 0, 0]], atol=0.01)
    np.testing.assert_array_equal(command.observe(state), state.value)
    after, over, _ = command.advance(state, drawn, frame)
    np.testing.assert_array_equal((np.asarray(after.value) == 9).all(1), [False, True, False])
    np.testing.assert_array_equal(after.left, [2, 1, 1])
    assert not over.any()
    np.testing.assert_array_equal(command.advance(state, None, frame).state.value, state.value)


def test_a_new_velocity_is_told_as_fast_as_the_ramp(robot, slow_and_left):
    """By 0.5 m/s² and 1 rad/s² at 50 Hz: 0.01 m/s and 0.02 rad/s a step, in training and as `velocity.ramped` does."""
    settings = CommandConfig(kind="velocity", ramp=(0.5, 1.0))
    command = velocity.make(settings, RATE, robot, slow_and_left)
    goal = jnp.array([[0.415, -0.005, 1.0]])
    drawn = velocity.Velocity(goal, jnp.array([9]), jnp.zeros((1, 3)))
    state = command.begin(jnp.array([400]), drawn)._replace(left=jnp.array([1]))
    values, frame = [np.asarray(state.value)], jnp.zeros((1, FrameLayout.of(robot).size))
    for given in (drawn, drawn, None):
        told = command.advance(state, given, frame)
        state, reward = told.state, told.reward
        values.append(np.asarray(state.value))
    np.testing.assert_allclose(np.concatenate(values), np.outer(range(4), [0.01, 0, 0.02]) + [0, -0.005, 0] * (
        np.arange(4) > 0)[:, None], atol=1e-6)  # fmt: skip
    np.testing.assert_array_equal(state.goal, goal)
    np.testing.assert_array_equal(command.observe(state), state.value)
    asked = np.concatenate([values[0], np.repeat(goal, 60, axis=0)])
    ramped = velocity.ramped(asked, settings.ramp, RATE)
    np.testing.assert_allclose(ramped[:4], np.concatenate(values), atol=1e-6)
    np.testing.assert_allclose(ramped[[41, 42, 60]], [[0.41, -0.005, 0.82], [0.415, -0.005, 0.84], goal[0]], atol=1e-6)
    np.testing.assert_array_equal(velocity.ramped(asked, (), RATE), asked)
    # The reward is that of the command as it is told: standing still while told 0.01 m/s earns nearly everything.
    assert float(reward[0]) > 0.99


def test_the_reward_of_a_velocity_in_closed_form(robot, slow_and_left):
    settings = CommandConfig(kind="velocity", speed_width=0.5, turn_width=0.4, average=0.1)
    command, layout = velocity.make(settings, RATE, robot, slow_and_left), FrameLayout.of(robot)
    frame = np.zeros((1, layout.size), np.float32)
    frame[:, layout.rotation] = [0, 1, 0, 0, 0, 1]  # faces +y
    frame[:, layout.velocity], frame[:, layout.angular_velocity] = [-0.3, 1.0, 5.0], [7.0, 7.0, 0.2]
    state = velocity.Velocity(jnp.array([[0.8, 0.3, 0.0]]), jnp.array([1]), jnp.zeros((1, 3)))
    # Errors of 0.2 m/s and 0.2 rad/s, of which the first of five steps counts a fifth and all that follow the rest.
    counted = 0.3 * np.log(1 + 0.2 / 0.3)
    for share in (0.2, 0.36):
        state, _, reward = command.advance(state, None, jnp.asarray(frame))
        expected = 1 / (1 + (counted * share) ** 2 / 0.25) / (1 + (counted * share) ** 2 / 0.16)
        np.testing.assert_allclose(reward, [expected], rtol=1e-5)
    np.testing.assert_allclose(state.off, [[0.36 * counted, 0.0, 0.36 * counted]], atol=1e-6)
    # A large error counts by its logarithm, whatever its sign: 4.0 m/s and 4.2 rad/s here.
    far = velocity.Velocity(jnp.array([[5.0, 0.3, -4.0]]), jnp.array([1]), jnp.zeros((1, 3)))
    off = command.advance(far, None, jnp.asarray(frame)).state.off
    large = 0.2 * 0.3 * np.log(1 + np.array([4.0, 4.2]) / 0.3)
    np.testing.assert_allclose(off, [[-large[0], 0.0, large[1]]], rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(command.reveal(state), state.off)


# --- motions ---------------------------------------------------------------------------------------------------------


def test_a_step_earns_by_moving_like_the_motion_that_is_told(robot, slow_and_left):
    settings = CommandConfig(kind="motion", average=0.02, hold=(1.0, 1.0))
    clips = slow_and_left.clips
    frames = [features.observe(robot, jnp.asarray(c.qpos), jnp.asarray(c.qvel), "compact").frame for c in clips]
    command = which.make(settings, RATE, robot, slow_and_left, jnp.concatenate([*frames, frames[0][:1]]))
    drawn = command.draw(jax.random.PRNGKey(0), (4,))._replace(
        clip=jnp.array([1, 1, 1, 1]), left=jnp.array([9, 9, 1, 1])
    )
    state = command.begin(jnp.array([0, 250, 10, 400]), drawn)
    np.testing.assert_array_equal(state.clip, [0, 1, 0, 1])  # the default pose, row 400, begins with a drawn one
    np.testing.assert_array_equal(command.observe(state), np.eye(2)[[0, 1, 0, 1]])
    moving = jnp.stack([frames[0][100], frames[0][100], frames[1][100], frames[1][100]])
    told = command.advance(state, drawn, moving)
    np.testing.assert_allclose(told.reward, [1, 0, 0, 1], atol=0.01)
    np.testing.assert_array_equal(told.state.clip, [0, 1, 1, 1])  # held, held, over, over
    assert not told.over.any()
    np.testing.assert_array_equal(command.advance(state, None, moving).state.clip, state.clip)
    # Halfway between the two: a mean of both distances.
    between = command.advance(state, drawn, 0.5 * (moving[:1] + moving[2:3]).repeat(4, 0)).reward
    np.testing.assert_allclose(between, 0.5, atol=0.02)


def test_a_posture_is_the_same_wherever_it_faces(robot, slow_and_left):
    clip, angle = slow_and_left.clips[1], 1.2
    qpos, qvel = clip.qpos[50].copy(), clip.qvel[50].copy()
    turned, spun = qpos.copy(), qvel.copy()
    cosine, sine = np.cos(angle), np.sin(angle)
    turned[:3] = [cosine * qpos[0] - sine * qpos[1] + 3, sine * qpos[0] + cosine * qpos[1] - 1, qpos[2]]
    turned[3:7] = rotations.multiply(np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)]), qpos[3:7])
    spun[:2] = [cosine * qvel[0] - sine * qvel[1], sine * qvel[0] + cosine * qvel[1]]
    frames = features.observe(robot, jnp.stack([qpos, turned]), jnp.stack([qvel, spun]), "compact").frame
    here, there = which.posture(frames, FrameLayout.of(robot))
    np.testing.assert_allclose(here, there, atol=2e-6)


def test_one_motion_is_none_to_choose_from(robot, walk):
    with pytest.raises(UserError, match=r"command\.kind is 'motion' and the run has one motion: expected two or more"):
        which.make(CommandConfig(kind="motion"), RATE, robot, MotionLibrary((walk,), (1.0,)), jnp.zeros((1, 1)))


def test_the_form_of_an_observation_counts_the_motions(robot):
    form = features.observation_form(preset("smoke", **{"command.kind": "motion", "motion": "walk,turn_left:2"}))
    assert form == "compact motion-2"
    assert features.observation_terms(robot, form)["motion_command"] == 2


# --- phases ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def part(walk):
    """Half of a stride more than two, which does not end as it begins."""
    return motion.MotionClip.from_qpos("part", walk.robot, walk.rate, walk.qpos[:130])


def timed(robot, clip):
    changes = {"command.kind": "phase", "env.axes": "heading", "features.axes": "heading", "env.first_cap": 1000}
    settings = preset("smoke", **changes)
    return Env(robot, clip, settings, physics.make(robot, settings.physics))


@pytest.fixture(scope="module")
def phased(robot, part):
    return timed(robot, part)


def test_the_phase_goes_on_and_ends_the_episode_with_the_clip(phased, part):
    last = len(part) - 1
    state = phased.command.begin(jnp.array([0, last - 2, last + 1]), ())
    np.testing.assert_array_equal(state, [0, last - 2, 0])
    seen = phased.command.observe(jnp.array([0, last // 4, last]))
    np.testing.assert_allclose(seen[0, :5], [0, 0, 0, 1, 1], atol=1e-6)
    assert phased.command.size == seen.shape[1] == 5 + 29 and float(seen[1, 1]) == pytest.approx(1, abs=1e-3)
    terms = features.observation_terms(phased.robot, "compact heading phase")
    assert terms["clip_phase"] == 5 + 29 and sum(terms.values()) == phased.observation_size
    joints = phased.library.qpos[:, 7:]
    np.testing.assert_allclose(seen[:, 5:], joints[[1, last // 4 + 1, last]] - joints.mean(0), atol=1e-6)
    frame = jnp.zeros((3, FrameLayout.of(phased.robot).size))
    np.testing.assert_array_equal(phased.command.wanted(state), [1, last - 1, 1])
    np.testing.assert_array_equal(phased.command.wanted(jnp.array([last - 1, last])), last)
    state, over, _ = phased.command.advance(state, None, frame)
    assert state.tolist() == [1, last - 1, 1] and not over.any()
    assert phased.command.advance(state, None, frame).over.tolist() == [False, True, False]


def test_the_phase_of_a_loop_begins_again(robot, walk):
    """Its last pose is its first one, and no episode ends there."""
    command, last = timed(robot, walk).command, len(walk) - 1
    state = command.begin(jnp.array([last - 2, last, last + 1]), ())
    assert state.tolist() == [last - 2, 0, 0]
    frame = jnp.zeros((3, FrameLayout.of(robot).size))
    rows = []
    for _ in range(4):
        state, over, _ = command.advance(state, None, frame)
        rows.append(state.tolist())
        assert not over.any()
    assert rows == [[last - 1, 1, 1], [0, 2, 2], [1, 3, 3], [2, 4, 4]]
    np.testing.assert_array_equal(command.wanted(jnp.array([last - 1])), 0)
    joints = walk.qpos[:, 7:]
    seen = command.observe(jnp.array([last - 1]))
    np.testing.assert_allclose(seen[0, 5:], joints[last] - joints.mean(0), atol=1e-5)


def test_a_phase_earns_all_for_the_demonstration_and_less_for_what_is_off(phased):
    rows, table = jnp.array([20, 40]), jnp.asarray(phased._table.frame)
    np.testing.assert_allclose(phased.command.advance(rows, None, table[rows + 1]).reward, 1.0, atol=1e-5)
    late = phased.command.advance(rows, None, table[rows - 10]).reward
    assert (np.asarray(late) < 0.9).all() and (np.asarray(late) > 0.1).all()
    # A turned world earns the same; joints that are off by 0.1 rad earn 0.5 (1 - exp(-0.3)) less.
    layout = FrameLayout.of(phased.robot)
    angle = 0.1
    cosine, sine = table[rows + 1][:, layout.cosine], table[rows + 1][:, layout.sine]
    off = table[rows + 1].at[:, layout.cosine].set(cosine * np.cos(angle) - sine * np.sin(angle))
    off = off.at[:, layout.sine].set(sine * np.cos(angle) + cosine * np.sin(angle))
    np.testing.assert_allclose(phased.command.advance(rows, None, off).reward, 1 - 0.5 * (1 - np.exp(-0.3)), atol=1e-3)


def test_a_phase_is_of_one_motion(robot):
    two = motion.load_library("walk,turn_left")
    settings = preset("smoke", **{"command.kind": "phase"})
    with pytest.raises(UserError, match="command.kind is 'phase' and the run has 2 motions: expected one"):
        Env(robot, two, settings, physics.make(robot, settings.physics))


# --- observations ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("content", ["full", "compact"])
def test_a_heading_observation_does_not_know_north(robot, walk, content):
    """Turn the world by any angle: what is observed stays."""
    qpos, qvel = walk.qpos[30:33].copy(), walk.qvel[30:33].copy()
    turned, moved = qpos.copy(), qvel.copy()
    for i, angle in enumerate((0.7, -2.5, 3.1)):
        by = np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)])
        turned[i, :3], moved[i, :3] = rotations.rotate(by, qpos[i, :3]), rotations.rotate(by, qvel[i, :3])
        turned[i, 3:7] = rotations.multiply(by, qpos[i, 3:7])
    observed = [
        features.observe(robot, jnp.float32(q), jnp.float32(v), f"{content} heading").actor
        for q, v in ((qpos, qvel), (turned, moved))
    ]
    np.testing.assert_allclose(*observed, atol=2e-5)
    world = features.observe(robot, jnp.float32(turned), jnp.float32(moved), content).actor
    assert np.abs(world - observed[0]).max() > 0.1
    # Facing +x the two are one.
    qpos[:, 3:7] = [1, 0, 0, 0]
    both = [
        features.observe(robot, jnp.float32(qpos), jnp.float32(qvel), form).actor
        for form in (content, f"{content} heading")
    ]
    np.testing.assert_allclose(*both, atol=1e-6)


def test_the_parts_of_an_observation_have_names_and_widths(robot):
    settings = preset("laptop", **config.COMMANDS["velocity"])
    form = features.observation_form(settings)
    assert form == "compact heading velocity" and features.observation_form(preset("laptop")) == "compact"
    terms = features.observation_terms(robot, form)
    assert (
        list(terms)[-2:] == ["velocity_commands", "velocity_errors"]
        and "heading_key_points" in terms
        and "key_points" not in terms
    )
    assert sum(terms.values()) == 92 and set(terms) <= set(TERMS)


# --- runs ------------------------------------------------------------------------------------------------------------


def test_no_command_changes_nothing(robot, walk):
    """No leaf of the state, no number of the observation, no key."""
    settings = preset("smoke", **TINY)
    env = Env(robot, walk, settings, physics.make(robot, settings.physics))
    state = env.reset(jax.random.PRNGKey(0))
    assert env.command is None and state.command == () and env.observation_size == 86
    assert commands.make(settings, robot, env.library, env._table.frame) is None


def test_product_and_sum():
    prior, obeyed = jnp.array([1.0, 0.5]), jnp.array([0.5, 1.0])
    np.testing.assert_array_equal(commands.combine(CommandConfig(), prior, obeyed), [0.5, 0.5])
    joined = commands.combine(CommandConfig(combine="sum", weight=2.0), prior, obeyed)
    np.testing.assert_array_equal(joined, [2.0, 2.5])
    np.testing.assert_array_equal(commands.combine(CommandConfig(combine="prior"), prior, obeyed), prior)
    np.testing.assert_array_equal(commands.combine(CommandConfig(combine="command"), prior, obeyed), obeyed)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"command.ahead": (1.0, 0.5)}, "setting command.ahead is 1, 0.5: expected two numbers, the lower one first"),
        ({"command.turn": (0.5,)}, "setting command.turn is 0.5: expected two numbers"),
        ({"command.hold": (0.0, 1.0)}, "setting command.hold begins with 0: expected more than 0 s"),
        ({"command.zero": 1.5}, "command.zero is 1.5"),
        ({"command.kind": "speed"}, "'speed'"),
    ],
)
def test_bad_commands_are_refused_in_a_sentence(changes, sentence):
    with pytest.raises(UserError, match=sentence):
        preset("smoke", **changes)


def test_a_folder_is_a_list_of_its_motions(tmp_path):
    for name in ("b", "a"):
        motion.save(motion.load("walk"), tmp_path / f"{name}.npz")
    assert library.listed(f"{tmp_path}:3,walk") == f"{tmp_path}/a.npz:1.5,{tmp_path}/b.npz:1.5,walk"
    gaits = library.listed("gaits").split(",")
    assert len(gaits) > 20 and all(name.startswith("gaits/") for name in gaits)
    assert [library.title(name) for name in ("gaits/+0.40_-0.80", "/a/b.npz", "walk")] == ["+0.40_-0.80", "b", "walk"]
    (tmp_path / "none").mkdir()
    with pytest.raises(UserError, match="none has no motion files: expected files that end in .npz"):
        library.listed(str(tmp_path / "none"))


def test_the_shipped_gaits_move_as_their_names_say():
    found = motion.load_library(library.listed("gaits"))
    for clip in found.clips:
        ahead, turn = map(float, clip.name.rsplit("/")[-1].split("_"))
        np.testing.assert_allclose(velocity.velocities(clip).mean(0), [ahead, 0.0, turn], atol=0.03)


def test_a_shipped_gait_is_the_generators(robot):
    made = gait.make(robot, gait.Command(0.8, 0.0, 0.4)).clip(4.0)
    np.testing.assert_allclose(motion.load("gaits/+0.80_+0.40").qpos, made.qpos, atol=1e-6)


def test_a_grid_of_gaits_is_a_folder(tmp_path, capsys):
    """What is out of reach is said and left out; a file is no folder."""
    out = [
        "motion",
        "synthesize",
        "--grid",
        "--out",
        str(tmp_path / "mine"),
        "--duration",
        "2",
        "--turns",
        "0",
        "--sides",
        "0",
        "0.3",
    ]
    cli.main([*out, "--speeds", "0", "9", "--sides", "0", "0.3"])
    names = sorted(path.name for path in (tmp_path / "mine").iterdir())
    assert names == ["+0.00_+0.00.npz", "+0.00_+0.00_+0.30.npz"]
    assert "left out: speed 9 m/s is out of the legs' reach" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stop:
        cli.main(["motion", "synthesize", "--grid", "--out", str(tmp_path / "mine.npz")])
    assert stop.value.code == 2 and "expected a folder with --grid" in capsys.readouterr().err


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """A tiny run that is told velocities, from the command line."""
    folder = tmp_path_factory.mktemp("told") / "run"
    changes = TINY | {"transitions": 128, "evaluations": (1.0,)}
    command = [
        "train",
        "--preset",
        "smoke",
        "--command",
        "velocity",
        "--motion",
        "walk,turn_left",
        "--run",
        str(folder),
    ]
    cli.main([*command, "--no-pictures", *settings(changes)])
    return folder


@pytest.mark.slow
def test_a_run_is_told_velocities_and_measured(told, capsys, monkeypatch):
    for name, seconds in {"CONSTANT": 1.0, "SETTLING": 0.2, "LEG": 0.4, "FOLLOWING": 0.1}.items():
        monkeypatch.setattr(steering, name, seconds)
    trainer, state = runs.Run.open(told).policy()
    assert trainer.env.observation_size.actor == 92 and state.env.command.value.shape == (8, 3)
    rows = (told / "metrics.csv").read_text().splitlines()
    assert "command/reward" in rows[0]
    cli.main(["evaluate", str(told), "--commands", "--episodes", "4"])
    assert "turning when told to go straight" in capsys.readouterr().out
    found = json.loads((told / "steering.json").read_text())
    assert 0 < found["changing_style"] < 10
    assert found["changing_episodes"] == 4 and len(found["cells"]) == steering.SPEEDS * steering.TURNS
    assert (told / "steering.png").stat().st_size > 10_000
    cli.main(["render", str(told), "--course", "0.3:0.4,0,0.2", "0.2:0,0,0"])
    assert (told / "course.mp4").exists() or (told / "course.gif").exists()
    with pytest.raises(SystemExit):
        cli.main(["render", str(told), "--course", "0.3:fast"])
    assert "leg '0.3:fast' of the course: expected SECONDS:FORWARD,LEFT,TURN" in capsys.readouterr().err


def test_an_evaluation_tells_as_training_does(robot, slow_and_left, monkeypatch):
    """From the first command to the second by 1 m/s² at 50 Hz."""
    config = preset("smoke", **{"command.kind": "velocity", "command.ramp": (1.0, 1.0)})
    trainer = SimpleNamespace(config=config, env=SimpleNamespace(library=slow_and_left))
    monkeypatch.setattr(steering, "_play", lambda trainer, state, rows, told: (told, rows, *[np.zeros(2)] * 3))
    asked = np.repeat([[[0.4, 0.0, 0.0]], [[1.0, 0.0, 0.5]]], 50, axis=0)
    played = steering.play(trainer, None, asked, np.random.default_rng(0))
    # The start is of the clip that moves like the first command: the slow one, rows 0 to 199.
    assert played.qpos[0] < 200
    rate = config.control_rate
    np.testing.assert_allclose(played.velocity[49:52, 0, 0], [0.4, 0.4 + 1 / rate, 0.4 + 2 / rate], atol=1e-6)
    np.testing.assert_allclose(played.velocity[-1, 0], [min(1.0, 0.4 + 50 / rate), 0.0, 0.5], atol=1e-6)


def test_starts_under_a_command_are_not_all_one_sample():
    """A recording that moves as told for one sample only, and a gait that does for a hundred."""
    command = np.array([0.5, 0.0, 0.2])
    recording = command + np.linspace(0, 1, 1000)[:, None] * np.array([1.0, 0.0, -1.0])
    assert steering.nearest_rows(recording, command).tolist() == list(range(steering.STARTS))
    gait = np.concatenate([recording, np.tile(command, (100, 1))])
    near = steering.nearest_rows(gait, command)
    assert set(range(1000, 1100)) <= set(near) and np.abs(gait[near] - command).sum(-1).max() <= steering.NEAR
    assert steering.nearest_rows(recording[:3], command).tolist() == [0, 1, 2]


@pytest.mark.slow
def test_a_run_without_commands_has_no_grid(robot, walk):
    trainer = Trainer(preset("smoke", **TINY), walk)
    with pytest.raises(UserError, match="the run's command.kind is 'none': expected 'velocity'"):
        steering.measure(trainer, None)


def test_phase_constants_make_one():
    parts = (phase.JOINTS, phase.JOINT_VELOCITIES, phase.HEIGHT, phase.TILT)
    assert sum(share for share, _ in parts) == pytest.approx(1.0)


def test_commands_to_the_sides_are_tried_where_there_are_any():
    low, high = np.array([0.0, 0.0, -0.8]), np.array([1.3, 0.0, 0.8])
    grid = steering._grid(low, high)
    assert grid.shape == (steering.SPEEDS * steering.TURNS, 3) and not grid[:, 1].any()
    wide = steering._grid(low + [-0.5, -0.4, 0.0], high + [0.0, 0.4, 0.0])
    np.testing.assert_allclose(wide[len(grid) :], [(0.0, side, 0.0) for side in (-0.4, -0.2, 0.2, 0.4)])
    assert (wide == 0).all(1).any() and wide[:, 0].min() == -0.5


def test_figures_of_cells():
    grid = np.array([[0.5, 0.0, 0.2]])
    reached = np.array([[[0.6, 0.1, 0.1], [0.3, -0.1, 0.5], [np.nan] * 3]])
    (cell,) = steering._cells(grid, reached, np.array([[False, False, True]]), np.array([[0.1, 0.3, 5.0]]))
    assert (cell.episodes, cell.falls) == (3, 1) and cell.style == pytest.approx(0.2)
    np.testing.assert_allclose([cell.speed, cell.turned], [0.45, 0.3])
    np.testing.assert_allclose([cell.speed_error, cell.turn_error, cell.drift], [0.15, 0.2, 0.1])
    assert dataclasses.is_dataclass(steering.Steering)
