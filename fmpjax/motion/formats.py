"""Reading and writing motion files.

Two formats: Unitree's LaFAN1 CSV (no header; root position, root quaternion xyzw, joints; 30 Hz) and this package's
``.npz`` (``qpos`` with the quaternion wxyz, ``rate``, ``robot``). Every fault of a file or of an argument raises
`UserError` with one sentence.
"""

import math
import os
import tempfile
import zipfile
import zlib
from pathlib import Path

import numpy as np

from fmpjax import resources, robots
from fmpjax.errors import UserError
from fmpjax.motion.clip import MotionClip, resample, sample_count

CSV_RATE = 30.0  # Hz, of the LaFAN1 files
LEAST_SAMPLES = 11  # one window of the motion prior: ten past frames and the present one
MOST_SAMPLES = 10_000_000
# Files carry six decimals; a norm further than this from one is not a rotation but another column.
NORM_TOLERANCE = 0.05


def bundled() -> list[str]:
    """Names of the shipped motions."""
    return sorted(p.stem for p in resources.folder("motions").glob("*.npz"))


def load(
    path: str | os.PathLike,
    *,
    fps: float | None = None,
    frames: tuple[int, int] | str | None = None,
    rate: float = 50.0,
    robot: str = "unitree_g1",
) -> MotionClip:
    """Load a motion and put it on the grid of ``rate``.

    Args:
      path: a ``.csv`` or ``.npz`` file, or the name of a bundled motion such as ``"walk"``.
      fps: rate of the source rows, Hz; replaces the file's own (30 Hz for CSV).
      frames: source rows to use, 0-based, both ends included: ``(2370, 2580)`` or ``"2370:2580"``.
      rate: rate of the clip, Hz.
      robot: name of the robot that the file must be for.

    Raises:
      UserError: a file or an argument is bad.
    """
    _check_rate("fps", fps)
    _check_rate("rate", rate)
    span = _parse_frames(frames)
    joint_count = robots.load(robot).joint_count
    file = _locate(path)
    if file.suffix.lower() == ".csv":
        qpos, source_rate = _read_csv(file, joint_count), CSV_RATE
    else:
        qpos, source_rate = _read_npz(file, joint_count, robot)
    source_rate = source_rate if fps is None else float(fps)
    if span is not None:
        first, last = span
        if last >= len(qpos):
            raise UserError(f"{file}: frames {first}:{last} are outside the file, which has rows 0:{len(qpos) - 1}")
        qpos = qpos[first : last + 1]
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
    return MotionClip.from_qpos(file.stem, robot, rate, resample(qpos, source_rate, rate))


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


def _locate(path: str | os.PathLike) -> Path:
    file = Path(path)
    if file.suffix.lower() in (".csv", ".npz"):
        if not file.is_file():
            raise UserError(f"no motion file {file}: expected a .csv or .npz file, or one of {', '.join(bundled())}")
        return file
    if file.name == str(path) and file.name in bundled():
        return resources.folder("motions") / f"{file.name}.npz"
    if file.is_file():
        raise UserError(f"{file}: unknown motion format {file.suffix!r}, expected .csv or .npz")
    raise UserError(f"unknown motion {str(path)!r}: expected a .csv or .npz file, or one of {', '.join(bundled())}")


def _check_rate(name: str, value: float | None) -> None:
    if value is not None and not (math.isfinite(value) and value > 0):
        raise UserError(f"{name} is {value}, expected a positive number of Hz")


def _parse_frames(frames: tuple[int, int] | str | None) -> tuple[int, int] | None:
    if frames is None:
        return None
    try:
        first, last = frames.split(":") if isinstance(frames, str) else frames
        if not isinstance(frames, str) and (first != int(first) or last != int(last)):
            raise ValueError
        first, last = int(first), int(last)
    except (TypeError, ValueError):
        raise UserError(f"frames is {frames!r}, expected FIRST:LAST, such as 2370:2580") from None
    if not 0 <= first <= last:
        raise UserError(f"frames is {first}:{last}, expected 0 <= FIRST <= LAST (rows are 0-based, both ends included)")
    return first, last


def _read_csv(file: Path, joint_count: int) -> np.ndarray:
    """Rows of a LaFAN1 CSV as ``qpos [T, 7 + J]`` with the quaternion reordered to wxyz."""
    try:
        lines = file.read_text("utf-8-sig").rstrip().split("\n")
    except UnicodeDecodeError:
        raise UserError(f"{file}: not a text file, expected comma-separated numbers") from None
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
                f"(root xyz, quaternion xyzw, {joint_count} joints)"
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
    _check_rows(file, rows, slice(3, 7), "line", 1)
    rows[:, 3:7] = rows[:, [6, 3, 4, 5]]
    return rows


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _read_npz(file: Path, joint_count: int, robot: str) -> tuple[np.ndarray, float]:
    """``qpos [T, 7 + J]`` and the rate (Hz) of a file written by `save`."""
    try:
        with np.load(file, allow_pickle=False) as archive:
            missing = [key for key in ("qpos", "rate", "robot") if key not in archive]
            if missing:
                raise UserError(f"{file}: no array named {missing[0]!r}, expected qpos, rate and robot")
            qpos, rate, stored_robot = (archive[key] for key in ("qpos", "rate", "robot"))
    except UserError:
        raise
    except (OSError, EOFError, ValueError, TypeError, AttributeError, KeyError, zipfile.BadZipFile, zlib.error):
        # NumPy and zipfile have no common error for a file that is cut short or not an archive.
        raise UserError(f"{file}: not a readable .npz archive, expected arrays qpos, rate and robot") from None
    if stored_robot.size != 1 or str(stored_robot.item()) != robot:
        raise UserError(f"{file}: the motion is for robot {stored_robot.tolist()!r}, expected {robot!r}")
    if rate.size != 1 or rate.dtype.kind not in "fiu" or not (np.isfinite(rate.item()) and rate.item() > 0):
        raise UserError(f"{file}: rate is {rate.tolist()!r}, expected a positive number of Hz")
    if qpos.dtype.kind not in "fiu" or qpos.ndim != 2 or qpos.shape[1] != 7 + joint_count:
        raise UserError(
            f"{file}: qpos is {qpos.dtype} of shape {qpos.shape}, expected numbers of shape (T, {7 + joint_count}) "
            f"(root xyz, quaternion wxyz, {joint_count} joints)"
        )
    qpos = qpos.astype(np.float64)
    _check_rows(file, qpos, slice(3, 7), "qpos row", 0)
    return qpos, float(rate.item())


def _check_rows(file: Path, rows: np.ndarray, quaternion: slice, word: str, start: int) -> None:
    """Refuse values that are not finite and quaternions that are not unit; ``start`` is the first row's number."""
    bad = np.argwhere(~np.isfinite(rows))
    if len(bad):
        row, column = bad[0]
        raise UserError(
            f"{file}: {word} {row + start}, column {column + start} is {rows[row, column]}, expected a finite number"
        )
    norm = np.linalg.norm(rows[:, quaternion], axis=1)
    bad = np.flatnonzero(np.abs(norm - 1) > NORM_TOLERANCE)
    if len(bad):
        raise UserError(
            f"{file}: {word} {bad[0] + start} has a root quaternion of length {norm[bad[0]]:.3g}, expected a unit one"
        )
