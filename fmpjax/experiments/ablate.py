"""The matched comparison: every method with every reset and seed, Table I and the learning curves from our own runs.

``fmpjax experiment ablate --out runs/table1`` plans the cells, runs what is missing, and writes the results.
"""

import dataclasses
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from fmpjax.experiments.common import cells, results, table
from fmpjax.experiments.common.cells import Cell, Specification
from fmpjax.shell import default


def main(
    out: Path = Path("runs/ablate"),
    spec: Annotated[Path | None, default("none")] = None,
    preset: Annotated[str | None, default(Specification.preset)] = None,
    motion: Annotated[str | None, default(Specification.motion)] = None,
    frames: Annotated[str | None, default("all")] = None,
    transitions: Annotated[int | None, default("the preset's")] = None,
    methods: Annotated[tuple[str, ...] | None, default(" ".join(Specification.methods))] = None,
    resets: Annotated[tuple[str, ...] | None, default(" ".join(Specification.resets))] = None,
    seeds: Annotated[tuple[int, ...] | None, default(" ".join(map(str, Specification.seeds)))] = None,
    workers: int = 1,
    together: bool = False,
    video: bool = False,
) -> None:
    """Run the matched comparison, and continue it when it is started again.

    Args:
      out: folder of the cells' runs and of the results.
      spec: TOML file with the keys below, `settings` and `variants`; the options below go before it.
      preset: preset of every cell.
      motion: a bundled motion's name or a file.
      frames: source rows "first:last" of the motion.
      transitions: budget of every cell.
      methods: methods to compare.
      resets: resets to train each from.
      seeds: seeds of each.
      workers: cells that run at once, each on its share of the cores.
      together: train all seeds of a method and reset as one program, which pays on an accelerator.
      video: film the final policies of each reset's first seed side by side.
    """
    # An exception, so that ending the comparison ends its cells, which save.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    specification = cells.read_specification(spec) if spec else Specification()
    named = {
        "preset": preset, "motion": motion, "frames": frames, "transitions": transitions,
        "methods": methods, "resets": resets, "seeds": seeds,
    }  # fmt: skip
    specification = dataclasses.replace(specification, **{k: v for k, v in named.items() if v is not None})
    planned = cells.plan(specification)
    results.check_folder(out)
    cells.run(planned, out, workers, together=together)
    paths = table.write(planned, out, [spec] if spec else [])
    print((out / "table.md").read_text())
    if video:
        paths += films(planned, out)
    for path in paths:
        print(f"wrote {path}")


def films(planned: Sequence[Cell], folder: Path, seconds: float = 10.0) -> list[Path]:
    """A grid of the final policies for each reset, from the first seed; the paths written."""
    from fmpjax import runs
    from fmpjax.evaluate import Evaluator
    from fmpjax.viz import render

    paths, first = [], planned[0].config.seed
    stride = 2  # 25 pictures a second
    for reset in dict.fromkeys(cell.config.env.reset for cell in planned):
        motions, labels = [], []
        for cell in planned:
            if cell.config.env.reset != reset or cell.config.seed != first:
                continue
            trainer, state = runs.Run.open(folder / cell.name).policy(best=False)
            played = Evaluator(trainer, 8).play(state.ppo)
            steps = slice(0, min(int(seconds * trainer.config.control_rate), int(played.length[0])), stride)
            motions.append(played.qpos[steps, 0])
            labels.append(table.title(cell.config.method, cell.variant))
        columns = len(motions) if len(motions) <= 3 else -(-len(motions) // 2)
        frames = render.grid(trainer.robot, motions, labels, columns=columns)
        rate = trainer.config.control_rate / stride
        paths.append(render.write_video(folder / f"policies-{reset}.mp4", frames, fps=rate))
    return paths


def cli(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m fmpjax.experiments.ablate``."""
    results.entry(main, arguments)


if __name__ == "__main__":
    cli()
