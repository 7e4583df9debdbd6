"""A run on disk: its folder, its training from start or checkpoint to a clean end, and what it leaves to look at."""

import contextlib
import dataclasses
import enum
import importlib.metadata
import json
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax
import numpy as np

from fmpjax import config as configuration
from fmpjax import deploy, diagnose, evaluate, jsons, memory, motion, policy, robots, sharding, shell
from fmpjax.checkpoint import Checkpoints
from fmpjax.config import Config
from fmpjax.errors import UserError, out_of_memory
from fmpjax.evaluate import Evaluation, Evaluator, table
from fmpjax.logs import MetricsLog, Progress, clock
from fmpjax.machine import cores
from fmpjax.motion import check
from fmpjax.train import Trainer, TrainState, stack, unstack
from fmpjax.viz import curves, render

try:
    import fcntl
except ImportError:  # on Windows, where every command says that it does not run
    fcntl = None

_PACKAGES = "jax jaxlib mujoco mujoco-mjx flax optax ott-jax orbax-checkpoint numpy".split()

_SAVE_INTERVAL = 120.0  # s between checkpoints at most, but for the iterations in hand


def load_motion(config: Config) -> motion.MotionLibrary:
    """The demonstrations that a configuration names, at its control rate."""
    return motion.load_library(
        config.motion, frames=config.frames or None, rate=round(config.control_rate, 6), robot=config.robot
    )


def describe(config: Config) -> str:
    """What the motions of a configuration were read as, and whether they are fit to learn from with its settings."""
    robot, lines = robots.load(config.robot), []
    for clip in load_motion(config).clips:
        lines.append(f"motion {clip.name}, {len(clip)} samples in {clip.duration:.2f} s, was read as\n{clip.reading}")
        said = check.faults(robot, clip) + check.unsuited(
            robot,
            clip,
            axes=config.features.axes,
            reset=config.env.reset,
            seconds=config.env.episode_steps / config.control_rate,
        )
        lines += [f"  warning: {sentence}" for sentence in said]
    return "\n".join(lines)


class Run:
    """A run folder.

    ``config.json`` and ``provenance.json`` say what it is; ``demonstration.npz`` holds the clip as it was resampled,
    ``demonstration-2.npz`` and so on further ones; ``metrics.csv`` and ``tensorboard/`` its course; ``checkpoints/``
    and ``best/`` its state.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        self.checkpoints = Checkpoints(self.folder)
        self._trainer: Trainer | None = None
        self._evaluator: Evaluator | None = None

    @classmethod
    def create(cls, folder: str | Path, config: Config) -> "Run":
        """A new run folder.

        Raises:
          UserError: the folder holds a run already, or cannot be written.
        """
        run = cls(folder)
        library = load_motion(config)
        if (run.folder / "config.json").exists():
            raise UserError(f"run folder {run.folder} holds a run already: go on with --resume, or name another --run")
        try:
            run.folder.mkdir(parents=True, exist_ok=True)
            for clip, path in zip(library.clips, run._demonstration_files(len(library.clips)), strict=True):
                motion.save(clip, path)
            write(run.folder / "provenance.json", jsons.dumps(provenance()))
            run._trainer = Trainer(config, run._demonstration(config))
            # Last: a folder with a configuration is a run, and what cannot be trained is none.
            write(run.folder / "config.json", configuration.to_json(config))
        except OSError as error:
            raise UserError(f"run folder {run.folder} cannot be written: {error.strerror}") from None
        return run

    @classmethod
    def open(cls, folder: str | Path) -> "Run":
        """An existing run folder.

        Raises:
          UserError: it is none.
        """
        run = cls(folder)
        if not (run.folder / "config.json").is_file():
            raise UserError(f"{run.folder} is not a run folder: expected config.json in it")
        return run

    @property
    def config(self) -> Config:
        return configuration.read(self.folder / "config.json")

    def extend(self, transitions: int) -> None:
        """Give the run a larger budget; its evaluations are at shares of that from here on."""
        longer = dataclasses.replace(self.config, transitions=transitions)
        write(self.folder / "config.json", configuration.to_json(longer))
        self._trainer = None

    def resumed(self) -> None:
        """Say in the provenance that this process goes on with the run."""
        made, here = self.provenance(), provenance()
        again = {key: here[key] for key in ("command", "date", "commit", "uncommitted_changes", "device")}
        made |= {"resumed": [*made.get("resumed", []), again]}
        write(self.folder / "provenance.json", jsons.dumps(made))

    def provenance(self) -> dict[str, Any]:
        """What ``provenance.json`` says.

        Raises:
          UserError: it is missing or broken.
        """
        path = self.folder / "provenance.json"
        try:
            made = json.loads(path.read_text())
        except (OSError, ValueError):
            made = None
        if not isinstance(made, dict):
            raise UserError(f"{path} cannot be read: expected the JSON object that the run's start wrote")
        return made

    def trainer(self) -> Trainer:
        """The run's parts."""
        if self._trainer is None:
            config = self.config
            self._trainer = Trainer(config, self._demonstration(config))
        return self._trainer

    def evaluator(self) -> Evaluator:
        """The run's evaluation, compiled once for training and what comes after."""
        if self._evaluator is None or self._evaluator.trainer is not self.trainer():
            self._evaluator = Evaluator(self.trainer())
        return self._evaluator

    def _demonstration_files(self, count: int) -> list[Path]:
        return [self.folder / f"demonstration{f'-{i + 1}' if i else ''}.npz" for i in range(count)]

    def _demonstration(self, config: Config) -> motion.MotionLibrary:
        """The clips as the folder holds them, whoever asks: the first process and a resumed one see the same bits."""
        motions = self.motions(config)
        clips = [
            dataclasses.replace(
                motion.load(path, rate=round(config.control_rate, 6), robot=config.robot), name=Path(name).stem
            )
            for path, (name, _) in zip(self._demonstration_files(len(motions)), motions, strict=True)
        ]
        return motion.MotionLibrary(tuple(clips), motion.library.shares(motions))

    def motions(self, config: Config) -> list[tuple[str, float]]:
        """Names and weights of the demonstrations; a file's name may hold commas and colons, and the file be gone."""
        if not self._demonstration_files(2)[1].exists():
            return [(config.motion, 1.0)]
        return motion.library.parse(config.motion)

    def policy(self, *, best: bool = True) -> tuple[Trainer, TrainState]:
        """The run's parts and its best state, or its newest where no evaluation chose a best one."""
        trainer = self.trainer()
        best = best and self.checkpoints.latest(best=True) is not None
        return trainer, self.checkpoints.restore(trainer.init(), best=best)

    def save_evaluation(self, evaluation: Evaluation, name: str = "evaluation") -> None:
        write(self.folder / f"{name}.json", evaluation.to_json())


class End(enum.Enum):
    """Why training ended, saved in each case."""

    BUDGET = "the budget is spent"
    TIME = "time is up"
    SIGNAL = "stopped"


def train(*group: Run, resume: bool = False, minutes: float | None = None, devices: int | None = 1) -> End:
    """Train a run to the end of its budget, or of its time, or until it is told to stop; all three end cleanly.

    Several runs that differ in nothing but their seeds are trained at once, as one program, each into its own folder.
    Several devices, all of them for None, share the environments or the seeds.

    Raises:
      UserError: the runs do not belong together, too much was not finite, or memory is too small; what was saved stays.
    """
    memory.check(group[0].config, len(group))
    with _enough_memory(group), _held(group):
        return _train(*group, resume=resume, minutes=minutes, devices=devices)


def _train(*group: Run, resume: bool, minutes: float | None, devices: int | None) -> End:
    primary = sharding.primary()
    config, progress = group[0].config, Progress(show=primary)
    began = time.monotonic()
    seeds = [run.config.seed for run in group]
    progress.note(
        f"run {', '.join(str(run.folder) for run in group)}: {config.method}, {config.preset}, {config.env.reset} "
        f"reset, motion {config.motion}"
    )
    trainer = _shared_trainer(group)
    states = _start(trainer, group, resume)
    evaluator = group[0].evaluator()
    for run in group:
        run._evaluator = evaluator
    done = int(states[0].iteration)
    if done >= config.iterations:
        progress.note(f"the budget of {config.transitions:,} transitions is spent: a larger --transitions would go on")
        return End.BUDGET
    if done and primary:
        for run in group:
            run.resumed()
    progress.note(f"{trainer.env.physics.name} physics on {machine()}; compiling, which takes a minute or so ...")
    compile_began = time.monotonic()
    state = states[0] if len(group) == 1 else stack(states)
    if devices != 1:
        state = trainer.place(state, sharding.mesh(devices))
    chunk = trainer.compile(state)
    compiling = time.monotonic() - compile_began
    progress.note(f"compiled in {compiling:.0f} s")
    spare = compiling  # s that the last evaluation and save may take
    names = [f"eval/{name}" for name in evaluate.names(config)]
    metric_names = sorted(jax.eval_shape(trainer.iteration, states[0])[1])
    logs = [MetricsLog(run.folder, [*metric_names, *names], done, keep=primary) for run in group]
    milestones = _milestones(config)
    best, evaluated = [_best(log)[0] for log in logs], _best(logs[0])[1]
    training_seconds, saved = logs[0].seconds, time.monotonic()

    with _StopSignals() as stop:
        while done < config.iterations:
            started = time.monotonic()
            state, metrics = chunk(state)
            metrics = jax.device_get(metrics)
            took = time.monotonic() - started
            rows = [{name: float(np.ravel(value)[i]) for name, value in metrics.items()} for i in range(len(group))]
            states = [state] if len(group) == 1 else unstack(state)
            training_seconds += took
            done = int(states[0].iteration)
            transitions = done * config.transitions_per_iteration
            rate = len(group) * config.chunk * config.transitions_per_iteration / took
            left = (config.iterations - done) * took / config.chunk
            if minutes is not None:
                left = min(left, minutes * 60 - (time.monotonic() - began))
            means = {name: _mean([row[name] for row in rows]) for name in metrics}
            progress.show(_line(transitions, config, rate, left, means), final=done >= config.iterations)
            for run, each in zip(group, states, strict=True):
                _check_finite(run, each, config)
            # Clocks and signals differ between processes; what follows must not.
            out_of_time = sharding.agree(
                minutes is not None and time.monotonic() - began + 1.5 * took + spare > minutes * 60
            )
            asked = sharding.agree(stop.requested)
            at_milestone = any(done >= m > evaluated for m in milestones)
            # A run that is asked to stop saves and no more, but its last iteration comes only once.
            evaluating = (at_milestone or out_of_time) and (not asked or done >= config.iterations)
            saving = sharding.agree(evaluating or time.monotonic() - saved > _SAVE_INTERVAL)
            before = time.monotonic()
            # Before the evaluation, after which processes are no longer in step.
            whole = [sharding.on_host(each) for each in states] if saving else []
            for i, (run, log, row) in enumerate(zip(group, logs, rows, strict=True)):
                better = False
                if evaluating:
                    evaluation, evaluated = evaluator(whole[i].ppo), done
                    row |= {f"eval/{name}": float(value) for name, value in evaluation.as_dict().items()}
                    which = f"seed {seeds[i]}, " if len(group) > 1 else ""
                    progress.note(f"evaluation at {transitions:,} transitions, {which}{clock(training_seconds)}:")
                    progress.note(table(evaluation))
                    better = evaluation.quality >= best[i]
                # Rows ahead of their checkpoint are computed again after a kill; rows behind it would be missing.
                log.write(done, transitions, training_seconds, row)
                if better:
                    best[i] = evaluation.quality
                    _save(run, whole[i], best=True)
                if saving:
                    _save(run, whole[i])
                if evaluating:
                    figures = json.loads(evaluation.to_json())
                    progress.note(diagnose.text(diagnose.Course(log.rows, config, figures)))
            if saving:
                saved = time.monotonic()
            if evaluating:
                spare = saved - before
            if out_of_time or asked:
                break
        if not saving:
            for run, each in zip(group, states, strict=True):
                _save(run, sharding.on_host(each))
    for log in logs:
        log.close()
    if done >= config.iterations:
        return End.BUDGET
    end = End.SIGNAL if asked else End.TIME
    progress.note(f"{end.value} at {transitions:,} transitions; saved. Go on with --resume.")
    return end


@contextlib.contextmanager
def _held(group: Sequence[Run]) -> Iterator[None]:
    """Keep other processes from training in the run folders; a process that ends, however, lets go of them."""
    with contextlib.ExitStack() as held:
        for run in group if fcntl and sharding.primary() else ():
            try:
                lock = held.enter_context((run.folder / ".lock").open("w"))
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UserError(f"run {run.folder} is being trained by another process: wait for its end") from None
            except OSError:  # a file system that has no locks or cannot be written, which saving will say
                pass
        yield


@contextlib.contextmanager
def _enough_memory(group: Sequence[Run]) -> Iterator[None]:
    """Say what to change where memory runs out."""
    try:
        yield
    except Exception as error:
        if not out_of_memory(error):
            raise
        config = group[0].config
        less = f"env.count (now {config.env.count}) or prior.bank (now {config.prior.bank})"
        less += f", or --seeds (now {len(group)})" if len(group) > 1 else ""
        saved = set.intersection(*(run.checkpoints.iterations() for run in group))
        kept = ""
        if saved:
            kept = f"; the checkpoint of iteration {max(saved):,} is whole: --resume goes on where there is more memory"
            kept += ", or with some of the seeds" if len(group) > 1 else ""
        raise UserError(f"out of memory on {machine()}: start a run with a smaller {less}{kept}") from error


def _save(run: Run, state: TrainState, *, best: bool = False) -> None:
    if sharding.primary():
        run.checkpoints.save(state, best=best)


def _shared_trainer(group: Sequence[Run]) -> Trainer:
    """The trainer of runs that differ in nothing but their seeds.

    Raises:
      UserError: they differ in more.
    """
    trainer = group[0].trainer()
    first = configuration.flatten(group[0].config)
    for run in group[1:]:
        for key, value in configuration.flatten(run.config).items():
            if key != "seed" and value != first[key]:
                raise UserError(
                    f"run {run.folder} has {key} {value!r} and run {group[0].folder} {first[key]!r}: "
                    "runs that train at once differ in their seeds alone"
                )
        run._trainer = trainer
    return trainer


def _start(trainer: Trainer, group: Sequence[Run], resume: bool) -> list[TrainState]:
    """States to begin with: those of the newest checkpoint that all runs have, or those of their seeds.

    Raises:
      UserError: there are checkpoints, and none that all runs have.
    """
    states = [trainer.init(run.config.seed) for run in group]
    if not resume:
        return states
    newest = [run.checkpoints.iterations() for run in group]
    # Where the newest are gone the best one is a whole state, too.
    saved = [found | run.checkpoints.iterations(best=True) for found, run in zip(newest, group, strict=True)]
    common = set.intersection(*newest) or set.intersection(*saved)
    if not common:
        if any(saved):  # never begin anew over what is there
            has = ", ".join(f"{r.folder} has {sorted(found) or 'none'}" for r, found in zip(group, saved, strict=True))
            raise UserError(f"{has}: expected a checkpoint of one iteration in all runs; resume each alone with --seed")
        return states
    start = max(common)
    return [
        run.checkpoints.restore(like, start, best=start not in found)
        for run, like, found in zip(group, states, newest, strict=True)
    ]


def finish(run: Run) -> list[Path]:
    """Evaluate the run's best policy, and write its table, learning curves and video; the paths written.

    A picture that cannot be made is left out.
    """
    trainer, state = run.policy()
    played = run.evaluator().play(state.ppo)
    evaluation = run.evaluator().measure(played)
    run.save_evaluation(evaluation)
    transitions = int(state.iteration) * trainer.config.transitions_per_iteration
    print(f"best policy, {transitions:,} transitions:\n{table(evaluation)}")
    paths = [run.folder / "evaluation.json", *_pictures(run, trainer, played)]
    if (run.folder / "metrics.csv").exists() and MetricsLog.read(run.folder / "metrics.csv"):
        print(diagnose.text(diagnose.read(run.folder)))
    return paths


def _pictures(run: Run, trainer: Trainer, played) -> list[Path]:
    """Draw a finished run; a picture that cannot be made is left out, which a line says."""

    def frames() -> Path:
        return render.contact_sheet(run.folder / "frames.png", _stride_frames(trainer, played), columns=6)

    def course() -> Path:
        return curves.learning_curves(run.folder / "metrics.csv", run.folder / "curves.png")

    makers = {"frames.png": frames}
    makers |= {"curves.png": course} if (run.folder / "metrics.csv").exists() else {}
    makers |= {"policy.mp4": lambda: video(run, trainer, played)}
    paths = []
    for name, make in makers.items():
        try:
            paths.append(make())
        except Exception as error:  # whatever it is, the training is finished
            print(f"no {name}: {str(error) or type(error).__name__}", file=sys.stderr)
    return paths


_EXPORTED = (
    "metrics.csv evaluation.json ranking-start.json ranking.json curves.png frames.png policy.mp4 policy.gif"
).split()


def export(run: Run, out: Path, *, onnx: bool = False) -> list[Path]:
    """Copy what a run has to show, and its policy, without states and demonstration, into ``out``; the paths written.

    With ``onnx`` the policy is also written for other programs, as `fmpjax.deploy` does it.

    Raises:
      UserError: ``out`` holds another run's results, or cannot be written, or there is no policy for ``onnx``.
    """
    trained = bool(run.checkpoints.iterations() or run.checkpoints.iterations(best=True))
    if onnx:
        deploy.check_installed()
        if not trained:
            raise UserError(f"run {run.folder} has no checkpoint: expected one, of which --onnx takes the policy")
    if out.resolve() == run.folder.resolve():
        raise UserError(f"{out} is the run itself: expected another folder")
    # Where the demonstration and the run lay is this machine's affair; their names are everybody's.
    places = [*(name for name, _ in run.motions(run.config)), run.folder.resolve(), run.folder]
    texts = {"config.json": (run.folder / "config.json").read_text().rstrip("\n")}
    texts["provenance.json"] = jsons.dumps(run.provenance())
    texts = {n: without_places(text, places) for n, text in texts.items()}
    if (out / "config.json").exists() and (out / "config.json").read_text().rstrip("\n") != texts["config.json"]:
        raise UserError(f"{out} holds results of another configuration: expected a new folder or this run's own")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for n, text in texts.items():
            write(out / n, text)
        copied = [Path(shutil.copy2(run.folder / n, out / n)) for n in _EXPORTED if (run.folder / n).exists()]
        if trained:
            trainer, state = run.policy()
            learned = policy.of(trainer, state.ppo)
            copied.append(policy.save(out / "policy.npz", learned))
            if onnx:
                copied += deploy.write(out, learned, trainer.robot, _origin(run))
        return [*(out / n for n in texts), *copied]
    except OSError as error:
        raise UserError(f"folder {out} cannot be written: {error.strerror}") from None


def _origin(run: Run) -> deploy.Origin:
    """Where the run's policy comes from, as its ONNX file and its card say."""
    path = run.folder / "evaluation.json"
    try:
        evaluation = json.loads(path.read_text()) if path.exists() else None
    except ValueError:
        raise UserError(f"{path} is not valid JSON: expected what `fmpjax evaluate` writes") from None
    return deploy.Origin(
        run=run.folder.resolve().name,
        config=run.config,
        motions=tuple(run.motions(run.config)),
        commit=run.provenance().get("commit"),
        evaluation=evaluation,
        changed=bool(run.provenance().get("uncommitted_changes")),
    )


def video(
    run: Run, trainer: Trainer, played, *, seconds: float = 10.0, path: Path | None = None, alone: bool = False
) -> Path:
    """The policy beside the demonstration, or alone, as a video; the path written."""
    rate = trainer.config.control_rate
    stride = 2  # 25 pictures a second
    episode = _longest(played)
    last = min(int(seconds * rate), len(played.qpos))
    shown = {"policy": played.qpos[: min(last, int(played.length[episode])) : stride, episode]}
    if not alone:
        shown["demonstration"] = trainer.library.clips[played.clip[episode]].qpos[:last:stride]
    panes = len(shown)
    frames = render.grid(trainer.robot, list(shown.values()), list(shown), columns=panes, width=360 * panes, height=360)
    return render.write_video(path or run.folder / "policy.mp4", frames, fps=rate / stride)


def _longest(played) -> int:
    """The longest episode, which shows most; ties go to the first."""
    return int(np.argmax(played.length))


def _stride_frames(trainer: Trainer, played) -> np.ndarray:
    """Twelve pictures of one second of the policy, from the late part of its longest episode."""
    episode = _longest(played)
    length = int(played.length[episode])
    last = min(length - 1, int(0.7 * len(played.qpos)))
    rows = np.linspace(max(0, last - int(trainer.config.control_rate)), last, 12).astype(int)
    return render.render_frames(trainer.robot, played.qpos[rows, episode], width=320, height=320)


def provenance() -> dict[str, object]:
    """Command, commit, versions and machine of this process."""
    here = Path(__file__).parent

    def git(*arguments: str) -> str | None:
        # An installed wheel may lie in somebody else's repository.
        if not (here.parent / "pyproject.toml").exists():
            return None
        try:
            done = subprocess.run(["git", *arguments], cwd=here, capture_output=True, text=True, timeout=10, check=True)
            return done.stdout.strip()
        except (OSError, subprocess.SubprocessError):
            return None

    changes = git("status", "--porcelain", "--untracked-files=no")
    return {
        "command": f"{shell.program()} {shlex.join(sys.argv[1:])}",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": git("rev-parse", "HEAD"),
        "uncommitted_changes": None if changes is None else bool(changes),
        "python": platform.python_version(),
        "packages": {name: importlib.metadata.version(name) for name in _PACKAGES},
        "device": machine(),
        "cores": cores(),
    }


def machine() -> str:
    """The device that JAX computes on, in words."""
    device = jax.devices()[0]
    return f"{cores()} CPU cores" if device.platform == "cpu" else device.device_kind


def _milestones(config: Config) -> list[int]:
    """Iterations after which to evaluate."""
    return [max(1, round(share * config.iterations)) for share in config.evaluations]


def _best(log: MetricsLog) -> tuple[float, int]:
    """Best quality so far, and the last iteration that was evaluated."""
    rows = [row for row in log.rows if row.get("eval/quality")]
    return max((float(row["eval/quality"]) for row in rows), default=-1.0), max(
        (int(row["iteration"]) for row in rows), default=0
    )


def _mean(values: Sequence[float]) -> float:
    """Mean of those that are defined; NaN where none is."""
    defined = [value for value in values if not np.isnan(value)]
    return float(np.mean(defined)) if defined else float("nan")


def _line(transitions: int, config: Config, rate: float, left: float, m: dict[str, float]) -> str:
    losses = " ".join(
        f"{name} {m[f'fit/{name}_loss']:.2f}" for name in ("value", "endpoint", "flow") if f"fit/{name}_loss" in m
    )
    return (
        f"{transitions / 1e6:6.2f} of {config.transitions / 1e6:.2f} M | {rate:,.0f}/s, {clock(left)} left | "
        f"episode {m['train/episode_length']:.0f} of {m['env/cap']:.0f} steps, falls {100 * m['train/falls']:.0f} % | "
        f"speed {m['train/speed']:+.2f} m/s | reward spread {m['train/reward_spread']:.2f} | {losses}"
    )


def _check_finite(run: Run, state: TrainState, config: Config) -> None:
    count = int(state.nonfinite)
    if count <= config.nonfinite_limit:
        return
    path = run.folder / "nonfinite_state.npz"
    offender = sharding.on_host(state.env.offender._asdict())
    if sharding.primary():
        np.savez(path, **offender)
    physics = config.physics
    full = f" or greater max_contacts (now {physics.max_contacts}) and max_constraints (now {physics.max_constraints})"
    raise UserError(
        f"{count} states or updates were not finite, more than nonfinite_limit, {config.nonfinite_limit}: "
        f"the last state before one is in {path}; a smaller physics.timestep or learning rate"
        f"{full + ', whose overflow counts too,' if physics.impl == 'warp' else ''} may help"
    )


class _StopSignals:
    """Ctrl-C and SIGTERM ask a run to stop after the chunk in hand; a second Ctrl-C stops at once."""

    def __init__(self):
        self.requested = False

    def __enter__(self):
        self._before = {s: signal.signal(s, self._request) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def _request(self, number, frame):
        if self.requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.requested = True
        print("\nstopping after the iterations in hand, then saving ...", flush=True)

    def __exit__(self, *exception):
        for number, handler in self._before.items():
            signal.signal(number, handler)


def without_places(text: str, places: Iterable[Path | str]) -> str:
    """JSON ``text`` with the files and folders of this machine cut to their names."""
    for place in sorted(map(str, places), key=len, reverse=True):
        name = Path(place).name or place  # "." has none
        text = text.replace(json.dumps(place)[1:-1], json.dumps(name)[1:-1])
    return text


def write(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text + "\n")
    os.replace(partial, path)
