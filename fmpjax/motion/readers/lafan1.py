"""Unitree's retargeted LaFAN1: CSV without a header, 30 Hz.

A row is root xyz (m), quaternion xyzw, joints (rad) in the model's order.
"""

from pathlib import Path

import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion.readers.recording import Recording, check_finite, check_unit
from fmpjax.robots import Robot

RATE = 30.0  # Hz
MOST_BYTES = 1 << 29


def read(file: Path, robot: Robot) -> Recording:
    """The recording in a CSV of Unitree's."""
    joint_count = robot.joint_count
    try:
        size = file.stat().st_size
        if size > MOST_BYTES:
            raise UserError(f"{file}: the file has {size} bytes, expected at most {MOST_BYTES}")
        lines = file.read_text("utf-8-sig").rstrip().split("\n")
    except UnicodeDecodeError:
        raise UserError(f"{file}: neither text nor an archive nor a pickle, expected a motion") from None
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from error
    if lines == [""]:
        raise UserError(f"{file}: the file is empty, expected rows of {7 + joint_count} numbers")
    columns = 7 + joint_count
    for number, line in enumerate(lines, 1):
        if line.count(",") != columns - 1:
            found = line.count(",") + 1 if line.strip() else 0
            raise UserError(
                f"{file}: line {number} has {found} columns, expected {columns} "
                f"(root xyz, quaternion xyzw, {joint_count} joints of robot {robot.name!r})"
            )
    cells = ",".join(lines).split(",")
    try:
        values = np.array(list(map(float, cells)))
    except ValueError:
        at = next(i for i, cell in enumerate(cells) if not _is_number(cell))
        raise UserError(
            f"{file}: line {at // columns + 1}, column {at % columns + 1} is {cells[at].strip()!r}, expected a number"
        ) from None
    rows = values.reshape(-1, columns)
    check_finite(file, rows, "line", 1)
    rows[:, 3:7] = rows[:, [6, 3, 4, 5]]
    check_unit(file, rows[:, 3:7], "line", 1)
    return Recording(rows, RATE)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
