"""A clip to look at: in MuJoCo's viewer, as a contact sheet or video, as curves."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from fmpjax.errors import UserError
from fmpjax.motion.clip import MotionClip
from fmpjax.motion.segment import KINDS, Stretch
from fmpjax.motion.soles import sole_points
from fmpjax.robots import Robot
from fmpjax.viz import render

PICTURES, COLUMNS = 20, 5  # of a contact sheet
VIDEO_FPS = 50.0  # Hz, at most
SIDES = ("left_", "right_")
COLORS = ("#2a6fb0", "#c8553d", "#3a8a6b")  # left, right, neither
KIND_COLORS = dict(zip(KINDS, ("#b8b8b8", "#9b6fb0", "#2a6fb0", "#3a8a6b", "#c8553d"), strict=True))


_NO_DISPLAY = "there is no display"


def has_display() -> bool:
    """Whether a window can be opened here; where one is promised and does not open, a sentence says so."""
    reason = no_window()
    if reason not in (None, _NO_DISPLAY):
        print(f"fmpjax: {reason}: a picture is drawn instead", file=sys.stderr, flush=True)
    return reason is None


def no_window() -> str | None:
    """Why no window can be opened here; None where one can."""
    if sys.platform == "darwin":
        import mujoco.viewer

        return None if mujoco.viewer._MJPYTHON is not None else "no window opens on macOS without mjpython"
    named = [f"{name} {os.environ[name]!r}" for name in ("DISPLAY", "WAYLAND_DISPLAY") if os.environ.get(name)]
    if not named:
        return _NO_DISPLAY
    return None if _window_opens() else f"no window opens on {' and '.join(named)}"


def _window_opens() -> bool:
    """Try a window, in a separate process: MuJoCo's viewer ends the process where none opens."""
    code = (
        "import glfw, sys; ready = glfw.init(); glfw.window_hint(glfw.VISIBLE, False);"
        "sys.exit(not (ready and glfw.create_window(64, 64, '', None, None)))"
    )
    try:
        return subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=30).returncode == 0
    except subprocess.TimeoutExpired:
        return False


def play(robot: Robot, clip: MotionClip) -> None:
    """Show the clip in MuJoCo's viewer, again and again, until its window is closed."""
    import mujoco.viewer

    data = mujoco.MjData(robot.model)
    with mujoco.viewer.launch_passive(robot.model, data) as viewer:
        start = time.perf_counter()
        while viewer.is_running():
            data.qpos[:] = clip.qpos[int((time.perf_counter() - start) * clip.rate) % len(clip)]
            mujoco.mj_forward(robot.model, data)
            viewer.sync()
            time.sleep(1 / clip.rate)


def picture(robot: Robot, clip: MotionClip, path: str | Path) -> Path:
    """Write the clip as a contact sheet (``.png``) or a video (``.mp4``, ``.gif``); returns the path written.

    Raises:
      UserError: the name has another ending, or the path cannot be written.
    """
    path = Path(path)
    if path.suffix == ".png":
        rows = np.unique(np.linspace(0, len(clip) - 1, PICTURES).round().astype(int))
        labels = [f"{row / clip.rate:.2f} s" for row in rows]
        # Each picture has its robot in the middle: rows so far apart leave the camera's smooth path.
        poses = clip.qpos[rows] * np.where(np.arange(clip.qpos.shape[1]) < 2, 0.0, 1.0)
        frames = render.render_frames(robot, poses, width=240, height=240, labels=labels)
        return render.contact_sheet(path, frames, COLUMNS)
    if path.suffix not in (".mp4", ".gif"):
        raise UserError(f"cannot show a motion as {path}: expected a name that ends in .png, .mp4 or .gif")
    every = max(1, int(np.ceil(clip.rate / VIDEO_FPS)))
    return render.write_video(path, render.render_frames(robot, clip.qpos[::every]), clip.rate / every)


def plot(robot: Robot, clip: MotionClip, path: str | Path) -> Path:
    """Draw root height, speed, heights of the feet and every joint against its limits as one PNG; returns its path.

    Raises:
      UserError: the name does not end in ``.png``, or the path cannot be written.
    """
    path = Path(path)
    if path.suffix != ".png":
        raise UserError(f"cannot plot a motion as {path}: expected a name that ends in .png")
    times = np.arange(len(clip)) / clip.rate
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(robot.joint_names):
        groups.setdefault(name.removeprefix(SIDES[0]).removeprefix(SIDES[1]), []).append(i)
    rows = 1 + -(-len(groups) // 4)
    figure = Figure((13, 1.9 * rows), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, 4, sharex=True)
    _root(panels[0], robot, clip, times)
    for panel, (name, joints) in zip(panels[1:].flat, groups.items(), strict=False):
        panel.set_title(f"{name.removesuffix('_joint').replace('_', ' ')}, rad", fontsize=9)
        for joint in joints:
            color = COLORS[_side(robot.joint_names[joint])]
            panel.plot(times, clip.qpos[:, 7 + joint], color=color, linewidth=1)
            for limit in (robot.joint_low[joint], robot.joint_high[joint]):
                panel.axhline(limit, color=color, linewidth=0.8, linestyle=":")
    for panel in panels[1:].flat[len(groups) :]:
        panel.set_axis_off()
    for panel in panels[-1]:
        panel.set_xlabel("s", fontsize=9)
    figure.suptitle(f"{clip.name}: left blue, right red; dotted: limits", fontsize=10)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}") from error
    return path


def timeline(clip: MotionClip, found: list[Stretch], path: str | Path) -> Path:
    """Draw the root's speed and height over time with the stretches behind them, as PNG; returns its path.

    Raises:
      UserError: the name does not end in ``.png``, or the path cannot be written.
    """
    path = Path(path)
    if path.suffix != ".png":
        raise UserError(f"cannot draw stretches as {path}: expected a name that ends in .png")
    figure = Figure((13, 4), dpi=90, layout="constrained")
    FigureCanvasAgg(figure)
    speed, height = figure.subplots(2, 1, sharex=True)
    times = np.arange(len(clip)) / clip.rate
    for panel, title, values in (
        (speed, "speed, m/s", np.linalg.norm(clip.qvel[:, :2], axis=1)),
        (height, "root height, m", clip.qpos[:, 2]),
    ):
        panel.set_ylabel(title, fontsize=9)
        panel.plot(times, values, color="black", linewidth=0.8)
        for stretch in found:
            panel.axvspan(times[stretch.rows][0], times[stretch.rows][-1], color=KIND_COLORS[stretch.kind], alpha=0.4)
    handles = [Patch(color=color, alpha=0.4, label=kind) for kind, color in KIND_COLORS.items()]
    speed.legend(handles=handles, ncols=len(handles), fontsize=8, loc="upper right")
    height.set_xlabel("s", fontsize=9)
    figure.suptitle(clip.name, fontsize=10)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror or error}") from error
    return path


def _root(panels: np.ndarray, robot: Robot, clip: MotionClip, times: np.ndarray) -> None:
    """The first row: the root's height, speed and turning, and the feet's heights."""
    points, _ = sole_points(robot, clip.qpos)
    height = points[..., 2] - robot.sole_radius
    drawn = {"root height, m": clip.qpos[:, 2], "speed, m/s": np.linalg.norm(clip.qvel[:, :2], axis=1)}
    for panel, (title, values) in zip(panels, drawn.items(), strict=False):
        panel.set_title(title, fontsize=9)
        panel.plot(times, values, color=COLORS[2], linewidth=1)
    feet, turn = panels[2:]
    feet.set_title("lowest point of each foot, m", fontsize=9)
    for foot, color in zip(robot.feet, COLORS, strict=False):
        feet.plot(times, height[:, robot.sole_body == foot].min(axis=1), color=color, linewidth=1)
    feet.axhline(0, color="black", linewidth=0.8, linestyle=":")
    turn.set_title("turning speed, rad/s", fontsize=9)
    turn.plot(times, np.linalg.norm(clip.qvel[:, 3:6], axis=1), color=COLORS[2], linewidth=1)


def _side(joint: str) -> int:
    return next((i for i, side in enumerate(SIDES) if joint.startswith(side)), 2)
