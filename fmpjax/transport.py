"""Entropic optimal transport between a rollout bank and the expert bank (section III-B of the paper).

Quadratic cost c(x, y) = |x - y|^2 / 2, uniform masses. ott-jax solves; the dual extensions, scores, gradients and
matching probabilities follow in closed form. Only score differences and gradients mean anything.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from ott.geometry import geometry
from ott.problems.linear import linear_problem
from ott.solvers.linear import acceleration, sinkhorn
from ott.tools import sinkhorn_divergence

Floats = jax.Array | np.ndarray  # JAX takes both

# TF32 spoils Sinkhorn: costs are differences of large inner products.
_HIGHEST = jax.lax.Precision.HIGHEST
DISCREPANCY_THRESHOLD, DISCREPANCY_ITERATIONS = 1e-4, 2000  # marginal error (L1) of its solves; iterations at most [D]


def squared_cost(x: Float[Floats, "n d"], y: Float[Floats, "m d"]) -> Float[jax.Array, "n m"]:
    """Costs |x_i - y_j|^2 / 2, ``[n, m]``, of points ``x [n, d]`` and ``y [m, d]`` as one matrix product."""
    inner = jnp.matmul(x, y.T, precision=_HIGHEST)
    return jnp.maximum(0.5 * (jnp.sum(x * x, -1)[:, None] + jnp.sum(y * y, -1)[None, :]) - inner, 0.0)


def median(values: Float[jax.Array, "..."]) -> Float[jax.Array, ""]:
    """Median of finite values >= 0 of any shape, exactly.

    Non-negative floats are ordered as their bits, so bisection over bits needs one count per bit. On a CPU that is many
    times faster than XLA's sort.
    """
    integer = jnp.int64 if values.dtype == jnp.float64 else jnp.int32
    bits = jax.lax.bitcast_convert_type(values.ravel(), integer)
    top, rank = jnp.iinfo(integer).bits - 2, (values.size - 1) // 2

    def set_bit(i, prefix):
        candidate = prefix | (jnp.ones((), integer) << (top - i).astype(integer))
        return jnp.where((bits < candidate).sum() <= rank, candidate, prefix)

    low = jax.lax.fori_loop(0, top + 1, set_bit, jnp.zeros((), integer))
    # The upper of an even number's two middle values is the lower again, or the least above it.
    above = jnp.where(bits > low, bits, jnp.iinfo(integer).max).min()
    high = jnp.where((bits <= low).sum() > values.size // 2, low, above)
    low, high = (jax.lax.bitcast_convert_type(x, values.dtype) for x in (low, high))
    return 0.5 * (low + high)


def entropy_coefficient(
    cost: Float[jax.Array, "n m"], dimension: jax.Array | float, fraction: float = 0.1
) -> Float[jax.Array, ""]:
    """Epsilon of a cross cost ``[n, m]``: a fraction of its median, at least 1e-3 / d."""
    return jnp.maximum(fraction * median(cost), 1e-3 / dimension)


class Solve(NamedTuple):
    """Target duals of the cross and self problems of one source bank."""

    epsilon: jax.Array
    expert_dual: jax.Array  # [m]
    self_dual: jax.Array  # [n]; the symmetric solve gives the two self duals at once
    converged: jax.Array  # [2] bool: cross, self
    iterations: jax.Array  # [2]


def solve(
    cross_cost: Float[jax.Array, "n m"],
    self_cost: Float[jax.Array, "k k"],
    epsilon: Float[jax.Array, ""],
    *,
    threshold: float = 1e-3,
    max_iterations: int = 200,
) -> Solve:
    """Solve transport of a source bank to the expert bank and to itself.

    Args:
      cross_cost: ``[n, m]`` source to expert.
      self_cost: ``[n, n]``.
      epsilon: entropy coefficient of both, held constant when differentiating.
      threshold: marginal error (L1) at which a solve has converged.
      max_iterations: bound; a solve that needs more is returned as it is, not converged.
    """
    inner = min(5, max_iterations)
    common = {"threshold": threshold, "inner_iterations": inner, "max_iterations": max_iterations}
    cross = sinkhorn.Sinkhorn(**common)(
        linear_problem.LinearProblem(geometry.Geometry(jax.lax.stop_gradient(cross_cost), epsilon=epsilon))
    )
    # Averaged parallel updates keep the two duals of the self problem equal and converge in a few iterations.
    symmetric = sinkhorn.Sinkhorn(parallel_dual_updates=True, momentum=acceleration.Momentum(value=0.5), **common)
    itself = symmetric(
        linear_problem.LinearProblem(geometry.Geometry(jax.lax.stop_gradient(self_cost), epsilon=epsilon))
    )
    return Solve(
        epsilon=jax.lax.stop_gradient(epsilon),
        expert_dual=jax.lax.stop_gradient(cross.g),
        self_dual=jax.lax.stop_gradient(0.5 * (itself.f + itself.g)),
        converged=jnp.stack([cross.converged, itself.converged]),
        iterations=jnp.stack([cross.n_iters, itself.n_iters]),
    )


def extension(
    cost: Float[jax.Array, "q m"], dual: Float[jax.Array, " m"], epsilon: Float[jax.Array, ""]
) -> tuple[Float[jax.Array, " q"], Float[jax.Array, "q m"]]:
    """Dual extension A(x) and matching probabilities (eqs. extension and gradient).

    Args:
      cost: ``[q, m]`` queries to targets.
      dual: ``[m]`` target dual in ott-jax's convention, where the masses are inside the dual.

    Returns:
      A ``[q]`` up to a constant, and p_j(x) ``[q, m]``.
    """
    logits = (dual - cost) / epsilon
    return epsilon * jax.nn.logsumexp(logits, axis=-1), jax.nn.softmax(logits, axis=-1)


def barycenter(probability: Float[jax.Array, "q m"], targets: Float[jax.Array, "m d"]) -> Float[jax.Array, "q d"]:
    """Mean target sum_j p_j y_j, ``[q, d]``; less x it is the gradient of a dual extension at x."""
    return jnp.matmul(probability, targets, precision=_HIGHEST)


@jax.jit
def discrepancy(
    x: Float[jax.Array, "n d"], y: Float[jax.Array, "m d"], dimension: jax.Array | float
) -> Float[jax.Array, ""]:
    """Debiased Sinkhorn divergence between features ``x [n, D]`` and ``y [m, D]``, at the cross cost's epsilon."""
    cross = squared_cost(x, y)
    epsilon = entropy_coefficient(cross, dimension)
    value, _ = sinkhorn_divergence.sinkhorn_divergence(
        geometry.Geometry,
        cross,
        squared_cost(x, x),
        squared_cost(y, y),
        epsilon=epsilon,
        solve_kwargs={"threshold": DISCREPANCY_THRESHOLD, "max_iterations": DISCREPANCY_ITERATIONS},
    )
    return value


class ScoreFunction(NamedTuple):
    """The transport score S_B of one source bank: higher where the expert is and the source is not."""

    source_bank: jax.Array  # [n, d]
    expert_bank: jax.Array  # [m, d]
    origin: jax.Array  # [d]; costs are taken about it, which keeps float32 exact for far banks
    solution: Solve

    @property
    def epsilon(self) -> jax.Array:
        return self.solution.epsilon

    def _extensions(self, x):
        x = x - self.origin
        expert, source = self.expert_bank - self.origin, self.source_bank - self.origin
        to_expert = extension(squared_cost(x, expert), self.solution.expert_dual, self.epsilon)
        to_source = extension(squared_cost(x, source), self.solution.self_dual, self.epsilon)
        return to_expert, to_source

    def score(self, x: Float[Floats, "q d"]) -> Float[jax.Array, " q"]:
        """S_B(x) = A_E(x) - (A_P1(x) + A_P2(x)) / 2, ``[q]``, up to a constant (eq. score)."""
        (expert, _), (source, _) = self._extensions(x)
        return expert - source

    def gradient(self, x: Float[Floats, "q d"]) -> Float[jax.Array, "q d"]:
        """Gradient of S_B at ``x [q, d]``."""
        (_, to_expert), (_, to_source) = self._extensions(x)
        return barycenter(to_expert, self.expert_bank) - barycenter(to_source, self.source_bank)

    def expert_extension(self, x: Float[Floats, "q d"]) -> tuple[Float[jax.Array, " q"], Float[jax.Array, "q d"]]:
        """A_E(x) ``[q]`` up to a constant, and its gradient ``[q, d]``."""
        (value, probability), _ = self._extensions(x)
        return value, barycenter(probability, self.expert_bank) - x

    def match_probability(self, x: Float[Floats, "q d"]) -> Float[jax.Array, "q m"]:
        """Probability of matching each expert atom, ``[q, m]``."""
        return self._extensions(x)[0][1]


def fit_score(
    source_bank: Float[Floats, "n d"],
    expert_bank: Float[Floats, "m d"],
    *,
    epsilon: float | jax.Array | None = None,
    threshold: float = 1e-6,
    max_iterations: int = 2000,
) -> ScoreFunction:
    """Fit the transport score between two sets of samples, from a source toward an expert.

    Args:
      source_bank: samples ``[n, d]`` to improve, such as windows of a policy.
      expert_bank: samples ``[m, d]`` of the target.
      epsilon: entropy coefficient; by default a tenth of the median cross cost, at least 1e-3 / d.
      threshold: marginal error (L1) at which the solver stops.
      max_iterations: of the solver, at most.

    Returns:
      The score, its gradient and its matching probabilities as functions of any points ``[q, d]``.

    Examples:
      >>> import jax.numpy as jnp
      >>> from fmpjax import transport
      >>> fitted = transport.fit_score(jnp.zeros((4, 1)), jnp.ones((4, 1)))
      >>> [round(float(g), 3) for g in fitted.gradient(jnp.array([[0.0], [0.5]]))[:, 0]]
      [1.0, 1.0]
    """
    source_bank, expert_bank = jnp.asarray(source_bank), jnp.asarray(expert_bank)
    origin = expert_bank.mean(0)
    source, expert = source_bank - origin, expert_bank - origin
    cross = squared_cost(source, expert)
    if epsilon is None:
        epsilon = entropy_coefficient(cross, source_bank.shape[-1])
    solution = solve(
        cross,
        squared_cost(source, source),
        jnp.asarray(epsilon, cross.dtype),
        threshold=threshold,
        max_iterations=max_iterations,
    )
    return ScoreFunction(source_bank, expert_bank, origin, solution)
