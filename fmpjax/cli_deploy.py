"""The command `fmpjax sim2sim`."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import tyro

from fmpjax.errors import UserError
from fmpjax.shell import default


@dataclasses.dataclass(frozen=True)
class Sim2Sim:
    """Run an exported policy on another MuJoCo model of its robot, with ONNX Runtime."""

    policy: tyro.conf.Positional[Path]
    """policy.onnx, as `fmpjax export --onnx` writes it."""
    model: Path
    """MJCF file with the policy's joints."""
    seconds: float = 10.0
    """Length of an episode at most."""
    episodes: int = 8
    """Starts from the default pose, all but the first with joints a little off."""
    video: Annotated[Path | None, default("no video")] = None
    """Film the first episode: a file .mp4, or .gif where no encoder is installed."""

    def __call__(self) -> None:
        from fmpjax import robots, sim2sim
        from fmpjax.viz import render

        if not 0 < self.seconds < math.inf:
            raise UserError(f"--seconds is {self.seconds:g}: expected a number above 0")
        if self.episodes < 1:
            raise UserError(f"--episodes is {self.episodes}: expected at least 1")
        if self.video is not None and self.video.suffix not in (".mp4", ".gif"):
            raise UserError(f"--video is {self.video}: expected a name that ends in .mp4 or .gif")
        policy = sim2sim.load(self.policy)
        simulation = sim2sim.Simulation(policy, self.model)
        played = sim2sim.play(simulation, seconds=self.seconds, episodes=self.episodes)
        print(sim2sim.report(simulation, played))
        if self.video is not None:
            # The robot of the training stands in for the model, whose looks may be missing.
            frames = render.render_frames(robots.load(policy.robot), played[0].qpos[::2], labels="sim2sim")
            print(f"wrote {render.write_video(self.video, frames, fps=0.5 / policy.step_dt)}")
