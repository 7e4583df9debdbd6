"""Several demonstrations as one: which there are, and how often each is drawn."""

import dataclasses
import glob
import itertools
import math
import os
from functools import cached_property
from pathlib import Path

import numpy as np

from fmpjax import resources
from fmpjax.errors import UserError
from fmpjax.motion import addresses
from fmpjax.motion.clip import MotionClip
from fmpjax.motion.formats import load

SUFFIXES = (".npz", ".csv", ".txt", ".pkl", ".pt", ".motion")  # of the files of a folder that are motions
NAMED = 4  # motions at most of which a line shows the names


@dataclasses.dataclass(frozen=True, eq=False)
class MotionLibrary:
    """``K`` clips of one robot at one rate; their rows follow one another in `qpos` and `qvel`.

    A clip's weight is its share of the episodes that start in it and of the windows that the motion prior draws,
    however long it is; within a clip all rows and windows weigh the same.
    """

    clips: tuple[MotionClip, ...]
    weights: tuple[float, ...]  # sum to one

    @classmethod
    def of(cls, motion: "MotionClip | MotionLibrary") -> "MotionLibrary":
        """A clip as the library of it alone."""
        return motion if isinstance(motion, MotionLibrary) else cls((motion,), (1.0,))

    @cached_property
    def qpos(self) -> np.ndarray:
        """Configurations of all clips, ``[M, 7 + J]``."""
        return np.concatenate([clip.qpos for clip in self.clips])

    @cached_property
    def qvel(self) -> np.ndarray:
        """Velocities of all clips, ``[M, 6 + J]``."""
        return np.concatenate([clip.qvel for clip in self.clips])

    @property
    def lengths(self) -> np.ndarray:
        """Rows of each clip, ``[K]``."""
        return np.array([len(clip) for clip in self.clips])

    @property
    def starts(self) -> np.ndarray:
        """First row of each clip, ``[K]``."""
        return np.cumsum(self.lengths) - self.lengths

    def rows_after(self, before: int, most: int | None = None) -> np.ndarray:
        """Rows with at least ``before`` rows of their own clip ahead of them, ``[W]``.

        Where they are more than ``most``, every second, third, ... row of each clip, so that about as many are left.
        """
        every = self._every(before, most)
        return np.concatenate(
            [np.arange(start + before, start + n, every) for start, n in zip(self.starts, self.lengths, strict=True)]
        )

    def share_after(self, before: int, most: int | None = None) -> np.ndarray | None:
        """How often each of those rows is drawn, ``[W]``, summing to one; None for one clip, where all are alike."""
        if len(self.clips) == 1:
            return None
        rows = -(-(self.lengths - before) // self._every(before, most))
        return np.repeat(np.array(self.weights) / rows, rows)

    def _every(self, before: int, most: int | None) -> int:
        return 1 if most is None else max(1, math.ceil(int((self.lengths - before).sum()) / most))

    def clip_of(self, rows: np.ndarray) -> np.ndarray:
        """Index of the clip of each row; that of the last clip for rows past the end."""
        return np.searchsorted(self.starts, rows, side="right") - 1

    def mean(self, values) -> np.ndarray:
        """Mean of one value a clip, by weight."""
        return np.average(np.asarray(values), axis=0, weights=self.weights)


def load_library(
    names: str, *, frames: str | None = None, rate: float = 50.0, robot: str = "unitree_g1"
) -> MotionLibrary:
    """The clips that a list such as ``"walk,turn_left:0.5,mine.npz:2"`` names, each with its weight (1 by default).

    Args:
      names: motions as `fmpjax.motion.load` takes them, addresses too, with commas between them.
      frames: source rows "first:last" of the only clip, or of each, with commas between them.
      rate: rate of the clips, Hz.
      robot: name of the robot that they must be for.

    Raises:
      UserError: a motion, a weight or the rows are bad.
    """
    entries = parse(names)
    spans = frames.split(",") if frames else [None] * len(entries)
    if len(spans) != len(entries):
        raise UserError(
            f"frames is {frames!r}: expected FIRST:LAST for each of the {len(entries)} motions of {names!r}"
        )
    clips = tuple(
        load(name, frames=span or None, rate=rate, robot=robot) for (name, _), span in zip(entries, spans, strict=True)
    )
    return MotionLibrary(clips, shares(entries))


def title(name: str) -> str:
    """A motion's name without its folder and the ending of a file."""
    path = Path(addresses.file_name(name) or name) if addresses.is_address(name) else Path(name)
    return path.stem if path.suffix in SUFFIXES else path.name


def listed(names: str) -> str:
    """A list of motions in which folders and patterns are replaced by the motion files that they stand for.

    A folder is one's own, a shipped one or one of a data set's on the Hugging Face hub; a pattern has a ``*``, ``?`` or
    ``[]``, ``**`` for folders in folders. Its files share its weight evenly.

    Raises:
      UserError: a folder holds no motion files, no file fits a pattern, a file's name has a comma, or `parse` refuses
        the list.
    """
    if os.path.isfile(names):
        return names
    entries = []
    for name, weight in parse(names):
        files = _files(name)
        if files is None:
            entries.append(name if weight == 1 else f"{name}:{weight:g}")
            continue
        for file in files:
            if "," in file:
                raise UserError(
                    f"motion file {file} has a comma in its name: expected none, since commas separate motions"
                )
        entries += [f"{file}:{weight / len(files):.6g}" for file in files]
    return ",".join(entries)


def briefly(names: str) -> str:
    """A list of motions in a line: as it is, or the number of them and the first names where they are many."""
    entries = parse(names)
    if len(entries) <= NAMED:
        return f"motion {names}"
    return f"{len(entries)} motions: {', '.join(name for name, _ in entries[:NAMED])} and {len(entries) - NAMED} more"


def _files(name: str) -> list[str] | None:
    """The motion files that a folder or a pattern stands for; None for the name of one motion."""
    if addresses.is_address(name):
        return addresses.listed(name, SUFFIXES)
    shipped = resources.folder("motions") / name
    folder = next((path for path in (Path(name), shipped) if path.is_dir()), None)
    if folder is not None:
        found = sorted(path for path in folder.iterdir() if path.suffix in SUFFIXES)
        if not found:
            raise UserError(f"folder {folder} has no motion files: expected files that end in {', '.join(SUFFIXES)}")
        if folder == shipped and not Path(name).is_absolute():
            return [f"{name}/{path.stem}" for path in found]
        return list(map(str, found))
    if os.path.isfile(name) or not any(sign in name for sign in "*?["):
        return None
    matches = sorted(path for path in glob.glob(name, recursive=True) if os.path.isfile(path))
    if not matches:
        raise UserError(f"no file matches the pattern {name!r}: expected motion files, such as 'clips/*.npz'")
    return matches


def accept_license(*names: str) -> None:
    """Accept, without a question, the licenses of the data sets in lists of motions, and print them.

    Raises:
      UserError: the hub cannot be reached, or `parse` refuses a list.
    """
    for name, _ in itertools.chain.from_iterable(map(parse, names)):
        if addresses.is_address(name):
            addresses.check_license(name, accept=True)


def describe(name: str) -> str:
    """What a bundled motion shows, in a line: robot, mean speed, turning where there is any, duration."""
    with np.load(resources.folder("motions") / f"{name}.npz") as file:
        robot = str(file["robot"])
    clip = load(name, robot=robot)
    speed, turn = np.linalg.norm(clip.qvel[:, :2], axis=1).mean(), clip.qvel[:, 5].mean()
    way = f", turning {'left' if turn > 0 else 'right'} at {abs(turn):.2f} rad/s" if abs(turn) > 0.05 else ""
    return f"{robot}, {speed:.2f} m/s{way}, {clip.duration:.1f} s"


def parse(names: str) -> list[tuple[str, float]]:
    """Names and weights of a list of motions.

    Raises:
      UserError: a name is missing, or a weight is no positive number.
    """
    if os.path.isfile(names):  # whatever its name has in it
        return [(names, 1.0)]
    entries = []
    for entry in names.split(","):
        name, colon, text = entry.strip().rpartition(":")
        # A colon before a slash is one of an address.
        if not colon or os.path.isfile(entry.strip()) or (addresses.is_address(entry.strip()) and "/" in text):
            name, text = entry.strip(), "1"
        try:
            weight = float(text)
        except ValueError:
            weight = math.nan
        if not (weight > 0 and math.isfinite(weight)):
            raise UserError(f"motion {entry.strip()!r} has weight {text!r}: expected NAME:WEIGHT, a number above 0")
        if not name:
            raise UserError(f"motion {names!r} names nothing before or after a comma: expected NAME[:WEIGHT],...")
        entries.append((name, weight))
    return entries


def shares(entries: list[tuple[str, float]]) -> tuple[float, ...]:
    """Weights of motions, as `parse` gives them, summing to one."""
    weights = [weight for _, weight in entries]
    return tuple(weight / sum(weights) for weight in weights)
