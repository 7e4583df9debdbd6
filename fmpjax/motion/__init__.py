"""Demonstrations: reading, resampling, writing, and a synthesized walk (`fmpjax.motion.gait`)."""

from fmpjax.motion.clip import MotionClip, resample, velocities
from fmpjax.motion.formats import bundled, folders, load, save
from fmpjax.motion.library import MotionLibrary, accept_license, describe, load_library

__all__ = [
    "MotionClip",
    "MotionLibrary",
    "accept_license",
    "bundled",
    "describe",
    "folders",
    "load",
    "load_library",
    "resample",
    "save",
    "velocities",
]
