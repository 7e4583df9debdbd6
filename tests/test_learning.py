"""What the policy and the priors learn with, each part on its own."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import linen

from fmpjax import learning
from fmpjax.learning import MLP


def test_elu_is_flaxs_with_its_derivative():
    x = jnp.concatenate([jnp.linspace(-30.0, 5.0, 701), jnp.array([0.0, -1e-6, 1e-6])])
    np.testing.assert_allclose(learning.elu(x), linen.elu(x), rtol=0, atol=1e-7)
    ours, theirs = (jax.vmap(jax.grad(f))(x) for f in (learning.elu, linen.elu))
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-7)


@pytest.mark.parametrize("count", [1, 2, 3, 500, 4096, 5000])
def test_an_order_holds_every_row_once(count):
    order = np.asarray(learning.permutation(jax.random.PRNGKey(count), count))
    np.testing.assert_array_equal(np.sort(order), np.arange(count))


def test_every_row_stands_everywhere_equally_often():
    """Chi-squared of rows over places in 20,000 orders of six: 25 degrees of freedom, 52.6 at one in a thousand."""
    keys = jax.random.split(jax.random.PRNGKey(0), 20_000)
    orders = np.asarray(jax.vmap(lambda key: learning.permutation(key, 6))(keys))
    counts = np.array([np.bincount(column, minlength=6) for column in orders.T])
    assert ((counts - 20_000 / 6) ** 2 / (20_000 / 6)).sum() < 52.6


def test_a_network_is_its_layers_one_after_another():
    x = jax.random.normal(jax.random.PRNGKey(0), (7, 3))
    network = MLP((4, 2), [learning.uniform(0.5), learning.uniform(0.1)], jnp.tanh)
    params = network.init(jax.random.PRNGKey(1), x)
    first, second = (params["params"][name]["kernel"] for name in ("hidden_0", "hidden_1"))
    assert 0.1 < np.abs(first).max() <= 0.5 and np.abs(second).max() <= 0.1
    np.testing.assert_allclose(network.apply(params, x), np.tanh(x @ first) @ second, atol=1e-6)


@pytest.mark.parametrize("rate", [None, 0.1])
@pytest.mark.parametrize("fault", ["none", "loss", "gradients"])
def test_a_step_is_taken_where_all_is_finite(rate, fault):
    """Gradient descent with momentum, at a rate of 0.1 that stands in the optimizer or beside it."""
    optimizer = optax.chain(learning.direction("sgd", 0.9), optax.identity() if rate else optax.scale(-0.1))
    params, gradients = {"a": jnp.array([1.0, 2.0])}, {"a": jnp.array([3.0, 4.0])}
    state = optimizer.init(params)
    loss = jnp.float32(jnp.nan if fault == "loss" else 1.0)
    gradients = {"a": gradients["a"].at[1].set(jnp.inf)} if fault == "gradients" else gradients
    step = learning.step_if_finite(optimizer, params, state, loss, gradients, rate)
    taken = fault == "none"
    assert bool(step.finite) == taken and float(step.skipped) == 1.0 - taken
    np.testing.assert_allclose(step.params["a"], [0.7, 1.6] if taken else [1.0, 2.0], rtol=1e-6)
    (trace,) = jax.tree.leaves(step.optimizer)
    np.testing.assert_array_equal(trace, [3.0, 4.0] if taken else [0.0, 0.0])
    if taken:
        assert float(step.gradient_norm) == 5.0


def test_the_share_of_an_old_update_halves_in_a_half_life():
    newest = learning.newest_share(4.0)
    mean = 1.0
    for _ in range(4):
        mean = learning.toward(mean, 0.0, newest)
    assert mean == pytest.approx(0.5)


def test_score_metrics_are_in_units_of_the_spread():
    scores = jnp.array([0.0, 1.0, 2.0, 3.0, 4.0])
    metrics = learning.score_metrics(*learning.median_and_spread(scores), jnp.array([5.0, 7.0]))
    assert {name: float(value) for name, value in metrics.items()} == {
        "score_median": 2.0,
        "score_spread": 2.0,
        "expert_margin": 2.0,
    }
    assert float(learning.score_metrics(jnp.float32(2.0), jnp.float32(0.0), scores[3:], 0.5)["expert_margin"]) == 3.0
    assert set(learning.score_metrics(jnp.float32(0.0), jnp.float32(1.0))) == {"score_median", "score_spread"}
    # A number that is missing shows, unless it is left out on purpose.
    assert np.isnan(learning.median_and_spread(scores.at[0].set(jnp.nan))[0])
    assert float(learning.median_and_spread(scores.at[0].set(jnp.nan), jnp.nanquantile)[0]) == 2.5
