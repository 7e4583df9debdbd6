"""What does each learned reward cost beside the rollout and PPO?

Rollout, windows and PPO are the same for every method and timed once per round. Fitting and scoring are timed for each
method in turn, on the same rollout. Overhead is the reward's time over everything else's.
"""

import argparse
import csv
import time
from collections.abc import Callable

import jax
import numpy as np

from fmpjax import config, motion, priors
from fmpjax.trainer import Trainer, policy_batch


def seconds(call: Callable[[], object]) -> float:
    """Time of a call, until its arrays are there."""
    began = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("preset", nargs="?", default="laptop", help="smoke, laptop (default) or paper")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--csv", help="file for the table")
    arguments = parser.parse_args()
    settings = config.preset(arguments.preset)
    trainer = Trainer(settings, motion.load(settings.motion, rate=settings.control_rate, robot=settings.robot))
    env, ppo, steps = trainer.env, trainer.ppo, settings.ppo.rollout_steps
    key, state = jax.random.PRNGKey(0), trainer.init()

    rollout = jax.jit(lambda s, k: env.rollout(s.env, ppo.act(s.ppo), k, steps))
    windows = jax.jit(lambda s, r: trainer.feature_map(env.frame_table(s.env, r)[r.window]))
    improve = jax.jit(lambda s, r, reward, k: ppo.update(s.ppo, policy_batch(r, reward), k))
    _, record = rollout(state, key)
    seen = priors.Rollout(windows(state, record), ~record.nonfinite, record.length == 1)
    pool = seen.features.reshape(-1, seen.features.shape[-1])
    methods = [method for method in priors.METHODS if not priors.follows(method)]  # without a command
    calls = {
        "rollout": lambda: rollout(state, key),
        "features": lambda: windows(state, record),
        "PPO": lambda: improve(state, record, seen.valid.astype(np.float32), key),
    }
    for method in methods:
        prior = priors.make(method, trainer.expert, settings)
        update, score = jax.jit(prior.update), jax.jit(prior.score)
        fitted = update(prior.init(key), seen, key)[0]
        calls[f"{method} update"] = lambda update=update, fitted=fitted: update(fitted, seen, key)
        calls[f"{method} score"] = lambda score=score, fitted=fitted: score(fitted, pool)
    for call in calls.values():
        seconds(call)
    taken = [[seconds(call) for call in calls.values()] for _ in range(arguments.rounds)]
    ms = dict(zip(calls, 1e3 * np.median(taken, axis=0), strict=True))
    rest = ms["rollout"] + ms["features"] + ms["PPO"]
    print(f"{settings.preset}: {len(pool):,} windows an iteration; rollout {ms['rollout']:.0f} ms, ", end="")
    print(f"features {ms['features']:.0f} ms, PPO {ms['PPO']:.0f} ms")
    print(f"{'method':<14}{'fit, ms':>10}{'score, ms':>11}{'of the iteration':>18}{'overhead':>10}")
    rows = []
    for method in methods:
        update, score = ms[f"{method} update"], ms[f"{method} score"]
        row = (method, max(0.0, update - score), score, update / (rest + update), update / rest)
        rows.append(row)
        print(f"{row[0]:<14}{row[1]:>10.1f}{row[2]:>11.1f}{100 * row[3]:>17.0f}%{100 * row[4]:>9.0f}%")
    if arguments.csv:
        with open(arguments.csv, "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("method", "fit_ms", "score_ms", "share_of_iteration", "overhead"))
            writer.writerows((m, *(f"{v:.4g}" for v in values)) for m, *values in rows)


if __name__ == "__main__":
    main()
