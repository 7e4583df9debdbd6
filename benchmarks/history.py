"""How fast is this checkout, compared with an earlier commit?

Both commits are measured in turn, each time in a process of its own, since times that are taken apart on a shared
machine cannot be compared. A line for each measurement goes to a CSV file that is committed:

- ``laptop``, ``paper``: time of a training iteration over that of the baseline (`throughput.py`); the lowest and the
  highest of the pairs are beside the median;
- ``cores``: rate of `laptop` on all cores over its rate on one, this checkout alone;
- ``first``: wall time of `make train PRESET=smoke` the second time, when its programs are compiled already, in seconds;
- ``run``, ``memory``: wall time and peak memory of a run of 0.7 M transitions of `laptop`, with its evaluation and its
  film, over those of the baseline. Both have trained once before; the baseline compiles every time.

The baseline is checked out into a temporary folder and runs with the packages of this environment.
"""

import argparse
import contextlib
import csv
import datetime
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
BASELINE = "e76cc19"  # the first program that was measured so
FIELDS = ("date", "commit", "baseline", "machine", "measured", "value", "lowest", "highest", "unit", "rounds")


def git(*arguments: str) -> str:
    """What a git command of this checkout prints."""
    return subprocess.run(
        ["git", "-C", str(ROOT), *arguments], check=True, capture_output=True, text=True
    ).stdout.strip()


@contextlib.contextmanager
def checked_out(commit: str) -> Generator[Path]:
    """A temporary folder with the files of a commit."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "baseline"
        git("worktree", "add", "--detach", str(path), commit)
        try:
            yield path
        finally:
            git("worktree", "remove", "--force", str(path))


def run(checkout: Path, *arguments: str, prefix: tuple[str, ...] = ()) -> tuple[float, float]:
    """Seconds that a Python command of a checkout takes, and its peak memory.

    The memory is the largest of the process and of those that it started, in the system's unit.

    Raises:
      SystemExit: it fails; its last lines are shown.
    """
    environment = os.environ | {"PYTHONPATH": str(checkout), "JAX_PLATFORMS": "cpu"}
    command = [*prefix, sys.executable, *arguments]
    with tempfile.TemporaryFile("w+") as printed:
        began = time.perf_counter()
        process = subprocess.Popen(command, cwd=checkout, env=environment, stdout=printed, stderr=subprocess.STDOUT)
        _, status, used = os.wait4(process.pid, 0)  # `resource` knows only the largest of all children so far
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            printed.seek(0)
            raise SystemExit(f"{' '.join(arguments)} in {checkout}: {printed.read()[-1000:]}")
        return time.perf_counter() - began, used.ru_maxrss


def iteration(checkout: Path, preset: str, calls: int, prefix: tuple[str, ...] = ()) -> float:
    """Milliseconds of a training iteration, the median of some calls in one process."""
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "table.csv"
        command = ("benchmarks/throughput.py", preset, "--no-parts", "--rounds", str(calls), "--csv", str(table))
        run(checkout, *command, prefix=prefix)
        with open(table, newline="") as file:
            return float(next(csv.DictReader(file))["ms"])


def measure(arguments: argparse.Namespace) -> Iterator[dict[str, object]]:
    """The rows of the table, one after the other."""

    def row(measured: str, values: list[float], unit: str) -> dict[str, object]:
        figures = {"value": np.median(values), "lowest": min(values), "highest": max(values)}
        shown = {name: f"{value:.3g}" for name, value in figures.items()}
        return {"measured": measured, "unit": unit, "rounds": len(values)} | shown

    with checked_out(arguments.baseline) as baseline:
        for preset in arguments.presets:
            here, there = [], []
            for _ in range(arguments.rounds):
                there.append(iteration(baseline, preset, arguments.calls))
                here.append(iteration(ROOT, preset, arguments.calls))
            yield row(preset, list(np.divide(here, there)), "of the baseline's time")
    if arguments.cores and (os.cpu_count() or 1) > 1 and sys.platform == "linux":
        one, every = [], []
        for _ in range(arguments.rounds):
            one.append(iteration(ROOT, "laptop", arguments.calls, ("taskset", "-c", "0")))
            every.append(iteration(ROOT, "laptop", arguments.calls))
        yield row("cores", list(np.divide(one, every)), "of one core's rate")
    if arguments.first:
        with tempfile.TemporaryDirectory() as folder:
            command = ("-m", "fmpjax.cli", "train", "--preset", "smoke", "--run")
            run(ROOT, *command, f"{folder}/0")
            taken = [run(ROOT, *command, f"{folder}/{i + 1}")[0] for i in range(arguments.rounds)]
        yield row("first", taken, "s")
    if arguments.run:
        command = ("-m", "fmpjax.cli", "train", "--preset", "laptop", "--transitions", "700000", "--run")
        with checked_out(arguments.baseline) as baseline, tempfile.TemporaryDirectory() as folder:
            checkouts = {"there": baseline, "here": ROOT}
            used = [
                [run(checkout, *command, f"{folder}/{side}{i}") for side, checkout in checkouts.items()]
                for i in range(arguments.rounds + 1)
            ]
        there, here = np.array(used[1:]).swapaxes(0, 1)
        for measured, of, ratios in zip(("run", "memory"), ("time", "memory"), (here / there).T, strict=True):
            yield row(measured, list(ratios), f"of the baseline's {of}")


def main() -> None:
    from fmpjax import runs

    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--baseline", default=BASELINE, help=f"commit to compare with, {BASELINE} by default")
    parser.add_argument("--presets", nargs="*", default=["laptop", "paper"], help="whose iterations are compared")
    parser.add_argument("--rounds", type=int, default=3, help="pairs of processes")
    parser.add_argument("--calls", type=int, default=5, help="calls of the compiled program in a process")
    parser.add_argument("--cores", action=argparse.BooleanOptionalAction, default=True, help="compare with one core")
    parser.add_argument("--first", action=argparse.BooleanOptionalAction, default=True, help="time a second short run")
    parser.add_argument("--run", action=argparse.BooleanOptionalAction, default=True, help="compare runs of 0.7 M")
    parser.add_argument("--csv", type=Path, default=ROOT / "experiments/results/throughput/history.csv")
    arguments = parser.parse_args()
    changed = "+" if git("status", "--porcelain", "--untracked-files=no") else ""
    head = {
        "date": datetime.date.today().isoformat(),
        "commit": git("rev-parse", "--short", "HEAD") + changed,
        "baseline": git("rev-parse", "--short", arguments.baseline),
        "machine": runs.machine(),
    }
    for line in measure(arguments):
        print(f"{line['measured']}: {line['value']} ({line['lowest']} to {line['highest']}) {line['unit']}", flush=True)
        new = not arguments.csv.exists()
        with open(arguments.csv, "a", newline="") as file:
            writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
            if new:
                writer.writeheader()
            writer.writerow(head | line)


if __name__ == "__main__":
    main()
