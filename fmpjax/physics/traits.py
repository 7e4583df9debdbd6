"""In what a robot and its floor may differ from their model, and the fields of the model that this changes."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from fmpjax.errors import UserError
from fmpjax.robots import FLOORS, Robot


class Traits(NamedTuple):
    """Differences of N robots and their floors from their model; ``J`` joints."""

    friction: jax.Array  # [N, 1] factor of the sliding friction of soles and floor
    torso_mass: jax.Array  # [N, 1] kg, added to the torso, whose inertia grows with it
    torso_center: jax.Array  # [N, 3] m, by which the torso's center of mass is off
    stiffness: jax.Array  # [N, J] factor of kp
    damping: jax.Array  # [N, J] factor of kd
    strength: jax.Array  # [N, J] factor of the torque limits
    joint_friction: jax.Array  # [N, J] N m, dry friction
    armature: jax.Array  # [N, J] factor of the motors' inertia
    slope: jax.Array  # [N, 2] rad, by which the floor rises along x and y: gravity is tilted, the floor is not
    # [N, 2] m, heights of the floor under the left and the right foot: last, as they alone change in an episode
    floors: Any

    @property
    def packed(self) -> jax.Array:
        """All of them in one array, ``[N, K]``."""
        return jnp.concatenate(self, axis=-1)


def widths(joints: int) -> tuple[int, ...]:
    """Numbers of each trait of one robot, in the order of `Traits`."""
    return (1, 1, 3, joints, joints, joints, joints, joints, 2, len(FLOORS))


def unpacked(row: Any) -> Traits:
    """The traits in the last axis of ``row [..., K]``, NumPy's or JAX's."""
    joints = (row.shape[-1] - sum(widths(0))) // 5
    ends = np.cumsum(widths(joints))
    return Traits(*(row[..., end - width : end] for width, end in zip(widths(joints), ends, strict=True)))


def gravity(slope: Any, xp: Any = jnp) -> Any:
    """Where gravity points above a floor of ``slope [..., 2]`` (rad), in axes whose z is normal to it, ``[..., 3]``."""
    downhill = -xp.concatenate([xp.sin(slope), xp.ones_like(slope[..., :1])], axis=-1)
    return downhill / xp.sqrt((downhill**2).sum(-1))[..., None]


@dataclasses.dataclass(frozen=True)
class Nominal:
    """The model's own numbers, of which traits change some; and where they stand."""

    fields: dict[str, np.ndarray]
    ground: np.ndarray  # [geoms] bool, soles and floor
    torso: np.ndarray  # [bodies] 1 for the torso
    carries: np.ndarray  # [bodies] 1 for the torso and every body that it hangs from
    gravity: float  # m/s²
    floors: np.ndarray  # [geoms, 2] 1 for the floor of the left and of the right foot; none on even ground

    @classmethod
    def of(cls, robot: Robot, model: mujoco.MjModel) -> "Nominal":
        """What `changed` needs of a robot's model.

        Raises:
          UserError: the robot names no torso.
        """
        torso = torso_body(robot) + 1
        geoms = [model.geom(i) for i in range(model.ngeom)]
        carries, body = np.zeros(model.nbody), torso
        while body:
            carries[body] = 1.0
            body = model.body_parentid[body]
        names = (
            "geom_pos geom_friction body_mass body_subtreemass body_inertia body_ipos actuator_gainprm "
            "actuator_biasprm actuator_forcerange jnt_actfrcrange dof_frictionloss dof_armature"
        )
        return cls(
            fields={name: getattr(model, name).copy() for name in names.split()},
            ground=np.array([geom.bodyid[0] == 0 or "_foot_" in geom.name for geom in geoms]),
            torso=np.arange(model.nbody) == torso,
            carries=carries,
            gravity=float(np.linalg.norm(model.opt.gravity)),
            floors=np.array([[geom.name == name for name in FLOORS] for geom in geoms], float),
        )

    @property
    def uneven(self) -> bool:
        """Whether the feet have floors of their own."""
        return bool(self.floors.any())


def torso_body(robot: Robot) -> int:
    """Index of the robot's torso.

    Raises:
      UserError: its robot.toml names none.
    """
    if "chest" not in robot.landmarks:
        raise UserError(
            f"robot {robot.name} has no chest among the [landmarks] of its robot.toml: expected the body whose mass a "
            "disturbance changes"
        )
    return robot.landmarks["chest"]


def changed(nominal: Nominal, traits: Traits, xp: Any = np) -> dict[str, Any]:
    """The model's fields with one robot's traits, each ``[...]`` as in `Traits` without N.

    The constants that MuJoCo derives from masses for the softness of constraints stay those of the model.
    """
    own, first = nominal.fields, np.arange(10) == 0
    root = np.ones(6)  # dofs of the root
    mass, torso = traits.torso_mass[0], nominal.torso
    factor = 1.0 + torso * mass / own["body_mass"][torso][0]
    kp = xp.where(first, traits.stiffness[:, None], 1.0)
    bias = xp.where(np.arange(10) == 1, traits.stiffness[:, None], 1.0)
    bias = bias * xp.where(np.arange(10) == 2, traits.damping[:, None], 1.0)
    joint_limits = xp.concatenate([np.ones(1), traits.strength])[:, None]
    sliding = nominal.ground[:, None] & (np.arange(3) == 0)
    raised = {}
    if nominal.uneven:
        height = xp.asarray(nominal.floors, traits.floors.dtype) @ traits.floors
        raised["geom_pos"] = own["geom_pos"] + height[:, None] * (np.arange(3) == 2)
    return raised | {
        "geom_friction": own["geom_friction"] * xp.where(sliding, traits.friction[0], 1.0),
        "body_mass": own["body_mass"] + torso * mass,
        "body_subtreemass": own["body_subtreemass"] + nominal.carries * mass,
        "body_inertia": own["body_inertia"] * factor[:, None],
        "body_ipos": own["body_ipos"] + torso[:, None] * traits.torso_center,
        "actuator_gainprm": own["actuator_gainprm"] * kp,
        "actuator_biasprm": own["actuator_biasprm"] * bias,
        "actuator_forcerange": own["actuator_forcerange"] * traits.strength[:, None],
        "jnt_actfrcrange": own["jnt_actfrcrange"] * joint_limits,
        "dof_frictionloss": xp.concatenate([0.0 * root, traits.joint_friction]),
        "dof_armature": own["dof_armature"] * xp.concatenate([root, traits.armature]),
        "opt.gravity": nominal.gravity * gravity(traits.slope, xp),
    }
