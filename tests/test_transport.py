"""Transport against recorded solutions, closed forms and automatic differentiation.

``data/transport.npz``: POT's log-domain Sinkhorn to 1e-13, float64, and the dual extensions that follow.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import transport

CASES = ("small", "far", "bank256")
# Float32: costs carry 1e-7 of their size, divided by an epsilon of a tenth of them. Float64: the solver's threshold.
TOLERANCE = {np.float32: 1e-4, np.float64: 1e-6}


class Solved(NamedTuple):
    """What `transport.fit_score` gives for two banks and their queries."""

    epsilon: np.ndarray
    score: np.ndarray  # [q]
    gradient: np.ndarray  # [q, d]
    expert_extension: np.ndarray  # [q]
    expert_gradient: np.ndarray  # [q, d]
    probability: np.ndarray  # [q, m]
    solution: transport.Solve


def _fit(source, expert, query, threshold):
    fitted = transport.fit_score(source, expert, threshold=threshold)
    return Solved(
        fitted.epsilon,
        fitted.score(query),
        fitted.gradient(query),
        *fitted.expert_extension(query),
        fitted.match_probability(query),
        fitted.solution,
    )


# Compiled once per float type and shape: the tests below use the shapes of the recorded cases.
_single = jax.jit(lambda *banks: _fit(*banks, 1e-6))
_double = jax.jit(lambda *banks: _fit(*banks, 1e-10))


def fit(source, expert, query, dtype=np.float32) -> Solved:
    with jax.enable_x64(dtype == np.float64):
        banks = (jnp.asarray(x, dtype) for x in (source, expert, query))
        return jax.tree.map(np.asarray, (_double if dtype == np.float64 else _single)(*banks))


@pytest.fixture(scope="module")
def reference(data):
    with np.load(data / "transport.npz") as file:
        return {case: {k.split("/")[1]: v for k, v in file.items() if k.startswith(f"{case}/")} for case in CASES}


def banks_of(given):
    return given["source_bank"], given["expert_bank"], given["query"]


@pytest.fixture(
    scope="module", params=[(c, d) for c in CASES for d in TOLERANCE], ids=lambda p: f"{p[0]}-{p[1].__name__}"
)
def solved(request, reference):
    case, dtype = request.param
    actual = fit(*banks_of(reference[case]), dtype)
    assert actual.score.dtype == dtype
    return actual, reference[case], TOLERANCE[dtype]


def centered(x):
    return np.asarray(x) - np.mean(x)


def assert_close(actual, expected, tolerance):
    """Agreement to a tolerance relative to the figure's own scale."""
    np.testing.assert_allclose(actual, expected, atol=tolerance * np.abs(expected).max(), rtol=0)


def test_epsilon_is_the_recorded_one(solved):
    actual, given, tolerance = solved
    assert actual.epsilon == pytest.approx(float(given["epsilon"]), rel=tolerance / 10)
    assert actual.solution.converged.all()


def test_score_is_the_recorded_one(solved):
    actual, given, tolerance = solved
    assert_close(centered(actual.score), given["score_centered"], tolerance)
    assert_close(actual.gradient, given["score_gradient"], tolerance)


def test_expert_extension_is_the_recorded_one(solved):
    actual, given, tolerance = solved
    assert_close(centered(actual.expert_extension), given["expert_extension_centered"], tolerance)
    assert_close(actual.expert_gradient, given["expert_extension_gradient"], tolerance)


def test_matching_is_the_recorded_one(solved):
    actual, given, tolerance = solved
    probability = actual.probability.astype(np.float64)
    np.testing.assert_allclose(probability.sum(-1), 1.0, atol=1e-5)
    assert_close(probability, given["match_probability"], tolerance)
    atoms = 1 / (probability**2).sum(-1)
    np.testing.assert_allclose(atoms, given["effective_atoms"], rtol=tolerance)
    # Norm retention: how much of a velocity's size survives the barycenter, in the mean over queries.
    velocity = given["expert_leg_velocity"]
    barycenter = np.linalg.norm(probability @ velocity, axis=-1).mean()
    atom = (probability @ np.linalg.norm(velocity, axis=-1)).mean()
    assert barycenter / atom == pytest.approx(float(given["norm_retention"]), rel=tolerance)


# --- order statistics and epsilon ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        [3.0, 1.0, 2.0],
        [4.0, 1.0, 3.0, 2.0],
        [0.0, 0.0, 5.0, 5.0],
        [2.0, 2.0, 2.0, 2.0, 7.0],
        [0.25],
        [0.0, 0.0],
        [1e-38, 1e38, 3.0, 1.0],
        [1.0, np.nextafter(np.float32(1.0), np.float32(2.0))],
    ],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_median_of_few(values, dtype):
    with jax.enable_x64(dtype == np.float64):
        actual = transport.median(jnp.asarray(values, dtype))
        assert actual.dtype == dtype
        assert float(actual) == float(np.median(np.asarray(values, dtype)))


def test_median_of_many():
    rng = np.random.default_rng(0)
    for shape in ((40, 41), (31, 37)):  # even and odd
        cost = rng.lognormal(sigma=3.0, size=shape).astype(np.float32)
        tied = np.round(cost, 0)
        for values in (cost, tied):
            assert float(transport.median(jnp.asarray(values))) == float(np.median(values))


def test_entropy_coefficient_is_a_tenth_of_the_median_with_a_floor():
    cost = jnp.array([[1.0, 3.0], [5.0, 9.0]])
    assert float(transport.entropy_coefficient(cost, 8)) == pytest.approx(0.4)
    assert float(transport.entropy_coefficient(cost, 8, fraction=0.25)) == pytest.approx(1.0)
    # Where more than half of the pairs coincide: 1e-3 / d.
    assert float(transport.entropy_coefficient(jnp.zeros((4, 4)), 8)) == pytest.approx(1.25e-4)
    ones, zeros = jnp.ones((5, 2)), jnp.zeros((4, 2))
    assert float(jax.jit(lambda: transport.fit_score(ones, ones).epsilon)()) == pytest.approx(5e-4)
    assert float(jax.jit(lambda: transport.fit_score(ones, zeros).epsilon)()) == pytest.approx(0.1)
    assert float(jax.jit(lambda: transport.fit_score(ones, zeros, epsilon=0.7).epsilon)()) == pytest.approx(0.7)


def test_squared_cost():
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(7, 5)).astype(np.float32), rng.normal(size=(4, 5)).astype(np.float32)
    expected = 0.5 * ((x[:, None] - y[None]) ** 2).sum(-1)
    np.testing.assert_allclose(transport.squared_cost(jnp.asarray(x), jnp.asarray(y)), expected, rtol=1e-5)
    assert (np.asarray(transport.squared_cost(jnp.asarray(x), jnp.asarray(x))) >= 0).all()


# --- derivatives -----------------------------------------------------------------------------------------------------


def test_gradients_are_those_of_the_score_with_epsilon_and_duals_held(reference):
    source, expert, query = banks_of(reference["small"])
    solution = fit(source, expert, query, np.float64).solution
    with jax.enable_x64(True):
        source, expert, query = (jnp.asarray(x) for x in (source, expert, query))
        fitted = transport.ScoreFunction(source, expert, expert.mean(0), jax.tree.map(jnp.asarray, solution))

        @jax.jit
        def both(x):
            score = jax.grad(lambda x: fitted.score(x).sum())(x)
            expert = jax.grad(lambda x: fitted.expert_extension(x)[0].sum())(x)
            return (fitted.gradient(x), score), (fitted.expert_extension(x)[1], expert)

        for closed, automatic in both(query):
            np.testing.assert_allclose(closed, automatic, atol=1e-10)


def test_the_solution_is_a_constant_of_the_banks(reference):
    source, expert, _ = (jnp.asarray(x, jnp.float32) for x in banks_of(reference["small"]))

    @jax.grad
    def slope(bank):
        cross, itself = transport.squared_cost(bank, expert), transport.squared_cost(bank, bank)
        solution = transport.solve(cross, itself, transport.entropy_coefficient(cross, 8), max_iterations=5)
        return solution.expert_dual.sum() + solution.self_dual.sum() + solution.epsilon

    assert not np.any(jax.jit(slope)(source))


# --- convergence -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bound", [3, 20])
def test_iterations_are_bounded_and_failure_is_told(bound):
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(24, 3)), 4 + 2 * rng.normal(size=(20, 3))
    x, y = jnp.asarray(x, jnp.float32), jnp.asarray(y, jnp.float32)
    args = transport.squared_cost(x, y), transport.squared_cost(x, x), jnp.float32(1e-3)
    solution = jax.jit(lambda *a: transport.solve(*a, threshold=1e-7, max_iterations=bound))(*args)
    assert (solution.iterations <= bound).all() and (solution.iterations > 0).all()
    assert not solution.converged.any()
    assert np.isfinite(solution.expert_dual).all() and np.isfinite(solution.self_dual).all()


def test_convergence_means_that_the_marginals_hold(reference):
    source, expert, _ = banks_of(reference["far"])
    at_source = fit(source, expert, source[:32])
    assert at_source.solution.converged.all() and (at_source.solution.iterations < 200).all()
    rest = fit(source, expert, source[32:])
    # Each expert atom is matched by its share of the source bank.
    received = np.concatenate([at_source.probability, rest.probability]).mean(0)
    np.testing.assert_allclose(received, 1 / 64, atol=2e-6)
    # And each source atom: the expert's pull less the score's is the self problem's barycenter, less x.
    pull = np.concatenate([x.expert_gradient - x.gradient for x in (at_source, rest)])
    np.testing.assert_allclose((pull + source).mean(0), source.mean(0), atol=1e-4)


# --- closed forms, on banks of the recorded shapes -------------------------------------------------------------------


def test_one_atom_banks_pull_from_the_source_to_the_expert():
    """S(x) = (y - s) . x + constant: each extension is minus the cost to its one atom, however often it is repeated."""
    rng = np.random.default_rng(3)
    s, y, x = (rng.normal(size=(n, 8)) for n in (1, 1, 40))
    actual = fit(s.repeat(32, 0), y.repeat(24, 0), x)
    np.testing.assert_allclose(actual.gradient, np.broadcast_to(y - s, x.shape), atol=1e-5)
    np.testing.assert_allclose(centered(actual.score), centered(x @ (y - s)[0]), atol=1e-5)
    np.testing.assert_allclose(actual.expert_gradient, y - x, atol=1e-5)
    np.testing.assert_allclose(centered(actual.expert_extension), centered(-0.5 * ((x - y) ** 2).sum(-1)), atol=1e-5)


def test_two_expert_atoms_and_one_source():
    """One source must give both atoms half, so p_1(x) = sigmoid((x - s) . D / epsilon), D = y_1 - y_2: hence

    S(x) = epsilon log cosh((x - s) . D / (2 epsilon)) + (mean(y) - s) . x + constant.
    """
    rng = np.random.default_rng(4)
    s, y, x = (0.5 * rng.normal(size=(n, 8)) for n in (1, 2, 40))
    x[0] = s[0]
    actual = fit(s.repeat(32, 0), y.repeat(12, 0), x)
    epsilon = float(actual.epsilon)
    assert epsilon == pytest.approx(0.1 * np.mean(0.5 * ((s - y) ** 2).sum(-1)), rel=1e-5)
    difference, pull = y[0] - y[1], y.mean(0) - s[0]
    phase = (x - s) @ difference / (2 * epsilon)
    first = actual.probability[:, :12].sum(-1)
    assert first[0] == pytest.approx(0.5, abs=1e-5)  # midway between the atoms, as the source sees them
    np.testing.assert_allclose(first, 1 / (1 + np.exp(-2 * phase)), atol=1e-4)
    expected = pull + 0.5 * np.tanh(phase)[:, None] * difference
    np.testing.assert_allclose(actual.gradient, expected, atol=2e-4)
    score = epsilon * np.logaddexp(phase, -phase) + x @ pull
    np.testing.assert_allclose(centered(actual.score), centered(score), atol=1e-4)


def plane_bank(seed, count):
    """Points in a plane of 16 dimensions: so dense for their epsilon that no atom keeps to itself."""
    return np.concatenate([np.random.default_rng(seed).normal(size=(count, 2)), np.zeros((count, 14))], axis=1)


def test_a_translated_bank_pulls_by_the_translation():
    """If y_j = x_j + v, both problems have one plan at every epsilon, and the score is v . x."""
    source, query, v = plane_bank(5, 64), plane_bank(6, 32), np.linspace(-0.5, 1, 16)
    actual = fit(source, source + v, query)
    np.testing.assert_allclose(actual.gradient, np.broadcast_to(v, query.shape), atol=1e-4)
    np.testing.assert_allclose(centered(actual.score), centered(query @ v), atol=1e-4)


def test_equal_banks_have_no_score():
    """The debiasing terms: where policy and expert are the same, the score is flat."""
    bank = plane_bank(6, 64)
    actual = fit(bank, bank, bank[:32])
    np.testing.assert_allclose(actual.gradient, np.zeros((32, 16)), atol=2e-4)
    assert np.ptp(actual.score) < 1e-4 < 0.1 < np.ptp(actual.expert_extension)  # the expert's term alone is not flat


@pytest.mark.parametrize("distance", [1.0, 100.0])
def test_a_common_translation_changes_nothing(reference, distance):
    """Banks far from the origin lose no digits: costs are taken about the expert's mean."""
    given = reference["small"]
    actual = fit(*(x + distance * np.linspace(-1, 1, 8) for x in banks_of(given)))
    tolerance = 1e-5 * (1 + distance)  # the inputs themselves are rounded to 1e-7 of the distance
    assert actual.epsilon == pytest.approx(float(given["epsilon"]), rel=tolerance)
    assert_close(actual.gradient, given["score_gradient"], tolerance)
    assert_close(centered(actual.score), given["score_centered"], tolerance)


def test_far_banks_stay_finite():
    """An expert a thousand spreads away: the pull is the displacement, though every kernel entry underflows."""
    rng = np.random.default_rng(7)
    source, expert = rng.normal(size=(64, 16)), rng.normal(size=(64, 16)) + 1000.0
    actual = fit(source, expert, np.linspace(0, 1, 32)[:, None] * expert[:1])
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(actual))
    np.testing.assert_allclose(actual.gradient, 1000.0, atol=6.0)
    assert (np.diff(actual.score) > 0).all()
