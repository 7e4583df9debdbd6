"""The policies of a run for a process without JAX: files, which it asks for, and what the motion prior says.

``python -m fmpjax.runs.served RUN FOLDER`` reads a JSON object per line from standard input and answers each by one:

- ``{"policy": null or ITERATION, "best": false}`` writes that checkpoint's policy, and answers ``{"wrote": PATH}``.
- ``{"score": {"qpos": [H, 7 + J], "qvel": [H, 6 + J]}}`` answers the prior's ``score`` of these states, oldest first,
  by the checkpoint that was written last, and the median of the ``demonstration``'s own scores.

What cannot be done is answered by ``{"error": SENTENCE}``. `Live` writes the policy of a run while it trains.
"""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import deploy, features, machine, policy
from fmpjax.acting import Seen
from fmpjax.errors import UserError
from fmpjax.runs.folder import Run
from fmpjax.runs.outputs import origin_of
from fmpjax.runs.session import Session

EVERY = 5.0  # s between two files of a live policy
SOME = 512  # windows of the demonstration that are scored


class Served:
    """A run whose policies are asked for."""

    def __init__(self, run: Run, folder: Path):
        self.run, self.folder = run, folder
        self._said: dict[str, str] | None = None
        self._at: tuple[int | None, bool] = None, False
        self._prior: Any = None  # the prior's state in the checkpoint that was written last, once it is asked for
        self._demonstration = float("nan")

    def policy(self, iteration: int | None, best: bool) -> Path:
        """Write the policy of a checkpoint; the path written."""
        trainer, checkpoints = self.run.trainer(), self.run.checkpoints
        parts = {name: checkpoints.part(f"ppo.{name}", iteration, best=best) for name in ("actor", "normalizer")}
        # The networks alone: a checkpoint may come from a program whose state had other parts.
        spread = {
            name: Seen(**kept) if isinstance(kept := parts["normalizer"][name], dict) else kept
            for name in ("mean", "std")
        }
        state: Any = SimpleNamespace(actor=parts["actor"], normalizer=SimpleNamespace(**spread))
        learned = policy.of(trainer, state)
        if self._said is None:
            self._said = deploy.metadata(learned, trainer.robot, origin_of(self.run))
        self._at, self._prior = (iteration, best), None
        return policy.save(self.folder / f"{'best' if best else iteration}.npz", learned, self._said)

    @cached_property
    def _scores(self) -> Callable[..., jax.Array]:
        """(the prior's state, qpos, qvel) -> score."""
        trainer = self.run.trainer()

        def score(prior, qpos, qvel):
            frames = features.observe(trainer.robot, qpos, qvel, trainer.env.form).frame
            return trainer.prior.score(prior, trainer.prior_map(frames[None]))[0]

        return jax.jit(score)

    @cached_property
    def _own_scores(self) -> Callable[[Any], jax.Array]:
        """The prior's state -> scores of the demonstration."""
        trainer = self.run.trainer()
        every = max(1, len(trainer.prior_expert.windows) // SOME)
        return jax.jit(lambda prior: trainer.prior.score(prior, trainer.prior_expert.windows[::every]))

    def score(self, qpos: np.ndarray, qvel: np.ndarray) -> dict[str, float]:
        """What the prior says of the states ``[H, ...]``, and of the demonstration in the median."""
        if self._prior is None:
            iteration, best = self._at
            self._prior = self.run.checkpoints.restore(self.run.trainer().shapes(), iteration, best=best).prior
            self._demonstration = float(jnp.median(self._own_scores(self._prior)))
        now = self._scores(self._prior, jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32))
        return {"score": float(now), "demonstration": self._demonstration}

    def answer(self, asked: dict[str, Any]) -> dict[str, Any]:
        """The answer to one request."""
        try:
            if "score" in asked:
                return self.score(np.array(asked["score"]["qpos"]), np.array(asked["score"]["qvel"]))
            return {"wrote": str(self.policy(asked["policy"], bool(asked["best"])))}
        except UserError as error:
            return {"error": str(error)}


class Live:
    """Shows the policies of runs while they train: files, and `fmpjax play` beside the training, which reads them."""

    def __init__(self, group: Sequence[Run], port: int):
        self._group, self._port = group, port
        self._said: dict[str, str] | None = None
        self._written = -float("inf")
        self._page: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "Live":
        return self

    def __exit__(self, *exception: object) -> None:
        """Close the page; what trained is in the checkpoints."""
        if self._page is not None:
            self._page.terminate()
            self._page.wait()
        for run in self._group:
            (run.folder / policy.LIVE).unlink(missing_ok=True)

    def open(self, session: Session) -> None:
        """Write the policies as they are at the start, and open the page.

        A page that does not open ends no training.
        """
        self.show(session)
        folders = [str(run.folder) for run in self._group]
        command = [sys.executable, "-m", "fmpjax.cli", "play", *folders, "--checkpoint", "live"]
        # A training that is killed cannot end its page, which therefore looks whether its parent is still there.
        command += ["--port", str(self._port), "--parent", str(os.getpid())]
        self._page = subprocess.Popen(command, start_new_session=True)

    def show(self, session: Session) -> None:
        """Write each run's policy, unless that was done a moment ago."""
        if time.monotonic() - self._written < EVERY:
            return
        for run, state in zip(self._group, session.states, strict=True):
            learned = policy.of(session.trainer, state.ppo)
            if self._said is None:
                self._said = deploy.metadata(learned, session.trainer.robot, origin_of(run))
            policy.save(run.folder / policy.LIVE, learned, self._said | {"iteration": str(session.done)})
        self._written = time.monotonic()


def main(run: str, folder: str) -> None:
    """Answer until the standard input ends."""
    machine.keep_compiled()
    os.nice(5)  # the simulation that asks comes first
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    with contextlib.redirect_stdout(sys.stderr):  # what libraries print is no answer
        served = Served(Run.open(run), Path(folder))
        for line in sys.stdin:
            print(json.dumps(served.answer(json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
