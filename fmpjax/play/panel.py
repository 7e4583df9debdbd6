"""The controls of a page: what people see of a session, and may do to it."""

from collections.abc import Callable, Sequence

import numpy as np
import viser

from fmpjax.play.loader import Loader
from fmpjax.play.session import SLOWEST, Session
from fmpjax.play.source import Source
from fmpjax.play.view import View

AXES = ("ahead, m/s", "to the left, m/s", "turning left, rad/s")
LEAST_SPAN = 0.1  # m/s, rad/s of a command that is worth a slider; less is the noise of the demonstrations
MEAN = 50  # steps over which the speed in the status is a mean, about a stride
STEP = 0.1  # of a key, m/s and rad/s
DIRECTIONS = {"forward": (1, 0), "backward": (-1, 0), "left": (0, 1), "right": (0, -1)}
IMPULSE, MOST_IMPULSE = 15.0, 60.0  # N s
# Axis and sign of the command that a key changes.
KEYS = {"W": (0, 1), "S": (0, -1), "A": (2, 1), "D": (2, -1), "Q": (1, 1), "E": (1, -1)}
ARROWS = {"arrowup": "forward", "arrowdown": "backward", "arrowleft": "left", "arrowright": "right"}
KEY_HELP = {0: "**W S** speed", 2: "**A D** turn", 1: "**Q E** sideways"}
# viser moves the camera by these keys, too: its listener is at the document, that of the hotkeys at the element below.
# A script runs in a page of viser where an image fails to load.
_KEEP_CAMERA = """<img src="data:," style="display: none" onerror="
window.fmpjaxKeys ||= document.documentElement.addEventListener('keydown', event => {
  if (/^(Key[WASDQE]|Arrow)/.test(event.code)) event.stopPropagation();
}) || true">"""
HELP = "**arrows** push, **P** pause, **R** reset. Drag the robot with the mouse."


class Panel:
    """The controls. All clients of a page share them."""

    def __init__(
        self, server: viser.ViserServer, session: Session, sources: Sequence[Source], loader: Loader, view: View
    ):
        self._session, self._sources, self._loader, self._view = session, sources, loader, view
        self._gui = gui = server.gui
        self._status = gui.add_markdown("")
        self._time()
        self._sliders: dict[int, viser.GuiInputHandle[float]] = {}
        if session.commands is not None:
            with gui.add_folder("Command"):
                self._command(session.commands)
        with gui.add_folder("Push"):
            self._impulse = gui.add_slider("impulse, N s", 1.0, MOST_IMPULSE, 1.0, IMPULSE)
            buttons = gui.add_button_group("push", tuple(DIRECTIONS))
            buttons.on_click(lambda event: self._push(event.target.value))
        with gui.add_folder("Policy"):
            self._policies = [self._policy(i, source) for i, source in enumerate(sources)]
        with gui.add_folder("View"):
            self._looks()
        told = [KEY_HELP[axis] for axis in KEY_HELP if axis in self._sliders]
        gui.add_markdown(", ".join([*told, *(["**X** stand"] if told else []), HELP]))
        self._keys()

    def update(self) -> None:
        """Show what has changed, and what checkpoints there are now."""
        session, parts = self._session, []
        for player, name, said in zip(session.players, self._loader.names, self._loader.said, strict=True):
            falls = f"{player.falls} fall{'' if player.falls == 1 else 's'}"
            lying = ", lies" if player.lies else ""
            ahead = np.mean([row.velocity[0] for row in list(player.rows)[-MEAN:]]) if player.rows else 0.0
            parts.append(f"**{player.label}** {name}, {ahead:.2f} m/s, {falls}{lying}" + (f": {said}" if said else ""))
        worst = f", by {1e3 * session.worst:.0f} ms at most" if session.late else ""
        clock = f"{session.time:.1f} s · {1 / session.dt:.0f} Hz, {session.late} of {session.steps} steps late{worst}"
        self._set(self._status, "content", "  \n".join([*parts, clock]))
        for handle, source, name in zip(self._policies, self._sources, self._loader.names, strict=True):
            names = source.names()
            options = tuple(names if name in names else [name, *names])
            if options != tuple(handle.options):
                handle.options = options

    def _set(self, handle, name: str, value) -> None:
        """Set what differs; each setting is a message to every client."""
        if getattr(handle, name) != value:
            setattr(handle, name, value)

    def _time(self) -> None:
        session, gui = self._session, self._gui
        self._pause = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._pause.on_click(lambda _: self._toggle())
        gui.add_button("Reset", icon=viser.Icon.REFRESH).on_click(lambda _: session.reset())
        pace = gui.add_slider("pace, of real time", SLOWEST, 1.0, 0.05, 1.0)
        pace.on_update(lambda _: session.slow(pace.value))

    def _toggle(self) -> None:
        self._session.pause(not self._session.paused)
        self._pause.label = "Go on" if self._session.paused else "Pause"
        self._pause.icon = viser.Icon.PLAYER_PLAY if self._session.paused else viser.Icon.PLAYER_PAUSE

    def _command(self, span: np.ndarray) -> None:
        for axis, label in enumerate(AXES):
            low, high = span[:, axis].round(2)
            if high - low < LEAST_SPAN:
                continue
            slider = self._gui.add_slider(label, float(low), float(high), 0.01, 0.0)
            slider.on_update(lambda event, axis=axis: self._slide(axis, event))
            self._sliders[axis] = slider
        self._gui.add_button("Stand", icon=viser.Icon.HAND_STOP).on_click(lambda _: self._stand())

    def _tell(self, axis: int, value: float, *, more: bool = False) -> None:
        """Command ``value`` along an axis, or ``more`` by it than now."""
        # Each key comes in a thread of its own, of which none may be lost. The slider is set without the session's
        # lock: the loop of the page takes viser's before it.
        with self._session.frozen():
            command = self._session.command.copy()
            command[axis] = command[axis] + value if more else value
            told = self._session.tell(command)
        if axis in self._sliders:
            self._set(self._sliders[axis], "value", round(float(told[axis]), 3))

    def _slide(self, axis: int, event: viser.GuiEvent) -> None:
        if event.client is not None:  # keys move the slider, too, and may be ahead of what it says
            self._tell(axis, event.target.value)

    def _stand(self) -> None:
        for axis in self._sliders:
            self._tell(axis, 0.0)

    def _push(self, direction: str) -> None:
        if direction in DIRECTIONS:  # a page may send any text
            self._session.push(self._impulse.value * np.array(DIRECTIONS[direction], float))

    def _policy(self, i: int, source: Source) -> viser.GuiDropdownHandle:
        label = self._session.players[i].label if len(self._sources) > 1 else "checkpoint"
        handle = self._gui.add_dropdown(label, tuple(source.names()), initial_value=self._loader.names[i])

        @handle.on_update
        def _(_) -> None:
            # Also called where the list itself has changed.
            if handle.value != self._loader.names[i] and handle.value in source.names():
                self._loader.ask(i, handle.value)

        return handle

    def _looks(self) -> None:
        gui, session, view = self._gui, self._session, self._view
        if any(player.clips for player in session.players):
            ghost = gui.add_checkbox("demonstration", True, hint="the blue ghost")
            ghost.on_update(lambda _: view.ghosts(ghost.value))
        stand_up = gui.add_checkbox("stand up after a fall", session.stand_up)
        stand_up.on_update(lambda _: setattr(session, "stand_up", bool(stand_up.value)))
        labels = [player.label for player in session.players]
        follow = gui.add_dropdown("follow", (*labels, "nobody"))
        chosen: dict[str, int | None] = {label: i for i, label in enumerate(labels)} | {"nobody": None}
        follow.on_update(lambda _: setattr(view, "watched", chosen.get(follow.value, view.watched)))

    def _keys(self) -> None:
        self._gui.add_html(_KEEP_CAMERA)

        def add(label: str, key, act: Callable[[], None]) -> None:
            self._gui.add_command(label, hotkey=key).on_trigger(lambda _: act())

        if self._sliders:
            for key, (axis, sign) in KEYS.items():
                if axis in self._sliders:
                    label = f"{'More' if sign > 0 else 'Less'} {AXES[axis]}"
                    add(label, key, lambda a=axis, s=sign: self._tell(a, s * STEP, more=True))
            add("Stand", "X", self._stand)
        for key, direction in ARROWS.items():
            add(f"Push {direction}", key, lambda direction=direction: self._push(direction))
        add("Pause or go on", "P", self._toggle)
        add("Reset", "R", self._session.reset)
