"""A policy's robot in another model, one step of control at a time."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from fmpjax.errors import UserError
from fmpjax.sim2sim.differences import differences
from fmpjax.sim2sim.exported import ExportedPolicy
from fmpjax.sim2sim.model import check_servos, drives_joint, prepared
from fmpjax.sim2sim.observation import CLIP_TERMS, TERMS

_MAKE = TERMS | CLIP_TERMS
_DEEPEST = 1.5e-3  # m, penetration of the floor at the start; the policy's own robot stands 1 mm in it


class Simulation:
    """A policy's robot in another model.

    ``differences`` is a list of sentences: what is not as it was in training. ``time`` is s since the last reset.
    """

    def __init__(
        self,
        policy: ExportedPolicy,
        path: str | Path,
        *,
        own_gains: bool = False,
        model: mujoco.MjModel | None = None,
        poses: np.ndarray | None = None,
    ):
        """Read an MJCF file.

        Args:
          policy: what is to run on it.
          path: the file.
          own_gains: keep the file's position servos; otherwise they get the policy's gains and torque limits.
          model: with servos and floor, where the file has been read already; it is taken as it is.
          poses: ``[M, J]`` rad, the clip at the rate of control, for a policy that is told the time in it.

        Raises:
          UserError: it cannot be read, or is no model of the policy's robot, or has no servos to keep; or the policy
            is told the time in a clip that is not given.
        """
        self.policy, said = policy, []
        self.poses, self.row = _clip(policy, poses), 0
        if model is None:
            model, said = prepared(policy, path, own_gains)
        self.model = model
        # A state that blows up is a fall, not a reset in silence.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.data = mujoco.MjData(model)
        joints = [model.joint(name) for name in policy.joint_names]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._qvel = np.array([joint.dofadr[0] for joint in joints])
        ids = [joint.id for joint in joints]
        servo = {int(j): i for i, (j, _) in enumerate(model.actuator_trnid) if drives_joint(model, i)}
        if own_gains:
            check_servos(model, {name: servo.get(i) for name, i in zip(policy.joint_names, ids, strict=True)}, path)
        self._servo = np.array([servo[i] for i in ids])
        free = int(np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)[0])
        self._root, self._root_body = int(model.jnt_qposadr[free]), int(model.jnt_bodyid[free])
        self._root_dof = int(model.jnt_dofadr[free])
        if model.opt.timestep > policy.step_dt * 1.001:
            raise UserError(
                f"{path} has a time step of {model.opt.timestep:g} s: expected at most {policy.step_dt:g} s, of control"
            )
        self.substeps = max(1, round(policy.step_dt / model.opt.timestep))
        self._key_points = [(self._body(p, path), p["offset"]) for p in policy.key_points]
        self._falls = [(self._body(s, path), s["ends"], s["radius"]) for s in policy.fall_shapes]
        self.time, self.raised = 0.0, 0.0
        self.command, self.errors, self.action = np.zeros(3), np.zeros(3), np.zeros(len(ids))
        self._told = np.zeros(3)
        self.reset()
        for name, width in policy.terms.items():
            if (found := policy.history * np.size(_MAKE[name](self))) != width:
                raise UserError(f"the policy's {name} has {width} numbers: expected {found}, as sim2sim makes them")
        self.differences = said + differences(policy, model, ids, self._servo, self._root_body, self.substeps)
        if self.raised:
            self.differences.append(f"the soles reach lower: the start is raised by {1e3 * self.raised:.1f} mm")

    def _body(self, place: dict[str, Any], path: str | Path) -> int:
        """Index of a body: found by its hinge, since models name bodies differently."""
        if place["joint"] is not None:
            return int(self.model.joint(place["joint"]).bodyid[0])
        found = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, place["body"])
        if found < 0:
            raise UserError(f"{path} has no body {place['body']!r}: the policy's robot has one")
        return found

    def reset(self, noise: np.ndarray | None = None) -> None:
        """The policy's default pose at rest; ``noise [2, J]`` is added to angles (rad) and velocities (rad/s)."""
        data, angles = self.data, self.policy.default_qpos
        mujoco.mj_resetData(self.model, data)
        data.qpos[self._root : self._root + 7] = angles[:7]
        data.qpos[self._qpos] = angles[7:]
        if noise is not None:
            data.qpos[self._qpos] += noise[0]
            data.qvel[self._qvel] += noise[1]
        mujoco.mj_fwdPosition(self.model, data)
        static = self.model.body_weldid[self.model.geom_bodyid[data.contact.geom]] == 0
        depth = -data.contact.dist[static.any(-1)].min(initial=0.0)
        self.raised = float(depth - _DEEPEST) if depth > _DEEPEST else 0.0
        data.qpos[self._root + 2] += self.raised
        mujoco.mj_kinematics(self.model, data)
        self.time, self.row, self.action, self._past = 0.0, 0, np.zeros(len(self._qpos)), []
        self.errors = np.zeros(3)  # running mean of velocity less command: m/s, m/s, rad/s
        self._told = np.zeros(3)

    def place(self, qpos: np.ndarray, qvel: np.ndarray, row: int = 0) -> None:
        """Start in a state in the policy's order, ``qpos [7 + J]`` and ``qvel [6 + J]``, at a row of the clip."""
        data = self.data
        mujoco.mj_resetData(self.model, data)
        data.qpos[self._root : self._root + 7], data.qpos[self._qpos] = qpos[:7], qpos[7:]
        data.qvel[self._root_dof : self._root_dof + 6], data.qvel[self._qvel] = qvel[:6], qvel[6:]
        mujoco.mj_kinematics(self.model, data)
        self.time, self.action, self.raised = 0.0, np.zeros(len(self._qpos)), 0.0
        self.errors, self._past, self.row, self._told = np.zeros(3), [], row, self.command.copy()

    @property
    def root_body(self) -> int:
        """Index of the body that carries the others."""
        return self._root_body

    @property
    def qpos(self) -> np.ndarray:
        """Configuration in the policy's order, ``[7 + J]``."""
        return np.concatenate([self.data.qpos[self._root : self._root + 7], self.data.qpos[self._qpos]])

    @property
    def qvel(self) -> np.ndarray:
        """Velocities in the policy's order, ``[6 + J]``: the root's in the world, its turning in its own axes."""
        return np.concatenate([self.data.qvel[self._root_dof : self._root_dof + 6], self.data.qvel[self._qvel]])

    @property
    def axes(self) -> np.ndarray:
        """The root's axes in the world, the columns of ``[3, 3]``."""
        return self.data.xmat[self._root_body].reshape(3, 3)

    @property
    def facing(self) -> np.ndarray:
        """Where the root faces over the floor, a unit vector ``[2]``."""
        return self.axes[:2, 0] / max(np.linalg.norm(self.axes[:2, 0]), 1e-6)

    def key_points(self) -> np.ndarray:
        """Key points less the root, in the world's axes, ``[K, 3]`` m."""
        root = self.data.xpos[self._root_body]
        return np.array([self._point(body, offset) - root for body, offset in self._key_points])

    def _point(self, body: int, offset: np.ndarray) -> np.ndarray:
        return self.data.xpos[body] + offset @ self.data.xmat[body].reshape(3, 3).T

    def phase(self) -> np.ndarray:
        """What a policy sees of the time in its clip, as `fmpjax.commands.phase` makes it: ``[5 + J]``."""
        poses, last = self.poses, len(self.poses) - 1
        angles = 2.0 * np.pi * self.row / last * np.array([1.0, 2.0])
        wanted = poses[min(self.row + 1, last)] - poses.mean(0)
        return np.concatenate([[self.row / last], np.sin(angles), np.cos(angles), wanted])

    @property
    def told(self) -> np.ndarray:
        """The command as the policy is told it, ``[3]``: it follows a new one as fast as in training."""
        return self.command if self.policy.ramp is None else self._told

    @property
    def over(self) -> bool:
        """Whether the clip has ended whose time the policy is told."""
        return 0 < len(self.poses) <= self.row + 1

    def observe(self) -> np.ndarray:
        """The policy's observation, ``[O]``; ahead of the first steps stands the first again."""
        newest = self._sensed()
        before = [*[self._past[0] if self._past else newest] * self.policy.history, *self._past]
        every = [*before, newest][-self.policy.history :]
        return np.concatenate([step[i] for i in range(len(newest)) for step in every])

    def _sensed(self) -> list[np.ndarray]:
        """The parts of the observation of this step alone."""
        return [np.ravel(_MAKE[name](self)) for name in self.policy.terms]

    def step(self) -> bool:
        """One step of control; whether a body that marks a fall then touches the floor."""
        observation = self.observe()
        self._past = [*self._past, self._sensed()][1 - self.policy.history :] if self.policy.history > 1 else []
        self.action = self.policy.act(observation)
        self.data.ctrl[self._servo] = self.policy.center + self.policy.scale * self.action
        mujoco.mj_step(self.model, self.data, self.substeps)
        self.time = self.data.time
        self.row = min(self.row + 1, max(0, len(self.poses) - 1))
        if not np.isfinite(self.data.qpos).all():
            return True
        mujoco.mj_kinematics(self.model, self.data)
        if "velocity_errors" in self.policy.terms:
            newest, scale = min(1.0, self.policy.step_dt / self.policy.average), self.policy.error_scale
            off = self.velocity() - self.told
            counted = np.sign(off) * scale * np.log1p(np.abs(off) / scale)
            self.errors = self.errors + newest * (counted - self.errors)
        if self.policy.ramp is not None:
            most = self.policy.ramp * self.policy.step_dt
            self._told = self._told + np.clip(self.command - self._told, -most, most)
        return any((self._point(body, ends)[:, 2] < radius).any() for body, ends, radius in self._falls)

    def push(self, velocity: np.ndarray) -> None:
        """Add ``velocity [2]`` (m/s, along the world's x and y) to the root's."""
        self.data.qvel[self._root_dof : self._root_dof + 2] += velocity

    def velocity(self) -> np.ndarray:
        """Velocity of the root forward and to the left in its own heading (m/s), and its turn (rad/s), ``[3]``."""
        x, y = self.facing
        forward, left = np.array([[x, y], [-y, x]]) @ self.qvel[:2]
        return np.array([forward, left, (self.axes @ self.qvel[3:6])[2]])


def _clip(policy: ExportedPolicy, poses: np.ndarray | None) -> np.ndarray:
    """The clip whose time a policy is told, ``[M, J]`` rad; no rows for one that is told none."""
    if "clip_phase" not in policy.terms:
        return np.zeros((0, len(policy.joint_names)))
    if poses is None:
        raise UserError("the policy is told the time in a clip, and its file has no clip: expected its run, to play it")
    return poses
