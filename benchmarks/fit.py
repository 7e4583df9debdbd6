"""What does one reward update cost, against the floor of its matrix products?

Full size: 256 queries distinct from the source bank, banks of 256, windows of ten 239-number frames (1,170 compact
coordinates), three losses. Windows are the bundled walk's with noise. The update is timed as the slope between two
scans of different lengths, so that scoring and dispatch fall out; its parts are timed one by one on the same data. On
an accelerator, or with --whole, as many updates as the paper reports are made, a rollout's in a call. The floor is the
update's matrix products, counted by formula, at the machine's own rate for them, measured in the same run.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import optax

from fmpjax import config, motion, priors, transport
from fmpjax.config import PriorConfig
from fmpjax.experiments.common.offline import product_flops, product_rate
from fmpjax.priors import flow
from fmpjax.trainer import Trainer

TARGET = 50.0  # ms an update
REPORTED_UPDATES = 9216  # of the paper's offline comparison
FEW, MANY = 4, 20  # updates of the two scans


def seconds(call: Callable[[], object]) -> float:
    """Time of a call, until its arrays are there."""
    began = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - began


def parts(settings: PriorConfig, dimension, source, query, expert, params) -> dict[str, Callable[[], object]]:
    """The update's parts as compiled calls on one source bank and its queries."""
    costs = jax.jit(
        lambda s, q, e: (
            transport.squared_cost(s, e),
            transport.squared_cost(s, s),
            transport.squared_cost(q, e),
            transport.squared_cost(q, s),
        )
    )
    cross, itself, to_expert, to_source = costs(source, query, expert)
    entropy = jax.jit(lambda c: transport.entropy_coefficient(c, dimension, settings.epsilon_fraction))
    epsilon = entropy(cross)
    threshold, most = settings.sinkhorn_threshold, settings.sinkhorn_iterations
    solve = jax.jit(lambda c, i, e: transport.solve(c, i, e, threshold=threshold, max_iterations=most))
    solution = solve(cross, itself, epsilon)

    @jax.jit
    def extend(to_expert, to_source, solution):
        value, p = transport.extension(to_expert, solution.expert_dual, solution.epsilon)
        own, own_p = transport.extension(to_source, solution.self_dual, solution.epsilon)
        return flow.Teacher(value - own, p @ expert - own_p @ source, p, own_p, solution)

    teacher = extend(to_expert, to_source, solution)
    sample = jax.jit(lambda key: flow.sample_flow(key, query, teacher, source, expert))
    points = sample(jax.random.PRNGKey(0))
    network = jax.jit(
        lambda p: jax.value_and_grad(flow.losses, has_aux=True)(p, query, teacher, points, dimension, settings)
    )
    optimizer = optax.chain(optax.clip_by_global_norm(settings.clip_norm), optax.adam(settings.learning_rate))
    adam, gradients = optimizer.init(params), network(params)[1]
    step = jax.jit(lambda g, a, p: optimizer.update(g, a, p))
    return {
        "costs": lambda: costs(source, query, expert),
        "median": lambda: entropy(cross),
        "Sinkhorn": lambda: solve(cross, itself, epsilon),
        "extensions, teacher": lambda: extend(to_expert, to_source, solution),
        "flow samples": lambda: sample(jax.random.PRNGKey(0)),
        "losses and gradient": lambda: network(params),
        "Adam": lambda: step(gradients, adam, params),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument(
        "--whole", action=argparse.BooleanOptionalAction, default=jax.default_backend() != "cpu",
        help=f"make {REPORTED_UPDATES:,} updates",
    )  # fmt: skip
    parser.add_argument("--noise", type=float, default=0.5, help="noise of the windows, standard deviations")
    parser.add_argument("--environments", type=int, default=64, help="the pool is 32 windows of each")
    arguments = parser.parse_args()

    settings = config.preset("paper")
    clip = motion.load(settings.motion, rate=settings.control_rate, robot=settings.robot)
    trainer = Trainer(settings, clip)
    windows, fitted = trainer.expert.windows, settings.prior
    dimension, size = trainer.feature_map.dimension, windows.shape[-1]
    pick_key, noise_key, prior_key, key = jax.random.split(jax.random.PRNGKey(0), 4)
    shape = (settings.ppo.rollout_steps, arguments.environments)
    picked = windows[jax.random.randint(pick_key, shape, 0, len(windows))]
    weight = jnp.tile(trainer.feature_map.weight, settings.features.history)
    features = picked + arguments.noise * weight * jax.random.normal(noise_key, picked.shape)
    rollout = priors.Rollout(features, jnp.ones(shape, bool))

    def scan(updates: int):
        changed = dataclasses.replace(settings, prior=dataclasses.replace(fitted, updates=updates))
        prior = priors.make("fmp", trainer.expert, changed)
        update, state = jax.jit(prior.update), prior.init(prior_key)
        return lambda: update(state, rollout, key)

    if arguments.whole:  # first: the parts below take a minute to compile on an accelerator
        call = scan(fitted.updates)
        seconds(call)
        calls = REPORTED_UPDATES // fitted.updates
        taken = sum(seconds(call) for _ in range(calls))
        print(f"{calls * fitted.updates:,} updates made, with their {calls} scorings: {taken:,.1f} s", flush=True)

    few, many = scan(FEW), scan(MANY)
    pool = features.reshape(-1, size)
    warm = many()
    expert = windows[warm[0].bank]
    pieces = parts(fitted, dimension, pool[: fitted.bank], pool[-fitted.minibatch :], expert, warm[0].params)
    rate = product_rate(2 * fitted.minibatch, size, fitted.hidden[0])
    for call in (few, many, *pieces.values()):
        seconds(call)
    slopes, rates, taken = [], [], []
    for _ in range(arguments.rounds):
        slopes.append(1e3 * (seconds(many) - seconds(few)) / (MANY - FEW))
        rates.append(rate())
        taken.append([1e3 * seconds(call) for call in pieces.values()])
    update, rate, taken = float(np.median(slopes)), float(np.median(rates)), np.median(taken, axis=0)
    print(
        f"{fitted.minibatch} queries, banks of {fitted.bank}, d = {float(dimension):.0f} ({size} compact), Sinkhorn "
        f"{float(warm[2]['sinkhorn_iterations']):.0f} iterations, {float(warm[2]['unconverged']):.0f} not converged"
    )
    show(dict(zip(pieces, taken, strict=True)), update, rate, product_flops(fitted, size))


def show(parts: dict[str, float], update: float, rate: float, flops: dict[str, float]) -> None:
    """Print the parts and the update (ms), and its floor at a rate of products (FLOP/s)."""
    whole, floor = sum(parts.values()), 1e3 * sum(flops.values()) / rate
    print(f"{'part':<24}{'ms':>8}{'share':>8}")
    for name, ms in parts.items():
        print(f"{name:<24}{ms:>8.2f}{100 * ms / whole:>7.0f}%")
    print(f"{'sum of the parts':<24}{whole:>8.2f}")
    print(f"{'update, in the scan':<24}{update:>8.2f}   target {TARGET:.0f}: {'met' if update <= TARGET else 'missed'}")
    products = ", ".join(f"{name} {count / 1e9:.2f}" for name, count in flops.items())
    print(
        f"{'floor':<24}{floor:>8.2f}   {sum(flops.values()) / 1e9:.2f} GFLOP ({products}) at {rate / 1e9:.0f} GFLOP/s"
    )
    print(f"{'update over floor':<24}{update / floor:>8.2f}")
    print(f"{REPORTED_UPDATES:,} updates at that: {REPORTED_UPDATES * update / 1e3:,.0f} s")


if __name__ == "__main__":
    main()
