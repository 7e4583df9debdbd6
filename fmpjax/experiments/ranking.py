"""How a reward ranks the demonstration against spoiled copies of itself.

A potential is fitted to the windows of a fixed policy (an untrained one, or a run's) and then scores the demonstration
and copies that are frozen, slowed, reversed, shuffled in time, and noisy. A reward is of use where the copies lose. Run
as ``fmpjax experiment ranking --run RUN`` or, for the start of training, with ``--start``. With ``--learned`` the
reward is the one that the run's training left, of any method that scores windows.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import features, jsons, priors, tables
from fmpjax.errors import UserError
from fmpjax.experiments.common import histories, results
from fmpjax.motion import MotionClip, resample
from fmpjax.shell import default
from fmpjax.trainer import Trainer

DRAWS = 4096  # pairs of windows that are compared
BLOCK = 8192  # windows that are scored at once
FLOOR = 1e-6  # least spread of the pool's scores, of a learned reward


def copies(trainer: Trainer, seed: int = 0) -> dict[str, np.ndarray]:
    """Features ``[W, D]``, as the prior takes them, of the demonstration's windows and of its spoiled copies."""
    clip, horizon = trainer.clip, trainer.env.horizon
    rng = np.random.default_rng(seed)

    def windows(qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
        frames = _frames(trainer, qpos, qvel)
        starts = np.arange(len(frames) - horizon + 1)[:, None]
        return frames[starts + np.arange(horizon)]

    def of(motion: MotionClip) -> np.ndarray:
        return windows(motion.qpos, motion.qvel)

    slow = MotionClip.from_qpos("slow", clip.robot, clip.rate, resample(clip.qpos, clip.rate, 2 * clip.rate))
    reverse = MotionClip.from_qpos("reverse", clip.robot, clip.rate, clip.qpos[::-1])
    noisy_qpos, noisy_qvel = clip.qpos.copy(), clip.qvel.copy()
    noisy_qpos[:, 7:] += rng.normal(0.0, 0.1, clip.qpos[:, 7:].shape)
    noisy_qvel[:, 6:] += rng.normal(0.0, 1.0, clip.qvel[:, 6:].shape)
    demonstration = windows(clip.qpos, clip.qvel)
    still = _frames(trainer, clip.qpos, np.zeros_like(clip.qvel))
    order = np.stack([rng.permutation(horizon) for _ in demonstration])
    rows = {
        "demonstration": demonstration,
        "frozen": np.repeat(still[horizon - 1 :, None], horizon, axis=1),
        "slowed to half": of(slow),
        "reversed": of(reverse),
        "shuffled in time": np.take_along_axis(demonstration, order[..., None], axis=1),
        "noisy (0.1 rad, 1 rad/s)": windows(noisy_qpos, noisy_qvel),
    }
    return {name: np.asarray(trainer.prior_map(jnp.asarray(value))) for name, value in rows.items()}


def _frames(trainer: Trainer, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    observed = features.observe(
        trainer.robot, jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32), "compact"
    )
    return np.asarray(observed.frame)


def rank(trainer: Trainer, windows: jax.Array, key: jax.Array, updates: int = 512) -> dict[str, dict[str, float]]:
    """Fit the prior to ``windows [T, N, D]`` and score the copies.

    Returns:
      As `compare`, and the mean reward of each copy, which is FMP's of its score.
    """
    config = trainer.config.prior
    changed = dataclasses.replace(trainer.config, prior=dataclasses.replace(config, updates=updates))
    prior = priors.make(trainer.config.method, trainer.expert, changed)
    init_key, fit_key = jax.random.split(key)
    valid = jnp.ones(windows.shape[:2], bool)
    fit = jax.jit(prior.update)
    state, _, metrics = fit(prior.init(init_key), priors.Rollout(windows, valid), fit_key)
    median, spread = float(metrics["score_median"]), max(float(metrics["score_spread"]), config.spread_floor)
    found = scored(trainer, prior, state)
    ranking = compare(found, median, spread)
    for name, s in found.items():
        # The logistic saturates far from the pool; the margin, in spreads of the pool, does not.
        ranking[name]["reward"] = float(np.mean(2 / (1 + np.exp(-(s - median) / spread))))
    ranking["pool"]["reward"] = 1.0
    return ranking


def rank_learned(trainer: Trainer, state: Any, windows: jax.Array, valid: jax.Array) -> dict[str, dict[str, float]]:
    """Score the copies by the prior that training left in ``state``; as `compare`.

    Args:
      windows: ``[T, N, D]`` of the run's policy.
      valid: ``[T, N]`` bool.

    Raises:
      UserError: the method scores no window by itself.
    """
    found = scored(trainer, trainer.prior, state)
    pool = _score(trainer.prior, state, windows[valid])
    low, median, high = np.quantile(pool, (0.25, 0.5, 0.75))
    return compare(found, float(median), max(float(high - low), FLOOR))


def scored(trainer: Trainer, prior: priors.MotionPrior, state: Any) -> dict[str, np.ndarray]:
    """Scores ``[W]`` of the windows of the demonstration and of each of its copies."""
    return {name: _score(prior, state, jnp.asarray(x)) for name, x in copies(trainer).items()}


def _score(prior: priors.MotionPrior, state: Any, x: jax.Array) -> np.ndarray:
    score = jax.jit(lambda state, x: prior.score(state, x))
    return np.concatenate([np.asarray(score(state, x[i : i + BLOCK])) for i in range(0, len(x), BLOCK)])


def compare(found: Mapping[str, np.ndarray], median: float, spread: float) -> dict[str, dict[str, float]]:
    """What the scores of `scored` say, given the median and spread of the pool's.

    Returns:
      By copy: mean score above the pool's median in spreads of the pool (``margin``), and how often a random window of
      the demonstration scores above one of the copy's (``beaten``). A tie counts one half.
    """
    rng = np.random.default_rng(0)
    good = rng.choice(found["demonstration"], DRAWS)

    def beaten(other: np.ndarray) -> float:
        return float(np.mean((good > other) + 0.5 * (good == other)))

    ranking = {
        name: {"margin": float((s.mean() - median) / spread), "beaten": beaten(rng.choice(s, DRAWS))}
        for name, s in found.items()
    }
    return ranking | {"pool": {"margin": 0.0, "beaten": beaten(np.array(median))}}


def table(ranking: dict[str, dict[str, float]]) -> str:
    """The ranking for people."""
    rows = [
        (
            name,
            f"{row['reward']:.3f}" if "reward" in row else "",
            f"{row['margin']:.2f}",
            f"{100 * row['beaten']:5.1f} %",
        )
        for name, row in ranking.items()
    ]
    headings = ("windows", "reward", "margin", "loses to the demonstration")
    return tables.lines("  {:<26} {:>7} {:>8}  {}", [headings, *rows])


def _file(start: bool, last: bool, learned: bool) -> str:
    if learned:
        return f"ranking-learned{'-last' if last else ''}.json"
    return "ranking-start.json" if start else "ranking.json"


def main(
    run: Path,
    start: bool = False,
    last: bool = False,
    learned: bool = False,
    updates: int = 512,
    out: Annotated[Path | None, default("in RUN: ranking.json, -start, -learned, -learned-last")] = None,
) -> None:
    """Rank the demonstration and spoiled copies of it under a fitted or a learned reward.

    Args:
      run: folder of the run.
      start: take the untrained policy.
      last: take the newest checkpoint in place of the best.
      learned: take the reward as training left it, of any method; nothing is fitted.
      updates: reward-model updates of the fit.
      out: JSON file to write.
    """
    from fmpjax import runs

    if start and learned:
        raise UserError("--start and --learned are two rewards: expected one of them")
    opened = runs.Run.open(run)
    if not learned:
        priors.check_potential(opened.config.method)
    path = out or opened.folder / _file(start, last, learned)
    results.check_file(path)
    if start:
        trainer = opened.trainer()
        state = trainer.init()
    else:
        trainer, state = opened.policy(best=not last)
    played = histories.pool(trainer, state.ppo, trainer.prior_map, jax.random.PRNGKey(0), steps=32 if start else 256)
    if learned:
        ranking = rank_learned(trainer, state.prior, played.features, played.valid)
    else:
        ranking = rank(trainer, played.features, jax.random.PRNGKey(1), updates)
    print(f"pool: {played.valid.size} windows, mean forward speed {played.speed:.3f} m/s")
    print(table(ranking))
    path.parent.mkdir(parents=True, exist_ok=True)
    told = {"pool_speed": played.speed} | ({} if learned else {"updates": updates})
    runs.write(path, jsons.dumps(told | {"windows": ranking}))
    print(f"wrote {path}")


if __name__ == "__main__":
    results.entry(main)
