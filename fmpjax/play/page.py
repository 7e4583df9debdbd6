"""A session in a page: the server, the robots, the controls, and the loop that keeps the page up to date."""

import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable, Generator, Sequence

from fmpjax.play import server as serving
from fmpjax.play.loader import Loader, Scorer
from fmpjax.play.panel import Panel
from fmpjax.play.plots import Plots
from fmpjax.play.session import Session
from fmpjax.play.source import Source
from fmpjax.play.view import View

FRAME, CURVES, LOOK = 1 / 25, 0.25, 1.0  # s between two pictures, two drawings of the curves, two looks for checkpoints


class Page:
    """A session that people can open in a browser. It runs until `close`."""

    def __init__(self, sources: Sequence[Source], *, host: str = serving.HOST, port: int = serving.PORT):
        """Read the policies, open the page, let the time go.

        Raises:
          UserError: a policy cannot be read, or the page cannot be opened.
        """
        serving.free_port(host, port)  # to refuse it before the policies are read, which takes a while
        names = [source.first for source in sources]
        players = [source.player(source.load(name)) for source, name in zip(sources, names, strict=True)]
        for i, player in enumerate(players):
            if any(player.label == other.label for other in players[:i]):
                player.label += f" ({i + 1})"
        self.session = Session(players)
        self.server = serving.start("fmpjax", host, port)
        self.loader = Loader(self.session, sources, names)
        self.view = View(self.server, self.session)
        self.panel = Panel(self.server, self.session, sources, self.loader, self.view)
        scored = any(source.has_prior for source in sources)
        with serving.beside(self.server, "Curves"):
            self.plots = Plots(self.server.gui, self.session, scored=scored)
        self._scorer = Scorer(self.session, sources, self.plots.add_score) if scored else None
        self._stop = threading.Event()
        self._clock = threading.Thread(target=self.session.run, args=(self._stop,), daemon=True)
        self._clock.start()

    def show(self, until: Callable[[], bool] = lambda: False) -> None:
        """Keep the page up to date until Ctrl-C, or until ``until()``."""
        last = drawn = looked = time.perf_counter()
        while not until():
            now = time.perf_counter()
            with self.server.atomic():
                if self.server.get_clients():
                    self.view.update(now - last)
                    if now - drawn > CURVES:
                        drawn = now
                        self.plots.update()
                        self.panel.update()
                last = now
            if now - looked > LOOK:
                looked = now
                self.loader.look()
            time.sleep(max(0.0, FRAME - (time.perf_counter() - now)))

    def close(self) -> None:
        """Stop the time and close the page."""
        self._stop.set()
        self._clock.join()
        if self._scorer is not None:
            self._scorer.close()
        self.loader.close()
        self.server.stop()


def address(server: serving.Server) -> str:
    """Where to open a page."""
    host = server.get_host()
    return f"http://{'localhost' if host in ('127.0.0.1', '0.0.0.0') else host}:{server.get_port()}"


@contextlib.contextmanager
def quick_turns() -> Generator[None]:
    """Threads take turns more often: the server of the page must not keep the simulation waiting."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(5e-4)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


def play(
    sources: Sequence[Source], *, host: str = serving.HOST, port: int = serving.PORT, parent: int | None = None
) -> None:
    """Serve a page until Ctrl-C, or until the process ``parent``, which started this one, has ended.

    Raises:
      UserError: a policy cannot be read, or the page cannot be opened.
    """
    with quick_turns():
        try:
            page = Page(sources, host=host, port=port)
        except BaseException:
            for source in sources:
                source.close()
            raise
        print(f"open {address(page.server)} in a browser; Ctrl-C ends it", flush=True)
        try:
            page.show(until=lambda: parent is not None and os.getppid() != parent)
        except KeyboardInterrupt:
            print()
        finally:
            page.close()
