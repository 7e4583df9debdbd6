"""Probes of the flow-matched prior: banks whose transport score is known, and one test for each of its rules."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from fmpjax import potential, priors, transport
from fmpjax.config import Config, PriorConfig
from fmpjax.errors import UserError
from fmpjax.priors import Rollout, flow, median_reward

STEPS, COUNT = 8, 64  # of a rollout
PROBE = PriorConfig(bank=64, minibatch=64, updates=600, hidden=(64, 64), learning_rate=3e-3, query_share=1.0)
TINY = PriorConfig(bank=32, minibatch=32, updates=16, hidden=(8,), query_share=0.5)


def rollout_of(points, valid=None):
    """A rollout of features ``[STEPS, COUNT, D]``."""
    valid = np.ones((STEPS, COUNT), bool) if valid is None else valid
    return Rollout(jnp.asarray(points, jnp.float32).reshape(STEPS, COUNT, -1), jnp.asarray(valid))


def make(method, expert, config):
    """A prior for an expert bank ``[m, D]`` of windows of one frame."""
    bank = jnp.asarray(expert, jnp.float32)
    size = bank.shape[-1]
    weight = jnp.full(size, size**-0.5)
    return priors.make(method, priors.Expert(bank, float(size), weight, 1), Config(prior=config))


@jax.jit
def _learn(expert, rollout):
    prior = make("fmp", expert, PROBE)
    return prior.update(prior.init(jax.random.PRNGKey(0)), rollout, jax.random.PRNGKey(1))


def learn(expert, points):
    """A new prior after one rollout in the plane: state, reward, metrics. One compilation serves every probe."""
    return _learn(jnp.asarray(expert, jnp.float32), rollout_of(points))


def score_of(state, x):
    """Score and gradient of the averaged model at points of the plane."""
    return [np.asarray(a) for a in potential.score_and_gradient(state.average, jnp.asarray(x, jnp.float32), 2.0)]


def cosine(a, b):
    return (a * b).sum(-1) / np.maximum(np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1), 1e-12)


# --- probes ----------------------------------------------------------------------------------------------------------


def test_probe_one_source_and_one_expert_atom():
    """Every window at s, the expert at y: the score's gradient is y - s, and the flow carries it along the segment."""
    s, y = np.array([0.3, -0.2]), np.array([-0.4, 0.7])
    state, reward, metrics = learn(np.tile(y, (64, 1)), np.tile(s, (STEPS * COUNT, 1)))
    _, gradient = score_of(state, s[None])
    np.testing.assert_allclose(gradient[0], y - s, atol=0.03)
    tau = np.linspace(0, 1, 11)
    path = (1 - tau)[:, None] * s + tau[:, None] * y
    # The expert head's slope along the path, at its own flow time, is the velocity of the flow.
    expert_head = jnp.broadcast_to(jnp.array([1.0, 0, 0]), (11, 3))
    _, slope = potential.contrast(
        state.average, jnp.asarray(path, jnp.float32), jnp.asarray(tau, jnp.float32), expert_head, 2.0
    )
    np.testing.assert_allclose(slope, np.tile(y - s, (11, 1)), atol=0.1)
    # So the score at time zero rises all the way to the expert, where no window has been.
    values, _ = score_of(state, path)
    assert (np.diff(values) > 0).all()
    # Equal windows have equal rewards: the median's.
    np.testing.assert_allclose(reward, 1.0, atol=1e-6)
    assert float(metrics["skipped"]) == 0 and all(np.isfinite(v) for v in metrics.values())


def test_probe_translated_bank():
    """An expert that is the rollout moved by v has the score v . x: its gradient is v everywhere."""
    rng = np.random.default_rng(1)
    points, v = rng.uniform(-1, 1, (STEPS * COUNT, 2)), np.array([0.8, -0.3])
    state, reward, metrics = learn(points[:64] + v - points[:64].mean(0) + points.mean(0), points)
    values, gradient = score_of(state, points)
    assert np.corrcoef(values, points @ v)[0, 1] > 0.98
    assert cosine(gradient, v).mean() > 0.95
    assert np.linalg.norm(gradient.mean(0) - v) < 0.1
    assert np.corrcoef(np.asarray(reward).ravel(), points @ v)[0, 1] > 0.95
    assert float(metrics["expert_margin"]) > 0.5


def test_probe_two_clusters_against_transport():
    """The learned score is the transport score of large banks, where that bends: an expert of two clusters."""
    rng = np.random.default_rng(2)
    points = rng.normal(size=(STEPS * COUNT, 2)) * [0.6, 0.3]
    center = np.array([[1.0, 0.5], [-1.0, 0.5]])
    expert = center[np.arange(64) % 2] + 0.1 * rng.normal(size=(64, 2))
    state, _, metrics = learn(expert, points)

    @jax.jit
    def reference(x):
        fitted = transport.fit_score(jnp.asarray(points, jnp.float32), jnp.asarray(expert, jnp.float32), threshold=1e-4)
        return fitted.score(x), fitted.gradient(x)

    true, slope = (np.asarray(a) for a in reference(jnp.asarray(points, jnp.float32)))
    values, gradient = score_of(state, points)
    assert np.corrcoef(values, true)[0, 1] > 0.98
    assert np.median(cosine(gradient, slope)) > 0.97
    # Size as well as direction: the score is not just any function that rises with the true one.
    assert np.std(values) == pytest.approx(np.std(true), rel=0.1)
    assert ((gradient - slope) ** 2).sum(-1).mean() < 0.1 * (slope**2).sum(-1).mean()
    for target in center:
        path, _ = score_of(state, np.linspace(0, 1, 9)[:, None] * target)
        assert (np.diff(path) > 0).all()


# --- the pieces of an update -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def banks():
    rng = np.random.default_rng(3)
    make = lambda n, shift: jnp.asarray(rng.normal(size=(n, 3)) + shift, jnp.float32)  # noqa: E731
    return {"source": make(32, 0.0), "expert": make(24, 1.0), "query": make(32, 0.0)}


@pytest.fixture(scope="module")
def taught(banks):
    """Teachers at the source bank implied, at the source bank given, and at other queries."""

    @jax.jit
    def teach(source, expert, query):
        coupling = priors.couple(source, expert, 3.0, TINY)
        return tuple(flow.teach(coupling, expert, at) for at in (None, source, query))

    return teach(banks["source"], banks["expert"], banks["query"])


def test_queries_may_be_the_bank(taught):
    implied, given, _ = taught
    for field in ("score", "gradient", "to_expert", "to_source"):
        np.testing.assert_allclose(getattr(implied, field), getattr(given, field), atol=1e-6)


def test_teacher_is_the_transport_score(banks, taught):
    teacher = taught[2]
    query = banks["query"]

    @jax.jit
    def reference(source, expert):
        fitted = transport.fit_score(source, expert, threshold=TINY.sinkhorn_threshold)
        return fitted.score(query), fitted.gradient(query), fitted.match_probability(query), fitted.epsilon

    score, gradient, probability, epsilon = reference(banks["source"], banks["expert"])
    assert float(teacher.solution.epsilon) == pytest.approx(float(epsilon), rel=1e-5)
    np.testing.assert_allclose(teacher.score - teacher.score.mean(), score - score.mean(), atol=1e-4)
    np.testing.assert_allclose(teacher.gradient, gradient, atol=1e-4)
    np.testing.assert_allclose(teacher.to_expert, probability, atol=1e-4)
    np.testing.assert_allclose(np.sum(teacher.to_source, -1), 1.0, atol=1e-5)


def test_flow_samples():
    """Heads uniform, atoms by the head's own probabilities, points on the segment at times uniform in [0, 1]."""
    draws = 60_000
    rng = np.random.default_rng(4)
    to_expert, to_source = np.array([0.05, 0.5, 0.0, 0.2, 0.25]), np.array([0.6, 0.1, 0.3])
    expert, source = rng.normal(size=(5, 2)) + 5, rng.normal(size=(3, 2)) - 5
    query = np.tile([[0.5, -0.5]], (draws, 1))
    teacher = flow.Teacher(None, None, jnp.tile(to_expert, (draws, 1)), jnp.tile(to_source, (draws, 1)), None)
    arrays = (jnp.asarray(x, jnp.float32) for x in (query, source, expert))
    query, source, expert = arrays
    sample = jax.tree.map(np.asarray, flow.sample_flow(jax.random.PRNGKey(0), query, teacher, source, expert))
    np.testing.assert_array_equal(sample.head.sum(-1), 1)
    head = sample.head.argmax(-1)
    assert_drawn(np.bincount(head, minlength=3), np.full(3, 1 / 3))
    assert sample.tau.min() >= 0 and sample.tau.max() <= 1
    assert_drawn(np.histogram(sample.tau, 10, (0, 1))[0], np.full(10, 0.1))
    np.testing.assert_allclose(sample.point, query + sample.tau[:, None] * sample.velocity, atol=1e-6)
    target = np.asarray(query) + sample.velocity
    for k, (atoms, probability) in enumerate([(expert, to_expert), (source, to_source), (source, to_source)]):
        mine = head == k
        distance = np.linalg.norm(target[mine][:, None] - np.asarray(atoms), axis=-1)
        assert distance.min(-1).max() < 1e-5  # z is an atom of the head's own bank
        assert_drawn(np.bincount(distance.argmin(-1), minlength=len(atoms)), probability)
        # Time does not depend on the head or the atom.
        assert sample.tau[mine].mean() == pytest.approx(0.5, abs=0.015)
        assert abs(np.corrcoef(sample.tau[mine], distance.argmin(-1))[0, 1]) < 0.03


def assert_drawn(counts, probability):
    """Counts within five standard deviations of their expectation, and exactly none where nothing is due."""
    total = counts.sum()
    assert (np.abs(counts - total * probability) <= 5 * np.sqrt(total * probability * (1 - probability))).all(), counts


def random_params(seed, size=3, hidden=(8,)):
    params = potential.init(jax.random.PRNGKey(seed), size, float(size), hidden)
    leaves, tree = jax.tree.flatten(params)
    rng = np.random.default_rng(seed)
    return tree.unflatten([jnp.asarray(rng.normal(size=x.shape) * 0.5, jnp.float32) for x in leaves])


def test_losses_formula(banks, taught):
    """Value: centered error over c0 squared. Endpoint and flow: mean squared distance of gradients."""
    params, query, teacher = random_params(0), banks["query"], taught[2]
    sample = flow.sample_flow(jax.random.PRNGKey(1), query, teacher, banks["source"], banks["expert"])
    weighted = dataclasses.replace(TINY, value_weight=2.0, endpoint_weight=3.0, flow_weight=5.0, value_scale=0.2)
    losses = jax.jit(lambda params: flow.losses(params, query, teacher, sample, 3.0, weighted))
    total, terms = losses(params)
    terms = {name: float(term) for name, term in terms.items()}
    values, gradients = (np.asarray(a) for a in potential.score_and_gradient(params, query, 3.0))
    error = (values - values.mean()) - (teacher.score - teacher.score.mean())
    assert terms["value_loss"] == pytest.approx(float(np.mean(error**2)) / 0.04, rel=1e-4)
    endpoint = np.mean(((gradients - teacher.gradient) ** 2).sum(-1))
    assert terms["endpoint_loss"] == pytest.approx(float(endpoint), rel=1e-4)
    head = np.argmax(sample.head, -1)
    chosen = lambda x: potential.heads(params, x, sample.tau, 3.0)[np.arange(32), head].sum()  # noqa: E731
    slope = jax.jit(jax.grad(chosen))(sample.point)
    expected = np.mean(((slope - sample.velocity) ** 2).sum(-1))
    assert terms["flow_loss"] == pytest.approx(float(expected), rel=1e-4)
    expected = 2 * terms["value_loss"] + 3 * terms["endpoint_loss"] + 5 * terms["flow_loss"]
    assert float(total) == pytest.approx(expected, rel=1e-6)
    correlation = np.corrcoef(values, teacher.score)[0, 1]
    assert terms["value_correlation"] == pytest.approx(correlation, abs=1e-4)
    # A constant added to the score costs nothing.
    shifted = params._replace(biases=(*params.biases[:-1], params.biases[-1] + jnp.array([7.0, 0, 0])))
    again = losses(shifted)[1]["value_loss"]
    assert float(again) == pytest.approx(terms["value_loss"], rel=1e-3)


@pytest.mark.parametrize("start", ["initial", "trained"])
def test_removing_the_flow_loss_leaves_the_others(banks, taught, start):
    params = random_params(5) if start == "trained" else potential.init(jax.random.PRNGKey(0), 3, 3.0, (8,))
    teacher = taught[2]
    sample = flow.sample_flow(jax.random.PRNGKey(1), banks["query"], teacher, banks["source"], banks["expert"])
    both = {
        weight: flow.losses(params, banks["query"], teacher, sample, 3.0, dataclasses.replace(TINY, flow_weight=weight))
        for weight in (1.0, 0.0)
    }
    (total, terms), (less, fewer) = both[1.0], both[0.0]
    assert set(terms) - set(fewer) == {"flow_loss"}
    assert set(fewer) == {"value_loss", "endpoint_loss", "value_correlation"}
    for name, term in fewer.items():
        if start == "initial":
            assert float(term) == float(terms[name])
        assert float(term) == pytest.approx(float(terms[name]), rel=1e-5)
    assert float(total - less) == pytest.approx(float(terms["flow_loss"]), rel=1e-4)


# --- an update -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tiny():
    """A small prior, its compiled update, and a rollout."""
    rng = np.random.default_rng(6)
    prior = make("fmp", rng.normal(size=(32, 3)) + 1, TINY)
    points = rng.normal(size=(STEPS, COUNT, 3))
    state, _, _ = (update := jax.jit(prior.update))(
        prior.init(jax.random.PRNGKey(0)), rollout_of(points), jax.random.PRNGKey(9)
    )
    return prior, update, state, points


def test_update_is_a_function_of_its_key(tiny):
    _, update, state, points = tiny
    first, again, other = (update(state, rollout_of(points), jax.random.PRNGKey(k)) for k in (1, 1, 2))
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.abs(first[0].params.linear - other[0].params.linear).max() > 1e-6


def test_reward_is_that_of_the_new_average(tiny):
    """Fit, then score: the reward is the average model's of this rollout, neither the old one's nor the newest's."""
    prior, update, state, points = tiny
    new, reward, metrics = update(state, rollout_of(points), jax.random.PRNGKey(1))

    def reward_of(params):
        score = np.asarray(potential.score(params, rollout_of(points).features.reshape(-1, 3), 3.0), np.float64)
        low, middle, high = np.quantile(score, [0.25, 0.5, 0.75])
        return (2 / (1 + np.exp(-(score - middle) / max(high - low, 1e-6)))).reshape(STEPS, COUNT)

    np.testing.assert_allclose(reward, reward_of(new.average), atol=2e-4)
    for other in (state.average, state.params, new.params):
        assert np.abs(np.asarray(reward) - reward_of(other)).max() > 1e-3
    score = prior.score(new, rollout_of(points).features.reshape(-1, 3))
    assert float(metrics["score_median"]) == pytest.approx(float(np.median(score)), abs=1e-5)


def test_average_has_a_half_life_of_sixteen_updates_and_restarts(tiny, monkeypatch):
    """With parameters that jump to a constant c and stay, sixteen updates take the average half the way to c."""
    prior, _, _, points = tiny
    update = jax.jit(lambda *args: prior.update(*args))
    monkeypatch.setattr(optax, "apply_updates", lambda params, _: jax.tree.map(jnp.ones_like, params))
    start = prior.init(jax.random.PRNGKey(3))
    first, _, _ = update(start, rollout_of(points), jax.random.PRNGKey(4))
    for average, old in zip(jax.tree.leaves(first.average), jax.tree.leaves(start.params), strict=True):
        np.testing.assert_allclose(average, 0.5 * old + 0.5, atol=1e-5)
    # The next rollout's average starts from the parameters, 1, not from the average, about a half.
    second, _, _ = update(first, rollout_of(points), jax.random.PRNGKey(5))
    for average in jax.tree.leaves(second.average):
        np.testing.assert_allclose(average, 1.0, atol=1e-6)


def test_average_that_goes_on(monkeypatch):
    """With parameters that are the constant 1, sixteen updates from an average of 0 take it to a half."""
    expert = np.random.default_rng(0).normal(size=(32, 3))
    points = np.random.default_rng(1).normal(size=(STEPS * COUNT, 3))
    prior = make("fmp", expert, dataclasses.replace(TINY, average_restarts=False))
    monkeypatch.setattr(optax, "apply_updates", lambda params, _: jax.tree.map(jnp.ones_like, params))
    start = prior.init(jax.random.PRNGKey(3))
    start = start._replace(average=jax.tree.map(jnp.zeros_like, start.average))
    state, _, _ = jax.jit(prior.update)(start, rollout_of(points), jax.random.PRNGKey(4))
    for average in jax.tree.leaves(state.average):
        np.testing.assert_allclose(average, 0.5, atol=1e-5)


def test_optimizer_state_persists_between_rollouts(tiny):
    _, update, state, points = tiny
    count = lambda s: int(optax.tree_utils.tree_get(s.optimizer, "count"))  # noqa: E731
    assert count(state) == 16
    assert count(update(state, rollout_of(points), jax.random.PRNGKey(1))[0]) == 32


def test_queries_come_from_the_first_share_of_environments_and_banks_from_all(tiny):
    """Environments beyond the share, put far away, enter the transport but are never asked about."""
    _, update, state, points = tiny
    base = update(state, rollout_of(points), jax.random.PRNGKey(1))[2]
    beyond, within = points.copy(), points.copy()
    beyond[:, COUNT // 2 :] += 50.0
    within[:, : COUNT // 2] += 50.0
    beyond = update(state, rollout_of(beyond), jax.random.PRNGKey(1))[2]
    within = update(state, rollout_of(within), jax.random.PRNGKey(1))[2]
    assert beyond["epsilon"] > 10 * base["epsilon"] and within["epsilon"] > 10 * base["epsilon"]
    # Queries at the far half know only far self-atoms: their pull is forty times that of the near half.
    assert within["endpoint_loss"] > 100 * beyond["endpoint_loss"]


def test_windows_that_are_not_finite_are_neither_rewarded_nor_learned_from(tiny):
    prior, update, state, points = tiny
    valid = np.random.default_rng(7).uniform(size=(STEPS, COUNT)) > 0.2
    spoiled = np.where(valid[..., None], points, np.nan)
    new, reward, metrics = update(state, rollout_of(spoiled, valid), jax.random.PRNGKey(1))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(new)) and all(np.isfinite(v) for v in metrics.values())
    assert float(metrics["skipped"]) == 0
    assert not np.asarray(reward)[~valid].any() and (np.asarray(reward)[valid] > 0).all()
    assert np.median(np.asarray(reward)[valid]) == pytest.approx(1.0, abs=0.01)


def test_an_update_that_is_not_finite_is_skipped_and_counted(tiny):
    """Non-finite windows that nobody marked: parameters and optimizer stay as they were, and the count tells."""
    _, update, state, points = tiny
    spoiled = np.full_like(points, np.nan)
    new, reward, metrics = update(state, rollout_of(spoiled), jax.random.PRNGKey(1))
    assert float(metrics["skipped"]) == TINY.updates
    for a, b in zip(jax.tree.leaves(new[:2]), jax.tree.leaves(state[:2]), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.asarray(reward).any()
    recovered, reward, metrics = update(new, rollout_of(points), jax.random.PRNGKey(1))
    assert float(metrics["skipped"]) == 0 and np.isfinite(reward).all()
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(recovered))


# --- the reward ------------------------------------------------------------------------------------------------------


def test_median_reward_formula():
    score = np.random.default_rng(8).normal(size=(5, 9)) * 3 + 100
    low, middle, high = np.quantile(score, [0.25, 0.5, 0.75])
    actual = median_reward(jnp.asarray(score, jnp.float32), jnp.ones((5, 9), bool), 1e-6)
    expected = 2 / (1 + np.exp(-(score - middle) / (high - low)))
    np.testing.assert_allclose(actual.reward, expected, atol=1e-4)
    assert float(actual.median) == pytest.approx(middle, rel=1e-6)
    assert float(actual.spread) == pytest.approx(high - low, rel=1e-4)
    assert (actual.reward > 0).all() and (actual.reward < 2).all()
    # 45 scores: the middle one is the median, and its reward one.
    assert np.asarray(actual.reward).ravel()[score.argsort(axis=None)[22]] == pytest.approx(1.0, abs=1e-5)


def test_spread_has_a_floor():
    score, valid = jnp.array([[0.0, 1.0, 2.0, 3.0, 4.0]]), jnp.ones((1, 5), bool)
    # IQR 2 below a floor of 8: sigmoid(+-2 / 8) at the ends.
    ends = 2 / (1 + np.exp(np.array([0.25, -0.25])))
    np.testing.assert_allclose(median_reward(score, valid, 8.0).reward[0, [0, 4]], ends, rtol=1e-6)
    np.testing.assert_allclose(median_reward(score, valid, 1.0).reward[0, 4], 2 / (1 + np.exp(-1.0)), rtol=1e-6)
    np.testing.assert_array_equal(median_reward(jnp.full((1, 5), 3.0), valid, 1e-6).reward, 1.0)


def test_invalid_and_nan_scores_get_nothing_and_move_nothing():
    score = np.array([[0.0, 1.0, 2.0, 3.0, 4.0, 1e9, np.nan, np.nan, np.inf]])
    valid = np.array([[1, 1, 1, 1, 1, 0, 0, 1, 0]], bool)
    actual = median_reward(jnp.asarray(score), jnp.asarray(valid), 1e-6)
    alone = median_reward(jnp.asarray(score[:, :5]), jnp.ones((1, 5), bool), 1e-6)
    assert (float(actual.median), float(actual.spread)) == (2.0, 2.0)
    np.testing.assert_array_equal(actual.reward[:, :5], alone.reward)
    np.testing.assert_array_equal(actual.reward[:, 5:], 0.0)
    nothing = median_reward(jnp.asarray(score), jnp.zeros((1, 9), bool), 1e-6)
    np.testing.assert_array_equal(nothing.reward, 0.0)


def test_unknown_method():
    with pytest.raises(UserError, match="unknown method 'gan': expected one of"):
        make("gan", np.zeros((2, 2)), PriorConfig())
