"""Every format round-trips on files made here, and every damaged file is one sentence at little cost."""

import io
import os
import pickle
import resource
import struct
import sys
import time
import zipfile

import mujoco
import numpy as np
import pytest

from fmpjax import motion, robots, rotations
from fmpjax.errors import UserError
from fmpjax.motion.readers import bodies as bodies_reader
from fmpjax.motion.readers import pickled

ROBOT = robots.load("unitree_g1")
JOINTS = ROBOT.joint_count
RATE = 40.0
# Isaac Lab's order of the G1's joints as its users list it, by position in the model's order.
ISAAC = "0 6 12 1 7 13 2 8 14 3 9 15 22 4 10 16 23 5 11 17 24 18 25 19 26 20 27 21 28"


@pytest.fixture(scope="module")
def qpos():
    """Thirty frames in which every joint differs, with the first quaternion's w positive."""
    rng = np.random.default_rng(0)
    t = np.arange(30)[:, None] / RATE
    low, high = ROBOT.joint_low, ROBOT.joint_high
    joints = low + (high - low) * (0.5 + 0.4 * np.sin(3 * t + rng.uniform(0, 6, JOINTS)))
    turn = rotations.exp_map(t * np.array([0.3, -0.5, 0.9]) + np.array([0.1, 0.2, -0.4]))
    return np.concatenate([t * [0.7, -0.2, 0.05] + [1.0, 2.0, 0.8], turn, joints], axis=1)


def bodies(qpos):
    data = mujoco.MjData(ROBOT.model)
    position, turn = [], []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(ROBOT.model, data)
        position.append(data.xpos[1:].copy())
        turn.append(data.xquat[1:].copy())
    return np.array(position), np.array(turn)


def mimickit(qpos):
    frames = np.concatenate([qpos[:, :3], rotations.log_map(qpos[:, 3:7]), qpos[:, 7:]], axis=1)
    return {"fps": int(RATE), "loop_mode": 0, "frames": frames}


def gmr(qpos):
    xyzw = qpos[:, [4, 5, 6, 3]]
    extra = {"local_body_pos": None, "link_body_list": ["pelvis", "head"]}
    return {"fps": np.float64(RATE), "root_pos": qpos[:, :3], "root_rot": xyzw, "dof_pos": qpos[:, 7:], **extra}


def locomujoco(qpos):
    order = np.random.default_rng(1).permutation(JOINTS)
    names = ["root", *np.array(ROBOT.joint_names)[order], "left_thumb"]
    wide = np.concatenate([qpos[:, :7], qpos[:, 7 + order], np.ones((len(qpos), 1))], axis=1)
    return {"qpos": wide, "joint_names": names, "frequency": RATE, "split_points": [0, len(qpos)], "xpos": np.zeros(0)}


def deep(qpos):
    position, turn = bodies(qpos)
    return {"fps": [RATE], "joint_pos": qpos[:, 7:], "body_pos_w": position, "body_quat_w": turn}


def wide(qpos):
    content = deep(qpos)
    order, joints = bodies_reader.breadth_first(ROBOT)
    places = {key: content[key][:, order] for key in ("body_pos_w", "body_quat_w")}
    return content | places | {"joint_pos": qpos[:, 7 + joints]}


def named(qpos):
    order = np.random.default_rng(2).permutation(JOINTS)
    names = np.array(ROBOT.joint_names)[order]
    content = deep(qpos) | {"joint_pos": qpos[:, 7 + order], "joint_names": names}
    return content | {key: content[key][:, :1] for key in ("body_pos_w", "body_quat_w")}


def own(qpos):
    return {"qpos": qpos, "rate": RATE, "robot": "unitree_g1"}


PICKLES, ARCHIVES = (mimickit, gmr), (locomujoco, deep, wide, named, own)


def write(path, make, qpos, protocol=4):
    content = make(qpos)
    if make in PICKLES:
        path.write_bytes(pickle.dumps(content, protocol))
    else:
        with path.open("wb") as stream:
            np.savez(stream, **content)
    return path


def fails(path, word=""):
    """Loading fails with one sentence that names the file."""
    with pytest.raises(UserError) as caught:
        motion.load(path, rate=RATE)
    message = str(caught.value)
    assert str(path) in message and word in message and "\n" not in message and len(message) < 600, message


@pytest.mark.parametrize("make", PICKLES + ARCHIVES)
def test_round_trip_whatever_the_name(tmp_path, qpos, make):
    loaded = motion.load(write(tmp_path / "clip.dat", make, qpos), rate=RATE)
    np.testing.assert_allclose(loaded.qpos, qpos, atol=1e-12)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("make", PICKLES)
def test_every_protocol_and_single_precision(tmp_path, qpos, make, protocol):
    def single(qpos):
        content = make(qpos)
        return {
            k: v.astype(">f4" if protocol else "f4") if isinstance(v, np.ndarray) else v for k, v in content.items()
        }

    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(single(qpos), protocol))
    np.testing.assert_allclose(motion.load(path, rate=RATE).qpos, qpos, atol=1e-6)


def test_lists_and_fortran_order(tmp_path, qpos):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(mimickit(qpos) | {"frames": mimickit(qpos)["frames"].tolist()}))
    np.testing.assert_allclose(motion.load(path, rate=RATE).qpos, qpos, atol=1e-12)
    path.write_bytes(pickle.dumps(mimickit(qpos) | {"frames": np.asfortranarray(mimickit(qpos)["frames"])}))
    np.testing.assert_allclose(motion.load(path, rate=RATE).qpos, qpos, atol=1e-12)


def test_breadth_first_order():
    assert " ".join(map(str, bodies_reader.breadth_first(ROBOT)[1])) == ISAAC


def test_bodies_of_another_robot(tmp_path, qpos):
    far = deep(qpos)
    far["body_pos_w"] = far["body_pos_w"] * 1.5
    with (tmp_path / "a.npz").open("wb") as stream:
        np.savez(stream, **far)
    fails(tmp_path / "a.npz", "from where joint_pos puts those of robot 'unitree_g1'")


@pytest.mark.parametrize("make", PICKLES + ARCHIVES)
def test_cut_short_and_damaged(tmp_path, qpos, make):
    path = write(tmp_path / "a", make, qpos)
    whole = path.read_bytes()
    for size in (0, 1, 3, 20, len(whole) // 3, len(whole) - 1):
        path.write_bytes(whole[:size])
        fails(path)
    rng = np.random.default_rng(3)
    for _ in range(40):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), 8):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            loaded = motion.load(path, rate=RATE)
        except UserError as error:
            assert str(path) in str(error)
        else:
            assert np.isfinite(loaded.qpos).all()


def test_damaged_text(tmp_path, qpos):
    """A CSV with bytes changed, lines cut, doubled or swapped loads as finite numbers or is one sentence."""
    path, rng = tmp_path / "a.csv", np.random.default_rng(5)
    rows = np.concatenate([qpos[:, :3], qpos[:, [4, 5, 6, 3]], qpos[:, 7:]], axis=1)
    whole = "\n".join(",".join(f"{v:.6f}" for v in row) for row in rows).encode()
    refused = 0
    for round_ in range(200):
        damaged = bytearray(whole)
        if round_ % 2:
            start, end = np.sort(rng.integers(0, len(whole), 2))
            piece = damaged[start:end]
            damaged[start:end] = (b"", piece * 2, piece[::-1])[round_ % 3]
        for at in rng.integers(0, len(damaged), 1 + round_ % 5) if damaged else ():
            damaged[at] = rng.choice(list(b",-.e9n\n\r\x00 \xff\xe9"))
        path.write_bytes(damaged)
        try:
            loaded = motion.load(path)
        except UserError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            refused += 1
        else:
            assert np.isfinite(loaded.qpos).all()
    assert 100 < refused < 200


@pytest.mark.parametrize("make", PICKLES + ARCHIVES)
def test_wrong_values(tmp_path, qpos, make):
    """Each array in turn with NaN, another type, another shape; each rate zero, negative, infinite, text, missing."""
    unread = {"loop_mode", "local_body_pos", "link_body_list", "xpos", "split_points"}
    for key, value in make(qpos).items():
        if key in unread:
            continue
        value = np.asarray(value)
        if value.dtype.kind == "U":
            bad = [np.array(["x"]), np.zeros(3), np.array([], "U1")]
        elif value.size == 1:
            bad = [np.float64(x) for x in (0, -30, np.nan, np.inf)] + [np.array(["50"]), np.array([50.0, 30.0]), 1e-300]
        else:
            nan = value.copy()
            nan.flat[value.shape[1] + 1] = np.nan
            bad = [
                nan,
                value[:5],
                value[:, :-1] if value.ndim == 2 else value[..., :-1],
                value.astype("U8"),
                value * 1j,
            ]
            bad += [np.zeros((0, *value.shape[1:])), np.zeros_like(value), np.float64(1.0), value.ravel()]
            bad = bad[:6] + bad[7:] if key in ("frames", "joint_pos", "dof_pos", "root_pos", "body_pos_w") else bad
        for other in bad:
            path = tmp_path / "b"
            changed = make(qpos) | {key: other}
            if make in PICKLES:
                path.write_bytes(pickle.dumps(changed))
            else:
                with path.open("wb") as stream:
                    np.savez(stream, **changed)
            fails(path)


def test_several_trajectories_and_missing_joints(tmp_path, qpos):
    for change, word in (
        ({"split_points": [0, 10, 30]}, "2 trajectories"),
        ({"joint_names": ["root"] * 31}, "no joint"),
    ):
        with (tmp_path / "a").open("wb") as stream:
            np.savez(stream, **(locomujoco(qpos) | change))
        fails(tmp_path / "a", word)


# --- hostile files ---------------------------------------------------------------------------------------------------


class Call:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


HEAD = b"\x80\x04"


@pytest.mark.parametrize(
    "payload",
    [
        Call(os.system, "touch {flag}"),
        Call(eval, "open({flag!r}, 'w')"),
        Call(np.ndarray, (10**10,)),
        Call(np.load, "{flag}"),
        {(1, 2): 3},
        [1, 2],
        np.array([Call(os.system, "touch {flag}")], object),
        np.array(["text"]),
        {1, 2},
        frozenset([1]),
    ],
)
def test_pickles_run_nothing(tmp_path, payload):
    flag = tmp_path / "flag"
    if isinstance(payload, Call):
        function, arguments = payload.call
        payload = Call(function, *(a.format(flag=str(flag)) if isinstance(a, str) else a for a in arguments))
    for content in (payload, {"fps": 30, "frames": payload}):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
        fails(tmp_path / "a.pkl")
        assert not flag.exists()


def _peak() -> int:
    """Most memory that this process has had, kB, in which Linux counts; macOS counts in bytes."""
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most // 1024 if sys.platform == "darwin" else most


@pytest.mark.parametrize(
    "code",
    [
        b"r\xff\xff\xff\x7f.",  # a memo entry 2^31
        b"\x8e" + struct.pack("<Q", 1 << 60) + b".",  # bytes of an exabyte
        b"\x96" + struct.pack("<Q", 1 << 45) + b".",  # a bytearray of 35 TB
        b"\x95" + struct.pack("<Q", 1 << 50) + b".",  # a frame
        b")" + b"\x85" * 100_000 + b"}" + b"s.",  # a deep tuple as a key
        b"]" * 50_000 + b"a" * 49_999 + b".",  # a deep list
        b"}(\x8c\x06frames]" + b"(\x8c\x01x" + b"2" * 1000 + b"eu.",
        b"cos\nsystem\n(\x8c\x04truetR.",
        b"\x8c\x02os\x8c\x06system\x93.",
        b"cnumpy.core.multiarray\n_reconstruct\n}\x8c\x08__init__Nsb.",  # a state for a class
        b"\x82\x01.",
        b"Pwho\n.",
        b".",
        b"",
    ],
)
def test_hostile_programs_are_cheap(tmp_path, code):
    (tmp_path / "a.pkl").write_bytes(HEAD + code)
    before, start = _peak(), time.process_time()
    fails(tmp_path / "a.pkl")
    assert time.process_time() - start < 3
    assert _peak() - before < 300_000


def test_nested_lists_do_not_unfold(tmp_path):
    bomb = [0.0] * 100
    for _ in range(20):
        bomb = [bomb] * 100
    whole = {
        name: bomb for name in ("rigid_body_pos", "rigid_body_rot", "dof_pos", "dof", "root_rot", "pose_aa", "qpos")
    }
    whole |= {"fps": 30, "root_trans_offset": bomb, "rate": 30, "robot": "unitree_g1", "split_points": bomb}
    for content in (
        {"fps": bomb, "frames": np.zeros((20, 35))},
        {"fps": 30, "frames": bomb},
        {"fps": 30, "loop_mode": bomb, "frames": np.zeros((20, 35)), "dof_pos": bomb},
        {"fps": 30, "root_pos": bomb, "root_rot": bomb, "dof_pos": bomb, "dof_names": bomb},
        whole,
        {name: value for name, value in whole.items() if name not in ("rate", "robot")},
        {name: value for name, value in whole.items() if name not in ("rate", "robot", "dof_pos")},
        {
            "qpos": np.zeros((20, 36)),
            "joint_names": ["root", *ROBOT.joint_names],
            "frequency": bomb,
            "split_points": bomb,
        },
    ):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(content))
        start = time.process_time()
        if "loop_mode" in content:
            content["loop_mode"] = None  # not read, and so no fault; the quaternions of zero vectors are fine
            motion.load(tmp_path / "a.pkl")
        else:
            fails(tmp_path / "a.pkl")
        assert time.process_time() - start < 1


def test_announced_sizes_cost_nothing(tmp_path, qpos):
    """A header that announces 10^9 frames, a member that announces terabytes, and one that unpacks to gigabytes."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**9, 36)})
    path = tmp_path / "a.npz"

    def archive(content, **options):
        with zipfile.ZipFile(path, "w", **options) as out:
            for name, value in own(qpos).items():
                data = io.BytesIO()
                np.save(data, value)
                out.writestr(f"{name}.npy", content if name == "qpos" else data.getvalue())

    before = _peak()
    archive(header.getvalue() + bytes(80))
    fails(path, "not a readable .npz archive")
    archive(header.getvalue() + bytes(80))
    data = path.read_bytes()
    at = data.rindex(b"PK\x01\x02", 0, data.index(b"rate.npy", data.index(b"PK\x01\x02")))
    path.write_bytes(data[: at + 24] + struct.pack("<I", 0xFFFFFFF0) + data[at + 28 :])
    fails(path)
    assert _peak() - before < 200_000


def test_too_large_a_pickle_is_not_read(tmp_path):
    path = tmp_path / "a.pkl"
    with path.open("wb") as stream:
        stream.write(b"\x80")
        stream.truncate(pickled.MOST_BYTES + 1)
    fails(path, "expected at most")
