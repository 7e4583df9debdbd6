"""BVH motion capture: a reader, and where the skeleton's joints go.

A file has a ``HIERARCHY`` (joints with an ``OFFSET`` in their parent and ``CHANNELS`` in any order, ``End Site`` where
a limb ends) and a ``MOTION`` (one line of channel values a frame). Axes and lengths are the file's own, usually y up
and centimeters; angles are degrees. A joint turns by its rotation channels in the order written, each about an axis
that the ones before have turned. A position channel replaces the offset's component.
"""

import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fmpjax import rotations
from fmpjax.errors import UserError
from fmpjax.motion.skeleton import JointPoses, posed

CHANNELS = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
MOST_BYTES = 1 << 27
MOST_CHARACTERS = 1 << 20  # of a line
MOST_JOINTS = 1000
MOST_POSES = 20_000_000  # joints times frames
LARGEST = 1e9
_CHANNEL = {name.lower(): i for i, name in enumerate(CHANNELS)}


class Bvh(NamedTuple):
    """A skeleton of ``J`` joints that moves for ``T`` frames; parents come before their children."""

    names: tuple[str, ...]  # [J]; an End Site is called "PARENT end"
    parent: np.ndarray  # [J] index, -1 for the root
    offset: np.ndarray  # [J, 3] in the parent, the file's unit of length
    channels: tuple[tuple[int, ...], ...]  # [J] indices into `CHANNELS`, in the file's order; none at an End Site
    rate: float  # Hz
    values: np.ndarray  # [T, C] channels of all joints in turn, lengths and deg
    format: str = "BVH"

    def taken(self, values: np.ndarray) -> "Bvh":
        """The same skeleton with other frames ``[T, C]``."""
        return self._replace(values=values)

    def poses(self, joints: Sequence[int] | None = None) -> JointPoses:
        """Where the ``joints``, by default all, are in every frame."""
        first = np.cumsum([0, *map(len, self.channels)])

        def local(joint: int) -> tuple[np.ndarray, np.ndarray]:
            moved = np.tile(self.offset[joint], (len(self.values), 1))
            turned_wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (len(self.values), 1))
            for column, channel in enumerate(self.channels[joint], first[joint]):
                value = self.values[:, column]
                if channel < 3:
                    moved[:, channel] = value
                else:
                    about = np.radians(value)[:, None] * np.eye(3)[channel - 3]
                    turned_wxyz = rotations.multiply(turned_wxyz, rotations.exp_map(about))
            return moved, turned_wxyz

        return posed(self.parent, local, joints)


def read(path: str | os.PathLike) -> Bvh:
    """Read a BVH file.

    Raises:
      UserError: the file cannot be read or is malformed; the sentence names the line.
    """
    file = Path(path)
    try:
        size = file.stat().st_size
        if size > MOST_BYTES:
            raise UserError(f"{file}: the file has {size} bytes, expected at most {MOST_BYTES}")
        lines = file.read_text("utf-8-sig").rstrip().split("\n")
    except UnicodeDecodeError:
        raise UserError(f"{file}: not a text file, expected BVH") from None
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from error
    for number, line in enumerate(lines, 1):
        if len(line) > MOST_CHARACTERS:
            raise UserError(f"{file}: line {number} has {len(line)} characters, expected at most {MOST_CHARACTERS}")
    if lines[0].split() != ["HIERARCHY"]:
        raise UserError(f"{file}: line 1 is {_shown(lines[0])}, expected HIERARCHY")
    start = next((i for i, line in enumerate(lines) if line.split() == ["MOTION"]), None)
    if start is None:
        raise UserError(f"{file}: no line MOTION, expected one after the joints; the file may be cut short")
    names, parent, offset, channels = _hierarchy(file, lines[:start])
    rate, values = _motion(file, lines, start + 1, sum(map(len, channels)))
    if len(values) * len(names) > MOST_POSES:
        raise UserError(
            f"{file}: {len(values)} frames of {len(names)} joints are {len(values) * len(names)} poses, "
            f"expected at most {MOST_POSES}"
        )
    return Bvh(names, parent, offset, channels, rate, values)


def _hierarchy(file: Path, lines: list[str]) -> tuple[tuple, np.ndarray, np.ndarray, tuple]:
    """Names, parents, offsets and channels of the joints."""
    words = _words(file, lines)
    names, parent, offset, channels = [], [], [], []
    inside: list[int] = []  # joints whose braces are open
    while True:
        word, line = next(words)
        joint = inside[-1] if inside else -1
        kind = word.upper()
        if kind == "ROOT" and not names or kind in ("JOINT", "END") and inside:
            if joint >= 0 and channels[joint] is None:
                raise UserError(
                    f"{file}: line {line} opens a joint within {_shown(names[joint])}, expected its CHANNELS first"
                )
            name = " ".join(_until_brace(file, words, line))
            name = f"{names[joint]} end" if kind == "END" else name
            if not name or name in names:
                raise UserError(
                    f"{file}: line {line} names a joint {_shown(name)}, expected a name that no other joint has"
                )
            if len(names) == MOST_JOINTS:
                raise UserError(f"{file}: line {line} has more than {MOST_JOINTS} joints, expected at most that many")
            inside.append(len(names))
            names.append(name)
            parent.append(joint)
            offset.append(None)
            channels.append(() if kind == "END" else None)
        elif kind == "OFFSET" and inside and offset[joint] is None:
            offset[joint] = [_number(file, line, next(words)[0]) for _ in range(3)]
        elif kind == "CHANNELS" and inside and channels[joint] is None:
            channels[joint] = _channels(file, line, words)
        elif word == "}" and inside:
            missing = "OFFSET" if offset[joint] is None else "CHANNELS" if channels[joint] is None else None
            if missing:
                raise UserError(f"{file}: line {line} ends joint {_shown(names[joint])}, expected its {missing} first")
            inside.pop()
        elif kind == "MOTION" and names and not inside:
            return tuple(names), np.array(parent), np.array(offset), tuple(channels)
        else:
            place = f"within joint {_shown(names[joint])}" if inside else "outside of the root"
            raise UserError(f"{file}: line {line} has {_shown(word)} {place}, where the format has no such word")


def _words(file: Path, lines: list[str]) -> Iterator[tuple[str, int]]:
    """Words after HIERARCHY and their lines' numbers, and MOTION at the end, past which there is nothing to read."""
    for number, line in enumerate(lines[1:], 2):
        for word in line.replace("{", " { ").replace("}", " } ").split():
            yield word, number
    yield "MOTION", len(lines) + 1
    raise UserError(f"{file}: line {len(lines) + 1} is MOTION within a joint, expected the end of the joint first")


def _until_brace(file: Path, words: Iterator[tuple[str, int]], line: int) -> Iterator[str]:
    for word, at in words:
        if word == "{":
            return
        if at != line:
            raise UserError(f"{file}: line {at} has {_shown(word)}, expected {{ after the joint's name")
        yield word


def _channels(file: Path, line: int, words: Iterator[tuple[str, int]]) -> tuple[int, ...]:
    word = next(words)[0]
    if not (word.isascii() and word.isdigit() and int(word[:4]) <= len(CHANNELS)):
        raise UserError(f"{file}: line {line} has {_shown(word)} CHANNELS, expected 0 to {len(CHANNELS)}")
    found = []
    for _ in range(int(word)):
        name, at = next(words)
        channel = _CHANNEL.get(name.lower())
        if channel is None or channel in found:
            raise UserError(
                f"{file}: line {at} has {_shown(name)} as channel {len(found) + 1} of {word}, "
                f"expected another one of {', '.join(CHANNELS)}"
            )
        found.append(channel)
    return tuple(found)


def _motion(file: Path, lines: list[str], start: int, columns: int) -> tuple[float, np.ndarray]:
    """The rate (Hz) and the rows ``[T, columns]`` of a motion whose ``Frames:`` is ``lines[start]``."""
    header = {}
    for at, name in ((start, "Frames:"), (start + 1, "Frame Time:")):
        line = lines[at].strip() if at < len(lines) else ""
        if not line.lower().startswith(name.lower()):
            raise UserError(f"{file}: line {at + 1} is {_shown(line)}, expected {name} and a number")
        header[name] = _number(file, at + 1, line[len(name) :].strip())
    count, seconds = header["Frames:"], header["Frame Time:"]
    if not (seconds > 0 and math.isfinite(1 / seconds)):
        raise UserError(f"{file}: line {start + 2} has a frame time of {seconds:g} s, expected a positive number")
    rows = [(number, line) for number, line in enumerate(lines[start + 2 :], start + 3) if line.strip()]
    if count != len(rows) or not rows:
        raise UserError(
            f"{file}: line {start + 1} announces {count:.10g} frames and {len(rows)} rows follow, "
            "expected as many as announced and at least one"
        )
    values = np.empty((len(rows), columns))
    for row, (number, line) in zip(values, rows, strict=True):
        cells = line.split()
        if len(cells) != columns:
            raise UserError(f"{file}: line {number} has {len(cells)} values, expected {columns}, one per channel")
        try:
            row[:] = list(map(float, cells))
        except ValueError:
            for cell in cells:
                _number(file, number, cell)
    bad = np.argwhere(~(np.abs(values) <= LARGEST))
    if len(bad):
        row, column = bad[0]
        raise UserError(
            f"{file}: line {rows[row][0]}, value {column + 1} is {values[row, column]}, "
            f"expected a number of at most {LARGEST:g} in size"
        )
    return 1 / seconds, values


def _number(file: Path, line: int, word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST:
        raise UserError(f"{file}: line {line} has {_shown(word)}, expected a number of at most {LARGEST:g} in size")
    return value


def _shown(text: str) -> str:
    """The text in quotes, cut to what fits a sentence."""
    text = text.strip()
    return repr(text if len(text) <= 40 else text[:37] + "...")
