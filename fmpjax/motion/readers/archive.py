"""Arrays of an ``.npz`` archive, each read when it is asked for, with no more memory than the file announces honestly.

NumPy's own reader trusts a header's shape and may unpickle. This one reads plain numbers and text only, and compares a
member's size with its header and with `MOST_BYTES` before it reads. An array of objects is read where all are text.
"""

import io
import lzma
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion.readers import pickled

MOST_BYTES = 1 << 30  # of one array


class Arrays(Mapping):
    """The arrays of an archive by name; reading one raises `UserError` where it is damaged, too large or of objects."""

    def __init__(self, file: Path):
        self._file = file
        try:
            with zipfile.ZipFile(file) as archive:
                self.members = archive.namelist()
                self._sizes = {i.filename[:-4]: i.file_size for i in archive.infolist() if i.filename.endswith(".npy")}
        except (OSError, EOFError, ValueError, NotImplementedError, zipfile.BadZipFile):
            raise self._unreadable() from None

    def __contains__(self, name: object) -> bool:
        return name in self._sizes  # a mapping's own would read the array

    def __iter__(self) -> Iterator[str]:
        return iter(self._sizes)

    def __len__(self) -> int:
        return len(self._sizes)

    def __getitem__(self, name: str) -> np.ndarray:
        size = self._sizes[name]
        if size > MOST_BYTES:
            raise UserError(f"{self._file}: array {name!r} has {size} bytes, expected at most {MOST_BYTES}")
        try:
            with zipfile.ZipFile(self._file) as archive:
                data = io.BytesIO(archive.read(f"{name}.npy"))
            version = np.lib.format.read_magic(data)
            header = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[version]
            try:
                shape, fortran, dtype = header(data)
            except Exception:  # NumPy parses it as a program's text, which has no common error
                raise self._unreadable() from None
            if dtype.kind == "O" and size <= pickled.MOST_BYTES:
                return pickled.read_texts(self._file, data.read())
            if dtype.kind not in "fiuU":
                raise UserError(f"{self._file}: array {name!r} holds {dtype}, expected numbers or text")
            raw = data.read()
            if math.prod(shape) * dtype.itemsize != len(raw):
                raise self._unreadable()
            return np.frombuffer(raw, dtype).reshape(shape, order="F" if fortran else "C")
        except UserError as error:
            if "pickle" not in str(error):
                raise
            raise UserError(f"{self._file}: array {name!r} holds objects, expected numbers or text") from None
        except (OSError, EOFError, ValueError, TypeError, KeyError, NotImplementedError, RuntimeError, SyntaxError):
            raise self._unreadable() from None
        except (zipfile.BadZipFile, zlib.error, lzma.LZMAError):
            # zipfile has no common error for a member that is cut short, damaged or encrypted.
            raise self._unreadable() from None

    def _unreadable(self) -> UserError:
        return UserError(f"{self._file}: not a readable .npz archive")
