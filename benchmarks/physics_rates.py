"""Does physics at 100 Hz hold up beside 200 Hz?

The bundled walk's joints are the servos' targets, open loop, from demonstration states. Each setting is compared with
the paper's options at 800 Hz: what 200 Hz itself loses against that is the scale on which to read 100 Hz. Differences
are root mean squares over starts at the stated time. Sink (depth of a foot's lowest sole point) and slip (its planar
speed, rolling included) are means over contacts up to that time; a foot touches while its lowest point is under 2 mm.
"""

import argparse
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import config, kinematics, motion, robots
from fmpjax.config import PhysicsConfig
from fmpjax.motion import MotionClip
from fmpjax.physics import reset
from fmpjax.physics.native import NativePhysics
from fmpjax.robots import Robot

CONTACT = 0.002  # m, a sole lower than this touches


def settings() -> dict[str, PhysicsConfig]:
    """The reference first, then what is compared with it."""
    paper, laptop = config.preset("paper").physics, config.preset("laptop").physics

    def at(base: PhysicsConfig, rate: int) -> PhysicsConfig:
        return dataclasses.replace(base, timestep=1.0 / rate, substeps=rate // 50)

    return {
        "paper, 800 Hz": at(paper, 800),
        "paper, 200 Hz": at(paper, 200),
        "paper, 100 Hz": at(paper, 100),
        "laptop, 200 Hz": at(laptop, 200),
        "laptop, 100 Hz": at(laptop, 100),
    }


def play(robot: Robot, clip: MotionClip, physics: PhysicsConfig, starts: np.ndarray, steps: int) -> np.ndarray:
    """States ``qpos [T, N, 7 + J]`` after each control step from the clip's rows ``starts [N]``."""
    backend = NativePhysics(robot, physics)
    targets = jnp.asarray(clip.qpos[starts[None] + 1 + np.arange(steps)[:, None], 7:], jnp.float32)
    start = reset(jnp.asarray(clip.qpos[starts], jnp.float32), jnp.asarray(clip.qvel[starts], jnp.float32))

    def step(state, target):
        state = backend.step(state, target)
        return state, state.qpos

    return np.asarray(jax.jit(lambda s, t: jax.lax.scan(step, s, t)[1])(start, targets))


def contacts(robot: Robot, qpos: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth (m) and planar speed (m/s) of each foot's lowest sole point, ``[T - 1, N, F]``; NaN off the floor."""
    poses = jax.jit(lambda q: kinematics.body_poses(robot, q))(jnp.asarray(qpos))
    height = np.asarray(kinematics.sole_heights(robot, poses))
    soles = np.asarray(kinematics.points(poses, robot.sole_body, robot.sole_point))[..., :2]
    feet = np.unique(robot.sole_body)
    low = np.stack([height[..., robot.sole_body == foot].min(-1) for foot in feet], axis=-1)
    # The lowest point of a foot is where it stands.
    where = [np.argmin(height[1:, :, robot.sole_body == foot], axis=-1) for foot in feet]
    moved = np.linalg.norm(np.diff(soles, axis=0), axis=-1)
    speed = [
        np.take_along_axis(moved[..., robot.sole_body == foot], at[..., None], axis=-1)[..., 0]
        for foot, at in zip(feet, where, strict=True)
    ]
    touching = (low[1:] < CONTACT) & (low[:-1] < CONTACT)
    depth = np.where(touching, np.maximum(0.0, -low[1:]), np.nan)
    return depth, np.where(touching, np.stack(speed, axis=-1) * rate, np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--starts", type=int, default=64)
    parser.add_argument("--times", type=float, nargs="+", default=[0.2, 0.5], help="s")
    arguments = parser.parse_args()
    robot, clip = robots.load("unitree_g1"), motion.load("walk")
    steps = [round(t * clip.rate) for t in arguments.times]
    starts = np.linspace(0, len(clip) - 2 - max(steps), arguments.starts).astype(int)
    played = {name: play(robot, clip, physics, starts, max(steps)) for name, physics in settings().items()}
    reference, *_ = played.values()
    print(f"{arguments.starts} starts; joints and root against the first row")
    columns = {"s": 5, "joints deg": 12, "root z mm": 11, "root xy mm": 12, "sink mm": 9, "worst": 7, "slip m/s": 10}
    print(f"{'physics':<16}" + "".join(f"{name:>{width}}" for name, width in columns.items()))
    for count in steps:
        for name, qpos in played.items():
            off = qpos[count - 1].astype(np.float64) - reference[count - 1]
            depth, slip = contacts(robot, qpos[:count], clip.rate)
            print(
                f"{name:<16}{count / clip.rate:>5.1f}{np.degrees(np.sqrt(np.mean(off[:, 7:] ** 2))):>12.2f}"
                f"{1e3 * np.sqrt(np.mean(off[:, 2] ** 2)):>11.1f}{1e3 * np.sqrt(np.mean(off[:, :2] ** 2)):>12.1f}"
                f"{1e3 * np.nanmean(depth):>9.2f}{1e3 * np.nanmax(depth):>7.1f}{np.nanmean(slip):>10.3f}"
            )


if __name__ == "__main__":
    main()
