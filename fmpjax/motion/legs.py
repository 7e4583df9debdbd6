"""Inverse kinematics of one leg."""

import mujoco
import numpy as np

from fmpjax.errors import UserError
from fmpjax.robots import Robot

STEPS = 30  # of Newton's method; where the foot is within reach a handful do
CLOSE = 1e-10  # m and rad, where it stops


class OutOfReach(UserError):
    """No angles of the leg put the foot where it should be."""


class Leg:
    """The six hinges between the root and one foot, solved by Newton's method.

    ``joints [6]``: indices of the hinges, from the root. ``heel``, ``toe`` ``[3]``: centers of the sole's hindmost and
    foremost spheres in the foot's body, m, y positive on either side; they have ``radius`` (m). ``half_width`` (m): of
    the sole.

    Raises:
      UserError: the robot has not six hinges there.
    """

    def __init__(self, robot: Robot, foot: int):
        self.model, self.data, self.body = robot.model, mujoco.MjData(robot.model), foot + 1
        joints, body = [], foot
        while body > 0:
            joints.append(robot.body_joint[body])
            body = robot.body_parent[body]
        self.joints = np.array([joint for joint in joints[::-1] if joint >= 0])
        if len(self.joints) != 6:
            raise UserError(f"robot {robot.name!r} has {len(self.joints)} hinges in a leg: a walk needs six")
        own = robot.sole_body == foot
        points = robot.sole_point[own]
        self.radius = float(robot.sole_radius[own][0])
        ends = points[[np.argmin(points[:, 0]), np.argmax(points[:, 0])]]
        self.heel, self.toe = np.stack([ends[:, 0], np.abs(ends[:, 1]), ends[:, 2]], axis=-1)
        self.half_width = float(np.abs(points[:, 1]).max()) + self.radius
        self.angles = robot.default_qpos[7 + self.joints]
        self._jacobian = np.zeros((6, robot.model.nv))

    def reach(self, qpos: np.ndarray, position: np.ndarray, orientation_wxyz: np.ndarray) -> None:
        """Put the leg's angles into ``qpos [7 + J]`` so that the foot's body has the pose in the world.

        The search starts from the last solution, so poses in order of time are found fastest.

        Raises:
          OutOfReach: the leg does not reach the pose.
        """
        model, data = self.model, self.data
        data.qpos[:] = qpos
        error, back, turn = np.zeros(6), np.zeros(4), np.zeros(4)
        angles = self.angles.copy()
        for _ in range(STEPS):
            data.qpos[7 + self.joints] = angles
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            error[:3] = position - data.xpos[self.body]
            mujoco.mju_negQuat(back, data.xquat[self.body])
            mujoco.mju_mulQuat(turn, orientation_wxyz, back)
            mujoco.mju_quat2Vel(error[3:], turn, 1.0)
            if np.abs(error).max() < CLOSE:
                break
            mujoco.mj_jacBody(model, data, self._jacobian[:3], self._jacobian[3:], self.body)
            step = np.linalg.solve(self._jacobian[:, 6 + self.joints], error)
            # Long steps cross the straight knee and come back bent the wrong way.
            angles = angles + step * min(1.0, 0.3 / np.abs(step).max())
        else:
            raise OutOfReach(
                "the walk's feet are out of the legs' reach: expected a lower pelvis, a lower speed or a higher cadence"
            )
        self.angles = angles
        qpos[7 + self.joints] = angles
