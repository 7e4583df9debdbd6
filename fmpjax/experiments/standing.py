"""Why a policy stands before it walks: what the fitted reward pays for, measured along a training run.

A policy is trained as `fmpjax train` would, and every so often it is halted and looked at: what its standing and its
walking moments earn and how soon they end in a fall, how much of the policy gradient is about survival alone, how well
the few updates of a rollout follow the transport they are fitted to, and which features carry the score. Run as
``fmpjax experiment standing measure --out FOLDER``; ``look --run RUN`` looks at a run's newest state only.
"""

import dataclasses
import time
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.flatten_util import ravel_pytree

from fmpjax import features, jsons, physics, potential, ppo, priors, runs
from fmpjax.config import Config, preset
from fmpjax.evaluate import Evaluator
from fmpjax.experiments.common import reference, results
from fmpjax.frames import FrameLayout
from fmpjax.priors import flow
from fmpjax.priors.base import couple, median_reward
from fmpjax.robots import Robot
from fmpjax.shell import Group, default
from fmpjax.trainer import Trainer, TrainState
from fmpjax.viz import curves

STANDING, WALKING = 0.15, 0.40  # m/s, mean forward speed of a window below or above which it counts as such
HAZARD_STEPS = 50  # control steps in which a fall is looked for
ROLLOUTS = 8  # rollouts of one measurement, one after another
PUSH = 0.1  # m/s
QUERIES, BANKS = 512, 16  # windows and source banks of the transport reference

_PANELS = {
    "share: standing (solid), walking": ("standing_share", "walking_share"),
    "mean reward: standing, walking": ("standing_reward", "walking_reward"),
    "falls within 1 s: standing, walking": ("standing_falls_in_1s", "walking_falls_in_1s"),
    "return at 0.97: standing, walking": ("standing_return_0.97", "walking_return_0.97"),
    "return explained by survival": ("return_survival_share",),
    "agreement of two gradients": ("gradient_agreement", "gradient_survival_cosine"),
    "correlation: 3 updates, 128": ("online_correlation", "128_updates_correlation"),
    "gain of a 0.1 m/s push, spreads: all, standing": ("push_gain", "standing_push_gain"),
}


class Moments(NamedTuple):
    """Consecutive rollouts of one frozen policy, ``[T, N, ...]`` with T = rollouts * steps."""

    windows: jax.Array  # [T, N, D] features
    pushed: jax.Array  # [T, N, D] the same windows, ``PUSH`` faster forward throughout
    speed: jax.Array  # [T, N] m/s, mean forward speed of the window
    reward: jax.Array  # [T, N] under the frozen prior
    survival: jax.Array  # [T, N] the reward of a policy that only survives: its mean
    batch: ppo.Batch


def gather(trainer: Trainer, state: TrainState, key: jax.Array) -> Moments:
    """Play the policy of ``state`` on, and score what it does with the prior of ``state``."""
    env, steps = trainer.env, trainer.config.ppo.rollout_steps
    layout = FrameLayout.of(trainer.robot)
    forward, ahead = layout.velocity.start, layout.root.start
    lag = jnp.arange(1 - env.horizon, 1) / trainer.config.control_rate  # s before the newest frame

    def play(env_state, key):
        after, record = env.rollout(env_state, trainer.ppo.act(state.ppo), key, steps)
        frames = env.frame_table(env_state, record)[record.window]
        # A faster window also comes from further back.
        faster = frames.at[..., forward].add(PUSH).at[..., ahead].add(PUSH * lag)
        windows = trainer.feature_map(frames), trainer.feature_map(faster)
        return after._replace(cap=env_state.cap), (*windows, frames[..., forward].mean(-1), record)

    _, (windows, pushed, speed, record) = jax.lax.scan(play, state.env, jax.random.split(key, ROLLOUTS))
    windows, pushed, speed, record = jax.tree.map(
        lambda x: x.reshape(-1, *x.shape[2:]), (windows, pushed, speed, record)
    )
    score = trainer.prior.score(state.prior, windows.reshape(-1, windows.shape[-1])).reshape(speed.shape)
    reward = median_reward(score, ~record.nonfinite, trainer.config.prior.spread_floor).reward
    batch = ppo.Batch(
        record.observation, record.next_observation, record.action, record.extras["mean"], record.extras["deviation"],
        reward, record.fell, record.timed_out,
    )  # fmt: skip
    return Moments(windows, pushed, speed, reward, jnp.full_like(reward, reward.mean()), batch)


def behaviors(moments: Moments, discounts=(0.97, 0.99)) -> dict[str, float]:
    """Share, mean reward, fall hazard and resulting return of the standing and of the walking moments."""
    speed, reward = np.asarray(moments.speed), np.asarray(moments.reward)
    fell, cut = np.asarray(moments.batch.fell), np.asarray(moments.batch.timed_out)
    total = len(speed) - HAZARD_STEPS
    falls = np.lib.stride_tricks.sliding_window_view(fell, HAZARD_STEPS, 0)[1 : total + 1]
    cuts = np.lib.stride_tricks.sliding_window_view(cut, HAZARD_STEPS, 0)[1 : total + 1]
    first_fall = np.where(falls.any(-1), falls.argmax(-1), HAZARD_STEPS)
    first_cut = np.where(cuts.any(-1), cuts.argmax(-1), HAZARD_STEPS)
    # Moments that a time-out cuts short say nothing of what would have come.
    known = (first_cut >= np.minimum(first_fall, HAZARD_STEPS)) & ~(fell | cut)[:total]
    falling = first_fall < np.minimum(first_cut, HAZARD_STEPS)
    row = {}
    for name, chosen in (("standing", np.abs(speed) < STANDING), ("walking", speed > WALKING)):
        sample = chosen[:total] & known
        within = falling[sample].mean() if sample.sum() >= 100 else np.nan
        hazard = 1.0 - (1.0 - min(within, 1.0 - 1e-6)) ** (1.0 / HAZARD_STEPS)
        row[f"{name}_share"] = chosen.mean()
        row[f"{name}_reward"] = reward[chosen].mean() if chosen.sum() >= 100 else np.nan
        row[f"{name}_falls_in_1s"] = within
        for discount in discounts:
            # Of a robot that continues like this: a reward at each step, until a fall.
            row[f"{name}_return_{discount}"] = row[f"{name}_reward"] / (1.0 - discount * (1.0 - hazard))
    return {name: float(value) for name, value in row.items()}


def _returns(reward, batch: ppo.Batch, discount: float):
    """Discounted returns ``[T, N]``; after a time-out and after the last step the mean reward continues without end."""
    value = jnp.full_like(reward, reward.mean() / (1.0 - discount))
    return ppo.generalized_advantage(reward, value, value, batch.fell, batch.timed_out, discount, 1.0) + value


def gradients(trainer: Trainer, state: TrainState, moments: Moments) -> dict[str, jax.Array]:
    """Signal to noise of the policy gradient, and how much of it mere survival explains."""
    config = trainer.config.ppo
    value = trainer.ppo.value(state.ppo, moments.batch.observation)
    next_value = trainer.ppo.value(state.ppo, moments.batch.next_observation)
    center = moments.survival.mean() / (1.0 - config.discount)

    def gradient(advantage, batch):
        # Where no episode ends by a fall, survival has no advantage anywhere.
        gain = (advantage - advantage.mean()) / jnp.maximum(advantage.std(), 1e-5)

        def surrogate(actor):
            mean, deviation = trainer.ppo.policy(actor, state.ppo.normalizer, batch.observation)
            log_probability = -0.5 * ((batch.action - mean) / deviation) ** 2 - jnp.log(deviation)
            return jnp.mean(jnp.clip(gain, -4, 4) * log_probability.sum(-1))

        return ravel_pytree(jax.grad(surrogate)(state.ppo.actor))[0]

    def per_rollout(reward, value, next_value):
        split = jax.tree.map(
            lambda x: x.reshape(ROLLOUTS, -1, *x.shape[1:]), (moments.batch, reward, value, next_value)
        )

        def one(item):
            batch, reward, value, next_value = item
            advantage = ppo.generalized_advantage(
                reward, value, next_value, batch.fell, batch.timed_out, config.discount, config.gae_lambda
            )
            return gradient(advantage, batch)

        return jax.lax.map(one, split)

    learned = per_rollout(moments.reward, value, next_value)
    flat = jnp.full_like(value, center)
    survival = per_rollout(moments.survival, flat, flat)

    def agreement(a):
        unit = a / jnp.maximum(jnp.linalg.norm(a, axis=-1, keepdims=True), 1e-12)
        pairs = unit @ unit.T
        return (pairs.sum() - len(a)) / (len(a) * (len(a) - 1))

    a, b = learned.mean(0), survival.mean(0)
    G, L = (_returns(reward, moments.batch, config.discount).ravel() for reward in (moments.reward, moments.survival))
    return {
        "gradient_agreement": agreement(learned),  # cosine of the gradients of two independent rollouts
        "gradient_survival_cosine": a @ b / jnp.maximum(jnp.linalg.norm(a) * jnp.linalg.norm(b), 1e-12),
        "return_survival_share": reference.correlation(G, L) ** 2,  # none without a fall
        "critic_explained_variance": 1.0 - jnp.var(G - value.ravel()) / jnp.var(G),
    }


def _groups(robot: Robot) -> dict[str, slice]:
    """Where the quantities are in a compact frame."""
    at = FrameLayout.of(robot)
    return {
        "root_position": at.root, "root_rotation": at.rotation, "joint_angles": slice(at.cosine.start, at.sine.stop),
        "key_points": at.key_points, "root_velocity": at.velocity, "root_angular_velocity": at.angular_velocity,
        "joint_velocity": at.joint_velocity,
    }  # fmt: skip


def deviations(trainer: Trainer) -> jax.Array:
    """The demonstration's own deviations ``[H, F]``, before any floor."""
    return features.relative_windows(trainer.env.clip_windows()).std(0)


def fits(trainer: Trainer, state: TrainState, moments: Moments, key: jax.Array) -> dict[str, jax.Array]:
    """How the fitted potential, and one fitted 128 times more to the same windows, follow the transport."""
    config, dimension = trainer.config.prior, trainer.feature_map.dimension
    pool = moments.windows.reshape(-1, moments.windows.shape[-1])
    expert = trainer.expert.windows[state.prior.bank]
    pick_key, bank_key, fit_key = jax.random.split(key, 3)
    query = pool[jax.random.randint(pick_key, (QUERIES,), 0, len(pool))]
    truth = reference.reference(pool, expert, query, dimension, config, bank_key, BANKS)
    spread = jnp.maximum(reference.spread(truth.score), config.spread_floor)
    longer = dataclasses.replace(trainer.config, prior=dataclasses.replace(config, updates=128))
    longer = priors.make(trainer.config.method, trainer.expert, longer)
    rollout = priors.Rollout(moments.windows, jnp.ones(moments.speed.shape, bool))
    refitted = longer.update(state.prior, rollout, fit_key)[0]
    row = {"score_spread": spread}
    for name, prior in (("online", state.prior), ("128_updates", refitted)):
        score, gradient = potential.score_and_gradient(prior.average, query, dimension)
        row[f"{name}_correlation"] = reference.correlation(score, truth.score)
        row[f"{name}_error"] = jnp.abs(score - score.mean() - truth.score).mean() / spread
        row[f"{name}_gradient_cosine"] = reference.cosine(gradient, truth.gradient)
    row |= _teachers(pool, expert, query, truth, dimension, config, bank_key)
    score = trainer.prior.score(state.prior, pool)
    spread = reference.spread(score)
    gain = trainer.prior.score(state.prior, moments.pushed.reshape(pool.shape)) - score
    standing = jnp.abs(moments.speed.ravel()) < STANDING
    # What the reward's argument gains, in its own units, if a window, or a standing one, were PUSH faster.
    row["push_gain"] = gain.mean() / spread
    row["standing_push_gain"] = jnp.where(standing, gain, 0.0).sum() / jnp.maximum(standing.sum(), 1) / spread
    weight = truth.gradient**2
    frame = weight.reshape(len(query), trainer.env.horizon, -1)
    for name, place in _groups(trainer.robot).items():
        row[f"gradient_share_{name}"] = frame[..., place].sum() / weight.sum()
    floored = trainer.feature_map.deviation > deviations(trainer) * (1 + 1e-5)
    row["floored_coordinates"] = floored.mean()
    row["gradient_share_floored"] = (frame * floored).sum() / weight.sum()
    limit = trainer.feature_map.clip * jnp.tile(trainer.feature_map.weight, trainer.env.horizon)
    row["clipped_coordinates"] = (jnp.abs(query) >= limit * (1 - 1e-6)).mean()
    return row


def _teachers(pool, expert, query, truth, dimension, config, key) -> dict[str, jax.Array]:
    """How one bank's transport teaches at windows of that bank, which the self-transport finds there, and at others."""
    source = pool[jax.random.randint(jax.random.fold_in(key, 1), (config.bank,), 0, len(pool))]
    source_truth = reference.reference(pool, expert, source, dimension, config, key, BANKS)
    coupling = couple(source, expert, dimension, config)
    row = {}
    for name, at, true in (("bank", None, source_truth), ("apart", query, truth)):
        teacher = flow.teach(coupling, expert, at)
        row[f"teacher_{name}_correlation"] = reference.correlation(teacher.score, true.score)
        row[f"teacher_{name}_gradient_cosine"] = reference.cosine(teacher.gradient, true.gradient)
        lengths = (jnp.linalg.norm(gradient, axis=-1).mean() for gradient in (teacher.gradient, true.gradient))
        row[f"teacher_{name}_gradient_length"], row[f"true_{name}_gradient_length"] = lengths
        row[f"teacher_{name}_own_share"] = teacher.to_source.max(-1).mean()  # of the nearest source window
    return row


@partial(jax.jit, static_argnums=0)
def _examine(trainer: Trainer, state: TrainState, key: jax.Array) -> tuple[Moments, dict[str, jax.Array]]:
    gather_key, fit_key = jax.random.split(key)
    moments = gather(trainer, state, gather_key)
    rest = gradients(trainer, state, moments) | fits(trainer, state, moments, fit_key)
    return moments._replace(windows=jnp.zeros(0), pushed=jnp.zeros(0)), rest


def examine(trainer: Trainer, state: TrainState, seed: int) -> dict[str, float]:
    """All figures of one state: behaviors, gradients, fits."""
    done = int(state.iteration) * trainer.config.transitions_per_iteration
    moments, rest = _examine(trainer, state, jax.random.fold_in(jax.random.PRNGKey(seed), done))
    row = {"transitions": done, "cap": float(state.env.cap), "speed": float(moments.speed.mean())}
    return row | behaviors(moments) | {name: float(value) for name, value in rest.items()}


def look(run: tuple[Path, ...], out: Path) -> None:
    """Look at the newest state of runs.

    Args:
      run: one folder or several.
      out: CSV file to write, a line a run.
    """
    results.check_file(out)
    rows = []
    for folder in run:
        opened = runs.Run.open(folder)
        priors.check_potential(opened.config.method)
        trainer, state = opened.policy(best=False)
        print(f"{folder}: compiling ...", flush=True)
        row = examine(trainer, state, trainer.config.seed)
        rows.append({"run": f"{folder.parent.name}/{folder.name}"} | row)
        print("\n".join(f"  {name:<32} {value:.4g}" for name, value in row.items()), flush=True)
    print(f"wrote {results.write_csv(out, rows)}")


def track(trainer: Trainer) -> dict[str, float | str]:
    """Whether the servos can follow the demonstration at all: its joints as targets, the root carried along or free.

    Returns:
      Root-mean-square joint error (rad) with the root carried, the same for the worst joint, the share of actions
      beyond one unit, and the steps until a fall with the root left free.
    """
    env, clip = trainer.env, trainer.clip
    qpos, qvel = (jnp.asarray(x, jnp.float32) for x in (clip.qpos, clip.qvel))
    lead = trainer.robot.damping / trainer.robot.stiffness  # s by which a damped servo trails its target
    actions = (qpos[1:, 7:] + lead * qvel[1:, 6:] - env.actions.center) / env.actions.scale

    def play(carried):
        def step(sim, inputs):
            action, q, v = inputs
            reached = env.advance(sim, action[None].astype(jnp.float32))
            sim, fell = reached.physics, reached.fell
            error = sim.qpos[0, 7:] - q[7:]
            if carried:
                sim = sim._replace(qpos=sim.qpos.at[0, :7].set(q[:7]), qvel=sim.qvel.at[0, :6].set(v[:6]))
            return sim, (error, fell[0])

        return jax.lax.scan(step, physics.reset(qpos[:1], qvel[:1]), (actions, qpos[1:], qvel[1:]))[1]

    error, _ = jax.jit(lambda: play(True))()
    _, fell = jax.jit(lambda: play(False))()
    rms = np.sqrt(np.mean(np.asarray(error) ** 2, 0))
    return {
        "joint_error": float(np.sqrt(np.mean(rms**2))),
        "worst_joint_error": float(rms.max()),
        "worst_joint": trainer.robot.joint_names[int(rms.argmax())],
        "actions_beyond_one": float(jnp.mean(jnp.abs(actions) > 1.0)),
        "open_loop_steps": int(np.argmax(fell)) if np.asarray(fell).any() else len(fell),
    }


def measure(
    out: Path,
    preset_name: str = "laptop",
    motion: str = "walk",
    frames: Annotated[str, default("all")] = "",
    seed: int = 0,
    transitions: int = 6_000_000,
    every: int = 500_000,
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),  # noqa: A002 - the option's name
) -> None:
    """Train, and look at the run every so often.

    Args:
      out: folder for standing.csv, standing.json and standing.png.
      preset_name: preset to start from.
      motion: a bundled motion's name or a file.
      frames: source rows "first:last" of the motion.
      seed: of the run.
      transitions: of the run.
      every: transitions between two measurements.
      set: any other setting as section.field=value, repeated.
    """
    changes = dict(item.partition("=")[::2] for item in set)
    config: Config = preset(preset_name, motion=motion, frames=frames, seed=seed, transitions=transitions, **changes)
    priors.check_potential(config.method)
    results.check_folder(out)
    out.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(config, runs.load_motion(config))
    tracking = track(trainer)
    print("tracking: " + ", ".join(f"{k} {v if isinstance(v, str) else round(v, 4)}" for k, v in tracking.items()))
    state = trainer.init()

    print("compiling ...", flush=True)
    chunk = trainer.compile(state)
    rows, due = [], every
    while int(state.iteration) < config.iterations:
        state, metrics = chunk(state)
        done = int(state.iteration) * config.transitions_per_iteration
        if done < due:
            continue
        due += every
        began = time.monotonic()
        row = examine(trainer, state, seed)
        row |= {"deviation": float(metrics["ppo/deviation"]), "expert_margin": float(metrics["fit/expert_margin"])}
        rows.append(row)
        print(
            f"{done / 1e6:5.2f} M | cap {row['cap']:3.0f} | speed {row['speed']:+.2f} m/s | standing "
            f"{row['standing_share']:.2f}, reward {row['standing_reward']:.2f} | walking {row['walking_share']:.2f}, "
            f"reward {row['walking_reward']:.2f} | survival {row['return_survival_share']:.2f} of the return | "
            f"fit {row['online_correlation']:.2f}, longer {row['128_updates_correlation']:.2f} | "
            f"{time.monotonic() - began:.0f} s",
            flush=True,
        )
        results.write_csv(out / "standing.csv", rows)
    settings = {"preset": preset_name, "motion": Path(motion).name, "frames": frames, "seed": seed, "set": changes}
    evaluation = Evaluator(trainer)(state.ppo).record()
    record = {"settings": settings, "tracking": tracking, "evaluation": evaluation, "provenance": runs.provenance()}
    runs.write(out / "standing.json", runs.without_places(jsons.dumps(record), [motion]))
    print(f"wrote {out}/standing.csv and standing.json")
    print(f"wrote {figure(out / 'standing.png', (out,))}")


def figure(out: Path, measured: tuple[Path, ...]) -> Path:
    """Draw the measurements of one or several folders.

    Args:
      out: PNG to write.
      measured: folders that `measure` wrote.
    """
    return curves.comparison(out, {folder.name: folder / "standing.csv" for folder in measured}, _PANELS)


COMMANDS = Group("Measure why a policy stands before it walks.", {"measure": measure, "look": look, "figure": figure})


if __name__ == "__main__":
    results.entry(COMMANDS)
