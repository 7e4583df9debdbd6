"""Sentences on what a model has unlike the one that a policy was trained on."""

import mujoco
import numpy as np

from fmpjax.sim2sim.exported import ExportedPolicy
from fmpjax.sim2sim.traits import FACTS, facts, integrator, self_collisions


def differences(
    policy: ExportedPolicy, model: mujoco.MjModel, ids: list[int], servos: np.ndarray, root: int, substeps: int
) -> list[str]:
    """Sentences on what a model has unlike the policy's training.

    Args:
      policy: the policy.
      model: with its servos.
      ids: of the policy's joints in the model, ``J``.
      servos: actuators of these joints, ``[J]``.
      root: body that carries the others.
      substeps: steps of the model per step of control.
    """
    said = []
    mass = float(model.body_subtreemass[root])
    if abs(mass - policy.total_mass) > 1e-3:
        said.append(f"mass {mass:.3f} kg, in training {policy.total_mass:.3f} kg")
    if ids != sorted(ids):
        said.append("the joints are in another order; they are found by name")
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
    gains = model.actuator_gainprm[servos, 0], -model.actuator_biasprm[servos, 2]
    said += _apart(policy, "stiffness", "N m/rad", 1e-3, gains[0], policy.stiffness)
    said += _apart(policy, "damping", "N m s/rad", 1e-3, gains[1], policy.damping)
    if abs(model.opt.timestep - policy.physics_dt) > 1e-9:
        said.append(f"time step {1e3 * model.opt.timestep:g} ms, in training {1e3 * policy.physics_dt:g} ms")
    control = substeps * model.opt.timestep
    if abs(control - policy.step_dt) > 1e-9:
        said.append(f"control every {1e3 * control:g} ms, in training {1e3 * policy.step_dt:g} ms")
    pairs, trained_pairs = self_collisions(model), policy.self_collisions
    if trained_pairs is not None and pairs != trained_pairs:
        said.append(f"{pairs} pairs of its bodies can hit each other, in training {trained_pairs}")
    if (own := integrator(model)) != policy.integrator:
        said.append(f"integrator {own}, in training {policy.integrator}")
    return said


def _unlike(
    policy: ExportedPolicy, what: str, where: np.ndarray, here: np.ndarray, trained: np.ndarray, unit: str
) -> list[str]:
    """A sentence on the joints that differ, with the first of them."""
    found = np.flatnonzero(where)
    if not len(found):
        return []
    first = found[0]
    a, b = (f"{low:.3f} to {high:.3f}" for low, high in (here[first], trained[first]))
    return [f"{what} of {len(found)} joints, such as {policy.joint_names[first]}: {a} {unit}, in training {b} {unit}"]


def _apart(
    policy: ExportedPolicy, words: str, unit: str, tolerance: float, here: np.ndarray, trained: np.ndarray
) -> list[str]:
    """A sentence on the joints whose numbers ``[J]`` or vectors ``[J, 3]`` differ, with the one that does most."""
    apart = np.abs(here - trained) if here.ndim == 1 else np.linalg.norm(here - trained, axis=-1)
    if not (apart > tolerance).any():
        return []
    most = int(apart.argmax())
    start = f"{words} of {np.sum(apart > tolerance)} joints, {policy.joint_names[most]} the most: "
    if here.ndim == 2:
        return [f"{start}{apart[most]:.4f} {unit}".rstrip() + " away from those in training"]
    return [f"{start}{here[most]:.4g} {unit}, in training {trained[most]:.4g} {unit}"]
