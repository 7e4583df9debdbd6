"""The commands under ``fmpjax motion``; another one is another class in `MOTION`."""

import dataclasses
import itertools
import math
import sys
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from fmpjax import motion, robots
from fmpjax.errors import UserError
from fmpjax.motion import MotionClip, gait
from fmpjax.motion.clip import Fact
from fmpjax.motion.gait import Style
from fmpjax.shell import Group, default


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reading:
    """How a motion file is read."""

    frames: Annotated[str | None, default("all")] = None
    """Source rows first:last, 0-based, both included; 100: and :200 go to the file's end or from its start."""
    fps: Annotated[float | None, default("the file's own")] = None
    """Rate of the source rows, Hz, instead of the file's own."""
    robot: str = "unitree_g1"
    """A shipped robot, or a robot's folder."""
    quaternion: Annotated[str | None, default("told by the file")] = None
    """Order of the root's quaternion, wxyz or xyzw, instead of the format's."""
    without: str = ""
    """Joints that are missing in the file and stay at zero: parts of their names, such as wrist,waist_roll."""
    degrees: bool = False
    """The file's joints are in degrees."""
    accept_license: bool = False
    """Accept the license of a Hugging Face data set without a question."""

    def options(self, *files: str) -> dict[str, Any]:
        """What `fmpjax.motion.load` is told; the licenses of ``files`` are accepted where that is asked for."""
        if self.accept_license:
            motion.accept_license(*files)
        names = (field.name for field in dataclasses.fields(Reading) if field.name != "accept_license")
        return {name: getattr(self, name) for name in names}


@dataclasses.dataclass(frozen=True)
class Source(Reading):
    """A motion in a file."""

    file: tyro.conf.Positional[str]
    """A motion file of any format, by its path or address, or a bundled motion's name."""

    def clip(self) -> tuple[MotionClip, int]:
        """The clip at the file's own rate, and how often its quaternion flips in the file."""
        from fmpjax.motion import check, formats

        file, recording = formats.record(self.file, **self.options(self.file))
        if len(recording.qpos) < formats.LEAST_SAMPLES:
            raise UserError(f"{file}: {len(recording.qpos)} frames, expected at least {formats.LEAST_SAMPLES}")
        clip = MotionClip.from_qpos(file.stem, robots.load(self.robot).name, recording.rate, recording.qpos)
        reading = recording.reading
        if recording.loops and self.frames is None:
            why = f"the file says that it loops; import and train repeat it to {formats.LOOPED:g} s"
            reading = reading._replace(facts=(*reading.facts, Fact("loop", "shown once", why)))
        clip = dataclasses.replace(clip, reading=reading)
        return clip, check.flips(recording.qpos[:, 3:7])


@dataclasses.dataclass(frozen=True)
class Import(Reading):
    """Read motions of any format and write them as this package's own."""

    files: tyro.conf.Positional[tuple[str, ...]]
    """Motion files, by path or address; several are written to the folder --out under their own names."""
    out: Path
    """File to write, .npz; a folder for several files."""
    rate: float = 50.0
    """Rate to write, Hz."""
    mirror: bool = False
    """Reflect left and right."""
    heading: Annotated[float | None, default("as it is")] = None
    """Rotate the motion so that its way from start to end has this angle from +x, deg."""
    loop: bool = False
    """Change the last 0.4 s so that the last pose equals the first."""
    repeat: int = 1
    """Write a loop this many times in a row."""
    speed: float = 1.0
    """Factor by which it plays faster."""
    join: bool = False
    """Write the files as one motion, each beginning where the one before has ended."""

    def __call__(self) -> None:
        from fmpjax.motion import addresses, check, edit

        if not self.files:
            raise UserError("no file to import: expected at least one")
        if self.repeat < 1:
            raise UserError(f"--repeat is {self.repeat}: expected at least 1")
        if self.heading is not None and not math.isfinite(self.heading):
            raise UserError(f"--heading is {self.heading}: expected degrees")
        several = len(self.files) > 1 and not self.join
        paths = [
            self.out / f"{Path(addresses.file_name(file)).stem}.npz" if several else self.out for file in self.files
        ]
        if several and len(set(paths)) < len(paths):
            raise UserError("two of the files have the same name: import them one by one")
        robot = robots.load(self.robot)
        clips, said, options = [], [], self.options(*self.files)
        for file in self.files:
            clip = motion.load(file, rate=self.rate, **options)
            said.append(f"{file} was read as\n{clip.reading}")
            if (doubt := check.doubtful_rate(robot, clip)) is not None:  # the written file will have a rate
                said.append(f"  warning: {doubt}")
            if self.speed != 1:
                before, clip = clip, edit.faster(clip, self.speed)
                said.append(f"  {_torques(robot, before, clip)}")
            if self.mirror:
                clip = edit.mirrored(robot, clip)
            if self.heading is not None:
                clip = edit.headed(clip, math.radians(self.heading))
            clip = edit.looped(clip) if self.loop else clip
            clips.append(edit.repeated(clip, self.repeat) if self.repeat > 1 else clip)
        print("\n".join(said))
        clips = [edit.joined(clips)] if self.join else clips
        for clip, path in zip(clips, paths, strict=not self.join):
            for warning in check.faults(robot, clip):
                print(f"  warning: {warning}")
            print(f"wrote {motion.save(clip, path)}: {len(clip)} samples, {clip.duration:.2f} s at {clip.rate:g} Hz")


def _torques(robot: robots.Robot, before: MotionClip, after: MotionClip) -> str:
    """A line on what another speed asks of the motors."""
    from fmpjax.motion import check

    own, new = (next(f for f in check.check(robot, clip) if f.name == "torque") for clip in (before, after))
    return f"torque      {new.value:.2f} of {new.where}'s limit, {own.value:.2f} of {own.where}'s at the file's speed"


@dataclasses.dataclass(frozen=True)
class Check(Source):
    """Print figures of a motion, healthy ranges and verdicts; exit code 1 if it is broken."""

    fix: bool = False
    """Put the soles on the floor, remove flips, clip joints to their limits, print the changes, check again."""
    out: Annotated[Path | None, default("none")] = None
    """File to write the fixed motion to, .npz."""
    axes: str = "world"
    """The run's features.axes, world or heading."""
    reset: str = "dataset"
    """The run's env.reset, dataset or fixed."""
    seconds: float = 10.0
    """Length of the run's evaluation."""

    def __call__(self) -> None:
        from fmpjax.motion import check, edit

        for name, value, allowed in (
            ("axes", self.axes, ("world", "heading")),
            ("reset", self.reset, ("dataset", "fixed")),
        ):
            if value not in allowed:
                raise UserError(f"--{name} is {value!r}: expected {' or '.join(allowed)}")
        if not self.seconds > 0:
            raise UserError(f"--seconds is {self.seconds:g}: expected more than 0")
        if self.fix != (self.out is not None):
            raise UserError("--fix and --out go together: one asks for a fixed motion, the other names its file")
        robot = robots.load(self.robot)
        clip, flips = self.clip()
        figures = check.check(robot, clip, flips)
        print(f"{self.file} was read as\n{clip.reading}\n\n{check.table(figures)}")
        for sentence in check.unsuited(robot, clip, axes=self.axes, reset=self.reset, seconds=self.seconds):
            print(f"\nnote: {sentence}")
        if self.out is not None:  # and --fix
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
    browser: bool = False
    """Show it in a page of the browser, with its joints, contacts and the verdicts of `motion check`."""
    host: str = "127.0.0.1"
    """Address of the page; any other than this machine's own lets everyone in the network see it."""
    port: int = 8080
    """Port of the page; 0 for any that is free."""

    def __call__(self) -> None:
        from fmpjax.viz import clip as show

        if self.browser and self.out is not None:
            raise UserError("--browser and --out do not go together: one shows a page, the other writes a file")
        robot = robots.load(self.robot)
        clip, flips = self.clip()
        if self.browser:
            from fmpjax import play

            play.check_installed()
            return play.serve_motion(robot, clip, flips=flips, host=self.host, port=self.port)
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
    """Synthesize a steady walk; --speed 0 alone gives standing. With --grid, a library of walks."""

    out: Path
    """File to write, .npz; a folder with --grid."""
    grid: bool = False
    """Write a walk for each combination of --speeds, --turns and --sides that the legs reach."""
    speeds: tuple[float, ...] = (0.0, 0.4, 0.8, 1.2)
    """Forward speeds of the grid, m/s."""
    turns: tuple[float, ...] = (-0.8, -0.4, 0.0, 0.4, 0.8)
    """Turning rates of the grid, to the left, rad/s."""
    sides: tuple[float, ...] = (0.0,)
    """Sideways speeds of the grid, to the left, m/s."""
    speed: Annotated[float | None, default("the robot's own")] = None
    """Forward, m/s; negative is backward."""
    sideways: float = 0.0
    """To the left, m/s."""
    turn: float = 0.0
    """To the left, rad/s."""
    duration: float = 8.0
    """Greatest duration, s; whole strides."""
    rate: float = 50.0
    """Hz."""
    robot: str = "unitree_g1"
    """A shipped robot, or a robot's folder."""
    style: _Style = _Style()
    """How the walk looks: lengths m, angles rad, phases as fractions of a stride."""

    def __call__(self) -> None:
        robot = robots.load(self.robot)
        if self.grid:
            return self._grid(robot)
        speed = robot.gait.get("speed", 0.0) if self.speed is None else self.speed
        walk = gait.make(robot, gait.Command(speed, self.sideways, self.turn), rate=self.rate, style=self.style)
        clip = walk.clip(self.duration)
        print(walk.said())
        print(f"wrote {motion.save(clip, self.out)}: {clip.duration:.2f} s")

    def _grid(self, robot: robots.Robot) -> None:
        """Write the library; what is out of reach is said and left out."""
        if self.out.suffix:
            raise UserError(f"--out is {self.out}: expected a folder with --grid")
        self.out.mkdir(parents=True, exist_ok=True)
        for speed, turn, side in itertools.product(self.speeds, self.turns, self.sides):
            try:
                walk = gait.make(robot, gait.Command(speed, side, turn), rate=self.rate, style=self.style)
            except gait.OutOfReach as refused:
                print(f"left out: {refused}")
                continue
            aside = f"_{side:+.2f}" if side else ""
            path = self.out / f"{speed:+.2f}_{turn:+.2f}{aside}.npz"
            print(f"wrote {motion.save(walk.clip(self.duration), path)}", flush=True)


@dataclasses.dataclass(frozen=True)
class Retarget:
    """Put a human's motion (BVH, SMPL) on a robot by inverse kinematics; exit code 1 if the result is broken."""

    file: tyro.conf.Positional[str]
    """Motion capture, by its path or address: .bvh, or .npz with SMPL's parameters as AMASS writes them."""
    out: Path
    """File to write, .npz."""
    frames: Annotated[str | None, default("all")] = None
    """Frames first:last of the file, 0-based, both included; 1: goes to the end."""
    robot: str = "unitree_g1"
    """A shipped robot, or a robot's folder."""
    skeleton: Annotated[Path | None, default("known names")] = None
    """TOML file with names of joints that fmpjax does not know, such as left_hip = "LThigh"."""
    up: Annotated[str | None, default("told by the file")] = None
    """Vertical axis of the file, y or z; by default the one along which the hips are above the ankles."""
    body_model: Annotated[Path | None, default("none")] = None
    """The body model (.npz) of the SMPL parameters, from its makers."""
    accept_license: bool = False
    """Accept the license of a Hugging Face data set without a question."""

    def __call__(self) -> None:
        from fmpjax.motion import retarget

        if self.accept_license:
            motion.accept_license(self.file)
        said, broken = retarget.convert(
            self.file, robots.load(self.robot), self.out, self.frames,
            skeleton=self.skeleton, up=self.up, body_model=self.body_model,
        )  # fmt: skip
        print(said)
        if broken:
            sys.exit(1)


@dataclasses.dataclass(frozen=True)
class Segment(Source):
    """Find the stretches of a long motion that can be trained: walking, running, turning, dancing, standing."""

    least: float = 2.0
    """Length of the shortest stretch, s."""
    out: Annotated[Path | None, default("none")] = None
    """Folder for the stretches that are not broken, as NAME-KIND-FIRST.npz."""
    forward: bool = False
    """Write only those that never go backward or to a side for a second: for policies that walk ahead and turn."""
    picture: Annotated[Path | None, default("none")] = None
    """Picture of speed and kinds over time, .png."""

    def __call__(self) -> None:
        from fmpjax.motion import formats, segment
        from fmpjax.viz import clip as show

        robot = robots.load(self.robot)
        clip, _ = self.clip()
        offset = 0 if self.frames is None else formats.span(self.frames, len(clip))[0]
        found, kinds = segment.segment(robot, clip, self.least, offset)
        print(f"{self.file} was read as\n{clip.reading}\n\n{segment.table(clip, found, kinds)}")
        if self.picture is not None:
            print(f"wrote {show.timeline(clip, found, self.picture)}")
        if self.out is not None:
            for stretch in found:
                if stretch.verdict != "broken" and (not self.forward or segment.forward(stretch.clip)):
                    print(f"wrote {motion.save(stretch.clip, self.out / f'{stretch.clip.name}.npz')}")


MOTION = Group(
    "Import, check, fix, view, plot, cut, make and retarget motions.",
    {
        "import": Import, "check": Check, "view": View, "plot": Plot, "synthesize": Synthesize, "retarget": Retarget,
        "segment": Segment,
    },
)  # fmt: skip
