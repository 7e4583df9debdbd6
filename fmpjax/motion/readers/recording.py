"""What every reader returns, and the checks that all of them share."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmpjax.errors import UserError
from fmpjax.robots import Robot

MOST_SAMPLES = 10_000_000
# Files carry six decimals; a norm further than this from one is not a rotation but another column.
NORM_TOLERANCE = 0.05
GREATEST = 1e6  # m or rad; more is another column, or damage


class Recording(NamedTuple):
    """A file's motion at its own rate."""

    qpos: np.ndarray  # [T, 7 + J] root xyz m, root quaternion wxyz as the file has it, joints rad
    rate: float  # Hz


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
    array = np.asarray(value)
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


def assemble(file: Path, name: str, position, rotation_wxyz, joints, rate: float) -> Recording:
    """A recording from checked parts, whose lengths and quaternions (``name`` in the file) are checked here."""
    lengths = (len(position), len(rotation_wxyz), len(joints))
    if len(set(lengths)) != 1:
        raise UserError(f"{file}: {lengths[0]} root positions, {lengths[1]} rotations and {lengths[2]} rows of joints")
    check_unit(file, rotation_wxyz, f"{name} row", 0)
    return Recording(np.concatenate([position, rotation_wxyz, joints], axis=1), rate)


def order_by_name(file: Path, names: Sequence[str], robot: Robot) -> np.ndarray:
    """Where each joint of the robot stands among ``names``, ``[J]``."""
    index = {name: i for i, name in enumerate(names)}
    missing = [joint for joint in robot.joint_names if joint not in index]
    if missing:
        raise UserError(
            f"{file}: no joint {missing[0]!r}, expected the {robot.joint_count} joints of robot {robot.name!r}"
        )
    return np.array([index[joint] for joint in robot.joint_names])


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
