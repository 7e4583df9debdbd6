"""One robot that is played with: its simulation, what pushes it, its demonstration beside it, and what is plotted."""

import dataclasses
from collections import deque

import mujoco
import numpy as np

from fmpjax import rotations
from fmpjax.motion import MotionClip
from fmpjax.sim2sim import ExportedPolicy, Simulation

KEPT = 10.0  # s of the past in the plots
PUSH = 0.1  # s that a push lasts
LYING = 1.5  # s after a fall until the robot stands again
PULL, MOST_PULL = 250.0, 250.0  # N/m of the spring by which a robot is dragged, and N that it pulls at most
LOST = 2.5  # m between the robot and its demonstration at which the demonstration comes back to it


@dataclasses.dataclass
class Row:
    """What is plotted of one step of control."""

    time: float  # s since the start of the session
    velocity: np.ndarray  # [3] m/s forward and to the left, rad/s
    command: np.ndarray  # [3]
    load: np.ndarray  # [2] N, what the floor bears of each foot


@dataclasses.dataclass
class Ghost:
    """The demonstration as it moves beside the robot."""

    clip: MotionClip
    row: float
    start: np.ndarray  # [7 + J], the robot's configuration when the ghost stood where it stood
    first: int  # row at which that was

    def qpos(self) -> np.ndarray:
        """Its configuration, ``[7 + J]``."""
        return moved(self.clip.qpos[int(self.row)], self.clip.qpos[self.first], self.start)


@dataclasses.dataclass
class Drag:
    """A hand that pulls at a point of a body."""

    body: int
    point: np.ndarray  # [3] m, in the body
    target: np.ndarray  # [3] m, in the world


class Player:
    """A robot, the policy that moves it and the demonstrations that the policy learned from."""

    def __init__(
        self,
        label: str,
        simulation: Simulation,
        clips: tuple[MotionClip, ...] = (),
        *,
        in_motion: bool = True,
        seed: int = 0,
    ):
        """A robot at its start.

        Args:
          label: what the page calls it.
          simulation: with a policy.
          clips: demonstrations, at the rate of control.
          in_motion: start at a state of a demonstration, where there is one; else in the default pose.
          seed: of the rows at which it starts.
        """
        self.label, self.simulation, self.clips = label, simulation, clips
        self._in_motion, self._random = in_motion, np.random.default_rng(seed)
        self._speeds = np.array([clip.heading_velocities.mean(0) for clip in clips])
        self.feet = _feet(simulation)
        self.ghost: Ghost | None = None
        self.drag: Drag | None = None
        self.falls, self._fallen = 0, 0.0
        self._push, self._pushing = np.zeros(3), 0.0
        dt = simulation.policy.step_dt
        self.rows: deque[Row] = deque(maxlen=round(KEPT / dt))
        self.states: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=64)  # newest last, for the motion prior
        self.restart(np.zeros(3))

    def use(self, policy: ExportedPolicy) -> None:
        """Continue with another policy of the same robot."""
        self.simulation.policy = policy

    def restart(self, command: np.ndarray, *, here: bool = False) -> None:
        """Put the robot at its start, or ``here`` on its feet, with the demonstration that moves like the command."""
        sim = self.simulation
        place = sim.qpos if here else sim.policy.default_qpos
        clip = self.clips[self._like(command)] if self.clips else None
        # From the first half, after which there is some of it left to be seen.
        anywhere = self._in_motion or not self.timed
        first = int(self._random.integers(0, max(1, len(clip) // 2))) if clip and anywhere else 0
        if clip and self._in_motion:
            qpos, qvel = moved(clip.qpos[first], clip.qpos[first], place), clip.qvel[first].copy()
            turn_wxyz = rotations.multiply(qpos[3:7], rotations.conjugate(clip.qpos[first, 3:7]))
            qvel[:3] = rotations.rotate(turn_wxyz, qvel[:3])
            sim.place(qpos, qvel, first)
        else:
            sim.reset()
            sim.place(moved(sim.qpos, sim.qpos, place), np.zeros_like(sim.qvel))
        self.ghost = Ghost(clip, float(first), sim.qpos, first) if clip else None
        self._fallen, self._pushing, self.drag = 0.0, 0.0, None
        self.states.clear()

    def push(self, impulse: np.ndarray) -> None:
        """Push the root by ``impulse [2]`` (N s) forward and to the left in its heading."""
        x, y = self.simulation.facing
        self._push = np.array([impulse[0] * x - impulse[1] * y, impulse[0] * y + impulse[1] * x, 0.0]) / PUSH
        self._pushing = PUSH

    def step(self, command: np.ndarray, time: float, *, stand_up: bool = True) -> None:
        """One step of control.

        Args:
          command: ``[3]`` m/s forward and to the left, rad/s; a policy that takes none ignores it.
          time: s since the start of the session.
          stand_up: put a robot that has fallen on its feet after a while.
        """
        sim, dt = self.simulation, self.simulation.policy.step_dt
        sim.command = command
        body, wrench = self._hands(dt)
        sim.data.xfrc_applied[body] += wrench
        fell = sim.step()
        sim.data.xfrc_applied[body] -= wrench
        if fell and not self._fallen:
            self.falls += 1
        self._fallen = self._fallen + dt if fell or self._fallen else 0.0
        finite = bool(np.isfinite(sim.qpos).all() and np.isfinite(sim.qvel).all())
        if not finite or (stand_up and self._fallen > LYING):
            self.restart(command, here=finite)
        elif sim.over:
            self.restart(command, here=True)
        else:
            self._follow(dt, command)
        self.rows.append(Row(time, sim.velocity(), command.copy(), self._loads()))
        self.states.append((sim.qpos, sim.qvel))

    @property
    def steered(self) -> bool:
        """Whether the policy takes commands."""
        return "velocity_commands" in self.simulation.policy.terms

    @property
    def timed(self) -> bool:
        """Whether the policy is told the time in its clip."""
        return "clip_phase" in self.simulation.policy.terms

    @property
    def lies(self) -> bool:
        """Whether it has fallen and was not put on its feet yet."""
        return bool(self._fallen)

    def _hands(self, dt: float) -> tuple[int, np.ndarray]:
        """The body that is pushed or pulled, and force and torque on it, ``[6]``."""
        data, wrench = self.simulation.data, np.zeros(6)
        if (drag := self.drag) is not None:
            point = data.xpos[drag.body] + data.xmat[drag.body].reshape(3, 3) @ drag.point
            force = PULL * (drag.target - point)
            force *= min(1.0, MOST_PULL / max(np.linalg.norm(force), 1e-9))
            wrench[:3], wrench[3:] = force, np.cross(point - data.xipos[drag.body], force)
            return drag.body, wrench
        if self._pushing > 1e-9:
            self._pushing -= dt
            wrench[:3] = self._push
        return self.simulation.root_body, wrench

    def _like(self, command: np.ndarray) -> int:
        """Index of the demonstration that moves like the command; a random one for a policy that takes none."""
        if not self.steered:
            return int(self._random.integers(len(self.clips)))
        return int(np.linalg.norm(self._speeds - command, axis=1).argmin())

    def _follow(self, dt: float, command: np.ndarray) -> None:
        """Move the demonstration on; at its end, or far from the robot, it begins again where the robot is."""
        if (ghost := self.ghost) is None:
            return
        ghost.row = float(self.simulation.row) if self.timed else ghost.row + dt * ghost.clip.rate
        here = self.simulation.qpos
        over = ghost.row > len(ghost.clip) - 1
        clip = self.clips[self._like(command)] if self.steered else ghost.clip
        if over or clip is not ghost.clip or np.linalg.norm(ghost.qpos()[:2] - here[:2]) > LOST:
            first = 0 if over or clip is not ghost.clip else int(ghost.row)
            self.ghost = Ghost(clip, float(first), here, first)

    def _loads(self) -> np.ndarray:
        """What the floor bears of each foot, ``[2]`` N."""
        data, model, loads, force = self.simulation.data, self.simulation.model, np.zeros(2), np.zeros(6)
        for i, pair in enumerate(model.geom_bodyid[data.contact.geom]):
            for foot, body in enumerate(self.feet):
                if body in pair:
                    mujoco.mj_contactForce(model, data, i, force)
                    loads[foot] += force[0]
        return loads


def moved(qpos: np.ndarray, start: np.ndarray, place: np.ndarray) -> np.ndarray:
    """A configuration moved over the floor and turned about the vertical, by what takes ``start`` to ``place``.

    All are ``[7 + J]``; of ``place`` the position over the floor and the heading count.
    """
    angle = float(rotations.yaw(place[3:7]) - rotations.yaw(start[3:7]))
    turn = rotations.exp_map(np.array([0.0, 0.0, angle]))
    out = qpos.copy()
    out[:3] = rotations.rotate(turn, qpos[:3] - start[:3] * [1.0, 1.0, 0.0]) + place[:3] * [1.0, 1.0, 0.0]
    out[3:7] = rotations.multiply(turn, qpos[3:7])
    return out


def _feet(simulation: Simulation) -> tuple[int, ...]:
    """Bodies that touch the floor in the default pose, two at most, the left one first."""
    simulation.reset()
    model, data = simulation.model, simulation.data
    bodies = {int(b) for b in model.geom_bodyid[data.contact.geom].ravel() if model.body_weldid[b] != 0}
    return tuple(sorted(bodies, key=lambda body: -data.xpos[body, 1])[:2])
