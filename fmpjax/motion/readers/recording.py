"""What every reader returns, and the steps that all of them share: joints in order, quaternions, units, rates."""

import dataclasses
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmpjax import rotations
from fmpjax.errors import UserError
from fmpjax.motion.clip import Fact, Reading
from fmpjax.motion.soles import slides, sole_points
from fmpjax.robots import Robot

MOST_SAMPLES = 10_000_000
# Files carry six decimals; a norm further than this from one is not a rotation but another column.
NORM_TOLERANCE = 0.05
GREATEST = 1e6  # m or rad; more is another column, or damage
ORDERS = ("wxyz", "xyzw")
ASSUMED = "the format's"  # where a quaternion's order comes from, if nothing in the file says it
# Sets of words for `Options.without` that other programs' files with fewer joints need.
WITHOUT = (("wrist",), ("waist_roll", "waist_pitch", "wrist_pitch", "wrist_yaw"))
TILTED, UPRIGHT = 0.94, 0.7  # cosine of a root's tilt: a doubtful mean, and that of one that stands
PLAINLY = 2.0  # times less tilt or slip, by which the other order of the quaternion is the better one
SLIPS = 0.3  # m/s over the floor, of the lowest sole point, from which a walk is doubtful
STEPS = 300  # pairs of rows in which the soles are looked at
JUDGED = 0.5  # s, of a file that is long enough for that
LIMIT_SLACK = 0.2  # rad that a file may exceed a joint's limit by and still be in radians
LISTED = 4  # joints that a sentence names


@dataclasses.dataclass(frozen=True)
class Options:
    """What the user says about a file; None where the file or its format decides."""

    fps: float | None = None  # Hz
    quaternion: str | None = None  # one of `ORDERS`
    without: tuple[str, ...] = ()  # words in the names of joints that the file lacks
    degrees: bool = False  # joints are in degrees


class Recording(NamedTuple):
    """A file's motion at its own rate, and what the file was read as."""

    qpos: np.ndarray  # [T, 7 + J] root xyz m, root quaternion wxyz, joints rad
    rate: float  # Hz
    reading: Reading
    loops: bool = False  # the file says that its end continues at its start


class Columns(NamedTuple):
    """Where the robot's joints are in a file."""

    index: np.ndarray  # [J] column of each joint, -1 where the file lacks it
    fact: Fact
    warnings: tuple[str, ...] = ()

    def of(self, joints: np.ndarray) -> np.ndarray:
        """The robot's joints ``[T, J]`` from the file's columns; joints that it lacks are zero."""
        return np.where(self.index < 0, 0.0, joints[:, np.maximum(self.index, 0)])


def positive(file: Path, name: str, value) -> float:
    """The one number in ``value``, which must be a rate in Hz."""
    # A pickle's nested lists could unfold without end.
    array = np.asarray(value if isinstance(value, int | float | np.ndarray | np.generic) else None)
    if array.size != 1 or array.dtype.kind not in "fiu" or not (np.isfinite(array.item()) and array.item() > 0):
        shown = array.tolist() if array.size < 10 and array.dtype.kind in "fiu" else type(value).__name__
        raise UserError(f"{file}: {name} is {shown!r}, expected a positive number of Hz")
    return float(array.item())


def table(file: Path, name: str, value, *shape: int, what: str = "") -> np.ndarray:
    """``value`` as finite float64 ``[T, *shape]``; -1 stands for any length."""
    if not isinstance(value, np.ndarray):  # a pickle's nested lists could unfold without end
        raise UserError(f"{file}: {name} is {_kind(value)}, expected an array of numbers{f' ({what})' if what else ''}")
    array = value
    fits = array.ndim == 1 + len(shape) and all(n in (-1, m) for n, m in zip(shape, array.shape[1:], strict=True))
    if array.dtype.kind not in "fiu" or not fits or len(array) > MOST_SAMPLES:
        wanted = ", ".join(["T", *("any" if n < 0 else str(n) for n in shape)])
        raise UserError(
            f"{file}: {name} is {array.dtype} of shape {array.shape}, expected numbers of shape ({wanted})"
            f"{f' ({what})' if what else ''}"
        )
    array = array.astype(np.float64)
    check_finite(file, array.reshape(len(array), math.prod(array.shape[1:])), f"{name} row", 0)
    return array


def texts(file: Path, name: str, value) -> list[str]:
    """A list of names."""
    if isinstance(value, np.ndarray):
        value = value.ravel().tolist() if value.dtype.kind == "U" else None
    if not isinstance(value, list | tuple) or not all(type(x) is str for x in value):
        raise UserError(f"{file}: {name} is {_kind(value)}, expected a list of names")
    return list(value)


def _kind(value) -> str:
    return "no text" if value is None else f"a {type(value).__name__}"


def assemble(
    file: Path,
    robot: Robot,
    options: Options,
    kind: Fact,
    *,
    position: np.ndarray,
    rotation: np.ndarray,
    order: str | None,
    joints: np.ndarray,
    columns: Columns,
    rate: float,
    rate_from: str,
    name: str,
    first: int = 0,
    warnings: Sequence[str] = (),
    order_from: str = ASSUMED,
    robot_from: str = "assumed, the file names none; --robot replaces it",
    loops: bool = False,
) -> Recording:
    """A recording from checked parts.

    Args:
      kind: the fact that says which format it is.
      position: of the root, ``[T, 3]`` m.
      rotation: of the root, quaternions ``[T, 4]`` in ``order``, the format's own; with None they are wxyz for certain.
      joints: the file's columns ``[T, N]``, of which ``columns`` picks the robot's.
      rate: Hz, and ``rate_from``, where it comes from.
      order_from: where the quaternion's order comes from.
      robot_from: where the robot comes from.
      name: of the rotations in errors, as "root_rot row", and ``first``, the number of the first row.

    Raises:
      UserError: lengths differ, a quaternion is not unit, the root is upside down, or joints are in degrees.
    """
    lengths = (len(position), len(rotation), len(joints))
    if len(set(lengths)) != 1:
        raise UserError(f"{file}: {lengths[0]} root positions, {lengths[1]} rotations and {lengths[2]} rows of joints")
    check_unit(file, rotation, name, first)
    rotation_wxyz, quaternion = oriented(file, rotation, order, order_from, options)
    angles = columns.of(joints)
    facts = [kind, Fact("robot", robot.name, robot_from), columns.fact, quaternion]
    if options.degrees:
        angles = np.radians(angles)
        facts.append(Fact("angles", "degrees", "--degrees"))
    else:
        _check_radians(file, angles, robot)
    if options.fps is not None:
        rate, rate_from = float(options.fps), "--fps"
    if (quaternion.value, quaternion.why) == ("xyzw", ASSUMED):
        _check_soles(file, robot, position, rotation, angles, rate)
    facts.append(Fact("rate", f"{rate:g} Hz", rate_from))
    return Recording(
        np.concatenate([position, rotation_wxyz, angles], axis=1),
        rate,
        Reading(tuple(facts), (*columns.warnings, *warnings)),
        loops,
    )


def match(file: Path, names: Sequence[str] | None, count: int, robot: Robot, options: Options, what: str) -> Columns:
    """The columns of the robot's joints in ``count`` columns, by their ``names`` or by their order.

    Args:
      names: of the columns, or None where the file has none.
      what: the array's name in errors.

    Raises:
      UserError: an essential joint is missing, a joint is named twice, or the number of columns fits no order.
    """
    if names is not None:
        if len(names) != count:
            raise UserError(f"{file}: {len(names)} joint names for {count} columns of {what}")
        return by_name(file, names, robot)
    kept = kept_joints(robot, options.without)
    if count == len(kept):
        return by_order(robot, kept, np.arange(count), options)
    raise UserError(
        f"{file}: {what} has {count} joints and no names, expected {expected_joints(robot, count, options)}"
    )


def expected_joints(robot: Robot, count: int, options: Options) -> str:
    """What ``count`` columns of joints should have been, and the option that makes them fit."""
    kept = len(kept_joints(robot, options.without))
    if options.without:
        return f"{kept} joints, those of robot {robot.name!r} without {','.join(options.without)}"
    fits = [words for words in WITHOUT if len(kept_joints(robot, words)) == count]
    hint = " or ".join(f"--without {','.join(words)}" for words in fits)
    hint = f"; say which it lacks, to be zero: `fmpjax motion import` with {hint}" if hint else ""
    return f"{kept} joints of robot {robot.name!r}{hint}"


def by_name(file: Path, names: Sequence[str], robot: Robot) -> Columns:
    """The columns of the robot's joints by name; what the robot lacks is left out, what the file lacks is zero.

    Raises:
      UserError: a joint of the legs is missing, or a joint is named twice.
    """
    plain = [plain_name(name) for name in names]
    index = np.array([plain.index(p) if p in plain else -1 for p in map(plain_name, robot.joint_names)])
    essential = [robot.joint_names[i] for i in robot.sagittal_joints if index[i] < 0]
    if essential:
        raise UserError(
            f"{file}: no joint {essential[0]!r}, expected the {robot.joint_count} joints of robot {robot.name!r}"
        )
    twice = [names[i] for i in index if i >= 0 and plain.count(plain[i]) > 1]
    if twice:
        raise UserError(f"{file}: two columns are named {twice[0]!r}, expected one")
    found = int(np.count_nonzero(index >= 0))
    spare = len(names) - found
    fact = Fact("joints", f"{found} by name", f"the file's names{f'; {spare} more are left out' if spare else ''}")
    return Columns(index, fact, _lacking(robot, index))


def by_order(
    robot: Robot,
    kept: np.ndarray,
    columns: np.ndarray,
    options: Options,
    why: str = "",
    order: str = "the model's order",
) -> Columns:
    """The columns of the joints ``kept [N]``, whose places in the file are ``columns [N]``; ``why`` this order."""
    why = why or "assumed, the file names no joints"
    if options.without:
        why = f"{why}; --without {','.join(options.without)}"
    index = np.full(robot.joint_count, -1)
    index[kept] = columns
    return Columns(
        index, Fact("joints", f"{len(kept)} in {order}", why), (*_lacking(robot, index), *_doubts(robot, kept, why))
    )


def _doubts(robot: Robot, kept: np.ndarray, why: str) -> tuple[str, ...]:
    """A sentence for each other set of joints ``[N]`` that the file may hold as well, where nothing proves which."""
    if not why.startswith("assumed"):
        return ()
    sets = ((words, kept_joints(robot, words)) for words in WITHOUT)
    return tuple(
        f"--without {','.join(words)} leaves as many joints, and the file does not prove which: look at the result"
        for words, other in sets
        if len(other) == len(kept) and not np.array_equal(other, kept)
    )


def _lacking(robot: Robot, index: np.ndarray) -> tuple[str, ...]:
    missing = [name for name, at in zip(robot.joint_names, index, strict=True) if at < 0]
    if not missing:
        return ()
    more = f" and {len(missing) - LISTED} more" if len(missing) > LISTED else ""
    return (f"{len(missing)} joints that the file lacks are at zero: {', '.join(missing[:LISTED])}{more}",)


def kept_joints(robot: Robot, without: Sequence[str]) -> np.ndarray:
    """The joints whose names contain none of the words, as indices ``[N]``."""
    words = [plain_name(word) for word in without]
    return np.array(
        [i for i, name in enumerate(robot.joint_names) if not any(word in plain_name(name) for word in words)], int
    )


def plain_name(name: str) -> str:
    """A joint's or body's name without what programs put around it: case, "joint", "dof", units."""
    words = re.findall(r"[a-z0-9]+", str(name)[:200].lower())
    return "_".join(word for word in words if word not in ("joint", "dof", "pos", "angle", "link", "rad", "deg"))


def oriented(
    file: Path, rotation: np.ndarray, order: str | None, order_from: str, options: Options
) -> tuple[np.ndarray, Fact]:
    """Quaternions ``[T, 4]`` as wxyz; the order is the format's unless the root would be upside down by it."""
    read = {"wxyz": rotation, "xyzw": rotation[:, [3, 0, 1, 2]]}
    if order is None:
        return rotation, Fact("quaternion", "none", "rotation vectors")
    if options.quaternion is not None:
        return read[options.quaternion], Fact("quaternion", options.quaternion, "--quaternion")
    other = ORDERS[1 - ORDERS.index(order)]
    if not len(rotation):
        return read[order], Fact("quaternion", order, order_from)
    usual, swapped = rotations.up(read[order]), rotations.up(read[other])
    if usual.max() < 0:
        if swapped.min() > 0:
            return read[other], Fact("quaternion", other, f"as {order} the root is upside down in all rows")
        raise UserError(
            f"{file}: the root's z axis points down in all rows, expected a standing robot; "
            "if this is meant, give `fmpjax motion import` --quaternion wxyz or xyzw"
        )
    if usual.mean() < TILTED and swapped.mean() > UPRIGHT and 1 - usual.mean() > PLAINLY * (1 - swapped.mean()):
        tilts = [np.degrees(np.arccos(np.clip(up, -1, 1))).mean() for up in (usual, swapped)]
        raise UserError(
            f"{file}: as {order}, the format's order, the root is tilted by {tilts[0]:.0f}° on average, and as {other} "
            f"by {tilts[1]:.0f}°; say which: `fmpjax motion import --quaternion wxyz` or xyzw"
        )
    return read[order], Fact("quaternion", order, order_from)


def _check_soles(file: Path, robot: Robot, position, xyzw: np.ndarray, angles: np.ndarray, rate: float) -> None:
    """Refuse quaternions ``[T, 4]`` in place of which wxyz lets the feet slide much less.

    A root that looks along -x is upright in both orders. In the wrong one it looks along +x, and walks backward. Only
    files that are read as xyzw are in doubt: MuJoCo's order is often written where others expect theirs.
    """
    if len(xyzw) < max(2, JUDGED * rate) or rotations.up(xyzw).min() <= UPRIGHT:
        return
    first = np.unique(np.linspace(0, len(xyzw) - 2, STEPS).astype(int))
    rows = np.stack([first, first + 1], axis=1).ravel()
    speeds = []
    for wxyz in (xyzw[rows][:, [3, 0, 1, 2]], xyzw[rows]):
        points, turned = sole_points(robot, np.concatenate([position[rows], wxyz, angles[rows]], axis=1))
        height = points[..., 2] - robot.sole_radius
        lowest = np.argmin(height[::2] + height[1::2], axis=1)
        slid = slides(robot, points, turned)[::2]  # within the pairs, not between them
        speeds.append(float(slid[np.arange(len(slid)), lowest].mean() * rate))
    if speeds[0] > SLIPS and speeds[0] > PLAINLY * speeds[1]:
        raise UserError(
            f"{file}: as xyzw, the format's order, the feet slide over the floor at {speeds[0]:.2g} m/s, and as wxyz "
            f"at {speeds[1]:.2g} m/s; say which: `fmpjax motion import --quaternion wxyz` or xyzw"
        )


def _check_radians(file: Path, angles: np.ndarray, robot: Robot) -> None:
    """Refuse joints ``[T, J]`` that are beyond the limits as radians and within them as degrees."""
    low, high = robot.joint_low - LIMIT_SLACK, robot.joint_high + LIMIT_SLACK

    def inside(values: np.ndarray) -> float:
        return float(np.mean((values >= low) & (values <= high))) if values.size else 1.0

    reach = np.abs(angles).max(initial=0.0)
    if (
        reach > 2 * max(np.abs(low).max(), np.abs(high).max())
        and inside(angles) < 0.9
        and inside(np.radians(angles)) > 0.99
    ):
        raise UserError(
            f"{file}: joints reach {reach:.0f}, expected radians within the limits of robot "
            f"{robot.name!r}; they look like degrees, which `fmpjax motion import --degrees` reads"
        )


def check_finite(file: Path, rows: np.ndarray, word: str, start: int) -> None:
    """Refuse values of ``rows [T, n]`` that are not finite or beyond `GREATEST`; ``start`` is the first number."""
    bad = np.argwhere(~(np.abs(rows) < GREATEST))
    if len(bad):
        row, column = bad[0]
        raise UserError(
            f"{file}: {word} {row + start}, column {column + start} is {rows[row, column]}, expected a finite number "
            f"below {GREATEST:g}"
        )


def check_unit(file: Path, quaternion: np.ndarray, word: str, start: int) -> None:
    """Refuse quaternions ``[T, 4]`` that are not unit; ``start`` is the first row's number."""
    norm = np.linalg.norm(quaternion, axis=1)
    bad = np.flatnonzero(np.abs(norm - 1) > NORM_TOLERANCE)
    if len(bad):
        raise UserError(
            f"{file}: {word} {bad[0] + start} has a root quaternion of length {norm[bad[0]]:.3g}, expected a unit one"
        )
