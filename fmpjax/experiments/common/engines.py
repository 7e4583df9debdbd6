"""What runs the processes of cells: this machine, or a cluster by submitit."""

import abc
import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from fmpjax.errors import UserError
from fmpjax.experiments.common.work import Task

CLUSTERS = ("none", "local", "slurm")
_MINUTES = 12 * 60  # that a job asks for where no option says otherwise
_REQUEUES = 1000  # times that a job may run out of its minutes, and continue in further ones


class Engine(abc.ABC):
    """Runs tasks in places, one in each at a time; a place is a share of this machine's cores, or none of them.

    What runs a task is called a process, which on a cluster is a job.
    """

    def __init__(self, places: Sequence[set[int]]):
        self._places = places
        self._running: dict[int, tuple[Task, Any]] = {}

    def start(self, waiting: list[Task]) -> list[Task]:
        """Begin as many of the waiting tasks as there are free places, and take them off the list; those begun."""
        begun = []
        with self._batch():
            for index, cores in enumerate(self._places):
                if waiting and index not in self._running:
                    task = dataclasses.replace(waiting.pop(0), cores=tuple(sorted(cores)))
                    self._running[index] = task, self._begin(task)
                    begun.append(task)
        return begun

    def running(self) -> list[Task]:
        """Tasks that have begun and not ended."""
        return [task for task, _ in self._running.values()]

    def ended(self) -> list[Task]:
        """Tasks that have ended since the last call."""
        over = [index for index, (_, process) in self._running.items() if self._over(process)]
        return [self._running.pop(index)[0] for index in over]

    def stop(self) -> None:
        """End the running tasks, which save first where they can, and wait for them."""
        processes = [process for _, process in self._running.values()]
        for process in processes:
            self._end(process)
        for process in processes:
            self._wait(process)

    def _batch(self) -> contextlib.AbstractContextManager:
        return contextlib.nullcontext()

    @abc.abstractmethod
    def _begin(self, task: Task) -> Any: ...

    @abc.abstractmethod
    def _over(self, process: Any) -> bool: ...

    @abc.abstractmethod
    def _end(self, process: Any) -> None: ...

    @abc.abstractmethod
    def _wait(self, process: Any) -> None: ...


class Processes(Engine):
    """Processes of this machine, as many at once as there are workers, each on its share of the cores."""

    def __init__(self, workers: int):
        super().__init__(shares(workers))

    def _begin(self, task: Task) -> subprocess.Popen:
        task.log.parent.mkdir(parents=True, exist_ok=True)
        with task.log.open("a") as log:
            return subprocess.Popen(
                [sys.executable, "-m", "fmpjax.experiments.common.work", msgspec.json.encode(task)],
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # a Ctrl-C reaches the cells through us, once
            )

    def _over(self, process: subprocess.Popen) -> bool:
        return process.poll() is not None

    def _end(self, process: subprocess.Popen) -> None:
        process.send_signal(signal.SIGTERM)

    def _wait(self, process: subprocess.Popen) -> None:
        process.wait()


class Submitted(Engine):
    """Jobs of submitit: an array on SLURM, or, to try the same on one machine, processes that it starts.

    On SLURM all tasks are submitted at once, and the array lets as many run as there are workers. submitit's processes
    on one machine have neither such a limit nor cores of their own, so here they get both.
    """

    def __init__(self, cluster: str, workers: int, folder: Path, count: int, options: Sequence[str] = ()):
        """An engine for ``count`` tasks.

        Raises:
          UserError: submitit is not installed, there is no SLURM, or it has no such option.
        """
        try:
            import submitit
        except ImportError:
            raise UserError(
                f"--cluster {cluster} needs submitit, which is not installed: pip install 'fmpjax[benchmark]'"
            ) from None
        slurm, parsed, places = cluster == "slurm", _parsed(options), shares(workers)
        super().__init__([set()] * count if slurm else places)
        try:
            self._executor = submitit.AutoExecutor(folder / "jobs", cluster, slurm_max_num_timeout=_REQUEUES)
            self._executor.update_parameters(
                name="fmpjax", timeout_min=_MINUTES, slurm_array_parallelism=workers, **parsed
            )
        except (RuntimeError, ValueError, NameError, TypeError) as error:
            said = " ".join(str(error).split())[:200]
            asked = f" with --slurm {' '.join(options)}" if options else ""
            raise UserError(f"--cluster {cluster}{asked} cannot be used: {said}") from None
        self._slurm = slurm

    def _batch(self) -> contextlib.AbstractContextManager:
        return self._executor.batch() if self._slurm else contextlib.nullcontext()

    def _begin(self, task: Task) -> Any:
        return self._executor.submit(task)

    def _over(self, process: Any) -> bool:
        return process.done()

    def _end(self, process: Any) -> None:
        process.cancel(check=False)

    def _wait(self, process: Any) -> None:
        if not self._slurm:
            process.wait()


def make(cluster: str, workers: int, folder: Path, count: int, options: Sequence[str] = ()) -> Engine:
    """The engine that ``--cluster`` names.

    Args:
      cluster: ``none`` for this machine's processes, ``local`` for submitit's, ``slurm`` for an array.
      workers: tasks at once.
      folder: of the cells, below which a cluster's files are.
      count: of tasks.
      options: of SLURM, NAME=VALUE as submitit names them.

    Raises:
      UserError: there is no such cluster here, or an option is bad.
    """
    if cluster not in CLUSTERS:
        raise UserError(f"--cluster is {cluster!r}: expected one of {', '.join(CLUSTERS)}")
    if options and cluster != "slurm":
        raise UserError(f"--slurm {' '.join(options)} goes with --cluster slurm, not {cluster}")
    return Processes(workers) if cluster == "none" else Submitted(cluster, workers, folder, count, options)


def _parsed(options: Sequence[str]) -> dict[str, Any]:
    parsed: dict[str, Any] = {}
    for option in options:
        name, equals, value = option.partition("=")
        if not (name and equals and value):
            raise UserError(f"--slurm has {option!r}: expected NAME=VALUE, such as partition=gpu")
        parsed[f"slurm_{name}"] = int(value) if value.isdigit() else value
    return parsed


def shares(workers: int) -> list[set[int]]:
    """Cores of each worker; workers beyond the cores share them.

    Raises:
      UserError: there are no workers.
    """
    if workers < 1:
        raise UserError(f"--workers is {workers}: expected at least 1")
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if len(cores) < workers:
        return [set(cores)] * workers
    return [set(cores[i::workers]) for i in range(workers)]
