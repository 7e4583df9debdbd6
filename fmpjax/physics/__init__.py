"""Physics backends behind one protocol."""

import jax

from fmpjax.config import PhysicsConfig
from fmpjax.physics.base import Physics, PhysicsState, reset
from fmpjax.robots import Robot


def make(robot: Robot, config: PhysicsConfig) -> Physics:
    """The backend that the configuration names; ``auto`` is MJX where JAX sees an accelerator, else MuJoCo C."""
    backend = config.backend
    if backend == "auto":
        backend = "native" if jax.default_backend() == "cpu" else "mjx"
    # Imported here: MJX takes seconds to import and a CPU run does without it.
    if backend == "mjx":
        from fmpjax.physics.mjx import MjxPhysics

        return MjxPhysics(robot, config)
    from fmpjax.physics.native import NativePhysics

    return NativePhysics(robot, config)


__all__ = ["Physics", "PhysicsState", "make", "reset"]
