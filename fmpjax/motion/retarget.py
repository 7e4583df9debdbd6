"""A human's motion on a robot: BVH motion capture by inverse kinematics.

The skeleton is scaled to the robot's legs. Trunk, thighs and arms point as the human's do; a limb has the robot's own
length. A foot that stands in the source stands in the result: its sole lies on the floor and rolls over heel or toe
without sliding. The source is taken to walk on one level floor.

What is measured over the motion (its floor, the axes of its joints, its size) is measured over the whole file, so a
part of it is the same whichever frame is the first.

Landmarks are the parts of the body that a robot names in ``robot.toml``. Poses are in the robot's axes: x ahead, y to
the left, z up. `fmpjax motion retarget` is the
command.
"""

import dataclasses
import itertools
import math
import os
import tomllib
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.ndimage import distance_transform_edt, median_filter, uniform_filter1d

from fmpjax import rotations
from fmpjax.errors import UserError
from fmpjax.motion import bvh, check
from fmpjax.motion.bvh import Bvh
from fmpjax.motion.clip import Fact, MotionClip, Reading
from fmpjax.motion.formats import cut, save, span
from fmpjax.robots import Robot

SIDES = ("left", "right")
# What skeletons call a limb's joint, beside left or l, right or r; where a skeleton has several, the first counts.
# LaFAN1 and Mixamo (UpLeg), CMU (femur), Xsens and 100STYLE (Hip, Knee, Ankle, Shoulder), Blender and Unreal (thigh).
JOINT_NAMES = {
    "hip": ("UpLeg", "femur", "UpperLeg", "thigh", "Hip"),
    "knee": ("Leg", "tibia", "LowerLeg", "LowLeg", "calf", "shin", "Knee"),
    "ankle": ("Ankle", "Foot"),
    "toe": ("Toe", "ToeBase", "toes", "ball", "Foot end", "Ankle end", "Foot"),
    "shoulder": ("Arm", "humerus", "UpperArm", "UpArm", "Shoulder"),
    "elbow": ("ForeArm", "radius", "LowerArm", "LowArm", "Elbow"),
    "wrist": ("wrist", "Hand"),
}
# Which of the file's axes are ahead, left and up, by the one that is up. Heading is free, so "ahead" is any of two.
AXES = {"y": (2, 0, 1), "z": (0, 1, 2)}
UPRIGHT = 0.5  # share of the way from ankles to hips that is along the axis that is up, in most frames
ODD_FIRST, ODD_SPEED = (
    5.0,
    15.0,
)  # times the frames after it, and rad/s: a first frame that turns so much is another pose
NEXT = 20  # frames after the first that it is compared with
MOST_RATE = 60.0  # Hz; of a faster source every second, third, ... frame is used

MOST_REACH = 1e5  # m
MOST_SKELETON = 1 << 16  # bytes

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
    # Feet of humans tilt further than the robot's ankles: their place counts, their orientation gives way.
    "ankle": (10.0, 0.3),
    "elbow": (0.5, 0.0),
    "wrist": (0.5, 0.0),
}
POSTURE_WEIGHT = 0.01  # 1/rad, toward the default pose: decides what the targets leave open
# Steps are damped, or near stretched knees and joint limits the solver jumps from one branch to another.
DAMPING = 1e-2
# Of a frame's landmarks from their targets, m: doubtful and broken, on average over the motion and at worst.
MEAN_RESIDUAL, WORST_RESIDUAL = (0.04, 0.10), (0.12, 0.30)
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
    source: Bvh,
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
    needed = ["pelvis", "chest", *(f"{side}_{part}" for side in SIDES for part in JOINT_NAMES if part != "toe")]
    missing = [part for part in needed if part not in robot.landmarks]
    if missing:
        raise UserError(
            f"robot {robot.name!r} has no landmark {missing[0]!r} in its robot.toml, which retargeting needs"
        )
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
    poses = bvh.joint_poses(source._replace(values=values))
    told, up = up, up or _up(poses.position, joint, name)
    axes = list(AXES[up])
    position = {part: poses.position[:, j][:, axes] for part, j in joint.items()}
    rotation_wxyz = {part: poses.rotation_wxyz[:, j][:, [0, *(1 + a for a in axes)]] for part, j in joint.items()}
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
    targets = Targets(
        {part: values[chosen] for part, values in targets.position.items()},
        {part: values[chosen] for part, values in targets.rotation_wxyz.items()},
        targets.contact[chosen],
    )
    qpos, residual = _solve(robot, targets, rate)
    known = ", ".join(f"{part} {source.names[joint[part]]}" for part in joint if part.startswith(("left", "pel", "ch")))
    thinned = f", one frame of {every}" if every > 1 else ""
    reading = Reading(
        (
            Fact("format", "BVH", f"{len(source.names)} joints, {len(source.values)} frames"),
            Fact("robot", robot.name, "--robot"),
            Fact("skeleton", "--skeleton" if skeleton else "by its names", known),
            Fact("up", up, "--up" if told else "hips are over ankles along it"),
            Fact("size", f"{scale:.4g} m per unit", "legs as long as the robot's"),
            Fact("rate", f"{rate:g} Hz", f"the file's {source.rate:g} Hz{thinned}"),
        )
    )
    clip = MotionClip.from_qpos(name, robot.name, rate, qpos)
    return Retargeted(dataclasses.replace(clip, reading=reading), residual, targets.contact, scale)


def odd_start(source: Bvh) -> bool:
    """Whether the first frame is another pose, such as a T-pose, and the motion begins at the second."""
    if len(source.values) < 4:
        return False
    turned = bvh.joint_poses(source._replace(values=source.values[: NEXT + 2])).rotation_wxyz
    between = rotations.multiply(rotations.conjugate(turned[:-1]), turned[1:])
    angle = np.linalg.norm(rotations.log_map(between), axis=-1).max(axis=1)
    return bool(angle[0] * source.rate > ODD_SPEED and angle[0] > ODD_FIRST * angle[1:].max())


def convert(
    file: str | os.PathLike,
    robot: Robot,
    out: str | os.PathLike,
    frames: str | None = None,
    *,
    skeleton: str | os.PathLike | None = None,
    up: str | None = None,
) -> tuple[str, bool]:
    """Retarget the BVH ``file``, or its ``frames`` FIRST:LAST, and write the clip as ``out``.

    Args:
      skeleton: a TOML file that names the skeleton's joint of each part, such as ``left_hip = "LThigh"``.
      up: the file's axis that is up, "y" or "z".

    Returns:
      What was read and how it fits, and whether the result is broken. A broken one is written as well.

    Raises:
      UserError: see `bvh.read`, `formats.cut`, `retarget` and `fmpjax.motion.save`.
    """
    file = Path(file)
    if up not in (None, *AXES):
        raise UserError(f"--up is {up!r}, expected one of {', '.join(AXES)}")
    source = bvh.read(file)
    names = None if skeleton is None else read_skeleton(skeleton)
    count, said = len(source.values), []
    cut(file, source.values, frames)  # refuses rows that are not there
    first, last = (0, count - 1) if frames is None else span(frames, count)
    if first == 0 and last > 1 and odd_start(source):
        first = 1
        said.append("frame 0 is another pose, and is left out")
    done = retarget(source, robot, file.stem, span=(first, last), skeleton=names, up=up)
    save(done.clip, out)
    facts = [*done.clip.reading.facts, Fact("frames", f"{first} to {last}", "--frames" if frames else "all")]
    verdict, faults = done.verdict(robot)
    lines = [
        f"{file} was read as",
        str(Reading(tuple(facts), tuple(said))),
        f"wrote {out}: {len(done.clip)} frames at {done.clip.rate:g} Hz, {done.scale:.4g} m per unit of the file, "
        f"{1000 * done.residual.mean():.1f} mm off the scaled skeleton on average and "
        f"{1000 * done.residual.max():.1f} mm at worst",
        f"verdict: {verdict}",
        *(f"  {fault}" for fault in faults),
    ]
    return "\n".join(lines), verdict == "broken"


def read_skeleton(path: str | os.PathLike) -> dict[str, str]:
    """The skeleton's joints by the part of the body, from a TOML file of lines such as ``left_hip = "LThigh"``.

    Raises:
      UserError: the file cannot be read, or names a part that there is not.
    """
    file = Path(path)
    try:
        if file.stat().st_size > MOST_SKELETON:
            raise UserError(f"{file}: the file has {file.stat().st_size} bytes, expected at most {MOST_SKELETON}")
        names = tomllib.loads(file.read_text("utf-8"))
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError):
        raise UserError(f'{file}: not TOML, expected lines such as left_hip = "LThigh"') from None
    parts = ["pelvis", "chest", *(f"{side}_{part}" for side in SIDES for part in JOINT_NAMES)]
    for part, name in names.items():
        if part not in parts or not isinstance(name, str):
            raise UserError(f"{file}: {part[:40]!r} is no part with a joint's name, expected one of {', '.join(parts)}")
    return names


def joints(source: Bvh, name: str, skeleton: dict[str, str] | None = None) -> dict[str, int]:
    """Indices of the skeleton's joints by the part of the body.

    Raises:
      UserError: a part has no joint whose name is known, or ``skeleton`` names a joint that there is not.
    """
    index = {}
    for i, joint in enumerate(source.names):
        index.setdefault(_plain(joint), i)
    found = {}
    for part, joint in (skeleton or {}).items():
        if joint not in source.names:
            raise UserError(
                f"{name}: the skeleton has no joint {joint[:40]!r} for {part}, expected one of {_listed(source)}"
            )
        found[part] = source.names.index(joint)
    for side, (part, names) in itertools.product(SIDES, JOINT_NAMES.items()):
        if f"{side}_{part}" in found:
            continue
        known = [
            _plain(joint)
            for other in names
            for joint in (side + other, side[0] + other, f"{other}{side}", f"{other}{side[0]}", *_end(other, side))
        ]
        match = [index[joint] for joint in known if joint in index and index[joint] not in found.values()]
        if not match:
            raise UserError(
                f"{name}: the skeleton has no joint for the {side} {part}, expected one named "
                f"{side.title()}{names[0]} or the like; name it in a file for --skeleton, with lines such as "
                f'{side}_{part} = "{source.names[-1][:40]}", from {_listed(source)}'
            )
        found[f"{side}_{part}"] = match[0]
    found.setdefault("pelvis", _fork(source.parent, found["left_hip"], found["right_hip"]))
    found.setdefault("chest", _fork(source.parent, found["left_shoulder"], found["right_shoulder"]))
    return found


def _end(name: str, side: str) -> tuple[str, ...]:
    """An end site's name where the side is written after the limb's."""
    limb, end, _ = name.partition(" end")
    return (f"{limb}{side}{end}", f"{limb}{side[0]}{end}") if end else ()


def _plain(joint: str) -> str:
    """A joint's name without a namespace, case and signs: mixamorig:LeftUpLeg, left_up_leg and LeftUpLeg are one."""
    joint = joint.rpartition(":")[2].lower()
    return "".join(c for c in joint.removeprefix("mixamorig_") if c.isalnum())


def _listed(source: Bvh) -> str:
    names = ", ".join(source.names)
    return names if len(names) <= 300 else f"{names[:297]}..."


def _up(position: np.ndarray, joint: dict[str, int], name: str) -> str:
    """The file's axis that is up, by where the hips are seen from the ankles; ``position [T, J, 3]``."""
    legs = sum(position[:, joint[f"{side}_hip"]] - position[:, joint[f"{side}_ankle"]] for side in SIDES)
    legs = legs / np.maximum(np.linalg.norm(legs, axis=-1, keepdims=True), 1e-9)
    along = {axis: float(np.median(legs[:, "xyz".index(axis)])) for axis in AXES}
    up = max(along, key=along.get)
    if along[up] < UPRIGHT:
        raise UserError(
            f"{name}: hips are over ankles neither along y nor along z in most frames, expected one of them to be up; "
            "say which with --up y or --up z"
        )
    return up


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
        # The solver meets limits to its own tolerance.
        qpos[t, 7:] = np.clip(qpos[t, 7:], robot.joint_low, robot.joint_high)
        residual[t] = np.sqrt(np.mean(np.sum((data.xpos[bodies] - wanted[t]) ** 2, axis=-1)))
    return qpos, residual
