"""Saving and restoring a run's whole state (orbax), atomically.

A checkpoint is a flat mapping from a leaf's path in `TrainState` to its array, so that a file says what it holds and a
mismatch can be named. Orbax writes to a temporary folder and renames it: a kill leaves the checkpoint before it good.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from fmpjax.errors import UserError
from fmpjax.trainer import TrainState

KEEP = 3  # last checkpoints kept


def _flatten(state: TrainState) -> dict[str, Any]:
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


class Checkpoints:
    """The checkpoints of one run folder: the last few in ``checkpoints/``, the best one in ``best/``."""

    def __init__(self, run: Path):
        self.run = Path(run).resolve()

    def _manager(self, kind: str, keep: int) -> ocp.CheckpointManager:
        # Of several processes each reads for itself, and the first alone writes: none waits for another.
        alone = ocp.options.MultiprocessingOptions(
            primary_host=jax.process_index(), active_processes={jax.process_index()}
        )
        options = ocp.CheckpointManagerOptions(
            max_to_keep=keep, create=False, enable_async_checkpointing=False, multiprocessing_options=alone
        )
        folder = self.run / kind
        folder.mkdir(parents=True, exist_ok=True)
        return ocp.CheckpointManager(folder, options=options)

    def save(self, state: TrainState, *, best: bool = False) -> None:
        """Write the state under its iteration's number."""
        kind, keep = ("best", 1) if best else ("checkpoints", KEEP)
        with self._manager(kind, keep) as manager:
            step = int(state.iteration)
            if step not in manager.all_steps():
                manager.save(step, args=ocp.args.StandardSave(jax.tree.map(np.asarray, _flatten(state))), force=True)

    def iterations(self, *, best: bool = False) -> set[int]:
        """Iterations of the checkpoints."""
        kind = "best" if best else "checkpoints"
        return {int(p.name) for p in (self.run / kind).glob("*") if p.name.isdigit()}

    def latest(self, *, best: bool = False) -> int | None:
        """Iteration of the newest checkpoint, or None."""
        return max(self.iterations(best=best), default=None)

    def restore(self, like: TrainState, iteration: int | None = None, *, best: bool = False) -> TrainState:
        """A checkpoint, by default the newest, or the best one, in the structure of ``like``: arrays, or their shapes.

        Raises:
          UserError: there is none, it cannot be read, or it is of another configuration.
        """
        folder, saved = self._read(iteration, best)
        expected = _flatten(like)
        if set(saved) != set(expected):
            name = sorted(set(saved) ^ set(expected))[0]
            raise UserError(f"checkpoint {folder} is of another configuration: {name} is in only one of the two")
        for name, leaf in expected.items():
            if saved[name].shape != leaf.shape or saved[name].dtype != leaf.dtype:
                raise UserError(
                    f"checkpoint {folder} is of another configuration: {name} is {saved[name].dtype}"
                    f"{list(saved[name].shape)}, expected {leaf.dtype}{list(leaf.shape)}"
                )
        leaves = [jnp.asarray(np.asarray(saved[name])) for name in expected]
        return jax.tree.unflatten(jax.tree.structure(like), leaves)

    def part(self, name: str, iteration: int | None = None, *, best: bool = False) -> Any:
        """A part of a checkpoint's state by itself, such as ``ppo.actor``: nested dictionaries of arrays.

        The rest of the state may be of another version of the program.

        Raises:
          UserError: there is no checkpoint, it cannot be read, or it has no such part.
        """
        folder, saved = self._read(iteration, best)
        found: dict[str, Any] = {}
        for path, leaf in saved.items():
            if not path.startswith(name + "."):
                continue
            *parents, last = path.removeprefix(name + ".").split(".")
            inner = found
            for key in parents:
                inner = inner.setdefault(key, {})
            inner[last] = np.asarray(leaf)
        if not found:
            raise UserError(f"checkpoint {folder} is of another configuration: it has no {name}")
        return found

    def _read(self, iteration: int | None, best: bool) -> tuple[Path, dict[str, Any]]:
        """Folder and leaves of a checkpoint."""
        step = self.latest(best=best) if iteration is None else iteration
        kind = "best" if best else "checkpoints"
        if step is None:
            raise UserError(f"run {self.run} has no checkpoint in {kind}/: train the run first")
        folder = self.run / kind / str(step)
        try:
            with self._manager(kind, KEEP) as manager:
                saved = manager.restore(step, args=ocp.args.StandardRestore())
        except Exception as error:  # orbax and tensorstore raise many kinds for a damaged folder
            cause = str(error).strip().splitlines()[0][:120] if str(error).strip() else type(error).__name__
            raise UserError(f"checkpoint {folder} cannot be read ({cause}): expected a complete checkpoint") from None
        return folder, saved
