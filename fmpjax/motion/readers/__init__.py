"""Recordings from files: one module a format, told apart by what is in the file and not by its name.

A file is an archive of arrays (this package's own, LocoMuJoCo's, BeyondMimic's and mjlab's), a pickle (MimicKit's,
GMR's) or text (Unitree's CSV). A reader checks all that it uses and announces every fault as one `UserError`.
"""

from pathlib import Path

from fmpjax.errors import UserError
from fmpjax.motion.readers import archive, beyondmimic, gmr, lafan1, locomujoco, mimickit, own, pickled
from fmpjax.motion.readers.recording import Recording
from fmpjax.robots import Robot

ARCHIVES = (own, locomujoco, beyondmimic)
PICKLES = (mimickit, gmr)


def read(file: Path, robot: Robot) -> Recording:
    """Read a motion file for ``robot``, at the file's own rate.

    Raises:
      UserError: the file cannot be read, is no motion, or is one of another robot.
    """
    try:
        with file.open("rb") as stream:
            head = stream.read(9)
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from error
    if head[:2] == b"PK":
        return _first(file, archive.Arrays(file), ARCHIVES, robot)
    if head[:1] in (b"\x80", b"(", b"}"):
        return _first(file, pickled.read(file), PICKLES, robot)
    if head == b"HIERARCHY":
        raise UserError(f"{file}: a BVH skeleton, which `fmpjax motion retarget` puts on a robot first")
    return lafan1.read(file, robot)


def _first(file: Path, content, formats, robot: Robot) -> Recording:
    """The recording by the first format that knows the names in ``content``."""
    for format_ in formats:
        if set(format_.MARKS) <= set(content):
            return format_.read(file, content, robot)
    names = ", ".join(sorted(content)[:8]) or "nothing"
    expected = " or ".join(f"{', '.join(f.MARKS)} ({f.NAME})" for f in formats)
    raise UserError(f"{file}: the file holds {names[:200]}, expected {expected}")
