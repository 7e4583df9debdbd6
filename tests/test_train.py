"""A run from its first iteration to its last, interrupted and resumed in every way that must not matter."""

import csv
import dataclasses
import fcntl
import json
import logging
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event

from fmpjax import cli, config, policy, runs
from fmpjax.checkpoint import Checkpoints
from fmpjax.config import preset
from fmpjax.errors import UserError
from fmpjax.evaluate import Episodes, Evaluation, Evaluator
from fmpjax.logs import MetricsLog
from fmpjax.priors import Expert
from fmpjax.trainer import Trainer
from tests.helpers import TINY, settings, tiny


def command(*arguments):
    return [sys.executable, "-m", "fmpjax.cli", *map(str, arguments)]


def rows(run):
    with (run / "metrics.csv").open(newline="") as file:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(file)]


def leaves(run, *, best=False):
    """A run's newest checkpoint, leaf by leaf."""
    trainer = runs.Run.open(run).trainer()
    state = Checkpoints(run).restore(trainer.shapes(), best=best)
    return {jax.tree_util.keystr(path): np.asarray(x) for path, x in jax.tree_util.tree_flatten_with_path(state)[0]}


@pytest.fixture(scope="module")
def compiled_programs():
    """Names of the programs that XLA compiles while the module's run trains."""
    return []


@pytest.fixture(scope="module")
def trained(tmp_path_factory, compiled_programs):
    """A run trained from start to end in this process."""
    folder = tmp_path_factory.mktemp("train") / "whole"
    run = runs.Run.create(folder, tiny())

    class Listener(logging.Handler):
        def emit(self, record):
            message = record.getMessage()
            if message.startswith("Compiling "):
                compiled_programs.append(message.split()[1])

    listener, log = Listener(), logging.getLogger("jax._src.interpreters.pxla")
    log.addHandler(listener)
    try:
        with jax.log_compiles():
            assert runs.train(run) is runs.End.BUDGET
    finally:
        log.removeHandler(listener)
    return folder


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """The same run, stopped by its time budget after the first chunk."""
    folder = tmp_path_factory.mktemp("train") / "halved"
    run = runs.Run.create(folder, tiny())
    assert runs.train(run, minutes=1e-6) is runs.End.TIME
    return folder


@pytest.fixture(scope="module")
def trainer(trained):
    return runs.Run.open(trained).trainer()


# --- the course of a run ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_program_is_compiled_exactly_once(trained, compiled_programs):
    """Five chunks and two evaluations: one compilation of the chunk, one of the evaluation's rollout."""
    chunks = [name for name in compiled_programs if "chunk" in name]
    plays = [name for name in compiled_programs if "_play" in name]
    assert len(chunks) == 1 and len(plays) == 1, compiled_programs


@pytest.mark.slow
def test_the_state_is_given_to_the_program(trainer):
    """The compiled chunk writes its state into the buffers of the one before."""
    state = trainer.init()
    program = trainer.compile(state)
    assert program.memory_analysis().alias_size_in_bytes > 0.9 * sum(x.nbytes for x in jax.tree.leaves(state))


@pytest.mark.slow
def test_the_paper_s_program_never_leaves_the_device(walk):
    """Lowered for an NVIDIA device, an iteration of ``paper`` with MJX has no call to the host; a CPU's has MuJoCo."""
    few = {"transitions": 8 * 32, "env.count": 8, "prior.bank": 16, "prior.minibatch": 16, "ppo.hidden": (16,)}

    def lowered(backend, platform):
        trainer = Trainer(preset("paper", **few, **{"physics.backend": backend}), walk)
        traced = jax.jit(trainer.iteration).trace(trainer.shapes())
        return traced.lower(lowering_platforms=(platform,)).as_text()

    assert "fmpjax_native_" in lowered("native", "cpu")
    program = lowered("mjx", "cuda")
    assert "callback" not in program and "fmpjax_" not in program
    # All that it calls outside StableHLO is the device's own Cholesky factor, for the constraint solver.
    called = set(re.findall(r"custom_call @(\w+)", program))
    assert called == {"cusolver_potrf_ffi"}


@pytest.mark.slow
def test_metrics_have_a_row_a_chunk(trained):
    found = rows(trained)
    assert [int(r["iteration"]) for r in found] == [2, 4, 6, 8, 10]
    assert [int(r["transitions"]) for r in found] == [128, 256, 384, 512, 640]
    # Evaluations at 40 and 100 per cent of the budget, and nowhere else.
    assert [bool(r["eval/quality"]) for r in found] == [False, True, False, False, True]
    for row in found:
        assert np.isfinite(float(row["train/reward"])) and float(row["train/nonfinite"]) == 0
        assert 0 < float(row["train/reward"]) < 2


@pytest.mark.slow
def test_last_three_checkpoints_and_the_best_one_are_kept(trained):
    assert Checkpoints(trained).latest() == 10
    # A run saves at evaluations and at its end: after 4 and 10 iterations.
    assert sorted(p.name for p in (trained / "checkpoints").iterdir() if p.name.isdigit()) == ["10", "4"]
    best = [int(p.name) for p in (trained / "best").iterdir() if p.name.isdigit()]
    quality = {int(r["iteration"]): float(r["eval/quality"]) for r in rows(trained) if r["eval/quality"]}
    # Ties go to the later one.
    assert best == [max(i for i, q in quality.items() if q == max(quality.values()))]


@pytest.mark.slow
def test_save_keeps_three_and_only_one_best(trainer, tmp_path):
    checkpoints = Checkpoints(tmp_path)
    state = trainer.init()
    for i in (1, 2, 3, 4, 5):
        checkpoints.save(state._replace(iteration=jnp.int32(i)))
        checkpoints.save(state._replace(iteration=jnp.int32(i)), best=True)
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir() if p.name.isdigit()) == ["3", "4", "5"]
    assert [p.name for p in (tmp_path / "best").iterdir() if p.name.isdigit()] == ["5"]
    restored = checkpoints.restore(state)
    assert int(restored.iteration) == 5
    for a, b in zip(jax.tree.leaves(state._replace(iteration=5)), jax.tree.leaves(restored), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_a_spent_budget_trains_no_further(trained):
    before = rows(trained)
    assert runs.train(runs.Run.open(trained), resume=True) is runs.End.BUDGET
    assert rows(trained) == before and Checkpoints(trained).latest() == 10


@pytest.mark.slow
def test_finish_writes_evaluation_curves_and_video(trained, capsys):
    paths = runs.finish(runs.Run.open(trained))
    assert ", by evaluation.json (the best policy) and the last " in capsys.readouterr().out
    assert all(p.is_file() and p.stat().st_size > 0 for p in paths)
    assert {"evaluation.json", "curves.png"} <= {p.name for p in paths}
    evaluation = json.loads((trained / "evaluation.json").read_text())
    assert evaluation["episodes"] == 4 and 0 <= evaluation["falls"] <= 4 and 0 < evaluation["mean_length"] <= 40
    # The best checkpoint's figures are those that training logged when it chose it.
    iteration = Checkpoints(trained).latest(best=True)
    logged = next(r for r in rows(trained) if int(r["iteration"]) == iteration)
    np.testing.assert_allclose(evaluation["mean_length"], float(logged["eval/mean_length"]), rtol=1e-4)
    np.testing.assert_allclose(evaluation["discrepancy"], float(logged["eval/discrepancy"]), rtol=1e-4)


# --- interruptions ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_an_export_carries_the_best_policy(trained, tmp_path):
    run = runs.Run.open(trained)
    written = runs.export(run, tmp_path / "out")
    assert tmp_path / "out" / "policy.npz" in written
    trainer, state = run.policy()
    observations = trainer.env.clip_observations[:5]
    actions, _ = trainer.ppo.act(state.ppo, deterministic=True)(observations, None)
    loaded = policy.load(tmp_path / "out" / "policy.npz")
    np.testing.assert_allclose(loaded(observations), trainer.env.actions(actions), atol=2e-5)
    assert sum(path.stat().st_size for path in written if path.name == "policy.npz") < 1e6


@pytest.mark.slow
def test_an_export_carries_the_newest_policy_with_its_own_figures(trained, tmp_path):
    run = runs.Run.open(shutil.copytree(trained, tmp_path / "run"))
    (run.folder / "evaluation-last.json").write_text(json.dumps({"falls": 3}))
    for name in ("frames.png", "robustness.json"):
        (run.folder / name).write_text("{}")
    # What an earlier export shows of the best policy does not stay beside the newest one; other files do.
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "course.mp4").write_text("mine")
    runs.export(run, tmp_path / "mine", best=False)
    assert (tmp_path / "mine" / "course.mp4").read_text() == "mine"
    for options in ([], ["--last"]):
        cli.main(["export", str(run.folder), str(tmp_path / "out"), *options])
        left = [(tmp_path / "out" / name).exists() for name in ("frames.png", "robustness.json")]
        assert left == [not options] * 2
    trainer, state = run.policy(best=False)
    observations = trainer.env.clip_observations[:5]
    actions, _ = trainer.ppo.act(state.ppo, deterministic=True)(observations, None)
    loaded = policy.load(tmp_path / "out" / "policy.npz")
    np.testing.assert_allclose(loaded(observations), trainer.env.actions(actions), atol=2e-5)
    assert json.loads((tmp_path / "out" / "evaluation.json").read_text())["falls"] == 3
    assert (tmp_path / "out" / "metrics.csv").exists()


@pytest.mark.slow
def test_a_resume_in_a_new_process_is_exact(trained, stopped):
    """Two iterations, a checkpoint, and eight more in another process are ten in one, bit for bit."""
    assert Checkpoints(stopped).latest() == 2 and len(rows(stopped)) == 1
    done = subprocess.run(
        command("train", "--resume", "--run", stopped, "--no-pictures"),
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    whole, halves = leaves(trained), leaves(stopped)
    assert whole.keys() == halves.keys() and len(whole) > 30
    for name, leaf in whole.items():
        np.testing.assert_array_equal(leaf, halves[name], err_msg=name)
    assert int(whole[".iteration"]) == 10
    made = json.loads((stopped / "provenance.json").read_text())
    assert [part["command"] for part in made["resumed"]] == [f"fmpjax train --resume --run {stopped} --no-pictures"]
    assert made["command"] != made["resumed"][0]["command"]
    # An evaluation is logged where time runs out; apart from it every row agrees to its last digit.
    for a, b in zip(rows(trained), rows(stopped), strict=True):
        differ = [k for k in a if a[k] != b[k] and not (k.startswith("eval/") and not a[k])]
        assert not differ, differ


@pytest.mark.slow
def test_a_larger_budget_goes_on_as_if_it_had_been_the_first(trained, tmp_path, monkeypatch, capsys):
    """A signal in its last iterations costs the first budget nothing, not even the evaluation at its end."""
    run = runs.Run.create(tmp_path / "run", tiny(transitions=TINY["transitions"] // 5))
    with monkeypatch.context() as patch:
        patch.setattr(runs.training.StopSignals, "__enter__", lambda self: setattr(self, "requested", True) or self)
        patch.setattr(runs.training.StopSignals, "__exit__", lambda *_: None)
        assert runs.train(run) is runs.End.BUDGET
    assert rows(run.folder)[-1]["eval/quality"] and Checkpoints(run.folder).latest(best=True) == 2
    run.extend(TINY["transitions"])
    assert run.config == tiny()
    assert runs.train(run, resume=True) is runs.End.BUDGET
    evaluated = [int(row["transitions"]) for row in rows(run.folder) if row["eval/quality"]]
    said = re.findall(r"^diagnosis at ([0-9,]+) transitions, by the newest evaluation", capsys.readouterr().out, re.M)
    assert [int(number.replace(",", "")) for number in said] == evaluated
    whole, halves = leaves(trained), leaves(run.folder)
    for name, leaf in whole.items():
        np.testing.assert_array_equal(leaf, halves[name], err_msg=name)


@pytest.mark.slow
def test_sigterm_saves_and_ends_well(tmp_path):
    folder = tmp_path / "run"
    # Twenty thousand iterations: it cannot end before the signal.
    changes = TINY | {"transitions": 64 * 20_000, "evaluations": (1.0,)}
    process = subprocess.Popen(
        command("train", "--preset", "smoke", "--run", folder, *settings(changes)),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        until = time.monotonic() + 300
        while time.monotonic() < until and process.poll() is None:
            if (folder / "metrics.csv").exists() and len(rows(folder)) >= 2:
                break
            time.sleep(0.2)
        process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=200)
    finally:
        if process.poll() is None:
            process.kill()
    assert process.returncode == 0, said
    assert "stopping after the current call of the program" in said and "Continue with --resume" in said
    saved = Checkpoints(folder).latest()
    assert saved == int(rows(folder)[-1]["iteration"]) >= 4

    # It goes on from there, and an end that is a time budget's is clean too.
    cli.main(["train", "--resume", "--run", str(folder), "--minutes", "0.01", "--no-pictures"])
    assert Checkpoints(folder).latest() > saved
    iterations = [int(r["iteration"]) for r in rows(folder)]
    assert iterations == list(range(2, iterations[-1] + 1, 2))


@pytest.mark.slow
def test_rows_beyond_the_checkpoint_are_written_again(trained, tmp_path, monkeypatch):
    """A process that is killed after it logged and before it saved leaves rows that a resume computes anew."""
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    shutil.rmtree(folder / "checkpoints" / "10")
    expected = rows(folder)
    # Checkpoints come by the clock too: with no interval, after every chunk.
    monkeypatch.setattr(runs.clock, "SAVE_INTERVAL", 0.0)
    assert runs.train(runs.Run.open(folder), resume=True) is runs.End.BUDGET
    assert rows(folder) == expected
    assert {p.name for p in (folder / "checkpoints").iterdir() if p.name.isdigit()} == {"6", "8", "10"}
    again = leaves(folder)
    for name, leaf in leaves(trained).items():
        np.testing.assert_array_equal(leaf, again[name], err_msg=name)


@pytest.mark.slow
def test_a_resume_never_begins_anew_over_what_is_there(trained, trainer, tmp_path):
    """The best state where the newest are gone; a refusal where runs have no iteration in common."""
    one, other = tmp_path / "one", tmp_path / "other"
    shutil.copytree(trained, one)
    shutil.rmtree(one / "checkpoints")
    best = Checkpoints(trained).latest(best=True)
    (state,) = runs.session.first_states(trainer, [runs.Run.open(one)], True)
    assert int(state.iteration) == best
    shutil.copytree(one, other)
    (other / "best" / str(best)).rename(other / "best" / "99")
    with pytest.raises(UserError, match=rf"one has \[{best}\], .*other has \[99\]: expected a checkpoint of one iter"):
        runs.session.first_states(trainer, [runs.Run.open(one), runs.Run.open(other)], True)
    shutil.rmtree(one / "best")
    assert int(runs.session.first_states(trainer, [runs.Run.open(one)], True)[0].iteration) == 0


@pytest.mark.slow
def test_two_processes_never_train_in_one_folder(trained):
    with (trained / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(UserError, match="is being trained by another process: wait for its end"):
            runs.train(runs.Run.open(trained), resume=True)
    assert runs.train(runs.Run.open(trained), resume=True) is runs.End.BUDGET


def test_tensorboard_keeps_the_course_before_a_resume(tmp_path):
    """Its steps are transitions, and what a resume computes again is purged from there on, not from the iteration."""
    log = MetricsLog(tmp_path, ["x"])
    for iteration in (2, 4, 6):
        log.write(iteration, 64 * iteration, 1.0, {"x": 0.5})
    log.close()
    shutil.rmtree(tmp_path / "tensorboard")
    MetricsLog(tmp_path, ["x"], 4).close()
    (path,) = (tmp_path / "tensorboard").iterdir()
    data, events = path.read_bytes(), []
    while data:  # a record: its length (8 bytes), a checksum (4), the event, a checksum (4)
        size = int.from_bytes(data[:8], "little")
        events.append(Event.FromString(data[12 : 12 + size]))
        data = data[16 + size :]
    assert [event.step for event in events if event.HasField("session_log")] == [257]


# --- bad checkpoints -------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_truncated_checkpoint_is_named(trained, trainer, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(trained, folder)
    largest = max(
        (p for p in (folder / "checkpoints" / "10").rglob("*") if p.is_file()), key=lambda p: p.stat().st_size
    )
    largest.write_bytes(largest.read_bytes()[: largest.stat().st_size // 2])
    with pytest.raises(UserError) as error:
        Checkpoints(folder).restore(trainer.shapes())
    assert str(folder / "checkpoints" / "10") in str(error.value) and "\n" not in str(error.value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "said"),
    [({"ppo.hidden": (24,)}, "expected float32"), ({"ppo.hidden": (16, 16)}, "only one of the two")],
)
def test_a_checkpoint_of_another_configuration_is_refused(trained, trainer, changes, said):
    other = Trainer(tiny(**changes), trainer.clip)
    with pytest.raises(UserError, match="is of another configuration") as error:
        Checkpoints(trained).restore(other.shapes())
    assert said in str(error.value) and str(trained) in str(error.value)


def test_no_checkpoint_is_said(tmp_path):
    with pytest.raises(UserError, match="has no checkpoint in checkpoints/"):
        Checkpoints(tmp_path).restore(None)
    with pytest.raises(UserError, match="has no checkpoint in best/"):
        Checkpoints(tmp_path).restore(None, best=True)


# --- parts -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("windows", "size"), [(370, 256), (342, 256), (256, 256), (40, 256), (1000, 7), (1, 5)])
def test_expert_bank_is_even_and_in_range(windows, size):
    expert = Expert(jnp.zeros((windows, 1)), 1.0, jnp.ones(1), 1)
    for seed in range(20):
        picked = np.asarray(expert.bank_rows(jax.random.PRNGKey(seed), size))
        assert picked.shape == (size,) and picked.min() >= 0 and picked.max() < windows
        # Every gap, that around the end included, is the mean one rounded down or up; so are the repetitions.
        gaps = np.diff(np.append(picked, picked[0] + windows))
        assert gaps.min() >= windows // size and gaps.max() <= -(-windows // size)
        counts = np.bincount(picked, minlength=windows)
        assert counts.max() <= -(-size // windows) and counts.min() >= size // windows if size >= windows else True


def test_a_clip_of_another_rate_or_robot_is_refused(walk):
    with pytest.raises(UserError, match="30 samples per second: expected the control rate, 50 Hz"):
        Trainer(tiny(), dataclasses.replace(walk, rate=30.0))
    with pytest.raises(UserError, match="of robot 'other'"):
        Trainer(tiny(), dataclasses.replace(walk, robot="other"))


def test_a_clip_shorter_than_a_window_is_refused(walk):
    short = dataclasses.replace(walk, qpos=walk.qpos[:60], qvel=walk.qvel[:60])
    with pytest.raises(UserError, match="features.history is 60: expected fewer than the 60 samples"):
        Trainer(tiny(**{"features.history": 60}), short)


def test_a_clip_too_short_to_evaluate_is_refused(walk):
    short = dataclasses.replace(walk, qpos=walk.qpos[:45], qvel=walk.qvel[:45])
    with pytest.raises(UserError, match=r"lasts 0.\d+ s: expected at least 1 s"):
        Trainer(tiny(), short)


def test_a_configuration_survives_its_file():
    changed = tiny(**{"seed": 7, "frames": "3:99", "ppo.hidden": (5, 4, 3)})
    assert config.from_json(config.to_json(changed)) == changed


@pytest.mark.slow
def test_a_prior_that_normalizes_by_itself_sees_windows_unclipped(walk):
    fmp, amp = (Trainer(tiny(method=method), walk) for method in ("fmp", "amp"))
    far = fmp.env.clip_windows() + 100.0

    def farthest(feature_map):
        return float(jnp.abs(feature_map(far) / fmp.expert.weight).max())

    assert farthest(fmp.prior_map) == pytest.approx(10.0)
    assert farthest(amp.prior_map) > 100.0
    np.testing.assert_array_equal(amp.prior_expert.windows, amp.prior_map(amp.env.clip_windows()))
    # What evaluations and studies measure in is the same for every method.
    assert farthest(amp.feature_map) == pytest.approx(10.0)
    np.testing.assert_array_equal(amp.expert.windows, fmp.expert.windows)


@pytest.mark.slow
def test_seeds_decide_the_start(trainer):
    def flat(state):
        return np.concatenate([np.asarray(x, np.float64).ravel() for x in jax.tree.leaves(state)])

    again, other = Trainer(tiny(), trainer.clip), Trainer(tiny(seed=1), trainer.clip)
    np.testing.assert_array_equal(flat(trainer.init()), flat(again.init()))
    assert np.any(flat(trainer.init()) != flat(other.init()))
    assert np.any(np.asarray(trainer.init().prior.bank) != np.asarray(other.init().prior.bank))


# --- evaluation ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def evaluator(trainer):
    return Evaluator(trainer, 6)


@pytest.fixture(scope="module")
def fallen(trainer, evaluator):
    """Episodes of a policy that throws itself down: every target far off in one direction."""
    state = trainer.init().ppo
    params = jax.tree.map(jnp.zeros_like, state.actor)
    params["params"]["Dense_0"]["bias"] += 20.0
    return evaluator.play(state._replace(actor=params))


@pytest.mark.slow
def test_a_policy_that_falls_is_counted_to_its_fall(trainer, evaluator, fallen):
    assert fallen.qpos.shape == (40, 6, 7 + trainer.robot.joint_count)
    assert fallen.fell.all() and (fallen.length > 2).all() and (fallen.length < 40).all()
    for i, length in enumerate(fallen.length):
        # The fall is on the last step that counts; after it nothing moves.
        observed = trainer.env._observe(jnp.asarray(fallen.qpos[:, i]), jnp.asarray(fallen.qvel[:, i]))
        expected = np.arange(40) >= length - 1
        np.testing.assert_array_equal(observed.fallen, expected)
        assert (fallen.qpos[length - 1 :, i] == fallen.qpos[length - 1, i]).all()
        assert np.any(fallen.qpos[length - 2, i] != fallen.qpos[length - 1, i])
    result = evaluator.measure(fallen)
    assert result.episodes == result.falls == 6 and result.quality == 0.0
    np.testing.assert_allclose(result.mean_length, fallen.length.mean())
    # Nobody lives to five seconds, so there is no late speed, and that is said, not made up.
    assert result.late_n == 0 and np.isnan(result.late_speed)
    assert json.loads(result.to_json())["late_speed"] is None
    assert result.discrepancy > 0.01


@pytest.mark.slow
def test_the_demonstration_itself_scores_perfectly(trainer, fallen):
    """Episodes that replay the clip: its excursion, its amplitude, and next to no discrepancy."""
    clip, horizon = trainer.clip, trainer.env.horizon
    evaluator = Evaluator(trainer, 4)
    steps = 300
    starts = np.array([horizon - 1, 20, 30, 40])
    index = starts[None] + 1 + np.arange(steps)[:, None]
    table = np.asarray(trainer.env._table.frame)
    played = Episodes(
        qpos=clip.qpos[index].astype(np.float32),
        qvel=clip.qvel[index].astype(np.float32),
        length=np.full(4, steps),
        fell=np.zeros(4, bool),
        start_qpos=clip.qpos[starts].astype(np.float32),
        history=np.stack([table[s - horizon + 1 : s + 1] for s in starts]),
        clip=np.zeros(4, int),
    )
    result = evaluator.measure(played)
    assert result.falls == 0 and result.mean_length == steps
    np.testing.assert_allclose(result.excursion, 1.0, atol=0.05)
    assert result.amplitude_mae < 1.5 and 0 <= result.contact_foot_speed < 0.3 and result.imbalance < 0.1
    assert result.discrepancy < evaluator.measure(fallen).discrepancy / 20
    np.testing.assert_allclose(result.displacement, steps / clip.rate * result.demonstration_speed, rtol=0.1)


@pytest.mark.slow
def test_evaluations_start_from_matched_resets(trainer, evaluator, fallen):
    again = Evaluator(trainer, 6)
    np.testing.assert_array_equal(again.rows, evaluator.rows)
    np.testing.assert_array_equal(fallen.start_qpos, trainer.clip.qpos[evaluator.rows[:6]].astype(np.float32))


def test_memory_that_runs_out_leaves_the_last_checkpoint_good(trained, tmp_path, monkeypatch, capsys):
    """The third call of the program fails as XLA fails: a sentence, exit 2, and a run that goes on to the same end."""
    folder = tmp_path / "short"
    runs.Run.create(folder, tiny())
    compiled = Trainer.compile

    def compile_and_fail(self, state):
        program, calls = compiled(self, state), []

        def call(state):
            calls.append(state)
            if len(calls) == 3:
                raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9 bytes")
            return program(state)

        call.out_tree = program.out_tree
        return call

    monkeypatch.setattr(runs.clock, "SAVE_INTERVAL", -1.0)  # a checkpoint after every call
    monkeypatch.setattr(Trainer, "compile", compile_and_fail)
    with pytest.raises(UserError) as told:
        runs.train(runs.Run.open(folder), resume=True)
    assert "start a run with a smaller env.count (now 8) or prior.bank (now 16)" in str(told.value)
    assert "the checkpoint of iteration 4 is whole: --resume continues with more memory" in str(told.value)
    with pytest.raises(SystemExit) as exit_:
        cli.main(["train", "--run", str(folder), "--resume", "--set", "env.count=8"])
    assert exit_.value.code == 2
    assert capsys.readouterr().err.startswith("fmpjax: out of memory on ")
    monkeypatch.undo()
    assert runs.train(runs.Run.open(folder), resume=True) is runs.End.BUDGET
    again = leaves(folder)
    for name, leaf in leaves(trained).items():
        np.testing.assert_array_equal(again[name], leaf, err_msg=name)


@pytest.mark.parametrize(
    ("falls", "speed", "demonstration", "expected"),
    [
        (0, 0.6, 0.8, 0.75),
        (0, 1.0, 0.8, 0.75),  # too fast by as much
        (5, 0.8, 0.8, 0.5),
        (0, 2.0, 0.8, 0.0),
        (0, -0.5, 0.8, 0.0),
        (0, np.nan, 0.8, 0.0),
        (0, 0.0, 0.0, 1.0),  # a demonstration that stands
    ],
)
def test_quality(falls, speed, demonstration, expected):
    names = [f.name for f in dataclasses.fields(Evaluation) if f.name not in ("pace", "obedience", "starts", "motions")]
    nothing = dict.fromkeys(names, 0.0)
    known = {"episodes": 10, "falls": falls, "late_speed": speed, "demonstration_speed": demonstration}
    assert Evaluation(**nothing | known).quality == pytest.approx(expected)
    # Turns to the left and to the right, whose mean is none: the speed along the own heading counts.
    turning = known | {"late_speed": 0.1, "path_speed": speed, "demonstration_turning": 0.4}
    assert Evaluation(**nothing | turning).quality == pytest.approx(expected)
    # In heading axes a policy has no direction to keep.
    drifting = known | {"late_speed": 0.1, "pace": speed}
    assert Evaluation(**nothing | drifting).quality == pytest.approx(expected)


@pytest.mark.slow
def test_a_video_is_as_long_as_it_is_asked_to_be(trainer, fallen, tmp_path, monkeypatch):
    shown = []
    render = runs.outputs.render
    monkeypatch.setattr(render, "grid", lambda robot, motions, labels, **_: shown.extend(map(len, motions)))
    monkeypatch.setattr(render, "write_video", lambda path, frames, fps: path)
    runs.video(runs.Run(tmp_path), trainer, fallen._replace(length=np.full(6, 40)), seconds=0.4)
    assert shown == [10, 10]  # 20 steps of 0.02 s, every second one


def test_places_of_this_machine_are_cut_to_their_names():
    text = json.dumps({"a": 0.975, "run": "/home/ada/läufe/mine", "of": "/home/ada/läufe/mine/best", "here": "./x"})
    cut = json.loads(runs.without_places(text, [".", Path("/home/ada/läufe/mine")]))
    assert cut == {"a": 0.975, "run": "mine", "of": "mine/best", "here": "./x"}
