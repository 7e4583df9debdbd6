"""Mirror images against a mirrored motion: what the robot observes there, and the joint targets."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import features, mirror, motion, robots, rotations
from fmpjax.actions import action_map
from fmpjax.errors import UserError
from fmpjax.motion import edit
from fmpjax.ppo import PPO, Batch
from fmpjax.trainer import Trainer
from tests.helpers import tiny


@pytest.mark.parametrize("form", ["full", "compact", "full heading", "compact heading"])
@pytest.mark.parametrize("name", ["unitree_g1", "unitree_g1_29dof", "strider"])
def test_the_image_of_an_observation_is_that_of_the_mirrored_motion(name, form):
    robot = robots.load(name)
    clip = motion.load("walk", robot=name)
    image = mirror.make(robot, form, action_map(robot, clip, "residual")).observation
    ours, theirs = (
        features.observation(robot, each.qpos[::9].astype(np.float32), each.qvel[::9].astype(np.float32), form)
        for each in (clip, edit.mirrored(robot, clip))
    )
    np.testing.assert_allclose(image(ours), theirs, atol=2e-4)
    assert np.abs(ours - theirs).max() > 0.1
    np.testing.assert_array_equal(image(image(ours)), ours)


def test_the_velocity_of_a_command_is_reflected(robot, walk):
    image = mirror.make(robot, "compact heading velocity", action_map(robot, walk, "absolute")).observation
    told = jnp.arange(1.0, 7.0)
    observed = jnp.concatenate([jnp.zeros(86), told])
    np.testing.assert_array_equal(image(observed)[-6:], [1, -2, -3, 4, -5, -6])


@pytest.mark.parametrize("kind", ["absolute", "residual"])
def test_mirrored_actions_have_mirrored_targets(robot, walk, kind):
    clip = dataclasses.replace(walk, qpos=walk.qpos[:31])  # its mean pose is not symmetric
    actions = action_map(robot, clip, kind)
    order, sign = edit.joint_mirror(robot)
    action = jnp.asarray(np.random.default_rng(0).normal(0, 0.2, (5, robot.joint_count)), jnp.float32)
    image = mirror.make(robot, "compact", actions).action
    np.testing.assert_allclose(actions(image(action)), sign * actions(action)[:, order], atol=1e-5)
    np.testing.assert_allclose(image(image(action)), action, atol=1e-5)


def test_what_has_no_image_is_refused(robot, walk):
    with pytest.raises(UserError, match="ppo.mirror is not 0: the mirror image of the observation's clip_phase is not"):
        Trainer(tiny(**{"ppo.mirror": 1.0, "command.kind": "phase"}), walk)


def test_the_image_of_what_sensors_see_is_that_of_the_mirrored_motion(robot, walk):
    """Two steps of history. The last actions are those that hold the joints where they are."""
    part = dataclasses.replace(walk, qpos=walk.qpos[:31])  # its mean pose is not symmetric
    actions = action_map(robot, part, "residual")
    image = mirror.make(robot, "deployable velocity history-2", actions).observation

    def sensed(clip, told):
        joints = clip.qpos[:, 7:] - actions.center
        down = rotations.rotate(rotations.conjugate(clip.qpos[:, 3:7]), np.array([0.0, 0.0, -1.0]))
        told = np.broadcast_to(told, (len(joints), 3))
        terms = clip.qvel[:, 3:6], down, told, joints, clip.qvel[:, 6:], joints / actions.scale
        return jnp.concatenate([each[i : len(each) - 1 + i] for each in terms for i in (0, 1)], axis=-1)

    ours = sensed(walk, [0.4, 0.1, 0.2])
    theirs = sensed(edit.mirrored(robot, walk), [0.4, -0.1, -0.2])
    np.testing.assert_allclose(image(ours), theirs, atol=2e-4)
    assert np.abs(ours - theirs).max() > 0.1


def test_a_policy_that_sees_less_than_the_critic_is_mirrored_too(walk):
    changes = {"ppo.mirror": 1.0, "env.observation": "deployable", "disturbance.friction": (0.5, 1.0)}
    trainer = Trainer(tiny(**changes), walk)
    _, figures = jax.eval_shape(trainer.iteration, trainer.shapes())
    assert "ppo/asymmetry" in figures


def taught(state, weight, width):
    """Changes of the mean action in states 0 and 1, each the other's mirror image, and the figures of an update.

    It rewards actions above their mean in one ``state``, whose mirror image has its numbers swapped and an opposite
    action.
    """
    config = dataclasses.replace(
        tiny().ppo, hidden=(32,), rollout_steps=8, actor_epochs=8, learning_rate=1e-3, bound_penalty=0.0, deviation=0.3
    )
    swapped = mirror.Reflection(np.array([1, 0]), np.ones(2), np.zeros(2))
    opposite = mirror.Reflection(np.array([0]), np.array([-1.0]), np.zeros(1))
    noise = jax.random.normal(jax.random.PRNGKey(1), (8, 64, 1))
    image = mirror.Mirror(swapped, opposite) if weight else None
    ppo = PPO(2, 1, dataclasses.replace(config, mirror=weight, mirror_width=width), mirror=image)
    start = ppo.init(jax.random.PRNGKey(0))
    seen = jnp.broadcast_to(jnp.asarray(state, jnp.float32), (8, 64, 2))
    mean, deviation = ppo.policy(start.actor, start.normalizer, seen)
    never = jnp.zeros((8, 64), bool)
    batch = Batch(seen, seen, mean + deviation * noise, mean, deviation, noise[..., 0], never, never)
    after, figures = jax.jit(ppo.update)(start, batch, jax.random.PRNGKey(2))
    states = jnp.array([state, state[::-1]], jnp.float32)
    before, now = (ppo.policy(actor, start.normalizer, states)[0] for actor in (start.actor, after.actor))
    return np.asarray(now - before)[:, 0], np.asarray(now)[:, 0], figures


@pytest.mark.parametrize("width", [0.0, 0.3])
def test_an_update_teaches_both_sides_what_was_seen_on_one(width):
    """A reward for actions above their mean, seen on one side alone: on the other side the mean falls as much."""
    (alone, _, plain), (shared, _, figures) = (taught([1.0, 0.0], weight, width) for weight in (0.0, 100.0))
    assert alone[0] > 0.01 and shared[0] > 0.01
    assert shared[1] < -0.5 * shared[0]
    assert alone[1] > -0.5 * alone[0]
    assert "asymmetry" not in plain and 0 < float(figures["asymmetry"]) < 1e-3


def test_a_symmetric_state_may_choose_a_side():
    """What is its own mirror image must have an action that is its own, unless such states do not count."""
    (_, held, _), (change, _, figures) = (taught([1.0, 1.0], 100.0, width) for width in (0.0, 0.3))
    assert np.abs(held).max() < 0.005
    assert change.min() > 0.01 and float(figures["asymmetry"]) == 0.0


@pytest.mark.parametrize(("distance", "share"), [(0.0, 0.0), (0.15, 0.2), (0.3, 0.5), (0.6, 0.8)])
def test_a_state_counts_in_the_mirror_loss_by_its_distance_from_its_image(distance, share):
    """Half at the width: d² / (d² + width²), with d the root mean square over the normalized observation."""
    ppo = PPO(2, 1, dataclasses.replace(tiny().ppo, mirror_width=0.3))
    normalizer = ppo.init(jax.random.PRNGKey(0)).normalizer
    seen = normalizer.mean + normalizer.std * jnp.array([[0.5, -0.5]])
    same = mirror.Reflection(np.arange(2), np.ones(2), np.asarray(normalizer.std * distance))
    ppo.mirror = mirror.Mirror(same, same)
    image, counted = ppo._mirrored(normalizer, seen)
    np.testing.assert_allclose(image - seen, [normalizer.std * distance], atol=1e-6)
    np.testing.assert_allclose(counted, [share], atol=1e-5)
