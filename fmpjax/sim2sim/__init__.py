"""An exported policy on a MuJoCo model of its robot, by MuJoCo, ONNX Runtime and NumPy alone, without JAX.

The observation is built from the names in the file's metadata; joints are found by name. The model may be any MJCF with
the policy's joints, with servos or without, with a floor or without. It keeps its own time step, solver, masses and
contacts. Its servos get the policy's gains and torque limits, unless it is to keep its own.
"""

from fmpjax.sim2sim.episodes import COURSE, Course, Episode, course, play, report
from fmpjax.sim2sim.exported import ExportedPolicy, load, read
from fmpjax.sim2sim.observation import TERMS
from fmpjax.sim2sim.simulation import Simulation
from fmpjax.sim2sim.traits import FACTS, facts, integrator, self_collisions

__all__ = [
    "COURSE",
    "FACTS",
    "TERMS",
    "Course",
    "Episode",
    "ExportedPolicy",
    "Simulation",
    "course",
    "facts",
    "integrator",
    "load",
    "play",
    "read",
    "report",
    "self_collisions",
]
