"""What the ONNX file says of itself."""

import json
from collections.abc import Iterable
from typing import Any

import numpy as np

import fmpjax
from fmpjax import features, sim2sim
from fmpjax.deploy.origin import Origin
from fmpjax.motion import addresses
from fmpjax.policy import Policy
from fmpjax.robots import Robot


def metadata(policy: Policy, robot: Robot, origin: Origin) -> dict[str, str]:
    """What the file says of itself, text by key."""
    # long: a table of keys
    terms, physics = features.observation_terms(robot, policy.observation), origin.config.physics
    steps = features.observation_history(policy.observation)
    # As `fmpjax.physics` steps it, whatever the file of the robot says.
    trained = robot.physics_model(frictionloss=physics.frictionloss)
    facts = sim2sim.facts(trained, policy.joint_names)
    mjlab = {
        "run_path": origin.run,
        "joint_names": _list(policy.joint_names),
        "joint_stiffness": _list(robot.stiffness),
        "joint_damping": _list(robot.damping),
        # mjlab's runners add this to the scaled action, so it is the action's offset and not the initial pose.
        "default_joint_pos": _list(policy.center),
        "command_names": "" if origin.commands is None else "base_velocity",
        "observation_names": _list(terms),
        "observation_terms_scale": _list([1.0] * len(terms)),
        "observation_terms_flatten_history_dim": _list([1] * len(terms)),  # truth is a number in mjlab's text
        "observation_terms_history_length": _list([steps if steps > 1 else 0] * len(terms)),
        "observation_terms_clip": _list(["-inf;inf"] * len(terms)),
        "action_scale": _list(policy.scale),
    }
    return mjlab | {
        "observation_widths": _list(terms.values()),
        "command_ranges": _list(f"{low};{high}" for low, high in (origin.commands or {}).values()),
        # s, and m/s and rad/s: time constant of the running means in velocity_errors, and what counts of an error
        # m/s², m/s² and rad/s²: how fast the policy must be told of a new velocity; empty: at once
        "command_ramp": ";".join(map(str, (ramp[0], ramp[0], ramp[1]))) if (ramp := origin.config.command.ramp) else "",
        "command_average": str(origin.config.command.average),
        "command_error_scale": str(origin.config.command.error_scale),
        "action_offset": _list(policy.center),
        "action_clip": _pairs(policy.low, policy.high),
        "joint_effort": _list(robot.effort),
        "joint_limits": _pairs(robot.joint_low, robot.joint_high),
        "joint_axes": _list(";".join(map(str, axis)) for axis in robot.joint_axis),
        "jointless_row": "" if robot.jointless_row is None else str(robot.jointless_row),
        "default_qpos": _list(robot.default_qpos),
        "key_points": json.dumps(
            [
                {"name": name, **_body(robot, body), "offset": offset.tolist()}
                for name, body, offset in zip(robot.key_point_names, robot.key_body, robot.key_offset, strict=True)
            ]
        ),
        "fall_shapes": json.dumps(
            [
                {**_body(robot, body), "ends": ends.tolist(), "radius": float(radius)}
                for body, ends, radius in zip(robot.fall_body, robot.fall_ends, robot.fall_radius, strict=True)
            ]
        ),
        "step_dt": str(1.0 / policy.rate),
        "physics_dt": str(physics.timestep),
        "integrator": sim2sim.integrator(trained),
        "self_collisions": str(sim2sim.self_collisions(trained)),
        **{name: _list(";".join(map(str, np.ravel(row))) for row in rows) for name, rows in facts.items()},
        "total_mass": str(robot.total_mass),
        "robot": robot.name,
        "method": origin.config.method,
        "motions": _list(addresses.file_name(name) for name, _ in origin.motions),
        "commit": origin.version,
        "fmpjax_version": fmpjax.__version__,
    }


def _list(values: Iterable[Any]) -> str:
    """Text of every digit: Python and NumPy print the shortest number that is read as the same one."""
    return ",".join(map(str, values))


def _pairs(low: np.ndarray, high: np.ndarray) -> str:
    return _list(f"{least};{most}" for least, most in zip(low, high, strict=True))


def _body(robot: Robot, index: int) -> dict[str, str | None]:
    """A body, and its hinge, by which it is found in a model that calls its bodies something else."""
    hinge = robot.body_joint[index]
    return {"body": robot.model.body(index + 1).name, "joint": robot.joint_names[hinge] if hinge >= 0 else None}
