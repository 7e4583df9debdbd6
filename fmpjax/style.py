"""How far played episodes are from the demonstrations in style, whatever features the run's own prior scores."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from fmpjax import features
from fmpjax.config.sections import FeatureConfig
from fmpjax.trainer import Trainer

INTERVAL = 0.5  # s between two windows of an episode
# Coordinates that the demonstrations hardly move would carry the distance: the floors of the preset `laptop`.
FLOORS = {"deviation_floor": 0.05, "angular_velocity_floor": 0.5}


class StyleDistance:
    """Distance of windows from the nearest window of any demonstration.

    Windows are compared in heading axes by standardized features: 1 is about one standard deviation of the
    demonstrations in every coordinate. It says nothing of obedience: another demonstration may have the wrong speed.
    """

    def __init__(self, trainer: Trainer):
        env = trainer.env
        self._horizon, self._stride = env.horizon, round(INTERVAL * trainer.config.control_rate)
        windows, share = env.clip_windows(), env.window_share()
        config = FeatureConfig(history=env.horizon, axes="heading", **FLOORS)
        self._map = features.fit_feature_map(trainer.robot, windows, config, share)
        self._expert = self._map(windows)

    def __call__(self, frames: jax.Array | np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Mean distance of each episode's windows, NaN where it has none.

        Args:
          frames: ``[T, N, F]`` compact frames after each control step.
          counts: ``[T, N]`` bool, the steps that count; a window counts if all its steps do.
        """
        first = np.arange(0, len(frames) - self._horizon + 1, self._stride)
        steps = first[:, None] + np.arange(self._horizon)
        whole = np.asarray(counts)[steps].all(1)
        distance = np.asarray(self._nearest(jnp.asarray(frames), jnp.asarray(steps)))
        total, count = np.where(whole, distance, 0.0).sum(0), whole.sum(0)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    @partial(jax.jit, static_argnums=0)
    def _nearest(self, frames: jax.Array, steps: jax.Array) -> jax.Array:
        """Distances ``[K, N]`` of the windows of the steps ``[K, H]``."""
        square = (self._expert**2).sum(-1)

        def nearest(window):
            found = self._map(jnp.swapaxes(frames[window], 0, 1))
            product = jnp.matmul(found, self._expert.T, precision="highest")
            return ((found**2).sum(-1, keepdims=True) + square - 2.0 * product).min(-1)

        return jnp.sqrt(jnp.maximum(jax.lax.map(nearest, steps), 0.0))
