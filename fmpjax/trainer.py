"""The training loop: one pure iteration, scanned.

Here all parts meet: rollout, windows, prior, rewards, policy. Nothing in this file knows a method by name.
"""

import contextlib
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import Mesh

from fmpjax import commands, features, learning, metrics, mirror, physics, priors, products, robots, sharding
from fmpjax.config import Config
from fmpjax.env import PER_ENVIRONMENT, Env, EnvState, Steps
from fmpjax.errors import UserError
from fmpjax.frames import FrameLayout
from fmpjax.motion import MotionClip, MotionLibrary
from fmpjax.ppo import PPO, Batch, PPOState


class TrainState(NamedTuple):
    """The whole state of a run. Only this is checkpointed."""

    ppo: PPOState
    prior: Any
    env: EnvState
    key: jax.Array
    iteration: jax.Array  # int32
    nonfinite: jax.Array  # int32, environments reset and updates skipped so far


Metrics = dict[str, jax.Array]


class Trainer:
    """The parts of one run, and the pure functions that train them."""

    def __init__(self, config: Config, demonstration: MotionClip | MotionLibrary):
        priors.check(config.method)
        self.config, self.library = config, MotionLibrary.of(demonstration)
        self.robot = robots.load(config.robot)
        for clip in self.library.clips:
            _check(clip, self.robot, config)
        backend = physics.make(
            self.robot,
            config.physics,
            joint_friction=bool(config.disturbance.joint_friction),
            uneven=bool(config.disturbance.step_height),
        )
        self.env = Env(self.robot, self.library, config, backend)
        clock = config.env.longest_episode if priors.remembers(config.method) else 0
        form = features.observation_form(config)
        image = mirror.make(self.robot, form, self.env.actions) if config.ppo.mirror else None
        estimated = features.estimated_columns(self.robot, config)
        newest = features.newest_columns(self.robot, form)
        self.ppo = PPO(self.env.observation_size, self.robot.joint_count, config.ppo, clock, image, estimated, newest)
        windows, share = self.env.clip_windows(), self.env.window_share()
        self.feature_map = features.fit_feature_map(self.robot, windows, config.features, share)
        self.expert = priors.Expert(
            windows=self.feature_map(windows),
            dimension=float(self.feature_map.dimension),
            weight=jnp.tile(self.feature_map.weight, self.env.horizon),
            horizon=self.env.horizon,
            share=None if share is None else jnp.asarray(share, jnp.float32),
            layout=FrameLayout.of(self.robot),
        )
        # What windows are compared in is the same for every method; what its prior is given need not be.
        self.prior_map = self.feature_map.unclipped() if priors.normalizes(config.method) else self.feature_map
        self.prior_expert = self.expert._replace(windows=self.prior_map(windows))
        label = self.env.window_clips() if config.command.labeled else None
        self.prior = priors.make(config.method, self.prior_expert, config, label)
        self._init = jax.jit(self._first)  # one program: compiled one by one, its operations take seconds

    @property
    def clip(self) -> MotionClip:
        """The only demonstration.

        Raises:
          UserError: there are several.
        """
        if len(self.library.clips) > 1:
            names = ", ".join(clip.name for clip in self.library.clips)
            raise UserError(f"the run has {len(self.library.clips)} motions ({names}): expected one")
        return self.library.clips[0]

    def init(self, seed: int | None = None) -> TrainState:
        """The state at iteration zero, a function of the seed, by default the configuration's."""
        state = self._init(jax.random.PRNGKey(self.config.seed if seed is None else seed))
        # A compiled chunk is given its state's buffers to write into, so no two leaves may share one.
        return jax.tree.map(jnp.copy, state)

    def shapes(self) -> TrainState:
        """A state's structure with shapes and types in place of arrays, into which a checkpoint is read."""
        return jax.eval_shape(self._first, jax.random.PRNGKey(0))

    def _first(self, key: jax.Array) -> TrainState:
        key, ppo_key, prior_key, env_key = jax.random.split(key, 4)
        return TrainState(
            ppo=self.ppo.init(ppo_key, self.env.clip_observations),
            prior=self.prior.init(prior_key),
            env=self.env.reset(env_key),
            key=key,
            iteration=jnp.int32(0),
            nonfinite=jnp.int32(0),
        )

    def iteration(self, state: TrainState, _=None) -> tuple[TrainState, Metrics]:
        """Roll out, fit the reward and score with it, improve the policy."""
        with self.precision():
            return self._iteration(state)

    def precision(self) -> contextlib.AbstractContextManager:
        """The precision of the matrix products of what is traced within; the physics has its own."""
        return products.at_precision(self.config.precision)

    def _iteration(self, state: TrainState) -> tuple[TrainState, Metrics]:
        key, rollout_key, prior_key, ppo_key = jax.random.split(state.key, 4)
        env, steps = self.env.rollout(state.env, self.ppo.act(state.ppo), rollout_key, self.config.ppo.rollout_steps)
        prior, reward, prior_metrics = self.prior.update(state.prior, self._rollout(state, steps), prior_key)
        reward, command_metrics = self._commanded(steps, reward)
        ppo, ppo_metrics = self.ppo.update(
            state.ppo, policy_batch(steps, reward), ppo_key, state.iteration >= self.config.settles_at
        )
        skipped = prior_metrics.get("skipped", 0.0) + ppo_metrics["skipped"]
        nonfinite = state.nonfinite + steps.nonfinite.sum().astype(jnp.int32) + jnp.int32(skipped)
        figures = (
            _rollout_metrics(self.robot, steps, reward)
            | {f"env/{name}": getattr(env, name) for name in ("cap", "capped_share")}
            | {f"fit/{name}": value for name, value in prior_metrics.items()}
            | {f"ppo/{name}": value for name, value in ppo_metrics.items()}
            | command_metrics
            | ({"env/push_share": env.disturbed.share.mean()} if self.env.disturbances else {})
            | {"train/nonfinite": nonfinite}
        )
        figures = {name: jnp.asarray(value, jnp.float32) for name, value in figures.items()}
        return TrainState(ppo, prior, env, key, state.iteration + 1, nonfinite), figures

    def _rollout(self, state: TrainState, steps: Steps) -> priors.Rollout:
        """What the prior sees of the steps: true states, whatever the policy's sensors say."""
        table = self.env.frame_table(state.env, steps)
        # Devices split the windows as the prior does, by rows of the rollout: indices travel, windows do not.
        windows = self.prior_map(table[sharding.gather(steps.window)])
        rollout = priors.Rollout(windows, ~steps.nonfinite, steps.length == 1)
        if self.config.command.labeled:
            rollout = rollout._replace(label=steps.label)
        if not priors.follows(self.config.method):
            return rollout
        reached, wanted = self.feature_map.placed(steps.frame), self.feature_map.placed(table[steps.wanted])
        return rollout._replace(frame=reached, wanted=wanted)

    def _commanded(self, steps: Steps, reward: jax.Array) -> tuple[jax.Array, Metrics]:
        """The prior's reward ``[T, N]`` joined by what the steps earn by obeying, where they are told anything."""
        if not self.env.command:
            return reward, {}
        measured = {"command/reward": steps.obeyed.mean(), "command/prior_reward": reward.mean()}
        return commands.combine(self.config.command, reward, steps.obeyed), measured

    def compile(self, state: TrainState) -> jax.stages.Compiled:
        """The compiled program of a run: ``config.chunk`` iterations, and their metrics, averaged.

        A state whose leaves have a leading axis of seeds, as `stack` makes it, gives metrics with that axis. A state
        that `place` put on a mesh stays there.
        """

        def chunk(state: TrainState) -> tuple[TrainState, Metrics]:
            state, figures = jax.lax.scan(self.iteration, state, None, length=self.config.chunk)
            return state, jax.tree.map(jnp.nanmean, figures)

        over = sharding.of(state.iteration)
        program: Callable[[TrainState], Any] = chunk
        if state.iteration.ndim:
            program = sharding.per_device(jax.vmap(chunk))
        if over is None:
            return jax.jit(program, donate_argnums=0).lower(state).compile()
        placed = jax.tree.map(lambda leaf: leaf.sharding, state)
        with jax.set_mesh(over):
            shardings = (placed, sharding.everywhere(over))
            return jax.jit(program, donate_argnums=0, out_shardings=shardings).lower(state).compile()

    def place(self, state: TrainState, over: Mesh) -> TrainState:
        """The state on the devices of a mesh: environments, or seeds where there are several, split over them.

        Raises:
          UserError: they do not divide.
        """
        seeds = len(state.iteration) if state.iteration.ndim else 1
        sharding.check_divides(self.config.env.count, seeds, over.size)
        if seeds > 1:
            return jax.device_put(state, sharding.rows(over))
        split = {name: jax.device_put(getattr(state.env, name), sharding.rows(over)) for name in PER_ENVIRONMENT}
        state = jax.device_put(state, sharding.everywhere(over))
        return state._replace(env=state.env._replace(**split))


def _check(clip: MotionClip, robot: robots.Robot, config: Config) -> None:
    if abs(clip.rate - config.control_rate) > 1e-6:
        raise UserError(
            f"motion {clip.name} has {clip.rate:g} samples per second: expected the control rate, "
            f"{config.control_rate:g} Hz"
        )
    if not robot.takes(clip.robot):
        raise UserError(f"motion {clip.name} is of robot {clip.robot!r}: expected {robot.name!r}")
    if clip.duration < metrics.WINDOW:
        raise UserError(
            f"motion {clip.name} lasts {clip.duration:.2f} s: expected at least {metrics.WINDOW:g} s, the window over "
            "which ranges of its joints are taken"
        )
    if len(clip) <= config.features.history:
        raise UserError(
            f"setting features.history is {config.features.history}: expected fewer than the {len(clip)} samples "
            f"of motion {clip.name}"
        )


def stack(states: Sequence[TrainState]) -> TrainState:
    """States of several seeds as one, each leaf with a leading axis of seeds."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *states)


def unstack(state: TrainState) -> list[TrainState]:
    """The states of the seeds in a stacked state."""
    return [jax.tree.map(itemgetter(i), state) for i in range(len(state.iteration))]


def policy_batch(steps: Steps, reward: jax.Array) -> Batch:
    """What PPO learns from: a rollout, and its rewards ``[T, N]``."""
    return Batch(
        observation=steps.observation,
        next_observation=steps.next_observation,
        action=steps.action,
        mean=steps.extras["mean"],
        deviation=steps.extras["deviation"],
        reward=reward,
        fell=steps.fell,
        timed_out=steps.timed_out,
        age=steps.length,
    )


def _rollout_metrics(robot: robots.Robot, steps: Steps, reward: jax.Array) -> Metrics:
    ended = steps.fell | steps.timed_out
    count = ended.sum()
    median, spread = learning.median_and_spread(reward)
    return {
        # NaN where no episode ended in the rollout; averages over a chunk leave it out.
        "train/episode_length": jnp.where(count > 0, (steps.length * ended).sum() / count, jnp.nan),
        "train/falls": jnp.where(count > 0, steps.fell.sum() / count, jnp.nan),
        "train/speed": steps.frame[..., FrameLayout.of(robot).velocity.start].mean(),
        "train/reward": reward.mean(),
        "train/reward_spread": spread,
        "train/reward_median": median,
    }
