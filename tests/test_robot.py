"""The shipped G1 models against the maker's, and forward kinematics and floor tests against MuJoCo's own.

``data/g1_figures.json`` is what `figures` gives for the maker's ``g1_29dof_rev_1_0`` model at three configurations,
``data/g1_29dof_figures.json`` the same for the first generation, ``g1_29dof``.
"""

import copy
import json
import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from fmpjax import kinematics, motion, robots
from fmpjax.errors import UserError

# Rotor inertia about the joint, kg m^2, by motor (maker's tables); ankles, waist roll and waist pitch have two each.
MOTOR_5020, MOTOR_7520_14, MOTOR_7520_22, MOTOR_4010 = 0.003609725, 0.010177520, 0.025101925, 0.00425
ARMATURE = [
    (r"hip_(pitch|yaw)|waist_yaw", MOTOR_7520_14),
    (r"hip_roll|knee", MOTOR_7520_22),
    (r"ankle|waist_(roll|pitch)", 2 * MOTOR_5020),
    (r"shoulder|elbow|wrist_roll", MOTOR_5020),
    (r"wrist_(pitch|yaw)", MOTOR_4010),
]


def figures(model, configurations):
    """Bodies, joints and body poses of a model whose joint 0 is the root, by name."""
    data = mujoco.MjData(model)
    bodies, joints, poses = {}, {}, []
    for i in range(1, model.nbody):
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, model.body_iquat[i])
        turn = turn.reshape(3, 3)
        bodies[model.body(i).name] = {
            "mass": float(model.body_mass[i]),
            "com": model.body_ipos[i].tolist(),
            "inertia": (turn @ np.diag(model.body_inertia[i]) @ turn.T).tolist(),
        }
    for i in range(1, model.njnt):
        joints[model.joint(i).name] = {
            "body": model.body(model.jnt_bodyid[i]).name,
            "axis": model.jnt_axis[i].tolist(),
            "range": model.jnt_range[i].tolist(),
            "effort": model.jnt_actfrcrange[i].tolist(),
        }
    for qpos in configurations:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        poses.append({"qpos": list(qpos), "position": data.xpos[1:].tolist(), "rotation_wxyz": data.xquat[1:].tolist()})
    return {"bodies": bodies, "joints": joints, "poses": poses}


def assert_same(actual, expected, path=""):
    """Equal structure and order; numbers to the seven digits that the makers' tables have."""
    if isinstance(expected, dict):
        assert list(actual) == list(expected), path
        for key in expected:
            assert_same(actual[key], expected[key], f"{path}/{key}")
    elif isinstance(expected, str):
        assert actual == expected, path
    elif expected and isinstance(expected, list) and isinstance(expected[0], dict):
        assert len(actual) == len(expected), path
        for i, pair in enumerate(zip(actual, expected, strict=True)):
            assert_same(*pair, f"{path}/{i}")
    else:
        np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=1e-9, err_msg=path)


@pytest.fixture(scope="module")
def recorded(data):
    return json.loads((data / "g1_figures.json").read_text())


@pytest.fixture(scope="module")
def first_generation():
    return robots.load("unitree_g1_29dof")


@pytest.fixture(scope="module")
def first_recorded(data):
    return json.loads((data / "g1_29dof_figures.json").read_text())


def random_states(robot, count, *, height=(0.3, 1.2), tilt=np.inf, seed=0):
    """``[count, 7 + J]``: joints within limits, heights in m, any attitude or rotations by about ``tilt`` rad."""
    rng = np.random.default_rng(seed)
    if tilt == np.inf:
        turn = rng.normal(size=(count, 4))
    else:
        turn = np.concatenate([np.ones((count, 1)), np.tan(tilt / 2) * rng.uniform(-1, 1, (count, 3))], axis=1)
    return np.concatenate(
        [
            rng.uniform(-1, 1, (count, 2)),
            rng.uniform(*height, (count, 1)),
            turn / np.linalg.norm(turn, axis=1, keepdims=True),
            rng.uniform(robot.joint_low, robot.joint_high, (count, robot.joint_count)),
        ],
        axis=1,
    )


def mujoco_states(robot, states, model=None):
    """MuJoCo's data at each state, one object reused."""
    model = robot.model if model is None else model
    data = mujoco.MjData(model)
    for qpos in states:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        yield data


# --- the model -------------------------------------------------------------------------------------------------------


def test_model_has_the_recorded_masses_inertias_joints_and_poses(robot, recorded):
    assert_same(figures(robot.model, [p["qpos"] for p in recorded["poses"]]), recorded)


def test_first_generation_has_the_recorded_figures_but_for_the_wrists_torque(first_generation, first_recorded):
    assert first_generation.total_mass == pytest.approx(35.1121, abs=1e-4)
    expected = copy.deepcopy(first_recorded)
    for name, joint in expected["joints"].items():
        if re.search("wrist_(pitch|yaw)", name):
            assert joint["effort"] == [-5, 5]  # the maker's; MimicKit's, and so the paper's, is 25
            joint["effort"] = [-25, 25]
    assert_same(figures(first_generation.model, [p["qpos"] for p in expected["poses"]]), expected)


@pytest.mark.parametrize(
    "file, recording", [("g1_29dof_rev_1_0.xml", "g1_figures.json"), ("g1_29dof.xml", "g1_29dof_figures.json")]
)
def test_makers_model_has_the_recorded_figures(external, data, file, recording):
    text = external(file).read_text()
    lines = [line for line in text.splitlines() if "mesh" not in line or "<compiler" in line]
    maker = mujoco.MjModel.from_xml_string("\n".join(lines))
    recorded = json.loads((data / recording).read_text())
    assert_same(figures(maker, [p["qpos"] for p in recorded["poses"]]), recorded)


def test_generations_differ_in_the_waist_alone(robot, first_generation):
    """Joints, gains and legs are the same, so that either takes the other's motions as they are."""
    assert first_generation.joint_names == robot.joint_names
    for field in ("joint_axis", "joint_low", "joint_high", "stiffness", "damping", "key_offset"):
        np.testing.assert_array_equal(getattr(first_generation, field), getattr(robot, field), err_msg=field)
    names = [robot.joint_names[i] for i in np.flatnonzero(first_generation.effort != robot.effort)]
    assert names and all(re.search("hip_roll|wrist_(pitch|yaw)", name) for name in names)
    moved = np.abs(first_generation.body_position - robot.body_position).max(1)
    assert {robot.model.body(b + 1).name for b in np.flatnonzero(moved)} == {
        "waist_roll_link", "torso_link", "left_shoulder_pitch_link", "right_shoulder_pitch_link",
    }  # fmt: skip
    assert first_generation.takes("unitree_g1") and robot.takes("unitree_g1_29dof") and not robot.takes("strider")
    walk = motion.load("walk", robot="unitree_g1_29dof")
    assert walk.robot == "unitree_g1_29dof"
    np.testing.assert_array_equal(walk.qpos, motion.load("walk").qpos)


def test_first_generation_collides_with_itself_and_the_floor(robot, first_generation):
    assert first_generation.self_collision and not robot.self_collision
    model = first_generation.physics_model()
    data = mujoco.MjData(model)
    data.qpos[:] = first_generation.default_qpos
    # The left arm straight down and pressed inward: the hand is in the thigh's way.
    data.qpos[7 + first_generation.joint_names.index("left_shoulder_roll_joint")] = -0.2
    mujoco.mj_forward(model, data)
    pairs = {frozenset(model.geom(g).name for g in c.geom) for c in data.contact}
    assert frozenset({"left_hip_fall", "left_hand_fall"}) in pairs
    assert not any("left_hip_fall" in pair and "left_thigh_fall" in pair for pair in pairs)  # parent and child
    # The maker's ranges reach no further than before.
    others = robot.physics_model()
    data = mujoco.MjData(others)
    data.qpos[:] = robot.default_qpos
    data.qpos[7 + robot.joint_names.index("left_shoulder_roll_joint")] = -0.5
    mujoco.mj_forward(others, data)
    assert all("floor" in {others.geom(g).name for g in c.geom} for c in data.contact)


def test_capsule_feet_have_a_point_at_either_end(first_generation):
    """Soles of the first generation are three capsules a foot: lowest points are MuJoCo's distances to the floor."""
    robot = first_generation
    assert len(robot.sole_body) == 12 and (robot.sole_radius == 0.02).all()
    floor = robot.model.geom("floor").id
    soles = [i for i in range(robot.model.ngeom) if "_foot_" in robot.model.geom(i).name]
    states = random_states(robot, 20, tilt=0.5, seed=6)
    for qpos, data in zip(states, mujoco_states(robot, states), strict=True):
        expected = min(mujoco.mj_geomDistance(robot.model, data, floor, g, 10.0, None) for g in soles)
        assert robots.lowest_sole(robot, qpos) == pytest.approx(expected, abs=1e-9)


def test_first_generation_starts_in_mimickits_pose(first_generation):
    robot = first_generation
    angles = dict(zip(robot.joint_names, robot.default_qpos[7:], strict=True))
    assert {name for name, angle in angles.items() if angle} == {"left_elbow_joint", "right_elbow_joint"}
    assert angles["left_elbow_joint"] == 1.57
    np.testing.assert_array_equal(robot.default_qpos[:7], [0, 0, 0.8, 1, 0, 0, 0])
    assert robots.lowest_sole(robot, robot.default_qpos) == pytest.approx(0.8 - 0.7919, abs=1e-4)


def test_robot_repeats_the_model(robot, recorded):
    assert robot.joint_names == tuple(recorded["joints"])
    joints = recorded["joints"].values()
    np.testing.assert_allclose(
        np.stack([robot.joint_low, robot.joint_high], 1), [j["range"] for j in joints], rtol=1e-6
    )
    np.testing.assert_array_equal(robot.joint_axis, [j["axis"] for j in joints])
    np.testing.assert_array_equal(robot.effort, [j["effort"][1] for j in joints])
    assert robot.total_mass == pytest.approx(33.341142, abs=1e-6)
    names = list(recorded["bodies"])
    parent = dict(zip(names, robot.body_parent, strict=True))
    assert parent["pelvis"] == -1
    assert names[parent["left_knee_link"]] == "left_hip_yaw_link"
    assert names[parent["right_shoulder_pitch_link"]] == "torso_link"
    for body, joint in zip(names, robot.body_joint, strict=True):
        assert (body == "pelvis") if joint < 0 else recorded["joints"][robot.joint_names[joint]]["body"] == body
    # The head has no joint and follows the torso, body 15 of the tree without the pelvis.
    assert robot.jointless_row == 15 and robot.joint_names[14] == "waist_pitch_joint"
    assert [names[b] for b in robot.key_body] == [
        "left_ankle_roll_link",
        "right_ankle_roll_link",
        "torso_link",
        "left_wrist_yaw_link",
        "right_wrist_yaw_link",
    ]
    np.testing.assert_array_equal(robot.key_offset[2], [0.015, 0.0, 0.43])
    assert not np.delete(robot.key_offset, 2, axis=0).any()
    assert [robot.joint_names[j] for j in robot.sagittal_joints] == [
        f"{side}_{joint}_joint" for side in ("left", "right") for joint in ("hip_pitch", "knee", "ankle_pitch")
    ]


def test_servo_gains_follow_from_the_motors(robot):
    """Natural frequency 10 Hz, damping ratio 2: kp = I w^2 and kd = 2 * 2 I w with w = 2 pi 10."""
    omega = 2 * np.pi * 10
    model = robot.model
    for i, name in enumerate(robot.joint_names):
        (armature,) = (value for pattern, value in ARMATURE if re.search(pattern, name))
        dof = 6 + i
        assert model.dof_armature[dof] == pytest.approx(armature, rel=1e-7), name
        assert robot.stiffness[i] == pytest.approx(armature * omega**2, rel=1e-6), name
        assert robot.damping[i] == pytest.approx(4 * armature * omega, rel=1e-6), name
        # The servo acts on its own joint: force = kp (target - q) - kd qd, limited to the motor's effort.
        assert model.actuator_trnid[i, 0] == 1 + i
        assert model.actuator_gear[i].tolist() == [1, 0, 0, 0, 0, 0]
        np.testing.assert_array_equal(model.actuator_biasprm[i, :3], [0, -robot.stiffness[i], -robot.damping[i]])
        np.testing.assert_array_equal(model.actuator_forcerange[i], [-robot.effort[i], robot.effort[i]])
    assert (model.dof_frictionloss[6:] == 0.1).all() and not model.dof_frictionloss[:6].any()
    assert not model.dof_damping.any() and not model.jnt_stiffness.any()
    assert not model.actuator_ctrllimited.any()  # targets are not clipped to the joint range


def test_physics_model_changes_a_copy(robot):
    model = robot.physics_model(timestep=0.01, iterations=3, frictionloss=0.0)
    assert (model.opt.timestep, model.opt.iterations) == (0.01, 3)
    assert not model.dof_frictionloss.any()
    assert robot.model.opt.timestep == 0.005 and robot.model.dof_frictionloss[6] == 0.1


def test_only_the_feet_and_shins_touch_the_floor(robot):
    model = robot.model
    touching = {model.geom(i).name for i in np.flatnonzero(model.geom_contype)}
    feet = {
        f"{s}_foot_{end}_{edge}" for s in ("left", "right") for end in ("heel", "toe") for edge in ("left", "right")
    }
    assert touching == feet | {"left_shin", "right_shin"}
    assert (model.geom_friction[[model.geom(name).id for name in touching | {"floor"}], 0] == 1.0).all()
    fall = {model.body(b + 1).name for b in robot.fall_body}
    assert not any(re.search("knee|ankle", name) for name in fall)
    assert {"pelvis", "torso_link", "left_hip_yaw_link", "right_hip_yaw_link", "left_elbow_link"} <= fall
    assert fall == {re.sub("left|right", lambda s: {"left": "right", "right": "left"}[s[0]], name) for name in fall}


def test_default_pose_stands_on_its_soles(robot, solved):
    qpos = robot.default_qpos
    assert ((robot.joint_low < qpos[7:]) & (qpos[7:] < robot.joint_high)).all()
    # All eight sole spheres are as far in the floor: hip, knee and ankle pitch add up to zero.
    np.testing.assert_allclose(solved.sole_heights[-1], np.full(8, -robots.CONTACT_DEPTH), atol=1e-6)
    assert not solved.fallen[-1]
    assert 0.7 < qpos[2] < 0.8 and qpos[3:7].tolist() == [1, 0, 0, 0]


def test_default_pose_is_clear_of_the_contact_boundary(robot):
    """Rounding of the state decides nothing: every sole bears, whatever joint noise of 1e-6 rad does."""
    model = robot.physics_model()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(20):
        qpos = robot.default_qpos.astype(np.float32).astype(np.float64)
        qpos[7:] += 1e-6 * rng.normal(size=robot.joint_count)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, 0.0, qpos[7:]
        mujoco.mj_forward(model, data)
        assert data.ncon == 8
        force, total = np.zeros(6), 0.0
        for i in range(data.ncon):
            mujoco.mj_contactForce(model, data, i, force)
            total += force[0]
        assert 0.7 < total / (9.81 * robot.total_mass) < 1.1


def test_unknown_robot():
    with pytest.raises(UserError, match="unknown robot 'atlas': expected one of strider, unitree_g1, unitree_g1_29dof"):
        robots.load("atlas")


# --- kinematics ------------------------------------------------------------------------------------------------------


class Solved(NamedTuple):
    """What the package says of every configuration, from one compiled call in float32."""

    qpos: np.ndarray  # the recorded configurations, any attitudes, crouches and near falls, and the default pose last
    poses: kinematics.BodyPoses
    key_points: np.ndarray
    sole_heights: np.ndarray
    fallen: np.ndarray


def fall_geoms(model):
    return [i for i in range(model.ngeom) if model.geom(i).name.endswith("_fall")]


def fall_clearances(robot, states):
    """MuJoCo's distance from the floor to each fall geom, ``[N, C]`` m."""
    model = robot.model
    floor, geoms = model.geom("floor").id, fall_geoms(model)
    return np.array(
        [
            [mujoco.mj_geomDistance(model, data, floor, geom, 10.0, None) for geom in geoms]
            for data in mujoco_states(robot, states)
        ]
    )


@pytest.fixture(scope="module")
def solved(robot, recorded):
    qpos = np.concatenate(
        [
            [p["qpos"] for p in recorded["poses"]],
            random_states(robot, 146, height=(0.1, 0.9), seed=3),
            random_states(robot, 250, tilt=1.2, seed=4),
            [robot.default_qpos],
        ]
    )
    # Every other random state is lifted or lowered until the fall geoms are a millimeter above or below the floor.
    close = np.arange(3, 399, 2)
    qpos[close, 2] -= fall_clearances(robot, qpos[close]).min(1) - np.where(close % 4 == 1, 1e-3, -1e-3)

    @jax.jit
    def solve(qpos):
        poses = kinematics.body_poses(robot, qpos)
        others = (
            function(robot, poses) for function in (kinematics.key_points, kinematics.sole_heights, kinematics.fallen)
        )
        return poses, *others

    # Leading axes are free: the batch is given as a grid.
    grid = jnp.asarray(qpos, jnp.float32).reshape(4, 100, -1)
    flat = jax.tree.map(lambda x: np.asarray(x).reshape(400, *x.shape[2:]), solve(grid))
    return Solved(qpos, *flat)


def test_body_poses_are_mujocos(robot, solved):
    assert solved.poses.position.dtype == solved.poses.rotation_wxyz.dtype == np.float32
    expected = [(d.xpos[1:].copy(), d.xquat[1:].copy()) for d in mujoco_states(robot, solved.qpos)]
    position, rotation = (np.array(x) for x in zip(*expected, strict=True))
    np.testing.assert_allclose(solved.poses.position, position, atol=1e-5)
    sign = np.sign(np.sum(rotation * solved.poses.rotation_wxyz, axis=-1, keepdims=True))
    np.testing.assert_allclose(solved.poses.rotation_wxyz, sign * rotation, atol=1e-5)


def test_body_poses_are_the_recorded_ones(solved, recorded):
    expected = [p["position"] for p in recorded["poses"]]
    np.testing.assert_allclose(solved.poses.position[: len(expected)], expected, atol=1e-5)


def test_key_points_are_in_their_bodies(robot, solved):
    for points, data in zip(solved.key_points, mujoco_states(robot, solved.qpos), strict=True):
        torso = data.body("torso_link")
        expected = [
            data.body("left_ankle_roll_link").xpos,
            data.body("right_ankle_roll_link").xpos,
            torso.xpos + torso.xmat.reshape(3, 3) @ [0.015, 0, 0.43],
            data.body("left_wrist_yaw_link").xpos,
            data.body("right_wrist_yaw_link").xpos,
        ]
        np.testing.assert_allclose(points, expected, atol=1e-5)


def test_sole_heights_are_mujocos_distances(robot, solved):
    model = robot.model
    soles = [i for i in range(model.ngeom) if "_foot_" in model.geom(i).name]
    floor = model.geom("floor").id
    expected = [
        [mujoco.mj_geomDistance(model, d, floor, g, 10.0, None) for g in soles]
        for d in mujoco_states(robot, solved.qpos)
    ]
    np.testing.assert_allclose(solved.sole_heights, expected, atol=2e-5)
    lowest = [robots.lowest_sole(robot, qpos) for qpos in solved.qpos[::40]]
    np.testing.assert_allclose(np.min(expected, axis=1)[::40], lowest, atol=1e-9)


def test_fallen_is_mujocos_contact(robot, solved):
    """With the fall geoms made to collide, MuJoCo finds a floor contact exactly where `fallen` says so."""
    model = robot.physics_model()
    falls = fall_geoms(model)
    assert len(falls) == len(robot.fall_body)
    model.geom_contype[:], model.body_contype[:] = 0, 0
    model.geom_contype[falls], model.body_contype[model.geom_bodyid[falls]] = 1, 1
    floor, contact = model.geom("floor").id, []
    for data in mujoco_states(robot, solved.qpos, model):
        mujoco.mj_collision(model, data)
        contact.append(any(floor in c.geom and c.dist < 0 for c in data.contact))
    contact, clearance = np.array(contact), fall_clearances(robot, solved.qpos)
    lowest = clearance.min(1)
    np.testing.assert_array_equal(contact, lowest < 0)
    decided = np.abs(lowest) > 1e-5  # of float32
    np.testing.assert_array_equal(solved.fallen[decided], contact[decided])
    assert decided.sum() > 395 and 100 < contact.sum() < 350
    # Most geoms are, somewhere, the one that decides a close call.
    close = np.abs(lowest) < 2e-3
    assert close.sum() >= 190 and len(np.unique(clearance[close].argmin(1))) >= 10
