"""The command `fmpjax play`."""

import dataclasses
import signal
from pathlib import Path
from typing import Annotated

import tyro

from fmpjax.errors import UserError
from fmpjax.shell import default


@dataclasses.dataclass(frozen=True)
class Play:
    """Play with policies in real time, in a page of the browser: command them, push them, compare checkpoints."""

    what: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, also of running trainings, and policies (policy.onnx, policy.npz), side by side."""
    checkpoint: Annotated[str | None, default("the best")] = None
    """Policy of the runs to begin with: `best`, `newest`, `live` (of `train --live`) or an iteration."""
    model: Annotated[Path | None, default("the robot of the training")] = None
    """MJCF file with the joints of the policies, for policy files only."""
    host: str = "127.0.0.1"
    """Address to listen at; any other than this machine's own lets everyone in the network play."""
    port: int = 8080
    """Port of the page; 0 for any that is free."""
    native: bool = False
    """Open MuJoCo's own viewer instead of a page, for one policy; needs a display."""
    gamepad: bool = False
    """Also steer with a gamepad; needs --native."""
    parent: Annotated[int | None, default("none")] = None
    """ID of a process with which the page ends, too; `train --live` gives its own."""

    def __call__(self) -> None:
        from fmpjax import play

        if not self.what:
            raise UserError("there is nothing to play: expected a run folder or the file of a policy")
        if self.gamepad and not self.native:
            raise UserError("--gamepad goes with --native: a page is steered by its keys and sliders")
        if self.native:
            if len(self.what) > 1:
                raise UserError(f"--native shows one robot: expected one run or policy, not {len(self.what)}")
            play.check_display("--native")
        play.check_installed(page=not self.native)
        sources = [play.source_of(path, name=self.checkpoint, model=self.model) for path in self.what]
        if self.native:
            play.show(sources[0], gamepad=self.gamepad)
        else:
            # A training with --live ends its page so; what reads checkpoints is to end with it.
            signal.signal(signal.SIGTERM, signal.default_int_handler)
            play.serve(sources, host=self.host, port=self.port, parent=self.parent)
