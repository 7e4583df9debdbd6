"""Parallel environments: resets, falls, time-outs, and the frames that the prior's windows are made of.

Windows are kept as indices. A rollout stores one compact frame a step; a window is H indices into the table
``[demonstration frames | default-pose frame | frames before the rollout | frames of the rollout]``. After a reset the
indices point at the demonstration's own preceding frames, or repeat the default pose, so a history is right by
construction.
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import commands, features, physics, sharding
from fmpjax.acting import Policy
from fmpjax.config import Config
from fmpjax.features import Observed
from fmpjax.motion import MotionClip, MotionLibrary
from fmpjax.motion.clip import refined
from fmpjax.robots import Robot

# What a state must stay below. No joint or fall of a robot of this size is as fast: such a state has blown up.
_LIMITS = physics.PhysicsState(qpos=np.inf, qvel=1e3, warmstart=np.inf)  # m and rad, m/s and rad/s, m/s² and rad/s²

# Of the demonstrations, from which a prior learns: 22 minutes at 50 Hz, 0.3 GB. Of more, an even part stands for all.
MOST_WINDOWS = 1 << 16

# Fields of `EnvState` with a leading axis of environments.
PER_ENVIRONMENT = ("physics", "observed", "history", "age", "command")


class Offender(NamedTuple):
    """The last state from which the physics left the finite numbers, kept to be looked at."""

    qpos: jax.Array  # [7 + J]
    qvel: jax.Array  # [6 + J]
    action: jax.Array  # [J] normalised


class EnvState(NamedTuple):
    """State of N environments; all of it is checkpointed."""

    physics: physics.PhysicsState
    observed: Observed  # of the present state
    history: jax.Array  # [N, H, F] frames up to the present one, oldest first
    age: jax.Array  # [N] int32, steps since the reset
    cap: jax.Array  # scalar, steps at which an episode times out
    capped_share: jax.Array  # scalar, running share of episodes that end by the cap
    cap_age: jax.Array  # scalar int32, rollouts since the cap last grew
    offender: Offender
    command: Any = ()  # each environment's, as its kind has it; nothing without commands


class Moment(NamedTuple):
    """N environments between two control steps of a rollout."""

    physics: physics.PhysicsState
    observed: Observed  # of the present state
    age: jax.Array  # [N] int32, steps since the reset
    window: jax.Array  # [N, H] int32, frame table's rows of the frames up to the present one, oldest first
    offender: Offender  # each environment's own in this rollout, [N, ...]
    command: Any = ()  # each environment's


class Drawn(NamedTuple):
    """What a step needs beside the action. A rollout draws it for all of its steps at once."""

    row: jax.Array  # [N] int32, frame table's rows of the frames after the step
    start: jax.Array  # [N] int32, frame table's rows of the states at which new episodes begin
    window: jax.Array  # [N, H] int32, frame table's rows of the histories up to there
    key: jax.Array  # of the noise on those states
    command: Any = ()  # random numbers of the commands


class Reached(NamedTuple):
    """What the physics of one control step reaches; the state before it where that is not finite."""

    physics: physics.PhysicsState
    observed: Observed
    fell: jax.Array  # [N] bool, or not finite
    finite: jax.Array  # [N] bool


class Steps(NamedTuple):
    """A rollout: T steps of N environments."""

    observation: jax.Array  # [T, N, O] before the action
    next_observation: jax.Array  # [T, N, O] after it, before any reset: the true one
    action: jax.Array  # [T, N, J] normalised
    extras: dict[str, jax.Array]  # what the policy said of the action, each [T, N, ...]
    fell: jax.Array  # [T, N] bool
    timed_out: jax.Array  # [T, N] bool; a fall on the same step is a fall
    nonfinite: jax.Array  # [T, N] bool, a fall for whoever learns
    length: jax.Array  # [T, N] int32, steps of the episode up to and including this one
    frame: jax.Array  # [T, N, F] compact frame after the step, before any reset
    window: jax.Array  # [T, N, H] int32 indices into the frame table
    obeyed: Any = ()  # [T, N] in [0, 1], what obeying the command earned; nothing without commands


class ActionMap(NamedTuple):
    """Joint targets (rad) from normalised actions: clip(center + scale * a, low, high); each ``[J]``."""

    center: np.ndarray
    scale: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def __call__(self, action: jax.Array) -> jax.Array:
        return jnp.clip(self.center + self.scale * action, self.low, self.high).astype(action.dtype)


def action_map(robot: Robot, motion: MotionClip | MotionLibrary, kind: str) -> ActionMap:
    """The ``absolute`` map around zero, or the ``residual`` map around the demonstrations' mean pose."""
    if kind == "absolute":
        scale = 1.4 * np.maximum(np.abs(robot.joint_low), np.abs(robot.joint_high))
        return ActionMap(np.zeros_like(scale), scale, -scale, scale)
    library = MotionLibrary.of(motion)
    return ActionMap(
        center=library.mean([clip.qpos[:, 7:].mean(0) for clip in library.clips]),
        scale=0.25 * robot.effort / robot.stiffness,
        low=robot.joint_low - 0.3,
        high=robot.joint_high + 0.3,
    )


class Env:
    """Environments of one robot and its demonstrations; its methods are pure."""

    def __init__(self, robot: Robot, motion: MotionClip | MotionLibrary, config: Config, backend: physics.Physics):
        self.robot, self.config, self.physics = robot, config.env, backend
        self.horizon = config.features.history
        library = MotionLibrary.of(motion)
        self.actions = action_map(robot, library, config.env.action)
        self.form = features.observation_form(config)
        observe = jax.jit(lambda qpos, qvel: features.observe(robot, qpos, qvel, self.form))
        self._observe = observe
        # A row stands `stride` rows after the frame before it.
        self.stride = config.env.demonstration_parts
        self.library = library = dataclasses.replace(
            library, clips=tuple(refined(clip, self.stride) for clip in library.clips)
        )
        # Rows of its clip that a row needs ahead of it to end a window.
        self._before = 0 if config.env.early_frames else (self.horizon - 1) * self.stride
        # Rows 0..M-1 are the demonstrations, row M the default pose; resets gather from here.
        self._qpos = np.concatenate([library.qpos, robot.default_qpos[None]]).astype(np.float32)
        self._qvel = np.concatenate([library.qvel, np.zeros_like(library.qvel[:1])]).astype(np.float32)
        self._table = jax.tree.map(np.asarray, observe(jnp.asarray(self._qpos), jnp.asarray(self._qvel)))
        self.clip_rows = len(library.qpos)
        self.command = commands.make(config, robot, library, self._table.frame)

    @property
    def observation_size(self) -> int:
        return self._table.actor.shape[-1] + (self.command.size if self.command else 0)

    @property
    def clip_observations(self) -> jax.Array:
        """Policy observations of the demonstrations, ``[M, O]``."""
        rows = jnp.arange(self.clip_rows)
        return self.seen(jnp.asarray(self._table.actor)[rows], self.first_command(rows))

    def seen(self, actor: jax.Array, command: Any) -> jax.Array:
        """What the networks observe, ``[..., O]``: the robot, and the command where there is one."""
        return jnp.concatenate([actor, self.command.observe(command)], axis=-1) if self.command else actor

    def first_command(self, rows: jax.Array, key: jax.Array | None = None) -> Any:
        """Commands of episodes that begin at the table rows ``[N]``."""
        if not self.command:
            return ()
        return self.command.begin(rows, self.command.draw(jax.random.PRNGKey(0) if key is None else key, rows.shape))

    def clip_windows(self) -> jax.Array:
        """The demonstrations' windows of compact frames, ``[W, H, F]``: all of them, or about `MOST_WINDOWS`."""
        rows = self.library.rows_after(self._before, MOST_WINDOWS)
        return jnp.asarray(self._table.frame)[self.history_rows(rows)]

    def window_share(self) -> np.ndarray | None:
        """How often each of those windows is drawn, ``[W]``, summing to one; None where all are alike."""
        return self.library.share_after(self._before, MOST_WINDOWS)

    def clip_of(self, rows: np.ndarray) -> np.ndarray:
        """Index of the demonstration of each table row, 0 for the default pose."""
        return np.where(rows < self.clip_rows, self.library.clip_of(rows), 0)

    def reset_rows(self, key: jax.Array, count: int) -> jax.Array:
        """Table rows ``[count]`` at which episodes start under the configured regime."""
        if self.config.reset == "fixed":
            return jnp.full((count,), self.clip_rows)
        if len(self.library.clips) == 1:
            return jax.random.randint(key, (count,), self._before, self.clip_rows)
        starts, lengths = self.library.starts, self.library.lengths
        weights = jnp.asarray(self.library.weights)
        clip = jax.random.choice(jax.random.fold_in(key, 1), len(starts), (count,), p=weights)
        first, end = jnp.asarray(starts + self._before), jnp.asarray(starts + lengths)
        return jax.random.randint(key, (count,), first[clip], end[clip])

    def history_rows(self, rows: jax.Array) -> jax.Array:
        """Table rows ``[count, H]`` of the histories that end at ``rows``; ahead of a clip stands its first row."""
        rows = rows[:, None]
        before = rows - self.stride * np.arange(self.horizon)[::-1]
        if self.config.early_frames:
            starts = self.library.starts
            before = jnp.maximum(before, jnp.asarray(starts)[jnp.searchsorted(starts, rows, side="right") - 1])
        return jnp.where(rows == self.clip_rows, rows, before)

    def _begin(
        self, rows: jax.Array, key: jax.Array | None, noise: jax.Array | None = None
    ) -> tuple[physics.PhysicsState, Observed]:
        """States at the table rows ``[N]`` and what is observed of them; with a key, joints are off by the noise."""
        qpos, qvel = jnp.asarray(self._qpos)[rows], jnp.asarray(self._qvel)[rows]
        noise = self.config.reset_noise if noise is None else noise[:, None]
        if key is None or (isinstance(noise, float) and not noise):
            return physics.reset(qpos, qvel), jax.tree.map(lambda table: jnp.asarray(table)[rows], self._table)
        angle, velocity = noise * jax.random.normal(key, (2, len(rows), self.robot.joint_count))
        qpos, qvel = qpos.at[:, 7:].add(angle), qvel.at[:, 6:].add(10.0 * velocity)
        return physics.reset(qpos, qvel), self._observe(qpos, qvel)

    def start_at(self, rows: jax.Array, key: jax.Array | None = None, noise: jax.Array | None = None) -> EnvState:
        """Environments at the table rows ``[N]``, episodes beginning; exactly there unless a key is given.

        With a key, joint angles are off by ``noise [N]`` rad (standard deviation), by ``reset_noise`` where it is not
        given, and joint velocities by ten times that in rad/s.
        """
        state, observed = self._begin(rows, key, noise)
        return EnvState(
            physics=state,
            observed=observed,
            history=jnp.asarray(self._table.frame)[self.history_rows(rows)],
            age=jnp.zeros(len(rows), jnp.int32),
            cap=jnp.float32(self.config.first_cap),
            capped_share=jnp.float32(0.0),
            cap_age=jnp.int32(0),
            offender=Offender(
                *(jnp.zeros(n) for n in (state.qpos.shape[-1], state.qvel.shape[-1], len(self.actions.low)))
            ),
            command=self.first_command(rows, None if key is None else jax.random.fold_in(key, 3)),
        )

    def reset(self, key: jax.Array) -> EnvState:
        """All environments at fresh resets."""
        return self.start_at(self.reset_rows(key, self.config.count), jax.random.fold_in(key, 2))

    def rollout(self, state: EnvState, policy: Policy, key: jax.Array, steps: int) -> tuple[EnvState, Steps]:
        """``steps`` control steps under a policy; falls and time-outs reset at once."""
        count = len(state.age)
        before = self.clip_rows + 1  # rows ahead of the frames before the rollout
        during = before + count * self.horizon  # rows ahead of the rollout's own frames

        def play(now: Moment, inputs) -> tuple[Moment, Steps]:
            noise, drawn = inputs
            action, extras = policy.act(self.seen(now.observed.actor, now.command), noise)
            now, record = self.step(now, action, drawn, state.cap)
            return now, record._replace(extras=extras)

        # Once for all steps: inside the loop, random numbers were most of what a small step launches.
        policy_keys, reset_keys = jax.vmap(jax.random.split, out_axes=1)(jax.random.split(key, steps))
        noise = jax.vmap(lambda key: policy.draw(key, (count,)))(policy_keys)
        starts = jax.vmap(lambda key: self.reset_rows(key, count))(reset_keys)
        drawn = Drawn(
            row=during + jnp.arange(steps * count).reshape(steps, count),
            start=starts,
            window=jax.vmap(self.history_rows)(starts),
            key=jax.vmap(lambda key: jax.random.fold_in(key, 2))(reset_keys),
            command=self._command_draws(reset_keys, count),
        )
        window = before + jnp.arange(count * self.horizon).reshape(count, self.horizon)
        offender = jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), state.offender)
        now = Moment(state.physics, state.observed, state.age, window, offender, state.command)
        now, record = jax.lax.scan(play, now, (noise, drawn))
        new_state = state._replace(
            physics=now.physics,
            observed=now.observed,
            history=self.frame_table(state, record)[now.window],
            age=now.age,
            command=now.command,
            offender=_last_offender(now.offender, record.nonfinite, state.offender),
        )
        return self._grow_cap(new_state, record), record

    def step(self, now: Moment, action: jax.Array, drawn: Drawn, cap: jax.Array) -> tuple[Moment, Steps]:
        """One control step, after which episodes that are over begin again.

        Args:
          now: the environments before the step.
          action: ``[N, J]`` normalised.
          drawn: what the step needs beside the action.
          cap: scalar, steps at which an episode times out.

        Returns:
          The environments before the next step, and the record of this one, each field ``[N, ...]``, with no extras.
        """
        reached = self.advance(now.physics, action)
        age = now.age + 1
        timed_out = (age >= cap) & ~reached.fell
        command, obeyed = (), ()
        if self.command:
            command, over, obeyed = self.command.advance(now.command, drawn.command, reached.observed.frame)
            timed_out |= over & ~reached.fell
        window = sharding.split(jnp.concatenate([now.window[:, 1:], drawn.row[:, None]], axis=1))
        record = Steps(
            observation=self.seen(now.observed.actor, now.command),
            next_observation=self.seen(reached.observed.actor, command),
            action=action,
            extras={},
            fell=reached.fell,
            timed_out=timed_out,
            nonfinite=~reached.finite,
            length=age,
            frame=reached.observed.frame,
            window=window,
            obeyed=obeyed,
        )
        done = reached.fell | timed_out
        sim, observed = self._begin(drawn.start, drawn.key)
        fresh = self.command.begin(drawn.start, drawn.command) if self.command else ()
        begun = sim, observed, jnp.zeros_like(age), drawn.window, fresh
        after = reached.physics, reached.observed, age, window, command
        *kept, command = jax.tree.map(lambda new, old: jnp.where(_over(done, old), new, old), begun, after)
        return Moment(*kept, offender=_offender(now, action, reached.finite), command=command), record

    def _command_draws(self, keys: jax.Array, count: int) -> Any:
        """Random numbers of the commands of all steps, which have a key each."""
        if not self.command:
            return ()
        return jax.vmap(lambda key: self.command.draw(jax.random.fold_in(key, 3), (count,)))(keys)

    def advance(self, sim: physics.PhysicsState, action: jax.Array) -> Reached:
        """The physics of one control step under normalised actions ``[N, J]``, whatever the episodes."""
        reached = sharding.per_device(self.physics.step)(sim, self.actions(action))
        finite = _finite(reached)
        # Non-finite numbers must not reach the observation, not even to be discarded: the state before stays.
        sim = jax.tree.map(lambda new, old: jnp.where(finite[:, None], new, old), reached, sim)
        observed = self._observe(sim.qpos, sim.qvel)
        return Reached(sim, observed, observed.fallen | ~finite, finite)

    def frame_table(self, state: EnvState, record: Steps) -> jax.Array:
        """Frames ``[rows, F]`` that the windows of a rollout begun in ``state`` index."""
        size = record.frame.shape[-1]
        before, during = sharding.gather((state.history, record.frame))
        return jnp.concatenate([jnp.asarray(self._table.frame), before.reshape(-1, size), during.reshape(-1, size)])

    def _grow_cap(self, state: EnvState, record: Steps) -> EnvState:
        """Raise the cap when episodes survive it (none where it starts at the full length)."""
        config = self.config
        ended, capped = (record.fell | record.timed_out).sum(), record.timed_out.sum()
        share = jnp.where(
            ended > 0, 0.9 * state.capped_share + 0.1 * capped / jnp.maximum(ended, 1), state.capped_share
        )
        cap_age = state.cap_age + 1
        last = min(config.last_cap, config.episode_steps)
        grow = (share > config.cap_share) & (cap_age >= config.cap_patience) & (state.cap < last)
        cap = jnp.where(grow, jnp.minimum(jnp.ceil(state.cap * config.cap_growth), last), state.cap)
        return state._replace(cap=cap, capped_share=share, cap_age=jnp.where(grow, 0, cap_age))


def _over(chosen: jax.Array, values: jax.Array) -> jax.Array:
    """``chosen [N]`` with as many axes as ``values [N, ...]``."""
    return chosen.reshape(-1, *[1] * (values.ndim - 1))


def _offender(now: Moment, action: jax.Array, finite: jax.Array) -> Offender:
    """Each environment's last offender after a step that left ``finite [N]`` of them finite."""
    # Each keeps its own, which needs no word from the others while the rollout goes on.
    here = Offender(now.physics.qpos, now.physics.qvel, action)
    return jax.tree.map(lambda new, old: jnp.where(finite[:, None], old, new), here, now.offender)


def _last_offender(offenders: Offender, nonfinite: jax.Array, before: Offender) -> Offender:
    """The newest of the offenders ``[N, ...]`` of a rollout, the first of those of one step; else the one before."""
    when = jnp.where(nonfinite, jnp.arange(1, len(nonfinite) + 1)[:, None], 0).max(0)
    last = jnp.argmax(when)
    return jax.tree.map(lambda new, old: jnp.where(when.any(), new[last], old), offenders, before)


def _finite(sim: physics.PhysicsState) -> jax.Array:
    """Whether each environment's state is finite and has not blown up, ``[N]`` bool."""
    # One comparison for all columns. It is false for NaN, and for infinity where the limit is infinity.
    limit = np.concatenate([np.full(x.shape[-1], most, np.float32) for x, most in zip(sim, _LIMITS, strict=True)])
    return (jnp.abs(jnp.concatenate(sim, axis=-1)) < limit).all(-1)
