"""How many transitions a second does training make, end to end, and where does the time go?

The whole program is timed as a run calls it: iterations scanned and compiled. Its parts are compiled one by one and
timed in turn with it on a state that it reached. The floor stands beside them: the physics alone on that state, which
on a CPU is `mujoco.rollout` without JAX.
"""

import argparse
import csv
import dataclasses
import resource
import sys
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import config, motion, priors
from fmpjax.config import Config
from fmpjax.physics.native import NativePhysics
from fmpjax.train import Trainer, TrainState, _batch

CALL = 30_000  # transitions in a call of the compiled program, about


def seconds(call: Callable[[], object]) -> float:
    """Time of a call, until its arrays are there."""
    began = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - began


def peak_memory() -> float:
    """Greatest resident memory of this process so far, MB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def physics_alone(trainer: Trainer, state: TrainState) -> Callable[[], object]:
    """A rollout's physics and nothing else, from the environments' present states."""
    backend, steps = trainer.env.physics, trainer.config.ppo.rollout_steps
    sim, count = state.env.physics, trainer.config.env.count
    targets = jnp.broadcast_to(
        trainer.env.actions(jnp.zeros(trainer.robot.joint_count)), (count, sim.qpos.shape[-1] - 7)
    )
    if not isinstance(backend, NativePhysics):
        scanned = jax.jit(lambda s, t: jax.lax.scan(lambda s, _: (backend.step(s, t), None), s, None, length=steps)[0])
        return lambda: scanned(sim, targets)
    qpos, qvel = np.asarray(sim.qpos, np.float64), np.asarray(sim.qvel, np.float64)
    initial = np.concatenate([np.zeros((count, 1)), qpos, qvel], axis=1)
    control = np.repeat(np.asarray(targets, np.float64)[:, None], steps * backend.substeps, axis=1)
    warmstart = np.asarray(sim.warmstart, np.float64)
    return lambda: backend._pool.rollout(backend.model, backend._data, initial, control, initial_warmstart=warmstart)[0]


def parts(trainer: Trainer, state: TrainState) -> dict[str, Callable[[], object]]:
    """The parts of one iteration as compiled calls on ``state``."""
    env, ppo, steps = trainer.env, trainer.ppo, trainer.config.ppo.rollout_steps
    key = jax.random.PRNGKey(0)
    rollout = jax.jit(lambda s, k: env.rollout(s.env, ppo.act(s.ppo), k, steps))
    windows = jax.jit(lambda s, r: trainer.feature_map(env.frame_table(s.env, r)[r.window]))
    update = jax.jit(trainer.prior.update)
    improve = jax.jit(lambda s, r, reward, k: ppo.update(s.ppo, _batch(r, reward), k))
    _, record = rollout(state, key)
    features = windows(state, record)
    seen = priors.Rollout(features, ~record.nonfinite)
    reward = update(state.prior, seen, key)[1]
    return {
        "rollout": lambda: rollout(state, key),
        "features": lambda: windows(state, record),
        "fit + score": lambda: update(state.prior, seen, key),
        "PPO": lambda: improve(state, record, reward, key),
    }


def measure(settings: Config, rounds: int) -> list[tuple[str, float, float, float]]:
    """Rows ``name, ms an iteration, share of the parts, transitions/s``; prints what is no row."""
    size = settings.transitions_per_iteration
    settings = dataclasses.replace(settings, chunk=max(1, min(settings.chunk, round(CALL / size))))
    clip = motion.load(settings.motion, rate=settings.control_rate, robot=settings.robot)
    trainer = Trainer(settings, clip)
    state = trainer.init()
    began = time.perf_counter()
    chunk = trainer.compile(state)
    compiled = time.perf_counter() - began
    state, _ = jax.block_until_ready(chunk(state))
    memory = peak_memory()
    # The compiled program takes its state's buffers; the parts keep a copy.
    kept = jax.tree.map(jnp.copy, state)
    calls = parts(trainer, kept) | {"physics alone": physics_alone(trainer, kept)}
    for call in calls.values():
        seconds(call)
    whole, taken = [], []
    for _ in range(rounds):
        began = time.perf_counter()
        state, _ = jax.block_until_ready(chunk(state))
        whole.append((time.perf_counter() - began) / settings.chunk)
        taken.append([seconds(call) for call in calls.values()])
    *part, floor = np.median(taken, axis=0)
    iteration = float(np.median(whole))
    print(
        f"{settings.preset}: {settings.env.count} environments x {settings.ppo.rollout_steps} steps, "
        f"{trainer.env.physics.name} physics at {1 / settings.physics.timestep:.0f} Hz, "
        f"{settings.prior.updates} reward updates"
    )
    print(f"compiled in {compiled:.1f} s, peak memory {memory:,.0f} MB")
    rows = [(name, 1e3 * t, t / sum(part), size / t) for name, t in zip(calls, part, strict=False)]
    rows.append(("sum of the parts", 1e3 * sum(part), 1.0, size / sum(part)))
    rows.append(("iteration, in the scan", 1e3 * iteration, iteration / sum(part), size / iteration))
    rows.append(("floor: physics alone", 1e3 * floor, floor / sum(part), size / floor))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("preset", nargs="?", default="laptop", help="smoke, laptop (default) or paper")
    parser.add_argument("--rounds", type=int, default=0, help="measurements of each part; 5, or 2 for the paper's size")
    parser.add_argument("--csv", help="file for the table")
    arguments = parser.parse_args()
    settings = config.preset(arguments.preset)
    rounds = arguments.rounds or (5 if settings.transitions_per_iteration < CALL / 2 else 2)
    rows = measure(settings, rounds)
    print(f"{'part':<24}{'ms':>10}{'share':>8}{'transitions/s':>16}")
    for name, ms, share, rate in rows:
        print(f"{name:<24}{ms:>10.1f}{100 * share:>7.0f}%{rate:>16,.0f}")
    if arguments.csv:
        with open(arguments.csv, "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("part", "milliseconds", "share", "transitions_per_second"))
            writer.writerows((name, f"{ms:.3f}", f"{share:.4f}", f"{rate:.1f}") for name, ms, share, rate in rows)


if __name__ == "__main__":
    main()
