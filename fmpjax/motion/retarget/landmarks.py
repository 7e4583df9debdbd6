"""Which joint of a skeleton is which part of the body, and which of its axes is up."""

import itertools
import os
import tomllib
from pathlib import Path

import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion.skeleton import Capture

SIDES = ("left", "right")
# What skeletons call a limb's joint, beside left or l, right or r; where a skeleton has several, the first counts.
# LAFAN1 and Mixamo (UpLeg), CMU (femur), Xsens and 100STYLE (Hip, Knee, Ankle, Shoulder), Blender and Unreal (thigh).
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
MOST_SKELETON = 1 << 16  # bytes


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


def joints(source: Capture, name: str, skeleton: dict[str, str] | None = None) -> dict[str, int]:
    """Indices of the skeleton's joints by the part of the body; an unknown toe is the end of the ankle's joint.

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
    missing = []
    for side, (part, names) in itertools.product(SIDES, JOINT_NAMES.items()):
        if f"{side}_{part}" in found:
            continue
        known = [
            _plain(joint)
            for other in names
            for joint in (side + other, side[0] + other, f"{other}{side}", f"{other}{side[0]}", *_end(other, side))
        ]
        match = [index[joint] for joint in known if joint in index and index[joint] not in found.values()]
        if not match and part == "toe" and f"{side}_ankle" in found:
            end = f"{source.names[found[f'{side}_ankle']]} end"
            match = [source.names.index(end)] if end in source.names else []
        if match:
            found[f"{side}_{part}"] = match[0]
        else:
            missing.append((side, part, f"{side.title()}{names[0]}"))
    if missing:
        side, part, usual = missing[0]
        raise UserError(
            f"{name}: the skeleton has no joint for the {', '.join(f'{side} {part}' for side, part, _ in missing)}, "
            f"expected names such as {usual}; name each in a file for --skeleton, with lines such as "
            f'{side}_{part} = "NAME", from {_listed(source)}'
        )
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


def _listed(source: Capture) -> str:
    names = ", ".join(source.names)
    return names if len(names) <= 300 else f"{names[:297]}..."


def up_axis(position: dict[str, np.ndarray], name: str) -> str:
    """The file's axis that is up, by where the hips are seen from the ankles; each part's ``position`` is [T, 3]."""
    legs = sum(position[f"{side}_hip"] - position[f"{side}_ankle"] for side in SIDES)
    legs = legs / np.maximum(np.linalg.norm(legs, axis=-1, keepdims=True), 1e-9)
    along = {axis: float(np.median(legs[:, "xyz".index(axis)])) for axis in AXES}
    up = max(along, key=along.__getitem__)
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


def segments() -> list[tuple[str, str]]:
    """Pairs of parts whose direction counts."""
    chain = ("hip", "knee", "ankle", "toe"), ("shoulder", "elbow", "wrist")
    limbs = [(f"{side}_{a}", f"{side}_{b}") for side in SIDES for parts in chain for a, b in itertools.pairwise(parts)]
    return [*limbs, ("left_hip", "right_hip"), ("left_shoulder", "right_shoulder")]
