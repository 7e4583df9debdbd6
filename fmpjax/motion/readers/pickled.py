"""Arrays and plain containers from a pickle, without running what the pickle says.

A pickle is a program: it names functions and calls them. This reader knows six names, those by which NumPy pickles
its arrays, and puts inert stand-ins behind them that check what they are given; any other name ends the reading. Keys
of dictionaries must be text, because hashing a deep structure can exhaust the stack. The interpreter is Python's own
of the pickle module: its C twin lets a few bytes reserve gigabytes.
"""

import io
import math
import pickle
from pathlib import Path

import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion.readers.recording import MOST_SAMPLES

MOST_BYTES = 1 << 27


def read(file: Path) -> dict[str, object]:
    """The dictionary in a pickle: arrays, numbers, text and lists by name.

    Raises:
      UserError: the file is cut short, too large, holds no dictionary, or names anything but NumPy's arrays.
    """
    try:
        size = file.stat().st_size
        if size > MOST_BYTES:
            raise UserError(f"{file}: the pickle has {size} bytes, expected at most {MOST_BYTES}")
        found = _Reader(io.BytesIO(file.read_bytes())).load()
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from error
    except _Refused as refused:
        raise UserError(f"{file}: {refused}, expected arrays, numbers and lists alone") from None
    except UserError:
        raise
    except Exception:
        # The interpreter has no common error for a program that makes no sense.
        raise UserError(f"{file}: not a readable pickle") from None
    if not isinstance(found, dict):
        raise UserError(f"{file}: the pickle holds a {type(found).__name__}, expected a dictionary")
    return {name: value.array if isinstance(value, _Array) else value for name, value in found.items()}


def numbers(file: Path, name: str, value, columns: int) -> np.ndarray:
    """An array as it is; rows in lists as an array ``[T, columns]``."""
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, list | tuple) or len(value) > MOST_SAMPLES:
        raise UserError(f"{file}: {name} is a {type(value).__name__}, expected numbers of shape (T, {columns})")
    rows = [row.array if isinstance(row, _Array) else row for row in value]
    for i, row in enumerate(rows):
        plain = isinstance(row, list | tuple) and all(type(x) in (int, float) for x in row[: columns + 1])
        if not (plain or isinstance(row, np.ndarray) and row.ndim == 1) or len(row) != columns:
            raise UserError(f"{file}: {name} row {i} is not a list of {columns} numbers")
    try:
        return np.array(rows, np.float64).reshape(-1, columns)
    except (ValueError, OverflowError, TypeError):
        raise UserError(f"{file}: {name} holds something that is not a number") from None


class _Refused(Exception):
    pass


class _Reader(pickle._Unpickler):
    """The interpreter, without sets, extensions and objects; dictionaries have text for keys."""

    dispatch = dict(pickle._Unpickler.dispatch)
    for _code in (pickle.FROZENSET, pickle.ADDITEMS, pickle.EXT1, pickle.EXT2, pickle.EXT4, pickle.PERSID):
        del dispatch[_code[0]]
    for _code in (pickle.BINPERSID, pickle.INST, pickle.OBJ, pickle.NEWOBJ, pickle.NEWOBJ_EX):
        del dispatch[_code[0]]
    del _code

    def find_class(self, module: str, name: str):
        known = _KNOWN.get((module.partition(".")[0], name))
        if known is not None:
            return known
        raise _Refused(f"the pickle names {module[:60]}.{name[:60]}")

    def _set(self, target: dict, items: list) -> None:
        if type(target) is not dict or not all(type(key) is str for key in items[::2]):
            raise _Refused("the pickle has a dictionary whose keys are not text")
        target.update(zip(items[::2], items[1::2], strict=True))

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set(self.stack[-1], [key, value])

    def load_setitems(self) -> None:
        items = self.pop_mark()
        self._set(self.stack[-1], items)

    def load_dict(self) -> None:
        items = self.pop_mark()
        self.stack.append({})
        self._set(self.stack[-1], items)

    dispatch[pickle.SETITEM[0]] = load_setitem
    dispatch[pickle.SETITEMS[0]] = load_setitems
    dispatch[pickle.DICT[0]] = load_dict


class _Inert:
    """Has ``__setstate__``, so that a pickle cannot write attributes."""

    def __setstate__(self, state) -> None:
        raise _Refused("the pickle gives a state to what has none")


class _Class(_Inert):
    """`numpy.ndarray`, named as an argument and never called."""

    def __init__(self, *_):
        raise _Refused("the pickle makes an array by its class")


class _Dtype(_Inert):
    """`numpy.dtype` of numbers."""

    def __init__(self, code, *_):
        self.dtype = np.dtype(code) if isinstance(code, str) and len(code) < 8 else np.dtype(object)
        if self.dtype.kind not in "fiub":
            raise _Refused("the pickle has an array of something that is not a number")

    def __setstate__(self, state) -> None:
        if state[1] in (">", "<"):
            self.dtype = self.dtype.newbyteorder(state[1])


class _Array(_Inert):
    """An array from its bytes."""

    array = np.zeros(0)

    def __init__(self, *_):
        pass  # NumPy makes an empty array first; its state brings shape and content

    def __setstate__(self, state) -> None:
        _, shape, dtype, fortran, raw = state
        self._fill(raw, dtype, shape, "F" if fortran else "C")

    def _fill(self, raw, dtype, shape, order) -> None:
        if isinstance(raw, str):
            raw = raw.encode("latin1")  # from Python 2
        shape = tuple(shape)
        if not isinstance(dtype, _Dtype) or math.prod(shape) * dtype.dtype.itemsize != len(raw):
            raise _Refused("the pickle has an array whose shape is not that of its content")
        self.array = np.frombuffer(bytes(raw), dtype.dtype).reshape(shape, order=order)


class _FromBuffer(_Array):
    """``numpy._core.numeric._frombuffer``, protocol 5."""

    def __init__(self, raw, dtype, shape, order):
        self._fill(raw, dtype, shape, order)


class _Scalar(_Array):
    """``numpy._core.multiarray.scalar``."""

    def __init__(self, dtype, raw):
        self._fill(raw, dtype, (), "C")


class _Encoded(_Inert):
    """``_codecs.encode``, by which protocols below 3 write bytes."""

    def __new__(cls, text, encoding):
        if not isinstance(text, str) or encoding != "latin1":
            raise _Refused("the pickle has bytes in an unknown encoding")
        return text.encode("latin1")


_KNOWN = {
    ("numpy", "ndarray"): _Class,
    ("numpy", "dtype"): _Dtype,
    ("numpy", "_reconstruct"): _Array,
    ("numpy", "_frombuffer"): _FromBuffer,
    ("numpy", "scalar"): _Scalar,
    ("_codecs", "encode"): _Encoded,
}
