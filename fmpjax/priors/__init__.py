"""Motion priors by name. Adding a method is one file here and one line in the registry."""

from fmpjax.errors import UserError
from fmpjax.priors import flow
from fmpjax.priors.base import MotionPrior, Reward, Rollout, median_reward

_REGISTRY = {"fmp": flow.make}


def make(method: str, expert_bank, dimension, config) -> MotionPrior:
    """The prior called ``method``; see its module for the arguments.

    Raises:
      UserError: unknown method.
    """
    check(method)
    return _REGISTRY[method](expert_bank, dimension, config)


def check(method: str) -> None:
    """Raise a `UserError` unless ``method`` names a prior."""
    if method not in _REGISTRY:
        raise UserError(f"unknown method {method!r}: expected one of {', '.join(_REGISTRY)}")


__all__ = ["MotionPrior", "Reward", "Rollout", "check", "make", "median_reward"]
