"""Pictures of the robot as a plotted skeleton, where MuJoCo cannot draw."""

import contextlib
from collections.abc import Generator

import mujoco
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.figure import Figure

from fmpjax.robots import Robot
from fmpjax.viz.picture import Picture

# Of the plotted skeleton: a point that is dy farther away appears this much further to the right and up.
SHIFT = np.array([0.2, 0.12])
TONES = {False: ("#25303c", "#46525f", "#97a3af"), True: ("#7fb2ea", "#a3c8f0", "#c5dcf5")}  # near, middle, far
FLOOR_DEPTH = 1.0  # m, how far behind the robot the floor ends
PLOT_DPI = 100


@contextlib.contextmanager
def drawing(robot: Robot, width: int, height: int, distance: float) -> Generator[Picture]:
    """Plot the bones as seen from the robot's right, a little from above."""
    figure = Figure((width / PLOT_DPI, height / PLOT_DPI), dpi=PLOT_DPI, facecolor="#f1f4f7")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    tall = 0.8 * distance  # m, what a picture shows from bottom to top
    wide = tall * width / height
    points_per_meter = 72 * height / PLOT_DPI / tall
    size = robot.view_distance / 2.4  # the thickness of bones below is for this distance
    axes.axhspan(-tall, FLOOR_DEPTH * SHIFT[1], color="#dbe1e7", linewidth=0, zorder=0)
    marks = LineCollection([], colors="#bcc6d0", linewidths=1, zorder=1)
    axes.add_collection(marks)
    bones = _Bones(robot)

    def picture(configurations: list[np.ndarray], look: np.ndarray) -> np.ndarray:
        axes.set_xlim(look[0] - wide / 2, look[0] + wide / 2)
        axes.set_ylim(look[2] - tall / 2, look[2] + tall / 2)
        # A mark across the floor every half meter shows the motion: the view moves with the robot.
        meters = np.arange(np.floor(look[0] - wide), look[0] + wide, 0.5)
        across = np.array([-tall / SHIFT[1], FLOOR_DEPTH])[:, None] * SHIFT
        marks.set_segments([across + (x, 0.0) for x in meters])
        drawn = []
        for ghostly, qpos in enumerate(configurations):
            tones = np.array(TONES[bool(ghostly)])
            segments, balls = bones.project(qpos, look[1])
            drawn += [
                LineCollection(
                    list(segments),
                    colors=tones[bones.tone],
                    linewidths=0.045 * size * points_per_meter,
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
