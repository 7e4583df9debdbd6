"""The command `fmpjax sim2sim`."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Literal

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
    """Greatest length of an episode, for a policy that takes no commands."""
    episodes: int = 8
    """Episodes from the default pose, all but the first with small random joint offsets."""
    gains: Literal["policy", "model"] = "policy"
    """Gains of the servos: the policy's, or those of the model, which then needs position servos."""
    course: Annotated[tuple[str, ...], default("a walk, a turn and a stop")] = ()
    """Commands for the policy, if it takes any, as SECONDS:FORWARD,LEFT,TURN in m/s and rad/s, leg by leg."""
    push: float = 0.0
    """Push the robot by this speed (m/s) in a random horizontal direction every two seconds."""
    video: Annotated[Path | None, default("no video")] = None
    """Film the first episode: a file .mp4, or .gif where no encoder is installed."""
    keyboard: bool = False
    """Steer the robot with keys in MuJoCo's viewer instead of playing episodes; needs a display."""
    gamepad: bool = False
    """The same, also with a gamepad."""

    def __call__(self) -> None:
        from fmpjax import robots, sim2sim

        if self.keyboard or self.gamepad:
            return self._steered()
        if not 0 < self.seconds < math.inf:
            raise UserError(f"--seconds is {self.seconds:g}: expected a number above 0")
        if self.episodes < 1:
            raise UserError(f"--episodes is {self.episodes}: expected at least 1")
        if not 0 <= self.push < math.inf:
            raise UserError(f"--push is {self.push:g}: expected a speed of at least 0")
        if self.video is not None and self.video.suffix not in (".mp4", ".gif"):
            raise UserError(f"--video is {self.video}: expected a name that ends in .mp4 or .gif")
        course = sim2sim.course(self.course)
        policy = sim2sim.load(self.policy)
        # The video shows the robot of the training, because the looks of the model may be missing.
        robot = None if self.video is None else robots.load(policy.robot)
        if not course and "velocity_commands" in policy.terms:
            course = sim2sim.COURSE
        simulation = sim2sim.Simulation(policy, self.model, own_gains=self.gains == "model")
        played = sim2sim.play(simulation, seconds=self.seconds, episodes=self.episodes, course=course, push=self.push)
        print(sim2sim.report(simulation, played, course))
        if robot is not None and self.video is not None:
            from fmpjax.viz import render

            frames = render.render_frames(robot, played[0].qpos[::2], labels="sim2sim")
            print(f"wrote {render.write_video(self.video, frames, fps=0.5 / policy.step_dt)}")

    def _steered(self) -> None:
        from fmpjax import play, sim2sim

        option = "--gamepad" if self.gamepad else "--keyboard"
        if self.course or self.push or self.video is not None:
            raise UserError(f"{option} is steered by hand: expected no --course, no --push and no --video")
        play.check_display(option)
        simulation = sim2sim.Simulation(sim2sim.load(self.policy), self.model, own_gains=self.gains == "model")
        for sentence in simulation.differences:
            print(f"unlike in training: {sentence}")
        play.steer(simulation, gamepad=self.gamepad)
