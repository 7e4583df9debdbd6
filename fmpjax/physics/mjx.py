"""MJX: the physics on the device, for accelerators."""

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from fmpjax.config import PhysicsConfig
from fmpjax.errors import UserError
from fmpjax.physics.base import PhysicsState
from fmpjax.physics.native import model
from fmpjax.robots import Robot


class MjxPhysics:
    """MJX in JAX (``impl="jax"``) or in Warp (``impl="warp"``, NVIDIA only, not deterministic)."""

    name = "mjx"

    def __init__(self, robot: Robot, config: PhysicsConfig):
        self.config = config
        self.model = model(robot, config)
        if jax.default_backend() == "cpu":
            # Measured on two cores: the dense Jacobian is seventy times slower there.
            self.model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
        if config.impl == "warp" and jax.default_backend() != "gpu":
            raise UserError("physics.impl is 'warp': expected an NVIDIA device, found " + jax.default_backend())
        self._overflow = 0  # bits of Warp's word on a world that lost contacts or constraints to a full buffer
        try:
            if config.impl == "warp":
                from mujoco.mjx.third_party.mujoco_warp._src.types import OverflowType as Lost

                self._overflow = int(Lost.NEFC | Lost.NJMAX_NNZ | Lost.BROADPHASE | Lost.NARROWPHASE)
            self._model = mjx.put_model(self.model, impl=config.impl)
            self._data(1)
        except (ImportError, RuntimeError) as error:
            if config.impl != "warp":
                raise
            raise UserError(
                f"physics.impl is 'warp', which this installation lacks ({error}): install fmpjax[warp]"
            ) from None

    def _data(self, count: int) -> mjx.Data:
        """State of one world; Warp's contact buffer is shared by all ``count`` of them."""
        config, buffers = self.config, {}
        if config.impl == "warp":
            buffers = {"naconmax": count * config.max_contacts, "njmax": config.max_constraints}
        return mjx.make_data(self.model, impl=config.impl, **buffers)

    def step(self, state: PhysicsState, targets: jax.Array) -> PhysicsState:
        template = self._data(len(state.qpos))

        def one(qpos, qvel, warmstart, target):
            data = template.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, ctrl=target)
            data, _ = jax.lax.scan(
                lambda d, _: (mjx.step(self._model, d), None), data, None, length=self.config.substeps
            )
            reached = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)
            # A template's flags are clear, and steps add to them.
            return spoil(reached, data._impl.overflow, self._overflow) if self._overflow else reached

        # TF32 in the constraint solver lets contacts sink.
        with jax.default_matmul_precision("highest"):
            return jax.vmap(one)(*state, jnp.asarray(targets, state.qpos.dtype))


def spoil(state: PhysicsState, flags: jax.Array, bits: int) -> PhysicsState:
    """The state of one world, not finite where its flags have one of the bits: so it is reset, and counted."""
    return jax.tree.map(lambda x: jnp.where(jnp.any(flags & bits), jnp.nan, x), state)
