"""The card for the people who run a policy."""

from typing import Any

import fmpjax
from fmpjax import features, resources, tables
from fmpjax.deploy.origin import Origin
from fmpjax.errors import UserError
from fmpjax.motion import addresses
from fmpjax.motion.formats import locate
from fmpjax.policy import Policy
from fmpjax.robots import Robot

_UNMEASURED = {
    "root_height": "the root's height",
    "root_linear_velocity": "the root's linear velocity",
    "key_points": "the places of key points",
    "heading_linear_velocity": "the root's linear velocity",
    "heading_key_points": "the places of key points",
    "velocity_errors": "the errors of its velocity",
}
# Rows of the table of obedience, by their names in steering.json.
_STEERING = {
    "mean error of the speed, m/s": "speed_error",
    "mean error of the turning, rad/s": "turn_error",
    "falls": "falls",
    "episodes": "episodes",
    "seconds of an episode": "seconds",
}
_CARD = """# {run}

A policy for the robot `{robot}` ({description}). It was trained by {method} with fmpjax {version}, commit {commit},
preset `{preset}`. It acts at {rate:g} Hz. {unmeasured}

## Training

At most {transitions:,} transitions, reset `{reset}`, physics at {physics_rate:g} Hz. The demonstrations:

| motion | weight | license |
|---|---|---|
{motions}

## Evaluation

{evaluation}

## Robustness

{robustness}
{steering}
## Observation

`obs` has {size} numbers, not normalized:

| from | to | name | what it is |
|---|---|---|---|
{observation}

## Action

`actions` has {joints} numbers, one per joint in the order below. The target of a joint (rad) is
offset + scale × action. The graph keeps it within low and high. A servo holds it with
torque = stiffness × (target − angle) − damping × velocity, within ± effort.

| joint | offset, rad | scale, rad | low, rad | high, rad | stiffness, N m/rad | damping, N m s/rad | effort, N m |
|---|---|---|---|---|---|---|---|
{actions}
"""
_MEANING = {
    "root_height": "height of the root above the floor, m",
    "root_rotation_6d": "x axis and z axis of the root, in the world",
    "root_linear_velocity": "of the root, in the world, m/s",
    "root_angular_velocity": "of the root, in the world, rad/s",
    "joint_position": "angles, rad, in the order of the joints",
    "joint_rotation_6d": "x axis and z axis of each joint's rotation, in the order of the joints",
    "joint_velocity": "rad/s, in the order of the joints",
    "key_points": "of {points}: place less the root's, in the world's axes, m",
    "heading_rotation_6d": "x axis and z axis of the root, in axes of which x points where it faces",
    "heading_linear_velocity": "of the root, in those axes, m/s",
    "heading_angular_velocity": "of the root, in those axes, rad/s",
    "heading_key_points": "of {points}: place less the root's, in those axes, m",
    "motion_command": "1 for the wanted motion, 0 for the others, in the order of the demonstrations",
    "motion_distances": "running mean of the squared distance to each of them, docs/steering.md of fmpjax",
    "clip_phase": "share of the demonstration that is over, its sine and cosine once and twice per clip, and the "
    "demonstration's joint angles of the next step less their mean, rad",
    "base_ang_vel": "of the root, in its own axes, rad/s",
    "projected_gravity": "where gravity points, a unit vector in the root's axes",
    "velocity_commands": "wanted velocity forward and to the left, m/s, and turn, rad/s",
    "velocity_errors": "running mean of velocity less wanted velocity, m/s, m/s and rad/s, zero at the start",
    "joint_pos": "angles, rad, in the order of the joints",
    "joint_pos_rel": "angles less the offset of the action, rad, in the order of the joints",
    "joint_vel_rel": "rad/s, in the order of the joints",
    "last_action": "`actions` of the step before, zero at the start",
}


def unmeasured(robot: Robot, observation: str) -> str | None:
    """A sentence that names what the policy observes and no robot measures; None where there is no such thing."""
    found = [_UNMEASURED[name] for name in features.observation_terms(robot, observation) if name in _UNMEASURED]
    if not found:
        return None
    listed = ", ".join(found[:-1]) + " and " + found[-1] if len(found) > 1 else found[0]
    return (
        f"the policy observes {listed}, which no sensor of the robot measures: "
        "it runs in simulation, and on hardware only with a state estimator"
    )


def card(policy: Policy, robot: Robot, origin: Origin) -> str:
    """The model card, Markdown."""
    config = origin.config
    sentence = unmeasured(robot, policy.observation)
    rows, start = [], 0
    for name, width in features.observation_terms(robot, policy.observation).items():
        meaning = _MEANING[name].format(points=", ".join(robot.key_point_names))
        if (steps := features.observation_history(policy.observation)) > 1:
            meaning += f"; of {steps} steps, the oldest first"
        if name == "velocity_commands" and (ramp := config.command.ramp):
            meaning += f"; it may change by {ramp[0]:g} m/s and {ramp[1]:g} rad/s in a second at most, as in training"
        if name == "joint_rotation_6d" and robot.jointless_row is not None:
            meaning += f", with a row that is always 1, 0, 0, 0, 0, 1 before joint {robot.jointless_row}"
        rows.append(tables.row((str(start), str(start + width - 1), f"`{name}`", meaning)))
        start += width
    numbers = zip(
        policy.center, policy.scale, policy.low, policy.high, robot.stiffness, robot.damping, robot.effort, strict=True
    )
    return _CARD.format(
        run=origin.run,
        robot=robot.name,
        description=robot.description,
        method=config.method,
        version=fmpjax.__version__,
        commit=origin.version,
        preset=config.preset,
        rate=policy.rate,
        unmeasured="" if sentence is None else sentence[0].upper() + sentence[1:] + ".",
        transitions=config.transitions,
        reset=config.env.reset,
        physics_rate=1.0 / config.physics.timestep,
        motions="\n".join(
            tables.row((addresses.file_name(name), f"{w:g}", _license(name, robot))) for name, w in origin.motions
        ),
        evaluation=_evaluated(origin.evaluation),
        robustness=_robustness(origin.evaluation, origin.robustness),
        steering=_steering(origin.steering),
        size=start,
        observation="\n".join(rows),
        joints=len(policy.joint_names),
        actions="\n".join(
            tables.row((f"`{joint}`", *(f"{number:.6g}" for number in row)))
            for joint, row in zip(policy.joint_names, numbers, strict=True)
        ),
    )


def _license(name: str, robot: Robot) -> str:
    if license := addresses.license_of(name):
        return f"{license}, as its data set's card says"
    if addresses.is_address(name):
        return "unknown: ask the motion's source"
    try:
        shipped = locate(name, robot.name).is_relative_to(resources.folder("motions"))
    except UserError:  # the file is no longer where it was
        shipped = False
    return "MIT, bundled with fmpjax" if shipped else "unknown: ask the motion's source"


def _evaluated(figures: dict[str, Any] | None) -> str:
    if figures is None:
        return "The run has no evaluation of this policy; `fmpjax evaluate` makes one."

    def speed(name: str) -> str:
        return "undefined" if figures.get(name) is None else f"{figures[name]:.3f} m/s"

    return (
        f"In simulation, on the model it was trained on: {figures['falls']} falls in {figures['episodes']} first "
        f"episodes, late speed {speed('late_speed')}, of the demonstration {speed('demonstration_speed')}."
    )


def _robustness(figures: dict[str, Any] | None, robustness: dict[str, Any] | None) -> str:
    starts = (figures or {}).get("starts") or []
    rows = [tables.row((f"{start['noise']:g}", str(start["falls"]), str(start["episodes"]))) for start in starts]
    cells = (robustness or {}).get("cells") or []
    parts = []
    if cells:
        headings = ("disturbance", "size", "falls", "first episodes")
        tried = [(c["disturbance"], c["size"], str(c["falls"]), str(c["episodes"])) for c in cells]
        parts += ["Falls under disturbances, as docs/robustness.md of fmpjax explains them.", ""]
        parts += [tables.markdown(headings, tried, texts=2), ""]
    if rows:
        parts += [
            "Falls by the noise of the joint angles at the start, rad; ten times that, rad/s, of their velocities."
            + ("" if cells else " Pushes, delays and other floors were not tried."),
            "",
            "| noise | falls | first episodes |",
            "|---|---|---|",
            *rows,
        ]
    return "\n".join(parts).rstrip() or "No disturbance was tried on this policy."


def _steering(figures: dict[str, Any] | None) -> str:
    """The section on how the policy obeys; empty where that was not measured."""
    if figures is None:
        return ""
    rows = [
        (label, *(_cell(figures.get(f"{kind}{name}")) for kind in ("", "changing_")))
        for label, name in _STEERING.items()
    ]
    table = tables.markdown(("", "constant commands", "changing commands"), rows)
    return f"\n## Steering\n\n{table}\n"


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3g}"
    return "undefined" if value is None else str(value).replace("|", "/").replace("\n", " ")
