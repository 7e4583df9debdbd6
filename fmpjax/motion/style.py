"""How a walk looks."""

import dataclasses
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro

from fmpjax.robots import Robot

FASTEST = 2.5  # steps/s
BACKWARD = 0.6  # of the roll of the feet and the swing of the arms that a walk ahead has
ASIDE = 2.5  # times as demanding as a step ahead
BANK = 0.45  # rad, of the feet in steps aside at the speed of the robot's own walk
SLOW_LATER = 0.065  # of a stride, by which the toe leaves later in the slowest walk


@dataclasses.dataclass(frozen=True)
class Style:
    """How the walk looks; lengths m, angles rad, phases as fractions of a stride. None leaves it to the robot."""

    cadence: float | None = None  # steps/s; rounded so that half a stride is a whole number of samples
    half_width: float | None = None  # of each foot's center from the line of travel
    toe_out: float | None = None
    # Of the foot ahead as it lands and of the foot behind as it leaves, in steps aside; positive to the left.
    bank: float | None = None
    # The foot's pitch, positive with the toe down.
    landing_pitch: float | None = None
    lowest_pitch: float | None = None  # in late swing
    highest_pitch: float | None = None  # about toe-off
    flat: float | None = None  # the sole is flat from here
    heel_off: float | None = None  # to here
    toe_off: float | None = None
    highest_at: float | None = None
    lowest_at: float | None = None
    # Added to the swing foot's height at its middle.
    swing_lift: Annotated[float | None, tyro.conf.arg(aliases=["--step-height"])] = None
    pelvis_height: float | None = None  # mean
    pelvis_bob: float | None = None  # half of the vertical travel, highest in mid-stance
    pelvis_yaw: float | None = None
    pelvis_roll: float | None = None
    pelvis_pitch: float | None = None
    torso_yaw: float | None = None  # against the pelvis
    torso_pitch: float | None = None
    arm_swing: float | None = None  # shoulder pitch, each way
    arm_center: float | None = None  # shoulder pitch, positive backward
    arm_out: float | None = None  # shoulder roll
    elbow: float | None = None
    elbow_swing: float | None = None
    # The zero-moment point in the foot's frame, along the foot, at the start and end of single support.
    pressure_start: float | None = None
    pressure_end: float | None = None
    pressure_inward: float | None = None  # toward the other foot

    def on(self, robot: Robot) -> "Style":
        """The style with what it leaves open as ``robot.toml`` has it, or zero where that is silent."""
        own = {name: robot.gait.get(name, 0.0) for name in dataclasses.asdict(self)}
        return Style(**(own | self.named()))

    def named(self) -> dict[str, Any]:
        """The numbers that are given."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}


OPEN = Style()  # every number is left open


class Command(NamedTuple):
    """Velocity of the pelvis in its own heading, and how fast it turns."""

    speed: float  # ahead, m/s
    sideways: float = 0.0  # to the left, m/s
    turn: float = 0.0  # to the left, rad/s


def effort(robot: Robot, command: Command) -> float:
    """How demanding a command is, 1 for the robot's own straight walk.

    A step aside counts `ASIDE` times, and a turn as the speed of a point as far from the axis as the pelvis is high.
    """
    arm = robot.gait.get("pelvis_height", 0.0) * command.turn
    return float(np.linalg.norm([command.speed, ASIDE * command.sideways, arm])) / robot.gait["speed"]


def fitted(robot: Robot, command: Command, style: Style = OPEN) -> Style:
    """The style of a walk at another velocity than the robot's own, at which it is the robot's own style.

    What ``style`` names stays. The feet roll less in shorter steps, backward from toe to heel, and not at all in steps
    aside; arms and trunk swing with the speed ahead; slow steps have longer double support and longer times. The pelvis
    is as high as in the robot's own walk: how low it must be is for the legs to say.
    """
    own = style.on(robot)
    ahead, hard = command.speed / robot.gait["speed"], effort(robot, command)
    roll = 2 * ahead / (1 + abs(ahead)) * (1.0 if ahead > 0 else BACKWARD)
    swing = float(np.clip(ahead, -BACKWARD, 1.5))
    small = min(1.0, 2 * hard)
    pace = hard or 1.0  # steps on the spot, where a lift is given, are the robot's own
    later = SLOW_LATER * max(0.0, 1 - pace)
    middle, half = (own.pressure_start + own.pressure_end) / 2, (own.pressure_end - own.pressure_start) / 2
    half = half * float(np.clip(2 * ahead, -1, 1))
    found = dataclasses.replace(
        own,
        cadence=min(FASTEST, own.cadence * (1 + pace) / 2),
        landing_pitch=own.landing_pitch * roll,
        lowest_pitch=own.lowest_pitch * roll,
        highest_pitch=own.highest_pitch * min(roll, 1.0),
        bank=BANK * command.sideways / robot.gait["speed"],
        heel_off=own.heel_off + later / 2,
        toe_off=own.toe_off + later,
        highest_at=own.highest_at + later,
        swing_lift=own.swing_lift * (1 + abs(command.sideways) / robot.gait["speed"]) if hard else 0.0,
        pelvis_bob=own.pelvis_bob * small,
        pelvis_roll=own.pelvis_roll * small,
        pelvis_yaw=own.pelvis_yaw * swing,
        torso_yaw=own.torso_yaw * swing,
        arm_swing=own.arm_swing * swing,
        elbow_swing=own.elbow_swing * swing,
        pressure_start=middle - half,
        pressure_end=middle + half,
    )
    return dataclasses.replace(found, **style.named())
