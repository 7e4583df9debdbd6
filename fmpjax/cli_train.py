"""The command `fmpjax train`."""

import contextlib
import dataclasses
import os
import time
from pathlib import Path
from typing import Annotated, Any

import tyro

from fmpjax import cli_settings, machine
from fmpjax import config as configuration
from fmpjax.cli_settings import preset_default
from fmpjax.errors import UserError
from fmpjax.shell import default


def runs_module():
    """`fmpjax.runs`, imported when a command needs it."""
    import jax

    from fmpjax import runs

    machine.keep_compiled()
    try:
        jax.devices()
    except (RuntimeError, AssertionError):  # which of them depends on the plugins that are installed
        platforms = os.environ.get("JAX_PLATFORMS", "")
        raise UserError(
            f"JAX_PLATFORMS is {platforms!r}, but JAX finds no such device: expected cpu, or a device of this machine"
        ) from None
    return runs


# Settings without an option of their section: each command has its own for them, or does without.
_NAMED = ("preset", "method", "robot", "motion", "frames", "seed", "transitions")

_Settings = Annotated[Any, tyro.conf.arg(name="", constructor_factory=lambda: cli_settings.options(*_NAMED))]


@dataclasses.dataclass(frozen=True)
class Pretrain:
    """Train what a method learns before the policy, and keep it for all runs."""

    method: tyro.conf.Positional[str]
    """`smp`, whose diffusion model is trained first."""
    preset: Annotated[str | None, default("laptop on a CPU, paper on an accelerator")] = None
    """`smoke`, `laptop`, `robust`, `robot` or `paper`."""
    robot: Annotated[str | None, preset_default("robot")] = None
    """A shipped robot, or a robot's folder."""
    motion: Annotated[str | None, preset_default("motion")] = None
    """Motions as `fmpjax train` takes them."""
    frames: Annotated[str | None, default("all")] = None
    """Source rows first:last of the motion, 0-based, both included; of several motions with commas between them."""
    command: Annotated[str | None, default("none")] = None
    """The command of the runs; commands imply heading axes."""
    again: bool = False
    """Train again even if the cache has it."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Any other setting as section.field=value; `smp.network=published` is the published network."""
    settings: _Settings = dataclasses.field(default_factory=lambda: cli_settings.options(*_NAMED)())

    def __call__(self) -> None:
        from fmpjax import priors

        priors.check_pretrained(self.method)
        runs = runs_module()
        from fmpjax.logs import Progress
        from fmpjax.motion import library
        from fmpjax.trainer import Trainer

        named = {"robot": self.robot, "motion": self.motion, "frames": self.frames}
        changes = cli_settings.changes(self.settings, self.set, {**named, "method": self.method})
        changes = configuration.commanded(self.command, changes, self.preset)
        config = configuration.preset(self.preset or runs.default_preset(), **changes)
        config = configuration.with_changes(config, {"motion": library.listed(config.motion)})
        runs.check_trainable(config)
        trainer = Trainer(config, runs.load_motion(config))
        folder = runs.pretraining.folder_of(trainer)
        if folder is None:
            raise UserError(
                "there is no cache folder for the pretrained model: expected a home folder, or one in XDG_CACHE_HOME"
            )
        runs.pretraining.pretrain(trainer, folder, Progress(), again=self.again)
        for name in ("metrics.csv", "curves.png", "settings.json"):
            print(f"in the cache: {folder / name}")


@dataclasses.dataclass(frozen=True)
class Train:
    """Train a policy from a demonstration."""

    method: Annotated[str | None, preset_default("method")] = None
    """Motion prior; `fmpjax list` shows all of them. `add` and `tracking` also set the command `phase`."""
    reset: Annotated[str | None, preset_default("env.reset")] = None
    """`dataset` (a demonstration state) or `fixed` (the default pose)."""
    preset: Annotated[str | None, default("laptop on a CPU, paper on an accelerator")] = None
    """`smoke`, `laptop`, `robust`, `robot` or `paper`; `fmpjax list` says what each is for."""
    robot: Annotated[str | None, preset_default("robot")] = None
    """A shipped robot, or a robot's folder."""
    motion: Annotated[str | None, preset_default("motion")] = None
    """A bundled motion's name, a file, a folder of files or an address (https://, hf://); several with weights as
    NAME[:WEIGHT],NAME[:WEIGHT]."""
    command: Annotated[str | None, default("none, or the run's own with --resume")] = None
    """What the policy is told: `none`, `velocity` (with the motions `gaits` by default), `phase`,
    or `motion` (one of several); docs/steering.md."""
    accept_license: bool = False
    """Accept the license of a Hugging Face data set without a question."""
    frames: Annotated[str | None, default("all")] = None
    """Source rows first:last of the motion, 0-based, both included; of several motions with commas between them."""
    seed: Annotated[int | None, preset_default("seed")] = None
    """Seed of everything that is random."""
    seeds: Annotated[int | None, default("a single run")] = None
    """Number of seeds to train at once, beginning with --seed, in one program: runs RUN/seed0, RUN/seed1, and so on."""
    transitions: Annotated[int | None, preset_default("transitions")] = None
    """Budget of environment steps; with --resume, a larger one continues a finished run."""
    run: Annotated[Path | None, default("runs/METHOD-DATE-TIME")] = None
    """Folder of the run."""
    minutes: Annotated[float | None, default("no limit")] = None
    """Time budget: the run ends cleanly and can be resumed."""
    devices: int = 1
    """Devices that share the environments, or the seeds; 0 for every one that JAX sees."""
    distributed: bool = False
    """One of several processes that train together on all their devices, as SLURM starts them; see docs/scaling.md."""
    coordinator: Annotated[str | None, default("as the scheduler says")] = None
    """HOST:PORT of the first process, if no scheduler provides it."""
    processes: Annotated[int | None, default("as the scheduler says")] = None
    """Number of processes, likewise."""
    process: Annotated[int | None, default("as the scheduler says")] = None
    """Number of this process, from 0, likewise."""
    resume: bool = False
    """Continue the run in --run, with its settings."""
    live: bool = False
    """Show the policy as it trains in a page of the browser; docs/play.md."""
    port: int = 8080
    """Port of that page; 0 for any that is free."""
    pictures: bool = True
    """Draw frames, learning curves and a video at the end, which takes some seconds."""
    logger: Annotated[str | None, default("none")] = None
    """`wandb` (Weights & Biases) or `trackio`, which get the figures of metrics.csv; they stay on this machine."""
    set: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Any setting as section.field=value, in place of its option below; `fmpjax settings` also explains the letters in
    brackets."""
    settings: _Settings = dataclasses.field(default_factory=lambda: cli_settings.options(*_NAMED)())

    def __call__(self) -> None:
        if self.minutes is not None and not self.minutes > 0:
            raise UserError(f"--minutes is {self.minutes:g}: expected more than 0")
        if self.seeds is not None and self.seeds < 1:
            raise UserError(f"--seeds is {self.seeds}: expected at least 1")
        if self.devices < 0:
            raise UserError(f"--devices is {self.devices}: expected 0 (for all) or more")
        if self.live:
            from fmpjax import play

            if self.distributed:
                raise UserError("--live does not go with --distributed: `fmpjax play RUN` shows the checkpoints")
            play.check_installed()
        if self.logger is not None:
            from fmpjax import logs

            logs.check_logger(self.logger)
        began = time.monotonic()
        self._connect()
        runs = runs_module()
        devices = None if self.distributed else self.devices or None
        if self.resume:
            group = self._resumed()
            self._extend(group)
        else:
            group = self._begun(devices)
        minutes = None if self.minutes is None else self.minutes - (time.monotonic() - began) / 60
        page = runs.Live(group, self.port) if self.live else None
        with page or contextlib.nullcontext():
            end = runs.train(
                *group, resume=self.resume, minutes=minutes, devices=devices, live=page, logger=self.logger
            )
        from fmpjax import sharding

        # Who sends a signal wants the process to end, not to film.
        if end is not runs.End.SIGNAL and sharding.primary():
            for run in group:
                for path in runs.finish(run, pictures=self.pictures):
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
        runs = runs_module()
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
            raise UserError(f"run {self.run} has {len(folders)} seeds: it cannot continue with {self.seeds}")
        group = [runs.Run.open(folder) for folder in folders]
        saved = configuration.flatten(group[0].config)
        if self.preset is not None and self.preset != saved["preset"]:
            raise UserError(f"run {self.run} has preset {saved['preset']!r}: it cannot continue as {self.preset!r}")
        asked = configuration.flatten(configuration.with_changes(group[0].config, changes))
        longer = asked["transitions"] > saved["transitions"]
        for key in changes:
            if asked[key] != saved[key] and not (key == "transitions" and longer):
                raise UserError(f"run {self.run} has {key} {saved[key]!r}: it cannot continue with {asked[key]!r}")
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
            raise refused or UserError("the first process stopped with an error: see its message")
        return group or self._resumed()

    def _created(self, devices: int | None):
        runs = runs_module()
        from fmpjax import sharding
        from fmpjax.motion import library

        config = configuration.preset(self.preset or runs.default_preset(), **self._changes())
        if self.accept_license:
            library.accept_license(config.motion)
        config = configuration.with_changes(config, {"motion": library.listed(config.motion)})
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
        changes = cli_settings.changes(self.settings, self.set, named)
        if self.resume:
            return changes | ({} if self.command is None else {"command.kind": self.command})
        return configuration.commanded(self.command, changes, self.preset)
