"""A run folder: what it holds, and how it is made, opened and read."""

import dataclasses
import json
from datetime import datetime
from pathlib import Path
from typing import Any

import jax

from fmpjax import config as configuration
from fmpjax import jsons, memory, motion, priors, robots
from fmpjax.checkpoint import Checkpoints
from fmpjax.commands import velocity
from fmpjax.config import Config
from fmpjax.env import window_count
from fmpjax.errors import UserError
from fmpjax.evaluate import Evaluation, Evaluator
from fmpjax.files import write
from fmpjax.motion.summary import summary
from fmpjax.provenance import provenance
from fmpjax.trainer import Trainer, TrainState


def default_preset() -> str:
    """Name of the preset for the device that JAX computes on."""
    return "laptop" if jax.default_backend() == "cpu" else "paper"


def default_folder(config: Config) -> Path:
    """A new run's folder where none is named, by its method and the time."""
    return Path("runs") / f"{config.method}-{datetime.now().strftime('%Y%m%d-%H%M%S')}"


def check_trainable(config: Config, seeds: int = 1) -> None:
    """Ask before there is a folder, which the corrected call would find taken, whether runs can be trained here.

    Raises:
      UserError: the method, the robot or a motion is unknown, or ``seeds`` runs at once do not fit the memory.
    """
    priors.check(config.method)
    robots.load(config.robot)
    memory.check(config, seeds)  # before the motions are read, which may be large
    memory.check(config, seeds, window_count(load_motion(config), config))


def load_motion(config: Config) -> motion.MotionLibrary:
    """The demonstrations that a configuration names, at its control rate."""
    return motion.load_library(
        config.motion, frames=config.frames or None, rate=round(config.control_rate, 6), robot=config.robot
    )


def describe(config: Config) -> str:
    """What the motions of a configuration were read as, and whether they are fit to learn from with its settings."""
    library = load_motion(config)
    said = summary(
        robots.load(config.robot),
        library,
        axes=config.features.axes,
        reset=config.env.reset,
        seconds=config.env.episode_steps / config.control_rate,
    )
    if config.command.kind == "velocity" and (far := velocity.beyond(velocity.told(config.command), library)):
        said += f"\n  warning: {far}"
    return said


class Run:
    """A run folder.

    ``config.json`` has its settings, ``provenance.json`` its origin; ``demonstration.npz`` is the resampled clip, and
    ``demonstration-2.npz`` and so on are further ones; ``metrics.csv`` and ``tensorboard/`` have the metrics;
    ``checkpoints/`` and ``best/`` have its states.
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
            raise UserError(
                f"run folder {run.folder} holds a run already: continue with --resume, or name another --run"
            )
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
        """Give the run a larger budget, in transitions; further evaluations are at shares of the new budget."""
        longer = dataclasses.replace(self.config, transitions=transitions)
        write(self.folder / "config.json", configuration.to_json(longer))
        self._trainer = None

    def resumed(self) -> None:
        """Say in the provenance that this process continues the run."""
        made, here = self.provenance(), provenance()
        again = {key: here[key] for key in ("command", "date", "commit", "uncommitted_changes", "device")}
        made |= {"resumed": [*made.get("resumed", []), again]}
        write(self.folder / "provenance.json", jsons.dumps(made))

    def provenance(self) -> dict[str, Any]:
        """The contents of ``provenance.json``.

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

    def share(self, other: "Run") -> None:
        """Use the parts of another run, which differs in its seed alone."""
        self._trainer, self._evaluator = other.trainer(), other.evaluator()

    def _demonstration_files(self, count: int) -> list[Path]:
        return [self.folder / f"demonstration{f'-{i + 1}' if i else ''}.npz" for i in range(count)]

    def _demonstration(self, config: Config) -> motion.MotionLibrary:
        """The clips as the folder holds them: the first process and a resumed one see the same bits."""
        motions = self.motions(config)
        clips = [
            dataclasses.replace(
                motion.load(path, rate=round(config.control_rate, 6), robot=config.robot),
                name=motion.library.title(name),
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
        """The run's trainer and its best state, or its newest state if no evaluation selected a best one."""
        trainer = self.trainer()
        best = best and self.checkpoints.latest(best=True) is not None
        return trainer, self.checkpoints.restore(trainer.shapes(), best=best)

    def save_evaluation(self, evaluation: Evaluation, name: str = "evaluation") -> None:
        write(self.folder / f"{name}.json", evaluation.to_json())
