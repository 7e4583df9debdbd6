"""Gait metrics of an evaluation (paper, section "Evaluation protocol and metrics").

Everything is a pure function on NumPy arrays, computed in float64. ``T`` recorded steps, ``N`` environments; the state
after step ``k`` is in row ``k``, at time ``(k + 1) / rate``. ``length [N]``, 1 to T, counts the rows of the first
episode; later rows are never read. The metrics return one value per episode, NaN where an episode does not contribute;
`summarize` makes the number to report and how many episodes it is of.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from fmpjax.config import Config
from fmpjax.errors import UserError

# The definitions of the figures.
RATE = Config().control_rate  # Hz, the paper's control steps
LATE_START, LATE_END = 5.0, 10.0  # s, both included [P]
WINDOW = 1.0  # s, of a joint range [P]
PERCENTILES = 5.0, 95.0  # that bound a joint range [P]
STILL = 1e-6  # rad; a joint whose expert range is smaller has no ratio to it [D]
TURNS = 0.1  # rad/s, from which a demonstration turns [D]
LEAST_SPEED = 0.1  # m/s, to which an error in speed is relative at least [D]


@dataclasses.dataclass(frozen=True)
class Summary:
    """A metric over episodes: the mean of those that contribute and their number; NaN and 0 when none does."""

    mean: float
    n: int


def summarize(per_episode: np.ndarray) -> Summary:
    """Mean and number of the finite values of ``per_episode [N]``."""
    return Summary(mean(per_episode), int(np.isfinite(per_episode).sum()))


def mean(values: npt.ArrayLike) -> float:
    """Mean of the finite values of an array of any shape, in float64; NaN where there are none."""
    return float(_mean(np.asarray(values, np.float64).ravel(), axis=0))


def late_speed(
    root_position: np.ndarray,
    length: np.ndarray,
    heading: np.ndarray,
    *,
    rate: float = RATE,
    start: float = LATE_START,
    end: float = LATE_END,
) -> np.ndarray:
    """Signed forward speed over the valid steps between 5 and 10 s, m/s.

    The mean speed between the first and the last valid step of that time. An episode with fewer than two valid steps in
    it is excluded and not counted as speed zero.

    Args:
      root_position: ``[T, N, 3]`` m.
      length: ``[N]`` valid steps.
      heading: ``[N]`` rad, of the demonstration at reset.
      rate: Hz.
      start: s.
      end: s, included.

    Returns:
      ``[N]``, NaN where excluded.
    """
    root_position = np.asarray(root_position, np.float64)
    first, last, seconds = _late(length, rate, start, end)
    moved = _rows(root_position, last) - root_position[min(first, len(root_position) - 1)]
    return _forward(moved, heading) / seconds


def late_path(
    root_position: np.ndarray,
    yaw: np.ndarray,
    length: np.ndarray,
    *,
    rate: float = RATE,
    start: float = LATE_START,
    end: float = LATE_END,
) -> tuple[np.ndarray, np.ndarray]:
    """Speed along the robot's own heading (m/s) and turning rate (rad/s, positive to the left) over the late steps.

    What `late_speed` is for a demonstration that goes straight, for one that turns.

    Args:
      root_position: ``[T, N, 3]`` m.
      yaw: ``[T, N]`` rad, of the root; whole turns do not matter.
      length: ``[N]`` valid steps.
      rate: Hz.
      start: s.
      end: s, included.

    Returns:
      Two of ``[N]``, NaN where `late_speed` excludes the episode.
    """
    root_position, yaw = np.asarray(root_position, np.float64), np.asarray(yaw, np.float64)
    first, last, seconds = _late(length, rate, start, end)
    turned = (np.diff(yaw, axis=0) + np.pi) % (2 * np.pi) - np.pi
    moved, heading = np.diff(root_position, axis=0), yaw[:-1] + turned / 2
    along = moved[..., 0] * np.cos(heading) + moved[..., 1] * np.sin(heading)

    def mean(steps: np.ndarray) -> np.ndarray:
        total = np.concatenate([np.zeros_like(steps[:1]), np.cumsum(steps, axis=0)])
        return (_rows(total, last) - total[min(first, len(total) - 1)]) / seconds

    return mean(along), mean(turned)


def _late(length: np.ndarray, rate: float, start: float, end: float) -> tuple[int, np.ndarray, np.ndarray]:
    """First late row, last one of each episode ``[N]``, seconds between ``[N]``, NaN where there are not two rows."""
    # Half a step of slack: row k is at (k + 1) / rate, whatever that rounds to.
    first = int(np.ceil(start * rate - 0.5)) - 1
    last = np.minimum(np.asarray(length), int(np.floor(end * rate + 0.5))) - 1
    included = last > first
    return first, np.where(included, last, 0), np.where(included, (last - first) / rate, np.nan)


def forward_displacement(
    root_position: np.ndarray, length: np.ndarray, heading: np.ndarray, start_position: np.ndarray | None = None
) -> np.ndarray:
    """Signed distance along the demonstration's heading, from the reset to the last valid step, m.

    Args:
      root_position: ``[T, N, 3]`` m.
      length: ``[N]`` valid steps.
      heading: ``[N]`` rad, of the demonstration at reset.
      start_position: ``[N, 3]`` m, at reset; the first recorded step, one control step later, where it is not given.

    Returns:
      ``[N]``.
    """
    root_position = np.asarray(root_position, np.float64)
    start = root_position[0] if start_position is None else np.asarray(start_position, np.float64)
    return _forward(_rows(root_position, np.asarray(length) - 1) - start, heading)


def window_ranges(
    joint_position: np.ndarray,
    length: np.ndarray,
    joints: np.ndarray,
    *,
    rate: float = RATE,
    window: float = WINDOW,
) -> np.ndarray:
    """Range of each joint in each complete window of one second: 95th minus 5th percentile, rad.

    Windows follow one another from the first step on, and do not overlap; percentiles interpolate linearly.

    Args:
      joint_position: ``[T, N, J]`` rad.
      length: ``[N]`` valid steps.
      joints: ``[6]`` indices into J, the robot's sagittal leg joints, left then right.
      rate: Hz.
      window: s.

    Returns:
      ``[W, N, 6]``, NaN where the window is not complete.
    """
    size = round(window * rate)
    q = np.asarray(joint_position, np.float64)[..., joints]
    count = len(q) // size
    low, high = np.percentile(q[: count * size].reshape(count, size, *q.shape[1:]), PERCENTILES, axis=1)
    complete = (np.arange(count)[:, None] + 1) * size <= np.asarray(length)
    return np.where(complete[..., None], high - low, np.nan)


def expert_ranges(
    joint_position: np.ndarray, joints: np.ndarray, *, rate: float = RATE, window: float = WINDOW
) -> np.ndarray:
    """Range of each joint in the demonstration, rad: the mean over its complete windows of one second, ``[6]``.

    Args:
      joint_position: ``[T, J]`` rad, the clip at ``rate``.
      joints: ``[6]`` indices into J.
      rate: Hz.
      window: s.

    Raises:
      UserError: the clip is shorter than one window.
    """
    frames = len(joint_position)
    ranges = window_ranges(np.asarray(joint_position)[:, None], np.array([frames]), joints, rate=rate, window=window)
    if not len(ranges):
        raise UserError(f"demonstration of {frames} frames at {rate:g} Hz: expected at least {window:g} s of motion")
    return ranges[:, 0].mean(axis=0)


def mean_ranges(ranges: np.ndarray) -> np.ndarray:
    """Mean of ``ranges [W, N, 6]`` over the windows and episodes that have them, ``[6]``."""
    return _mean(np.where(np.isfinite(ranges).all(-1, keepdims=True), ranges, np.nan), axis=(0, 1))


def excursion(ranges: np.ndarray, expert: np.ndarray) -> np.ndarray:
    """Ratio of the policy's joint ranges to the expert's, mean over joints and complete windows but the first.

    A joint that the expert holds still has no ratio and is left out.

    Args:
      ranges: ``[W, N, 6]`` rad, of `window_ranges`.
      expert: ``[6]`` rad, of `expert_ranges`.

    Returns:
      ``[N]``, NaN for an episode without a complete second window.
    """
    moving = expert > STILL
    return _mean(ranges[1:, :, moving] / expert[moving], axis=(0, 2))


def amplitude_mae(ranges: np.ndarray, expert: np.ndarray) -> np.ndarray:
    """Mean absolute difference of the policy's and the expert's joint ranges, degrees, over all complete windows.

    Args:
      ranges: ``[W, N, 6]`` rad, of `window_ranges`.
      expert: ``[6]`` rad, of `expert_ranges`.

    Returns:
      ``[N]``, NaN for an episode without a complete window.
    """
    return np.rad2deg(_mean(np.abs(ranges - expert), axis=(0, 2)))


def left_right_imbalance(ranges: np.ndarray) -> np.ndarray:
    """How far left and right joint ranges differ: ``|left - right| / mean(left, right)``, mean over joint pairs.

    Ranges are first averaged over the episode's complete windows: a window of one second need not hold a whole stride,
    and what it cuts off is not an imbalance of the gait. 0 is symmetric (or neither side moves), 2 is one-sided.

    Args:
      ranges: ``[W, N, 6]`` rad, of `window_ranges`: three joints of the left leg, then the same of the right.

    Returns:
      ``[N]``, NaN for an episode without a complete window.
    """
    left, right = np.split(_mean(ranges, axis=0), 2, axis=-1)
    total = left + right
    # NaN stays NaN; only 0/0, two legs at rest, is replaced.
    return _mean(2.0 * np.abs(left - right) / np.where(total == 0.0, 1.0, total), axis=-1)


def contact_foot_speed(
    foot_position: np.ndarray, contact: np.ndarray, length: np.ndarray, *, rate: float = RATE
) -> np.ndarray:
    """Mean planar speed of a foot while it is in contact with the floor, m/s.

    Speed is taken between successive steps, and counts where the foot is in contact at both.

    Args:
      foot_position: ``[T, N, F, 3]`` m.
      contact: ``[T, N, F]`` bool.
      length: ``[N]`` valid steps.
      rate: Hz.

    Returns:
      ``[N]``, NaN for an episode without such a pair of steps.
    """
    planar = np.asarray(foot_position, np.float64)[..., :2]
    contact = np.asarray(contact, bool)
    with np.errstate(invalid="ignore"):  # rows after the episode may hold anything
        speed = np.linalg.norm(np.diff(planar, axis=0), axis=-1) * rate
    valid = np.arange(1, len(planar))[:, None, None] < np.asarray(length)[:, None]
    return _mean(np.where(contact[1:] & contact[:-1] & valid, speed, np.nan), axis=(0, 2))


def action_rate(targets: np.ndarray, length: np.ndarray, *, rate: float = RATE) -> np.ndarray:
    """How fast the joint targets change: mean absolute difference of successive steps times the rate, rad/s.

    Args:
      targets: ``[T, N, J]`` rad.
      length: ``[N]`` valid steps.
      rate: Hz.

    Returns:
      ``[N]``, NaN for an episode of one step.
    """
    return _mean_change(targets, length, order=1) * rate


def joint_jerk(joint_velocity: np.ndarray, length: np.ndarray, *, rate: float = RATE) -> np.ndarray:
    """Mean absolute jerk of the joints, rad/s³: the second difference of their velocities times the squared rate.

    Args:
      joint_velocity: ``[T, N, J]`` rad/s.
      length: ``[N]`` valid steps.
      rate: Hz.

    Returns:
      ``[N]``, NaN for an episode of fewer than three steps.
    """
    return _mean_change(joint_velocity, length, order=2) * rate**2


def power(
    targets: np.ndarray,
    joint_position: np.ndarray,
    joint_velocity: np.ndarray,
    length: np.ndarray,
    *,
    stiffness: np.ndarray,
    damping: np.ndarray,
    effort: np.ndarray,
) -> np.ndarray:
    """Mean mechanical power of the servos, W: the sum over joints of |torque · velocity|.

    The torque is the servo's at the end of each step, ``stiffness · (target - position) - damping · velocity``, at most
    ``effort`` either way. Braking costs as much as driving, and heat is left out.

    Args:
      targets: ``[T, N, J]`` rad.
      joint_position: ``[T, N, J]`` rad.
      joint_velocity: ``[T, N, J]`` rad/s.
      length: ``[N]`` valid steps.
      stiffness: ``[J]`` N m/rad.
      damping: ``[J]`` N m s/rad.
      effort: ``[J]`` N m.

    Returns:
      ``[N]``.
    """
    velocity = np.asarray(joint_velocity, np.float64)
    off = np.asarray(targets, np.float64) - np.asarray(joint_position, np.float64)
    torque = np.clip(stiffness * off - damping * velocity, -effort, effort)
    return _mean(_valid(np.abs(torque * velocity).sum(-1, keepdims=True), length), axis=(0, 2))


def _mean_change(x: np.ndarray, length: np.ndarray, *, order: int) -> np.ndarray:
    """Mean absolute difference of that order along the steps of ``x [T, N, J]``, ``[N]``."""
    x = _valid(np.asarray(x, np.float64), length)
    return _mean(np.abs(np.diff(x, n=order, axis=0)), axis=(0, 2))


def _valid(x: np.ndarray, length: np.ndarray) -> np.ndarray:
    """``x [T, N, J]`` with NaN after the end of each episode."""
    return np.where(np.arange(len(x))[:, None, None] < np.asarray(length)[:, None], x, np.nan)


def _rows(x: np.ndarray, row: np.ndarray) -> np.ndarray:
    """``x[row[n], n]`` for each environment of ``x [T, N, ...]``."""
    return x[row, np.arange(x.shape[1])]


def _forward(moved: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Component of ``moved [N, 3]`` along ``heading [N]``, NaN where the episode ends in a state that is not finite."""
    moved = np.where(np.isfinite(moved), moved, np.nan)
    return moved[:, 0] * np.cos(heading) + moved[:, 1] * np.sin(heading)


def _mean(x: np.ndarray, axis: int | tuple[int, ...]) -> np.ndarray:
    """Mean of the finite values along ``axis``, NaN where there are none; unlike `np.nanmean` it does not warn."""
    finite = np.isfinite(x)
    count = finite.sum(axis=axis)
    return np.where(count > 0, np.where(finite, x, 0.0).sum(axis=axis) / np.maximum(count, 1), np.nan)


def pace_of(figures: Mapping[str, Any]) -> float:
    """The late speed of an evaluation that counts, m/s.

    It is along the robot's own heading where the demonstration turns, and where the prior sees vectors in heading axes:
    there nothing tells the policy a direction of the world, and a push turns it permanently.
    """
    if figures.get("pace") is not None:
        return figures["pace"]
    return figures["path_speed" if figures["demonstration_turning"] > TURNS else "late_speed"]


def choosing(command: str) -> str:
    """The figure of an evaluation whose highest value chooses ``best/``, in runs with a kind of command."""
    return "eval/quality" if command == "none" else "eval/score"


def pace_error(figures: Mapping[str, Any]) -> float:
    """Relative error of an evaluation's pace; 1, as of a robot that stands, where no episode lasts so long."""
    late = pace_of(figures)
    unit = max(figures["demonstration_speed"], LEAST_SPEED)
    return 1.0 if np.isnan(late) else abs(late - figures["demonstration_speed"]) / unit
