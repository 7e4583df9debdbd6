"""What is played: a run with its checkpoints, or the file of a policy."""

import copy
import itertools
import re
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np

from fmpjax import config as configuration
from fmpjax import motion, policy, robots, sim2sim
from fmpjax.errors import UserError
from fmpjax.motion import MotionClip
from fmpjax.play.player import Player
from fmpjax.play.reader import Reader

BEST, NEWEST, LIVE = "best", "newest", "live"


class Source(Protocol):
    """Policies of one robot, by name."""

    label: str
    first: str  # name of the policy to begin with
    has_prior: bool  # whether there is a motion prior that scores

    def names(self) -> list[str]:
        """The policies that there are now."""
        ...

    def version(self, name: str) -> str | None:
        """What changes when the name stands for another policy; None where there is none of that name."""
        ...

    def load(self, name: str) -> sim2sim.ExportedPolicy:
        """Read a policy.

        Raises:
          UserError: there is none of that name, or it cannot be read.
        """
        ...

    def player(self, learned: sim2sim.ExportedPolicy) -> Player:
        """A robot that a policy moves."""
        ...

    def score(self, qpos: np.ndarray, qvel: np.ndarray) -> tuple[float, float] | None:
        """What a motion prior says of states ``[H, ...]`` and of its demonstration; None where there is no prior."""
        ...

    def close(self) -> None:
        """Let go of processes and files."""
        ...


class RunSource:
    """A run, which may still train: its checkpoints and, where it is trained with ``--live``, the policy as it is."""

    has_prior = True

    def __init__(self, folder: Path, name: str | None = None):
        """A run folder; ``name`` is of the policy to begin with, the best one by default.

        Raises:
          UserError: it is no run folder, or has no such policy.
        """
        self.folder, self.label = folder, folder.resolve().name
        self.config = configuration.read(folder / "config.json")
        self.robot = robots.load(self.config.robot)
        self.horizon = self.config.features.history  # states that the motion prior sees at once
        self._reader = Reader(folder)
        names = self.names()
        if not names:
            raise UserError(f"run {folder} has no checkpoint: train the run first")
        self.first = names[0] if name is None else name
        if self.first not in names:
            raise UserError(f"run {folder} has no policy {name!r}: expected one of {', '.join(names)}")
        self._scored = False

    def names(self) -> list[str]:
        """Best, newest and live, if they exist, then the iterations of the checkpoints, the last first."""
        numbers = _numbers(self.folder / "checkpoints")
        live = (self.folder / policy.LIVE).is_file()
        kinds = ((BEST, _numbers(self.folder / "best")), (NEWEST, numbers), (LIVE, live))
        return [name for name, there in kinds if there] + [str(number) for number in numbers]

    def version(self, name: str) -> str | None:
        """An iteration, or the time at which the live policy was written."""
        try:
            if name == LIVE:
                return str((self.folder / policy.LIVE).stat().st_mtime_ns)
            numbers = _numbers(self.folder / ("best" if name == BEST else "checkpoints"))
            return str(numbers[0]) if name in (BEST, NEWEST) else {str(n): str(n) for n in numbers}[name]
        except (OSError, IndexError, KeyError):
            return None

    def load(self, name: str) -> sim2sim.ExportedPolicy:
        """Read a policy; the names are those of `names` and no others, so that no name leads out of the folder."""
        version = self.version(name)
        if version is None:
            raise UserError(f"run {self.folder} has no policy {name!r}: expected one of {', '.join(self.names())}")
        self._scored = name != LIVE
        if name == LIVE:
            return read_npz(self.folder / policy.LIVE)
        return read_npz(self._reader.policy(int(version), best=name == BEST))

    def player(self, learned: sim2sim.ExportedPolicy) -> Player:
        """A robot in the physics of the training."""
        physics = self.config.physics
        model = copy.copy(self.robot.model)
        for option in ("timestep", "iterations", "ls_iterations"):
            setattr(model.opt, option, getattr(physics, option))
        model.dof_frictionloss[6:] = physics.frictionloss
        clips = self._clips()
        poses = clips[0].qpos[:, 7:] if clips and self.config.command.kind == "phase" else None
        simulation = sim2sim.Simulation(learned, self.robot.path, model=model, poses=poses)
        return Player(self.label, simulation, clips, in_motion=self.config.env.reset == "dataset")

    def score(self, qpos: np.ndarray, qvel: np.ndarray) -> tuple[float, float] | None:
        """What the prior of the checkpoint that was read last says; None for one of another version, and for live."""
        if not self._scored or len(qpos) < self.horizon:
            return None
        try:
            return self._reader.score(qpos[-self.horizon :], qvel[-self.horizon :])
        except UserError:
            self._scored = False
            return None

    def close(self) -> None:
        """End the process that reads checkpoints."""
        self._reader.close()

    def _clips(self) -> tuple[MotionClip, ...]:
        """The demonstrations as the run's folder holds them."""
        rate = round(self.config.control_rate, 6)
        files = (self.folder / f"demonstration{f'-{i}' if i > 1 else ''}.npz" for i in itertools.count(1))
        held = itertools.takewhile(Path.is_file, files)
        return tuple(motion.load(path, rate=rate, robot=self.config.robot) for path in held)


class FileSource:
    """The file of a policy: policy.onnx, or policy.npz as `fmpjax export` writes it."""

    has_prior = False

    def __init__(self, path: Path, model: Path | None = None):
        """The file, on an MJCF model or the robot of its training."""
        self.path, self._model = path, model
        self.label = path.stem if path.parent.name in ("", "exported") else path.resolve().parent.name
        self.first = path.name

    def names(self) -> list[str]:
        """The file alone."""
        return [self.path.name]

    def version(self, name: str) -> str | None:
        """A file does not change."""
        return "" if name == self.path.name else None

    def load(self, name: str) -> sim2sim.ExportedPolicy:
        """Read the file."""
        if name != self.path.name:
            raise UserError(f"{self.path.parent} has no policy {name!r}: expected {self.path.name}")
        return read_npz(self.path) if self.path.suffix == ".npz" else sim2sim.load(self.path)

    def player(self, learned: sim2sim.ExportedPolicy) -> Player:
        """A robot on the model that was named, or on that of the training."""
        if self._model is not None:
            return Player(self.label, sim2sim.Simulation(learned, self._model))
        robot = robots.load(learned.robot)
        if robot.joint_names != learned.joint_names:
            raise UserError(f"{self.path} moves other joints than {robot.name} has: name its model with --model")
        model: mujoco.MjModel = copy.copy(robot.model)
        model.opt.timestep = learned.physics_dt
        model.dof_frictionloss[6:] = learned.facts["joint_friction"]
        return Player(self.label, sim2sim.Simulation(learned, robot.path, model=model))

    def score(self, qpos: np.ndarray, qvel: np.ndarray) -> tuple[float, float] | None:
        """No prior is in the file."""
        return None

    def close(self) -> None:
        """Nothing is open."""


def of(path: Path, *, name: str | None = None, model: Path | None = None) -> RunSource | FileSource:
    """The source that a run folder, an exported folder or a policy's file is.

    Args:
      path: the folder or the file.
      name: of the run's policy to begin with.
      model: MJCF file for a policy's file.

    Raises:
      UserError: it is none, or the other options do not go with it.
    """
    if path.is_dir():
        exported = [file for file in (path / "policy.npz", path / "policy.onnx") if file.is_file()]
        is_run = (path / "config.json").is_file()
        trained = any((path / kind).is_dir() for kind in ("checkpoints", "best")) or (path / policy.LIVE).is_file()
        if is_run and (trained or not exported):
            if model is not None:
                raise UserError(f"--model goes with the file of a policy: {path} is a run, which has its own robot")
            return RunSource(path, name)
        if not exported:
            raise UserError(f"{path} is no run folder: expected config.json in it, or policy.npz or policy.onnx")
        path = exported[0]
    if name is not None:
        raise UserError(f"--checkpoint goes with a run: {path} is the file of one policy")
    if not path.is_file() or path.suffix not in (".onnx", ".npz"):
        raise UserError(f"{path} cannot be played: expected a run folder, policy.onnx or policy.npz")
    return FileSource(path, model)


def read_npz(path: Path) -> sim2sim.ExportedPolicy:
    """A policy that NumPy runs.

    Raises:
      UserError: the file cannot be read, or does not say what its robot is.
    """
    learned = policy.load(path)

    def act(observation: np.ndarray) -> np.ndarray:
        return (learned(observation) - learned.center) / learned.scale

    shapes = (1, len(learned.mean)), (1, len(learned.joint_names))
    return sim2sim.read(path, policy.metadata(path), act, shapes)


def _numbers(folder: Path) -> list[int]:
    """Iterations of the checkpoints in a folder, the last one first; a checkpoint that is half written has none."""
    found = folder.iterdir() if folder.is_dir() else []
    return sorted((int(path.name) for path in found if re.fullmatch(r"\d+", path.name)), reverse=True)
