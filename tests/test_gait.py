"""The bundled motions: the figures that make them walks, and that the package can write them again."""

import mujoco
import numpy as np
import pytest

from fmpjax import cli, motion, robots, rotations
from fmpjax.errors import UserError
from fmpjax.motion import gait, soles

STRIDE = 54  # samples


@pytest.fixture(scope="module")
def figures(robot, walk):
    return gait.measure(robot, walk)


def test_bundled_file_is_what_the_package_writes(robot, walk):
    again = gait.synthesize(robot)
    np.testing.assert_allclose(again.qpos, walk.qpos, atol=1e-4)
    np.testing.assert_allclose(again.qvel, walk.qvel, atol=1e-2)


@pytest.mark.parametrize(
    ("figure", "low", "high"),
    [
        ("speed", 0.80, 0.90),
        ("cadence", 1.7, 1.95),
        ("height_min", 0.74, 0.76),
        ("height_max", 0.77, 0.79),
        ("range_left_hip", 35, 45),
        ("range_right_hip", 35, 45),
        ("range_left_knee", 50, 62),
        ("range_right_knee", 50, 62),
        ("range_left_ankle", 25, 30),
        ("range_right_ankle", 25, 30),
        ("slip", 0, 0.005),
        ("penetration", 0, 0.005),
        ("gap", 0, 0.005),
        ("clearance", 0.015, 0.05),
        ("limit_margin", 0.1, np.inf),
        ("joint_speed", 3, 9),
        ("joint_acceleration", 0, 160),
        ("double_support", 0.15, 0.25),
        ("lateral", 0.02, 0.04),
        ("balance", 0, 0.015),
    ],
)
def test_figures_of_the_bundled_walk(figures, figure, low, high):
    assert low <= figures[figure] <= high, f"{figure} is {figures[figure]:.4g}"


def test_every_stride_is_the_first_one_moved_on(walk):
    turns = (len(walk) - 1) // STRIDE
    assert turns * STRIDE == len(walk) - 1
    for turn in range(1, turns):
        later = walk.qpos[turn * STRIDE : (turn + 1) * STRIDE].copy()
        later[:, 0] -= turn * 0.85 * STRIDE / 50
        np.testing.assert_allclose(later, walk.qpos[:STRIDE], atol=1e-12)
    np.testing.assert_allclose(walk.qpos[-1, 1:], walk.qpos[0, 1:], atol=1e-12)


def test_right_leg_mirrors_the_left_one(robot, walk):
    left, right = (walk.qpos[:, 7 + robot.sagittal_joints[side]] for side in (slice(0, 3), slice(3, 6)))
    # The arms' and trunk's masses are not quite symmetric, which moves the pelvis by less than a millimetre.
    np.testing.assert_allclose(right[STRIDE // 2 : STRIDE], left[: STRIDE // 2], atol=5e-3)


def test_arms_swing_against_the_legs(robot, walk):
    hip, shoulder = (
        walk.qpos[:, 7 + robot.joint_names.index(f"left_{joint}_pitch_joint")] for joint in ("hip", "shoulder")
    )
    # Both angles grow backward.
    assert np.corrcoef(hip, shoulder)[0, 1] < -0.6


def test_heel_lands_first_and_toe_leaves_last(robot, walk):
    points, _ = soles.sole_points(robot, walk.qpos[:STRIDE])
    left = robot.sole_body == robot.sole_body[0]
    height = (points[:, :, 2] - robot.sole_radius)[:, left]
    heel = robot.sole_point[left, 0] < 0
    low = height < 0.002
    landing, leaving = low[0], low[np.flatnonzero(low[: STRIDE * 3 // 4].any(axis=1))[-1]]
    assert landing[heel].all()
    assert not landing[~heel].any()
    assert leaving[~heel].all()
    assert not leaving[heel].any()
    assert low[STRIDE // 4].all()  # flat in mid-stance


def test_robot_touches_nothing_but_the_floor(robot, walk):
    data = mujoco.MjData(robot.model)
    feet = {0, *(robot.sole_body + 1).tolist()}
    for row in walk.qpos[:STRIDE:3]:
        data.qpos[:] = row
        mujoco.mj_forward(robot.model, data)
        assert {int(robot.model.geom_bodyid[g]) for c in data.contact for g in c.geom} <= feet


def test_ground_carries_the_weight(robot, walk):
    """Over a stride the ground's push averages to the weight, and never leaves the range of a walk."""
    _, force = gait._ground_force(robot, walk.qpos[:STRIDE], 50.0, 0.85 * STRIDE / 50)
    weight = robot.total_mass * gait.GRAVITY
    np.testing.assert_allclose(force.mean(axis=0) / weight, [0, 0, 1], atol=2e-3)
    assert 0.6 < force[:, 2].min() / weight < force[:, 2].max() / weight < 1.4
    assert np.abs(force[:, :2]).max() / weight < 0.35  # a friction coefficient that any floor has


def test_zero_moment_point_of_a_standing_robot_is_under_its_mass(robot):
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.default_qpos
    mujoco.mj_forward(robot.model, data)
    still = np.tile(robot.default_qpos, (5, 1))
    found = gait.zero_moment_point(robot, still, 50.0, 0.0)
    np.testing.assert_allclose(found, np.tile(data.subtree_com[1, :2], (5, 1)), atol=1e-9)


def test_figures_notice_a_bad_walk(robot, walk):
    """Each figure is worth its name: a sunk, slid or jerked clip fails."""
    sunk = walk.qpos.copy()
    sunk[:, 2] -= 0.01
    assert gait.measure(robot, _clip(walk, sunk))["penetration"] == pytest.approx(0.01, abs=1e-4)
    slid = walk.qpos.copy()
    slid[:, 0] *= 1.1
    assert gait.measure(robot, _clip(walk, slid))["slip"] > 0.02
    raised = walk.qpos.copy()
    raised[:, 2] += 0.01
    assert gait.measure(robot, _clip(walk, raised))["gap"] == pytest.approx(0.01, abs=1e-4)
    jerked = walk.qpos.copy()
    jerked[100, 10] += 0.2
    assert gait.measure(robot, _clip(walk, jerked))["joint_acceleration"] > 200


def _clip(walk, qpos):
    return motion.MotionClip.from_qpos(walk.name, walk.robot, walk.rate, qpos)


# --- the library -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["turn_left", *(pytest.param(name, marks=pytest.mark.slow) for name in ("slow_walk", "fast_walk", "turn_right"))],
)
def test_library_is_what_the_package_writes(robot, name):
    again, bundled = gait.synthesize(robot, **gait.LIBRARY["unitree_g1"][name]), motion.load(name)
    np.testing.assert_allclose(again.qpos, bundled.qpos, atol=1e-4)


def test_library_is_what_is_bundled():
    names = [*gait.LIBRARY["unitree_g1"], *(f"strider_{name}" for name in gait.LIBRARY["strider"])]
    assert motion.bundled() == sorted(names) and sorted(gait.LIBRARY) == robots.available()


@pytest.mark.parametrize(
    ("name", "speed", "turn", "cadence"),
    [
        ("slow_walk", 0.5, 0.0, 1.39),
        ("walk", 0.85, 0.0, 1.85),
        ("fast_walk", 1.1, 0.0, 2.08),
        # The root is on the inner side of the path, on which the feet are.
        ("turn_left", 0.68, 0.5, 1.85),
        ("turn_right", 0.68, -0.5, 1.85),
    ],
)
def test_figures_of_the_library(robot, name, speed, turn, cadence):
    figures = gait.measure(robot, motion.load(name))
    assert figures["speed"] == pytest.approx(speed, abs=0.003)
    assert figures["turn"] == pytest.approx(turn, abs=1e-6)
    assert figures["cadence"] == pytest.approx(cadence, abs=0.02)
    for figure, low, high in (
        ("height_min", 0.71, 0.76),
        ("height_max", 0.75, 0.79),
        ("slip", 0, 0.005),
        ("penetration", 0, 0.001),
        ("gap", 0, 0.001),
        ("clearance", 0.02, 0.04),
        ("limit_margin", 0.1, np.inf),
        ("joint_speed", 3, 9),
        ("joint_acceleration", 0, 180),
        ("double_support", 0.15, 0.3),
        ("lateral", 0.02, 0.045),
        ("balance", 0, 0.015),
    ):
        assert low <= figures[figure] <= high, f"{figure} is {figures[figure]:.4g}"


def test_library_touches_nothing_but_the_floor(robot):
    data = mujoco.MjData(robot.model)
    feet = {0, *(robot.sole_body + 1).tolist()}
    for name in gait.LIBRARY["unitree_g1"]:
        for row in motion.load(name).qpos[:70:3]:
            data.qpos[:] = row
            mujoco.mj_forward(robot.model, data)
            assert {int(robot.model.geom_bodyid[g]) for c in data.contact for g in c.geom} <= feet


# --- turning ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def turning():
    return motion.load("turn_left")


@pytest.fixture(scope="module")
def centre(turning):
    """Centre of the path: the point about which a stride turns."""
    start, end = turning.qpos[0, :2], turning.qpos[STRIDE, :2]
    angle = 0.5 * STRIDE / 50
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s], [s, c]])
    return np.linalg.solve(np.eye(2) - rotation, end - rotation @ start)


def test_every_turning_stride_is_the_first_one_turned(turning, centre):
    turn_wxyz = rotations.exp_map(np.array([0.0, 0.0, 0.5 * STRIDE / 50]))
    first, later = turning.qpos[:STRIDE], turning.qpos[STRIDE : 2 * STRIDE]
    middle = np.append(centre, 0.0)
    np.testing.assert_allclose(later[:, :3], middle + rotations.rotate(turn_wxyz, first[:, :3] - middle), atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(later[:, 3:7] * rotations.multiply(turn_wxyz, first[:, 3:7]), axis=1)), 1)
    np.testing.assert_allclose(later[:, 7:], first[:, 7:], atol=1e-9)


def test_feet_stand_on_arcs_beside_the_path(robot, turning, centre):
    """Path of 0.7 m/s at 0.5 rad/s to the left: 1.4 m around; each foot stands half the width inside or outside."""
    data = mujoco.MjData(robot.model)
    left, right = dict.fromkeys((robot.sole_body + 1).tolist())
    for at, foot, radius in ((STRIDE // 4, left, 1.4 - 0.085), (STRIDE * 3 // 4, right, 1.4 + 0.085)):
        data.qpos[:] = turning.qpos[at]
        mujoco.mj_kinematics(robot.model, data)
        assert np.linalg.norm(data.xpos[foot, :2] - centre) == pytest.approx(radius, abs=1e-4)


def test_right_turn_mirrors_the_left_one(robot, turning):
    other = motion.load("turn_right")
    left, right = slice(0, 3), slice(3, 6)
    joints = turning.qpos[:, 7 + robot.sagittal_joints], other.qpos[:, 7 + robot.sagittal_joints]
    half = STRIDE // 2
    np.testing.assert_allclose(joints[1][half:STRIDE, right], joints[0][:half, left], atol=5e-3)
    np.testing.assert_allclose(joints[1][half:STRIDE, left], joints[0][:half, right], atol=5e-3)


def test_ground_pushes_toward_the_centre(robot, turning, centre):
    """Over a stride the push, seen from the walker, is the weight and what holds the mass on its circle."""
    period = STRIDE / 50
    _, force = gait._ground_force(robot, turning.qpos[:STRIDE], 50.0, 0.7 * period, 0.5 * period)
    data, inward = mujoco.MjData(robot.model), np.zeros((STRIDE, 3))
    for i, row in enumerate(turning.qpos[:STRIDE]):
        data.qpos[:] = row
        mujoco.mj_forward(robot.model, data)
        inward[i, :2] = centre - data.subtree_com[1, :2]
    expected = robot.total_mass * 0.5**2 * np.mean(np.linalg.norm(inward, axis=1))
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    assert np.mean(np.sum(force * inward, axis=1)) == pytest.approx(expected, rel=0.05)
    assert force[:, 2].mean() / (robot.total_mass * gait.GRAVITY) == pytest.approx(1, abs=2e-3)


# --- arguments -------------------------------------------------------------------------------------------------------


def test_other_speeds_and_rates(robot):
    slow = gait.measure(robot, gait.synthesize(robot, speed=0.7, duration=3.0))
    assert slow["speed"] == pytest.approx(0.7)
    assert slow["slip"] < 0.005
    fine = gait.synthesize(robot, duration=3.0, rate=100.0)
    assert fine.rate == 100.0
    assert gait.measure(robot, fine)["joint_speed"] < 9


def test_faults(robot):
    with pytest.raises(UserError, match="speed is -1, expected a positive number of m/s"):
        gait.synthesize(robot, speed=-1)
    with pytest.raises(UserError, match="rate is nan, expected a positive number of Hz"):
        gait.synthesize(robot, rate=float("nan"))
    with pytest.raises(UserError, match="duration is 0.5 s, expected at least one stride of 1.08 s"):
        gait.synthesize(robot, duration=0.5)
    with pytest.raises(UserError, match="out of the legs' reach"):
        gait.synthesize(robot, speed=2.0, duration=2.0)
    with pytest.raises(UserError, match="out of the legs' reach"):
        gait.synthesize(robot, turn=2.0)
    with pytest.raises(UserError, match="turn is inf, expected a finite number"):
        gait.synthesize(robot, turn=float("inf"))
    with pytest.raises(UserError, match="duration is 1000000000.0 s, expected at most 200000 s at 50 Hz"):
        gait.synthesize(robot, duration=1e9)
    with pytest.raises(UserError, match="cadence is 0, expected a positive number of steps/s"):
        gait.synthesize(robot, style=gait.Style(cadence=0))
    with pytest.raises(UserError, match="elbow is nan, expected a finite number"):
        gait.synthesize(robot, style=gait.Style(elbow=float("nan")))
    with pytest.raises(UserError, match="the style's phases are flat 0.087, heel_off 0.6.*: expected growing numbers"):
        gait.synthesize(robot, style=gait.Style(heel_off=0.6))


def synthesize(out, options):
    cli.main(["motion", "synthesize", "--out", str(out), *options.split()])


def test_command_writes_the_file(robot, tmp_path):
    synthesize(tmp_path / "walk.npz", "--duration 1.1")
    assert len(motion.load(tmp_path / "walk.npz")) == STRIDE + 1


def test_command_has_the_turn_and_the_style(robot, tmp_path):
    out = tmp_path / "turn.npz"
    synthesize(out, "--speed 0.6 --turn -0.3 --duration 3.3 --step-height 0.05 --style.pelvis-height 0.75")
    figures = gait.measure(robot, motion.load(out))
    assert figures["turn"] == pytest.approx(-0.3)
    assert figures["clearance"] > 0.033
    assert figures["height_min"] < 0.74


def test_command_says_what_is_wrong(tmp_path, capsys):
    out = tmp_path / "turn.npz"
    with pytest.raises(SystemExit) as caught:
        synthesize(out, "--speed -1")
    assert caught.value.code == 2
    assert capsys.readouterr().err == "fmpjax: speed is -1.0, expected a positive number of m/s\n"
    assert not out.exists()
