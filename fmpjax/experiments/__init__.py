"""Studies of priors and runs, one module per table or figure; `common` holds what they share, `report` gathers them."""

import importlib
from typing import Any

from fmpjax.errors import UserError

# What `fmpjax experiment --help` shows of each study without importing it: the first sentence of its own help.
STUDIES = {
    "ablate": "Run the matched comparison, and continue it when it is started again.",
    "barycenter": "Measure what the barycentric baseline's first targets keep of the motion.",
    "benchmark": "Run the benchmark of all methods, and continue it when it is started again.",
    "curvature": "Compare the score and the barycentric reward halfway between two atoms.",
    "generalization": "Fit FMP, Endpoint and Value to a standing policy's windows, and measure them beyond these.",
    "ranking": "Rank the demonstration and spoiled copies of it under a fitted or a learned reward.",
    "standing": "Measure why a policy stands before it walks.",
    "static_teacher": "Fit FMP with dynamic and with static path supervision, and compare them.",
}


def load(name: str) -> Any:
    """The command line of a study, for `shell.parse`: a function, or a group of commands.

    Raises:
      UserError: there is no such study.
    """
    if name not in STUDIES:
        raise UserError(f"unknown experiment {name!r}: expected one of {', '.join(STUDIES)}")
    module = importlib.import_module(f"fmpjax.experiments.{name}")
    return getattr(module, "COMMANDS", None) or module.main
