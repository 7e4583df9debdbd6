"""Text: rows of root xyz (m), quaternion, joints (rad), as Unitree's retargeted LAFAN1 has them.

Cells are separated by commas, semicolons, tabs or spaces. Without a header a row is root xyz, quaternion xyzw and
joints in the model's order. A header's names put the columns in order; a column of times gives the rate. Otherwise the
rate is the one in the file's name ("60hz"), or 30 Hz, that of LAFAN1.
"""

import re
import warnings
from pathlib import Path

import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion.clip import Fact
from fmpjax.motion.readers.recording import (
    ASSUMED,
    Columns,
    Options,
    Recording,
    assemble,
    by_name,
    by_order,
    check_finite,
    expected_joints,
    kept_joints,
    plain_name,
)
from fmpjax.robots import Robot

RATE = 30.0  # Hz
MOST_BYTES = 1 << 29
AT_ONCE = 4096  # lines whose cells are Python's objects at the same time
MOST_RATE = 1000.0  # Hz, that a name or a column of times is trusted to mean
SEPARATORS = (";", "\t", ",")  # the first that the first line has; else spaces
_PLACE = re.compile(r"(?:.*[^a-z])?(?:x|y|z)$|.*(?:translate|trans|pos|position)(?:x|y|z)$")
_TURN = re.compile(r"(?:.*[^a-z])?(?:q|quat|quaternion|rot|rotation|orientation|orn)_?([wxyz])$")
_TIME, _COUNTER = ("time", "t", "timestamp", "time_s", "seconds"), ("", "frame", "index", "row", "step", "frame_id")


def read(file: Path, robot: Robot, options: Options) -> Recording:
    """The recording in a text file."""
    lines = _lines(file, robot)
    separator = next((s for s in SEPARATORS if s in lines[0]), None)
    if separator == ";" and any("," in line for line in lines[:2]):
        lines = [line.replace(",", ".") for line in lines]  # decimal commas
    header, first = _header(lines, separator), 0
    if header is not None:
        lines, first = lines[1:], 1
        if not lines:
            raise UserError(f"{file}: the file has a header and no rows, expected rows of numbers")
    rows = _rows(file, lines, separator, first, len(header) if header else None, robot, options)
    check_finite(file, rows, "line", 1 + first)
    names = header if header and len(header) == rows.shape[1] else None
    place, turn, order, joints, time, left = _layout(file, names, rows.shape[1], robot, options)
    rate, rate_from = _rate(file, rows, time)
    kind = Fact("format", "text", f"{rows.shape[1]} columns, {'a header' if header else 'no header'}")
    left_out = (f"columns left out: {', '.join(left[:6])}{' ...' if len(left) > 6 else ''}",) if left else ()
    return assemble(
        file,
        robot,
        options,
        kind,
        position=rows[:, place],
        rotation=rows[:, turn],
        order=order,
        joints=rows,
        columns=joints,
        rate=rate,
        rate_from=rate_from,
        name="line",
        first=1 + first,
        order_from="the header's names" if order == "wxyz" else ASSUMED,
        warnings=left_out,
    )


def _lines(file: Path, robot: Robot) -> list[str]:
    try:
        size = file.stat().st_size
        if size > MOST_BYTES:
            raise UserError(f"{file}: the file has {size} bytes, expected at most {MOST_BYTES}")
        text = file.read_text("utf-8-sig").rstrip("\r\n ")
    except UnicodeDecodeError:
        raise UserError(f"{file}: neither text nor an archive nor a pickle, expected a motion") from None
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from error
    if not text:
        raise UserError(f"{file}: the file is empty, expected rows of {7 + robot.joint_count} numbers")
    return text.split("\n")


def _cells(line: str, separator: str | None) -> list[str]:
    return [cell.strip().strip('"') for cell in line.split(separator)]


def _header(lines: list[str], separator: str | None) -> list[str] | None:
    """The names in the first line, or None where it is a row of numbers."""
    cells = _cells(lines[0].lstrip("# "), separator)
    while len(cells) > 1 and not cells[-1]:
        cells.pop()
    counted = cells == [str(i) for i in range(len(cells))] and len(cells) > 7  # a spreadsheet's own column numbers
    if counted or not any(map(_is_number, filter(None, cells))):
        return cells if any(cells) else None
    # A header whose first cell is a row number's place and the rest are column numbers.
    return cells if not cells[0] and cells[1:] == [str(i) for i in range(len(cells) - 1)] else None


def _rows(
    file: Path, lines: list[str], separator: str | None, first: int, named: int | None, robot: Robot, options: Options
) -> np.ndarray:
    """The numbers ``[T, columns]``."""
    if separator is None:
        counts = [len(line.split()) for line in lines]
    else:
        trailing = all(line.rstrip("\r ").endswith(separator) for line in lines)
        if trailing:
            lines = [line.rstrip("\r ")[:-1] for line in lines]
        counts = [line.count(separator) + 1 if line.strip() else 0 for line in lines]
    columns = named or counts[0]
    expected = 7 + len(kept_joints(robot, options.without))
    if named is None and columns != expected:
        raise UserError(
            f"{file}: line {1 + first} has {columns} columns, expected {expected} for root xyz, quaternion xyzw and "
            f"{expected_joints(robot, columns - 7, options)}"
        )
    for number, count in enumerate(counts, 1 + first):
        if count != columns:
            raise UserError(
                f"{file}: line {number} has {count} columns, expected {columns}"
                f"{' as the header has' if named else f' (root xyz, quaternion xyzw, {columns - 7} joints)'}"
            )
    values = np.empty((len(lines), columns))
    for start in range(0, len(lines), AT_ONCE):
        part = values[start : start + AT_ONCE]
        text = (separator or " ").join(lines[start : start + AT_ONCE])
        numbers = _parsed(text, separator)
        if numbers is not None and numbers.size == part.size:
            part[:] = numbers.reshape(part.shape)
            continue
        cells = text.split(separator)
        try:
            part[:] = np.array(list(map(float, cells))).reshape(part.shape)
        except ValueError:
            at = next(i for i, cell in enumerate(cells) if not _is_number(cell))
            raise UserError(
                f"{file}: line {start + at // columns + 1 + first}, column {at % columns + 1} is "
                f"{cells[at].strip()[:40]!r}, expected a number"
            ) from None
    return values


def _parsed(text: str, separator: str | None) -> np.ndarray | None:
    """The numbers in a text by NumPy, which is quick and says nothing of what it can't read; None in that case."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, sep=separator or " ")
        except (ValueError, DeprecationWarning):
            return None


def _layout(
    file: Path, names: list[str] | None, count: int, robot: Robot, options: Options
) -> tuple[list[int], list[int], str, Columns, int | None, list[str]]:
    """Columns of the root's place and quaternion, the latter's order, the joints', the times', names of the rest."""
    plain = [plain_name(name) for name in names] if names else []
    known = set(map(plain_name, robot.joint_names))
    if names is None or not known & set(plain):
        # No header, or one that names no joint: everything is in the usual order, after a column of row numbers.
        time = next((i for i, name in enumerate(plain[:2]) if name in _TIME), None)
        skip = sum(name in (*_TIME, *_COUNTER) for name in plain[:2]) if plain else 0
        kept = kept_joints(robot, options.without)
        if count - skip - 7 != len(kept):
            raise UserError(
                f"{file}: the header names {count} columns and no joint of robot {robot.name!r}, expected root xyz, "
                f"quaternion xyzw and {expected_joints(robot, count - skip - 7, options)}"
            )
        columns = by_order(robot, kept, skip + 7 + np.arange(len(kept)), options)
        return [skip, skip + 1, skip + 2], list(range(skip + 3, skip + 7)), "xyzw", columns, time, []
    joints = by_name(file, names, robot)
    rest = [i for i in range(count) if plain[i] not in known]
    turn = {m[1]: i for i in rest if (m := _TURN.match(names[i].strip().lower()))}
    place = [i for i in rest if i not in turn.values() and _PLACE.match(names[i].strip().lower())]
    place = {names[i].strip().lower()[-1]: i for i in reversed(place)}
    if len(turn) != 4 or len(place) != 3:
        raise UserError(
            f"{file}: the header names joints, but not the root's position and quaternion, expected names such as "
            "root_x, root_y, root_z, qx, qy, qz, qw"
        )
    time = next((i for i in rest if plain[i] in _TIME), None)
    used = {*turn.values(), *place.values(), time}
    left = [names[i] for i in rest if i not in used and plain[i] not in _COUNTER]
    joints = joints._replace(fact=joints.fact._replace(value=joints.fact.value, why="the header's names"))
    return [place[a] for a in "xyz"], [turn[a] for a in "wxyz"], "wxyz", joints, time, left


def _rate(file: Path, rows: np.ndarray, time: int | None) -> tuple[float, str]:
    """The rate (Hz) and where it comes from."""
    if time is not None and len(rows) > 1:
        step = float(np.median(np.diff(rows[:, time])))
        if 1 / MOST_RATE <= step <= 1.0 and np.abs(np.diff(rows[:, time]) - step).max() < 0.2 * step:
            return round(1 / step, 3), "the column of times"
        raise UserError(f"{file}: the column of times has steps of {step:g} s (median), expected even steps in seconds")
    named = re.search(r"(?<![0-9.])(\d{1,3}(?:\.\d+)?)[ _-]?(?:hz|fps)(?![a-z])", file.name.lower())
    if named and 1 <= float(named[1]) <= MOST_RATE:
        return float(named[1]), "the file's name; --fps replaces it"
    return RATE, "assumed, the file has none; --fps replaces it"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
