"""A robot in a page of viser: the geoms of its model, all of one shape as one batch, which a frame moves at once."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
import viser

from fmpjax import rotations

HIDDEN_GROUP = 3  # and above: geoms that only collide or mark falls
GHOST_COLOR, GHOST_OPACITY = (60, 140, 240), 0.3
CELL = 1.0  # m between two lines of the floor
_GEOM = mujoco.mjtGeom


class Piece(NamedTuple):
    """A unit shape that a geom is made of."""

    shape: str  # "box", "ball", "tube" or "mesh" and its number
    geom: int
    offset: np.ndarray  # [3] m, in the geom
    scale: tuple[float, float, float]


class Batch(NamedTuple):
    """Pieces of one shape."""

    geoms: np.ndarray  # [N]
    offsets: np.ndarray  # [N, 3] m, in their geoms
    handle: viser.BatchedMeshHandle


class Pose(NamedTuple):
    """Where a robot is."""

    places: np.ndarray  # [geoms, 3] m
    bodies: np.ndarray  # [bodies, 3] m
    turns_wxyz: np.ndarray  # [bodies, 4]

    @classmethod
    def of(cls, data: mujoco.MjData) -> "Pose":
        """A copy of the state whose kinematics ``data`` holds."""
        return cls(data.geom_xpos.copy(), data.xpos.copy(), data.xquat.copy())


class Figure:
    """A robot, or its demonstration, in the page."""

    def __init__(self, scene: viser.SceneApi, name: str, model: mujoco.MjModel, *, ghost: bool = False):
        """Add what is seen of a model to the scene.

        Args:
          scene: of the page.
          name: path in the scene.
          model: of the robot; its floor is not drawn.
          ghost: draw it blue and transparent.
        """
        self.model = model
        self.data = mujoco.MjData(model)
        grouped: dict[str, list[Piece]] = {}
        for geom in range(model.ngeom):
            for piece in _pieces(model, geom):
                grouped.setdefault(piece.shape, []).append(piece)
        self.batches = [self._add(scene, f"{name}/{shape}", pieces, ghost) for shape, pieces in grouped.items()]

    def _add(self, scene: viser.SceneApi, name: str, pieces: Sequence[Piece], ghost: bool) -> Batch:
        vertices, faces, flat = _shape(self.model, pieces[0].shape)
        colors = np.array([_color(self.model, piece.geom) for piece in pieces])
        handle = scene.add_batched_meshes_simple(
            name,
            vertices,
            faces,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (len(pieces), 1)),
            batched_positions=np.zeros((len(pieces), 3)),
            batched_scales=np.array([piece.scale for piece in pieces], np.float32),
            batched_colors=GHOST_COLOR if ghost else colors,
            opacity=GHOST_OPACITY if ghost else None,
            flat_shading=flat,
            cast_shadow=not ghost,
            receive_shadow=not ghost,
            lod="off",
        )
        return Batch(np.array([p.geom for p in pieces]), np.array([p.offset for p in pieces]), handle)

    def pose(self, pose: Pose, shift: np.ndarray) -> None:
        """Show it in a pose, moved by ``shift [3]`` m."""
        wxyz = rotations.multiply(pose.turns_wxyz[self.model.geom_bodyid], self.model.geom_quat)
        for geoms, offsets, handle in self.batches:
            places = pose.places[geoms] + rotations.rotate(wxyz[geoms], offsets) + shift
            handle.batched_positions, handle.batched_wxyzs = places.astype(np.float32), wxyz[geoms].astype(np.float32)

    def show(self, qpos: np.ndarray, shift: np.ndarray) -> None:
        """Show a configuration of the model, ``[nq]``."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        self.pose(Pose.of(self.data), shift)

    def hide(self, hidden: bool) -> None:
        """Take it out of sight, or show it again."""
        for batch in self.batches:
            batch.handle.visible = not hidden

    def on_drag(self, pulled: Callable[[int, np.ndarray | None, np.ndarray], None], let_go: Callable[[], None]) -> None:
        """Call back while somebody drags it by the mouse.

        Args:
          pulled: called with the body, the point of it that is taken hold of (None where it is held already) and where
            the pointer is, both ``[3]`` m in the page.
          let_go: called at the end.
        """
        # viser awaits coroutines one by one. It runs functions in threads, where the end could overtake a pull before
        # it, which would then go on without a hand.
        for geoms, _, handle in self.batches:

            @handle.on_drag
            async def _(event, geoms=geoms) -> None:
                if event.phase == "end" or event.instance_index is None:
                    let_go()
                else:
                    body = int(self.model.geom_bodyid[geoms[event.instance_index]])
                    taken = np.array(event.start_position) if event.phase == "start" else None
                    pulled(body, taken, np.array(event.end_position))


class Floor:
    """An endless floor, whose lines move where the robot that is looked at stands still in the page."""

    def __init__(self, scene: viser.SceneApi):
        scene.set_up_direction("+z")
        self._grid = scene.add_grid(
            "/floor",
            infinite_grid=True,
            cell_size=CELL,
            section_size=5 * CELL,
            cell_color=(176, 182, 190),
            section_color=(130, 138, 148),
            fade_distance=30.0,
            shadow_opacity=0.3,
            plane_color=(238, 240, 243),
            plane_opacity=1.0,
        )

    def shift(self, shift: np.ndarray) -> None:
        """Move it by ``shift [3]`` m; it looks the same after whole sections."""
        self._grid.position = tuple(np.mod(shift, 5 * CELL) * [1.0, 1.0, 0.0])


def _pieces(model: mujoco.MjModel, geom: int) -> list[Piece]:
    kind, size, center = _GEOM(model.geom_type[geom]), model.geom_size[geom], np.zeros(3)
    if model.geom_group[geom] >= HIDDEN_GROUP or model.geom_rgba[geom, 3] == 0:
        return []
    if kind == _GEOM.mjGEOM_SPHERE:
        return [Piece("ball", geom, center, (size[0],) * 3)]
    if kind == _GEOM.mjGEOM_ELLIPSOID:
        return [Piece("ball", geom, center, tuple(size))]
    if kind == _GEOM.mjGEOM_BOX:
        return [Piece("box", geom, center, tuple(size))]
    if kind in (_GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_CAPSULE):
        tube, end = Piece("tube", geom, center, (size[0], size[0], size[1])), np.array([0.0, 0.0, size[1]])
        balls = [Piece("ball", geom, place, (size[0],) * 3) for place in (end, -end)]
        return [tube, *(balls if kind == _GEOM.mjGEOM_CAPSULE else [])]
    if kind == _GEOM.mjGEOM_MESH:
        return [Piece(f"mesh{model.geom_dataid[geom]}", geom, center, (1.0, 1.0, 1.0))]
    return []  # planes, which are the floor, and what no robot is made of


def _shape(model: mujoco.MjModel, shape: str) -> tuple[np.ndarray, np.ndarray, bool]:
    """Vertices and faces of a unit shape or a mesh, and whether its faces are flat."""
    if shape == "box":
        box = trimesh.creation.box((2.0, 2.0, 2.0))
        return box.vertices, box.faces, True
    if shape == "ball":
        ball = trimesh.creation.icosphere(subdivisions=3)
        return ball.vertices, ball.faces, False
    if shape == "tube":
        tube = trimesh.creation.cylinder(radius=1.0, height=2.0, sections=32)
        return tube.vertices, tube.faces, True
    mesh = int(shape.removeprefix("mesh"))
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    return model.mesh_vert[first : first + count], model.mesh_face[face : face + faces], True


def _color(model: mujoco.MjModel, geom: int) -> np.ndarray:
    material = model.geom_matid[geom]
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    return np.round(255 * rgba[:3]).astype(np.uint8)
