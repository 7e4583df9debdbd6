"""Several demonstrations as one: which there are, and how often each is drawn."""

import dataclasses
import math
import os
from functools import cached_property
from pathlib import Path

import numpy as np

from fmpjax import resources
from fmpjax.errors import UserError
from fmpjax.motion.clip import MotionClip
from fmpjax.motion.formats import load

SUFFIXES = (".npz", ".npy", ".csv", ".txt", ".json", ".pkl", ".pt")  # of the files of a folder that are motions
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

    def rows_after(self, before: int) -> np.ndarray:
        """Rows with at least ``before`` rows of their own clip ahead of them, ``[W]``."""
        return np.concatenate(
            [np.arange(start + before, start + n) for start, n in zip(self.starts, self.lengths, strict=True)]
        )

    def share_after(self, before: int) -> np.ndarray | None:
        """How often each of those rows is drawn, ``[W]``, summing to one; None for one clip, where all are alike."""
        if len(self.clips) == 1:
            return None
        rows = self.lengths - before
        return np.repeat(np.array(self.weights) / rows, rows)

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
      names: motions as `fmpjax.motion.load` takes them, with commas between them.
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
    path = Path(name)
    return path.stem if path.suffix in SUFFIXES else path.name


def listed(names: str) -> str:
    """A list of motions in which each folder, one's own or a shipped one, is replaced by the motion files in it.

    A folder's weight is shared evenly by its files.

    Raises:
      UserError: a folder holds no motion files, or `parse` refuses the list.
    """
    if os.path.isfile(names):
        return names
    entries = []
    for name, weight in parse(names):
        shipped = resources.folder("motions") / name
        folder = next((path for path in (Path(name), shipped) if path.is_dir()), None)
        names_shipped = folder == shipped and not Path(name).is_absolute()
        if folder is None:
            entries.append(name if weight == 1 else f"{name}:{weight:g}")
            continue
        files = sorted(path for path in folder.iterdir() if path.suffix in SUFFIXES)
        if not files:
            raise UserError(f"folder {folder} holds no motion files: expected some that end in {', '.join(SUFFIXES)}")
        parts = [f"{name}/{path.stem}" if names_shipped else str(path) for path in files]
        entries += [f"{part}:{weight / len(files):.6g}" for part in parts]
    return ",".join(entries)


def briefly(names: str) -> str:
    """A list of motions in a line: as it is, or the number of them and the first names where they are many."""
    entries = parse(names)
    if len(entries) <= NAMED:
        return f"motion {names}"
    return f"{len(entries)} motions: {', '.join(name for name, _ in entries[:NAMED])} and {len(entries) - NAMED} more"


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
        if not colon or os.path.isfile(entry.strip()):
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
