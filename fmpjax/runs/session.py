"""Runs that are trained at once: one program, its state, and where it starts from."""

import time
from collections.abc import Sequence

import jax
import numpy as np

from fmpjax import config as configuration
from fmpjax import sharding
from fmpjax.config import Config
from fmpjax.errors import UserError
from fmpjax.logs import Progress
from fmpjax.runs import pretraining
from fmpjax.runs.folder import Run
from fmpjax.trainer import Trainer, TrainState, stack, unstack


class Session:
    """Runs that differ in nothing but their seeds, as one program."""

    def __init__(self, group: Sequence[Run], *, resume: bool = False):
        """The state to begin with; nothing is compiled yet.

        Raises:
          UserError: the runs differ in more, or with ``resume`` have no checkpoint of one iteration in common.
        """
        self.group = group
        self.config = group[0].config
        self.trainer = shared_trainer(group)
        self.states = first_states(self.trainer, group, resume)  # one for each run, on the devices
        self.evaluator = group[0].evaluator()
        for run in group[1:]:
            run.share(group[0])

    @property
    def done(self) -> int:
        """Iterations so far."""
        return int(self.states[0].iteration)

    def pretrain(self, progress: Progress) -> None:
        """Learn what the method learns before any policy, or take it from the cache; nothing where that is done."""
        self.states = pretraining.pretrained(self.trainer, self.states, [run.folder for run in self.group], progress)

    def compile(self, devices: int | None) -> None:
        """Compile the program for a number of devices, all of them for None."""
        state = self.states[0] if len(self.group) == 1 else stack(self.states)
        if devices != 1:
            state = self.trainer.place(state, sharding.mesh(devices))
        self._state, self._program = state, self.trainer.compile(state)

    def metric_names(self) -> list[str]:
        """Names of the metrics of an iteration; the program is compiled before."""
        form = self._program.out_tree
        return sorted(jax.tree.unflatten(form, range(form.num_leaves))[1])

    def advance(self) -> tuple[list[dict[str, float]], float]:
        """Call the program once: each run's metrics, and the seconds that it took."""
        started = time.monotonic()
        self._state, metrics = self._program(self._state)
        metrics = jax.device_get(metrics)
        took = time.monotonic() - started
        self.states = [self._state] if len(self.group) == 1 else unstack(self._state)
        rows = [{name: float(np.ravel(value)[i]) for name, value in metrics.items()} for i in range(len(self.group))]
        return rows, took

    def check_finite(self) -> None:
        """Raise a `UserError` where a run had too much that was not finite; the state before the last is written."""
        for run, state in zip(self.group, self.states, strict=True):
            _check_finite(run, state, self.config)

    def on_host(self) -> list[TrainState]:
        """Each run's whole state in this process's memory; all processes call it at the same point."""
        return [sharding.on_host(state) for state in self.states]


def shared_trainer(group: Sequence[Run]) -> Trainer:
    """The trainer of runs that differ in nothing but their seeds.

    Raises:
      UserError: they differ in more.
    """
    first = configuration.flatten(group[0].config)
    for run in group[1:]:
        for key, value in configuration.flatten(run.config).items():
            if key != "seed" and value != first[key]:
                raise UserError(
                    f"run {run.folder} has {key} {value!r} and run {group[0].folder} {first[key]!r}: "
                    "runs that train together may differ only in their seeds"
                )
    return group[0].trainer()


def first_states(trainer: Trainer, group: Sequence[Run], resume: bool) -> list[TrainState]:
    """The states to begin with: those of the newest checkpoint that all runs have, or those of their seeds.

    Raises:
      UserError: there are checkpoints, and none that all runs have.
    """
    if not resume:
        return [trainer.init(run.config.seed) for run in group]
    newest = [run.checkpoints.iterations() for run in group]
    # Where the newest are gone the best one is a whole state, too.
    saved = [found | run.checkpoints.iterations(best=True) for found, run in zip(newest, group, strict=True)]
    common = set.intersection(*newest) or set.intersection(*saved)
    if not common:
        if any(saved):  # never start again over what is there
            has = ", ".join(f"{r.folder} has {sorted(found) or 'none'}" for r, found in zip(group, saved, strict=True))
            raise UserError(f"{has}: expected a checkpoint of one iteration in all runs; resume each alone with --seed")
        return [trainer.init(run.config.seed) for run in group]
    start, like = max(common), trainer.shapes()
    return [
        run.checkpoints.restore(like, start, best=start not in found) for run, found in zip(group, newest, strict=True)
    ]


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
