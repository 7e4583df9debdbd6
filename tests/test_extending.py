"""The examples of docs/extending.md are run as they stand there."""

import re
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import kinematics, physics, priors, robots
from fmpjax.config import Config, PriorConfig, preset
from fmpjax.errors import UserError
from fmpjax.physics.native import NativePhysics
from tests.helpers import ROOT

PAGE = ROOT / "docs" / "extending.md"


def example(name):
    """What the page's example of that name defines."""
    (block,) = re.findall(rf"^<!-- example: {name} -->\n```python\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    names = {"__name__": name}
    exec(compile(block, PAGE.name, "exec"), names)
    return SimpleNamespace(**names)


# --- a prior ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def registry(monkeypatch):
    """A registry that forgets after the test."""
    monkeypatch.setattr(priors, "_REGISTRY", dict(priors._REGISTRY))


@pytest.fixture
def witness(registry):
    example("prior")
    windows = jax.random.normal(jax.random.PRNGKey(0), (20, 6)) / 6**0.5
    expert = priors.Expert(windows, 6.0, jnp.full(6, 6**-0.5), 2)
    return priors.make("witness", expert, Config(method="witness", prior=PriorConfig(bank=16))), windows


def test_the_example_prior_ranks_the_demonstration_above_the_policy(witness):
    prior, windows = witness
    assert "witness" in priors.descriptions()
    far = windows[jax.random.randint(jax.random.PRNGKey(1), (4, 8), 0, 20)] + 1.0
    half = jnp.where(jnp.arange(8)[None, :, None] < 2, windows[:8], far)  # two of eight environments imitate
    valid = jnp.ones((4, 8), bool).at[0, 5].set(False)
    rollout = priors.Rollout(half.at[0, 5].set(jnp.nan), valid)
    state, reward, metrics = jax.jit(prior.update)(prior.init(jax.random.PRNGKey(2)), rollout, jax.random.PRNGKey(3))
    assert reward.shape == (4, 8) and reward[0, 5] == 0.0
    assert reward[:, :2].min() > jnp.delete(reward[:, 2:].ravel(), 3).max()
    assert metrics["expert_margin"] > 0 and all(np.isfinite(value) for value in metrics.values())
    assert prior.score(state, windows).mean() > prior.score(state, far.reshape(-1, 6)).mean()


def test_a_method_is_registered_once(registry):
    def make(expert, config):
        """Of this test."""

    priors.register("mine", make)
    priors.register("mine", make)
    priors.check("mine")
    assert preset("smoke", method="mine").method == "mine"
    with pytest.raises(UserError, match="method 'amp' is registered already: expected a new name beside fmp, "):
        priors.register("amp", make)


# --- physics ---------------------------------------------------------------------------------------------------------


def test_the_example_backend_steps_two_environments():
    made = example("physics")
    np.testing.assert_allclose(made.state.qpos[:, 7:], made.targets, atol=1e-6)
    np.testing.assert_allclose(made.state.qvel[:, 6:], 3 * np.repeat([[1.0], [-1.0]], 12, axis=1), rtol=1e-4)
    np.testing.assert_array_equal(made.state.qpos[:, :7], made.qpos[:, :7])


# --- a robot ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def stilts(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    robot = example("robot").robot
    assert capsys.readouterr().out == "stilts ('left_hip', 'right_hip') 4.4 kg\n"
    return robot


def test_the_example_robot_stands_on_its_soles_and_takes_a_step(stilts):
    assert robots.lowest_sole(stilts, stilts.default_qpos) == pytest.approx(-robots.CONTACT_DEPTH)
    assert stilts.takes("stilts") and not stilts.takes("strider")
    backend = NativePhysics(stilts, preset("smoke").physics)
    start = jnp.asarray(stilts.default_qpos, jnp.float32)[None]
    state = backend.step(physics.reset(start, jnp.zeros((1, 8))), jnp.zeros((1, 2)))
    assert state.qpos.shape == (1, 9) and abs(state.qpos[0, 2] - start[0, 2]) < 0.01
    assert not kinematics.fallen(stilts, kinematics.body_poses(stilts, state.qpos))[0]


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("robot.xml", "<mujoco", "<muj", r"stilts cannot be read as a robot: .*"),
        ("robot.xml", "left_foot_", "left_sole_", "expected a left and a right foot, each one body"),
        (
            "robot.toml",
            "sagittal_joints =",
            "sagittal =",
            "toml has no sagittal_joints, or misnames it: expected the keys",
        ),
        ("robot.toml", '"left_leg"', '"left_arm"', "toml has no .*left_arm.*, or misnames it"),
        ("robot.toml", "camera =", "camera", "toml is not TOML .*: expected the keys in docs"),
        ("robot.toml", "distance = 1.5", "distance = []", "stilts cannot be read as a robot: float"),
    ],
)
def test_a_robot_with_a_fault_is_refused_in_a_sentence(stilts, file, old, new, said):
    folder = Path("other/stilts")
    folder.mkdir(parents=True)
    for name in ("robot.xml", "robot.toml"):
        text = (Path("stilts") / name).read_text()
        (folder / name).write_text(text.replace(old, new) if name == file else text)
        assert name != file or old in text
    with pytest.raises(UserError, match=said):
        robots.load(str(folder))


def test_a_robot_without_its_facts_or_with_a_shipped_name_is_refused(stilts):
    facts = Path("stilts/robot.toml")
    facts.unlink()
    with pytest.raises(UserError, match=r"cannot read stilts/robot\.toml: No such file or directory"):
        robots.load("stilts")
    Path("stilts").rename("strider2")
    Path("mine").mkdir()
    Path("strider2").rename("mine/strider")
    with pytest.raises(UserError, match="robot 'mine/strider' is called 'strider' as a shipped one is"):
        robots.load("mine/strider")
