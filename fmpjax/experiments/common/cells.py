"""Cells of an experiment: training runs that differ in what a specification names, each a run folder of its own.

Cells run as processes, several at once where asked, each on its share of the cores: two small runs on a core each are
faster than one after the other on both. A cell that was killed continues from its checkpoint, a finished one is left
alone, and one of another configuration is refused.
"""

import dataclasses
import itertools
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fmpjax import config as configuration
from fmpjax import priors
from fmpjax.config import Config
from fmpjax.errors import UserError
from fmpjax.logs import MetricsLog, Progress, clock

_POLL = 1.0  # s between looks at the running cells


@dataclasses.dataclass(frozen=True)
class Specification:
    """A plan: every method, by default of the paper, with every reset, variant and seed."""

    preset: str = "laptop"
    motion: str = "walk"
    frames: str = ""
    transitions: int = 0  # 0 for the preset's
    methods: tuple[str, ...] = priors.PAPER
    resets: tuple[str, ...] = ("dataset", "fixed")
    seeds: tuple[int, ...] = (0,)
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # section.field: value, of every cell
    variants: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)  # by name, of its cells


@dataclasses.dataclass(frozen=True)
class Cell:
    """One run of an experiment."""

    name: str  # METHOD-RESET[-VARIANT]/seedSEED, also its folder
    variant: str  # "" where the specification has none
    config: Config
    changes: Mapping[str, Any]  # by which the configuration departs from its preset

    @property
    def group(self) -> str:
        """What the cell shares with those that differ in nothing but the seed."""
        return self.name.partition("/")[0]

    @property
    def command(self) -> list[str]:
        """Arguments of ``fmpjax train``, without the run's folder."""
        settings = [f"--set={key}={_text(value)}" for key, value in self.changes.items()]
        return ["train", "--preset", self.config.preset, *settings]


def _text(value: Any) -> str:
    return ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)


def read_specification(path: Path) -> Specification:
    """The plan in a TOML file.

    Raises:
      UserError: the file cannot be read, or has an unknown key or a value of the wrong type.
    """
    try:
        with path.open("rb") as file:
            values = tomllib.load(file)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UserError(f"{path} is not valid TOML: {error}") from None
    known = {field.name: field for field in dataclasses.fields(Specification)}
    for key, value in values.items():
        if key not in known:
            raise UserError(f"{path}: unknown key {key!r}, expected one of {', '.join(known)}")
        _check(path, key, value)
    checked: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return Specification(**checked)


def _check(path: Path, key: str, value: Any) -> None:
    if key in ("methods", "resets"):
        good, expected = isinstance(value, list) and all(isinstance(v, str) for v in value), "a list of names"
    elif key == "seeds":
        good, expected = isinstance(value, list) and all(type(v) is int for v in value), "a list of whole numbers"
    elif key == "settings":
        good, expected = isinstance(value, dict), "a table of section.field = value"
    elif key == "variants":
        good = isinstance(value, dict) and all(isinstance(v, dict) for v in value.values())
        expected = "tables of section.field = value"
    elif key == "transitions":
        good, expected = type(value) is int and value >= 0, "a whole number"
    else:
        good, expected = isinstance(value, str), "a text"
    if not good or (isinstance(value, list) and not value):
        raise UserError(f"{path}: {key} is {value!r}, expected {expected}")


def plan(specification: Specification) -> list[Cell]:
    """The cells of a specification, seeds innermost.

    Raises:
      UserError: a name, setting or value that no configuration can have, or a cell twice, or none at all.
    """
    s = specification
    for method in s.methods:
        priors.check(method)
    cells = []
    variants = s.variants or {"": {}}
    for reset, method, variant, seed in itertools.product(s.resets, s.methods, variants, s.seeds):
        changes: dict[str, Any] = {"motion": s.motion, "method": method, "env.reset": reset, "seed": seed}
        changes |= {"frames": s.frames} if s.frames else {}
        changes |= {"transitions": s.transitions} if s.transitions else {}
        changes |= {**s.settings, **variants[variant]}
        group = "-".join(part for part in (method, reset, variant) if part)
        cells.append(Cell(f"{group}/seed{seed}", variant, configuration.preset(s.preset, **changes), changes))
    if not cells:
        raise UserError("the plan has no cells: expected a method, a reset and a seed at least")
    for name, count in Counter(cell.name for cell in cells).items():
        if count > 1:
            raise UserError(f"the plan names {name} {count} times: expected every method, reset and seed once")
    return cells


def finished(cell: Cell, folder: Path) -> bool:
    """Whether the run in ``folder`` has spent the cell's budget and been evaluated.

    Raises:
      UserError: the folder holds a run of another configuration.
    """
    from fmpjax import runs

    run = folder / cell.name
    if not (run / "config.json").exists():
        return False
    saved = configuration.flatten(runs.Run.open(run).config)
    for key, value in configuration.flatten(cell.config).items():
        if saved[key] != value:
            raise UserError(f"{run} holds a run with {key} {saved[key]!r}, not {value!r}: name another --out")
    return (run / "evaluation.json").exists() and _done(cell, folder) >= cell.config.iterations


def _done(cell: Cell, folder: Path) -> int:
    rows = MetricsLog.read(folder / cell.name / "metrics.csv")
    return int(rows[-1]["iteration"]) if rows else 0


def run(cells: Sequence[Cell], folder: Path, workers: int = 1, *, together: bool = False) -> None:
    """Run what is not finished yet, ``workers`` at once.

    Args:
      cells: of one plan.
      folder: where their run folders are.
      workers: processes at once, each on its share of the cores.
      together: train all seeds of a group in one process as one program, which pays on an accelerator.

    Raises:
      UserError: a folder holds another configuration (before anything runs), or cells failed (after all others ran).
    """
    todo = [cell for cell in cells if not finished(cell, folder)]
    progress = Progress(30.0)
    progress.note(f"{len(cells)} cells, {len(cells) - len(todo)} of them finished before")
    shares = _shares(workers)
    waiting = _jobs(todo, folder, together)
    running: dict[int, _Job] = {}
    failed: list[_Job] = []
    began, before = time.monotonic(), {cell.name: _done(cell, folder) for cell in todo}
    total = sum(cell.config.iterations - before[cell.name] for cell in todo)
    try:
        while waiting or running:
            for index in set(range(len(shares))) - set(running):
                if waiting:
                    running[index] = waiting.pop(0)
                    running[index].start(folder, shares[index])
                    progress.note(f"{running[index].name} begins, log in {running[index].log(folder)}")
            time.sleep(_POLL)
            for index, job in list(running.items()):
                if job.process is None or job.process.poll() is None:
                    continue
                del running[index]
                good = job.process.returncode == 0 and all(finished(cell, folder) for cell in job.cells)
                failed += [] if good else [job]
                progress.note(f"{job.name} {'is done' if good else 'FAILED'} after {clock(job.seconds)}")
            # Work is counted in iterations; the rate so far gives the time left.
            done = sum(_done(cell, folder) - before[cell.name] for cell in todo)
            left = clock((time.monotonic() - began) * (total - done) / done) if done > 0 else "unknown time"
            now = ", ".join(f"{job.name} {100 * job.share(folder):.0f} %" for job in running.values())
            progress.show(f"{sum(finished(c, folder) for c in todo)} of {len(todo)} done | {now} | {left} left")
    finally:
        begun = [job.process for job in running.values() if job.process]
        for process in begun:
            process.send_signal(signal.SIGTERM)
        for process in begun:
            process.wait()
    if failed:
        names = ", ".join(job.name for job in failed)
        raise UserError(f"{len(failed)} of the cells failed: see {failed[0].log(folder)} ({names})")


@dataclasses.dataclass
class _Job:
    """Cells of one process."""

    cells: list[Cell]
    process: subprocess.Popen | None = None
    began: float = 0.0

    @property
    def name(self) -> str:
        return self.cells[0].name if len(self.cells) == 1 else f"{self.cells[0].group} ({len(self.cells)} seeds)"

    @property
    def seconds(self) -> float:
        return time.monotonic() - self.began

    def share(self, folder: Path) -> float:
        """Share of the budget that is spent."""
        return sum(_done(cell, folder) for cell in self.cells) / sum(cell.config.iterations for cell in self.cells)

    def log(self, folder: Path) -> Path:
        return folder / f"{self.cells[0].name}.log"

    def start(self, folder: Path, cores: set[int]) -> None:
        """Begin, or continue where an earlier process was killed."""
        first = self.cells[0]
        begun = all((folder / cell.name / "config.json").exists() for cell in self.cells)
        if not begun:
            # A process that was killed while it made the folders left them behind: `_jobs` has seen that nothing more
            # than a beginning is in them.
            for cell in self.cells:
                shutil.rmtree(folder / cell.name, ignore_errors=True)
        if len(self.cells) == 1:
            where = ["--run", str(folder / first.name)]
        else:
            where = ["--run", str(folder / first.group), "--seeds", str(len(self.cells))]
        arguments = [*first.command, *where, *(["--resume"] if begun else [])]
        self.log(folder).parent.mkdir(parents=True, exist_ok=True)
        self.began = time.monotonic()
        with self.log(folder).open("a") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-c", _LAUNCH, ",".join(map(str, sorted(cores))), *arguments],
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # a Ctrl-C reaches the cells through us, once
            )


def _jobs(todo: Sequence[Cell], folder: Path, together: bool) -> list[_Job]:
    """Processes for the cells to do; together, consecutive seeds of a group that have got as far are one."""
    if not together:
        return [_Job([cell]) for cell in todo]
    jobs: list[_Job] = []
    for cell in sorted(todo, key=lambda cell: cell.config.seed):
        for job in jobs:
            last = job.cells[-1]
            follows = last.group == cell.group and cell.config.seed == last.config.seed + 1
            if follows and _done(last, folder) == _done(cell, folder):
                job.cells.append(cell)
                break
        else:
            jobs.append(_Job([cell]))
    return jobs


def _shares(workers: int) -> list[set[int]]:
    """Cores of each worker; workers beyond the cores share them."""
    if workers < 1:
        raise UserError(f"--workers is {workers}: expected at least 1")
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    if len(cores) < workers:
        return [set(cores)] * workers
    return [set(cores[i::workers]) for i in range(workers)]


# XLA counts its threads by the cores that a process may use, so they are set before it is imported.
_LAUNCH = """
import os, sys
cores = set(map(int, sys.argv[1].split(","))) if sys.argv[1] else set()
if cores:
    os.sched_setaffinity(0, cores)
del sys.argv[1]
from fmpjax.cli import main
main(sys.argv[1:])
"""
