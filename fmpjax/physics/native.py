"""MuJoCo C on every core, called from inside the scanned loop.

On a CPU this is an order of magnitude faster than MJX. The callback is pure: the next state depends on its arguments
alone.
"""

import os

import jax
import mujoco
import mujoco.rollout
import numpy as np

from fmpjax.config import PhysicsConfig
from fmpjax.physics.base import PhysicsState
from fmpjax.robots import Robot


class NativePhysics:
    """MuJoCo's threaded rollout behind `jax.pure_callback`."""

    name = "native"

    def __init__(self, robot: Robot, config: PhysicsConfig):
        self.model = model(robot, config)
        self.substeps = config.substeps
        self.threads = config.threads or len(os.sched_getaffinity(0))
        self._pool = mujoco.rollout.Rollout(nthread=self.threads)
        self._data = [mujoco.MjData(self.model) for _ in range(self.threads)]

    def step(self, state: PhysicsState, targets: jax.Array) -> PhysicsState:
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
        return jax.pure_callback(self._advance, shapes, state, targets, vmap_method="sequential")

    def _advance(self, state: PhysicsState, targets) -> PhysicsState:
        qpos, qvel, warmstart = (np.asarray(x, np.float64) for x in state)
        dtype, (count, nq) = np.asarray(state.qpos).dtype, qpos.shape
        # MuJoCo's full physics state begins with the time, which nothing here depends on.
        initial = np.concatenate([np.zeros((count, 1)), qpos, qvel], axis=1)
        control = np.broadcast_to(np.asarray(targets, np.float64)[:, None], (count, self.substeps, targets.shape[-1]))
        states, _ = self._pool.rollout(
            self.model, self._data, initial, np.ascontiguousarray(control), initial_warmstart=warmstart
        )
        velocity = states[:, -1, 1 + nq :]
        before = states[:, -2, 1 + nq :] if self.substeps > 1 else qvel
        return PhysicsState(
            states[:, -1, 1 : 1 + nq].astype(dtype),
            velocity.astype(dtype),
            # The rollout does not return its solver's last acceleration; the last velocity step stands in.
            ((velocity - before) / self.model.opt.timestep).astype(dtype),
        )


def model(robot: Robot, config: PhysicsConfig) -> mujoco.MjModel:
    """The robot's model with the run's solver options."""
    built = robot.physics_model(
        timestep=config.timestep,
        iterations=config.iterations,
        ls_iterations=config.ls_iterations,
        frictionloss=config.frictionloss,
    )
    # A state that blows up must show as not finite, so that the environment can count it, not be reset in silence.
    built.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return built
