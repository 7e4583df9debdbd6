"""How the fitted reward ranks the demonstration against spoiled copies of itself.

The prior is fitted to the windows of a fixed policy (an untrained one, or a run's) and then scores the demonstration
and copies that are frozen, slowed, reversed, shuffled in time, and noisy. A reward is of use where the copies lose. Run
as ``fmpjax experiment ranking --run RUN`` or, for the start of training, with ``--start``.
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import features, jsons, priors, tables
from fmpjax.experiments.common import histories, results
from fmpjax.motion import MotionClip, resample
from fmpjax.shell import default
from fmpjax.trainer import Trainer


def copies(trainer: Trainer, seed: int = 0) -> dict[str, np.ndarray]:
    """Features ``[W, D]`` of the demonstration's windows and of its spoiled copies."""
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
    return {name: np.asarray(trainer.feature_map(jnp.asarray(value))) for name, value in rows.items()}


def _frames(trainer: Trainer, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    observed = features.observe(
        trainer.robot, jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32), "compact"
    )
    return np.asarray(observed.frame)


def rank(trainer: Trainer, windows: jax.Array, key: jax.Array, updates: int = 512) -> dict[str, dict[str, float]]:
    """Fit the prior to ``windows [T, N, D]`` and score the copies.

    Returns:
      By copy: mean reward, mean score above the pool's median in spreads of the pool (``margin``), and how often a
      random window of the demonstration scores above one of the copy's (``beaten``).
    """
    config = trainer.config.prior
    changed = dataclasses.replace(trainer.config, prior=dataclasses.replace(config, updates=updates))
    prior = priors.make(trainer.config.method, trainer.expert, changed)
    init_key, fit_key = jax.random.split(key)
    valid = jnp.ones(windows.shape[:2], bool)
    fit = jax.jit(prior.update)
    state, _, metrics = fit(prior.init(init_key), priors.Rollout(windows, valid), fit_key)
    score = jax.jit(lambda x: prior.score(state, x))
    median, spread = float(metrics["score_median"]), max(float(metrics["score_spread"]), config.spread_floor)
    scores = {name: np.asarray(score(jnp.asarray(x))) for name, x in copies(trainer).items()}
    rng = np.random.default_rng(0)
    good = rng.choice(scores["demonstration"], 4096)
    return {
        name: {
            # The logistic saturates far from the pool; the margin, in spreads of the pool, does not.
            "reward": float(np.mean(2 / (1 + np.exp(-(s - median) / spread)))),
            "margin": float((s.mean() - median) / spread),
            "beaten": float(np.mean(good > rng.choice(s, 4096))),
        }
        for name, s in scores.items()
    } | {"pool": {"reward": 1.0, "margin": 0.0, "beaten": float(np.mean(good > median))}}


def table(ranking: dict[str, dict[str, float]]) -> str:
    """The ranking for people."""
    rows = [
        (name, f"{row['reward']:.3f}", f"{row['margin']:.2f}", f"{100 * row['beaten']:5.1f} %")
        for name, row in ranking.items()
    ]
    headings = ("windows", "reward", "margin", "loses to the demonstration")
    return tables.lines("  {:<26} {:>7} {:>8}  {}", [headings, *rows])


def main(
    run: Path,
    start: bool = False,
    last: bool = False,
    updates: int = 512,
    out: Annotated[Path | None, default("RUN/ranking.json, or RUN/ranking-start.json with --start")] = None,
) -> None:
    """Rank the demonstration and spoiled copies of it under a reward fitted to a policy's windows.

    Args:
      run: folder of the run.
      start: take the untrained policy.
      last: take the newest checkpoint in place of the best.
      updates: reward-model updates of the fit.
      out: JSON file to write.
    """
    from fmpjax import runs

    opened = runs.Run.open(run)
    priors.check_potential(opened.config.method)
    path = out or opened.folder / ("ranking-start.json" if start else "ranking.json")
    results.check_file(path)
    if start:
        trainer = opened.trainer()
        policy = trainer.init().ppo
    else:
        trainer, state = opened.policy(best=not last)
        policy = state.ppo
    played = histories.pool(trainer, policy, trainer.feature_map, jax.random.PRNGKey(0), steps=32 if start else 256)
    ranking = rank(trainer, played.features, jax.random.PRNGKey(1), updates)
    print(f"pool: {played.valid.size} windows, mean forward speed {played.speed:.3f} m/s")
    print(table(ranking))
    path.parent.mkdir(parents=True, exist_ok=True)
    runs.write(path, jsons.dumps({"pool_speed": played.speed, "updates": updates, "windows": ranking}))
    print(f"wrote {path}")


if __name__ == "__main__":
    results.entry(main)
