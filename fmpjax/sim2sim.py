"""An exported policy on a MuJoCo model of its robot, by MuJoCo, ONNX Runtime and NumPy alone, without JAX.

The observation is built from the names in the file's metadata; joints are found by name. The model may be any MJCF with
the policy's joints, with servos or without, with a floor or without. It keeps its own time step, solver, masses and
contacts. Its servos get the policy's gains and torque limits, unless it is to keep its own.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np

from fmpjax.errors import UserError

_HINGE = mujoco.mjtJoint.mjJNT_HINGE
_DEEPEST = 1.5e-3  # m, penetration of the floor at the start; the policy's own robot stands 1 mm in it
# Seconds and command (m/s, m/s, rad/s) of each leg, for a policy that takes commands and is told nothing else.
COURSE = ((4.0, (0.5, 0.0, 0.0)), (4.0, (0.5, 0.0, 0.4)), (2.0, (0.0, 0.0, 0.0)))
Course = Sequence[tuple[float, tuple[float, float, float]]]


class Policy(NamedTuple):
    """What an ONNX file from `fmpjax export --onnx` holds; ``J`` joints."""

    act: Callable[[np.ndarray], np.ndarray]  # observation [O] -> actions [J]
    terms: dict[str, int]  # names and widths of the observation's parts
    joint_names: tuple[str, ...]
    center: np.ndarray  # [J] rad, the targets of action zero
    scale: np.ndarray  # [J] rad, a unit of action
    stiffness: np.ndarray  # [J] N m/rad
    damping: np.ndarray  # [J] N m s/rad
    effort: np.ndarray  # [J] N m
    joint_limits: np.ndarray  # [J, 2] rad
    joint_axes: np.ndarray  # [J, 3]
    jointless_row: int | None
    default_qpos: np.ndarray  # [7 + J] where the robot starts
    key_points: list[dict[str, Any]]
    fall_shapes: list[dict[str, Any]]
    step_dt: float  # s, of control
    physics_dt: float  # s, in training
    total_mass: float  # kg
    integrator: str  # MuJoCo's name of it, in training
    facts: dict[str, np.ndarray]  # what `facts` says of the model of the training
    robot: str


def load(path: str | Path) -> Policy:
    """Read an exported policy.

    Raises:
      UserError: onnxruntime is missing, or the file is, or it is no such policy.
    """
    try:
        import onnxruntime
    except ImportError:
        raise UserError("sim2sim needs the package onnxruntime: install the extra fmpjax[deploy]") from None
    if not Path(path).is_file():
        raise UserError(f"{path} is not a file: expected policy.onnx as `fmpjax export --onnx` writes it")
    expected = "expected a file as `fmpjax export --onnx` writes it"
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # more only wait for each other in so small a network
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a class for each kind
        raise UserError(f"{path} is not an ONNX file ({str(error).splitlines()[0]}): {expected}") from None
    said = session.get_modelmeta().custom_metadata_map
    try:
        _check_plain(said)
        widths = map(int, said["observation_widths"].split(","))
        policy = Policy(
            act=lambda x: session.run(["actions"], {"obs": x[None].astype(np.float32)})[0][0],
            terms=dict(zip(said["observation_names"].split(","), widths, strict=True)),
            joint_names=tuple(said["joint_names"].split(",")),
            center=_numbers(said["action_offset"]),
            scale=_numbers(said["action_scale"]),
            stiffness=_numbers(said["joint_stiffness"]),
            damping=_numbers(said["joint_damping"]),
            effort=_numbers(said["joint_effort"]),
            joint_limits=_rows(said["joint_limits"]),
            joint_axes=_rows(said["joint_axes"]),
            jointless_row=int(said["jointless_row"]) if said["jointless_row"] else None,
            default_qpos=_numbers(said["default_qpos"]),
            key_points=_places(said["key_points"], "offset"),
            fall_shapes=_places(said["fall_shapes"], "ends", "radius"),
            step_dt=float(said["step_dt"]),
            physics_dt=float(said["physics_dt"]),
            total_mass=float(said["total_mass"]),
            integrator=said["integrator"],
            facts={name: _rows(said[name]) for name in FACTS},
            robot=said["robot"],
        )
    except KeyError as error:
        raise UserError(f"{path} has no metadata {error}: {expected}") from None
    except (ValueError, TypeError) as error:
        raise UserError(f"{path} has metadata that cannot be read ({error}): {expected}") from None
    _check(path, policy, session)
    return policy


def _numbers(text: str, separator: str = ",") -> np.ndarray:
    numbers = np.array(text.split(separator), np.float64)
    if not np.isfinite(numbers).all():
        raise ValueError(f"{text[:40]!r} is not finite")
    return numbers


def _rows(text: str) -> np.ndarray:
    """A matrix; of columns of one number a vector."""
    rows = np.array([_numbers(row, ";") for row in text.split(",")])
    return rows[:, 0] if rows.shape[1] == 1 else rows


def _places(text: str, *wanted: str) -> list[dict[str, Any]]:
    """Points or shapes in bodies, as JSON has them."""
    return [
        {"body": place["body"], "joint": place["joint"]} | {name: np.array(place[name], np.float64) for name in wanted}
        for place in json.loads(text)
    ]


def _check_plain(said: dict[str, str]) -> None:
    """Refuse what mjlab's keys may ask for and a policy of fmpjax never does: scales, clips and histories.

    Raises:
      ValueError: one of them is asked for.
    """
    for key, plain in (("scale", "1.0"), ("clip", "-inf;inf"), ("history_length", "0")):
        values = set(said[f"observation_terms_{key}"].split(","))
        if values != {plain}:
            raise ValueError(f"observation_terms_{key} is {min(values - {plain})}, and sim2sim knows {plain} alone")


def _check(path: str | Path, policy: Policy, session) -> None:
    joints, size = len(policy.joint_names), sum(policy.terms.values())
    names = [node.name for node in (*session.get_inputs(), session.get_outputs()[0])]
    if names != ["obs", "actions"]:
        raise UserError(f"{path} maps {', '.join(names[:-1])} to {names[-1]}: expected obs to actions")
    taken, given = session.get_inputs()[0].shape, session.get_outputs()[0].shape
    for name in policy.terms:
        if name not in _TERMS:
            raise UserError(f"{path} observes {name!r}, which sim2sim does not know: expected {', '.join(_TERMS)}")
    if (taken, given) != ([1, size], [1, joints]):
        raise UserError(f"{path} maps {taken} to {given}: its metadata tells of [1, {size}] to [1, {joints}]")
    per_joint = ("center", "scale", "stiffness", "damping", "effort", "joint_limits", "joint_axes")
    for name, rows in ({name: getattr(policy, name) for name in per_joint} | policy.facts).items():
        if len(rows) != joints:
            raise UserError(f"{path} has {len(rows)} of {name}: expected one per joint, {joints}")
    if len(policy.default_qpos) != 7 + joints:
        raise UserError(f"{path} has {len(policy.default_qpos)} numbers in default_qpos: expected {7 + joints}")


class Simulation:
    """A policy's robot in another model.

    ``differences`` is a list of sentences: what is not as it was in training. ``time`` is s since the last reset.
    """

    def __init__(self, policy: Policy, path: str | Path, *, own_gains: bool = False):
        """Read an MJCF file.

        Args:
          policy: what is to run on it.
          path: the file.
          own_gains: keep the file's position servos; otherwise they get the policy's gains and torque limits.

        Raises:
          UserError: it cannot be read, or is no model of the policy's robot, or has no servos to keep.
        """
        self.policy = policy
        try:
            spec = mujoco.MjSpec.from_file(str(path))
            said = _prepare(spec, policy, path, own_gains)
            self.model = model = spec.compile()
        except UserError:
            raise
        except (ValueError, FileNotFoundError) as error:
            raise UserError(f"{path} cannot be read as MJCF: {' '.join(str(error).split())}") from None
        # A state that blows up is a fall, not a reset in silence.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.data = mujoco.MjData(model)
        joints = [model.joint(name) for name in policy.joint_names]
        self._qpos = np.array([joint.qposadr[0] for joint in joints])
        self._qvel = np.array([joint.dofadr[0] for joint in joints])
        ids = [joint.id for joint in joints]
        servo = {int(j): i for i, (j, _) in enumerate(model.actuator_trnid) if _drives_joint(model, i)}
        if own_gains:
            _check_servos(model, {name: servo.get(i) for name, i in zip(policy.joint_names, ids, strict=True)}, path)
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
        self.command, self.action = np.zeros(3), np.zeros(len(ids))
        self.reset()
        for name, width in policy.terms.items():
            if (found := np.size(_TERMS[name](self))) != width:
                raise UserError(f"the policy's {name} has {width} numbers: expected {found}, as sim2sim makes them")
        self.differences = said + _differences(self, ids)

    def _body(self, place: dict[str, Any], path: str | Path) -> int:
        """Index of a body: its hinge finds it, whatever the model calls it."""
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
        self.time, self.action = 0.0, np.zeros(len(self._qpos))

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

    def key_points(self) -> np.ndarray:
        """Key points less the root, in the world's axes, ``[K, 3]`` m."""
        root = self.data.xpos[self._root_body]
        return np.array([self._point(body, offset) - root for body, offset in self._key_points])

    def _point(self, body: int, offset: np.ndarray) -> np.ndarray:
        return self.data.xpos[body] + offset @ self.data.xmat[body].reshape(3, 3).T

    def observe(self) -> np.ndarray:
        """The policy's observation, ``[O]``."""
        return np.concatenate([np.ravel(_TERMS[name](self)) for name in self.policy.terms])

    def step(self) -> bool:
        """One step of control; whether a body that marks a fall then touches the floor."""
        self.action = self.policy.act(self.observe())
        self.data.ctrl[self._servo] = self.policy.center + self.policy.scale * self.action
        mujoco.mj_step(self.model, self.data, self.substeps)
        self.time = self.data.time
        if not np.isfinite(self.data.qpos).all():
            return True
        mujoco.mj_kinematics(self.model, self.data)
        return any((self._point(body, ends)[:, 2] < radius).any() for body, ends, radius in self._falls)

    def velocity(self) -> np.ndarray:
        """Velocity of the root forward and to the left in its own heading (m/s), and its turn (rad/s), ``[3]``."""
        x, y = self.axes[:2, 0] / max(np.linalg.norm(self.axes[:2, 0]), 1e-6)
        forward, left = np.array([[x, y], [-y, x]]) @ self.qvel[:2]
        return np.array([forward, left, (self.axes @ self.qvel[3:6])[2]])


def _joint_rotations(sim: Simulation) -> np.ndarray:
    """First and last column of each hinge's rotation, ``[rows, 6]``."""
    axis, angle = sim.policy.joint_axes, sim.qpos[7:, None]
    columns = []
    for unit in np.eye(3)[[0, 2]]:
        along = axis * (axis @ unit)[:, None]
        columns.append(np.cos(angle) * (unit - along) + np.sin(angle) * np.cross(axis, unit) + along)
    rows = np.concatenate(columns, -1)
    return rows if (cut := sim.policy.jointless_row) is None else np.insert(rows, cut, [1, 0, 0, 0, 0, 1], axis=0)


_TERMS: dict[str, Callable[[Simulation], np.ndarray]] = {
    "root_height": lambda sim: sim.qpos[2:3],
    "root_rotation_6d": lambda sim: sim.axes[:, [0, 2]].T,
    "root_linear_velocity": lambda sim: sim.qvel[:3],
    "root_angular_velocity": lambda sim: sim.axes @ sim.qvel[3:6],
    "joint_position": lambda sim: sim.qpos[7:],
    "joint_rotation_6d": _joint_rotations,
    "joint_velocity": lambda sim: sim.qvel[6:],
    "key_points": lambda sim: sim.key_points(),
    # What a robot senses, under the names of Unitree's programs.
    "base_ang_vel": lambda sim: sim.qvel[3:6],
    "projected_gravity": lambda sim: -sim.axes[2],
    "velocity_commands": lambda sim: sim.command,
    "joint_pos": lambda sim: sim.qpos[7:],
    "joint_pos_rel": lambda sim: sim.qpos[7:] - sim.policy.center,
    "joint_vel_rel": lambda sim: sim.qvel[6:],
    "last_action": lambda sim: sim.action,
}


def _drives_joint(model: mujoco.MjModel, actuator: int) -> bool:
    return model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT


def _check_servos(model: mujoco.MjModel, servos: dict[str, int | None], path: str | Path) -> None:
    """Refuse a model whose own actuators ``servos``, by joint, do not all hold an angle."""
    for name, i in servos.items():
        gain, bias = (0, (0, 0)) if i is None else (model.actuator_gainprm[i, 0], model.actuator_biasprm[i])
        if not (gain > 0 and bias[1] == -gain and model.actuator_gear[i, 0] == 1):
            raise UserError(f"{path} has no position servo on {name}: expected one per joint where it keeps its gains")


def _prepare(spec: mujoco.MjSpec, policy: Policy, path: str | Path, own_gains: bool) -> list[str]:
    """Give the policy's joints its servos unless ``own_gains``, and the world a floor; sentences on what was added.

    Servos of MuJoCo apply the torque of the gains; its implicit integrators know their damping, as in training.
    """
    hinges = {joint.name for joint in spec.joints if joint.type == _HINGE}
    missing = [name for name in policy.joint_names if name not in hinges]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise UserError(f"{path} has no hinge {', '.join(missing[:3])}{more}: the policy moves {policy.robot}")
    if sum(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in spec.joints) != 1:
        raise UserError(f"{path} has not one free joint: expected a robot whose root is free, and nothing else that is")
    for key in list(spec.keys):  # of as many controls as there were
        spec.delete(key)
    said = _without_missing_meshes(spec, path)
    if not any(geom.contype or geom.conaffinity for geom in spec.worldbody.geoms):
        plane = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0, 0, 1]}
        spec.worldbody.add_geom(**plane, contype=1, conaffinity=1, condim=3, friction=[1, 5e-3, 1e-4])
        said.append("no floor: one was added at height 0")
    if own_gains:
        return said
    # An explicit integrator blows up where a servo's damping is large beside the inertia that it moves.
    if spec.option.integrator in (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4):
        said.append(f"integrator {integrator(spec)}: implicitfast was taken for the servos' damping")
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    servos: dict[str, Any] = {}
    for actuator in spec.actuators:
        if actuator.target in policy.joint_names and actuator.trntype == mujoco.mjtTrn.mjTRN_JOINT:
            if actuator.target in servos:
                raise UserError(f"{path} has two actuators on {actuator.target}: expected one or none")
            servos[actuator.target] = actuator
    rows = zip(policy.joint_names, policy.stiffness, policy.damping, policy.effort, strict=True)
    for name, stiffness, damping, effort in rows:
        servo = servos.get(name) or spec.add_actuator(name=f"{name}_servo", target=name)
        servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
        servo.dyntype = mujoco.mjtDyn.mjDYN_NONE
        servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        servo.gear = [1, 0, 0, 0, 0, 0]
        servo.gainprm, servo.biasprm = np.zeros(10), np.zeros(10)
        servo.gainprm[0] = stiffness
        servo.biasprm[:3] = 0, -stiffness, -damping
        servo.ctrllimited, servo.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE, mujoco.mjtLimited.mjLIMITED_FALSE
        servo.forcelimited, servo.forcerange = mujoco.mjtLimited.mjLIMITED_TRUE, [-effort, effort]
    return said


def _without_missing_meshes(spec: mujoco.MjSpec, path: str | Path) -> list[str]:
    """Remove the shapes whose mesh files are not there, as where a model came without them; a sentence on that."""
    folder = Path(path).parent / spec.meshdir
    missing = [mesh for mesh in spec.meshes if mesh.file and not (folder / mesh.file).is_file()]
    names = {mesh.name for mesh in missing}
    for geom in [geom for geom in spec.geoms if geom.meshname in names]:
        spec.delete(geom)
    for mesh in missing:
        spec.delete(mesh)
    if not missing:
        return []
    return [f"{len(missing)} mesh files are missing, such as {missing[0].file}: their shapes are left out"]


def integrator(model: mujoco.MjModel | mujoco.MjSpec) -> str:
    """MuJoCo's name of the integrator of a model."""
    option = model.opt if isinstance(model, mujoco.MjModel) else model.option
    return mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_").lower()


# What `facts` says: its words, its unit, and the difference from which it is told.
FACTS = {
    "joint_places": ("places", "m", 1e-4),
    "joint_directions": ("directions", "", 1e-3),
    "joint_loads": ("loads", "kg", 1e-3),
    "joint_armature": ("armature", "kg m^2", 1e-6),
    "joint_friction": ("friction", "N m", 1e-6),
    "joint_passive_damping": ("damping of its own", "N m s/rad", 1e-6),
}


def facts(model: mujoco.MjModel, joint_names: Sequence[str]) -> dict[str, np.ndarray]:
    """What tells two models of one robot apart, joint by joint, at angles of zero; names of bodies do not matter.

    Places of the joints less the root's (m) and their directions in its axes, ``[J, 3]``; the mass that each carries
    (kg), armature (kg m²), dry friction (N m) and damping of the joint itself (N m s/rad), ``[J]``.
    """
    data = mujoco.MjData(model)
    joints = [model.joint(name) for name in joint_names]
    ids, dofs = [joint.id for joint in joints], [joint.dofadr[0] for joint in joints]
    data.qpos[[joint.qposadr[0] for joint in joints]] = 0.0
    mujoco.mj_kinematics(model, data)
    root = model.jnt_bodyid[np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)[0]]
    axes = data.xmat[root].reshape(3, 3)
    return {
        "joint_places": (data.xanchor[ids] - data.xpos[root]) @ axes,
        "joint_directions": data.xaxis[ids] @ axes,
        "joint_loads": model.body_subtreemass[model.jnt_bodyid[ids]],
        "joint_armature": model.dof_armature[dofs],
        "joint_friction": model.dof_frictionloss[dofs],
        "joint_passive_damping": model.dof_damping[dofs],
    }


def _differences(sim: Simulation, ids: list[int]) -> list[str]:
    """Sentences on what the model, its policy's joints ``ids``, has unlike the policy's training."""
    policy, model, said = sim.policy, sim.model, []
    mass = float(model.body_subtreemass[sim._root_body])
    if abs(mass - policy.total_mass) > 1e-3:
        said.append(f"mass {mass:.3f} kg, in training {policy.total_mass:.3f} kg")
    if ids != sorted(ids):
        said.append("joints stand in another order; they are found by name")
    moved = set(ids)
    others = [j for j in range(model.njnt) if j not in moved and model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]
    if others:
        names = ", ".join(model.joint(j).name for j in others[:3]) + (" ..." if len(others) > 3 else "")
        said.append(f"{len(others)} joints that the policy does not move: {names}")
    ranges = np.where(model.jnt_limited[ids, None], model.jnt_range[ids], [-np.inf, np.inf])
    said += _unlike(
        policy, "limits", np.abs(ranges - policy.joint_limits).max(-1) > 1e-3, ranges, policy.joint_limits, "rad"
    )
    efforts = np.where(model.jnt_actfrclimited[ids, None], model.jnt_actfrcrange[ids], [-np.inf, np.inf])
    weaker = efforts[:, 1] < policy.effort - 1e-3
    trained = np.stack([-policy.effort, policy.effort], -1)
    said += _unlike(policy, "lower torque limits", weaker, efforts, trained, "N m")
    here = facts(model, policy.joint_names)
    for name, (words, unit, tolerance) in FACTS.items():
        said += _apart(policy, words, unit, tolerance, here[name], policy.facts[name])
    gains = model.actuator_gainprm[sim._servo, 0], -model.actuator_biasprm[sim._servo, 2]
    said += _apart(policy, "stiffness", "N m/rad", 1e-3, gains[0], policy.stiffness)
    said += _apart(policy, "damping", "N m s/rad", 1e-3, gains[1], policy.damping)
    if abs(model.opt.timestep - policy.physics_dt) > 1e-9:
        said.append(f"time step {1e3 * model.opt.timestep:g} ms, in training {1e3 * policy.physics_dt:g} ms")
    control = sim.substeps * model.opt.timestep
    if abs(control - policy.step_dt) > 1e-9:
        said.append(f"control every {1e3 * control:g} ms, in training {1e3 * policy.step_dt:g} ms")
    if (own := integrator(model)) != policy.integrator:
        said.append(f"integrator {own}, in training {policy.integrator}")
    if sim.raised:
        said.append(f"the soles reach lower: the start is raised by {1e3 * sim.raised:.1f} mm")
    return said


def _unlike(
    policy: Policy, what: str, where: np.ndarray, here: np.ndarray, trained: np.ndarray, unit: str
) -> list[str]:
    """A sentence on the joints that differ, with the first of them."""
    found = np.flatnonzero(where)
    if not len(found):
        return []
    first = found[0]
    a, b = (f"{low:.3f} to {high:.3f}" for low, high in (here[first], trained[first]))
    return [f"{what} of {len(found)} joints, such as {policy.joint_names[first]}: {a} {unit}, in training {b} {unit}"]


def _apart(policy: Policy, words: str, unit: str, tolerance: float, here: np.ndarray, trained: np.ndarray) -> list[str]:
    """A sentence on the joints whose numbers ``[J]`` or vectors ``[J, 3]`` differ, with the one that does most."""
    apart = np.abs(here - trained) if here.ndim == 1 else np.linalg.norm(here - trained, axis=-1)
    if not (apart > tolerance).any():
        return []
    most = int(apart.argmax())
    start = f"{words} of {np.sum(apart > tolerance)} joints, {policy.joint_names[most]} the most: "
    if here.ndim == 2:
        return [f"{start}{apart[most]:.4f} {unit}".rstrip() + " away from those in training"]
    return [f"{start}{here[most]:.4g} {unit}, in training {trained[most]:.4g} {unit}"]


class Episode(NamedTuple):
    """One start of a policy until its fall or the end; ``T`` steps of control."""

    qpos: np.ndarray  # [T + 1, 7 + J], the start first, of finite numbers alone
    speed: float  # m/s along the own heading, mean of the second half
    legs: np.ndarray  # [L, 3] mean velocity in the second half of each leg of the course; not finite after a fall
    seconds: float
    fell: bool


def course(legs: Sequence[str]) -> Course:
    """A course from words such as ``4:0.5,0,0.4``: seconds, then velocity forward, to the left (m/s) and turn (rad/s).

    Raises:
      UserError: a word cannot be read.
    """
    found = []
    for leg in legs:
        seconds, _, command = leg.partition(":")
        try:
            numbers = [float(seconds), *map(float, command.split(","))]
        except ValueError:
            numbers = []
        if len(numbers) != 4 or not np.isfinite(numbers).all() or numbers[0] <= 0:
            raise UserError(f"leg {leg!r} of the course: expected SECONDS:FORWARD,LEFT,TURN such as 4:0.5,0,0.4")
        found.append((numbers[0], tuple(numbers[1:])))
    return tuple(found)


def play(
    sim: Simulation,
    *,
    seconds: float = 10.0,
    episodes: int = 8,
    noise: float = 0.02,
    seed: int = 0,
    course: Course | None = None,
) -> list[Episode]:
    """Run the policy from its default pose, the first time exactly, then with joints a little off.

    Args:
      sim: the model.
      seconds: length of an episode at most, where there is no course.
      episodes: their number.
      noise: rad, standard deviation of the joint angles; ten times that in rad/s of their velocities.
      seed: of the noise.
      course: seconds and command of each leg, for a policy that takes commands.

    Raises:
      UserError: there is a course, and the policy takes no commands.
    """
    if course and "velocity_commands" not in sim.policy.terms:
        raise UserError("there is a course, and the policy takes no commands: expected one that observes them")
    course = course or ((seconds, (0.0, 0.0, 0.0)),)
    ends, commands = np.cumsum([leg for leg, _ in course]), np.array([command for _, command in course])
    random, played = np.random.default_rng(seed), []
    for episode in range(episodes):
        off = random.normal(size=(2, len(sim.policy.joint_names))) * noise * np.array([[1.0], [10.0]])
        sim.reset(off if episode else None)
        qpos, velocities, legs, fell = [sim.qpos], [], [], False
        while not fell and sim.time < ends[-1] - 1e-9:
            legs.append(int(np.searchsorted(ends - 1e-9, sim.time, side="right")))
            sim.command = commands[legs[-1]]
            fell = sim.step()
            velocities.append(sim.velocity())
            if np.isfinite(sim.qpos).all():
                qpos.append(sim.qpos)
        reached, steps = np.array(velocities), np.array(legs)
        means = np.full((len(course), 3), np.nan)
        for leg in range(steps[-1] + (not fell)):
            rows = np.flatnonzero(steps == leg)
            means[leg] = reached[rows[len(rows) // 2 :]].mean(0)
        speed = float(reached[len(reached) // 2 :, 0].mean())
        played.append(Episode(np.array(qpos), speed, means, sim.time, fell))
    return played


def report(sim: Simulation, played: list[Episode], course: Course | None = None) -> str:
    """Falls, speed, what became of each leg of the course, and the differences between the models, in words."""
    falls = [episode for episode in played if episode.fell]
    upright = [episode.speed for episode in played if not episode.fell]
    lines = [f"falls: {len(falls)} of {len(played)} episodes"]
    if falls:
        lines[0] += f", after {min(e.seconds for e in falls):.2f} to {max(e.seconds for e in falls):.2f} s"
    lines.append(
        f"speed: {np.mean(upright):.3f} m/s, second half of the episodes without a fall"
        if upright
        else "speed: undefined, each episode ends in a fall"
    )
    for leg, (seconds, command) in enumerate(course or ()):
        reached = np.array([episode.legs[leg] for episode in played])
        reached = reached[np.isfinite(reached).all(-1)]
        told = "nothing, each episode had ended in a fall" if not len(reached) else _velocity(reached.mean(0))
        lines.append(f"told {_velocity(command)} for {seconds:g} s: {told}")
    if not sim.differences:
        return "\n".join([*lines, "the model is as in training in masses, joints, limits, integrator and time step"])
    return "\n".join([*lines, "unlike in training:", *(f"  {sentence}" for sentence in sim.differences)])


def _velocity(velocity: Sequence[float]) -> str:
    forward, left, turn = velocity
    return f"{forward:.2f} m/s forward, {left:.2f} m/s to the left, {turn:.2f} rad/s"
