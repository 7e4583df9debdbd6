"""Feet that stand: when they do, how they lie on the floor, and where their ankles are then."""

import numpy as np
from scipy.ndimage import distance_transform_edt, median_filter, uniform_filter1d

from fmpjax import rotations
from fmpjax.motion.retarget.axes import quaternion_wxyz
from fmpjax.motion.retarget.landmarks import SIDES
from fmpjax.robots import Robot

# Of a heel or toe that stands, at the robot's size.
CONTACT_HEIGHT = 0.03  # m, above where it usually stands
CONTACT_SPEED = 0.3  # m/s
STANDING_PERCENTILE = 5.0  # of a point's height over the clip: where it usually stands
SETTLING = 0.05  # s; contacts and their gaps that are shorter do not count
CLEARANCE, RISING = 0.01, 0.1  # m and s; a swinging foot is at least so high, so long after and before it stands
LEVEL, TILTED = 0.05, 0.2  # rad; a standing foot that tilts less is laid flat, one that tilts more is left as it is


def contacts(position: dict, rate: float) -> tuple[np.ndarray, np.ndarray, dict[str, float]]:
    """Whether each foot's heel and toe stand, ``[T, 2]`` each, and the height (m) of ankle and toe when they do."""
    settling = 2 * int(SETTLING * rate) + 1
    stands, floor = [], {}
    for part in ("ankle", "toe"):
        points = np.stack([position[f"{side}_{part}"] for side in SIDES], axis=1)
        floor[part] = float(np.percentile(points[..., 2], STANDING_PERCENTILE))
        speed = np.linalg.norm(np.gradient(points, 1 / rate, axis=0), axis=-1)
        low = points[..., 2] < floor[part] + CONTACT_HEIGHT
        stands.append(median_filter(low & (speed < CONTACT_SPEED), (settling, 1), mode="nearest"))
    return *stands, floor


def foot_orientation(rotation_wxyz: np.ndarray, toe: np.ndarray, flat: np.ndarray, rate: float) -> np.ndarray:
    """Orientation ``[T, 4]`` of a foot, level where it stands on heel and toe (``flat [T]``)."""
    inverse = rotations.conjugate(rotation_wxyz)
    # What is up in the foot is known while it stands; one that never stands is taken as level on average.
    standing = flat if flat.any() else ~flat
    up = rotations.rotate(inverse, np.array([0.0, 0.0, 1.0]))[standing].mean(axis=0)
    up = up / np.linalg.norm(up)
    ahead = rotations.rotate(inverse, toe).mean(axis=0)
    ahead = ahead - (ahead @ up) * up
    ahead = ahead / max(np.linalg.norm(ahead), 1e-9)  # a toe right under the ankle points nowhere
    foot_wxyz = rotations.multiply(rotation_wxyz, quaternion_wxyz(np.column_stack([ahead, np.cross(up, ahead), up])))
    heading = np.zeros_like(toe)
    heading[:, 2] = rotations.yaw(foot_wxyz)
    heading_wxyz = rotations.exp_map(heading)
    tilt = rotations.log_map(rotations.multiply(rotations.conjugate(heading_wxyz), foot_wxyz))
    angle = np.linalg.norm(tilt, axis=-1)
    kept = np.where(angle < TILTED, np.maximum(angle - LEVEL, 0.0) / (TILTED - LEVEL) * TILTED / (angle + 1e-9), 1.0)
    share = uniform_filter1d(flat.astype(float), 2 * int(SETTLING * rate) + 1, mode="nearest")
    return rotations.multiply(heading_wxyz, rotations.exp_map(tilt * (1 - share * (1 - kept))[:, None]))


def sole(robot: Robot, side: str) -> tuple[np.ndarray, np.ndarray]:
    """Points ``[P, 3]`` of a foot's sole, seen from its ankle, and their radii ``[P]``, m."""
    own = robot.sole_body == robot.landmarks[f"{side}_ankle"]
    return robot.sole_point[own], robot.sole_radius[own]


def sole_height(robot: Robot, side: str, foot_wxyz: np.ndarray) -> np.ndarray:
    """Height ``[...]`` (m) of the foot's lowest sole point over its ankle, for orientations ``[..., 4]``."""
    points, radius = sole(robot, side)
    return (rotations.rotate(foot_wxyz[..., None, :], points)[..., 2] - radius).min(axis=-1)


def planted(
    robot: Robot, side: str, free: np.ndarray, foot_wxyz: np.ndarray, stands: np.ndarray, rate: float
) -> np.ndarray:
    """The ankle's path ``free [T, 3]``, corrected so that a standing foot rolls and a swinging one is off the floor.

    While the foot stands, its lowest sole point is on the floor and does not move. Each stance keeps its mean place;
    the correction goes over from one stance to the next linearly.
    """
    points, radius = sole(robot, side)
    arm = rotations.rotate(foot_wxyz[:, None, :], points)  # [T, P, 3]
    lowest = np.argmin(arm[1:, :, 2] + arm[:-1, :, 2] - 2 * radius, axis=-1)
    step = -(arm[1:] - arm[:-1])[np.arange(len(lowest)), lowest, :2]
    rolled = np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)])
    floor = -sole_height(robot, side, foot_wxyz)
    correction = np.column_stack([rolled, floor]) - free
    edges = np.flatnonzero(np.diff(np.concatenate([[False], stands, [False]])))
    for first, end in edges.reshape(-1, 2):
        correction[first:end, :2] -= correction[first:end, :2].mean(axis=0)
    frames, standing = np.arange(len(free)), np.flatnonzero(stands)
    path, least = free.copy(), np.full(len(free), CLEARANCE)
    if len(standing):
        path += np.column_stack([np.interp(frames, standing, column[standing]) for column in correction.T])
        # Before its start and after its end the clip may stand.
        away = distance_transform_edt(np.pad(~stands, 1))[1:-1]
        least *= np.minimum(away / (RISING * rate), 1.0)
    path[:, 2] = np.maximum(path[:, 2], floor + least)
    return path
