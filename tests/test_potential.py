"""The three-head potential against an independent implementation, automatic derivatives and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import potential

SIZE, DIMENSION, POINTS = 7, 11.0, 6
HEADS, CONTRAST, SCORE, BOTH = map(
    jax.jit, (potential.heads, potential.contrast, potential.score, potential.score_and_gradient)
)


def random_params(seed=0, size=SIZE, hidden=(16, 12), dtype=np.float64):
    """Parameters in which every term differs from zero."""
    rng = np.random.default_rng(seed)
    sizes = (size + 4, *hidden, 3)
    shapes = zip(sizes[:-1], sizes[1:], strict=True)
    return potential.Params(
        linear=jnp.asarray(rng.normal(size=(3, size)), dtype),
        weights=tuple(jnp.asarray(rng.normal(size=s) / np.sqrt(s[0]), dtype) for s in shapes),
        biases=tuple(jnp.asarray(rng.normal(size=o), dtype) for o in sizes[1:]),
    )


def residual(params, x, tau, dimension):
    """The network alone in NumPy, one point at a time: sqrt(d) x and four time features through a SiLU trunk."""
    out = []
    for point, t in zip(x, tau, strict=True):
        h = np.concatenate([np.sqrt(dimension) * point, [t, t * t, np.sin(np.pi * t), np.cos(np.pi * t)]])
        layers = list(zip(params.weights, params.biases, strict=True))
        for depth, (weight, bias) in enumerate(layers):
            h = h @ np.asarray(weight) + np.asarray(bias)
            if depth < len(layers) - 1:
                h = h / (1 + np.exp(-h))
        out.append(h)
    return np.array(out)


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def points():
    rng = np.random.default_rng(5)
    return rng.normal(size=(POINTS, SIZE)), rng.uniform(size=POINTS)


def test_heads_formula(x64, points):
    params, (x, tau) = random_params(), points
    expected = -0.5 * (x**2).sum(-1, keepdims=True) + x @ np.asarray(params.linear).T
    expected = expected + residual(params, x, tau, DIMENSION)
    actual = HEADS(params, jnp.asarray(x), jnp.asarray(tau), DIMENSION)
    np.testing.assert_allclose(actual, expected, rtol=1e-12)
    single = HEADS(jax.tree.map(lambda p: p.astype(jnp.float32), params), jnp.float32(x), jnp.float32(tau), DIMENSION)
    np.testing.assert_allclose(single, expected, rtol=1e-4, atol=1e-5)


def test_score_is_the_contrast_at_time_zero_without_the_quadratic(x64, points):
    params, (x, _) = random_params(), points
    rest = x @ np.asarray(params.linear).T + residual(params, x, np.zeros(POINTS), DIMENSION)
    expected = rest[:, 0] - 0.5 * (rest[:, 1] + rest[:, 2])
    np.testing.assert_allclose(SCORE(params, jnp.asarray(x), DIMENSION), expected, rtol=1e-12)
    # Far away, where the quadratic is 1e12, nothing of it is left in the gradient either.
    far = jnp.asarray(x) + 1e6
    _, gradient = BOTH(params, far, DIMENSION)
    linear = np.asarray(params.linear)
    slope = linear[0] - 0.5 * (linear[1] + linear[2])
    trunk = jax.jit(jax.vmap(jax.grad(lambda y: jnp.dot(_network(params, y), potential.SCORE_CONTRAST))))(far)
    np.testing.assert_allclose(gradient, slope + trunk, rtol=1e-6, atol=1e-8)


def _network(params, y):
    """Residual of one point at time zero, in JAX."""
    h = jnp.concatenate([jnp.sqrt(DIMENSION) * y, jnp.array([0.0, 0.0, 0.0, 1.0])])
    *inner, (weight, bias) = zip(params.weights, params.biases, strict=True)
    for w, b in inner:
        h = jax.nn.silu(h @ w + b)
    return h @ weight + bias


def test_gradients_are_those_of_autodiff_and_finite_differences(x64, points):
    params, (x, tau) = random_params(1), points
    x, tau = jnp.asarray(x), jnp.asarray(tau)
    # A different contrast for every point, so that a mixed-up row or head shows.
    weights = jnp.asarray(np.random.default_rng(2).normal(size=(POINTS, 3)))

    def value(y, t, w):
        return potential.heads(params, y[None], t[None], DIMENSION)[0] @ w

    values, gradients = CONTRAST(params, x, tau, weights, DIMENSION)
    np.testing.assert_allclose(values, jax.jit(jax.vmap(value))(x, tau, weights), rtol=1e-12)
    np.testing.assert_allclose(gradients, jax.jit(jax.vmap(jax.grad(value)))(x, tau, weights), rtol=1e-10)
    step = 1e-5
    for i in range(SIZE):
        shift = step * np.eye(SIZE)[i]
        higher, lower = (CONTRAST(params, x + s, tau, weights, DIMENSION)[0] for s in (shift, -shift))
        np.testing.assert_allclose(gradients[:, i], (higher - lower) / (2 * step), rtol=1e-6, atol=1e-7)


def test_score_and_gradient_agree_with_score(x64, points):
    params, x = random_params(3), jnp.asarray(points[0])
    values, gradients = BOTH(params, x, DIMENSION)
    np.testing.assert_allclose(values, SCORE(params, x, DIMENSION), rtol=1e-12)
    expected = jax.jit(jax.grad(lambda y: potential.score(params, y, DIMENSION).sum()))(x)
    np.testing.assert_allclose(gradients, expected, rtol=1e-10)


def test_network_starts_as_the_quadratic_with_score_zero():
    params = potential.init(jax.random.PRNGKey(0), SIZE, DIMENSION, (16, 12))
    x = jnp.asarray(np.random.default_rng(0).normal(size=(POINTS, SIZE)), jnp.float32)
    heads = HEADS(params, x, jnp.linspace(0, 1, POINTS), DIMENSION)
    np.testing.assert_allclose(heads, np.repeat(-0.5 * np.sum(x * x, -1, keepdims=True), 3, axis=1), rtol=1e-6)
    values, gradients = BOTH(params, x, DIMENSION)
    assert not np.any(values) and not np.any(gradients)
    # Yet it can learn: the trunk below the last layer is alive.
    loss = lambda p: jnp.sum((potential.score(p, x, DIMENSION) - 1) ** 2)  # noqa: E731
    slope = jax.jit(jax.grad(loss))(params)
    assert np.abs(slope.weights[-1]).max() > 0 and np.abs(slope.linear).max() > 0


def test_parameter_count_and_scale_at_full_size():
    size, dimension = 2390, 2390.0
    params = potential.init(jax.random.PRNGKey(1), size, dimension, (256, 256))
    # Trunk (2390 + 4) 256 + 256, then 256 256 + 256, outputs 256 3 + 3, and a linear term for each of three heads.
    count = 2394 * 256 + 256 + 256 * 256 + 256 + 256 * 3 + 3 + 3 * 2390
    assert sum(p.size for p in jax.tree.leaves(params)) == count == 686_853
    assert np.std(params.weights[0]) == pytest.approx(1 / np.sqrt(dimension), rel=0.01)
    assert np.std(params.weights[1]) == pytest.approx(1 / 16, rel=0.02)
    # The compact window has fewer coordinates but the full dimension sets the scale.
    compact = potential.init(jax.random.PRNGKey(1), 1170, dimension, (256, 256))
    assert np.std(compact.weights[0]) == pytest.approx(1 / np.sqrt(dimension), rel=0.01)
