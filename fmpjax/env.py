"""Parallel environments: resets, falls, time-outs, and the frames that the prior's windows are made of.

Windows are kept as indices. A rollout stores one compact frame a step; a window is H indices into the table
``[demonstration frames | default-pose frame | frames before the rollout | frames of the rollout]``. After a reset the
indices point at the demonstration's own preceding frames, or repeat the default pose, so a history is right by
construction.
"""

# long: the step and the rollout share their state, and are read together

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import commands, disturbances, features, offenders, physics, sharding
from fmpjax.acting import ActionRule, Seen, of_actor
from fmpjax.actions import ActionMap, action_map
from fmpjax.config import Config, DisturbanceConfig
from fmpjax.errors import UserError
from fmpjax.features import Observed
from fmpjax.motion import MotionClip, MotionLibrary
from fmpjax.motion.clip import refined
from fmpjax.offenders import Offender
from fmpjax.robots import Robot

# Of the demonstrations, from which a prior learns: 22 minutes at 50 Hz, 0.3 GB. Of more, an even part represents all.
MOST_WINDOWS = 1 << 16

# Fields of `EnvState` with a leading axis of environments.
PER_ENVIRONMENT = ("physics", "observed", "history", "age", "command", "disturbed")

__all__ = ["ActionMap", "Drawn", "Env", "EnvState", "Moment", "Steps", "action_map", "window_count"]


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
    disturbed: Any = ()  # each environment's `disturbances.State`; nothing without disturbances


class Moment(NamedTuple):
    """N environments between two control steps of a rollout."""

    physics: physics.PhysicsState
    observed: Observed  # of the present state
    age: jax.Array  # [N] int32, steps since the reset
    window: jax.Array  # [N, H] int32, frame table's rows of the frames up to the present one, oldest first
    offender: Offender  # each environment's own in this rollout, [N, ...]
    command: Any = ()  # each environment's
    disturbed: Any = ()  # each environment's


class Drawn(NamedTuple):
    """What a step needs beside the action. A rollout draws it for all of its steps at once."""

    row: jax.Array  # [N] int32, frame table's rows of the frames after the step
    start: jax.Array  # [N] int32, frame table's rows of the states at which new episodes begin
    window: jax.Array  # [N, H] int32, frame table's rows of the histories up to there
    key: jax.Array  # of the noise on those states
    command: Any = ()  # random numbers of the commands
    disturbed: Any = ()  # random numbers of the disturbances


class Reached(NamedTuple):
    """What the physics of one control step reaches; the state before it where that is not finite."""

    physics: physics.PhysicsState
    observed: Observed
    fell: jax.Array  # [N] bool, or not finite
    finite: jax.Array  # [N] bool
    disturbed: Any = ()  # the disturbances after the step


class Steps(NamedTuple):
    """A rollout: T steps of N environments."""

    observation: Any  # [T, N, O] before the action; `Seen` with disturbances
    next_observation: jax.Array  # [T, N, O] after it, before any reset: the true one, with disturbances the critic's
    action: jax.Array  # [T, N, J] normalized
    extras: dict[str, jax.Array]  # what the policy said of the action, each [T, N, ...]
    fell: jax.Array  # [T, N] bool
    timed_out: jax.Array  # [T, N] bool; a fall on the same step is a fall
    nonfinite: jax.Array  # [T, N] bool; learning counts it as a fall
    length: jax.Array  # [T, N] int32, steps of the episode up to and including this one
    frame: jax.Array  # [T, N, F] compact frame after the step, before any reset
    window: jax.Array  # [T, N, H] int32 indices into the frame table
    obeyed: Any = ()  # [T, N] in [0, 1], what obeying the command earned; nothing without commands
    wanted: Any = ()  # [T, N] int32 indices into the frame table, where the command names the frame to reach
    label: Any = ()  # [T, N] int32 indices of the demonstrations, where the command names one


def window_count(library: MotionLibrary, config: Config) -> int:
    """W, the windows of `Env.clip_windows`, before there are any."""
    parts = config.env.demonstration_parts
    lengths = (library.lengths - 1) * parts + 1 - _rows_before(config)
    return int((-(-lengths // max(1, -(-lengths.sum() // MOST_WINDOWS)))).sum())


def _rows_before(config: Config) -> int:
    """Rows of its clip that a row needs ahead of it to end a window."""
    return 0 if config.env.early_frames else (config.features.history - 1) * config.env.demonstration_parts


class Env:
    """Parallel environments of one robot with its demonstrations. All methods are pure functions."""

    def __init__(self, robot: Robot, motion: MotionClip | MotionLibrary, config: Config, backend: physics.Physics):
        self.robot, self.config, self.physics = robot, config.env, backend
        self.horizon = config.features.history
        library = MotionLibrary.of(motion)
        self.actions = action_map(robot, library, config.env.action)
        self.form, true_form = features.observation_form(config), features.true_form(config)
        observe = jax.jit(lambda qpos, qvel: features.observe(robot, qpos, qvel, true_form))
        self._observe = observe
        # A row stands `stride` rows after the frame before it.
        self.stride = config.env.demonstration_parts
        self.library = library = dataclasses.replace(
            library, clips=tuple(refined(clip, self.stride) for clip in library.clips)
        )
        # The first row of a clip at which an episode may begin: a window needs rows ahead of it.
        self.first_row = _rows_before(config)
        # Rows 0..M-1 are the demonstrations, row M the default pose; resets gather from here.
        self._qpos = np.concatenate([library.qpos, robot.default_qpos[None]]).astype(np.float32)
        self._qvel = np.concatenate([library.qvel, np.zeros_like(library.qvel[:1])]).astype(np.float32)
        self._table = jax.tree.map(np.asarray, observe(jnp.asarray(self._qpos), jnp.asarray(self._qvel)))
        self.clip_rows = len(library.qpos)
        self.command = commands.make(config, robot, library, self._table.frame)
        told = jax.eval_shape(lambda: self._told(self.first_command(jnp.arange(1))))
        self.disturbances = disturbances.make(config, robot, self.actions, told.shape[-1] if self.command else 0)
        if config.disturbance.step_height and not getattr(backend, "uneven", False):
            raise UserError(
                f"setting disturbance.step_height is {config.disturbance.step_height:g} and the physics has even "
                "ground: expected physics that was made with uneven=True"
            )

    @property
    def observation_size(self) -> Any:
        """Numbers that the networks observe; `Seen` where the critic sees more than the actor."""
        return jax.tree.map(lambda x: x.shape[-1], jax.eval_shape(lambda: self.clip_observations))

    @property
    def clip_observations(self) -> Any:
        """What the networks observe of the demonstrations, ``[M, O]``."""
        rows = jnp.arange(self.clip_rows)
        if not self.disturbances:
            return self.seen(jnp.asarray(self._table.actor)[rows], self.first_command(rows))
        begun, key = self.start_at(rows), jax.random.PRNGKey(0)
        disturbed = self.disturbances.standing(begun.disturbed, begun.physics.qpos)
        return self.look(begun._replace(disturbed=disturbed), self.disturbances.draw(key, (len(rows),)))[1]

    def look(self, now: Any, drawn: jax.Array) -> tuple[Any, Any]:
        """The environments, an `EnvState` or a `Moment`, after their sensors were read, and what the networks observe.

        ``drawn`` are random numbers of the disturbances, and nothing without those.
        """
        if not self.disturbances:
            return now, self.seen(now.observed.actor, now.command)
        actor, disturbed = self.disturbances.sense(now.disturbed, now.physics, self._told(now.command), drawn)
        critic = self._revealed(now.observed.actor, now.command, disturbed)
        return now._replace(disturbed=disturbed), Seen(actor, critic)

    def seen(self, actor: jax.Array, command: Any) -> jax.Array:
        """What the networks observe without disturbances, ``[..., O]``: the robot, and the command if there is one."""
        return jnp.concatenate([actor, self._told(command, whole=True)], axis=-1) if self.command else actor

    def _told(self, command: Any, whole: bool = False) -> Any:
        """What networks see of the command, ``[..., C]``; the ``whole`` also where the actor is deployable."""
        if not self.command:
            return ()
        told = self.command.observe(command)
        if self.command.reveal is None or not (whole or self.config.observation != "deployable"):
            return told
        return jnp.concatenate([told, self.command.reveal(command)], axis=-1)

    def _revealed(self, actor: jax.Array, command: Any, disturbed: disturbances.State) -> jax.Array:
        """What a critic sees with disturbances, ``[N, C]``: all that is true."""
        assert self.disturbances is not None
        return jnp.concatenate([self.seen(actor, command), self.disturbances.reveal(disturbed)], axis=-1)

    def first_command(self, rows: jax.Array, key: jax.Array | None = None) -> Any:
        """Commands of episodes that begin at the table rows ``[N]``."""
        if not self.command:
            return ()
        return self.command.begin(rows, self.command.draw(jax.random.PRNGKey(0) if key is None else key, rows.shape))

    @property
    def clip_frames(self) -> jax.Array:
        """Compact frames of the demonstrations' rows, ``[M, F]``."""
        return jnp.asarray(self._table.frame)[: self.clip_rows]

    def clip_windows(self) -> jax.Array:
        """The demonstrations' windows of compact frames, ``[W, H, F]``: all of them, or about `MOST_WINDOWS`."""
        rows = self.library.rows_after(self.first_row, MOST_WINDOWS)
        return jnp.asarray(self._table.frame)[self.history_rows(rows)]

    def window_share(self) -> np.ndarray | None:
        """How often each of those windows is drawn, ``[W]``, summing to one; None where all are alike."""
        return self.library.share_after(self.first_row, MOST_WINDOWS)

    def window_clips(self) -> np.ndarray:
        """Index of the demonstration of each of those windows, ``[W]``."""
        return self.library.clip_of(self.library.rows_after(self.first_row, MOST_WINDOWS))

    def clip_of(self, rows: np.ndarray) -> np.ndarray:
        """Index of the demonstration of each table row, 0 for the default pose."""
        return np.where(rows < self.clip_rows, self.library.clip_of(rows), 0)

    def reset_rows(self, key: jax.Array, count: int) -> jax.Array:
        """Table rows ``[count]`` at which episodes start under the configured regime."""
        if self.config.reset == "fixed":
            return jnp.full((count,), self.clip_rows)
        if len(self.library.clips) == 1:
            return jax.random.randint(key, (count,), self.first_row, self.clip_rows)
        starts, lengths = self.library.starts, self.library.lengths
        weights = jnp.asarray(self.library.weights)
        clip = jax.random.choice(jax.random.fold_in(key, 1), len(starts), (count,), p=weights)
        first, end = jnp.asarray(starts + self.first_row), jnp.asarray(starts + lengths)
        return jax.random.randint(key, (count,), first[clip], end[clip])

    def history_rows(self, rows: jax.Array | np.ndarray) -> jax.Array:
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
        size = self.config.reset_noise if noise is None else noise[:, None]
        if key is None or (isinstance(size, float) and not size):
            return physics.reset(qpos, qvel), jax.tree.map(lambda table: jnp.asarray(table)[rows], self._table)
        angle, velocity = size * jax.random.normal(key, (2, len(rows), self.robot.joint_count))
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
            disturbed=self._first_disturbances(jax.random.PRNGKey(0) if key is None else key, len(rows)),
        )

    def _first_disturbances(self, key: jax.Array, count: int) -> Any:
        return self.disturbances.init(jax.random.fold_in(key, 4), count) if self.disturbances else ()

    def undisturbed(self, state: EnvState) -> EnvState:
        """Environments whose episodes begin, with the disturbances that there may be at zero."""
        if not self.disturbances:
            return state
        calm = self.disturbances.init(jax.random.PRNGKey(0), len(state.age), DisturbanceConfig())
        return state._replace(disturbed=calm)

    def reset(self, key: jax.Array) -> EnvState:
        """All environments at fresh resets."""
        return self.start_at(self.reset_rows(key, self.config.count), jax.random.fold_in(key, 2))

    def rollout(self, state: EnvState, policy: ActionRule, key: jax.Array, steps: int) -> tuple[EnvState, Steps]:
        """Play ``steps`` control steps under a policy; environments reset at once after a fall or a time-out."""
        count = len(state.age)
        before = self.clip_rows + 1  # rows ahead of the frames before the rollout
        during = before + count * self.horizon  # rows ahead of the rollout's own frames

        def play(now: Moment, inputs) -> tuple[Moment, Steps]:
            noise, drawn = inputs
            now, seen = self.look(now, drawn.disturbed)
            action, extras = policy.act(of_actor(seen), noise)
            now, record = self.step(now, action, drawn, state.cap)
            return now, record._replace(observation=seen, extras=extras)

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
            disturbed=self.disturbance_draws(key, steps, count),
        )
        window = before + jnp.arange(count * self.horizon).reshape(count, self.horizon)
        offender = jax.tree.map(lambda x: jnp.zeros((count, *x.shape), x.dtype), state.offender)
        now = Moment(state.physics, state.observed, state.age, window, offender, state.command, state.disturbed)
        now, record = jax.lax.scan(play, now, (noise, drawn))
        new_state = state._replace(
            physics=now.physics,
            observed=now.observed,
            history=self.frame_table(state, record)[now.window],
            age=now.age,
            command=now.command,
            disturbed=now.disturbed,
            offender=offenders.last_offender(now.offender, record.nonfinite, state.offender),
        )
        return self._grow_cap(new_state, record), record

    def step(self, now: Moment, action: jax.Array, drawn: Drawn, cap: jax.Array) -> tuple[Moment, Steps]:
        """One control step; environments whose episode is over reset.

        Args:
          now: the environments before the step.
          action: ``[N, J]`` normalized.
          drawn: what the step needs beside the action.
          cap: scalar, steps at which an episode times out.

        Returns:
          The environments before the next step, and the record of this one, each field ``[N, ...]``, with no extras.
          Its observation is that of a robot without disturbances.
        """
        reached = self.advance(now.physics, action, now.disturbed, drawn.disturbed)
        age = now.age + 1
        timed_out = (age >= cap) & ~reached.fell
        command, obeyed, wanted, label = (), (), (), ()
        if self.command:
            wanted = self.command.wanted(now.command) if self.command.wanted else ()
            label = self.command.label(now.command) if self.command.label else ()
            command, over, obeyed = self.command.advance(now.command, drawn.command, reached.observed.frame)
            timed_out |= over & ~reached.fell
        window = sharding.split(jnp.concatenate([now.window[:, 1:], drawn.row[:, None]], axis=1))
        following = self.seen(reached.observed.actor, command)
        if self.disturbances:
            following = self._revealed(reached.observed.actor, command, reached.disturbed)
        record = Steps(
            observation=self.seen(now.observed.actor, now.command),
            next_observation=following,
            action=action,
            extras={},
            fell=reached.fell,
            timed_out=timed_out,
            nonfinite=~reached.finite,
            length=age,
            frame=reached.observed.frame,
            window=window,
            obeyed=obeyed,
            wanted=wanted,
            label=label,
        )
        done = reached.fell | timed_out
        sim, observed = self._begin(drawn.start, drawn.key)
        fresh = self.command.begin(drawn.start, drawn.command) if self.command else ()
        begun = sim, observed, jnp.zeros_like(age), drawn.window, fresh
        after = reached.physics, reached.observed, age, window, command
        *kept, command = jax.tree.map(lambda new, old: jnp.where(_over(done, old), new, old), begun, after)
        disturbed = self._again(reached.disturbed, done, drawn.disturbed)
        offender = offenders.offender(now.physics, action, reached.finite, now.offender)
        return Moment(*kept, offender=offender, command=command, disturbed=disturbed), record

    def _again(self, disturbed: Any, done: jax.Array, drawn: Any) -> Any:
        """The disturbances, those of an episode begun again where one is ``done [N]``."""
        if not self.disturbances:
            return disturbed
        fresh = self.disturbances.begin(disturbed.sizes, drawn)
        episode = jax.tree.map(lambda new, old: jnp.where(_over(done, old), new, old), fresh, disturbed.episode)
        return disturbed._replace(episode=episode)

    def disturbance_draws(self, key: jax.Array, steps: int, count: int) -> Any:
        """Random numbers of the disturbances of ``count`` environments in ``steps`` steps; nothing without those."""
        return self.disturbances.draw(jax.random.fold_in(key, 4), (steps, count)) if self.disturbances else ()

    def _command_draws(self, keys: jax.Array, count: int) -> Any:
        """Random numbers of the commands of all steps, which have a key each."""
        if not (command := self.command):
            return ()
        return jax.vmap(lambda key: command.draw(jax.random.fold_in(key, 3), (count,)))(keys)

    def advance(self, sim: physics.PhysicsState, action: jax.Array, disturbed: Any = (), drawn: Any = ()) -> Reached:
        """The physics of one control step under normalized actions ``[N, J]``, whatever the episodes.

        With disturbances it takes their state and random numbers, too.
        """
        arguments: tuple[Any, ...] = sim, self.actions(action)
        if self.disturbances:
            arguments, disturbed = self.disturbances.act(disturbed, sim, action, drawn)
        reached = sharding.per_device(self.physics.step)(*arguments)
        finite = offenders.finite(reached)
        # Non-finite numbers must not reach the observation, not even to be discarded: the state before stays.
        sim = jax.tree.map(lambda new, old: jnp.where(finite[:, None], new, old), reached, sim)
        observed = self._observe(sim.qpos, sim.qvel)
        return Reached(sim, observed, observed.fallen | ~finite, finite, disturbed)

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
        state = state._replace(cap=cap, capped_share=share, cap_age=jnp.where(grow, 0, cap_age))
        if not self.disturbances:
            return state
        return state._replace(disturbed=self.disturbances.grow(state.disturbed, share, config.cap_share))


def _over(chosen: jax.Array, values: jax.Array) -> jax.Array:
    """``chosen [N]`` with as many axes as ``values [N, ...]``."""
    return chosen.reshape(-1, *[1] * (values.ndim - 1))
