"""MuJoCo C on every core, called from inside the scanned loop.

On a CPU this is an order of magnitude faster than MJX. The callback is pure: the next state depends on its arguments
alone.
"""

import threading

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

from fmpjax import machine
from fmpjax.config import PhysicsConfig
from fmpjax.physics.base import PhysicsState
from fmpjax.robots import Robot


class NativePhysics:
    """MuJoCo's threaded rollout behind `jax.pure_callback`."""

    name = "native"

    def __init__(self, robot: Robot, config: PhysicsConfig):
        self.model = model(robot, config)
        self.substeps = config.substeps
        self.threads = config.threads or machine.cores()
        self._pool = mujoco.rollout.Rollout(nthread=self.threads)
        self._data = [mujoco.MjData(self.model) for _ in range(self.threads)]
        self._turn = threading.Lock()  # several devices call back at once; the threads serve one after another

    def step(self, state: PhysicsState, targets: jax.Array) -> PhysicsState:
        # One array each way: every array that crosses to the host costs tens of microseconds.
        packed = jnp.concatenate([*state, targets.astype(state.qpos.dtype)], axis=-1)
        nq, nv = self.model.nq, self.model.nv
        shape = jax.ShapeDtypeStruct((*packed.shape[:-1], nq + 2 * nv), packed.dtype)
        reached = jax.pure_callback(self._advance, shape, packed, vmap_method="broadcast_all")
        return PhysicsState(*jnp.split(reached, (nq, nq + nv), axis=-1))

    def _advance(self, packed) -> np.ndarray:
        """Rows ``qpos, qvel, warmstart`` after a control step from rows ``qpos, qvel, warmstart, targets``.

        Batches of batches, as `jax.vmap` makes them, are advanced at once.
        """
        packed = np.asarray(packed)
        batch = packed.shape[:-1]
        packed = packed.reshape(-1, packed.shape[-1])
        count, nq, nv = len(packed), self.model.nq, self.model.nv
        shape = (count, self.substeps, 1 + nq + nv)
        # MuJoCo's full physics state begins with the time, which nothing here depends on.
        initial = np.zeros((count, 1 + nq + nv))
        initial[:, 1:] = packed[:, : nq + nv]
        control = np.repeat(packed[:, None, nq + 2 * nv :].astype(np.float64), self.substeps, axis=1)
        with self._turn:
            states, _ = self._pool.rollout(
                [self.model] * count,
                self._data,
                initial,
                control,
                initial_warmstart=packed[:, nq + nv : nq + 2 * nv].astype(np.float64),
                nstep=self.substeps,
                state=np.empty(shape),
                sensordata=np.empty((count, self.substeps, self.model.nsensordata)),
                skip_checks=True,
            )
        before = states[:, -2] if self.substeps > 1 else initial
        reached = np.empty((count, nq + 2 * nv), packed.dtype)
        reached[:, : nq + nv] = states[:, -1, 1:]
        # The rollout does not return its solver's last acceleration; the last velocity step stands in.
        reached[:, nq + nv :] = (states[:, -1, 1 + nq :] - before[:, 1 + nq :]) / self.model.opt.timestep
        return reached.reshape(*batch, -1)


def model(robot: Robot, config: PhysicsConfig, **numerics: float) -> mujoco.MjModel:
    """The robot's model with the run's solver options, and custom numbers that a backend reads."""
    built = robot.physics_model(
        numerics=numerics,
        timestep=config.timestep,
        iterations=config.iterations,
        ls_iterations=config.ls_iterations,
        frictionloss=config.frictionloss,
    )
    # A state that blows up must show as not finite, so that the environment can count it, not be reset in silence.
    built.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return built
