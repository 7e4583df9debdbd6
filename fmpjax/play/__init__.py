"""Policies and motions live: in a page of the browser (viser), or in MuJoCo's own viewer. No JAX is imported here.

`session` is the clock of the simulation, `player` one robot in it, `source` and `reader` where its policies come from,
`loader` reads them meanwhile. `server`, `page`, `view`, `scene`, `panel` and `plots` are the page of a session,
`clip` that of a motion. `native` and `devices` are MuJoCo's viewer with keyboard and gamepad.
"""

import importlib.util
from collections.abc import Sequence

from fmpjax.errors import UserError
from fmpjax.motion import MotionClip
from fmpjax.play.session import Session
from fmpjax.play.source import Source
from fmpjax.play.source import of as source_of
from fmpjax.robots import Robot
from fmpjax.sim2sim import Simulation

__all__ = [
    "Session",
    "Source",
    "check_display",
    "check_installed",
    "serve",
    "serve_motion",
    "show",
    "source_of",
    "steer",
]


def check_installed(*, page: bool = True) -> None:
    """Refuse where the package viser, which a page needs, is missing.

    Raises:
      UserError: it is.
    """
    if page and importlib.util.find_spec("viser") is None:
        raise UserError("a page needs the package viser, which is not installed: install the extra fmpjax[play]")


def check_display(option: str) -> None:
    """Refuse where no window can be opened.

    Raises:
      UserError: none can.
    """
    from fmpjax.viz.clip import no_window

    if reason := no_window():
        raise UserError(f"{option} opens a window, and {reason}: without one, `fmpjax play` serves a page")


def serve(sources: Sequence[Source], *, host: str, port: int, parent: int | None = None) -> None:
    """Serve sources as a page until Ctrl-C, or until the process ``parent``, which started this one, has ended."""
    from fmpjax.play.page import play

    play(sources, host=host, port=port, parent=parent)


def show(source: Source, *, gamepad: bool = False) -> None:
    """Show a source in MuJoCo's viewer until its window is closed."""
    from fmpjax.play.native import play

    play(source, gamepad=gamepad)


def steer(simulation: Simulation, *, gamepad: bool = False) -> None:
    """Steer a simulation in MuJoCo's viewer, by its keys and by a gamepad, until its window is closed."""
    from fmpjax.play.native import drive

    drive(simulation, gamepad=gamepad)


def serve_motion(robot: Robot, shown: MotionClip, *, flips: int = 0, host: str, port: int) -> None:
    """Serve a motion as a page until Ctrl-C."""
    from fmpjax.play.clip import play

    play(robot, shown, flips=flips, host=host, port=port)
