"""The contract of a command: what the policy is told, and what a step earns by obeying."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax


class Command(NamedTuple):
    """A kind of command, as pure functions over ``N`` environments. Its ``state`` is a pytree of arrays ``[N, ...]``.

    The actor and the critic see the command. The motion prior never does.
    """

    size: int  # numbers that the networks see
    draw: Callable[[jax.Array, tuple[int, ...]], Any]  # (key, (N,)) -> drawn: random numbers of one step
    begin: Callable[[jax.Array, Any], Any]  # (rows [N], drawn) -> state, of episodes that begin at these table rows
    # (state, drawn, frame [N, F] reached) -> Told: after a control step. Without random numbers, where drawn is None, a
    # command that is held is held on.
    advance: Callable[[Any, Any, jax.Array], "Told"]
    observe: Callable[[Any], jax.Array]  # state -> [N, size]
    # state -> [N, R], what else the reward depends on; a deployable actor does not see it. None for nothing
    reveal: Callable[[Any], jax.Array] | None = None
    # state -> rows [N] of the table whose frames the next step should reach; None where the command names none
    wanted: Callable[[Any], jax.Array] | None = None
    # state -> [N] int32, index of the demonstration that the next step should be of; None where the command names none
    label: Callable[[Any], jax.Array] | None = None


class Told(NamedTuple):
    """What a control step makes of commands."""

    state: Any  # in force from here on
    over: jax.Array  # [N] bool, whether the command ends the episode, as a time-out
    reward: jax.Array  # [N] in [0, 1], what the step earned
