"""Several devices and several processes: the numbers of one, to rounding. The devices are four fake ones of the CPU."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import cli, motion, priors, sharding
from fmpjax.errors import UserError
from fmpjax.trainer import Trainer, stack, unstack
from tests.helpers import tiny

DEVICES = 4


def trainer(**changes):
    return Trainer(tiny(chunk=1, **changes), motion.load("walk"))


def names(tree):
    return {jax.tree_util.keystr(path): leaf for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]}


def assert_close(one, other, tolerance=2e-3):
    """The absolute tolerance is above Adam's steps on parameters whose gradients are nothing but rounding."""
    for name, leaf in names(one).items():
        a, b = np.asarray(leaf, np.float64), np.asarray(names(other)[name], np.float64)
        np.testing.assert_allclose(b, a, rtol=tolerance, atol=tolerance, err_msg=name)


def test_hints_do_nothing_without_a_mesh():
    x = jnp.arange(6.0)
    assert sharding.split(x) is x
    assert sharding.gather(x) is x
    assert sharding.per_device(lambda y: y + len(y))(x)[0] == 6.0


def test_a_function_sees_its_device_s_rows_alone():
    x = jax.device_put(jnp.arange(8.0), sharding.rows(sharding.mesh(DEVICES)))
    with jax.set_mesh(sharding.mesh(DEVICES)):
        y = jax.jit(sharding.per_device(lambda rows: rows - rows[0]))(x)
    np.testing.assert_array_equal(y, [0, 1] * 4)


def test_environments_split_over_devices_are_those_of_one():
    """One iteration: rollout, fit with queries of their own, scores, PPO. Contacts make rounding larger, not much."""
    t = trainer(**{"prior.query_is_bank": False, "prior.query_share": 0.75})
    one, metrics = t.compile(t.init())(t.init())
    split = t.place(t.init(), sharding.mesh(DEVICES))
    assert split.env.physics.qpos.addressable_shards[0].data.shape[0] == 8 // DEVICES
    other, split_metrics = t.compile(split)(split)
    assert other.env.physics.qpos.addressable_shards[0].data.shape[0] == 8 // DEVICES
    assert_close(metrics, split_metrics)
    assert_close(one, other)


@pytest.mark.slow
def test_seeds_split_over_devices_are_those_of_one():
    t = trainer()
    program = t.compile(t.init(2))
    group = t.place(stack([t.init(seed) for seed in range(DEVICES)]), sharding.mesh(DEVICES))
    after, metrics = t.compile(group)(group)
    assert metrics["train/speed"].shape == (DEVICES,)
    assert_close(program(t.init(2))[0], unstack(after)[2])


@pytest.mark.parametrize("method", ["fmp", "amp", "wail", "pwil", "smp", "bank16", "barycentric"])
def test_a_prior_splits_its_windows(method):
    changes = {"amp.minibatch": 16, "amp.replay": 64, "amp.replay_new": 8, "wail.minibatch": 16, "smp.batch": 8}
    config = tiny(**changes)
    key = jax.random.PRNGKey(0)
    expert = priors.Expert(jax.random.normal(key, (40, 20)), 20.0, jnp.full(20, 20**-0.5), 10)
    prior = priors.make(method, expert, config)
    rollout = priors.Rollout(jax.random.normal(jax.random.PRNGKey(1), (4, 8, 20)) + 0.5, jnp.ones((4, 8), bool))
    rollout = rollout._replace(start=jnp.arange(32).reshape(4, 8) % 5 == 0)
    one = jax.jit(prior.update)(prior.init(key), rollout, key)
    over = sharding.mesh(DEVICES)
    split = jax.device_put(rollout, jax.NamedSharding(over, jax.P(None, sharding.AXIS)))
    with jax.set_mesh(over):
        other = jax.jit(prior.update)(jax.device_put(prior.init(key), sharding.everywhere(over)), split, key)
    assert_close(one, other, 1e-3)


def test_bad_devices(tmp_path, capsys):
    with pytest.raises(UserError, match="--devices is 9: expected 1 to 4, the devices that JAX sees"):
        sharding.mesh(9)
    t = trainer()
    with pytest.raises(UserError, match="setting env.count is 8: expected a multiple of 3, the devices that share"):
        t.place(t.init(), sharding.mesh(3))
    with pytest.raises(UserError, match="the number of seeds is 2: expected a multiple of 4"):
        t.place(stack([t.init(0), t.init(1)]), sharding.mesh(4))
    run = ["--preset", "smoke", "--run", str(tmp_path / "run")]
    for arguments, message in (
        ([*run, "--devices", "9"], "--devices is 9: expected 1 to 4, the devices that JAX sees"),
        ([*run, "--devices", "4", "--set", "env.count=6"], "setting env.count is 6: expected a multiple of 4"),
        ([*run, "--devices", "4", "--seeds", "2"], "the number of seeds is 2: expected a multiple of 4"),
        (["--devices", "-1"], "--devices is -1: expected 0 (for all) or more"),
        (["--processes", "2"], "--coordinator, --processes and --process go with --distributed"),
        (["--distributed"], "--distributed needs the run's folder"),
    ):
        with pytest.raises(SystemExit) as exit_info:
            cli.main(["train", *arguments])
        assert exit_info.value.code == 2
        assert message in capsys.readouterr().err
    # Nothing that the corrected command would find in its way.
    assert not (tmp_path / "run").exists()
