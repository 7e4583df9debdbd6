"""How well a policy performs the motion that it is told: one in a whole episode, or another every few seconds."""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import frozen, jsons, metrics, tables
from fmpjax.ppo import PPOState
from fmpjax.trainer import Trainer

CONSTANT = 10.0  # s, of an episode that is told one motion
LEG, LEGS = 3.0, 7  # s of each of an episode's changing motions, and their number
SETTLING = 1.0  # s after each command that do not count


@dataclasses.dataclass(frozen=True)
class Performing:
    """Figures of episodes. A robot performs the motion to whose frames its posture is nearest, over half a second."""

    motions: tuple[str, ...]
    performed: tuple[tuple[float, ...], ...]  # [told][performed] share of the time; NaN where no episode stands so long
    correct: float  # mean share of the time in which the robot performs what it is told
    episodes: int  # told one motion
    falls: int
    motion_falls: tuple[int, ...]  # of the episodes that are told each motion
    changing_episodes: int
    changing_falls: int
    changing_correct: float
    seconds: float = CONSTANT
    changing_seconds: float = LEG * LEGS

    def to_json(self) -> str:
        """All figures; what is not defined is null."""
        return jsons.dumps(vars(self))


class Played(NamedTuple):
    """N episodes of T steps; after a fall nothing moves."""

    nearest: np.ndarray  # [T, N] int, the motion that is performed
    alive: np.ndarray  # [T, N] bool
    fell: np.ndarray  # [N] bool


def measure(trainer: Trainer, state: PPOState, *, episodes: int = 256, each: int = 32, seed: int = 1) -> Performing:
    """Play the deterministic policy and measure what it performs.

    Args:
      trainer: of a run whose command is a motion.
      state: of the policy.
      episodes: that are told another motion, drawn evenly, every `LEG` seconds.
      each: episodes that are told each motion throughout.
      seed: of starts and changing motions.

    Raises:
      UserError: the run's command is no motion.
    """
    trainer.config.command.require("motion")
    rng, rate = np.random.default_rng(seed), trainer.config.control_rate
    names = tuple(clip.name for clip in trainer.env.library.clips)
    told = np.repeat(np.arange(len(names)), each)
    steps, settling = round(CONSTANT * rate), round(SETTLING * rate)
    played = play(trainer, state, np.tile(told, (steps, 1)), rng)
    kept = played.alive[settling:]
    shares = [
        [metrics.mean((played.nearest[settling:] == j)[kept & (told == i)]) for j in range(len(names))]
        for i in range(len(names))
    ]
    legs, length = rng.integers(len(names), size=(LEGS, episodes)), round(LEG * rate)
    moved = play(trainer, state, np.repeat(legs, length, axis=0), rng)
    by_leg = LEGS, length, episodes
    right = moved.nearest.reshape(by_leg) == legs[:, None]
    return Performing(
        motions=names,
        performed=tuple(map(tuple, shares)),
        correct=metrics.mean([shares[i][i] for i in range(len(names))]),
        episodes=len(told),
        falls=int(played.fell.sum()),
        motion_falls=tuple(int(played.fell[told == i].sum()) for i in range(len(names))),
        changing_episodes=episodes,
        changing_falls=int(moved.fell.sum()),
        changing_correct=metrics.mean(right[:, settling:][moved.alive.reshape(by_leg)[:, settling:]]),
    )


def play(trainer: Trainer, state: PPOState, told: np.ndarray, rng: np.random.Generator) -> Played:
    """Episodes that are told the motions ``told [T, N]``, from random states of the first."""
    env = trainer.env
    first, last = env.library.starts + env.first_row, env.library.starts + env.library.lengths - 1
    rows = rng.integers(first[told[0]], last[told[0]] + 1)
    return Played(*map(np.asarray, _play(trainer, state, jnp.asarray(rows), jnp.asarray(told, jnp.int32))))


@partial(jax.jit, static_argnums=0)
def _play(trainer: Trainer, state: PPOState, rows: jax.Array, told: jax.Array):
    env = trainer.env
    policy, start = trainer.ppo.act(state, deterministic=True), env.undisturbed(env.start_at(rows))

    def step(carry, inputs):
        (now, alive), (motion, drawn) = carry, inputs
        taken = frozen.step(trainer, env, policy, now._replace(command=now.command._replace(clip=motion)), alive, drawn)
        return (taken.now, taken.alive), (taken.now.command.distance.argmin(-1), taken.alive)

    drawn = env.disturbance_draws(jax.random.PRNGKey(0), len(told), len(rows))
    (_, alive), played = jax.lax.scan(step, (start, jnp.ones(len(rows), bool)), (told, drawn))
    return *played, ~alive


def table(performing: Performing) -> str:
    """The figures as lines for people."""
    p = performing
    each = p.episodes // len(p.motions)
    rows = [
        ("performs the motion that it is told", f"{100 * p.correct:.0f} %", f"of the time, {p.seconds:g} s each"),
        *(
            (f"  {name}", f"{100 * p.performed[i][i]:.0f} %", f"of the time, {p.motion_falls[i]} falls of {each}")
            for i, name in enumerate(p.motions)
        ),
        ("falls", f"{p.falls} of {p.episodes}", ""),
        ("performs it, another every 3 s", f"{100 * p.changing_correct:.0f} %", f"of the time after {SETTLING:g} s"),
        ("falls", f"{p.changing_falls} of {p.changing_episodes}", f"in {p.changing_seconds:g} s"),
    ]
    return tables.lines("  {:<36} {:>20}  {}", rows)
