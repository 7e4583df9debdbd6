"""The policy in an ONNX file from `fmpjax export --onnx`."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fmpjax.errors import UserError
from fmpjax.sim2sim.observation import CLIP_TERMS, TERMS
from fmpjax.sim2sim.traits import FACTS


class ExportedPolicy(NamedTuple):
    """A policy with what its file says of it; ``J`` joints."""

    act: Callable[[np.ndarray], np.ndarray]  # observation [O] -> actions [J]
    terms: dict[str, int]  # names and widths of the observation's parts
    history: int  # steps of control that each part is of, the oldest first
    joint_names: tuple[str, ...]
    center: np.ndarray  # [J] rad, the targets of action zero
    scale: np.ndarray  # [J] rad, a unit of action
    stiffness: np.ndarray  # [J] N m/rad
    damping: np.ndarray  # [J] N m s/rad
    effort: np.ndarray  # [J] N m
    joint_limits: np.ndarray  # [J, 2] rad
    joint_axes: np.ndarray  # [J, 3]
    jointless_row: int | None
    default_qpos: np.ndarray  # [7 + J] where the robot starts
    key_points: list[dict[str, Any]]
    fall_shapes: list[dict[str, Any]]
    step_dt: float  # s, of control
    physics_dt: float  # s, in training
    total_mass: float  # kg
    integrator: str  # MuJoCo's name of it, in training
    facts: dict[str, np.ndarray]  # what `facts` says of the model of the training
    robot: str
    average: float = 0.5  # s, time constant of the running means of the velocity's errors
    error_scale: float = 0.3  # m/s and rad/s; a larger error counts in them by its logarithm
    self_collisions: int | None = None  # pairs of bodies that could collide in training; None: the file doesn't say
    ramp: np.ndarray | None = None  # [3] how fast it is told of a new one (m/s², m/s², rad/s²); None: at once
    commands: np.ndarray | None = None  # [2, 3] lowest and highest velocity that it may be told (m/s, m/s, rad/s)


def load(path: str | Path) -> ExportedPolicy:
    """Read an exported policy.

    Raises:
      UserError: onnxruntime is missing, or the file is, or it is no such policy.
    """
    try:
        import onnxruntime
    except ImportError:
        raise UserError("sim2sim needs the package onnxruntime: install the extra fmpjax[deploy]") from None
    if not Path(path).is_file():
        raise UserError(f"{path} is not a file: expected policy.onnx as `fmpjax export --onnx` writes it")
    expected = "expected a file as `fmpjax export --onnx` writes it"
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # more only wait for each other in so small a network
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a class for each kind
        raise UserError(f"{path} is not an ONNX file ({str(error).splitlines()[0]}): {expected}") from None
    names = [node.name for node in (*session.get_inputs(), session.get_outputs()[0])]
    if names != ["obs", "actions"]:
        raise UserError(f"{path} maps {', '.join(names[:-1])} to {names[-1]}: expected obs to actions")
    return read(
        path,
        session.get_modelmeta().custom_metadata_map,
        lambda x: session.run(["actions"], {"obs": x[None].astype(np.float32)})[0][0],
        (session.get_inputs()[0].shape, session.get_outputs()[0].shape),
    )


def read(
    path: str | Path,
    said: Mapping[str, str],
    act: Callable[[np.ndarray], np.ndarray],
    shapes: tuple[Sequence[int], Sequence[int]],
) -> ExportedPolicy:
    """A policy from the metadata of its file.

    Args:
      path: the file, for sentences.
      said: the metadata, text by key.
      act: observation ``[O]`` -> actions ``[J]``.
      shapes: of what it takes and gives, ``[1, O]`` and ``[1, J]``.

    Raises:
      UserError: the metadata is incomplete, cannot be read or does not fit the shapes.
    """
    expected = "expected a file as `fmpjax export --onnx` writes it"
    try:
        _check_plain(said)
        widths = map(int, said["observation_widths"].split(","))
        policy = ExportedPolicy(
            act=act,
            terms=dict(zip(said["observation_names"].split(","), widths, strict=True)),
            history=_history(said),
            joint_names=tuple(said["joint_names"].split(",")),
            center=_numbers(said["action_offset"]),
            scale=_numbers(said["action_scale"]),
            stiffness=_numbers(said["joint_stiffness"]),
            damping=_numbers(said["joint_damping"]),
            effort=_numbers(said["joint_effort"]),
            joint_limits=_rows(said["joint_limits"]),
            joint_axes=_rows(said["joint_axes"]),
            jointless_row=int(said["jointless_row"]) if said["jointless_row"] else None,
            default_qpos=_numbers(said["default_qpos"]),
            key_points=_places(said["key_points"], "offset"),
            fall_shapes=_places(said["fall_shapes"], "ends", "radius"),
            step_dt=float(said["step_dt"]),
            physics_dt=float(said["physics_dt"]),
            total_mass=float(said["total_mass"]),
            integrator=said["integrator"],
            facts={name: _rows(said[name]) for name in FACTS},
            robot=said["robot"],
            average=float(said.get("command_average", 0.5)),
            error_scale=float(said.get("command_error_scale", 0.3)),
            self_collisions=int(said["self_collisions"]) if "self_collisions" in said else None,
            ramp=_rows(said["command_ramp"])[0] if said.get("command_ramp") else None,
            commands=_rows(said["command_ranges"]).T if said.get("command_ranges") else None,
        )
    except KeyError as error:
        raise UserError(f"{path} has no metadata {error}: {expected}") from None
    except (ValueError, TypeError) as error:
        raise UserError(f"{path} has metadata that cannot be read ({error}): {expected}") from None
    _check(path, policy, shapes)
    return policy


def _numbers(text: str, separator: str = ",") -> np.ndarray:
    numbers = np.array(text.split(separator), np.float64)
    if not np.isfinite(numbers).all():
        raise ValueError(f"{text[:40]!r} is not finite")
    return numbers


def _rows(text: str) -> np.ndarray:
    """A matrix; of columns of one number a vector."""
    rows = np.array([_numbers(row, ";") for row in text.split(",")])
    return rows[:, 0] if rows.shape[1] == 1 else rows


def _places(text: str, *wanted: str) -> list[dict[str, Any]]:
    """Points or shapes in bodies, as JSON has them."""
    return [
        {"body": place["body"], "joint": place["joint"]} | {name: np.array(place[name], np.float64) for name in wanted}
        for place in json.loads(text)
    ]


def _check_plain(said: Mapping[str, str]) -> None:
    """Refuse what mjlab's keys may ask for and a policy of fmpjax never does: scales and clips.

    Raises:
      ValueError: one of them is asked for.
    """
    for key, plain in (("scale", "1.0"), ("clip", "-inf;inf")):
        values = set(said[f"observation_terms_{key}"].split(","))
        if values != {plain}:
            raise ValueError(f"observation_terms_{key} is {min(values - {plain})}, and sim2sim knows only {plain}")


def _history(said: Mapping[str, str]) -> int:
    """Steps that each part of the observation is of.

    Raises:
      ValueError: the parts are of different numbers.
    """
    lengths = set(said["observation_terms_history_length"].split(","))
    if len(lengths) != 1 or int(min(lengths)) < 0:
        raise ValueError(
            f"observation_terms_history_length is {', '.join(sorted(lengths))}: expected one for all terms"
        )
    return max(1, int(lengths.pop()))


def _check(path: str | Path, policy: ExportedPolicy, shapes: tuple[Sequence[int], Sequence[int]]) -> None:
    joints, size = len(policy.joint_names), sum(policy.terms.values())
    for name in policy.terms:
        if name not in TERMS | CLIP_TERMS:
            raise UserError(f"{path} observes {name!r}, which sim2sim does not know: expected {', '.join(TERMS)}")
    taken, given = map(list, shapes)
    if (taken, given) != ([1, size], [1, joints]):
        raise UserError(f"{path} maps {taken} to {given}: its metadata says [1, {size}] to [1, {joints}]")
    per_joint = ("center", "scale", "stiffness", "damping", "effort", "joint_limits", "joint_axes")
    for name, rows in ({name: getattr(policy, name) for name in per_joint} | policy.facts).items():
        if len(rows) != joints:
            raise UserError(f"{path} has {len(rows)} values of {name}: expected {joints}, one per joint")
    if len(policy.default_qpos) != 7 + joints:
        raise UserError(f"{path} has {len(policy.default_qpos)} numbers in default_qpos: expected {7 + joints}")
    if policy.commands is not None and policy.commands.shape != (2, 3):
        raise UserError(f"{path} has command_ranges of shape {policy.commands.shape[::-1]}: expected (3, 2)")
    if policy.ramp is not None and not (policy.ramp.shape == (3,) and (policy.ramp > 0).all()):
        raise UserError(f"{path} has command_ramp {policy.ramp.tolist()}: expected three numbers above 0")
