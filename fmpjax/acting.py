"""How actions are chosen: the interface between the learner and the environment."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax


def _keep(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    return key


class Seen(NamedTuple):
    """What the networks observe where the critic sees more than the actor; elsewhere one array is for both."""

    actor: Any  # [..., O]
    critic: Any  # [..., C]


def of_actor(seen: Any) -> Any:
    """The actor's part of what is observed, or of what is kept for both networks."""
    return seen.actor if isinstance(seen, Seen) else seen


def of_critic(seen: Any) -> Any:
    """The critic's part."""
    return seen.critic if isinstance(seen, Seen) else seen


class ActionRule(NamedTuple):
    """A stochastic policy as the environment calls it.

    Its random numbers are separate, so that a rollout draws those of all its steps at once.

    ``act(observation [N, O], drawn) -> action [N, J], extras``: normalized actions and what to remember of them, each
    ``[N, ...]``. ``draw(key, (N,)) -> drawn``: the random numbers of one step; the key itself unless told otherwise.
    """

    act: Callable[[jax.Array, Any], tuple[jax.Array, dict[str, jax.Array]]]
    draw: Callable[[jax.Array, tuple[int, ...]], Any] = _keep

    def __call__(self, observation: jax.Array, key: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Draw and act: one step."""
        return self.act(observation, self.draw(key, observation.shape[:-1]))
