"""Physics backends behind one protocol."""

import jax

from fmpjax.config import PhysicsConfig
from fmpjax.errors import UserError
from fmpjax.physics.base import Physics, PhysicsState, reset
from fmpjax.physics.traits import Traits
from fmpjax.robots import Robot


def make(robot: Robot, config: PhysicsConfig, *, joint_friction: bool = False) -> Physics:
    """The backend that the configuration names; ``auto`` is MJX where JAX sees an accelerator, else MuJoCo C.

    With ``joint_friction`` traits may give the joints dry friction where the model has none.

    Raises:
      UserError: joint friction is asked of MJX.
    """
    backend = config.backend
    if backend == "auto":
        backend = "native" if jax.default_backend() == "cpu" else "mjx"
    # Imported here: MJX takes seconds to import and a CPU run does without it.
    if backend == "mjx":
        from fmpjax.physics.mjx import MjxPhysics

        if joint_friction:  # with it MJX was seen to leave MuJoCo C by a tenth of a radian in one control step
            raise UserError("disturbance.joint_friction needs physics.backend=native: MJX gives other results")
        return MjxPhysics(robot, config)
    from fmpjax.physics.native import NativePhysics

    return NativePhysics(robot, config)


__all__ = ["Physics", "PhysicsState", "Traits", "make", "reset"]
