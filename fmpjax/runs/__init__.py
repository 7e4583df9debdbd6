"""A run on disk: its folder, its training from start or checkpoint to a clean end, and what it leaves to look at."""

from fmpjax.files import without_places, write
from fmpjax.provenance import machine, provenance
from fmpjax.runs import pretraining
from fmpjax.runs.clock import End
from fmpjax.runs.films import course_video, pushed_video, video
from fmpjax.runs.folder import Run, check_trainable, default_folder, default_preset, describe, load_motion
from fmpjax.runs.outputs import export, finish, web
from fmpjax.runs.served import Live
from fmpjax.runs.training import train

__all__ = [
    "End",
    "Live",
    "Run",
    "check_trainable",
    "course_video",
    "default_folder",
    "default_preset",
    "describe",
    "export",
    "finish",
    "load_motion",
    "machine",
    "pretraining",
    "provenance",
    "pushed_video",
    "train",
    "video",
    "web",
    "without_places",
    "write",
]
