"""Films of a run's policy: beside the demonstration, under commands, under pushes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter1d

from fmpjax import robustness, steering
from fmpjax.evaluate import Episodes
from fmpjax.pushes import pushes_of
from fmpjax.runs.folder import Run
from fmpjax.trainer import Trainer, TrainState
from fmpjax.viz import render

_STRIDE = 2  # control steps a picture, which makes 25 pictures a second
_SHOWN = 0.6  # s for which the picture says what has happened
_SAID = {"left": "to its left", "right": "to its right"}


def longest(played: Episodes) -> int:
    """The longest episode, which shows most; ties go to the first."""
    return int(np.argmax(played.length))


def video(
    run: Run,
    trainer: Trainer,
    played: Episodes,
    *,
    seconds: float = 10.0,
    path: Path | None = None,
    alone: bool = False,
    smooth: bool = True,
) -> Path:
    """The policy beside the demonstration, or alone, as a video; the path written.

    It lasts ``seconds``, or until one second after the fall of a policy that falls before.
    """
    rate = trainer.config.control_rate
    episode = longest(played)
    length = int(played.length[episode])
    last = min(int(seconds * rate), len(played.qpos), length + int(rate))
    shown = {"policy": played.qpos[: min(last, length) : _STRIDE, episode]}
    if not alone:
        shown["demonstration"] = trainer.library.clips[played.clip[episode]].qpos[:last:_STRIDE]
    panes = len(shown)
    motions, labels = list(shown.values()), list(shown)
    frames = render.grid(trainer.robot, motions, labels, columns=panes, width=360 * panes, height=360, smooth=smooth)
    return render.write_video(path or run.folder / "policy.mp4", frames, fps=rate / _STRIDE)


def course_video(
    run: Run,
    trainer: Trainer,
    state: TrainState,
    course: Sequence[tuple[float, tuple[float, float, float]]],
    path: Path | None,
) -> Path:
    """The policy under a course of commanded velocities, which the picture shows; the path written.

    Args:
      run: whose command is a velocity.
      trainer: of the run.
      state: of the policy.
      course: seconds and velocity (m/s ahead, m/s to the left, rad/s to the left) of each leg.
      path: of the video, ``RUN/course.mp4`` by default.

    Raises:
      UserError: the run's command is no velocity, or the file cannot be written.
    """
    trainer.config.command.require("velocity")
    rate = trainer.config.control_rate
    told = np.concatenate([np.tile(command, (max(1, round(seconds * rate)), 1)) for seconds, command in course])
    played = steering.play(trainer, state.ppo, told[:, None], np.random.default_rng(0))
    # A stride swings the velocity: what is shown is a mean over half a second.
    shown = uniform_filter1d(played.velocity[:, 0], round(0.5 * rate), axis=0, mode="nearest")
    length = max(1, int(played.alive[:, 0].sum()))
    labels = [_told(*pair, aside=bool(told[:, 1].any())) for pair in zip(told, shown, strict=True)]
    frames = render.render_frames(
        trainer.robot, played.qpos[:length:_STRIDE, 0], width=640, height=400, labels=labels[:length:_STRIDE]
    )
    return render.write_video(path or run.folder / "course.mp4", frames, fps=rate / _STRIDE)


def _told(told: np.ndarray, does: np.ndarray, *, aside: bool) -> str:
    """A commanded velocity and the robot's, each ``[3]``, in words; the part to the side where any is commanded."""
    (ahead, left, turn), (ahead_now, left_now, turn_now) = told, does
    if aside:
        now = f"{ahead_now:.2f}, {left_now:+.2f}, {turn_now:+.2f}"
        return f"told {ahead:.2f}, {left:+.2f} m/s, {turn:+.2f} rad/s   does {now}"
    return f"told {ahead:.2f} m/s, {turn:+.2f} rad/s   does {ahead_now:.2f}, {turn_now:+.2f}"


def pushed_video(
    run: Run, trainer: Trainer, state: TrainState, speed: float, path: Path | None, seconds: float
) -> Path:
    """Four episodes under pushes in any direction every two seconds, which the picture names; the path written.

    Args:
      run: of the policy.
      trainer: of the run.
      state: of the policy.
      speed: m/s that each push adds to the root's velocity.
      path: of the video, ``RUN/pushed.mp4`` by default.
      seconds: greatest length.

    Raises:
      UserError: the robot has no torso, or the file cannot be written.
    """
    rate = trainer.config.control_rate
    played = robustness.Player(trainer, 4).play(state.ppo, robustness.pushed(speed))
    # A picture of a fall, and of the second after it, says more than a robot that lies still for the rest.
    last = min(int(seconds * rate), len(played.qpos), int(played.length.max() + rate))
    labels = [_happened(played, episode, rate)[:last:_STRIDE] for episode in range(4)]
    motions = list(played.qpos[:last:_STRIDE].swapaxes(0, 1))
    frames = render.grid(trainer.robot, motions, labels, columns=2, width=720, height=600)
    return render.write_video(path or run.folder / "pushed.mp4", frames, fps=rate / _STRIDE)


def _happened(played: robustness.Played, episode: int, rate: float) -> list[str]:
    """For every step of an episode, the push of the last moments or the fall, in words."""
    words = [""] * len(played.qpos)
    one = slice(episode, episode + 1)
    for push in pushes_of(played.qpos[:, one], played.length[one], played.fell[one], played.pushes[:, one]):
        until = min(len(words), push.step + round(_SHOWN * rate))
        said = f"pushed {_SAID.get(push.side, push.side)}, {push.speed:.2g} m/s"
        words[push.step : until] = [said] * (until - push.step)
    if played.fell[episode]:
        end = int(played.length[episode])
        words[end:] = ["fell"] * (len(words) - end)
    return words
