"""A skeleton's motion on a robot, and how well it fits."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion import check
from fmpjax.motion.clip import Fact, MotionClip, Reading
from fmpjax.motion.retarget import landmarks
from fmpjax.motion.retarget.inverse import solve
from fmpjax.motion.retarget.landmarks import AXES, JOINT_NAMES, SIDES, joints
from fmpjax.motion.retarget.targets import Targets, leg_length, rest_positions, targets_of
from fmpjax.motion.skeleton import Capture
from fmpjax.robots import Robot

MOST_RATE = 60.0  # Hz; of a faster source every second, third, ... frame is used
MOST_REACH = 1e5  # m
# Of a frame's landmarks from their targets, m: doubtful and broken, on average over the motion and at worst.
MEAN_RESIDUAL, WORST_RESIDUAL = (0.04, 0.10), (0.12, 0.30)


class Retargeted(NamedTuple):
    """A retargeted motion and how well it fits."""

    clip: MotionClip
    residual: np.ndarray  # [T] m, root mean square distance of the landmarks from their targets
    contact: np.ndarray  # [T, 2] bool, left and right foot stand in the source
    scale: float  # m of the robot per unit of the file

    def verdict(self, robot: Robot) -> tuple[str, list[str]]:
        """``good``, ``odd`` or ``broken``, and a sentence per fault: of the fit, and of the clip by `check`."""
        fit = []
        for name, value, (odd, broken) in (
            ("mean residual", float(self.residual.mean()), MEAN_RESIDUAL),
            ("worst residual", float(self.residual.max()), WORST_RESIDUAL),
        ):
            if not value < odd:
                at = f" (at {np.argmax(self.residual) / self.clip.rate:.2f} s)" if name.startswith("worst") else ""
                what = "odd" if value < broken else "broken"
                fit.append(f"{name} is {what}: {1000 * value:.0f} mm, healthy to {1000 * odd:.0f} mm{at}")
        faults = fit + check.faults(robot, self.clip)
        broken = any(" is broken: " in fault for fault in faults)
        return "broken" if broken else "odd" if faults else "good", faults


def retarget(
    source: Capture,
    robot: Robot,
    name: str,
    *,
    span: tuple[int, int] | None = None,
    skeleton: dict[str, str] | None = None,
    up: str | None = None,
) -> Retargeted:
    """The motion of ``source`` on ``robot``, at the source's rate or the largest part of it up to `MOST_RATE`.

    Args:
      source: a skeleton whose joints `JOINT_NAMES` or ``skeleton`` know.
      robot: a robot with landmarks.
      name: of the clip, and of the source in errors.
      span: first and last frame to retarget, both included; all by default.
      skeleton: the skeleton's joint of parts such as "left_hip", where its name is not known.
      up: the file's axis that is up, "y" or "z"; by default the one along which hips are over ankles.

    Raises:
      UserError: the skeleton lacks a joint or a limb has no length, which axis is up is not clear, the motion is too
        short or goes too far, the robot lacks a landmark, or mink is not installed.
    """
    _check_landmarks(robot)
    first, last = (0, len(source.values) - 1) if span is None else span
    every = max(1, math.ceil(source.rate / MOST_RATE - 1e-3))
    rate = source.rate / every
    # Before the span as well as after it: every frame of the file that falls on the grid of its first frame.
    values = source.values[first % every :: every]
    chosen = slice(first // every, first // every + (last - first) // every + 1)
    count = len(values[chosen])
    if count < 2:
        raise UserError(f"{name}: the motion has {count} frame at {rate:g} Hz, expected at least two")
    joint = joints(source, name, skeleton)
    axis, position, rotation_wxyz = _landmark_poses(source.taken(values), joint, up, name)
    rest = rest_positions(robot)
    scale = leg_length(rest) / leg_length(position)
    reach = scale * max(float(np.abs(p).max()) for p in position.values())
    if not reach < MOST_REACH:
        raise UserError(
            f"{name}: the motion is {reach:.3g} m away at the robot's size, expected less than {MOST_REACH:g}"
        )
    targets = targets_of(robot, rest, {part: scale * p for part, p in position.items()}, rotation_wxyz, rate)
    targets = Targets(
        {part: values[chosen] for part, values in targets.position.items()},
        {part: values[chosen] for part, values in targets.rotation_wxyz.items()},
        targets.contact[chosen],
    )
    qpos, residual = solve(robot, targets, rate)
    thinned = f", one frame of {every}" if every > 1 else ""
    facts = (
        Fact("format", source.format, f"{len(source.names)} joints, {len(source.values)} frames"),
        Fact("robot", robot.name, "--robot replaces it"),
        _skeleton_fact(source, joint, told=bool(skeleton)),
        Fact("up", axis, "--up" if up else "hips are over ankles along it"),
        Fact("size", f"{scale:.4g} m per unit", "legs as long as the robot's"),
        Fact("rate", f"{rate:g} Hz", f"the file's {source.rate:g} Hz{thinned}"),
    )
    clip = dataclasses.replace(MotionClip.from_qpos(name, robot.name, rate, qpos), reading=Reading(facts))
    return Retargeted(clip, residual, targets.contact, scale)


def _check_landmarks(robot: Robot) -> None:
    needed = ["pelvis", "chest", *(f"{side}_{part}" for side in SIDES for part in JOINT_NAMES if part != "toe")]
    missing = [part for part in needed if part not in robot.landmarks]
    if missing:
        raise UserError(
            f"robot {robot.name!r} has no landmark {missing[0]!r} in its robot.toml, which retargeting needs"
        )


def _landmark_poses(source: Capture, joint: dict[str, int], up: str | None, name: str) -> tuple[str, dict, dict]:
    """The axis that is up, and positions ``[T, 3]`` and orientations ``[T, 4]`` of landmarks in the robot's axes."""
    poses = source.poses(list(joint.values()))
    position = {part: poses.position[:, i] for i, part in enumerate(joint)}
    up = up or landmarks.up_axis(position, name)
    axes = list(AXES[up])
    position = {part: values[:, axes] for part, values in position.items()}
    turned = [0, *(1 + a for a in axes)]
    rotation_wxyz = {part: poses.rotation_wxyz[:, i][:, turned] for i, part in enumerate(joint)}
    for a, b in landmarks.segments():
        if not np.linalg.norm(position[a] - position[b], axis=-1).min() > 0:
            raise UserError(f"{name}: the skeleton's {a} and {b} are at the same place, expected a distance")
    return up, position, rotation_wxyz


def _skeleton_fact(source: Capture, joint: dict[str, int], *, told: bool) -> Fact:
    """Which joints were taken, on the left alone."""
    known = ", ".join(
        f"{part} {source.names[i]}" for part, i in joint.items() if part.startswith(("left", "pel", "ch"))
    )
    return Fact("skeleton", "--skeleton" if told else "by its names", known)
