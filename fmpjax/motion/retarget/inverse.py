"""Inverse kinematics: configurations of a robot whose landmarks are near their targets."""

import numpy as np

from fmpjax.errors import UserError
from fmpjax.motion.retarget.targets import Targets
from fmpjax.robots import Robot

# Weights of the least squares: of a landmark's position (1/m) and of its orientation (1/rad).
WEIGHTS = {
    "pelvis": (1.0, 0.5),
    "chest": (0.0, 0.5),
    "knee": (0.2, 0.0),
    # Feet of humans tilt further than the robot's ankles: their place counts, their orientation gives way.
    "ankle": (10.0, 0.3),
    "elbow": (0.5, 0.0),
    "wrist": (0.5, 0.0),
}
POSTURE_WEIGHT = 0.01  # 1/rad, toward the default pose: decides what the targets leave open
# Steps are damped, or near stretched knees and joint limits the solver jumps from one branch to another.
DAMPING = 1e-2
FIRST_ITERATIONS, ITERATIONS = 100, 2
SMALL_STEP = 1e-3  # rad and m; a frame that moves less is solved


def solve(robot: Robot, targets: Targets, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Configurations ``[T, 7 + J]`` and residuals ``[T]`` (m), each frame from the one before."""
    try:
        import mink
    except ImportError:
        raise UserError("retargeting needs the package mink: install fmpjax[retarget]") from None
    configuration = mink.Configuration(robot.physics_model())
    model, data = configuration.model, configuration.data
    start = robot.default_qpos.copy()
    start[:3], start[3:7] = targets.position["pelvis"][0], targets.rotation_wxyz["pelvis"][0]
    configuration.update(start)
    posture = mink.PostureTask(model, POSTURE_WEIGHT)
    posture.set_target(robot.default_qpos)
    frame = {
        part: mink.FrameTask(robot.landmarks[part] + 1, "body", *WEIGHTS[part.rpartition("_")[2]])
        for part in targets.position
    }
    tasks, limits = [*frame.values(), posture], [mink.ConfigurationLimit(model)]
    measured = [part for part in frame if WEIGHTS[part.rpartition("_")[2]][0] > 0]
    bodies = np.array([robot.landmarks[part] + 1 for part in measured])
    wanted = np.stack([targets.position[part] for part in measured], axis=1)
    count = len(wanted)
    qpos, residual = np.empty((count, model.nq)), np.empty(count)
    for t in range(count):
        for _ in range(FIRST_ITERATIONS if t == 0 else ITERATIONS):
            for part, task in frame.items():
                # A landmark without a target orientation is content with its own.
                turned = targets.rotation_wxyz.get(part)
                wxyz = data.xquat[robot.landmarks[part] + 1] if turned is None else turned[t]
                task.set_target(mink.SE3(np.concatenate([wxyz, targets.position[part][t]])))
            step = mink.solve_ik(configuration, tasks, 1.0, solver="daqp", damping=DAMPING, limits=limits)
            configuration.integrate_inplace(step, 1.0)
            if np.abs(step).max() < SMALL_STEP:
                break
        qpos[t] = data.qpos
        # The solver meets limits to its own tolerance.
        qpos[t, 7:] = np.clip(qpos[t, 7:], robot.joint_low, robot.joint_high)
        residual[t] = np.sqrt(np.mean(np.sum((data.xpos[bodies] - wanted[t]) ** 2, axis=-1)))
    return qpos, residual
