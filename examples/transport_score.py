"""The transport score on a toy, and on windows of motion.

In the toy, the policy's samples are around 0 and the demonstration's are around -1 and 1. On either side,
the gradient of the score points to the nearer of the two. The middle, which is the mean of the demonstration, has the
lowest score: the score does not reward averages.

Then the same function scores windows of a robot's motion, ten frames each. The policy's windows are those of the slow
walk, the demonstration's those of the walk. The output shows which motions score above the slow walk, and that playing
the demonstration backward lowers the score.
"""

import jax.numpy as jnp
import numpy as np

import fmpjax
from fmpjax import features, transport

HORIZON = 10  # frames in a window


def toy() -> transport.ScoreFunction:
    """Print the score on a line; the fitted score is returned."""
    rng = np.random.default_rng(0)
    policy = rng.normal(0.0, 0.1, (256, 1))
    demonstration = rng.choice([-1.0, 1.0], (256, 1)) + rng.normal(0.0, 0.1, (256, 1))
    score = fmpjax.fit_score(policy, demonstration)
    x = jnp.array([[-1.0], [-0.5], [0.0], [0.5], [1.0]])
    print("      x   score  gradient")
    for place, value, slope in zip(x[:, 0], score.score(x) - score.score(x[2:3]), score.gradient(x)[:, 0], strict=True):
        print(f"{place:7.1f} {value:7.2f} {slope:9.2f}")
    return score


def windows() -> dict[str, float]:
    """Print the mean score of several motions; by motion, above the slow walk's."""
    robot = fmpjax.load_robot("unitree_g1")

    def frames(name: str, order: int = 1) -> jnp.ndarray:
        clip = fmpjax.load_motion(name)
        # Played backward, a motion has its positions in reverse and its velocities the other way.
        observed = features.observe(robot, clip.qpos[::order], order * clip.qvel[::order], "compact")
        starts = jnp.arange(len(clip) - HORIZON + 1)[:, None]
        return observed.frame[starts + jnp.arange(HORIZON)]  # [W, H, F]

    walk = frames("walk")
    settings = fmpjax.preset("laptop").features
    feature_map = features.fit_feature_map(robot, walk, settings)
    expert, source = feature_map(walk), feature_map(frames("slow_walk"))
    score = fmpjax.fit_score(source[:256], expert[:256], threshold=1e-3)
    motions = {
        "slow_walk": source,
        "walk": expert,
        "fast_walk": feature_map(frames("fast_walk")),
        "turn_left": feature_map(frames("turn_left")),
        "walk, backward": feature_map(frames("walk", -1)),
    }
    scores = {name: float(score.score(x).mean()) for name, x in motions.items()}
    scores = {name: value - scores["slow_walk"] for name, value in scores.items()}
    for name, value in scores.items():
        print(f"{name:<16} {value:7.3f}")
    return scores


if __name__ == "__main__":
    toy()
    windows()
