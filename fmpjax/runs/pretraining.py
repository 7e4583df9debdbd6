"""What a method learns of the demonstrations before any policy: made once, and kept in the user's cache folder.

A folder there is named after a hash of all that the result depends on. It holds ``learned.npz``, the figures of the
training (``metrics.csv``, ``tensorboard/``, ``curves.png``) and ``settings.json``, which says what it is.
"""

import contextlib
import dataclasses
import hashlib
import math
import shutil
import tempfile
import time
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from filelock import FileLock, Timeout

from fmpjax import jsons, machine, sharding
from fmpjax.errors import UserError
from fmpjax.files import write
from fmpjax.logs import MetricsLog, Progress, clock
from fmpjax.provenance import provenance
from fmpjax.trainer import Trainer, TrainState
from fmpjax.viz import curves

FORMAT = 1  # of what is kept, and of the features; another one makes all that was kept before unknown
ROWS = 200  # of the table, at most
SEED = 0  # of the training, which is the same for all runs
FOLDER = "pretraining"  # of a run, with the loss curve
_LEARNED = "learned.npz"


def identity(trainer: Trainer) -> str:
    """A hash of the demonstrations, the robot and the settings that a trainer's pretraining depends on."""
    config, library = trainer.config, trainer.library
    assert trainer.prior.pretraining is not None
    told = {
        "format": FORMAT,
        "method": config.method,
        "settings": dict(trainer.prior.pretraining.settings),
        "features": dataclasses.asdict(config.features),
        "windows": [config.env.demonstration_parts, config.env.early_frames, config.control_rate],
        "precision": config.precision,
        "clips": [library.lengths.tolist(), list(library.weights)],
    }
    found = hashlib.sha256(jsons.dumps(told).encode())
    for samples in (library.qpos, library.qvel):
        found.update(samples.astype(np.float32).tobytes())
    for file in (trainer.robot.path, trainer.robot.path.with_name("robot.toml")):
        found.update(file.read_bytes())
    return found.hexdigest()[:16]


def folder_of(trainer: Trainer) -> Path | None:
    """Where the cache has, or will have, the trainer's pretraining; None where there is no cache folder."""
    cache = machine.cache_folder("pretrained")
    return None if cache is None else cache / f"{trainer.config.method}-{identity(trainer)}"


def pretrain(trainer: Trainer, folder: Path, progress: Progress, *, again: bool = False) -> Any:
    """What the trainer's method learns before any policy: what a folder holds or, where it holds none, trained now.

    One process at a time trains it; those that begin meanwhile wait, and read it. Where the file system has no locks,
    each trains.

    Args:
      trainer: of a method with a pretraining.
      folder: that `folder_of` gives, or another one.
      progress: says what is done.
      again: train also where the folder holds it.

    Raises:
      UserError: the loss was not finite, or the folder cannot be written.
    """
    lock = FileLock(folder.with_name(f".{folder.name}.lock"))
    try:
        try:
            lock.acquire(timeout=0)
        except NotImplementedError:
            progress.note(f"{folder.parent} has no locks: runs that start together pretrain each for itself")
        except Timeout:
            progress.note(f"another process pretrains {trainer.config.method} on the demonstration: waiting for it")
            lock.acquire()
        return _pretrain(trainer, folder, progress, again)
    except OSError as error:
        raise UserError(f"{folder} cannot be written: {error.strerror or error}") from None
    finally:
        lock.release()


def _pretrain(trainer: Trainer, folder: Path, progress: Progress, again: bool) -> Any:
    method = trainer.config.method
    if folder.exists() and not again:
        with contextlib.suppress(OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile):
            kept = _read(folder / _LEARNED, trainer)
            progress.note(f"{method} is pretrained on the demonstration already, in {folder}")
            return kept
        progress.note(f"{folder} cannot be read: pretraining again")
    partial = Path(tempfile.mkdtemp(prefix=".partial-", dir=folder.parent))
    try:
        learned = _train(trainer, partial, progress)
        shutil.rmtree(folder, ignore_errors=True)
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return learned


def pretrained(
    trainer: Trainer, states: Sequence[TrainState], runs: Sequence[Path], progress: Progress
) -> list[TrainState]:
    """The states with what their method learns before any policy; the runs' folders get its loss curve.

    Of several processes the first one trains.

    Raises:
      UserError: the loss was not finite.
    """
    pretraining = trainer.prior.pretraining
    if pretraining is None or all(bool(pretraining.finished(state.prior)) for state in states):
        return list(states)
    learned, refused = pretraining.learned(states[0].prior), None
    if sharding.primary():
        try:
            folder = folder_of(trainer) or runs[0] / FOLDER
            learned = pretrain(trainer, folder, progress)
            ignored = shutil.ignore_patterns(_LEARNED)
            for copy in (run / FOLDER for run in runs):
                if copy != folder:
                    shutil.copytree(folder, copy, ignore=ignored, dirs_exist_ok=True)
        except UserError as error:
            refused = error
    if not sharding.agree(refused is None):
        raise refused or UserError("the first process stopped with an error: see its message")
    learned = sharding.first(learned)
    # A compiled chunk is given its state's buffers to write into, so no two leaves may share one.
    return [state._replace(prior=jax.tree.map(jnp.copy, pretraining.put(state.prior, learned))) for state in states]


def _train(trainer: Trainer, folder: Path, progress: Progress) -> Any:
    """Train, and write the result and its loss curve into a folder."""
    pretraining, method = trainer.prior.pretraining, trainer.config.method
    assert pretraining is not None
    count, began = pretraining.iterations, time.monotonic()
    said = ", ".join(f"{name}={value}" for name, value in pretraining.settings.items())
    progress.note(f"pretraining {method} on the demonstration, {count:,} iterations: {said}")
    first, key = jax.random.split(jax.random.PRNGKey(SEED))
    with trainer.precision():
        state = jax.jit(trainer.prior.init)(first)
        advance = jax.jit(pretraining.advance).lower(state, key, 0).compile()
    log = MetricsLog(folder, ["pretraining/loss", "pretraining/skipped"])
    every, seconds, loss = math.ceil(count / ROWS), 0.0, math.nan
    for done in [*range(every, count, every), count]:
        started = time.monotonic()
        state, figures = jax.device_get(advance(state, key, done))
        seconds += time.monotonic() - started
        loss = float(figures["loss"])
        log.write(done, None, seconds, {f"pretraining/{name}": float(value) for name, value in figures.items()})
        left = seconds / done * (count - done)
        progress.show(f"pretraining {done:,} of {count:,} | loss {loss:.4f} | {clock(left)} left", final=done == count)
        if not math.isfinite(loss):
            break
    log.close()
    learned = jax.device_get(pretraining.learned(state))
    if not all(np.isfinite(leaf).all() for leaf in [loss, *jax.tree.leaves(learned)]):
        raise UserError(
            f"the pretraining of {method} gave numbers that are not finite: expected a smaller {method}.learning_rate "
            f"(now {getattr(trainer.config, method).learning_rate:g})"
        )
    curves.learning_curves(folder / "metrics.csv", folder / "curves.png")
    np.savez(folder / _LEARNED, **{str(i): leaf for i, leaf in enumerate(jax.tree.leaves(learned))})
    told = {
        "method": method,
        "robot": trainer.robot.name,
        "motions": [[clip.name, w] for clip, w in zip(trainer.library.clips, trainer.library.weights, strict=True)],
        "settings": dict(pretraining.settings),
        "loss": loss,
        "seconds": round(time.monotonic() - began, 2),
        "provenance": provenance(),
    }
    write(folder / "settings.json", jsons.dumps(told))
    return learned


def _read(file: Path, trainer: Trainer) -> Any:
    """What a file holds, as `_train` wrote it; a `ValueError` or `KeyError` where it is of another shape."""
    pretraining = trainer.prior.pretraining
    assert pretraining is not None
    like = jax.eval_shape(lambda key: pretraining.learned(trainer.prior.init(key)), jax.random.PRNGKey(0))
    leaves, structure = jax.tree.flatten(like)
    with np.load(file) as saved:
        found = [saved[str(i)] for i in range(len(leaves))]
    for leaf, expected in zip(found, leaves, strict=True):
        if leaf.shape != expected.shape or leaf.dtype != expected.dtype:
            raise ValueError(f"{leaf.dtype}{leaf.shape}")
    return jax.tree.unflatten(structure, found)
