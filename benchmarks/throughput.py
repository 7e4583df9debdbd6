"""How many transitions per second does training make, where does the time go, and what is the least it could take?

A case is a number of environments, of seeds and of devices. It is the whole program as a run calls it, iterations
scanned and compiled. On a CPU all cases are timed in turn, round after round, so that a noisy machine disturbs them
alike. On an accelerator, whose memory they would share, they run one after the other, and the table is written after
each. The parts of a case are compiled one by one and timed on the state that it reached: physics alone (on a CPU
`mujoco.rollout` without JAX), the rest of the rollout, features, fitting, scoring, PPO.

A part's floors, with peaks measured in between:

- its matrix products, counted in the traced program, at the rate of large ones;
- its bytes: every array that the compiled program writes, once written and once read, at the rate of a large copy;
- its launches: instructions that the compiled program executes, loops unrolled as far as their length is known.

On a CPU several devices are fake ones that share its cores: their rate shows what splitting costs. If a case does not
fit the device's memory, a line says so, and the others continue.
"""

import argparse
import csv
import itertools
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from counting import executed, products

CALL = 30_000  # transitions in a call of the compiled program, about
PEAK, COPY = 2048, 2**26  # side of the square product, floats of the copy that measure the machine
AGAIN = 32  # times that an accelerator, which takes microseconds, does either

# --- parts -----------------------------------------------------------------------------------------------------------


def seconds(call: Callable[[], object]) -> float:
    """Time of a call, until its arrays are there."""
    import jax

    began = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - began


def peaks() -> tuple[Callable[[], float], Callable[[], float]]:
    """Calls that measure the rate of a large matrix product (FLOP/s) and of a large copy (bytes/s, both ways)."""
    import jax
    import jax.numpy as jnp

    again, side = (1, PEAK) if jax.default_backend() == "cpu" else (AGAIN, 4 * PEAK)
    a, x = jnp.full((side, side), 1 / side), jnp.ones(COPY)
    multiply = jax.jit(lambda a: jax.lax.fori_loop(0, again, lambda _, b: a @ b, a))
    copy = jax.jit(lambda x: jax.lax.fori_loop(0, again, lambda _, y: y + 1, x))
    for call, of in ((multiply, a), (copy, x)):
        jax.block_until_ready(call(of))
    return (
        lambda: 2.0 * again * side**3 / seconds(lambda: multiply(a)),
        lambda: 8.0 * again * COPY / seconds(lambda: copy(x)),
    )


class Part(NamedTuple):
    """A compiled part of an iteration, and what it executes."""

    call: Callable[[], object]
    flops: float = 0.0
    written: float = 0.0
    launches: int = 0


def physics_alone(trainer, state) -> Part:
    """The physics of a rollout that the policy plays and nothing else, of every seed at once."""
    import jax
    import jax.numpy as jnp
    import mujoco
    import mujoco.rollout

    from fmpjax.physics.native import NativePhysics

    env, backend, steps = trainer.env, trainer.env.physics, trainer.config.ppo.rollout_steps

    def visited(s):
        """States before each control step, ``[steps, N, ...]``, and the targets of the policy in them."""

        def one(now, key):
            after, record = env.rollout(now, trainer.ppo.act(s.ppo), key, 1)
            return after, (now.physics, env.actions(record.action[0]))

        return jax.lax.scan(one, s.env, jax.random.split(jax.random.PRNGKey(0), steps))[1]

    seeds = state.env.age.ndim > 1
    sim, targets = jax.jit(jax.vmap(visited, out_axes=1) if seeds else visited)(state)
    sim, targets = jax.tree.map(lambda x: x.reshape(steps, -1, x.shape[-1]), (sim, targets))
    if not isinstance(backend, NativePhysics):

        def each(total, now):
            return total + backend.step(*now).qvel, None  # what a step reaches must be used, or it is left out

        return part(lambda *now: jax.lax.scan(each, jnp.zeros_like(now[0].qvel[0]), now)[0], sim, targets)
    qpos, qvel, targets = (np.asarray(x, np.float64).reshape(-1, x.shape[-1]) for x in (sim.qpos, sim.qvel, targets))
    initial = np.concatenate([np.zeros((len(qpos), 1)), qpos, qvel], axis=1)
    control = np.repeat(targets[:, None], backend.substeps, axis=1)
    pool = mujoco.rollout.Rollout(nthread=backend.threads)
    data = [mujoco.MjData(backend.model) for _ in range(backend.threads)]
    return Part(lambda: pool.rollout(backend.model, data, initial, control)[0])


def part(function: Callable[..., Any], *arguments: Any) -> Part:
    """``function(*arguments)``, compiled."""
    import jax

    traced = jax.jit(function).trace(*arguments)
    compiled = traced.lower().compile()
    count, written = executed(compiled.as_text())
    return Part(lambda: compiled(*arguments), products(traced.jaxpr.jaxpr), written, count.total())


def parts(trainer, state, seeds: int) -> dict[str, Part]:
    """The parts of one iteration on ``state``, which has an axis of seeds where there are several."""
    import jax

    from fmpjax import priors
    from fmpjax.trainer import policy_batch

    env, ppo, prior = trainer.env, trainer.ppo, trainer.prior
    over = jax.vmap if seeds > 1 else lambda function: function
    keys = jax.random.split(jax.random.PRNGKey(0), seeds) if seeds > 1 else jax.random.PRNGKey(0)
    play = over(lambda s, k: env.rollout(s.env, ppo.act(s.ppo), k, trainer.config.ppo.rollout_steps)[1])
    look = over(lambda s, r: trainer.feature_map(env.frame_table(s.env, r)[r.window]))
    fit = over(lambda s, f, r, k: prior.update(s.prior, priors.Rollout(f, ~r.nonfinite, r.length == 1), k)[1])
    score = over(lambda s, f: prior.score(s.prior, f.reshape(-1, f.shape[-1])))
    improve = over(lambda s, r, reward, k: ppo.update(s.ppo, policy_batch(r, reward), k)[0])
    made = {"physics": physics_alone(trainer, state), "rollout": part(play, state, keys)}
    record = made["rollout"].call()
    made["features"] = part(look, state, record)
    features = made["features"].call()
    made["fit"] = part(fit, state, features, record, keys)
    made["score"] = part(score, state, features)
    made["PPO"] = part(improve, state, record, made["fit"].call(), keys)
    return made


def apart(figures: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Parts that do not overlap: the rollout without its physics, fitting without the scoring that ends an update."""
    split = dict(figures)
    split["rollout, rest"] = np.maximum(split.pop("rollout") - split["physics"], 0.0)
    split["fit"] = np.maximum(split["fit"] - split["score"], 0.0)
    return {name: split[name] for name in ("physics", "rollout, rest", "features", "fit", "score", "PPO")}


# --- measuring -------------------------------------------------------------------------------------------------------


class Case(NamedTuple):
    """One program, compiled and warm."""

    row: dict[str, float]
    trainer: Any
    program: Callable[[Any], Any]
    state: list  # of one, as a call takes it and gives the next
    transitions: int  # of a call
    parts: dict[str, Part]


def prepare(arguments, clip, environments: int, seeds: int, devices: int) -> Case:
    """Compile a case, warm it up and take it apart."""
    import jax
    import jax.numpy as jnp

    from fmpjax import sharding
    from fmpjax.trainer import Trainer, stack

    trainer = Trainer(settings_of(arguments, environments, seeds), clip)
    settings = trainer.config
    state = trainer.init() if seeds == 1 else stack([trainer.init(seed) for seed in range(seeds)])
    state = state if devices == 1 else trainer.place(state, sharding.mesh(devices))
    began = time.perf_counter()
    program: Any = trainer.compile(state)
    compiled = time.perf_counter() - began
    memory = program.memory_analysis()
    count, _ = executed(program.as_text())
    between = sum(n for kind, n in count.items() if kind.startswith(("all-", "collective-", "reduce-scatter")))
    state, _ = jax.block_until_ready(program(state))
    # The compiled program takes its state's buffers; the parts keep a copy.
    taken = parts(trainer, jax.tree.map(jnp.copy, state), seeds) if arguments.parts and devices == 1 else {}
    for each in taken.values():
        seconds(each.call)
    row = {
        "environments": settings.env.count, "seeds": seeds, "devices": devices, "compile_s": compiled,
        "program_mb": (memory.temp_size_in_bytes + memory.argument_size_in_bytes) / 1e6,
        "launches": count.total() / settings.chunk, "exchanges": between / settings.chunk,
    }  # fmt: skip
    peak = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
    row["device_peak_mb"] = peak / 1e6 if peak else float("nan")
    transitions = seeds * settings.transitions_per_iteration * settings.chunk
    return Case(row, trainer, program, [state], transitions, taken)


def settings_of(arguments, environments: int, seeds: int = 1):
    """A case's configuration: as many iterations in a call as make about `CALL` transitions."""
    from fmpjax import config

    changes = dict(item.split("=", 1) for item in arguments.set)
    changes |= {"env.count": environments} if environments else {}
    settings = config.preset(arguments.preset, **changes)
    chunk = max(1, min(settings.chunk, round(CALL / seeds / settings.transitions_per_iteration)))
    return config.preset(arguments.preset, **({"chunk": chunk} | changes))


def measure(arguments: argparse.Namespace, group: list[tuple[int, int, int]], first_s: float) -> list[dict[str, Any]]:
    """Lines of the table for some cases, timed in turn: a case's whole iteration, then its parts; prints them.

    ``first_s`` is the first case's time of a transition, or 0 where that is among these.
    """
    import jax

    from fmpjax import motion, runs
    from fmpjax.errors import out_of_memory

    settings = settings_of(arguments, 0)
    clip = motion.load(settings.motion, rate=settings.control_rate, robot=settings.robot)
    cases: list[Case] = []
    for which in group:
        try:
            cases.append(prepare(arguments, clip, *which))
        except (MemoryError, jax.errors.JaxRuntimeError) as error:
            if not out_of_memory(error):
                raise
            print("{} environments, {} seeds, {} devices: out of memory, left out".format(*which), flush=True)
    if not cases:
        return []
    product_rate, copy_rate = peaks()
    rates, wholes, pieces = [], [], []
    for _ in range(arguments.rounds):
        rates.append((product_rate(), copy_rate()))
        wholes.append([])
        for case in cases:
            began = time.perf_counter()
            case.state[0], _ = jax.block_until_ready(case.program(case.state[0]))
            wholes[-1].append((time.perf_counter() - began) / case.trainer.config.chunk)
        pieces.append([[seconds(each.call) for each in case.parts.values()] for case in cases])
    flop_rate, byte_rate = np.median(rates, axis=0)
    first = cases[0].trainer
    if not first_s:
        print(
            f"{arguments.preset} on {runs.machine()}: {first.env.physics.name} physics at "
            f"{1 / first.config.physics.timestep:.0f} Hz, {first.config.prior.updates} reward updates; products at "
            f"{flop_rate / 1e9:,.0f} GFLOP/s, copies at {byte_rate / 1e9:,.1f} GB/s"
        )
    wholes, lines = np.array(wholes), []
    for i, case in enumerate(cases):
        per_iteration = case.transitions / case.trainer.config.chunk
        whole = float(np.median(wholes[:, i]))
        relative = wholes[:, i] / per_iteration
        base = first_s or wholes[:, 0] / (cases[0].transitions / first.config.chunk)
        head = case.row | {"part": "iteration", "ms": 1e3 * whole, "transitions_per_s": per_iteration / whole}
        lines.append(head | {"to_the_first": float(np.median(base / relative))})
        show(lines[-1])
        if not case.parts:
            continue
        times = dict(zip(case.parts, np.median([r[i] for r in pieces], axis=0), strict=True))
        split = {n: (times[n], p.flops, 2 * p.written, p.launches) for n, p in case.parts.items()}
        lines += show_parts(
            case, apart({n: np.array(f) for n, f in split.items()}), per_iteration, flop_rate, byte_rate
        )
    return lines


def show(line: dict[str, Any]) -> None:
    """Print a case's line."""
    peak = "" if np.isnan(line["device_peak_mb"]) else f", device's peak so far {line['device_peak_mb']:,.0f} MB"
    print(
        f"{line['environments']} environments, {line['seeds']} seeds, {line['devices']} devices: "
        f"{line['transitions_per_s']:,.0f} transitions/s, {line['to_the_first']:.2f} of the first; "
        f"{line['ms']:,.1f} ms an iteration, {line['launches']:,.0f} launches, {line['exchanges']:,.0f} exchanges; "
        f"compiled in {line['compile_s']:.0f} s, {line['program_mb']:,.0f} MB{peak}",
        flush=True,
    )


def show_parts(
    case: Case, split: dict[str, np.ndarray], per_iteration: float, flop_rate: float, byte_rate: float
) -> list[dict[str, Any]]:
    """Print the parts of a case's iteration (seconds, FLOP, bytes, launches of each); their lines of the table."""
    total, lines = sum(f[0] for f in split.values()), []
    print(
        f"  {'part':<16}{'ms':>10}{'share':>7}{'transitions/s':>15}{'GFLOP':>9}{'ms':>9}{'GB':>8}{'ms':>9}"
        f"{'launches':>10}"
    )
    for name, (taken, flops, moved, launches) in split.items():
        rate = per_iteration / taken if taken else float("nan")
        line = {
            "part": name, "ms": 1e3 * taken, "share": taken / total, "transitions_per_s": rate,
            "gflop": flops / 1e9, "product_floor_ms": 1e3 * flops / flop_rate,
            "gigabytes": moved / 1e9, "byte_floor_ms": 1e3 * moved / byte_rate, "launches": launches,
        }  # fmt: skip
        lines.append({k: case.row[k] for k in ("environments", "seeds", "devices")} | line)
        print(
            f"  {name:<16}{line['ms']:>10.1f}{100 * line['share']:>6.0f}%{line['transitions_per_s']:>15,.0f}"
            f"{line['gflop']:>9.2f}{line['product_floor_ms']:>9.2f}{line['gigabytes']:>8.2f}"
            f"{line['byte_floor_ms']:>9.2f}{line['launches']:>10,.0f}"
        )
    print(f"  {'sum':<16}{1e3 * total:>10.1f}", flush=True)
    return lines


def plot(lines: list[dict[str, Any]], path: str) -> None:
    """Rate over environments, a line for each number of seeds and devices; physics alone dashed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((5, 3.5), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for i, (seeds, devices) in enumerate(dict.fromkeys((line["seeds"], line["devices"]) for line in lines)):
        for what, style in (("iteration", "-"), ("physics", "--")):
            chosen = [
                line for line in lines if (line["seeds"], line["devices"], line["part"]) == (seeds, devices, what)
            ]
            if not chosen:
                continue
            label = f"{seeds} seed{'s' if seeds > 1 else ''}, {devices} device{'s' if devices > 1 else ''}"
            x, y = zip(*((line["environments"], line["transitions_per_s"]) for line in chosen), strict=True)
            label = label if what == "iteration" else "  physics alone"
            axes.plot(x, y, style, color=f"C{i}", marker="o", markersize=4, label=label)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.set_xlabel("environments")
    axes.set_ylabel("transitions/s")
    axes.grid(alpha=0.25, linewidth=0.5)
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("preset", nargs="?", default="laptop", help="smoke, laptop (default) or paper")
    parser.add_argument("--environments", type=int, nargs="+", default=[0], help="0 for the preset's")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--devices", type=int, nargs="+", default=[1])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--parts", action=argparse.BooleanOptionalAction, default=True, help="take one device apart")
    parser.add_argument("--set", nargs="*", default=[], help="other settings, section.field=value")
    parser.add_argument("--csv", help="file for the table")
    parser.add_argument("--png", help="file for the curves")
    arguments = parser.parse_args()
    # Before JAX is imported; an accelerator's devices are what they are.
    fake = f"--xla_force_host_platform_device_count={max(arguments.devices)}"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {fake}"
    # A device that waits for the others holds one of XLA's threads, one a core: too few are a deadlock.
    if max(arguments.devices) > 1:
        os.environ.setdefault("NPROC", str(2 * max(os.cpu_count() or 1, *arguments.devices)))
    import jax

    cases = list(itertools.product(arguments.environments, arguments.seeds, arguments.devices))
    lines: list[dict[str, Any]] = []
    for group in [cases] if jax.default_backend() == "cpu" else [[case] for case in cases]:
        lines += measure(arguments, group, 1 / lines[0]["transitions_per_s"] if lines else 0.0)
        write(lines, arguments.csv, arguments.png)


def write(lines: list[dict[str, Any]], table: str | None, picture: str | None) -> None:
    """The table and the curves so far."""
    if table and lines:
        with open(table, "w", newline="") as file:
            writer = csv.DictWriter(file, dict.fromkeys(key for line in lines for key in line))
            writer.writeheader()
            writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in line.items()} for line in lines)
    if picture and lines:
        plot(lines, picture)


if __name__ == "__main__":
    main()
