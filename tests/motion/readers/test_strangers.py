"""Files as other programs write them, made here from the bundled walk: read right, said how, or refused."""

import bz2
import dataclasses
import gzip
import io
import pickle
import struct
import zipfile
import zlib

import mujoco
import numpy as np
import pytest

from fmpjax import cli, motion, robots, rotations
from fmpjax.errors import UserError
from fmpjax.motion import edit, formats
from fmpjax.motion.readers import bodies as bodies_reader
from fmpjax.motion.readers import pickled
from fmpjax.motion.readers import text as text_reader

ROBOT = robots.load("unitree_g1")
NAMES = list(ROBOT.joint_names)
WRISTS = [i for i, name in enumerate(NAMES) if "wrist" in name]
RATE = 50.0


@pytest.fixture(scope="module")
def qpos():
    """A second of the walk, a little tilted, with every joint and the waist in motion."""
    rows = motion.load("walk").qpos[:60].copy()
    t = np.arange(60)[:, None] / RATE
    rows[:, 7:] += 0.1 * np.sin(2 * t + np.arange(ROBOT.joint_count)) + 0.02 * np.arange(ROBOT.joint_count) / 29
    rows[:, :2] += [1.0, -2.0]
    rows[:, 3:7] = rotations.multiply(rotations.exp_map(np.array([0.05, 0.02, -0.2])), rows[:, 3:7])
    return rows


def fact(clip, what):
    """Value and origin of one thing that the file was read as."""
    return next((f.value, f.why) for f in clip.reading.facts if f.what == what)


def same(clip, qpos):
    np.testing.assert_allclose(clip.qpos, qpos, atol=1e-6)


def refused(path, *words, **options):
    with pytest.raises(UserError) as caught:
        motion.load(path, rate=RATE, **options)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message and len(message) < 600, message
    for word in words:
        assert word in message, message


# --- text ------------------------------------------------------------------------------------------------------------


def text(path, qpos, *, order="xyzw", separator=",", header=None, tail="", degrees=False, columns=None):
    rows = qpos.copy()
    rows[:, 3:7] = qpos[:, 3:7] if order == "wxyz" else qpos[:, [4, 5, 6, 3]]
    rows[:, 7:] = np.degrees(rows[:, 7:]) if degrees else rows[:, 7:]
    rows = rows if columns is None else rows[:, columns]
    lines = [separator.join(f"{v:.8f}" for v in row) + tail for row in rows]
    path.write_text("\n".join(([separator.join(header)] if header else []) + lines) + "\n")
    return path


def test_quaternions_of_mujoco_are_told_by_the_upside_down_root(tmp_path, qpos):
    clip = motion.load(text(tmp_path / "a.csv", qpos, order="wxyz"), fps=RATE)
    same(clip, qpos)
    assert fact(clip, "quaternion") == ("wxyz", "as xyzw the root is upside down in all rows")
    clip = motion.load(text(tmp_path / "a.csv", qpos), fps=RATE)
    same(clip, qpos)
    assert fact(clip, "quaternion") == ("xyzw", "the format's")


def test_a_root_that_is_upside_down_either_way_is_refused(tmp_path, qpos):
    over = qpos.copy()
    over[:, 3:7] = rotations.multiply(rotations.exp_map(np.array([2.2, 2.2, 0.0])), over[:, 3:7])
    path = text(tmp_path / "a.csv", over)
    refused(path, "the root's z axis points down in all rows", "--quaternion")
    same(motion.load(path, fps=RATE, quaternion="xyzw"), motion.MotionClip.from_qpos("", "", RATE, over).qpos)
    with pytest.raises(UserError, match="quaternion is 'zyxw', expected one of wxyz, xyzw"):
        motion.load(path, quaternion="zyxw")


def test_a_root_on_its_side_that_stands_in_the_other_order_is_refused(tmp_path, qpos):
    """A heading of 100 degrees, written wxyz: as xyzw it is a roll of 80 degrees and not upside down."""
    turned = qpos.copy()
    turned[:, 3:7] = rotations.exp_map(np.array([0.0, 0.0, np.radians(100)]))
    refused(text(tmp_path / "a.csv", turned, order="wxyz"), "is tilted by 80°", "as wxyz by 0°", "--quaternion wxyz")


@pytest.mark.parametrize(("heading", "words"), [(180, "slide over the floor at"), (200, "tilted"), (150, "tilted")])
def test_a_walk_that_looks_back_is_upright_in_both_orders_and_refused(tmp_path, heading, words):
    """Written wxyz, it is upright as xyzw too, but looks along +x and walks backward, or leans."""
    walk = edit.headed(motion.load("walk"), np.radians(heading)).qpos
    path = text(tmp_path / "a.csv", walk, order="wxyz")
    refused(path, words, "--quaternion wxyz")
    same(motion.load(path, fps=RATE, rate=RATE, quaternion="wxyz"), walk)
    same(motion.load(text(tmp_path / "b.csv", walk), fps=RATE, rate=RATE), walk)


def test_a_fall_does_not_hide_the_order(tmp_path):
    """A walk in a circle, written wxyz, that lies in a fifth of its rows."""
    walk = motion.load("turn_left").qpos.copy()
    down = slice(0, len(walk) // 5)
    walk[down, 3:7] = rotations.multiply(walk[down, 3:7], rotations.exp_map(np.array([0.0, np.pi / 2, 0.0])))
    refused(text(tmp_path / "a.csv", walk, order="wxyz"), "tilted", "--quaternion wxyz")
    same(motion.load(text(tmp_path / "b.csv", walk), fps=RATE, rate=RATE), walk)


def test_degrees_are_refused_with_the_option_that_reads_them(tmp_path, qpos):
    path = text(tmp_path / "a.csv", qpos, degrees=True)
    refused(path, "they look like degrees", "--degrees")
    header = ["x", "y", "z", "qx", "qy", "qz", "qw", *(f"{name} (deg)" for name in NAMES)]
    refused(text(tmp_path / "b.csv", qpos, degrees=True, header=header), "they look like degrees")
    clip = motion.load(path, fps=RATE, degrees=True)
    same(clip, qpos)
    assert fact(clip, "angles") == ("degrees", "--degrees")


@pytest.mark.parametrize("separator", [",", ";", " ", "\t", ", "])
@pytest.mark.parametrize("tail", ["", ","])
def test_separators(tmp_path, qpos, separator, tail):
    tail = tail and separator.strip(" ")
    same(motion.load(text(tmp_path / "a.csv", qpos, separator=separator, tail=tail), fps=RATE), qpos)


@pytest.mark.parametrize("separator", [",", " "])
def test_a_long_file_is_read_a_part_at_a_time(tmp_path, qpos, separator, monkeypatch):
    monkeypatch.setattr(text_reader, "AT_ONCE", 7)
    path = text(tmp_path / "a_50hz.csv", qpos, separator=separator)
    same(motion.load(path), qpos)
    lines = path.read_text().split("\n")
    cells = lines[38].split(separator)
    cells[4] = "x"
    lines[38] = separator.join(cells)
    path.write_text("\n".join(lines))
    refused(path, "line 39, column 5 is 'x', expected a number")


def test_decimal_commas(tmp_path, qpos):
    path = text(tmp_path / "a.csv", qpos, separator=";")
    path.write_text(path.read_text().replace(".", ","))
    same(motion.load(path, fps=RATE), qpos)


def test_a_header_puts_columns_in_order_and_times_give_the_rate(tmp_path, qpos):
    order = np.random.default_rng(0).permutation(ROBOT.joint_count)
    header = ["time", "root_x", "root_y", "root_z", "qw", "qx", "qy", "qz", *(NAMES[i] for i in order), "left_thumb"]
    t = np.arange(len(qpos))[:, None] / 40
    rows = np.concatenate([t, qpos[:, :7], qpos[:, 7 + order], t], axis=1)
    lines = [",".join(header), *(",".join(f"{v:.8f}" for v in row) for row in rows)]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    clip = motion.load(tmp_path / "a.csv", rate=40.0)
    same(clip, qpos)
    assert fact(clip, "joints") == ("29 by name", "the header's names")
    assert fact(clip, "quaternion") == ("wxyz", "the header's names")
    assert fact(clip, "rate") == ("40 Hz", "the column of times")
    assert clip.reading.warnings == ("columns left out: left_thumb",)
    lines[0] = lines[0].replace("qw", "w0")
    (tmp_path / "a.csv").write_text("\n".join(lines))
    refused(tmp_path / "a.csv", "names joints, but not the root's position and quaternion")


def test_a_header_without_joints_and_a_spreadsheets_row_numbers(tmp_path, qpos):
    rows = np.concatenate([np.arange(len(qpos))[:, None], qpos[:, :3], qpos[:, [4, 5, 6, 3]], qpos[:, 7:]], axis=1)
    lines = ["," + ",".join(map(str, range(36))), *(",".join(f"{v:.8f}" for v in row) for row in rows)]
    (tmp_path / "a.csv").write_text("\n".join(lines))
    same(motion.load(tmp_path / "a.csv", fps=RATE), qpos)


def test_a_rate_in_the_name(tmp_path, qpos):
    clip = motion.load(text(tmp_path / "walk_60hz_v2.csv", qpos), rate=60.0)
    same(clip, qpos)
    assert fact(clip, "rate")[0] == "60 Hz" and "name" in fact(clip, "rate")[1]
    clip = motion.load(text(tmp_path / "walk60.csv", qpos), rate=30.0)
    assert fact(clip, "rate")[0] == "30 Hz" and fact(clip, "rate")[1].startswith("assumed")


def test_fewer_joints_by_the_stated_words(tmp_path, qpos):
    kept = [i for i in range(36) if i - 7 not in WRISTS]
    path = text(tmp_path / "a.csv", qpos, columns=kept)
    refused(path, "30 columns, expected 36", "--without wrist")
    clip = motion.load(path, fps=RATE, without="wrist")
    expected = qpos.copy()
    expected[:, [7 + i for i in WRISTS]] = 0
    same(clip, expected)
    assert clip.reading.warnings[0].startswith("6 joints that the file lacks are at zero: left_wrist_roll_joint")
    assert clip.reading.warnings[1].startswith("--without waist_roll,waist_pitch,wrist_pitch,wrist_yaw leaves as many")
    refused(path, "expected 34 for", without="wrist_roll")
    with pytest.raises(UserError, match="no joint of robot 'unitree_g1' has 'thumb' in its name"):
        motion.load(path, without="thumb")


@pytest.mark.parametrize("frames", ["20:", ":39", "20:39"])
def test_frames_may_leave_out_an_end(tmp_path, qpos, frames):
    clip = motion.load(text(tmp_path / "a.csv", qpos), fps=RATE, frames=frames)
    first, last = (20 if "20" in frames else 0), (39 if "39" in frames else 59)
    same(clip, qpos[first : last + 1])
    assert fact(clip, "rows") == (f"{first} to {last} of 60", "as asked")
    with pytest.raises(UserError, match="frames 70:70 are outside"):
        motion.load(tmp_path / "a.csv", frames="70:")


# --- archives with bodies --------------------------------------------------------------------------------------------


def places(qpos):
    data = mujoco.MjData(ROBOT.model)
    position, turn = np.zeros((len(qpos), ROBOT.model.nbody, 3)), np.zeros((len(qpos), ROBOT.model.nbody, 4))
    for i, row in enumerate(qpos):
        data.qpos[:] = row
        mujoco.mj_kinematics(ROBOT.model, data)
        position[i], turn[i] = data.xpos, data.xquat
    return position, turn


def archive(path, **arrays):
    with path.open("wb") as stream:
        np.savez(stream, **arrays)
    return path


BODY_NAMES = [ROBOT.model.body(i).name for i in range(ROBOT.model.nbody)]
SOME = ["pelvis", "left_hip_roll_link", "left_knee_link", "left_ankle_roll_link", "right_hip_roll_link",
        "right_knee_link", "right_ankle_roll_link", "torso_link", "left_elbow_link", "left_wrist_yaw_link",
        "right_elbow_link", "right_wrist_yaw_link"]  # fmt: skip


@pytest.mark.parametrize("order", ["the model's order", "Isaac Lab's order"])
@pytest.mark.parametrize("held", ["all", "some", "world first", "more"])
def test_the_order_of_joints_without_names_is_proved(tmp_path, qpos, order, held):
    position, turn = places(qpos)
    wide, joints = bodies_reader.breadth_first(ROBOT)
    deep = order == "the model's order"
    rows = np.arange(1, 31) if deep else 1 + wide
    if held == "some":
        rows = [BODY_NAMES.index(name) for name in SOME]
    rows = [0, *rows] if held == "world first" else rows
    position, turn = position[:, rows], turn[:, rows]
    if held == "more":
        position = np.concatenate([position, position[:, 5:8] + [0.0, 0.0, 0.3]], axis=1)
        turn = np.concatenate([turn, turn[:, 5:8]], axis=1)
    values = qpos[:, 7:] if deep else qpos[:, 7 + joints]
    path = archive(tmp_path / "a.npz", fps=[RATE], joint_pos=values, body_pos_w=position, body_quat_w=turn)
    clip = motion.load(path)
    same(clip, qpos)
    assert fact(clip, "joints") == (f"29 in {order}", "the bodies' places prove it")
    assert fact(clip, "root")[0] == ("body 1" if held == "world first" else "body 0")


def test_bodies_that_prove_nothing_are_refused(tmp_path, qpos):
    position, turn = places(qpos)
    arrays = {"fps": [RATE], "joint_pos": qpos[:, 7:], "body_pos_w": position[:, 1:3], "body_quat_w": turn[:, 1:3]}
    refused(archive(tmp_path / "a.npz", **arrays), "2 bodies do not determine the order of the joints")
    # Pelvis and the trunk's chain: no leg or arm tells one order from another.
    rows = [BODY_NAMES.index(n) for n in ("pelvis", "waist_yaw_link", "waist_roll_link", "torso_link")]
    still = qpos.copy()
    still[:, 7 + 12 : 7 + 15] = still[:, 7 + 2 : 7 + 3] = still[:, 7 + 5 : 7 + 6] = still[:, 7 + 8 : 7 + 9] = 0.0
    position, turn = places(still)
    arrays = {"fps": [RATE], "joint_pos": still[:, 7:], "body_pos_w": position[:, rows], "body_quat_w": turn[:, rows]}
    refused(archive(tmp_path / "a.npz", **arrays), "do not tell whether joints are in")
    alone = {"fps": [RATE], "joint_pos": qpos[:, 7:], "joint_names": NAMES}
    alone |= {"body_pos_w": np.zeros((60, 1, 3)), "body_quat_w": np.tile([1.0, 0.0, 0.0, 0.0], (60, 1, 1))}
    refused(archive(tmp_path / "a.npz", **alone), "lies at (0, 0, 0) in every frame")


@pytest.mark.parametrize("whole", [True, False])
def test_holosoma(tmp_path, qpos, whole):
    """Root and joints in one array or joints alone, the world before the root, links of its own between."""
    position, turn = places(qpos)
    names = ["world", "pelvis", "pelvis_contour_link", *BODY_NAMES[2:]]
    rows = [0, 1, 1, *range(2, 31)]
    path = archive(
        tmp_path / "a.npz", fps=np.array([50]), joint_pos=(qpos if whole else qpos[:, 7:]).astype("f4"),
        body_pos_w=position[:, rows], body_quat_w=turn[:, rows], joint_names=NAMES, body_names=names,
    )  # fmt: skip
    clip = motion.load(path)
    same(clip, qpos)
    assert fact(clip, "root")[0] == ("in joint_pos" if whole else "body 1")
    assert not clip.reading.warnings


def test_bodies_that_contradict_named_joints_are_said(tmp_path, qpos):
    position, turn = places(qpos)
    path = archive(
        tmp_path / "a.npz", fps=[RATE], joint_pos=qpos[:, 7:][:, ::-1], joint_names=NAMES,
        body_pos_w=position[:, 1:], body_quat_w=turn[:, 1:],
    )  # fmt: skip
    (warning,) = motion.load(path).reading.warnings
    assert "from where its joints put those of robot 'unitree_g1'" in warning


def test_isaac_lab_amp_by_its_names(tmp_path, qpos):
    position, turn = places(qpos)
    order = np.random.default_rng(1).permutation(ROBOT.joint_count)
    rows = [BODY_NAMES.index(name) for name in ("torso_link", "left_elbow_link", "pelvis", "left_knee_link", "head")
            if name in BODY_NAMES]  # fmt: skip
    path = archive(
        tmp_path / "a.npz", fps=np.int64(50), dof_names=[NAMES[i] for i in order], dof_positions=qpos[:, 7 + order],
        body_names=[BODY_NAMES[i] for i in rows], body_positions=position[:, rows], body_rotations=turn[:, rows],
    )  # fmt: skip
    clip = motion.load(path)
    same(clip, qpos)
    assert fact(clip, "root") == ("body 2", "named pelvis")


def test_arrays_of_objects(tmp_path, qpos):
    """Names in an array of objects are read where all are text; other objects are passed over and run nothing."""
    position, turn = places(qpos)
    order = np.random.default_rng(2).permutation(ROBOT.joint_count)
    arrays = {"fps": [RATE], "body_pos_w": position[:, 1:], "body_quat_w": turn[:, 1:]}
    names = np.array([NAMES[i] for i in order], object)
    clip = motion.load(archive(tmp_path / "a.npz", joint_pos=qpos[:, 7 + order], joint_names=names, **arrays))
    same(clip, qpos)

    class Call:
        def __reduce__(self):
            return (open, (str(tmp_path / "flag"), "w"))

    path = archive(tmp_path / "a.npz", joint_pos=qpos[:, 7:], joint_names=np.array([Call()], object), **arrays)
    same(motion.load(path), qpos)
    assert not (tmp_path / "flag").exists()
    refused(archive(tmp_path / "a.npz", joint_pos=np.array([Call()], object), **arrays), "holds objects")
    assert not (tmp_path / "flag").exists()


def test_a_robot_with_the_same_joints_takes_the_file(tmp_path, qpos, monkeypatch):
    path = motion.save(motion.MotionClip.from_qpos("a", "unitree_g1", RATE, qpos), tmp_path / "a.npz")
    twin = dataclasses.replace(ROBOT, name="twin")
    monkeypatch.setattr(robots, "load", lambda name: twin if name == "twin" else ROBOT)
    clip = motion.load(path, robot="twin")
    same(clip, qpos)
    assert clip.robot == "twin" and "unitree_g1, has the same joints" in fact(clip, "robot")[1]
    other = dataclasses.replace(ROBOT, name="twin", joint_names=ROBOT.joint_names[::-1])
    monkeypatch.setattr(robots, "load", lambda name: other if name == "twin" else ROBOT)
    refused(path, "the motion is for robot 'unitree_g1', expected 'twin'", robot="twin")


# --- pickles, joblib, PyTorch ----------------------------------------------------------------------------------------


def joblib_pickle(content):
    """A dictionary of float arrays as joblib writes it: an array's bytes follow the instruction that builds it."""
    out = io.BytesIO()
    out.write(b"\x80\x04}(")
    for name, value in content.items():
        key = name.encode()
        out.write(b"\x8c" + bytes([len(key)]) + key)
        if not isinstance(value, np.ndarray):
            out.write(b"K" + bytes([value]))
            continue
        shape = b"(" + b"".join(b"K" + bytes([n]) for n in value.shape) + b"t"
        dtype = b"cnumpy\ndtype\n(\x8c\x02f8\x89\x88tR(K\x03\x8c\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
        out.write(b"cjoblib.numpy_pickle\nNumpyArrayWrapper\n)\x81}(")
        out.write(b"\x8c\x08subclasscnumpy\nndarray\n\x8c\x05shape" + shape + b"\x8c\x05order\x8c\x01C\x8c\x05dtype")
        out.write(dtype + b"\x8c\x0aallow_mmap\x88\x8c\x1bnumpy_array_alignment_bytesK\x10ub")
        padding = 16 - (out.tell() + 1) % 16
        out.write(bytes([padding]) + b"\xff" * padding + value.astype("<f8").tobytes())
    return out.getvalue() + b"u."


def asap(qpos, kept):
    axes = np.concatenate([np.zeros((1, 3)), ROBOT.joint_axis[kept], np.zeros((3, 3))])
    angles = np.concatenate([np.zeros((len(qpos), 1)), qpos[:, 7:][:, kept], np.zeros((len(qpos), 3))], axis=1)
    return {
        "root_trans_offset": qpos[:, :3], "pose_aa": angles[..., None] * axes, "dof": qpos[:, 7:][:, kept],
        "root_rot": qpos[:, [4, 5, 6, 3]], "fps": 50,
    }  # fmt: skip


@pytest.mark.parametrize("pack", [bytes, zlib.compress, gzip.compress, bz2.compress])
@pytest.mark.parametrize("lacks", [("wrist",), ("waist_roll", "waist_pitch", "wrist_pitch", "wrist_yaw")])
def test_joblib_and_joints_proved_by_their_axes(tmp_path, qpos, pack, lacks):
    kept = [i for i, name in enumerate(NAMES) if not any(word in name for word in lacks)]
    (tmp_path / "a.pkl").write_bytes(pack(joblib_pickle(asap(qpos, kept))))
    clip = motion.load(tmp_path / "a.pkl")
    expected = np.zeros_like(qpos)
    expected[:, :7] = qpos[:, :7]
    expected[:, [7 + i for i in kept]] = qpos[:, [7 + i for i in kept]]
    same(clip, expected)
    assert fact(clip, "joints") == ("23 in the model's order", "the axes in pose_aa tell which")


def test_a_dictionary_of_motions(tmp_path, qpos):
    path, one = tmp_path / "a.pkl", asap(qpos, range(29))
    path.write_bytes(pickle.dumps({"0-walk": one}))
    same(motion.load(path), qpos)
    path.write_bytes(pickle.dumps({"0-walk": one, "1-run": one}))
    refused(path, "2 motions (0-walk, 1-run), expected one per file")


def test_fewer_joints_in_a_pickle(tmp_path, qpos):
    content = {"fps": 50.0, "root_pos": qpos[:, :3], "root_rot": qpos[:, [4, 5, 6, 3]], "dof_pos": qpos[:, 7:30]}
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(content))
    refused(path, "dof_pos has 23 joints and no names", "--without wrist or --without waist_roll,")
    assert not motion.load(path, without="wrist").qpos[:, [7 + i for i in WRISTS]].any()
    names = [n for n in NAMES if "wrist" not in n]
    path.write_bytes(pickle.dumps(content | {"dof_names": [n.removesuffix("_joint") for n in names]}))
    assert fact(motion.load(path), "joints") == ("23 by name", "the file's names")
    path.write_bytes(pickle.dumps(content | {"dof_names": [n.replace("left_knee", "knie") for n in names]}))
    refused(path, "no joint 'left_knee_joint'")


def torch_archive(path, tensors, *, order="little", numbers=()):
    """A dictionary of float tensors as PyTorch writes it; the arrays lie in members, with strides."""
    out = io.BytesIO(b"")
    out.write(b"\x80\x02}(")
    with zipfile.ZipFile(path, "w") as archive:
        for name, value in numbers:
            out.write(b"X" + struct.pack("<I", len(name)) + name.encode() + b"K" + bytes([value]))
        for i, (name, value) in enumerate(tensors.items()):
            shape = b"(" + b"".join(b"K" + bytes([n]) for n in value.shape) + b"t"
            steps = np.array(value.strides) // value.itemsize
            stride = b"(" + b"".join(b"M" + struct.pack("<H", n) for n in steps) + b"t"
            out.write(b"X" + struct.pack("<I", len(name)) + name.encode() + b"ctorch._utils\n_rebuild_tensor_v2\n((")
            out.write(b"X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\0" + str(i).encode() + b"X\x03\0\0\0cpu")
            out.write(b"M" + struct.pack("<H", value.size) + b"tQK\x00" + shape + stride)
            out.write(b"\x89ccollections\nOrderedDict\n)RtR")
            raw = value.ravel(order="K").astype("<f4" if order == "little" else ">f4")
            archive.writestr(f"a/data/{i}", raw.tobytes())
        archive.writestr("a/data.pkl", out.getvalue() + b"u.")
        archive.writestr("a/byteorder", order)
        archive.writestr("a/version", "3\n")
    return path


@pytest.fixture
def protomotions(qpos):
    position, turn = places(qpos)
    return {
        "rigid_body_pos": np.array(position[:, 1:], "f4", order="C"),
        "rigid_body_rot": np.array(turn[:, 1:, [1, 2, 3, 0]], "f4", order="C"),
        "dof_pos": np.array(qpos[:, 7:], "f4", order="F"),  # strides are not those of rows
    }


@pytest.mark.parametrize("order", ["little", "big"])
def test_pytorch_archives(tmp_path, qpos, protomotions, order):
    clip = motion.load(torch_archive(tmp_path / "a.motion", protomotions, order=order, numbers=[("fps", 50)]))
    same(clip, qpos)
    assert fact(clip, "format")[0] == "ProtoMotions" and fact(clip, "quaternion")[0] == "xyzw"


def test_pytorch_archives_run_nothing(tmp_path, protomotions):
    path = tmp_path / "a.pt"
    for code, word in (
        (b"\x80\x02cos\nsystem\nX\x04\0\0\0true\x85R.", "the pickle names os.system"),
        (b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\0"
         b"0X\x03\0\0\0cpuK\x01tQK\x00(J\xff\xff\xff\x7ft(K\x01t\x89)tR.", "beyond its storage"),
        (b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\0"
         b"0X\x03\0\0\0cpuK\x01tQK\x00(J\xff\xff\xff\x7ft(K\x00t\x89)tR.", "beyond its storage"),
        (b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n((X\x07\0\0\0storagectorch\nFloatStorage\nX\x08\0\0\0"
         b"../../etX\x03\0\0\0cpuK\x01tQ.", "not a storage"),
        (b"\x80\x02ccollections\nOrderedDict\n)R(K\x01K\x02u.", "keys are not text"),
        (b"\x80\x02]K\x01a.", "holds a list, expected a dictionary"),
    ):  # fmt: skip
        with zipfile.ZipFile(path, "w") as out:
            out.writestr("a/data.pkl", code)
            out.writestr("a/data/0", bytes(16))
        refused(path, word)
    path.write_bytes(b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.")
    refused(path, "an archive of PyTorch before 1.6")


def test_a_looping_clip_is_repeated(tmp_path, qpos):
    """MimicKit's loop of one stride goes on where it ended, at its speed, without a jump."""
    walk = motion.load("walk")
    stride = walk.qpos[: 1 + round(1.08 * walk.rate)]
    frames = np.concatenate([stride[:, :3], rotations.log_map(stride[:, 3:7]), stride[:, 7:]], axis=1)
    path = tmp_path / "a.pkl"
    for mode, seconds in ((1, 10.8), (0, 1.08)):
        path.write_bytes(pickle.dumps({"fps": 50, "loop_mode": mode, "frames": frames.tolist()}))
        clip = motion.load(path)
        assert clip.duration == pytest.approx(seconds)
    path.write_bytes(pickle.dumps({"fps": 50, "loop_mode": 1, "frames": frames.tolist()}))
    clip = motion.load(path)
    assert fact(clip, "loop") == ("10 times", "the file says that it loops")
    assert np.abs(np.diff(clip.qpos[:, 7:], axis=0)).max() < 1.2 * np.abs(np.diff(walk.qpos[:, 7:], axis=0)).max()
    assert clip.qpos[-1, 0] - clip.qpos[0, 0] == pytest.approx(10 * (stride[-1, 0] - stride[0, 0]), rel=0.02)
    assert len(motion.load(path, frames="0:40")) == 41


# --- damage ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["joblib", "zlib", "torch", "objects", "header"])
def test_flipped_bytes_end_in_one_sentence(tmp_path, qpos, protomotions, kind):
    path = tmp_path / "a"
    if kind == "torch":
        torch_archive(path, protomotions, numbers=[("fps", 50)])
    elif kind == "objects":
        position, turn = places(qpos[:20])
        archive(path, fps=[RATE], joint_pos=qpos[:20, 7:], body_pos_w=position[:, 1:], body_quat_w=turn[:, 1:],
                joint_names=np.array(NAMES, object))  # fmt: skip
    elif kind == "header":
        text(path, qpos[:20], header=["x", "y", "z", "qx", "qy", "qz", "qw", *NAMES])
    else:
        raw = joblib_pickle(asap(qpos, range(29)))
        path.write_bytes(zlib.compress(raw) if kind == "zlib" else raw)
    whole, rng, fine = path.read_bytes(), np.random.default_rng(7), 0
    for round_ in range(120):
        damaged = bytearray(whole)
        # Half of the flips fall on the instructions, at the start or (in archives) at the end.
        far = len(whole) if round_ % 2 else min(700, len(whole))
        for at in rng.integers(0, far, 1 + round_ % 6):
            damaged[at if round_ % 4 else len(whole) - 1 - at] = rng.integers(256)
        path.write_bytes(damaged[: rng.integers(1, len(whole))] if round_ % 10 == 9 else damaged)
        try:
            loaded = motion.load(path)
        except UserError as error:
            assert str(path) in str(error) and "\n" not in str(error)
        else:
            fine += 1
            assert np.isfinite(loaded.qpos).all()
    assert fine < 110


def test_a_compressed_bomb_is_cheap(tmp_path, monkeypatch):
    monkeypatch.setattr(pickled, "MOST_BYTES", 1 << 16)
    (tmp_path / "a.pkl").write_bytes(zlib.compress(bytes(1 << 24)))
    refused(tmp_path / "a.pkl", "unpacks to more than")


# --- commands --------------------------------------------------------------------------------------------------------


def test_import_prints_what_was_read(tmp_path, qpos, capsys):
    path = text(tmp_path / "a.csv", qpos, order="wxyz", columns=[i for i in range(36) if i - 7 not in WRISTS])
    cli.main(["motion", "import", str(path), "--without", "wrist", "--fps", "50", "--out", str(tmp_path / "b.npz")])
    out = capsys.readouterr().out
    for words in ("text", "unitree_g1", "23 in the model's order", "as xyzw the root is upside down", "50 Hz", "--fps",
                  "warning: 6 joints that the file lacks are at zero"):  # fmt: skip
        assert words in out
    cli.main(["motion", "import", "walk", "--repeat", "2", "--out", str(tmp_path / "c.npz")])
    assert motion.load(tmp_path / "c.npz").duration == pytest.approx(2 * motion.load("walk").duration)
    with pytest.raises(SystemExit) as end:
        cli.main(["motion", "import", "walk", "--repeat", "0", "--out", str(tmp_path / "d.npz")])
    assert end.value.code == 2


# --- strangers' own files, where they are present --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "options", "height"),
    [
        ("asap_joblib.pkl", {}, 0.9),
        ("gmt_23dof_60rows.pkl", {"without": "wrist"}, 0.77),
        ("holosoma_60rows.npz", {}, 0.70),
        ("holosoma_60rows_joints_only_world_first.npz", {}, 0.70),
        ("isaaclab_amp_G1_60rows.npz", {}, 0.795),
        ("mimickit_g1_run_25frames.pkl", {}, 0.71),
        ("mjlab_order_14_bodies.npz", {}, 0.77),
        ("mjlab_order_world_first.npz", {}, 0.77),
        ("protomotions_crouch.motion", {}, 0.45),
        ("unitree_rl_lab_60hz_120rows.csv", {}, 0.67),
        ("walk_23dof.csv", {"without": "waist_roll,waist_pitch,wrist_pitch,wrist_yaw"}, 0.746),
        ("walk_degrees.csv", {"degrees": True}, 0.746),
        ("walk_header.csv", {}, 0.746),
        ("walk_semicolon.csv", {}, 0.746),
        ("walk_space.csv", {}, 0.746),
        ("walk_trailing_comma.csv", {}, 0.746),
        ("walk_wxyz.csv", {}, 0.746),
        ("wbc_mjlab_60rows_object_names.npz", {}, 0.77),
    ],
)
def test_strangers_files_are_read(external, name, options, height):
    clip = motion.load(external(name), **options)
    assert clip.qpos[0, 2] == pytest.approx(height, abs=0.02)
    assert rotations.up(clip.qpos[:, 3:7]).mean() > (-0.5 if "crouch" in name else 0.5)
    assert {"format", "robot", "joints", "quaternion", "rate"} <= {f.what for f in clip.reading.facts}
    if name.startswith("walk_") and "23" not in name:
        np.testing.assert_allclose(clip.qpos, motion.load(external("walk30.csv")).qpos, atol=2e-4)


def test_mjlab_files_of_one_motion_agree(external):
    names = ("mjlab_order_14_bodies.npz", "mjlab_order_world_first.npz", "wbc_mjlab_60rows_object_names.npz")
    clips = [formats.load(external(name)).qpos for name in names]
    np.testing.assert_allclose(clips[1], clips[0], atol=1e-6)
    np.testing.assert_allclose(clips[2], clips[0], atol=1e-6)
