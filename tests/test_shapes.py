"""The shapes that functions state are checked in the tests, and cost users nothing."""

import os
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import TypeCheckError

from fmpjax import features, learning, potential, priors, rotations, transport
from fmpjax.priors import flow

checked = pytest.mark.skipif(os.environ.get("FMPJAX_TEST_SHAPES") == "0", reason="shapes are not checked")
ONE = jnp.float32(1.0)


# Each of these would compute something without the check: it broadcasts, or leaves numbers out.
WRONG = {
    "a vector as a quaternion": lambda: rotations.yaw(np.ones((3, 5))),
    "a quaternion as a vector": lambda: rotations.rotate(np.ones((2, 4)), np.ones((2, 4))),
    "one dual for all targets": lambda: transport.extension(jnp.ones((3, 2)), jnp.ones(1), ONE),
    "an epsilon for each target": lambda: transport.extension(jnp.ones((3, 2)), jnp.ones(2), jnp.ones(2)),
    "a point in place of points": lambda: transport.squared_cost(jnp.ones((3, 2)), jnp.ones((4, 1))),
    "one flow time for all points": lambda: potential.heads(
        potential.Params(jnp.ones((3, 2)), (jnp.ones((6, 3)),), (jnp.ones(3),)), jnp.ones((5, 2)), jnp.ones(1), 2.0
    ),
    "one number standardizes all": lambda: learning.standardize(jnp.ones((3, 2)), jnp.ones(1), jnp.ones(1), 5.0),
    "validity of a step for all": lambda: priors.median_reward(jnp.ones((3, 2)), jnp.ones(2, bool), 1e-3),
    "validity in numbers": lambda: priors.median_reward(jnp.ones((3, 2)), jnp.ones((3, 2)), 1e-3),
    "one draw for all queries": lambda: flow.pick(jnp.ones(1), jnp.ones((3, 2)), jnp.ones((2, 4))),
    "a frame in place of a window": lambda: features.relative_windows(jnp.ones(9)),
    "whole numbers": lambda: transport.median(jnp.arange(4)),
}


@checked
@pytest.mark.parametrize("call", WRONG.values(), ids=WRONG)
def test_a_wrong_shape_is_refused(call):
    with pytest.raises(TypeCheckError):
        call()


def test_users_pay_nothing_for_it():
    """In a process of its own: without the hook nothing is checked, and the checker is not even imported."""
    looked = "import sys, jax.numpy as jnp\nfrom fmpjax import learning\n"
    looked += "learning.standardize(jnp.ones((3, 2)), jnp.ones(1), jnp.ones(1), 5.0)\nprint('beartype' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", looked], capture_output=True, text=True, timeout=120)
    assert done.stdout == "False\n", done.stderr
