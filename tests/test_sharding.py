"""Several devices and several processes: the numbers of one, to rounding. The devices are four fake ones of the CPU."""

import csv
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import cli, motion, priors, runs, sharding
from fmpjax.errors import UserError
from fmpjax.trainer import Trainer, stack, unstack
from tests.helpers import TINY, settings, tiny

DEVICES = 4


def trainer(**changes):
    return Trainer(tiny(chunk=1, **changes), motion.load("walk"))


def names(tree):
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]}


def assert_close(one, other, tolerance=2e-3):
    """The absolute tolerance is above Adam's steps on parameters whose gradients are nothing but rounding."""
    for name, leaf in names(one).items():
        a, b = np.asarray(leaf, np.float64), np.asarray(names(other)[name], np.float64)
        np.testing.assert_allclose(b, a, rtol=tolerance, atol=tolerance, err_msg=name)


def test_hints_do_nothing_without_a_mesh():
    x = jnp.arange(6.0)
    assert sharding.split(x) is x
    assert sharding.gather(x) is x
    assert sharding.per_device(lambda y: y + len(y))(x)[0] == 6.0


def test_a_function_sees_its_device_s_rows_alone():
    x = jax.device_put(jnp.arange(8.0), sharding.rows(sharding.mesh(DEVICES)))
    with jax.set_mesh(sharding.mesh(DEVICES)):
        y = jax.jit(sharding.per_device(lambda rows: rows - rows[0]))(x)
    np.testing.assert_array_equal(y, [0, 1] * 4)


def test_environments_split_over_devices_are_those_of_one():
    """One iteration: rollout, fit with queries of their own, scores, PPO. Contacts make rounding larger, not much."""
    t = trainer(**{"prior.query_is_bank": False, "prior.query_share": 0.75})
    one, metrics = t.compile(t.init())(t.init())
    split = t.place(t.init(), sharding.mesh(DEVICES))
    assert split.env.physics.qpos.addressable_shards[0].data.shape[0] == 8 // DEVICES
    other, split_metrics = t.compile(split)(split)
    assert other.env.physics.qpos.addressable_shards[0].data.shape[0] == 8 // DEVICES
    assert_close(metrics, split_metrics)
    assert_close(one, other)


@pytest.mark.slow
def test_seeds_split_over_devices_are_those_of_one():
    t = trainer()
    program = t.compile(t.init(2))
    group = t.place(stack([t.init(seed) for seed in range(DEVICES)]), sharding.mesh(DEVICES))
    after, metrics = t.compile(group)(group)
    assert metrics["train/speed"].shape == (DEVICES,)
    assert_close(program(t.init(2))[0], unstack(after)[2])


@pytest.mark.parametrize("method", ["fmp", "amp", "wail", "pwil", "smp", "bank16", "barycentric"])
def test_a_prior_splits_its_windows(method):
    changes = {"amp.minibatch": 16, "amp.replay": 64, "amp.replay_new": 8, "wail.minibatch": 16, "smp.batch": 8}
    config = tiny(**changes)
    key = jax.random.PRNGKey(0)
    expert = priors.Expert(jax.random.normal(key, (40, 20)), 20.0, jnp.full(20, 20**-0.5), 10)
    prior = priors.make(method, expert, config)
    rollout = priors.Rollout(jax.random.normal(jax.random.PRNGKey(1), (4, 8, 20)) + 0.5, jnp.ones((4, 8), bool))
    rollout = rollout._replace(start=jnp.arange(32).reshape(4, 8) % 5 == 0)
    one = jax.jit(prior.update)(prior.init(key), rollout, key)
    over = sharding.mesh(DEVICES)
    split = jax.device_put(rollout, jax.NamedSharding(over, jax.P(None, sharding.AXIS)))
    with jax.set_mesh(over):
        other = jax.jit(prior.update)(jax.device_put(prior.init(key), sharding.everywhere(over)), split, key)
    assert_close(one, other, 1e-3)


def test_bad_devices(tmp_path, capsys):
    with pytest.raises(UserError, match="--devices is 9: expected 1 to 4, the devices that JAX sees"):
        sharding.mesh(9)
    t = trainer()
    with pytest.raises(UserError, match="setting env.count is 8: expected a multiple of 3, the devices that share"):
        t.place(t.init(), sharding.mesh(3))
    with pytest.raises(UserError, match="the number of seeds is 2: expected a multiple of 4"):
        t.place(stack([t.init(0), t.init(1)]), sharding.mesh(4))
    run = ["--preset", "smoke", "--run", str(tmp_path / "run")]
    for arguments, message in (
        ([*run, "--devices", "9"], "--devices is 9: expected 1 to 4, the devices that JAX sees"),
        ([*run, "--devices", "4", "--set", "env.count=6"], "setting env.count is 6: expected a multiple of 4"),
        ([*run, "--devices", "4", "--seeds", "2"], "the number of seeds is 2: expected a multiple of 4"),
        (["--devices", "-1"], "--devices is -1: expected 0 (for all) or more"),
        (["--processes", "2"], "--coordinator, --processes and --process go with --distributed"),
        (["--distributed"], "--distributed needs the run's folder"),
    ):
        with pytest.raises(SystemExit) as exit_info:
            cli.main(["train", *arguments])
        assert exit_info.value.code == 2
        assert message in capsys.readouterr().err
    # Nothing that the corrected command would find in its way.
    assert not (tmp_path / "run").exists()


def free_address():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return f"localhost:{free.getsockname()[1]}"


@pytest.mark.slow
@pytest.mark.alone
def test_every_process_has_the_physics_on_a_device_of_its_own():
    program = """
import sys
from fmpjax import sharding
sharding.connect(sys.argv[1], 2, int(sys.argv[2]))
import jax, jax.numpy as jnp
from fmpjax import physics, robots
from fmpjax.config import preset
robot = robots.load("unitree_g1")
backend = physics.make(robot, preset("smoke", **{"physics.backend": "mjx"}).physics)
qpos = jnp.asarray(robot.default_qpos)[None]
jax.jit(backend.step).lower(physics.reset(qpos, jnp.zeros((1, 35))), qpos[:, 7:])
(device,) = jax.tree.leaves(backend._model)[0].devices()
print("process", jax.process_index(), "of", jax.process_count(), "has", device.process_index)
"""
    address = free_address()
    pair = [
        subprocess.Popen(
            [sys.executable, "-c", program, address, str(i)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        for i in range(2)
    ]
    said = [process.communicate(timeout=200) for process in pair]
    assert [process.returncode for process in pair] == [0, 0], said
    for i in range(2):
        assert f"process {i} of 2 has {i}" in said[i][0]


@pytest.mark.slow
@pytest.mark.alone
def test_two_processes_are_one(tmp_path):
    """The same run by two processes with two devices each and by one with one: metrics, and a checkpoint to go on."""
    address = free_address()
    short = {"transitions": 8 * 8 * 4, "evaluations": (1.0,)}
    planned, common = tiny(**short), ["train", "--preset", "smoke", *settings(TINY | short)]
    joined = ["--run", tmp_path / "two", "--distributed", "--coordinator", address, "--processes", 2]
    flags = "import os; os.environ['XLA_FLAGS'] += ' --xla_force_host_platform_device_count=2'; "
    main = "import sys; from fmpjax.cli import main; main(sys.argv[1:])"

    def start(*arguments):
        command = [sys.executable, "-c", flags + main, *map(str, [*common, *arguments])]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    pair = [start(*joined, "--process", i) for i in range(2)]
    said = [process.communicate(timeout=300)[0] for process in pair]
    assert [process.returncode for process in pair] == [0, 0], said
    assert runs.train(runs.Run.create(tmp_path / "one", planned)) is runs.End.BUDGET
    assert "best policy" in said[0]
    assert "best policy" not in said[1]

    def rows(folder):
        with (folder / "metrics.csv").open(newline="") as file:
            return list(csv.DictReader(file))

    one, two = rows(tmp_path / "one"), rows(tmp_path / "two")
    assert [r["iteration"] for r in two] == [r["iteration"] for r in one] == ["2", "4"]
    for name in ("train/speed", "train/reward", "fit/epsilon", "fit/flow_loss", "ppo/critic_loss"):
        assert float(two[0][name]) == pytest.approx(float(one[0][name]), rel=2e-2, abs=2e-3), name
    assert (tmp_path / "two" / "evaluation.json").exists()
