"""The estimate of a run's memory stays below what compiled programs take, and not far below."""

import dataclasses

import jax
import pytest

from fmpjax import cli, env, machine, memory, motion, runs
from fmpjax.config import preset
from fmpjax.errors import UserError
from fmpjax.trainer import Trainer
from tests.helpers import tiny

# Temporary and argument bytes by `compiled.memory_analysis()`, in MB, on a CPU: JAX 0.10.2, the bundled walk.
MEASURED = {
    ("smoke",): 17.4,
    ("smoke", "env.count=1024"): 381.6,
    ("smoke", "method=amp"): 16.3,
    ("smoke", "method=amp", "amp.minibatch=8192"): 281.9,
    ("laptop",): 64.8,
    ("laptop", "env.count=1024"): 459.1,
    ("laptop", "env.count=4096"): 1810.6,
    ("laptop", "prior.bank=1024"): 74.0,
    ("laptop", "prior.bank=1024", "prior.minibatch=1024", "prior.query_is_bank=true"): 162.3,
    ("laptop", "prior.minibatch=2048"): 168.8,
    ("paper",): 831.3,
    ("smoke", "method=barycentric", "env.count=512", "prior.bank=1024"): 187.8,
    ("smoke", "method=bank16", "env.count=512", "prior.bank=1024"): 318.6,
    ("smoke", "method=amp", "env.count=512"): 408.9,
    ("smoke", "method=gail", "env.count=512"): 333.2,
    ("smoke", "method=pwil", "env.count=512"): 184.1,
    ("smoke", "method=smp", "env.count=512"): 731.8,
    ("smoke", "method=smp", "smp.batch=8192"): 1295.9,
    ("laptop", "method=smp"): 198.3,
    ("smoke", "method=add", "env.count=512"): 74.1,
    ("smoke", "method=tracking", "env.count=512"): 64.0,
}


COUNTS = (20_000, 65_536)  # windows of a demonstration, fewer and more than those of a rollout of `paper` hold
# With PWIL what it takes grows with the demonstration's windows, whose number stands first; the walk in finer parts.
MEASURED_WINDOWS = {
    (23_617, "smoke", "method=pwil", "env.count=512"): 231.8,
    (34_133, "smoke", "method=pwil", "env.count=128"): 79.9,
}


@pytest.mark.parametrize("case", MEASURED_WINDOWS, ids=str)
def test_estimate_with_windows_is_below_what_was_measured(case):
    windows, name, *settings = case
    estimate = sum(memory.parts(preset(name, **dict(item.split("=") for item in settings)), 1, windows).values())
    assert 1.1 < 1e6 * MEASURED_WINDOWS[case] / estimate < 2.75


@pytest.mark.parametrize("case", MEASURED, ids=" ".join)
def test_estimate_is_below_what_was_measured(case):
    name, *settings = case
    estimate = sum(memory.parts(preset(name, **dict(item.split("=") for item in settings))).values())
    assert 1.15 < 1e6 * MEASURED[case] / estimate < 2.75


def test_the_windows_of_the_demonstration_are_counted_for_pwil():
    """What each window holds for each environment, 4 bytes: once, and twice where the rollout's own are fewer."""
    config = preset("paper", method="pwil")
    few, many = (memory.parts(config, 2, count)["env.count"] - memory.parts(config, 2)["env.count"] for count in COUNTS)
    assert few == 2 * 4 * 1024 * COUNTS[0]
    assert many == 2 * (2 * 4 * 1024 * COUNTS[1] - memory.parts(config)["env.count"] // 2)
    assert memory.parts(preset("paper"), 1, 65_536) == memory.parts(preset("paper"))


@pytest.mark.parametrize(("parts", "early"), [(1, False), (8, True), (8, False)])
def test_windows_are_counted_before_there_are_any(robot, walk, monkeypatch, parts, early):
    """Of two clips of different lengths; also where they are too many, and a part stands for all."""
    turn = motion.load("turn_left")
    library = motion.MotionLibrary(
        (walk, dataclasses.replace(turn, qpos=turn.qpos[:99], qvel=turn.qvel[:99])), (0.5, 0.5)
    )
    config = preset("smoke", **{"env.demonstration_parts": parts, "env.early_frames": early})
    for most in (1 << 16, 150):
        monkeypatch.setattr(env, "MOST_WINDOWS", most)
        made = env.Env(robot, library, config, None)
        assert env.window_count(library, config) == len(made.window_share())


def test_a_long_motion_that_pwil_cannot_hold_is_refused(monkeypatch):
    """The walk itself fits, its windows for so many environments do not."""
    config = preset("smoke", method="pwil", **{"env.count": 512})
    monkeypatch.setattr(machine, "memory", lambda: sum(memory.parts(config).values()) + 1000)
    memory.check(config)
    with pytest.raises(UserError, match=r"expected a smaller env.count \(now 512\)"):
        runs.check_trainable(config)


@pytest.mark.slow
def test_estimate_is_below_what_a_program_takes():
    config = tiny(**{"env.count": 512, "chunk": 1})
    trainer = Trainer(config, motion.load("walk"))
    program = jax.jit(trainer.iteration).lower(jax.eval_shape(trainer.init)).compile()
    taken = program.memory_analysis()
    estimate = sum(memory.parts(config).values())
    assert estimate < taken.temp_size_in_bytes + taken.argument_size_in_bytes < 3 * estimate


def test_estimate_grows_with_what_costs():
    base = memory.parts(preset("laptop"))
    assert memory.parts(preset("laptop"), 3) == {setting: 3 * size for setting, size in base.items()}
    assert memory.parts(preset("laptop", **{"env.count": 256}))["env.count"] == 2 * base["env.count"]
    assert memory.parts(preset("laptop", **{"prior.bank": 512}))["prior.bank"] == 4 * base["prior.bank"]
    assert memory.parts(preset("laptop", robot="strider"))["env.count"] < base["env.count"]
    assert memory.parts(preset("laptop", method="amp", **{"amp.replay": 10**9}))["amp.replay"] > 10**12


@pytest.mark.parametrize(
    ("setting", "value"),
    [("env.count", 10_000_000), ("prior.bank", 10_000_000), ("prior.minibatch", 10**9), ("amp.replay", 10**10)],
)
def test_what_cannot_fit_is_refused_before_it_starts(tmp_path, capsys, setting, value):
    run, method = tmp_path / "run", "amp" if setting.startswith("amp") else "fmp"
    with pytest.raises(SystemExit) as exit_:
        cli.main(["train", "--preset", "smoke", "--method", method, "--run", str(run), "--set", f"{setting}={value}"])
    assert exit_.value.code == 2 and not run.exists()
    error = capsys.readouterr().err
    assert error.startswith("fmpjax: the run needs at least ") and error.count("\n") == 1
    assert f"GiB of memory and this machine has {machine.memory() / 2**30:,.1f} GiB" in error
    assert error.endswith(f"expected a smaller {setting} (now {value})\n")


def test_a_smaller_machine_refuses_a_resume_and_seeds(tmp_path, monkeypatch):
    config = preset("smoke")
    needed = sum(memory.parts(config).values())
    made = [runs.Run.create(tmp_path / str(seed), dataclasses.replace(config, seed=seed)) for seed in (0, 1)]
    monkeypatch.setattr(machine, "memory", lambda: needed)
    memory.check(config)
    with pytest.raises(UserError, match=r"smaller env.count \(now 16\), or --seeds \(now 2\)"):
        runs.train(*made, resume=True)
    monkeypatch.setattr(machine, "memory", lambda: None)
    memory.check(config, 1000)
    monkeypatch.setattr(machine, "memory", lambda: 1)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")  # whose allocator refuses
    memory.check(config)
