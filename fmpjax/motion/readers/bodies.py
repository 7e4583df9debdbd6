"""Files with joints and the world places of bodies: BeyondMimic, mjlab, HoloSoma, Isaac Lab's AMP, ProtoMotions.

The programs write the same numbers under other names, and in different orders: Isaac Lab numbers joints and bodies
breadth-first through the tree, with siblings in the model's order; MuJoCo's family keeps the model's own order,
depth-first, and may put the world before the root. HoloSoma writes root and joints into one array. A file may hold some
of the robot's bodies, or more than the robot has.

Names put joints in order where the file has them. Otherwise the order must be proved: that one is taken whose forward
kinematics meets the bodies' places, and a file that proves none is refused.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion.clip import Fact, Reading
from fmpjax.motion.readers.pickled import numbers
from fmpjax.motion.readers.recording import (
    WITHOUT,
    Columns,
    Options,
    Recording,
    assemble,
    by_name,
    by_order,
    check_unit,
    expected_joints,
    kept_joints,
    oriented,
    plain_name,
    positive,
    table,
    texts,
)
from fmpjax.robots import Robot

PROOFS = 20  # frames
TOLERANCE = 0.05  # m, mean distance of a body from its place
DISTINCT = 2.0  # an order is proved where the next one is so many times further off
EXACT = 1e-3  # m, to which files are written
SAME = 0.02  # rad; orders that differ less need no proof
MOST_BODIES = 1000
LEAST_BODIES = 3  # that prove anything, besides the root
JOINT_NAMES, BODY_NAMES = ("joint_names", "dof_names"), ("body_names", "rigid_body_names", "link_body_list")


class Dialect(NamedTuple):
    """What a family of programs calls its arrays."""

    NAME: str
    joints: str
    places: str
    turns: str
    order: str  # of the quaternions

    @property
    def MARKS(self) -> tuple[str, ...]:
        """Names that a file of the family has."""
        return ("fps", self.joints, self.places, self.turns)

    def read(self, file: Path, content: Mapping, robot: Robot, options: Options) -> Recording:
        """The recording in a file of the family."""
        return _read(self, file, content, robot, options)


DIALECTS = (
    Dialect("BeyondMimic, mjlab", "joint_pos", "body_pos_w", "body_quat_w", "wxyz"),
    Dialect("Isaac Lab's AMP", "dof_positions", "body_positions", "body_rotations", "wxyz"),
    Dialect("ProtoMotions", "dof_pos", "rigid_body_pos", "rigid_body_rot", "xyzw"),
)


def breadth_first(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """The robot's bodies ``[B]`` and joints ``[J]`` in Isaac Lab's order, as indices of the model's order."""
    level = [0]
    bodies = []
    while level:
        bodies += level
        level = [int(child) for body in level for child in np.flatnonzero(robot.body_parent == body)]
    joints = robot.body_joint[bodies]
    return np.array(bodies), joints[joints >= 0]


def _read(dialect: Dialect, file: Path, content: Mapping, robot: Robot, options: Options) -> Recording:
    joints = table(file, dialect.joints, numbers(file, dialect.joints, content[dialect.joints], robot.joint_count), -1)
    places = table(file, dialect.places, content[dialect.places], -1, 3)
    turns = table(file, dialect.turns, content[dialect.turns], -1, 4)
    rate = positive(file, "fps", content["fps"])
    if not (places.shape[1] and turns.shape[1]):
        raise UserError(f"{file}: no bodies in {dialect.places} or {dialect.turns}, expected the root first")
    if places.shape[1] > MOST_BODIES:
        raise UserError(f"{file}: {places.shape[1]} bodies in {dialect.places}, expected at most {MOST_BODIES}")
    if places.shape[:2] != turns.shape[:2]:
        raise UserError(
            f"{file}: {dialect.places} is of {places.shape[:2]} frames and bodies, {dialect.turns} of {turns.shape[:2]}"
        )
    bodies = _names(file, content, BODY_NAMES, places.shape[1])
    root, root_from = _root(file, dialect, bodies, places, turns, robot)
    position, rotation, order, name = places[:, root], turns[:, root], dialect.order, f"{dialect.turns} row"
    named = _names(file, content, JOINT_NAMES, None)
    width = len(named) if named else robot.joint_count
    if joints.shape[1] == 7 + width:
        position, rotation, joints = joints[:, :3], joints[:, 3:7], joints[:, 7:]
        order, name, root_from = "wxyz", f"{dialect.joints} row", f"the first seven columns of {dialect.joints}"
    if len(position) != len(joints):
        raise UserError(f"{file}: {len(position)} frames of bodies and {len(joints)} rows of joints")
    if named is not None and len(named) != joints.shape[1]:
        raise UserError(f"{file}: {len(named)} joint names for {joints.shape[1]} columns of {dialect.joints}")
    check_unit(file, rotation, name, 0)
    rotation_wxyz, _ = oriented(file, rotation, order, "", options)
    whole = np.concatenate([position, rotation_wxyz], axis=1)
    places = places[:, root:]
    bodies = bodies[root:] if bodies else None
    if named is None:
        columns = _proved(file, dialect, robot, options, whole, joints, places, bodies)
    else:
        columns = by_name(file, named, robot)
    found = assemble(
        file,
        robot,
        options,
        Fact("format", dialect.NAME, "its names"),
        position=position,
        rotation=rotation,
        order=order,
        joints=joints,
        columns=columns,
        rate=rate,
        rate_from="the file",
        name=name,
    )
    off, seen = _distance(robot, found.qpos, _some(places), _same_bodies(robot, bodies))
    warnings = ()
    if seen > LEAST_BODIES and off > TOLERANCE:
        warnings = (
            f"the bodies of {dialect.places} lie {off:.2g} m from where its joints put those of robot {robot.name!r}",
        )
    where = f"body {root}" if name.startswith(dialect.turns) else f"in {dialect.joints}"
    facts, said = found.reading
    return found._replace(reading=Reading((*facts[:2], Fact("root", where, root_from), *facts[2:]), (*said, *warnings)))


def _names(file: Path, content: Mapping, keys: tuple[str, ...], count: int | None) -> list[str] | None:
    """The first list of names that the file has and that can be read; of ``count`` names, where given."""
    for key in keys:
        if key in content:
            try:
                names = texts(file, key, content[key])
            except UserError as error:
                # Objects in place of text are no reason to refuse what kinematics can prove.
                if "objects" in str(error):
                    continue
                raise
            if count is None or len(names) == count:
                return names
    return None


def _root(file: Path, dialect: Dialect, names: list[str] | None, places, turns, robot: Robot) -> tuple[int, str]:
    """Index of the root among the file's bodies, and how it was found."""
    own = plain_name(robot.model.body(1).name)
    if names:
        plain = [plain_name(name) for name in names]
        if own in plain:
            return plain.index(own), f"named {names[plain.index(own)]}"
        if plain[0] == "world" and len(plain) > 1:
            return 1, "the body after the world"
    if len(places) and not np.any(places[:, 0]) and not np.ptp(turns[:, 0], axis=0).any():
        if places.shape[1] == 1:
            raise UserError(
                f"{file}: the only body of {dialect.places} lies at (0, 0, 0) in every frame, expected the root"
            )
        return 1, "body 0 is the world: it lies at (0, 0, 0) in every frame"
    return 0, "the format's"


def _same_bodies(robot: Robot, names: list[str] | None) -> np.ndarray | None:
    """Which of the robot's bodies each of the file's is, ``[N]``, -1 for none; None without names."""
    if not names:
        return None
    own = [plain_name(robot.model.body(i).name) for i in range(1, robot.model.nbody)]
    return np.array([own.index(p) if (p := plain_name(name)) in own else -1 for name in names])


def _some(rows: np.ndarray) -> np.ndarray:
    """A few of the rows, spread evenly."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, PROOFS).astype(int))] if len(rows) else rows


def _distance(robot: Robot, qpos: np.ndarray, seen: np.ndarray, same: np.ndarray | None) -> tuple[float, int]:
    """Mean distance (m) of the file's bodies ``seen [F, N, 3]`` from the robot's in ``qpos [T, 7 + J]``, and how many.

    ``same [N]`` says which is which; without it each body of the smaller set counts with the nearest of the other.
    """
    data = mujoco.MjData(robot.model)
    own = np.zeros((len(seen), robot.model.nbody - 1, 3))
    for row, place in zip(_some(qpos), own, strict=True):
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.model, data)
        place[:] = data.xpos[1:]
    if not len(seen):
        return 0.0, 0
    if same is not None and np.count_nonzero(same >= 0) > LEAST_BODIES:
        known = np.flatnonzero(same >= 0)
        return float(np.linalg.norm(own[:, same[known]] - seen[:, known], axis=-1).mean()), len(known)
    apart = np.linalg.norm(own[:, :, None] - seen[:, None], axis=-1).mean(axis=0)  # [B, N]
    nearest = apart.min(axis=1 if seen.shape[1] > own.shape[1] else 0)
    return float(nearest.mean()), len(nearest)


def _proved(
    file: Path, dialect: Dialect, robot: Robot, options: Options, root: np.ndarray, joints, places, names
) -> Columns:
    """The columns of joints without names, by the ``root [T, 7]`` and the ``places [T, N, 3]`` of bodies from it on.

    Raises:
      UserError: no order of so many joints is known, none meets the bodies, or two do.
    """
    count = joints.shape[1]
    wide_bodies, wide = breadth_first(robot)
    tries = []
    words = [options.without] if options.without else [(), *WITHOUT]
    for kept in (kept_joints(robot, each) for each in words):
        if len(kept) == count:
            tries.append((by_order(robot, kept, np.arange(count), options, _MET), None))
            level = np.array([joint for joint in wide if joint in kept])
            tries.append((by_order(robot, level, np.arange(count), options, _MET, "Isaac Lab's order"), wide_bodies))
    if not tries:
        raise UserError(f"{file}: {dialect.joints} has {count} joints and no names, "
            f"expected {expected_joints(robot, count, options)}")  # fmt: skip
    if not len(joints):
        return tries[0][0]
    same, seen = _same_bodies(robot, names), _some(places)
    if places.shape[1] - 1 < LEAST_BODIES:
        raise UserError(
            f"{file}: no joint_names, and {places.shape[1]} bodies do not determine the order of the joints, "
            f"expected names or at least {LEAST_BODIES + 1} bodies"
        )
    errors = []
    for columns, bodies in tries:
        if same is None and places.shape[1] == robot.model.nbody - 1:
            which = np.arange(places.shape[1]) if bodies is None else bodies
        else:
            which = same
        angles = columns.of(np.radians(joints) if options.degrees else joints)
        errors.append(_distance(robot, np.concatenate([root, angles], axis=1), seen, which)[0])
    best = int(np.argmin(errors))
    if errors[best] > TOLERANCE:
        raise UserError(
            f"{file}: the bodies of {dialect.places} lie {errors[best]:.2g} m from where {dialect.joints} puts those "
            f"of robot {robot.name!r}, expected at most {TOLERANCE} m"
        )
    for (columns, _), error in zip(tries, errors, strict=True):
        differs = np.abs(columns.of(joints) - tries[best][0].of(joints)).max() > SAME
        if differs and error < DISTINCT * errors[best] + EXACT:
            raise UserError(
                f"{file}: the bodies of {dialect.places} do not tell whether joints are in "
                f"{tries[best][0].fact.value.partition(' in ')[2]} or {columns.fact.value.partition(' in ')[2]}, "
                "expected joint_names"
            )
    return tries[best][0]


_MET = "the bodies' places prove it"
