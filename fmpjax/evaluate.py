"""Evaluation of a frozen policy on first episodes (section IV-C of the paper)."""

import dataclasses
from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import features, frozen, jsons, kinematics, metrics, rotations, tables, transport
from fmpjax.config import Config, FeatureConfig
from fmpjax.env import EnvState
from fmpjax.motion import MotionClip
from fmpjax.ppo import PPOState
from fmpjax.trainer import Trainer

# The definitions of the figures, beside those in `metrics`.
DETAILED = 64  # episodes whose late speed, joints and feet are analyzed [P]
WINDOWS = 512  # windows at most on either side of the Sinkhorn discrepancy [D]
CONTACT_HEIGHT = 0.01  # m, a foot is in contact where a sole point is lower [D]
OTHER_SIZES = 3  # times fewer episodes at the sizes of perturbation that are not the headline's [D]
LISTED = 12  # motions that the table names
STARTS_SEED = 1  # of the episodes' starts, the same in every evaluation [D]


class Start(NamedTuple):
    """First episodes whose starts are perturbed by one size of noise."""

    noise: float  # rad, standard deviation of the joint angles; ten times that in rad/s of their velocities
    episodes: int
    falls: int


class Episodes(NamedTuple):
    """First episodes of N environments over T steps, of the headline's size; after a fall the state stands still."""

    qpos: np.ndarray  # [T, N, 7 + J]
    qvel: np.ndarray  # [T, N, 6 + J]
    length: np.ndarray  # [N] steps survived
    fell: np.ndarray  # [N] bool
    start_qpos: np.ndarray  # [N, 7 + J]
    history: np.ndarray  # [N, H, F] compact frames up to the start
    clip: np.ndarray  # [N] index of the demonstration that it starts in, 0 for the default pose
    starts: tuple[Start, ...] = ()  # every size, the headline's included, the smallest first
    targets: np.ndarray | None = None  # [T, n, J] joint targets of the detailed episodes, rad; None: not recorded
    obedience: np.ndarray | None = None  # [N] mean of the command's reward while up; None without a command


class Share(NamedTuple):
    """The episodes that started in one of several demonstrations."""

    motion: str
    episodes: int
    falls: int
    late_speed: float  # m/s, along the own heading where the demonstration turns; of the detailed episodes
    late_n: int  # episodes behind it
    demonstration_speed: float  # m/s


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """The evaluation's figures; `as_dict` names them as the metrics files do."""

    noise: float  # rad, of the starts that all figures but `starts` are of
    episodes: int
    falls: int
    mean_length: float  # steps
    late_speed: float  # m/s, of the detailed episodes
    late_n: int  # episodes behind the late speed, at most 64
    late_deviation: float  # m/s, between episodes
    path_speed: float  # m/s, late, along the robot's own heading
    turn: float  # rad/s, late, to the left
    excursion: float
    excursion_n: int
    amplitude_mae: float  # degrees
    discrepancy: float  # Sinkhorn, in the paper's features
    contact_foot_speed: float  # m/s
    imbalance: float
    displacement: float  # m
    demonstration_speed: float  # m/s
    demonstration_turn: float  # rad/s, to the left
    demonstration_turning: float  # rad/s, either way
    action_rate: float  # rad/s, of the joint targets
    joint_jerk: float  # rad/s³
    power: float  # W, mechanical, of the servos
    joint_ranges: tuple[float, ...]  # degrees, six sagittal joints
    expert_ranges: tuple[float, ...]  # degrees
    pace: float | None = None  # m/s, the late speed that counts, see `metrics.pace_of`
    obedience: float | None = None  # mean of the command's reward in the steps before a fall; None without a command
    starts: tuple[Start, ...] = ()  # falls at every size of perturbation
    motions: tuple[Share, ...] = ()  # where there are several

    @property
    def quality(self) -> float:
        """Share of surviving episodes times one less the relative error of the late speed.

        Too fast is no better than too slow. The speed is that of `metrics.pace_of`.
        """
        return (1.0 - self.falls / self.episodes) * max(0.0, 1.0 - metrics.pace_error(vars(self)))

    @property
    def score(self) -> float:
        """What "best" means: the quality; with a command the surviving share times the obedience.

        A command says what is wanted, which need not be the demonstration's pace.
        """
        return self.quality if self.obedience is None else (1.0 - self.falls / self.episodes) * self.obedience

    def as_dict(self) -> dict[str, float]:
        """Scalar figures, by name; `names` says which."""
        values = {name: value for name, value in vars(self).items() if not isinstance(value, tuple)}
        values = _told(values | {"score": self.score})
        counts = [count for start in self.starts for count in (start.falls, start.episodes)]
        sized = _sized(start.noise for start in self.starts)
        return values | {"quality": self.quality} | dict(zip(sized, counts, strict=True))

    def record(self) -> dict[str, Any]:
        """All figures, for JSON; what is not defined is NaN."""
        values = vars(self) | {"quality": self.quality, "starts": [start._asdict() for start in self.starts]}
        values = _told(values | {"score": self.score})
        del values["motions"]
        motions = [share._asdict() for share in self.motions]
        return values | ({"motions": motions} if motions else {})

    def to_json(self) -> str:
        """All figures; what is not defined is null."""
        return jsons.dumps(self.record())


def names(config: Config) -> list[str]:
    """Names of an evaluation's scalar figures, those of `Evaluation.as_dict`."""
    plain = [field.name for field in dataclasses.fields(Evaluation) if "tuple" not in str(field.type)]
    obedience = None if config.command.kind == "none" else 0.0
    known = _told(dict.fromkeys([*plain, "score", "quality"]) | {"obedience": obedience})
    return [*known, *_sized(sorted(config.evaluation_noise))]


def _told(values: dict[str, Any]) -> dict[str, Any]:
    """Figures by name, without those that only runs with a command have where there is none."""
    if values["obedience"] is not None:
        return values
    return {name: value for name, value in values.items() if name not in ("obedience", "score")}


def _sized(sizes: Iterable[float]) -> list[str]:
    return [f"{figure}_at_{size:g}" for size in sizes for figure in ("falls", "episodes")]


def episodes_of(config: Config, episodes: int) -> dict[float, int]:
    """Episodes to play at each size of perturbation, the headline's first.

    The headline is the smallest size at which episodes differ: the demonstration's states as they are, and from the
    fixed pose the smallest perturbation. The other sizes have a third of its episodes; the fixed pose without a
    perturbation has one, since all would be the same.
    """
    fixed, sizes = config.env.reset == "fixed", sorted(config.evaluation_noise)
    headline = next((size for size in sizes if size > 0 or not fixed), sizes[0])
    counts = {headline: episodes} | {size: -(-episodes // OTHER_SIZES) for size in sizes if size != headline}
    return counts | ({0.0: 1} if fixed and 0.0 in counts else {})


class Evaluator:
    """First episodes of a trainer's environments under a deterministic policy, compiled once.

    Every size of perturbation is in one batch, the headline's episodes first.
    """

    def __init__(self, trainer: Trainer, episodes: int | None = None, seed: int = STARTS_SEED):
        self.trainer = trainer
        robot, env = trainer.robot, trainer.env
        self._sizes = episodes_of(trainer.config, episodes or trainer.config.evaluation_episodes)
        self.noise, self.count = next(iter(self._sizes.items()))
        self._poses = jax.jit(partial(kinematics.body_poses, robot))
        self._frames = jax.jit(lambda qpos, qvel: features.observe(robot, qpos, qvel, "compact").frame)
        # Every evaluation of a configuration starts from the same states, perturbations included.
        key = jax.random.PRNGKey(seed)
        rows = np.asarray(env.reset_rows(key, max(self._sizes.values())))
        self.rows = np.concatenate([rows[:count] for count in self._sizes.values()])
        self._noise = np.repeat(np.array(list(self._sizes), np.float32), list(self._sizes.values()))
        self._key = np.asarray(jax.random.fold_in(key, 2))
        # The discrepancy is in the paper's features whatever the run's own are, so that it compares.
        paper = FeatureConfig(history=env.horizon)
        windows, share = env.clip_windows(), env.window_share()
        self._feature_map = features.fit_feature_map(robot, windows, paper, share)
        expert = np.arange(0, len(windows), max(1, len(windows) // WINDOWS))
        if share is not None:
            expert = trainer.expert.bank_rows(jax.random.PRNGKey(0), WINDOWS)
        self._expert = self._feature_map(windows[expert])

    def start(self) -> EnvState:
        """The episodes' starts, the headline's first."""
        return self.trainer.env.start_at(jnp.asarray(self.rows), jnp.asarray(self._key), jnp.asarray(self._noise))

    @partial(jax.jit, static_argnums=0)
    def _play(self, state: PPOState):
        env, headline, start = self.trainer.env, self.count, self.start()
        policy = self.trainer.ppo.act(state, deterministic=True)

        def step(carry, drawn):
            now, alive, fell, length, earned = carry
            taken = frozen.step(self.trainer, env, policy, now, alive, drawn)
            if taken.earned is not None:
                earned = earned + jnp.where(alive, taken.earned, 0.0)
            sim, targets = taken.now.physics, env.actions(taken.action)[:headline][:DETAILED]
            after = (taken.now, taken.alive, fell | taken.fell, length + alive, earned)
            return after, (sim.qpos[:headline], sim.qvel[:headline], targets)

        alive = jnp.ones(len(self.rows), bool)
        nothing = None if env.command is None else jnp.zeros(len(self.rows))
        (_, _, fell, length, earned), (qpos, qvel, targets) = jax.lax.scan(
            step,
            (start, alive, ~alive, jnp.zeros(len(self.rows), jnp.int32), nothing),
            env.disturbance_draws(jnp.asarray(self._key), env.config.episode_steps, len(self.rows)),
            length=env.config.episode_steps,
        )
        return qpos, qvel, targets, length, fell, start.physics.qpos, start.history, earned

    def play(self, state: PPOState) -> Episodes:
        """First episodes under ``state``'s mean action."""
        headline = slice(0, self.count)
        qpos, qvel, targets, *each, earned = jax.device_get(self._play(state))
        length, fell, start_qpos, history = (values[headline] for values in each)
        clip = self.trainer.env.clip_of(self.rows[headline])
        ends = np.cumsum(list(self._sizes.values()))
        falls = [int(part.sum()) for part in np.split(each[1], ends[:-1])]
        starts = sorted(map(Start, self._sizes, self._sizes.values(), falls))
        obedience = None if earned is None else earned[headline] / length
        return Episodes(qpos, qvel, length, fell, start_qpos, history, clip, tuple(starts), targets, obedience)

    def __call__(self, state: PPOState) -> Evaluation:
        return self.measure(self.play(state))

    def measure(self, played: Episodes) -> Evaluation:
        """The figures of played episodes."""
        trainer, robot, library = self.trainer, self.trainer.robot, self.trainer.library
        rate = trainer.config.control_rate
        heading = rotations.yaw(played.start_qpos[:, 3:7].astype(np.float64))
        root = played.qpos[..., :3].astype(np.float64)
        displacement = metrics.forward_displacement(root, played.length, heading, played.start_qpos[:, :3])

        detail = slice(0, DETAILED)
        length = played.length[detail]
        speed = metrics.late_speed(root[:, detail], length, heading[detail], rate=rate)
        yaw = rotations.yaw(played.qpos[:, detail, 3:7].astype(np.float64))
        path_speed, turn = metrics.late_path(root[:, detail], yaw, length, rate=rate)
        joints = played.qpos[:, detail, 7:].astype(np.float64)
        ranges = metrics.window_ranges(joints, length, robot.sagittal_joints, rate=rate)
        expert = library.mean(
            [metrics.expert_ranges(clip.qpos[:, 7:], robot.sagittal_joints, rate=rate) for clip in library.clips]
        )
        excursion = metrics.summarize(metrics.excursion(ranges, expert))
        feet, contact = self._feet(jnp.asarray(played.qpos[:, detail]))
        late = metrics.summarize(speed)
        own_speed = [planar_speed(clip) for clip in library.clips]
        own_turn = np.array([clip.turning for clip in library.clips])
        own_axes = self.trainer.config.features.axes == "heading"
        turns = (abs(own_turn[played.clip[detail]]) > metrics.TURNS) | own_axes
        path = metrics.summarize(path_speed).mean
        paced_along = own_axes or library.mean(abs(own_turn)) > metrics.TURNS
        return Evaluation(
            noise=self.noise,
            episodes=len(played.length),
            falls=int(played.fell.sum()),
            mean_length=float(played.length.mean()),
            late_speed=late.mean,
            late_n=late.n,
            late_deviation=float(np.nanstd(speed)) if late.n else float("nan"),
            path_speed=path,
            turn=metrics.summarize(turn).mean,
            excursion=excursion.mean,
            excursion_n=excursion.n,
            amplitude_mae=metrics.summarize(metrics.amplitude_mae(ranges, expert)).mean,
            discrepancy=self._discrepancy(played, detail),
            contact_foot_speed=metrics.summarize(metrics.contact_foot_speed(feet, contact, length, rate=rate)).mean,
            imbalance=metrics.summarize(metrics.left_right_imbalance(ranges)).mean,
            displacement=metrics.summarize(displacement).mean,
            demonstration_speed=float(library.mean(own_speed)),
            demonstration_turn=float(library.mean(own_turn)),
            demonstration_turning=float(library.mean(abs(own_turn))),
            **self._effort(played, length),
            joint_ranges=tuple(np.degrees(metrics.mean_ranges(ranges)).round(2).tolist()),
            expert_ranges=tuple(np.degrees(expert).round(2).tolist()),
            pace=path if paced_along else late.mean,
            obedience=None if played.obedience is None else float(played.obedience.mean()),
            starts=played.starts,
            motions=self._shares(played, np.where(turns, path_speed, speed), own_speed),
        )

    def _shares(self, played: Episodes, speed: np.ndarray, own_speed: list[float]) -> tuple[Share, ...]:
        """Shares of the demonstrations, given the late speeds of the detailed episodes."""
        clips = self.trainer.library.clips
        if len(clips) == 1 or self.trainer.config.env.reset == "fixed":
            return ()
        shares = []
        for i, clip in enumerate(clips):
            mine = played.clip == i
            late = metrics.summarize(speed[mine[: len(speed)]])
            falls = int(played.fell[mine].sum())
            shares.append(Share(clip.name, int(mine.sum()), falls, late.mean, late.n, own_speed[i]))
        return tuple(shares)

    def _effort(self, played: Episodes, length: np.ndarray) -> dict[str, float]:
        """How smoothly and how hard the joints work in the detailed episodes; NaN where no targets are recorded."""
        robot, rate, count = self.trainer.robot, self.trainer.config.control_rate, len(length)
        angle, velocity = played.qpos[:, :count, 7:], played.qvel[:, :count, 6:]
        found = {"joint_jerk": metrics.joint_jerk(velocity, length, rate=rate)}
        if played.targets is not None:
            servo = {"stiffness": robot.stiffness, "damping": robot.damping, "effort": robot.effort}
            found["action_rate"] = metrics.action_rate(played.targets, length, rate=rate)
            found["power"] = metrics.power(played.targets, angle, velocity, length, **servo)
        means = {name: metrics.summarize(values).mean for name, values in found.items()}
        return {"action_rate": np.nan, "power": np.nan} | means

    def _feet(self, qpos: jax.Array) -> tuple[np.ndarray, np.ndarray]:
        """Foot positions ``[T, n, F, 3]`` (m, the mean of a foot's sole points) and contacts ``[T, n, F]``."""
        robot = self.trainer.robot
        poses = self._poses(qpos)
        soles = kinematics.points(poses, robot.sole_body, robot.sole_point)
        heights = kinematics.sole_heights(robot, poses)
        feet = np.unique(robot.sole_body)
        position = np.stack([np.asarray(soles[..., robot.sole_body == f, :].mean(-2)) for f in feet], axis=-2)
        contact = np.stack([np.asarray(heights[..., robot.sole_body == f].min(-1)) for f in feet], axis=-1)
        return position, contact < CONTACT_HEIGHT

    def _discrepancy(self, played: Episodes, detail: slice) -> float:
        """Debiased Sinkhorn discrepancy between evaluation and expert windows in the paper's features."""
        horizon = self.trainer.env.horizon
        qpos, qvel = jnp.asarray(played.qpos[:, detail]), jnp.asarray(played.qvel[:, detail])
        frames = self._frames(qpos, qvel)
        frames = np.concatenate([np.swapaxes(played.history[detail], 0, 1), np.asarray(frames)])  # [H + T, n, F]
        steps, episodes = np.nonzero(np.arange(len(played.qpos))[:, None] < played.length[detail])
        # Evenly spaced samples in a fixed shuffled order: the same windows for the same lengths.
        pick = np.random.default_rng(0).permutation(len(steps))[:WINDOWS]
        rows = steps[pick, None] + 1 + np.arange(horizon)
        evaluated = self._feature_map(jnp.asarray(frames[rows, episodes[pick, None]]))
        return float(transport.discrepancy(evaluated, self._expert, self._feature_map.dimension))


def planar_speed(clip: MotionClip) -> float:
    """Mean speed of a clip's root over the floor, m/s."""
    return float(np.linalg.norm(np.diff(clip.qpos[:, :2], axis=0), axis=-1).mean() * clip.rate)


def _listed(motions: tuple[Share, ...]) -> list[Share]:
    """The motions that a table shows: all of a few, of many those with the most falls."""
    if len(motions) <= LISTED:
        return list(motions)
    return sorted(motions, key=lambda share: -share.falls)[:LISTED]


def _shown(value: float, layout: str) -> str:
    """A figure as text; one that is not defined as a dash."""
    return format(value, layout) if np.isfinite(value) else "–"


def table(evaluation: Evaluation) -> str:
    """The figures as a table for people."""
    e = evaluation
    rows = [
        ("mean episode length", f"{e.mean_length:.1f}", "steps"),
        ("falls", f"{e.falls} of {e.episodes}", f"joint noise of {e.noise:g} rad at the start, as in all below"),
        ("late speed", f"{_shown(e.late_speed, '.3f')} ± {_shown(e.late_deviation, '.3f')}", f"m/s, n = {e.late_n}"),
        ("along its own heading", _shown(e.path_speed, ".3f"), f"m/s, turning at {_shown(e.turn, '+.3f')} rad/s"),
        ("demonstration's speed", f"{e.demonstration_speed:.3f}", f"m/s, turning at {e.demonstration_turn:+.3f} rad/s"),
        ("excursion", _shown(e.excursion, ".3f"), f"of the demonstration's, n = {e.excursion_n}"),
        ("amplitude error", _shown(e.amplitude_mae, ".2f"), "degrees"),
        ("Sinkhorn discrepancy", f"{e.discrepancy:.4f}", "in the paper's features"),
        ("foot speed in contact", _shown(e.contact_foot_speed, ".3f"), "m/s"),
        ("rate of the joint targets", f"{e.action_rate:.2f}", f"rad/s; jerk of the joints {e.joint_jerk:.0f} rad/s³"),
        ("power of the servos", f"{e.power:.0f}", "W, mechanical"),
        ("left-right imbalance", _shown(e.imbalance, ".3f"), ""),
        ("forward displacement", f"{e.displacement:.2f}", "m"),
        ("leg ranges (hip, knee, ankle; L, R)", " ".join(f"{r:.0f}" for r in e.joint_ranges), "degrees"),
        ("demonstration's leg ranges", " ".join(f"{r:.0f}" for r in e.expert_ranges), "degrees"),
    ]
    if e.obedience is not None:
        rows.append(("obedience", f"{e.obedience:.3f}", "mean of the command's reward before a fall"))
    rows += [
        (f"falls at joint noise of {start.noise:g} rad", f"{start.falls} of {start.episodes}", "")
        for start in e.starts
        if start.noise != e.noise
    ]
    rows += [
        (
            f"from {share.motion}",
            _shown(share.late_speed, ".3f"),
            f"m/s of {share.demonstration_speed:.3f}, {share.falls} falls in {share.episodes}",
        )
        for share in _listed(e.motions)
    ]
    if len(e.motions) > LISTED:
        rows.append((f"and {len(e.motions) - LISTED} more motions", "", "with fewer falls or as many"))
    return tables.lines("  {:<36} {:>20}  {}", rows)
