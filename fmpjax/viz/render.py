"""Videos of the robot without a screen and without root rights.

MuJoCo draws through EGL or OSMesa, on macOS through CGL, whichever works here; where none does, a skeleton is plotted
instead, so that a video always comes out. Configurations ``qpos [T, 7 + J]`` are in MuJoCo's order: root position (m),
root quaternion wxyz, joint angles (rad). Frames are ``uint8 [T, H, W, 3]``.
"""

import functools
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter1d

from fmpjax.errors import UserError
from fmpjax.robots import Robot
from fmpjax.viz import opengl, skeleton
from fmpjax.viz.opengl import backend
from fmpjax.viz.video import contact_sheet, write_video

__all__ = ["BACKENDS", "backend", "contact_sheet", "grid", "render_frames", "write_video"]

BACKENDS = ("egl", "osmesa", "cgl", "skeleton")
SMOOTHING = 12.0  # frames, standard deviation of the camera's path


def render_frames(
    robot: Robot,
    qpos: np.ndarray,
    *,
    width: int = 480,
    height: int = 360,
    ghost: np.ndarray | None = None,
    follow: bool = True,
    labels: str | Sequence[str] | None = None,
    using: str | None = None,
    smooth: bool = True,
) -> np.ndarray:
    """Draw a motion.

    Args:
      robot: the robot.
      qpos: ``[T, 7 + J]`` configurations.
      width: pixels.
      height: pixels.
      ghost: ``[T, 7 + J]``, a second motion drawn as a translucent robot.
      follow: move the camera with the root, smoothly; otherwise it is fixed and sees the whole path.
      labels: a caption, or one per frame.
      using: one of `BACKENDS` instead of the one that `backend` finds.
      smooth: draw smooth edges, which without a GPU takes twice the time.

    Returns:
      ``uint8 [T, height, width, 3]``.

    Raises:
      UserError: a motion has another shape or is not finite, the labels are too few, or ``using`` is unknown.
    """
    using = backend() if using is None else using
    if using not in BACKENDS:
        raise UserError(f"unknown renderer {using!r}: expected one of {', '.join(BACKENDS)}")
    motions = [_checked(robot, "qpos", qpos)]
    if ghost is not None:
        motions.append(_checked(robot, "ghost", ghost))
        if len(motions[0]) != len(motions[1]):
            raise UserError(f"ghost has {len(motions[1])} frames: expected as many as qpos, {len(motions[0])}")
    captions = [labels] * len(qpos) if labels is None or isinstance(labels, str) else list(labels)
    if len(captions) != len(qpos):
        raise UserError(f"labels has {len(captions)} captions: expected one per frame, {len(qpos)}")
    frames = np.zeros((len(qpos), height, width, 3), np.uint8)
    if len(frames) == 0:
        return frames
    if using != "skeleton":
        try:
            _draw(functools.partial(opengl.drawing, using, smooth=smooth), robot, motions, captions, follow, frames)
            return frames
        except opengl.DriverError as error:
            opengl.say(f"the renderer {using!r} failed ({error}): pictures are drawn by 'skeleton' instead")
    _draw(skeleton.drawing, robot, motions, captions, follow, frames)
    return frames


def _draw(draw, robot: Robot, motions, captions, follow: bool, frames: np.ndarray) -> None:
    """Fill ``frames``, drawn by ``draw``: `opengl.drawing` or `skeleton.drawing`."""
    _, height, width, _ = frames.shape
    look, distance = _camera_path(robot, motions[0][:, :2], width / height, follow)
    with draw(robot, width, height, distance) as picture:
        for i, caption in enumerate(captions):
            frames[i] = picture([motion[i] for motion in motions], look[i])
            if caption:
                frames[i] = _captioned(frames[i], caption)


def grid(
    robot: Robot,
    motions: Sequence[np.ndarray],
    labels: Sequence[str | Sequence[str]],
    *,
    columns: int = 3,
    width: int = 960,
    height: int = 640,
    using: str | None = None,
    smooth: bool = True,
) -> np.ndarray:
    """Draw several motions at once, each in a pane with its label; shorter ones hold their last frame.

    Args:
      robot: the robot.
      motions: ``[T, 7 + J]`` each.
      labels: one for each motion, or one for each of its frames.
      columns: panes in a row.
      width: pixels, of all panes together.
      height: pixels, of all panes together.
      using: as in `render_frames`.
      smooth: likewise.

    Returns:
      ``uint8 [longest T, height, width, 3]``.
    """
    gap = 2  # pixels between the panes
    if not motions or min(map(len, motions)) == 0:
        raise UserError("a motion to show has no frames: expected at least one")
    rows = -(-len(motions) // columns)
    length = max(map(len, motions))
    frames = np.full((length, height, width, 3), 255, np.uint8)
    across, down = (np.linspace(0, size + gap, n + 1).astype(int) for size, n in ((width, columns), (height, rows)))
    for index, (qpos, label) in enumerate(zip(motions, labels, strict=True)):
        row, column = divmod(index, columns)
        top, left, low, right = down[row], across[column], down[row + 1] - gap, across[column + 1] - gap
        pane = render_frames(
            robot, qpos, width=right - left, height=low - top, labels=label, using=using, smooth=smooth
        )
        frames[:, top:low, left:right] = pane[np.minimum(np.arange(length), len(pane) - 1)]
    return frames


def _camera_path(robot: Robot, root: np.ndarray, aspect: float, follow: bool) -> tuple[np.ndarray, float]:
    """Points to look at ``[T, 3]`` and the camera's distance, m, for a root path ``[T, 2]``.

    Their height is fixed, so that a fall is seen as one.
    """
    narrow = max(1.0, 0.8 / aspect)  # a tall pane steps back until a stride fits
    if follow:
        center = gaussian_filter1d(root, SMOOTHING, axis=0, mode="nearest")
        distance = robot.view_distance * narrow
    else:
        span = np.ptp(root, axis=0)
        center = np.broadcast_to(root.min(0) + span / 2, root.shape)
        distance = robot.view_distance * narrow + 1.2 * float(np.linalg.norm(span)) / max(aspect, 1.0)
    return np.column_stack([center, np.full(len(root), robot.view_height)]), distance


def _captioned(image: np.ndarray, text: str) -> np.ndarray:
    """The image with a caption at its top left."""
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture, "RGBA")
    size = max(10, image.shape[0] // 20)
    font, pad = ImageFont.load_default(size), size // 2
    wide, tall = draw.textlength(text, font), sum(font.getmetrics())  # ty: ignore[missing-union-attribute] - a font of a size is FreeType's
    draw.rounded_rectangle((pad, pad, 3 * pad + wide, 2 * pad + tall), pad, fill=(20, 26, 34, 170))
    draw.text((2 * pad, 1.5 * pad), text, font=font, fill=(255, 255, 255, 255))
    return np.asarray(picture)


def _checked(robot: Robot, name: str, qpos: np.ndarray) -> np.ndarray:
    qpos, columns = np.asarray(qpos, np.float64), 7 + robot.joint_count
    if qpos.ndim != 2 or qpos.shape[1] != columns:
        raise UserError(f"{name} has shape {qpos.shape}: expected (frames, {columns}) for {robot.name}")
    bad = np.flatnonzero(~np.isfinite(qpos).all(axis=1))
    if len(bad):
        raise UserError(f"{name} is not finite in frame {bad[0]}: expected numbers")
    return qpos
