"""What averaging matched successors does to the motion in them (section V-D of the paper).

The barycentric baseline's targets in the first rollout of an untrained policy, under either reset: how much of the
legs' velocity the average keeps, how many expert windows it is over, how fast it goes. Run as
``python -m fmpjax.experiments.barycenter --out FOLDER``.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np

from fmpjax import config as configuration
from fmpjax import features, priors
from fmpjax.errors import UserError
from fmpjax.experiments import results
from fmpjax.experiments.results import Table, Verdict, number
from fmpjax.features import FeatureMap
from fmpjax.shell import default
from fmpjax.train import Trainer
from fmpjax.viz import panels
from fmpjax.viz.panels import Line, Panel

NAME = "barycenter"
RESETS = ("dataset", "fixed")
TARGETS = 2048  # of the first rollout [P]
REWARD_TOLERANCE = 1e-6  # within which rewards made anew must be the method's own
QUANTILES = np.linspace(0.0, 1.0, 41)
COLOURS = {"dataset": "#2a6fb0", "fixed": "#c8553d"}
PAPER = {
    "dataset": {"retention": 0.130, "effective_atoms": 218.4, "target_speed": 0.851, "reward_difference": 2.1e-7},
    "fixed": {"retention": 0.103, "effective_atoms": 239.7, "target_speed": 0.834, "reward_difference": 2.1e-7},
}


def in_units(feature_map: FeatureMap, newest: np.ndarray) -> np.ndarray:
    """Compact frames ``[n, F]`` in m, rad/s and so on, of features ``[n, F]`` of the newest frame of windows."""
    mean, deviation, weight = (np.asarray(a, np.float64) for a in feature_map[:3])
    return newest / weight * deviation[-1] + mean[-1]


def retention(probability: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator of the norm retention (eq. retention) for each query, ``[n]``.

    Args:
      probability: ``[n, m]`` of matching each expert atom.
      velocity: ``[m, 6]`` rad/s of the atoms' sagittal leg joints.
    """
    return np.linalg.norm(probability @ velocity, axis=-1), probability @ np.linalg.norm(velocity, axis=-1)


def measure(trainer: Trainer, targets: int, seed: int) -> dict[str, Any]:
    """Targets and rewards of the barycentric prior in the first rollout of an untrained policy.

    All is made anew in float64 from the windows and the prior's dual: matching, targets and rewards.

    Raises:
      UserError: fewer windows than targets.
    """
    count = trainer.config.transitions_per_iteration
    if count < targets:
        raise UserError(f"the first rollout has {count} windows: expected at least {targets}, one a target")
    state = trainer.init(seed)
    _, rollout_key, prior_key, _ = jax.random.split(state.key, 4)
    env, steps = trainer.env, trainer.config.ppo.rollout_steps
    _, record = jax.jit(lambda s, k: env.rollout(s.env, trainer.ppo.act(s.ppo), k, steps))(state, rollout_key)
    windows = trainer.feature_map(env.frame_table(state.env, record)[record.window])
    valid = np.flatnonzero(~np.asarray(record.nonfinite))
    prior, reward, _ = jax.jit(trainer.prior.update)(state.prior, priors.Rollout(windows, ~record.nonfinite), prior_key)
    chosen = np.random.default_rng(seed).choice(valid, targets, replace=False)
    x = np.asarray(windows, np.float64).reshape(-1, windows.shape[-1])[chosen]
    frames = x.reshape(targets, env.horizon, -1)
    # Matched on all frames but the newest, less their planar positions: `barycentric.split`.
    condition, successor = frames[:, :-1, 2:].reshape(targets, -1), frames[:, -1]
    atoms, after, dual = (np.asarray(a, np.float64) for a in (prior.condition, prior.successor, prior.dual))
    cost = 0.5 * ((condition**2).sum(-1)[:, None] + (atoms**2).sum(-1)) - condition @ atoms.T
    logits = (dual - cost) / float(prior.epsilon)
    probability = np.exp(logits - logits.max(-1, keepdims=True))
    probability /= probability.sum(-1, keepdims=True)
    target = probability @ after
    # Features are standardised coordinates over sqrt(d), of which d / H are the newest frame's: d_g.
    temperature = trainer.config.prior.temperature
    rewards = 2.0 * np.exp(-env.horizon / temperature * ((successor - target) ** 2).sum(-1))

    native = np.asarray(reward, np.float64).ravel()[chosen]
    seen = native > np.finfo(np.float32).tiny

    legs = -trainer.robot.joint_count + trainer.robot.sagittal_joints
    bank, goal = in_units(trainer.feature_map, after), in_units(trainer.feature_map, target)
    forward = features.velocity_index(trainer.robot)
    kept, matched = retention(probability, bank[:, legs])
    effective = 1.0 / (probability**2).sum(-1)
    return {
        "windows": len(valid),
        "retention": float(kept.mean() / matched.mean()),
        "target_leg_velocity": float(kept.mean()),
        "matched_leg_velocity": float(matched.mean()),
        "effective_atoms": float(effective.mean()),
        "bank": len(after),
        "target_speed": float(goal[:, forward].mean()),
        "bank_speed": float(bank[:, forward].mean()),
        "reward": float(rewards.mean()),
        "reward_difference": float(np.abs(rewards - native).max()),
        # Far from the demonstration rewards are next to nothing, and agree whatever the targets: their exponents tell.
        "exponent_difference": float(np.abs(np.log(rewards[seen]) - np.log(native[seen])).max(initial=0.0)),
        "target_leg_velocity_quantiles": np.quantile(kept, QUANTILES).tolist(),
        "matched_leg_velocity_quantiles": np.quantile(matched, QUANTILES).tolist(),
        "effective_atoms_quantiles": np.quantile(effective, QUANTILES).tolist(),
    }


def table(record: Mapping[str, Any]) -> Table:
    """The attenuation's figures, the paper's beside ours."""

    def line(name: str, f: Mapping[str, float]) -> list[str]:
        return [
            name, number(f["retention"]), number(f.get("target_leg_velocity")), number(f["effective_atoms"], 1),
            number(f["target_speed"]), f"{f['reward_difference']:.1e}",
        ]  # fmt: skip

    lines = []
    for reset, figures in record["resets"].items():
        lines += [line(f"{reset} reset", figures), line(f"{reset} reset, the paper's", PAPER[reset])]
    headings = [
        "targets", "norm retention", "legs, rad/s", "effective atoms", "forward speed, m/s", "rewards differ by"
    ]  # fmt: skip
    return Table(f"{record['settings']['targets']:,} barycentric targets of the first rollout", headings, lines)


def verdicts(record: Mapping[str, Any]) -> list[Verdict]:
    """The paper's claims on the barycentre, by our figures."""
    resets = record["resets"]

    def each(key: str, digits: int = 3) -> str:
        return " and ".join(f"{number(f[key], digits)} ({reset})" for reset, f in resets.items())

    largest = max(f["reward_difference"] for f in resets.values())
    exponent = max(f["exponent_difference"] for f in resets.values())
    return [
        Verdict(
            "Averaging removes most of the legs' velocity", f"it keeps {each('retention')}",
            all(f["retention"] < 0.5 for f in resets.values()),
        ),
        Verdict(
            "The matching is diffuse",
            f"{each('effective_atoms', 1)} effective atoms",
            all(f["effective_atoms"] > f["bank"] / 2 for f in resets.values()),
        ),
        Verdict(
            "The target keeps its forward speed",
            f"{each('target_speed')} m/s, the bank's own mean being {each('bank_speed')}",
            all(f["target_speed"] > 0.8 * f["bank_speed"] for f in resets.values()),
        ),
        Verdict(
            "Rewards made anew are the method's own",
            f"they differ by {largest:.1e} at most, their logarithms by {exponent:.1e}",
            largest <= REWARD_TOLERANCE,
        ),
    ]  # fmt: skip


def figure(record: Mapping[str, Any], path: Path) -> Path:
    """Distributions of the legs' velocity in targets and in what they average, and of the effective atoms."""
    velocity, atoms = {}, {}
    for reset, figures in record["resets"].items():
        colour, share = COLOURS[reset], QUANTILES.tolist()
        velocity[f"{reset}: target"] = Line(figures["target_leg_velocity_quantiles"], share, colour)
        velocity[f"{reset}: matched windows"] = Line(figures["matched_leg_velocity_quantiles"], share, colour, "--")
        atoms[f"{reset}: target"] = Line(figures["effective_atoms_quantiles"], share, colour)
    return panels.draw(
        path,
        [
            Panel("share of targets with less leg velocity", "norm over six sagittal joints, rad/s", velocity),
            Panel("share of targets over fewer windows", "effective atoms of the bank", atoms),
        ],
        width=4.4,
    )


def main(
    out: Path,
    preset: str = "paper",
    motion: str = "walk",
    frames: Annotated[str, default("all")] = "",
    seed: int = 0,
    smoke: bool = False,
) -> None:
    """Reconstruct the barycentric baseline's first targets under either reset.

    Args:
      out: folder for barycenter.json, .csv and .png.
      preset: of features, robot and untrained policy; with 1,024 environments whatever it says.
      motion: a bundled motion's name or a file.
      frames: source rows "first:last" of the motion.
      seed: of everything random.
      smoke: the whole path, small.
    """
    from fmpjax import runs

    count, targets = (16, 64) if smoke else (1024, TARGETS)
    results.check_folder(out)
    base = configuration.preset(
        preset, motion=motion, frames=frames, method="barycentric", seed=seed, **{"env.count": count}
    )
    clip = runs.load_motion(base)
    resets = {}
    for reset in RESETS:
        print(f"first rollout, {reset} reset ...", flush=True)
        config = dataclasses.replace(base, env=dataclasses.replace(base.env, reset=reset))
        resets[reset] = measure(Trainer(config, clip), targets, seed)
    settings = {"preset": preset, "motion": Path(motion).name, "frames": frames, "seed": seed, "targets": targets}
    record = {"settings": settings, "resets": resets}
    scalars = [
        {"reset": reset} | {k: v for k, v in figures.items() if not isinstance(v, list)}
        for reset, figures in resets.items()
    ]
    paths = results.save(out, NAME, record, scalars, (motion, out))
    paths.append(figure(record, out / f"{NAME}.png"))
    print(results.text(table(record)), end="\n\n")
    print(*verdicts(record), sep="\n")
    print(*(f"wrote {path}" for path in paths), sep="\n")


if __name__ == "__main__":
    results.entry(main)
