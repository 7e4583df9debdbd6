"""Quaternion and 6D rotation algebra on NumPy or JAX arrays.

Quaternions are unit, scalar first (``_wxyz``), components on the last axis. Every function takes leading axes freely
and computes with the array library of its first argument, so the same code serves clips on the host and states on the
device.
"""

from typing import Any

import numpy as np
from jaxtyping import Float


def _library(x):
    if isinstance(x, np.ndarray | np.generic):
        return np
    import jax  # a caller with JAX arrays has imported it; commands without them start without it

    return jax.numpy if isinstance(x, jax.Array) else np


def multiply(a_wxyz: Float[Any, "*#batch 4"], b_wxyz: Float[Any, "*#batch 4"]) -> Float[Any, "... 4"]:
    """Hamilton product of two quaternions, ``[..., 4]``."""
    a, b = (tuple(q[..., i] for i in range(4)) for q in (a_wxyz, b_wxyz))
    return _library(a_wxyz).stack(multiplied(a, b), axis=-1)


def multiplied(a_wxyz, b_wxyz):
    """The same of components: four arrays each, and the product's four."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a_wxyz, b_wxyz
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q_wxyz: Float[Any, "*batch 4"]) -> Float[Any, "*batch 4"]:
    """Inverse of a unit quaternion, ``[..., 4]``."""
    return q_wxyz * np.array([1, -1, -1, -1], q_wxyz.dtype)


def rotate(q_wxyz: Float[Any, "*#batch 4"], v: Float[Any, "*#batch 3"]) -> Float[Any, "... 3"]:
    """Rotate vectors ``v [..., 3]`` by ``q_wxyz [..., 4]``."""
    q, v = tuple(q_wxyz[..., i] for i in range(4)), tuple(v[..., i] for i in range(3))
    return _library(q_wxyz).stack(rotated(q, v), axis=-1)


def rotated(q_wxyz, v):
    """The same of components: four arrays and three, and the rotated vector's three."""
    (w, x, y, z), (a, b, c) = q_wxyz, v
    s, t, u = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (
        a + w * s + (y * u - z * t),
        b + w * t + (z * s - x * u),
        c + w * u + (x * t - y * s),
    )


def exp_map(v: Float[Any, "*batch 3"]) -> Float[Any, "*batch 4"]:
    """Quaternion ``[..., 4]`` of the rotation vector ``v [..., 3]`` (axis times angle, rad)."""
    xp = _library(v)
    half = 0.5 * xp.linalg.norm(v, axis=-1, keepdims=True)
    return xp.concatenate([xp.cos(half), 0.5 * v * xp.sinc(half / np.pi)], axis=-1)


def log_map(q_wxyz: Float[Any, "*batch 4"]) -> Float[Any, "*batch 3"]:
    """Rotation vector ``[..., 3]`` (rad) of the shorter rotation that ``q_wxyz`` stands for."""
    xp = _library(q_wxyz)
    q = xp.where(q_wxyz[..., :1] < 0, -q_wxyz, q_wxyz)
    norm = xp.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    angle = 2.0 * xp.arctan2(norm, q[..., :1])
    # Near zero the angle is twice the vector part; the guard keeps 0/0 out.
    return q[..., 1:] * xp.where(norm > 1e-12, angle / xp.where(norm > 1e-12, norm, 1.0), 2.0)


def slerp(
    a_wxyz: Float[Any, "*#batch 4"], b_wxyz: Float[Any, "*#batch 4"], fraction: Float[Any, "*#batch 1"]
) -> Float[Any, "... 4"]:
    """Shortest-arc interpolation from ``a_wxyz`` to ``b_wxyz``; ``fraction [..., 1]`` is in [0, 1]."""
    return multiply(a_wxyz, exp_map(fraction * log_map(multiply(conjugate(a_wxyz), b_wxyz))))


def to_6d(q_wxyz: Float[Any, "*batch 4"]) -> Float[Any, "*batch 6"]:
    """First and last column of the rotation matrix, ``[R e_x, R e_z]``, ``[..., 6]``."""
    xp = _library(q_wxyz)
    w, x, y, z = (q_wxyz[..., i] for i in range(4))
    return xp.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y + w * z),
            2 * (x * z - w * y),
            2 * (x * z + w * y),
            2 * (y * z - w * x),
            1 - 2 * (x * x + y * y),
        ],
        axis=-1,
    )


def yaw(q_wxyz: Float[Any, "*batch 4"]) -> Float[Any, "*batch"]:
    """Heading of the rotated x axis about z, rad, ``[...]``."""
    xp = _library(q_wxyz)
    w, x, y, z = (q_wxyz[..., i] for i in range(4))
    return xp.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def up(q_wxyz: Float[Any, "*batch 4"]) -> Float[Any, "*batch"]:
    """Cosine of the tilt of the rotated z axis, ``[...]``: 1 upright, -1 upside down."""
    return 1 - 2 * (q_wxyz[..., 1] ** 2 + q_wxyz[..., 2] ** 2)
