"""What every prior keeps to; nested ablations of FMP, the averaged transport score, the barycentric target and AMP."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import priors, robots, transport
from fmpjax.checkpoint import Checkpoints
from fmpjax.config import FOLLOWERS, AMPConfig
from fmpjax.errors import UserError
from fmpjax.frames import FrameLayout
from fmpjax.priors import Expert, adversary, amp, barycentric, empirical
from fmpjax.trainer import TrainState
from tests.helpers import COUNT, SMALL, STEPS, expert_of, rollout_of


@pytest.fixture(scope="module")
def cloud():
    """A demonstration and a rollout in three dimensions."""
    rng = np.random.default_rng(3)
    return expert_of(rng.normal(size=(32, 3)) + 1.0), rng.normal(size=(STEPS * COUNT, 3))


@pytest.mark.parametrize("method", priors.METHODS)
def test_every_prior_keeps_the_contract(cloud, method, tmp_path):
    """Shapes, finite rewards, 0 where a window is not valid, a function of its key alone, a state that can be saved."""
    expert, points = cloud
    if method == "barycentric":
        expert = expert_of(jnp.tile(expert.windows, (1, 2)), horizon=2)
        points = np.tile(points, (1, 2))
    if method in FOLLOWERS:
        layout = FrameLayout.of(robots.load("strider"))
        expert = expert_of(np.resize(expert.windows, (32, layout.size)))._replace(layout=layout)
        points = np.resize(points, (len(points), layout.size))
    prior = priors.make(method, expert, SMALL)
    valid = np.ones((STEPS, COUNT), bool)
    valid[2, 5] = False
    points = points.reshape(STEPS, COUNT, -1).copy()
    points[2, 5] = np.nan
    rollout = rollout_of(points, valid)
    if method in FOLLOWERS:
        rollout = rollout._replace(frame=rollout.features, wanted=jnp.zeros_like(rollout.features))
    update = jax.jit(prior.update)
    state = jax.jit(prior.init)(jax.random.PRNGKey(0))
    new, reward, metrics = update(state, rollout, jax.random.PRNGKey(1))
    assert reward.shape == (STEPS, COUNT)
    assert np.isfinite(reward).all()
    assert (reward >= 0).all()
    assert reward[2, 5] == 0.0
    assert {"score_median", "score_spread"} <= set(metrics)
    assert all(np.isfinite(value) for value in metrics.values())
    assert jax.tree.structure(new) == jax.tree.structure(state)
    same = lambda a, b: a.shape == b.shape and a.dtype == b.dtype  # noqa: E731 - what a scan's carry must keep
    assert jax.tree.all(jax.tree.map(same, new, state))
    again = update(state, rollout, jax.random.PRNGKey(1))
    np.testing.assert_array_equal(again[1], reward)
    windows = rollout_of(np.nan_to_num(points)).features.reshape(STEPS * COUNT, -1)
    if method in FOLLOWERS:
        with pytest.raises(UserError, match="a window alone has no score"):
            jax.jit(prior.score)(new, windows)
    else:
        assert jax.jit(prior.score)(new, windows).shape == (STEPS * COUNT,)
    run = TrainState(None, new, None, jax.random.PRNGKey(2), jnp.int32(1), jnp.int32(0))
    Checkpoints(tmp_path).save(run)
    jax.tree.map(np.testing.assert_array_equal, Checkpoints(tmp_path).restore(run), run)


# --- nested ablations ------------------------------------------------------------------------------------------------


def test_nested_ablations_differ_in_nothing_but_a_loss(cloud):
    """The same initial parameters, bank, queries and teacher; the first update's common losses are the same numbers."""
    expert, points = cloud
    starts, firsts = {}, {}
    for method in ("fmp", "endpoint", "value"):
        prior = priors.make(method, expert, SMALL)
        starts[method] = prior.init(jax.random.PRNGKey(4))
        firsts[method] = jax.jit(prior.update)(starts[method], rollout_of(points), jax.random.PRNGKey(5))
    for method in ("endpoint", "value"):
        for a, b in zip(jax.tree.leaves(starts["fmp"]), jax.tree.leaves(starts[method]), strict=True):
            np.testing.assert_array_equal(a, b)
    losses = {m: {k for k in metrics if k.endswith("_loss")} for m, (_, _, metrics) in firsts.items()}
    assert losses["fmp"] == {"value_loss", "endpoint_loss", "flow_loss"}
    assert losses["endpoint"] == {"value_loss", "endpoint_loss"}
    assert losses["value"] == {"value_loss"}
    for method in ("endpoint", "value"):
        for name in (*losses[method], "epsilon", "sinkhorn_iterations", "value_correlation"):
            assert float(firsts[method][2][name]) == pytest.approx(float(firsts["fmp"][2][name]), rel=1e-5), name
    # And the loss that went did something. Adam's first step shows little but signs, its moments show the gradients.
    for one, other in (("fmp", "endpoint"), ("endpoint", "value")):
        moved = jax.tree.map(lambda a, b: jnp.abs(a - b).max(), firsts[one][0].optimizer, firsts[other][0].optimizer)
        assert max(map(float, jax.tree.leaves(moved))) > 1e-3


def test_scalar_methods_share_one_expert_bank(cloud):
    """Windows that a bank of 8 does not exhaust, so that two draws differ."""
    expert, _ = cloud
    config = dataclasses.replace(SMALL, prior=dataclasses.replace(SMALL.prior, bank=8))
    for seed in range(3):
        key = jax.random.PRNGKey(seed)
        banks = [priors.make(m, expert, config).init(key).bank for m in ("fmp", "endpoint", "value", "bank16")]
        for bank in banks[1:]:
            np.testing.assert_array_equal(bank, banks[0])


# --- 16-bank score ---------------------------------------------------------------------------------------------------


def test_averaged_score_is_the_mean_of_its_banks(cloud):
    """Against `transport.fit_score`, solved bank by bank to a far finer tolerance; only differences mean anything."""
    expert, points = cloud
    config = dataclasses.replace(
        SMALL, prior=dataclasses.replace(SMALL.prior, sinkhorn_threshold=1e-6, sinkhorn_iterations=2000)
    )
    prior = empirical.make(expert, config)
    state, reward, _ = prior.update(prior.init(jax.random.PRNGKey(0)), rollout_of(points), jax.random.PRNGKey(1))
    query = jnp.asarray(points, jnp.float32)
    expected = np.mean(
        [
            transport.fit_score(source, expert.windows[state.bank], epsilon=epsilon).score(query)
            for source, epsilon in zip(state.source, state.epsilon, strict=True)
        ],
        axis=0,
    )
    actual = np.asarray(prior.score(state, query))
    np.testing.assert_allclose(actual - actual.mean(), expected - expected.mean(), atol=2e-4)
    assert len(np.unique(np.asarray(state.epsilon))) == 3  # fresh banks
    low, middle, high = np.quantile(actual, [0.25, 0.5, 0.75])
    np.testing.assert_allclose(reward.ravel(), 2 / (1 + np.exp(-(actual - middle) / (high - low))), atol=1e-4)


# --- barycentric target ----------------------------------------------------------------------------------------------


def phases(epsilon_fraction):
    """A prior of two gait phases, and windows ``[n, 8]`` of two frames of four coordinates.

    Histories stand at +1 or -1 in their third coordinate (the first two are the planar position, which is not matched),
    successors at +2 or -2 in the fourth.
    """

    def window(history, successor):
        return [0.0, 0.0, history, 0.0, 0.0, 0.0, 0.0, successor]

    windows = np.array([window(1, 2), window(-1, -2)] * 16, np.float32)
    config = dataclasses.replace(
        SMALL, prior=dataclasses.replace(SMALL.prior, epsilon_fraction=epsilon_fraction, sinkhorn_iterations=500)
    )
    prior = barycentric.make(expert_of(windows, horizon=2), config)
    return prior, windows, window


@pytest.mark.parametrize("epsilon_fraction", [0.1, 1.0, 20.0])
def test_barycenter_matches_on_the_history_and_scores_the_successor(epsilon_fraction):
    """Two phases in closed form.

    Costs between like histories are 0 and between unlike ones 2. In a balanced pool the duals are equal, so a window of
    one phase is matched to its own with p = 1 / (1 + exp(-2 / epsilon)) and its target is 2 p - 2 (1 - p). Banks are
    drawn at random and so nearly balanced only; a source bank of both phases alike is put in by hand.
    """
    prior, windows, window = phases(epsilon_fraction)
    condition, successor = barycentric.split(jnp.asarray(windows), 2)
    assert condition.shape == (32, 2)
    config = dataclasses.replace(SMALL.prior, epsilon_fraction=1.0, sinkhorn_iterations=500)
    expert = expert_of(windows, horizon=2)
    # Half of the cross costs are 0 and half 2: their median is 1, so the fraction is epsilon itself.
    config = dataclasses.replace(config, epsilon_fraction=epsilon_fraction)
    dual, epsilon, solution = barycentric.match(condition, condition, expert, config)
    assert float(epsilon) == pytest.approx(epsilon_fraction, rel=1e-5)
    state = barycentric.BarycentricState(condition, successor, dual, epsilon)
    own = 1 / (1 + math.exp(-2 / epsilon_fraction))
    target, probability = barycentric.target(state, condition)
    np.testing.assert_allclose(target[:, 3], np.where(windows[:, 2] > 0, 1, -1) * (4 * own - 2), atol=2e-3)
    np.testing.assert_allclose(np.asarray(probability)[0, ::2].sum(), own, atol=1e-3)
    # d_g T = 4: the exponent of a successor v of the first phase is -(v - target)^2 / 4 * d, with d = 8 features in all
    # that `expert_of` leaves unscaled, d / (d / H) = 2.
    queries = jnp.asarray([window(1, v) for v in (2.0, 0.0, -2.0)], jnp.float32)
    expected = [-2.0 * (v - (4 * own - 2)) ** 2 for v in (2.0, 0.0, -2.0)]
    np.testing.assert_allclose(prior.score(state, queries), expected, atol=0.02)


def test_barycenter_prefers_the_mean_motion_where_matching_is_diffuse():
    """What the paper holds against it: with diffuse matching, the standstill between two phases earns the most."""
    prior, windows, window = phases(20.0)
    points = np.tile(windows, (STEPS * COUNT // 32, 1))
    points[::8] = window(1, 0)  # a few windows stand between the phases
    state, reward, metrics = prior.update(prior.init(jax.random.PRNGKey(0)), rollout_of(points), jax.random.PRNGKey(2))
    reward = np.asarray(reward).ravel()
    assert reward[::8].mean() > 1.5
    assert np.delete(reward, np.s_[::8]).mean() < 0.1
    assert 25 < float(metrics["effective_atoms"]) <= 32.001


# --- AMP -------------------------------------------------------------------------------------------------------------


def test_amp_reward_and_its_cap():
    """r = -2 log(1 - sigmoid(l)): 2 log 2 at 0, 2 log(1 + e) at 1; capped at -2 log 1e-4 = 18.42."""
    config = AMPConfig()
    rewards = amp.reward_of(jnp.array([0.0, 1.0, -50.0, 100.0]), config)
    np.testing.assert_allclose(
        rewards, [2 * math.log(2), 2 * math.log(1 + math.e), 0.0, 18.420681], rtol=1e-6, atol=1e-9
    )


def test_amp_loss_by_hand():
    """A linear discriminator l = w x with w = 2 in one dimension.

    agent x = 0.5: l = 1, softplus(1) = log(1 + e) = 1.313262; demonstration x = -1: l = -2, softplus(2) = 2.126928.
    Cross entropy (1.313262 + 2.126928) / 2 = 1.720095. Slopes are w^2 = 4 on both sides: 10 * (4 + 4) / 2 = 40. Logit
    penalty 0.01 * 4 = 0.04. Sum 41.760095.
    """
    params = {"params": {"logit": {"kernel": jnp.array([[2.0]]), "bias": jnp.zeros(1)}}}
    network = adversary.network((), 1.0, 1.0)
    apply = lambda params, x: network.apply(params, x)[..., 0]  # noqa: E731
    total, stats = adversary.cross_entropy(apply, params, jnp.array([[0.5]]), jnp.array([[-1.0]]), AMPConfig())
    assert float(total) == pytest.approx(41.760095, rel=1e-6)
    assert float(stats["discriminator_loss"]) == pytest.approx(1.720095, rel=1e-6)
    assert float(stats["gradient_penalty"]) == pytest.approx(4.0)
    assert (float(stats["agent_accuracy"]), float(stats["expert_accuracy"])) == (0.0, 0.0)


def test_amp_normalizer_weighs_agent_and_demonstration_alike():
    """Against numpy on all that was seen, where the two sides had equally many windows."""
    rng = np.random.default_rng(0)
    state = adversary.Normalizer(jnp.float32(0.0), jnp.zeros(2), jnp.ones(2))
    batches = [(rng.normal(1, 2, (50, 2)), rng.normal(-3, 0.5, (50, 2))) for _ in range(3)]
    for agent, demonstration in batches:
        state = adversary.update_normalizer(state, jnp.asarray(agent), jnp.asarray(demonstration))
    seen = np.concatenate([np.concatenate(batch) for batch in batches])
    np.testing.assert_allclose(state.mean, seen.mean(0), rtol=1e-5)
    np.testing.assert_allclose(state.variance, seen.var(0), rtol=1e-5)
    # Four times as many of the agent's change nothing.
    agent, demonstration = batches[0]
    begin = adversary.Normalizer(jnp.float32(0.0), jnp.zeros(2), jnp.ones(2))
    more = adversary.update_normalizer(begin, jnp.asarray(np.tile(agent, (4, 1))), jnp.asarray(demonstration))
    np.testing.assert_allclose(more.mean, np.concatenate([agent, demonstration]).mean(0), rtol=1e-5)


def test_amp_replay_fills_and_then_turns_over_slowly():
    """400 places: three rollouts of 150 go in whole, the last 50 over the oldest, then 10 a rollout, oldest first."""
    replay = adversary.Replay(jnp.zeros((400, 1), jnp.float16), jnp.int32(0), jnp.int32(0))
    put = jax.jit(adversary.store, static_argnums=2)

    def held():
        return [int((np.asarray(replay.windows)[: int(replay.count)] == value).sum()) for value in range(1, 6)]

    seen = []
    for value in range(1, 6):
        replay = put(replay, jnp.full((150, 1), float(value)), 10, jax.random.PRNGKey(value))
        seen.append((int(replay.count), int(replay.head), held()))
    assert seen == [
        (150, 150, [150, 0, 0, 0, 0]),
        (300, 300, [150, 150, 0, 0, 0]),
        (400, 50, [100, 150, 150, 0, 0]),
        (400, 60, [90, 150, 150, 10, 0]),
        (400, 70, [80, 150, 150, 10, 10]),
    ]


def test_amp_scores_before_it_fits(cloud):
    """The reward of a rollout is that of the discriminator and the normalizer which stood before it."""
    expert, points = cloud
    prior = amp.make(expert, SMALL)
    state = prior.init(jax.random.PRNGKey(0))
    for key in (1, 2):
        new, reward, _ = prior.update(state, rollout_of(points), jax.random.PRNGKey(key))
        before = amp.reward_of(prior.score(state, jnp.asarray(points, jnp.float32)), SMALL.amp)
        after = amp.reward_of(prior.score(new, jnp.asarray(points, jnp.float32)), SMALL.amp)
        np.testing.assert_allclose(reward.ravel(), before, rtol=1e-5)
        assert np.abs(np.asarray(after - before)).max() > 1e-3
        state = new


def test_amp_fits_with_the_normalizer_that_scored():
    """One window everywhere on either side: whatever is drawn, the first update's loss is that of the initial state."""
    expert = expert_of(np.full((32, 3), 0.7))
    points = np.full((STEPS * COUNT, 3), -0.4)
    config = dataclasses.replace(SMALL, amp=dataclasses.replace(SMALL.amp, updates=1))
    prior = amp.make(expert, config)
    state = prior.init(jax.random.PRNGKey(0))
    _, _, metrics = prior.update(state, rollout_of(points), jax.random.PRNGKey(1))
    agent, demonstration = (float(prior.score(state, jnp.full((1, 3), x, jnp.float32))[0]) for x in (-0.4, 0.7))
    expected = 0.5 * (np.log1p(np.exp(agent)) + np.log1p(np.exp(-demonstration)))
    assert float(metrics["discriminator_loss"]) == pytest.approx(expected, rel=1e-3)  # replayed in half precision
    assert float(metrics["replayed"]) == STEPS * COUNT


def test_amp_first_layer_starts_within_the_full_windows_scale():
    expert = expert_of(np.zeros((4, 30)))._replace(dimension=90.0)
    kernel = np.asarray(amp.make(expert, SMALL).init(jax.random.PRNGKey(0)).params["params"]["Dense_0"]["kernel"])
    assert 0.9 * 90**-0.5 < np.abs(kernel).max() <= 90**-0.5


def test_amp_reward_rises_toward_the_demonstration():
    """The discriminator's targets and the reward agree: from the rollout to the demonstration it rises all the way."""
    rng = np.random.default_rng(1)
    expert = expert_of(rng.normal(size=(32, 3)) * 0.2 + 0.6)
    points = rng.normal(size=(STEPS * COUNT, 3)) * 0.2 - 0.6
    config = dataclasses.replace(SMALL, amp=dataclasses.replace(SMALL.amp, updates=100, learning_rate=3e-3))
    prior = amp.make(expert, config)
    state = prior.init(jax.random.PRNGKey(0))
    update = jax.jit(prior.update)
    for key in range(5):
        state, _, metrics = update(state, rollout_of(points), jax.random.PRNGKey(key))
    way = np.linspace(-0.6, 0.6, 9)[:, None] * np.ones(3)
    reward = np.asarray(amp.reward_of(prior.score(state, jnp.asarray(way, jnp.float32)), config.amp))
    assert (np.diff(reward) > 0).all()
    assert metrics["expert_accuracy"] > 0.9
    assert metrics["agent_accuracy"] > 0.9


def test_amp_slopes_are_those_of_the_full_window():
    """A coordinate that stands twice in the full window stands once here, root two times as large: the same penalty.

    In the full window z = (x, x) and l = a x1 + a x2 has squared slope 2 a^2. Here y = root 2 x and the same l is
    root 2 a y: squared slope 2 a^2.
    """
    windows = jnp.asarray(np.random.default_rng(2).normal(size=(64, 2)), jnp.float32)
    weight = jnp.array([2.0**0.5, 1.0]) / 3.0**0.5  # one coordinate of three stands twice
    expert = Expert(windows * weight, 3.0, weight, 1)
    prior = amp.make(expert, dataclasses.replace(SMALL, amp=dataclasses.replace(SMALL.amp, hidden=())))
    state = prior.init(jax.random.PRNGKey(0))
    kernel = np.asarray(state.params["params"]["logit"]["kernel"])[:, 0]
    # The initial normalizer leaves standardized coordinates as they are.
    logit = np.asarray(prior.score(state, expert.windows))
    np.testing.assert_allclose(logit, np.asarray(windows) * [2.0**0.5, 1.0] @ kernel, atol=1e-5)
