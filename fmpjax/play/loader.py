"""Policies that are read while the robots move on, and what the motion prior says of them."""

import queue
import threading
from collections.abc import Callable, Sequence

import numpy as np

from fmpjax.errors import UserError
from fmpjax.play.session import Session
from fmpjax.play.source import Source

SCORES = 0.2  # s between two scores of the motion prior


class Loader:
    """Reads policies in a separate thread, one after another."""

    def __init__(self, session: Session, sources: Sequence[Source], names: Sequence[str]):
        """A loader for players that have the policies of these names."""
        self._session, self._sources = session, sources
        self.names = list(names)  # what each player is to have
        self.said = [""] * len(sources)  # why a player has not got it, or that it is coming
        self._versions = [source.version(name) for source, name in zip(sources, names, strict=True)]
        self._asked: queue.SimpleQueue[int | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def ask(self, player: int, name: str) -> None:
        """Have a player use a policy of its source, soon. A name that the source does not have is refused in words."""
        self.names[player], self.said[player] = name, "loading ..."
        self._asked.put(player)

    def look(self) -> None:
        """Read again the names that now mean another policy: the best, the newest, the live one."""
        for player, (source, name) in enumerate(zip(self._sources, self.names, strict=True)):
            version = source.version(name)
            if version is not None and version != self._versions[player]:
                self._versions[player] = version
                self.ask(player, name)

    def close(self) -> None:
        """End the thread, and what the sources have open."""
        self._asked.put(None)
        for source in self._sources:
            source.close()

    def _work(self) -> None:
        while (player := self._asked.get()) is not None:
            name, source = self.names[player], self._sources[player]
            try:
                version = source.version(name)
                self._session.use(player, source.load(name))
                self._versions[player] = version
                told = ""
            except UserError as error:
                told = str(error)
            if self.names[player] == name:  # nobody asked for another one meanwhile
                self.said[player] = told


class Scorer:
    """Asks each source again and again what its motion prior says of the last moments of its player."""

    def __init__(
        self, session: Session, sources: Sequence[Source], told: Callable[[float, Sequence[float], float], None]
    ):
        """Start to ask; ``told(time, scores, demonstration)`` is called with the answers."""
        self._session, self._sources, self._told = session, sources, told
        self._stop = threading.Event()
        threading.Thread(target=self._work, daemon=True).start()

    def close(self) -> None:
        """Ask no more."""
        self._stop.set()

    def _work(self) -> None:
        while not self._stop.wait(SCORES):
            with self._session.frozen():
                time, paused = self._session.time, self._session.paused
                states = [list(player.states) for player in self._session.players]
            if paused:
                continue
            found = [
                source.score(*map(np.array, zip(*kept, strict=True))) if kept else None
                for source, kept in zip(self._sources, states, strict=True)
            ]
            if any(found) and not self._stop.is_set():
                scores = [np.nan if answer is None else answer[0] for answer in found]
                self._told(time, scores, next(answer[1] for answer in found if answer is not None))
