"""The settings of the rewards that FMP is compared with."""

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
from fmpjax.errors import UserError

# Methods that compare each step with the demonstration at the same time, which only the command `phase` tells.
FOLLOWERS = ("add", "tracking")


@dataclasses.dataclass(frozen=True)
class AdversaryConfig(Section):
    """What the adversarial priors share, with AMP's numbers."""

    hidden: Widths = (1024, 512)  # units of the hidden layers, with ReLU [M]
    logit_init: NonNegativeFloat = 1.0  # the weights of the logit layer start uniform up to this magnitude [M]
    updates: PositiveInt = 32  # updates per rollout: two passes in minibatches of two windows per environment [M]
    # windows of the demonstration per update; as many current and as many replayed ones [M]
    minibatch: PositiveInt = 2048
    replay: PositiveInt = 200_000  # windows of earlier rollouts that are kept [M]
    replay_new: PositiveInt = 1000  # windows per rollout that are added once the replay is full [M]
    gradient_penalty: NonNegativeFloat = 10.0  # weight of half the squared slopes at windows of both sides [M]
    logit_penalty: NonNegativeFloat = 0.01  # weight of the squared weights of the logit layer [M]
    optimizer: Optimizer = "sgd"  # optimizer of the network [M]
    learning_rate: PositiveFloat = 2.5e-4  # learning rate of the optimizer [M]
    momentum: Decay = 0.9  # momentum of SGD; Adam does not use it [M]
    weight_decay: NonNegativeFloat = 1e-4  # weight decay of the optimizer [M]
    normalizer_clip: PositiveFloat = 10.0  # limit on the magnitude of normalized coordinates [M]
    normalizer_floor: PositiveFloat = 1e-4  # smallest standard deviation by which a coordinate is divided [M]


@dataclasses.dataclass(frozen=True)
class AMPConfig(AdversaryConfig):
    """The discriminator of ``method=amp``."""

    # smallest probability in the reward, which limits the reward to -2 log of it [M]
    least_probability: Fraction = 1e-4


@dataclasses.dataclass(frozen=True)
class GAILConfig(AdversaryConfig):
    """The discriminator of ``method=gail``: AMP's network."""

    replay: NonNegativeInt = 0  # windows of earlier rollouts that are kept; 0: the opponent is the current policy [D]
    gradient_penalty: NonNegativeFloat = 0.0  # weight of half the squared slopes, in AMP's form [D]; 0 or 10 [A]
    logit_penalty: NonNegativeFloat = 0.0  # weight of the squared weights of the logit layer [A: none]
    optimizer: Optimizer = "adam"  # optimizer of the network [A]
    learning_rate: PositiveFloat = 1e-5  # learning rate of the optimizer [A]
    weight_decay: NonNegativeFloat = 0.0  # weight decay of the optimizer [A: none]


@dataclasses.dataclass(frozen=True)
class WAILConfig(AdversaryConfig):
    """The critic of ``method=wail``: AMP's network."""

    updates: PositiveInt = 5  # updates per rollout; two to five [W]
    # windows of earlier rollouts that are kept; 0: the distance is to the current policy [D]
    replay: NonNegativeInt = 0
    gradient_penalty: NonNegativeFloat = 10.0  # weight of (slope - 1)^2 at random points between the two sides [W]
    # weight of the squared weights of the logit layer; the slope penalty is enough [W]
    logit_penalty: NonNegativeFloat = 0.0
    optimizer: Optimizer = "adam"  # optimizer of the network [W]
    learning_rate: PositiveFloat = 1e-4  # learning rate of the optimizer [D: WGAN-GP's]
    weight_decay: NonNegativeFloat = 0.0  # weight decay of the optimizer [D: none]
    # rollouts, half-life of the running deviation by which the reward is divided [D]
    deviation_half_life: PositiveFloat = 16.0
    deviation_floor: PositiveFloat = 1e-3  # smallest value of this deviation [D]


@dataclasses.dataclass(frozen=True)
class PWILConfig(Section):
    """The greedy coupling of ``method=pwil``."""

    scale: PositiveFloat = 5.0  # alpha, reward of a perfect step [L]
    decay: PositiveFloat = 5.0  # beta, how fast the reward falls with the distance [L]
    # the mass of a step is less than 1 / T by this, so that the demonstration's mass lasts [L]
    slack: NonNegativeFloat = 1e-6


# Transformer layers, heads, numbers per head.
SMP_NETWORKS = {
    "published": (2, 4, 64),  # [S]
    "small": (1, 2, 32),  # a thirtieth of the arithmetic, for a CPU [D]
}


@dataclasses.dataclass(frozen=True)
class SMPConfig(Section):
    """The diffusion model of ``method=smp``."""

    # size of the network: "published" [S], or "small" with a thirtieth of the arithmetic [D]
    network: Literal["published", "small"] = "published"
    noise_steps: PositiveInt = 50  # number of DDPM noise steps, with the squared-cosine schedule [S]
    iterations: PositiveInt = 50_000  # iterations of the pretraining, before the policy learns [S]
    batch: PositiveInt = 512  # windows per iteration [S]
    learning_rate: PositiveFloat = 1e-4  # learning rate of AdamW [S]
    weight_decay: NonNegativeFloat = 0.01  # weight decay of AdamW [D: its usual one]
    clip_norm: PositiveFloat = 1.0  # limit on the norm of the gradient [S]
    # decay of the running average of the parameters, which scores [S, there once in ten iterations]
    average: Decay = 0.995
    # noise steps at which windows are scored [S]
    score_steps: Annotated[tuple[NonNegativeInt, ...], Meta(min_length=1)] = (22, 15, 8)
    score_batch: PositiveInt = 4096  # windows scored at the same time; fewer need less memory [S]
    scale: PositiveFloat = 1.0  # reward of a window without error [S]
    decay: PositiveFloat = 6.0  # how fast the reward falls with the error relative to its running mean [S]
    error_floor: PositiveFloat = 1e-4  # smallest value of this running mean [S]
    mean_samples: PositiveFloat = 5e7  # windows after which this running mean no longer changes [S, its G1 variant]

    def check(self) -> None:
        """Raise a `UserError` where windows would be scored at a noise step that is none."""
        if max(self.score_steps) >= self.noise_steps:
            raise UserError(
                f"setting smp.score_steps is {', '.join(map(str, self.score_steps))}: expected noise steps from 0 to "
                f"{self.noise_steps - 1}, below smp.noise_steps"
            )


@dataclasses.dataclass(frozen=True)
class ADDConfig(AMPConfig):
    """The discriminator of ``method=add``: AMP's network and reward, on differences between single frames."""

    minibatch: PositiveInt = 1024  # differences of the current rollout per update; as many replayed ones [M]
    gradient_penalty: NonNegativeFloat = 2.0  # weight of the squared slopes at the policy's differences [M]
    normalizer_clip: PositiveFloat = 1e9  # limit on the magnitude of normalized differences [M: none]
    normalizer_floor: PositiveFloat = 1e-4  # smallest running mean by which a difference is divided [M]


@dataclasses.dataclass(frozen=True)
class TrackingConfig(Section):
    """DeepMimic's reward, of ``method=tracking``: a sum of exponentials of squared errors, with MimicKit's numbers."""

    joint_weight: NonNegativeFloat = 0.5  # weight of the joint angles in the sum [M]
    # how fast their term falls, per rad^2 summed over the joints [M, which weighs joints of the G1]
    joint_decay: NonNegativeFloat = 0.25
    joint_velocity_weight: NonNegativeFloat = 0.1  # weight of the joint velocities in the sum [M]
    # how fast their term falls, per (rad/s)^2 summed over the joints [M, likewise]
    joint_velocity_decay: NonNegativeFloat = 0.01
    root_weight: NonNegativeFloat = 0.15  # weight of the root's height and rotation in the sum [M]
    root_decay: NonNegativeFloat = 5.0  # how fast their term falls, per m^2 [M]
    root_velocity_weight: NonNegativeFloat = 0.1  # weight of the root's velocities in the sum [M]
    root_velocity_decay: NonNegativeFloat = 1.0  # how fast their term falls, per (m/s)^2 [M]
    key_point_weight: NonNegativeFloat = 0.15  # weight of the key points relative to the root in the sum [M]
    key_point_decay: NonNegativeFloat = 10.0  # how fast their term falls, per m^2 summed over the key points [M]
    turn_share: NonNegativeFloat = 0.1  # weight of rad^2 beside m^2 in the errors of the root [M]

    def check(self) -> None:
        """Raise a `UserError` where nothing is rewarded."""
        weights = [field.name for field in dataclasses.fields(self) if field.name.endswith("_weight")]
        if not any(getattr(self, name) for name in weights):
            raise UserError(f"settings tracking.{', '.join(weights)} are all 0: expected one above 0")
