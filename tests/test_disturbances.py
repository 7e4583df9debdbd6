"""Disturbances in closed form: pushes, late actions, sensors that err, what is drawn, and what the networks see."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import disturbances, features, kinematics, motion, physics, robots, rotations
from fmpjax.acting import ActionRule, Seen
from fmpjax.actions import action_map
from fmpjax.config import DisturbanceConfig, preset
from fmpjax.env import Env
from fmpjax.errors import UserError
from tests.helpers import disturbed

COUNT = 1000  # the same in all tests, for which JAX compiles its operations once


def built(robot, walk, told=0, **changes):
    config = preset("laptop", **changes)
    return disturbances.make(config, robot, action_map(robot, walk, "residual"), told)


def states(robot, count=COUNT):
    qpos = np.tile(robot.default_qpos, (COUNT, 1))
    qpos[:, 3:7] = [np.cos(0.2), 0.0, np.sin(0.2), 0.0]  # pitched by 0.4 rad
    qvel = np.random.default_rng(0).normal(size=(count, 6 + robot.joint_count))
    return physics.reset(jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32))


# --- what is asked for -----------------------------------------------------------------------------------------------


def test_presets_without_disturbances_have_none(robot, walk):
    for name in ("smoke", "laptop", "paper"):
        config = preset(name)
        assert disturbances.make(config, robot, action_map(robot, walk, "residual"), 0) is None
        assert not config.disturbance.any
    assert preset("robust").disturbance.any and preset("robot").command.kind == "velocity"


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("friction", "1.2,0.3", "friction is 1.2, 0.3: expected two numbers, the lower one first, or none"),
        ("friction", "0,1", "friction is 0, 1: expected numbers above 0"),
        ("torso_mass", "1", "torso_mass is 1: expected two numbers, the lower one first, or none"),
        ("damping", "-0.1,1", "damping is -0.1, 1: expected numbers of at least 0"),
        ("torso_center", "0.1", "torso_center is 0.1: expected three numbers, along x, y and z, or none"),
        ("slope", "0.6", "slope is 0.6: expected at most 0.5 rad"),
        ("step_height", "0.3", "step_height is 0.3: expected at most 0.1 m"),
        ("delay", "4,0", "delay is 4, 0: expected two numbers, the lower one first, or none"),
        ("push_interval", "0,1", "push_interval is 0, 1: expected numbers above 0"),
    ],
)
def test_ranges_out_of_order_or_of_physics_are_refused(key, value, said):
    with pytest.raises(UserError, match=f"setting disturbance.{said}"):
        preset("laptop", **{f"disturbance.{key}": value})


def test_pushes_without_a_speed_are_refused():
    with pytest.raises(UserError, match="push_speed is empty and push_interval is not"):
        preset("laptop", **{"disturbance.push_speed": "", "disturbance.push_interval": "1,2"})


def test_a_history_of_what_has_none_is_refused():
    with pytest.raises(UserError, match="observation_history is 3 and env.observation 'compact': expected 1"):
        preset("laptop", **{"env.observation_history": 3})


@pytest.mark.parametrize("changes", [{}, {"env.observation": "deployable"}])
def test_an_estimator_of_what_cannot_be_known_is_refused(changes):
    with pytest.raises(UserError, match="ppo.estimator is 16: expected nothing unless env.observation is 'deployable'"):
        preset("laptop", **{"ppo.estimator": (16,)}, **changes)


def test_a_critic_sees_what_the_estimator_estimates(robot, walk):
    config = preset("laptop", **{"env.observation": "deployable", "env.axes": "heading"})
    qpos, qvel = (jnp.asarray(x[20:23], jnp.float32) for x in (walk.qpos, walk.qvel))
    seen = features.observe(robot, qpos, qvel, features.true_form(config)).actor
    columns = np.asarray(seen)[:, features.estimated_columns(robot, config)]
    yaw = np.asarray(rotations.yaw(qpos[:, 3:7]))
    ahead = np.cos(yaw) * qvel[:, 0] + np.sin(yaw) * qvel[:, 1]
    aside = np.cos(yaw) * qvel[:, 1] - np.sin(yaw) * qvel[:, 0]
    np.testing.assert_allclose(columns, np.stack([qpos[:, 2], ahead, aside, qvel[:, 2]], axis=-1), atol=1e-5)


def test_a_torso_of_no_mass_is_refused(robot, walk):
    with pytest.raises(UserError, match=r"torso_mass begins with -50: expected more than -[\d.]+ kg, since the torso"):
        built(robot, walk, **{"disturbance.torso_mass": (-50.0, 0.0)})


# --- what is drawn ---------------------------------------------------------------------------------------------------


def test_robots_and_floors_are_drawn_from_their_ranges(robot, walk):
    ranges = {
        "friction": (0.3, 1.2),
        "torso_mass": (-1.0, 3.0),
        "stiffness": (0.9, 1.1),
        "damping": (0.8, 1.2),
        "strength": (0.5, 1.0),
        "joint_friction": (0.1, 0.2),
        "armature": (1.0, 1.05),
    }
    more = {"torso_center": (0.01, 0.02, 0.03), "slope": 0.1, "encoder_bias": 0.015}
    made = built(robot, walk, **{f"disturbance.{k}": v for k, v in (ranges | more).items()})
    state = made.init(jax.random.PRNGKey(0), COUNT)
    for name, (low, high) in ranges.items():
        found, span = np.asarray(getattr(state.body, name)), high - low
        assert low <= found.min() < low + 0.02 * span and high - 0.02 * span < found.max() <= high + 1e-6, name
    off = np.abs(np.asarray(state.body.torso_center))
    np.testing.assert_allclose(off.max(0), [0.01, 0.02, 0.03], rtol=0.03)
    steep = np.linalg.norm(state.body.slope, axis=-1)
    assert 0.098 < steep.max() <= 0.1 and abs(np.asarray(state.body.slope).mean()) < 0.005
    assert 0.0149 < np.abs(state.bias).max() <= 0.015
    again = made.init(jax.random.PRNGKey(0), COUNT)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(again), strict=True))


def test_what_is_not_asked_for_stays_the_robots_own(robot, walk):
    made = built(robot, walk, **{"disturbance.friction": (0.5, 0.5), "physics.frictionloss": 0.2})
    body = made.init(jax.random.PRNGKey(0), COUNT).body
    for name, value in {"friction": 0.5, "torso_mass": 0, "stiffness": 1, "joint_friction": 0.2, "slope": 0}.items():
        np.testing.assert_array_equal(getattr(body, name), np.full_like(getattr(body, name), value))


def test_delays_are_drawn_for_each_episode(robot, walk):
    made = built(robot, walk, **{"disturbance.delay": (1, 4)})
    state = made.init(jax.random.PRNGKey(0), COUNT)
    counts = np.bincount(state.episode.delay, minlength=6)
    assert counts[0] == counts[5] == 0 and counts[1:5].min() > 200
    other = made.begin(state.sizes, made.draw(jax.random.PRNGKey(1), (COUNT,)))
    assert (other.delay != state.episode.delay).mean() > 0.6


# --- pushes ----------------------------------------------------------------------------------------------------------

PUSHED = {"disturbance.push_interval": (0.1, 0.1), "disturbance.push_speed": (0.5, 0.5)}


def test_a_push_adds_its_velocity_and_comes_when_it_is_due(robot, walk):
    made = built(robot, walk, **PUSHED)
    state, sim = made.init(jax.random.PRNGKey(0), COUNT), states(robot)
    state = state._replace(episode=state.episode._replace(wait=jnp.arange(COUNT) % 5 + 1))
    drawn, action = made.draw(jax.random.PRNGKey(1), (COUNT,)), jnp.zeros((COUNT, robot.joint_count))
    (pushed, targets), after = made.act(state, sim, action, drawn)
    added, due = np.asarray(pushed.qvel - sim.qvel), np.asarray(state.episode.wait) == 1
    angle = 2 * np.pi * np.asarray(drawn)[:, 0]
    expected = 0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1) * due[:, None]
    np.testing.assert_allclose(added[:, :2], expected, atol=1e-6)
    assert not added[:, 2:].any() and due.sum() == COUNT / 5
    np.testing.assert_array_equal(after.episode.wait, np.where(due, 5, np.asarray(state.episode.wait) - 1))
    np.testing.assert_allclose(targets, made.actions(action))
    np.testing.assert_array_equal(pushed.qpos, sim.qpos)


def test_a_push_lifts_and_turns_within_its_sizes(robot, walk):
    sizes = {"push_lift": 0.4, "push_tilt": 0.52, "push_turn": 0.78}
    made = built(robot, walk, **PUSHED, **{f"disturbance.{k}": v for k, v in sizes.items()})
    state, sim = made.init(jax.random.PRNGKey(0), COUNT), states(robot)
    state = state._replace(episode=state.episode._replace(wait=jnp.ones(COUNT, int)), share=jnp.full(COUNT, 0.5))
    drawn = made.draw(jax.random.PRNGKey(1), (COUNT,))
    (pushed, _), _ = made.act(state, sim, jnp.zeros((COUNT, robot.joint_count)), drawn)
    added = np.asarray(pushed.qvel - sim.qvel)
    np.testing.assert_allclose(np.linalg.norm(added[:, :2], axis=1), 0.25, atol=1e-6)  # half of the size
    np.testing.assert_allclose(np.abs(added[:, 2:6]).max(0), [0.2, 0.26, 0.26, 0.39], rtol=0.02)
    assert not added[:, 6:].any() and np.abs(added[:, :6].mean(0)).max() < 0.03


def test_pushes_grow_while_episodes_survive(robot, walk):
    made = built(robot, walk, **PUSHED, **{"disturbance.push_start": 0.3, "disturbance.push_growth": 0.1})
    state = made.init(jax.random.PRNGKey(0), COUNT)
    np.testing.assert_allclose(state.share, 0.3)
    for surviving, expected in ((0.9, 0.4), (0.9, 0.5), (0.1, 0.4), (0.1, 0.3), (0.1, 0.3)):
        state = made.grow(state, jnp.float32(surviving), 0.75)
        np.testing.assert_allclose(state.share, expected, rtol=1e-6)
    for _ in range(9):
        state = made.grow(state, jnp.float32(0.9), 0.75)
    np.testing.assert_array_equal(state.share, 1.0)


# --- uneven ground ---------------------------------------------------------------------------------------------------


def test_uneven_ground_leaves_all_other_random_numbers_as_they_are(robot, walk):
    even = built(robot, walk, **PUSHED, **{"disturbance.turn_noise": 0.1})
    uneven = built(robot, walk, **PUSHED, **{"disturbance.turn_noise": 0.1, "disturbance.step_height": 0.02})
    key = jax.random.PRNGKey(3)
    np.testing.assert_array_equal(uneven.draw(key, (5, 7))[..., : even.draws], even.draw(key, (5, 7)))


def test_uneven_ground_on_a_physics_without_it_is_refused(robot, walk):
    config = preset("laptop", **{"disturbance.step_height": 0.02, "physics.backend": "native"})
    with pytest.raises(UserError, match="step_height is 0.02 and the physics has even ground"):
        Env(robot, walk, config, physics.make(robot, config.physics))


def test_a_foot_that_is_lifted_comes_down_on_another_floor(robot, walk):
    made = built(robot, walk, **{"disturbance.step_height": 0.04})
    state, level = made.init(jax.random.PRNGKey(0), COUNT), states(robot)
    ahead = np.asarray(state.episode.ahead)
    assert not np.asarray(state.episode.floors).any() and np.abs(ahead).max() == pytest.approx(0.02, rel=0.01)
    standing = np.tile(robot.default_qpos, (COUNT, 1)).astype(np.float32)
    lifted = standing.copy()
    lifted[:, 2] += 0.5
    action = jnp.zeros((COUNT, robot.joint_count))

    def step(state, qpos, key):
        sim, drawn = level._replace(qpos=jnp.asarray(qpos)), made.draw(jax.random.PRNGKey(key), (COUNT,))
        (_, _, body), state = made.act(state, sim, action, drawn)
        np.testing.assert_array_equal(body.floors, state.episode.floors)
        return state

    # Feet that touch stay where they are, and what comes next is drawn again.
    still = step(state, standing, 1)
    assert not np.asarray(still.episode.floors).any() and (np.asarray(still.episode.ahead) != ahead).all()
    # In the air both feet are above their next floors, which then stay those.
    flown = step(still, lifted, 2)
    np.testing.assert_array_equal(flown.episode.floors, still.episode.ahead)
    again = step(flown, lifted, 3)
    np.testing.assert_array_equal(again.episode.floors, flown.episode.floors)
    # A foot that is lifted by 10 mm does not reach a floor that is higher.
    low = standing.copy()
    low[:, 2] += 0.01
    reached = np.asarray(step(still, low, 4).episode.floors)
    soles = kinematics.sole_heights(robot, kinematics.body_poses(robot, jnp.asarray(low[:1])))
    height = float(soles.min())
    assert 0.008 < height < 0.01  # the default pose is sunk by 1 mm
    expected = np.where(np.asarray(still.episode.ahead) + 0.005 < height, still.episode.ahead, 0.0)
    np.testing.assert_array_equal(reached, expected)
    assert 0.2 < (reached == 0).mean() < 0.5
    # An episode that begins again begins on level ground.
    assert not np.asarray(made.begin(state.sizes, made.draw(jax.random.PRNGKey(5), (COUNT,))).floors).any()


# --- late actions ----------------------------------------------------------------------------------------------------


def test_late_actions_reach_each_physics_step_when_they_should(robot, walk):
    delay, substeps, steps = 5, 2, 6
    made = built(robot, walk, **{"disturbance.delay": (0, delay)})
    joints = robot.joint_count
    state, sim = made.init(jax.random.PRNGKey(0), COUNT), states(robot)
    state = state._replace(episode=state.episode._replace(delay=jnp.arange(COUNT) % (delay + 1)))
    actions = np.random.default_rng(0).uniform(-0.5, 0.5, (steps, joints)).astype(np.float32)
    seen = []
    for action in actions:
        (_, targets), state = made.act(
            state, sim, jnp.tile(action, (COUNT, 1)), made.draw(jax.random.PRNGKey(0), (COUNT,))
        )
        seen.append(np.asarray(targets))
    seen = np.concatenate(seen, axis=1)  # [COUNT, steps * substeps, J]
    told = np.repeat(actions, substeps, axis=0)
    for late in range(delay + 1):
        expected = np.concatenate([np.zeros((late, joints)), told])[: steps * substeps]
        np.testing.assert_allclose(seen[late], made.actions(jnp.asarray(expected, jnp.float32)), atol=1e-6)
    np.testing.assert_allclose(state.episode.sent[0, -1], actions[-1])


def test_the_last_action_is_within_its_limits(robot, walk):
    made = built(robot, walk, **{"env.observation": "deployable"})
    state, sim = made.init(jax.random.PRNGKey(0), COUNT), states(robot)
    action = jnp.full((COUNT, robot.joint_count), 1e3)
    (_, targets), state = made.act(state, sim, action, made.draw(jax.random.PRNGKey(0), (COUNT,)))
    np.testing.assert_allclose(targets[0], robot.joint_high + 0.3, rtol=1e-6)
    np.testing.assert_allclose(made.actions(state.episode.sent[:, -1]), targets, atol=1e-5)
    assert np.abs(state.episode.sent).max() < 100


# --- sensors ---------------------------------------------------------------------------------------------------------


def test_a_deployable_observation_is_what_a_robot_senses(robot, walk):
    made = built(robot, walk, told=3, **{"env.observation": "deployable", "command.kind": "velocity"})
    state, sim = made.init(jax.random.PRNGKey(0), COUNT), states(robot)
    told = jnp.asarray(np.random.default_rng(2).normal(size=(COUNT, 3)), jnp.float32)
    seen, after = made.sense(state, sim, told, made.draw(jax.random.PRNGKey(0), (COUNT,)))
    terms = features.observation_terms(robot, "deployable velocity")
    assert list(terms) == [
        "base_ang_vel", "projected_gravity", "velocity_commands", "joint_pos_rel", "joint_vel_rel", "last_action",
    ]  # fmt: skip
    assert seen.shape == (COUNT, sum(terms.values())) == (COUNT, 96)
    parts = dict(zip(terms, np.split(np.asarray(seen), np.cumsum(list(terms.values()))[:-1], axis=1), strict=True))
    np.testing.assert_allclose(parts["base_ang_vel"], sim.qvel[:, 3:6])
    np.testing.assert_allclose(
        parts["projected_gravity"], np.tile([np.sin(0.4), 0, -np.cos(0.4)], (COUNT, 1)), atol=1e-6
    )
    np.testing.assert_allclose(parts["velocity_commands"], told)
    np.testing.assert_allclose(parts["joint_pos_rel"], sim.qpos[:, 7:] - made.actions.center, atol=1e-6)
    np.testing.assert_allclose(parts["joint_vel_rel"], sim.qvel[:, 6:])
    assert not parts["last_action"].any()
    assert features.observation_form(preset("robust")) == "deployable"
    assert (
        features.observation_form(preset("robot", **{"env.observation_history": 4})) == "deployable velocity history-4"
    )


def test_noise_and_bias_are_within_their_sizes_and_the_state_stays_true(robot, walk):
    noise = {"turn_noise": 0.2, "tilt_noise": 0.05, "angle_noise": 0.01, "velocity_noise": 1.5}
    joints = robot.joint_count
    made = built(robot, walk, **{"env.observation": "deployable"}, **{f"disturbance.{k}": v for k, v in noise.items()})
    plain = built(robot, walk, **{"env.observation": "deployable"})
    state, sim = made.init(jax.random.PRNGKey(0), COUNT), states(robot)
    seen, _ = made.sense(state, sim, (), made.draw(jax.random.PRNGKey(1), (COUNT,)))
    true, _ = plain.sense(
        plain.init(jax.random.PRNGKey(0), COUNT), sim, (), plain.draw(jax.random.PRNGKey(1), (COUNT,))
    )
    off = np.asarray(seen - true)
    most = np.abs(off).max(0)
    np.testing.assert_allclose(most[:3], 0.2, rtol=0.03)
    assert 0.04 < most[3:6].max() <= 0.05 * np.sqrt(2)
    np.testing.assert_allclose(most[6 : 6 + joints], 0.01, rtol=0.03)
    np.testing.assert_allclose(most[6 + joints : 6 + 2 * joints], 1.5, rtol=0.03)
    assert not off[:, 6 + 2 * joints :].any() and np.abs(off[:, :6].mean(0)).max() < 0.02
    np.testing.assert_allclose(np.linalg.norm(np.asarray(seen)[:, 3:6], axis=1), 1.0, rtol=1e-5)


def test_an_encoder_that_is_off_is_off_for_the_servo_and_the_actor(robot, walk):
    made = built(robot, walk, **{"disturbance.encoder_bias": 0.1, "env.observation": "deployable"})
    state, sim = made.init(jax.random.PRNGKey(0), COUNT), states(robot)
    drawn, joints = made.draw(jax.random.PRNGKey(1), (COUNT,)), robot.joint_count
    seen, _ = made.sense(state, sim, (), drawn)
    np.testing.assert_allclose(seen[:, 6 : 6 + joints], sim.qpos[:, 7:] + state.bias - made.actions.center, atol=1e-6)
    # A servo that has reached its target by its encoder is off by the bias.
    (_, targets), _ = made.act(state, sim, jnp.zeros((COUNT, joints)), drawn)
    np.testing.assert_allclose(targets + state.bias, made.actions(jnp.zeros((COUNT, joints))), atol=1e-6)


def test_any_observation_can_err(robot, walk):
    made = built(robot, walk, **{"disturbance.angle_noise": 0.01, "disturbance.velocity_noise": 1.0})
    state, sim = made.init(jax.random.PRNGKey(0), COUNT), states(robot)
    seen, _ = made.sense(state, sim, (), made.draw(jax.random.PRNGKey(1), (COUNT,)))
    true = features.observe(robot, sim.qpos, sim.qvel, "compact").actor
    off = np.abs(np.asarray(seen - true))
    joints = slice(13, 13 + robot.joint_count)
    assert seen.shape == true.shape and not off[:, :13].max() > 1e-5
    assert 0 < off[:, joints].max() <= 0.01 + 1e-6


def test_a_history_holds_each_terms_steps_oldest_first(robot, walk):
    made = built(robot, walk, **{"env.observation": "deployable", "env.observation_history": 3})
    state, sim = made.init(jax.random.PRNGKey(0), COUNT), states(robot)
    drawn, joints = made.draw(jax.random.PRNGKey(1), (COUNT,)), robot.joint_count
    turns = []
    for step in range(4):
        moved = sim._replace(qvel=sim.qvel + step)
        seen, state = made.sense(state, moved, (), drawn)
        turns.append(np.asarray(moved.qvel[:, 3:6]))
        expected = np.concatenate([turns[max(0, step + past)] for past in (-2, -1, 0)], axis=1)
        np.testing.assert_allclose(seen[:, :9], expected)
    assert seen.shape[1] == 3 * (6 + 3 * joints) == sum(features.observation_terms(robot, made.form).values())
    np.testing.assert_allclose(seen[:, -joints:], 0)
    single = built(robot, walk, **{"env.observation": "deployable"})
    newest, _ = single.sense(single.init(jax.random.PRNGKey(0), COUNT), moved, (), drawn)
    np.testing.assert_array_equal(seen[:, features.newest_columns(robot, made.form)], newest)
    assert not features.newest_columns(robot, single.form)


# --- in the environment ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def played():
    """Two rollouts of the `robot` preset's disturbances, faster than usual, and the environment before and after."""
    config, one = disturbed(), robots.load("unitree_g1")
    env = Env(one, motion.load("walk"), config, physics.make(one, config.physics, uneven=True))
    joints = one.joint_count

    def act(observation, key):
        return 0.3 * jax.random.normal(key, (len(observation), joints)), {"saw": observation}

    roll = jax.jit(lambda state, key: env.rollout(state, ActionRule(act), key, 8))
    start = env.reset(jax.random.PRNGKey(0))
    middle, first = roll(start, jax.random.PRNGKey(1))
    end, second = roll(middle, jax.random.PRNGKey(2))
    return env, (start, middle, end), (first, second), roll


def test_the_actor_sees_sensors_and_the_critic_the_truth(played):
    env, (start, *_), (first, second), _ = played
    assert isinstance(first.observation, Seen)
    sizes = env.observation_size
    assert sizes.actor == first.observation.actor.shape[-1] == 2 * 96
    # Compact observation, command, its errors, two actions on their way, their delay, robot and floor, uneven ground.
    assert sizes.critic == first.observation.critic.shape[-1] == 86 + 3 + 3 + 2 * 29 + 1 + 7 + 2
    assert first.next_observation.shape[-1] == sizes.critic
    np.testing.assert_array_equal(first.extras["saw"], first.observation.actor)
    clip = env.clip_observations
    assert (clip.actor.shape, clip.critic.shape) == ((env.clip_rows, sizes.actor), (env.clip_rows, sizes.critic))
    # What the critic sees next is what it then sees, where no episode ended.
    on = ~np.asarray(first.fell | first.timed_out)[:-1]
    np.testing.assert_allclose(
        np.asarray(first.next_observation)[:-1][on], np.asarray(first.observation.critic)[1:][on], atol=1e-5
    )
    assert on.any()


def test_robots_stay_the_same_and_episodes_do_not(played):
    _, (start, middle, end), (first, _), _ = played
    for a, b in zip(jax.tree.leaves(start.disturbed.body), jax.tree.leaves(end.disturbed.body), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(start.disturbed.bias, end.disturbed.bias)
    ended = np.asarray(first.fell | first.timed_out)
    assert ended.any()
    # The first action of an episode is preceded by none.
    again = ended[:-1]
    last = np.asarray(first.observation.actor)[1:][again][:, -29:]
    assert again.any() and not last.any()


def test_a_rollout_is_a_function_of_its_state(played):
    _, (_, middle, end), (_, second), roll = played
    kept = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), middle)
    again, record = roll(kept, jax.random.PRNGKey(2))
    for a, b in zip(jax.tree.leaves((end, second)), jax.tree.leaves((again, record)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_prior_sees_the_true_state(played):
    env, (_, _, end), (_, second), _ = played
    alive = ~np.asarray(second.fell | second.timed_out)[-1]
    true = features.observe(env.robot, end.physics.qpos, end.physics.qvel, "compact").frame
    np.testing.assert_allclose(np.asarray(second.frame)[-1][alive], np.asarray(true)[alive], atol=1e-5)
    assert alive.any()


def test_an_undisturbed_start_is_the_models_own(played):
    env, (start, *_), _, _ = played
    calm = env.undisturbed(start).disturbed
    assert not np.asarray(calm.bias).any() and not np.asarray(calm.sizes.noise).any()
    assert (np.asarray(calm.body.friction) == 1).all() and not np.asarray(calm.episode.delay).any()
    assert np.asarray(calm.episode.wait).min() > 100
    assert jax.tree.structure(calm) == jax.tree.structure(start.disturbed)
    assert DisturbanceConfig() == preset("laptop").disturbance
