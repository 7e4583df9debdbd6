"""The command line: `fmpjax` with the commands in `COMMANDS`."""

import dataclasses
import math
import os
import sys
import time
from pathlib import Path
from typing import Annotated

import tyro

import fmpjax
from fmpjax import config as configuration
from fmpjax import experiments, machine, shell, tables
from fmpjax.cli_deploy import Sim2Sim
from fmpjax.cli_motion import MOTION
from fmpjax.errors import UserError
from fmpjax.shell import default


def _setting(key: str) -> object:
    """For ``Annotated``: the default of an option that overrides a setting, which may depend on the preset."""
    presets: dict[str, list[str]] = {}
    for name in configuration.PRESETS:
        value = configuration.flatten(configuration.preset(name))[key]
        presets.setdefault(f"{value:,}" if isinstance(value, int) else value, []).append(name)
    if len(presets) == 1:
        return default(*presets)
    return default(", ".join(f"{value} in {' and '.join(names)}" for value, names in presets.items()))


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a policy from a demonstration."""

    method: Annotated[str | None, _setting("method")] = None
    """Motion prior; `fmpjax list` shows all of them."""
    reset: Annotated[str | None, _setting("env.reset")] = None
    """`dataset` (a demonstration state) or `fixed` (the default pose)."""
    preset: Annotated[str | None, default("laptop on a CPU, paper on an accelerator")] = None
    """`smoke`, `laptop` or `paper`."""
    robot: Annotated[str | None, _setting("robot")] = None
    """A robot under robots/."""
    motion: Annotated[str | None, _setting("motion")] = None
    """A bundled motion's name, a file or a folder of files; several with weights as NAME[:WEIGHT],NAME[:WEIGHT]."""
    command: Annotated[str | None, default("none, or the run's own with --resume")] = None
    """What the policy is told: `none`, `velocity` (by default of the motions `gaits`) or `phase`; docs/steering.md."""
    frames: Annotated[str | None, default("all")] = None
    """Source rows first:last of the motion, 0-based, both included; of several motions with commas between them."""
    seed: Annotated[int | None, _setting("seed")] = None
    """Seed of everything that is random."""
    seeds: Annotated[int | None, default("a single run")] = None
    """Train as many seeds at once, from --seed on, in one program: the runs RUN/seed0, RUN/seed1, and so on."""
    transitions: Annotated[int | None, _setting("transitions")] = None
    """Budget of environment steps; with --resume, a larger one than the run's lets it go on."""
    run: Annotated[Path | None, default("runs/METHOD-DATE-TIME")] = None
    """Folder of the run."""
    minutes: Annotated[float | None, default("no limit")] = None
    """Time budget: the run ends cleanly and can be resumed."""
    devices: int = 1
    """Devices that share the environments, or the seeds; 0 for every one that JAX sees."""
    distributed: bool = False
    """One of several processes that train together on all their devices, as SLURM starts them; see docs/scaling.md."""
    coordinator: Annotated[str | None, default("as the scheduler says")] = None
    """HOST:PORT of the first process, where no scheduler tells it."""
    processes: Annotated[int | None, default("as the scheduler says")] = None
    """Number of processes, likewise."""
    process: Annotated[int | None, default("as the scheduler says")] = None
    """Number of this process, from 0, likewise."""
    resume: bool = False
    """Go on with the run in --run, with its settings."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Any other setting as section.field=value; `fmpjax settings` explains all of them."""

    def __call__(self) -> None:
        if self.minutes is not None and not self.minutes > 0:
            raise UserError(f"--minutes is {self.minutes:g}: expected more than 0")
        if self.seeds is not None and self.seeds < 1:
            raise UserError(f"--seeds is {self.seeds}: expected at least 1")
        if self.devices < 0:
            raise UserError(f"--devices is {self.devices}: expected 0 (for all) or more")
        began = time.monotonic()
        self._connect()
        runs = _runs()
        devices = None if self.distributed else self.devices or None
        if self.resume:
            group = self._resumed()
            self._extend(group)
        else:
            group = self._begun(devices)
        minutes = None if self.minutes is None else self.minutes - (time.monotonic() - began) / 60
        end = runs.train(*group, resume=self.resume, minutes=minutes, devices=devices)
        from fmpjax import sharding

        # Who sends a signal wants the process to end, not to film.
        if end is not runs.End.SIGNAL and sharding.primary():
            for run in group:
                for path in runs.finish(run):
                    print(f"wrote {path}")

    def _connect(self) -> None:
        by_hand = (self.coordinator, self.processes, self.process)
        if not self.distributed:
            if by_hand != (None, None, None):
                raise UserError("--coordinator, --processes and --process go with --distributed")
            return
        if self.run is None:
            raise UserError("--distributed needs the run's folder, the same for all processes: name it with --run")
        from fmpjax import sharding

        sharding.connect(*by_hand)

    def _resumed(self):
        runs = _runs()
        if self.run is None:
            raise UserError("--resume needs the run's folder: name it with --run")
        changes = self._changes()
        folders = [path for path in self.run.glob("seed*") if path.is_dir()]
        folders.sort(key=lambda path: (len(path.name), path.name))
        if (self.run / "config.json").exists() or not folders:
            folders = [self.run]
        elif "seed" in changes:
            # Some of the seeds: as many as --seeds says, one by default, from --seed on.
            first = configuration.with_changes(configuration.Config(), {"seed": changes["seed"]}).seed
            folders = [self.run / f"seed{first + i}" for i in range(self.seeds or 1)]
        if self.seeds is not None and self.seeds != len(folders):
            raise UserError(f"run {self.run} has {len(folders)} seeds: it cannot go on with {self.seeds}")
        group = [runs.Run.open(folder) for folder in folders]
        saved = configuration.flatten(group[0].config)
        if self.preset is not None and self.preset != saved["preset"]:
            raise UserError(f"run {self.run} has preset {saved['preset']!r}: it cannot go on as {self.preset!r}")
        asked = configuration.flatten(configuration.with_changes(group[0].config, changes))
        longer = asked["transitions"] > saved["transitions"]
        for key in changes:
            if asked[key] != saved[key] and not (key == "transitions" and longer):
                raise UserError(f"run {self.run} has {key} {saved[key]!r}: it cannot go on with {asked[key]!r}")
        return group

    def _extend(self, group) -> None:
        """Give the runs the larger budget that a resume asks for; the first process writes it for all."""
        from fmpjax import sharding

        budget = configuration.with_changes(group[0].config, self._changes()).transitions
        for run in group if sharding.primary() else ():
            if budget > run.config.transitions:
                run.extend(budget)
        sharding.wait("extended")

    def _begun(self, devices: int | None):
        """New runs: the first process makes the folders, the others find them."""
        from fmpjax import sharding

        group, refused = None, None
        try:
            group = self._created(devices) if sharding.primary() else None
        except UserError as error:
            refused = error
        # The others wait here for the folders, and no longer than for a first process that has given up.
        if not sharding.agree(refused is None):
            raise refused or UserError("the first process was refused, and says why")
        return group or self._resumed()

    def _created(self, devices: int | None):
        runs = _runs()
        from fmpjax import sharding

        config = configuration.preset(self.preset or runs.default_preset(), **self._changes())
        runs.check_trainable(config, self.seeds or 1)
        if devices != 1:
            sharding.check_divides(config.env.count, self.seeds or 1, sharding.mesh(devices).size)
        print(runs.describe(config), flush=True)
        folder = self.run or runs.default_folder(config)
        if self.seeds is None:
            return [runs.Run.create(folder, config)]
        seeds = range(config.seed, config.seed + self.seeds)
        configs = [configuration.validate(dataclasses.replace(config, seed=seed)) for seed in seeds]
        return [runs.Run.create(folder / f"seed{each.seed}", each) for each in configs]

    def _changes(self) -> dict[str, object]:
        named = {
            "method": self.method,
            "env.reset": self.reset,
            "robot": self.robot,
            "motion": self.motion,
            "frames": self.frames,
            "seed": self.seed,
            "transitions": self.transitions,
        }
        from fmpjax.motion import library

        changes: dict[str, object] = {key: value for key, value in named.items() if value is not None}
        for item in self.set:
            key, equals, value = item.partition("=")
            if not equals or key == "preset":
                raise UserError(f"--set {item!r}: expected section.field=value")
            changes[key] = value
        if self.resume:
            return changes | ({} if self.command is None else {"command.kind": self.command})
        changes = configuration.commanded(self.command, changes)
        if isinstance(names := changes.get("motion"), str):
            changes["motion"] = library.listed(names)
        return changes


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Evaluate a run's best policy on first episodes."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    episodes: Annotated[int | None, default("the run's evaluation_episodes")] = None
    """First episodes at the smallest perturbation, by which a run is judged; docs/metrics.md."""
    last: bool = False
    """Take the newest checkpoint in place of the best."""
    commands: bool = False
    """Measure how well a policy that is told velocities obeys them; docs/steering.md."""

    def __call__(self) -> None:
        if self.commands:
            return self._commands()
        runs = _runs()
        from fmpjax.evaluate import Evaluator, table

        if self.episodes is not None and self.episodes < 1:
            raise UserError(f"--episodes is {self.episodes}: expected at least 1")
        run = runs.Run.open(self.run)
        trainer, state = run.policy(best=not self.last)
        print("compiling the evaluation ...", flush=True)
        evaluation = Evaluator(trainer, self.episodes)(state.ppo)
        print(f"iteration {int(state.iteration):,}:\n{table(evaluation)}")
        name = "evaluation-last" if self.last else "evaluation"
        run.save_evaluation(evaluation, name)
        print(f"wrote {run.folder / name}.json")

    def _commands(self) -> None:
        runs = _runs()
        from fmpjax import steering
        from fmpjax.files import write
        from fmpjax.viz import heat

        if self.episodes is not None and self.episodes < 1:
            raise UserError(f"--episodes is {self.episodes}: expected at least 1")
        run = runs.Run.open(self.run)
        trainer, state = run.policy(best=not self.last)
        print("compiling the episodes ...", flush=True)
        found = steering.measure(trainer, state.ppo, **({} if self.episodes is None else {"changing": self.episodes}))
        print(f"iteration {int(state.iteration):,}:\n{steering.table(found)}")
        path = run.folder / ("steering-last.json" if self.last else "steering.json")
        write(path, found.to_json())
        print(f"wrote {path}\nwrote {heat.draw(path.with_suffix('.png'), *steering.maps(found))}")


@dataclasses.dataclass(frozen=True)
class Render:
    """Render a run's best policy beside the demonstration."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    seconds: float = 10.0
    """Length at most."""
    out: Annotated[Path | None, default("RUN/policy.mp4")] = None
    """File to write; .gif where no encoder is installed."""
    alone: bool = False
    """Leave the demonstration out, whose licence may not let a picture of it be passed on."""

    def __call__(self) -> None:
        runs = _runs()
        from fmpjax.evaluate import Evaluator

        if not 0 < self.seconds < math.inf:
            raise UserError(f"--seconds is {self.seconds:g}: expected a number above 0")
        run = runs.Run.open(self.run)
        trainer, state = run.policy()
        print("rolling out and rendering ...", flush=True)
        played = Evaluator(trainer, 8).play(state.ppo)
        print(f"wrote {runs.video(run, trainer, played, seconds=self.seconds, path=self.out, alone=self.alone)}")


@dataclasses.dataclass(frozen=True)
class Export:
    """Copy a run's results, without its states, to a folder."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    out: tyro.conf.Positional[Path]
    """Folder to write."""
    onnx: bool = False
    """Write policy.onnx and MODEL_CARD.md, too, for other programs; docs/deploy.md."""

    def __call__(self) -> None:
        runs = _runs()
        from fmpjax import deploy, features, robots

        run = runs.Run.open(self.run)
        for path in runs.export(run, self.out, onnx=self.onnx):
            print(f"wrote {path}")
        config = run.config
        for say in (deploy.unmeasured, deploy.no_stock) if self.onnx else ():
            if sentence := say(robots.load(config.robot), features.observation_form(config)):
                print(f"note: {sentence}")


@dataclasses.dataclass(frozen=True)
class Diagnose:
    """Say what is wrong with a run, finished or not, in words."""

    run: tyro.conf.Positional[Path]
    """Folder of the run, or of its exported results."""
    last: bool = False
    """Look at the newest evaluation in place of the best policy's."""

    def __call__(self) -> None:
        from fmpjax import diagnose

        print(diagnose.text(diagnose.read(self.run, last=self.last)))


@dataclasses.dataclass(frozen=True)
class Report:
    """Gather what the experiments found on one page, ours beside the paper's."""

    folder: tyro.conf.Positional[Path]
    """Folder below which their results are."""
    out: Annotated[Path | None, default("FOLDER/report.html")] = None
    """HTML page to write; the same in Markdown stands beside it."""

    def __call__(self) -> None:
        _runs()
        from fmpjax.experiments import report

        for path in report.write(self.folder, self.out or self.folder / "report.html"):
            print(f"wrote {path}")


@dataclasses.dataclass(frozen=True)
class ShowConfig:
    """Print every setting of a preset."""

    preset: tyro.conf.Positional[str] = "laptop"
    """`smoke`, `laptop` or `paper`."""

    def __call__(self) -> None:
        for key, value in configuration.flatten(configuration.preset(self.preset)).items():
            print(f"{key} = {value}")


@dataclasses.dataclass(frozen=True)
class Settings:
    """Explain every setting: its default in each preset, its meaning and what it may be."""

    section: tyro.conf.Positional[str] = ""
    """A section, such as `ppo`, or one setting; all of them where it is left out."""
    markdown: bool = False
    """Print the page docs/settings.md, which has all of them."""

    def __call__(self) -> None:
        from fmpjax.config import explaining

        if self.markdown and self.section:
            raise UserError(f"--markdown prints all settings: expected no section, not {self.section!r}")
        print(explaining.markdown() if self.markdown else explaining.text(self.section), end="")


@dataclasses.dataclass(frozen=True)
class List:
    """List methods, presets, robots and motions, each with what it is."""

    def __call__(self) -> None:
        from fmpjax import motion, priors, robots

        for title, described in (
            ("methods", priors.descriptions()),
            ("presets", configuration.DESCRIPTIONS),
            ("robots", {name: robots.load(name).description for name in robots.available()}),
            ("motions", {name: motion.describe(name) for name in motion.bundled()}),
        ):
            print(f"{title}:\n{tables.aligned(list(described.items()), texts=2)}")


def _runs():
    """`fmpjax.runs`, imported when a command needs it."""
    import jax

    from fmpjax import runs

    machine.keep_compiled()
    try:
        jax.devices()
    except (RuntimeError, AssertionError):  # which of them depends on the plugins that are installed
        platforms = os.environ.get("JAX_PLATFORMS", "")
        raise UserError(
            f"JAX_PLATFORMS is {platforms!r}, and no such device is there: expected cpu, or a device that JAX sees"
        ) from None
    return runs


def _experiment(name: str, *options: str) -> None:
    """Run a study; no other is imported."""
    study = experiments.load(name)
    machine.keep_compiled()
    shell.parse(study, f"fmpjax experiment {name}", options)


EXPERIMENT = shell.Group("Run a study of priors or runs, one per table or figure.", experiments.STUDIES)
COMMANDS = shell.Group(
    "Flow-Matched Motion Priors in JAX. `fmpjax --version` prints the version.",
    {
        "train": Train, "evaluate": Evaluate, "diagnose": Diagnose, "render": Render, "export": Export,
        "sim2sim": Sim2Sim, "experiment": EXPERIMENT, "report": Report, "motion": MOTION, "config": ShowConfig,
        "settings": Settings,
        "list": List,
    },
)  # fmt: skip


def main(arguments: list[str] | None = None) -> None:
    """Entry point: bad input is one sentence and exit code 2."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with shell.ending():
        if arguments == ["--version"]:
            print(f"fmpjax {fmpjax.__version__}")
        elif arguments[:1] == ["experiment"] and len(arguments) > 1 and not arguments[1].startswith("-"):
            _experiment(*arguments[1:])
        else:
            shell.parse(COMMANDS, "fmpjax", arguments)()


if __name__ == "__main__":
    main()
