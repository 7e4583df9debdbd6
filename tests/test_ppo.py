"""PPO on probe environments whose values and optima are known, and each rule of the update on its own."""

import dataclasses
import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax.acting import Seen
from fmpjax.config import PPOConfig, preset
from fmpjax.ppo import PPO, Batch, adapt_rate, generalized_advantage

STEPS, COUNT = 8, 16
PROBE = dataclasses.replace(
    PPOConfig(),
    rollout_steps=STEPS,
    hidden=(32,),
    activation="tanh",
    optimizer="adam",
    learning_rate=3e-3,
    deviation=0.3,
    critic_epochs=4,
    actor_epochs=4,
    critic_batch=2,
    actor_batch=2,
    discount=0.5,
    bound_penalty=0.0,
)


class Probe(NamedTuple):
    """An environment of one action: what is seen, what follows, and reward - cost * (action - wanted)^2; ``[T, N]``."""

    observation: jax.Array
    next_observation: jax.Array
    fell: jax.Array
    timed_out: jax.Array
    reward: jax.Array
    cost: jax.Array
    wanted: jax.Array


def probe(observation, fell, *, following=None, timed_out=None, reward=0.0, cost=0.0, wanted=0.0):
    observation = ONES * observation
    return Probe(
        observation[..., None],
        (observation if following is None else ONES * following)[..., None],
        fell,
        NO if timed_out is None else timed_out,
        *(ONES * x for x in (reward, cost, wanted)),
    )


def batch_of(ppo, state, key, env):
    """A rollout of the present policy in a probe environment."""
    action, extras = ppo.act(state)(env.observation, key)
    reward = env.reward - env.cost * (action[..., 0] - env.wanted) ** 2
    return Batch(
        env.observation,
        env.next_observation,
        action,
        extras["mean"],
        extras["deviation"],
        reward,
        env.fell,
        env.timed_out,
    )


def test_hidden_layers_start_as_pytorch_starts_them():
    """Uniform within 1 / sqrt(inputs), biases zero; the mean's weights within their own bound."""
    ppo = PPO(25, 3, dataclasses.replace(PPOConfig(), hidden=(256, 64)))
    state = ppo.init(jax.random.PRNGKey(0))
    for params in (state.actor, state.critic):
        layers = [p for p in jax.tree.leaves(params) if p.ndim == 2]
        for inputs in (25, 256):
            (kernel,) = (p for p in layers if p.shape[0] == inputs)
            assert 0.97 * inputs**-0.5 < float(jnp.abs(kernel).max()) <= inputs**-0.5
        last = 0.01 if params is state.actor else 64**-0.5
        (kernel,) = (p for p in layers if p.shape[0] == 64)
        assert 0.5 * last < float(jnp.abs(kernel).max()) <= last


@functools.cache
def make(**changes):
    """PPO, its state at the start, and its compiled update."""
    ppo = PPO(1, 1, dataclasses.replace(PROBE, **changes))
    return ppo, ppo.init(jax.random.PRNGKey(0)), jax.jit(ppo.update)


def whole_batch(**changes):
    """PPO that takes a single descent step on the whole rollout in each phase."""
    return make(**({"actor_batch": STEPS, "critic_batch": STEPS, "actor_epochs": 1, "critic_epochs": 1} | changes))


@functools.cache
def _trained(ppo, updates):
    def one(carry, key):
        state, env = carry
        batch_key, update_key = jax.random.split(key)
        state, metrics = ppo.update(state, batch_of(ppo, state, batch_key, env), update_key)
        return (state, env), metrics

    return jax.jit(lambda s, env, keys: jax.lax.scan(one, (s, env), keys))


def train(env, *, updates=150, **changes):
    """PPO, its state after training in a probe environment, and the course of its metrics."""
    ppo, state, _ = make(**changes)
    (state, _), metrics = _trained(ppo, updates)(state, env, jax.random.split(jax.random.PRNGKey(1), updates))
    return ppo, state, metrics


def full(value):
    return jnp.full((STEPS, COUNT), value)


ZEROS, ONES = full(0.0), full(1.0)
NO, YES = full(False), full(True)


# Half of the environments see +1, the others -1.
SIGN = jnp.where(jnp.arange(COUNT) % 2 == 0, 1.0, -1.0) * ONES


# --- advantages ------------------------------------------------------------------------------------------------------


def slow_advantage(reward, value, next_value, fell, timed_out, discount, gae_lambda):
    """Generalized advantages as a sum over what follows, term by term."""
    steps, count = reward.shape
    out = np.zeros((steps, count))
    for i in range(count):
        for t in range(steps):
            weight = 1.0
            for s in range(t, steps):
                ahead = 0.0 if fell[s, i] else next_value[s, i]
                out[t, i] += weight * (reward[s, i] + discount * ahead - value[s, i])
                if fell[s, i] or timed_out[s, i]:
                    break
                weight *= discount * gae_lambda
    return out


@pytest.mark.parametrize("gae_lambda", [0.0, 0.95, 1.0])
def test_advantages_equal_a_slow_loop(gae_lambda):
    rng = np.random.default_rng(0)
    reward, value, next_value = rng.normal(size=(3, 40, 6)).astype(np.float32)
    ends = rng.random((40, 6))
    fell, timed_out = ends < 0.1, ends > 0.9
    ours = generalized_advantage(reward, value, next_value, fell, timed_out, 0.99, gae_lambda)
    slow = slow_advantage(reward, value, next_value, fell, timed_out, 0.99, gae_lambda)
    np.testing.assert_allclose(ours, slow, atol=1e-4)


@pytest.mark.parametrize("seed", [0, 1])
def test_advantage_plus_value_is_the_td_lambda_return(data, seed):
    """Against recorded TD(0.95) returns; within an episode V(s_t+1) is step t's next value, elsewhere it is free."""
    case = np.load(data / "features.npz")
    reward, next_value = case["td_reward"], case["td_next_value"]
    fell, timed_out = case["td_fell"], case["td_timeout"]
    assert fell.any() and timed_out.any() and not (fell & timed_out).any()
    value = np.random.default_rng(seed).normal(scale=3.0, size=reward.shape)
    value[1:] = np.where((fell | timed_out)[:-1], value[1:], next_value[:-1])
    arrays = (jnp.asarray(x, jnp.float32) for x in (reward, value, next_value))
    advantage = generalized_advantage(*arrays, fell, timed_out, 0.99, 0.95)
    np.testing.assert_allclose(advantage + value, case["td_lambda_return"], atol=2e-4)


def test_nothing_leaks_across_an_end():
    reward, value, next_value = np.random.default_rng(0).normal(size=(3, 10, 1)).astype(np.float32)
    for how in ("fell", "timed_out"):
        ends = {"fell": np.zeros((10, 1), bool), "timed_out": np.zeros((10, 1), bool)}
        ends[how][4] = True
        before = generalized_advantage(reward, value, next_value, **ends, discount=0.99, gae_lambda=0.95)
        changed = reward.copy()
        changed[5:] += 100.0
        after = generalized_advantage(changed, value, next_value, **ends, discount=0.99, gae_lambda=0.95)
        np.testing.assert_array_equal(before[:5], after[:5])
        assert (np.abs(before[5:] - after[5:]) > 1).all()
        # The value beyond a time-out counts, the one beyond a fall does not.
        moved = next_value.copy()
        moved[4] += 1.0
        gain = generalized_advantage(reward, value, moved, **ends, discount=0.99, gae_lambda=0.95) - before
        np.testing.assert_allclose(gain[4], 0.99 if how == "timed_out" else 0.0, atol=1e-5)


def test_a_fall_is_worth_what_it_is_said_to_be():
    """A fall at the last of three steps, rewards of one, discount 1/2, lambda 1, no critic."""
    zero, fell = np.zeros((3, 1), np.float32), np.array([[False], [False], [True]])
    next_value = np.array([[0.0], [0.0], [7.0]], np.float32)  # the critic's of a fallen state is not asked for
    returns = generalized_advantage(zero + 1.0, zero, next_value, fell, zero > 0, 0.5, 1.0, fall_value=-8.0)
    # Backward: 1 - 8 / 2 = -3; 1 - 3 / 2 = -0.5; 1 - 0.5 / 2 = 0.75.
    np.testing.assert_allclose(returns[:, 0], [0.75, -0.5, -3.0], atol=1e-6)


# --- probe environments ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fell", "timed_out", "expected"),
    [
        pytest.param(YES, NO, 1.0, id="one-step episodes that end in a fall: r"),
        pytest.param(NO, YES, 2.0, id="one-step episodes cut by time: r / (1 - discount)"),
        pytest.param(NO, NO, 2.0, id="no end: r / (1 - discount)"),
    ],
)
def test_value_of_a_constant_reward(fell, timed_out, expected):
    ppo, state, metrics = train(probe(1.0, fell, timed_out=timed_out, reward=1.0))
    np.testing.assert_allclose(ppo.value(state, jnp.ones((1, 1))), expected, atol=0.02)
    assert metrics["critic_loss"][-1] < 1e-3


def test_value_of_a_reward_that_the_observation_tells():
    ppo, state, metrics = train(probe(SIGN, YES, reward=3.0 * SIGN))
    np.testing.assert_allclose(ppo.value(state, jnp.array([[1.0], [-1.0]])), [3.0, -3.0], atol=0.05)
    assert metrics["explained_variance"][-1] > 0.99


def test_value_of_a_reward_one_step_away():
    """Observation 0, nothing, observation 1, reward 1, end: worth the discount at first, then 1."""
    late = jnp.broadcast_to((jnp.arange(STEPS) % 2 == 1)[:, None], (STEPS, COUNT))
    ppo, state, _ = train(probe(1.0 * late, late, following=1.0, reward=1.0 * late))
    np.testing.assert_allclose(ppo.value(state, jnp.array([[0.0], [1.0]])), [0.5, 1.0], atol=0.02)


def test_value_of_a_reward_that_only_the_clock_tells():
    """Eight steps that look alike, reward 1 at the last, then a fall: the critic must know how many are over."""
    ppo = PPO(1, 1, PROBE, clock=STEPS)
    last = jnp.broadcast_to((jnp.arange(STEPS) == STEPS - 1)[:, None], (STEPS, COUNT))
    age = jnp.broadcast_to(1 + jnp.arange(STEPS)[:, None], (STEPS, COUNT))
    env = probe(1.0, last, following=1.0, reward=1.0 * last)

    def one(state, key):
        return ppo.update(state, batch_of(ppo, state, key, env)._replace(age=age), key)[0], None

    keys = jax.random.split(jax.random.PRNGKey(1), 150)
    state, _ = jax.jit(lambda state: jax.lax.scan(one, state, keys))(ppo.init(jax.random.PRNGKey(0)))
    over = jnp.arange(STEPS)
    np.testing.assert_allclose(ppo.value(state, jnp.ones((STEPS, 1)), over), 0.5 ** (7 - over), atol=0.1)


def test_policy_finds_the_rewarded_action():
    ppo, state, _ = train(probe(1.0, YES, cost=1.0, wanted=0.5))
    mean, _ = ppo.policy(state.actor, state.normalizer, jnp.ones((1, 1)))
    np.testing.assert_allclose(mean, [[0.5]], atol=0.08)


def test_policy_finds_the_action_that_the_observation_asks_for():
    ppo, state, _ = train(probe(SIGN, YES, cost=1.0, wanted=0.5 * SIGN))
    mean, _ = ppo.policy(state.actor, state.normalizer, jnp.array([[1.0], [-1.0]]))
    np.testing.assert_allclose(mean[:, 0], [0.5, -0.5], atol=0.1)


# --- the actor's loss ------------------------------------------------------------------------------------------------


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def random_batch(ppo, state, seed=0):
    keys = jax.random.split(jax.random.PRNGKey(seed), 3)
    observation, reward = jax.random.normal(keys[0], (2, STEPS, COUNT))
    return batch_of(ppo, state, keys[1], probe(observation, YES, reward=reward))


def test_advantages_are_normalized_and_clipped():
    """At ratio one the surrogate is minus the mean gain, which is zero unless outliers are clipped."""
    ppo, state, update = whole_batch()
    batch = random_batch(ppo, state)
    assert abs(update(state, batch, jax.random.PRNGKey(0))[1]["actor_loss"]) < 1e-5
    reward = batch.reward.at[3, 5].set(200.0)
    value = np.asarray(ppo.value(state, batch.observation))
    advantage = np.asarray(reward) - value
    gain = (advantage - advantage.mean()) / advantage.std()
    assert gain.max() > 10
    metrics = update(state, batch._replace(reward=reward), jax.random.PRNGKey(0))[1]
    np.testing.assert_allclose(metrics["actor_loss"], -np.clip(gain, -4, 4).mean(), rtol=1e-3)
    np.testing.assert_allclose(metrics["advantage_deviation"], advantage.std(), rtol=1e-4)


@pytest.mark.parametrize(("sign", "moves"), [(1.0, False), (-1.0, True)])
def test_ratio_clip(sign, moves):
    """Nothing pulls where the ratio has gone the advantage's way by more than the clip; everything does elsewhere."""
    ppo, state, update = whole_batch()
    batch = random_batch(ppo, state)
    good = jnp.where(jnp.arange(COUNT) % 2 == 0, 1.0, -1.0) * ONES
    # The policy that acted stood a deviation off the present one: its own mean has become e^0.5 times rarer, the
    # present mean as much more frequent.
    elsewhere = batch.mean + batch.deviation
    raised = good[..., None] * sign > 0
    batch = batch._replace(action=jnp.where(raised, batch.mean, elsewhere), mean=elsewhere, reward=10.0 * good)
    new, metrics = update(state, batch, jax.random.PRNGKey(0))
    np.testing.assert_allclose(metrics["clipped"], 1.0)
    assert same(new.actor, state.actor) != moves


def test_bound_penalty_pulls_only_beyond_one():
    ppo, state, plain = whole_batch()
    _, _, penalized = whole_batch(bound_penalty=10.0)

    def with_mean(value):
        params = jax.tree.map(lambda x: x, state.actor)
        params["params"]["Dense_0"] = jax.tree.map(jnp.zeros_like, params["params"]["Dense_0"])
        params["params"]["Dense_0"]["bias"] += value
        return state._replace(actor=params)

    for value in (-1.5, -0.99, 0.0, 0.99, 1.5):
        start = with_mean(value)
        batch = random_batch(ppo, start)
        without, plain_metrics = plain(start, batch, jax.random.PRNGKey(0))
        with_, metrics = penalized(start, batch, jax.random.PRNGKey(0))
        np.testing.assert_allclose(metrics["bound_penalty"], max(abs(value) - 1, 0) ** 2, rtol=1e-5)
        norms = metrics["actor_gradient_norm"], plain_metrics["actor_gradient_norm"]
        if abs(value) < 1:
            assert same(with_.actor, without.actor) and norms[0] == norms[1]
        else:
            bias = with_.actor["params"]["Dense_0"]["bias"] - value
            assert float(bias[0]) * value < 0 and norms[0] > 2 * norms[1]


# --- rates, deviations, normalizer -----------------------------------------------------------------------------------


def test_rate_follows_the_divergence():
    rate = jnp.float32(3e-4)
    for kl, factor in [(0.061, 1 / 1.5), (0.059, 1.0), (0.03, 1.0), (0.016, 1.0), (0.014, 1.5), (0.0, 1.5)]:
        np.testing.assert_allclose(adapt_rate(rate, jnp.float32(kl), 0.03), 3e-4 * factor, rtol=1e-6)
    np.testing.assert_allclose(adapt_rate(jnp.float32(1.2e-5), jnp.float32(1.0), 0.03), 1e-5)
    np.testing.assert_allclose(adapt_rate(jnp.float32(9e-3), jnp.float32(0.0), 0.03), 1e-2)
    assert adapt_rate(rate, jnp.float32(5.0), 0.0) is rate


@pytest.mark.parametrize("settling", [False, True])
def test_a_run_settles_by_its_last_values(settling):
    """As with them from the start; before, as without the setting. A rate that is constant stays so."""
    usual = {"discount": 0.9, "gae_lambda": 0.8, "target_kl": 0.03}
    last = {"discount": 0.99, "gae_lambda": 0.95, "target_kl": 1e-6}
    ppo, state, _ = make(**usual, settle=0.2, **{f"settle_{name}": value for name, value in last.items()})
    batch = random_batch(ppo, state)
    one, told = jax.jit(ppo.update)(state, batch, jax.random.PRNGKey(2), settling)
    other, expected = make(**(last if settling else usual))[2](state, batch, jax.random.PRNGKey(2))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-7), one, other)
    assert float(told["rate"]) == float(expected["rate"])
    constant = make(target_kl=0.0, settle=0.2)[0]
    assert float(jax.jit(constant.update)(state, batch, jax.random.PRNGKey(2), settling)[0].rate) == float(state.rate)


def test_the_last_part_of_the_budget_settles():
    config = preset("smoke", **{"ppo.settle": 0.25, "chunk": 2})
    config = dataclasses.replace(config, transitions=config.transitions_per_iteration * 8)
    assert (config.iterations, config.settles_at) == (8, 6)
    assert preset("smoke").settles_at == preset("smoke").iterations


def test_rate_is_adapted_once_an_update_and_used_by_the_next():
    ppo, state, update = whole_batch(target_kl=0.03)
    batch = random_batch(ppo, state)
    new, metrics = update(state, batch, jax.random.PRNGKey(0))
    # The one step starts from the policy that acted, where the divergence is zero.
    np.testing.assert_allclose(metrics["kl"], 0.0, atol=1e-4)
    np.testing.assert_allclose(new.rate, 1.5 * state.rate, rtol=1e-6)
    halved, _ = update(state._replace(rate=state.rate / 2), batch, jax.random.PRNGKey(0))
    step, half = (jax.tree.map(lambda a, b: a - b, s.critic, state.critic) for s in (new, halved))
    for a, b in zip(jax.tree.leaves(step), jax.tree.leaves(half), strict=True):
        np.testing.assert_allclose(b, a / 2, atol=1e-6)


@pytest.mark.parametrize("learned", [False, True])
def test_deviation(learned):
    """Actions off the mean cost: a learned deviation falls to its floor and stays; a fixed one does not move."""
    changes = {"learn_deviation": learned, "least_deviation": 0.2, "learning_rate": 1e-2}
    ppo, state, _ = make(**changes)
    _, deviation = ppo.policy(state.actor, state.normalizer, jnp.ones((1, 1)))
    np.testing.assert_allclose(deviation, 0.3, rtol=1e-5)
    ppo, state, metrics = train(probe(1.0, YES, cost=1.0), updates=60, **changes)
    _, after = ppo.policy(state.actor, state.normalizer, jnp.ones((1, 1)))
    if learned:
        np.testing.assert_allclose(after, 0.2, rtol=1e-5)
        assert (np.diff(metrics["deviation"]) < 0).any() and metrics["deviation"].min() >= 0.2 * (1 - 1e-5)
    else:
        np.testing.assert_array_equal(after, deviation)


def test_normalizer_starts_from_the_demonstration_where_asked():
    observations = 5.0 + 2.0 * jax.random.normal(jax.random.PRNGKey(0), (300, 3))
    observations = observations.at[:, 2].set(7.0)
    for from_clip in (False, True):
        ppo = PPO(3, 1, dataclasses.replace(PROBE, normalizer_from_clip=from_clip))
        statistics = ppo.init(jax.random.PRNGKey(0), observations).normalizer
        if from_clip:
            np.testing.assert_allclose(statistics.mean, observations.mean(0), rtol=1e-4)
            np.testing.assert_allclose(statistics.std[:2], observations[:, :2].std(0), rtol=1e-3)
            # A coordinate that the demonstration never moves has the floor, or what rounding leaves of it.
            assert 1e-4 * (1 - 1e-6) <= float(statistics.std[2]) < 1e-2
            assert int(statistics.count.lo) == 300
        else:
            np.testing.assert_array_equal(statistics.mean, 0.0)
            assert int(statistics.count.lo) == 0


def test_normalizer_is_the_plain_mean_and_deviation_without_a_cap():
    ppo = PPO(2, 1, PROBE)
    parts = [i + (1.0 + i) * jax.random.normal(jax.random.PRNGKey(i), (32, 4, 2)) for i in range(4)]
    statistics = ppo.init(jax.random.PRNGKey(0)).normalizer
    for part in parts:
        statistics = ppo.observe(statistics, part)
    seen = np.concatenate([np.asarray(p).reshape(-1, 2) for p in parts])
    np.testing.assert_allclose(statistics.mean, seen.mean(0), rtol=1e-4)
    np.testing.assert_allclose(statistics.std, seen.std(0), rtol=1e-4)
    assert int(statistics.count.lo) == len(seen)


def test_capped_normalizer_forgets():
    """Counts are held at the cap, so a batch of B among C moves the mean by B / (C + B) of its distance."""
    cap, size = 100, 64
    ppo = PPO(1, 1, dataclasses.replace(PROBE, normalizer_count=cap))
    statistics = ppo.init(jax.random.PRNGKey(0)).normalizer
    count, mean, variance = 0.0, 0.0, 0.0
    rng = np.random.default_rng(0)
    for i in range(12):
        part = rng.normal(i, 1.0 + 0.3 * i, size=(size, 1))
        total = count + size
        shift = part.mean() - mean
        summed = count * variance + size * part.var() + shift**2 * count * size / total
        mean, variance = mean + shift * size / total, summed / total
        count = min(total, cap)
        statistics = ppo.observe(statistics, jnp.asarray(part, jnp.float32))
        assert int(statistics.count.lo) == count
        np.testing.assert_allclose(statistics.mean, mean, rtol=1e-4)
        np.testing.assert_allclose(statistics.std, math.sqrt(variance), rtol=1e-3)


def test_normalizer_moves_only_at_the_end_of_an_update():
    ppo, state, update = whole_batch()
    batch = random_batch(ppo, state)
    batch = batch._replace(observation=3.0 + 2.0 * batch.observation)
    new, metrics = update(state, batch, jax.random.PRNGKey(0))
    assert same(new.normalizer, ppo.observe(state.normalizer, batch.observation))
    assert not same(new.normalizer, state.normalizer)
    # Values, and with them everything that was fitted, were read through the old statistics.
    np.testing.assert_allclose(metrics["value"], ppo.value(state, batch.observation).mean(), rtol=1e-5)
    moved = ppo.value(state._replace(normalizer=new.normalizer), batch.observation).mean()
    assert abs(float(moved - metrics["value"])) > 1e-4


def test_normalized_observations_are_clipped():
    ppo, state, update = whole_batch()
    far = ppo.value(state, jnp.array([[10.0], [1e6]]))
    np.testing.assert_array_equal(far[0], far[1])


# --- a critic that sees more -----------------------------------------------------------------------------------------


def test_each_network_sees_its_own_part():
    ppo = PPO(Seen(2, 3), 1, PROBE)
    state = ppo.init(jax.random.PRNGKey(0))
    seen = Seen(jnp.ones((4, 2)), jnp.ones((4, 3)))
    (mean, _), value = ppo.policy(state.actor, state.normalizer, seen), ppo.value(state, seen)
    other_critic, other_actor = seen._replace(critic=2 * seen.critic), seen._replace(actor=2 * seen.actor)
    np.testing.assert_array_equal(ppo.policy(state.actor, state.normalizer, other_critic)[0], mean)
    np.testing.assert_array_equal(ppo.value(state, other_actor), value)
    assert (ppo.policy(state.actor, state.normalizer, other_actor)[0] != mean).all()
    assert (ppo.value(state, other_critic) != value).all()
    # What only the critic reads may stand alone.
    np.testing.assert_array_equal(ppo.value(state, seen.critic), value)


def test_the_estimator_learns_what_only_the_critic_sees():
    """It follows from what the actor observes. The policy reads the estimate and does not train it."""
    config = dataclasses.replace(PROBE, estimator=(32,), normalizer_count=0)
    ppo = PPO(Seen(2, 4), 1, config, estimated=[2, 3])
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(STEPS, COUNT, 2))
    truth = np.stack([seen[..., 0] * seen[..., 1], 3.0 + seen[..., 0]], axis=-1)
    observation = Seen(jnp.asarray(seen), jnp.asarray(np.concatenate([seen, truth], axis=-1)))

    def update(state, key):
        action, extras = ppo.act(state)(observation.actor, key)
        batch = Batch(observation, observation, action, extras["mean"], extras["deviation"], ZEROS, NO, NO)
        return ppo.update(state, batch, key)

    start = ppo.init(jax.random.PRNGKey(0), observation)
    assert start.actor["params"]["MLP_0"]["hidden_0"]["kernel"].shape == (4, 32)
    state, metrics = jax.lax.scan(update, start, jax.random.split(jax.random.PRNGKey(1), 120))
    assert metrics["estimate_error"][0] > 0.5 and metrics["estimate_error"][-1] < 0.02
    gradient = jax.grad(lambda actor: ppo.policy(actor, state.normalizer, observation)[0].sum())(state.actor)["params"]
    assert not any(leaf.any() for name in ("estimator", "estimate") for leaf in jax.tree.leaves(gradient[name]))
    assert gradient["MLP_0"]["hidden_0"]["kernel"][2:].any()  # what the estimates are multiplied by
    assert [kernel.shape for kernel, _ in ppo.estimator_layers(state.actor)] == [(2, 32), (32, 2)]


def test_both_parts_have_running_statistics_that_may_forget():
    ppo = PPO(Seen(2, 3), 1, dataclasses.replace(PROBE, normalizer_count=10))
    seen = Seen(jax.random.normal(jax.random.PRNGKey(0), (5, 8, 2)), 7.0 + jnp.zeros((5, 8, 3)))
    normalizer = ppo.observe(ppo.init(jax.random.PRNGKey(0)).normalizer, seen)
    np.testing.assert_allclose(normalizer.mean.actor, seen.actor.mean((0, 1)), atol=1e-6)
    np.testing.assert_allclose(normalizer.mean.critic, 7.0, rtol=1e-6)
    assert int(normalizer.count.lo) == 10


# --- numbers that are not finite -------------------------------------------------------------------------------------


@pytest.mark.parametrize("optimizer", ["adam", "sgd"])
def test_a_rollout_of_nonsense_changes_nothing_and_is_counted(optimizer):
    ppo, state, update = make(optimizer=optimizer)
    batch = random_batch(ppo, state)
    new, metrics = update(state, batch._replace(reward=batch.reward.at[2, 3].set(jnp.nan)), jax.random.PRNGKey(0))
    # Normalized advantages carry it into every sample of the actor; plain SGD's critic loses single minibatches.
    assert same((new.actor, new.actor_optimizer), (state.actor, state.actor_optimizer))
    minibatches = 4 * (STEPS // 2)
    if optimizer == "adam":
        assert same((new.critic, new.critic_optimizer), (state.critic, state.critic_optimizer))
        assert float(metrics["skipped"]) == 2 * minibatches
    else:
        assert minibatches < float(metrics["skipped"]) < 2 * minibatches
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(new))


def test_only_the_minibatch_with_nonsense_is_skipped():
    ppo, state, update = make()
    batch = random_batch(ppo, state)
    new, metrics = update(state, batch._replace(mean=batch.mean.at[2, 3].set(jnp.inf)), jax.random.PRNGKey(0))
    assert float(metrics["skipped"]) == PROBE.actor_epochs
    assert not same(new.actor, state.actor) and not same(new.critic, state.critic)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(new))
