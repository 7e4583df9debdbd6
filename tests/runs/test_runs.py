"""The clock and the recorder of a training, which need no program and no arrays."""

import dataclasses
from types import SimpleNamespace

import pytest

from fmpjax.config import preset
from fmpjax.evaluate import Evaluation, names, table
from fmpjax.logs import MetricsLog
from fmpjax.runs.clock import SAVE_INTERVAL, Clock, Due, End
from fmpjax.runs.recorder import Recorder
from fmpjax.runs.training import progress_line

# Ten iterations of 64 transitions in chunks of two, evaluated after four and ten.
CONFIG = preset(
    "smoke",
    **{"transitions": 640, "chunk": 2, "evaluations": (0.4, 1.0), "env.count": 8, "ppo.rollout_steps": 8},
)
NOT_YET = Due(evaluate=False, save=False, end=None)


class Time:
    """Seconds that pass when a test says so."""

    def __init__(self):
        self.seconds = 1000.0

    def __call__(self):
        return self.seconds


@pytest.fixture
def time():
    return Time()


def ticking(clock, time, took, *, asked=False):
    """What is due after each call of the program, to the end; each call takes so many seconds."""
    dues = []
    while not dues or dues[-1].end is None:
        time.seconds += took
        clock.tick(clock.done + 2, took)
        dues.append(clock.due(asked=asked))
        clock.did(dues[-1])
    return dues


# --- the clock -------------------------------------------------------------------------------------------------------


def test_a_budget_is_spent_with_an_evaluation_at_each_milestone(time):
    clock = Clock(CONFIG, now=time)
    dues = ticking(clock, time, took=1.0)
    assert [due.evaluate for due in dues] == [False, True, False, False, True]
    assert [due.save for due in dues] == [False, True, False, False, True]
    assert [due.end for due in dues] == [None] * 4 + [End.BUDGET]
    assert clock.spent and clock.transitions == 640 and clock.seconds == 5.0


def test_a_resumed_clock_does_not_evaluate_again(time):
    evaluated = Clock(CONFIG, done=4, evaluated=4, seconds=9.0, now=time)
    assert [due.evaluate for due in ticking(evaluated, time, took=1.0)] == [False, False, True]
    assert evaluated.seconds == 12.0
    missed = Clock(CONFIG, done=6, evaluated=0, now=time)
    assert [due.evaluate for due in ticking(missed, time, took=1.0)] == [True, True]


def test_a_checkpoint_is_due_by_the_clock(time):
    clock = Clock(CONFIG, now=time)
    time.seconds += SAVE_INTERVAL
    clock.tick(2, 1.0)
    assert clock.due(asked=False) == NOT_YET
    time.seconds += 0.5
    assert clock.due(asked=False) == Due(evaluate=False, save=True, end=None)
    assert clock.due(asked=False).save, "still due: nothing was saved"
    clock.did(Due(evaluate=False, save=True, end=None))
    assert clock.due(asked=False) == NOT_YET


def test_minutes_leave_time_for_the_last_evaluation_and_save(time):
    """The first call that another one of the same length, half as much again and the spare would take past the end."""
    clock = Clock(CONFIG, minutes=1.0, began=time() - 20.0, spare=10.0, now=time)
    time.seconds += 10.0  # 30 of 60 s are over
    clock.tick(2, 10.0)
    assert clock.due(asked=False) == NOT_YET  # 30 + 15 + 10 s
    time.seconds += 10.0
    clock.tick(3, 10.0)
    assert clock.due(asked=False) == Due(evaluate=True, save=True, end=End.TIME)


def test_the_time_to_spare_is_what_the_last_evaluation_took(time):
    clock = Clock(CONFIG, minutes=1.0, spare=50.0, now=time)
    clock.tick(4, 1.0)
    due = clock.due(asked=False)
    assert due == Due(evaluate=True, save=True, end=None)
    time.seconds += 8.0
    clock.did(due)
    time.seconds += 42.0  # 50 + 1.5 + 8 s is within the minute, with 50 s to spare it were not
    clock.tick(6, 1.0)
    assert clock.due(asked=False).end is None
    time.seconds += 1.0
    assert clock.due(asked=False).end is End.TIME


def test_a_stop_saves_without_an_evaluation_but_at_the_end_of_the_budget(time):
    clock = Clock(CONFIG, done=2, now=time)
    clock.tick(4, 1.0)
    assert clock.due(asked=True) == Due(evaluate=False, save=False, end=End.SIGNAL)
    clock.tick(10, 1.0)
    assert clock.due(asked=True) == Due(evaluate=True, save=True, end=End.BUDGET)


def test_time_that_is_up_and_a_stop_are_a_stop(time):
    clock = Clock(CONFIG, minutes=1e-6, now=time)
    clock.tick(2, 1.0)
    assert clock.due(asked=True) == Due(evaluate=False, save=False, end=End.SIGNAL)


def test_processes_agree_three_times_in_one_order_on_what_the_first_one_says(time):
    said = []

    def first(flag):
        said.append(flag)
        return False

    clock = Clock(CONFIG, minutes=1e-6, agree=first, now=time)
    time.seconds += 2 * SAVE_INTERVAL
    clock.tick(2, 1.0)
    assert clock.due(asked=True) == NOT_YET
    assert said == [True, True, True]  # time, signal, save

    clock = Clock(CONFIG, agree=lambda flag: True, now=time)
    clock.tick(2, 1.0)
    assert clock.due(asked=False) == Due(evaluate=False, save=True, end=End.SIGNAL)


def test_what_is_left_and_how_fast_it_goes(time):
    clock = Clock(CONFIG, minutes=1.0, now=time)
    clock.tick(2, 4.0)
    assert clock.left == 16.0 and clock.rate == 32.0
    time.seconds += 50.0
    assert clock.left == 10.0


def test_the_progress_line_is_of_all_runs(time):
    clock = Clock(CONFIG, now=time)
    clock.tick(4, 2.0)
    row = {
        "train/episode_length": 20.0,
        "env/cap": 60.0,
        "train/falls": 0.25,
        "train/speed": 0.5,
        "train/reward_spread": 1.0,
        "fit/value_loss": 2.0,
    }
    other = row | {"train/episode_length": float("nan"), "train/falls": 0.75}
    assert progress_line(clock, [row, other]) == (
        "  0.26 of 0.64 k | 128/s, 0:06 left | episode 20 of 60 steps, falls 50 % | speed +0.50 m/s | "
        "reward spread 1.00 | value 2.00"
    )


# --- the recorder ----------------------------------------------------------------------------------------------------


class Checkpoints:
    """What was saved, and how many rows the log had by then."""

    def __init__(self, folder):
        self.folder, self.saved = folder, []

    def save(self, state, *, best):
        rows = len(MetricsLog.read(self.folder / "metrics.csv"))
        self.saved.append(("best" if best else "newest", state.name, rows))


STATE = SimpleNamespace(name="state", ppo="policy")
ROW = {"train/reward": 0.5}


def evaluation(falls, obedience=None):
    """Figures of ten episodes at the demonstration's own speed, of which some fell: the quality is 1 - falls / 10."""
    fields = [f.name for f in dataclasses.fields(Evaluation) if f.name not in ("obedience", "starts", "motions")]
    known = {"episodes": 10, "falls": falls, "late_speed": 0.8, "pace": 0.8, "demonstration_speed": 0.8}
    known |= {"joint_ranges": (0.0,) * 6, "expert_ranges": (0.0,) * 6, "obedience": obedience}
    return Evaluation(**dict.fromkeys(fields, 0.0) | known)


@pytest.fixture
def make(tmp_path):
    """A function that makes a recorder in the test's folder, whose policies fall as often as it is told."""

    def recorder(*falls, iteration=0, config=CONFIG, **options):
        results, said = iter(falls), []
        run = SimpleNamespace(folder=tmp_path, checkpoints=Checkpoints(tmp_path))

        def evaluate(policy):
            assert policy == "policy"
            found = next(results)
            return evaluation(*found) if isinstance(found, tuple) else evaluation(found)

        columns = ["train/reward", *(f"eval/{name}" for name in names(config))]
        made = Recorder(run, config, columns, iteration, evaluate=evaluate, note=said.append, **options)
        return made, run.checkpoints.saved, said

    return recorder


@pytest.fixture
def at(time):
    return Clock(CONFIG, done=2, seconds=75.0, now=time)


def test_a_row_is_written_before_its_checkpoint(make, at, tmp_path):
    """After a kill a row ahead of its checkpoint is computed again; one behind it would be missing."""
    recorder, saved, said = make()
    recorder.record(at, ROW)
    assert not saved
    at.tick(4, 1.0)
    recorder.record(at, ROW, STATE)
    recorder.close()
    assert saved == [("newest", "state", 2)] and not said
    first, second = MetricsLog.read(tmp_path / "metrics.csv")
    assert (first["iteration"], first["transitions"], first["seconds"]) == ("2", "128", "75.00")
    assert second["iteration"] == "4" and not second["eval/quality"] and second["train/reward"] == "0.5"


def test_an_evaluation_is_said_and_written_and_the_best_policy_kept(make, at, tmp_path):
    """The later of two equals is kept."""
    recorder, saved, said = make(5, 7, 5, label="seed 3, ")
    for iteration in (4, 6, 8):
        at.tick(iteration, 1.0)
        recorder.record(at, ROW, STATE, evaluate=True)
    assert [(kind, rows) for kind, _, rows in saved] == [
        ("best", 1), ("newest", 1), ("newest", 2), ("best", 3), ("newest", 3),
    ]  # fmt: skip
    assert recorder.best == 0.5
    rows = MetricsLog.read(tmp_path / "metrics.csv")
    assert [row["eval/quality"] for row in rows] == ["0.5", "0.3", "0.5"]
    assert [row["eval/falls"] for row in rows] == ["5", "7", "5"]
    headline, _, diagnosis = said[:3]
    assert headline == "evaluation at 256 transitions, seed 3, 1:16:"
    assert diagnosis.startswith("diagnosis at 256 transitions")


COMMANDED = preset("smoke", **{"command.kind": "velocity", "transitions": 640, "env.count": 8, "ppo.rollout_steps": 8})


def test_the_best_policy_of_a_steered_run_obeys(make, at, tmp_path):
    """Qualities of 1, 0.9 and 1: the second is the best, since it obeys. A resumed run knows; older rows do not say."""
    recorder, saved, said = make((0, 0.2), (1, 0.8), (0, 0.6), config=COMMANDED)
    for iteration in (4, 6, 8):
        at.tick(iteration, 1.0)
        recorder.record(at, ROW, STATE, evaluate=True)
    recorder.close()
    assert [rows for kind, _, rows in saved if kind == "best"] == [1, 2]
    assert recorder.best == pytest.approx(0.72) and "obedience" in said[1]
    rows = MetricsLog.read(tmp_path / "metrics.csv")
    assert [row["eval/obedience"] for row in rows] == ["0.2", "0.8", "0.6"]
    assert [row["eval/score"] for row in rows] == ["0.2", "0.72", "0.6"]
    again, *_ = make(iteration=8, config=COMMANDED)
    assert again.best == pytest.approx(0.72)
    rows = (tmp_path / "metrics.csv").read_text()
    (tmp_path / "metrics.csv").write_text(rows.replace("eval/score", "eval/earlier"))
    older, *_ = make(iteration=8, config=COMMANDED)
    assert older.best == -1.0


def test_without_a_command_the_figures_are_those_they_were():
    assert not {"obedience", "score"} & {*names(CONFIG), *evaluation(3).as_dict(), *evaluation(3).record()}
    for figures in (names(COMMANDED), evaluation(3, 0.5).as_dict(), evaluation(3, 0.5).record()):
        assert {"obedience", "score"} <= {*figures}
    assert evaluation(3).score == evaluation(3).quality and evaluation(3, 0.5).score == pytest.approx(0.35)
    assert "obedience" not in table(evaluation(3))


def test_a_resumed_recorder_knows_what_was_best(make, at):
    recorder, *_ = make(2)
    at.tick(4, 1.0)
    recorder.record(at, ROW, STATE, evaluate=True)
    at.tick(6, 1.0)
    recorder.record(at, ROW, STATE)
    recorder.close()
    again, saved, _ = make(3, iteration=6)
    assert (again.best, again.evaluated, len(again.log.rows)) == (0.8, 4, 2)
    at.tick(8, 1.0)
    again.record(at, ROW, STATE, evaluate=True)
    assert saved == [("newest", "state", 3)]
    earlier, *_ = make(iteration=2)
    assert (earlier.best, earlier.evaluated) == (-1.0, 0)


def test_a_process_that_does_not_write_evaluates_all_the_same(make, at, tmp_path):
    """Each process computes what the first one writes, so that all continue alike."""
    recorder, saved, said = make(5, keep=False)
    recorder.record(at, ROW, STATE, evaluate=True)
    recorder.close()
    assert recorder.best == 0.5 and recorder.evaluated == 2 and said
    assert not saved and not list(tmp_path.iterdir())
