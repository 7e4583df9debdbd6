"""Steering by the keys of a window and by a gamepad."""

from collections.abc import Callable
from typing import Any

import glfw
import numpy as np

from fmpjax.errors import UserError
from fmpjax.play.session import DEFAULT_COMMANDS, Session

STEP = 0.1  # of a key, m/s and rad/s
IMPULSE = 15.0  # N s, of a push
DEAD = 0.1  # of a stick's way: what is less is none
# Letters are keys of MuJoCo's viewer. Axis and sign of the command that a key changes:
KEYS = {
    glfw.KEY_UP: (0, 1),
    glfw.KEY_DOWN: (0, -1),
    glfw.KEY_LEFT: (2, 1),
    glfw.KEY_RIGHT: (2, -1),
    glfw.KEY_PAGE_UP: (1, 1),
    glfw.KEY_PAGE_DOWN: (1, -1),
}
# Direction of the push of a key of the number pad, forward and to the left.
PUSHES = {glfw.KEY_KP_8: (1, 0), glfw.KEY_KP_2: (-1, 0), glfw.KEY_KP_4: (0, 1), glfw.KEY_KP_6: (0, -1)}
HELP = (
    "arrows: speed and turn; page up and down: sideways; end: stand; number pad 8 2 4 6: push; "
    "space: pause; enter: reset; Ctrl and the right mouse button: pull"
)


class Keyboard:
    """What the keys of a window do to a session."""

    def __init__(self, session: Session):
        self._session = session

    def __call__(self, key: int) -> None:
        """A key was pressed."""
        session = self._session
        if key in KEYS:
            axis, sign = KEYS[key]
            with session.frozen():
                command = session.command.copy()
                command[axis] += sign * STEP
                session.tell(command)
        elif key in PUSHES:
            session.push(IMPULSE * np.array(PUSHES[key], float))
        elif key == glfw.KEY_END:
            session.tell(np.zeros(3))
        elif key == glfw.KEY_SPACE:
            session.pause(not session.paused)
        elif key == glfw.KEY_ENTER:
            session.reset()


class Gamepad:
    """The first gamepad: the left stick walks, the right one turns, A resets, B pushes from the left."""

    def __init__(self, session: Session, read: Callable[[], Any] | None = None):
        """A gamepad that is connected.

        Args:
          session: what it steers.
          read: gives GLFW's state of it, None where it is gone; the first gamepad of this machine by default.

        Raises:
          UserError: there is none.
        """
        self._session, self._held = session, frozenset[int]()
        self._read = _first_gamepad() if read is None else read

    def poll(self) -> None:
        """Do what the sticks and buttons say. A gamepad that is gone lets the robot stand."""
        state, session = self._read(), self._session
        if state is None:
            session.tell(np.zeros(3))
            return
        sticks = np.array(
            [
                -state.axes[glfw.GAMEPAD_AXIS_LEFT_Y],
                -state.axes[glfw.GAMEPAD_AXIS_LEFT_X],
                -state.axes[glfw.GAMEPAD_AXIS_RIGHT_X],
            ]
        )
        low, high = DEFAULT_COMMANDS if session.commands is None else session.commands
        sticks = np.where(np.abs(sticks) < DEAD, 0.0, sticks)
        session.tell(np.where(sticks > 0, sticks * high, -sticks * low))
        buttons = (glfw.GAMEPAD_BUTTON_A, glfw.GAMEPAD_BUTTON_B)
        held = frozenset(button for button in buttons if state.buttons[button])
        if glfw.GAMEPAD_BUTTON_A in held - self._held:
            session.reset()
        if glfw.GAMEPAD_BUTTON_B in held - self._held:
            session.push(IMPULSE * np.array([0.0, -1.0]))
        self._held = held


def _first_gamepad() -> Callable[[], Any]:
    found = [pad for pad in range(glfw.JOYSTICK_LAST + 1) if glfw.init() and glfw.joystick_is_gamepad(pad)]
    if not found:
        raise UserError("--gamepad finds no gamepad: connect one that GLFW knows")
    return lambda: glfw.get_gamepad_state(found[0])
