"""The commands under ``fmpjax motion``; another one is another class in `MOTION`."""

import dataclasses
import math
import sys
from pathlib import Path
from typing import Annotated, get_type_hints

import tyro

from fmpjax import motion, robots
from fmpjax.errors import UserError
from fmpjax.motion import MotionClip, gait
from fmpjax.motion.gait import Style
from fmpjax.shell import Group, default


@dataclasses.dataclass(frozen=True)
class Source:
    """A motion in a file."""

    file: tyro.conf.Positional[str]
    """A motion file of any format, or a bundled motion's name."""
    frames: Annotated[str | None, default("all")] = None
    """Source rows first:last, 0-based, both included."""
    fps: Annotated[float | None, default("the file's own")] = None
    """Rate of the source rows in place of the file's own, Hz."""
    robot: str = "unitree_g1"
    """A robot under robots/."""

    def clip(self) -> tuple[MotionClip, int]:
        """The clip at the file's own rate, and how often its quaternion flips in the file."""
        from fmpjax.motion import check, formats

        file, recording = formats.record(self.file, fps=self.fps, frames=self.frames, robot=self.robot)
        if len(recording.qpos) < formats.LEAST_SAMPLES:
            raise UserError(f"{file}: {len(recording.qpos)} frames, expected at least {formats.LEAST_SAMPLES}")
        clip = MotionClip.from_qpos(file.stem, self.robot, recording.rate, recording.qpos)
        return clip, check.flips(recording.qpos[:, 3:7])


@dataclasses.dataclass(frozen=True)
class Import:
    """Read motions of any format and write them as this package's own."""

    files: tyro.conf.Positional[tuple[str, ...]]
    """Motion files; several are written to the folder --out under their own names."""
    out: Path
    """File to write, .npz; a folder for several files."""
    frames: Annotated[str | None, default("all")] = None
    """Source rows first:last, 0-based, both included."""
    fps: Annotated[float | None, default("the file's own")] = None
    """Rate of the source rows in place of the file's own, Hz."""
    rate: float = 50.0
    """Rate to write, Hz."""
    robot: str = "unitree_g1"
    """A robot under robots/."""
    mirror: bool = False
    """Reflect left and right."""
    heading: Annotated[float | None, default("as it is")] = None
    """Turn the way from start to end to this angle from +x, deg."""
    loop: bool = False
    """Bend the last 0.4 s so that the end meets the start."""

    def __call__(self) -> None:
        from fmpjax.motion import edit

        if not self.files:
            raise UserError("no file to import: expected at least one")
        if self.heading is not None and not math.isfinite(self.heading):
            raise UserError(f"--heading is {self.heading}: expected degrees")
        several = len(self.files) > 1
        paths = [self.out / f"{Path(file).stem}.npz" if several else self.out for file in self.files]
        if len(set(paths)) < len(paths):
            raise UserError("two of the files have the same name: import them one by one")
        robot = robots.load(self.robot)
        clips = []
        for file in self.files:
            clip = motion.load(file, fps=self.fps, frames=self.frames, rate=self.rate, robot=self.robot)
            if self.mirror:
                clip = edit.mirrored(robot, clip)
            if self.heading is not None:
                clip = edit.headed(clip, math.radians(self.heading))
            clips.append(edit.looped(clip) if self.loop else clip)
        for clip, path in zip(clips, paths, strict=True):
            print(f"wrote {motion.save(clip, path)}: {len(clip)} samples, {clip.duration:.2f} s at {clip.rate:g} Hz")


@dataclasses.dataclass(frozen=True)
class Check(Source):
    """Print figures of a motion, healthy ranges and verdicts; exit code 1 where it is broken."""

    fix: bool = False
    """Put the soles on the floor, take out flips, clip joints to their limits, say what was changed, check again."""
    out: Annotated[Path | None, default("none")] = None
    """File to write the fixed motion to, .npz."""

    def __call__(self) -> None:
        from fmpjax.motion import check, edit

        if self.fix != (self.out is not None):
            raise UserError("--fix and --out go together: one asks for a fixed motion, the other names its file")
        robot = robots.load(self.robot)
        clip, flips = self.clip()
        figures = check.check(robot, clip, flips)
        print(check.table(figures))
        if self.fix:
            clip, changes = edit.fixed(robot, clip)
            changes += [f"{flips} flips of the quaternion taken out"] * bool(flips)
            print("\n".join(["", "fixed:", *(changes or ["nothing to change"]), ""]))
            figures = check.check(robot, clip)
            print(check.table(figures))
            print(f"wrote {motion.save(clip, self.out)}")
        if any(figure.verdict == "broken" for figure in figures):
            sys.exit(1)


@dataclasses.dataclass(frozen=True)
class View(Source):
    """Show a motion in MuJoCo's viewer; without a display, or with --out, as a picture."""

    out: Annotated[Path | None, default("the viewer, or NAME.png without a display")] = None
    """A contact sheet (.png) or a video (.mp4, .gif)."""

    def __call__(self) -> None:
        from fmpjax.viz import clip as show

        robot = robots.load(self.robot)
        clip, _ = self.clip()
        if self.out is None and show.has_display():
            show.play(robot, clip)
        else:
            print(f"wrote {show.picture(robot, clip, self.out or f'{clip.name}.png')}")


@dataclasses.dataclass(frozen=True)
class Plot(Source):
    """Draw a motion's root, feet and joints over time."""

    out: Annotated[Path | None, default("NAME-plot.png")] = None
    """File to write."""

    def __call__(self) -> None:
        from fmpjax.viz import clip as show

        clip, _ = self.clip()
        print(f"wrote {show.plot(robots.load(self.robot), clip, self.out or f'{clip.name}-plot.png')}")


class _Style(Style):
    """A walk's style, as the help shows what it leaves open."""

    __annotations__ = {
        name: Annotated[kind, default("the robot's own")]
        for name, kind in get_type_hints(Style, include_extras=True).items()
    }


@dataclasses.dataclass(frozen=True)
class Synthesize:
    """Write a steady walk of our own."""

    out: Path
    """File to write, .npz."""
    speed: Annotated[float | None, default("the robot's own")] = None
    """Along the path, m/s."""
    turn: float = 0.0
    """To the left, rad/s."""
    duration: float = 8.0
    """At most, s; whole strides."""
    rate: float = 50.0
    """Hz."""
    robot: str = "unitree_g1"
    """A robot under robots/."""
    style: _Style = _Style()
    """How the walk looks: lengths m, angles rad, phases as fractions of a stride."""

    def __call__(self) -> None:
        robot = robots.load(self.robot)
        clip = gait.synthesize(
            robot, speed=self.speed, turn=self.turn, duration=self.duration, rate=self.rate, style=self.style
        )
        print(f"wrote {motion.save(clip, self.out)}: {clip.duration:.2f} s")


@dataclasses.dataclass(frozen=True)
class Retarget:
    """Put a human's motion capture (BVH, LaFAN1's or CMU's skeleton) on a robot by inverse kinematics."""

    file: tyro.conf.Positional[Path]
    """Motion capture, .bvh."""
    out: Path
    """File to write, .npz."""
    frames: Annotated[str | None, default("all")] = None
    """Frames first:last of the file, 0-based, both included."""
    robot: str = "unitree_g1"
    """A robot under robots/."""

    def __call__(self) -> None:
        from fmpjax.motion import retarget

        print(retarget.convert(self.file, robots.load(self.robot), self.out, self.frames))


MOTION = Group(
    "Import, check, fix, view, plot, make and retarget motions.",
    {
        "import": Import, "check": Check, "view": View, "plot": Plot, "synthesize": Synthesize, "retarget": Retarget,
    },
)  # fmt: skip
