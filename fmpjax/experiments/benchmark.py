"""The benchmark: every method on several motions from both resets, at equal transitions and at equal wall time.

``fmpjax experiment benchmark --out runs/benchmark`` plans the cells, runs what is missing, here or on a cluster, and
writes scores, statistics and pictures of what is finished. A method has one setting for all motions.
"""

import dataclasses
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from fmpjax import priors
from fmpjax.errors import UserError
from fmpjax.experiments.common import cells, comparison, courses, measured, results, scores, table
from fmpjax.experiments.common.cells import Cell, Specification
from fmpjax.motion import library
from fmpjax.shell import default

NAME = "benchmark"
MOTIONS = ("walk", "slow_walk", "fast_walk", "turn_left")  # bundled, all of `fmpjax motion synthesize`
# Of every cell: a policy that turns needs axes of its own, so all have them; evaluations are close enough in time for
# a comparison at equal wall time.
SETTINGS: Mapping[str, Any] = {
    "env.axes": "heading",
    "features.axes": "heading",
    "evaluations": (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0),
}
SEEDS = (0, 1, 2, 3, 4)
SMOKE = Specification(
    preset="smoke",
    methods=("fmp", "barycentric"),
    resets=("dataset",),
    seeds=(0, 1),
    settings={**SETTINGS, "evaluations": (0.5, 1.0)},
    pictures=False,
)


def main(
    out: Path = Path("runs/benchmark"),
    preset: Annotated[str | None, default(Specification.preset)] = None,
    methods: Annotated[tuple[str, ...] | None, default("all")] = None,
    resets: Annotated[tuple[str, ...] | None, default(" ".join(Specification.resets))] = None,
    seeds: Annotated[tuple[int, ...] | None, default(" ".join(map(str, SEEDS)))] = None,
    transitions: Annotated[int | None, default("the preset's")] = None,
    motion: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    only: bool = False,
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    smoke: bool = False,
    workers: int = 1,
    together: bool = False,
    measure: bool = True,
    keep: bool = True,
    cluster: str = "none",
    slurm: tuple[str, ...] = (),
) -> None:
    """Run the benchmark of all methods, and continue it when it is started again.

    Args:
      out: folder of the cells' runs and of the results.
      preset: preset of every cell.
      methods: methods to compare; the others are compared with the first.
      resets: resets to train each from.
      seeds: seeds of each.
      transitions: budget of every cell.
      motion: a further motion, a bundled one's name or a file; may be given several times.
      only: leave out the default motions.
      set: any other setting of every cell as section.field=value; may be given several times.
      smoke: two methods and two motions with a budget that teaches nothing, in minutes.
      workers: cells that run at once; on one machine each has its share of the cores.
      together: train all seeds of a method, reset and motion as one program, which pays on an accelerator.
      measure: measure each trained cell's falls under disturbances and what its reward prefers; a minute or two.
      keep: keep the checkpoints of finished cells; without them 0.2 MB of a cell are left, which can be committed.
      cluster: where cells run; `none`: processes of this machine, `slurm`: an array, `local`: the same without SLURM.
      slurm: options of the array as submitit names them, such as partition=gpu gpus_per_node=1 timeout_min=600.
    """
    # An exception, so that who ends the benchmark ends its cells, which save.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    start = SMOKE if smoke else Specification(methods=priors.METHODS, seeds=SEEDS, settings=SETTINGS, pictures=False)
    named = {"preset": preset, "methods": methods, "resets": resets, "seeds": seeds, "transitions": transitions}
    changed: dict[str, Any] = {key: value for key, value in named.items() if value is not None}
    changed["settings"] = {**start.settings, **_settings(set)}
    defaults = () if only else MOTIONS[:2] if smoke else MOTIONS
    planned = plan(dataclasses.replace(start, **changed), [*defaults, *motion])
    if measure:
        planned = [measured.of(cell, smoke=smoke) for cell in planned]
    results.check_folder(out)
    failed = None
    try:
        cells.run(planned, out, workers, together=together, cluster=cluster, options=slurm, keep=keep)
    except UserError as error:
        failed = error
    if any(cells.finished(cell, out) for cell in planned):
        _tell(write(planned, out), out)
    if failed:  # the results are of those that did not
        raise failed


def _tell(paths: Sequence[Path], folder: Path) -> None:
    print((folder / f"{NAME}.md").read_text())
    for path in paths:
        print(f"wrote {path}")


def _settings(given: Sequence[str]) -> dict[str, str]:
    pairs = [item.partition("=") for item in given]
    for item, (key, equals, _) in zip(given, pairs, strict=True):
        if not equals or key in ("preset", "method", "motion", "seed", "env.reset"):
            raise UserError(f"--set {item!r}: expected section.field=value, of a setting that all cells share")
    return {key: value for key, _, value in pairs}


def plan(specification: Specification, motions: Sequence[str]) -> list[Cell]:
    """The cells of a benchmark: those of the specification, on each of the motions.

    Raises:
      UserError: a name, setting or motion that no cell can have, or two motions of one name.
    """
    from fmpjax import runs

    if not motions:
        raise UserError("--only leaves out the default motions: expected at least one --motion")
    named: dict[str, str] = {}
    for motion in motions:
        name = library.title(motion)
        if name in named:
            raise UserError(f"motions {named[name]!r} and {motion!r} are both called {name!r}: expected two names")
        named[name] = motion
    variants = {name: {"motion": library.listed(motion)} for name, motion in named.items()}
    specification = dataclasses.replace(specification, variants=variants)
    planned = cells.plan(specification)
    # Bad motions are refused now, and not by a cell each.
    for cell in {cell.variant: cell for cell in planned}.values():
        runs.check_trainable(cell.config)
        runs.load_motion(cell.config)
    return planned


def write(planned: Sequence[Cell], folder: Path) -> list[Path]:
    """Scores, statistics, courses and pictures of the finished cells in ``folder``; the paths written."""
    finished = [cell for cell in planned if cells.finished(cell, folder)]
    histories = [scores.read(cell, folder) for cell in finished]
    found = scores.results(histories)
    record = {
        "plan": {
            "preset": planned[0].config.preset,
            "transitions": planned[0].config.transitions,
            **{key: _each(planned, key) for key in ("methods", "motions", "resets", "seeds")},
        },
        "cells": {"planned": len(planned), "finished": len(histories)},
        "machines": scores.machines(histories),
        "runs": {history.cell.name: table.origin(folder / history.cell.name) for history in histories},
        **comparison.compare(found),
    }
    record["notes"] = notes(record)
    motions = [name for cell in planned for name, _ in library.parse(cell.config.motion)]
    paths = results.save(folder, NAME, record, [each.line() for each in found], {folder, *motions})
    text = [results.markdown(comparison.table(record)), *(f"- {line}" for line in comparison.sentences(record))]
    (folder / f"{NAME}.md").write_text("\n".join([text[0], "", *text[1:]]) + "\n")
    rows = [row for cell in finished for row in courses.course(cell, folder)]
    lists = {
        "robustness": [row for cell in finished for row in measured.robust(cell, folder)],
        "ranking": [row for cell in finished for row in measured.ranking(cell, folder)],
    }
    return [
        *paths,
        *(results.write_csv(folder / f"{NAME}_{name}.csv", lines) for name, lines in lists.items() if lines),
        folder / f"{NAME}.md",
        *comparison.draw(record, found, [folder / f"{NAME}.png"]),
        results.write_csv(folder / f"{NAME}_courses.csv", rows),
        courses.draw(rows, folder / f"{NAME}_courses.png"),
    ]


def _each(planned: Sequence[Cell], key: str) -> list[Any]:
    of = {
        "methods": lambda cell: cell.config.method,
        "motions": lambda cell: cell.variant,
        "resets": lambda cell: cell.config.env.reset,
        "seeds": lambda cell: cell.config.seed,
    }[key]
    return list(dict.fromkeys(map(of, planned)))


def notes(record: Mapping[str, Any]) -> list[str]:
    """What the reader of the table must know of its figures."""
    count, planned = record["cells"]["finished"], record["cells"]["planned"]
    found = [
        f"{count} of {planned} cells are finished.",
        "Methods are compared on the motions and seeds that all of them have finished.",
        "Figures are interquartile means over motions and seeds (of walks the share), with their 95 % bootstrap "
        "intervals, stratified by motion; the last column counts pairs of the same motion and seed.",
        "Falls at a size are of starts with joint noise of that deviation; all other figures are of the starts that "
        "docs/metrics.md calls the headline's.",
        "Falls when pushed, delayed, slipping and under all together, and how often the reward prefers the "
        "demonstration to its spoiled copies, are of the last policy alone, where they were measured.",
    ]
    if len(record["machines"]) != 1:
        found.append(
            f"The cells were trained on different machines ({', '.join(record['machines'])}), whose wall times do not "
            "compare: figures at equal wall time are left out."
        )
    return found


def cli(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m fmpjax.experiments.benchmark``."""
    results.entry(main, arguments)


if __name__ == "__main__":
    cli()
