"""Reading and writing motion files.

`load` reads every format of `fmpjax.motion.readers`; `save` writes this package's own ``.npz``. Every fault of a file
or of an argument raises `UserError` with one sentence.
"""

import dataclasses
import math
import os
import tempfile
from pathlib import Path

import numpy as np

from fmpjax import resources, robots
from fmpjax.errors import UserError
from fmpjax.motion import addresses, edit, readers
from fmpjax.motion.clip import Fact, MotionClip, resample, sample_count
from fmpjax.motion.readers.recording import MOST_SAMPLES, ORDERS, Options, Recording, plain_name

LOOPED = 10.0  # s, an evaluation's episode: a clip that loops is repeated until it lasts so long
LEAST_SAMPLES = 11  # one window of the motion prior: ten past frames and the present one


def bundled() -> list[str]:
    """Names of the shipped motions; those of other robots than the G1 begin with the robot's."""
    return sorted(p.stem for p in resources.folder("motions").glob("*.npz"))


def folders() -> dict[str, str]:
    """The shipped folders of motions, each with what it holds."""
    found = {p.name: len(list(p.glob("*.npz"))) for p in sorted(resources.folder("motions").iterdir()) if p.is_dir()}
    return {name: f"unitree_g1, a folder of {count} walks, turns and standing" for name, count in found.items()}


def load(
    path: str | os.PathLike,
    *,
    fps: float | None = None,
    frames: tuple[int, int] | str | None = None,
    rate: float = 50.0,
    robot: str = "unitree_g1",
    quaternion: str | None = None,
    without: str = "",
    degrees: bool = False,
) -> MotionClip:
    """Load a motion and resample it to ``rate``; the clip's `reading` says how the file was read.

    A file that is marked as a loop is repeated until it lasts `LOOPED` s, unless ``frames`` selects a part of it.

    Args:
      path: a file of any format of `fmpjax.motion.readers`, its address (`fmpjax.motion.addresses`), or the name of a
        bundled motion such as ``"walk"``, which is each robot's own.
      fps: rate of the source rows, Hz; replaces the file's own.
      frames: source rows to use, 0-based, both ends included: ``(2370, 2580)``, ``"2370:2580"``, ``"100:"``.
      rate: rate of the clip, Hz.
      robot: name of the robot whose joints the file must have.
      quaternion: order of the root's quaternion, ``"wxyz"`` or ``"xyzw"``; replaces the format's.
      without: words separated by commas; joints with one of them in their name are missing in the file and are zero.
      degrees: the file's joints are in degrees.

    Raises:
      UserError: a file or an argument is bad.
    """
    _check_rate("rate", rate)
    file, recording = record(
        path, fps=fps, frames=frames, robot=robot, quaternion=quaternion, without=without, degrees=degrees
    )
    qpos, source_rate, reading = recording.qpos, recording.rate, recording.reading
    count = sample_count(len(qpos), source_rate, rate)
    if min(count, len(qpos)) < LEAST_SAMPLES:
        raise UserError(
            f"{file}: {len(qpos)} frames at {source_rate:g} Hz give {count} samples at {rate:g} Hz, "
            f"expected at least {LEAST_SAMPLES} of both"
        )
    if count > MOST_SAMPLES:
        raise UserError(
            f"{file}: {len(qpos)} frames at {source_rate:g} Hz give {count} samples at {rate:g} Hz, "
            f"expected at most {MOST_SAMPLES}"
        )
    clip = MotionClip.from_qpos(file.stem, robots.load(robot).name, rate, resample(qpos, source_rate, rate))
    if recording.loops and frames is None and clip.duration < LOOPED:
        times = math.ceil(LOOPED / clip.duration)
        clip = edit.repeated(clip, times)
        fact = Fact("loop", f"{times} times", "the file says that it loops")
        reading = reading._replace(facts=(*reading.facts, fact))
    return dataclasses.replace(clip, reading=reading)


def record(
    path: str | os.PathLike,
    *,
    fps: float | None = None,
    frames: tuple[int, int] | str | None = None,
    robot: str = "unitree_g1",
    quaternion: str | None = None,
    without: str = "",
    degrees: bool = False,
) -> tuple[Path, Recording]:
    """The file of a motion and its rows as they are, at their own rate; arguments and errors as of `load`."""
    _check_rate("fps", fps)
    if quaternion not in (None, *ORDERS):
        raise UserError(f"quaternion is {quaternion!r}, expected one of {', '.join(ORDERS)}")
    loaded = robots.load(robot)
    words = tuple(word.strip() for word in without.split(",") if word.strip())
    for word in words:
        if not any(plain_name(word) in plain_name(name) for name in loaded.joint_names):
            raise UserError(f"without is {without!r}, and no joint of robot {robot!r} has {word!r} in its name")
    file = locate(path, robot)
    recording = readers.read(file, loaded, Options(fps, quaternion, words, degrees))
    rows = cut(file, recording.qpos, frames)
    if frames is None or len(rows) == len(recording.qpos):
        return file, recording
    first, last = span(frames, len(recording.qpos))
    fact = Fact("rows", f"{first} to {last} of {len(recording.qpos)}", "as asked")
    reading = recording.reading._replace(facts=(*recording.reading.facts, fact))
    return file, recording._replace(qpos=rows, reading=reading)


def cut(file: Path, rows: np.ndarray, frames: tuple[int, int] | str | None) -> np.ndarray:
    """The ``frames`` of a file's ``rows [T, ...]``, first to last, both included; all where None.

    Raises:
      UserError: the frames are not two row numbers of the file, in order.
    """
    if frames is None:
        return rows
    first, last = span(frames, len(rows))
    if last >= len(rows):
        raise UserError(f"{file}: frames {first}:{last} are outside the file, which has rows 0:{len(rows) - 1}")
    return rows[first : last + 1]


def span(frames: tuple[int, int] | str, count: int) -> tuple[int, int]:
    """First and last row of ``frames`` in a file of ``count`` rows; a side that is left out is the file's end.

    Raises:
      UserError: they are not two row numbers in order.
    """
    try:
        if isinstance(frames, str):
            first, last = frames.split(":")
            if not first.strip() + last.strip():
                raise ValueError
            first, last = first.strip() or 0, last.strip() or max(count - 1, int(first or 0))
        else:
            first, last = frames
            if first != int(first) or last != int(last):
                raise ValueError
        first, last = int(first), int(last)
    except (TypeError, ValueError):
        raise UserError(f"frames is {frames!r}, expected FIRST:LAST, such as 2370:2580, 100: or :200") from None
    if not 0 <= first <= last:
        raise UserError(f"frames is {first}:{last}, expected 0 <= FIRST <= LAST (rows are 0-based, both ends included)")
    return first, last


def save(clip: MotionClip, path: str | os.PathLike) -> Path:
    """Write a clip as ``.npz``; an existing file is replaced whole or left untouched. Velocities are not stored.

    Raises:
      UserError: the name does not end in ``.npz`` or the folder cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise UserError(f"cannot save a motion as {path}: expected a name ending in .npz")
    partial = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.stem}.", delete=False) as out:
            partial = Path(out.name)
            np.savez_compressed(out, qpos=clip.qpos, rate=np.float64(clip.rate), robot=np.str_(clip.robot))
        # Temporary files are private to their owner; a motion is an ordinary file.
        partial.chmod(0o644)
        os.replace(partial, path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        if partial is not None:
            partial.unlink(missing_ok=True)
    return path


def locate(path: str | os.PathLike, robot: str = "unitree_g1") -> Path:
    """The file that ``path`` names: a bundled motion's, of the robot where it has one of that name, or its own.

    The file at an address is fetched first.
    """
    if addresses.is_address(path):
        return addresses.fetch(str(path))
    file = Path(path)
    for name in (f"{robot}_{path}", str(path)):
        if (shipped := resources.folder("motions") / f"{name}.npz").is_file() and not file.is_absolute():
            return shipped
    if file.is_file():
        return file
    what = f"no motion file {file}" if file.suffix else f"unknown motion {str(path)!r}"
    raise UserError(f"{what}: expected a motion file, or one of {', '.join(bundled())}")


def _check_rate(name: str, value: float | None) -> None:
    if value is not None and not (math.isfinite(value) and value > 0):
        raise UserError(f"{name} is {value}, expected a positive number of Hz")
