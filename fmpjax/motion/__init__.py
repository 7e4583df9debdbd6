"""Demonstrations: reading, resampling, writing, and a synthesised walk (`fmpjax.motion.gait`)."""

from fmpjax.motion.clip import MotionClip, resample, velocities
from fmpjax.motion.formats import bundled, load, save

__all__ = ["MotionClip", "bundled", "load", "resample", "save", "velocities"]
