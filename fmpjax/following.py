"""How well a policy that is told the time in the clip follows it, from any time on to the clip's end."""

import dataclasses
import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import features, frozen, jsons, metrics, tables
from fmpjax.frames import FrameLayout
from fmpjax.ppo import PPOState
from fmpjax.trainer import Trainer

PARTS = 20  # of the clip, in which figures are taken apart
LEAST = 1.0  # s before the clip's end at which the last episode begins


@dataclasses.dataclass(frozen=True)
class Following:
    """Figures of episodes that begin at evenly spaced times of the clip. Errors are means over the steps played."""

    episodes: int
    finished: int  # reach the clip's end without a fall
    joint_error: float  # rad, mean of absolute values over the joints
    key_point_error: float  # m, of the key points relative to the root, each in its own heading
    height_error: float  # m, of the root, absolute
    root_error: float  # m, distance of the root from where the clip is, which began at the same place
    excursion: float  # the leg joints' ranges over those of the clip in the same second; of episodes that finish
    seconds: float  # length of the clip
    part_joint_error: tuple[float, ...]  # rad, in each of `PARTS` equal parts of the clip
    part_falls: tuple[int, ...]  # falls in that part
    part_finished: tuple[float, ...]  # share of the episodes begun in that part that finish; NaN where none begins

    def to_json(self) -> str:
        """All figures; what is not defined is null."""
        return jsons.dumps(vars(self))


class Played(NamedTuple):
    """N episodes of at most T steps, and the clip at the same times."""

    qpos: np.ndarray  # [T, N, nq] reached
    wanted: np.ndarray  # [T, N, nq] of the clip
    points: np.ndarray  # [T, N, K, 3] m, key points less the root, in the heading frame
    wanted_points: np.ndarray  # [T, N, K, 3]
    share: np.ndarray  # [T, N] of the clip that is over after the step
    counts: np.ndarray  # [T, N] bool, steps that were played
    fell: np.ndarray  # [N] bool


def measure(trainer: Trainer, state: PPOState, *, episodes: int = 128) -> Following:
    """Play the deterministic policy from evenly spaced times of the clip to its end, and compare.

    Args:
      trainer: of a run whose command is a phase.
      state: of the policy.
      episodes: their number.

    Raises:
      UserError: the run's command is no phase.
    """
    trainer.config.command.require("phase")
    env, rate = trainer.env, trainer.config.control_rate
    last = env.clip_rows - 1
    latest = max(env.first_row, last - round(LEAST * rate) * env.stride)
    rows = np.linspace(env.first_row, latest, episodes).round().astype(np.int32)
    steps = math.ceil((last - rows.min()) / env.stride)
    qpos, points, reached, counts, fell = map(np.asarray, _play(trainer, state, jnp.asarray(rows), steps))
    wanted_points = np.asarray(_points(trainer, env.clip_frames))[reached]
    played = Played(qpos, env.library.qpos[reached], points, wanted_points, reached / last, counts, fell)
    return figures(played, rows / last, trainer.robot.sagittal_joints, rate, last / env.stride / rate)


@partial(jax.jit, static_argnums=(0, 3))
def _play(trainer: Trainer, state: PPOState, rows: jax.Array, steps: int):
    env = trainer.env
    policy, start = trainer.ppo.act(state, deterministic=True), env.undisturbed(env.start_at(rows))

    def step(carry, drawn):
        now, alive, fell = carry
        taken = frozen.step(trainer, env, policy, now, alive, drawn)
        reached = taken.now
        again = reached.command < now.command  # a clip that loops has ended, and is compared no further
        row = jnp.where(again, env.clip_rows - 1, reached.command)
        record = reached.physics.qpos, _points(trainer, reached.observed.frame), row, alive
        return (reached, taken.alive & ~again, fell | taken.fell), record

    drawn = env.disturbance_draws(jax.random.PRNGKey(0), steps, len(rows))
    alive = jnp.ones(len(rows), bool)
    (_, _, fell), played = jax.lax.scan(step, (start, alive, ~alive), drawn, length=steps)
    return *played, fell


def _points(trainer: Trainer, frame: jax.Array) -> jax.Array:
    """Key points less the root of frames ``[..., F]``, in their own heading: ``[..., K, 3]`` m."""
    points = features.in_own_heading(trainer.robot, frame)[..., FrameLayout.of(trainer.robot).key_points]
    return points.reshape(*points.shape[:-1], -1, 3)


def figures(played: Played, begun: np.ndarray, joints: np.ndarray, rate: float, seconds: float) -> Following:
    """The figures of played episodes.

    Args:
      played: the episodes.
      begun: ``[N]`` share of the clip at which each begins.
      joints: ``[6]`` indices of the sagittal leg joints.
      rate: control steps per second, Hz.
      seconds: length of the clip.
    """
    counts, finished = played.counts, ~played.fell
    off = np.abs(played.qpos[..., 7:] - played.wanted[..., 7:]).mean(-1)
    root = played.qpos[..., :3] - played.wanted[..., :3]
    part = np.minimum((played.share * PARTS).astype(int), PARTS - 1)
    own = np.minimum((begun * PARTS).astype(int), PARTS - 1)
    length = counts.sum(0)
    ended = part[np.maximum(length - 1, 0), np.arange(len(length))]
    return Following(
        episodes=len(finished),
        finished=int(finished.sum()),
        joint_error=metrics.mean(off[counts]),
        key_point_error=metrics.mean(np.linalg.norm(played.points - played.wanted_points, axis=-1).mean(-1)[counts]),
        height_error=metrics.mean(np.abs(root[..., 2])[counts]),
        root_error=metrics.mean(np.linalg.norm(root, axis=-1)[counts]),
        excursion=_excursion(played, length * finished, joints, rate),
        seconds=seconds,
        part_joint_error=tuple(metrics.mean(off[counts & (part == i)]) for i in range(PARTS)),
        part_falls=tuple(int((played.fell & (ended == i)).sum()) for i in range(PARTS)),
        part_finished=tuple(metrics.mean(finished[own == i]) for i in range(PARTS)),
    )


def _excursion(played: Played, length: np.ndarray, joints: np.ndarray, rate: float) -> float:
    """Mean range of the joints in windows of a second, over that of the clip in the same windows."""
    policy, clip = (
        metrics.window_ranges(angles[..., 7:], length, joints, rate=rate) for angles in (played.qpos, played.wanted)
    )
    known = np.isfinite(policy)
    return float(policy[known].sum() / clip[known].sum()) if known.any() and clip[known].sum() > 0 else float("nan")


def table(following: Following) -> str:
    """The figures as lines for people."""
    f = following
    rows = [
        ("reach the clip's end", f"{f.finished} of {f.episodes}", f"begun all over its {f.seconds:.1f} s"),
        ("error of the joints", f"{f.joint_error:.3f}", "rad, mean of absolute values"),
        ("error of the key points", f"{f.key_point_error:.3f}", "m, relative to the root, in its heading"),
        ("error of the root's height", f"{f.height_error:.3f}", "m"),
        ("distance from the clip's place", f"{f.root_error:.2f}", "m; the policy does not know its place"),
        ("excursion", f"{f.excursion:.2f}", "of the clip's in the same seconds"),
    ]
    return tables.lines("  {:<36} {:>20}  {}", rows)


def curves(following: Following) -> dict[str, tuple[float, ...]]:
    """What changes along the clip, by title: a value for each of `PARTS` equal parts."""
    return {
        "error of the joints, rad": following.part_joint_error,
        "falls in this part": tuple(map(float, following.part_falls)),
        "share of the episodes begun here that reach the end": following.part_finished,
    }
