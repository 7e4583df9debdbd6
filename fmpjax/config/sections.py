"""The settings: a frozen dataclass for each section, and `Config`, which holds them.

A field states its type with its choices or bounds, its default, which is the paper's, and in a comment its meaning, its
unit and its source. `reading` checks values by these types; `fmpjax settings` and docs/settings.md print all of it. A
rule about several fields is in the ``check`` of their section, or of `Config` where they are of several sections.
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

    # "native": MuJoCo C on all cores; "mjx": on the device; "auto": mjx on an accelerator, else native [D]
    backend: Literal["auto", "native", "mjx"] = "auto"
    impl: Literal["jax", "warp"] = "jax"  # implementation of MJX; "warp" is for NVIDIA GPUs [D]
    timestep: PositiveFloat = 0.005  # s, length of a physics step; 0.005 s are 200 Hz [D]
    substeps: PositiveInt = 4  # physics steps per control step; 4 of 0.005 s give 50 Hz control [P]
    iterations: PositiveInt = 10  # maximum number of Newton iterations of the solver [D]
    ls_iterations: PositiveInt = 20  # maximum number of iterations of its line search [D]
    frictionloss: NonNegativeFloat = 0.1  # N m, dry friction of each joint [M]
    threads: NonNegativeInt = 0  # CPU threads of the native backend; 0: all cores [D]
    # contacts per environment: MJX in JAX keeps the nearest ones, Warp's buffer holds them [D]
    max_contacts: PositiveInt = 40
    max_constraints: PositiveInt = 256  # constraint rows per environment in the buffers of impl="warp" [D]


@dataclasses.dataclass(frozen=True)
class EnvConfig(Section):
    """Environments, episodes and resets."""

    count: PositiveInt = 1024  # number of parallel environments [P]
    # episodes start in a state of the demonstration ("dataset") or in the default pose ("fixed") [P]
    reset: Literal["dataset", "fixed"] = "dataset"
    # states of the demonstration per control step, between its samples, too; 1: its samples [M: any time]
    demonstration_parts: PositiveInt = 8
    early_frames: bool = True  # windows may begin before the demonstration; they repeat its first frame there [M]
    # rad, standard deviation of noise on joint angles at training resets; on velocities ten times that in rad/s [D]
    reset_noise: NonNegativeFloat = 0.0
    episode_steps: PositiveInt = 500  # control steps per episode, 10 s [P]
    # control steps, longest episode at the start of training; it grows while episodes survive [P: 500]
    first_cap: PositiveInt = 500
    # control steps, longest episode at the end of this growth; evaluations play episode_steps [D]
    last_cap: PositiveInt = 500
    cap_growth: PositiveFloat = 1.25  # factor by which this cap grows at a time [D]
    cap_share: NonNegativeFloat = 0.75  # the cap grows if a larger share of the episodes than this reaches it [D]
    cap_patience: NonNegativeInt = 25  # minimum number of rollouts between two growth steps [D]
    # what the policy observes on the G1: "full", 237 numbers [P]; "compact", 86 numbers with the same information [D];
    # "deployable", only what a robot senses, docs/robustness.md [D]
    observation: Literal["full", "compact", "deployable"] = "full"
    observation_history: PositiveInt = 1  # control steps of sensor values that a deployable policy observes [D]
    # axes of observed vectors: "world" [P], or "heading", x where the root faces [D]
    axes: Literal["world", "heading"] = "world"
    # unit of an action: "absolute", 1.4 max|limit| around zero [M]; "residual", 0.25 effort/kp around the
    # demonstration's mean pose [D]
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
    """What the policy is told to do, and the reward for following it."""

    # command: none [P], a velocity in the heading frame, the time in the clip ("phase"), or one of several motions [D]
    kind: Literal["none", "velocity", "phase", "motion"] = "none"
    # how the prior's reward and the command's are combined; "prior" and "command": only that one's counts [D]
    combine: Literal["product", "sum", "prior", "command"] = "product"
    weight: PositiveFloat = 1.0  # weight of the command's reward in a sum [D]
    # each motion has a prior of its own, for the steps in which the policy is told this motion [D]
    labeled: bool = False
    hold: tuple[float, ...] = (1.0, 3.0)  # s, shortest and longest time until a new velocity or motion is drawn [D]
    zero: Annotated[float, Meta(ge=0, le=1)] = 0.1  # share of the drawn velocities that are zero [D]
    # m/s, slowest and fastest velocity ahead; if all three ranges are empty: the demonstrations' own velocities [D]
    ahead: tuple[float, ...] = ()
    # m/s, slowest and fastest velocity to the left; empty: 0 if another range is given [D]
    sideways: tuple[float, ...] = ()
    # rad/s, slowest and fastest turning to the left; empty: 0 if another range is given [D]
    turn: tuple[float, ...] = ()
    # m/s² and rad/s², how fast the policy is told of a new velocity; empty: at once [D]
    ramp: tuple[PositiveFloat, ...] = ()
    average: PositiveFloat = 0.5  # s, time constant of the running means of errors and distances [D: half a stride]
    # m/s and rad/s; a larger error counts in this mean by its logarithm [D: the whole error asks for a leap]
    error_scale: PositiveFloat = 0.3
    speed_width: PositiveFloat = 0.2  # m/s, error of the speed that halves its reward [D]
    turn_width: PositiveFloat = 0.25  # rad/s, error of the turning rate that halves its reward [D]

    @property
    def ranges(self) -> tuple[tuple[float, ...], ...] | None:
        """Ends of the velocity's three components, ``[3, 2]``; None for the demonstrations' own velocities."""
        given = (self.ahead, self.sideways, self.turn)
        return tuple(ends or (0.0, 0.0) for ends in given) if any(given) else None

    def require(self, *kinds: str) -> None:
        """Raise a `UserError` where a run's command is of none of the kinds."""
        if self.kind not in kinds:
            raise UserError(f"the run's command.kind is {self.kind!r}: expected {' or '.join(map(repr, kinds))}")

    def check(self) -> None:
        """Raise a `UserError` where a range is none."""
        for name in ("hold", "ahead", "sideways", "turn"):
            ends = getattr(self, name)
            if (ends or name == "hold") and not (len(ends) == 2 and ends[0] <= ends[1]):
                raise UserError(
                    f"setting command.{name} is {', '.join(f'{end:g}' for end in ends) or 'empty'}: expected two "
                    "numbers, the lower one first"
                )
        if len(self.ramp) not in (0, 2):
            raise UserError(
                f"setting command.ramp is {', '.join(f'{limit:g}' for limit in self.ramp)}: expected two numbers, "
                "m/s² and rad/s², or none"
            )
        if self.labeled and self.kind != "motion":
            raise UserError(f"setting command.labeled is true and command.kind {self.kind!r}: expected 'motion'")
        if not self.hold[0] > 0:
            raise UserError(f"setting command.hold begins with {self.hold[0]:g}: expected more than 0 s")


@dataclasses.dataclass(frozen=True)
class FeatureConfig(Section):
    """Features of the windows that the prior scores."""

    history: Annotated[int, Meta(ge=2, le=64)] = 10  # frames per window, H [P]
    # axes of a window's vectors: "world" [P], or "heading", x where the root of the newest frame faces [D]
    axes: Literal["world", "heading"] = "world"
    deviation_floor: PositiveFloat = 1e-4  # smallest standard deviation by which a coordinate is divided [M]
    angular_velocity_floor: PositiveFloat = 1e-4  # rad/s, the same for angular velocities of joints and root [M]
    clip: PositiveFloat = 10.0  # limit on the magnitude of standardized coordinates [P]


@dataclasses.dataclass(frozen=True)
class PriorConfig(Section):
    """The transport potential and its fitting, sections III-B to III-D of the paper."""

    bank: PositiveInt = 256  # windows in the expert bank and in each source bank, m = n [P]
    minibatch: PositiveInt = 256  # queries per update of the network [P]
    updates: PositiveInt = 128  # updates of the network per rollout [P]
    query_share: Fraction = 0.75  # share of the environments that supply queries: the first ones, 0-767 of 1,024 [P]
    # the source bank's windows are the queries: cheaper, but biased, docs/learning.md [P: no]
    query_is_bank: bool = False
    hidden: Widths = (256, 256)  # units of the hidden layers in the trunk [P]
    learning_rate: PositiveFloat = 3e-4  # learning rate of Adam [P]
    clip_norm: PositiveFloat = 10.0  # limit on the norm of the gradient [P]
    average_half_life: PositiveFloat = 16.0  # updates, half-life of the running average of the parameters [P]
    average_restarts: bool = True  # the average restarts from the current parameters at each rollout [P]
    value_scale: PositiveFloat = 0.10  # c0, scale of the value loss, eq. (value) [P]
    value_weight: NonNegativeFloat = 1.0  # weight of the value loss [P]
    endpoint_weight: NonNegativeFloat = 1.0  # weight of the endpoint loss [P]
    flow_weight: NonNegativeFloat = 1.0  # weight of the flow loss [P]
    # entropic regularization, as a fraction of the median cost between the two banks [P]
    epsilon_fraction: NonNegativeFloat = 0.1
    sinkhorn_threshold: NonNegativeFloat = 1e-3  # marginal error (L1) at which a Sinkhorn solve has converged [D]
    # maximum number of iterations of a solve; solves that have not converged are counted [D]
    sinkhorn_iterations: PositiveInt = 200
    # source banks solved at the same time; 0: one on a CPU, all on an accelerator [D]
    parallel_solves: NonNegativeInt = 0
    score_banks: PositiveInt = 16  # number of source banks that method=bank16 averages [P]
    temperature: PositiveFloat = 1.0  # T, temperature of method=barycentric [D]
    # eta, smallest interquartile range by which scores are divided in the reward [D]
    spread_floor: PositiveFloat = 1e-6

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
    hidden: Widths = (1024, 512)  # units of the hidden layers of actor and critic, which are separate networks [M]
    # hidden layers of a network that estimates the root's height and velocity for an actor that cannot observe them [D]
    estimator: tuple[PositiveInt, ...] = ()
    activation: Literal["relu", "elu", "swish", "tanh"] = "relu"  # activation of the hidden layers [M]
    mean_init: NonNegativeFloat = 0.01  # the weights of the actor's last layer start uniform up to this magnitude [M]
    orthogonal: bool = False  # orthogonal initial weights instead of uniform ones within 1 / sqrt(inputs) [M: no]
    deviation: PositiveFloat = 0.05  # standard deviation of the normalized actions at the start [M]
    learn_deviation: bool = False  # learn the standard deviation, one number per joint [M: fixed]
    least_deviation: PositiveFloat = 0.05  # smallest value of a learned standard deviation [D]
    optimizer: Optimizer = "sgd"  # optimizer of actor and critic [M]
    learning_rate: PositiveFloat = 1e-4  # learning rate of the optimizer [P]
    momentum: Decay = 0.9  # momentum of SGD; Adam does not use it [M]
    clip_norm: NonNegativeFloat = 0.0  # limit on the norm of the gradient; 0: none [M]
    # KL divergence at which the learning rate aims, `ppo.adapt_rate`; 0: the rate stays as it is [M: 0]
    target_kl: NonNegativeFloat = 0.0
    critic_epochs: PositiveInt = 2  # passes of the critic over a rollout [M]
    critic_batch: PositiveInt = 2  # samples per environment in a minibatch of the critic [M]
    actor_epochs: PositiveInt = 5  # passes of the actor over a rollout [M]
    actor_batch: PositiveInt = 4  # samples per environment in a minibatch of the actor [M]
    discount: Fraction = 0.99  # gamma, discount of future rewards [P]
    gae_lambda: Fraction = 0.95  # lambda of the generalized advantage estimate [P]
    fall_value: float = 0.0  # return after a fall, in rewards [M: 0]
    # share of the budget, at its end, in which the three values below take the place of the discount, lambda and KL
    # divergence above [D]
    settle: Annotated[float, Meta(ge=0, le=1)] = 0.0
    settle_discount: Fraction = 0.985  # gamma at the end [D]
    settle_gae_lambda: Fraction = 0.95  # lambda at the end [D]
    settle_target_kl: PositiveFloat = 0.008  # KL divergence at the end [D]
    clip: PositiveFloat = 0.2  # limit on the distance of the probability ratio from 1 [P]
    advantage_clip: PositiveFloat = 4.0  # limit on the magnitude of normalized advantages [M]
    bound_penalty: NonNegativeFloat = 10.0  # weight of the penalty sum max(|mean| - 1, 0)^2 on the mean action [M]
    normalizer_clip: PositiveFloat = 10.0  # limit on the magnitude of normalized observations [M]
    normalizer_floor: PositiveFloat = 1e-4  # smallest standard deviation by which an observation is divided [M]
    normalizer_from_clip: bool = False  # start the running statistics of observations from the demonstration [M: no]
    # limit on the count of these statistics, which then forget slowly; 0: none [M: 0]
    normalizer_count: NonNegativeInt = 0
    # weight of the squared difference between the mean action in a mirrored state and the mirrored mean action [D]
    mirror: NonNegativeFloat = 0.0
    # distance of a state from its own mirror image, rms over the normalized observation, at which it counts half in
    # the mirror loss, so that a symmetric state may choose a side; 0: all states count alike [D]
    mirror_width: NonNegativeFloat = 0.0

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

    method: str = "fmp"  # motion prior; `fmpjax list` prints the names [P]
    robot: str = "unitree_g1_29dof"  # name of a shipped robot, or the path of a robot's folder [M]
    # name of a bundled motion, a file, or an address (https://, hf://); several are separated by commas, with weights
    # as NAME:WEIGHT [D]
    motion: str = "walk"
    frames: str = ""  # rows of the motion's file as "first:last", both included; empty: all [D]
    preset: str = "paper"  # preset from which the other settings start
    seed: Annotated[int, Meta(ge=0, le=2**32 - 1)] = 0  # seed of all random numbers [D]
    # precision of the networks' products [M]; "bfloat16": rounded factors, summed in float32, faster on CPUs with
    # instructions for it [D]; "default": TF32 on NVIDIA GPUs
    precision: Literal["float32", "bfloat16", "default"] = "float32"
    transitions: PositiveInt = 50_003_968  # budget: environment steps of the whole run [P]
    # shares of the budget at which the policy is evaluated [P]; episodes of the training continue, the paper's restart
    # [D]
    evaluations: tuple[Fraction, ...] = (0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
    evaluation_episodes: PositiveInt = 1024  # first episodes per evaluation [P]
    # rad, standard deviations of noise on joint angles at the start of evaluated episodes; on velocities ten times that
    # in rad/s, docs/metrics.md [D]
    evaluation_noise: Annotated[tuple[NonNegativeFloat, ...], Meta(min_length=1)] = (0.0, 1e-3, 1e-2)
    chunk: PositiveInt = 14  # iterations per call of the compiled program; 1,526 rollouts are 109 calls [D]
    # number of resets and skipped updates, because of numbers that are not finite, after which a run stops [D]
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
    def settles_at(self) -> int:
        """The iteration from which the policy settles; that after the last one where it never does."""
        return round((1.0 - self.ppo.settle) * self.iterations)

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
        if self.ppo.estimator and (self.env.observation, self.env.axes) != ("deployable", "heading"):
            raise UserError(
                f"setting ppo.estimator is {', '.join(map(str, self.ppo.estimator))}: expected nothing unless "
                f"env.observation is 'deployable' and env.axes 'heading' (now {self.env.observation!r} and "
                f"{self.env.axes!r}), for it estimates a velocity in heading axes that this observation leaves out"
            )
        if self.command.labeled and self.method in ("pwil", "smp"):
            raise UserError(
                f"setting command.labeled is true and method {self.method!r}: expected a method that learns while the "
                "policy does, and that scores each window by itself"
            )
        longest = self.env.longest_episode
        if self.method == "pwil" and self.pwil.slack * longest >= 1:
            raise UserError(
                f"setting pwil.slack is {self.pwil.slack:g}: expected less than {1 / longest:g}, the mass of one of "
                f"the {longest} steps that an episode has"
            )
