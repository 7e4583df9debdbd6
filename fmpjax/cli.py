"""The command line: `fmpjax` with the commands in `COMMANDS`."""

import dataclasses
import math
import sys
from pathlib import Path
from typing import Annotated

import tyro

import fmpjax
from fmpjax import config as configuration
from fmpjax import experiments, machine, shell, tables
from fmpjax.cli_deploy import Sim2Sim
from fmpjax.cli_motion import MOTION
from fmpjax.cli_play import Play
from fmpjax.cli_train import Pretrain, Train, runs_module
from fmpjax.errors import UserError
from fmpjax.shell import default


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Evaluate a run's best policy on first episodes."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    episodes: Annotated[int | None, default("the run's evaluation_episodes")] = None
    """First episodes at the smallest perturbation, by which a run is judged; docs/metrics.md."""
    last: bool = False
    """Take the newest checkpoint instead of the best."""
    commands: bool = False
    """Measure how well a policy obeys its command: velocities, the time in the clip or motions; docs/steering.md."""
    robust: bool = False
    """Measure how often a policy falls under pushes, delays and other disturbances; docs/robustness.md."""
    disturbances: Annotated[tuple[str, ...], default("all")] = ()
    """With --robust, the disturbances to play, such as push delay together."""

    def __call__(self) -> None:
        if self.commands and self.robust:
            raise UserError("--commands and --robust are two evaluations: expected one of them")
        if self.disturbances and not self.robust:
            raise UserError("--disturbances goes with --robust")
        if self.episodes is not None and self.episodes < 1:
            raise UserError(f"--episodes is {self.episodes}: expected at least 1")
        run = runs_module().Run.open(self.run)
        trainer, state = run.policy(best=not self.last)
        measure = self._commands if self.commands else self._robust if self.robust else self._first
        measure(run, trainer, state)

    def _first(self, run, trainer, state) -> None:
        from fmpjax.evaluate import Evaluator, table

        print("compiling the evaluation ...", flush=True)
        evaluation = Evaluator(trainer, self.episodes)(state.ppo)
        print(f"iteration {int(state.iteration):,}:\n{table(evaluation)}")
        path = self._file(run, "evaluation")
        run.save_evaluation(evaluation, path.stem)
        print(f"wrote {path}")

    def _commands(self, run, trainer, state) -> None:
        from fmpjax import following, performing, steering
        from fmpjax.viz import along, heat

        trainer.config.command.require("velocity", "phase", "motion")
        if sentence := steering.beyond(trainer):
            print(f"note: {sentence}")
        print("compiling the episodes ...", flush=True)
        changed = {} if self.episodes is None else {"episodes": self.episodes}
        if trainer.config.command.kind == "phase":
            followed = following.measure(trainer, state.ppo, **changed)
            print(f"iteration {int(state.iteration):,}:\n{following.table(followed)}")
            self._save(run, "following", followed, along.draw, followed.seconds, following.curves(followed))
            return
        if trainer.config.command.kind == "motion":
            performed = performing.measure(trainer, state.ppo, **changed)
            print(f"iteration {int(state.iteration):,}:\n{performing.table(performed)}")
            self._save(run, "performing", performed, heat.draw_motions, performed.motions, performed.performed)
            return
        found = steering.measure(trainer, state.ppo, **changed)
        print(f"iteration {int(state.iteration):,}:\n{steering.table(found)}")
        self._save(run, "steering", found, heat.draw, *steering.maps(found))

    def _robust(self, run, trainer, state) -> None:
        from fmpjax import robustness
        from fmpjax.viz import bars

        episodes = self.episodes or robustness.EPISODES
        print(f"compiling the episodes, {episodes} of each case; each case takes seconds ...", flush=True)
        print(f"iteration {int(state.iteration):,}:\n{robustness.heading()}")
        found = robustness.measure(
            trainer,
            state.ppo,
            episodes=episodes,
            disturbances=self.disturbances,
            note=lambda line: print(line, flush=True),
        )
        title = f"{run.folder.resolve().name}: first episodes of {found.seconds:g} s, {episodes} per bar"
        self._save(run, "robustness", found, bars.draw, robustness.bars(found), title)

    def _save(self, run, name: str, found, draw, *drawn) -> None:
        """Write figures and their picture, ``draw(path, *drawn)``, to the run's folder."""
        from fmpjax.files import write

        path = self._file(run, name)
        write(path, found.to_json())
        print(f"wrote {path}\nwrote {draw(path.with_suffix('.png'), *drawn)}")

    def _file(self, run, name: str) -> Path:
        """The file of the run that holds figures of its best policy, or of its newest."""
        return run.folder / f"{name}{'-last' if self.last else ''}.json"


@dataclasses.dataclass(frozen=True)
class Render:
    """Render a run's best policy beside the demonstration."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    seconds: float = 10.0
    """Greatest length."""
    last: bool = False
    """Take the newest checkpoint instead of the best."""
    out: Annotated[Path | None, default("RUN/policy.mp4")] = None
    """File to write; .gif where no encoder is installed."""
    alone: bool = False
    """Leave the demonstration out; its license may forbid sharing pictures of it."""
    course: Annotated[tuple[str, ...], default("none")] = ()
    """Commands for a policy with velocity commands: SECONDS:FORWARD,LEFT,TURN (m/s, rad/s), such as 4:0.5,0,0.4."""
    push: Annotated[float | None, default("none")] = None
    """Film four episodes with a push of this speed, m/s, every 2 s in any direction."""

    def __call__(self) -> None:
        runs = runs_module()
        from fmpjax.evaluate import Evaluator

        if not 0 < self.seconds < math.inf:
            raise UserError(f"--seconds is {self.seconds:g}: expected a number above 0")
        if self.push is not None and not 0 < self.push < math.inf:
            raise UserError(f"--push is {self.push:g}: expected a speed above 0, in m/s")
        if self.push is not None and self.course:
            raise UserError("--push and --course were both given: expected one of them")
        run = runs.Run.open(self.run)
        trainer, state = run.policy(best=not self.last)
        print("rolling out and rendering ...", flush=True)
        if self.push is not None:
            print(f"wrote {runs.pushed_video(run, trainer, state, self.push, self.out, self.seconds)}")
            return
        if self.course:
            from fmpjax import sim2sim

            print(f"wrote {runs.course_video(run, trainer, state, sim2sim.course(self.course), self.out)}")
            return
        played = Evaluator(trainer, 8).play(state.ppo)
        print(f"wrote {runs.video(run, trainer, played, seconds=self.seconds, path=self.out, alone=self.alone)}")


@dataclasses.dataclass(frozen=True)
class Export:
    """Copy a run's results without its checkpoints to a folder, or write a web page of its policy."""

    run: tyro.conf.Positional[Path]
    """Folder of the run."""
    out: Annotated[tyro.conf.Positional[Path | None], default("RUN/export")] = None
    """Folder to write."""
    onnx: bool = False
    """Also write policy.onnx and MODEL_CARD.md, for other programs; docs/deploy.md."""
    web: Annotated[Path | None, default("no page")] = None
    """New folder for a page on which the policy runs in a browser; nothing else is written unless asked for."""
    last: bool = False
    """Take the newest checkpoint instead of the best, with the figures of `fmpjax evaluate --last`."""

    def __call__(self) -> None:
        runs = runs_module()
        from fmpjax import deploy, features, robots

        run = runs.Run.open(self.run)
        if self.web is None or self.onnx or self.out is not None:
            for path in runs.export(run, self.out or run.folder / "export", onnx=self.onnx, best=not self.last):
                print(f"wrote {path}")
        if self.web is not None:
            runs.web(run, self.web, best=not self.last)
            print(f"wrote {self.web}, a page: see it with `python -m http.server --directory {self.web}`")
        config = run.config
        for say in (deploy.unmeasured, deploy.no_stock) if self.onnx else ():
            if sentence := say(robots.load(config.robot), features.observation_form(config)):
                print(f"note: {sentence}")


@dataclasses.dataclass(frozen=True)
class Diagnose:
    """Say what is wrong with a run, finished or not, in words."""

    run: tyro.conf.Positional[Path]
    """Folder of the run, or of its exported results."""
    last: bool = False
    """Look at the newest evaluation instead of the best policy's."""

    def __call__(self) -> None:
        from fmpjax import diagnose

        print(diagnose.text(diagnose.read(self.run, last=self.last)))


@dataclasses.dataclass(frozen=True)
class Report:
    """Collect the results of the experiments on one page, beside the paper's."""

    folder: tyro.conf.Positional[Path]
    """Folder with results, also in subfolders."""
    out: Annotated[Path | None, default("FOLDER/report.html")] = None
    """HTML page to write; the same in Markdown is written beside it."""

    def __call__(self) -> None:
        runs_module()
        from fmpjax.experiments import report

        for path in report.write(self.folder, self.out or self.folder / "report.html"):
            print(f"wrote {path}")


@dataclasses.dataclass(frozen=True)
class ShowConfig:
    """Print every setting of a preset."""

    preset: tyro.conf.Positional[str] = "laptop"
    """`smoke`, `laptop`, `robust`, `robot` or `paper`."""

    def __call__(self) -> None:
        for key, value in configuration.flatten(configuration.preset(self.preset)).items():
            print(f"{key} = {value}")


@dataclasses.dataclass(frozen=True)
class Settings:
    """Explain every setting: its default in each preset, its meaning and what it may be."""

    section: tyro.conf.Positional[str] = ""
    """A section, such as `ppo`, or one setting; by default all of them."""
    markdown: bool = False
    """Print the page docs/settings.md, which has all of them."""

    def __call__(self) -> None:
        from fmpjax.config import explaining

        if self.markdown and self.section:
            raise UserError(f"--markdown prints all settings: expected no section, not {self.section!r}")
        print(explaining.markdown() if self.markdown else explaining.text(self.section), end="")


@dataclasses.dataclass(frozen=True)
class List:
    """List methods, presets, robots and motions, each with what it is."""

    def __call__(self) -> None:
        from fmpjax import motion, priors, robots

        for title, described in (
            ("methods", priors.descriptions()),
            ("presets", configuration.DESCRIPTIONS),
            ("robots", {name: robots.load(name).description for name in robots.available()}),
            ("motions", {name: motion.describe(name) for name in motion.bundled()} | motion.folders()),
        ):
            print(f"{title}:\n{tables.aligned(list(described.items()), texts=2)}")


def _experiment(name: str, *options: str) -> None:
    """Run a study; no other is imported."""
    study = experiments.load(name)
    machine.keep_compiled()
    shell.parse(study, f"fmpjax experiment {name}", options)


EXPERIMENT = shell.Group("Run a study of priors or runs, one per table or figure.", experiments.STUDIES)
COMMANDS = shell.Group(
    "Flow-Matched Motion Priors in JAX. `fmpjax --version` prints the version.",
    {
        "train": Train, "pretrain": Pretrain, "evaluate": Evaluate, "diagnose": Diagnose, "render": Render,
        "export": Export, "sim2sim": Sim2Sim, "play": Play, "experiment": EXPERIMENT, "report": Report,
        "motion": MOTION, "config": ShowConfig, "settings": Settings,
        "list": List,
    },
)  # fmt: skip


def main(arguments: list[str] | None = None) -> None:
    """Entry point: bad input is one sentence and exit code 2."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with shell.ending():
        if arguments == ["--version"]:
            print(f"fmpjax {fmpjax.__version__}")
        elif arguments[:1] == ["experiment"] and len(arguments) > 1 and not arguments[1].startswith("-"):
            _experiment(*arguments[1:])
        else:
            shell.parse(COMMANDS, "fmpjax", arguments)()


if __name__ == "__main__":
    main()
