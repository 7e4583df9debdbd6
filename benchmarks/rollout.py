"""Does the rollout inside the scanned loop keep MuJoCo's own speed?

The same model, starts, targets, batch and threads, four ways, interleaved:

- ``mujoco``: `mujoco.rollout` alone, one call for the whole time;
- ``callback``: the native backend's step in `jax.lax.scan`, a call per control step;
- ``observed``: the same with forward kinematics, observation, frame and fall test;
- ``env``: `Env.rollout` under a constant policy: resets, histories and records too.

Rates are physics steps per second, medians over rounds. Ratios are medians of each round's ratio to ``mujoco``. The
target for ``env`` is 0.90.
"""

import argparse
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np

from fmpjax import config, features, motion, robots
from fmpjax.acting import ActionRule
from fmpjax.env import Env, EnvState
from fmpjax.physics.native import NativePhysics

TARGET = 0.90


def seconds(call: Callable[[], object]) -> float:
    """Time of a call, until its arrays are there."""
    began = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - began


def ways(env: Env, backend: NativePhysics, start: EnvState, steps: int) -> dict[str, Callable[[], object]]:
    """The four ways to play ``steps`` control steps from ``start``, compiled where they compile."""
    count = len(start.age)
    targets = jnp.broadcast_to(env.actions(jnp.zeros(env.robot.joint_count)), (count, env.robot.joint_count))
    qpos, qvel = np.asarray(start.physics.qpos, np.float64), np.asarray(start.physics.qvel, np.float64)
    initial = np.concatenate([np.zeros((count, 1)), qpos, qvel], axis=1)
    control = np.ascontiguousarray(
        np.broadcast_to(np.asarray(targets, np.float64)[:, None], (count, steps * backend.substeps, targets.shape[-1]))
    )
    pool = mujoco.rollout.Rollout(nthread=backend.threads)
    data = [mujoco.MjData(backend.model) for _ in range(backend.threads)]

    def alone():
        return pool.rollout(backend.model, data, initial, control)[0]

    def callback(sim, targets):
        return jax.lax.scan(lambda s, _: (backend.step(s, targets), None), sim, None, length=steps)[0]

    def observed(sim, targets):
        def step(s, _):
            s = backend.step(s, targets)
            return s, features.observe(env.robot, s.qpos, s.qvel, env.form)

        return jax.lax.scan(step, sim, None, length=steps)

    def constant(observation, key):
        return jnp.zeros((count, env.robot.joint_count)), {}

    def whole(state, key):
        return env.rollout(state, ActionRule(constant), key, steps)

    compiled = {name: jax.jit(way) for name, way in (("callback", callback), ("observed", observed), ("env", whole))}
    return {
        "mujoco": alone,
        "callback": lambda: compiled["callback"](start.physics, targets),
        "observed": lambda: compiled["observed"](start.physics, targets),
        "env": lambda: compiled["env"](start, jax.random.PRNGKey(0)),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--preset", default="laptop", help="whose physics and observation, laptop by default")
    parser.add_argument("--batches", type=int, nargs="+", default=[64, 128, 256, 512, 1024])
    parser.add_argument("--steps", type=int, default=16, help="control steps of one measurement")
    parser.add_argument("--rounds", type=int, default=7, help="measurements of each way and batch")
    arguments = parser.parse_args()

    settings = config.preset(arguments.preset, **{"physics.backend": "native", "env.first_cap": 500})
    robot = robots.load(settings.robot)
    clip = motion.load(settings.motion, rate=settings.control_rate, robot=settings.robot)
    backend = NativePhysics(robot, settings.physics)
    env = Env(robot, clip, settings, backend)
    print(
        f"{arguments.preset}: {1 / settings.physics.timestep:.0f} Hz physics, {backend.substeps} substeps, "
        f"{backend.threads} threads, {arguments.steps} control steps from demonstration states"
    )
    names = ("mujoco", "callback", "observed", "env")
    print(f"{'batch':>6}" + "".join(f"{n:>10}" for n in names) + "   steps/s" + "".join(f"{n:>10}" for n in names[1:]))
    for batch in arguments.batches:
        start = env.start_at(env.reset_rows(jax.random.PRNGKey(0), batch))
        calls = ways(env, backend, start, arguments.steps)
        for call in calls.values():
            seconds(call)
        taken = np.array([[seconds(calls[n]) for n in names] for _ in range(arguments.rounds)])
        rates = np.median(batch * arguments.steps * backend.substeps / taken, axis=0)
        ratios = np.median(taken[:, :1] / taken[:, 1:], axis=0)
        verdict = "" if ratios[-1] >= TARGET else f"  env below {TARGET:.2f}"
        print(
            f"{batch:>6}"
            + "".join(f"{r:>10,.0f}" for r in rates)
            + " " * 10
            + "".join(f"{r:>10.2f}" for r in ratios)
            + verdict,
            flush=True,
        )


if __name__ == "__main__":
    main()
