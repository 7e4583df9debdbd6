"""What is seen of a session: robots side by side, demonstrations as ghosts, the floor."""

from typing import NamedTuple

import numpy as np
import viser

from fmpjax.play.player import Drag, Player
from fmpjax.play.scene import Figure, Floor, Pose
from fmpjax.play.session import Session

LANE = 1.5  # m between robots in the page; each is alone in its own world
CAMERA, LOOK_AT = (1.9, -2.1, 1.2), (0.0, 0.0, 0.65)
FOLLOWING = 0.3  # s by which the page's middle follows the robot, so that its sway is seen
FAR = 2.0  # m at which the middle jumps


class _Shown(NamedTuple):
    player: Player
    robot: Figure
    ghost: Figure | None
    label: viser.LabelHandle | None


class View:
    """The scene of a session. ``watched`` is the player that stays in the middle, None for a camera that stays."""

    def __init__(self, server: viser.ViserServer, session: Session):
        self._session, scene = session, server.scene
        self.watched: int | None = 0
        self._middle = np.zeros(3)
        self._floor = Floor(scene)
        server.initial_camera.position, server.initial_camera.look_at = CAMERA, LOOK_AT
        several = len(session.players) > 1
        self._shown = [
            _Shown(
                player,
                Figure(scene, f"/robot{i}", player.simulation.model),
                Figure(scene, f"/ghost{i}", player.simulation.model, ghost=True) if player.clips else None,
                scene.add_label(f"/label{i}", player.label, anchor="bottom-center") if several else None,
            )
            for i, player in enumerate(session.players)
        ]
        self._lanes = [np.array([0.0, LANE * (i - (len(self._shown) - 1) / 2), 0.0]) for i in range(len(self._shown))]
        for i, shown in enumerate(self._shown):
            shown.robot.on_drag(
                lambda body, point, target, i=i: self._pull(i, body, point, target), lambda i=i: session.drag(i, None)
            )

    def ghosts(self, shown: bool) -> None:
        """Show the demonstrations, or not."""
        for one in self._shown:
            if one.ghost is not None:
                one.ghost.hide(not shown)

    def update(self, passed: float) -> None:
        """Show where everything is now, ``passed`` s after the last time."""
        # The simulation waits while it is frozen: what is seen is only copied then, and sent afterwards.
        with self._session.frozen():
            if self.watched is not None:
                self._follow(self._session.players[self.watched], passed)
            seen = [(Pose.of(one.player.simulation.data), _ghost(one)) for one in self._shown]
        for shown, lane, (pose, ghost) in zip(self._shown, self._lanes, seen, strict=True):
            shift = lane - self._middle
            if np.isfinite(pose.places).all():
                shown.robot.pose(pose, shift)
            if shown.label is not None:
                root = pose.bodies[shown.player.simulation.root_body]
                shown.label.position = tuple(root + shift + [0, 0, 0.75])
            if shown.ghost is not None and ghost is not None:
                shown.ghost.show(ghost, shift)
        self._floor.shift(-self._middle)

    def _follow(self, player: Player, passed: float) -> None:
        off = player.simulation.qpos[:2] - self._middle[:2]
        if not np.isfinite(off).all():
            return
        share = 1.0 if np.linalg.norm(off) > FAR else 1.0 - np.exp(-passed / FOLLOWING)
        self._middle[:2] += share * off

    def _pull(self, i: int, body: int, taken: np.ndarray | None, target: np.ndarray) -> None:
        """Pull player ``i`` toward a point of the page, from now on at ``taken``, or where it is held.

        A robot that was put at its start has slipped from the hand, and has to be taken hold of again.
        """
        shift = self._lanes[i] - self._middle
        with self._session.frozen():
            data, drag = self._session.players[i].simulation.data, self._session.players[i].drag
            if taken is not None:
                local = (taken - shift - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
            elif drag is not None and drag.body == body:
                local = drag.point
            else:
                return
            self._session.drag(i, Drag(body, local, target - shift))


def _ghost(shown: _Shown) -> np.ndarray | None:
    return None if shown.ghost is None or shown.player.ghost is None else shown.player.ghost.qpos()
