"""MJX: the physics on the device, for accelerators."""

import functools
from typing import NoReturn

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from fmpjax import machine
from fmpjax.config import PhysicsConfig
from fmpjax.errors import UserError
from fmpjax.physics import native
from fmpjax.physics.base import PhysicsState
from fmpjax.physics.traits import Nominal, Traits, changed, unpacked
from fmpjax.robots import Robot

machine.import_mjx()

from mujoco import mjx  # noqa: E402 - after it was imported without a word


class MjxPhysics:
    """MJX in JAX (``impl="jax"``) or in Warp (``impl="warp"``: for NVIDIA, where it is not deterministic)."""

    name = "mjx"

    def __init__(self, robot: Robot, config: PhysicsConfig, *, uneven: bool = False):
        self.robot, self.config, self.uneven = robot, config, uneven
        limits = {}
        if robot.self_collision and config.impl == "jax":
            # MJX in JAX works on every pair of geoms at every step: of a pair of shapes' kinds the nearest are kept.
            limits = {"max_geom_pairs": config.max_contacts, "max_contact_points": config.max_contacts}
        self.model = native.model(robot, config, uneven=uneven, **limits)
        self._device = jax.local_devices()[0]  # of several processes each has its own
        self._overflow = 0  # bits of Warp's word on worlds that lost contacts or constraints to a full buffer
        if config.impl == "warp":
            self._model = self._warp_model()
        else:
            if self._device.platform == "cpu":
                # Measured on two cores: the dense Jacobian is seventy times slower there.
                self.model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
            # Its line search takes every step it may, in every world: after six it stands where it does after twenty.
            self.model.opt.ls_iterations = min(config.ls_iterations, 6)
            # A tolerance made for float64 is never met in float32; Warp has the same floor.
            self.model.opt.tolerance = max(self.model.opt.tolerance, 1e-6)
            self._model = mjx.put_model(self.model, impl=config.impl, device=self._device)

        self._step = jax.custom_batching.custom_vmap(self._advance)

        @self._step.def_vmap
        def _(size, batched, *arguments):
            # Batches of batches, as seeds make them, are advanced at once: Warp's worlds share a contact buffer,
            # whose size must be that of them all.
            whole = [x if b else jnp.broadcast_to(x, (size, *x.shape)) for x, b in zip(arguments, batched, strict=True)]
            reached = self._step(*(x.reshape(-1, x.shape[-1]) for x in whole))
            return tuple(x.reshape(size, -1, x.shape[-1]) for x in reached), (True,) * len(reached)

    def _warp_model(self) -> mjx.Model:
        # Warp never resets a state that blows up, and refuses the flag that asks it not to.
        self.model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        try:
            from mujoco.mjx.third_party.mujoco_warp._src.types import OverflowType as Lost

            built = mjx.put_model(self.model, impl="warp", device=self._device)
        except NotImplementedError as error:
            _refuse(f"the robot's model uses a feature that Warp lacks ({error}): expected physics.impl 'jax'")
        except (ImportError, RuntimeError) as error:
            _refuse(f"it is not installed ({error}): install fmpjax[warp]")
        except AssertionError:
            _refuse(f"it runs on an NVIDIA device or a CPU, found {self._device.platform}: expected physics.impl 'jax'")
        self._overflow = int(Lost.NEFC | Lost.NJMAX_NNZ | Lost.BROADPHASE | Lost.NARROWPHASE)
        # By default a line is printed for every world whose solver takes all its iterations.
        return built.tree_replace({"opt._impl.warn_overflow": 0})

    def _data(self, count: int) -> mjx.Data:
        """State of one world; Warp's contact buffer is shared by all ``count`` of them."""
        config, buffers = self.config, {}
        if config.impl == "warp":
            buffers = {"naconmax": count * config.max_contacts, "njmax": config.max_constraints}
        return mjx.make_data(self.model, impl=config.impl, device=self._device, **buffers)

    def step(self, state: PhysicsState, targets: jax.Array, traits: Traits | None = None) -> PhysicsState:
        targets = jnp.asarray(targets, state.qpos.dtype).reshape(len(targets), -1)
        if traits is None:
            return PhysicsState(*self._step(*state, targets))
        return PhysicsState(*self._step(*state, targets, traits.packed.astype(state.qpos.dtype)))

    @functools.cached_property
    def _nominal(self) -> Nominal:
        return Nominal.of(self.robot, self.model)

    def _advance(self, *arguments: jax.Array) -> tuple[jax.Array, ...]:
        template = self._data(len(arguments[0]))

        def one(qpos, qvel, warmstart, targets, *traits):
            model, data = self._model, template.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
            if traits:
                fields = changed(self._nominal, unpacked(traits[0]), jnp)
                model = model.tree_replace({name: jnp.asarray(x, qpos.dtype) for name, x in fields.items()})
                if self.uneven:  # Warp places what is fixed to the world once, when it makes the data
                    floor = np.any(self._nominal.floors, axis=1, keepdims=True)
                    data = data.replace(geom_xpos=jnp.where(floor, model.geom_pos, data.geom_xpos))

            def step(data, targets):
                data = data.replace(ctrl=targets)
                own = _saturated(model, data) if self.config.impl == "jax" else model
                return mjx.step(own, data), None

            # Targets of one control step are held; those of each physics step are as many already.
            several = jnp.broadcast_to(targets.reshape(-1, self.model.nu), (self.config.substeps, self.model.nu))
            data, _ = jax.lax.scan(step, data, several)
            reached = data.qpos, data.qvel, data.qacc_warmstart
            if not self._overflow:
                return reached
            # A template's flags are clear, and steps add to them. What overflowed is reset, and counted.
            lost = jnp.any(data._impl.overflow & self._overflow)
            return tuple(jnp.where(lost, jnp.nan, x) for x in reached)

        # TF32 in the constraint solver lets contacts sink.
        with jax.default_matmul_precision("highest"):
            return jax.vmap(one)(*arguments)


def _saturated(model: mjx.Model, data: mjx.Data) -> mjx.Model:
    """The model with a constant force in place of each servo that is at its force limit.

    The implicit integrator then adds no damping for it, as in MuJoCo C and in Warp. MJX in JAX adds it all the same.
    """
    gain, bias, (low, high) = model.actuator_gainprm, model.actuator_biasprm, model.actuator_forcerange.T
    target = jnp.where(model.actuator_ctrllimited, jnp.clip(data.ctrl, *model.actuator_ctrlrange.T), data.ctrl)
    force = gain[:, 0] * target + bias[:, 0] + bias[:, 1] * data.qpos[7:] + bias[:, 2] * data.qvel[6:]
    full = (model.actuator_forcelimited & ((force <= low) | (force >= high)))[:, None]
    constant = jnp.zeros_like(bias).at[:, 0].set(jnp.clip(force, low, high))
    return model.tree_replace(
        {"actuator_gainprm": jnp.where(full, 0.0, gain), "actuator_biasprm": jnp.where(full, constant, bias)}
    )


def _refuse(why: str) -> NoReturn:
    raise UserError(f"physics.impl is 'warp': {why}") from None
