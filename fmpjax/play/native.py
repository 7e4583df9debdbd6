"""A session in MuJoCo's own viewer, steered by its keys and by a gamepad."""

import time

import mujoco
import mujoco.viewer
import numpy as np

from fmpjax.play.devices import HELP, Gamepad, Keyboard
from fmpjax.play.player import Player
from fmpjax.play.session import Session
from fmpjax.play.source import Source
from fmpjax.sim2sim import Simulation

DISTANCE, ELEVATION = 3.0, -15.0  # m and deg, of the camera


def play(source: Source, *, gamepad: bool = False) -> None:
    """Show a source until the window is closed.

    Raises:
      UserError: the policy cannot be read, or there is no gamepad.
    """
    try:
        show(Session([source.player(source.load(source.first))]), gamepad=gamepad)
    finally:
        source.close()


def drive(simulation: Simulation, *, gamepad: bool = False) -> None:
    """Steer a simulation until the window is closed.

    Raises:
      UserError: there is no gamepad.
    """
    show(Session([Player(simulation.policy.robot, simulation)]), gamepad=gamepad)


def show(session: Session, *, gamepad: bool = False) -> None:
    """Show a session of one player until the window is closed."""
    simulation = session.players[0].simulation
    pad = Gamepad(session) if gamepad else None
    print(HELP, flush=True)
    with mujoco.viewer.launch_passive(simulation.model, simulation.data, key_callback=Keyboard(session)) as viewer:
        with viewer.lock():
            viewer.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
            viewer.cam.trackbodyid = simulation.root_body
            viewer.cam.distance, viewer.cam.elevation = DISTANCE, ELEVATION
            viewer.opt.geomgroup[3:] = 0
        told = None
        while viewer.is_running():
            due = time.perf_counter() + session.dt
            if pad is not None:
                pad.poll()
            if not session.paused:
                with viewer.lock():
                    session.tick()
            viewer.sync()
            if told is None or not np.array_equal(told, session.command):
                told = session.command.copy()
                print(f"\rcommand {told[0]:+.1f} m/s, {told[1]:+.1f} m/s, {told[2]:+.1f} rad/s ", end="", flush=True)
            time.sleep(max(0.0, due - time.perf_counter()))
    print()
