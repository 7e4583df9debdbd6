"""What is asked of the machine, and that no system is taken for granted."""

import os
import subprocess
import sys

import pytest

from fmpjax import machine

# A system with neither an affinity nor /proc nor /sys, as macOS is, before anything of the package is imported: to open
# what is there on Linux fails as it fails there. Where there is no fcntl, what trains goes without its lock.
_BARE = """
import builtins, io, os, sys
for name in ("process_cpu_count", "sched_getaffinity", "sched_setaffinity"):
    if hasattr(os, name):
        delattr(os, name)
os.cpu_count = lambda: 3
import jax, mujoco.rollout, mujoco.mjx  # theirs to answer for
sys.modules["fcntl"] = None
real = open
def bare(file, *arguments, **options):
    if str(file).startswith(("/proc", "/sys")):
        raise FileNotFoundError(file)
    return real(file, *arguments, **options)
builtins.open = io.open = bare
"""


def run(code, **environment):
    """What a Python process prints, where it does not fail."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_no_call_is_of_one_system_alone(tmp_path):
    printed = run(
        _BARE
        + f"""
from fmpjax import config, machine, physics, robots, runs
from fmpjax.experiments.common import engines
print(machine.cores(), physics.make(robots.load("strider"), config.preset("smoke").physics).threads)
print(runs.provenance()["cores"], runs.machine(), engines.shares(2), bool(machine.processor()))
folder = runs.Run({str(tmp_path)!r})
with runs.training.held([folder]):
    print("held")
"""
    )
    assert printed.splitlines()[-3:] == ["3 3", "3 3 CPU cores [set(), set()] True", "held"]


def test_mjx_says_nothing_of_a_warp_that_is_not_installed():
    assert run("import sys; sys.modules['warp'] = None; import fmpjax.physics.mjx") == ""


def test_cores_are_those_that_the_process_may_use(monkeypatch):
    monkeypatch.setattr(os, "process_cpu_count", lambda: 5, raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {1, 2}, raising=False)
    assert machine.cores() == 5
    monkeypatch.delattr(os, "process_cpu_count")
    assert machine.cores() == 2
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert machine.cores() == 1


def test_memory_is_the_machines_or_its_containers(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "_CGROUPS", (str(tmp_path / "none"),))
    whole = machine.memory()
    assert 2**28 < whole < 2**46
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(machine, "_CGROUPS", (str(limit),))
    for text, expected in (("1000000\n", 1_000_000), ("max\n", whole), (f"{2**63 - 4096}\n", whole)):
        limit.write_text(text)
        assert machine.memory() == expected
    monkeypatch.delattr(os, "sysconf")
    limit.write_text("max")
    assert machine.memory() is None


@pytest.mark.parametrize("asked", ["wrong", "osmesa", "egl", "disable"])
def test_mujoco_is_imported_whatever_its_variable_says(asked):
    """Also where the library that it names is missing; the variable stays what it was, and pictures come out."""
    code = (
        "import os, fmpjax, numpy as np; from fmpjax.viz import render\n"
        "import fmpjax.physics.mjx\n"  # which names what `mujoco` consists of
        "robot = fmpjax.load_robot('strider')\n"
        "frames = render.render_frames(robot, robot.default_qpos[None], width=64, height=48)\n"
        "print(os.environ['MUJOCO_GL'], frames.std() > 5)"
    )
    assert run(code, MUJOCO_GL=asked).split() == [asked, "True"]


def test_a_command_says_that_its_renderer_is_another(tmp_path):
    """OpenGL, whose import for the first platform failed, is imported again for another."""
    command = [sys.executable, "-m", "fmpjax.cli", "motion", "view", "strider_walk", "--robot", "strider"]
    environment = os.environ | {"MUJOCO_GL": "wrong"}
    command += ["--out", str(tmp_path / "walk.png")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("fmpjax: MUJOCO_GL is 'wrong', which draws nothing here: pictures are drawn by ")
    assert done.stderr.count("\n") == 1 and (tmp_path / "walk.png").exists()
