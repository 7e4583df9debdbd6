"""Priors fitted to the windows of one frozen policy, and measured against independent transport references.

All priors begin at the same parameters and see the same banks, queries and paths, so that they differ in their losses
alone. They are then asked where they were not fitted: in environments held out, along rollout-to-expert paths, and on
histories that a standing and a walking policy executed (section V-B of the paper).
"""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import potential, priors
from fmpjax.config import Config, PriorConfig
from fmpjax.errors import UserError
from fmpjax.experiments.common import histories
from fmpjax.experiments.common.reference import Reference, centered_error, correlation, cosine, reference, spread
from fmpjax.logs import Progress, clock
from fmpjax.priors import flow
from fmpjax.shell import default
from fmpjax.trainer import Trainer

FRACTIONS = (0.0, 0.25, 0.5, 0.75, 1.0)  # of the way from a rollout's window to an expert's [P]
BLOCK = 128  # updates of one call, as many as the paper's of a rollout: the parameter average restarts in each [P]
GROUPS = "groups"  # the second reference group, measured like a prior

QUERY_SHARE = 0.75  # environments that supply queries; the others are held out [P]
MAKERS = {
    "fmp": flow.make,
    "endpoint": flow.make_endpoint,
    "value": flow.make_value,
    "static": flow.make_static,
}
COUNTED = ("fmp", "static")  # priors whose updates `product_flops` counts


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is fitted and measured; the defaults are the paper's where it gives one."""

    environments: int = 1024  # of which the first three quarters supply queries [P]
    updates: int = 9216  # [P]
    banks: int = 128  # of each of two reference groups [P]
    paths: int = 512  # windows held out that are moved toward the expert [D]
    cohort: int = 128  # executed histories of each policy [P]


SMOKE = Size(environments=32, updates=4, banks=2, paths=16, cohort=8)


Updates = Annotated[int | None, default(f"{Size.updates:,}; {SMOKE.updates:,} with --smoke")]


def size(updates: int | None, smoke: bool) -> Size:
    """The size that a command line asks for.

    Raises:
      UserError: updates that are no whole number of blocks.
    """
    chosen = SMOKE if smoke else Size()
    updates = chosen.updates if updates is None else updates
    if updates < 1 or updates % min(BLOCK, updates):
        raise UserError(f"--updates is {updates}: expected a multiple of {BLOCK}, or fewer than that")
    return dataclasses.replace(chosen, updates=updates)


# --- what an update costs at least -----------------------------------------------------------------------------------


def product_flops(settings: PriorConfig, width: int, *, static: bool = False) -> dict[str, float]:
    """Floating-point operations of an update's matrix products, for windows of ``width`` coordinates."""
    bank, query = settings.bank, settings.minibatch
    points = query * (2 if settings.flow_weight else 1)
    # A layer's product and its transpose for the gradient in x; then the adjoints of both: two each, but that the
    # points themselves need none.
    layers = [(width, settings.hidden[0], 5), (width, potential.HEADS, 4)]
    layers += [(i, o, 6) for i, o in zip(settings.hidden, (*settings.hidden[1:], potential.HEADS), strict=True)]
    teachers = 2 if static else 1
    return {
        "costs": 2.0 * width * (bank * bank * 2 + query * bank * 2) * teachers,
        "teacher gradient": 2.0 * width * query * bank * 2 * teachers,
        "network": sum(2.0 * points * i * o * times for i, o, times in layers),
    }


def product_rate(points: int, width: int, hidden: int, rounds: int = 8) -> Callable[[], float]:
    """Measures the machine's rate (FLOP/s) for products of the network's first layer's shape."""
    a, b = jnp.ones((points, width)), jnp.ones((width, hidden))
    chain = jax.jit(lambda a, b: jax.lax.fori_loop(0, rounds, lambda _, a: (a @ b) @ b.T * 1e-6, a))
    jax.block_until_ready(chain(a, b))

    def rate() -> float:
        began = time.perf_counter()
        jax.block_until_ready(chain(a, b))
        return 4.0 * rounds * points * width * hidden / (time.perf_counter() - began)

    return rate


# --- fitting ---------------------------------------------------------------------------------------------------------


class Fit(NamedTuple):
    """A fitted prior."""

    state: flow.FlowState
    seconds: float  # of fitting, compilation left out
    unconverged: float  # solves that did not reach their threshold


def fit(
    names: Sequence[str], expert: priors.Expert, config: Config, rollout: priors.Rollout, updates: int, key
) -> tuple[dict[str, Fit], float]:
    """Fit every prior by as many updates on one rollout, block after block in turn, each block one compiled scan.

    Taking turns makes the times comparable on a machine that does something else besides.

    Returns:
      The fits by name, and the machine's rate for matrix products in between, FLOP/s.
    """
    block = min(BLOCK, updates)
    prior = dataclasses.replace(
        config.prior, updates=block, query_share=QUERY_SHARE, query_is_bank=False, average_restarts=True
    )
    config = dataclasses.replace(config, prior=prior)
    init_key, key = jax.random.split(key)
    made = {name: MAKERS[name](expert, config) for name in names}
    states = {name: prior.init(init_key) for name, prior in made.items()}
    compiled = {name: jax.jit(prior.update).lower(states[name], rollout, key).compile() for name, prior in made.items()}
    rate = product_rate(2 * config.prior.minibatch, expert.windows.shape[-1], config.prior.hidden[0])
    seconds, unconverged, rates = dict.fromkeys(made, 0.0), dict.fromkeys(made, 0.0), []
    progress, began = Progress(30.0), time.monotonic()
    blocks = updates // block
    for done, block_key in enumerate(jax.random.split(key, blocks), 1):
        for name, update in compiled.items():
            started = time.perf_counter()
            states[name], _, metrics = jax.block_until_ready(update(states[name], rollout, block_key))
            seconds[name] += time.perf_counter() - started
            unconverged[name] += float(metrics["unconverged"])
        rates.append(rate())
        left = clock((time.monotonic() - began) * (blocks - done) / done)
        progress.show(f"{done * block:,} of {updates:,} updates | {left} left", final=done == blocks)
    fits = {name: Fit(states[name], seconds[name], unconverged[name]) for name in made}
    return fits, float(np.median(rates))


# --- measuring -------------------------------------------------------------------------------------------------------


class Layout(NamedTuple):
    """Where the queries of a study are in one batch."""

    held_out: slice
    paths: tuple[slice, ...]  # a slice a fraction
    executed: slice  # standing and walking
    walking: slice


def lay_out(held_out: int, paths: int, standing: int, walking: int) -> Layout:
    """The queries' places: those held out, the fractions of the paths, standing histories, walking ones."""
    executed = held_out + len(FRACTIONS) * paths
    end = executed + standing + walking
    starts = [held_out + i * paths for i in range(len(FRACTIONS))]
    return Layout(
        slice(held_out), tuple(slice(s, s + paths) for s in starts), slice(executed, end), slice(end - walking, end)
    )


def agreement(candidate: Reference, truth: Reference, layout: Layout, floor: float) -> dict[str, Any]:
    """How a candidate's score and gradient agree with a reference's at the study's queries.

    Rewards are normalized by the median and range of their own scores over the queries compared. Increments are the
    score's change from a path's source, their error is in interquartile ranges of the reference at the sources.
    """
    source = layout.paths[0]
    source_spread = jnp.maximum(spread(truth.score[source]), floor)

    def reward_error(rows):
        valid = jnp.ones(len(truth.score[rows]), bool)
        ours, theirs = (priors.median_reward(x.score[rows], valid, floor).reward for x in (candidate, truth))
        return jnp.abs(ours - theirs).mean()

    def increment_error(rows):
        ours, theirs = (x.score[rows] - x.score[source] for x in (candidate, truth))
        return jnp.sqrt(jnp.mean((ours - theirs) ** 2)) / source_spread

    def over(function, rows, *, field="score"):
        return function(getattr(candidate, field)[rows], getattr(truth, field)[rows])

    executed = layout.executed
    figures = {
        "held_out_error": reward_error(layout.held_out),
        "held_out_correlation": over(correlation, layout.held_out),
        "held_out_cosine": over(cosine, layout.held_out, field="gradient"),
        "source_error": reward_error(source),
        "path_correlation": [over(correlation, rows) for rows in layout.paths],
        "path_cosine": [over(cosine, rows, field="gradient") for rows in layout.paths],
        "path_increment": [increment_error(rows) for rows in layout.paths],
        "walking_correlation": over(correlation, layout.walking),
        "walking_cosine": over(cosine, layout.walking, field="gradient"),
        "executed_error": over(centered_error, executed) / jnp.maximum(spread(truth.score[executed]), floor),
    }
    return jax.tree.map(float, figures)


def paths(pool, expert, source, dimension, config: PriorConfig, key) -> list[jax.Array]:
    """Points ``[q, D]`` at each of `FRACTIONS` on the way from ``source [q, D]`` to matched atoms of ``expert [m, D]``.

    Each source goes to one atom, drawn by its matching probabilities in the transport of a bank of ``pool [n, D]``.
    """
    bank_key, draw_key = jax.random.split(key)
    bank = pool[jax.random.randint(bank_key, (config.bank,), 0, len(pool))]
    teacher = flow.teach(priors.couple(bank, expert, dimension, config), expert, source)
    target = flow.pick(jax.random.uniform(draw_key, source.shape[:1]), teacher.to_expert, expert)
    return [source + fraction * (target - source) for fraction in FRACTIONS]


class _Played(NamedTuple):
    """What the two policies of a study executed."""

    pool: histories.Pool  # of the standing policy
    still: histories.Cohort  # soon after a reset, of the standing policy
    moving: histories.Cohort  # likewise, of the walking one
    told: dict[str, Any]  # how far the policies were trained, their speeds and the cohorts' sizes


def _play(run: Path, walking: Path, size: Size, keys: jax.Array) -> tuple[Trainer, _Played]:
    """The standing run's parts, and the windows that both policies execute."""
    trainer, state = histories.policy(run, best=False)
    walker, walker_state = histories.policy(walking, best=True)
    _check_alike(run, trainer, walking, walker)
    print(f"playing {size.environments} environments of {run}, and {walking} ...", flush=True)
    still = histories.soon_after_reset(trainer, state.ppo, trainer.feature_map, keys[0], size.cohort, "standing")
    moving = histories.soon_after_reset(walker, walker_state.ppo, trainer.feature_map, keys[1], size.cohort, "walking")
    pool = histories.pool(trainer, state.ppo, trainer.feature_map, keys[2], count=size.environments)
    told = {
        "standing_transitions": int(state.iteration) * trainer.config.transitions_per_iteration,
        "walking_transitions": int(walker_state.iteration) * walker.config.transitions_per_iteration,
        "pool_speed": pool.speed, "standing_speed": still.speed, "walking_speed": moving.speed,
        "standing": len(still.features), "walking": len(moving.features),
    }  # fmt: skip
    return trainer, _Played(pool, still, moving, told)


def _measure(
    trainer: Trainer, played: _Played, fits: Mapping[str, Fit], size: Size, keys: jax.Array
) -> tuple[dict[str, dict[str, Any]], float]:
    """Figures of every fit and of the second reference group, by name; and the time of both references, s."""
    config, dimension = trainer.config.prior, trainer.feature_map.dimension
    pool, still, moving = played.pool.features, played.still.features, played.moving.features
    width = pool.shape[-1]
    everything = pool.reshape(-1, width)
    expert = trainer.expert.windows[next(iter(fits.values())).state.bank]
    held_out = pool[:, int(QUERY_SHARE * size.environments) :].reshape(-1, width)
    source = held_out[jax.random.choice(keys[0], len(held_out), (size.paths,), replace=False)]
    points = paths(everything, expert, source, dimension, config, keys[1])
    query = jnp.concatenate([held_out, *points, still, moving])
    layout = lay_out(len(held_out), size.paths, len(still), len(moving))

    print(f"two references of {size.banks} banks at {len(query):,} queries ...", flush=True)
    refer = jax.jit(reference, static_argnames=("config", "banks"))
    began = time.perf_counter()
    truth, other = (
        jax.block_until_ready(refer(everything, expert, query, dimension, config, key, size.banks))
        for key in jax.random.split(keys[2])
    )
    seconds = time.perf_counter() - began
    models: dict[str, dict[str, Any]] = {}
    for name, fitted in fits.items():
        candidate = Reference(*potential.score_and_gradient(fitted.state.average, query, dimension))
        models[name] = agreement(candidate, truth, layout, config.spread_floor)
        models[name] |= {"seconds": fitted.seconds, "unconverged": fitted.unconverged}
    models[GROUPS] = agreement(other, truth, layout, config.spread_floor)
    return models, seconds


def study(run: Path, walking: Path, names: Sequence[str], size: Size, seed: int) -> dict[str, Any]:
    """Fit priors to a standing run's windows and measure all of them, and a second reference group, in the same way.

    Args:
      run: folder of a run whose newest policy stands.
      walking: folder of a run of the same demonstration whose best policy walks.
      names: of the priors, keys of `MAKERS`.
      size: of the study.
      seed: of everything random.

    Returns:
      Settings, what the policies did, and by name each prior's figures as `agreement` gives them, with its fitting time
      and, where counted, the least time of its matrix products at the rate measured beside it (s).

    Raises:
      UserError: a folder holds no policy, the runs do not belong together, or a cohort is empty.
    """
    keys = jax.random.split(jax.random.PRNGKey(seed), 7)
    trainer, played = _play(run, walking, size, keys[:3])
    pool = played.pool
    print(f"fitting {', '.join(names)} to {pool.valid.size:,} windows, {pool.speed:.3f} m/s ...", flush=True)
    rollout = priors.Rollout(pool.features, pool.valid)
    fits, rate = fit(names, trainer.expert, trainer.config, rollout, size.updates, keys[3])
    models, reference_seconds = _measure(trainer, played, fits, size, keys[4:])
    for name in set(names) & set(COUNTED):
        flops = product_flops(trainer.config.prior, pool.features.shape[-1], static=name == "static")
        models[name]["floor_seconds"] = size.updates * sum(flops.values()) / rate
    config = trainer.config
    return {
        "settings": dataclasses.asdict(size) | {
            "seed": seed, "preset": config.preset, "motion": Path(config.motion).name, "frames": config.frames,
        },
        "policies": played.told,
        "product_rate": rate,
        "reference_seconds": reference_seconds,
        "fractions": FRACTIONS,
        "models": models,
    }  # fmt: skip


def _check_alike(run: Path, trainer: Trainer, walking: Path, walker: Trainer) -> None:
    """Raise a `UserError` unless windows of both runs are of one robot, length and rate."""
    for key in ("robot", "features.history", "control_rate"):
        ours, theirs = (attrgetter(key)(t.config) for t in (trainer, walker))
        if ours != theirs:
            raise UserError(f"run {walking} has {key} {theirs!r} and run {run} {ours!r}: expected the same in both")


def rows(record: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A study's figures as lines of a CSV file, one a prior; lists become a column a fraction."""
    lines = []
    for name, figures in record["models"].items():
        line: dict[str, Any] = {"model": name}
        for key, value in figures.items():
            if isinstance(value, list):
                line |= {f"{key}_{f}": v for f, v in zip(record["fractions"], value, strict=True)}
            else:
                line[key] = value
        lines.append(line)
    return [{key: line.get(key, "") for key in lines[0]} for line in lines]


def cost(record: Mapping[str, Any]) -> str:
    """A sentence on the time of the fits and the floor below it."""
    parts = []
    for name, figures in record["models"].items():
        if "seconds" not in figures:
            continue
        part = f"{name} {figures['seconds']:,.0f} s"
        if "floor_seconds" in figures:
            part += f" ({figures['floor_seconds']:,.0f} s for its matrix products alone)"
        parts.append(part)
    return (
        f"{record['settings']['updates']:,} updates: {', '.join(parts)}, at {record['product_rate'] / 1e9:.0f} GFLOP/s "
        "in matrix products of the network's first layer, measured in between"
    )
