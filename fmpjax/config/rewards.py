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

    hidden: Widths = (1024, 512)  # units of the ReLU layers [M]
    logit_init: NonNegativeFloat = 1.0  # the logit layer's weights are uniform in this range [M]
    updates: PositiveInt = 32  # per rollout: two passes in minibatches of two windows per environment [M]
    minibatch: PositiveInt = 2048  # windows of the demonstration, as many current and as many replayed ones [M]
    replay: PositiveInt = 200_000  # windows kept of earlier rollouts [M]
    replay_new: PositiveInt = 1000  # windows per rollout that go in once it is full [M]
    gradient_penalty: NonNegativeFloat = 10.0  # weight of half the squared slopes on both sides [M]
    logit_penalty: NonNegativeFloat = 0.01  # weight of the logit layer's squared weights [M]
    optimizer: Optimizer = "sgd"  # of the network [M]
    learning_rate: PositiveFloat = 2.5e-4  # of the optimizer [M]
    momentum: Decay = 0.9  # momentum of SGD, which Adam leaves unread [M]
    weight_decay: NonNegativeFloat = 1e-4  # of the optimizer [M]
    normalizer_clip: PositiveFloat = 10.0  # normalized coordinates are clipped to this magnitude [M]
    normalizer_floor: PositiveFloat = 1e-4  # least standard deviation of a coordinate [M]


@dataclasses.dataclass(frozen=True)
class AMPConfig(AdversaryConfig):
    """The discriminator of ``method=amp``."""

    least_probability: Fraction = 1e-4  # caps the reward at -2 log of it [M]


@dataclasses.dataclass(frozen=True)
class GAILConfig(AdversaryConfig):
    """The discriminator of ``method=gail``: AMP's network."""

    replay: NonNegativeInt = 0  # windows kept of earlier rollouts; none: the opponent is the current policy [D]
    gradient_penalty: NonNegativeFloat = 0.0  # weight of half the squared slopes, AMP's form [D]; 0 or 10 [A]
    logit_penalty: NonNegativeFloat = 0.0  # weight of the logit layer's squared weights [A: none]
    optimizer: Optimizer = "adam"  # of the network [A]
    learning_rate: PositiveFloat = 1e-5  # of the optimizer [A]
    weight_decay: NonNegativeFloat = 0.0  # of the optimizer [A: none]


@dataclasses.dataclass(frozen=True)
class WAILConfig(AdversaryConfig):
    """The critic of ``method=wail``: AMP's network."""

    updates: PositiveInt = 5  # per rollout, two to five [W]
    replay: NonNegativeInt = 0  # windows kept of earlier rollouts; none: the distance is to the current policy [D]
    gradient_penalty: NonNegativeFloat = 10.0  # weight of (slope - 1)^2 at random interpolates [W]
    logit_penalty: NonNegativeFloat = 0.0  # weight of the logit layer's squared weights; the slope is bounded [W]
    optimizer: Optimizer = "adam"  # of the network [W]
    learning_rate: PositiveFloat = 1e-4  # of the optimizer [D: WGAN-GP's]
    weight_decay: NonNegativeFloat = 0.0  # of the optimizer [D: none]
    deviation_half_life: PositiveFloat = 16.0  # rollouts, of the running deviation that the reward divides by [D]
    deviation_floor: PositiveFloat = 1e-3  # least such deviation [D]


@dataclasses.dataclass(frozen=True)
class PWILConfig(Section):
    """The greedy coupling of ``method=pwil``."""

    scale: PositiveFloat = 5.0  # alpha, the reward of a perfect step [L]
    decay: PositiveFloat = 5.0  # beta, of the reward with the distance [L]
    slack: NonNegativeFloat = 1e-6  # by how much the mass of a step is below 1 / T; the demonstration lasts [L]


# Transformer layers, heads, numbers per head.
SMP_NETWORKS = {
    "published": (2, 4, 64),  # [S]
    "small": (1, 2, 32),  # a thirtieth of the arithmetic, for a CPU [D]
}


@dataclasses.dataclass(frozen=True)
class SMPConfig(Section):
    """The diffusion model of ``method=smp``."""

    network: Literal["published", "small"] = "published"  # [S]; "small" has a thirtieth of the arithmetic [D]
    noise_steps: PositiveInt = 50  # DDPM steps, squared-cosine schedule [S]
    iterations: PositiveInt = 50_000  # of pretraining, before the policy learns [S]
    batch: PositiveInt = 512  # windows per iteration [S]
    learning_rate: PositiveFloat = 1e-4  # of AdamW [S]
    weight_decay: NonNegativeFloat = 0.01  # of AdamW [D: its usual one]
    clip_norm: PositiveFloat = 1.0  # gradient-norm clip [S]
    average: Decay = 0.995  # factor of the parameter average; the average scores [S, there once in ten iterations]
    # noise steps at which windows are scored [S]
    score_steps: Annotated[tuple[NonNegativeInt, ...], Meta(min_length=1)] = (22, 15, 8)
    score_batch: PositiveInt = 4096  # windows scored side by side, which bounds the memory that this takes [S]
    scale: PositiveFloat = 1.0  # the reward of a window without error [S]
    decay: PositiveFloat = 6.0  # of the reward with the error relative to its running mean [S]
    error_floor: PositiveFloat = 1e-4  # least running mean of the error [S]
    mean_samples: PositiveFloat = 5e7  # windows after which that running mean stays [S, its G1 variant]

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

    minibatch: PositiveInt = 1024  # differences of the present rollout, and as many replayed ones [M]
    gradient_penalty: NonNegativeFloat = 2.0  # weight of the squared slopes at the policy's differences [M]
    normalizer_clip: PositiveFloat = 1e9  # normalized differences are clipped to this magnitude [M: not at all]
    normalizer_floor: PositiveFloat = 1e-4  # least running mean of a difference, by which it is divided [M]


@dataclasses.dataclass(frozen=True)
class TrackingConfig(Section):
    """DeepMimic's reward, of ``method=tracking``: a sum of exponentials of squared errors, with MimicKit's numbers."""

    joint_weight: NonNegativeFloat = 0.5  # of the joint angles in the sum [M]
    joint_decay: NonNegativeFloat = 0.25  # per rad^2, summed over the joints [M, which weighs joints of the G1]
    joint_velocity_weight: NonNegativeFloat = 0.1  # of the joint velocities in the sum [M]
    joint_velocity_decay: NonNegativeFloat = 0.01  # per (rad/s)^2, summed over the joints [M, likewise]
    root_weight: NonNegativeFloat = 0.15  # of the root's height and rotation in the sum [M]
    root_decay: NonNegativeFloat = 5.0  # per m^2 [M]
    root_velocity_weight: NonNegativeFloat = 0.1  # of the root's velocities in the sum [M]
    root_velocity_decay: NonNegativeFloat = 1.0  # per (m/s)^2 [M]
    key_point_weight: NonNegativeFloat = 0.15  # of the key points less the root in the sum [M]
    key_point_decay: NonNegativeFloat = 10.0  # per m^2, summed over the key points [M]
    turn_share: NonNegativeFloat = 0.1  # of rad^2 beside m^2 in the errors of the root [M]

    def check(self) -> None:
        """Raise a `UserError` where nothing is rewarded."""
        weights = [field.name for field in dataclasses.fields(self) if field.name.endswith("_weight")]
        if not any(getattr(self, name) for name in weights):
            raise UserError(f"settings tracking.{', '.join(weights)} are all 0: expected one above 0")
