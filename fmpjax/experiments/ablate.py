"""The matched comparison: every method with every reset and seed, Table I and the learning curves from our own runs.

``python -m fmpjax.experiments.ablate --out runs/table1`` plans the cells, runs what is missing, and writes the results.
"""

import dataclasses
import sys
from pathlib import Path

import tyro

from fmpjax.errors import UserError
from fmpjax.experiments import cells, table
from fmpjax.experiments.cells import Specification


def main(
    out: Path = Path("runs/ablate"),
    spec: Path | None = None,
    preset: str | None = None,
    motion: str | None = None,
    frames: str | None = None,
    transitions: int | None = None,
    methods: tuple[str, ...] | None = None,
    resets: tuple[str, ...] | None = None,
    seeds: tuple[int, ...] | None = None,
    workers: int = 1,
) -> None:
    """Run the matched comparison; started again, it goes on where it was.

    Args:
      out: folder of the cells' runs and of the results.
      spec: TOML file with the keys below, `settings` and `variants`; the options below go before it.
      preset: preset of every cell, `laptop` by default.
      motion: a bundled motion's name or a file.
      frames: source rows "first:last" of the motion.
      transitions: budget of every cell, the preset's by default.
      methods: all six by default.
      resets: `dataset` and `fixed` by default.
      seeds: 0 by default.
      workers: cells that run at once, each on its share of the cores.
    """
    from fmpjax import runs

    specification = cells.read_specification(spec) if spec else Specification()
    named = {
        "preset": preset, "motion": motion, "frames": frames, "transitions": transitions,
        "methods": methods, "resets": resets, "seeds": seeds,
    }  # fmt: skip
    specification = dataclasses.replace(specification, **{k: v for k, v in named.items() if v is not None})
    planned = cells.plan(specification)
    cells.run(planned, out, workers)
    paths = table.write(planned, out, runs.provenance())
    print((out / "table.md").read_text())
    for path in paths:
        print(f"wrote {path}")


def cli(arguments: list[str] | None = None) -> None:
    """Entry point: bad input is one sentence and exit code 2."""
    try:
        tyro.cli(main, args=arguments)
    except UserError as error:
        print(f"ablate: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    cli()
