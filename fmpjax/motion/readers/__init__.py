"""Recordings from files: one module per format, told apart by what is in the file and not by its name.

A file is an archive of arrays, PyTorch's archive, a pickle (joblib's as well) or text. Every container may hold every
format; a format is known by the names of its arrays. A reader checks all that it uses and announces every fault as one
`UserError`. What a file does not prove is assumed aloud: a `Recording` has the facts it was read by.
"""

from collections.abc import Mapping
from pathlib import Path

from fmpjax.errors import UserError
from fmpjax.motion.readers import archive, bodies, gmr, humanoidverse, locomujoco, mimickit, own, pickled, smpl, text
from fmpjax.motion.readers.recording import Options, Recording
from fmpjax.robots import Robot

FORMATS = (own, locomujoco, *bodies.DIALECTS, mimickit, gmr, humanoidverse)


def read(file: Path, robot: Robot, options: Options) -> Recording:
    """Read a motion file for ``robot``, at the file's own rate.

    Raises:
      UserError: the file cannot be read, is no motion, or is one of another robot.
    """
    try:
        with file.open("rb") as stream:
            head = stream.read(9)
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from error
    content = arrays(file, head)
    if content is not None:
        return _known(file, content, robot, options)
    if head == b"HIERARCHY":
        raise UserError(f"{file}: a BVH skeleton, which only `fmpjax motion retarget` reads")
    return text.read(file, robot, options)


def arrays(file: Path, head: bytes) -> Mapping | None:
    """The arrays by name in an archive or a pickle, which ``head``, the file's first bytes, tell; None for others.

    Raises:
      UserError: the file is damaged, or holds something else.
    """
    if head[:2] == b"PK":
        found = archive.Arrays(file)
        torch = any(name.endswith("/data.pkl") for name in found.members)
        return pickled.read_torch(file, found.members) if torch else found
    if head[:1] in (b"\x80", b"(", b"}") or head[:2] in pickled.COMPRESSED:
        return _single(file, pickled.read(file))
    return None


def _single(file: Path, content: dict) -> dict:
    """The motion in a dictionary of motions by name, where there is one; else the dictionary."""
    motions = {name: inner for name, inner in content.items() if isinstance(inner, dict)}
    if len(motions) != len(content) or not content:
        return content
    if len(motions) > 1:
        names = ", ".join(name[:40] for name in list(motions)[:4])
        raise UserError(f"{file}: the file holds {len(motions)} motions ({names}), expected one per file")
    return next(iter(motions.values()))


def _known(file: Path, content: Mapping, robot: Robot, options: Options) -> Recording:
    """The recording by the first format that knows the names in ``content``."""
    if smpl.holds(content):
        raise UserError(f"{file}: SMPL parameters of a human, which only `fmpjax motion retarget` reads")
    for format_ in FORMATS:
        if set(format_.MARKS) <= set(content):
            return format_.read(file, content, robot, options)
    names = ", ".join(sorted(content)[:8]) or "nothing"
    expected = " or ".join(f"{', '.join(f.MARKS)} ({f.NAME})" for f in FORMATS)
    raise UserError(f"{file}: the file holds {names[:200]}, expected {expected}")
