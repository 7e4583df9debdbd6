"""Walks of our own: the bundled ones, the figures that make them walks, and gaits at any velocity."""

import dataclasses
import functools

import mujoco
import numpy as np
import pytest

from fmpjax import cli, motion, robots, rotations
from fmpjax.errors import UserError
from fmpjax.motion import balance, check, edit, gait, soles

STRIDE = 54  # samples


@pytest.fixture(scope="module")
def strider():
    return robots.load("strider")


@pytest.fixture(scope="module")
def figures(robot, walk):
    return gait.measure(robot, walk)


def test_bundled_file_is_what_the_package_writes(robot, walk):
    again = gait.synthesize(robot)
    # Newton's method stops 1e-10 from the solution, one step earlier or later as the rounding may be.
    np.testing.assert_allclose(again.qpos, walk.qpos, atol=2e-9)
    np.testing.assert_allclose(again.qvel, walk.qvel, atol=1e-6)


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
        ("penetration", 0.0009, 0.0011),
        ("gap", -0.0011, -0.0009),
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
    # The arms' and trunk's masses are not quite symmetric, which moves the pelvis by less than a millimeter.
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
    _, force = balance.ground_force(robot, walk.qpos[:STRIDE], 50.0, np.array([0.85 * STRIDE / 50, 0.0]))
    weight = robot.total_mass * balance.GRAVITY
    np.testing.assert_allclose(force.mean(axis=0) / weight, [0, 0, 1], atol=2e-3)
    assert 0.6 < force[:, 2].min() / weight < force[:, 2].max() / weight < 1.4
    assert np.abs(force[:, :2]).max() / weight < 0.35  # a friction coefficient that any floor has


def test_zero_moment_point_of_a_standing_robot_is_under_its_mass(robot):
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.default_qpos
    mujoco.mj_forward(robot.model, data)
    still = np.tile(robot.default_qpos, (5, 1))
    found = balance.zero_moment_point(robot, still, 50.0, np.zeros(2))
    np.testing.assert_allclose(found, np.tile(data.subtree_com[1, :2], (5, 1)), atol=1e-9)


def test_figures_notice_a_bad_walk(robot, walk):
    """Each figure is worth its name: a sunk, slid or jerked clip fails."""
    sunk = walk.qpos.copy()
    sunk[:, 2] -= 0.01
    assert gait.measure(robot, _clip(walk, sunk))["penetration"] == pytest.approx(0.01 + robots.CONTACT_DEPTH, abs=1e-4)
    slid = walk.qpos.copy()
    slid[:, 0] *= 1.1
    assert gait.measure(robot, _clip(walk, slid))["slip"] > 0.02
    raised = walk.qpos.copy()
    raised[:, 2] += 0.01
    assert gait.measure(robot, _clip(walk, raised))["gap"] == pytest.approx(0.01 - robots.CONTACT_DEPTH, abs=1e-4)
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
    np.testing.assert_allclose(again.qpos, bundled.qpos, atol=2e-9)


def test_library_is_what_is_bundled():
    names = [*gait.LIBRARY["unitree_g1"], *(f"strider_{name}" for name in gait.LIBRARY["strider"])]
    walking = [name for name in robots.available() if robots.load(name).gait]
    assert motion.bundled() == sorted(names) and sorted(gait.LIBRARY) == walking


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
        ("penetration", 0.0009, 0.0011),
        ("gap", -0.0011, -0.0009),
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
def center(turning):
    """Center of the path: the point about which a stride turns."""
    start, end = turning.qpos[0, :2], turning.qpos[STRIDE, :2]
    angle = 0.5 * STRIDE / 50
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s], [s, c]])
    return np.linalg.solve(np.eye(2) - rotation, end - rotation @ start)


def test_every_turning_stride_is_the_first_one_turned(turning, center):
    turn_wxyz = rotations.exp_map(np.array([0.0, 0.0, 0.5 * STRIDE / 50]))
    first, later = turning.qpos[:STRIDE], turning.qpos[STRIDE : 2 * STRIDE]
    middle = np.append(center, 0.0)
    np.testing.assert_allclose(later[:, :3], middle + rotations.rotate(turn_wxyz, first[:, :3] - middle), atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(later[:, 3:7] * rotations.multiply(turn_wxyz, first[:, 3:7]), axis=1)), 1)
    np.testing.assert_allclose(later[:, 7:], first[:, 7:], atol=1e-9)


def test_feet_stand_on_arcs_beside_the_path(robot, turning, center):
    """Path of 0.7 m/s at 0.5 rad/s to the left: 1.4 m around; each foot stands half the width inside or outside."""
    data = mujoco.MjData(robot.model)
    left, right = dict.fromkeys((robot.sole_body + 1).tolist())
    for at, foot, radius in ((STRIDE // 4, left, 1.4 - 0.085), (STRIDE * 3 // 4, right, 1.4 + 0.085)):
        data.qpos[:] = turning.qpos[at]
        mujoco.mj_kinematics(robot.model, data)
        assert np.linalg.norm(data.xpos[foot, :2] - center) == pytest.approx(radius, abs=1e-4)


def test_right_turn_mirrors_the_left_one(robot, turning):
    other = motion.load("turn_right")
    left, right = slice(0, 3), slice(3, 6)
    joints = turning.qpos[:, 7 + robot.sagittal_joints], other.qpos[:, 7 + robot.sagittal_joints]
    half = STRIDE // 2
    np.testing.assert_allclose(joints[1][half:STRIDE, right], joints[0][:half, left], atol=5e-3)
    np.testing.assert_allclose(joints[1][half:STRIDE, left], joints[0][:half, right], atol=5e-3)


def test_ground_pushes_toward_the_center(robot, turning, center):
    """Over a stride the push, seen from the walker, is the weight and what holds the mass on its circle."""
    period = STRIDE / 50
    _, force = balance.ground_force(robot, turning.qpos[:STRIDE], 50.0, np.array([0.7 * period, 0.0]), 0.5 * period)
    data, inward = mujoco.MjData(robot.model), np.zeros((STRIDE, 3))
    for i, row in enumerate(turning.qpos[:STRIDE]):
        data.qpos[:] = row
        mujoco.mj_forward(robot.model, data)
        inward[i, :2] = center - data.subtree_com[1, :2]
    expected = robot.total_mass * 0.5**2 * np.mean(np.linalg.norm(inward, axis=1))
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    assert np.mean(np.sum(force * inward, axis=1)) == pytest.approx(expected, rel=0.05)
    assert force[:, 2].mean() / (robot.total_mass * balance.GRAVITY) == pytest.approx(1, abs=2e-3)


# --- any velocity ----------------------------------------------------------------------------------------------------

COARSE = [(1.1, 0.0, 0.0), (0.7, 0.0, 0.5), (0.0, 0.4, 0.0), (-0.5, 0.0, 0.0), (0.0, 0.0, 0.6), (0.0, 0.0, 0.0)]
FINE = [
    *((speed, 0.0, turn) for speed in (0.2, 0.5, 0.9, 1.3) for turn in (-0.6, 0.3, 0.6)),
    *((0.0, sideways, 0.0) for sideways in (-0.4, -0.1, 0.2)),
    *((-0.3, 0.0, turn) for turn in (-0.6, 0.3)),
    (0.6, 0.3, 0.3),
    (-0.4, -0.3, 0.4),
    (0.0, 0.4, -0.6),
]


@pytest.fixture(scope="module")
def gaits(robot):
    """A function from a command to its gait, each made once."""
    return functools.cache(lambda *command: gait.make(robot, gait.Command(*command)))


@pytest.mark.parametrize("command", [*COARSE, *(pytest.param(command, marks=pytest.mark.slow) for command in FINE)])
def test_a_gait_has_its_velocity_and_its_quality(robot, gaits, command):
    found = gaits(*command)
    clip = found.clip(5.0)
    figures = gait.measure(robot, clip)
    speed, sideways, turn = command
    for name, wanted in (("speed", speed), ("sideways", sideways)):
        assert figures[name] == pytest.approx(wanted, abs=0.01 * max(0.2, np.hypot(speed, sideways))), name
    assert figures["turn"] == pytest.approx(turn, abs=1e-6)
    for figure, low, high in (
        ("slip", 0, 0.005),
        ("penetration", 0.0009, 0.0011),
        ("gap", -0.0011, -0.0009),
        ("clearance", 0.015, np.inf),
        ("limit_margin", 0.03, np.inf),
        ("joint_speed", 0, 10),
        ("joint_acceleration", 0, 250),
        ("balance", 0, 0.017),
    ):
        assert low <= figures[figure] <= high, f"{figure} is {figures[figure]:.4g}"
    verdicts = {figure.name: figure for figure in check.check(robot, clip)}
    assert {figure.verdict for figure in verdicts.values()} == {"good"}
    assert verdicts["loop gap"].value < 1e-9
    assert np.abs(clip.qpos[:, 7 + robot.sagittal_joints[[1, 4]]]).min() > 0.15
    if any(command):
        assert 0.8 <= figures["cadence"] <= 2.6
        assert figures["cadence"] == pytest.approx(found.style.cadence, rel=0.03)


def test_standing_is_still_and_upright_over_the_feet(robot, gaits):
    qpos = gaits(0.0, 0.0, 0.0).qpos
    np.testing.assert_allclose(qpos, np.tile(qpos[0], (len(qpos), 1)), atol=1e-9)
    points, _ = soles.sole_points(robot, qpos[:1])
    pressed = balance.zero_moment_point(robot, qpos, 50.0, np.zeros(2))[0]
    assert (points[0, :, :2].min(axis=0) + 0.03 < pressed).all() and (
        pressed < points[0, :, :2].max(axis=0) - 0.03
    ).all()


def test_feet_step_on_the_spot_where_they_are_lifted(robot):
    clip = gait.synthesize(robot, speed=0.0, duration=3.0, style=gait.Style(swing_lift=0.04))
    figures = gait.measure(robot, clip)
    assert figures["clearance"] > 0.015 and abs(figures["speed"]) < 1e-6 and figures["cadence"] > 1.7


@pytest.mark.parametrize("command", [(0.0, 0.4, 0.0), pytest.param((0.7, 0.0, 0.5), marks=pytest.mark.slow)])
def test_the_mirrored_command_has_the_mirrored_gait(robot, gaits, command):
    speed, sideways, turn = command
    one, other = gaits(*command), gaits(speed, -sideways, -turn)
    assert one.style == dataclasses.replace(other.style, bank=-other.style.bank)
    mirrored = edit.mirrored(robot, other.clip(3.0)).qpos[len(one.qpos) // 2 :, 7:]
    # The arms' and trunk's masses are not quite symmetric.
    np.testing.assert_allclose(mirrored[: len(one.qpos)], one.qpos[:, 7:], atol=8e-3)


def test_feet_pass_each_other_in_steps_aside(robot, gaits):
    points, _ = soles.sole_points(robot, gaits(0.0, 0.4, 0.0).qpos)
    left = robot.sole_body == robot.feet[0]
    across = points[:, left, 1].min(axis=1) - points[:, ~left, 1].max(axis=1)
    assert across.min() - 2 * robot.sole_radius[0] > 0.025


def test_given_numbers_win_over_chosen_ones(robot):
    style = gait.Style(cadence=2.3, swing_lift=0.05)
    found = gait.make(robot, gait.Command(1.2), style=style)
    assert (found.style.cadence, found.style.swing_lift) == (2.3, 0.05)
    assert found.style.pelvis_height < robot.gait["pelvis_height"] and "pelvis_height" in found.chosen
    assert not {"cadence", "swing_lift"} & set(found.chosen)
    assert f"pelvis_height {found.style.pelvis_height:.4g}" in found.said()


def test_given_numbers_that_the_robots_own_complete_are_that_walk(robot):
    found = gait.make(robot, gait.Command(0.5), style=gait.Style(swing_lift=0.05))
    assert found.style == gait.Style(swing_lift=0.05).on(robot) and not found.chosen


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        ({"speed": 3.0}, "speed 3 m/s is out of the legs' reach: expected at most about speed 1"),
        (
            {"speed": 0.0, "sideways": -2.0},
            "sideways -2 m/s is out of the legs' reach: expected at most about sideways -0",
        ),
        ({"turn": 1e12}, r"speed 0.85 m/s, turn 1e\+12 rad/s is out of the legs' reach: expected at most about speed"),
        (
            {"speed": 0.5, "style": gait.Style(pelvis_height=2.0)},
            "speed 0.5 m/s is out of the legs' reach with this style",
        ),
    ],
)
def test_what_the_legs_cannot_reach_is_refused_with_what_they_can(robot, options, wanted):
    with pytest.raises(UserError, match=f"^{wanted}"):
        gait.synthesize(robot, **options)


def test_a_robot_without_a_walk_is_told_whose_it_takes():
    with pytest.raises(UserError, match=r"'unitree_g1_29dof' has no \[gait\] .*; it takes the walks of unitree_g1$"):
        gait.synthesize(robots.load("unitree_g1_29dof"))


def test_another_robot_steps_aside_too(strider):
    figures = gait.measure(strider, gait.make(strider, gait.Command(0.0, 0.2, 0.2)).clip(4.0))
    assert figures["sideways"] == pytest.approx(0.2, abs=0.002) and figures["slip"] < 0.005


# --- arguments -------------------------------------------------------------------------------------------------------


def test_other_speeds_and_rates(robot):
    slow = gait.measure(robot, gait.synthesize(robot, speed=0.7, duration=3.0))
    assert slow["speed"] == pytest.approx(0.7)
    assert slow["slip"] < 0.005
    fine = gait.synthesize(robot, duration=3.0, rate=100.0)
    assert fine.rate == 100.0
    assert gait.measure(robot, fine)["joint_speed"] < 9


def test_faults(robot):
    with pytest.raises(UserError, match="rate is nan, expected a positive number of Hz"):
        gait.synthesize(robot, rate=float("nan"))
    with pytest.raises(UserError, match="duration is 0.5 s, expected at least one stride of 1.08 s"):
        gait.synthesize(robot, duration=0.5)
    with pytest.raises(UserError, match="turn is inf, expected a finite number"):
        gait.synthesize(robot, turn=float("inf"))
    with pytest.raises(UserError, match="sideways is nan, expected a finite number"):
        gait.synthesize(robot, sideways=float("nan"))
    with pytest.raises(UserError, match="duration is -1, expected a positive number of s"):
        gait.synthesize(robot, duration=-1)
    with pytest.raises(UserError, match="duration is 1000000000.0 s, expected at most 200000 s at 50 Hz"):
        gait.synthesize(robot, duration=1e9)
    with pytest.raises(UserError, match="cadence is 0, expected a positive number of steps/s"):
        gait.synthesize(robot, style=gait.Style(cadence=0))
    with pytest.raises(UserError, match="elbow is nan, expected a finite number"):
        gait.synthesize(robot, style=gait.Style(elbow=float("nan")))
    with pytest.raises(
        UserError, match="the style's phases are flat 0.087, heel_off 0.6.*: expected increasing numbers"
    ):
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


def test_command_steps_aside_and_says_what_it_chose(robot, tmp_path, capsys):
    out = tmp_path / "aside.npz"
    synthesize(out, "--speed 0 --sideways -0.2 --duration 3")
    assert gait.measure(robot, motion.load(out))["sideways"] == pytest.approx(-0.2, abs=1e-3)
    assert "chosen: cadence 1." in capsys.readouterr().out


def test_a_cadence_that_does_not_follow_the_speed_is_said(robot, tmp_path, capsys):
    out = tmp_path / "slow.npz"
    own = robot.gait["cadence"]
    synthesize(out, "--speed 0.2 --step-height 0.05 --duration 3")
    assert f": its cadence is {own:g} steps/s, where 1." in capsys.readouterr().out
    for rest in (f"--speed {robot.gait['speed']} --step-height 0.05", "--speed 0.2 --style.cadence 1.3"):
        synthesize(out, f"{rest} --duration 3")
        assert "fits the speed" not in capsys.readouterr().out


def test_command_says_what_is_wrong(tmp_path, capsys):
    out = tmp_path / "turn.npz"
    with pytest.raises(SystemExit) as caught:
        synthesize(out, "--style.cadence -1")
    assert caught.value.code == 2
    assert capsys.readouterr().err == "fmpjax: cadence is -1.0, expected a positive number of steps/s\n"
    assert not out.exists()
