"""A run's metrics: rows of a CSV file, TensorBoard scalars, and a line for people."""

import csv
import math
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensorboardX import SummaryWriter

from fmpjax.errors import UserError

_FIRST = ("iteration", "transitions", "seconds")


class MetricsLog:
    """``metrics.csv`` and ``tensorboard/`` of a run folder; a resumed run continues at its checkpoint.

    With ``keep=False`` nothing is written: another process does.
    """

    def __init__(self, run: Path, columns: list[str], iteration: int = 0, *, keep: bool = True):
        self._keep = keep
        self._path = run / "metrics.csv"
        self._columns = [*_FIRST, *columns]
        rows = self.read(self._path) if iteration else []
        # Columns that only an earlier version wrote stay.
        self._columns += [name for name in (rows[0] if rows else ()) if name not in self._columns]
        self.rows = [row for row in rows if int(row["iteration"]) <= iteration]
        if not keep:
            return
        # Rows beyond the checkpoint are computed again, so the file is cut back to it, by way of a new file.
        partial = self._path.with_suffix(".partial")
        with partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._columns, extrasaction="ignore", restval="")
            writer.writeheader()
            writer.writerows(self.rows)
        os.replace(partial, self._path)
        # TensorBoard drops what it holds from this step on; steps are transitions there.
        seen = int(self.rows[-1]["transitions"]) + 1 if self.rows else None
        self._board = SummaryWriter(str(run / "tensorboard"), purge_step=seen)

    @property
    def seconds(self) -> float:
        """Training time behind the last row, s."""
        return float(self.rows[-1]["seconds"]) if self.rows else 0.0

    def write(self, iteration: int, transitions: int | None, seconds: float, values: Mapping[str, float]) -> None:
        """One row; what is missing or not a number stays empty.

        Without transitions, where no environment steps, TensorBoard's steps are iterations.
        """
        row: dict[str, Any] = {"iteration": iteration, "seconds": f"{seconds:.2f}"}
        row |= {} if transitions is None else {"transitions": transitions}
        row |= {k: f"{v:.6g}" for k, v in values.items() if not math.isnan(v)}
        self.rows.append(row)
        if not self._keep:
            return
        with self._path.open("a", newline="") as file:
            csv.DictWriter(file, self._columns, extrasaction="ignore", restval="").writerow(row)
        for name, value in values.items():
            if not math.isnan(value):
                self._board.add_scalar(name, value, iteration if transitions is None else transitions)
        self._board.flush()

    def close(self) -> None:
        if self._keep:
            self._board.close()

    @staticmethod
    def read(path: Path) -> list[dict[str, str]]:
        """Rows of a metrics file; an incomplete last line is left out."""
        if not path.exists():
            return []
        try:
            with path.open(newline="") as file:
                return [row for row in csv.DictReader(file) if None not in row.values() and set(_FIRST) <= set(row)]
        except (UnicodeDecodeError, csv.Error):
            raise UserError(f"{path} cannot be read: expected the table that training writes") from None


class Progress:
    """One line that follows a run: rewritten on a terminal, printed now and then into a file."""

    def __init__(self, interval: float = 15.0, *, show: bool = True):
        self._terminal, self._shown = sys.stdout.isatty(), show
        self._interval, self._last = interval, -math.inf

    def note(self, text: str) -> None:
        """A line that stays."""
        if self._shown:
            print(("\r\033[K" if self._terminal else "") + text, flush=True)

    def show(self, text: str, *, final: bool = False) -> None:
        """The progress line."""
        now = time.monotonic()
        if not self._shown:
            return
        if self._terminal:
            print("\r\033[K" + text, end="\n" if final else "", flush=True)
        elif final or now - self._last >= self._interval:
            print(text, flush=True)
            self._last = now


def clock(seconds: float) -> str:
    """``h:mm:ss`` or ``m:ss``."""
    minutes, s = divmod(int(max(seconds, 0)), 60)
    hours, m = divmod(minutes, 60)
    return f"{hours}:{m:02d}:{s:02d}" if hours else f"{m}:{s:02d}"
