"""NumPy functions called from compiled programs on a CPU, by XLA's foreign-function interface.

`jax.pure_callback` does the same, but JAX keeps no compiled program that has one, since it holds an address of this
process. A foreign function is called by its name: the program can be kept and read by another process.

The structures are those of XLA's C interface, ``xla/ffi/api/c_api.h``, as far as they are read here.
"""

import ctypes
from collections.abc import Callable
from ctypes import POINTER, Structure, c_char_p, c_int, c_int32, c_int64, c_size_t, c_uint32, c_void_p

import jax
import numpy as np

Function = Callable[[np.ndarray, np.ndarray], None]  # reads the first array and fills the second

_METADATA, _EXECUTE, _INTERNAL = 1, 3, 13  # kind of extension, stage, error code
_DTYPES = {11: np.float32, 12: np.float64}
_VERSION = 0, 1  # of the interface that is used


class _Extension(Structure):
    _fields_ = [("size", c_size_t), ("kind", c_int), ("next", c_void_p)]


class _Version(Structure):
    _fields_ = [("size", c_size_t), ("extension", c_void_p), ("major", c_int), ("minor", c_int)]


class _Metadata(Structure):
    _fields_ = [("size", c_size_t), ("version", _Version), ("traits", c_uint32), ("state_type", c_int64)]


class _MetadataExtension(Structure):
    _fields_ = [("base", _Extension), ("metadata", POINTER(_Metadata))]


class _Api(Structure):
    _fields_ = [
        ("size", c_size_t),
        ("extension", c_void_p),
        ("version", _Version),
        ("internal", c_void_p),
        ("error_create", ctypes.CFUNCTYPE(c_void_p, c_void_p)),
    ]


class _ErrorArguments(Structure):
    _fields_ = [("size", c_size_t), ("extension", c_void_p), ("message", c_char_p), ("code", c_int)]


class _Buffer(Structure):
    _fields_ = [
        ("size", c_size_t),
        ("extension", c_void_p),
        ("dtype", c_int),
        ("data", c_void_p),
        ("rank", c_int64),
        ("dims", POINTER(c_int64)),
    ]


class _Buffers(Structure):
    _fields_ = [
        ("size", c_size_t),
        ("extension", c_void_p),
        ("count", c_int64),
        ("types", POINTER(c_int32)),
        ("buffers", POINTER(POINTER(_Buffer))),
    ]


class _Frame(Structure):
    _fields_ = [
        ("size", c_size_t),
        ("extension", POINTER(_MetadataExtension)),
        ("api", POINTER(_Api)),
        ("context", c_void_p),
        ("stage", c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
    ]


_HANDLER = ctypes.CFUNCTYPE(c_void_p, POINTER(_Frame))
_registered: dict[str, object] = {}  # handlers by name; XLA keeps their addresses for good


def register(name: str, function: Function) -> None:
    """Give XLA a function under a name; a name that is taken already stays what it is.

    The name must say all that the function computes, since kept programs call it by that alone.
    """
    if name not in _registered:
        handler = _HANDLER(lambda frame: _handle(frame, function))
        new = ctypes.pythonapi.PyCapsule_New
        new.restype, new.argtypes = ctypes.py_object, [c_void_p, c_char_p, c_void_p]
        jax.ffi.register_ffi_target(name, new(ctypes.cast(handler, c_void_p), None, None), platform="cpu")
        _registered[name] = handler


def call(name: str, argument: jax.Array, width: int) -> jax.Array:
    """The registered function of ``argument [..., m]``: ``[..., width]`` of the same type."""
    shape = jax.ShapeDtypeStruct((*argument.shape[:-1], width), argument.dtype)
    return jax.ffi.ffi_call(name, shape, vmap_method="broadcast_all")(argument)


def _handle(frame, function: Function) -> int | None:
    frame = frame.contents
    if frame.extension and frame.extension.contents.base.kind == _METADATA:
        version = frame.extension.contents.metadata.contents.version
        version.major, version.minor = _VERSION
        return None
    if frame.stage != _EXECUTE:
        return None
    try:
        function(_array(frame.arguments), _array(frame.results))
    except BaseException as error:  # XLA would print an exception and continue with what is in memory
        said = f"{type(error).__name__}: {error}".encode()
        arguments = _ErrorArguments(ctypes.sizeof(_ErrorArguments), None, said, _INTERNAL)
        return frame.api.contents.error_create(ctypes.addressof(arguments))
    return None


def _array(buffers: _Buffers) -> np.ndarray:
    """The memory of the only buffer."""
    buffer = buffers.buffers[0].contents
    shape = [buffer.dims[i] for i in range(buffer.rank)]
    dtype = np.dtype(_DTYPES[buffer.dtype])
    size = int(np.prod(shape)) * dtype.itemsize
    memory = (ctypes.c_char * size).from_address(buffer.data)
    return np.frombuffer(memory, dtype).reshape(shape)  # ty: ignore[no-matching-overload] - ctypes' arrays are buffers
