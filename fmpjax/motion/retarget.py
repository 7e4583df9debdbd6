"""A human's motion on a robot: BVH motion capture (LaFAN1's and CMU's skeletons) by inverse kinematics.

The skeleton is scaled to the robot's legs. Trunk, thighs and arms point as the human's do; a limb has the robot's own
length. A foot that stands in the source stands in the result: its sole lies on the floor and rolls over heel or toe
without sliding. The source is taken to walk on one level floor, y up.

Landmarks are the parts of the body that a robot names in ``robot.toml``. Poses are in the robot's axes: x ahead, y to
the left, z up. `fmpjax motion retarget` is the
command.
"""

import itertools
import math
import os
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.ndimage import distance_transform_edt, median_filter, uniform_filter1d

from fmpjax import rotations
from fmpjax.errors import UserError
from fmpjax.motion import bvh
from fmpjax.motion.bvh import Bvh
from fmpjax.motion.clip import MotionClip
from fmpjax.motion.formats import cut, save
from fmpjax.robots import Robot

SIDES = ("left", "right")
# What LaFAN1 and CMU call a limb's joint, after Left or l, Right or r; where a skeleton has several, the first counts.
JOINT_NAMES = {
    "hip": ("UpLeg", "femur"),
    "knee": ("Leg", "tibia"),
    "ankle": ("Foot",),
    "toe": ("Toe", "ToeBase", "toes", "Foot end"),
    "shoulder": ("Arm", "humerus"),
    "elbow": ("ForeArm", "radius"),
    "wrist": ("wrist", "Hand"),
}
MOST_RATE = 60.0  # Hz; of a faster source every second, third, ... frame is used

MOST_REACH = 1e5  # m

# Of a heel or toe that stands, at the robot's size.
CONTACT_HEIGHT = 0.03  # m, above where it usually stands
CONTACT_SPEED = 0.3  # m/s
STANDING_PERCENTILE = 5.0  # of a point's height over the clip: where it usually stands
SETTLING = 0.05  # s; contacts and their gaps that are shorter do not count
CLEARANCE, RISING = 0.01, 0.1  # m and s; a swinging foot is at least so high, so long after and before it stands
LEVEL, TILTED = 0.05, 0.2  # rad; a standing foot that tilts less is laid flat, one that tilts more is left as it is

# Weights of the least squares: of a landmark's position (1/m) and of its orientation (1/rad).
WEIGHTS = {
    "pelvis": (1.0, 0.5),
    "chest": (0.0, 0.5),
    "knee": (0.2, 0.0),
    "ankle": (10.0, 3.0),
    "elbow": (0.5, 0.0),
    "wrist": (0.5, 0.0),
}
POSTURE_WEIGHT = 0.01  # 1/rad, toward the default pose: decides what the targets leave open
DAMPING = 1e-4
FIRST_ITERATIONS, ITERATIONS = 100, 2
SMALL_STEP = 1e-3  # rad and m; a frame that moves less is solved


class Targets(NamedTuple):
    """Where the robot's landmarks shall be in each of ``T`` frames."""

    position: dict[str, np.ndarray]  # [T, 3] m, by landmark
    rotation_wxyz: dict[str, np.ndarray]  # [T, 4], by landmark
    contact: np.ndarray  # [T, 2] bool, left and right foot


class Retargeted(NamedTuple):
    """A retargeted motion and how well it fits."""

    clip: MotionClip
    residual: np.ndarray  # [T] m, root mean square distance of the landmarks from their targets
    contact: np.ndarray  # [T, 2] bool, left and right foot stand in the source
    scale: float  # m of the robot per unit of the file


def retarget(source: Bvh, robot: Robot, name: str) -> Retargeted:
    """The motion of ``source`` on ``robot``, at the source's rate or the largest part of it up to `MOST_RATE`.

    Args:
      source: a skeleton with the names of LaFAN1 or CMU.
      robot: a robot with landmarks.
      name: of the clip, and of the source in errors.

    Raises:
      UserError: the skeleton lacks a joint or a limb has no length, the motion is too short or goes too far, the robot
        lacks a landmark, or mink is not installed.
    """
    needed = ["pelvis", "chest", *(f"{side}_{part}" for side in SIDES for part in JOINT_NAMES if part != "toe")]
    missing = [part for part in needed if part not in robot.landmarks]
    if missing:
        raise UserError(
            f"robot {robot.name!r} has no landmark {missing[0]!r} in its robot.toml, which retargeting needs"
        )
    every = max(1, math.ceil(source.rate / MOST_RATE - 1e-6))
    rate = source.rate / every
    values = source.values[::every]
    if len(values) < 2:
        raise UserError(f"{name}: the motion has {len(values)} frame at {rate:g} Hz, expected at least two")
    joint = _joints(source, name)
    poses = bvh.joint_poses(source._replace(values=values))
    # From x to the left, y up, z ahead.
    position = {part: poses.position[:, j][:, [2, 0, 1]] for part, j in joint.items()}
    rotation_wxyz = {part: poses.rotation_wxyz[:, j][:, [0, 3, 1, 2]] for part, j in joint.items()}
    for a, b in _segments():
        if not np.linalg.norm(position[a] - position[b], axis=-1).min() > 0:
            raise UserError(f"{name}: the skeleton's {a} and {b} are at one place, expected a distance")
    rest = _rest(robot)
    scale = _leg_length(rest) / _leg_length(position)
    reach = scale * max(float(np.abs(p).max()) for p in position.values())
    if not reach < MOST_REACH:
        raise UserError(
            f"{name}: the motion is {reach:.3g} m away at the robot's size, expected less than {MOST_REACH:g}"
        )
    targets = _targets(robot, rest, {part: scale * p for part, p in position.items()}, rotation_wxyz, rate)
    qpos, residual = _solve(robot, targets, rate)
    return Retargeted(MotionClip.from_qpos(name, robot.name, rate, qpos), residual, targets.contact, scale)


def convert(file: str | os.PathLike, robot: Robot, out: str | os.PathLike, frames: str | None = None) -> str:
    """Retarget the BVH ``file``, or its ``frames`` FIRST:LAST, and write the clip as ``out``; says how it fits.

    Raises:
      UserError: see `bvh.read`, `formats.cut`, `retarget` and `fmpjax.motion.save`.
    """
    file = Path(file)
    source = bvh.read(file)
    done = retarget(source._replace(values=cut(file, source.values, frames)), robot, file.stem)
    save(done.clip, out)
    return (
        f"wrote {out}: {len(done.clip)} frames at {done.clip.rate:g} Hz, {done.scale:.4g} m per unit of the file, "
        f"{1000 * done.residual.mean():.1f} mm off the scaled skeleton on average and "
        f"{1000 * done.residual.max():.1f} mm at worst"
    )


def _joints(source: Bvh, name: str) -> dict[str, int]:
    """Indices of the skeleton's joints by the part of the body."""
    index = {joint.rpartition(":")[2].lower(): i for i, joint in enumerate(source.names)}
    found = {}
    for side in SIDES:
        for part, names in JOINT_NAMES.items():
            known = [prefix + joint.lower() for joint in names for prefix in (side, side[0])]
            match = [index[joint] for joint in known if joint in index]
            if not match:
                raise UserError(
                    f"{name}: the skeleton has no joint for the {side} {part}, "
                    f"expected one named {side.title()}{names[0]} as in LaFAN1 or as CMU names it"
                )
            found[f"{side}_{part}"] = match[0]
    found["pelvis"] = _fork(source.parent, found["left_hip"], found["right_hip"])
    found["chest"] = _fork(source.parent, found["left_shoulder"], found["right_shoulder"])
    return found


def _fork(parent: np.ndarray, a: int, b: int) -> int:
    """The nearest common ancestor of two joints; parents come before children."""
    while a != b:
        a, b = (int(parent[a]), b) if a > b else (a, int(parent[b]))
    return a


def _segments() -> list[tuple[str, str]]:
    """Pairs of parts whose direction counts."""
    chain = ("hip", "knee", "ankle", "toe"), ("shoulder", "elbow", "wrist")
    limbs = [(f"{side}_{a}", f"{side}_{b}") for side in SIDES for parts in chain for a, b in itertools.pairwise(parts)]
    return [*limbs, ("left_hip", "right_hip"), ("left_shoulder", "right_shoulder")]


def _rest(robot: Robot) -> dict[str, np.ndarray]:
    """Positions ``[3]`` (m) of the landmarks in the default pose, seen from the pelvis."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.default_qpos
    mujoco.mj_kinematics(robot.model, data)
    return {
        part: data.xpos[body + 1] - data.xpos[robot.landmarks["pelvis"] + 1] for part, body in robot.landmarks.items()
    }


def _leg_length(position: dict[str, np.ndarray]) -> float:
    """Mean length of both legs from hip to ankle."""
    bones = [(f"{side}_{a}", f"{side}_{b}") for side in SIDES for a, b in (("hip", "knee"), ("knee", "ankle"))]
    return 2 * float(np.mean([np.linalg.norm(position[a] - position[b], axis=-1) for a, b in bones]))


def _targets(
    robot: Robot, rest: dict, position: dict[str, np.ndarray], rotation_wxyz: dict[str, np.ndarray], rate: float
) -> Targets:
    """The robot's targets from the source's joints, which are scaled to the robot."""
    spine = sum(position[f"{side}_shoulder"] - position[f"{side}_hip"] for side in SIDES)
    turned = {
        part: _upright(rotation_wxyz[part], spine, position[f"left_{ends}"] - position[f"right_{ends}"])
        for part, ends in (("pelvis", "hip"), ("chest", "shoulder"))
    }
    heel, toe, floor = _contacts(position, rate)
    middle = (position["left_hip"] + position["right_hip"]) / 2
    hips = (rest["left_hip"] + rest["right_hip"]) / 2
    ankle_height = {side: -_lowest(robot, side, np.array([1.0, 0.0, 0.0, 0.0])) for side in SIDES}
    lift = np.array([0.0, 0.0, np.mean(list(ankle_height.values())) - floor["ankle"]])
    at = {"pelvis": middle + lift - rotations.rotate(turned["pelvis"], hips)}
    at["chest"] = at["pelvis"] + rotations.rotate(turned["pelvis"], rest["chest"])
    for i, side in enumerate(SIDES):
        part = {name: f"{side}_{name}" for name in JOINT_NAMES}
        hip = at["pelvis"] + rotations.rotate(turned["pelvis"], rest[part["hip"]])
        at[part["knee"]] = _along(hip, position, rest, part["hip"], part["knee"])
        shoulder = at["chest"] + rotations.rotate(turned["chest"], rest[part["shoulder"]] - rest["chest"])
        at[part["elbow"]] = _along(shoulder, position, rest, part["shoulder"], part["elbow"])
        at[part["wrist"]] = _along(at[part["elbow"]], position, rest, part["elbow"], part["wrist"])
        ankle = position[part["ankle"]]
        foot_wxyz = _foot(rotation_wxyz[part["ankle"]], position[part["toe"]] - ankle, heel[:, i] & toe[:, i], rate)
        # Legs keep their direction where the robot's hips are wider than the human's.
        free = ankle + (hip - position[part["hip"]]) * [1, 1, 0]
        at[part["ankle"]] = _planted(robot, side, free + lift, foot_wxyz, heel[:, i] | toe[:, i], rate)
        turned[part["ankle"]] = foot_wxyz
    return Targets(at, turned, heel | toe)


def _upright(rotation_wxyz: np.ndarray, up: np.ndarray, left: np.ndarray) -> np.ndarray:
    """Orientation ``[T, 4]`` of a joint's body, x ahead and z up, where the joint's own axes may be named otherwise.

    Which of the joint's axes is which is read from where ``up`` and ``left`` ``[T, 3]`` are on average.
    """
    inverse = rotations.conjugate(rotation_wxyz)
    axes = np.zeros((3, 3))
    for column, direction in ((2, up), (1, left)):
        mean = rotations.rotate(inverse, direction).mean(axis=0)
        mean = np.where(axes.any(axis=1), 0.0, mean)
        nearest = np.argmax(np.abs(mean))
        axes[nearest, column] = np.copysign(1.0, mean[nearest])
    axes[:, 0] = np.cross(axes[:, 1], axes[:, 2])
    return rotations.multiply(rotation_wxyz, _quaternion_wxyz(axes))


def _quaternion_wxyz(axes: np.ndarray) -> np.ndarray:
    """Quaternion of a rotation matrix ``[3, 3]``."""
    out = np.zeros(4)
    mujoco.mju_mat2Quat(out, axes.reshape(9))
    return out


def _along(start: np.ndarray, position: dict, rest: dict, near: str, far: str) -> np.ndarray:
    """The end ``[T, 3]`` of the robot's segment from ``near`` to ``far`` that points as the human's does."""
    segment = position[far] - position[near]
    length = np.linalg.norm(rest[far] - rest[near])
    return start + length * segment / np.linalg.norm(segment, axis=-1, keepdims=True)


def _contacts(position: dict, rate: float) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Whether each foot's heel and toe stand, ``[T, 2]`` each, and the height (m) of ankle and toe when they do."""
    settling = 2 * int(SETTLING * rate) + 1
    stands, floor = [], {}
    for part in ("ankle", "toe"):
        points = np.stack([position[f"{side}_{part}"] for side in SIDES], axis=1)
        floor[part] = float(np.percentile(points[..., 2], STANDING_PERCENTILE))
        speed = np.linalg.norm(np.gradient(points, 1 / rate, axis=0), axis=-1)
        low = points[..., 2] < floor[part] + CONTACT_HEIGHT
        stands.append(median_filter(low & (speed < CONTACT_SPEED), (settling, 1), mode="nearest"))
    return *stands, floor


def _foot(rotation_wxyz: np.ndarray, toe: np.ndarray, flat: np.ndarray, rate: float) -> np.ndarray:
    """Orientation ``[T, 4]`` of a foot, level where it stands on heel and toe (``flat [T]``)."""
    inverse = rotations.conjugate(rotation_wxyz)
    # What is up in the foot is known while it stands; one that never stands is taken as level on average.
    standing = flat if flat.any() else ~flat
    up = rotations.rotate(inverse, np.array([0.0, 0.0, 1.0]))[standing].mean(axis=0)
    up = up / np.linalg.norm(up)
    ahead = rotations.rotate(inverse, toe).mean(axis=0)
    ahead = ahead - (ahead @ up) * up
    ahead = ahead / max(np.linalg.norm(ahead), 1e-9)  # a toe right under the ankle points nowhere
    foot_wxyz = rotations.multiply(rotation_wxyz, _quaternion_wxyz(np.column_stack([ahead, np.cross(up, ahead), up])))
    heading = np.zeros_like(toe)
    heading[:, 2] = rotations.yaw(foot_wxyz)
    heading_wxyz = rotations.exp_map(heading)
    tilt = rotations.log_map(rotations.multiply(rotations.conjugate(heading_wxyz), foot_wxyz))
    angle = np.linalg.norm(tilt, axis=-1)
    kept = np.where(angle < TILTED, np.maximum(angle - LEVEL, 0.0) / (TILTED - LEVEL) * TILTED / (angle + 1e-9), 1.0)
    share = uniform_filter1d(flat.astype(float), 2 * int(SETTLING * rate) + 1, mode="nearest")
    return rotations.multiply(heading_wxyz, rotations.exp_map(tilt * (1 - share * (1 - kept))[:, None]))


def _sole(robot: Robot, side: str) -> tuple[np.ndarray, np.ndarray]:
    own = robot.sole_body == robot.landmarks[f"{side}_ankle"]
    return robot.sole_point[own], robot.sole_radius[own]


def _lowest(robot: Robot, side: str, foot_wxyz: np.ndarray) -> np.ndarray:
    """Height ``[...]`` (m) of the foot's lowest sole point over its ankle, for orientations ``[..., 4]``."""
    points, radius = _sole(robot, side)
    return (rotations.rotate(foot_wxyz[..., None, :], points)[..., 2] - radius).min(axis=-1)


def _planted(
    robot: Robot, side: str, free: np.ndarray, foot_wxyz: np.ndarray, stands: np.ndarray, rate: float
) -> np.ndarray:
    """The ankle's path ``free [T, 3]``, corrected so that a standing foot rolls and a swinging one is off the floor.

    While the foot stands, its lowest sole point is on the floor and does not move. Each stance keeps its mean place;
    the correction goes over from one stance to the next linearly.
    """
    points, radius = _sole(robot, side)
    arm = rotations.rotate(foot_wxyz[:, None, :], points)  # [T, P, 3]
    lowest = np.argmin(arm[1:, :, 2] + arm[:-1, :, 2] - 2 * radius, axis=-1)
    step = -(arm[1:] - arm[:-1])[np.arange(len(lowest)), lowest, :2]
    rolled = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
    floor = -_lowest(robot, side, foot_wxyz)
    correction = np.column_stack([rolled, floor]) - free
    edges = np.flatnonzero(np.diff(np.concatenate([[False], stands, [False]])))
    for first, end in edges.reshape(-1, 2):
        correction[first:end, :2] -= correction[first:end, :2].mean(axis=0)
    frames, standing = np.arange(len(free)), np.flatnonzero(stands)
    path, least = free.copy(), np.full(len(free), CLEARANCE)
    if len(standing):
        path += np.column_stack([np.interp(frames, standing, column[standing]) for column in correction.T])
        # Before its start and after its end the clip may stand.
        away = distance_transform_edt(np.pad(~stands, 1))[1:-1]
        least *= np.minimum(away / (RISING * rate), 1.0)
    path[:, 2] = np.maximum(path[:, 2], floor + least)
    return path


def _solve(robot: Robot, targets: Targets, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Configurations ``[T, 7 + J]`` and residuals ``[T]`` (m), each frame from the one before."""
    try:
        import mink
    except ImportError:
        raise UserError("retargeting needs the package mink: install fmpjax[retarget]") from None
    configuration = mink.Configuration(robot.physics_model())
    model, data = configuration.model, configuration.data
    start = robot.default_qpos.copy()
    start[:3], start[3:7] = targets.position["pelvis"][0], targets.rotation_wxyz["pelvis"][0]
    configuration.update(start)
    posture = mink.PostureTask(model, POSTURE_WEIGHT)
    posture.set_target(robot.default_qpos)
    frame = {
        part: mink.FrameTask(robot.landmarks[part] + 1, "body", *WEIGHTS[part.rpartition("_")[2]])
        for part in targets.position
    }
    tasks, limits = [*frame.values(), posture], [mink.ConfigurationLimit(model)]
    measured = [part for part in frame if WEIGHTS[part.rpartition("_")[2]][0] > 0]
    bodies = np.array([robot.landmarks[part] + 1 for part in measured])
    wanted = np.stack([targets.position[part] for part in measured], axis=1)
    count = len(wanted)
    qpos, residual = np.empty((count, model.nq)), np.empty(count)
    for t in range(count):
        for _ in range(FIRST_ITERATIONS if t == 0 else ITERATIONS):
            for part, task in frame.items():
                # A landmark without a target orientation is content with its own.
                turned = targets.rotation_wxyz.get(part)
                wxyz = data.xquat[robot.landmarks[part] + 1] if turned is None else turned[t]
                task.set_target(mink.SE3(np.concatenate([wxyz, targets.position[part][t]])))
            step = mink.solve_ik(configuration, tasks, 1.0, solver="daqp", damping=DAMPING, limits=limits)
            configuration.integrate_inplace(step, 1.0)
            if np.abs(step).max() < SMALL_STEP:
                break
        qpos[t] = data.qpos
        residual[t] = np.sqrt(np.mean(np.sum((data.xpos[bodies] - wanted[t]) ** 2, axis=-1)))
    return qpos, residual
