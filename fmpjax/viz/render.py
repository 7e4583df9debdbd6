"""Videos of the robot without a screen and without root rights.

MuJoCo draws through EGL or OSMesa, on macOS through CGL, whichever works here; where none does, a skeleton is plotted
instead, so that a video always comes out. Configurations ``qpos [T, 7 + J]`` are in MuJoCo's order: root position (m),
root quaternion wxyz, joint angles (rad). Frames are ``uint8 [T, H, W, 3]``.
"""

import contextlib
import copy
import functools
import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter1d

from fmpjax.errors import UserError
from fmpjax.robots import Robot

BACKENDS = ("egl", "osmesa", "cgl", "skeleton")
_HERE = ("cgl",) if sys.platform == "darwin" else ("egl", "osmesa")  # what MuJoCo may draw through on this system
_OFF = ("disable", "disabled", "off", "false", "0")
_ANY = ("", "enable", "enabled", "on", "true", "1", "glfw", "glx")  # what MuJoCo knows beside, and what needs a window

AZIMUTH, ELEVATION = 125.0, -10.0  # deg; the robot walks along +x, past the camera and a little towards it
SMOOTHING = 12.0  # frames, standard deviation of the camera's path
GHOST_RGBA = (0.20, 0.55, 0.95, 0.16)
HIDDEN_GROUPS = slice(3, None)  # geoms that only collide or mark falls
GIF_FPS = 50.0  # Hz; viewers slow faster ones down

# Of the plotted skeleton: a point that is dy farther away appears this much further to the right and up.
SHIFT = np.array([0.2, 0.12])
TONES = {False: ("#25303c", "#46525f", "#97a3af"), True: ("#7fb2ea", "#a3c8f0", "#c5dcf5")}  # near, middle, far
FLOOR_DEPTH = 1.0  # m, how far behind the robot the floor ends
PLOT_DPI = 100

# A context that opens is not enough: without a driver the first use of it fails, and may take the process with it.
_PROBE = """
import importlib, sys
import mujoco
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
"""


@functools.cache
def backend() -> str:
    """What draws here, one of `BACKENDS`.

    The environment variable ``MUJOCO_GL`` may ask for ``egl``, ``osmesa`` or ``cgl``, which is tried first, or for
    none of them by ``disable``. Where what it asks for does not draw, a sentence on standard error says what does.
    """
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    if asked in _OFF:
        return "skeleton"
    found = next((name for name in sorted(_HERE, key=lambda name: name != asked) if _draws(name)), "skeleton")
    if asked not in (*_ANY, found):
        _say(f"MUJOCO_GL is {asked!r}, which draws nothing here: pictures are drawn by {found!r} instead")
    return found


def _draws(name: str) -> bool:
    command = [sys.executable, "-c", _PROBE, name]
    # A name that MuJoCo does not know would keep the probe from importing it.
    environment = os.environ | {"MUJOCO_GL": name}
    with contextlib.suppress(subprocess.TimeoutExpired):
        return subprocess.run(command, env=environment, capture_output=True, timeout=60).returncode == 0
    return False


@functools.cache  # once in a process
def _say(sentence: str) -> None:
    print(f"fmpjax: {sentence}", file=sys.stderr, flush=True)


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
) -> np.ndarray:
    """Draw a motion.

    Args:
      robot: the robot.
      qpos: ``[T, 7 + J]`` configurations.
      width: pixels.
      height: pixels.
      ghost: ``[T, 7 + J]``, a second motion drawn as a translucent robot.
      follow: move the camera with the root, smoothly; otherwise it stands still and sees the whole path.
      labels: a caption, or one per frame.
      using: one of `BACKENDS` instead of the one that `backend` finds.

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
            _draw(functools.partial(_scene, using), robot, motions, captions, follow, frames)
            return frames
        except _DriverError as error:
            _say(f"the renderer {using!r} failed ({error}): pictures are drawn by 'skeleton' instead")
    _draw(_skeleton, robot, motions, captions, follow, frames)
    return frames


class _DriverError(Exception):
    """MuJoCo cannot draw through a platform, though the probe could."""


def _draw(draw, robot: Robot, motions, captions, follow: bool, frames: np.ndarray) -> None:
    """Fill ``frames``, drawn by ``draw``: `_scene` or `_skeleton`."""
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
    labels: Sequence[str],
    *,
    columns: int = 3,
    width: int = 960,
    height: int = 640,
    using: str | None = None,
) -> np.ndarray:
    """Draw several motions at once, each in a pane with its label; shorter ones hold their last frame.

    Args:
      robot: the robot.
      motions: ``[T, 7 + J]`` each.
      labels: one for each motion.
      columns: panes in a row.
      width: pixels, of all panes together.
      height: pixels, of all panes together.
      using: as in `render_frames`.

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
        pane = render_frames(robot, qpos, width=right - left, height=low - top, labels=label, using=using)
        frames[:, top:low, left:right] = pane[np.minimum(np.arange(length), len(pane) - 1)]
    return frames


def write_video(path: str | Path, frames: np.ndarray, fps: float) -> Path:
    """Write ``frames`` as ``.mp4``, or as ``.gif`` where that is asked for or no encoder is installed.

    Args:
      path: ends in ``.mp4`` or ``.gif``; missing folders are made.
      frames: ``uint8 [T, H, W, 3]``.
      fps: frames per second.

    Returns:
      The path that was really written.

    Raises:
      UserError: the path cannot be written, or there is nothing to write.
    """
    path = Path(path)
    if path.suffix not in (".mp4", ".gif"):
        raise UserError(f"cannot write a video to {path}: expected a name that ends in .mp4 or .gif")
    if len(frames) == 0:
        raise UserError(f"cannot write {path}: the video has no frames")
    encoder = _encoder() if path.suffix == ".mp4" else None
    path = path if encoder or path.suffix == ".gif" else path.with_suffix(".gif")
    with _writing(path):
        if encoder:
            _write_mp4(encoder, path, frames, fps)
        else:
            _write_gif(path, frames, fps)
    return path


def contact_sheet(path: str | Path, frames: np.ndarray, columns: int) -> Path:
    """Write ``frames`` (``uint8 [T, H, W, 3]``) as one PNG, row by row in a grid of ``columns``; returns its path.

    Raises:
      UserError: the path cannot be written, or there is nothing to write.
    """
    path, gap = Path(path), 4
    if len(frames) == 0 or columns < 1:
        raise UserError(f"cannot write {path}: expected at least one frame and one column")
    _, height, width, _ = frames.shape
    columns = min(columns, len(frames))
    rows = -(-len(frames) // columns)
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, np.uint8)
    for i, frame in enumerate(frames):
        top, left = i // columns * (height + gap), i % columns * (width + gap)
        sheet[top : top + height, left : left + width] = frame
    with _writing(path):
        Image.fromarray(sheet).save(path, format="PNG")
    return path


# --- Pictures. Both ways to draw are a context that yields picture(configurations, look) -> uint8 [H, W, 3]. ---

Picture = Callable[[list[np.ndarray], np.ndarray], np.ndarray]


@contextlib.contextmanager
def _scene(name: str, robot: Robot, width: int, height: int, distance: float) -> Iterator[Picture]:
    """Draw with MuJoCo through the OpenGL platform ``name``."""
    model = copy.copy(robot.model)
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    data = mujoco.MjData(model)
    camera, option, perturb = mujoco.MjvCamera(), mujoco.MjvOption(), mujoco.MjvPerturb()
    camera.azimuth, camera.elevation, camera.distance = AZIMUTH, ELEVATION, distance
    option.geomgroup[HIDDEN_GROUPS] = 0
    scene = mujoco.MjvScene(model, maxgeom=3 * model.ngeom + 100)
    rectangle = mujoco.MjrRect(0, 0, width, height)
    # mujoco.Renderer takes its platform from MUJOCO_GL at the first import of mujoco, which is long past.
    try:
        platform = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        platform.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # of any kind: each platform has its own
        raise _DriverError(str(error).strip().partition("\n")[0] or type(error).__name__) from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)

    def pose(qpos: np.ndarray) -> None:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)

    def picture(configurations: list[np.ndarray], look: np.ndarray) -> np.ndarray:
        camera.lookat[:] = look
        pose(configurations[0])
        mujoco.mjv_updateScene(model, data, option, perturb, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
        for ghost in configurations[1:]:
            solid = scene.ngeom
            pose(ghost)
            mujoco.mjv_addGeoms(model, data, option, perturb, mujoco.mjtCatBit.mjCAT_DYNAMIC, scene)
            for geom in scene.geoms[solid : scene.ngeom]:
                geom.matid = -1
                geom.rgba[:] = GHOST_RGBA
        image = np.empty((height, width, 3), np.uint8)
        mujoco.mjr_render(rectangle, scene, context)
        mujoco.mjr_readPixels(image, None, rectangle, context)
        return image[::-1]

    try:
        yield picture
    finally:
        context.free()
        platform.free()


@contextlib.contextmanager
def _skeleton(robot: Robot, width: int, height: int, distance: float) -> Iterator[Picture]:
    """Plot the bones as seen from the robot's right, a little from above."""
    figure = Figure((width / PLOT_DPI, height / PLOT_DPI), dpi=PLOT_DPI, facecolor="#f1f4f7")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    tall = 0.8 * distance  # m, what a picture shows from bottom to top
    wide = tall * width / height
    points_per_metre = 72 * height / PLOT_DPI / tall
    size = robot.view_distance / 2.4  # the thickness of bones below is for this distance
    axes.axhspan(-tall, FLOOR_DEPTH * SHIFT[1], color="#dbe1e7", linewidth=0, zorder=0)
    marks = axes.add_collection(LineCollection([], colors="#bcc6d0", linewidths=1, zorder=1))
    bones = _Bones(robot)

    def picture(configurations: list[np.ndarray], look: np.ndarray) -> np.ndarray:
        axes.set_xlim(look[0] - wide / 2, look[0] + wide / 2)
        axes.set_ylim(look[2] - tall / 2, look[2] + tall / 2)
        # A mark across the floor every half metre shows the motion: the view moves with the robot.
        metres = np.arange(np.floor(look[0] - wide), look[0] + wide, 0.5)
        across = np.array([-tall / SHIFT[1], FLOOR_DEPTH])[:, None] * SHIFT
        marks.set_segments([across + (x, 0.0) for x in metres])
        drawn = []
        for ghostly, qpos in enumerate(configurations):
            tones = np.array(TONES[bool(ghostly)])
            segments, balls = bones.project(qpos, look[1])
            drawn += [
                LineCollection(
                    segments,
                    colors=tones[bones.tone],
                    linewidths=0.045 * size * points_per_metre,
                    capstyle="round",
                    zorder=3 - ghostly,
                ),
                EllipseCollection(
                    *([0.15 * size], [0.17 * size], [0.0]),
                    units="xy",
                    offsets=balls,
                    offset_transform=axes.transData,
                    facecolors=tones[0],
                    zorder=3 - ghostly,
                ),
            ]
        for artist in drawn:
            axes.add_collection(artist, autolim=False)
        canvas.draw()
        for artist in drawn:
            artist.remove()
        return np.asarray(canvas.buffer_rgba())[:height, :width, :3]

    yield picture


class _Bones:
    """The robot as ``N`` line segments, far ones first, each between two points that are fixed in bodies."""

    tone: np.ndarray  # [N] 0 near, 1 middle, 2 far

    def __init__(self, robot: Robot):
        self._model, self._data = robot.model, mujoco.MjData(robot.model)
        none = np.zeros(3)
        child = np.flatnonzero(robot.body_parent >= 0)
        ends = [((robot.body_parent[i], none), (i, none)) for i in child]
        # A body's own extent beyond its joint: feet, hands, and what key points mark, such as the head.
        for body in np.unique(robot.sole_body):
            points = robot.sole_point[robot.sole_body == body]
            ahead = points[:, 0] > points[:, 0].mean()
            heel, toe = (body, points[~ahead].mean(0)), (body, points[ahead].mean(0))
            ends += [((body, none), heel), (heel, toe), (toe, (body, none))]
        leaf = ~np.isin(robot.fall_body, robot.body_parent)
        ends += [((b, none), (b, e[0])) for b, e in zip(robot.fall_body[leaf], robot.fall_ends[leaf], strict=True)]
        marked = np.any(robot.key_offset, axis=1)
        self._balls = list(zip(robot.key_body[marked], robot.key_offset[marked], strict=True))
        ends += [((body, none), (body, offset)) for body, offset in self._balls]
        self._ends = [point for segment in ends for point in segment]
        sideways = self._points(self._ends, robot.default_qpos)[:, 1].reshape(-1, 2).mean(1)
        tone = 1 + (sideways > 0.03).astype(int) - (sideways < -0.03)
        order = np.argsort(-tone, kind="stable")
        self.tone = tone[order]
        self._ends = [self._ends[2 * i + k] for i in order for k in (0, 1)]

    def project(self, qpos: np.ndarray, middle: float) -> tuple[np.ndarray, np.ndarray]:
        """Segments ``[N, 2, 2]`` and balls ``[M, 2]`` in the picture, m; ``middle`` is the y that is not shifted."""
        points = self._points(self._ends + self._balls, qpos)
        flat = points[:, [0, 2]] + (points[:, 1:2] - middle) * SHIFT
        return flat[: len(self._ends)].reshape(-1, 2, 2), flat[len(self._ends) :]

    def _points(self, ends: list[tuple[int, np.ndarray]], qpos: np.ndarray) -> np.ndarray:
        """World positions ``[len(ends), 3]`` of points given as body and offset."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        body = np.array([b for b, _ in ends]) + 1
        offset = np.array([o for _, o in ends])
        return self._data.xpos[body] + np.einsum("nij,nj->ni", self._data.xmat[body].reshape(-1, 3, 3), offset)


def _camera_path(robot: Robot, root: np.ndarray, aspect: float, follow: bool) -> tuple[np.ndarray, float]:
    """Points to look at ``[T, 3]`` and the camera's distance, m, for a root path ``[T, 2]``.

    Their height is fixed, so that a fall is seen as one.
    """
    narrow = max(1.0, 0.8 / aspect)  # a tall pane steps back until a stride fits
    if follow:
        centre = gaussian_filter1d(root, SMOOTHING, axis=0, mode="nearest")
        distance = robot.view_distance * narrow
    else:
        span = np.ptp(root, axis=0)
        centre = np.broadcast_to(root.min(0) + span / 2, root.shape)
        distance = robot.view_distance * narrow + 1.2 * np.linalg.norm(span) / max(aspect, 1.0)
    return np.column_stack([centre, np.full(len(root), robot.view_height)]), distance


def _captioned(image: np.ndarray, text: str) -> np.ndarray:
    """The image with a caption at its top left."""
    picture = Image.fromarray(image)
    draw = ImageDraw.Draw(picture, "RGBA")
    size = max(10, image.shape[0] // 20)
    font, pad = ImageFont.load_default(size), size // 2
    wide, tall = draw.textlength(text, font), sum(font.getmetrics())
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


# --- Files. ---


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Make the folder of ``path``; turn the system's refusal into a `UserError`."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OSError as error:
        reason = error.strerror or str(error).strip().splitlines()[-1]
        raise UserError(f"cannot write {path}: {reason}") from error


def _encoder():
    """The module ``imageio_ffmpeg`` where it is installed with a program to run, else None."""
    try:
        encoder = importlib.import_module("imageio_ffmpeg")
        encoder.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        return None
    return encoder


def _write_mp4(encoder, path: Path, frames: np.ndarray, fps: float) -> None:
    path.touch()  # the system's own words for a path that cannot be written
    # The format wants even sides.
    height, width = frames.shape[1] // 2 * 2, frames.shape[2] // 2 * 2
    writer = encoder.write_frames(
        str(path), (width, height), fps=fps, quality=6, macro_block_size=2, ffmpeg_log_level="error"
    )
    writer.send(None)
    for frame in frames:
        writer.send(np.ascontiguousarray(frame[:height, :width]))
    writer.close()


def _write_gif(path: Path, frames: np.ndarray, fps: float) -> None:
    every = int(np.ceil(fps / GIF_FPS))
    # One palette for all frames, from the first and the last, keeps the colours from flickering.
    palette = Image.fromarray(np.concatenate([frames[0], frames[-1]])).quantize(255)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames[::every]]
    # The format counts in 10 ms: rounding the times, not the durations, keeps the speed right.
    ends = np.round(100 * every / fps * np.arange(len(images) + 1)).astype(int)
    durations = (10 * np.diff(ends)).tolist()
    images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=durations, loop=0)
