"""Every number of the method, once, with its source.

Sources: [P] the paper; [M] MimicKit, the code base the paper builds on; of the other priors [A] acme's GAIL, [W] WAIL
(arXiv 1906.08113), [L] PWIL (arXiv 2006.04678), [S] SMP in MimicKit; [D] decided here where these are silent. The
defaults of the dataclasses are the paper's; `PRESETS` says where ``smoke`` and ``laptop`` depart from them and why.
"""

import dataclasses
import difflib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fmpjax import jsons
from fmpjax.errors import UserError


@dataclasses.dataclass(frozen=True)
class PhysicsConfig:
    """Simulation between two control steps."""

    backend: str = "auto"  # "native" (MuJoCo C on all cores), "mjx" (on the device), "auto": mjx on an accelerator [D]
    impl: str = "jax"  # implementation of MJX, "jax" or "warp" (for NVIDIA) [D]
    timestep: float = 0.005  # s, 200 Hz [D]
    substeps: int = 4  # physics steps in a control step, 50 Hz control [P]
    iterations: int = 10  # Newton iterations at most [D]
    ls_iterations: int = 20  # line-search iterations at most [D]
    frictionloss: float = 0.1  # N m, joint friction [M]
    threads: int = 0  # threads of the native backend, 0 for every core [D]
    max_contacts: int = 40  # contacts of one world: MJX in JAX keeps the nearest, Warp's buffer has room for them [D]
    max_constraints: int = 256  # constraint rows of one world in the buffers of impl="warp" [D]


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """Environments, episodes and resets."""

    count: int = 1024  # parallel environments [P]
    reset: str = "dataset"  # "dataset" (a demonstration state) or "fixed" (the default pose) [P]
    demonstration_parts: int = 8  # times per control step at which the demonstration is read; 1: samples [M: any time]
    early_frames: bool = True  # windows may begin before the demonstration, its first frame standing in [M]
    reset_noise: float = 0.0  # rad, deviation of joint angles at a training reset; ten times that in rad/s [D: none]
    episode_steps: int = 500  # control steps, 10 s [P]
    first_cap: int = 500  # episode cap at the start; below episode_steps it grows as episodes survive [P: 500]
    last_cap: int = 500  # cap at which the growth ends; evaluation plays episode_steps all the same [D]
    cap_growth: float = 1.25  # factor of a growth step [D]
    cap_share: float = 0.75  # share of episodes that end by the cap above which the cap grows [D]
    cap_patience: int = 25  # rollouts between two growth steps at least [D]
    observation: str = "full"  # "full": 237 numbers [P]; "compact": 86 that carry the same information [D]
    action: str = "absolute"  # 1.4 max|limit| around zero [M], or "residual": 0.25 effort/kp around the mean [D]

    @property
    def longest_episode(self) -> int:
        """Control steps of the longest episode in training."""
        return max(self.first_cap, min(self.last_cap, self.episode_steps))


@dataclasses.dataclass(frozen=True)
class FeatureConfig:
    """Window features of the prior."""

    history: int = 10  # frames in a window, H [P]
    axes: str = "world"  # of a window's vectors: "world" [P], or "heading", x forward in its newest frame [D]
    deviation_floor: float = 1e-4  # least standard deviation of a coordinate when standardising [M]
    angular_velocity_floor: float = 1e-4  # rad/s, the same of the joints' and the root's angular velocities [M]
    clip: float = 10.0  # standardised coordinates are clipped to this magnitude [P]


@dataclasses.dataclass(frozen=True)
class PriorConfig:
    """The transport potential and its fitting, sections III-B to III-D of the paper."""

    bank: int = 256  # windows in the expert bank and in a source bank, m = n [P]
    minibatch: int = 256  # queries of an update [P]
    updates: int = 128  # reward-model updates in a rollout [P]
    query_share: float = 0.75  # the first environments, 0-767 of 1,024, supply queries [P]
    query_is_bank: bool = False  # queries are the source bank itself: cheaper, and biased, docs/learning.md [P: no]
    hidden: tuple[int, ...] = (256, 256)  # trunk layers [P]
    learning_rate: float = 3e-4  # Adam [P]
    clip_norm: float = 10.0  # gradient-norm clip [P]
    average_half_life: float = 16.0  # updates, half-life of the parameter average [P]
    average_restarts: bool = True  # at every rollout, from the current parameters [P]
    value_scale: float = 0.10  # c0 of the value loss, eq. (value) [P]
    value_weight: float = 1.0  # [P]
    endpoint_weight: float = 1.0  # [P]
    flow_weight: float = 1.0  # [P]
    epsilon_fraction: float = 0.1  # entropy over the median cross cost [P]
    sinkhorn_threshold: float = 1e-3  # marginal error (L1) at which a solve has converged [D]
    sinkhorn_iterations: int = 200  # at most; what has not converged by then is counted [D]
    parallel_solves: int = 0  # source banks solved side by side; 0 for one on a CPU, all on an accelerator [D]
    score_banks: int = 16  # source banks that method=bank16 averages [P]
    temperature: float = 1.0  # T of method=barycentric [D]
    spread_floor: float = 1e-6  # eta, least interquartile range in the reward [D]


@dataclasses.dataclass(frozen=True)
class AdversaryConfig:
    """What the adversarial priors share, with AMP's numbers."""

    hidden: tuple[int, ...] = (1024, 512)  # ReLU layers [M]
    logit_init: float = 1.0  # the logit layer's weights are uniform in this range [M]
    updates: int = 32  # in a rollout: two passes in minibatches of two windows an environment [M]
    minibatch: int = 2048  # windows of the demonstration, as many present and as many replayed ones [M]
    replay: int = 200_000  # windows kept of earlier rollouts [M]
    replay_new: int = 1000  # windows of a rollout that go in once it is full [M]
    gradient_penalty: float = 10.0  # weight of half the squared slopes on both sides [M]
    logit_penalty: float = 0.01  # weight of the logit layer's squared weights [M]
    optimizer: str = "sgd"  # "sgd" or "adam" [M]
    learning_rate: float = 2.5e-4  # [M]
    momentum: float = 0.9  # of SGD [M]
    weight_decay: float = 1e-4  # [M]
    normalizer_clip: float = 10.0  # normalised coordinates are clipped to this magnitude [M]
    normalizer_floor: float = 1e-4  # least standard deviation of a coordinate [M]


@dataclasses.dataclass(frozen=True)
class AMPConfig(AdversaryConfig):
    """The discriminator of ``method=amp``."""

    least_probability: float = 1e-4  # caps the reward at -2 log of it [M]


@dataclasses.dataclass(frozen=True)
class GAILConfig(AdversaryConfig):
    """The discriminator of ``method=gail``: AMP's network."""

    replay: int = 0  # none: the opponent is the present policy [D]
    gradient_penalty: float = 0.0  # 0 or 10 [A]; in AMP's form [D]
    logit_penalty: float = 0.0  # none [A]
    optimizer: str = "adam"  # [A]
    learning_rate: float = 1e-5  # [A]
    weight_decay: float = 0.0  # none [A]


@dataclasses.dataclass(frozen=True)
class WAILConfig(AdversaryConfig):
    """The critic of ``method=wail``: AMP's network."""

    updates: int = 5  # two to five in a rollout [W]
    replay: int = 0  # none: the distance is to the present policy [D]
    gradient_penalty: float = 10.0  # weight of (slope - 1)^2 at random interpolates [W]
    logit_penalty: float = 0.0  # none: the slope is bounded already [W]
    optimizer: str = "adam"  # [W]
    learning_rate: float = 1e-4  # [D: WGAN-GP's]
    weight_decay: float = 0.0  # none [D]
    deviation_half_life: float = 16.0  # rollouts, of the running deviation that the reward divides by [D]
    deviation_floor: float = 1e-3  # least such deviation [D]


@dataclasses.dataclass(frozen=True)
class PWILConfig:
    """The greedy coupling of ``method=pwil``."""

    scale: float = 5.0  # alpha, the reward of a perfect step [L]
    decay: float = 5.0  # beta, of the reward with the distance [L]
    slack: float = 1e-6  # mass that a step lacks of 1 / T, so that the demonstration's never runs out [L]


@dataclasses.dataclass(frozen=True)
class SMPConfig:
    """The diffusion model of ``method=smp``."""

    network: str = "published"  # "published" [S] or "small", see `SMP_NETWORKS`
    noise_steps: int = 50  # DDPM steps, squared-cosine schedule [S]
    iterations: int = 50_000  # of pretraining, all in the first update of a run [S]
    batch: int = 512  # windows in each [S]
    learning_rate: float = 1e-4  # AdamW [S]
    weight_decay: float = 0.01  # of AdamW [D: its usual one]
    clip_norm: float = 1.0  # gradient-norm clip [S]
    average: float = 0.995  # factor of the parameter average; the average scores [S, there once in ten iterations]
    score_steps: tuple[int, ...] = (22, 15, 8)  # noise steps at which windows are scored [S]
    score_batch: int = 4096  # windows scored side by side, which bounds the memory that this takes [S]
    scale: float = 1.0  # the reward of a window without error [S]
    decay: float = 6.0  # of the reward with the error relative to its running mean [S]
    error_floor: float = 1e-4  # least running mean of the error [S]
    mean_samples: float = 5e7  # windows after which that running mean stays [S, its G1 variant]


# Transformer layers, heads, numbers a head.
SMP_NETWORKS = {
    "published": (2, 4, 64),  # [S]
    "small": (1, 2, 32),  # a thirtieth of the arithmetic, for a CPU [D]
}


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Policy optimisation, section IV-A of the paper."""

    rollout_steps: int = 32  # control steps in a rollout [P]
    hidden: tuple[int, ...] = (1024, 512)  # actor and critic layers, separate networks [M]
    activation: str = "relu"  # [M]
    mean_init: float = 0.01  # actor's mean weights are uniform in this range [M]
    orthogonal: bool = False  # orthogonal weights in place of uniform ones within 1 / sqrt(inputs) [M: no]
    deviation: float = 0.05  # standard deviation in normalised actions at the start [M]
    learn_deviation: bool = False  # learn it, one number a joint [M: fixed]
    least_deviation: float = 0.05  # floor of a learned deviation [D]
    optimizer: str = "sgd"  # "sgd" or "adam" [M]
    learning_rate: float = 1e-4  # [P]
    momentum: float = 0.9  # of SGD [M]
    clip_norm: float = 0.0  # gradient-norm clip, 0 for none [M]
    target_kl: float = 0.0  # 0 keeps the rate; else it falls above and rises below, see `ppo.adapt_rate` [M: 0]
    critic_epochs: int = 2  # [M]
    critic_batch: int = 2  # samples an environment in a minibatch [M]
    actor_epochs: int = 5  # [M]
    actor_batch: int = 4  # [M]
    discount: float = 0.99  # gamma [P]
    gae_lambda: float = 0.95  # [P]
    fall_value: float = 0.0  # return from a fall on, in rewards [M: nothing]
    clip: float = 0.2  # probability-ratio clip [P]
    advantage_clip: float = 4.0  # normalised advantages are clipped to this magnitude [M]
    bound_penalty: float = 10.0  # weight of sum max(|mean| - 1, 0)^2 [M]
    normalizer_clip: float = 10.0  # normalised observations are clipped to this magnitude [M]
    normalizer_floor: float = 1e-4  # least standard deviation of an observation [M]
    normalizer_from_clip: bool = False  # start the running statistics from the demonstration [M: no]
    normalizer_count: int = 0  # cap of the running count, which then forgets slowly; 0 for none [M: 0]


@dataclasses.dataclass(frozen=True)
class Config:
    """One run."""

    method: str = "fmp"
    robot: str = "unitree_g1_29dof"  # [M]
    motion: str = "walk"  # a bundled motion's name or a file; several as NAME[:WEIGHT],NAME[:WEIGHT]
    frames: str = ""  # source rows "first:last" of the motion, both included; empty for all
    preset: str = "paper"
    seed: int = 0
    precision: str = "float32"  # of the networks' matrix products [M]; "default" is TF32 on NVIDIA
    transitions: int = 50_003_968  # budget [P]
    # Simulation goes on through an evaluation, where the paper's starts anew [D].
    evaluations: tuple[float, ...] = (0.1, 0.2, 0.4, 0.6, 0.8, 1.0)  # shares of the budget at which to evaluate [P]
    evaluation_episodes: int = 1024  # first episodes of an evaluation [P]
    # rad, deviations of joint angles at an evaluation's starts, ten times that in rad/s; docs/metrics.md [D: none]
    evaluation_noise: tuple[float, ...] = (0.0, 1e-3, 1e-2)
    chunk: int = 14  # iterations in one call of the compiled program; 1,526 rollouts are 109 calls [D]
    nonfinite_limit: int = 1000  # environments reset or updates skipped for non-finite numbers before a run stops [D]
    physics: PhysicsConfig = PhysicsConfig()
    env: EnvConfig = EnvConfig()
    features: FeatureConfig = FeatureConfig()
    prior: PriorConfig = PriorConfig()
    amp: AMPConfig = AMPConfig()
    gail: GAILConfig = GAILConfig()
    wail: WAILConfig = WAILConfig()
    pwil: PWILConfig = PWILConfig()
    smp: SMPConfig = SMPConfig()
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
        """Control steps a second, Hz."""
        return 1.0 / (self.physics.timestep * self.physics.substeps)


# What walks on two cores in a quarter of an hour. Each departure from the paper, and why:
# - physics at 100 Hz without joint friction, five Newton iterations: three times the paper's rate on a CPU;
# - 128 environments, 256 episodes an evaluation: many small policy updates in few transitions;
# - actions are residuals around the demonstration's mean pose, each joint's as wide as a quarter of what its motor can
#   hold; the observation's statistics start from the demonstration's and follow the policy's: the first policy stands
#   about upright and sees numbers of order one. So from the fixed pose, too, the policy is given the demonstration's
#   mean pose and the spread of its states, though never a state;
# - 86 observed numbers that carry what the 237 do: fewer to multiply;
# - an episode cap that grows from 64 steps to 150, a time-out being no end: docs/learning.md says what either does;
# - discount 0.97: a median-centred reward pays one a step for mere survival, worth 1/(1 - gamma); lambda 0.9, since a
#   policy gradient from so small a rollout is mostly noise;
# - three reward updates a rollout of 4,096: the reward changes little between so small rollouts; the average of the
#   potential's parameters goes on over rollouts, since three updates are too few to average;
# - queries from every environment, as few as they are; a floor of 1e-3 under the reward's spread, below which scores
#   are the fit's noise;
# - feature deviations floored at 0.05, those of angular velocities at 0.5 rad/s: coordinates that the demonstration
#   hardly moves would carry the distance;
# - Adam with a rate that follows the KL divergence and a critic's loss in units of the return's variance, a gradient
#   clip, small networks (ELU, orthogonal), five epochs of both, learned deviation: sample efficiency. No bound penalty:
#   a residual that is too large is clipped at the joint's range;
# - AMP with Adam, a smaller network and replay, and as many updates and samples in each as the potential has; GAIL and
#   WAIL with the same network and samples; GAIL with as many updates and AMP's rate, since 1e-5 hardly moves in so few;
# - SMP with a smaller network, fewer and smaller iterations and the larger rate that these allow: pretraining takes
#   seconds to minutes instead of hours on two cores. It is not the published prior, and `smp.network` says so. Its
#   reward is scaled by e^6 or so: an average window earns 1, which the critic finds, and not 0.0025.
_LAPTOP: dict[str, Any] = {
    "robot": "unitree_g1",
    "precision": "default",
    "transitions": 6_000_000,
    "evaluations": (0.2, 0.3, 0.4, 0.55, 0.7, 0.85, 1.0),
    "evaluation_episodes": 256,
    "chunk": 25,
    "physics.timestep": 0.01,
    "physics.substeps": 2,
    "physics.iterations": 5,
    "physics.ls_iterations": 5,
    "physics.frictionloss": 0.0,
    "env.count": 128,
    "env.first_cap": 64,
    "env.last_cap": 150,
    "env.demonstration_parts": 1,
    "env.early_frames": False,
    "env.observation": "compact",
    "env.action": "residual",
    "features.deviation_floor": 0.05,
    "features.angular_velocity_floor": 0.5,
    "prior.updates": 3,
    "prior.average_restarts": False,
    "prior.query_share": 1.0,
    "prior.spread_floor": 1e-3,
    "amp.hidden": (256, 128),
    "amp.updates": 3,
    "amp.minibatch": 256,
    "amp.replay": 40_000,
    "amp.optimizer": "adam",
    "amp.learning_rate": 1e-4,
    "gail.hidden": (256, 128),
    "gail.updates": 3,
    "gail.minibatch": 256,
    "gail.learning_rate": 1e-4,
    "wail.hidden": (256, 128),
    "wail.minibatch": 256,
    "smp.network": "small",
    "smp.iterations": 2000,
    "smp.batch": 128,
    "smp.learning_rate": 1e-3,
    "smp.scale": 400.0,
    "ppo.hidden": (256, 128),
    "ppo.activation": "elu",
    "ppo.orthogonal": True,
    "ppo.deviation": 0.35,
    "ppo.learn_deviation": True,
    "ppo.optimizer": "adam",
    "ppo.learning_rate": 5e-4,
    "ppo.clip_norm": 1.0,
    "ppo.target_kl": 0.03,
    "ppo.critic_epochs": 5,
    "ppo.critic_batch": 8,
    "ppo.actor_epochs": 5,
    "ppo.actor_batch": 8,
    "ppo.discount": 0.97,
    "ppo.gae_lambda": 0.9,
    "ppo.bound_penalty": 0.0,
    "ppo.normalizer_from_clip": True,
    "ppo.normalizer_count": 2_000_000,
}

# The whole path, small: nothing is learned, everything runs.
_SMOKE: dict[str, Any] = _LAPTOP | {
    "transitions": 16 * 32 * 20,
    "evaluations": (0.5, 1.0),
    "evaluation_episodes": 8,
    "chunk": 5,
    "env.count": 16,
    "prior.bank": 64,
    "prior.minibatch": 64,
    "prior.updates": 2,
    "prior.score_banks": 2,
    "amp.hidden": (64, 64),
    "amp.updates": 2,
    "amp.minibatch": 64,
    "amp.replay": 1000,
    "gail.hidden": (64, 64),
    "gail.updates": 2,
    "gail.minibatch": 64,
    "wail.hidden": (64, 64),
    "wail.updates": 2,
    "wail.minibatch": 64,
    "smp.iterations": 20,
    "smp.batch": 32,
    "ppo.hidden": (64, 64),
}

PRESETS: Mapping[str, Mapping[str, Any]] = {"smoke": _SMOKE, "laptop": _LAPTOP, "paper": {}}
DESCRIPTIONS = {
    "smoke": "the whole path in a minute; learns nothing",
    "laptop": "walks after about a quarter of an hour on two cores",
    "paper": "the paper's setting, for an accelerator",
}


def preset(name: str, /, **changes: Any) -> Config:
    """A preset's configuration with changes, given as ``section.field`` keys.

    Raises:
      UserError: unknown preset or field, or a value of the wrong type.
    """
    if name not in PRESETS:
        raise UserError(f"unknown preset {name!r}: expected one of {', '.join(PRESETS)}")
    return validate(with_changes(Config(preset=name), {**PRESETS[name], **changes}))


def with_changes(config: Config, changes: Mapping[str, Any]) -> Config:
    """``config`` with ``section.field`` or ``field`` keys replaced; strings are read as the field's type."""
    for key, value in changes.items():
        section, _, field = key.rpartition(".")
        target = getattr(config, section, None) if section else config
        names = [f.name for f in dataclasses.fields(target)] if dataclasses.is_dataclass(target) else []
        if field not in names or dataclasses.is_dataclass(getattr(target, field)):
            known = list(flatten(config))
            close = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else "see `fmpjax config` for all of them"
            raise UserError(f"unknown setting {key!r}: {hint}")
        value = _convert(key, value, getattr(target, field))
        target = dataclasses.replace(target, **{field: value})
        config = dataclasses.replace(config, **{section: target}) if section else target
    return config


def _convert(key: str, value: Any, like: Any) -> Any:
    kind = type(like)
    try:
        if kind is tuple:
            items = value.strip("()[] ").split(",") if isinstance(value, str) else value
            values = tuple(type(like[0])(item) for item in items if item != "")
            if not all(map(math.isfinite, values)):
                raise ValueError
            return values
        if kind is bool and isinstance(value, str):
            return {"true": True, "1": True, "false": False, "0": False}[value.lower()]
        if kind is int and isinstance(value, str):
            return int(value.replace("_", ""))
        if kind is int and (isinstance(value, bool) or value != int(value)):
            raise ValueError
        if kind is float and not math.isfinite(float(value)):
            raise ValueError
        return kind(value)
    except (ValueError, TypeError, KeyError, OverflowError):
        raise UserError(f"setting {key} is {value!r}: expected {kind.__name__} such as {like!r}") from None


def flatten(config: Config) -> dict[str, Any]:
    """All settings by ``section.field`` key."""
    flat = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            flat |= {f"{field.name}.{f.name}": getattr(value, f.name) for f in dataclasses.fields(value)}
        else:
            flat[field.name] = value
    return flat


def to_json(config: Config) -> str:
    """The settings as a flat JSON object."""
    return jsons.dumps(flatten(config))


# What settings were before they existed, where that is not the default: what an older file without them means.
_BEFORE: dict[str, Any] = {
    "precision": "default",
    "env.demonstration_parts": 1,
    "env.early_frames": False,
    "evaluation_noise": (0.0,),
}


def from_json(text: str) -> Config:
    """The configuration that `to_json` wrote."""
    settings = json.loads(text)
    if not isinstance(settings, dict):
        raise json.JSONDecodeError("no object", text, 0)
    return validate(with_changes(Config(), {**_BEFORE, **settings}))


def read(path: Path) -> Config:
    """The configuration in a run's ``config.json``.

    Raises:
      UserError: the file holds none.
    """
    try:
        return from_json(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise UserError(f"{path} is not valid JSON: expected a run's configuration") from None


_CHOICES = {
    "env.reset": ("dataset", "fixed"),
    "env.observation": ("full", "compact"),
    "features.axes": ("world", "heading"),
    "env.action": ("absolute", "residual"),
    "amp.optimizer": ("sgd", "adam"),
    "gail.optimizer": ("sgd", "adam"),
    "wail.optimizer": ("sgd", "adam"),
    "smp.network": tuple(SMP_NETWORKS),
    "physics.backend": ("auto", "native", "mjx"),
    "physics.impl": ("jax", "warp"),
    "ppo.optimizer": ("sgd", "adam"),
    "precision": ("float32", "default"),
    "ppo.activation": ("relu", "elu", "swish", "tanh"),
}
_POSITIVE = (
    "transitions env.count env.demonstration_parts env.episode_steps env.first_cap ppo.rollout_steps "
    "physics.timestep physics.substeps "
    "features.deviation_floor features.angular_velocity_floor features.clip prior.bank prior.minibatch "
    "prior.updates prior.learning_rate ppo.learning_rate ppo.deviation chunk evaluation_episodes "
    "prior.spread_floor prior.value_scale env.last_cap prior.score_banks prior.temperature amp.updates "
    "amp.minibatch amp.replay amp.replay_new amp.learning_rate gail.updates gail.minibatch gail.replay_new "
    "gail.learning_rate wail.updates wail.minibatch wail.replay_new wail.learning_rate wail.deviation_half_life "
    "wail.deviation_floor pwil.scale pwil.decay smp.noise_steps smp.iterations smp.batch smp.scale smp.learning_rate "
    "smp.clip_norm smp.decay smp.error_floor smp.mean_samples smp.score_batch"
).split()


def validate(config: Config) -> Config:
    """The configuration itself, or a `UserError` naming the first setting that cannot be."""
    flat = flatten(config)
    for key, allowed in _CHOICES.items():
        if flat[key] not in allowed:
            raise UserError(f"unknown {key.rpartition('.')[2]} {flat[key]!r}: expected one of {', '.join(allowed)}")
    for key in _POSITIVE:
        if not flat[key] > 0:
            raise UserError(f"setting {key} is {flat[key]}: expected more than 0")
    for key in (
        "prior.parallel_solves physics.threads env.reset_noise gail.replay gail.gradient_penalty wail.replay "
        "wail.gradient_penalty pwil.slack smp.weight_decay"
    ).split():
        if flat[key] < 0:
            raise UserError(f"setting {key} is {flat[key]}: expected 0 or more")
    noise = config.evaluation_noise
    # Columns of the metrics are named after the sizes as they are printed.
    if not noise or min(noise) < 0 or len({f"{size:g}" for size in noise}) < len(noise):
        raise UserError(
            f"setting evaluation_noise is {', '.join(f'{size:g}' for size in noise) or 'empty'}: "
            "expected sizes of 0 or more, in rad, each once"
        )
    for key in ("ppo.discount", "ppo.gae_lambda", "prior.query_share"):
        if not 0 < flat[key] <= 1:
            raise UserError(f"setting {key} is {flat[key]}: expected a number in (0, 1]")
    if not 0 <= config.smp.average < 1:
        raise UserError(f"setting smp.average is {config.smp.average}: expected a number in [0, 1)")
    steps = config.smp.score_steps
    if not steps or not all(0 <= step < config.smp.noise_steps for step in steps):
        raise UserError(
            f"setting smp.score_steps is {', '.join(map(str, steps)) or 'empty'}: expected noise steps from 0 to "
            f"{config.smp.noise_steps - 1}, below smp.noise_steps"
        )
    longest = config.env.longest_episode
    if config.method == "pwil" and config.pwil.slack * longest >= 1:
        raise UserError(
            f"setting pwil.slack is {config.pwil.slack:g}: expected less than {1 / longest:g}, the mass of one of the "
            f"{longest} steps that an episode has"
        )
    if not 0 <= config.seed < 2**32:
        raise UserError(f"setting seed is {config.seed}: expected 0 to {2**32 - 1}")
    if not 2 <= config.features.history <= 64:
        raise UserError(f"setting features.history is {config.features.history}: expected 2 to 64 frames")
    if config.prior.query_is_bank and config.prior.minibatch != config.prior.bank:
        raise UserError(
            f"setting prior.minibatch is {config.prior.minibatch}: expected prior.bank, {config.prior.bank}, "
            "since prior.query_is_bank makes the source bank the minibatch"
        )
    for phase in ("critic", "actor"):
        batch = flat[f"ppo.{phase}_batch"]
        if batch < 1 or config.ppo.rollout_steps % batch:
            raise UserError(
                f"setting ppo.{phase}_batch is {batch}: expected a divisor of ppo.rollout_steps, "
                f"{config.ppo.rollout_steps}, so that minibatches are equal"
            )
    return config
