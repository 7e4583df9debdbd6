"""A step of episodes under a policy that does not learn, as every evaluation plays them."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from fmpjax.acting import of_actor
from fmpjax.env import Env, EnvState
from fmpjax.trainer import Trainer


class Step(NamedTuple):
    """Where a control step has led ``N`` episodes."""

    now: EnvState  # of episodes that had ended before, as it was
    alive: jax.Array  # [N] bool, whether the episode continues
    fell: jax.Array  # [N] bool, whether it ended in this step by a fall
    action: jax.Array  # [N, J] normalized, taken
    earned: jax.Array | None  # [N] in [0, 1], the command's reward of the step; None without a command


def step(trainer: Trainer, env: Env, policy: Any, now: EnvState, alive: jax.Array, drawn: Any) -> Step:
    """Advance episodes by one control step.

    A command is held. The step on which a robot falls is part of its episode; after it nothing moves.

    Args:
      trainer: of the policy, whose precision counts.
      env: where the episodes are, the trainer's or another one of the same robot.
      policy: as `PPO.act` makes it, deterministic.
      now: the environments.
      alive: ``[N]`` bool, episodes that have not ended.
      drawn: random numbers of the disturbances, one step of `Env.disturbance_draws`.
    """
    now, seen = env.look(now, drawn)
    with trainer.precision():
        action, _ = policy.act(of_actor(seen), None)
    reached = env.advance(now.physics, action, now.disturbed, drawn)
    now, going_on, earned = now._replace(disturbed=reached.disturbed), alive & ~reached.fell, None
    if env.command:  # it stays what it was, and may end the episode
        command, over, earned = env.command.advance(now.command, None, reached.observed.frame)
        now, going_on = now._replace(command=command), going_on & ~over

    def hold(new, old):
        return jnp.where(alive.reshape(-1, *[1] * (new.ndim - 1)), new, old)

    physics, observed = jax.tree.map(hold, (reached.physics, reached.observed), (now.physics, now.observed))
    return Step(now._replace(physics=physics, observed=observed), going_on, alive & reached.fell, action, earned)
