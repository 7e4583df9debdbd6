"""Cells of an experiment: training runs that differ in what a specification names, each a run folder of its own.

Cells run as processes, several at once where asked, each on its share of the cores: two small runs on a core each are
faster than one after the other on both. A cell that was killed goes on from its checkpoint, a finished one is left
alone, and one of another configuration is refused.
"""

import dataclasses
import itertools
import os
import signal
import subprocess
import sys
import time
import tomllib
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
    """A plan: every method with every reset, variant and seed."""

    preset: str = "laptop"
    motion: str = "walk"
    frames: str = ""
    transitions: int = 0  # 0 for the preset's
    methods: tuple[str, ...] = priors.METHODS
    resets: tuple[str, ...] = ("dataset", "fixed")
    seeds: tuple[int, ...] = (0,)
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # section.field: value, of every cell
    variants: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)  # by name, of its cells


@dataclasses.dataclass(frozen=True)
class Cell:
    """One run of an experiment."""

    name: str  # also its folder's
    variant: str  # "" where the specification has none
    config: Config
    changes: Mapping[str, Any]  # by which the configuration departs from its preset

    @property
    def command(self) -> list[str]:
        """Arguments of ``fmpjax train``, but for the run's folder."""
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
    return Specification(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


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
      UserError: a name, setting or value that no configuration can have.
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
        name = "-".join(part for part in (method, reset, variant, str(seed)) if part)
        cells.append(Cell(name, variant, configuration.preset(s.preset, **changes), changes))
    return cells


def finished(cell: Cell, folder: Path) -> bool:
    """Whether the run in ``folder`` has spent the cell's budget and been evaluated.

    Raises:
      UserError: the folder holds a run of another configuration.
    """
    run = folder / cell.name
    if not (run / "config.json").exists():
        return False
    saved = configuration.flatten(configuration.from_json((run / "config.json").read_text()))
    for key, value in configuration.flatten(cell.config).items():
        if saved[key] != value:
            raise UserError(f"{run} holds a run with {key} {saved[key]!r}, not {value!r}: name another --out")
    return (run / "evaluation.json").exists() and _done(cell, folder) >= cell.config.iterations


def _done(cell: Cell, folder: Path) -> int:
    rows = MetricsLog.read(folder / cell.name / "metrics.csv")
    return int(rows[-1]["iteration"]) if rows else 0


def run(cells: Sequence[Cell], folder: Path, workers: int = 1) -> None:
    """Run what is not finished yet, ``workers`` at once.

    Raises:
      UserError: a folder holds another configuration (before anything runs), or cells failed (after all others ran).
    """
    todo = [cell for cell in cells if not finished(cell, folder)]
    progress = Progress(30.0)
    progress.note(f"{len(cells)} cells, {len(cells) - len(todo)} of them finished before")
    if not todo:
        return
    folder.mkdir(parents=True, exist_ok=True)
    shares = _shares(workers)
    waiting, running, failed = list(todo), {}, []
    began, spent = time.monotonic(), []
    # Work is counted in iterations of every cell's own; the rate so far gives the time left.
    total = sum(cell.config.iterations - _done(cell, folder) for cell in todo)
    before = {cell.name: _done(cell, folder) for cell in todo}
    try:
        while waiting or running:
            for index in range(len(shares)):
                if index not in running and waiting:
                    cell = waiting.pop(0)
                    running[index] = (cell, _start(cell, folder, shares[index]), time.monotonic())
                    progress.note(f"{cell.name} begins, log in {folder / cell.name}.log")
            time.sleep(_POLL)
            for index, (cell, process, started) in list(running.items()):
                if process.poll() is None:
                    continue
                del running[index]
                took = time.monotonic() - started
                if process.returncode or not finished(cell, folder):
                    failed.append(cell.name)
                    progress.note(f"{cell.name} FAILED after {clock(took)}")
                else:
                    spent.append(took)
                    progress.note(f"{cell.name} is done after {clock(took)}")
            done = sum(_done(cell, folder) - before[cell.name] for cell in todo if cell not in waiting)
            elapsed = time.monotonic() - began
            left = clock(elapsed * (total - done) / done) if done else "unknown time"
            now = ", ".join(
                f"{cell.name} {100 * _done(cell, folder) / cell.config.iterations:.0f} %"
                for cell, _, _ in running.values()
            )
            progress.show(f"{len(todo) - len(waiting) - len(running)} of {len(todo)} done | {now} | {left} left")
    finally:
        for _, process, _ in running.values():
            process.send_signal(signal.SIGTERM)
        for _, process, _ in running.values():
            process.wait()
    if failed:
        raise UserError(
            f"{len(failed)} of {len(todo)} cells failed: see {folder / failed[0]}.log ({', '.join(failed)})"
        )


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
from fmpjax.cli import main
main(sys.argv[2:])
"""


def _start(cell: Cell, folder: Path, cores: set[int]) -> subprocess.Popen:
    where = folder / cell.name
    begun = (where / "config.json").exists()
    arguments = [*cell.command, "--run", str(where), *(["--resume"] if begun else [])]
    with (folder / f"{cell.name}.log").open("a") as log:
        return subprocess.Popen(
            [sys.executable, "-c", _LAUNCH, ",".join(map(str, sorted(cores))), *arguments],
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # a Ctrl-C reaches the cells through us, once
        )
