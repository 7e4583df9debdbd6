"""Several processes of one run, which wait for each other: `make test` leaves the machine to them."""

import csv
import socket
import subprocess
import sys

import pytest

from fmpjax import runs
from tests.helpers import TINY, settings, tiny


def free_address():
    with socket.socket() as free:
        free.bind(("localhost", 0))
        return f"localhost:{free.getsockname()[1]}"


@pytest.mark.slow
def test_every_process_has_the_physics_on_a_device_of_its_own():
    program = """
import sys
from fmpjax import sharding
sharding.connect(sys.argv[1], 2, int(sys.argv[2]))
import jax, jax.numpy as jnp
from fmpjax import physics, robots
from fmpjax.config import preset
robot = robots.load("strider")
backend = physics.make(robot, preset("smoke", **{"physics.backend": "mjx"}).physics)
qpos = jnp.asarray(robot.default_qpos)[None]
jax.jit(backend.step).lower(physics.reset(qpos, jnp.zeros((1, robot.model.nv))), qpos[:, 7:])
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
def test_two_processes_are_one(tmp_path):
    """The same run by two processes with two devices each and by one with one: metrics, and a checkpoint to go on."""
    address = free_address()
    short = {"transitions": 8 * 8 * 4, "evaluations": (1.0,)}
    planned, common = tiny(**short), ["train", "--preset", "smoke", "--no-pictures", *settings(TINY | short)]
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
