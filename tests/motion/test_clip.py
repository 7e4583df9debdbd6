"""Motion clips against closed forms, and every sentence that a bad file earns."""

import os
import re
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest

from fmpjax import motion, robots, rotations
from fmpjax.errors import UserError
from fmpjax.motion import MotionClip, clip, formats

JOINTS = robots.load("unitree_g1").joint_count


def moving(rate, rows, *, axis=(0.0, 0.0, 1.0), spin=0.7, start=(1.0, 0.0, 0.0, 0.0)):
    """Constant root velocity, constant body-frame angular velocity ``spin * axis``, constant joint velocities."""
    t = np.arange(rows)[:, None] / rate
    root = np.array([0.3, -1.0, 0.8]) + t * np.array([0.9, 0.2, -0.1])
    turn = rotations.exp_map(t * spin * np.array(axis))
    joints = np.linspace(-0.2, 0.2, JOINTS) + t * np.linspace(-1.0, 1.0, JOINTS)
    return np.concatenate(
        [root, rotations.multiply(np.broadcast_to(np.array(start), turn.shape), turn), joints], axis=1
    )


def write_csv(path, qpos):
    rows = qpos.copy()
    rows[:, 3:7] = qpos[:, [4, 5, 6, 3]]
    path.write_text("\n".join(",".join(f"{v:.9f}" for v in row) for row in rows) + "\n")
    return path


@pytest.fixture
def csv(tmp_path):
    return write_csv(tmp_path / "clip.csv", moving(30.0, 40))


# --- resampling and velocities ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("source", "rate"), [(30.0, 50.0), (120.0, 50.0), (50.0, 50.0), (60.0, 50.0), (29.97, 50.0)])
def test_resampling_constant_motion_is_exact(source, rate):
    axis = np.array([0.6, 0.0, 0.8])
    rows = 61
    out = motion.resample(moving(source, rows, axis=axis), source, rate)
    assert len(out) == int(np.floor((rows - 1) / source * rate + 1e-9)) + 1
    np.testing.assert_allclose(out, moving(rate, len(out), axis=axis), atol=1e-12)


def test_a_clip_tells_its_velocity_in_its_own_heading():
    spinning = MotionClip.from_qpos("spin", "unitree_g1", 50.0, moving(50.0, 500))  # through more than a full turn
    yaw = 0.7 * np.arange(500) / 50.0
    np.testing.assert_allclose(spinning.yaw, yaw, atol=1e-9)
    assert spinning.turning == pytest.approx(0.7)
    ahead, left = 0.9 * np.cos(yaw) + 0.2 * np.sin(yaw), 0.2 * np.cos(yaw) - 0.9 * np.sin(yaw)
    np.testing.assert_allclose(spinning.heading_velocities, np.stack([ahead, left, 0.7 + 0 * yaw], axis=1), atol=1e-9)


def test_last_sample_on_the_grid_is_kept():
    out = motion.resample(moving(30.0, 211), 30.0, 50.0)
    assert len(out) == 351
    np.testing.assert_allclose(out[-1], moving(30.0, 211)[-1], atol=1e-12)
    # 7.01 s is not a multiple of 0.02 s: the grid ends before the source does.
    assert len(motion.resample(moving(100.0, 702), 100.0, 50.0)) == 351


def test_resampling_takes_the_shorter_arc():
    qpos = moving(30.0, 30, axis=(0.0, 1.0, 0.0))
    flipped = qpos.copy()
    flipped[::3, 3:7] *= -1
    np.testing.assert_allclose(motion.resample(flipped, 30.0, 50.0), motion.resample(qpos, 30.0, 50.0), atol=1e-12)


def test_quaternions_are_continuous_from_a_positive_start():
    # Two full turns about x pass through w = -1: the sign must follow, not jump.
    q = moving(50.0, 200, axis=(1.0, 0.0, 0.0), spin=np.pi)[:, 3:7]
    scrambled = q * np.where(np.arange(200) % 7 < 3, -1.0, 1.0)[:, None] * 1.01
    np.testing.assert_allclose(clip.continuous(scrambled), q, atol=1e-12)
    assert clip.continuous(-q)[0, 0] >= 0


def test_velocities_of_constant_motion():
    axis = np.array([0.48, 0.64, 0.6])
    v = motion.velocities(moving(50.0, 20, axis=axis, spin=2.0), 50.0)
    assert v.shape == (20, 6 + JOINTS)
    np.testing.assert_allclose(v[:, :3], np.tile([0.9, 0.2, -0.1], (20, 1)), atol=1e-10)
    np.testing.assert_allclose(v[:, 3:6], np.tile(2.0 * axis, (20, 1)), atol=1e-10)
    np.testing.assert_allclose(v[:, 6:], np.tile(np.linspace(-1, 1, JOINTS), (20, 1)), atol=1e-10)


def test_angular_velocity_is_in_the_body_frame():
    # A body that lies on its side (90 deg about x) turns about the world's z: its own y axis then points along z, so
    # the body-frame rate is about +y.
    t = np.arange(20)[:, None] / 50.0
    side = rotations.exp_map(np.array([np.pi / 2, 0.0, 0.0]))
    qpos = moving(50.0, 20)
    qpos[:, 3:7] = rotations.multiply(rotations.exp_map(t * np.array([0.0, 0.0, 1.5])), np.broadcast_to(side, (20, 4)))
    np.testing.assert_allclose(motion.velocities(qpos, 50.0)[:, 3:6], np.tile([0.0, 1.5, 0.0], (20, 1)), atol=1e-10)


def test_velocities_are_central_inside_and_one_sided_at_the_ends():
    qpos = moving(10.0, 12)
    t = np.arange(12) / 10.0
    qpos[:, 7] = t**2
    v = motion.velocities(qpos, 10.0)[:, 6]
    np.testing.assert_allclose(v[1:-1], 2 * t[1:-1], atol=1e-12)  # exact for a parabola
    np.testing.assert_allclose([v[0], v[-1]], [0.1, 2.1], atol=1e-12)  # the mean over the first and last interval


def test_velocities_integrate_as_mujoco_does():
    """MuJoCo's own difference of two configurations gives the same velocity, in its conventions."""
    model = robots.load("unitree_g1").model
    qpos = moving(50.0, 12, axis=(0.0, 0.8, 0.6), start=(0.5, 0.5, -0.5, 0.5))
    expected = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, expected, 0.04, qpos[4], qpos[6])
    np.testing.assert_allclose(motion.velocities(qpos, 50.0)[5], expected, atol=1e-9)


# --- files -----------------------------------------------------------------------------------------------------------


def test_csv_order_and_rate(csv):
    loaded = motion.load(csv)
    assert isinstance(loaded, MotionClip)
    assert (loaded.name, loaded.robot, loaded.rate, len(loaded)) == ("clip", "unitree_g1", 50.0, 66)
    assert loaded.duration == pytest.approx(1.3)
    np.testing.assert_allclose(loaded.qpos, moving(50.0, 66), atol=1e-8)
    np.testing.assert_allclose(loaded.qvel[:, 3:6], np.tile([0, 0, 0.7], (66, 1)), atol=1e-5)


def test_csv_with_windows_line_ends_and_a_blank_tail(csv):
    expected = motion.load(csv).qpos
    csv.write_bytes(b"\xef\xbb\xbf" + csv.read_bytes().replace(b"\n", b"\r\n") + b"\r\n\r\n")
    np.testing.assert_array_equal(motion.load(csv).qpos, expected)


def test_fps_replaces_the_source_rate(csv):
    loaded = motion.load(csv, fps=60, rate=30.0)
    assert len(loaded) == 20
    np.testing.assert_allclose(loaded.qvel[:, 0], 1.8, atol=1e-6)


@pytest.mark.parametrize("frames", [(5, 35), "5:35", np.array([5, 35])])
def test_frames_include_both_ends(csv, frames):
    loaded = motion.load(csv, frames=frames, rate=30.0)
    assert len(loaded) == 31
    np.testing.assert_allclose(loaded.qpos, moving(30.0, 40)[5:36], atol=1e-8)


def test_paper_range_gives_351_samples(tmp_path):
    path = write_csv(tmp_path / "long.csv", moving(120.0, 240))
    assert len(motion.load(path, frames="20:230")) == 351


def test_norms_within_tolerance_are_repaired(tmp_path):
    qpos = moving(30.0, 40)
    qpos[:, 3:7] *= 1.03
    loaded = motion.load(write_csv(tmp_path / "a.csv", qpos))
    np.testing.assert_allclose(np.linalg.norm(loaded.qpos[:, 3:7], axis=1), 1.0, atol=1e-12)


def test_npz_round_trip(csv, tmp_path):
    first = motion.load(csv)
    path = motion.save(first, tmp_path / "new" / "again.npz")
    assert [p.name for p in path.parent.iterdir()] == ["again.npz"]
    second = motion.load(path)
    assert second.name == "again"
    np.testing.assert_allclose(second.qpos, first.qpos, atol=1e-15)
    np.testing.assert_allclose(second.qvel, first.qvel, atol=1e-12)
    assert len(motion.load(path, rate=100.0)) == 131


def test_failed_save_leaves_the_old_file(csv, tmp_path, monkeypatch):
    path = motion.save(motion.load(csv), tmp_path / "a.npz")
    before = path.read_bytes()

    def full(*_args, **_kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(formats.np, "savez_compressed", full)
    with pytest.raises(UserError, match="cannot write .*a.npz: No space left"):
        motion.save(motion.load(csv), path)
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.npz", "clip.csv"]


def test_bundled_motion_by_name():
    assert "walk" in motion.bundled()
    loaded = motion.load("walk")
    assert loaded.name == "walk"
    assert loaded.rate == 50.0
    assert len(loaded) > 300


def test_reading_ten_thousand_rows_is_quick(tmp_path):
    path = write_csv(tmp_path / "long.csv", moving(30.0, 10_000, spin=0.1))
    motion.load(path)
    start = time.process_time()
    motion.load(path)
    assert time.process_time() - start < 1.5  # about 0.2 s; the slack is for a loaded machine


# --- one sentence for each fault -------------------------------------------------------------------------------------


def fails(pattern, *args, **kwargs):
    with pytest.raises(UserError) as caught:
        motion.load(*args, **kwargs)
    message = str(caught.value)
    assert re.search(pattern, message), message
    assert "\n" not in message


def edit(csv, line, column, text):
    lines = csv.read_text().split("\n")
    cells = lines[line - 1].split(",")
    cells[column - 1] = text
    lines[line - 1] = ",".join(cells)
    csv.write_text("\n".join(lines))


def test_missing_files(tmp_path):
    fails(r"no motion file .*nowhere\.csv: expected .* one of .*walk", tmp_path / "nowhere.csv")
    fails(r"unknown motion 'wlak': expected .* one of .*walk", "wlak")
    fails(r"unknown motion", tmp_path)
    fails(r"unknown robot 'h1': expected one of strider, unitree_g1", "walk", robot="h1")
    other = tmp_path / "clip.bvh"
    other.write_text("HIERARCHY")
    fails(r"clip\.bvh: a BVH skeleton, which only `fmpjax motion retarget`", other)


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ("", r"clip\.csv: the file is empty"),
        ("\n\n", r"clip\.csv: the file is empty"),
        (",".join(["0"] * 35), r"line 1 has 35 columns, expected 36 .*29 joints"),
        ("\n" + ",".join(["0"] * 36), r"line 1 has 0 columns, expected 36"),
    ],
)
def test_csv_shape(csv, text, pattern):
    csv.write_text(text)
    fails(pattern, csv)


def test_csv_later_line_with_other_columns(csv):
    edit(csv, 17, 4, "0,0")
    fails(r"clip\.csv: line 17 has 37 columns, expected 36", csv)


def test_csv_bad_values(csv):
    good = csv.read_text()
    edit(csv, 12, 9, "left")
    fails(r"clip\.csv: line 12, column 9 is 'left', expected a number", csv)
    csv.write_text(good)
    edit(csv, 40, 36, "")
    fails(r"clip\.csv: line 40, column 36 is '', expected a number", csv)
    for value in ("nan", "inf", "-inf"):
        csv.write_text(good)
        edit(csv, 3, 1, value)
        fails(rf"clip\.csv: line 3, column 1 is {value}, expected a finite number", csv)
    csv.write_text(good)
    for column in range(4, 8):
        edit(csv, 5, column, "0")
    fails(r"clip\.csv: line 5 has a root quaternion of length 0, expected a unit one", csv)
    csv.write_bytes(bytes(range(256)))
    fails(r"clip\.csv: neither text nor an archive nor a pickle", csv)


@pytest.mark.parametrize("frames", ["5", ":", "a:b", "1:2:3", (1, 2, 3), (1.5, 20), 7, ""])
def test_frames_syntax(csv, frames):
    fails(r"frames is .*, expected FIRST:LAST, such as 2370:2580", csv, frames=frames)


def test_frames_range(csv):
    fails(r"frames is 20:10, expected 0 <= FIRST <= LAST", csv, frames="20:10")
    fails(r"frames is -5:10, expected 0 <= FIRST <= LAST", csv, frames=(-5, 10))
    fails(r"clip\.csv: frames 20:40 are outside the file, which has rows 0:39", csv, frames="20:40")


@pytest.mark.parametrize("value", [0, -30.0, float("nan"), float("inf")])
def test_rates(csv, value):
    fails(r"fps is .*, expected a positive number of Hz", csv, fps=value)
    fails(r"rate is .*, expected a positive number of Hz", csv, rate=value)


def test_too_few_and_too_many_samples(csv):
    fails(r"clip\.csv: 10 frames at 30 Hz give 16 samples at 50 Hz, expected at least 11", csv, frames="0:9")
    fails(r"clip\.csv: 40 frames at 1000 Hz give 2 samples at 50 Hz, expected at least 11", csv, fps=1000)
    fails(r"expected at most 10000000", csv, fps=1e-9)
    assert len(motion.load(csv, frames="0:10", rate=30)) == 11


def npz(path, **arrays):
    full = {"qpos": moving(50.0, 30), "rate": 50.0, "robot": "unitree_g1"} | arrays
    np.savez(path, **{k: v for k, v in full.items() if v is not None})
    return path


@pytest.mark.parametrize(
    ("arrays", "pattern"),
    [
        ({"qpos": None}, r"a\.npz: the file holds rate, robot, expected qpos, rate, robot \(fmpjax\) or"),
        ({"rate": None}, r"the file holds qpos, robot, expected"),
        ({"robot": None}, r"the file holds qpos, rate, expected"),
        ({"qpos": np.zeros((30, 30))}, r"shape \(30, 30\), expected numbers of shape \(T, 36\) .*29 joints"),
        ({"qpos": np.zeros(36)}, r"shape \(36,\), expected"),
        ({"qpos": np.full((30, 36), "x")}, r"expected numbers of shape"),
        ({"qpos": np.zeros((0, 36))}, r"0 frames .*expected at least 11"),
        ({"qpos": np.zeros((30, 36))}, r"qpos row 0 has a root quaternion of length 0"),
        ({"qpos": np.full((30, 36), np.nan)}, r"qpos row 0, column 0 is nan, expected a finite number"),
        ({"robot": "h1"}, r"the motion is for robot 'h1', expected 'unitree_g1'"),
        ({"rate": -1.0}, r"rate is -1.0, expected a positive number of Hz"),
        ({"rate": np.array([50.0, 30.0])}, r"rate is \[50.0, 30.0\], expected"),
        ({"qpos": np.array([{}])}, r"array 'qpos' holds objects, expected numbers or text"),
    ],
)
def test_npz_faults(tmp_path, arrays, pattern):
    fails(pattern, npz(tmp_path / "a.npz", **arrays))


def test_npz_cut_short_or_another_file(tmp_path):
    path = npz(tmp_path / "a.npz")
    whole = path.read_bytes()
    for size in (10, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:size])
        fails(r"a\.npz: not a readable \.npz archive", path)
    damaged = bytearray(whole)
    damaged[len(whole) // 3] ^= 0xFF
    path.write_bytes(damaged)
    fails(r"a\.npz: not a readable \.npz archive", path)
    np.save(tmp_path / "b.npy", np.zeros((30, 36)))
    (tmp_path / "b.npy").rename(tmp_path / "b.npz")
    fails(r"b\.npz: neither text nor an archive nor a pickle", tmp_path / "b.npz")


def test_save_needs_the_ending(csv, tmp_path):
    with pytest.raises(UserError, match=r"cannot save a motion as .*a\.csv: expected a name ending in \.npz"):
        motion.save(motion.load(csv), tmp_path / "a.csv")


# --- the public clip, where it is present ----------------------------------------------------------------------------


@pytest.mark.skipif("FMPJAX_TEST_DATA" not in os.environ, reason="FMPJAX_TEST_DATA names no data folder")
def test_the_demonstration_of_the_paper():
    found = sorted(Path(os.environ["FMPJAX_TEST_DATA"]).rglob("walk1_subject1.csv"))
    if not found:
        pytest.skip("no walk1_subject1.csv there")
    loaded = motion.load(found[0], frames="2370:2580")
    assert len(loaded) == 351
    assert np.linalg.norm(loaded.qvel[:, :2], axis=1).mean() == pytest.approx(0.868, abs=0.005)
    assert 0.73 < loaded.qpos[:, 2].min() < loaded.qpos[:, 2].max() < 0.80
    assert np.all(loaded.qpos[:, 3] > 0)  # the file's own sign is negative throughout this range


def test_a_clip_is_shown_in_one_line():
    assert repr(motion.load("walk")) == "MotionClip(walk of unitree_g1, 7.56 s, 379 samples at 50 Hz)"
