"""What a finished run leaves: evaluation, pictures, policy files."""

import json
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np

from fmpjax import deploy, diagnose, jsons, policy
from fmpjax.commands import velocity
from fmpjax.errors import UserError
from fmpjax.evaluate import Episodes, table
from fmpjax.files import without_places, write
from fmpjax.logs import MetricsLog
from fmpjax.motion import addresses
from fmpjax.runs.films import longest, video
from fmpjax.runs.folder import Run
from fmpjax.trainer import Trainer
from fmpjax.viz import curves, render

_CURVES = ("metrics.csv", "curves.png")
# Figures of a policy and their pictures. Those of the newest one have -last in their names: `fmpjax evaluate --last`.
_FIGURES = (
    "evaluation.json steering.json following.json performing.json robustness.json ranking-start.json ranking.json "
    "ranking-learned.json steering.png following.png performing.png robustness.png"
).split()
_FILMS = ("frames.png", "policy.mp4", "policy.gif", "course.mp4", "pushed.mp4")  # of the best policy


def finish(run: Run, *, pictures: bool = True) -> list[Path]:
    """Evaluate the run's best policy, and write its table and, unless told otherwise, its pictures; the paths written.

    A picture that cannot be made is left out.
    """
    trainer, state = run.policy()
    played = run.evaluator().play(state.ppo)
    evaluation = run.evaluator().measure(played)
    run.save_evaluation(evaluation)
    transitions = int(state.iteration) * trainer.config.transitions_per_iteration
    print(f"best policy, {transitions:,} transitions:\n{table(evaluation)}")
    paths = [run.folder / "evaluation.json", *(_pictures(run, trainer, played) if pictures else ())]
    if (run.folder / "metrics.csv").exists() and MetricsLog.read(run.folder / "metrics.csv"):
        print(diagnose.text(diagnose.read(run.folder)))
    return paths


def _pictures(run: Run, trainer: Trainer, played: Episodes) -> list[Path]:
    """Draw a finished run; a picture that cannot be made is left out, which a line says."""

    def frames() -> Path:
        return render.contact_sheet(run.folder / "frames.png", _stride_frames(trainer, played), columns=6)

    def course() -> Path:
        return curves.learning_curves(run.folder / "metrics.csv", run.folder / "curves.png")

    makers = {"frames.png": frames}
    makers |= {"curves.png": course} if (run.folder / "metrics.csv").exists() else {}
    makers |= {"policy.mp4": lambda: video(run, trainer, played, smooth=False)}
    paths = []
    for name, make in makers.items():
        try:
            paths.append(make())
        except Exception as error:  # whatever it is, the training is finished
            print(f"no {name}: {str(error) or type(error).__name__}", file=sys.stderr)
    return paths


def export(run: Run, out: Path, *, onnx: bool = False, best: bool = True) -> list[Path]:
    """Copy what a run has to show, and its policy, without states and demonstration, into ``out``; the paths written.

    With ``onnx`` the policy is also written for other programs, as `fmpjax.deploy` does it. Without ``best`` policy and
    figures are the newest ones, and films, which are of the best policy, are left out. Films and figures of another
    policy of the run, which an earlier export wrote there, are removed.

    Raises:
      UserError: ``out`` holds another run's results, or cannot be written, or there is no policy for ``onnx``.
    """
    trained = bool(run.checkpoints.iterations() or run.checkpoints.iterations(best=True))
    if onnx:
        _check_deployable(run, "--onnx")
    if out.resolve() == run.folder.resolve():
        raise UserError(f"{out} is the run itself: expected another folder")
    # Where the demonstration and the run lay is this machine's affair; their names and addresses are everybody's.
    names = (name for name, _ in run.motions(run.config) if not addresses.shareable(name))
    places = [*names, run.folder.resolve(), run.folder]
    texts = {"config.json": (run.folder / "config.json").read_text().rstrip("\n")}
    texts["provenance.json"] = jsons.dumps(run.provenance())
    texts = {n: without_places(text, places) for n, text in texts.items()}
    again = (out / "config.json").exists()
    if again and (out / "config.json").read_text().rstrip("\n") != texts["config.json"]:
        raise UserError(f"{out} holds results of another configuration: expected a new folder or this run's own")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for n, text in texts.items():
            write(out / n, text)
        shown = {n: n for n in (*_CURVES, *(_FILMS if best else ()))} | {n: _name(n, best) for n in _FIGURES}
        shown = {to: n for to, n in shown.items() if (run.folder / n).exists()}
        copied = [Path(shutil.copy2(run.folder / n, out / to)) for to, n in shown.items()]
        if again:  # else a file of such a name is somebody else's
            for name in {*_FILMS, *_FIGURES} - {*shown}:
                (out / name).unlink(missing_ok=True)
        if trained:
            trainer, state = run.policy(best=best)
            learned = policy.of(trainer, state.ppo)
            origin = origin_of(run, best=best)
            said = deploy.metadata(learned, trainer.robot, origin)
            copied.append(policy.save(out / "policy.npz", learned, said))
            if onnx:
                copied += deploy.write(out, learned, trainer.robot, origin)
        return [*(out / n for n in texts), *copied]
    except OSError as error:
        raise UserError(f"folder {out} cannot be written: {error.strerror}") from None


def _name(figures: str, best: bool) -> str:
    """The file of a run with these figures, of its best policy or of its newest."""
    return figures if best else "-last.".join(figures.rsplit(".", 1))


def web(run: Run, folder: Path, *, best: bool = True) -> list[Path]:
    """Write a page on which the run's policy runs in a browser into a new ``folder``; the paths written.

    Raises:
      UserError: there is no policy, or `fmpjax.deploy.write_page` refuses it, or ``folder`` cannot be written.
    """
    _check_deployable(run, "--web")
    trainer, state = run.policy(best=best)
    try:
        return deploy.write_page(folder, policy.of(trainer, state.ppo), trainer.robot, origin_of(run, best=best))
    except OSError as error:
        raise UserError(f"folder {folder} cannot be written: {error.strerror}") from None


def _check_deployable(run: Run, option: str) -> None:
    """Refuse a run without a policy for other programs, or without the packages that ``option`` needs."""
    deploy.check_installed(option)
    if not (run.checkpoints.iterations() or run.checkpoints.iterations(best=True)):
        raise UserError(f"run {run.folder} has no checkpoint: {option} needs one, train the run first")


def origin_of(run: Run, *, best: bool = True) -> deploy.Origin:
    """Where the run's best policy, or its newest, comes from, as its ONNX file and its card say."""
    return deploy.Origin(
        run=run.folder.resolve().name,
        config=run.config,
        motions=tuple(run.motions(run.config)),
        commit=run.provenance().get("commit"),
        evaluation=_measured(run, _name("evaluation.json", best)),
        changed=bool(run.provenance().get("uncommitted_changes")),
        commands=_commands(run),
        steering=_measured(run, _name("steering.json", best)),
        robustness=_measured(run, _name("robustness.json", best)),
    )


def _measured(run: Run, name: str) -> dict[str, Any] | None:
    """What ``fmpjax evaluate`` wrote into a file of the run; None where it did not."""
    path = run.folder / name
    if not path.exists():
        return None
    try:
        figures = json.loads(path.read_text())
    except ValueError:
        figures = None
    if not isinstance(figures, dict):
        raise UserError(f"{path} is not a file of `fmpjax evaluate`: expected a JSON object of figures")
    return figures


def _commands(run: Run) -> dict[str, tuple[float, float]] | None:
    """Lowest and highest commanded velocities of a run that has them."""
    if run.config.command.kind != "velocity":
        return None
    low, high = velocity.extent(run.config.command, run.trainer().env.library)
    names = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
    return {name: (float(low[i]), float(high[i])) for i, name in enumerate(names)}


def _stride_frames(trainer: Trainer, played: Episodes) -> np.ndarray:
    """Twelve pictures of one second of the policy, from the late part of its longest episode."""
    episode = longest(played)
    length = int(played.length[episode])
    last = min(length - 1, int(0.7 * len(played.qpos)))
    rows = np.linspace(max(0, last - int(trainer.config.control_rate)), last, 12).astype(int)
    return render.render_frames(trainer.robot, played.qpos[rows, episode], width=320, height=320)
