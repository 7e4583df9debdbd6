"""Flow-Matched Motion Priors for humanoid imitation, end to end in JAX."""

__version__ = "0.1.0"

from fmpjax import machine

machine.import_mujoco()

from fmpjax.robots import load as load_robot  # noqa: E402 - after MuJoCo

__all__ = ["load_robot"]
