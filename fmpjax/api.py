"""Training in one call, for Python programs and notebooks."""

import time
from pathlib import Path
from typing import Any

from fmpjax import config as configuration
from fmpjax import logs, runs
from fmpjax.config import Config
from fmpjax.errors import UserError
from fmpjax.motion import library
from fmpjax.runs import Run


def train(
    config: Config | None = None,
    *,
    command: str | None = None,
    preset: str | None = None,
    folder: str | Path | None = None,
    minutes: float | None = None,
    resume: bool = False,
    logger: str | None = None,
    **settings: Any,
) -> Run:
    """Train a policy from a demonstration, as the command ``fmpjax train`` does, and return its run.

    At the end the best policy is evaluated, and its figures, curves and film are written into the run folder. Ctrl-C
    (or an interrupted notebook cell) saves the run and ends the training without these files.

    Args:
      config: the settings; by default those of ``preset``.
      command: what the policy is told, "none", "velocity", "phase" or "motion"; docs/steering.md.
      preset: the name of a preset; by default `laptop` on a CPU and `paper` on an accelerator.
      folder: the run folder; by default ``runs/METHOD-DATE-TIME``.
      minutes: time limit, including compilation and evaluations.
      resume: continue the run in ``folder`` with its own settings.
      logger: "wandb" or "trackio", which also get the figures of ``metrics.csv``; docs/metrics.md.
      **settings: changes of the settings: ``method="amp"``, ``motion="walk.npz"``, ``**{"ppo.discount": 0.98}``.

    Returns:
      The run: ``run.folder``, ``run.config``, ``run.policy()``.

    Raises:
      UserError: a setting is unknown or wrong, ``folder`` holds a run already or has none to resume, too many numbers
        were not finite, memory is too small, or a logger is missing; saved checkpoints stay.
    """
    began = time.monotonic()
    if minutes is not None and not minutes > 0:
        raise UserError(f"minutes is {minutes:g}: expected more than 0")
    logs.check_logger(logger)
    if resume:
        if folder is None or config or command or preset or settings:
            raise UserError("resume continues a run with its own settings: expected its folder and no settings")
        run = Run.open(folder)
    else:
        if config is not None and command is not None:
            raise UserError(
                "command and a Config were given: expected command.kind, motion and the axes to be set in the Config"
            )
        run = _created(config, preset, folder, configuration.commanded(command, settings, preset))
    left = None if minutes is None else minutes - (time.monotonic() - began) / 60
    if runs.train(run, resume=resume, minutes=left, logger=logger) is not runs.End.SIGNAL:
        runs.finish(run)
    return run


def _created(config: Config | None, preset: str | None, folder: str | Path | None, settings: dict[str, Any]) -> Run:
    """A new run folder, once its settings are known to be good."""
    if config is None:
        config = configuration.preset(preset or runs.default_preset(), **settings)
    elif not isinstance(config, Config) or preset is not None:
        raise UserError(f"config is {config!r} and preset is {preset!r}: expected a Config or the name of a preset")
    else:
        config = configuration.validate(configuration.with_changes(config, settings))
    config = configuration.with_changes(config, {"motion": library.listed(config.motion)})
    runs.check_trainable(config)
    print(runs.describe(config), flush=True)
    return Run.create(folder or runs.default_folder(config), config)
