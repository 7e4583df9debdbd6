"""What `fmpjax motion retarget` does: a file in, a clip and a report out."""

import dataclasses
import os
from pathlib import Path

import numpy as np

from fmpjax import rotations
from fmpjax.errors import UserError
from fmpjax.motion import addresses, bvh, readers
from fmpjax.motion.clip import Fact, Reading
from fmpjax.motion.formats import cut, save, span
from fmpjax.motion.readers import smpl
from fmpjax.motion.retarget.fit import retarget
from fmpjax.motion.retarget.landmarks import AXES, read_skeleton
from fmpjax.motion.skeleton import Capture
from fmpjax.robots import Robot

ODD_FIRST, ODD_SPEED = 5.0, 15.0  # times the frames after it, and rad/s: a first frame that turns so is another pose
NEXT = 20  # frames after the first that it is compared with


def odd_start(source: Capture) -> bool:
    """Whether the first frame is another pose, such as a T-pose, and the motion begins at the second."""
    if len(source.values) < 4:
        return False
    turned = source.taken(source.values[: NEXT + 2]).poses().rotation_wxyz
    between = rotations.multiply(rotations.conjugate(turned[:-1]), turned[1:])
    angle = np.linalg.norm(rotations.log_map(between), axis=-1).max(axis=1)
    return bool(angle[0] * source.rate > ODD_SPEED and angle[0] > ODD_FIRST * angle[1:].max())


def read(file: Path, body_model: Path | None = None) -> Capture:
    """Read motion capture: BVH, or a body model's parameters, which need the model.

    Raises:
      UserError: the file cannot be read, or the model is missing, no model or not needed.
    """
    try:
        with file.open("rb") as stream:
            head = stream.read(9)
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from error
    content = readers.arrays(file, head)
    if content is not None:
        return smpl.read(file, content, body_model)
    if body_model is not None:
        raise UserError(f"{file}: not SMPL parameters (.npz), which --body-model {body_model} is for")
    return bvh.read(file)


def convert(
    file: str | os.PathLike,
    robot: Robot,
    out: str | os.PathLike,
    frames: str | None = None,
    *,
    skeleton: str | os.PathLike | None = None,
    up: str | None = None,
    body_model: str | os.PathLike | None = None,
) -> tuple[str, bool]:
    """Retarget the ``file``, or its ``frames`` FIRST:LAST, and write the clip as ``out``.

    Args:
      file: motion capture, by its path or its address.
      robot: that it is put on.
      out: file to write, ``.npz``.
      frames: those to take; all for None.
      skeleton: a TOML file that names the skeleton's joint of each part, such as ``left_hip = "LThigh"``.
      up: the file's axis that is up, "y" or "z".
      body_model: the body model of a file with SMPL's parameters.

    Returns:
      What was read and how it fits, and whether the result is broken. A broken one is written as well.

    Raises:
      UserError: see `addresses.fetch`, `read`, `formats.cut`, `retarget` and `fmpjax.motion.save`.
    """
    if up not in (None, *AXES):
        raise UserError(f"--up is {up!r}, expected one of {', '.join(AXES)}")
    file = addresses.local(file)
    source = read(file, None if body_model is None else Path(body_model))
    names = None if skeleton is None else read_skeleton(skeleton)
    count, said = len(source.values), []
    cut(file, source.values, frames)  # refuses rows that are not there
    first, last = (0, count - 1) if frames is None else span(frames, count)
    if first == 0 and last > 1 and odd_start(source):
        first = 1
        said.append("frame 0 is another pose, and is left out")
    done = retarget(source, robot, str(file), span=(first, last), skeleton=names, up=up)
    done = done._replace(clip=dataclasses.replace(done.clip, name=file.stem))
    save(done.clip, out)
    facts = [*done.clip.reading.facts, Fact("frames", f"{first} to {last}", "as asked" if frames else "all")]
    verdict, faults = done.verdict(robot)
    lines = [
        f"{file} was read as",
        str(Reading(tuple(facts), tuple(said))),
        f"wrote {out}: {len(done.clip)} frames at {done.clip.rate:g} Hz, {done.scale:.4g} m per unit of the file, "
        f"{1000 * done.residual.mean():.1f} mm off the scaled skeleton on average and "
        f"{1000 * done.residual.max():.1f} mm at worst",
        f"verdict: {verdict}",
        *(f"  {fault}" for fault in faults),
    ]
    return "\n".join(lines), verdict == "broken"
