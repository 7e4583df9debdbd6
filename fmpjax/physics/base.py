"""What a physics backend offers: one control step for a batch of robots on a floor."""

from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp

from fmpjax.physics.traits import Traits


class PhysicsState(NamedTuple):
    """Physical state of N robots; a backend needs nothing else to continue."""

    qpos: jax.Array  # [N, 7 + J] root xyz m, root quaternion wxyz, joints rad
    qvel: jax.Array  # [N, 6 + J] root velocity (world) m/s, angular velocity (body) rad/s, joints rad/s
    warmstart: jax.Array  # [N, 6 + J] accelerations from which MJX's constraint solver starts; unused by MuJoCo C


class Physics(Protocol):
    """A backend. Both entries are pure and jittable."""

    name: str

    def step(self, state: PhysicsState, targets: jax.Array, traits: Traits | None = None) -> PhysicsState:
        """Advance one control step with joint targets (rad) held by the servos.

        Args:
          state: of N robots.
          targets: ``[N, J]``, or ``[N, S, J]`` of each physics step.
          traits: in what the robots and their floors differ from the model.
        """
        ...


def reset(qpos: jax.Array, qvel: jax.Array) -> PhysicsState:
    """State at rest in the solver from positions and velocities."""
    return PhysicsState(qpos, qvel, jnp.zeros_like(qvel))
