"""The precision of the networks' products."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen

from fmpjax import motion, products
from fmpjax.trainer import Trainer
from tests.helpers import tiny


def _rounded(x):
    return np.asarray(x.astype(jnp.bfloat16), np.float64)


@pytest.fixture
def factors():
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    return [jax.random.normal(key, shape) for key, shape in zip(keys, ((3, 5, 7), (7, 4), (3, 5, 4)), strict=True)]


def test_a_rounded_product_is_the_exact_one_of_rounded_factors(factors):
    x, kernel, slope = factors
    found, pull = jax.vjp(products.rounded_product, x, kernel)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, _rounded(x) @ _rounded(kernel), atol=1e-5)
    to_x, to_kernel = pull(slope)
    np.testing.assert_allclose(to_x, _rounded(slope) @ _rounded(kernel).T, atol=1e-5)
    np.testing.assert_allclose(to_kernel, np.einsum("abi,abo->io", x, slope), atol=1e-5)
    # A network whose factors need no rounding has exactly its own outputs.
    whole = jnp.round(4 * x), jnp.round(4 * kernel)
    np.testing.assert_array_equal(products.rounded_product(*whole), jnp.matmul(*whole, precision="highest"))


def test_slopes_of_slopes_are_those_of_exact_products(factors):
    """A score is a gradient, and its network learns from the gradient of that."""
    x, kernel = 0.3 * factors[0], factors[1]  # where tanh magnifies no rounding

    def roughness(product, kernel):
        slope = jax.grad(lambda x: jnp.tanh(product(x, kernel)).sum())(x)
        return jnp.sum(slope**2)

    found = jax.grad(roughness, 1)(products.rounded_product, kernel)
    wanted = jax.grad(roughness, 1)(lambda a, b: jnp.matmul(a, b, precision="highest"), kernel)
    assert np.linalg.norm(found - wanted) < 0.02 * np.linalg.norm(wanted)
    assert not np.array_equal(found, wanted)


@pytest.mark.parametrize("bias", [True, False])
def test_layers_within_have_rounded_products_and_the_same_parameters(bias):
    layer, x = linen.Dense(6, use_bias=bias, bias_init=linen.initializers.normal(1.0)), jnp.linspace(-1, 1, 8)[None]
    exact = layer.init(jax.random.PRNGKey(1), x)
    with products.at_precision("bfloat16"):
        params = layer.init(jax.random.PRNGKey(1), x)
        found = jax.jit(layer.apply)(params, x)
    assert jax.tree.all(jax.tree.map(np.array_equal, exact, params))
    kernel, shift = exact["params"]["kernel"], exact["params"].get("bias", 0.0)
    np.testing.assert_allclose(found, products.rounded_product(x, kernel) + shift, atol=1e-6)
    assert not np.allclose(found, layer.apply(exact, x), atol=1e-6)
    np.testing.assert_allclose(layer.apply(exact, x), jnp.matmul(x, kernel, precision="highest") + shift, atol=1e-6)


def test_an_iteration_with_rounded_products_is_close_to_one_without():
    """Of the program: products of bfloat16 numbers, and figures that differ little."""
    clip = motion.load("walk")
    exact, rounded = (Trainer(tiny(precision=name), clip) for name in ("float32", "bfloat16"))
    state = exact.init()
    texts = [jax.jit(trainer.iteration).lower(state).as_text() for trainer in (exact, rounded)]
    products_of = [text.count("xbf16>) -> tensor") for text in texts]
    assert products_of[0] == 0 and products_of[1] >= 10
    found = [jax.jit(trainer.iteration)(state)[1] for trainer in (exact, rounded)]
    for name in ("fit/value_loss", "fit/score_median", "ppo/critic_loss"):
        assert float(found[1][name]) == pytest.approx(float(found[0][name]), rel=0.05, abs=0.01), name
