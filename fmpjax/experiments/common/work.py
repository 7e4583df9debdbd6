"""What the process of a cell does: train its run, or continue it, measure it, unless another process does so.

The module imports no JAX, so that the process is on its cores before XLA counts them.
"""

import contextlib
import dataclasses
import importlib
import os
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
from filelock import FileLock, Timeout

from fmpjax.errors import UserError
from fmpjax.logs import MetricsLog

RUN = "RUN"  # in a measurement's arguments, the cell's folder
CHECKPOINTS = ("checkpoints", "best")  # folders of a run's


class Measure(NamedTuple):
    """A command that measures a trained cell by its checkpoints."""

    file: str  # that it writes into the cell's folder
    arguments: tuple[str, ...]  # of `fmpjax`; the cell's folder takes the place of RUN


@dataclasses.dataclass(frozen=True)
class Task:
    """Cells that one process trains: one, or the consecutive seeds of a group at once.

    submitit pickles it, calls it on a node of the cluster, and calls `checkpoint` where its time there is up.
    """

    folder: str  # of all cells
    cells: tuple[str, ...]  # their names, which are their run folders
    iterations: int  # of each cell's budget
    arguments: tuple[str, ...]  # of `fmpjax train`, but for the run's folder
    measures: tuple[Measure, ...] = ()  # of each cell, once it is trained
    keep: bool = True  # the checkpoints of a cell that is trained and measured
    cores: tuple[int, ...] = ()  # to run on; none for all

    @property
    def log(self) -> Path:
        return Path(self.folder) / f"{self.cells[0]}.log"

    def __call__(self) -> None:
        """`run`, in a process of its own, all of whose output goes into the log."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("a") as log:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
                os.dup2(log.fileno(), stream.fileno())
        self.run()

    @property
    def folders(self) -> list[Path]:
        """The cells' run folders."""
        return [Path(self.folder) / name for name in self.cells]

    def trained(self) -> bool:
        """Whether all cells have spent their budget and been evaluated."""
        return all(ended(folder, self.iterations) for folder in self.folders)

    def done(self) -> bool:
        """Whether nothing is left to do; what was dropped with the checkpoints cannot be measured any more."""
        return self.trained() and not any(self._missing(folder) or self._spare(folder) for folder in self.folders)

    def run(self) -> None:
        """Train the cells to their end, where they are not there yet, and measure them.

        Raises:
          UserError: another process has one of the cells, or had some of them.
          ChildProcessError: the training or a measurement failed, or was stopped; the log says why.
        """
        with contextlib.ExitStack() as locks:
            for name in self.cells:
                path = Path(self.folder) / f"{name}.lock"
                path.parent.mkdir(parents=True, exist_ok=True)
                try:
                    locks.enter_context(FileLock(path).acquire(timeout=0))
                except Timeout:
                    raise UserError(f"cell {name} is being run by another process: wait for its end") from None
            if self.cores:
                os.sched_setaffinity(0, self.cores)
            if not self.trained():
                self._train()
            for folder in self.folders:
                for measure in self._missing(folder):
                    self._command(str(folder) if part == RUN else part for part in measure.arguments)
                if left := self._missing(folder):
                    raise ChildProcessError(f"{folder} has no {left[0].file}: see {self.log}")
                if self._spare(folder):
                    for name in CHECKPOINTS:
                        shutil.rmtree(folder / name, ignore_errors=True)

    def checkpoint(self) -> Any:
        """For submitit: the same task again, which continues from the run's checkpoint."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)

    def _missing(self, folder: Path) -> list[Measure]:
        """The measurements that a cell has yet to have."""
        if not _restorable(folder):
            return []
        return [measure for measure in self.measures if not (folder / measure.file).exists()]

    def _spare(self, folder: Path) -> bool:
        """Whether a cell has checkpoints that are not to be kept."""
        return not self.keep and _restorable(folder)

    def _command(self, arguments: Iterable[str]) -> None:
        """Run `fmpjax`, as one would at a terminal; how it ends is in the log."""
        arguments = list(arguments)
        sys.argv = ["fmpjax", *arguments]  # what the run's provenance names
        with contextlib.suppress(SystemExit):
            importlib.import_module("fmpjax.cli").main(arguments)  # by its name: commands are above studies

    def _train(self) -> None:
        folders = self.folders
        begun = all((folder / "config.json").exists() for folder in folders)
        if not begun:
            if any(iterations(folder) for folder in folders if (folder / "config.json").exists()):
                raise UserError(
                    f"cells {', '.join(self.cells)} are at different iterations, because another command trained "
                    "some of them: start the command again"
                )
            # A process that was killed while it made the folders left no more than a beginning in them.
            for folder in folders:
                shutil.rmtree(folder, ignore_errors=True)
        where = ["--run", str(folders[0])]
        if len(folders) > 1:
            where = ["--run", str(folders[0].parent), "--seeds", str(len(folders))]
        self._command([*self.arguments, *where, *(["--resume"] if begun else [])])
        if not self.trained():
            raise ChildProcessError(f"{self.cells[0]} did not come to its end: see {self.log}")


def _restorable(run: Path) -> bool:
    """Whether a run has its checkpoints."""
    return any((run / name).exists() for name in CHECKPOINTS)


def iterations(run: Path) -> int:
    """Iterations of a run so far."""
    rows = MetricsLog.read(run / "metrics.csv")
    return int(rows[-1]["iteration"]) if rows else 0


def ended(run: Path, budget: int) -> bool:
    """Whether a run has spent its budget of iterations and been evaluated."""
    return (run / "evaluation.json").exists() and iterations(run) >= budget


def main(text: str) -> None:
    """Entry point of a process on this machine: a task as JSON."""
    msgspec.json.decode(text, type=Task)()


if __name__ == "__main__":
    try:
        main(sys.argv[1])
    except (UserError, ChildProcessError) as error:
        sys.exit(f"fmpjax: {error}")
