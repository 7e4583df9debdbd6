"""A second robot, with other joints in another order, no arms and no waist: nothing is tied to the first."""

import json

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from fmpjax import cli, features, kinematics, motion, robots, runs
from fmpjax.errors import UserError
from fmpjax.motion import check, edit, gait, retarget
from tests.helpers import TINY, settings

JOINTS, KEYS = 12, 3


@pytest.fixture(scope="module")
def strider():
    return robots.load("strider")


@pytest.fixture(scope="module")
def clip():
    return motion.load("walk", robot="strider")


# --- the model -------------------------------------------------------------------------------------------------------


def test_the_model(strider):
    assert strider.joint_count == JOINTS and strider.jointless_row is None and not strider.landmarks
    model = strider.model
    assert strider.total_mass == pytest.approx(5.2 + 2 * (0.45 + 0.5 + 1.1 + 0.7 + 0.12 + 0.4))
    # Servos of 10 Hz, twice critically damped, on the rotor's inertia alone.
    omega, armature = 2 * np.pi * 10, model.dof_armature[6:]
    np.testing.assert_allclose(strider.stiffness, armature * omega**2, rtol=1e-4)
    np.testing.assert_allclose(strider.damping, 4 * armature * omega, rtol=1e-4)
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], np.arange(1, 1 + JOINTS))
    np.testing.assert_allclose(robots.lowest_sole(strider, strider.default_qpos), -robots.CONTACT_DEPTH, atol=1e-12)


def test_the_model_is_its_own_mirror_image(strider):
    order, sign = edit.joint_mirror(strider)
    assert sign.tolist() == 2 * [-1, -1, 1, 1, 1, -1]  # yaw, roll, pitch, knee, ankle pitch, ankle roll
    low, high = strider.joint_low * sign, strider.joint_high * sign
    np.testing.assert_allclose(np.minimum(low, high), strider.joint_low[order])
    for values in (strider.effort, strider.stiffness):
        np.testing.assert_allclose(values, values[order])
    pose = strider.default_qpos[7:]
    np.testing.assert_allclose(pose, sign * pose[order])
    names = [strider.model.body(i).name for i in range(1, strider.model.nbody)]
    for left, right in ((n, n.replace("left", "right")) for n in names if n.startswith("left")):
        one, other = strider.model.body(left), strider.model.body(right)
        np.testing.assert_allclose([*one.mass, *one.inertia], [*other.mass, *other.inertia])
        np.testing.assert_allclose(one.pos, other.pos * [1, -1, 1])


def test_it_stands_on_its_servos(strider):
    """Two seconds at the default pose: it sags a little and keeps upright, so limits and servos are enough."""
    model = strider.physics_model(timestep=0.005)
    data = mujoco.MjData(model)
    data.qpos[:] = strider.default_qpos
    data.ctrl[:] = strider.default_qpos[7:]
    for _ in range(60):
        mujoco.mj_step(model, data)
    assert data.qpos[2] > 0.9 * strider.default_qpos[2]
    assert np.abs(data.actuator_force).max() < strider.effort.min()


# --- sizes, kinematics, physics --------------------------------------------------------------------------------------


def test_sizes_follow_from_the_robot(strider, clip):
    qpos, qvel = jnp.asarray(clip.qpos[:10]), jnp.asarray(clip.qvel[:10])
    rows = 6 * JOINTS  # no body without a joint
    assert features.frame_size(strider) == 3 + 6 + rows + 3 * KEYS + 3 + 3 + JOINTS
    assert features.prior_window(strider, qpos, qvel).shape == (10 * features.frame_size(strider),)
    assert features.actor_observation(strider, qpos, qvel).shape == (10, 1 + 6 + 3 + 3 + rows + JOINTS + 3 * KEYS)
    # The compact frame keeps every distance of the full one.
    frames = features.observe(strider, qpos, qvel, "full").frame
    full = features.prior_window(strider, qpos[None], qvel[None])[0].reshape(10, -1)
    weight = features.compact_weights(strider)
    a, b = features.relative_windows(frames) * weight, full
    np.testing.assert_allclose(jnp.linalg.norm(a[0] - a[5]), jnp.linalg.norm(b[0] - b[5]), rtol=1e-5)


def test_kinematics_are_mujocos(strider, clip):
    data = mujoco.MjData(strider.model)
    poses = kinematics.body_poses(strider, jnp.asarray(clip.qpos[::40], jnp.float32))
    for i, row in enumerate(clip.qpos[::40]):
        data.qpos[:] = row
        mujoco.mj_kinematics(strider.model, data)
        np.testing.assert_allclose(poses.position[i], data.xpos[1:], atol=1e-5)


# --- its walk --------------------------------------------------------------------------------------------------------


def test_its_walk(strider, clip):
    figures = gait.measure(strider, clip)
    assert figures["turn"] == pytest.approx(0, abs=1e-6)
    assert figures["cadence"] == pytest.approx(2.1, abs=0.05)
    for figure, low, high in (
        ("speed", 0.44, 0.48),
        ("slip", 0, 0.003),
        ("penetration", 0.0009, 0.0011),
        ("gap", -0.0011, -0.0009),
        ("clearance", 0.01, 0.03),
        ("limit_margin", 0.02, np.inf),
        ("balance", 0, 0.01),
    ):
        assert low <= figures[figure] <= high, f"{figure} is {figures[figure]:.4g}"
    assert {f.verdict for f in check.check(strider, clip)} == {"good"}


def test_its_walk_is_what_the_package_writes(strider, clip):
    again = gait.synthesize(strider, **gait.LIBRARY["strider"]["walk"])
    np.testing.assert_allclose(again.qpos, clip.qpos, atol=1e-4)


def test_a_style_is_the_robots_where_it_is_not_named(strider, robot):
    assert gait.Style().on(strider).pelvis_height == strider.gait["pelvis_height"]
    named = gait.Style(swing_lift=0.03).on(strider)
    assert named.swing_lift == 0.03 and named.half_width == strider.gait["half_width"]
    # What is asked for counts, another robot's own number too; what nobody names is zero.
    assert gait.Style(half_width=robot.gait["half_width"]).on(strider).half_width == robot.gait["half_width"]
    assert gait.Style().on(strider).elbow == 0 and gait.Style().on(robot).elbow == robot.gait["elbow"]


# --- the wrong robot -------------------------------------------------------------------------------------------------


def test_a_motion_of_another_robot_is_refused_by_name():
    with pytest.raises(UserError, match=r"strider_walk.npz: the motion is for robot 'strider', expected 'unitree_g1'"):
        motion.load("strider_walk")
    with pytest.raises(UserError, match=r"turn_left.npz: the motion is for robot 'unitree_g1', expected 'strider'"):
        motion.load("turn_left", robot="strider")


def test_it_has_nothing_that_stands_for_a_humans_body(strider):
    with pytest.raises(UserError, match="robot 'strider' has no landmark 'pelvis' in its robot.toml"):
        retarget.retarget(None, strider, "walk")


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A tiny run from the command line, which finds the robot's own walk."""
    folder = tmp_path_factory.mktemp("strider") / "run"
    changes = TINY | {"transitions": 128, "evaluations": (1.0,)}
    cli.main(["train", "--preset", "smoke", "--robot", "strider", "--run", str(folder), *settings(changes)])
    return folder


@pytest.mark.slow
def test_it_trains(trained, strider):
    found = json.loads((trained / "evaluation.json").read_text())
    assert found["episodes"] == 4 and found["demonstration_speed"] == pytest.approx(0.467, abs=0.01)
    assert (trained / "policy.mp4").stat().st_size > 1000
    trainer, state = runs.Run.open(trained).policy()
    assert trainer.robot is strider and trainer.expert.windows.shape[1] == 10 * len(features.compact_weights(strider))
    assert int(state.iteration) == 2


@pytest.mark.slow
def test_a_run_of_another_robot_is_refused_by_name(trained, capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(["train", "--resume", "--robot", "unitree_g1", "--run", str(trained)])
    assert stop.value.code == 2
    assert "has robot 'strider': it cannot continue with 'unitree_g1'" in capsys.readouterr().err
    # A policy moved to another robot: the run's own demonstration tells.
    path = trained / "config.json"
    text = path.read_text()
    path.write_text(text.replace('"strider"', '"unitree_g1"'))
    try:
        with pytest.raises(SystemExit) as stop:
            cli.main(["evaluate", str(trained)])
        assert stop.value.code == 2
        assert "the motion is for robot 'strider', expected 'unitree_g1'" in capsys.readouterr().err
    finally:
        path.write_text(text)
