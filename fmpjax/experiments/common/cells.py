"""Cells of an experiment: training runs that differ in what a specification names, each a run folder of its own.

Cells run as processes, several at once where asked, each on its share of the cores: two small runs on a core each are
faster than one after the other on both. A cell that was killed continues from its checkpoint, a finished one is left
alone, and one of another configuration is refused.
"""

import dataclasses
import itertools
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
from fmpjax.experiments.common import engines, work
from fmpjax.experiments.common.work import Measure, Task
from fmpjax.logs import Progress, clock

_POLL = 1.0  # s between looks at the running cells
_LISTED = 4  # running cells at most of which a line shows the progress


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
    pictures: bool = True  # whether a cell ends with frames and a film


@dataclasses.dataclass(frozen=True)
class Cell:
    """One run of an experiment."""

    name: str  # METHOD-RESET[-VARIANT]/seedSEED, also its folder
    variant: str  # "" where the specification has none
    config: Config
    changes: Mapping[str, Any]  # by which the configuration departs from its preset
    pictures: bool = True  # whether it ends with frames and a film
    measures: tuple[Measure, ...] = ()  # once it is trained

    @property
    def group(self) -> str:
        """What the cell shares with those that differ in nothing but the seed."""
        return self.name.partition("/")[0]

    @property
    def command(self) -> list[str]:
        """Arguments of ``fmpjax train``, without the run's folder."""
        settings = [f"--set={key}={_text(value)}" for key, value in self.changes.items()]
        return ["train", "--preset", self.config.preset, *settings, *([] if self.pictures else ["--no-pictures"])]


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
    elif key == "pictures":
        good, expected = type(value) is bool, "true or false"
    elif key == "transitions":
        good, expected = type(value) is int and value >= 0, "a whole number"
    else:
        good, expected = isinstance(value, str), "a text"
    if not good or (isinstance(value, list) and not value):
        raise UserError(f"{path}: {key} is {value!r}, expected {expected}")


def plan(specification: Specification) -> list[Cell]:
    """The cells of a specification, seeds outermost: where it is ended early, all methods have the first seeds.

    Raises:
      UserError: a name, setting or value that no configuration can have, or a cell twice, or none at all.
    """
    s = specification
    for method in s.methods:
        priors.check(method)
    cells = []
    variants = s.variants or {"": {}}
    for seed, reset, method, variant in itertools.product(s.seeds, s.resets, s.methods, variants):
        changes: dict[str, Any] = {"motion": s.motion, "method": method, "env.reset": reset, "seed": seed}
        changes |= {"frames": s.frames} if s.frames else {}
        changes |= {"transitions": s.transitions} if s.transitions else {}
        changes |= {**s.settings, **variants[variant]}
        group = "-".join(part for part in (method, reset, variant) if part)
        made = configuration.preset(s.preset, **changes)
        cells.append(Cell(f"{group}/seed{seed}", variant, made, changes, s.pictures))
    if not cells:
        raise UserError("the plan has no cells: expected at least one method, reset and seed")
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
    return work.ended(run, cell.config.iterations)


def run(
    cells: Sequence[Cell],
    folder: Path,
    workers: int = 1,
    *,
    together: bool = False,
    cluster: str = "none",
    options: Sequence[str] = (),
    keep: bool = True,
) -> None:
    """Run what is not finished yet, ``workers`` at once.

    Args:
      cells: of one plan.
      folder: where their run folders are.
      workers: processes at once; on one machine each has its share of the cores.
      together: train all seeds of a group in one process as one program, which pays on an accelerator.
      cluster: where they run, as `engines.make` takes it.
      options: of the cluster.
      keep: the checkpoints of cells that are trained and measured.

    Raises:
      UserError: a folder holds another configuration (before anything runs), or cells failed (after all others ran).
    """
    for cell in cells:
        finished(cell, folder)  # another configuration is refused before anything runs
    todo = [cell for cell in cells if not _task([cell], folder, keep).done()]
    progress = Progress(30.0)
    progress.note(f"{len(cells)} cells, {len(cells) - len(todo)} of them finished before")
    waiting, failed = _tasks(todo, folder, together, keep), []
    engine = engines.make(cluster, workers, folder, len(waiting), options)
    began, begun, ended = time.monotonic(), {}, 0
    before = {cell.name: work.iterations(folder / cell.name) for cell in todo}
    done, total = dict(before), sum(cell.config.iterations for cell in todo) - sum(before.values())
    try:
        while waiting or engine.running():
            for task in engine.start(waiting):
                begun[task.cells] = time.monotonic()
                progress.note(f"{_name(task)} begins, log in {task.log}")
            time.sleep(_POLL)
            now = engine.running()
            for task in engine.ended():
                good = task.done()
                failed += [] if good else [task]
                ended += len(task.cells) if good else 0
                took = clock(time.monotonic() - begun[task.cells])
                progress.note(f"{_name(task)} {'is done' if good else 'FAILED'} after {took}")
            done |= {name: work.iterations(folder / name) for task in now for name in task.cells}
            # Work is counted in iterations; the rate so far gives the time left.
            new = sum(done.values()) - sum(before.values())
            left = clock((time.monotonic() - began) * (total - new) / new) if new > 0 else "unknown time"
            parts = ", ".join(f"{_name(task)} {_share(task, done):.0%}" for task in engine.running()[:_LISTED])
            progress.show(f"{ended} of {len(todo)} done | {parts} | {left} left")
    finally:
        engine.stop()
    if failed:
        names = ", ".join(map(_name, failed))
        raise UserError(f"{len(failed)} of the cells failed: see {failed[0].log} ({names})")


def _name(task: Task) -> str:
    first = task.cells[0]
    return first if len(task.cells) == 1 else f"{first.partition('/')[0]} ({len(task.cells)} seeds)"


def _share(task: Task, done: Mapping[str, int]) -> float:
    """Share of the budget that is spent, given each cell's iterations."""
    return sum(done[name] for name in task.cells) / (len(task.cells) * task.iterations)


def _task(group: Sequence[Cell], folder: Path, keep: bool) -> Task:
    """Cells that differ in their seeds alone, as one task."""
    first = group[0]
    names = tuple(cell.name for cell in group)
    return Task(str(folder), names, first.config.iterations, tuple(first.command), first.measures, keep)


def _tasks(todo: Sequence[Cell], folder: Path, together: bool, keep: bool = True) -> list[Task]:
    """Tasks for the cells to do; together, consecutive seeds of a group that have got as far are one."""
    groups: list[list[Cell]] = []
    for cell in sorted(todo, key=lambda cell: cell.config.seed) if together else todo:
        for group in groups if together else ():
            last = group[-1]
            follows = last.group == cell.group and cell.config.seed == last.config.seed + 1
            if follows and work.iterations(folder / last.name) == work.iterations(folder / cell.name):
                group.append(cell)
                break
        else:
            groups.append([cell])
    return [_task(group, folder, keep) for group in groups]
