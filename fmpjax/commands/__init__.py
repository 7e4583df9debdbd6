"""What a policy is told while it acts: nothing, a velocity, a time in the clip or one of several motions.

A command lives in the state of each environment. What a step earns by it joins the prior's reward (`combine`).
"""

import jax

from fmpjax.commands import phase, velocity, which
from fmpjax.commands.base import Command
from fmpjax.config import CommandConfig, Config
from fmpjax.motion import MotionLibrary
from fmpjax.robots import Robot

__all__ = ["Command", "combine", "make", "phase", "velocity", "which"]


def make(config: Config, robot: Robot, library: MotionLibrary, frames: jax.Array) -> Command | None:
    """The command that a configuration asks for; None for none.

    Args:
      config: of the run.
      robot: that is told.
      library: the demonstrations, at the rate of their table's rows.
      frames: ``[M + 1, F]`` compact frames of the table's rows, the default pose's last.

    Raises:
      UserError: the demonstrations do not suit the command.
    """
    kind = config.command.kind
    if kind == "velocity":
        return velocity.make(config.command, config.control_rate, robot, library)
    if kind == "phase":
        return phase.make(robot, library, frames, config.env.demonstration_parts)
    if kind == "motion":
        return which.make(config.command, config.control_rate, robot, library, frames)
    return None


def combine(config: CommandConfig, prior: jax.Array, command: jax.Array) -> jax.Array:
    """The reward of steps whose motion earns ``prior`` and whose obedience earns ``command``, of the same shape."""
    if config.combine == "prior":
        return prior
    if config.combine == "command":
        return command
    return prior * command if config.combine == "product" else prior + config.weight * command
