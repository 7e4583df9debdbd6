"""A trained policy for other programs: an ONNX file that says what it needs, and a card for the people who run it.

The graph takes ``obs [1, O]`` and gives ``actions [1, J]``, both float32. Normalization and limits are inside. A joint
target (rad) is ``action_offset + action_scale * actions``. The file's metadata has mjlab's keys, with every digit, and
our own; docs/deploy.md lists them. A list is text with commas, its inner lists with semicolons; points are JSON.
"""

import importlib.util
import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import fmpjax
from fmpjax import features, sim2sim, tables
from fmpjax.config import Config
from fmpjax.errors import UserError
from fmpjax.motion import bundled
from fmpjax.policy import Policy
from fmpjax.robots import Robot

OPSET, IR = 17, 8  # what runners of 2022 and later read
_UNMEASURED = {
    "root_height": "the root's height",
    "root_linear_velocity": "the root's linear velocity",
    "key_points": "the places of key points",
}
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


class Origin(NamedTuple):
    """Where a policy comes from."""

    run: str  # the run folder's name
    config: Config
    motions: tuple[tuple[str, float], ...]  # names and weights
    commit: str | None  # of the program that trained it
    evaluation: dict[str, Any] | None  # what evaluation.json says
    changed: bool = False  # whether the program had changes that the commit does not have
    # Of a policy that takes velocities as commands: low and high of lin_vel_x, lin_vel_y (m/s) and ang_vel_z (rad/s).
    commands: Mapping[str, tuple[float, float]] | None = None


def check_installed() -> None:
    """Refuse where the package onnx is missing.

    Raises:
      UserError: it is.
    """
    if importlib.util.find_spec("onnx") is None:
        raise UserError("--onnx needs the package onnx, which is not installed: install the extra fmpjax[deploy]")


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


def no_stock(robot: Robot, observation: str) -> str | None:
    """A sentence on why Unitree's stock program cannot run a policy; None where it can."""
    if sorted(robot.joint_names) != sorted(SDK_JOINTS):
        return f"no params/deploy.yaml: {robot.name} has not the 29 joints of Unitree's program for the G1"
    unknown = [name for name in features.observation_terms(robot, observation) if name not in STOCK]
    if not unknown:
        return None
    return f"no params/deploy.yaml: Unitree's program does not know the observation {', '.join(unknown)}"


def write(folder: Path, policy: Policy, robot: Robot, origin: Origin) -> list[Path]:
    """Write ``policy.onnx`` and ``MODEL_CARD.md`` into ``folder``; the paths written.

    Where Unitree's stock program can run the policy, ``params/deploy.yaml`` and ``exported/policy.onnx``, too, where
    that program looks for them.

    Raises:
      UserError: the widths of observation, layers and joints do not fit together, or a number is not finite.
    """
    import onnx

    terms = features.observation_terms(robot, policy.observation)
    check_widths(policy, terms)
    model = graph(policy)
    onnx.helper.set_model_props(model, metadata(policy, robot, origin))
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, folder / "policy.onnx")
    (folder / "MODEL_CARD.md").write_text(card(policy, robot, origin))
    paths = [folder / "policy.onnx", folder / "MODEL_CARD.md"]
    if no_stock(robot, policy.observation) is None:
        for path in (exported := folder / "exported" / "policy.onnx", settings := folder / "params" / "deploy.yaml"):
            path.parent.mkdir(exist_ok=True)
        settings.write_text(stock(policy, robot, origin))
        shutil.copy2(folder / "policy.onnx", exported)
        paths += [exported, settings]
    return paths


def stock(policy: Policy, robot: Robot, origin: Origin) -> str:
    """The settings with which Unitree's stock program runs the policy, YAML.

    Raises:
      UserError: the policy takes commands, and nobody says from which ranges.
    """
    terms = features.observation_terms(robot, policy.observation)
    if "velocity_commands" in terms and origin.commands is None:
        raise UserError("the policy takes commands of no known range: expected lin_vel_x, lin_vel_y and ang_vel_z")
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
            name: {"params": {}, "clip": None, "scale": [1.0] * width, "history_length": 1}
            for name, width in terms.items()
        },
    }
    # YAML takes JSON for values.
    return "".join(f"{key}: {json.dumps(value)}\n" for key, value in settings.items())


def _plain(values: np.ndarray) -> list[float]:
    """Python's numbers, of as many digits as the array's type has."""
    return [float(str(value)) for value in values]


def check_widths(policy: Policy, terms: dict[str, int]) -> None:
    """Refuse a policy whose parts do not fit together or are not finite.

    Raises:
      UserError: they do not.
    """
    joints = len(policy.joint_names)
    widths = {f"input of layer {i}": kernel.shape[0] for i, kernel in enumerate(policy.kernels)}
    outputs = [kernel.shape[1] for kernel in policy.kernels]
    expected = [sum(terms.values()), *outputs[:-1]]
    checks = list(zip(widths.items(), expected, strict=True))
    checks += [(("normalizer", len(policy.mean)), expected[0]), (("output of the last layer", outputs[-1]), joints)]
    checks += [((name, len(getattr(policy, name))), joints) for name in ("center", "scale", "low", "high")]
    for (name, width), wanted in checks:
        if width != wanted:
            raise UserError(
                f"the policy's {name} has {width} numbers: expected {wanted}, "
                f"as {joints} joints and the {policy.observation!r} observation make it"
            )
    for name, value in policy._asdict().items():
        arrays = value if name in ("kernels", "biases") else [value] if isinstance(value, np.ndarray) else []
        if not all(np.isfinite(array).all() for array in arrays):
            raise UserError(f"the policy's {name} are not finite: expected numbers")


def graph(policy: Policy):
    """The policy as an ONNX model without metadata: ``obs [1, O]`` to ``actions [1, J]``."""
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    nodes, constants = [], []

    def constant(name: str, value: np.ndarray | float) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, np.float32), name))
        return name

    def apply(kind: str, name: str, *inputs: str, **attributes) -> str:
        nodes.append(helper.make_node(kind, inputs, [name], name=f"{kind}_{name}", **attributes))
        return name

    x = apply("Sub", "centered", "obs", constant("mean", policy.mean))
    x = apply("Div", "scaled", x, constant("deviation", policy.deviation))
    x = apply("Clip", "normalized", x, constant("least", -policy.clip), constant("most", policy.clip))
    last = len(policy.kernels) - 1
    for i, (kernel, bias) in enumerate(zip(policy.kernels, policy.biases, strict=True)):
        x = apply("Gemm", f"layer_{i}", x, constant(f"kernel_{i}", kernel), constant(f"bias_{i}", bias))
        if i < last and policy.activation == "swish":
            x = apply("Mul", f"hidden_{i}", x, apply("Sigmoid", f"gate_{i}", x))
        elif i < last:
            x = apply({"relu": "Relu", "elu": "Elu", "tanh": "Tanh"}[policy.activation], f"hidden_{i}", x)
    # The limits of the joint targets, in units of action: a runner that knows no limits keeps them all the same.
    x = apply("Max", "above", x, constant("lowest", (policy.low - policy.center) / policy.scale))
    apply("Min", "actions", x, constant("highest", (policy.high - policy.center) / policy.scale))

    def tensor(name: str, width: int):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, width])

    body = helper.make_graph(
        nodes, "policy", [tensor("obs", len(policy.mean))], [tensor("actions", len(policy.joint_names))], constants
    )
    return helper.make_model(
        body,
        producer_name="fmpjax",
        producer_version=fmpjax.__version__,
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR,
    )


def metadata(policy: Policy, robot: Robot, origin: Origin) -> dict[str, str]:
    """What the file says of itself, text by key."""
    terms, physics = features.observation_terms(robot, policy.observation), origin.config.physics
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
        "observation_terms_history_length": _list([0] * len(terms)),
        "observation_terms_clip": _list(["-inf;inf"] * len(terms)),
        "action_scale": _list(policy.scale),
    }
    return mjlab | {
        "observation_widths": _list(terms.values()),
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
        **{name: _list(";".join(map(str, np.ravel(row))) for row in rows) for name, rows in facts.items()},
        "total_mass": str(robot.total_mass),
        "robot": robot.name,
        "method": origin.config.method,
        "motions": _list(Path(name).name for name, _ in origin.motions),
        "commit": _commit(origin),
        "fmpjax_version": fmpjax.__version__,
    }


def _commit(origin: Origin) -> str:
    return (origin.commit or "unknown") + (" with changes" if origin.changed else "")


def _list(values: Iterable[Any]) -> str:
    """Text of every digit: Python and NumPy print the shortest number that is read as the same one."""
    return ",".join(map(str, values))


def _pairs(low: np.ndarray, high: np.ndarray) -> str:
    return _list(f"{least};{most}" for least, most in zip(low, high, strict=True))


def _body(robot: Robot, index: int) -> dict[str, str | None]:
    """A body, and its hinge, by which it is found in a model that calls its bodies something else."""
    hinge = robot.body_joint[index]
    return {"body": robot.model.body(index + 1).name, "joint": robot.joint_names[hinge] if hinge >= 0 else None}


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
    "base_ang_vel": "of the root, in its own axes, rad/s",
    "projected_gravity": "where gravity points, a unit vector in the root's axes",
    "velocity_commands": "wanted velocity forward and to the left, m/s, and turn, rad/s",
    "joint_pos": "angles, rad, in the order of the joints",
    "joint_pos_rel": "angles less the offset of the action, rad, in the order of the joints",
    "joint_vel_rel": "rad/s, in the order of the joints",
    "last_action": "`actions` of the step before, zero at the start",
}


def card(policy: Policy, robot: Robot, origin: Origin) -> str:
    """The model card, Markdown."""
    config = origin.config
    sentence = unmeasured(robot, policy.observation)
    rows, start = [], 0
    for name, width in features.observation_terms(robot, policy.observation).items():
        meaning = _MEANING[name].format(points=", ".join(robot.key_point_names))
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
        commit=_commit(origin),
        preset=config.preset,
        rate=policy.rate,
        unmeasured="" if sentence is None else sentence[0].upper() + sentence[1:] + ".",
        transitions=config.transitions,
        reset=config.env.reset,
        physics_rate=1.0 / config.physics.timestep,
        motions="\n".join(tables.row((Path(name).name, f"{w:g}", _license(name))) for name, w in origin.motions),
        evaluation=_evaluated(origin.evaluation),
        robustness=_robustness(origin.evaluation),
        size=start,
        observation="\n".join(rows),
        joints=len(policy.joint_names),
        actions="\n".join(
            tables.row((f"`{joint}`", *(f"{number:.6g}" for number in row)))
            for joint, row in zip(policy.joint_names, numbers, strict=True)
        ),
    )


def _license(motion: str) -> str:
    return "MIT, bundled with fmpjax" if motion in bundled() else "unknown: ask the motion's source"


def _evaluated(figures: dict[str, Any] | None) -> str:
    if figures is None:
        return "The run has no evaluation of this policy; `fmpjax evaluate` makes one."

    def speed(name: str) -> str:
        return "undefined" if figures.get(name) is None else f"{figures[name]:.3f} m/s"

    return (
        f"In simulation, on the model it was trained on: {figures['falls']} falls in {figures['episodes']} first "
        f"episodes, late speed {speed('late_speed')}, of the demonstration {speed('demonstration_speed')}."
    )


def _robustness(figures: dict[str, Any] | None) -> str:
    starts = (figures or {}).get("starts") or []
    rows = [tables.row((f"{start['noise']:g}", str(start["falls"]), str(start["episodes"]))) for start in starts]
    if not rows:
        return "No disturbance was tried on this policy."
    return "\n".join(
        [
            "Falls by the noise of the joint angles at the start, rad; ten times that, rad/s, of their velocities. "
            "Pushes, delays and other floors were not tried.",
            "",
            "| noise | falls | first episodes |",
            "|---|---|---|",
            *rows,
        ]
    )
