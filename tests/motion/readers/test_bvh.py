"""BVH files written by hand: where the joints go in closed form, and every sentence that a bad file earns."""

import re
import time

import numpy as np
import pytest

from fmpjax import rotations
from fmpjax.errors import UserError
from fmpjax.motion import bvh

ARM = """HIERARCHY
ROOT Hips
{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Arm {
    OFFSET 0 10 0
    CHANNELS 3 Yrotation Xrotation Zrotation
    JOINT Hand
    {
      OFFSET 0 0 5
      CHANNELS 0
      End Site
      {
        OFFSET 2 0 0
      }
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.02
0 0 0 0 0 0 0 0 0
7 8 9 90 0 0 0 90 0
"""


@pytest.fixture
def write(tmp_path):
    def write(text):
        path = tmp_path / "clip.bvh"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def quarter(axis, degrees=90.0):
    return rotations.exp_map(np.radians(degrees) * np.eye(3)["XYZ".index(axis)])


# --- poses -----------------------------------------------------------------------------------------------------------


def test_skeleton(write):
    found = bvh.read(write(ARM))
    assert found.names == ("Hips", "Arm", "Hand", "Hand end")
    assert found.parent.tolist() == [-1, 0, 1, 2]
    assert found.offset.tolist() == [[1, 2, 3], [0, 10, 0], [0, 0, 5], [2, 0, 0]]
    assert found.channels == ((0, 1, 2, 5, 3, 4), (4, 3, 5), (), ())
    assert found.rate == 50
    assert found.values.shape == (2, 9)


def test_nested_offsets_turn_with_their_parents(write):
    position, rotation_wxyz = bvh.read(write(ARM)).poses()
    # At rest the root stands at its channels, which replace the offset; the rest of the chain adds up.
    np.testing.assert_allclose(position[0], [[0, 0, 0], [0, 10, 0], [0, 10, 5], [2, 10, 5]], atol=1e-12)
    # The root turns y to -x, so the arm lies along -x. The arm's quarter turn about its own x axis, which now is the
    # world's y, takes z to x: its hand is 5 along +x, and the hand's end 2 along the arm's x axis, the world's y.
    np.testing.assert_allclose(position[1], [[7, 8, 9], [-3, 8, 9], [2, 8, 9], [2, 10, 9]], atol=1e-12)
    turn = rotations.multiply(quarter("Z"), quarter("X"))
    np.testing.assert_allclose(np.abs(rotation_wxyz[1, 3] @ turn), 1, atol=1e-12)


@pytest.mark.parametrize("order", ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"])
def test_rotations_multiply_in_the_order_written(write, order):
    names = " ".join(f"{axis}rotation" for axis in order)
    text = f"HIERARCHY\nROOT a\n{{\nOFFSET 0 0 0\nCHANNELS 3 {names}\n}}\nMOTION\nFrames: 1\nFrame Time: 1\n10 20 30\n"
    found = bvh.read(write(text)).poses().rotation_wxyz[0, 0]
    a, b, c = (quarter(axis, degrees) for axis, degrees in zip(order, (10, 20, 30), strict=True))
    np.testing.assert_allclose(found, rotations.multiply(rotations.multiply(a, b), c), atol=1e-12)


def test_lone_position_channel_replaces_its_component(write):
    text = ARM.replace("CHANNELS 0", "CHANNELS 1 Yposition").replace("0 0 0 0 0 0 0 0 0", "0 0 0 0 0 0 0 0 0 4")
    text = text.replace("90 0\n", "90 0 4\n")
    position = bvh.read(write(text)).poses().position
    np.testing.assert_allclose(position[0, 2], [0, 14, 5], atol=1e-12)


def test_layout_does_not_matter(write):
    expected = bvh.read(write(ARM))
    packed = ARM.replace("\n  ", " ").replace("Hand\n    {", "Hand {").replace("{\n", "{ ").replace("}\n  }", "} }")
    for text in (ARM.replace("\n", "\r\n"), "\ufeff" + ARM, ARM + "\n\n", packed, ARM.replace("rotation", "ROTATION")):
        found = bvh.read(write(text))
        assert found.names == expected.names
        assert found.channels == expected.channels
        np.testing.assert_array_equal(found.values, expected.values)


# --- faults ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("HIERARCHY", "", "line 1 is '', expected HIERARCHY"),
        ("HIERARCHY", "SKELETON", "line 1 is 'SKELETON', expected HIERARCHY"),
        ("MOTION", "", "no line MOTION"),
        ("  OFFSET 1 2 3\n", "", "line 18 ends joint 'Hips', expected its OFFSET first"),
        ("OFFSET 1 2 3", "OFFSET 1 2", "line 4 has 'CHANNELS', expected a number"),
        ("OFFSET 1 2 3", "OFFSET 1 nan 3", "line 4 has 'nan', expected a number"),
        ("OFFSET 1 2 3", "OFFSET 1 2 3 4", "line 4 has '4' within joint 'Hips'"),
        ("OFFSET 1 2 3", "OFFSET 1 1e300 3", "line 4 has '1e300', expected a number of at most 1e.09"),
        ("      CHANNELS 0\n", "", "line 12 opens a joint within 'Hand', expected its CHANNELS first"),
        ("CHANNELS 3", "CHANNELS three", "line 8 has 'three' CHANNELS, expected 0 to 6"),
        ("CHANNELS 3", "CHANNELS 1000000000000", "line 8 has '1000000000000' CHANNELS, expected 0 to 6"),
        ("CHANNELS 3", "CHANNELS 4", "line 9 has 'JOINT' as channel 4 of 4"),
        ("CHANNELS 3", "CHANNELS 2", "line 8 has 'Zrotation' within joint 'Arm'"),
        (
            "Yrotation Xrotation Z",
            "Yrotation Yrotation Z",
            "line 8 has 'Yrotation' as channel 2 of 3, expected",
        ),
        ("Yrotation Xrotation Z", "Yrotation Wrotation Z", "line 8 has 'Wrotation' as channel 2 of 3"),
        ("JOINT Hand", "JOINT Arm", "line 9 names a joint 'Arm', expected a name that no other joint has"),
        ("JOINT Hand", "JOINT", "line 9 names a joint '', expected a name"),
        ("JOINT Hand", "ROOT Hand", "line 9 has 'ROOT' within joint 'Arm'"),
        ("JOINT Hand\n    {", "JOINT Hand", "line 10 has 'OFFSET', expected { after the joint's name"),
        ("  }\n}\nMOTION", "  }\nMOTION", "line 19 has 'MOTION' within joint 'Hips'"),
        ("}\nMOTION", "}\n}\nMOTION", "line 20 has '}' outside of the root"),
        ("}\nMOTION", "}\nROOT Two\nMOTION", "line 20 has 'ROOT' outside of the root"),
        ("Frames: 2", "Frames: two", "line 21 has 'two', expected a number"),
        ("Frames: 2", "Frame: 2", "line 21 is 'Frame: 2', expected Frames: and a number"),
        ("Frames: 2", "Frames: 1000000000", "line 21 announces 1000000000 frames and 2 rows follow"),
        ("Frames: 2", "Frames: -1", "line 21 announces -1 frames and 2 rows follow"),
        ("Frames: 2", "Frames: 3", "line 21 announces 3 frames and 2 rows follow"),
        ("Frames: 2", "Frames: 1", "line 21 announces 1 frames and 2 rows follow"),
        ("Frame Time: 0.02", "Frame Time: 0", "line 22 has a frame time of 0 s, expected a positive number"),
        ("Frame Time: 0.02", "Frame Time: 1e-320", "line 22 has a frame time of 9.99989e-321 s"),
        ("Frame Time: 0.02", "", "line 22 is '', expected Frame Time: and a number"),
        ("7 8 9 90", "7 8 90", "line 24 has 8 values, expected 9, one per channel"),
        ("7 8 9 90", "7 8 9 90 1", "line 24 has 10 values, expected 9"),
        ("7 8 9 90", "7 8 x 90", "line 24 has 'x', expected a number"),
        ("7 8 9 90", "7 8 nan 90", "line 24, value 3 is nan, expected a number"),
        ("7 8 9 90", "7 8 -inf 90", "line 24, value 3 is -inf, expected a number"),
        ("7 8 9 90", "7 8 1e300 90", "line 24, value 3 is 1e.300, expected a number of at most 1e.09 in size"),
    ],
)
def test_faults(write, old, new, sentence):
    assert old in ARM
    with pytest.raises(UserError, match=sentence) as caught:
        bvh.read(write(ARM.replace(old, new, 1)))
    assert "clip.bvh" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_faults_of_the_file_itself(write, tmp_path):
    with pytest.raises(UserError, match="cannot read .*none.bvh: No such file"):
        bvh.read(tmp_path / "none.bvh")
    with pytest.raises(UserError, match="cannot read"):
        bvh.read(tmp_path)
    with pytest.raises(UserError, match="not a text file, expected BVH"):
        bvh.read(write(b"HIERARCHY\xff\xfe"))
    with pytest.raises(UserError, match="line 1 is '', expected HIERARCHY"):
        bvh.read(write(""))
    with pytest.raises(UserError, match="line 2 has 2000000 characters, expected at most 1048576"):
        bvh.read(write("HIERARCHY\n" + "{" * 2_000_000))


def test_deep_and_wide_skeletons_end_in_a_sentence(write):
    body = "{ OFFSET 0 0 0 CHANNELS 0 "
    deep = "".join(f"JOINT a{i} {body}\n" for i in range(5000))
    began = time.perf_counter()
    with pytest.raises(UserError, match="line 1002 has more than 1000 joints"):
        bvh.read(write(f"HIERARCHY\nROOT r {body}\n{deep}MOTION\n"))
    assert time.perf_counter() - began < 2


def test_fuzz(write):
    """Whatever is cut out, doubled or overwritten, a file is read or refused in one sentence."""
    random = np.random.default_rng(0)
    scraps = [
        "",
        "{",
        "}",
        "JOINT",
        "End Site",
        "MOTION",
        "OFFSET",
        "CHANNELS 6",
        "nan",
        "-1",
        "1e400",
        "\0",
        "é",
        "\n",
    ]
    refused = 0
    for _ in range(300):
        start, stop = np.sort(random.integers(len(ARM), size=2))
        stop = min(stop, start + random.integers(1, 40))
        text = ARM[:start] + str(random.choice(scraps)) + ARM[stop - random.integers(2) * (stop - start) :]
        try:
            found = bvh.read(write(text))
        except UserError as error:
            refused += 1
            assert re.fullmatch(r"[^\n]{10,300}", str(error))
        else:
            assert np.isfinite(found.poses().position).all()
    assert 100 < refused < 300
