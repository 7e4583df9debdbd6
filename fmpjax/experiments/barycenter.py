"""What averaging matched successors does to the motion in them (section V-D of the paper).

The barycentric baseline's targets in the first rollout of an untrained policy, under either reset: how much of the
legs' velocity the average keeps, how many expert windows it is over, how fast it goes. A draw is one seed's policy,
starts and banks; figures are means over draws. Run as ``fmpjax experiment barycenter --out FOLDER``.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np

from fmpjax import config as configuration
from fmpjax import priors
from fmpjax.config import Config
from fmpjax.errors import UserError
from fmpjax.experiments.common import results
from fmpjax.experiments.common.results import Table, Verdict, number
from fmpjax.features import FeatureMap
from fmpjax.frames import PLANAR, FrameLayout
from fmpjax.motion import MotionLibrary
from fmpjax.priors.barycentric import BarycentricState
from fmpjax.shell import default
from fmpjax.trainer import Trainer
from fmpjax.viz import panels
from fmpjax.viz.panels import Line, Panel

NAME = "barycenter"
RESETS = ("dataset", "fixed")
TARGETS = 2048  # of the first rollout [P]
REWARD_TOLERANCE = 1e-6  # to which recomputed rewards must equal the method's own
_SPREAD = ("retention", "target_leg_velocity", "effective_atoms", "target_speed")  # figures with a deviation
QUANTILES = np.linspace(0.0, 1.0, 41)
COLORS = {"dataset": "#2a6fb0", "fixed": "#c8553d"}
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


def measure(
    trainer: Trainer, targets: int, seeds: Sequence[int], fractions: Sequence[float] = ()
) -> dict[float, list[dict[str, Any]]]:
    """Targets and rewards of the barycentric prior in the first rollout of an untrained policy, one of each seed.

    Args:
      trainer: with a barycentric prior.
      targets: of each rollout.
      seeds: of the draws.
      fractions: entropies over the median cost to match at, the configuration's alone by default.

    Returns:
      The figures of each draw, by fraction.

    Raises:
      UserError: fewer windows than targets.
    """
    config = trainer.config
    if config.transitions_per_iteration < targets:
        raise UserError(
            f"the first rollout has {config.transitions_per_iteration} windows: expected at least {targets}, "
            "one per target"
        )
    updates = {
        fraction: jax.jit(_prior_at(trainer, fraction).update)
        for fraction in fractions or [config.prior.epsilon_fraction]
    }

    @jax.jit
    def roll(state, key):
        _, record = trainer.env.rollout(state.env, trainer.ppo.act(state.ppo), key, config.ppo.rollout_steps)
        windows = trainer.feature_map(trainer.env.frame_table(state.env, record)[record.window])
        return priors.Rollout(windows, ~record.nonfinite)

    draws: dict[float, list[dict[str, Any]]] = {fraction: [] for fraction in updates}
    for seed in seeds:
        state = trainer.init(seed)
        _, rollout_key, prior_key, _ = jax.random.split(state.key, 4)
        rollout = roll(state, rollout_key)
        for fraction, update in updates.items():
            prior, reward, _ = update(state.prior, rollout, prior_key)
            draws[fraction].append(_figures(trainer, prior, rollout, reward, targets, seed))
    return draws


def _prior_at(trainer: Trainer, fraction: float) -> priors.MotionPrior:
    """The trainer's prior with another entropy."""
    config = trainer.config
    changed = dataclasses.replace(config, prior=dataclasses.replace(config.prior, epsilon_fraction=fraction))
    return priors.make(config.method, trainer.prior_expert, changed)


def _figures(
    trainer: Trainer, prior: BarycentricState, rollout: priors.Rollout, reward: jax.Array, targets: int, seed: int
) -> dict[str, Any]:
    """Figures of one draw, all recomputed in float64 from the windows and the prior's dual."""
    env, windows = trainer.env, rollout.features
    valid = np.flatnonzero(np.asarray(rollout.valid))
    chosen = np.random.default_rng(seed).choice(valid, targets, replace=False)
    x = np.asarray(windows, np.float64).reshape(-1, windows.shape[-1])[chosen]
    frames = x.reshape(targets, env.horizon, -1)
    # Matched on all frames but the newest, less their planar positions: `barycentric.split`.
    condition, successor = frames[:, :-1, PLANAR.stop :].reshape(targets, -1), frames[:, -1]
    atoms, after, dual = (np.asarray(a, np.float64) for a in (prior.condition, prior.successor, prior.dual))
    cost = 0.5 * ((condition**2).sum(-1)[:, None] + (atoms**2).sum(-1)) - condition @ atoms.T
    logits = (dual - cost) / float(prior.epsilon)
    probability = np.exp(logits - logits.max(-1, keepdims=True))
    probability /= probability.sum(-1, keepdims=True)
    target = probability @ after
    # Features are standardized coordinates over sqrt(d), of which d / H are the newest frame's: d_g.
    temperature = trainer.config.prior.temperature
    rewards = 2.0 * np.exp(-env.horizon / temperature * ((successor - target) ** 2).sum(-1))

    native = np.asarray(reward, np.float64).ravel()[chosen]
    seen = native > np.finfo(np.float32).tiny

    layout = FrameLayout.of(trainer.robot)
    legs, forward = layout.joint_velocity.start + trainer.robot.sagittal_joints, layout.velocity.start
    bank, goal = in_units(trainer.feature_map, after), in_units(trainer.feature_map, target)
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


def over_draws(draws: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over draws, quantiles included; of what must agree the largest difference; and standard deviations."""
    figures = {}
    for name in draws[0]:
        values = np.array([draw[name] for draw in draws])
        figures[name] = (values.max(0) if name.endswith("_difference") else values.mean(0)).tolist()
    spread = {name: float(np.std([draw[name] for draw in draws], ddof=1)) for name in _SPREAD if len(draws) > 1}
    return figures | {"deviation": spread}


def table(record: Mapping[str, Any]) -> Table:
    """The attenuation's figures, the paper's beside ours."""

    def figure(f: Mapping[str, Any], name: str, digits: int = 3) -> str:
        deviation = f.get("deviation", {}).get(name)
        return number(f.get(name), digits) + ("" if deviation is None else f" ± {number(deviation, digits)}")

    def line(name: str, f: Mapping[str, Any]) -> list[str]:
        return [
            name, figure(f, "retention"), figure(f, "target_leg_velocity"), figure(f, "effective_atoms", 1),
            figure(f, "target_speed"), f"{f['reward_difference']:.1e}",
        ]  # fmt: skip

    lines = []
    for reset, figures in record["resets"].items():
        lines.append(line(f"{reset} reset", figures))
        for fraction, others in record.get("entropies", {}).items():
            lines.append(line(f"{reset} reset, entropy {fraction}", others[reset]))
        lines.append(line(f"{reset} reset, the paper's", PAPER[reset]))
    headings = [
        "targets", "norm retention", "legs, rad/s", "effective atoms", "forward speed, m/s", "rewards differ by"
    ]  # fmt: skip
    settings = record["settings"]
    draws = settings.get("draws", 1)
    caption = f"{settings['targets']:,} barycentric targets of the first rollout"
    if draws > 1:
        caption += f"; means over {draws} draws, with the standard deviation between them"
    if record.get("entropies"):
        caption += f"; entropies over the median cost, {settings['entropy']:g} where none is named"
    return Table(caption, headings, lines)


def verdicts(record: Mapping[str, Any]) -> list[Verdict]:
    """The paper's claims on the barycenter, by our figures."""
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
            "Recomputed rewards are the method's own",
            f"they differ by {largest:.1e} at most, their logarithms by {exponent:.1e}",
            largest <= REWARD_TOLERANCE,
        ),
    ]  # fmt: skip


def figure(record: Mapping[str, Any], path: Path) -> Path:
    """Distributions of the legs' velocity in targets and in what they average, and of the effective atoms."""
    velocity, atoms = {}, {}
    for reset, figures in record["resets"].items():
        color, share = COLORS[reset], QUANTILES.tolist()
        velocity[f"{reset}: target"] = Line(figures["target_leg_velocity_quantiles"], share, color)
        velocity[f"{reset}: matched windows"] = Line(figures["matched_leg_velocity_quantiles"], share, color, "--")
        atoms[f"{reset}: target"] = Line(figures["effective_atoms_quantiles"], share, color)
    return panels.draw(
        path,
        [
            Panel("share of targets with less leg velocity", "norm over six sagittal joints, rad/s", velocity),
            Panel("share of targets over fewer windows", "effective atoms of the bank", atoms),
        ],
        width=4.4,
    )


def _under_resets(
    base: Config, clip: MotionLibrary, targets: int, seeds: Sequence[int], fractions: Sequence[float]
) -> tuple[dict[float, dict[str, Any]], list[dict[str, Any]]]:
    """Figures over the draws, by entropy and reset; and those of each draw, lines of the CSV file."""
    found: dict[float, dict[str, Any]] = {fraction: {} for fraction in fractions}
    scalars = []
    for reset in RESETS:
        print(f"first rollouts, {reset} reset ...", flush=True)
        config = dataclasses.replace(base, env=dataclasses.replace(base.env, reset=reset))
        for fraction, each in measure(Trainer(config, clip), targets, seeds, fractions).items():
            found[fraction][reset] = over_draws(each)
            scalars += [
                {"reset": reset, "entropy": fraction, "seed": seed}
                | {k: v for k, v in figures.items() if not isinstance(v, list)}
                for seed, figures in zip(seeds, each, strict=True)
            ]
    return found, scalars


def main(
    out: Path,
    preset: str = "paper",
    motion: str = "walk",
    frames: Annotated[str, default("all")] = "",
    seed: int = 0,
    draws: int = 8,
    entropies: tuple[float, ...] = (0.12, 0.15),
    smoke: bool = False,
) -> None:
    """Measure what the barycentric baseline's first targets keep of the motion.

    Args:
      out: folder for barycenter.json, .csv and .png.
      preset: of features, robot and untrained policy; with 1,024 environments whatever it says.
      motion: a bundled motion's name or a file.
      frames: source rows "first:last" of the motion.
      seed: of everything random in the first draw; the next has the next seed.
      draws: first rollouts, each with a policy, starts and banks of its own.
      entropies: further entropies over the median cost to match at, beside the preset's.
      smoke: a small test run.
    """
    from fmpjax import runs

    if draws < 1:
        raise UserError(f"--draws is {draws}: expected at least 1")
    for entropy in entropies:
        if not 0 < entropy < np.inf:
            raise UserError(f"--entropies has {entropy:g}: expected numbers above 0")
    count, targets, draws = (16, 64, 2) if smoke else (1024, TARGETS, draws)
    results.check_folder(out)
    base = configuration.preset(
        preset, motion=motion, frames=frames, method="barycentric", seed=seed, **{"env.count": count}
    )
    clip = runs.load_motion(base)
    own = base.prior.epsilon_fraction
    fractions = list(dict.fromkeys([own, *entropies]))
    found, scalars = _under_resets(base, clip, targets, range(seed, seed + draws), fractions)
    settings = {
        "preset": preset, "motion": Path(motion).name, "frames": frames, "seed": seed, "draws": draws,
        "targets": targets, "entropy": own,
    }  # fmt: skip
    others = {f"{fraction:g}": found[fraction] for fraction in fractions if fraction != own}
    record = {"settings": settings, "resets": found[own], "entropies": others}
    paths = results.save(out, NAME, record, scalars, (motion, out))
    paths.append(figure(record, out / f"{NAME}.png"))
    print(results.text(table(record)), end="\n\n")
    print(*verdicts(record), sep="\n")
    print(*(f"wrote {path}" for path in paths), sep="\n")


if __name__ == "__main__":
    results.entry(main)
