"""The settings of what disturbs the robot."""

import dataclasses
from typing import Annotated

from msgspec import Meta

from fmpjax.config.base import Fraction, NonNegativeFloat, NonNegativeInt, Section
from fmpjax.errors import UserError

Ends = tuple[float, ...]  # of a range, the lower one first; empty for none
_STEEPEST = 0.5  # rad, beyond which a floor is no floor
_HIGHEST = 0.1  # m, beyond which the shank of a foot on a low floor could touch the level


@dataclasses.dataclass(frozen=True)
class DisturbanceConfig(Section):
    """Disturbances of the robot in training, docs/robustness.md; an empty range or zero means none."""

    # Of each environment, drawn once.

    # factor of the sliding friction between soles and floor, which is 1 for the G1 [D]; 0.3 to 1.2 [J]
    friction: Ends = ()
    torso_mass: Ends = ()  # kg, added to the torso [D]; -1 to 3 [U, H]
    # m, largest offset of the torso's center of mass along x, y and z [D]; 0.025, 0.025, 0.03 [J]
    torso_center: tuple[NonNegativeFloat, ...] = ()
    stiffness: Ends = ()  # factor of each servo's kp [D]; 0.9 to 1.1 [H]
    damping: Ends = ()  # factor of each servo's kd [D]; 0.9 to 1.1 [H]
    strength: Ends = ()  # factor of each motor's largest torque [D]
    joint_friction: Ends = ()  # N m, dry friction of each joint instead of physics.frictionloss [D]; 0.05 to 0.2 [Y]
    armature: Ends = ()  # factor of each motor's inertia [D]; 1 to 1.05 [Y]
    slope: NonNegativeFloat = 0.0  # rad, steepest slope of the floor, in any direction [D]
    encoder_bias: NonNegativeFloat = 0.0  # rad, largest constant error of each joint's encoder [D]; 0.015 [J]

    # Of each episode.

    # physics steps, shortest and longest delay of the actions [D]; 0 to physics.substeps [H]
    delay: Annotated[tuple[NonNegativeInt, ...], Meta(max_length=2)] = ()

    # Of each footstep.

    # m, greatest difference in height between the floors of the two feet, each drawn again for every footstep [D]
    step_height: NonNegativeFloat = 0.0

    # Of each control step.

    turn_noise: NonNegativeFloat = 0.0  # rad/s, largest error of the observed angular velocity [D]; 0.2 [J]
    tilt_noise: NonNegativeFloat = 0.0  # rad, largest error of the observed direction of gravity [D]; 0.05 [J]
    angle_noise: NonNegativeFloat = 0.0  # rad, largest error of the observed joint angles [D]; 0.01 [J]
    velocity_noise: NonNegativeFloat = 0.0  # rad/s, largest error of the observed joint velocities [D]; 1.5 [J]
    push_interval: Ends = ()  # s, shortest and longest time between two pushes [D]; 1 to 3 [J]
    # m/s, smallest and largest change of the root's velocity along the floor [D]; 0.5 on each axis [J]
    push_speed: Ends = (0.0, 0.5)
    push_lift: NonNegativeFloat = 0.0  # m/s, largest change of the root's velocity up or down [D]; 0.4 [J]
    push_tilt: NonNegativeFloat = 0.0  # rad/s, largest change of its rolling and of its pitching [D]; 0.52 [J]
    push_turn: NonNegativeFloat = 0.0  # rad/s, largest change of its turning [D]; 0.78 [J]
    push_start: Fraction = 1.0  # share of their full size that pushes have at the start of a run [D]
    # increase of this share per rollout while more than env.cap_share of the episodes survive; else it decreases [D]
    push_growth: NonNegativeFloat = 0.0

    @property
    def bodies(self) -> bool:
        """Whether the robot or its floor differs from one environment to the next."""
        ranges = (self.friction, self.torso_mass, self.torso_center, self.stiffness, self.damping, self.strength)
        return any((*ranges, self.joint_friction, self.armature, self.slope, self.step_height))

    @property
    def noisy(self) -> bool:
        """Whether the actor sees anything but the truth."""
        noise = (self.turn_noise, self.tilt_noise, self.angle_noise, self.velocity_noise)
        return any((*noise, self.encoder_bias))

    @property
    def any(self) -> bool:
        """Whether there is any disturbance."""
        return any((self.bodies, self.noisy, self.push_interval, self.delay))

    def check(self) -> None:
        """Raise a `UserError` where a range is none or out of physics."""
        above = {"friction": 0, "stiffness": 0, "strength": 0, "armature": 0, "push_interval": 0}
        least = {"damping": 0, "joint_friction": 0, "push_speed": 0, "delay": 0}
        for name in ("torso_mass", *above, *least):
            ends = getattr(self, name)
            if ends and not (len(ends) == 2 and ends[0] <= ends[1]):
                raise UserError(f"{self._said(name)}: expected two numbers, the lower one first, or none")
            if ends and name in above and not ends[0] > above[name]:
                raise UserError(f"{self._said(name)}: expected numbers above 0")
            if ends and name in least and not ends[0] >= least[name]:
                raise UserError(f"{self._said(name)}: expected numbers of at least 0")
        if self.torso_center and len(self.torso_center) != 3:
            raise UserError(f"{self._said('torso_center')}: expected three numbers, along x, y and z, or none")
        if self.slope > _STEEPEST:
            raise UserError(f"setting disturbance.slope is {self.slope:g}: expected at most {_STEEPEST:g} rad")
        if self.step_height > _HIGHEST:
            raise UserError(f"setting disturbance.step_height is {self.step_height:g}: expected at most {_HIGHEST:g} m")
        if self.push_interval and not self.push_speed:
            raise UserError("setting disturbance.push_speed is empty and push_interval is not: expected two numbers")

    def _said(self, name: str) -> str:
        return f"setting disturbance.{name} is {', '.join(f'{end:g}' for end in getattr(self, name))}"
