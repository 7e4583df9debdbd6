"""Physics backends behind one protocol."""

import jax

from fmpjax.config import PhysicsConfig
from fmpjax.errors import UserError
from fmpjax.physics.base import Physics, PhysicsState, reset
from fmpjax.physics.traits import Traits
from fmpjax.robots import Robot


def make(robot: Robot, config: PhysicsConfig, *, joint_friction: bool = False, uneven: bool = False) -> Physics:
    """The backend that the configuration names; ``auto`` is MJX where JAX sees an accelerator, else MuJoCo C.

    With ``joint_friction`` traits may give the joints dry friction where the model has none; on ``uneven`` ground the
    floors of the feet have heights, which traits say.

    Raises:
      UserError: joint friction is asked of MJX in JAX, or the robot's world cannot be uneven.
    """
    backend = config.backend
    if backend == "auto":
        backend = "native" if jax.default_backend() == "cpu" else "mjx"
    # Imported here: MJX takes seconds to import and a CPU run does without it.
    if backend == "mjx":
        from fmpjax.physics.mjx import MjxPhysics

        if joint_friction and config.impl == "jax":  # it was seen to leave MuJoCo C by 0.1 rad in one control step
            raise UserError(
                "disturbance.joint_friction needs physics.backend=native or physics.impl=warp: MJX in JAX gives other "
                "results"
            )
        return MjxPhysics(robot, config, uneven=uneven)
    from fmpjax.physics.native import NativePhysics

    return NativePhysics(robot, config, uneven=uneven)


__all__ = ["Physics", "PhysicsState", "Traits", "make", "reset"]
