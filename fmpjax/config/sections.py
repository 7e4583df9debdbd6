"""The settings: a frozen dataclass for each section, and `Config`, which holds them.

A field states its type with its choices or bounds, its default, which is the paper's, and in a comment its meaning, its
unit and its source. `reading` checks values by these types; `fmpjax settings` and docs/settings.md print all of it. A
rule about several fields stands in the ``check`` of their section, or of `Config` where they are of several sections.
"""

import dataclasses
from typing import Annotated, Literal

from msgspec import Meta

from fmpjax.config.base import (
    Decay,
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    Optimizer,
    PositiveFloat,
    PositiveInt,
    Section,
    Widths,
)
from fmpjax.config.disturbance import DisturbanceConfig
from fmpjax.config.rewards import (
    FOLLOWERS,
    ADDConfig,
    AMPConfig,
    GAILConfig,
    PWILConfig,
    SMPConfig,
    TrackingConfig,
    WAILConfig,
)
from fmpjax.errors import UserError


@dataclasses.dataclass(frozen=True)
class PhysicsConfig(Section):
    """Simulation between two control steps."""

    # "native" is MuJoCo C on all cores, "mjx" runs on the device; "auto" is mjx on an accelerator, else native [D]
    backend: Literal["auto", "native", "mjx"] = "auto"
    impl: Literal["jax", "warp"] = "jax"  # implementation of MJX; "warp" is for NVIDIA [D]
    timestep: PositiveFloat = 0.005  # s, simulation time per physics step, 200 Hz [D]
    substeps: PositiveInt = 4  # physics steps per control step, 50 Hz control [P]
    iterations: PositiveInt = 10  # Newton iterations at most [D]
    ls_iterations: PositiveInt = 20  # line-search iterations at most [D]
    frictionloss: NonNegativeFloat = 0.1  # N m, joint friction [M]
    threads: NonNegativeInt = 0  # threads of the native backend, 0 for every core [D]
    max_contacts: PositiveInt = 40  # contacts per world: MJX in JAX keeps the nearest, Warp's buffer holds them [D]
    max_constraints: PositiveInt = 256  # constraint rows per world in the buffers of impl="warp" [D]


@dataclasses.dataclass(frozen=True)
class EnvConfig(Section):
    """Environments, episodes and resets."""

    count: PositiveInt = 1024  # parallel environments [P]
    reset: Literal["dataset", "fixed"] = "dataset"  # to a demonstration state ("dataset") or the default pose [P]
    # times per control step at which the demonstration is read; 1 reads its samples [M: any time]
    demonstration_parts: PositiveInt = 8
    early_frames: bool = True  # windows may begin before the demonstration, whose first frame then stands in [M]
    reset_noise: NonNegativeFloat = 0.0  # rad, deviation of joints at a training reset; ten times that in rad/s [D]
    episode_steps: PositiveInt = 500  # control steps, 10 s [P]
    first_cap: PositiveInt = 500  # control steps, episode cap at the start; it grows as episodes survive [P: 500]
    last_cap: PositiveInt = 500  # control steps, cap at which the growth ends; evaluation plays episode_steps [D]
    cap_growth: PositiveFloat = 1.25  # factor per growth step [D]
    cap_share: NonNegativeFloat = 0.75  # share of episodes that end by the cap above which the cap grows [D]
    cap_patience: NonNegativeInt = 25  # rollouts between two growth steps at least [D]
    # 237 numbers [P], 86 that carry the same information, or what a robot senses, docs/robustness.md ("deployable") [D]
    observation: Literal["full", "compact", "deployable"] = "full"
    observation_history: PositiveInt = 1  # control steps of which a deployable policy sees its sensors [D]
    axes: Literal["world", "heading"] = "world"  # of observed vectors [P]; "heading": x where the root faces [D]
    # 1.4 max|limit| around zero [M], or "residual": 0.25 effort/kp around the demonstration's mean pose [D]
    action: Literal["absolute", "residual"] = "absolute"

    @property
    def longest_episode(self) -> int:
        """Control steps of the longest episode in training."""
        return max(self.first_cap, min(self.last_cap, self.episode_steps))

    def check(self) -> None:
        """Raise a `UserError` where a history is asked for of an observation that has none."""
        if self.observation_history > 1 and self.observation != "deployable":
            raise UserError(
                f"setting env.observation_history is {self.observation_history} and env.observation "
                f"{self.observation!r}: expected 1, since only 'deployable' has a history"
            )


@dataclasses.dataclass(frozen=True)
class CommandConfig(Section):
    """What the policy is told, and what a step earns by obeying."""

    # nothing [P], a velocity in the heading frame, the time in the clip ("phase"), or one of several motions [D]
    kind: Literal["none", "velocity", "phase", "motion"] = "none"
    # of the reward of the motion and that of the command; "prior" pays the motion's alone [D]
    combine: Literal["product", "sum", "prior"] = "product"
    weight: PositiveFloat = 1.0  # of the command's reward in a sum [D]
    hold: tuple[float, ...] = (1.0, 3.0)  # s, shortest and longest time for which a velocity or a motion is held [D]
    zero: Annotated[float, Meta(ge=0, le=1)] = 0.1  # share of the new velocities that are zero [D]
    # m/s, slowest and fastest velocity ahead; empty, with the next two, for the demonstrations' own velocities [D]
    ahead: tuple[float, ...] = ()
    sideways: tuple[float, ...] = ()  # m/s, the same to the left; empty for none where another range is given [D]
    turn: tuple[float, ...] = ()  # rad/s, the same of turning to the left [D]
    average: PositiveFloat = 0.5  # s, time constant of the running means of errors and distances [D: half a stride]
    # m/s and rad/s; in that mean a larger error counts by its logarithm [D: the whole error asks for a leap]
    error_scale: PositiveFloat = 0.3
    speed_width: PositiveFloat = 0.2  # m/s, error at which the reward of the speed falls to a half [D]
    turn_width: PositiveFloat = 0.25  # rad/s, error at which the reward of the turning falls to a half [D]

    @property
    def ranges(self) -> tuple[tuple[float, ...], ...] | None:
        """Ends of the velocity's three components, ``[3, 2]``; None for the demonstrations' own velocities."""
        given = (self.ahead, self.sideways, self.turn)
        return tuple(ends or (0.0, 0.0) for ends in given) if any(given) else None

    def check(self) -> None:
        """Raise a `UserError` where a range is none."""
        for name in ("hold", "ahead", "sideways", "turn"):
            ends = getattr(self, name)
            if (ends or name == "hold") and not (len(ends) == 2 and ends[0] <= ends[1]):
                raise UserError(
                    f"setting command.{name} is {', '.join(f'{end:g}' for end in ends) or 'empty'}: expected two "
                    "numbers, the lower one first"
                )
        if not self.hold[0] > 0:
            raise UserError(f"setting command.hold begins with {self.hold[0]:g}: expected more than 0 s")


@dataclasses.dataclass(frozen=True)
class FeatureConfig(Section):
    """Window features of the prior."""

    history: Annotated[int, Meta(ge=2, le=64)] = 10  # frames per window, H [P]
    axes: Literal["world", "heading"] = "world"  # of a window's vectors [P]; "heading": x forward in the newest [D]
    deviation_floor: PositiveFloat = 1e-4  # least standard deviation by which a coordinate is divided [M]
    angular_velocity_floor: PositiveFloat = 1e-4  # rad/s, the same for angular velocities of joints and root [M]
    clip: PositiveFloat = 10.0  # standardized coordinates are clipped to this magnitude [P]


@dataclasses.dataclass(frozen=True)
class PriorConfig(Section):
    """The transport potential and its fitting, sections III-B to III-D of the paper."""

    bank: PositiveInt = 256  # windows in the expert bank and in a source bank, m = n [P]
    minibatch: PositiveInt = 256  # queries per update [P]
    updates: PositiveInt = 128  # reward-model updates per rollout [P]
    query_share: Fraction = 0.75  # the first environments, 0-767 of 1,024, supply queries [P]
    query_is_bank: bool = False  # queries are the source bank itself: cheaper, and biased, docs/learning.md [P: no]
    hidden: Widths = (256, 256)  # units of the trunk's layers [P]
    learning_rate: PositiveFloat = 3e-4  # of Adam [P]
    clip_norm: PositiveFloat = 10.0  # gradient-norm clip [P]
    average_half_life: PositiveFloat = 16.0  # updates, half-life of the parameter average [P]
    average_restarts: bool = True  # the average starts again at every rollout, from the current parameters [P]
    value_scale: PositiveFloat = 0.10  # c0 of the value loss, eq. (value) [P]
    value_weight: NonNegativeFloat = 1.0  # weight of the value loss [P]
    endpoint_weight: NonNegativeFloat = 1.0  # weight of the endpoint loss [P]
    flow_weight: NonNegativeFloat = 1.0  # weight of the flow loss [P]
    epsilon_fraction: NonNegativeFloat = 0.1  # entropy over the median cross cost [P]
    sinkhorn_threshold: NonNegativeFloat = 1e-3  # marginal error (L1) at which a solve has converged [D]
    sinkhorn_iterations: PositiveInt = 200  # at most; solves that have not converged by then are counted [D]
    parallel_solves: NonNegativeInt = 0  # source banks solved side by side; 0: one on a CPU, all on an accelerator [D]
    score_banks: PositiveInt = 16  # source banks that method=bank16 averages [P]
    temperature: PositiveFloat = 1.0  # T of method=barycentric [D]
    spread_floor: PositiveFloat = 1e-6  # eta, least interquartile range in the reward [D]

    def check(self) -> None:
        """Raise a `UserError` where the minibatch has to be the bank and is not."""
        if self.query_is_bank and self.minibatch != self.bank:
            raise UserError(
                f"setting prior.minibatch is {self.minibatch}: expected prior.bank, {self.bank}, "
                "since prior.query_is_bank makes the source bank the minibatch"
            )


@dataclasses.dataclass(frozen=True)
class PPOConfig(Section):
    """Policy optimization, section IV-A of the paper."""

    rollout_steps: PositiveInt = 32  # control steps per rollout [P]
    hidden: Widths = (1024, 512)  # units of the actor's and the critic's layers, separate networks [M]
    activation: Literal["relu", "elu", "swish", "tanh"] = "relu"  # of the hidden layers [M]
    mean_init: NonNegativeFloat = 0.01  # actor's mean weights are uniform in this range [M]
    orthogonal: bool = False  # orthogonal weights in place of uniform ones within 1 / sqrt(inputs) [M: no]
    deviation: PositiveFloat = 0.05  # standard deviation in normalized actions at the start [M]
    learn_deviation: bool = False  # learn it, one number per joint [M: fixed]
    least_deviation: PositiveFloat = 0.05  # floor of a learned deviation [D]
    optimizer: Optimizer = "sgd"  # of actor and critic [M]
    learning_rate: PositiveFloat = 1e-4  # of the optimizer [P]
    momentum: Decay = 0.9  # momentum of SGD, which Adam leaves unread [M]
    clip_norm: NonNegativeFloat = 0.0  # gradient-norm clip, 0 for none [M]
    target_kl: NonNegativeFloat = 0.0  # 0 keeps the rate; else it falls above and rises below, `ppo.adapt_rate` [M: 0]
    critic_epochs: PositiveInt = 2  # passes over a rollout [M]
    critic_batch: PositiveInt = 2  # samples per environment in a minibatch [M]
    actor_epochs: PositiveInt = 5  # passes over a rollout [M]
    actor_batch: PositiveInt = 4  # samples per environment in a minibatch [M]
    discount: Fraction = 0.99  # gamma [P]
    gae_lambda: Fraction = 0.95  # lambda of the generalized advantage estimate [P]
    fall_value: float = 0.0  # return from a fall on, in rewards [M: nothing]
    clip: PositiveFloat = 0.2  # probability-ratio clip [P]
    advantage_clip: PositiveFloat = 4.0  # normalized advantages are clipped to this magnitude [M]
    bound_penalty: NonNegativeFloat = 10.0  # weight of sum max(|mean| - 1, 0)^2 [M]
    normalizer_clip: PositiveFloat = 10.0  # normalized observations are clipped to this magnitude [M]
    normalizer_floor: PositiveFloat = 1e-4  # least standard deviation of an observation [M]
    normalizer_from_clip: bool = False  # start the running statistics from the demonstration [M: no]
    normalizer_count: NonNegativeInt = 0  # cap of the running count, which then forgets slowly; 0 for none [M: 0]
    mirror: bool = False  # updates see half of the samples as their mirror images, left for right [D]

    def check(self) -> None:
        """Raise a `UserError` where minibatches would not be equal."""
        for phase, batch in (("critic", self.critic_batch), ("actor", self.actor_batch)):
            if self.rollout_steps % batch:
                raise UserError(
                    f"setting ppo.{phase}_batch is {batch}: expected a divisor of ppo.rollout_steps, "
                    f"{self.rollout_steps}, so that minibatches are equal"
                )


@dataclasses.dataclass(frozen=True)
class Config(Section):
    """One run."""

    method: str = "fmp"  # motion prior, as `fmpjax list` names it [P]
    robot: str = "unitree_g1_29dof"  # folder under robots/ [M]
    # a bundled motion's name, a file or its address (https://, hf://); several with commas between, weights as
    # NAME:WEIGHT [D]
    motion: str = "walk"
    frames: str = ""  # source rows "first:last" of the motion, both included; empty for all [D]
    preset: str = "paper"  # preset that the other settings depart from
    seed: Annotated[int, Meta(ge=0, le=2**32 - 1)] = 0  # of everything that is random [D]
    precision: Literal["float32", "default"] = "float32"  # of the networks' products [M]; "default": TF32 on NVIDIA
    transitions: PositiveInt = 50_003_968  # budget [P]
    # shares of the budget at which to evaluate [P]; simulation continues, where the paper's starts again [D]
    evaluations: tuple[Fraction, ...] = (0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
    evaluation_episodes: PositiveInt = 1024  # first episodes per evaluation [P]
    # rad, deviations of joint angles at an evaluation's starts, ten times that in rad/s; docs/metrics.md [D]
    evaluation_noise: Annotated[tuple[NonNegativeFloat, ...], Meta(min_length=1)] = (0.0, 1e-3, 1e-2)
    chunk: PositiveInt = 14  # iterations per call of the compiled program; 1,526 rollouts are 109 calls [D]
    # environments reset or updates skipped for numbers that are not finite before a run stops [D]
    nonfinite_limit: NonNegativeInt = 1000
    physics: PhysicsConfig = PhysicsConfig()
    env: EnvConfig = EnvConfig()
    command: CommandConfig = CommandConfig()
    disturbance: DisturbanceConfig = DisturbanceConfig()
    features: FeatureConfig = FeatureConfig()
    prior: PriorConfig = PriorConfig()
    amp: AMPConfig = AMPConfig()
    gail: GAILConfig = GAILConfig()
    wail: WAILConfig = WAILConfig()
    pwil: PWILConfig = PWILConfig()
    smp: SMPConfig = SMPConfig()
    add: ADDConfig = ADDConfig()
    tracking: TrackingConfig = TrackingConfig()
    ppo: PPOConfig = PPOConfig()

    @property
    def transitions_per_iteration(self) -> int:
        return self.env.count * self.ppo.rollout_steps

    @property
    def iterations(self) -> int:
        """Iterations of the budget, rounded up to whole calls of the compiled program."""
        call = self.transitions_per_iteration * self.chunk
        return -(-self.transitions // call) * self.chunk

    @property
    def control_rate(self) -> float:
        """Control steps per second, Hz."""
        return 1.0 / (self.physics.timestep * self.physics.substeps)

    def check(self) -> None:
        """Raise a `UserError` where values do not go together, in a section or between sections."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, Section):
                value.check()
        # Columns of the metrics are named after the sizes as they are printed.
        noise = [f"{size:g}" for size in self.evaluation_noise]
        if len(set(noise)) < len(noise):
            raise UserError(f"setting evaluation_noise is {', '.join(noise)}: expected each size once")
        if self.method in FOLLOWERS and self.command.kind != "phase":
            raise UserError(
                f"method is {self.method!r} and command.kind {self.command.kind!r}: expected 'phase', since "
                f"{self.method} compares each step with the demonstration at the commanded time"
            )
        longest = self.env.longest_episode
        if self.method == "pwil" and self.pwil.slack * longest >= 1:
            raise UserError(
                f"setting pwil.slack is {self.pwil.slack:g}: expected less than {1 / longest:g}, the mass of one of "
                f"the {longest} steps that an episode has"
            )
