"""BeyondMimic's and mjlab's ``.npz``: ``fps``, ``joint_pos [T, J]``, ``body_pos_w [T, B, 3]``, ``body_quat_w``.

Body 0 is the root; quaternions are wxyz. The two programs write the same names in different orders: Isaac Lab, on which
BeyondMimic stands, numbers joints and bodies breadth-first through the tree, with siblings in the model's order; mjlab
keeps the model's own order, depth-first. Where the file has ``joint_names`` they decide. Where it has not, both orders
are tried on a few frames, and the one whose forward kinematics meets the bodies' places is the file's. A file with
another number of bodies gives no such proof and is taken as BeyondMimic's.
"""

from pathlib import Path

import mujoco
import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion.readers.archive import Arrays
from fmpjax.motion.readers.recording import Recording, assemble, order_by_name, positive, table
from fmpjax.robots import Robot

NAME = "BeyondMimic, mjlab"
MARKS = ("fps", "joint_pos", "body_pos_w", "body_quat_w")
PROOFS = 20  # frames
TOLERANCE = 0.05  # m, mean distance of a body from its place


def read(file: Path, content: Arrays, robot: Robot) -> Recording:
    """The recording in a BeyondMimic or mjlab motion."""
    joints = table(file, "joint_pos", content["joint_pos"], -1)
    places = table(file, "body_pos_w", content["body_pos_w"], -1, 3)
    turns_wxyz = table(file, "body_quat_w", content["body_quat_w"], -1, 4)
    rate = positive(file, "fps", content["fps"])
    if not (places.shape[1] and turns_wxyz.shape[1]):
        raise UserError(f"{file}: no bodies in body_pos_w or body_quat_w, expected the root first")
    whole = assemble(file, "body_quat_w", places[:, 0], turns_wxyz[:, 0], joints, rate)
    if "joint_names" in content:
        names = content["joint_names"].ravel().tolist()
        if len(names) != joints.shape[1]:
            raise UserError(f"{file}: {len(names)} joint names for {joints.shape[1]} columns of joint_pos")
        order = order_by_name(file, names, robot)
    elif joints.shape[1] != robot.joint_count:
        raise UserError(f"{file}: joint_pos has {joints.shape[1]} joints and no names, expected {robot.joint_count}")
    else:
        order = _order(file, robot, whole.qpos, places)
    return whole._replace(qpos=np.concatenate([whole.qpos[:, :7], joints[:, order]], axis=1))


def breadth_first(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """The robot's bodies ``[B]`` and joints ``[J]`` in Isaac Lab's order, as indices of the model's order."""
    level = [0]
    bodies = []
    while level:
        bodies += level
        level = [int(child) for body in level for child in np.flatnonzero(robot.body_parent == body)]
    joints = robot.body_joint[bodies]
    return np.array(bodies), joints[joints >= 0]


def _order(file: Path, robot: Robot, qpos: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Where each joint of the robot stands in the file, ``[J]``, by the places ``[T, B, 3]`` of the bodies."""
    bodies, joints = breadth_first(robot)
    wide = np.argsort(joints)
    if places.shape[1] != len(bodies):
        return wide
    deep = np.arange(robot.joint_count)
    some = np.unique(np.linspace(0, len(qpos) - 1, PROOFS).astype(int)) if len(qpos) else np.arange(0)
    errors = []
    for order, seen in ((wide, places[:, np.argsort(bodies)]), (deep, places)):
        data, error = mujoco.MjData(robot.model), 0.0
        for i in some:
            data.qpos[:7], data.qpos[7:] = qpos[i, :7], qpos[i, 7:][order]
            mujoco.mj_kinematics(robot.model, data)
            error += np.linalg.norm(data.xpos[1:] - seen[i], axis=1).mean() / len(some)
        errors.append(error)
    if min(errors) > TOLERANCE:
        raise UserError(
            f"{file}: the bodies of body_pos_w lie {min(errors):.2g} m from where joint_pos puts those of robot "
            f"{robot.name!r}, expected at most {TOLERANCE} m"
        )
    return wide if errors[0] <= errors[1] else deep
