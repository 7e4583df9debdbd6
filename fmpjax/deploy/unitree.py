"""Settings for Unitree's stock program, which runs a policy on the G1."""

import json

import numpy as np

from fmpjax import features
from fmpjax.deploy.origin import Origin
from fmpjax.errors import UserError
from fmpjax.policy import Policy
from fmpjax.robots import Robot

# Parts of the observation that Unitree's stock program for the G1 makes (and `gait_phase`, which fmpjax does not have).
STOCK = "base_ang_vel projected_gravity velocity_commands joint_pos joint_pos_rel joint_vel_rel last_action".split()
_LEG = "hip_pitch hip_roll hip_yaw knee ankle_pitch ankle_roll".split()
_ARM = "shoulder_pitch shoulder_roll shoulder_yaw elbow wrist_roll wrist_pitch wrist_yaw".split()
# The G1's motors in the order of Unitree's SDK.
SDK_JOINTS = [
    *(f"{side}_{part}_joint" for side in ("left", "right") for part in _LEG),
    *(f"waist_{part}_joint" for part in ("yaw", "roll", "pitch")),
    *(f"{side}_{part}_joint" for side in ("left", "right") for part in _ARM),
]


def no_stock(robot: Robot, observation: str) -> str | None:
    """A sentence on why Unitree's stock program cannot run a policy; None where it can."""
    if sorted(robot.joint_names) != sorted(SDK_JOINTS):
        return f"no params/deploy.yaml: {robot.name} has not the 29 joints of Unitree's program for the G1"
    unknown = [name for name in features.observation_terms(robot, observation) if name not in STOCK]
    if not unknown:
        return None
    return f"no params/deploy.yaml: Unitree's program does not know the observation {', '.join(unknown)}"


def stock(policy: Policy, robot: Robot, origin: Origin) -> str:
    """The settings with which Unitree's stock program runs the policy, YAML.

    Raises:
      UserError: the policy takes commands, and their ranges are not known.
    """
    terms = features.observation_terms(robot, policy.observation)
    if "velocity_commands" in terms and origin.commands is None:
        raise UserError("the policy takes unknown commands: expected lin_vel_x, lin_vel_y and ang_vel_z")
    steps = features.observation_history(policy.observation)
    commands = {name: list(span) for name, span in (origin.commands or {}).items()}
    action = {
        "clip": np.stack([policy.low, policy.high], -1).astype(float).tolist(),
        "joint_names": list(policy.joint_names),
        "scale": _plain(policy.scale),
        "offset": _plain(policy.center),
        "joint_ids": None,
    }
    settings = {
        "joint_ids_map": [SDK_JOINTS.index(name) for name in policy.joint_names],
        "step_dt": 1.0 / policy.rate,
        "stiffness": _plain(robot.stiffness),
        "damping": _plain(robot.damping),
        "default_joint_pos": _plain(policy.center),
        "commands": {"base_velocity": {"ranges": commands | {"heading": None}}} if commands else {},
        "actions": {"JointPositionAction": action},
        "observations": {
            name: {"params": {}, "clip": None, "scale": [1.0] * (width // steps), "history_length": steps}
            for name, width in terms.items()
        },
    }
    # YAML takes JSON for values.
    return "".join(f"{key}: {json.dumps(value)}\n" for key, value in settings.items())


def _plain(values: np.ndarray) -> list[float]:
    """Python's numbers, of as many digits as the array's type has."""
    return [float(str(value)) for value in values]
