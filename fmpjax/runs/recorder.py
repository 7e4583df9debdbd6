"""What one run of a training writes: rows of its log, evaluations, checkpoints and the best policy."""

import json
from collections.abc import Callable, Mapping, Sequence

from fmpjax import config as configuration
from fmpjax import diagnose, metrics
from fmpjax.config import Config
from fmpjax.evaluate import Evaluation, table
from fmpjax.logs import MetricsLog, Mirror, clock
from fmpjax.ppo import PPOState
from fmpjax.runs.clock import Clock
from fmpjax.runs.folder import Run
from fmpjax.trainer import TrainState


class Recorder:
    """The log, the evaluations and the checkpoints of one run."""

    def __init__(
        self,
        run: Run,
        config: Config,
        columns: Sequence[str],
        iteration: int,
        *,
        evaluate: Callable[[PPOState], Evaluation],
        note: Callable[[str], None],
        label: str = "",
        keep: bool = True,
        logger: str | None = None,
    ):
        """Continue the run's log from an iteration.

        Args:
          run: where to write.
          config: the settings that the diagnosis judges by.
          columns: names of the metrics and of the evaluation's figures.
          iteration: rows after it are computed again.
          evaluate: the figures of a policy.
          note: says a line.
          label: says which run it is, where there are several.
          keep: False where another process writes.
          logger: "wandb" or "trackio" gets the rows of the log, too.
        """
        self._run, self._config, self._label, self._keep = run, config, label, keep
        self._evaluate, self._note = evaluate, note
        mirror = Mirror(logger, run.folder, configuration.flatten(run.config)) if logger and keep else None
        self.log = MetricsLog(run.folder, list(columns), iteration, keep=keep, mirror=mirror)
        rows = [row for row in self.log.rows if row.get("eval/quality")]
        # With a command, rows of earlier versions have no score, or one that the pace made lower: the next policy
        # replaces theirs.
        name = metrics.choosing(config.command.kind)
        self.best = max((float(row[name]) for row in rows if row.get(name)), default=-1.0)  # score of the best policy
        self.evaluated = max((int(row["iteration"]) for row in rows), default=0)  # the last iteration evaluated

    def record(
        self, at: Clock, row: Mapping[str, float], state: TrainState | None = None, *, evaluate: bool = False
    ) -> None:
        """Write a row, and what is due with it.

        Args:
          at: the training's clock.
          row: the metrics.
          state: what to save, in this process's memory; None where no save is due.
          evaluate: evaluate ``state``, and keep it where it is the best so far.
        """
        if not evaluate:
            self._write(at, row, state)
            return
        assert state is not None, "an evaluation needs the state"
        evaluation, self.evaluated = self._evaluate(state.ppo), at.done
        self._note(f"evaluation at {at.transitions:,} transitions, {self._label}{clock(at.seconds)}:")
        self._note(table(evaluation))
        better = evaluation.score >= self.best
        if better:
            self.best = evaluation.score
        figures = {f"eval/{name}": float(value) for name, value in evaluation.as_dict().items()}
        self._write(at, {**row, **figures}, state, better=better)
        history = diagnose.History(self.log.rows, self._config, json.loads(evaluation.to_json()))
        self._note(diagnose.text(history))

    def save(self, state: TrainState, *, best: bool = False) -> None:
        """Save a checkpoint."""
        if self._keep:
            self._run.checkpoints.save(state, best=best)

    def close(self) -> None:
        """Close the log."""
        self.log.close()

    def _write(self, at: Clock, row: Mapping[str, float], state: TrainState | None, *, better: bool = False) -> None:
        # Rows ahead of their checkpoint are computed again after a kill; rows behind it would be missing.
        self.log.write(at.done, at.transitions, at.seconds, row)
        if state is not None:
            if better:
                self.save(state, best=True)
            self.save(state)
