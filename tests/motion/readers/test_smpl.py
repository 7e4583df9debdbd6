"""SMPL's parameters as AMASS writes them, and a small body model of our own."""

import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fmpjax import cli, motion, rotations
from fmpjax.errors import UserError
from fmpjax.motion import bvh, retarget
from fmpjax.motion.readers import smpl

RATE = 30.0
REST = np.array([  # m, y up, arms spread, as the makers' models stand
    [0.0, 0.9, 0.0], [0.07, 0.82, 0.0], [-0.07, 0.82, 0.0], [0.0, 1.0, -0.02], [0.11, 0.45, 0.0], [-0.11, 0.45, 0.0],
    [0.0, 1.14, 0.0], [0.09, 0.06, -0.03], [-0.09, 0.06, -0.03], [0.0, 1.19, 0.0], [0.11, 0.01, 0.09],
    [-0.11, 0.01, 0.09], [0.0, 1.4, -0.03], [0.08, 1.32, -0.02], [-0.08, 1.32, -0.02], [0.0, 1.48, 0.0],
    [0.17, 1.35, -0.02], [-0.17, 1.35, -0.02], [0.43, 1.33, -0.03], [-0.43, 1.33, -0.03], [0.68, 1.34, -0.03],
    [-0.68, 1.34, -0.03],
])  # fmt: skip


def body(path, joints=52, **changed):
    """A body model whose vertices are its joints and two more, and whose first shape makes the legs longer."""
    rest = np.concatenate([REST, np.tile(REST[20], (joints - 22, 1)), [[0.0, 1.7, 0.0], [0.0, 0.0, 0.0]]])
    shapes = np.zeros((len(rest), 3, 10))
    shapes[[4, 5], 1, 0] = -0.02
    shapes[[7, 8, 10, 11], 1, 0] = -0.04
    parents = np.concatenate([smpl.PARENTS, np.full(joints - 22, 20)])
    parents[0] = 2**32 - 1  # as the makers write it
    model = {
        "v_template": rest,
        "shapedirs": shapes,
        "J_regressor": np.eye(joints, len(rest)),
        "kintree_table": np.stack([parents, np.arange(joints)]),
        "J": np.array([object()], object),
    } | changed
    np.savez(path, **{name: value for name, value in model.items() if value is not None})
    return path


@pytest.fixture(scope="module")
def steps():
    """Places ``[T, 3]`` and rotation vectors ``[T, 22, 3]`` of steps in place with bent arms, z up."""
    t = np.arange(40) / RATE
    turned = np.zeros((40, 22, 3))
    swing = np.maximum(np.sin(2 * np.pi * t), 0), np.maximum(-np.sin(2 * np.pi * t), 0)
    for side in range(2):
        turned[:, 1 + side, 0], turned[:, 4 + side, 0] = -0.1 - 0.4 * swing[side], 0.2 + 0.8 * swing[side]
        turned[:, 7 + side, 0] = -0.1 - 0.4 * swing[side]
        turned[:, 16 + side, 2] = (1 - 2 * side) * -1.3
        turned[:, 18 + side, 1] = (1 - 2 * side) * -(0.6 + 0.2 * np.sin(2 * np.pi * t))
    root = Rotation.from_euler("x", 90, degrees=True)  # y up in the model, z up in the file
    turned[:, 0] = root.as_rotvec()
    place = np.column_stack([0.02 * np.sin(2 * np.pi * t), 0.1 * t, np.zeros(40)])
    return place, turned


def parameters(steps, **changed):
    place, turned = steps
    poses = np.concatenate([turned.reshape(len(turned), 66), np.zeros((len(turned), 90))], axis=1)
    values = {"trans": place, "poses": poses, "betas": np.eye(16)[0], "gender": "male", "mocap_framerate": RATE}
    return {name: value for name, value in (values | changed).items() if value is not None}


@pytest.fixture
def amass(tmp_path, steps):
    def write(**changed):
        np.savez(tmp_path / "a.npz", **parameters(steps, **changed))
        return tmp_path / "a.npz"

    return write


def read(path, model):
    return retarget.read(path, model)


def test_joints_are_those_of_the_body_model(amass, steps, tmp_path):
    """By SciPy's rotations, joint by joint, for a body with longer legs."""
    found = read(amass(), body(tmp_path / "model.npz")).poses()
    rest = REST.copy()
    rest[[4, 5], 1] -= 0.02
    rest[[7, 8, 10, 11], 1] -= 0.04
    place, turned = steps
    world, position = [], []
    for joint, parent in enumerate(smpl.PARENTS):
        own = Rotation.from_rotvec(turned[:, joint])
        world.append(own if parent < 0 else world[parent] * own)
        at = rest[0] + place if parent < 0 else position[parent] + world[parent].apply(rest[joint] - rest[parent])
        position.append(at)
    np.testing.assert_allclose(found.position, np.stack(position, axis=1), atol=1e-12)
    for joint, expected in enumerate(world):
        wxyz = expected.as_quat()[:, [3, 0, 1, 2]]
        apart = rotations.log_map(rotations.multiply(rotations.conjugate(wxyz), found.rotation_wxyz[:, joint]))
        np.testing.assert_allclose(apart, 0, atol=1e-7)


def test_smpl_x_names_its_parts(amass, steps, tmp_path):
    """SMPL-X's file has parts in place of poses, another name of the rate, and 55 joints in the model."""
    expected = read(amass(), body(tmp_path / "model.npz"))
    place, turned = steps
    flat = turned.reshape(-1, 66)
    parts = {"poses": None, "mocap_framerate": None, "mocap_frame_rate": np.array(RATE)}
    for root, limbs in (("root_orient", "pose_body"), ("global_orient", "body_pose")):
        file = amass(**parts, **{root: flat[:, :3], limbs: flat[:, 3:]})
        found = read(file, body(tmp_path / "x.npz", 55))
        np.testing.assert_array_equal(found.values, expected.values)
        np.testing.assert_array_equal(found.offset, expected.offset)


def test_shapes_of_the_face_are_no_shapes_of_the_body(tmp_path):
    """SMPL-X's first release has ten shapes of the body and ten of the face in one array."""
    shapes = np.zeros((24 + 30, 3, 20))
    shapes[4, 0, 9] = 0.1
    shapes[4, 1, 10:] = 1.0
    model = body(tmp_path / "x.npz", 52, shapedirs=shapes)
    places = smpl.joint_places(model, np.ones(16))
    np.testing.assert_allclose(places[4], REST[4] + [0.1, 0.0, 0.0])


def test_a_body_on_the_robot_is_the_same_skeleton_on_the_robot(robot, amass, steps, tmp_path, capsys):
    """The same joints written as BVH, which has other arithmetic, give the same motion."""
    pytest.importorskip("mink")
    model = body(tmp_path / "model.npz")
    file, out = amass(), tmp_path / "out.npz"
    cli.main(["motion", "retarget", str(file), "--body-model", str(model), "--out", str(out)])
    said = capsys.readouterr().out
    for words in ("SMPL, 16 betas, male", "22 joints, 40 frames", "up          z", "30 Hz", "verdict: "):
        assert words in said
    assert "broken" not in said and said.count("  format ") == 1
    source = read(file, model)
    lines = ["HIERARCHY"]

    def visit(joint, depth):
        lines.append(
            f"{'JOINT' if depth else 'ROOT'} {smpl.JOINTS[joint]} {{ OFFSET {tuple_text(source.offset[joint])}"
        )
        place = "" if depth else "Xposition Yposition Zposition "
        lines.append(f"CHANNELS {3 if depth else 6} {place}Zrotation Yrotation Xrotation")
        columns.append(joint)
        for child in np.flatnonzero(smpl.PARENTS == joint):
            visit(child, depth + 1)
        lines.append("}")

    def tuple_text(values):
        return " ".join(f"{v:.9f}" for v in values)

    columns = []
    visit(0, 0)
    place, turned = steps
    lines += ["MOTION", f"Frames: {len(place)}", f"Frame Time: {1 / RATE:.9f}"]
    angles = [Rotation.from_rotvec(turned[:, j]).as_euler("ZYX", degrees=True) for j in columns]
    rows = np.concatenate([place + source.offset[0], *angles], axis=1)
    (tmp_path / "a.bvh").write_text("\n".join([*lines, *(tuple_text(row) for row in rows)]) + "\n")
    again = retarget.retarget(bvh.read(tmp_path / "a.bvh"), robot, "a")
    np.testing.assert_allclose(again.clip.qpos, motion.load(out, rate=RATE).qpos, atol=1e-3)


def test_a_pickle_holds_the_same(amass, steps, tmp_path):
    model = body(tmp_path / "model.npz")
    expected = read(amass(), model)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(parameters(steps, gender="male")))
    found = read(tmp_path / "a.pkl", model)
    np.testing.assert_array_equal(found.values, expected.values)
    assert found.format == expected.format
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(parameters(steps, poses=[[[]]], betas=[[1.0]])))
    with pytest.raises(UserError, match="a.pkl: poses is a list, expected an array of numbers"):
        read(tmp_path / "a.pkl", model)


def test_it_says_which_file_the_user_must_bring(amass, tmp_path, capsys):
    with pytest.raises(SystemExit) as end:
        cli.main(["motion", "retarget", str(amass()), "--out", str(tmp_path / "out.npz")])
    assert end.value.code == 2
    error = capsys.readouterr().err
    for words in ("SMPL parameters (male)", "--body-model FILE", "smplh/GENDER/model.npz", "SMPLX_GENDER.npz"):
        assert words in error
    assert not (tmp_path / "out.npz").exists()
    with pytest.raises(UserError, match="SMPL parameters of a human, which only `fmpjax motion retarget` reads"):
        motion.load(amass())


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"trans": np.zeros((39, 3))}, "39 positions of the body and 40 poses"),
        ({"poses": np.zeros((40, 63))}, "poses have 63 columns, expected 66 or more"),
        ({"poses": np.full((40, 66), np.nan)}, "poses row 0, column 0 is nan"),
        ({"poses": np.float64(1.0)}, "poses is float64 of shape ()"),
        ({"mocap_framerate": None}, "no mocap_framerate or mocap_frame_rate, expected the rate in Hz"),
        ({"mocap_framerate": -1.0}, "mocap_framerate is -1.0, expected a positive number"),
        ({"trans": None}, "expected BVH or SMPL's trans and poses"),
        ({"poses": None, "root_orient": np.zeros((40, 3)), "pose_body": np.zeros((40, 60))}, "pose_body of shape"),
    ],
)
def test_wrong_parameters(amass, tmp_path, changed, words):
    with pytest.raises(UserError) as caught:
        read(amass(**changed), body(tmp_path / "model.npz"))
    assert words in str(caught.value) and str(tmp_path / "a.npz") in str(caught.value)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"J_regressor": None}, "no J_regressor, expected --body-model FILE"),
        (
            {"J_regressor": np.eye(52, 50)},
            "J_regressor is float64 of shape (52, 50), expected",
        ),
        ({"kintree_table": np.zeros((2, 52), int)}, "are not connected like those of SMPL"),
        ({"kintree_table": np.zeros((2, 50), int)}, "expected one parent for each of 52 joints"),
        ({"shapedirs": np.zeros((54, 2, 10))}, "shapedirs is float64 of shape (54, 2, 10), expected (54, 3, any)"),
        ({"v_template": np.zeros((0, 3))}, "0 vertices, expected 1 to"),
        ({"v_template": np.arange(162.0).reshape(54, 3)}, "expected a body in meters"),
        ({"J_regressor": np.array([None])}, "'J_regressor' holds objects"),
    ],
)
def test_wrong_body_models(amass, tmp_path, changed, words):
    model = body(tmp_path / "model.npz", **changed)
    with pytest.raises(UserError) as caught:
        read(amass(), model)
    assert words in str(caught.value) and str(model) in str(caught.value) and "\n" not in str(caught.value)


def test_other_files_in_place_of_a_body_model(amass, tmp_path):
    with pytest.raises(UserError, match="cannot read .*nowhere.npz"):
        read(amass(), tmp_path / "nowhere.npz")
    (tmp_path / "model.pkl").write_bytes(pickle.dumps({"v_template": 1}))
    with pytest.raises(UserError, match="model.pkl: not an .npz, expected --body-model FILE"):
        read(amass(), tmp_path / "model.pkl")
    (tmp_path / "a.bvh").write_text("HIERARCHY\n")
    with pytest.raises(UserError, match="not SMPL parameters .*, which --body-model .*model.npz is for"):
        read(tmp_path / "a.bvh", tmp_path / "model.npz")


def test_damaged_parameters_end_in_one_sentence(amass, tmp_path):
    model, path = body(tmp_path / "model.npz"), amass()
    whole, rng, fine = path.read_bytes(), np.random.default_rng(3), 0
    for round_ in range(60):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole) if round_ % 2 else 900, 1 + round_ % 5):
            damaged[at if round_ % 4 else len(whole) - 1 - at] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            found = read(path, model)
        except UserError as error:
            assert str(path) in str(error) and "\n" not in str(error)
        else:
            fine += 1
            assert np.isfinite(found.poses().position).all()
    assert fine < 58
