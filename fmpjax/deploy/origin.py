"""Where a policy comes from."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from fmpjax.config import Config


class Origin(NamedTuple):
    """Where a policy comes from."""

    run: str  # the run folder's name
    config: Config
    motions: tuple[tuple[str, float], ...]  # names and weights
    commit: str | None  # of the program that trained it
    evaluation: dict[str, Any] | None  # what evaluation.json says
    changed: bool = False  # whether the program had changes that the commit does not have
    # Of a policy that takes velocities as commands: low and high of lin_vel_x, lin_vel_y (m/s) and ang_vel_z (rad/s).
    commands: Mapping[str, tuple[float, float]] | None = None
    steering: dict[str, Any] | None = None  # what steering.json says
    robustness: dict[str, Any] | None = None  # what robustness.json says

    @property
    def version(self) -> str:
        """The commit, and whether the program had changes."""
        return (self.commit or "unknown") + (" with changes" if self.changed else "")
