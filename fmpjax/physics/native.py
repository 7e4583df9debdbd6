"""MuJoCo C on every core, called from inside the scanned loop.

On a CPU this is an order of magnitude faster than MJX. The function is pure: the next state depends on its argument
alone.
"""

import hashlib
import threading

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

from fmpjax import machine
from fmpjax.config import PhysicsConfig
from fmpjax.physics import ffi
from fmpjax.physics.base import PhysicsState
from fmpjax.robots import Robot

# The backend that serves a name; XLA keeps its address for good, so those of the same name share its threads.
_FIRST: dict[str, "NativePhysics"] = {}


class NativePhysics:
    """MuJoCo's threaded rollout as a foreign function of XLA; behind `jax.pure_callback` beside an accelerator."""

    name = "native"

    def __init__(self, robot: Robot, config: PhysicsConfig):
        self.model = model(robot, config)
        self.substeps = config.substeps
        self.threads = config.threads or machine.cores()
        # All that a step depends on is in the name, by which a program that was kept finds it.
        image = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, image)
        told = f"{config.substeps} {config.threads}".encode() + image.tobytes()
        self._function = f"fmpjax_native_{hashlib.sha256(told).hexdigest()[:16]}"
        if (first := _FIRST.setdefault(self._function, self)) is not self:
            self._pool, self._data, self._turn = first._pool, first._data, first._turn
            return
        self._pool = mujoco.rollout.Rollout(nthread=self.threads)
        self._data = [mujoco.MjData(self.model) for _ in range(self.threads)]
        self._turn = threading.Lock()  # several devices call back at once; the threads serve one after another
        ffi.register(self._function, self._advance)

    def step(self, state: PhysicsState, targets: jax.Array) -> PhysicsState:
        # One array each way: every array that crosses to the host costs tens of microseconds.
        packed = jnp.concatenate([*state, targets.astype(state.qpos.dtype)], axis=-1)
        nq, nv = self.model.nq, self.model.nv
        if jax.default_backend() == "cpu":
            reached = ffi.call(self._function, packed, nq + 2 * nv)
        else:
            shape = jax.ShapeDtypeStruct((*packed.shape[:-1], nq + 2 * nv), packed.dtype)
            reached = jax.pure_callback(self._called, shape, packed, vmap_method="broadcast_all")
        return PhysicsState(*jnp.split(reached, (nq, nq + nv), axis=-1))

    def _called(self, packed) -> np.ndarray:
        packed = np.asarray(packed)
        reached = np.empty((*packed.shape[:-1], self.model.nq + 2 * self.model.nv), packed.dtype)
        self._advance(packed, reached)
        return reached

    def _advance(self, packed: np.ndarray, reached: np.ndarray) -> None:
        """Fill rows ``qpos, qvel, warmstart`` after a control step of rows ``qpos, qvel, warmstart, targets``.

        Batches of batches, as `jax.vmap` makes them, are advanced at once.
        """
        packed, reached = (x.reshape(-1, x.shape[-1]) for x in (packed, reached))
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
        reached[:, : nq + nv] = states[:, -1, 1:]
        # The rollout does not return its solver's last acceleration; the last velocity step stands in.
        reached[:, nq + nv :] = (states[:, -1, 1 + nq :] - before[:, 1 + nq :]) / self.model.opt.timestep


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
