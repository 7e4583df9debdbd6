"""How well a policy stays up: its falls, speed and excursion under each disturbance alone, and under all together."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import frozen, jsons, metrics, physics, rotations, tables
from fmpjax.config import Config, DisturbanceConfig
from fmpjax.env import Env, EnvState
from fmpjax.errors import UserError
from fmpjax.evaluate import episodes_of, planar_speed
from fmpjax.ppo import PPOState
from fmpjax.pushes import Side, by_side, pushes_of, sides_text
from fmpjax.trainer import Trainer

EPISODES = 256  # per cell
SEED = 1  # of starts and disturbances
EVERY = 2.0  # s between two pushes where pushes are alone
Z = 1.959964  # standard deviations on either side of a 95 % interval

# What peers set for the G1; docs/robustness.md.
NOISE: dict[str, Any] = {"turn_noise": 0.2, "tilt_noise": 0.05, "angle_noise": 0.01, "velocity_noise": 1.5}
SPIN: dict[str, Any] = {"push_lift": 0.4, "push_tilt": 0.52, "push_turn": 0.78}
# mjlab draws a push of up to 0.5 m/s on each axis: 0.38 m/s on average, 0.71 m/s at most, as here in any direction.
MJLAB = DisturbanceConfig(
    friction=(0.3, 1.2),
    torso_center=(0.025, 0.025, 0.03),
    encoder_bias=0.015,
    push_interval=(1.0, 3.0),
    push_speed=(0.05, 0.71),
    **SPIN,
    **NOISE,
)


class Case(NamedTuple):
    """What episodes are played under."""

    disturbance: str
    size: str  # with its unit
    config: DisturbanceConfig


class Cell(NamedTuple):
    """First episodes under one disturbance."""

    disturbance: str
    size: str
    episodes: int
    falls: int
    low: float  # share of falls, lower end of its 95 % interval (Wilson's)
    high: float
    seconds: float  # mean length of an episode
    speed: float  # m/s along the own heading, late; of the episodes that last so long
    speed_n: int  # episodes behind it
    excursion: float  # of the demonstrations'
    excursion_n: int
    sides: tuple[Side, ...] = ()  # where it is pushed: the pushes to each side, and the falls after them


@dataclasses.dataclass(frozen=True)
class Robustness:
    """A policy's figures, case by case."""

    cells: tuple[Cell, ...]
    seconds: float  # of an episode without a fall
    demonstration_speed: float  # m/s

    def to_json(self) -> str:
        """All figures; what is not defined is null."""
        cells = [cell._asdict() | {"sides": [side._asdict() for side in cell.sides]} for cell in self.cells]
        return jsons.dumps(vars(self) | {"cells": cells})


def cases(config: Config) -> list[Case]:
    """The cases under which a run's policy is tried: none, each disturbance alone at three sizes, and all together."""
    substeps, step = config.physics.substeps, 1e3 * config.physics.timestep
    alone: dict[str, list[tuple[str, dict[str, Any]]]] = {
        "push": [(f"{v:g} m/s", {"push_speed": (v, v)}) for v in (0.25, 0.5, 1.0)],
        "push, turning": [
            (f"{x:g} x mjlab", {"push_speed": (0.0, 0.0)} | {name: x * most for name, most in SPIN.items()})
            for x in (1, 2, 3)
        ],
        "delay": [
            (f"{k * step:g} ms", {"delay": (k, k)})
            for k in dict.fromkeys((max(1, substeps // 2), substeps, 2 * substeps))
        ],
        "friction": [(f"x {v:g}", {"friction": (v, v)}) for v in (0.3, 0.5, 1.5)],
        "torso mass": [(f"{v:+g} kg", {"torso_mass": (v, v)}) for v in (-2.0, 3.0, 6.0)],
        "torso center": [(f"±{1e3 * v:g} mm", {"torso_center": (v, v, v)}) for v in (0.025, 0.05, 0.1)],
        "gains": [
            (f"± {100 * v:g} %", {"stiffness": (1 - v, 1 + v), "damping": (1 - v, 1 + v)}) for v in (0.1, 0.2, 0.4)
        ],
        "motor strength": [(f"x {v:g}", {"strength": (v, v)}) for v in (0.9, 0.7, 0.5)],
        "joint friction": [(f"{v:g} N m", {"joint_friction": (v, v)}) for v in (0.2, 0.5, 1.0)],
        "armature": [(f"x {v:g}", {"armature": (v, v)}) for v in (1.05, 1.2, 1.5)],
        "encoder bias": [(f"±{v:g} rad", {"encoder_bias": v}) for v in (0.015, 0.03, 0.06)],
        "observation noise": [
            (f"{x:g} x mjlab", {name: x * most for name, most in NOISE.items()}) for x in (0.5, 1, 2)
        ],
        "slope": [(f"to {v:g} rad", {"slope": v}) for v in (0.03, 0.06, 0.12)],
        "steps": [(f"to {1e3 * v:g} mm", {"step_height": v}) for v in (0.02, 0.04, 0.08)],
    }
    every: dict[str, Any] = {"push_interval": (EVERY, EVERY)}
    found = [Case("none", "", DisturbanceConfig())]
    for name, sizes in alone.items():
        found += [
            Case(name, size, DisturbanceConfig(**(every if "push" in name else {}) | changes))
            for size, changes in sizes
        ]
    peers = dataclasses.replace(
        MJLAB,
        torso_mass=(-1.0, 3.0),
        stiffness=(0.9, 1.1),
        damping=(0.9, 1.1),
        joint_friction=(0.05, 0.2),
        armature=(1.0, 1.05),
        delay=(0, substeps),
    )
    return [*found, Case("together", "mjlab's", MJLAB), Case("together", "all peers'", peers)]


def pushed(speed: float) -> DisturbanceConfig:
    """Pushes of one size, m/s, in any direction, as in the cases of pushes alone."""
    return DisturbanceConfig(push_interval=(EVERY, EVERY), push_speed=(speed, speed))


class _Second(NamedTuple):
    """Episodes under way."""

    now: EnvState
    alive: jax.Array  # [N] bool
    fell: jax.Array  # [N] bool
    length: jax.Array  # [N] int32


class Played(NamedTuple):
    """First episodes of N environments over T steps; after a fall the state stands still."""

    qpos: np.ndarray  # [T, N, 7 + J]
    length: np.ndarray  # [N] steps survived
    fell: np.ndarray  # [N] bool
    pushes: np.ndarray  # [T, N, 6] what was added to the root's velocity before each step, mostly zero


class Player:
    """First episodes of a trainer's robot under any disturbances, by one program for those of a kind of ground.

    Args:
      trainer: of the run.
      episodes: per case.
      seed: of starts and disturbances, which are the same for every policy.
      uneven: whether the ground may be uneven, too.

    Raises:
      UserError: the robot names no torso, or its world cannot be uneven.
    """

    def __init__(self, trainer: Trainer, episodes: int = EPISODES, seed: int = SEED, *, uneven: bool = False):
        self.trainer, self.count = trainer, episodes
        config = trainer.config
        # Every disturbance is on, but for uneven ground, which has a model of its own; their sizes are in the state.
        everything = dataclasses.replace(
            MJLAB,
            torso_mass=(0.0, 0.0),
            joint_friction=(0.0, 0.0),
            delay=(0, 2 * config.physics.substeps),
            step_height=float(uneven),
        )
        settings = dataclasses.replace(config.physics, backend="native")  # MJX does not have all of them
        everything = dataclasses.replace(config, disturbance=everything, physics=settings)
        backend = physics.make(trainer.robot, settings, joint_friction=True, uneven=uneven)
        self.env = Env(trainer.robot, trainer.library, everything, backend)
        assert self.env.disturbances is not None, "the evaluation's own configuration has every disturbance"
        self.disturbances = self.env.disturbances
        self.noise = next(iter(episodes_of(config, episodes)))
        self._key = jax.random.PRNGKey(seed)
        rows = self.env.reset_rows(self._key, episodes)
        self._start = self.env.start_at(rows, jax.random.fold_in(self._key, 2), jnp.full(episodes, self.noise))
        self.chunk = round(config.control_rate)

    def play(self, state: PPOState, config: DisturbanceConfig) -> Played:
        """Play episodes under the mean action and disturbances of these sizes."""
        disturbed = self.disturbances.init(jax.random.fold_in(self._key, 3), self.count, config)
        disturbed = disturbed._replace(share=jnp.ones_like(disturbed.share))
        alive = jnp.ones(self.count, bool)
        under_way = _Second(self._start._replace(disturbed=disturbed), alive, ~alive, jnp.zeros(self.count, jnp.int32))
        steps, recorded = self.env.config.episode_steps, []
        for i in range(-(-steps // self.chunk)):
            under_way, second = self._second(state, under_way, jax.random.fold_in(self._key, 100 + i))
            recorded.append(jax.tree.map(np.asarray, second))
            if not np.asarray(under_way.alive).any():
                break
        qpos, pushes = (np.concatenate(part)[:steps] for part in zip(*recorded, strict=True))
        # An episode of the longest length may have ended within the last chunk, past its end.
        length = np.minimum(np.asarray(under_way.length), steps)
        fell = np.asarray(under_way.fell) & (np.asarray(under_way.length) <= steps)
        rest = steps - len(qpos)
        qpos = np.concatenate([qpos, np.repeat(qpos[-1:], rest, axis=0)])
        return Played(
            qpos, length, fell, np.concatenate([pushes, np.zeros_like(pushes, shape=(rest, *pushes.shape[1:]))])
        )

    @partial(jax.jit, static_argnums=0)
    def _second(self, state: PPOState, under_way: _Second, key: jax.Array):
        env, policy = self.env, self.trainer.ppo.act(state, deterministic=True)

        def step(carry, drawn):
            pushes = jnp.where(carry.alive[:, None], self.disturbances.push(carry.now.disturbed, drawn), 0.0)
            taken = frozen.step(self.trainer, env, policy, carry.now, carry.alive, drawn)
            after = _Second(taken.now, taken.alive, carry.fell | taken.fell, carry.length + carry.alive)
            return after, (taken.now.physics.qpos, pushes)

        return jax.lax.scan(step, under_way, env.disturbance_draws(key, self.chunk, self.count))


def chosen(config: Config, disturbances: Sequence[str]) -> list[Case]:
    """The cases of the named disturbances, all of them where none is named.

    Raises:
      UserError: no case has such a disturbance.
    """
    every = cases(config)
    names = dict.fromkeys(case.disturbance for case in every)
    for name in disturbances:
        if name not in names:
            raise UserError(f"unknown disturbance {name!r}: expected some of {', '.join(map(repr, names))}")
    return [case for case in every if not disturbances or case.disturbance in disturbances]


def measure(
    trainer: Trainer,
    state: PPOState,
    *,
    episodes: int = EPISODES,
    disturbances: Sequence[str] = (),
    note: Any = None,
) -> Robustness:
    """Play the deterministic policy under every case and measure it.

    Args:
      trainer: of the run.
      state: of the policy.
      episodes: per case.
      disturbances: names of those to play; none for all.
      note: called with a line after each case; None for silence.

    Raises:
      UserError: the robot has no torso whose mass could differ, no case has a disturbance of that name, or uneven
        ground is named and the robot's world cannot be.
    """
    wanted = chosen(trainer.config, disturbances)
    cells: list[Cell] = []
    for uneven in (False, True):
        alike = [case for case in wanted if bool(case.config.step_height) == uneven]
        if not alike:
            continue
        try:
            cells += _played(Player(trainer, episodes, uneven=uneven), alike, state, note)
        except UserError as error:
            if disturbances or not uneven:
                raise
            if note:
                note(f"  without {alike[0].disturbance}: {error}")
    order = [(case.disturbance, case.size) for case in wanted]
    cells.sort(key=lambda cell: order.index((cell.disturbance, cell.size)))
    speed = float(trainer.library.mean([planar_speed(clip) for clip in trainer.library.clips]))
    return Robustness(tuple(cells), trainer.config.env.episode_steps / trainer.config.control_rate, speed)


def _played(player: Player, wanted: Sequence[Case], state: PPOState, note: Any) -> list[Cell]:
    cells = []
    for case in wanted:
        cells.append(_cell(player.trainer, case, player.play(state, case.config)))
        if note:
            note(table(cells[-1:]))
            if cells[-1].sides:
                note(f"    {sides_text(cells[-1].sides)}")
    return cells


def _cell(trainer: Trainer, case: Case, played: Played) -> Cell:
    rate, robot = trainer.config.control_rate, trainer.robot
    qpos, length, fell, added = played
    pushes = pushes_of(qpos, length, fell, added)
    low, high = wilson(int(fell.sum()), len(fell))
    speeds, _ = metrics.late_path(qpos[..., :3], rotations.yaw(qpos[..., 3:7].astype(np.float64)), length, rate=rate)
    expert = trainer.library.mean(
        [metrics.expert_ranges(clip.qpos[:, 7:], robot.sagittal_joints, rate=rate) for clip in trainer.library.clips]
    )
    ranges = metrics.window_ranges(qpos[..., 7:], length, robot.sagittal_joints, rate=rate)
    speed, excursion = metrics.summarize(speeds), metrics.summarize(metrics.excursion(ranges, expert))
    return Cell(
        disturbance=case.disturbance,
        size=case.size,
        episodes=len(fell),
        falls=int(fell.sum()),
        low=low,
        high=high,
        seconds=float(length.mean()) / rate,
        speed=speed.mean,
        speed_n=speed.n,
        excursion=excursion.mean,
        excursion_n=excursion.n,
        sides=tuple(by_side(pushes)) if pushes else (),
    )


def wilson(count: float, total: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share of which ``count`` of ``total`` were seen."""
    share, z2 = count / total, Z**2 / total
    middle, half = share + z2 / 2, Z * np.sqrt((share * (1 - share) + z2 / 4) / total)
    return max(0.0, float((middle - half) / (1 + z2))), min(1.0, float((middle + half) / (1 + z2)))


def table(cells: Any) -> str:
    """Lines for people: falls with their interval, mean length, speed and excursion of each case."""
    layout = "  {:<18} {:<12} {:>12} {:>14} {:>8} {:>10} {:>10}"
    return tables.lines(layout, [_row(cell) for cell in cells])


def heading() -> str:
    """The names of the columns of `table`."""
    names = ("disturbance", "size", "falls", "95 %", "length", "speed", "excursion")
    return tables.lines("  {:<18} {:<12} {:>12} {:>14} {:>8} {:>10} {:>10}", [names])


def _row(cell: Cell) -> tuple[str, ...]:
    def known(value: float, text: str) -> str:
        return "undefined" if np.isnan(value) else text.format(value)

    return (
        cell.disturbance,
        cell.size,
        f"{cell.falls} of {cell.episodes}",
        f"{100 * cell.low:.1f}-{100 * cell.high:.1f} %",
        f"{cell.seconds:.1f} s",
        known(cell.speed, "{:.2f} m/s"),
        known(cell.excursion, "{:.2f}"),
    )


def bars(found: Robustness) -> list[tuple[str, list[tuple[str, float, float, float]]]]:
    """The cells by disturbance, each with its size, share of falls and interval."""
    groups: dict[str, list[tuple[str, float, float, float]]] = {}
    for cell in found.cells:
        share = cell.falls / cell.episodes
        groups.setdefault(cell.disturbance, []).append((cell.size, share, cell.low, cell.high))
    return list(groups.items())
