"""How fast is each physics backend, on the same model, states and targets?

``native`` is MuJoCo C called from the scan, ``mjx-jax`` and ``mjx-warp`` run on the device; Warp, which needs
fmpjax[warp], is made for NVIDIA and runs on a CPU in one thread. Rates are physics steps per second, medians over
rounds in turn. The last column is how far the joints are from those of the first backend: contacts magnify rounding,
and a wrong model shows at once.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import config, motion, physics, robots
from fmpjax.env import Env
from fmpjax.errors import UserError

BACKENDS = {
    "native": {"physics.backend": "native"},
    "mjx-jax": {"physics.backend": "mjx", "physics.impl": "jax"},
    "mjx-warp": {"physics.backend": "mjx", "physics.impl": "warp"},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--preset", default="laptop", help="whose physics, laptop by default")
    parser.add_argument("--batches", type=int, nargs="+", default=[128])
    parser.add_argument("--steps", type=int, default=8, help="control steps of one measurement")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--backends", nargs="+", choices=BACKENDS, default=list(BACKENDS))
    arguments = parser.parse_args()
    print(f"{'batch':>7}  {'backend':<10}{'compile':>10}{'steps/s':>12}{'to the first':>14}{'joints off':>12}")
    for batch in arguments.batches:
        calls, compiled = {}, {}
        for name in arguments.backends:
            settings = config.preset(arguments.preset, **BACKENDS[name])
            robot = robots.load(settings.robot)
            try:
                backend = physics.make(robot, settings.physics)
            except UserError as error:
                print(f"{batch:>7}  {name:<10} left out: {error}")
                continue
            clip = motion.load(settings.motion, rate=settings.control_rate, robot=settings.robot)
            env = Env(robot, clip, settings, backend)
            start = env.start_at(env.reset_rows(jax.random.PRNGKey(0), batch)).physics
            targets = jnp.broadcast_to(env.actions(jnp.zeros(robot.joint_count)), (batch, robot.joint_count))

            def play(sim, targets, backend=backend):
                step = lambda s, _: (backend.step(s, targets), None)  # noqa: E731
                return jax.lax.scan(step, sim, None, length=arguments.steps)[0]

            began = time.perf_counter()
            program = jax.jit(play).lower(start, targets).compile()
            compiled[name] = time.perf_counter() - began
            calls[name] = lambda program=program, start=start, targets=targets: program(start, targets)
        reached = {name: np.asarray(call().qpos[:, 7:]) for name, call in calls.items()}
        taken = {name: [] for name in calls}
        for _ in range(arguments.rounds):
            for name, call in calls.items():
                began = time.perf_counter()
                jax.block_until_ready(call())
                taken[name].append(time.perf_counter() - began)
        first = next(iter(calls))
        for name in calls:
            rate = batch * arguments.steps * settings.physics.substeps / np.median(taken[name])
            ratio = np.median(np.array(taken[first]) / taken[name])
            off = np.degrees(np.median(np.abs(reached[name] - reached[first])))
            print(
                f"{batch:>7}  {name:<10}{compiled[name]:>8.0f} s{rate:>12,.0f}{ratio:>14.2f}{off:>11.3f}°", flush=True
            )


if __name__ == "__main__":
    main()
