"""The robot: its MuJoCo model and the facts about it that the rest of the program reads.

A robot is a folder with ``robot.xml`` (MJCF: bodies, joints, servos, collision geoms) and ``robot.toml`` (key points,
default pose, joints that the gait metrics read, its walk, its camera). Nothing else in the package names a joint or a
body of one robot, or depends on their order.
"""

import dataclasses
import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from fmpjax import resources
from fmpjax.errors import UserError

_FEET = ("left_foot_", "right_foot_")  # what the names of sole points begin with
FLOORS = ("left_floor", "right_floor")  # of the two feet, where the ground is uneven
_LOOKS = 1  # geom group of what only the eye sees
# m, how far a standing robot's soles are sunk into the floor. At 0 rounding decides which sole points touch; here all
# bear, 0.9 of the G1's weight at once, and the pose neither drops nor is thrown. Resting soles settle at 0.6 mm.
CONTACT_DEPTH = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """A floating-base robot with hinge joints, on a floor.

    Arrays are float64 on the host; joints are in model order. ``J`` joints, ``B`` bodies without the world, ``K`` key
    points, ``C`` fall spheres and capsules, ``P`` sole points (a sphere has one, a capsule two).
    """

    name: str
    path: Path  # of its robot.xml
    description: str  # what it is, in a line
    model: mujoco.MjModel
    joint_names: tuple[str, ...]
    joint_axis: np.ndarray  # [J, 3] unit axis in the joint's body
    joint_low: np.ndarray  # [J] rad
    joint_high: np.ndarray  # [J] rad
    effort: np.ndarray  # [J] motor limit, N m
    stiffness: np.ndarray  # [J] servo kp, N m/rad
    damping: np.ndarray  # [J] servo kd, N m s/rad
    default_qpos: np.ndarray  # [7 + J] default pose, its soles CONTACT_DEPTH in the floor or its root at a given height
    body_parent: np.ndarray  # [B] index of the parent body, -1 for the root
    body_position: np.ndarray  # [B, 3] m, in the parent
    body_rotation_wxyz: np.ndarray  # [B, 4], in the parent
    body_joint: np.ndarray  # [B] index of the body's hinge, -1 without
    jointless_row: int | None  # row of the joint-rotation block that is always the identity, None without one
    key_point_names: tuple[str, ...]
    key_body: np.ndarray  # [K]
    key_offset: np.ndarray  # [K, 3] m, in the body
    fall_body: np.ndarray  # [C]
    fall_ends: np.ndarray  # [C, 2, 3] m, capsule axis ends in the body; equal for a sphere
    fall_radius: np.ndarray  # [C] m
    sole_body: np.ndarray  # [P]
    sole_point: np.ndarray  # [P, 3] m, center of the sphere, or of an end of the capsule, in the body
    sole_radius: np.ndarray  # [P] m
    feet: np.ndarray  # [2] bodies of the left and the right sole points
    sagittal_joints: np.ndarray  # [6] indices: left hip, knee, ankle, then right
    total_mass: float  # kg
    self_collision: bool  # whether its bodies touch each other
    landmarks: dict[str, int]  # index of the body that stands for a human's pelvis, chest, left_hip and so on
    gait: dict[str, Any]  # its walk, as `fmpjax.motion.gait` reads it; empty for a robot without one
    view_distance: float  # m from which a picture shows it whole
    view_height: float  # m above the floor, where the camera looks

    @property
    def joint_count(self) -> int:
        return len(self.joint_names)

    def physics_model(
        self,
        *,
        numerics: Mapping[str, float] = {},  # noqa: B006
        uneven: bool = False,
        **options,
    ) -> mujoco.MjModel:
        """The model without its looks, which cost time in every step, and with other solver options.

        Options are fields of ``model.opt``, e.g. ``timestep=0.01`` (s), and ``frictionloss`` (N m, every hinge).
        ``numerics`` are custom numbers of the model, which MJX reads. On ``uneven`` ground each foot has a floor of its
        own, `FLOORS`, which nothing else touches.

        Raises:
          UserError: the ground is to be uneven, and the model's world is not one plane, or its bits for collisions are
            used up.
        """
        spec = mujoco.MjSpec.from_file(str(self.path))
        for geom in [g for g in spec.geoms if g.group == _LOOKS]:
            spec.delete(geom)
        for geom in spec.geoms:
            geom.material = ""
        for look in (*spec.materials, *spec.textures):  # megabytes in each copy of the model
            spec.delete(look)
        if uneven:
            self._part_floor(spec)
        for name, value in numerics.items():
            spec.add_numeric(name=name, size=1, data=[value])
        model = spec.compile()
        if uneven:  # the floors will not stay where MuJoCo's shortcut for the world's origin holds
            model.geom_sameframe[[model.geom(name).id for name in FLOORS]] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        if "frictionloss" in options:
            model.dof_frictionloss[6:] = options.pop("frictionloss")
        for key, value in options.items():
            setattr(model.opt, key, value)
        return model

    def _part_floor(self, spec: mujoco.MjSpec) -> None:
        """Give each foot a floor of its own, at the height of the model's, which it then no longer touches."""
        ground = spec.worldbody.geoms
        if len(ground) != 1 or ground[0].type != mujoco.mjtGeom.mjGEOM_PLANE:
            found = " and ".join(geom.name or "a geom without a name" for geom in ground) or "nothing"
            raise UserError(
                f"disturbance.step_height needs a world of one plane, the floor: that of robot {self.name} has {found}"
            )
        floor, used = ground[0], 0
        for geom in spec.geoms:
            used |= geom.contype | geom.conaffinity
        free = [1 << bit for bit in range(31) if not used >> bit & 1]
        if len(free) < 3:
            raise UserError(
                f"disturbance.step_height needs three bits that no contype or conaffinity of robot {self.name} uses: "
                f"found {len(free)}"
            )
        for geom in spec.geoms:
            if geom.contype & floor.conaffinity or geom.conaffinity & floor.contype:
                geom.contype |= free[next((i for i, foot in enumerate(_FEET) if geom.name.startswith(foot)), 2)]
        floor.contype, floor.conaffinity = 0, free[2]
        for name, bit in zip(FLOORS, free, strict=False):
            own = spec.worldbody.add_geom(name=name, contype=0, conaffinity=bit, density=0)
            for alike in "type size pos quat condim friction solref solimp solmix priority margin gap".split():
                setattr(own, alike, getattr(floor, alike))

    def takes(self, other: str) -> bool:
        """Whether motions of the robot named ``other`` are this one's, too: both have the same joints in one order."""
        return other == self.name or (other in available() and load(other).joint_names == self.joint_names)


def available() -> list[str]:
    """Names that `load` accepts."""
    return sorted(p.parent.name for p in resources.folder("robots").glob("*/robot.xml"))


def load(name: str) -> Robot:
    """Load a shipped robot by its folder's name, or any robot by the path of its folder.

    Raises:
      UserError: there is no such robot, or its files are not as docs/robots.md says.
    """
    return _shipped(name) if name in available() else _from_folder(name)


@functools.cache
def _shipped(name: str) -> Robot:
    return _read(name, resources.folder("robots") / name / "robot.xml")


def _from_folder(name: str) -> Robot:
    path = Path(name) / "robot.xml"
    if not path.is_file():
        known = ", ".join(available())
        raise UserError(f"unknown robot {name!r}: expected one of {known}, or a folder with robot.xml and robot.toml")
    own, facts = path.parent.resolve().name, path.with_suffix(".toml")
    if own in available():
        raise UserError(f"robot {name!r} is called {own!r} as a shipped one is: expected a folder of another name")
    try:
        return _read(own, path)
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"cannot read {facts}: {error.strerror or error}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{facts} is not TOML ({error}): expected the keys in docs/robots.md") from None
    except KeyError as error:
        said = str(error.args[0])[:80]
        raise UserError(f"{facts} has no {said}, or misnames it: expected the keys in docs/robots.md") from None
    except (TypeError, ValueError) as error:
        raise UserError(f"{path.parent} cannot be read as a robot: {' '.join(str(error).split())}") from None


def _read(name: str, path: Path) -> Robot:
    model = mujoco.MjModel.from_xml_path(str(path))
    _check(path, model)
    facts = tomllib.loads(path.with_suffix(".toml").read_text())
    joint_names = tuple(model.joint(i).name for i in range(1, model.njnt))
    index = {joint: i for i, joint in enumerate(joint_names)}
    body_joint = np.full(model.nbody - 1, -1)
    body_joint[model.jnt_bodyid[1:] - 1] = np.arange(len(joint_names))
    geoms = [model.geom(i) for i in range(model.ngeom)]
    fall = [g for g in geoms if g.name.endswith("_fall")]
    soles = [g for g in geoms if "_foot_" in g.name]
    sole_points = [(g, point) for g in soles for point in np.unique(_axis_ends(g), axis=0)]
    default = model.qpos0.copy()
    for joint, angle in facts["default_pose"].items():
        default[7 + index[joint]] = angle
    robot = Robot(
        name=name,
        path=path,
        description=facts.get("description") or f"{len(joint_names)} joints, {model.body_mass.sum():.0f} kg",
        model=model,
        joint_names=joint_names,
        joint_axis=model.jnt_axis[1:].copy(),
        joint_low=model.jnt_range[1:, 0].copy(),
        joint_high=model.jnt_range[1:, 1].copy(),
        effort=model.actuator_forcerange[:, 1].copy(),
        stiffness=model.actuator_gainprm[:, 0].copy(),
        damping=-model.actuator_biasprm[:, 2],
        default_qpos=default,
        body_parent=model.body_parentid[1:] - 1,
        body_position=np.where(np.arange(model.nbody - 1)[:, None] == 0, 0.0, model.body_pos[1:]),
        body_rotation_wxyz=model.body_quat[1:].copy(),
        body_joint=body_joint,
        jointless_row=index[facts["jointless_row_after"]] + 1 if "jointless_row_after" in facts else None,
        key_point_names=tuple(p["name"] for p in facts["key_points"]),
        key_body=np.array([model.body(p["body"]).id - 1 for p in facts["key_points"]]),
        key_offset=np.array([p.get("offset", (0.0, 0.0, 0.0)) for p in facts["key_points"]]),
        fall_body=np.array([g.bodyid[0] - 1 for g in fall]),
        fall_ends=np.array([_axis_ends(g) for g in fall]),
        fall_radius=np.array([g.size[0] for g in fall]),
        sole_body=np.array([g.bodyid[0] - 1 for g, _ in sole_points]),
        sole_point=np.array([point for _, point in sole_points]),
        sole_radius=np.array([g.size[0] for g, _ in sole_points]),
        feet=np.array([next(g.bodyid[0] - 1 for g in soles if g.name.startswith(side)) for side in _FEET]),
        sagittal_joints=np.array([index[j] for j in facts["sagittal_joints"]]),
        total_mass=float(model.body_mass.sum()),
        self_collision=bool((model.geom_conaffinity[model.geom_bodyid > 0] != 0).any()),
        landmarks={part: model.body(body).id - 1 for part, body in facts.get("landmarks", {}).items()},
        gait=facts.get("gait", {}),
        view_distance=float(facts["camera"]["distance"]),
        view_height=float(facts["camera"]["height"]),
    )
    if "default_height" in facts:
        robot.default_qpos[2] = facts["default_height"]
    else:
        robot.default_qpos[2] -= lowest_sole(robot, robot.default_qpos) + CONTACT_DEPTH
    return robot


def _check(path: Path, model: mujoco.MjModel) -> None:
    """Refuse a model that the rest of the program, which has its own kinematics, would misread."""
    hinges, soles = np.arange(1, model.njnt), [g for g in map(model.geom, range(model.ngeom)) if "_foot_" in g.name]
    feet = [{int(g.bodyid[0]) for g in soles if g.name.startswith(side)} for side in _FEET]
    for holds, expected in (
        (model.njnt > 1 and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE, "a root with a free joint, and hinges"),
        ((model.jnt_type[1:] == mujoco.mjtJoint.mjJNT_HINGE).all(), "no joints but hinges beside the root's"),
        (len(set(model.jnt_bodyid)) == model.njnt, "at most one hinge in a body"),
        (not model.jnt_pos[1:].any(), "hinges at the origins of their bodies"),
        (not model.qpos0[7:].any(), "angles that are zero as the model is drawn"),
        (np.array_equal(model.actuator_trnid[:, 0], hinges), "one servo a hinge, in the order of the hinges"),
        (all(g.name.startswith(_FEET) for g in soles), "soles named left_foot_... and right_foot_..."),
        ([len(bodies) for bodies in feet] == [1, 1] and feet[0] != feet[1], "a left and a right foot, each one body"),
    ):
        if not holds:
            raise UserError(f"{path}: expected {expected}")


def _axis_ends(geom) -> np.ndarray:
    if geom.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE:
        return np.array([geom.pos, geom.pos])
    axis = np.zeros(9)
    mujoco.mju_quat2Mat(axis, geom.quat)
    half = geom.size[1] * axis.reshape(3, 3)[:, 2]
    return np.array([geom.pos - half, geom.pos + half])


def lowest_sole(robot: Robot, qpos: np.ndarray) -> float:
    """Height of the lowest sole point above the floor, m, for one configuration ``qpos [7 + J]``."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(robot.model, data)
    rotation = data.xmat[robot.sole_body + 1].reshape(-1, 3, 3)
    points = data.xpos[robot.sole_body + 1] + np.einsum("pij,pj->pi", rotation, robot.sole_point)
    return float((points[:, 2] - robot.sole_radius).min())
