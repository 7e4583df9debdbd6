"""A motion in a page: the robot that moves like it, its joints and contacts over time, and what the check says."""

import time
from collections.abc import Callable

import numpy as np
import viser

from fmpjax.motion import MotionClip, check
from fmpjax.motion.soles import sole_points
from fmpjax.play import server as serving
from fmpjax.play.page import FRAME, address, quick_turns
from fmpjax.play.plots import COLORS, TOLD, Chart
from fmpjax.play.scene import Figure, Floor
from fmpjax.play.view import CAMERA, LOOK_AT
from fmpjax.robots import Robot

AROUND = 2.0  # s of the curves before and after the moment that is shown
SIGNS = {"good": "✓", "odd": "⚠", "broken": "✗"}


class ClipPage:
    """A motion that people can open in a browser."""

    def __init__(
        self, robot: Robot, clip: MotionClip, *, flips: int = 0, host: str = serving.HOST, port: int = serving.PORT
    ):
        """Check the motion and open the page.

        Args:
          robot: that moves like it.
          clip: the motion.
          flips: how often its quaternion flips in the file.
          host: address to listen at.
          port: of it.

        Raises:
          UserError: the page cannot be opened.
        """
        self.robot, self.clip, self.time = robot, clip, 0.0
        self.server = server = serving.start(clip.name, host, port)
        server.initial_camera.position, server.initial_camera.look_at = CAMERA, LOOK_AT
        self._floor, self._figure = Floor(server.scene), Figure(server.scene, "/robot", robot.model)
        points, _ = sole_points(robot, clip.qpos)
        height = points[..., 2] - robot.sole_radius
        self._heights = [height[:, robot.sole_body == foot].min(axis=1) for foot in robot.feet]
        self._controls(server.gui)
        with server.gui.add_folder("Check"):
            server.gui.add_markdown(verdicts(check.check(robot, clip, flips)))
        with serving.beside(server, "Curves"):
            self._curves(server.gui)
        self._drawn = -1.0

    def _controls(self, gui: viser.GuiApi) -> None:
        clip = self.clip
        gui.add_markdown(f"**{clip.name}**, {clip.duration:.2f} s, {len(clip)} samples at {clip.rate:g} Hz")
        self._playing = gui.add_checkbox("play", True)
        self._pace = gui.add_slider("pace, of real time", 0.05, 1.0, 0.05, 1.0)
        step = 1 / clip.rate
        self._slider = gui.add_slider("time, s", 0.0, round(clip.duration, 3), round(min(step, clip.duration), 4), 0.0)
        self._slider.on_update(lambda event: self._seek(event.client is not None))
        self._follow = gui.add_checkbox("follow", True)

    def _seek(self, by_hand: bool) -> None:
        if by_hand:  # this page moves the slider, too
            self._playing.value, self.time = False, float(self._slider.value)

    def _curves(self, gui: viser.GuiApi) -> None:
        names = [name.removesuffix("_joint") for name in self.robot.joint_names]
        self._joint = gui.add_dropdown("joint", tuple(names))
        self._joint.on_update(lambda _: setattr(self, "_drawn", -1.0))
        self._angle = Chart(gui, "angle, rad", ["angle", "low limit", "high limit"], [COLORS[0], TOLD, TOLD])
        self._speed = Chart(gui, "speed of the root, m/s", ["speed"], COLORS[:1])
        self._soles = Chart(gui, "lowest point of each foot, m", ["left", "right", "touches"], [*COLORS[:2], TOLD])

    def update(self, passed: float) -> None:
        """Show the motion ``passed`` s later; after its end it begins again."""
        clip = self.clip
        if self._playing.value:
            self.time = (self.time + passed * self._pace.value) % max(clip.duration, 1e-9)
            self._slider.value = round(self.time, 3)
        row = min(len(clip) - 1, round(self.time * clip.rate))
        qpos = clip.qpos[row]
        shift = -qpos[:3] * [1.0, 1.0, 0.0] if self._follow.value else np.zeros(3)
        self._figure.show(qpos, shift)
        self._floor.shift(shift)
        if abs(self.time - self._drawn) > 0.2:
            self._drawn = self.time
            self._draw(row)

    def _draw(self, row: int) -> None:
        clip, robot = self.clip, self.robot
        around = round(AROUND * clip.rate)
        rows = np.arange(max(0, row - around), min(len(clip), row + around + 1))
        times, even = rows / clip.rate, np.ones(len(rows))
        names = [name.removesuffix("_joint") for name in robot.joint_names]
        joint = names.index(self._joint.value) if self._joint.value in names else 0
        limits = robot.joint_low[joint] * even, robot.joint_high[joint] * even
        self._angle.draw(times, clip.qpos[rows, 7 + joint], *limits)
        self._speed.draw(times, np.linalg.norm(clip.qvel[rows, :2], axis=1))
        self._soles.draw(times, *(height[rows] for height in self._heights), check.CONTACT * even)

    def show(self, until: Callable[[], bool] = lambda: False) -> None:
        """Play until Ctrl-C, or until ``until()``."""
        last = time.perf_counter()
        while not until():
            now = time.perf_counter()
            if self.server.get_clients():
                with self.server.atomic():
                    self.update(now - last)
            last = now
            time.sleep(max(0.0, FRAME - (time.perf_counter() - now)))


def verdicts(figures: list[check.Figure]) -> str:
    """The figures of a check as Markdown, what is wrong first."""
    order = sorted(figures, key=lambda figure: -list(SIGNS).index(figure.verdict))
    rows = [f"{SIGNS[f.verdict]} **{f.name}** {f.value:.3g} {check.RANGES[f.name].unit} {_where(f)}" for f in order]
    return "  \n".join(rows)


def _where(figure: check.Figure) -> str:
    return f"({figure.where})" if figure.verdict != "good" and figure.where else ""


def play(robot: Robot, clip: MotionClip, *, flips: int, host: str, port: int) -> None:
    """Serve a motion until Ctrl-C.

    Raises:
      UserError: the page cannot be opened.
    """
    with quick_turns():
        page = ClipPage(robot, clip, flips=flips, host=host, port=port)
        print(f"open {address(page.server)} in a browser; Ctrl-C ends it", flush=True)
        try:
            page.show()
        except KeyboardInterrupt:
            print()
        finally:
            page.server.stop()
