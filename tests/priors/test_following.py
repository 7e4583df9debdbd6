"""ADD and tracking, which compare each step with the demonstration at the same time: forms, settings, training."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmpjax import cli, config, features, motion, priors, robots
from fmpjax.config import ADDConfig, FeatureConfig, TrackingConfig, preset
from fmpjax.errors import UserError
from fmpjax.frames import FrameLayout
from fmpjax.priors import MotionPrior, add, adversary, amp, tracking
from fmpjax.trainer import Trainer
from tests.helpers import COUNT, SMALL, STEPS, expert_of, rollout_of, tiny

# --- ADD -------------------------------------------------------------------------------------------------------------


def pairs(reached, wanted, valid=None):
    """A rollout of frames ``[n, F]`` that were reached and wanted."""
    grid = lambda x: jnp.asarray(x, jnp.float32).reshape(STEPS, COUNT, -1)  # noqa: E731
    return rollout_of(np.zeros((STEPS * COUNT, 1)), valid)._replace(frame=grid(reached), wanted=grid(wanted))


def test_add_loss_by_hand():
    """A linear discriminator l = 2 x, a difference of 0.5 and none: l = 1 and 0.

    Cross entropy (log(1 + e) + log 2) / 2 = 1.003204, twice the squared slope 4 at the difference alone, logit penalty
    0.01 * 4: 9.043204.
    """
    params = {"params": {"logit": {"kernel": jnp.array([[2.0]]), "bias": jnp.zeros(1)}}}
    network = adversary.network((), 1.0, 1.0)
    apply = lambda params, x: network.apply(params, x)[..., 0]  # noqa: E731
    total, stats = adversary.cross_entropy(
        apply, params, jnp.array([[0.5]]), jnp.zeros((1, 1)), ADDConfig(), both=False
    )
    assert float(total) == pytest.approx(9.043204, rel=1e-6)
    assert float(stats["discriminator_loss"]) == pytest.approx(0.5 * (math.log(1 + math.e) + math.log(2)), rel=1e-6)


@pytest.mark.parametrize(("difference", "penalty"), [(-1.0, 0.0), (1.0, 9.0)])
def test_add_penalizes_no_slope_at_the_zero_vector(difference, penalty):
    """A slope of 3 above -0.1, and so at zero, and none below."""
    params = {"params": {"logit": {"kernel": jnp.zeros((1, 1))}}}
    apply = lambda params, x: 3.0 * jax.nn.relu(x[..., 0] + 0.1)  # noqa: E731
    agent = jnp.array([[difference]])
    _, stats = adversary.cross_entropy(apply, params, agent, jnp.zeros((1, 1)), ADDConfig(), both=False)
    assert float(stats["gradient_penalty"]) == pytest.approx(penalty)


def test_add_divides_by_the_mean_magnitude_of_all_differences():
    rng = np.random.default_rng(0)
    batches = [rng.normal(2.0, [1.0, 30.0], (n, 2)) for n in (50, 20)]
    state = adversary.Normalizer(jnp.float32(0.0), jnp.zeros(2), jnp.ones(2))
    for batch in batches:
        state = add.update_scale(state, jnp.asarray(batch, jnp.float32), None)
    np.testing.assert_allclose(jnp.sqrt(state.variance), np.abs(np.concatenate(batches)).mean(0), rtol=1e-5)
    np.testing.assert_array_equal(state.mean, 0.0)
    assert float(state.count) == 70


def test_add_compares_single_frames_with_their_multiplicities():
    """Two frames of two coordinates, the first of which stands twice: weights over root (3 * 2) in a window."""
    weight = np.tile([math.sqrt(2), 1.0], 2) / math.sqrt(6)
    expert = priors.Expert(jnp.zeros((5, 4)), 6.0, jnp.asarray(weight), 2)
    zero = add.perfect(expert)
    assert zero.windows.shape == (1, 2) and zero.dimension == 3.0 and zero.horizon == 1
    np.testing.assert_allclose(zero.weight, np.array([math.sqrt(2), 1.0]) / math.sqrt(3), rtol=1e-6)
    np.testing.assert_array_equal(zero.windows, 0.0)


def trained(points, rounds=4, **changes):
    """ADD's update, and its state after rollouts whose differences are ``points [n, F]``."""
    settings = dataclasses.replace(SMALL.add, updates=60, learning_rate=3e-3, **changes)
    prior = add.make(expert_of(np.zeros((4, points.shape[-1]))), dataclasses.replace(SMALL, add=settings))
    update, state = jax.jit(prior.update), prior.init(jax.random.PRNGKey(0))
    for seed in range(rounds):
        state, _, metrics = update(state, pairs(0 * points, points), jax.random.PRNGKey(seed))
    return update, state, metrics


def test_add_pays_most_for_the_motion_itself():
    """Identical motion is the zero vector, whatever the motion; any difference earns less, larger ones least."""
    rng = np.random.default_rng(1)
    signs, sizes = rng.choice([-1.0, 1.0], (STEPS * COUNT, 3)), rng.uniform(0.5, 1.5, (STEPS * COUNT, 3))
    points = signs * sizes * [1.0, 0.01, 20.0]
    update, state, metrics = trained(points)
    motion_itself = rng.normal(size=points.shape)
    rewards = {
        size: np.asarray(update(state, pairs(motion_itself - size * points, motion_itself), jax.random.PRNGKey(9))[1])
        for size in (0.0, 0.5, 1.0)
    }
    best = rewards[0.0]
    np.testing.assert_allclose(best, best[0, 0], rtol=1e-4)
    assert best[0, 0] > rewards[0.5].max() and best[0, 0] > rewards[1.0].max()
    assert rewards[0.5].mean() > rewards[1.0].mean()
    assert metrics["expert_margin"] > 1 and metrics["agent_accuracy"] > 0.7
    assert best.max() <= amp.cap(SMALL.add) + 1e-5


def test_add_scores_before_it_fits_and_by_the_demonstration_less_the_robot():
    rng = np.random.default_rng(2)
    points, wanted = rng.normal(size=(2, STEPS * COUNT, 3))
    prior = add.make(expert_of(np.zeros((4, 3))), SMALL)
    state = prior.init(jax.random.PRNGKey(0))
    _, reward, metrics = prior.update(state, pairs(wanted - points, wanted), jax.random.PRNGKey(1))
    # At the start every coordinate is divided by 1, and each stands once.
    apply = adversary.network(SMALL.add.hidden, SMALL.add.logit_init, 3.0).apply
    logit = apply(state.params, jnp.asarray(points, jnp.float32))[..., 0]
    np.testing.assert_allclose(reward.ravel(), amp.reward_of(logit, SMALL.add), rtol=1e-4)
    assert float(metrics["replayed"]) == STEPS * COUNT


# --- tracking --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def states(walk):
    """Two rows of six states that differ in everything, also in place and heading."""
    rng = np.random.default_rng(3)
    qpos, qvel = walk.qpos[40:46].copy(), walk.qvel[40:46].copy()
    other, moved = walk.qpos[44:50].copy(), walk.qvel[44:50].copy()
    other[:, 7:] += rng.normal(0, 0.1, other[:, 7:].shape)
    other[:, :3] += rng.normal(0, [2.0, 2.0, 0.03], (6, 3))
    moved += rng.normal(0, 0.5, moved.shape)
    turn = Rotation.from_euler("z", rng.uniform(-3, 3, (6, 1))) * Rotation.from_euler("x", rng.normal(0, 0.2, (6, 1)))
    turned = turn * Rotation.from_quat(other[:, 3:7], scalar_first=True)
    other[:, 3:7] = turned.as_quat(scalar_first=True)
    return (qpos, qvel), (other, moved)


@pytest.fixture(scope="module")
def placed(robot, walk):
    """A function from states to frames as a prior gets them with a command: without x, y and heading."""
    frames = features.observe(robot, jnp.asarray(walk.qpos), jnp.asarray(walk.qvel), "compact").frame
    windows = frames[np.arange(10) + np.arange(50)[:, None]]
    mapped = features.fit_feature_map(robot, windows, FeatureConfig(axes="heading"))
    return lambda qpos, qvel: mapped.placed(
        features.observe(robot, jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32), "compact").frame
    )


def local(robot, qpos, qvel):
    """By MuJoCo and SciPy, of one state: the root's rotation and velocities and its key points, in its own heading."""
    data = mujoco.MjData(robot.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(robot.model, data)
    root = Rotation.from_quat(qpos[3:7], scalar_first=True)
    x = root.as_matrix()[:, 0]
    own = Rotation.from_euler("z", -math.atan2(x[1], x[0]))
    bodies = [int(body) + 1 for body in robot.key_body]  # the world is MuJoCo's body 0
    points = [
        data.xpos[body] + data.xmat[body].reshape(3, 3) @ offset
        for body, offset in zip(bodies, robot.key_offset, strict=True)
    ]
    return own * root, own.apply(qvel[:3]), own.apply(root.apply(qvel[3:6])), own.apply(np.array(points) - qpos[:3])


def test_tracking_pays_one_for_no_error(robot, placed, walk):
    frames, layout = placed(walk.qpos, walk.qvel), FrameLayout.of(robot)
    found = tracking.errors(frames, frames, layout)
    assert all(float(jnp.abs(error).max()) == 0.0 for error in found)
    np.testing.assert_allclose(tracking.reward_of(found, TrackingConfig()), 1.0, rtol=1e-6)
    weights = [value for name, value in dataclasses.asdict(TrackingConfig()).items() if name.endswith("_weight")]
    assert sum(weights) == pytest.approx(1.0)


def test_tracking_is_deepmimics_sum_in_numpy(robot, placed, states):
    """Errors from the states themselves: angles of quaternions, MuJoCo's bodies; place and heading do not matter."""
    (qpos, qvel), (other, moved) = states
    found = tracking.errors(placed(qpos, qvel), placed(other, moved), FrameLayout.of(robot))
    rewards = tracking.reward_of(found, TrackingConfig())
    for i in range(len(qpos)):
        ours, theirs = local(robot, qpos[i], qvel[i]), local(robot, other[i], moved[i])
        tilt = (ours[0] * theirs[0].inv()).magnitude() ** 2
        velocity, spin, points = (np.sum((ours[k] - theirs[k]) ** 2) for k in (1, 2, 3))
        joints, rates = np.sum((qpos[i, 7:] - other[i, 7:]) ** 2), np.sum((qvel[i, 6:] - moved[i, 6:]) ** 2)
        height = (qpos[i, 2] - other[i, 2]) ** 2
        expected = tracking.Errors(joints, rates, height, tilt, velocity, spin, points)
        np.testing.assert_allclose([float(error[i]) for error in found], expected, rtol=2e-3, atol=1e-5)
        total = (
            0.5 * math.exp(-0.25 * joints)
            + 0.1 * math.exp(-0.01 * rates)
            + 0.15 * math.exp(-5 * (height + 0.1 * tilt))
            + 0.1 * math.exp(-(velocity + 0.1 * spin))
            + 0.15 * math.exp(-10 * points)
        )
        assert float(rewards[i]) == pytest.approx(total, rel=1e-3)
    assert 0.05 < float(rewards.min()) < float(rewards.max()) < 0.95


def test_tracking_says_how_large_errors_are(robot, placed, walk):
    """Joints that are all off by 0.2 rad, in half of the steps that count."""
    off = walk.qpos.copy()
    off[:, 7:] += 0.2
    layout = FrameLayout.of(robot)
    wanted, reached = (np.asarray(placed(q, walk.qvel)[: STEPS * COUNT]) for q in (walk.qpos, off))
    valid = np.ones((STEPS, COUNT), bool)
    valid[0] = False
    reached = np.where(np.arange(STEPS * COUNT)[:, None] % 2, reached, wanted)
    reached[:COUNT] = np.nan
    prior = tracking.make(expert_of(np.zeros((4, layout.size)))._replace(layout=layout), SMALL)
    state, reward, metrics = prior.update(prior.init(None), pairs(reached, wanted, valid), None)
    assert state == () and float(metrics["joint_error"]) == pytest.approx(0.2 / math.sqrt(2), rel=1e-3)
    assert float(metrics["velocity_error"]) == 0.0 and float(metrics["key_point_error"]) > 0.01
    np.testing.assert_array_equal(reward[0], 0.0)
    np.testing.assert_allclose(np.ravel(reward)[COUNT::2], 1.0, rtol=1e-5)
    assert (np.ravel(reward)[COUNT + 1 :: 2] < 0.8).all()


# --- both ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", config.FOLLOWERS)
def test_a_rollout_without_what_was_wanted_is_a_mistake(method):
    layout = FrameLayout.of(robots.load("strider"))
    prior = priors.make(method, expert_of(np.zeros((4, layout.size)))._replace(layout=layout), SMALL)
    rollout = rollout_of(np.zeros((STEPS * COUNT, layout.size)))
    with pytest.raises(ValueError, match="rollout without frames"):
        prior.update(prior.init(jax.random.PRNGKey(0)), rollout, jax.random.PRNGKey(0))
    with pytest.raises(UserError, match=f"method {method} scores a step by the time in the clip: a window alone has"):
        prior.score(None, rollout.features[0])


@pytest.mark.parametrize("method", config.FOLLOWERS)
def test_a_method_that_follows_brings_the_phase_with_it(method):
    made = preset("laptop", method=method)
    assert (made.command.kind, made.command.combine) == ("phase", "prior")
    assert (made.env.axes, made.features.axes) == ("heading", "heading")
    own = preset("laptop", method=method, **{"command.combine": "product", "features.axes": "world"})
    assert (own.command.combine, own.features.axes) == ("product", "world")
    assert preset("laptop", method="fmp").command.kind == "none"


@pytest.mark.parametrize("command", ["none", "velocity"])
def test_a_method_that_follows_is_refused_without_a_phase(command, capsys, tmp_path):
    with pytest.raises(SystemExit) as stop:
        cli.main(["train", "--method", "add", "--command", command, "--preset", "smoke", "--run", str(tmp_path / "r")])
    assert stop.value.code == 2 and not (tmp_path / "r").exists()
    assert capsys.readouterr().err == (
        f"fmpjax: method is 'add' and command.kind '{command}': expected 'phase', since add compares each step with "
        "the demonstration at the commanded time\n"
    )


def test_a_reward_of_nothing_is_refused():
    parts = ("joint", "joint_velocity", "root", "root_velocity", "key_point")
    with pytest.raises(UserError, match="tracking.joint_weight, .*key_point_weight are all 0: expected one above 0"):
        preset("laptop", **{f"tracking.{part}_weight": 0.0 for part in parts})
    preset("laptop", **{f"tracking.{part}_weight": 0.0 for part in parts[1:]})


@pytest.mark.slow
def test_both_train_on_true_states_and_the_commanded_frames():
    """One compiled iteration, with sensors that err: what the priors see is true all the same.

    Two rollouts' frames are compared with the newest frames of their windows, and what was wanted with the clip.
    """
    errs = {f"disturbance.{name}": size for name, size in (("angle_noise", 0.5), ("encoder_bias", 0.5))}
    trainer = Trainer(
        tiny(method="tracking", chunk=1, **errs, **{"env.observation": "deployable"}), motion.load("walk")
    )
    parts = {name: priors.make(name, trainer.prior_expert, trainer.config) for name in config.FOLLOWERS}

    def update(state, rollout, key):
        found = {name: part.update(state[name], rollout, key) for name, part in parts.items()}
        metrics = {f"{name}/{k}": v for name, (_, _, values) in found.items() for k, v in values.items()}
        size, mapped = rollout.frame.shape[-1], trainer.feature_map
        newest = rollout.features[..., -size:] / mapped.weight * mapped.deviation[-1] + mapped.mean[-1]
        unclipped = jnp.abs(rollout.features[..., -size:] / mapped.weight) < 0.99 * mapped.clip
        metrics["off"] = jnp.max(jnp.abs(newest - rollout.frame) * unclipped)
        table = mapped.placed(jnp.asarray(trainer.env._table.frame))
        far = jnp.abs(rollout.wanted[..., None, :] - table).max(-1)
        metrics["unknown"] = far.min(-1).max()
        # Within an episode, what is wanted is the next row; the walk repeats itself, so several rows may be the one.
        # At its end it begins again, with its first row in place of its last.
        near, last = far < 1e-3, trainer.env.clip_rows - 1
        followed = (near[:-1, :, :-1] & near[1:, :, 1:]).any(-1) | (near[:-1, :, last - 1] & near[1:, :, 0])
        metrics["jumps"] = jnp.sum(~followed & ~rollout.start[1:])
        return {name: new for name, (new, _, _) in found.items()}, found["tracking"][1], metrics

    trainer.prior = MotionPrior(lambda key: {name: part.init(key) for name, part in parts.items()}, update, None)
    state = trainer.init()
    new, metrics = jax.jit(trainer.iteration)(state)
    fit = {name.removeprefix("fit/"): float(value) for name, value in metrics.items() if name.startswith("fit/")}
    assert all(map(math.isfinite, fit.values())), fit
    assert fit["off"] < 1e-3 and fit["unknown"] < 1e-5 and fit["jumps"] == 0
    assert 0 < fit["tracking/joint_error"] < 1.0
    # The policy earns the prior's reward alone.
    assert float(metrics["train/reward"]) == pytest.approx(float(metrics["command/prior_reward"]), rel=1e-6)
    assert not np.array_equal(
        new.prior["add"].params["params"]["logit"]["kernel"], state.prior["add"].params["params"]["logit"]["kernel"]
    )
