"""Motion priors by name. Adding a method is one file here and one line in the registry, or a call of `register`."""

from collections.abc import Callable

import numpy as np

from fmpjax.config import FOLLOWERS, Config
from fmpjax.errors import UserError
from fmpjax.priors import add, amp, barycentric, empirical, flow, gail, labeled, pwil, smp, tracking, wail
from fmpjax.priors.base import Expert, MotionPrior, Pretraining, Reward, Rollout, couple, median_reward

_REGISTRY: dict[str, Callable[[Expert, Config], MotionPrior]] = {
    "fmp": flow.make,
    "endpoint": flow.make_endpoint,
    "value": flow.make_value,
    "bank16": empirical.make,
    "barycentric": barycentric.make,
    "amp": amp.make,
    "gail": gail.make,
    "wail": wail.make,
    "pwil": pwil.make,
    "smp": smp.make,
    "add": add.make,
    "tracking": tracking.make,
}
METHODS = tuple(_REGISTRY)
PAPER = ("fmp", "endpoint", "value", "bank16", "barycentric", "amp")  # those of the paper's Table I
_OWN_NORMALIZER = ("amp", "gail", "wail")
_REMEMBERS = ("pwil",)
_PRETRAINED = ("smp",)
_POTENTIALS = ("fmp", "endpoint", "value")


def make(method: str, expert: Expert, config: Config, label: np.ndarray | None = None) -> MotionPrior:
    """The prior called ``method``, with ``label [W]`` of the expert's windows one for each label.

    Raises:
      UserError: unknown method.
    """
    check(method)
    build = _REGISTRY[method]
    return build(expert, config) if label is None else labeled.make(lambda part: build(part, config), expert, label)


def register(method: str, make: Callable[[Expert, Config], MotionPrior]) -> None:
    """Add a method from outside of the package: ``make`` builds it, and ``method`` names it in a configuration.

    Raises:
      UserError: the name is taken.
    """
    if _REGISTRY.get(method, make) is not make:
        raise UserError(f"method {method!r} is registered already: expected a new name beside {', '.join(_REGISTRY)}")
    _REGISTRY[method] = make


def descriptions() -> dict[str, str]:
    """Methods and a line on each, the first of its ``make`` function's docstring."""
    return {name: (make.__doc__ or "").partition("\n")[0] for name, make in _REGISTRY.items()}


def normalizes(method: str) -> bool:
    """Whether the prior called ``method`` normalizes windows itself, and so takes them unclipped."""
    return method in _OWN_NORMALIZER


def remembers(method: str) -> bool:
    """Whether the reward of a window depends on what its episode did before, so that the critic needs a clock."""
    return method in _REMEMBERS


def follows(method: str) -> bool:
    """Whether the prior called ``method`` compares each step with the demonstration at the same time."""
    return method in FOLLOWERS


def check_pretrained(method: str) -> None:
    """Raise a `UserError` unless ``method`` learns something of the demonstration before any policy."""
    check(method)
    if method not in _PRETRAINED:
        raise UserError(f"method {method!r} has no pretraining: expected {', '.join(_PRETRAINED)}")


def check_potential(method: str) -> None:
    """Raise a `UserError` unless ``method`` fits a potential to transport."""
    if method not in _POTENTIALS:
        raise UserError(f"method is {method!r}: expected one that fits a potential, {', '.join(_POTENTIALS)}")


def check(method: str) -> None:
    """Raise a `UserError` unless ``method`` names a prior."""
    if method not in _REGISTRY:
        raise UserError(f"unknown method {method!r}: expected one of {', '.join(_REGISTRY)}")


__all__ = [
    "METHODS",
    "PAPER",
    "Expert",
    "MotionPrior",
    "Pretraining",
    "Reward",
    "Rollout",
    "check",
    "check_potential",
    "check_pretrained",
    "couple",
    "descriptions",
    "follows",
    "make",
    "median_reward",
    "normalizes",
    "register",
    "remembers",
]
