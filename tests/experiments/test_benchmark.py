"""The benchmark: its plan, cells that survive a kill and run once, here and on a cluster, and a prior that joins."""

import csv
import dataclasses
import json
import os
import re
import signal
import sys
import time

import numpy as np
import pytest
from filelock import FileLock

from fmpjax import config as configuration
from fmpjax import priors
from fmpjax.errors import UserError
from fmpjax.experiments import benchmark
from fmpjax.experiments.common import cells, engines, measured, scores
from fmpjax.experiments.common.cells import Specification
from fmpjax.experiments.common.work import RUN, Measure, Task
from tests.helpers import TINY

SMALL = {key: ",".join(map(str, v)) if isinstance(v, tuple) else v for key, v in TINY.items()}
try:
    # Here and not in a test: its import closes the streams of all log handlers but the standard ones, which in a test
    # are those that capture the output.
    import submitit
except ImportError:
    submitit = None
needs_submitit = pytest.mark.skipif(submitit is None, reason="the extra benchmark is not installed")


def small(*methods, motions=("walk",), seeds=(0,)):
    settings = {**benchmark.SETTINGS, **SMALL}
    specification = Specification(
        preset="smoke", methods=methods, resets=("dataset",), seeds=seeds, settings=settings, pictures=False
    )
    return benchmark.plan(specification, motions)


# --- the plan --------------------------------------------------------------------------------------------------------


def test_all_methods_have_one_setting_for_all_motions():
    planned = benchmark.plan(
        Specification(preset="laptop", methods=priors.METHODS, seeds=(0, 1), settings=benchmark.SETTINGS),
        benchmark.MOTIONS,
    )
    assert len(planned) == len(priors.METHODS) * 4 * 2 * 2
    for method in priors.METHODS:
        configs = [configuration.flatten(cell.config) for cell in planned if cell.config.method == method]
        apart = {key for key in configs[0] if len({str(config[key]) for config in configs}) > 1}
        assert apart == {"motion", "seed", "env.reset"}
    assert planned[0].name == f"{priors.METHODS[0]}-dataset-walk/seed0" and planned[0].config.features.axes == "heading"
    assert len(planned[0].config.evaluations) == 10
    assert "--no-pictures" not in planned[0].command and all("--no-pictures" in c.command for c in small("fmp"))


def test_motions_of_ones_own_join_the_default_ones(tmp_path):
    from fmpjax import motion

    mine = motion.save(motion.load("slow_walk"), tmp_path / "mine.npz")
    assert [cell.variant for cell in small("fmp", motions=("walk", str(mine)))] == ["walk", "mine"]
    for motions, said in (
        ((), "--only leaves out the default motions: expected at least one --motion"),
        (("walk", str(tmp_path / "none.npz")), "none.npz"),
        (("mine.npz", str(mine)), "motions 'mine.npz' and '.*mine.npz' are both called 'mine': expected two names"),
    ):
        with pytest.raises(UserError, match=said):
            small("fmp", motions=motions)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--set", "method=amp"], "--set 'method=amp': expected section.field=value, of a setting that all cells"),
        (["--set", "amp.updates"], "--set 'amp.updates': expected section.field=value"),
        (["--cluster", "lsf"], "--cluster is 'lsf': expected one of none, local, slurm"),
        (["--slurm", "partition=gpu"], "--slurm partition=gpu goes with --cluster slurm, not none"),
        (["--workers", "0"], "--workers is 0: expected at least 1"),
        (["--methods", "gan"], "unknown method 'gan'"),
    ],
)
def test_bad_options_are_refused_before_anything_runs(tmp_path, capsys, options, said):
    with pytest.raises(SystemExit) as exit_:
        benchmark.cli(["--smoke", "--out", str(tmp_path / "out"), *options])
    assert exit_.value.code == 2 and said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


# --- a cell runs once ------------------------------------------------------------------------------------------------


def task(folder, name="fmp-dataset-walk/seed0", finished=True):
    """A task of a cell that has spent its budget of ten iterations, and may have been evaluated."""
    run = folder / name
    run.mkdir(parents=True, exist_ok=True)
    (run / "metrics.csv").write_text("iteration,transitions,seconds\n10,640,3.0\n")
    if finished:
        (run / "evaluation.json").write_text("{}")
    return Task(str(folder), (name,), 10, ("--bad-option",))


def test_a_finished_cell_is_not_run_again(tmp_path, monkeypatch):
    trained = []
    monkeypatch.setattr(Task, "_train", lambda self: trained.append(self.cells))
    task(tmp_path).run()
    assert not trained
    task(tmp_path, "fmp-dataset-walk/seed1", finished=False).run()
    assert trained == [("fmp-dataset-walk/seed1",)]


def test_a_cell_that_another_process_has_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(Task, "_train", lambda self: pytest.fail("it was run"))
    mine = task(tmp_path, finished=False)
    with FileLock(tmp_path / "fmp-dataset-walk" / "seed0.lock"):
        with pytest.raises(UserError, match="cell fmp-dataset-walk/seed0 is being run by another process: wait"):
            mine.run()


def test_a_trained_cell_is_measured_once_and_loses_its_checkpoints_where_they_are_not_kept(tmp_path, monkeypatch):
    """What was finished without checkpoints stays as it is: nothing can be measured of it any more."""
    ran = []

    def command(self, arguments):
        ran.append(list(arguments))
        (tmp_path / self.cells[0] / "figures.json").write_text("{}")

    monkeypatch.setattr(Task, "_command", command)
    mine = dataclasses.replace(task(tmp_path), measures=(Measure("figures.json", ("evaluate", RUN, "--robust")),))
    run = tmp_path / mine.cells[0]
    assert mine.done()  # there is no checkpoint to measure
    (run / "checkpoints" / "10").mkdir(parents=True)
    assert not mine.done()
    mine.run()
    assert ran == [["evaluate", str(run), "--robust"]] and mine.done() and (run / "checkpoints").exists()
    dropping = dataclasses.replace(mine, keep=False)
    assert not dropping.done()
    dropping.run()
    assert len(ran) == 1 and dropping.done() and not (run / "checkpoints").exists()
    assert (run / "evaluation.json").exists() and (run / "metrics.csv").exists()


def test_a_measurement_that_fails_fails_the_cell(tmp_path, monkeypatch):
    monkeypatch.setattr(Task, "_command", lambda self, arguments: None)
    mine = dataclasses.replace(task(tmp_path), measures=(Measure("figures.json", ()),), keep=False)
    (tmp_path / mine.cells[0] / "checkpoints").mkdir()
    with pytest.raises(ChildProcessError, match=r"seed0 has no figures.json: see .*seed0.log"):
        mine.run()
    assert (tmp_path / mine.cells[0] / "checkpoints").exists() and not mine.done()


def test_scores_of_what_was_measured():
    robust = [
        {"disturbance": "push", "size": "0.25 m/s", "episodes": 64, "falls": 8},
        {"disturbance": "push", "size": "0.5 m/s", "episodes": 64, "falls": 24},
        {"disturbance": "delay", "size": "10 ms", "episodes": 64, "falls": 64},
    ]
    ranking = [
        {"windows": name, "beaten": beaten}
        for name, beaten in (("demonstration", 0.5), ("frozen", 1.0), ("reversed", 0.6), ("pool", 0.9))
    ]
    found = measured.scores(robust, ranking)
    assert found["falls_push"] == 25 and found["falls_delay"] == 100 and found["preferred"] == pytest.approx(80)
    assert np.isnan(found["falls_friction"]) and np.isnan(measured.scores([], [])["preferred"])
    assert set(found) <= {score.name for score in scores.SCORES}
    assert [len(measured.of(cell).measures) for cell in small("fmp", "tracking")] == [2, 1]


def test_a_seed_that_another_command_has_trained_is_not_begun_again(tmp_path):
    """Two seeds that were to be trained at once: the first has iterations, the second nothing."""
    mine = task(tmp_path, finished=False)
    run = tmp_path / mine.cells[0]
    (run / "config.json").write_text("{}")
    both = Task(str(tmp_path), (*mine.cells, "fmp-dataset-walk/seed1"), 10, ())
    with pytest.raises(UserError, match="cells .*seed0, .*seed1 are at different iterations, because another"):
        both.run()
    assert (run / "metrics.csv").exists()


def test_a_process_that_ends_before_its_cell_has_failed(tmp_path):
    """The log says why, and the engine's process ends badly."""
    engine, waiting = engines.Processes(1), [task(tmp_path, finished=False), task(tmp_path, "fmp/seed1")]
    (begun,) = engine.start(waiting)
    assert len(waiting) == 1 and engine.running() == [begun] and begun.cores
    assert engine.start(waiting) == []  # one place, which is taken
    until = time.monotonic() + 60
    while not (over := engine.ended()) and time.monotonic() < until:
        time.sleep(0.1)
    assert over == [begun] and engine.running() == []
    assert "did not come to its end: see" in begun.log.read_text() and "--bad-option" in begun.log.read_text()


def test_shares_are_even_and_all_of_the_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3, 4}, raising=False)
    assert engines.shares(2) == [{0, 2, 4}, {1, 3}]
    assert engines.shares(6) == [{0, 1, 2, 3, 4}] * 6


# --- submitit --------------------------------------------------------------------------------------------------------


def test_a_cluster_without_submitit_is_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(UserError, match=re.escape("--cluster local needs submitit, which is not installed")):
        engines.make("local", 1, tmp_path, 1)


@needs_submitit
def test_submitit_runs_a_finished_and_a_failing_cell(tmp_path):
    good, bad = task(tmp_path), task(tmp_path, "amp-dataset-walk/seed0", finished=False)
    engine, waiting, over = engines.make("local", 2, tmp_path, 2), [good, bad], []
    assert len(engine.start(waiting)) == 2 and not waiting
    until = time.monotonic() + 120
    while engine.running() and time.monotonic() < until:
        over += engine.ended()
        time.sleep(0.2)
    assert {each.cells for each in over} == {good.cells, bad.cells}
    assert "amp-dataset-walk/seed0 did not come to its end" in bad.log.read_text()
    assert bad.checkpoint().function == bad  # where its time is up, the same again


@needs_submitit
def test_bad_options_of_slurm_and_no_slurm_are_one_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="--cluster slurm with --slurm a=1 cannot be used: .*srun"):
        engines.make("slurm", 1, tmp_path, 1, ["a=1"])
    with pytest.raises(UserError, match=re.escape("--slurm has 'gpu': expected NAME=VALUE")):
        engines.make("slurm", 1, tmp_path, 1, ["gpu"])


SBATCH = """#!/bin/bash
# Stands in for SLURM: runs each task of the array after the other.
cp "$1" "$(dirname "$0")/submitted.sh"
count=$(grep -oP '#SBATCH --array=0-\\K[0-9]+' "$1")
for i in $(seq 0 "$count"); do
  SLURM_ARRAY_JOB_ID=7 SLURM_ARRAY_TASK_ID=$i SLURM_JOB_ID=$((8 + i)) SLURM_NTASKS=1 SLURM_JOB_NUM_NODES=1 \\
    SLURM_NODEID=0 SLURM_PROCID=0 SLURM_LOCALID=0 bash "$1" < /dev/null >> "$(dirname "$0")/nodes.log" 2>&1 &
done
echo "Submitted batch job 7"
"""
SRUN = """#!/bin/bash
while [[ "$1" == --* || "$1" != *python* ]]; do shift; done
exec "$@"
"""


@needs_submitit
def test_slurm_gets_one_array_of_all_cells(tmp_path, monkeypatch):
    """A stand-in for SLURM runs the array's tasks; both cells are finished ones."""
    for name, text in (("sbatch", SBATCH), ("srun", SRUN), ("sacct", "#!/bin/bash\n"), ("scancel", "#!/bin/bash\n")):
        path = tmp_path / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    out = tmp_path / "out"
    waiting = [task(out), task(out, "amp-dataset-walk/seed0")]
    engine = engines.make("slurm", 1, out, 2, ["partition=gpu", "timeout_min=90"])
    assert len(engine.start(waiting)) == 2
    until, over = time.monotonic() + 120, []
    while engine.running() and time.monotonic() < until:
        over += engine.ended()
        time.sleep(0.2)
    script = (tmp_path / "bin" / "submitted.sh").read_text()
    assert len(over) == 2, (tmp_path / "bin" / "nodes.log").read_text()
    for option in ("--array=0-1%1", "--partition=gpu", "--time=90", "--job-name=fmpjax"):
        assert f"#SBATCH {option}" in script
    assert [each.log.exists() for each in over] == [True, True]


# --- from the plan to the page ---------------------------------------------------------------------------------------


PRIOR = '''"""A reward of one for every state that is finite."""

import jax.numpy as jnp

from fmpjax.priors import MotionPrior


def make(expert, config):
    """One, whatever the robot does."""

    def update(state, rollout, key):
        return state, jnp.where(rollout.valid, 1.0, 0.0), {}

    return MotionPrior(lambda key: (), update, lambda state, features: jnp.zeros(len(features)))
'''


@pytest.mark.slow
def test_a_new_prior_is_one_file_and_one_line(tmp_path, monkeypatch):
    """Its cells are planned, trained, scored and compared as those of every method."""
    monkeypatch.setattr(priors, "_REGISTRY", dict(priors._REGISTRY))
    monkeypatch.setattr(sys, "argv", list(sys.argv))
    (tmp_path / "constant.py").write_text(PRIOR)
    monkeypatch.syspath_prepend(tmp_path)
    constant = __import__("constant")
    priors.register("constant", constant.make)

    monkeypatch.setattr(measured, "EPISODES", 2)
    monkeypatch.setattr(measured, "DISTURBANCES", ("push",))
    planned = [measured.of(cell) for cell in small("constant")]
    for each in cells._tasks(planned, tmp_path / "out", together=False, keep=False):
        each.run()
        assert each.done()
    paths = benchmark.write(planned, tmp_path / "out")
    assert all(path.stat().st_size for path in paths)
    with (tmp_path / "out" / "benchmark.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [(x["method"], x["motion"], x["budget"]) for x in lines] == [
        ("constant", "walk", "transitions"), ("constant", "walk", "seconds"),
    ]  # fmt: skip
    assert float(lines[0]["power"]) > 0 and float(lines[0]["action_rate"]) > 0 and float(lines[0]["joint_jerk"]) > 0
    # A constant prefers nothing: every comparison is a tie. The last evaluation of both budgets is the only one.
    assert float(lines[0]["preferred"]) == 50 and 0 <= float(lines[0]["falls_push"]) <= 100
    with (tmp_path / "out" / "benchmark_robustness.csv").open() as file:
        assert [row["size"] for row in csv.DictReader(file)] == ["0.25 m/s", "0.5 m/s", "1 m/s"]
    assert (tmp_path / "out" / "benchmark_ranking.csv").exists()
    assert not list((tmp_path / "out").glob("**/checkpoints"))
    record = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert record["plan"]["methods"] == ["constant"] and record["cells"] == {"planned": 1, "finished": 1}
    assert str(tmp_path) not in json.dumps(record)
    assert "dataset, equal transitions: constant" in (tmp_path / "out" / "benchmark.md").read_text()


@pytest.mark.slow
@needs_submitit
def test_a_killed_cell_continues_to_its_end_and_is_then_left_alone(tmp_path, capsys):
    """A process of this machine is killed after its first checkpoint; submitit's continues from there."""
    planned = cells.plan(Specification(preset="smoke", methods=("fmp",), resets=("dataset",), settings=SMALL))
    run = tmp_path / "fmp-dataset" / "seed0"
    engine = engines.Processes(1)
    engine.start(cells._tasks(planned, tmp_path, together=False))
    until = time.monotonic() + 400

    def saved():
        return [int(path.name) for path in run.glob("checkpoints/*") if path.name.isdigit()]

    while not saved() and engine.running() and time.monotonic() < until:
        time.sleep(0.02)
        assert engine.ended() == [], (tmp_path / "fmp-dataset" / "seed0.log").read_text()
    ((_, process),) = engine._running.values()
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    last = max(saved())
    assert 0 < last < 10 and not cells.finished(planned[0], tmp_path)
    before = (run / "metrics.csv").read_text().splitlines()[: 1 + last // 2]  # rows of two iterations each

    cells.run(planned, tmp_path, cluster="local")
    assert cells.finished(planned[0], tmp_path)
    # What was saved was not trained again, training time included.
    assert (run / "metrics.csv").read_text().splitlines()[: len(before)] == before
    stamp = (run / "metrics.csv").stat().st_mtime_ns
    rows = [line.split(",") for line in (run / "metrics.csv").read_text().splitlines()]
    assert [row[0] for row in rows[1:]] == ["2", "4", "6", "8", "10"]
    (again,) = json.loads((run / "provenance.json").read_text())["resumed"]
    assert again["command"].startswith("fmpjax train --preset smoke --set=") and again["command"].endswith("--resume")
    cells.run(planned, tmp_path, cluster="local")
    assert (run / "metrics.csv").stat().st_mtime_ns == stamp
    assert "1 cells, 1 of them finished before" in capsys.readouterr().out
    assert len(list((tmp_path / "jobs").glob("*_submitted.pkl"))) == 1
