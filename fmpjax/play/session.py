"""Robots in real time: the clock of the simulation, and what people may do to it. No browser is known here."""

import threading
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager

import numpy as np

from fmpjax.errors import UserError
from fmpjax.play.player import Drag, Player
from fmpjax.sim2sim import ExportedPolicy

BEHIND = 0.25  # s by which the simulation may be behind before it lets that time go
DEFAULT_COMMANDS = np.array([[-0.5, -0.3, -0.8], [1.0, 0.3, 0.8]])  # of a policy that does not say what it may be told
SLOWEST = 0.05  # of real time


class Session:
    """Players under one clock and one command. Every method may be called from any thread."""

    def __init__(self, players: Sequence[Player]):
        """A session that has not begun.

        Raises:
          UserError: there is no player, or they act at different rates.
        """
        if not players:
            raise UserError("there is nothing to play: expected a run or a policy")
        rates = {round(1.0 / player.simulation.policy.step_dt, 6): player.label for player in players}
        if len(rates) > 1:
            (a, first), (b, second), *_ = rates.items()
            raise UserError(f"{first} acts at {a:g} Hz and {second} at {b:g} Hz: expected policies with the same rate")
        self.players = list(players)
        self.dt = players[0].simulation.policy.step_dt  # s, of control
        self.command = np.zeros(3)  # m/s forward and to the left, rad/s
        self.stand_up = True  # whether a robot that fell is put on its feet
        self.paused = False
        self.pace = 1.0  # of real time
        self.time = 0.0  # s that were simulated
        self.steps, self.late, self.worst = 0, 0, 0.0  # ticks of the clock, those that were late, s of the latest
        self._lock = threading.RLock()

    def frozen(self) -> AbstractContextManager:
        """Hold the simulation while several things are read or changed."""
        return self._lock

    @property
    def commands(self) -> np.ndarray | None:
        """Lowest and highest command, ``[2, 3]``; None where no policy takes commands."""
        spans = [
            DEFAULT_COMMANDS if player.simulation.policy.commands is None else player.simulation.policy.commands
            for player in self.players
            if player.steered
        ]
        if not spans:
            return None
        low, high = np.stack(spans, axis=1)
        return np.stack([low.min(0), high.max(0)])

    def tell(self, command: np.ndarray) -> np.ndarray:
        """Command the robots, within what they may be told; the command that is in force."""
        with self._lock:
            if (span := self.commands) is not None and np.isfinite(command).all():
                self.command = np.clip(np.asarray(command, float), *span)
            return self.command

    def push(self, impulse: np.ndarray, player: int | None = None) -> None:
        """Push one robot, or all, by ``impulse [2]`` (N s) forward and to the left."""
        with self._lock:
            for pushed in self.players if player is None else [self.players[player]]:
                pushed.push(np.asarray(impulse, float))

    def drag(self, player: int, drag: Drag | None) -> None:
        """Pull a robot at a point of a body, or let go of it."""
        with self._lock:
            self.players[player].drag = drag

    def reset(self) -> None:
        """Put all robots at their starts."""
        with self._lock:
            for player in self.players:
                player.restart(self.command)

    def pause(self, paused: bool) -> None:
        """Stop the time, or let it go on."""
        with self._lock:
            self.paused = bool(paused)

    def slow(self, pace: float) -> None:
        """Let the time go at ``pace`` of real time, at most 1."""
        with self._lock:
            self.pace = float(np.clip(pace, SLOWEST, 1.0))

    def use(self, player: int, policy: ExportedPolicy) -> None:
        """Continue with another policy of the same robot.

        Raises:
          UserError: it is of another robot, or acts at another rate.
        """
        now = self.players[player].simulation.policy
        if policy.joint_names != now.joint_names or policy.step_dt != now.step_dt:
            raise UserError(
                f"the policy moves {policy.robot} at {1 / policy.step_dt:g} Hz: expected one of {now.robot} "
                f"at {1 / now.step_dt:g} Hz"
            )
        with self._lock:
            self.players[player].use(policy)

    def tick(self) -> None:
        """One step of control of every robot."""
        with self._lock:
            self.time += self.dt
            for player in self.players:
                player.step(self.command, self.time, stand_up=self.stand_up)

    def run(self, stop: threading.Event) -> None:
        """Let the time go until ``stop``.

        A tick is late where it ends after the next one is due. A simulation that is too far behind does not run after
        the time that it lost.
        """
        due = time.perf_counter()
        while not stop.is_set():
            if self.paused:
                stop.wait(self.dt)
                due = time.perf_counter()
                continue
            self.tick()
            due += self.dt / self.pace
            behind = time.perf_counter() - due
            self.steps += 1
            if behind > 0:
                self.late, self.worst = self.late + 1, max(self.worst, behind)
            if behind > BEHIND:
                due += behind
            elif behind < 0:
                time.sleep(-behind)
