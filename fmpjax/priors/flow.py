"""Flow-Matched Motion Prior: the transport potential fitted online (sections III-C and III-D of the paper).

An update draws a source bank from the rollout, solves its transport to the expert bank and to itself, and takes one
Adam step on three losses: the centered value of the score, its gradient, and the flow along rollout-to-expert paths.
The average of the updates' parameters then scores every window.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Float

from fmpjax import learning, potential, sharding, transport
from fmpjax.config import Config, PriorConfig
from fmpjax.priors.base import (
    Coupling,
    Expert,
    MotionPrior,
    Rollout,
    couple_draws,
    flatten,
    median_reward,
)


class FlowState(NamedTuple):
    """State of the prior between rollouts."""

    bank: jax.Array  # [m] int32, rows of the demonstration's windows: E of the paper, drawn once
    params: potential.Params
    optimizer: optax.OptState
    average: potential.Params  # averaged over updates, the last rollout's alone if it restarts; it scores


class Teacher(NamedTuple):
    """Transport supervision at the queries of one update."""

    score: jax.Array  # [q] up to a constant
    gradient: jax.Array  # [q, D]
    to_expert: jax.Array  # [q, m] conditional matching probabilities
    to_source: jax.Array  # [q, n]
    solution: transport.Solve


def teach(coupling: Coupling, expert: Float[jax.Array, "m D"], query: Float[jax.Array, "q D"] | None) -> Teacher:
    """Read score, gradient and matching probabilities of a solved source bank at the queries.

    Args:
      expert: ``[m, D]``, the bank that it was solved against.
      query: ``[q, D]``; the source bank itself when None, which saves two cost matrices.
    """
    source, solution = coupling.source, coupling.solution
    if query is None:
        query_to_expert, query_to_source = sharding.split((coupling.cross_cost, coupling.self_cost))
    else:
        query_to_expert = transport.squared_cost(query, expert)
        query_to_source = transport.squared_cost(query, source)
    expert_value, to_expert = transport.extension(query_to_expert, solution.expert_dual, solution.epsilon)
    source_value, to_source = transport.extension(query_to_source, solution.self_dual, solution.epsilon)
    return Teacher(
        score=expert_value - source_value,
        # The -x of the two gradients cancels.
        gradient=transport.barycenter(to_expert, expert) - transport.barycenter(to_source, source),
        to_expert=to_expert,
        to_source=to_source,
        solution=solution,
    )


class Flow(NamedTuple):
    """Supervision along the paths of one update."""

    point: jax.Array  # [q, D] x_tau
    tau: jax.Array  # [q]
    head: jax.Array  # [q, 3] weights of the heads, one-hot
    velocity: jax.Array  # [q, D] z - x


def pick(
    draw: Float[jax.Array, " q"], probability: Float[jax.Array, "q m"], targets: Float[jax.Array, "m D"]
) -> Float[jax.Array, "q D"]:
    """Targets ``[q, D]`` by probabilities ``[q, m]`` over ``targets [m, D]`` and uniform numbers ``draw [q]``."""
    index = (jnp.cumsum(probability, axis=-1) < draw[:, None]).sum(-1)
    return targets[jnp.minimum(index, len(targets) - 1)]


def sample_flow(
    key: jax.Array,
    query: Float[jax.Array, "q D"],
    teacher: Teacher,
    source: Float[jax.Array, "n D"],
    expert: Float[jax.Array, "m D"],
) -> Flow:
    """Draw a head, a target atom by that head's probabilities, and a flow time for each query (eq. flow)."""
    head_key, atom_key, tau_key = jax.random.split(key, 3)
    head = jax.random.randint(head_key, query.shape[:1], 0, potential.HEADS)
    draw = jax.random.uniform(atom_key, query.shape[:1])
    cross, itself = pick(draw, teacher.to_expert, expert), pick(draw, teacher.to_source, source)
    target = jnp.where((head == 0)[:, None], cross, itself)
    tau = jax.random.uniform(tau_key, query.shape[:1])
    velocity = target - query
    return Flow(query + tau[:, None] * velocity, tau, jax.nn.one_hot(head, potential.HEADS), velocity)


def static_path(flow: Flow, coupling: Coupling, expert: jax.Array) -> Flow:
    """Static supervision at the same points (eq. static): the score's gradient by a bank of its own, at time zero.

    Args:
      flow: whose points are asked.
      coupling: of a bank B', independent of the one that drew the points.
      expert: ``[m, D]``.
    """
    contrast = jnp.broadcast_to(jnp.asarray(potential.SCORE_CONTRAST), flow.head.shape)
    gradient = teach(coupling, expert, flow.point).gradient
    return Flow(flow.point, jnp.zeros_like(flow.tau), contrast, gradient)


def losses(params, query, teacher: Teacher, flow: Flow, dimension, config: PriorConfig):
    """Weighted sum of the losses, and statistics: each of them, the correlation of values (eqs. value to flow).

    Queries at time zero and flow points go through the network as one batch.
    """
    count = len(query)
    contrast = jnp.broadcast_to(jnp.asarray(potential.SCORE_CONTRAST), (count, potential.HEADS))
    terms = {}
    if config.flow_weight:
        # Side by side, not one after the other: each query's two points stay on its device.
        pair = lambda a, b: jnp.stack([a, b], axis=1).reshape(2 * count, *a.shape[1:])  # noqa: E731
        points, times = pair(query, flow.point), pair(jnp.zeros(count), flow.tau)
        values, gradients = potential.contrast(params, points, times, pair(contrast, flow.head), dimension)
        values, gradients = values.reshape(count, 2), gradients.reshape(count, 2, -1)
        terms["flow"] = jnp.mean(jnp.sum((gradients[:, 1] - flow.velocity) ** 2, axis=-1))
        values, gradients = values[:, 0], gradients[:, 0]
    else:
        values, gradients = potential.contrast(params, query, jnp.zeros(count), contrast, dimension)
    if config.endpoint_weight:
        terms["endpoint"] = jnp.mean(jnp.sum((gradients - teacher.gradient) ** 2, axis=-1))
    centered, target = values - values.mean(), teacher.score - teacher.score.mean()
    terms["value"] = jnp.mean((centered - target) ** 2) / config.value_scale**2
    total = sum(getattr(config, f"{name}_weight") * term for name, term in terms.items())
    stats = {f"{name}_loss": term for name, term in terms.items()}
    product = jnp.sum(centered**2) * jnp.sum(target**2)
    stats["value_correlation"] = jnp.sum(centered * target) / jnp.sqrt(jnp.maximum(product, 1e-30))
    return total, stats


def make(expert: Expert, config: Config) -> MotionPrior:
    """Flow-Matched Motion Prior: a potential fitted to transport by three losses, of value, endpoint and flow."""
    return _make(expert, config.prior)


def make_endpoint(expert: Expert, config: Config) -> MotionPrior:
    """FMP without the flow loss, everything else the same."""
    return _make(expert, dataclasses.replace(config.prior, flow_weight=0.0))


def make_value(expert: Expert, config: Config) -> MotionPrior:
    """FMP without the flow and the endpoint loss, everything else the same."""
    changed = dataclasses.replace(config.prior, flow_weight=0.0, endpoint_weight=0.0)
    return _make(expert, changed)


def make_static(expert: Expert, config: Config) -> MotionPrior:
    """FMP with static in place of dynamic supervision on the same paths: a control to fit offline, not a method.

    Everything random but the second bank is drawn as FMP draws it.
    """
    return _make(expert, config.prior, static=True)


def _make(expert: Expert, config: PriorConfig, *, static: bool = False) -> MotionPrior:
    # long: the functions of a prior close over its settings
    windows, dimension = expert.windows, expert.dimension
    optimizer = optax.chain(optax.clip_by_global_norm(config.clip_norm), optax.adam(config.learning_rate))
    newest = learning.newest_share(config.average_half_life)  # half-life in updates

    def init(key):
        bank_key, key = jax.random.split(key)
        params = potential.init(key, windows.shape[-1], dimension, config.hidden)
        return FlowState(expert.bank_rows(bank_key, config.bank), params, optimizer.init(params), params)

    def score(state: FlowState, x):
        return potential.score(state.average, x, dimension)

    def fit_once(carry, drawn, expert_bank, pool, count):
        params, optimizer_state, average = carry
        coupling, second, query_key, flow_key = drawn
        if config.query_is_bank:
            query, teacher = sharding.split(coupling.source), teach(coupling, expert_bank, None)
        else:
            querying = max(1, int(config.query_share * count))  # the first environments supply the queries
            row = jax.random.randint(query_key, (config.minibatch,), 0, len(pool) // count * querying)
            query = sharding.split(pool[row // querying * count + row % querying])
            teacher = teach(coupling, expert_bank, query)
        flow = sample_flow(flow_key, query, teacher, coupling.source, expert_bank)
        if static:
            flow = static_path(flow, second, expert_bank)
        (total, stats), gradients = jax.value_and_grad(losses, has_aux=True)(
            params, query, teacher, flow, dimension, config
        )
        step = learning.step_if_finite(optimizer, params, optimizer_state, total, gradients)
        metrics = stats | {
            "gradient_norm": step.gradient_norm,
            "epsilon": teacher.solution.epsilon,
            "sinkhorn_iterations": teacher.solution.iterations.max(),
            "unconverged": (~teacher.solution.converged).sum().astype(jnp.float32),
            "skipped": step.skipped,
        }
        return (step.params, step.optimizer, learning.toward(average, step.params, newest)), metrics

    def update(state: FlowState, rollout: Rollout, key):
        expert_bank, shape = windows[state.bank], rollout.valid.shape
        # A window that is not finite is replaced by the first of the demonstration, and is not rewarded.
        pool = flatten(rollout, windows[0])
        bank_keys, query_keys, flow_keys = jax.vmap(lambda key: jax.random.split(key, 3), out_axes=1)(
            jax.random.split(key, config.updates)
        )
        first = couple_draws(bank_keys, pool, expert_bank, dimension, config)
        second = None
        if static:
            second_keys = jax.vmap(lambda key: jax.random.fold_in(key, 1))(bank_keys)
            second = couple_draws(second_keys, pool, expert_bank, dimension, config)
        carry, metrics = jax.lax.scan(
            lambda carry, drawn: fit_once(carry, drawn, expert_bank, pool, shape[1]),
            (state.params, state.optimizer, state.params if config.average_restarts else state.average),
            (first, second, query_keys, flow_keys),
        )
        state = FlowState(state.bank, *carry)
        result = median_reward(score(state, pool).reshape(shape), rollout.valid, config.spread_floor)
        summary = {name: values.mean() for name, values in metrics.items()}
        for name in ("unconverged", "skipped"):
            summary[name] = metrics[name].sum()
        summary |= learning.score_metrics(result.median, result.spread, score(state, expert_bank), config.spread_floor)
        return state, result.reward, summary

    return MotionPrior(init, update, score)
