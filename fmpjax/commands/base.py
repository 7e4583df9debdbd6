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
    # (state, drawn) -> state, over [N] bool: after a control step, and whether the command ends the episode. Without
    # random numbers, where drawn is None, a command that is held is held on.
    advance: Callable[[Any, Any], tuple[Any, jax.Array]]
    observe: Callable[[Any], jax.Array]  # state -> [N, size]
    reward: Callable[[Any, jax.Array], jax.Array]  # (state in force, frame [N, F] reached) -> [N], in [0, 1]
