"""The step that all evaluations share, on environments that are numbers."""

import contextlib
from types import SimpleNamespace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from fmpjax import frozen
from fmpjax.commands.base import Told


class Now(NamedTuple):
    physics: object
    observed: object
    command: object = ()
    disturbed: object = ()


class Observed(NamedTuple):
    frame: object


def env_of(*, fell, command=None):
    """Environments that move by their action, and fall as they are told."""

    def look(now, drawn):
        return now._replace(disturbed=drawn), now.observed.frame

    def advance(physics, action, disturbed, drawn):
        place = physics + action[:, 0]
        return SimpleNamespace(physics=place, observed=Observed(place[:, None]), fell=fell, disturbed=disturbed + 1)

    return SimpleNamespace(look=look, advance=advance, command=command)


TRAINER = SimpleNamespace(precision=contextlib.nullcontext)
POLICY = SimpleNamespace(act=lambda seen, key: (seen + 1.0, {}))
START = Now(jnp.array([1.0, 2.0, 3.0]), Observed(jnp.array([[1.0], [2.0], [3.0]])))
ALIVE = jnp.array([True, True, False])


def test_an_episode_ends_with_the_step_of_its_fall_and_then_nothing_moves():
    taken = frozen.step(TRAINER, env_of(fell=jnp.array([False, True, True])), POLICY, START, ALIVE, jnp.zeros(3))
    np.testing.assert_array_equal(taken.now.physics, [3, 5, 3])
    np.testing.assert_array_equal(taken.now.observed.frame[:, 0], [3, 5, 3])
    np.testing.assert_array_equal(taken.alive, [True, False, False])
    np.testing.assert_array_equal(taken.fell, [False, True, False])
    np.testing.assert_array_equal(taken.now.disturbed, [1, 1, 1])
    assert taken.earned is None


def test_a_command_is_held_and_may_end_an_episode():
    def advance(state, drawn, frame):
        assert drawn is None
        return Told(state + 1, state > 5, frame[:, 0] / 10)

    env = env_of(fell=jnp.zeros(3, bool), command=SimpleNamespace(advance=advance))
    now = START._replace(command=jnp.array([5, 6, 6]))
    taken = frozen.step(TRAINER, env, POLICY, now, ALIVE, jnp.zeros(3))
    np.testing.assert_array_equal(taken.now.command, [6, 7, 7])
    np.testing.assert_array_equal(taken.alive, [True, False, False])
    assert not taken.fell.any()
    np.testing.assert_allclose(taken.earned, [0.3, 0.5, 0.7])  # of the frame that is reached
