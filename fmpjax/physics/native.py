"""MuJoCo C on every core, called from inside the scanned loop.

On a CPU this is an order of magnitude faster than MJX. The function is pure: the next state depends on its argument
alone.
"""

import copy
import functools
import hashlib
import operator
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
from fmpjax.physics.traits import Nominal, Traits, changed, unpacked
from fmpjax.robots import FLOORS, Robot

# The backend that serves a name; XLA keeps its address for good, so those of the same name share its threads.
_FIRST: dict[str, "NativePhysics"] = {}
# Models of robots with traits that are kept at least, a tenth of a megabyte each.
_KEPT = 1024


class NativePhysics:
    """MuJoCo's threaded rollout as a foreign function of XLA; behind `jax.pure_callback` beside an accelerator."""

    name = "native"

    def __init__(self, robot: Robot, config: PhysicsConfig, *, uneven: bool = False):
        self.uneven = uneven
        self.robot, self.model = robot, _without_warmstart(model(robot, config, uneven=uneven))
        if uneven:  # MuJoCo's tree of boxes has the floors where they were compiled
            self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        self.substeps = config.substeps
        self.threads = config.threads or machine.cores()
        # All that a step depends on is in the name, by which a program that was kept finds it.
        image = np.empty(mujoco.mj_sizeModel(self.model), np.uint8)
        mujoco.mj_saveModel(self.model, None, image)
        told = f"{config.substeps} {config.threads} {robot.landmarks.get('chest')}".encode() + image.tobytes()
        self._function = f"fmpjax_native_{hashlib.sha256(told).hexdigest()[:16]}"
        self._first = _FIRST.setdefault(self._function, self)
        if self._first is not self:
            return
        self._pool = mujoco.rollout.Rollout(nthread=self.threads)
        self._data = [mujoco.MjData(self.model) for _ in range(self.threads)]
        self._turn = threading.Lock()  # several devices call back at once; the threads serve one after another
        self._models: dict[tuple[int, bytes], mujoco.MjModel] = {}  # by their traits
        ffi.register(self._function, self._advance)

    def step(self, state: PhysicsState, targets: jax.Array, traits: Traits | None = None) -> PhysicsState:
        # One array each way: every array that crosses to the host costs tens of microseconds.
        dtype = state.qpos.dtype
        name, advance = self._function, self._first._advance
        parts = [state.qpos, state.qvel, targets.astype(dtype)]
        if targets.ndim == 3 or traits is not None:
            sequence = targets.shape[-2] if targets.ndim == 3 else 1
            known = 0 if traits is None else traits.packed.shape[-1]
            parts[-1] = parts[-1].reshape(len(targets), -1)
            parts += [] if traits is None else [traits.packed.astype(dtype)]
            name = f"{name}_{sequence}_{known}"
            advance = functools.partial(advance, sequence=sequence, traits=known)
            ffi.register(name, advance)
        packed = jnp.concatenate(parts, axis=-1)
        nq, nv = self.model.nq, self.model.nv
        if jax.default_backend() == "cpu":
            reached = ffi.call(name, packed, nq + nv)
        else:
            shape = jax.ShapeDtypeStruct((*packed.shape[:-1], nq + nv), packed.dtype)
            called = functools.partial(_called, advance, nq + nv)
            reached = jax.pure_callback(called, shape, packed, vmap_method="broadcast_all")
        return PhysicsState(*jnp.split(reached, (nq,), axis=-1), state.warmstart)

    def _advance(self, packed: np.ndarray, reached: np.ndarray, *, sequence: int = 1, traits: int = 0) -> None:
        """Fill rows ``qpos, qvel`` after a control step of rows ``qpos, qvel, targets, traits``.

        Batches of batches, as `jax.vmap` makes them, are advanced at once. A row has targets of ``sequence`` physics
        steps, one for all of them or as many as there are, and ``traits`` numbers of traits.
        """
        packed, reached = (x.reshape(-1, x.shape[-1]) for x in (packed, reached))
        count, nq, nv = len(packed), self.model.nq, self.model.nv
        # MuJoCo's full physics state begins with the time, which nothing here depends on.
        initial = np.zeros((count, 1 + nq + nv))
        initial[:, 1:] = packed[:, : nq + nv]
        targets = packed[:, nq + nv : packed.shape[1] - traits].reshape(count, sequence, -1)
        control = np.repeat(targets.astype(np.float64), self.substeps // sequence, axis=1)
        with self._turn:
            models = self._with_traits(packed[:, packed.shape[1] - traits :]) if traits else [self.model] * count
            states, _ = self._pool.rollout(
                models,
                self._data,
                initial,
                control,
                nstep=self.substeps,
                state=np.empty((count, self.substeps, 1 + nq + nv)),
                sensordata=np.empty((count, self.substeps, self.model.nsensordata)),
                skip_checks=True,
            )
        reached[:] = states[:, -1, 1:]

    def _with_traits(self, rows: np.ndarray) -> list[mujoco.MjModel]:
        """A model for each row of traits; models are kept, since all traits but the floors stay for a whole run."""
        # Where floors change, each row has a model of its own, in which they are set again for each step.
        keys = [(i if self.uneven else 0, row[: -len(FLOORS)].tobytes()) for i, row in enumerate(rows)]
        if len(self._models) > max(_KEPT, 2 * len(rows) * jax.local_device_count()):
            self._models.clear()
        for key, row in zip(keys, rows, strict=True):
            if key not in self._models:
                self._models[key] = self._model_of(unpacked(row.astype(np.float64)))
        models = [self._models[key] for key in keys]
        if self.uneven:
            heights = self._nominal.fields["geom_pos"][:, 2] + rows[:, -len(FLOORS) :] @ self._nominal.floors.T
            for built, height in zip(models, heights, strict=True):
                built.geom_pos[:, 2] = height
        return models

    def _model_of(self, traits: Traits) -> mujoco.MjModel:
        built = copy.copy(self.model)
        for name, value in changed(self._nominal, traits).items():
            operator.attrgetter(name)(built)[:] = value
        # The torso's center of mass may no longer be where MuJoCo's shortcuts for it hold.
        built.body_sameframe[self._nominal.torso] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        return built

    @functools.cached_property
    def _nominal(self) -> Nominal:
        return Nominal.of(self.robot, self.model)


def _called(advance, width: int, packed) -> np.ndarray:
    packed = np.asarray(packed)
    reached = np.empty((*packed.shape[:-1], width), packed.dtype)
    advance(packed, reached)
    return reached


def _without_warmstart(built: mujoco.MjModel) -> mujoco.MjModel:
    """The model whose solver starts each step from the accelerations without constraints, with a sparse Jacobian.

    Newton's method converges in the same few iterations from there, and more often to the last digit; choosing between
    two starts, the islands and a dense Jacobian of 35 columns cost a sixth of a step's time.
    """
    built.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    built.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART | mujoco.mjtDisableBit.mjDSBL_ISLAND
    return built


def model(robot: Robot, config: PhysicsConfig, *, uneven: bool = False, **numerics: float) -> mujoco.MjModel:
    """The robot's model with the run's solver options, and custom numbers that a backend reads."""
    built = robot.physics_model(
        numerics=numerics,
        uneven=uneven,
        timestep=config.timestep,
        iterations=config.iterations,
        ls_iterations=config.ls_iterations,
        frictionloss=config.frictionloss,
    )
    # A state that blows up must show as not finite, so that the environment can count it, not be reset in silence.
    built.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return built
