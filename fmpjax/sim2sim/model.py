"""The model that a policy is to run on: its servos, its floor, and what is removed from it."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from fmpjax.errors import UserError
from fmpjax.sim2sim.exported import ExportedPolicy
from fmpjax.sim2sim.traits import integrator

_HINGE = mujoco.mjtJoint.mjJNT_HINGE


def drives_joint(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator acts on a joint."""
    return model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT


def check_servos(model: mujoco.MjModel, servos: dict[str, int | None], path: str | Path) -> None:
    """Refuse a model whose own actuators ``servos``, by joint, do not all hold an angle."""
    for name, i in servos.items():
        gain, bias = (0, (0, 0)) if i is None else (model.actuator_gainprm[i, 0], model.actuator_biasprm[i])
        if not (gain > 0 and bias[1] == -gain and model.actuator_gear[i, 0] == 1):
            raise UserError(f"{path} has no position servo on {name}: expected one per joint with --gains model")


def prepared(policy: ExportedPolicy, path: str | Path, own_gains: bool) -> tuple[mujoco.MjModel, list[str]]:
    """The model in a file with the policy's servos and a floor, and sentences on what was added.

    Raises:
      UserError: the file cannot be read, or is no model of the policy's robot.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        said = prepare(spec, policy, path, own_gains)
        return spec.compile(), said
    except UserError:
        raise
    except (ValueError, FileNotFoundError) as error:
        raise UserError(f"{path} cannot be read as MJCF: {' '.join(str(error).split())}") from None


def prepare(spec: mujoco.MjSpec, policy: ExportedPolicy, path: str | Path, own_gains: bool) -> list[str]:
    """Give the policy's joints its servos unless ``own_gains``, and the world a floor; sentences on what was added.

    Servos of MuJoCo apply the torque of the gains; its implicit integrators know their damping, as in training.
    """
    hinges = {joint.name for joint in spec.joints if joint.type == _HINGE}
    missing = [name for name in policy.joint_names if name not in hinges]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        raise UserError(f"{path} has no hinge {', '.join(missing[:3])}{more}: the policy moves {policy.robot}")
    if sum(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in spec.joints) != 1:
        raise UserError(f"{path} has no free joint, or several: expected one, of the robot's root")
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
