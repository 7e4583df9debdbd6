"""Observations and windows against recorded ones, and compact features against the full ones they stand for.

``data/features.npz``: random states and the observations that MimicKit's own code gives for them, float64.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from fmpjax import features
from fmpjax.config import FeatureConfig
from fmpjax.errors import UserError
from fmpjax.frames import FORWARD, PLANAR, FrameLayout

H, FRAME, FULL = 10, 239, 2390
POSITION = np.arange(3)  # of a frame: root x, y, z
KEY_POINTS = np.arange(189, 204)
VELOCITY = np.arange(204, 207)


@pytest.fixture(scope="module")
def reference(data):
    with np.load(data / "features.npz") as file:
        return dict(file)


@pytest.fixture(scope="module")
def observe(robot):
    """All forms of a batch of states ``[N, 10]``, compiled once a float type and size."""

    def everything(qpos, qvel):
        return {
            "window": features.prior_window(robot, qpos, qvel),
            "actor": features.actor_observation(robot, qpos, qvel),
            "full": features.observe(robot, qpos, qvel, "full"),
            "compact": features.observe(robot, qpos, qvel, "compact"),
        }

    compiled = jax.jit(everything)

    def run(qpos, qvel, dtype=np.float32):
        if dtype == np.float32:
            return jax.tree.map(np.asarray, compiled(jnp.asarray(qpos, dtype), jnp.asarray(qvel, dtype)))
        # JAX keeps index arrays in the width in which it first saw them.
        jax.clear_caches()
        with jax.enable_x64(True):
            out = jax.tree.map(np.asarray, compiled(jnp.asarray(qpos, dtype), jnp.asarray(qvel, dtype)))
        jax.clear_caches()
        return out

    return run


@pytest.fixture(scope="module")
def observed(observe, reference):
    return observe(reference["qpos"], reference["qvel"])


# --- the recorded observations ---------------------------------------------------------------------------------------


def test_joint_order_is_that_of_the_reference(robot, reference):
    assert tuple(reference["joint_names"]) == robot.joint_names


def test_window_is_the_recorded_one(observed, reference):
    assert observed["window"].shape == (24, FULL) and observed["window"].dtype == np.float32
    np.testing.assert_allclose(observed["window"], reference["prior_window"], atol=1e-5, rtol=1e-5)


def test_actor_observation_is_the_recorded_one(observed, reference):
    np.testing.assert_allclose(observed["actor"][:, -1], reference["actor_obs"], atol=1e-5, rtol=1e-5)
    np.testing.assert_allclose(observed["full"].actor, observed["actor"], atol=1e-6)


def test_compact_observation_has_the_joints_themselves(observed, reference):
    compact, full = observed["compact"].actor, observed["full"].actor
    assert compact.shape[-1] == 86 and full.shape[-1] == 237
    np.testing.assert_array_equal(compact[..., :13], full[..., :13])
    np.testing.assert_allclose(compact[..., 13:42], reference["qpos"][..., 7:], atol=1e-6)
    np.testing.assert_array_equal(compact[..., 42:], full[..., 193:])


# --- frames of a window ----------------------------------------------------------------------------------------------


def test_x_and_y_are_relative_to_the_newest_frame_and_z_is_not(observed, reference):
    root = observed["window"].reshape(24, H, FRAME)[..., POSITION]
    position = reference["qpos"][..., :3]
    np.testing.assert_allclose(root[..., :2], position[..., :2] - position[:, -1:, :2], atol=1e-5)
    assert not root[:, -1, :2].any() and np.abs(root[:, 0, :2]).max() > 0.01
    np.testing.assert_allclose(root[..., 2], position[..., 2], atol=1e-6)


def test_oldest_frame_is_first(observe, reference):
    """A change in the oldest state alone moves the first 239 numbers alone; in the newest, all but x and y."""
    qpos, qvel = (np.repeat(reference[k][:1], 24, axis=0) for k in ("qpos", "qvel"))
    qvel[1, 0, 6:] += 1.0
    qpos[2, -1, 0] += 1.0
    window = observe(qpos, qvel)["window"].reshape(24, H, FRAME)
    assert not (window[1] != window[0])[1:].any() and (window[1, 0] - window[0, 0])[-29:].min() > 0.99
    difference = window[2] - window[0]
    np.testing.assert_allclose(difference[:-1, 0], -1.0, atol=1e-5)
    np.testing.assert_allclose(np.delete(difference, 0, axis=1), 0.0, atol=1e-5)
    assert difference[-1, 0] == 0


def test_translation_on_the_floor_changes_nothing_and_height_only_itself(observe, observed, reference):
    shifted = reference["qpos"].copy()
    shifted[..., :2] += [3.0, -2.0]
    moved = observe(shifted, reference["qvel"])
    np.testing.assert_allclose(moved["window"], observed["window"], atol=1e-5)
    np.testing.assert_allclose(moved["actor"], observed["actor"], atol=1e-5)
    lifted = reference["qpos"].copy()
    lifted[..., 2] += 0.25
    raised = observe(lifted, reference["qvel"])
    expected = np.zeros((H, FRAME))
    expected[:, 2] = 0.25
    np.testing.assert_allclose(raised["window"] - observed["window"], np.tile(expected.ravel(), (24, 1)), atol=1e-5)
    np.testing.assert_allclose((raised["actor"] - observed["actor"])[..., 0], 0.25, atol=1e-6)


def test_velocities_are_in_world_axes(observe, reference):
    """A body turned by 90 degrees about z that spins about its own x spins about the world's y; velocity stays."""
    qpos, qvel = (np.repeat(reference[k][:1], 24, axis=0) for k in ("qpos", "qvel"))
    qpos[..., 3:7] = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    qvel[..., :6] = [0.5, -1.0, 0.25, 2.0, 0.0, 0.0]
    frame = observe(qpos, qvel)["window"].reshape(24, H, FRAME)[0, 0]
    np.testing.assert_allclose(frame[204:210], [0.5, -1.0, 0.25, 0.0, 2.0, 0.0], atol=1e-6)
    # The rotation's 6D form is [R e_x, R e_z].
    np.testing.assert_allclose(frame[3:9], [0, 1, 0, 0, 0, 1], atol=1e-6)


def test_jointless_row_is_the_identity(observed):
    rows = observed["window"].reshape(24, H, FRAME)[..., 9:189].reshape(24, H, 30, 6)
    identity = np.array([1, 0, 0, 0, 0, 1])
    np.testing.assert_array_equal(rows[:, :, 15], np.broadcast_to(identity, (24, H, 6)))
    assert (np.abs(np.delete(rows, 15, axis=2) - identity).max(axis=(0, 1, 3)) > 0.05).all()


@pytest.mark.parametrize(("positions", "velocities"), [(35, 35), (36, 36), (37, 35), (0, 35)])
def test_wrong_shapes(robot, positions, velocities):
    qpos, qvel = np.zeros((H, positions)), np.zeros((H, velocities))
    message = f"state of {positions} positions and {velocities} velocities: robot unitree_g1 expects 36 and 35"
    for function in (features.actor_observation, features.prior_window):
        with pytest.raises(UserError, match=message):
            function(robot, qpos, qvel)


# --- the feature map -------------------------------------------------------------------------------------------------


def windows_of(array):
    """Every window ``[T - 9, 10, ...]`` of a sequence ``[T, ...]``, one by one."""
    return np.stack([array[start : start + H] for start in range(len(array) - H + 1)])


@pytest.fixture(scope="module", params=[np.float32, np.float64], ids=["float32", "float64"])
def case(request, robot, walk, observe):
    """Demonstration windows, the same disturbed, and wild states, as full windows and as compact frames."""
    rng = np.random.default_rng(0)
    qpos, qvel = windows_of(walk.qpos)[::7], windows_of(walk.qvel)[::7]
    near = qpos + 0.02 * rng.normal(size=qpos.shape), qvel + 0.5 * rng.normal(size=qvel.shape)
    wild = qpos + 0.7 * rng.normal(size=qpos.shape), qvel + 8.0 * rng.normal(size=qvel.shape)
    parts = [(qpos, qvel), near, wild]
    count = len(qpos)
    both = [np.concatenate(x) for x in zip(*parts, strict=True)]
    both[0][..., 3:7] /= np.linalg.norm(both[0][..., 3:7], axis=-1, keepdims=True)
    out = observe(*both, dtype=request.param)
    return {"dtype": request.param, "count": count, "full": out["window"], "frames": out["compact"].frame}


def full_features(windows, demonstration, floor, clip=10.0):
    """The 2,390 standardized, clipped and scaled coordinates, float64."""
    mean, deviation = demonstration.mean(0), np.maximum(demonstration.std(0), floor)
    z = np.clip((windows - mean) / deviation, -clip, clip)
    return z / np.sqrt(FULL), np.abs((windows - mean) / deviation) > clip


@pytest.mark.parametrize("floor", [1e-4, 0.05])
def test_compact_features_have_the_distances_of_the_full_ones(robot, case, floor):
    count = case["count"]
    with jax.enable_x64(case["dtype"] == np.float64):
        frames = jnp.asarray(case["frames"])
        feature_map = features.fit_feature_map(
            robot, frames[:count], FeatureConfig(deviation_floor=floor, angular_velocity_floor=floor)
        )
        compact = np.asarray(feature_map(frames), np.float64)
    full, clipped = full_features(case["full"].astype(np.float64), case["full"][:count].astype(np.float64), floor)
    assert compact.shape == (3 * count, 1170) and full.shape == (3 * count, FULL)
    # Of the wild states many coordinates are clipped, of the disturbed ones some, and most of the others not.
    assert 0.05 < clipped[2 * count :].mean() < 0.9
    assert clipped[count : 2 * count].any() and not clipped[:count].any()
    square = lambda x: ((x[:, None] - x[None, :: len(x) // 20]) ** 2).sum(-1)  # noqa: E731
    # Where a coordinate hardly moves, float32's rounding over the floor of 1e-4 is 1e-3 deviations.
    tolerance = {"rtol": 2e-3, "atol": 1e-5} if case["dtype"] == np.float32 else {"rtol": 1e-5, "atol": 1e-8}
    np.testing.assert_allclose(square(compact), square(full), **tolerance)


def test_statistics_are_the_demonstrations(robot, case):
    count, floor = case["count"], 0.05
    frames = np.asarray(case["frames"], np.float64)
    relative = frames.copy()
    relative[..., :2] -= frames[:, -1:, :2]
    with jax.enable_x64(case["dtype"] == np.float64):
        fitted = features.fit_feature_map(
            robot,
            jnp.asarray(case["frames"][:count]),
            FeatureConfig(deviation_floor=floor, angular_velocity_floor=floor),
        )
        again = np.asarray(fitted(jnp.asarray(case["frames"])))
        of_relative = np.asarray(fitted(jnp.asarray(relative, case["dtype"])))
    assert float(fitted.dimension) == FULL and float(fitted.clip) == 10.0
    mean, deviation = relative[:count].mean(0), np.maximum(relative[:count].std(0), floor)
    np.testing.assert_allclose(fitted.mean, mean, atol=2e-6)
    np.testing.assert_allclose(fitted.deviation, deviation, rtol=1e-5, atol=1e-6)
    assert (deviation == floor).mean() > 0.1 and (deviation > floor).mean() > 0.3
    # A coordinate stands once in the full frame, but sine and cosine of a hinge about y twice; of x and z once.
    about_y = robot.joint_axis[:, 1] == 1
    weight = np.ones(117)
    weight[9:38][about_y] = weight[38:67][about_y] = np.sqrt(2)
    np.testing.assert_allclose(fitted.weight, weight / np.sqrt(FULL), rtol=1e-6)
    expected = np.clip((relative - mean) / deviation, -10, 10) * weight / np.sqrt(FULL)
    np.testing.assert_allclose(again, expected.reshape(len(frames), -1), atol=1e-5)
    np.testing.assert_allclose(of_relative, again, atol=1e-5)  # making relative twice changes nothing


def test_features_ignore_where_on_the_floor_the_window_is(robot, case):
    frames = case["frames"].astype(np.float32)
    fitted = features.fit_feature_map(
        robot, jnp.asarray(frames[: case["count"]]), FeatureConfig(deviation_floor=0.05, angular_velocity_floor=0.05)
    )
    shift = np.zeros(frames.shape[-1], np.float32)
    shift[:2] = [2.0, -1.0]
    np.testing.assert_allclose(fitted(jnp.asarray(frames + shift)), fitted(jnp.asarray(frames)), atol=1e-5)
    shift[:3] = [0.0, 0.0, 0.02]
    assert np.abs(fitted(jnp.asarray(frames + shift)) - fitted(jnp.asarray(frames))).max() > 1e-3


def test_heading_axes_ignore_which_way_the_window_goes(robot, walk):
    """The whole motion turned about the vertical: the same features in heading axes, others in the world's."""
    turn, index = np.float64(0.7), np.arange(30)[:, None] + np.arange(10)
    qpos, qvel = np.array(walk.qpos[:40], np.float64), np.array(walk.qvel[:40], np.float64)
    cosine, sine = np.cos(turn), np.sin(turn)
    matrix = np.array([[cosine, -sine], [sine, cosine]])
    turned_qpos, turned_qvel = qpos.copy(), qvel.copy()
    turned_qpos[:, :2], turned_qvel[:, :2] = qpos[:, :2] @ matrix.T, qvel[:, :2] @ matrix.T
    mujoco_turn = np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)])
    for row in turned_qpos:
        mujoco.mju_mulQuat(row[3:7], mujoco_turn, row[3:7].copy())
    plain, turned = (
        features.observe(robot, jnp.asarray(a, jnp.float32), jnp.asarray(b, jnp.float32), "compact").frame[index]
        for a, b in ((qpos, qvel), (turned_qpos, turned_qvel))
    )
    own, world = (
        features.fit_feature_map(
            robot, plain, FeatureConfig(axes=axes, deviation_floor=0.05, angular_velocity_floor=0.05)
        )
        for axes in ("heading", "world")
    )
    np.testing.assert_allclose(own(turned), own(plain), atol=2e-5)
    assert np.abs(world(turned) - world(plain)).max() > 0.05
    # What a heading does not touch is what it was; the newest frame looks along x.
    start = FrameLayout.of(robot).velocity.start
    unturned = np.r_[2, 5, 8, 9:67, start + 2, start + 5, start + 6 : plain.shape[-1]]
    placed = features.turned_windows(features.relative_windows(turned), own.turned)
    np.testing.assert_array_equal(placed[..., unturned], turned[..., unturned])
    np.testing.assert_allclose(placed[:, -1, 4], 0, atol=1e-6)
    assert (placed[:, -1, 3] > 0.9).all()
    np.testing.assert_allclose(placed[:, -1, start], np.linalg.norm(qvel[index[:, -1], :2], axis=-1), atol=0.1)


def test_layout_says_where_each_quantity_stands(robot, observed, reference):
    frame, layout = observed["compact"].frame, FrameLayout.of(robot)
    qpos, qvel = reference["qpos"], reference["qvel"]
    assert frame.shape[-1] == layout.size == 117 and features.frame_size(robot) == FRAME
    full = observed["window"].reshape(24, H, FRAME)
    expected = {
        "root": qpos[..., :3],  # absolute in the history
        "rotation": full[..., 3:9],
        "cosine": np.cos(qpos[..., 7:]),
        "sine": np.sin(qpos[..., 7:]),
        "key_points": full[..., KEY_POINTS],
        "velocity": qvel[..., :3],
        "angular_velocity": full[..., 207:210],
        "joint_velocity": qvel[..., 6:],
    }
    assert tuple(expected) == FrameLayout._fields
    for name, values in expected.items():
        np.testing.assert_allclose(frame[..., getattr(layout, name)], values, atol=1e-5, err_msg=name)
    # What every robot's frames have at the same place.
    np.testing.assert_allclose(frame[..., PLANAR], qpos[..., :2], atol=1e-6)
    np.testing.assert_array_equal(frame[..., FORWARD], frame[..., layout.rotation][..., :2])


def test_float64_agrees_to_rounding(observe, reference):
    observed = observe(reference["qpos"], reference["qvel"], np.float64)
    # The reference was computed in float64.
    np.testing.assert_allclose(observed["window"], reference["prior_window"], atol=1e-6)
    np.testing.assert_allclose(observed["actor"][:, -1], reference["actor_obs"], atol=1e-6)


def test_angular_velocities_have_a_floor_of_their_own(robot, walk):
    """Joint velocities and the root's angular velocity, the last 3 + J coordinates, and nothing else."""
    frames = features.observe(robot, jnp.asarray(walk.qpos[:40]), jnp.asarray(walk.qvel[:40]), "compact").frame
    windows = frames[np.arange(30)[:, None] + np.arange(10)]
    plain = features.fit_feature_map(robot, windows, FeatureConfig())
    raised = features.fit_feature_map(robot, windows, FeatureConfig(angular_velocity_floor=0.5))
    cut = -(3 + robot.joint_count)
    np.testing.assert_array_equal(raised.deviation[:, :cut], plain.deviation[:, :cut])
    np.testing.assert_array_equal(raised.deviation[:, cut:], np.maximum(plain.deviation[:, cut:], 0.5))
    assert (np.asarray(plain.deviation[:, cut:]) < 0.5).any()
    assert (np.asarray(plain.deviation[:, cut:]) > 0.5).any()
