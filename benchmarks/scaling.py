"""How does training's rate grow with environments, seeds and devices?

Every case is the whole program as a run calls it, compiled and timed by itself, with compile time and memory beside it.
On a CPU the devices are fake ones that share its cores: there the figure to look at is what splitting costs. Cases are
timed in turn, round after round, so that a noisy machine disturbs them alike; ratios are to the first case.
"""

import argparse
import csv
import itertools
import os
import time

import numpy as np


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("preset", nargs="?", default="laptop", help="smoke, laptop (default) or paper")
    parser.add_argument("--environments", type=int, nargs="+", default=[0], help="0 for the preset's")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--devices", type=int, nargs="+", default=[1])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--set", nargs="*", default=[], help="other settings, section.field=value")
    parser.add_argument("--csv", help="file for the table")
    parser.add_argument("--png", help="file for the curves")
    arguments = parser.parse_args()
    # Before JAX is imported; an accelerator's devices are what they are.
    fake = f"--xla_force_host_platform_device_count={max(arguments.devices)}"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {fake}"
    rows = measure(arguments)
    if arguments.csv:
        with open(arguments.csv, "w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    if arguments.png:
        plot(rows, arguments.png)


def measure(arguments: argparse.Namespace) -> list[dict[str, float]]:
    """The cases' rows; prints them."""
    import jax

    from fmpjax import config, motion, sharding
    from fmpjax.train import Trainer, stack

    clip, programs, rows = None, [], []
    for environments, seeds, devices in itertools.product(arguments.environments, arguments.seeds, arguments.devices):
        changes = dict(item.split("=", 1) for item in arguments.set)
        changes |= {"env.count": environments} if environments else {}
        settings = config.preset(arguments.preset, **({"chunk": 1} | changes))
        clip = clip or motion.load(settings.motion, rate=settings.control_rate, robot=settings.robot)
        trainer = Trainer(settings, clip)
        state = trainer.init() if seeds == 1 else stack([trainer.init(seed) for seed in range(seeds)])
        state = state if devices == 1 else trainer.place(state, sharding.mesh(devices))
        began = time.perf_counter()
        program = trainer.compile(state)
        compiled = time.perf_counter() - began
        memory = program.memory_analysis()
        rows.append(
            {
                "environments": settings.env.count, "seeds": seeds, "devices": devices, "compile_s": compiled,
                "program_mb": (memory.temp_size_in_bytes + memory.argument_size_in_bytes) / 1e6,
                "transitions": seeds * settings.transitions_per_iteration * settings.chunk,
            }
        )  # fmt: skip
        state, _ = jax.block_until_ready(program(state))
        programs.append([program, state])
    taken = []
    for _ in range(arguments.rounds):
        taken.append([])
        for case in programs:
            began = time.perf_counter()
            case[1], _ = jax.block_until_ready(case[0](case[1]))
            taken[-1].append(time.perf_counter() - began)
    per_transition = np.array(taken) / [row["transitions"] for row in rows]
    print(f"{arguments.preset} on {jax.devices()[0].device_kind}, {len(os.sched_getaffinity(0))} cores")
    print(
        f"{'environments':>12}{'seeds':>7}{'devices':>9}{'compile':>10}{'memory':>10}{'rate':>14}{'to the first':>14}"
    )
    for i, row in enumerate(rows):
        row["transitions_per_s"] = float(1 / np.median(per_transition[:, i]))
        row["ratio"] = float(np.median(per_transition[:, 0] / per_transition[:, i]))
        print(
            f"{row['environments']:>12}{row['seeds']:>7}{row['devices']:>9}{row['compile_s']:>8.0f} s"
            f"{row['program_mb']:>7,.0f} MB{row['transitions_per_s']:>12,.0f}/s{row['ratio']:>14.2f}"
        )
    return rows


def plot(rows: list[dict[str, float]], path: str) -> None:
    """Rate over environments, a line for each number of seeds and devices."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((5, 3.5), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for seeds, devices in dict.fromkeys((row["seeds"], row["devices"]) for row in rows):
        chosen = [row for row in rows if (row["seeds"], row["devices"]) == (seeds, devices)]
        label = f"{seeds} seed{'s' if seeds > 1 else ''}, {devices} device{'s' if devices > 1 else ''}"
        x, y = zip(*((row["environments"], row["transitions_per_s"]) for row in chosen), strict=True)
        axes.plot(x, y, marker="o", markersize=4, label=label)
    axes.set_xscale("log", base=2)
    axes.set_ylim(0)
    axes.set_xlabel("environments")
    axes.set_ylabel("transitions/s")
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(path)


if __name__ == "__main__":
    main()
