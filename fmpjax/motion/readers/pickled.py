"""Arrays and plain containers from a pickle, without running what the pickle says.

A pickle is a program: it names functions and calls them. This reader knows a few names, those by which NumPy, joblib
and PyTorch write arrays, and puts inert stand-ins behind them that check what they are given; any other name ends the
reading. Keys of dictionaries must be text, because hashing a deep structure can exhaust the stack. The interpreter is
Python's own of the pickle module: its C twin lets a few bytes reserve gigabytes.

joblib writes an array's bytes after the instruction that makes the array, and may compress the whole file. PyTorch
writes a zip archive with one pickle, which refers to the archive's other members by number.
"""

import bz2
import io
import lzma
import math
import pickle
import zipfile
import zlib
from pathlib import Path

import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion.readers.recording import MOST_SAMPLES

MOST_BYTES = 1 << 27
MOST_DEPTH = 4  # of dictionaries in dictionaries
# How a compressed file begins, and what unpacks it; `wbits` of 47 takes zlib's header and gzip's.
COMPRESSED = {
    b"\x1f\x8b": lambda: zlib.decompressobj(wbits=47),
    b"\x78\x01": lambda: zlib.decompressobj(wbits=47),
    b"\x78\x5e": lambda: zlib.decompressobj(wbits=47),
    b"\x78\x9c": lambda: zlib.decompressobj(wbits=47),
    b"\x78\xda": lambda: zlib.decompressobj(wbits=47),
    b"BZ": bz2.BZ2Decompressor,
    b"\xfd7": lzma.LZMADecompressor,
    b"]\x00": lzma.LZMADecompressor,
}
OLD_TORCH = b"\x80\x02\x8a\x0a\x6c\xfc\x9c"  # a number that PyTorch wrote before it wrote archives


def read(file: Path) -> dict[str, object]:
    """The dictionary in a pickle: arrays, numbers, text, lists and dictionaries by name.

    Raises:
      UserError: the file is cut short, too large, holds no dictionary, or names anything but arrays.
    """
    try:
        size = file.stat().st_size
        if size > MOST_BYTES:
            raise UserError(f"{file}: the pickle has {size} bytes, expected at most {MOST_BYTES}")
        raw = file.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from error
    if raw.startswith(OLD_TORCH):
        raise UserError(f"{file}: an archive of PyTorch before 1.6, expected one saved by a newer PyTorch")
    return _run(file, lambda: _Reader(io.BytesIO(_unpacked(raw))))


def read_torch(file: Path, names: list[str]) -> dict[str, object]:
    """The dictionary in PyTorch's archive, whose members are ``names``; errors as of `read`."""
    folder = next(name for name in names if name.endswith("/data.pkl"))[: -len("data.pkl")]
    return _run(file, lambda: _TorchReader(file, folder))


def read_texts(file: Path, raw: bytes) -> np.ndarray:
    """The array of text that NumPy has pickled because its type was object; errors as of `read`."""
    found = _run(file, lambda: _Reader(io.BytesIO(raw)), kind=_Array).array
    if found.dtype.kind != "U":
        raise UserError(f"{file}: an array of objects, expected numbers or text")
    return found


def _run(file: Path, reader, kind=dict):
    try:
        found = reader().load()
        if not isinstance(found, kind):
            name = "single array" if isinstance(found, _Array) else type(found).__name__
            raise UserError(f"{file}: the pickle holds a {name}, expected a dictionary")
        return _plain(found) if kind is dict else found
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from error
    except _Refused as refused:
        raise UserError(f"{file}: {refused}, expected only arrays, numbers, text, lists and dictionaries") from None
    except UserError:
        raise
    except Exception:
        # The interpreter has no common error for a program that makes no sense.
        raise UserError(f"{file}: not a readable pickle") from None


def _plain(value, depth: int = 0):
    """Dictionaries with arrays in place of their stand-ins."""
    if isinstance(value, _Array):
        return value.array
    if not isinstance(value, dict):
        return value
    if depth > MOST_DEPTH:
        raise _Refused("the pickle has dictionaries that are nested too deep")
    return {name: _plain(inner, depth + 1) for name, inner in value.items()}


def _unpacked(raw: bytes) -> bytes:
    """The bytes of a file that joblib may have compressed."""
    unpacker = COMPRESSED.get(raw[:2])
    if unpacker is None:
        return raw
    unpacker = unpacker()
    out = unpacker.decompress(raw, MOST_BYTES + 1)
    if len(out) > MOST_BYTES:
        raise _Refused(f"the pickle unpacks to more than {MOST_BYTES} bytes")
    if not unpacker.eof:
        raise _Refused("the compressed pickle is cut short")
    return out


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
    for _code in (pickle.BINPERSID, pickle.INST, pickle.OBJ, pickle.NEWOBJ_EX):
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

    def load_newobj(self) -> None:
        arguments, made = self.stack.pop(), self.stack.pop()
        if made is not _Following or arguments != ():
            raise _Refused("the pickle makes an object")
        self.append(_Following())

    def load_build(self) -> None:
        super().load_build()
        made = self.stack[-1]
        if isinstance(made, _Following):
            made.fill(self._following)

    def _following(self, size: int) -> bytes:
        """The next bytes of the file, which follow an instruction and are none."""
        frame = self._unframer.current_frame
        if frame is not None and frame.read(1):
            raise _Refused("the pickle has an array within a frame")
        self._unframer.current_frame = None
        raw = self._unframer.file_read(size)
        if len(raw) != size:
            raise _Refused("the pickle is cut short")
        return raw

    dispatch[pickle.NEWOBJ[0]] = load_newobj
    dispatch[pickle.BUILD[0]] = load_build
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
    """`numpy.dtype` of numbers or text, or of objects, which `_Array` takes where all are text."""

    def __init__(self, code, *_):
        self.dtype = np.dtype(code) if isinstance(code, str) and len(code) < 8 else np.dtype("V1")
        if self.dtype.kind not in "fiubUO":
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
        shape = tuple(shape)
        if isinstance(dtype, _Dtype) and dtype.dtype.kind == "O":
            if not isinstance(raw, list) or not all(type(x) is str for x in raw) or math.prod(shape) != len(raw):
                raise _Refused("the pickle has an array of objects")
            # NumPy's text is as wide as the longest.
            if len(raw) * max(map(len, raw), default=0) * 4 > MOST_BYTES:
                raise _Refused("the pickle has an array of long texts")
            self.array = np.array(raw, dtype=str).reshape(shape)
            return
        if isinstance(raw, str):
            raw = raw.encode("latin1")  # from Python 2
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


class _Following(_Array):
    """``joblib.numpy_pickle.NumpyArrayWrapper``: an array whose bytes follow in the file."""

    def __setstate__(self, state) -> None:
        self.state = state

    def fill(self, following) -> None:
        """Take the array's bytes from ``following(size)``."""
        state, self.state = self.state, None
        shape, dtype = state["shape"], state["dtype"]
        if not isinstance(dtype, _Dtype) or dtype.dtype.kind not in "fiub":
            raise _Refused("the pickle has an array of something that is not a number")
        if state.get("numpy_array_alignment_bytes") is not None:
            following(following(1)[0])
        size = math.prod(shape) * dtype.dtype.itemsize
        if not 0 <= size <= MOST_BYTES:
            raise _Refused("the pickle has an array of an impossible size")
        self._fill(following(size), dtype, shape, "F" if state["order"] == "F" else "C")


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
    ("joblib", "NumpyArrayWrapper"): _Following,
}


class _Storage(_Inert):
    """A type of PyTorch's storages, named and never called."""

    def __init__(self, code: str):
        self.dtype = np.dtype(code)


class _Tensor(_Array):
    """``torch._utils._rebuild_tensor_v2``."""

    def __init__(self, storage, offset, shape, stride, *_):
        if (
            not isinstance(storage, np.ndarray)
            or len(shape) != len(stride)
            or not all(type(x) is int and x >= 0 for x in (offset, *shape, *stride))
        ):
            raise _Refused("the archive has an invalid tensor")
        count = math.prod(shape)
        last = offset + sum((n - 1) * step for n, step in zip(shape, stride, strict=True))
        if count and (last >= len(storage) or count > len(storage)):
            raise _Refused("the archive has a tensor beyond its storage")
        if count:
            steps = tuple(step * storage.itemsize for step in stride)
            self.array = np.lib.stride_tricks.as_strided(storage[offset:], tuple(shape), steps, writeable=False)
        else:
            self.array = np.zeros(tuple(shape), storage.dtype)

    def __setstate__(self, state) -> None:
        raise _Refused("the archive gives a state to a tensor")


class _Hooks(dict):
    """`collections.OrderedDict` without content, which every tensor is given."""

    def __init__(self, *arguments):
        if arguments:
            raise _Refused("the archive fills an OrderedDict")

    def __setstate__(self, state) -> None:
        raise _Refused("the archive gives a state to what has none")


_STORAGES = {
    "FloatStorage": "f4", "DoubleStorage": "f8", "HalfStorage": "f2", "LongStorage": "i8", "IntStorage": "i4",
    "ShortStorage": "i2", "CharStorage": "i1", "ByteStorage": "u1", "BoolStorage": "?",
}  # fmt: skip


class _TorchReader(_Reader):
    """The interpreter of the pickle in PyTorch's archive, which refers to members by number."""

    dispatch = dict(_Reader.dispatch)

    def __init__(self, file: Path, folder: str):
        self._file, self._folder, self._left = file, folder, MOST_BYTES
        super().__init__(io.BytesIO(self._member("data.pkl")))

    def _member(self, name: str) -> bytes:
        try:
            with zipfile.ZipFile(self._file) as archive, archive.open(self._folder + name) as member:
                raw = member.read(self._left + 1)
        except KeyError:
            raise _Refused(f"the archive has no member {name[:60]!r}") from None
        if len(raw) > self._left:
            raise _Refused(f"the archive's members have more than {MOST_BYTES} bytes")
        self._left -= len(raw)
        return raw

    def find_class(self, module: str, name: str):
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _Tensor
        if module == "torch" and name in _STORAGES:
            return _Storage(_STORAGES[name])
        if (module, name) == ("collections", "OrderedDict"):
            return _Hooks
        return super().find_class(module, name)

    def persistent_load(self, pid) -> np.ndarray:
        kind, storage, key, *_ = pid
        if kind != "storage" or not isinstance(storage, _Storage) or not (isinstance(key, str) and key.isdigit()):
            raise _Refused("the archive refers to something that is not a storage")
        try:
            order = self._member("byteorder").strip()
        except _Refused:
            order = b"little"
        raw, dtype = self._member(f"data/{key}"), storage.dtype.newbyteorder(">" if order == b"big" else "<")
        return np.frombuffer(raw[: len(raw) // dtype.itemsize * dtype.itemsize], dtype)

    dispatch[pickle.BINPERSID[0]] = pickle._Unpickler.load_binpersid
