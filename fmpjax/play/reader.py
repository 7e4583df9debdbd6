"""A process beside this one that reads a run's checkpoints, so that neither JAX nor a checkpoint delays the robot."""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

from fmpjax.errors import UserError


class Reader:
    """`fmpjax.runs.served` of one run, started when it is first asked."""

    def __init__(self, run: Path):
        self._run, self._lock = run, threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._folder, self._closed = "", False

    def policy(self, iteration: int | None, *, best: bool = False) -> Path:
        """File of a checkpoint's policy, by default the newest's.

        Raises:
          UserError: it cannot be read.
        """
        return Path(self._ask({"policy": iteration, "best": best})["wrote"])

    def score(self, qpos: Any, qvel: Any) -> tuple[float, float]:
        """What the motion prior says of states ``[H, ...]``, oldest first, and of its demonstration in the median.

        Raises:
          UserError: the checkpoint has no prior that this version of the program can read.
        """
        answer = self._ask({"score": {"qpos": qpos.tolist(), "qvel": qvel.tolist()}})
        return answer["score"], answer["demonstration"]

    def close(self) -> None:
        """End the process; nothing can be asked from here on."""
        self._closed = True
        self._end()

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            shutil.rmtree(self._folder, ignore_errors=True)

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        with self._lock:
            self._check_open()
            process = self._started()
            assert process.stdin and process.stdout  # they are pipes
            try:
                process.stdin.write(json.dumps(request) + "\n")
                process.stdin.flush()
                line = process.stdout.readline()
            except (OSError, ValueError):  # a pipe that has closed
                line = ""
            if not line:
                self._check_open()
                lines = Path(self._folder, "errors").read_text().strip().splitlines()
                self._end()
                told = lines[-1] if lines else "the process that reads it has ended"
                raise UserError(f"run {self._run} cannot be read: {told}")
        answer = json.loads(line)
        if "error" in answer:
            raise UserError(answer["error"])
        return answer

    def _check_open(self) -> None:
        if self._closed:
            raise UserError(f"run {self._run} is closed: expected no more questions")

    def _started(self) -> subprocess.Popen[str]:
        if self._process is None:
            self._folder = tempfile.mkdtemp(prefix="fmpjax-play-")
            command = [sys.executable, "-m", "fmpjax.runs.served", str(self._run), self._folder]
            # Beside an accelerator, too: its memory may be a training's.
            environment = os.environ | {"JAX_PLATFORMS": "cpu"}
            with Path(self._folder, "errors").open("w") as errors:
                self._process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=errors,
                    text=True,
                    env=environment,
                    start_new_session=True,  # Ctrl-C is this process's to answer
                )
        return self._process
