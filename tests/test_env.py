"""Episodes, resets and windows, on a physics of a few lines whose every step can be followed by hand."""

import functools
import math
import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import env as environments
from fmpjax import features, motion, physics, robots
from fmpjax.acting import ActionRule
from fmpjax.config import preset
from fmpjax.env import Env

HORIZON = 10
COUNT = 5
STEPS = 24
FALL, BREAK = 0.6, 0.9  # targets of the first joint above which the fake robot falls, and its numbers blow up


class FakePhysics:
    """The root moves by the first targets and the joints follow theirs half way.

    The first target also commands faults. A clock stands in the warm start; environment i's numbers blow up in the i-th
    of four ways when it reads 1002, which only a state that a test prepared ever does.
    """

    name = "fake"

    def step(self, state, targets):
        qpos, qvel, clock = state
        fall, broken = targets[:, :1] > FALL, targets[:, :1] > BREAK
        root = qpos[:, :3] + jnp.concatenate([0.02 * targets[:, :2], jnp.zeros_like(targets[:, :1])], axis=1)
        root = root.at[:, 2:].set(jnp.where(fall, 0.0, root[:, 2:]))
        joints = 0.5 * (qpos[:, 7:] + targets)
        qpos = jnp.concatenate([root, qpos[:, 3:7], joints], axis=1)
        qpos = jnp.where(broken, jnp.nan, qpos)
        qvel = jnp.where(broken, jnp.inf, 0.9 * qvel + 0.01)
        clock = clock + 1.0
        now, which = clock[:, 0] == 1003.0, jnp.arange(len(clock))
        qpos = qpos.at[:, 4].set(jnp.where(now & (which == 0), jnp.nan, qpos[:, 4]))
        qvel = qvel.at[:, 9].set(jnp.where(now & (which == 1), -jnp.inf, qvel[:, 9]))
        clock = clock.at[:, 3].set(jnp.where(now & (which == 2), jnp.nan, clock[:, 3]))
        qvel = qvel.at[:, 0].set(jnp.where(now & (which == 3), 2e3, qvel[:, 0]))
        return physics.PhysicsState(qpos, qvel, clock)


def policy_of(low, high):
    """Random actions; the first joint's, which commands the faults, in [low, high]."""

    def policy(observation, key):
        action = jax.random.uniform(key, (len(observation), JOINTS), minval=-0.4, maxval=0.4)
        first = jax.random.uniform(jax.random.fold_in(key, 1), (len(observation),), minval=low, maxval=high)
        return action.at[:, 0].set(first), {"mean": action, "deviation": jnp.ones_like(action)}

    return ActionRule(policy)


def _noise():
    """Actions that are random numbers."""
    return ActionRule(lambda _, noise: (noise, {}), lambda key, shape: jax.random.normal(key, (*shape, JOINTS)))


ROBOT = robots.load("unitree_g1")
JOINTS = ROBOT.joint_count
CLIP = motion.load("walk")


@functools.cache
def make(**changes):
    changes = {"count": COUNT, "first_cap": 500, "last_cap": 500} | changes
    built = Env(ROBOT, CLIP, preset("smoke", **{f"env.{k}": v for k, v in changes.items()}), FakePhysics())
    # Targets are the actions themselves, so that the fake physics reads its commands.
    ones = np.ones(JOINTS, np.float32)
    built.actions = environments.ActionMap(0 * ones, ones, -2 * ones, 2 * ones)
    return built


@functools.cache
def compiled(built):
    return jax.jit(lambda state, key, low, high: built.rollout(state, policy_of(low, high), key, STEPS))


class Rolled(NamedTuple):
    env: Env
    states: list  # before each rollout, and the last
    records: list


def roll(built, rollouts, *, low=-0.5, high=0.5, seed=0, start=None):
    states, records = [start or built.reset(jax.random.PRNGKey(seed))], []
    for i in range(rollouts):
        state, record = compiled(built)(states[-1], jax.random.PRNGKey(100 * seed + i), low, high)
        states.append(state)
        records.append(record)
    return Rolled(built, states, records)


def capped():
    """The environment that most tests share: a cap of 12 steps."""
    return make(first_cap=12, episode_steps=12)


@pytest.fixture(scope="module")
def falling():
    """Six rollouts with falls at random."""
    return roll(capped(), 6, high=0.65)


@pytest.fixture(scope="module")
def breaking():
    """Two rollouts in which numbers now and then blow up."""
    return roll(capped(), 2, high=0.95, seed=3)


@pytest.fixture(scope="module")
def growing():
    """Forty rollouts under the fixed-pose regime with a cap that grows from 4 steps to 8."""
    return roll(make(reset="fixed", first_cap=4, episode_steps=8, cap_patience=2), 40)


@functools.cache
def clip_table():
    """States, frames and observations of the demonstration and, last, the default pose."""
    qpos = np.concatenate([CLIP.qpos, ROBOT.default_qpos[None]]).astype(np.float32)
    qvel = np.concatenate([CLIP.qvel, np.zeros((1, 6 + JOINTS))]).astype(np.float32)
    return qpos, qvel, observe(qpos, qvel)


@jax.jit
def observe_on_device(qpos, qvel):
    return features.observe(ROBOT, qpos, qvel, "compact")


def observe(qpos, qvel):
    """Observations of states, not by way of the environment."""
    return jax.tree.map(np.asarray, observe_on_device(qpos, qvel))


# --- resets ----------------------------------------------------------------------------------------------------------


def test_dataset_reset_starts_at_demonstration_states_with_their_own_history():
    built = make(count=200)
    state = built.reset(jax.random.PRNGKey(0))
    qpos, qvel, table = clip_table()
    rows = []
    for i in range(200):
        row = np.flatnonzero((qpos == np.asarray(state.physics.qpos[i])).all(1))[0]
        rows.append(row)
        np.testing.assert_array_equal(state.physics.qvel[i], qvel[row])
        np.testing.assert_allclose(state.history[i], table.frame[row - HORIZON + 1 : row + 1], atol=1e-6)
        np.testing.assert_allclose(state.observed.actor[i], table.actor[row], atol=1e-6)
    # Every time with a whole history, the demonstration's last state included, and no other.
    assert min(rows) >= HORIZON - 1 and max(rows) <= len(CLIP) - 1 and len(set(rows)) > 120
    many = np.asarray(built.reset_rows(jax.random.PRNGKey(1), 20_000))
    assert sorted(set(many.tolist())) == list(range(HORIZON - 1, len(CLIP)))
    assert not np.any(state.age) and not np.any(state.physics.warmstart)


@pytest.mark.parametrize("reset", ["dataset", "fixed"])
def test_reset_noise_moves_joints_alone_and_is_seen(reset):
    """Angles by 0.05 rad and velocities by 0.5 rad/s; the history stays the demonstration's."""
    built, count = make(count=400, reset=reset, reset_noise=0.05), 400
    key = jax.random.PRNGKey(0)
    state, exact = built.reset(key), built.start_at(built.reset_rows(key, count))
    qpos, qvel, _ = clip_table()
    assert (qpos[:, None] == np.asarray(exact.physics.qpos[:5])[None]).all(2).any(0).all()
    off, fast = state.physics.qpos - exact.physics.qpos, state.physics.qvel - exact.physics.qvel
    assert not off[:, :7].any() and not fast[:, :6].any()
    # Standard errors of a deviation of 400 x 29 numbers: 0.7 %.
    np.testing.assert_allclose([off[:, 7:].std(), fast[:, 6:].std()], [0.05, 0.5], rtol=0.03)
    assert abs(np.corrcoef(off[:, 7:].ravel(), fast[:, 6:].ravel())[0, 1]) < 0.04
    seen = observe(np.asarray(state.physics.qpos), np.asarray(state.physics.qvel))
    np.testing.assert_allclose(state.observed.actor, seen.actor, atol=1e-5)
    np.testing.assert_array_equal(state.history, exact.history)


def test_reset_noise_is_fresh_at_every_fall():
    built = make(reset="fixed", reset_noise=0.05, episode_steps=4, first_cap=4, last_cap=4)
    state = built.reset(jax.random.PRNGKey(0))
    _, record = compiled(built)(state, jax.random.PRNGKey(1), -0.4, -0.3)
    first = np.asarray(record.observation)[np.asarray(record.length) == 1]
    assert len(first) == COUNT * STEPS / 4
    assert len(np.unique(first.round(5), axis=0)) == len(first)


def test_fixed_reset_repeats_the_default_pose_with_soles_in_the_floor():
    built = make(reset="fixed")
    state = built.reset(jax.random.PRNGKey(0))
    _, _, table = clip_table()
    for i in range(COUNT):
        np.testing.assert_array_equal(state.physics.qpos[i], ROBOT.default_qpos.astype(np.float32))
        assert not np.any(state.physics.qvel[i])
        np.testing.assert_allclose(state.history[i], np.repeat(table.frame[-1:], HORIZON, 0), atol=1e-6)
        sunk = -robots.lowest_sole(ROBOT, np.asarray(state.physics.qpos[i], np.float64))
        assert sunk == pytest.approx(robots.CONTACT_DEPTH, abs=1e-6)


def test_resets_within_a_rollout_follow_the_regime(growing):
    _, _, table = clip_table()
    record = jax.tree.map(np.asarray, growing.records[0])
    assert record.timed_out[3].all() and record.timed_out.sum() == COUNT * (STEPS // 4)
    after = record.observation[1:][record.timed_out[:-1]]
    np.testing.assert_allclose(after, np.broadcast_to(table.actor[-1], after.shape), atol=1e-6)
    frames = np.asarray(growing.env.frame_table(growing.states[0], growing.records[0]))[record.window]
    older = frames[4, :, :-1]
    np.testing.assert_allclose(older, np.broadcast_to(table.frame[-1], older.shape), atol=1e-6)


# --- windows ---------------------------------------------------------------------------------------------------------


def test_windows_equal_an_independent_history(falling):
    """A loop in NumPy that knows only actions and reset states rebuilds every window of six rollouts."""
    qpos_table, qvel_table, table = clip_table()
    step = jax.jit(FakePhysics().step)

    start = falling.states[0]
    sim = jax.tree.map(np.array, start.physics)
    rows = [np.flatnonzero((qpos_table == q).all(1))[0] for q in sim.qpos]
    history = [list(table.frame[r - HORIZON + 1 : r + 1]) for r in rows]
    checked = after_reset = 0
    fresh = np.ones(COUNT, bool)
    for state, record, follow in zip(falling.states[:-1], falling.records, falling.states[1:], strict=True):
        frames = np.asarray(falling.env.frame_table(state, record))
        windows = frames[np.asarray(record.window)]
        record = jax.tree.map(np.asarray, record)
        for t in range(STEPS):
            sim = jax.tree.map(np.array, step(sim, record.action[t]))
            frame = observe(sim.qpos, sim.qvel).frame
            for i in range(COUNT):
                history[i] = [*history[i][1:], frame[i]]
                np.testing.assert_allclose(windows[t, i], np.stack(history[i]), atol=2e-5)
                # The window's end is the state just reached, before any reset.
                np.testing.assert_array_equal(windows[t, i, -1], record.frame[t, i])
                checked, after_reset = checked + 1, after_reset + fresh[i]
                fresh[i] = record.fell[t, i] or record.timed_out[t, i]
                if fresh[i] and t + 1 < STEPS:
                    # Strides look alike in observations, which know no place: the root's x tells them apart.
                    alike = np.abs(table.actor - record.observation[t + 1, i]).max(1) < 1e-5
                    x = record.frame[t + 1, i, 0] - 0.02 * record.action[t + 1, i, 0]
                    row = int(np.where(alike, np.abs(qpos_table[:, 0] - x), np.inf).argmin())
                    assert alike[row] and abs(qpos_table[row, 0] - x) < 1e-5 and HORIZON - 1 <= row < len(CLIP)
                    history[i] = list(table.frame[row - HORIZON + 1 : row + 1])
                    sim.qpos[i], sim.qvel[i] = qpos_table[row], qvel_table[row]
        # A reset on the last step shows only in the state that the rollout leaves.
        for i in np.flatnonzero(fresh):
            row = int(np.flatnonzero((qpos_table == np.asarray(follow.physics.qpos[i])).all(1))[0])
            history[i] = list(table.frame[row - HORIZON + 1 : row + 1])
            sim.qpos[i], sim.qvel[i] = qpos_table[row], qvel_table[row]
        np.testing.assert_allclose(follow.history, np.stack([np.stack(h) for h in history]), atol=2e-5)
        np.testing.assert_allclose(follow.physics.qpos, sim.qpos, atol=1e-6)
    assert checked == 6 * STEPS * COUNT and after_reset > 20


def test_a_window_never_crosses_a_reset(falling):
    """A window holds as many frames of its rollout as the episode has steps in it; the others are older."""
    during = len(CLIP) + 1 + COUNT * HORIZON
    steps = np.arange(1, STEPS + 1)[:, None]
    for record in falling.records:
        window, length = np.asarray(record.window), np.asarray(record.length)
        own = window >= during
        np.testing.assert_array_equal(own.sum(-1), np.minimum(np.minimum(length, steps), HORIZON))
        np.testing.assert_array_equal(np.sort(own, -1), own)  # the newest ones, at the end
        for i in range(COUNT):
            assert ((window[:, i][own[:, i]] - during) % COUNT == i).all()


def test_lengths_count_steps_since_the_reset(falling):
    age = np.zeros(COUNT, int)
    for state, record in zip(falling.states[1:], falling.records, strict=True):
        for t in range(STEPS):
            age += 1
            np.testing.assert_array_equal(record.length[t], age)
            age[np.asarray(record.fell[t] | record.timed_out[t])] = 0
        np.testing.assert_array_equal(state.age, age)


# --- ends of episodes ------------------------------------------------------------------------------------------------


def test_falls_and_time_outs_are_where_they_were_commanded(falling):
    for record in falling.records:
        commanded = np.asarray(record.action)[..., 0] > FALL
        np.testing.assert_array_equal(record.fell, commanded)
        np.testing.assert_array_equal(record.timed_out, (np.asarray(record.length) >= 12) & ~commanded)
        assert not np.any(record.nonfinite) and np.asarray(record.length).max() <= 12
    assert sum(np.asarray(r.fell).sum() for r in falling.records) > 10
    assert sum(np.asarray(r.timed_out).sum() for r in falling.records) > 5


def test_next_observation_is_the_true_one(falling):
    for record in falling.records:
        done = np.asarray(record.fell | record.timed_out)[:-1]
        following, after = np.asarray(record.next_observation)[:-1], np.asarray(record.observation)[1:]
        np.testing.assert_array_equal(following[~done], after[~done])
        assert (np.abs(following[done] - after[done]).max(-1) > 1e-3).all()
        # A fallen robot is seen on the floor (the first number is the root's height), not at its reset.
        fell = np.asarray(record.fell)[:-1]
        assert (following[fell][:, 0] == 0.0).all() and (after[fell][:, 0] > 0.5).all()


def test_fall_on_the_step_of_the_cap_is_a_fall(falling):
    both = 0
    for record in falling.records:
        last = (np.asarray(record.length) == 12) & (np.asarray(record.action)[..., 0] > FALL)
        assert np.asarray(record.fell)[last].all() and not np.asarray(record.timed_out)[last].any()
        both += last.sum()
    assert both, "no fall was commanded on the step of the cap"


def test_a_real_fall_is_seen():
    """A robot on its back, knees off the floor: the torso touches, so it has fallen; standing it has not."""
    lying = ROBOT.default_qpos.copy()
    lying[2], lying[3:7] = 0.08, [math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0]
    qpos = np.stack([lying, ROBOT.default_qpos]).astype(np.float32)
    seen = observe(qpos, np.zeros((2, 6 + JOINTS), np.float32))
    np.testing.assert_array_equal(seen.fallen, [True, False])


# --- the cap ---------------------------------------------------------------------------------------------------------


def grow(built, state, fell, timed_out):
    """One rollout's worth of episode ends through the growth rule."""
    record = environments.Steps(*[None] * len(environments.Steps._fields))
    return built._grow_cap(state, record._replace(fell=jnp.asarray(fell), timed_out=jnp.asarray(timed_out)))


def test_cap_grows_by_a_quarter_rounded_up_to_the_full_length():
    built = make(first_cap=64, episode_steps=500)
    state, caps, ages = built.reset(jax.random.PRNGKey(0)), [64.0], [0]
    for rollout in range(1, 400):
        state = grow(built, state, [False, False], [True, True])
        if float(state.cap) != caps[-1]:
            caps.append(float(state.cap))
            ages.append(rollout)
    assert caps == [64, 80, 100, 125, 157, 197, 247, 309, 387, 484, 500]
    # The share passes 3/4 after 14 rollouts (1 - 0.9^14 = 0.77), patience after 25; then every 25 rollouts.
    assert ages == [25 * i for i in range(len(caps))]


def test_cap_share_is_a_running_mean_over_rollouts_in_which_episodes_end():
    built = make(first_cap=64, episode_steps=500, cap_patience=1)
    state = built.reset(jax.random.PRNGKey(0))
    rng = np.random.default_rng(0)
    share, cap = 0.0, 64.0
    for _ in range(120):
        ends = rng.random((3, 8))
        timed_out, fell = ends < 0.3 * rng.random(), ends > 0.97
        ended = timed_out.sum() + fell.sum()
        if ended:
            share = 0.9 * share + 0.1 * timed_out.sum() / ended
        if share > 0.75 and cap < 500:
            cap = min(math.ceil(cap * 1.25), 500)
        state = grow(built, state, fell, timed_out)
        np.testing.assert_allclose(float(state.capped_share), share, rtol=1e-5)
        assert float(state.cap) == cap
    assert cap > 64


def test_cap_stays_below_the_share():
    built = make(first_cap=64, episode_steps=500, cap_patience=1)
    state = built.reset(jax.random.PRNGKey(0))
    for _ in range(100):
        state = grow(built, state, [True, False, False, False], [False, True, True, True])  # exactly 3/4 time out
    assert float(state.cap) == 64.0


def test_cap_at_the_full_length_never_moves():
    built = make(first_cap=500, episode_steps=500, cap_patience=1)
    state = built.reset(jax.random.PRNGKey(0))
    for _ in range(60):
        state = grow(built, state, [False], [True])
    assert float(state.cap) == 500.0


def test_cap_grows_after_a_rollout_and_holds_from_the_next(growing):
    caps = [float(s.cap) for s in growing.states]
    assert caps[0] == 4.0 and caps[-1] == 8.0 and sorted(set(caps)) == [4.0, 5.0, 7.0, 8.0]
    for i, record in enumerate(growing.records):
        ends, length = np.asarray(record.timed_out), np.asarray(record.length)
        # Episodes end at their rollout's cap, not at the one that grows out of it.
        assert ends.any() and (length[ends] == caps[i]).all()


# --- numbers that are not finite -------------------------------------------------------------------------------------


def test_nonfinite_states_are_counted_reset_and_contained(breaking):
    for state, record in zip(breaking.states[1:], breaking.records, strict=True):
        broken = np.asarray(record.action)[..., 0] > BREAK
        np.testing.assert_array_equal(record.nonfinite, broken)
        assert np.asarray(record.fell)[broken].all() and not np.asarray(record.timed_out)[broken].any()
        for leaf in jax.tree.leaves((state, record, breaking.env.frame_table(state, record))):
            assert np.isfinite(np.asarray(leaf, np.float64)).all()
        # The next step begins at a demonstration state.
        _, _, table = clip_table()
        after = np.asarray(record.observation)[1:][broken[:-1]]
        gap = np.abs(after[:, None] - table.actor[None]).max(-1).min(-1)
        assert (gap < 1e-6).all() and len(gap)
    assert sum(np.asarray(r.nonfinite).sum() for r in breaking.records) > 2


def test_every_kind_of_blow_up_is_contained_and_its_state_is_kept():
    """Environments 0 to 3 break at their third step, each in another way; the fifth never notices."""
    built = capped()
    calm = roll(built, 1, seed=5)
    start = calm.states[0]
    clock = start.physics.warmstart.at[:4].add(1000.0)
    struck = roll(built, 1, seed=5, start=start._replace(physics=start.physics._replace(warmstart=clock)))
    a, b = (jax.tree.map(np.asarray, x.records[0]) for x in (calm, struck))
    expected = np.zeros((STEPS, COUNT), bool)
    expected[2, :4] = True
    np.testing.assert_array_equal(b.nonfinite, expected)
    np.testing.assert_array_equal(b.fell, expected)
    for one, two in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(one[:, 4], two[:, 4])
        np.testing.assert_array_equal(one[:2], two[:2])
    for leaf in jax.tree.leaves((struck.states[-1], b, built.frame_table(start, struck.records[0]))):
        assert np.isfinite(np.asarray(leaf, np.float64)).all()
    # What is recorded of a blow-up is the state before it.
    np.testing.assert_array_equal(b.frame[2, :4], b.frame[1, :4])
    # The state before the first one's blow-up, and its action, are kept to be looked at.
    offender = struck.states[-1].offender
    np.testing.assert_array_equal(offender.action, b.action[2, 0])
    np.testing.assert_allclose(observe(offender.qpos[None], offender.qvel[None]).frame[0], b.frame[1, 0], atol=1e-5)
    assert not np.any(calm.states[-1].offender.qpos)


# --- action maps -----------------------------------------------------------------------------------------------------


def test_absolute_actions_are_joint_angles_around_zero():
    actions = environments.action_map(ROBOT, CLIP, "absolute")
    reach = 1.4 * np.maximum(np.abs(ROBOT.joint_low), np.abs(ROBOT.joint_high))
    for a in (-1.0, -0.3, 0.0, 0.5, 1.0):
        np.testing.assert_allclose(actions(jnp.full((2, JOINTS), a)), np.stack([a * reach] * 2), rtol=1e-6)
    # Clipped to the map's own reach, which is beyond the joints' range, not to that range.
    np.testing.assert_allclose(actions(jnp.full(JOINTS, 7.0)), reach, rtol=1e-6)
    np.testing.assert_allclose(actions(jnp.full(JOINTS, -7.0)), -reach, rtol=1e-6)
    assert (reach > ROBOT.joint_high).all()


def test_residual_actions_turn_around_the_mean_pose():
    actions = environments.action_map(ROBOT, CLIP, "residual")
    mean, scale = CLIP.qpos[:, 7:].mean(0), 0.25 * ROBOT.effort / ROBOT.stiffness
    np.testing.assert_allclose(actions(jnp.zeros(JOINTS)), mean, atol=1e-6)
    small = jnp.full(JOINTS, 0.2)
    inside = (mean + 0.2 * scale > ROBOT.joint_low) & (mean + 0.2 * scale < ROBOT.joint_high)
    np.testing.assert_allclose(np.asarray(actions(small))[inside], (mean + 0.2 * scale)[inside], atol=1e-6)
    np.testing.assert_allclose(actions(jnp.full(JOINTS, 1e3)), ROBOT.joint_high + 0.3, atol=1e-6)
    np.testing.assert_allclose(actions(jnp.full(JOINTS, -1e3)), ROBOT.joint_low - 0.3, atol=1e-6)


def test_actions_reach_the_physics_through_the_map():
    class Records(FakePhysics):
        def step(self, state, targets):
            return state._replace(qpos=state.qpos.at[:, 7:].set(targets))

    built = Env(ROBOT, CLIP, preset("smoke", **{"env.count": COUNT}), Records())
    action = jax.random.uniform(jax.random.PRNGKey(0), (COUNT, JOINTS), minval=-3, maxval=3)
    sim = built.advance(built.reset(jax.random.PRNGKey(1)).physics, action).physics
    np.testing.assert_array_equal(sim.qpos[:, 7:], environments.action_map(ROBOT, CLIP, "residual")(action))


def test_every_step_of_a_rollout_has_random_numbers_of_its_own():
    """Drawn for all steps at once, they are those that each step would draw from its own key."""
    built, key = make(), jax.random.PRNGKey(5)
    policy = ActionRule(
        lambda observation, noise: (noise, {}), lambda key, shape: jax.random.normal(key, (*shape, JOINTS))
    )
    _, record = built.rollout(built.reset(key), policy, key, 4)
    for step_key, action in zip(jax.random.split(key, 4), record.action, strict=True):
        policy_key, _ = jax.random.split(step_key)
        np.testing.assert_array_equal(action, jax.random.normal(policy_key, (COUNT, JOINTS)))


def test_a_step_launches_few_kernels():
    """A launch costs microseconds, whatever it computes: a step of 575 was a fifth of an iteration."""
    native = Env(ROBOT, CLIP, preset("laptop"), physics.make(ROBOT, preset("laptop").physics))
    state = jax.eval_shape(native.reset, jax.random.PRNGKey(0))
    policy = ActionRule(
        lambda observation, noise: (noise, {}), lambda key, shape: jax.random.normal(key, (*shape, JOINTS))
    )

    def launches(steps):
        program = jax.jit(lambda state, key: native.rollout(state, policy, key, steps))
        text = program.lower(state, jax.random.PRNGKey(0)).compile().as_text()
        loop = max(re.split(r"\n\n", text), key=lambda computation: computation.count("ffi_call"))
        return len(re.findall(r" (?:fusion|copy|concatenate|dot|custom-call|while|call)\(", loop))

    assert launches(4) <= 80
