"""Plane geometry of a walk whose body moves and turns at a steady rate, seen from its own heading.

A ``way [..., 2]`` (m) is how far the body goes ahead and to its left while it turns by an ``angle [...]`` (rad).
"""

import numpy as np
from numpy.typing import ArrayLike

from fmpjax import rotations


def turned(points: np.ndarray, angle: ArrayLike) -> np.ndarray:
    """Points ``[..., 2]`` turned about the origin by ``angle [...]`` (rad)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = points[..., 0], points[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def arc(way: np.ndarray, angle: ArrayLike) -> np.ndarray:
    """End ``[..., 2]`` (m) of the arc that starts at the origin with heading +x."""
    return turned(way * np.sinc(np.asarray(angle) / (2 * np.pi))[..., None], np.asarray(angle) / 2)


def heading_wxyz(angle: ArrayLike) -> np.ndarray:
    """Quaternion ``[..., 4]`` of a turn about z by ``angle [...]`` (rad)."""
    half = np.asarray(angle) / 2
    zero = np.zeros_like(half)
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def moved(qpos: np.ndarray, way: np.ndarray, angle: ArrayLike) -> np.ndarray:
    """Configurations ``[..., 7 + J]`` moved along the arc."""
    qpos = qpos.copy()
    qpos[..., :2] = arc(way, angle) + turned(qpos[..., :2], angle)
    qpos[..., 3:7] = rotations.multiply(heading_wxyz(angle), qpos[..., 3:7])
    return qpos
