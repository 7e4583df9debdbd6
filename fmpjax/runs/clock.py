"""The clock of a training: its budget, its minutes, and when to evaluate, to save and to end."""

import enum
import time
from collections.abc import Callable
from typing import NamedTuple

from fmpjax.config import Config

SAVE_INTERVAL = 120.0  # s at most between checkpoints, except for the iterations in hand


class End(enum.Enum):
    """Why training ended; the run is saved in each case."""

    BUDGET = "the budget is spent"
    TIME = "time is up"
    SIGNAL = "stopped"


class Due(NamedTuple):
    """What is to be done after a call of the program."""

    evaluate: bool  # which is saved, too
    save: bool
    end: End | None  # None: continue


class Clock:
    """Counts a training's iterations and seconds, and decides what is due after each call of the program.

    It knows no arrays and no files.
    """

    def __init__(
        self,
        config: Config,
        *,
        done: int = 0,
        evaluated: int = 0,
        seconds: float = 0.0,
        minutes: float | None = None,
        began: float | None = None,
        spare: float = 0.0,
        agree: Callable[[bool], bool] = bool,
        now: Callable[[], float] = time.monotonic,
    ):
        """A clock that starts now.

        Args:
          config: of the run; its budget, chunks and evaluations.
          done: iterations so far.
          evaluated: the last iteration that was evaluated.
          seconds: training time so far, s.
          minutes: time that the training may take from ``began`` on; None for no limit.
          began: when the training began, by ``now``; None for now.
          spare: time to leave for the last evaluation and save until one was measured, s.
          agree: the first process's flag, on every process; clocks and signals differ between processes.
          now: the time, s.
        """
        self.config, self.done, self.seconds = config, done, seconds
        self._agree, self._now = agree, now
        self._limit = None if minutes is None else minutes * 60
        self._began = now() if began is None else began
        self._milestones = [max(1, round(share * config.iterations)) for share in config.evaluations]
        self._evaluated, self._spare = evaluated, spare
        self._took = 0.0  # s, the last call of the program
        self._saved = self._decided = now()

    @property
    def spent(self) -> bool:
        """Whether the budget is spent."""
        return self.done >= self.config.iterations

    @property
    def transitions(self) -> int:
        """Environment steps so far, of each run."""
        return self.done * self.config.transitions_per_iteration

    @property
    def rate(self) -> float:
        """Environment steps of each run per second, in the last call of the program."""
        return self.config.chunk * self.config.transitions_per_iteration / self._took

    @property
    def left(self) -> float:
        """Seconds to the end: of the budget, or of the minutes where these end first."""
        budget = (self.config.iterations - self.done) * self._took / self.config.chunk
        return budget if self._limit is None else min(budget, self._limit - (self._now() - self._began))

    def tick(self, done: int, took: float) -> None:
        """A call of the program led to iteration ``done`` and took so many seconds."""
        self.done, self._took = done, took
        self.seconds += took

    def due(self, *, asked: bool) -> Due:
        """What is to be done now; ``asked`` says whether the training was asked to stop.

        All processes call it at the same point, and it asks `agree` three times.
        """
        out_of_time = self._agree(self._out_of_time())
        asked = self._agree(asked)
        at_milestone = any(self.done >= m > self._evaluated for m in self._milestones)
        # A run that is asked to stop saves and no more, but its last iteration comes only once.
        evaluate = (at_milestone or out_of_time) and (not asked or self.spent)
        save = self._agree(evaluate or self._now() - self._saved > SAVE_INTERVAL)
        end = End.BUDGET if self.spent else End.SIGNAL if asked else End.TIME if out_of_time else None
        self._decided = self._now()
        return Due(evaluate, save, end)

    def did(self, due: Due) -> None:
        """What was due is done."""
        if due.save:
            self._saved = self._now()
        if due.evaluate:
            self._evaluated, self._spare = self.done, self._saved - self._decided

    def _out_of_time(self) -> bool:
        """Whether another call of the program, an evaluation and a save would pass the limit."""
        return self._limit is not None and self._now() - self._began + 1.5 * self._took + self._spare > self._limit
