"""How well a policy obeys commanded velocities: constant ones over a grid, and ones that change under way."""

import dataclasses
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import frozen, jsons, metrics, tables
from fmpjax.commands import velocity
from fmpjax.frames import FrameLayout
from fmpjax.ppo import PPOState
from fmpjax.style import StyleDistance
from fmpjax.trainer import Trainer

SPEEDS, TURNS = 7, 9  # cells of the grid ahead and turning
SIDES = 5  # cells to the sides, where any are commanded
ASIDE = 0.1  # m/s, extent to the sides below which none are: a walk drifts by some hundredths
CONSTANT = 10.0  # s, of an episode under one command
SETTLING = 2.0  # s at its start that do not count
LEG, LEGS = 3.0, 7  # s under each of an episode's changing commands, and their number
FOLLOWING = 1.0  # s at the start of each that do not count
NEAR = 0.02  # m/s and rad/s summed over the three, by which starts may be further from a command than the nearest
STARTS = 25  # samples of the demonstrations, at least, from which the starts under a command are drawn
ZERO = 0.1  # share of the changing commands that are zero


class Cell(NamedTuple):
    """Episodes under one constant command."""

    ahead: float  # m/s
    turn: float  # rad/s, to the left
    episodes: int
    falls: int
    speed: float  # m/s ahead, mean of the episodes that stayed up
    turned: float  # rad/s
    speed_error: float  # m/s, mean of the absolute errors of the episodes' mean speeds
    turn_error: float  # rad/s, the same of the turning
    drift: float  # m/s to the left of what is commanded, mean of absolute values
    sideways: float = 0.0  # m/s to the left, commanded
    style: float = float("nan")  # distance from the demonstrations, mean of the episodes that stayed up


@dataclasses.dataclass(frozen=True)
class Steering:
    """The figures of a policy's obedience. Errors are absolute ones of means over an episode or a leg, averaged."""

    cells: tuple[Cell, ...]
    speed_error: float  # m/s, mean over the cells
    turn_error: float  # rad/s
    episodes: int  # under constant commands
    falls: int
    sideways_error: float  # m/s, mean over the commands to the sides; NaN without any
    straight_turn: float  # rad/s, mean of the absolute turning where the command is straight ahead
    standing_speed: float  # m/s, mean speed over the floor where the command is zero
    changing_episodes: int
    changing_falls: int
    changing_speed_error: float  # m/s
    changing_turn_error: float  # rad/s
    changing_sideways_error: float  # m/s
    seconds: float = CONSTANT  # of an episode under a constant command
    changing_seconds: float = LEG * LEGS
    style: float = float("nan")  # distance from the nearest window of the demonstrations, mean over the cells
    changing_style: float = float("nan")  # the same of all episodes under changing commands, up to a fall

    def to_json(self) -> str:
        """All figures; what is not defined is null."""
        return jsons.dumps(vars(self) | {"cells": [cell._asdict() for cell in self.cells]})


def measure(trainer: Trainer, state: PPOState, *, episodes: int = 256, each: int = 4, seed: int = 1) -> Steering:
    """Play the deterministic policy under commands and measure how it obeys.

    Args:
      trainer: of a run whose command is a velocity.
      state: of the policy.
      episodes: under commands that change.
      each: episodes under each constant command, from different states of the nearest demonstration.
      seed: of starts and changing commands.

    Raises:
      UserError: the run's command is no velocity.
    """
    config, library = trainer.config.command, trainer.env.library
    config.require("velocity")
    rng, rate = np.random.default_rng(seed), trainer.config.control_rate
    low, high = velocity.extent(config, library)
    grid = _grid(low, high)
    told = np.repeat(grid, each, axis=0)[None]
    steps = round(CONSTANT * rate)
    played = play(trainer, state, np.repeat(told, steps, axis=0), rng)
    distance, settled = StyleDistance(trainer), round(SETTLING * rate)
    style = distance(played.frames[settled:], played.alive[settled:])
    reached = np.where(played.fell[:, None], np.nan, played.velocity[settled:].mean(0))
    by_cell = len(grid), each
    cells = _cells(grid, reached.reshape(*by_cell, 3), played.fell.reshape(by_cell), style.reshape(by_cell))
    plane, aside = cells[: SPEEDS * TURNS], cells[SPEEDS * TURNS :]
    straight = [cell for cell in plane if cell.turn == 0 and cell.ahead > 0]
    still = np.flatnonzero((grid == 0).all(1))
    place = played.qpos[..., :2]
    way = np.linalg.norm(place[-1] - place[settled], axis=-1) / (CONSTANT - SETTLING)
    way = np.where(played.fell, np.nan, way).reshape(by_cell)

    legs = rng.uniform(low, high, (LEGS, episodes, 3))
    legs[rng.uniform(size=(LEGS, episodes)) < ZERO] = 0.0
    length = round(LEG * rate)
    moved = play(trainer, state, np.repeat(legs, length, axis=0), rng)
    means = moved.velocity.reshape(LEGS, length, episodes, 3)[:, round(FOLLOWING * rate) :].mean(1)
    off = np.abs(means - legs)[moved.alive.reshape(LEGS, length, episodes)[:, -1]]
    return Steering(
        cells=tuple(cells),
        speed_error=metrics.mean([cell.speed_error for cell in plane]),
        turn_error=metrics.mean([cell.turn_error for cell in plane]),
        episodes=told.shape[1],
        falls=int(played.fell.sum()),
        sideways_error=metrics.mean([cell.drift for cell in aside]),
        straight_turn=metrics.mean([abs(cell.turned) for cell in straight]),
        standing_speed=metrics.mean(way[still].ravel()),
        changing_episodes=episodes,
        changing_falls=int(moved.fell.sum()),
        changing_speed_error=metrics.mean(off[:, 0]),
        changing_turn_error=metrics.mean(off[:, 2]),
        changing_sideways_error=metrics.mean(off[:, 1]),
        style=metrics.mean([cell.style for cell in plane]),
        changing_style=metrics.mean(distance(moved.frames, moved.alive)),
    )


def _grid(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Constant commands ``[C, 3]`` within an extent: `SPEEDS` by `TURNS` ones, then those straight to the sides."""
    speeds, turns = np.linspace(low[0], high[0], SPEEDS), np.linspace(low[2], high[2], TURNS)
    for values in (speeds, turns):
        values[np.abs(values).argmin()] = 0.0  # standing and straight ahead are among them: zero is within the extent
    sides = np.linspace(low[1], high[1], SIDES) if high[1] - low[1] > ASIDE else np.array([])
    return np.array(
        [(v, 0.0, w) for v in speeds for w in turns] + [(0.0, side, 0.0) for side in sides if abs(side) > 1e-6]
    )


def beyond(trainer: Trainer) -> str | None:
    """A sentence where the commands of `measure` reach beyond the velocities of the demonstrations; else None."""
    config, library = trainer.config.command, trainer.env.library
    if config.kind != "velocity":
        return None
    return velocity.beyond(velocity.corners(*velocity.extent(config, library)), library)


class Played(NamedTuple):
    """Episodes of N environments over T steps; after a fall nothing moves."""

    velocity: np.ndarray  # [T, N, 3] in the heading frame: m/s, m/s, rad/s
    qpos: np.ndarray  # [T, N, nq]
    frames: np.ndarray  # [T, N, F] compact
    alive: np.ndarray  # [T, N] bool
    fell: np.ndarray  # [N] bool


def play(trainer: Trainer, state: PPOState, told: np.ndarray, rng: np.random.Generator) -> Played:
    """Episodes under the commands ``told [T, N, 3]``, from states whose demonstration moves most like the first.

    The policy is told them as in training, at most as fast as `CommandConfig.ramp`.
    """
    told = velocity.ramped(told, trainer.config.command.ramp, trainer.config.control_rate)
    table = np.concatenate([velocity.velocities(clip) for clip in trainer.env.library.clips])
    rows = [rng.choice(nearest_rows(table, command)) for command in told[0]]
    return Played(*map(np.asarray, _play(trainer, state, jnp.asarray(rows), jnp.asarray(told, jnp.float32))))


def nearest_rows(table: np.ndarray, command: np.ndarray) -> np.ndarray:
    """The rows of velocities ``table [R, 3]`` nearest to a command ``[3]``: all within `NEAR`, `STARTS` at least.

    A recording may have a single sample so near. Episodes that all begin there would all be the same.
    """
    distance = np.abs(table - command).sum(-1)
    last = np.sort(distance)[min(STARTS, len(table)) - 1]
    return np.flatnonzero(distance <= max(distance.min() + NEAR, last))


@partial(jax.jit, static_argnums=0)
def _play(trainer: Trainer, state: PPOState, rows: jax.Array, told: jax.Array):
    env, layout = trainer.env, FrameLayout.of(trainer.robot)
    policy, start = trainer.ppo.act(state, deterministic=True), env.undisturbed(env.start_at(rows))

    def step(carry, inputs):
        (now, alive), (command, drawn) = carry, inputs
        now = now._replace(command=now.command._replace(value=command))
        taken = frozen.step(trainer, env, policy, now, alive, drawn)
        reached = taken.now
        return (reached, taken.alive), (
            layout.heading_velocity(reached.observed.frame),
            reached.physics.qpos,
            reached.observed.frame,
            taken.alive,
        )

    drawn = env.disturbance_draws(jax.random.PRNGKey(0), len(told), len(rows))
    (_, alive), played = jax.lax.scan(step, (start, jnp.ones(len(rows), bool)), (told, drawn))
    return *played, ~alive


def _cells(grid: np.ndarray, reached: np.ndarray, fell: np.ndarray, style: np.ndarray) -> list[Cell]:
    """Figures of each command ``[C, 3]`` from mean velocities ``[C, E, 3]``, falls and style distances ``[C, E]``."""
    cells = []
    for command, means, falls, distances in zip(grid, reached, fell, style, strict=True):
        off = np.abs(means - command)
        cells.append(
            Cell(
                ahead=float(command[0]),
                turn=float(command[2]),
                episodes=len(falls),
                falls=int(falls.sum()),
                speed=metrics.mean(means[:, 0]),
                turned=metrics.mean(means[:, 2]),
                speed_error=metrics.mean(off[:, 0]),
                turn_error=metrics.mean(off[:, 2]),
                drift=metrics.mean(off[:, 1]),
                sideways=float(command[1]),
                style=metrics.mean(distances[~falls]),
            )
        )
    return cells


def table(steering: Steering) -> str:
    """The figures as lines for people."""
    s = steering
    rows = [
        ("mean error of the speed", f"{s.speed_error:.3f}", f"m/s, constant commands, {s.seconds:g} s each"),
        ("mean error of the turning", f"{s.turn_error:.3f}", "rad/s"),
        ("falls", f"{s.falls} of {s.episodes}", ""),
        ("mean error to the sides", f"{s.sideways_error:.3f}", "m/s, commands to the sides"),
        ("turning when told to go straight", f"{s.straight_turn:.3f}", "rad/s"),
        ("speed when told to stand", f"{s.standing_speed:.3f}", "m/s over the floor"),
        ("distance from the demonstrations", f"{s.style:.3f}", "standard deviations, nearest windows"),
        ("mean error of the speed", f"{s.changing_speed_error:.3f}", f"m/s, a new command every {LEG:g} s"),
        ("mean error of the turning", f"{s.changing_turn_error:.3f}", "rad/s"),
        ("mean error to the sides", f"{s.changing_sideways_error:.3f}", "m/s"),
        ("falls", f"{s.changing_falls} of {s.changing_episodes}", f"in {s.changing_seconds:g} s"),
        ("distance from the demonstrations", f"{s.changing_style:.3f}", "standard deviations"),
    ]
    aside = any(cell.sideways for cell in s.cells)
    return tables.lines("  {:<36} {:>20}  {}", [row for row in rows if aside or "sides" not in row[0]])


def maps(steering: Steering) -> tuple[list[float], list[float], dict[str, np.ndarray]]:
    """Speeds of the rows, turning rates of the columns, and maps of errors and falls by title."""
    plane = [cell for cell in steering.cells if not cell.sideways]
    speeds, turns = (sorted({getattr(cell, name) for cell in plane}) for name in ("ahead", "turn"))
    shape = len(speeds), len(turns)
    titles = {
        "speed_error": "mean error of the speed, m/s",
        "turn_error": "mean error of the turning, rad/s",
        "falls": f"falls of {plane[0].episodes} episodes",
        "style": "distance from the demonstrations",
    }
    values = {t: np.array([getattr(cell, n) for cell in plane], float).reshape(shape) for n, t in titles.items()}
    return speeds, turns, values
