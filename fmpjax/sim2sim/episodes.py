"""Episodes of a policy in a simulation, and what became of them in words."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fmpjax.errors import UserError
from fmpjax.sim2sim.simulation import Simulation

# Seconds and command (m/s, m/s, rad/s) of each leg, for a policy that takes commands and is told nothing else.
COURSE = ((4.0, (0.5, 0.0, 0.0)), (4.0, (0.5, 0.0, 0.4)), (2.0, (0.0, 0.0, 0.0)))
EVERY = 2.0  # s between two pushes, as in `fmpjax evaluate --robust`
Course = Sequence[tuple[float, tuple[float, float, float]]]


class Episode(NamedTuple):
    """One start of a policy until its fall or the end; ``T`` steps of control."""

    qpos: np.ndarray  # [T + 1, 7 + J], the start first, of finite numbers alone
    speed: float  # m/s along the own heading, mean of the second half
    legs: np.ndarray  # [L, 3] mean velocity in the second half of each leg of the course; not finite after a fall
    seconds: float
    fell: bool


def course(legs: Sequence[str]) -> Course:
    """A course from words such as ``4:0.5,0,0.4``: seconds, then velocity forward, to the left (m/s) and turn (rad/s).

    Raises:
      UserError: a word cannot be read.
    """
    found = []
    for leg in legs:
        seconds, _, command = leg.partition(":")
        try:
            numbers = [float(seconds), *map(float, command.split(","))]
        except ValueError:
            numbers = []
        if len(numbers) != 4 or not np.isfinite(numbers).all() or numbers[0] <= 0:
            raise UserError(f"leg {leg!r} of the course: expected SECONDS:FORWARD,LEFT,TURN such as 4:0.5,0,0.4")
        leg_seconds, forward, left, turn = numbers
        found.append((leg_seconds, (forward, left, turn)))
    return tuple(found)


def play(
    sim: Simulation,
    *,
    seconds: float = 10.0,
    episodes: int = 8,
    noise: float = 0.02,
    seed: int = 0,
    course: Course | None = None,
    push: float = 0.0,
) -> list[Episode]:
    """Run the policy from its default pose, the first time exactly, then with joints a little off.

    Args:
      sim: the model.
      seconds: length of an episode at most, where there is no course.
      episodes: their number.
      noise: rad, standard deviation of the joint angles; ten times that in rad/s of their velocities.
      seed: of the noise.
      course: seconds and command of each leg, for a policy that takes commands.
      push: m/s, added to the root's velocity in a random horizontal direction every two seconds.

    Raises:
      UserError: there is a course, and the policy takes no commands.
    """
    if course and "velocity_commands" not in sim.policy.terms:
        raise UserError("the policy takes no commands: expected no course")
    course = course or ((seconds, (0.0, 0.0, 0.0)),)
    ends, commands = np.cumsum([leg for leg, _ in course]), np.array([command for _, command in course])
    random, directions, played = np.random.default_rng(seed), np.random.default_rng([seed, 1]), []
    for episode in range(episodes):
        off = random.normal(size=(2, len(sim.policy.joint_names))) * noise * np.array([[1.0], [10.0]])
        sim.reset(off if episode else None)
        qpos, velocities, legs, fell, pushes = [sim.qpos], [], [], False, 1
        while not fell and sim.time < ends[-1] - 1e-9:
            legs.append(int(np.searchsorted(ends - 1e-9, sim.time, side="right")))
            sim.command = commands[legs[-1]]
            if push and sim.time > EVERY * pushes - 1e-9:
                angle, pushes = directions.uniform(0.0, 2.0 * np.pi), pushes + 1
                sim.push(push * np.array([np.cos(angle), np.sin(angle)]))
            fell = sim.step()
            velocities.append(sim.velocity())
            if np.isfinite(sim.qpos).all():
                qpos.append(sim.qpos)
        reached, steps = np.array(velocities), np.array(legs)
        means = np.full((len(course), 3), np.nan)
        for leg in range(steps[-1] + (not fell)):
            rows = np.flatnonzero(steps == leg)
            means[leg] = reached[rows[len(rows) // 2 :]].mean(0)
        speed = float(reached[len(reached) // 2 :, 0].mean())
        played.append(Episode(np.array(qpos), speed, means, sim.time, fell))
    return played


def report(sim: Simulation, played: list[Episode], course: Course | None = None) -> str:
    """Falls, speed, what became of each leg of the course, and the differences between the models, in words."""
    falls = [episode for episode in played if episode.fell]
    upright = [episode.speed for episode in played if not episode.fell]
    lines = [f"falls: {len(falls)} of {len(played)} episodes"]
    if falls:
        lines[0] += f", after {min(e.seconds for e in falls):.2f} to {max(e.seconds for e in falls):.2f} s"
    lines.append(
        f"speed: {np.mean(upright):.3f} m/s, second half of the episodes without a fall"
        if upright
        else "speed: undefined, each episode ends in a fall"
    )
    for leg, (seconds, command) in enumerate(course or ()):
        reached = np.array([episode.legs[leg] for episode in played])
        reached = reached[np.isfinite(reached).all(-1)]
        told = "nothing, each episode had ended in a fall" if not len(reached) else _velocity(reached.mean(0))
        lines.append(f"told {_velocity(command)} for {seconds:g} s: {told}")
    if not sim.differences:
        return "\n".join([*lines, "the model is as in training in masses, joints, limits, integrator and time step"])
    return "\n".join([*lines, "unlike in training:", *(f"  {sentence}" for sentence in sim.differences)])


def _velocity(velocity: Sequence[float]) -> str:
    forward, left, turn = velocity
    return f"{forward:.2f} m/s forward, {left:.2f} m/s to the left, {turn:.2f} rad/s"
