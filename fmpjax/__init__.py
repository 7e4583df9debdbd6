"""Flow-Matched Motion Priors for humanoid imitation, end to end in JAX.

The names in ``__all__`` are public, and docs/api.md describes them. Everything else is private and may change in any
version. ``import fmpjax`` is cheap: a name's module is imported when the name is first used.
"""

import importlib
from typing import TYPE_CHECKING

from fmpjax import machine

__version__ = "0.2.0"

__all__ = [
    "Config",
    "Env",
    "Run",
    "UserError",
    "fit_score",
    "load_motion",
    "load_policy",
    "load_robot",
    "preset",
    "train",
]

machine.import_mujoco()

if TYPE_CHECKING:
    from fmpjax.api import train
    from fmpjax.config import Config, preset
    from fmpjax.env import Env
    from fmpjax.errors import UserError
    from fmpjax.motion import load as load_motion
    from fmpjax.policy import load as load_policy
    from fmpjax.robots import load as load_robot
    from fmpjax.runs import Run
    from fmpjax.transport import fit_score
else:
    # Where each public name comes from.
    _HOMES = {
        "Config": "fmpjax.config",
        "Env": "fmpjax.env",
        "Run": "fmpjax.runs",
        "UserError": "fmpjax.errors",
        "fit_score": "fmpjax.transport",
        "load_motion": "fmpjax.motion",
        "load_policy": "fmpjax.policy",
        "load_robot": "fmpjax.robots",
        "preset": "fmpjax.config",
        "train": "fmpjax.api",
    }

    def __getattr__(name):
        """A public name, imported when it is first used."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        home = importlib.import_module(_HOMES[name])
        value = getattr(home, "load" if name.startswith("load_") else name)
        globals()[name] = value
        return value


def __dir__():
    return sorted({*globals(), *__all__})
