"""Train a policy, film it, export it, and call the exported policy, which is a function of NumPy arrays.

With the preset ``smoke`` this takes a minute, and the film shows a robot that falls, because nothing is learned. With
``laptop`` it takes a quarter of an hour on two cores, and the robot walks.

    python examples/train_film_export.py laptop
"""

import sys
from pathlib import Path

import numpy as np

import fmpjax
from fmpjax import features, runs


def main(preset: str, folder: Path, **settings) -> np.ndarray:
    """Run the example in ``folder``.

    Returns:
      The exported policy's joint targets at the first pose of the demonstration, rad ``[29]``.
    """
    run = fmpjax.train(preset=preset, motion="walk", folder=folder / "run", **settings)
    for path in sorted(run.folder.glob("*.[pjm]*")):
        print(f"  {path.name}")  # curves.png, evaluation.json, frames.png, policy.mp4, ...

    runs.export(run, folder / "export")
    policy = fmpjax.load_policy(folder / "export" / "policy.npz")  # NumPy is enough from here on
    print(policy)
    robot, clip = fmpjax.load_robot(run.config.robot), fmpjax.load_motion("walk")
    observation = features.observation(robot, clip.qpos[0], clip.qvel[0], policy.observation)
    targets = policy(np.asarray(observation))
    print(f"the first joint's servo holds {targets[0]:.3f} rad, where it is at {clip.qpos[0, 7]:.3f} rad")
    return targets


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "smoke", Path("runs/example"))
