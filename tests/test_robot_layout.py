"""What a robot is must not hang on how its file is written: order, names, and bodies that nothing turns."""

import copy
import dataclasses
import functools
import re
import shutil
import xml.etree.ElementTree as ET

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from fmpjax import features, kinematics, motion, physics, resources, robots
from fmpjax.config import preset
from fmpjax.errors import UserError
from fmpjax.motion import gait
from fmpjax.viz import render


def source(name="strider"):
    """The root element of a shipped robot's model, and the text of its facts."""
    folder = resources.folder("robots") / name
    return ET.parse(folder / "robot.xml").getroot(), (folder / "robot.toml").read_text()


def write(folder, model, facts):
    folder.mkdir(parents=True)
    ET.ElementTree(model).write(folder / "robot.xml")
    (folder / "robot.toml").write_text(facts)
    return folder / "robot.xml"


@pytest.fixture(scope="module")
def strider():
    return robots.load("strider")


@pytest.fixture(scope="module")
def retold(tmp_path_factory):
    """Strider written otherwise: right leg first, other names of joints, a head and shin ends that are fixed bodies."""
    model, facts = source()
    trunk = model.find("worldbody/body")
    legs = trunk.findall("body")
    for leg in legs:
        trunk.remove(leg)
    head = ET.SubElement(trunk, "body", name="head", pos="0.01 0 0.3")
    head.append(copy.deepcopy(trunk.find("geom[@name='head_fall']")))
    trunk.remove(trunk.find("geom[@name='head_fall']"))
    del head.find("geom").attrib["pos"]
    trunk.extend(reversed(legs))
    for shin in (body for body in model.iter("body") if body.get("name").endswith("_shank_link")):
        ankle = shin.find("body")
        shin.remove(ankle)
        side = ankle.get("name").partition("_")[0]
        end = ET.SubElement(shin, "body", name=f"{side}_shin_end", pos=ankle.get("pos"))
        del ankle.attrib["pos"]
        end.append(ankle)
    servos = model.find("actuator")
    servos[:] = servos[6:] + servos[:6]
    for element in model.iter():
        for key in ("name", "joint"):
            if element.tag in ("joint", "position") and key in element.attrib:
                element.set(key, renamed(element.get(key)))
    facts = re.sub(r"\w+_joint\b", lambda found: renamed(found[0]), facts)
    facts = facts.replace('body = "trunk"\noffset = [0.01, 0.0, 0.3]', 'body = "head"')
    folder = tmp_path_factory.mktemp("robots")
    shipped = resources.folder
    shutil.copytree(shipped("robots"), folder / "robots")
    write(folder / "robots" / "retold", model, facts)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(resources, "folder", lambda kind: folder / kind if kind == "robots" else shipped(kind))
        yield robots.load("retold")


def renamed(joint):
    return joint.removesuffix("_joint").replace("hip", "upper").replace("knee", "middle")


@pytest.fixture(scope="module")
def order(strider, retold):
    """Where each of strider's joints stands in the other file."""
    return np.array([retold.joint_names.index(renamed(name)) for name in strider.joint_names])


@pytest.fixture(scope="module")
def walks(strider, retold):
    return [gait.synthesize(robot, duration=1.0) for robot in (strider, retold)]


def columns(order, before):
    return np.concatenate([np.arange(before), before + order])


# --- the same robot --------------------------------------------------------------------------------------------------


def test_it_is_another_file_of_the_same_robot(strider, retold, order):
    assert order.tolist() == [*range(6, 12), *range(6)] and not set(strider.joint_names) & set(retold.joint_names)
    assert (retold.body_joint < 0).sum() == 4 and (strider.body_joint < 0).sum() == 1
    for fact in ("joint_low", "joint_high", "effort", "stiffness", "damping", "joint_axis"):
        np.testing.assert_array_equal(getattr(retold, fact)[order], getattr(strider, fact))
    np.testing.assert_array_equal(order[strider.sagittal_joints], retold.sagittal_joints)
    np.testing.assert_allclose(retold.default_qpos[columns(order, 7)], strider.default_qpos, atol=1e-12)
    for robot in (strider, retold):
        assert [robot.model.body(b + 1).name for b in robot.feet] == ["left_foot_link", "right_foot_link"]


def test_it_walks_the_same_walk(strider, retold, order, walks):
    ours, theirs = walks
    np.testing.assert_allclose(theirs.qpos[:, columns(order, 7)], ours.qpos, atol=1e-8)
    one, other = gait.measure(strider, ours), gait.measure(retold, theirs)
    for figure, value in one.items():
        assert other[figure] == pytest.approx(value, abs=1e-4), figure


def test_it_is_observed_the_same(strider, retold, order, walks):
    frames = []
    for robot, clip in zip((strider, retold), walks, strict=True):
        qpos, qvel = (jnp.asarray(x[::8], jnp.float32) for x in (clip.qpos, clip.qvel))
        observed = jax.jit(functools.partial(features.observe, robot, form="full"))(qpos, qvel)
        assert observed.actor.shape[-1] == 1 + 6 + 6 + 7 * 12 + 9
        frames.append(np.asarray(observed.frame))
    where = np.concatenate([np.arange(9), 9 + order, 21 + order, np.arange(33, 48), 48 + order])
    np.testing.assert_allclose(frames[1][:, where], frames[0], atol=1e-4)


def test_its_kinematics_are_mujocos(retold, walks):
    data, clip = mujoco.MjData(retold.model), walks[1]
    poses = jax.jit(functools.partial(kinematics.body_poses, retold))(jnp.asarray(clip.qpos[::12], jnp.float32))
    for i, row in enumerate(clip.qpos[::12]):
        data.qpos[:] = row
        mujoco.mj_kinematics(retold.model, data)
        np.testing.assert_allclose(poses.position[i], data.xpos[1:], atol=1e-5)
        np.testing.assert_allclose(np.abs(np.sum(poses.rotation_wxyz[i] * data.xquat[1:], axis=-1)), 1, atol=1e-5)


def test_it_moves_the_same(strider, retold, order, walks):
    """One control step from the walk, targets ahead of it: the physics knows the servos by their joints."""
    ends = []
    for robot, clip in zip((strider, retold), walks, strict=True):
        qpos, qvel = (jnp.asarray(x[[8, 32]], jnp.float32) for x in (clip.qpos, clip.qvel))
        targets = jnp.asarray(clip.qpos[[14, 38], 7:], jnp.float32)
        backend = physics.make(robot, dataclasses.replace(preset("laptop").physics, backend="native", iterations=20))
        ends.append(np.asarray(backend.step(physics.reset(qpos, qvel), targets).qpos))
    np.testing.assert_allclose(ends[1][:, columns(order, 7)], ends[0], atol=1e-5)
    assert np.abs(ends[0][:, 7:] - walks[0].qpos[[8, 32], 7:]).max() > 0.05


def test_a_motion_of_the_one_is_refused_for_the_other(retold, walks, tmp_path):
    path = motion.save(walks[0], tmp_path / "walk.npz")
    with pytest.raises(UserError, match=r"walk.npz: the motion is for robot 'strider', expected 'retold'"):
        motion.load(path, robot="retold")


# --- what would be misread is refused --------------------------------------------------------------------------------


def swap_servos(model):
    servos = model.find("actuator")
    servos[:] = servos[1::-1] + servos[2:]


def add_hinge(model):
    ET.SubElement(model.find(".//body[@name='left_thigh_link']"), "joint", name="twist", axis="0 0 1", range="-1 1")


def change(path, key, value):
    return lambda model: model.find(path).set(key, value)


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (swap_servos, "one servo a hinge, in the order of the hinges"),
        (lambda model: model.find("actuator").remove(model.find("actuator")[3]), "one servo a hinge"),
        (add_hinge, "at most one hinge in a body"),
        (change(".//joint[@name='left_knee_joint']", "type", "slide"), "no joints but hinges beside the root's"),
        (change(".//joint[@name='left_knee_joint']", "pos", "0 0 0.01"), "hinges at the origins of their bodies"),
        (change(".//joint[@name='left_knee_joint']", "ref", "0.3"), "angles that are zero as the model is drawn"),
        (change(".//geom[@name='left_foot_toe_left']", "name", "toe_foot_1"), "soles named left_foot_... and right_"),
        (change(".//geom[@name='left_shin']", "name", "left_foot_top"), "a left and a right foot, each one body"),
    ],
)
def test_a_model_that_would_be_misread_is_refused(tmp_path, spoil, expected):
    model, facts = source()
    spoil(model)
    path = write(tmp_path / "odd", model, facts)
    with pytest.raises(UserError, match=f"^{re.escape(str(path))}: expected {re.escape(expected)}"):
        robots._read("odd", path)


def test_a_robot_without_a_walk_or_with_other_legs_says_so(strider, tmp_path):
    with pytest.raises(UserError, match=r"robot 'strider' has no \[gait\] in its robot.toml"):
        gait.synthesize(dataclasses.replace(strider, gait={}))
    with pytest.raises(UserError, match=r"the \[gait\] of robot 'strider' has 'arm_middle': expected 'speed'"):
        gait.synthesize(dataclasses.replace(strider, gait=strider.gait | {"arm_middle": 0.1}))
    with pytest.raises(UserError, match="robot 'strider' has no joint 'neck', which its walk moves"):
        gait.synthesize(dataclasses.replace(strider, gait=strider.gait | {"joints": {"waist_yaw": "neck"}}))
    model, facts = source()
    foot = model.find(".//body[@name='left_foot_link']")
    foot.remove(foot.find("joint"))
    servos = model.find("actuator")
    servos.remove(servos.find("*[@name='left_ankle_roll']"))
    robot = robots._read("stiff", write(tmp_path / "stiff", model, facts))
    with pytest.raises(UserError, match="robot 'stiff' has 5 hinges in a leg: a walk needs six"):
        gait.synthesize(robot)


# --- pictures --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", robots.available())
def test_a_robot_fills_its_picture(name):
    robot = robots.load(name)
    frame = render.render_frames(robot, robot.default_qpos[None], width=120, height=120, using="skeleton")[0]
    rows = np.flatnonzero((frame < 100).all(axis=-1).any(axis=1))
    assert 2 < rows[0] < 30 and 85 < rows[-1] < 115
