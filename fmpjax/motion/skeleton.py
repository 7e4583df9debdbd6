"""A skeleton that moves, as motion capture is read, and where its joints are."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from fmpjax import rotations


class JointPoses(NamedTuple):
    """World poses of ``K`` joints in ``T`` frames, in the file's axes and unit of length."""

    position: np.ndarray  # [T, K, 3]
    rotation_wxyz: np.ndarray  # [T, K, 4]


class Capture(Protocol):
    """A skeleton of ``J`` joints that moves for ``T`` frames; parents come before their children."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints, ``[J]``."""
        ...

    @property
    def parent(self) -> np.ndarray:
        """Index of each joint's parent ``[J]``, -1 for the root."""
        ...

    @property
    def rate(self) -> float:
        """Frames per second, Hz."""
        ...

    @property
    def values(self) -> np.ndarray:
        """One row per frame, ``[T, ...]``."""
        ...

    @property
    def format(self) -> str:
        """What the file is."""
        ...

    def taken(self, values: np.ndarray) -> "Capture":
        """The same skeleton with other frames."""
        ...

    def poses(self, joints: Sequence[int] | None = None) -> JointPoses:
        """World poses of the ``joints``, by default of all, in that order."""
        ...


def posed(
    parent: np.ndarray, local: Callable[[int], tuple[np.ndarray, np.ndarray]], joints: Sequence[int] | None
) -> JointPoses:
    """World poses of the ``joints``, by default of all; joints that none of them hangs on are left out.

    Args:
      parent: ``[J]`` index of each joint's parent, which comes before it, -1 for the root.
      local: place ``[T, 3]`` and orientation ``[T, 4]`` (wxyz) of a joint in its parent.
      joints: indices.
    """
    wanted = range(len(parent)) if joints is None else joints
    needed = np.zeros(len(parent), bool)
    needed[list(wanted)] = True
    for joint in range(len(parent) - 1, 0, -1):
        if needed[joint] and parent[joint] >= 0:
            needed[parent[joint]] = True
    world: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for joint in map(int, np.flatnonzero(needed)):
        moved, turned_wxyz = local(joint)
        if parent[joint] >= 0:
            above, above_wxyz = world[int(parent[joint])]
            moved = above + rotations.rotate(above_wxyz, moved)
            turned_wxyz = rotations.multiply(above_wxyz, turned_wxyz)
        world[joint] = moved, turned_wxyz
    return JointPoses(*(np.stack([world[int(joint)][i] for joint in wanted], axis=1) for i in range(2)))
