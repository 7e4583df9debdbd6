"""What tells two models of one robot apart."""

from collections.abc import Sequence

import mujoco
import numpy as np


def integrator(model: mujoco.MjModel | mujoco.MjSpec) -> str:
    """MuJoCo's name of the integrator of a model."""
    option = model.opt if isinstance(model, mujoco.MjModel) else model.option
    return mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_").lower()


def self_collisions(model: mujoco.MjModel) -> int:
    """Pairs of a model's moving bodies that can collide with each other, however far apart they are."""
    geoms = [geom for geom in range(model.ngeom) if model.body_weldid[model.geom_bodyid[geom]]]
    bodies = model.body_weldid[model.geom_bodyid[geoms]]
    kinds, takes = model.geom_contype[geoms], model.geom_conaffinity[geoms]
    collide = (kinds[:, None] & takes | kinds & takes[:, None]) != 0
    pairs = {tuple(sorted(pair)) for pair in np.stack([bodies[i] for i in np.nonzero(collide)], -1).tolist()}
    excluded = np.stack([model.exclude_signature >> 16, model.exclude_signature & 0xFFFF], -1)
    pairs -= {tuple(sorted(pair)) for pair in model.body_weldid[excluded].tolist()}
    # MuJoCo leaves out a body and its parent, and takes what the file names as a pair.
    parent = model.body_weldid[model.body_parentid]
    pairs = {(a, b) for a, b in pairs if a != b and parent[b] != a and parent[a] != b}
    named = model.body_weldid[model.geom_bodyid[np.stack([model.pair_geom1, model.pair_geom2], -1)]]
    return len(pairs | {tuple(sorted(pair)) for pair in named.tolist() if 0 not in pair})


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
