"""Retargeting: the bundled walk, written as a human's motion capture, comes back as the bundled walk."""

import dataclasses
import sys

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmpjax import cli, motion, rotations
from fmpjax.errors import UserError
from fmpjax.motion import bvh, check, gait, retarget, soles
from fmpjax.motion.retarget import feet

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
# Joints and their parents, by LAFAN1's names; what is a landmark of the robot; CMU's names.
TREE = {"Hips": None, "Spine": "Hips"}
LANDMARK = {"Hips": "pelvis", "Spine": "chest"}
CMU = {"Hips": "root", "Spine": "thorax"}
for prefix, short in (("Left", "l"), ("Right", "r")):
    for name, parent, part, cmu in (
        ("UpLeg", None, "hip", "femur"),
        ("Leg", "UpLeg", "knee", "tibia"),
        ("Foot", "Leg", "ankle", "foot"),
        ("Toe", "Foot", "ankle", "toes"),
        ("Arm", None, "shoulder", "humerus"),
        ("ForeArm", "Arm", "elbow", "radius"),
        ("Hand", "ForeArm", "wrist", "wrist"),
    ):
        TREE[prefix + name] = prefix + parent if parent else "Spine" if name == "Arm" else "Hips"
        LANDMARK[prefix + name] = f"{prefix.lower()}_{part}"
        CMU[prefix + name] = short + cmu


def capture(robot, clip, *, unit=100.0, names=None, axes_wxyz=IDENTITY, arms=1.0):
    """BVH text, y up, of the robot's landmarks as joints; ``axes_wxyz`` renames their axes, ``arms`` stretches arms."""
    data = mujoco.MjData(robot.model)
    position, rotation_wxyz = ({joint: np.zeros((len(clip), size)) for joint in TREE} for size in (3, 4))
    for t, row in enumerate(clip.qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.model, data)
        for joint, part in LANDMARK.items():
            body = robot.landmarks[part] + 1
            wxyz = data.xquat[body]
            toe = rotations.rotate(wxyz, np.array([0.12, 0.0, -0.03])) * joint.endswith("Toe")
            position[joint][t] = unit * (data.xpos[body] + toe)[[1, 2, 0]]
            rotation_wxyz[joint][t] = rotations.multiply(wxyz[[0, 2, 3, 1]], axes_wxyz)
    lines, columns = ["HIERARCHY"], []

    def visit(joint):
        parent, at, turned = TREE[joint], position[joint], rotation_wxyz[joint]
        if parent:
            inverse = rotations.conjugate(rotation_wxyz[parent])
            at = rotations.rotate(inverse, at - position[parent])
            turned = rotations.multiply(inverse, turned)
            at = at * (arms if joint.endswith(("ForeArm", "Hand")) else 1.0)
        columns.extend([at, Rotation.from_quat(turned[:, [1, 2, 3, 0]]).as_euler("ZYX", degrees=True)])
        lines.append(f"{'JOINT' if parent else 'ROOT'} {(names or {}).get(joint, joint)} {{ OFFSET 0 0 0")
        lines.append("CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation")
        for child in TREE:
            if TREE[child] == joint:
                visit(child)
        lines.append("}")

    visit("Hips")
    lines.extend(["MOTION", f"Frames: {len(clip)}", f"Frame Time: {1 / clip.rate:.9f}"])
    lines.extend(" ".join(f"{value:.6f}" for value in row) for row in np.concatenate(columns, axis=1))
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="module")
def second():
    """A little more than a second of the walk at the rate of LAFAN1."""
    return motion.load("walk", frames=(0, 60), rate=30.0)


@pytest.fixture(scope="module")
def read(tmp_path_factory):
    def read(text):
        path = tmp_path_factory.mktemp("bvh") / "walk.bvh"
        path.write_text(text)
        return bvh.read(path)

    return read


@pytest.fixture(scope="module")
def source(robot, second, read):
    return read(capture(robot, second))


@pytest.fixture(scope="module")
def done(robot, source):
    pytest.importorskip("mink")
    return retarget.retarget(source, robot, "walk")


def test_walk_comes_back(robot, second, done):
    assert done.clip.rate == pytest.approx(30)
    assert done.scale == pytest.approx(0.01, rel=1e-3)  # the file is in centimeters
    assert done.residual.max() < 0.012
    error = done.clip.qpos - second.qpos
    # The hip of the walk is not quite fixed in the pelvis, as a human's is.
    assert np.abs(error[:, :3]).max() < 0.015
    turn = rotations.multiply(rotations.conjugate(second.qpos[:, 3:7]), done.clip.qpos[:, 3:7])
    assert np.degrees(np.linalg.norm(rotations.log_map(turn), axis=-1)).max() < 2
    legs = np.degrees(error[:, 7 + robot.sagittal_joints])
    assert np.abs(legs).max() < 8
    assert np.abs(legs).mean() < 2
    arms = [7 + i for i, joint in enumerate(robot.joint_names) if "shoulder" in joint or "elbow" in joint]
    assert np.degrees(np.abs(error[:, arms])).max() < 3


def test_feet_stay_on_the_floor(robot, second, done):
    figures, original = gait.measure(robot, done.clip), gait.measure(robot, second)
    assert figures["slip"] < 0.006
    assert figures["penetration"] < 0.001
    assert figures["gap"] < 0.001
    assert figures["clearance"] == pytest.approx(original["clearance"], abs=0.004)
    assert figures["limit_margin"] > 0.1
    assert figures["joint_acceleration"] < 1.3 * original["joint_acceleration"]
    # The feet that the source's heights and speeds let stand are those that touch the floor.
    points, _ = soles.sole_points(robot, second.qpos)
    low = points[:, :, 2] - robot.sole_radius < 0.002
    touch = np.stack(
        [low[:, robot.sole_body == robot.landmarks[f"{s}_ankle"]].any(axis=1) for s in ("left", "right")], 1
    )
    assert (touch == done.contact).mean() > 0.9


def test_names_units_axes_and_lengths_of_arms_do_not_matter(robot, second, read, done):
    """CMU's names, inches, joints whose x axis points up the spine, and longer arms."""
    text = capture(robot, second, unit=1 / 0.0254, names=CMU, axes_wxyz=np.array([0.5, 0.5, 0.5, 0.5]), arms=1.4)
    again = retarget.retarget(read(text), robot, "walk")
    assert again.scale == pytest.approx(0.0254, rel=1e-3)
    np.testing.assert_allclose(again.clip.qpos, done.clip.qpos, atol=1e-3)


def test_heading_and_place_do_not_matter(robot, second, read, done):
    quarter = rotations.exp_map(np.array([0.0, 0.0, np.pi / 2]))
    moved = second.qpos.copy()
    moved[:, :3] = rotations.rotate(quarter, moved[:, :3]) + [3.0, -2.0, 0.7]  # the floor may be at any height
    moved[:, 3:7] = rotations.multiply(quarter, moved[:, 3:7])
    clip = motion.MotionClip.from_qpos("walk", robot.name, second.rate, moved)
    found = retarget.retarget(read(capture(robot, clip)), robot, "walk").clip.qpos
    np.testing.assert_allclose(found[:, 7:], done.clip.qpos[:, 7:], atol=5e-3)
    expected = rotations.rotate(quarter, done.clip.qpos[:, :3]) + np.array([3.0, -2.0, 0.0]) * done.scale / 0.01
    np.testing.assert_allclose(found[:, :3], expected, atol=2e-3)


def test_a_fast_source_is_thinned(robot, source, done):
    fast = source._replace(rate=120.0, values=np.repeat(source.values, 2, axis=0))
    thinned = retarget.retarget(fast, robot, "walk")
    assert thinned.clip.rate == 60
    assert len(thinned.clip) == len(source.values)


def test_joint_limits_hold_where_the_source_breaks_them(robot, second, read):
    pytest.importorskip("mink")
    bent = second.qpos[:12].copy()
    elbow = 7 + robot.joint_names.index("left_elbow_joint")
    waist = 7 + robot.joint_names.index("waist_pitch_joint")
    bent[:, elbow], bent[:, waist] = -1.6, 1.0
    clip = motion.MotionClip.from_qpos("bent", robot.name, second.rate, bent)
    joints = retarget.retarget(read(capture(robot, clip)), robot, "bent").clip.qpos[:, 7:]
    assert (joints >= robot.joint_low).all()
    assert (joints <= robot.joint_high).all()
    assert joints[-1, waist - 7] == pytest.approx(robot.joint_high[waist - 7], abs=0.02)


def test_planted_foot_stays_and_rolls_about_its_toe(robot):
    """A standing foot drifts in the source; in the result it stands at its mean place, then turns about its toe."""
    frames = 20
    pitch = np.concatenate([np.zeros(10), np.linspace(0.0, 0.5, 10)])
    foot_wxyz = rotations.exp_map(pitch[:, None] * [0.0, 1.0, 0.0])
    drift = np.linspace(0.0, 0.04, frames)
    free = np.column_stack([1.0 + drift, np.full(frames, 0.1), np.full(frames, 0.3)])
    stands = np.ones(frames, bool)
    path = feet.planted(robot, "left", free, foot_wxyz, stands, 30.0)
    np.testing.assert_allclose(path[:10, 0], path[0, 0], atol=1e-12)
    np.testing.assert_allclose(path[:, 0].mean(), free[:, 0].mean(), atol=1e-12)
    points, radius = feet.sole(robot, "left")
    toe = points[np.argmax(points[:, 0])]
    placed = path + rotations.rotate(foot_wxyz, toe)
    np.testing.assert_allclose(placed[:, 0], placed[0, 0], atol=1e-12)
    np.testing.assert_allclose(placed[:, 2], radius[0], atol=1e-12)


def test_swinging_foot_clears_the_floor(robot):
    frames = 31
    free = np.zeros((frames, 3))
    stands = np.zeros(frames, bool)
    stands[[0, 1, -2, -1]] = True
    path = feet.planted(robot, "left", free, np.tile(IDENTITY, (frames, 1)), stands, 30.0)
    height = path[:, 2] + feet.sole_height(robot, "left", IDENTITY)
    np.testing.assert_allclose(height[stands], 0, atol=1e-12)
    np.testing.assert_allclose(height[4:-4], feet.CLEARANCE, atol=1e-12)
    np.testing.assert_allclose(height[2], feet.CLEARANCE / 3, atol=1e-12)


def test_any_motion_is_solved_or_refused(robot, source):
    """Joints that turn at random, feet that never stand, a toe under its ankle: limits hold and nothing is infinite."""
    pytest.importorskip("mink")
    random = np.random.default_rng(0)
    values = source.values[:8].copy()
    toe = 6 * source.names.index("LeftToe")
    values[:, toe : toe + 3] = [0.0, -5.0, 0.0]
    wild = values + random.uniform(-180, 180, values.shape)
    wild[:, toe : toe + 3] = [0.0, -5.0, 0.0]
    for changed in (values, wild):
        found = retarget.retarget(source._replace(values=changed), robot, "walk")
        assert np.isfinite(found.clip.qvel).all()
        assert (found.clip.qpos[:, 7:] >= robot.joint_low).all()
        assert (found.clip.qpos[:, 7:] <= robot.joint_high).all()
    values[3, 0] = 1e9
    with pytest.raises(UserError, match="walk: the motion is 1e.07 m away at the robot's size, expected less than"):
        retarget.retarget(source._replace(values=values), robot, "walk")


def test_a_part_does_not_depend_on_its_first_frame(robot, source, done):
    part = retarget.retarget(source, robot, "walk", span=(15, 60))
    np.testing.assert_allclose(part.contact, done.contact[15:])
    np.testing.assert_allclose(part.clip.qpos[10:], done.clip.qpos[25:], atol=0.02)


def test_feet_that_tilt_beyond_the_ankles_do_not_shake_the_rest(robot, second, read, done):
    """Human feet roll and tilt further than the robot's ankles can: the joints' accelerations stay the source's."""
    path_source = read(capture(robot, second))
    values = path_source.values.copy()
    t = np.arange(len(values)) / second.rate
    for i, name in enumerate(("LeftFoot", "RightFoot")):
        at = 6 * path_source.names.index(name) + 3
        values[:, at : at + 3] += 35 * np.sin(9 * t + 3 * i)[:, None] * [1.0, 0.3, 1.0]
    found = retarget.retarget(path_source._replace(values=values), robot, "walk")
    figures = {figure.name: figure.value for figure in check.check(robot, found.clip)}
    assert figures["joint acceleration"] < 600
    assert figures["joint speed"] < 20
    assert found.residual.max() < 0.08
    assert figures["limit excess"] == 0


def test_z_up_is_told_by_the_legs(robot, second, read, done, tmp_path):
    """The same file with its root turned so that z is up gives the same motion."""
    source = read(capture(robot, second))
    text = turned_up(source)
    found = retarget.retarget(text, robot, "walk")
    assert dict((f.what, f.value) for f in found.clip.reading.facts)["up"] == "z"
    np.testing.assert_allclose(found.clip.qpos[:, 7:], done.clip.qpos[:, 7:], atol=5e-3)
    lying = retarget.retarget(text, robot, "walk", up="y")
    verdict, faults = lying.verdict(robot)
    assert verdict != "good" and any(fault.startswith("tilt is odd") for fault in faults)


def turned_up(source):
    """The skeleton with z up: x, y, z of the file become y, z, x."""
    values = source.values.copy()
    values[:, :3] = source.values[:, [2, 0, 1]]
    euler = Rotation.from_euler("ZYX", source.values[:, 3:6], degrees=True)
    third = Rotation.from_matrix([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    values[:, 3:6] = (third * euler).as_euler("ZYX", degrees=True)
    return source._replace(values=values)


def test_bad_fits_are_broken(robot, done):
    far = done._replace(residual=done.residual + 0.2)
    verdict, faults = far.verdict(robot)
    assert verdict == "broken"
    assert faults[0].startswith("mean residual is broken: 20") and faults[1].startswith("worst residual is odd")
    assert done.verdict(robot)[0] == "good"


XSENS = {"UpLeg": "Hip", "Leg": "Knee", "Foot": "Ankle", "Arm": "Shoulder", "ForeArm": "Elbow", "Hand": "Wrist"}
UNREAL = {"UpLeg": "thigh", "Leg": "calf", "Foot": "foot", "Toe": "ball", "Arm": "upperarm", "ForeArm": "lowerarm",
          "Hand": "hand"}  # fmt: skip


@pytest.mark.parametrize("kind", ["Xsens", "Unreal", "Mixamo", "SMPL"])
def test_names_of_other_programs(source, kind):
    expected = retarget.joints(source, "walk")

    def rename(name):
        side, limb = (name[:4], name[4:]) if name.startswith("Left") else (name[:5], name[5:])
        if not name.startswith(("Left", "Right")):
            return name
        if kind == "Xsens":
            return side + XSENS.get(limb, limb)
        if kind == "Unreal":
            return f"{UNREAL[limb]}_{side[0].lower()}"
        if kind == "SMPL":
            return f"{side[0]}_{ {'Toe': 'Foot'}.get(limb, XSENS.get(limb, limb)) }"
        return f"mixamorig:{side}{limb.replace('Toe', 'ToeBase')}"

    assert retarget.joints(source._replace(names=tuple(map(rename, source.names))), "walk") == expected


def test_a_collar_is_no_shoulder(source):
    """LAFAN1's LeftShoulder is the collar and LeftArm the shoulder; Xsens has LeftCollar and LeftShoulder."""
    names = tuple({"Spine": "LeftShoulder"}.get(name, name) for name in source.names)
    assert retarget.joints(source._replace(names=names), "walk")["left_shoulder"] == source.names.index("LeftArm")


def test_a_first_frame_in_another_pose_is_left_out(robot, second, tmp_path, capsys):
    pytest.importorskip("mink")
    path, out = tmp_path / "walk.bvh", tmp_path / "walk.npz"
    lines = capture(robot, second).split("\n")
    at = next(i for i, line in enumerate(lines) if line.startswith("Frame Time"))
    first = np.array(lines[at + 1].split(), float).reshape(-1, 6)
    first[:, 3:] = 0.0
    first[0, 3:] = [90.0, 0.0, 0.0]
    lines[at + 1] = " ".join(map(str, first.ravel()))
    path.write_text("\n".join(lines))
    cli.main(["motion", "retarget", str(path), "--out", str(out)])
    said = capsys.readouterr().out
    assert "warning: frame 0 is another pose, and is left out" in said
    assert "verdict: good" in said
    assert len(motion.load(out, rate=30.0)) == len(second) - 1
    path.write_text(capture(robot, second))
    cli.main(["motion", "retarget", str(path), "--frames", "15:", "--out", str(out)])
    assert "another pose" not in capsys.readouterr().out
    assert len(motion.load(out, rate=30.0)) == len(second) - 15


def test_a_skeleton_file_names_the_joints(robot, second, tmp_path, capsys):
    pytest.importorskip("mink")
    path, out, mapping = tmp_path / "walk.bvh", tmp_path / "walk.npz", tmp_path / "names.toml"
    path.write_text(capture(robot, second).replace("LeftLeg", "Knie"))

    def code(*more):
        with pytest.raises(SystemExit) as end:
            cli.main(["motion", "retarget", str(path), "--out", str(out), *more])
        return end.value.code

    assert code() == 2
    error = capsys.readouterr().err
    assert (
        error.startswith(f"fmpjax: {path}: ")
        and "no joint for the left knee" in error
        and "--skeleton" in error
        and "Knie" in error
    )
    for text, word in (
        ('left_knee = "Knee"', "no joint 'Knee' for left_knee"),
        ('left_nose = "Knie"', "'left_nose' is no part"),
        ("left_knee = 3", "'left_knee' is no part with a joint's name"),
        ("left_knee", "not TOML"),
    ):
        mapping.write_text(text)
        assert code("--skeleton", str(mapping)) == 2
        assert word in capsys.readouterr().err
    assert code("--skeleton", str(tmp_path / "nowhere.toml")) == 2
    assert code("--up", "x") == 2
    mapping.write_text('left_knee = "Knie"')
    cli.main(["motion", "retarget", str(path), "--out", str(out), "--skeleton", str(mapping), "--frames", ":30"])
    assert len(motion.load(out, rate=30.0)) == 31


def test_all_unknown_joints_are_named_at_once_and_an_ankles_end_is_the_toe(source):
    """None of the names is known; the toes are end sites, which BVH names after their parents."""

    def plain(name):
        return f"{plain(name.replace('Toe', 'Foot'))} end" if "Toe" in name else f"J{source.names.index(name)}"

    strange = source._replace(names=tuple(map(plain, source.names)))
    with pytest.raises(UserError, match="no joint for the left hip, left knee, left ankle, left toe, left shoulder,"):
        retarget.joints(strange, "walk")
    expected = retarget.joints(source, "walk")
    told = {part: strange.names[at] for part, at in expected.items() if "toe" not in part}
    assert retarget.joints(strange, "walk", told) == expected
    del told["left_hip"], told["right_wrist"]
    with pytest.raises(UserError, match='the left hip, right wrist, expected .* such as left_hip = "NAME", from J0'):
        retarget.joints(strange, "walk", told)


@pytest.mark.parametrize("name", ["cmu_01_01_first120.bvh", "hip_knee_ankle_names_30.bvh"])
def test_strangers_captures(external, robot, name, tmp_path, capsys):
    pytest.importorskip("mink")
    cli.main(["motion", "retarget", str(external(name)), "--out", str(tmp_path / "a.npz")])
    said = capsys.readouterr().out
    assert ("frame 0 is another pose" in said) == name.startswith("cmu")
    assert "broken" not in said


# --- faults and the command ------------------------------------------------------------------------------------------


def test_faults(robot, source, monkeypatch):
    with pytest.raises(UserError, match="walk: the skeleton has no joint for the left knee, expected names such as"):
        names = tuple(name.replace("LeftLeg", "Knie") for name in source.names)
        retarget.retarget(source._replace(names=names), robot, "walk")
    with pytest.raises(UserError, match="walk: the motion has 1 frame at 60 Hz, expected at least two"):
        retarget.retarget(source._replace(rate=240.0, values=source.values[:3]), robot, "walk")
    with pytest.raises(UserError, match="walk: hips are over ankles neither along y nor along z in most frames"):
        values = source.values.copy()
        values[:, 3:6] += [90.0, 0.0, 0.0]  # lies on its side
        retarget.retarget(source._replace(values=values), robot, "walk")
    with pytest.raises(UserError, match="walk: the skeleton's left_hip and left_knee are at the same place"):
        values = source.values.copy()
        at = 6 * source.names.index("LeftLeg")
        values[:, at : at + 3] = 0.0
        retarget.retarget(source._replace(values=values), robot, "walk")
    with pytest.raises(UserError, match="robot 'unitree_g1' has no landmark 'pelvis' in its robot.toml"):
        retarget.retarget(source, dataclasses.replace(robot, landmarks={}), "walk")
    monkeypatch.setitem(sys.modules, "mink", None)
    with pytest.raises(UserError, match=r"needs the package mink: install fmpjax\[retarget\]"):
        retarget.retarget(source, robot, "walk")


def test_namespaces_and_end_sites_are_understood(source):
    names = tuple(f"mixamorig:{name}" for name in source.names)
    assert retarget.joints(source._replace(names=names), "walk") == retarget.joints(source, "walk")
    names = tuple(name.replace("LeftToe", "LeftFoot end") for name in source.names)
    assert retarget.joints(source._replace(names=names), "walk") == retarget.joints(source, "walk")


def test_command(robot, second, tmp_path, capsys):
    pytest.importorskip("mink")
    path, out = tmp_path / "walk.bvh", tmp_path / "out" / "walk.npz"
    path.write_text(capture(robot, second))
    command = ["motion", "retarget", str(path), "--out", str(out)]
    cli.main(command)
    assert f"wrote {out}: {len(second)} frames at 30 Hz, 0.01 m per unit of the file" in capsys.readouterr().out
    assert motion.load(out, rate=30.0).qpos.shape == second.qpos.shape
    cli.main([*command, "--frames", "5:24"])
    assert "20 frames at 30 Hz" in capsys.readouterr().out
    assert len(motion.load(out, rate=30.0)) == 20
    out.unlink()
    with pytest.raises(SystemExit) as caught:
        cli.main([*command, "--frames", f"5:{len(second)}"])
    assert caught.value.code == 2
    assert f"frames 5:{len(second)} are outside the file" in capsys.readouterr().err
    path.write_text("HIERARCHY\n")
    with pytest.raises(SystemExit) as caught:
        cli.main(command)
    assert caught.value.code == 2
    assert "no line MOTION" in capsys.readouterr().err
    assert not out.exists()
