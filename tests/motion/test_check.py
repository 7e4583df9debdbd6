"""Edits against closed forms and MuJoCo's kinematics, figures against clips with one known fault, and the commands."""

import dataclasses
import os
import pickle
import re
import time

import mujoco
import numpy as np
import pytest
from PIL import Image

from fmpjax import cli, motion, robots, rotations
from fmpjax import config as configuration
from fmpjax.errors import UserError
from fmpjax.motion import MotionClip, check, edit, gait, library, segment, soles
from fmpjax.viz import clip as show


def changed(clip, change):
    qpos = clip.qpos.copy()
    change(qpos)
    return MotionClip.from_qpos(clip.name, clip.robot, clip.rate, qpos)


def figures(robot, clip, flips=0):
    return {figure.name: figure for figure in check.check(robot, clip, flips)}


@pytest.fixture(scope="module")
def lively(robot, walk):
    """The walk with every joint moved off its symmetric place."""
    shift = np.random.default_rng(0).uniform(0.05, 0.15, robot.joint_count)

    def change(qpos):
        qpos[:, 7:] += shift
        qpos[:, 1] += 0.3
        qpos[:, 3:7] = rotations.multiply(rotations.exp_map(np.array([0.1, 0.2, 0.4])), qpos[:, 3:7])

    return changed(walk, change)


# --- edits -----------------------------------------------------------------------------------------------------------


def test_mirror_twice_is_the_identity(robot, lively):
    once = edit.mirrored(robot, lively)
    assert np.abs(once.qpos - lively.qpos).max() > 0.2
    np.testing.assert_allclose(edit.mirrored(robot, once).qpos, lively.qpos, atol=1e-12)


def test_mirrored_key_points_are_reflections(robot, lively):
    data = mujoco.MjData(robot.model)

    def places(clip):
        found = []
        for data.qpos[:] in clip.qpos[::40]:
            mujoco.mj_kinematics(robot.model, data)
            turn = data.xmat[robot.key_body + 1].reshape(-1, 3, 3)
            found.append(data.xpos[robot.key_body + 1] + np.einsum("kij,kj->ki", turn, robot.key_offset))
        return dict(zip(robot.key_point_names, np.swapaxes(found, 0, 1), strict=True))

    plain, image = places(lively), places(edit.mirrored(robot, lively))
    for name, at in plain.items():
        partner = name.replace("left", "?").replace("right", "left").replace("?", "right")
        # The maker's model is symmetric to a hundredth of a millimeter in the arms, a millimeter in the torso's chain.
        np.testing.assert_allclose(image[partner], at * [1, -1, 1], atol=5e-4)


@pytest.mark.parametrize("degrees", [0.0, 90.0, -135.0])
def test_heading(robot, lively, degrees):
    turned = edit.headed(lively, np.radians(degrees))
    way = turned.qpos[-1, :2] - turned.qpos[0, :2]
    assert np.degrees(np.arctan2(way[1], way[0])) == pytest.approx(degrees)
    np.testing.assert_allclose(turned.qpos[0, :3], lively.qpos[0, :3])
    np.testing.assert_allclose(turned.qpos[:, 7:], lively.qpos[:, 7:])
    # Seen from the body nothing changes.
    np.testing.assert_allclose(turned.qvel[:, 3:], lively.qvel[:, 3:], atol=1e-9)
    seen = [rotations.rotate(rotations.conjugate(c.qpos[:, 3:7]), c.qvel[:, :3]) for c in (turned, lively)]
    np.testing.assert_allclose(*seen, atol=1e-9)


def test_no_heading_without_a_way(robot):
    with pytest.raises(UserError, match="it has no heading"):
        edit.headed(MotionClip.from_qpos("still", robot.name, 50.0, np.tile(robot.default_qpos, (20, 1))), 0.0)


def test_loop_meets_its_start(robot, walk):
    open_ = MotionClip.from_qpos("open", walk.robot, walk.rate, walk.qpos[:91])
    closed = edit.looped(open_)
    assert figures(robot, open_)["loop gap"].value > 0.3
    assert figures(robot, closed)["loop gap"].value < 1e-9
    np.testing.assert_array_equal(closed.qpos[:70, 7:], open_.qpos[:70, 7:])
    np.testing.assert_allclose(closed.qpos[:, :2], open_.qpos[:, :2])
    assert closed.qpos[-1, 2] == pytest.approx(open_.qpos[0, 2])


def test_fix_puts_the_clip_right(robot, walk):
    def spoil(qpos):
        qpos[:, 2] += 0.07
        qpos[20:25, 10] = robot.joint_high[3] + 0.4

    clip, said = edit.fixed(robot, changed(walk, spoil))
    assert said[0] == "left_knee_joint clipped in 5 samples, by 0.400 rad at most"
    assert said[1].startswith("moved down by 70.")
    found = figures(robot, clip)
    assert found["limit excess"].value == 0
    assert found["float"].value < 0.001
    assert edit.fixed(robot, clip)[1] == []


def test_faster(walk):
    quick = edit.faster(walk, 1.2)
    assert len(quick) == 1 + int((len(walk) - 1) / 1.2)
    np.testing.assert_allclose(quick.qpos[50], walk.qpos[60], atol=1e-12)
    assert np.abs(quick.qvel[:, 0]).mean() == pytest.approx(1.2 * np.abs(walk.qvel[:, 0]).mean(), rel=0.02)
    with pytest.raises(UserError, match="--speed is 9: expected a factor from 0.25 to 4"):
        edit.faster(walk, 9)


def test_joined_clips_go_on_where_the_last_ended(robot, walk):
    turn = motion.load("turn_left")
    both = edit.joined([turn, walk, turn])
    assert len(both) == 2 * len(turn) + len(walk) - 2
    np.testing.assert_array_equal(both.qpos[: len(turn)], turn.qpos)
    found = figures(robot, both)
    for name in ("joint speed", "joint acceleration", "root acceleration", "penetration"):
        assert found[name].verdict == "good"
    # The walk goes to where the turn looked at its end.
    way = both.qpos[len(turn) + len(walk) - 2, :2] - both.qpos[len(turn) - 1, :2]
    assert np.arctan2(way[1], way[0]) == pytest.approx(rotations.yaw(turn.qpos[-1, 3:7]), abs=0.15)
    assert found["turning"].value == pytest.approx(2 * turn.duration * 0.5 / both.duration, rel=0.1)


# --- figures ---------------------------------------------------------------------------------------------------------


def test_bundled_walk_is_good(robot, walk):
    found = check.check(robot, walk)
    assert [f.name for f in found] == list(check.RANGES)
    assert {f.verdict for f in found} == {"good"}


@pytest.mark.parametrize(
    ("name", "change", "value", "verdict"),
    [
        ("penetration", lambda q: np.subtract.at(q, (slice(None), 2), 0.1), 0.1, "broken"),
        ("penetration", lambda q: np.subtract.at(q, (slice(None), 2), 0.03), 0.03, "odd"),
        ("float", lambda q: np.add.at(q, (slice(None), 2), 0.05), 0.05, "odd"),
        ("float", lambda q: np.add.at(q, (slice(None), 2), 0.2), 0.2, "broken"),
        ("speed", lambda q: np.multiply.at(q, (slice(None), 0), 20), 17.0, "broken"),
        ("limit excess", lambda q: np.put(q, 100 * 36 + 7 + 3, -0.587267), 0.5, "broken"),
        # One sample off by 0.5 m: a second difference of twice that.
        ("root acceleration", lambda q: np.add.at(q, (100, 1), 0.5), 2 * 0.5 * 50**2, "broken"),
        ("joint acceleration", lambda q: np.add.at(q, (100, 20), 1.0), 2 * 1.0 * 50**2, "broken"),
        ("joint speed", lambda q: np.add.at(q, (slice(100, None), 20), 1.3), 1.3 * 50, "broken"),
    ],
)
def test_each_fault_has_its_figure(robot, walk, name, change, value, verdict):
    figure = figures(robot, changed(walk, change))[name]
    assert figure.value == pytest.approx(value, rel=0.05)
    assert figure.verdict == verdict


def test_sliding_feet(robot):
    """A robot that stands and is pushed over the floor at 0.5 m/s slips at that speed; one that stands does not."""
    still = np.tile(robot.default_qpos, (30, 1))
    clip = MotionClip.from_qpos("still", robot.name, 50.0, still)
    assert figures(robot, clip)["foot slip"].value == pytest.approx(0, abs=1e-12)
    still[:, 1] = 0.5 * np.arange(30) / 50
    found = figures(robot, MotionClip.from_qpos("pushed", robot.name, 50.0, still))
    assert found["foot slip"].value == pytest.approx(0.5)
    assert found["speed"].value == pytest.approx(0.5)


def test_flips_are_counted():
    q = np.tile([0.6, 0.8, 0.0, 0.0], (10, 1))
    q[3:5] *= -1
    assert check.flips(q) == 2
    assert check.Figure("flips", 2).verdict == "odd"


def test_upside_down_and_heading(robot, walk):
    def over(qpos):
        qpos[:, 3:7] = rotations.multiply(rotations.exp_map(np.array([np.pi, 0.0, 0.0])), qpos[:, 3:7])

    found = figures(robot, changed(walk, over))
    assert found["tilt"].verdict == "broken" and found["tilt"].value > 170
    assert any(fault.startswith("tilt is broken") for fault in check.faults(robot, changed(walk, over)))
    turned = figures(robot, edit.headed(walk, np.radians(60)))["heading"]
    way = np.degrees(check.heading(walk))
    assert turned.value == pytest.approx(60, abs=0.1)
    assert turned.where == f"faces {60 + np.degrees(rotations.yaw(walk.qpos[0, 3:7])) - way:.0f}°"
    left = figures(robot, motion.load("turn_left"))["turning"]
    assert left.value == pytest.approx(0.5, abs=0.02)


def test_what_does_not_suit_a_run(robot, walk):
    def said(clip, axes="world", reset="dataset", seconds=10.0):
        return " ".join(check.unsuited(robot, clip, axes=axes, reset=reset, seconds=seconds))

    left = motion.load("turn_left")
    assert said(walk) == said(walk, reset="fixed") == said(left, axes="heading") == ""
    assert "--set features.axes=heading" in said(left)
    away = edit.headed(walk, np.radians(90))
    assert said(away) == said(away, axes="heading", reset="fixed") == ""
    assert "heads 90° from +x" in said(away, reset="fixed")
    short = MotionClip.from_qpos("short", robot.name, 50.0, walk.qpos[:77])
    assert "lasts 1.5 s and does not loop, and an evaluation lasts 10 s" in said(short)
    assert said(short, seconds=1.0) == ""


@pytest.mark.parametrize(
    ("name", "rate", "word"),
    [
        ("walk", 100.0, ""),
        ("walk", 50.0, "faster"),
        ("walk", 240.0, "slower"),
        ("fast_walk", 50.0, "faster"),
        ("slow_walk", 100.0, ""),
    ],
)
def test_strides_give_a_wrong_rate_away(robot, tmp_path, name, rate, word):
    """A text file without a rate, read at half or twice its speed; a rate that is told is not doubted."""
    qpos = motion.load(name, rate=100.0).qpos
    rows = qpos[:, [0, 1, 2, 4, 5, 6, 3, *range(7, qpos.shape[1])]]
    (tmp_path / "a.csv").write_text("\n".join(",".join(f"{v:.6f}" for v in row) for row in rows))
    clip = motion.load(tmp_path / "a.csv", fps=rate)
    told = " ".join(check.unsuited(robot, clip, axes="world", reset="dataset", seconds=1.0))
    assert "strides" not in told
    facts = tuple(f._replace(why="assumed") if f.what == "rate" else f for f in clip.reading.facts)
    clip = dataclasses.replace(clip, reading=clip.reading._replace(facts=facts))
    told = " ".join(check.unsuited(robot, clip, axes="world", reset="dataset", seconds=1.0))
    assert ("strides" in told) == bool(word) and word in told


def test_a_long_motion_is_checked_in_pieces(robot, walk, monkeypatch):
    """The same faults, with the times of the whole."""

    def jump(qpos):
        qpos[200, 20] += 1.0

    clip = changed(walk, jump)
    whole = check.faults(robot, clip)
    monkeypatch.setattr(check, "PIECE", 90)
    assert any("at 4.00 s" in fault for fault in whole)
    pieces = check.faults(robot, clip)
    assert [f for f in pieces if f.startswith("joint")] == [f for f in whole if f.startswith("joint")]
    assert not any("duration" in fault for fault in pieces)


def test_torques_of_a_long_motion_are_sampled(robot, monkeypatch):
    """Of an hour not every sample is measured; the figure stays what it is."""
    turn = motion.load("turn_left")
    whole = figures(robot, turn)["torque"].value
    points, _ = soles.sole_points(robot, turn.qpos)
    height = points[..., 2] - robot.sole_radius
    every = check.torques(robot, turn, points, height)
    np.testing.assert_allclose(check.torques(robot, turn, points, height, 2), every[::2])
    monkeypatch.setattr(check, "MOST_TORQUES", 210)
    sampled = figures(robot, turn)["torque"].value
    assert abs(sampled - whole) > 1e-6
    assert sampled == pytest.approx(whole, rel=0.05)


def test_not_a_number_is_broken():
    assert check.Figure("speed", float("nan")).verdict == "broken"


def test_torques_of_a_crouch_are_those_of_statics(robot):
    """Moment about the knee of half the weight, under the center of mass, less that of shank and foot."""
    crouch, index = robot.default_qpos.copy(), robot.joint_names.index
    for side in ("left", "right"):
        for joint, angle in (("hip_pitch", -0.7), ("knee", 1.2), ("ankle_pitch", -0.5)):
            crouch[7 + index(f"{side}_{joint}_joint")] = angle
    crouch[2] -= robots.lowest_sole(robot, crouch)
    clip = MotionClip.from_qpos("still", robot.name, 50.0, np.tile(crouch, (15, 1)))
    points, _ = soles.sole_points(robot, clip.qpos)
    torque = check.torques(robot, clip, points, points[..., 2] - robot.sole_radius)[7]
    data = mujoco.MjData(robot.model)
    data.qpos[:] = crouch
    mujoco.mj_forward(robot.model, data)
    for side in ("left", "right"):
        knee = robot.model.body(f"{side}_knee_link").id
        foot = robot.model.body_subtreemass[knee] * (data.subtree_com[knee, 0] - data.xpos[knee, 0])
        whole = robot.total_mass / 2 * (data.subtree_com[1, 0] - data.xpos[knee, 0])
        assert torque[index(f"{side}_knee_joint")] == pytest.approx(9.81 * abs(whole - foot), rel=0.03)
        assert torque[index(f"{side}_knee_joint")] > 15


def test_three_thousand_frames_are_quick(robot, walk):
    clip = MotionClip.from_qpos("long", walk.robot, walk.rate, np.tile(walk.qpos, (8, 1))[:3000])
    start = time.process_time()
    check.check(robot, clip)
    assert time.process_time() - start < 4  # 0.2 s on an idle core


# --- commands --------------------------------------------------------------------------------------------------------


def run(*arguments):
    cli.main(["motion", *map(str, arguments)])


def code(*arguments):
    with pytest.raises(SystemExit) as end:
        run(*arguments)
    return end.value.code


def test_import_check_and_synthesize(tmp_path, capsys, robot):
    run("synthesize", "--speed", "0.7", "--duration", "1.2", "--out", tmp_path / "a.npz")
    run(
        "import",
        tmp_path / "a.npz",
        "--out",
        tmp_path / "b.npz",
        "--mirror",
        "--heading",
        "90",
        "--loop",
        "--rate",
        "30",
    )
    clip = motion.load(tmp_path / "b.npz", rate=30.0)
    assert clip.qpos[-1, 1] - clip.qpos[0, 1] == pytest.approx(0.7 * clip.duration, rel=0.05)
    run("import", tmp_path / "a.npz", "walk", "--out", tmp_path / "both")
    assert sorted(p.name for p in (tmp_path / "both").iterdir()) == ["a.npz", "walk.npz"]
    run("check", tmp_path / "both" / "walk.npz")
    run("import", "walk", "--speed", "1.4", "--out", tmp_path / "fast.npz")
    said = capsys.readouterr().out
    assert "broken" not in said
    torque = re.search(r"torque +(\S+) of (\w+)'s limit, (\S+) of (\w+)'s at the file's speed", said)
    fast, slow = (figures(robot, motion.load(path))["torque"] for path in (tmp_path / "fast.npz", "walk"))
    assert torque.groups() == (f"{fast.value:.2f}", fast.where, f"{slow.value:.2f}", slow.where)


def test_import_doubts_an_assumed_rate(robot, tmp_path, capsys):
    """The written file has a rate, so nothing could tell later."""
    rows = motion.load("walk", rate=60.0).qpos[:, [0, 1, 2, 4, 5, 6, 3, *range(7, 7 + robot.joint_count)]]
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", fmt="%.6f")
    run("import", tmp_path / "a.csv", "--out", tmp_path / "b.npz")
    assert "strides of 0.93 m are usually faster" in capsys.readouterr().out
    run("import", tmp_path / "a.csv", "--fps", "60", "--out", tmp_path / "b.npz")
    assert "strides" not in capsys.readouterr().out


@pytest.mark.parametrize("command", ["check", "segment"])
def test_what_shows_a_loop_once_says_that_it_loops(robot, walk, tmp_path, capsys, command):
    stride = walk.qpos[:55]
    frames = np.concatenate([stride[:, :3], rotations.log_map(stride[:, 3:7]), stride[:, 7:]], axis=1)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps({"fps": 50, "loop_mode": 1, "frames": frames.tolist()}))
    run(command, tmp_path / "a.pkl")
    assert "the file says that it loops; import and train repeat it to 10 s" in capsys.readouterr().out
    run(command, tmp_path / "a.pkl", "--frames", "0:40")
    assert "repeat it" not in capsys.readouterr().out


def test_broken_clip_is_exit_code_one_until_it_is_fixed(tmp_path, capsys, walk):
    def sink(qpos):
        qpos[:, 2] -= 0.2

    path = motion.save(changed(walk, sink), tmp_path / "sunk.npz")
    assert code("check", path) == 1
    assert "penetration        0.201 m             0 to 0.02   broken" in capsys.readouterr().out
    run("check", path, "--fix", "--out", tmp_path / "up.npz")
    assert "moved up by 200.0 mm" in capsys.readouterr().out
    run("check", tmp_path / "up.npz")


def test_pictures(tmp_path, robot, walk, monkeypatch):
    monkeypatch.setattr(show.render, "backend", lambda: "skeleton")
    run("plot", "walk", "--frames", "0:60", "--out", tmp_path / "plot.png")
    run("view", "walk", "--frames", "0:40", "--out", tmp_path / "sheet.png")
    assert Image.open(tmp_path / "plot.png").size[0] > 1000
    assert Image.open(tmp_path / "sheet.png").size == (5 * 244 - 4, 4 * 244 - 4)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("import", "nope", "--out", "a.npz"), "unknown motion 'nope'"),
        (("import", "walk", "--out", "a.csv"), "expected a name ending in .npz"),
        (("import", "walk", "walk", "--out", "a"), "same name"),
        (("import", "walk", "--out", "a.npz", "--heading", "nan"), "--heading is nan"),
        (("import", "walk", "--out", "a.npz", "--fps", "0"), "fps is 0"),
        (("check", "walk", "--fix"), "--fix and --out go together"),
        (("check", "walk", "--frames", "0:3"), "4 frames, expected at least 11"),
        (("check", "walk", "--robot", "h1"), "unknown robot 'h1'"),
        (("check", "walk", "--axes", "sideways"), "--axes is 'sideways': expected world or heading"),
        (("check", "walk", "--reset", "nope"), "--reset is 'nope': expected dataset or fixed"),
        (("check", "walk", "--seconds", "-3"), "--seconds is -3: expected more than 0"),
        (("view", "walk", "--out", "a.bmp"), "expected a name that ends in .png, .mp4 or .gif"),
        (("plot", "walk", "--out", "a.pdf"), "expected a name that ends in .png"),
        (("synthesize", "--out", "a.npz", "--speed", "-9"), "speed -9 m/s is out of the legs' reach"),
    ],
)
def test_bad_input(tmp_path, monkeypatch, capsys, arguments, word):
    monkeypatch.chdir(tmp_path)
    assert code(*arguments) == 2
    error = capsys.readouterr().err
    assert word in error and error.count("\n") == 1
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("reset", ["dataset", "fixed"])
def test_train_says_what_it_reads_and_warns_first(robot, walk, tmp_path, reset):
    """What `train` prints before it makes a run's folder."""
    runs = pytest.importorskip("fmpjax.runs")

    def spoil(qpos):
        qpos[:, 2] -= 0.2

    path = motion.save(edit.headed(changed(walk, spoil), np.radians(90)), tmp_path / "sunk.npz")
    config = configuration.preset("smoke", motion=f"{path},turn_left", **{"env.reset": reset})
    said = runs.describe(config)
    assert "motion sunk" in said and "fmpjax's .npz" in said and "motion turn_left" in said
    assert "warning: penetration is broken: 0.2" in said
    assert ("warning: the motion heads 90° from +x" in said) == (reset == "fixed")
    assert "--set features.axes=heading" in said


def test_of_many_motions_train_says_what_they_share(robot, walk, tmp_path):
    """One line per value of a fact and one warning per kind, however many motions there are."""
    runs = pytest.importorskip("fmpjax.runs")
    for i in range(6):
        part = dataclasses.replace(walk, qpos=walk.qpos[: 100 + 20 * i] - [0, 0, 0.2 * (i < 4), *np.zeros(33)])
        motion.save(part, tmp_path / f"part{i}.npz")
    names = library.listed(str(tmp_path))
    said = runs.describe(configuration.preset("smoke", motion=names)).split("\n")
    assert said[0] == "6 motions, 18 s in all, were read as"
    assert sum(line.lstrip().startswith("format") for line in said) == 1 and "6 motions: its arrays" in said[1]
    sunk = [line for line in said if "penetration is broken: 0.2" in line]
    assert len(sunk) == 1 and sunk[0].endswith("[motion part0 and 3 more]")
    assert len(said) < 16


def test_train_prints_it(monkeypatch, capsys, tmp_path):
    runs = pytest.importorskip("fmpjax.runs")

    class Made(Exception):
        pass

    def create(*_):
        raise Made

    monkeypatch.setattr(runs.Run, "create", create)
    with pytest.raises(Made):
        cli.main(["train", "--preset", "smoke", "--motion", "turn_right", "--run", str(tmp_path / "run")])
    assert "motion turn_right, " in capsys.readouterr().out


def test_soles_are_where_mujoco_puts_them(robot):
    rng = np.random.default_rng(0)
    qpos = rng.normal(size=(20, 7 + robot.joint_count))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    points, rotation = soles.sole_points(robot, qpos)
    data = mujoco.MjData(robot.model)
    for row, point, turned in zip(qpos, points, rotation, strict=True):
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.model, data)
        own = data.xmat[robot.sole_body + 1].reshape(-1, 3, 3)
        np.testing.assert_allclose(turned, own, atol=1e-12)
        place = data.xpos[robot.sole_body + 1] + np.einsum("pij,pj->pi", own, robot.sole_point)
        np.testing.assert_allclose(point, place, atol=1e-12)


# --- stretches -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def long(robot, walk):
    """Five seconds each of standing, waving, walking, turning, running on the spot's pace, and a fall."""
    rate, still = walk.rate, np.tile(robot.default_qpos, (250, 1))

    def clip(qpos):
        return MotionClip.from_qpos("part", robot.name, rate, qpos)

    wave = still.copy()
    wave[:, 7 + 15 :] += 0.6 * np.sin(2 * np.pi * 1.2 * np.arange(250) / rate)[:, None]
    fall = still.copy()
    pitch = np.clip(np.arange(250) / rate, 0, 1) * np.pi / 2
    fall[:, 3:7] = rotations.exp_map(pitch[:, None] * [0.0, 1.0, 0.0])
    fall[:, 2] = still[0, 2] * np.cos(pitch) + 0.12
    run = walk.qpos.copy()
    run[:, 0] *= 2.6
    turn = motion.load("turn_left").qpos
    return edit.joined([clip(q[:250]) for q in (still, wave, walk.qpos, turn, run, fall)])


def test_stretches_of_a_long_motion(robot, long):
    found, kinds = segment.segment(robot, long)
    assert [s.kind for s in found] == ["standing", "dancing", "walking", "turning", "running"]
    for i, stretch in enumerate(found):
        # A second's window blurs the borders; standing before the fall is short.
        assert abs(stretch.first - 249 * i) < 40 and stretch.last - stretch.first > 170
        assert len(stretch.clip) == stretch.last - stretch.first + 1
        np.testing.assert_allclose(stretch.clip.qpos[0, 7:], long.qpos[stretch.first, 7:])
    assert found[2].speed == pytest.approx(0.86, abs=0.1)
    assert found[3].turning == pytest.approx(0.5, abs=0.1)
    assert found[0].verdict == "good" and found[2].verdict != "broken"
    assert (kinds[-150:] == segment.DOWN).all()
    assert [s.kind for s in segment.segment(robot, long, least=6.0)[0]] == ["turning"]  # the moving ones together
    assert segment.segment(robot, long, least=20.0)[0] == []
    with pytest.raises(UserError, match="--least is 0.5: expected at least 1 s"):
        segment.segment(robot, long, least=0.5)


def test_a_jump_parts_a_walk(robot, walk):
    def jump(qpos):
        qpos[150:, 12] += 1.5

    found, kinds = segment.segment(robot, changed(walk, jump))
    assert [s.kind for s in found] == ["walking", "walking"]
    assert found[0].last < 150 <= found[1].first
    assert kinds[150] == segment.BROKEN


def test_segment_command(tmp_path, capsys, long):
    path = motion.save(long, tmp_path / "long.npz")
    run("segment", path, "--frames", "400:", "--out", tmp_path / "parts", "--picture", tmp_path / "a.png")
    said = capsys.readouterr().out
    assert "rows            seconds  kind      m/s    rad/s   verdict" in said
    walks = [line for line in said.splitlines() if " walking " in line]
    first, last = map(int, walks[0].split()[0].split(":"))
    assert 460 < first < 540 and 700 < last < 790
    written = motion.load(tmp_path / "parts" / f"long-walking-{first}.npz")
    np.testing.assert_allclose(written.qpos[0, 7:], motion.load(path).qpos[first, 7:])
    assert "s on the ground or falling" in said
    assert Image.open(tmp_path / "a.png").size[0] > 1000
    run("import", path, "walk", "--join", "--speed", "1.25", "--out", tmp_path / "joined.npz")
    joined = motion.load(tmp_path / "joined.npz").duration
    assert joined == pytest.approx((long.duration + motion.load("walk").duration) / 1.25, abs=0.05)
    assert code("segment", path, "--picture", tmp_path / "a.pdf") == 2


def test_stretches_that_go_forward(robot, walk, tmp_path, capsys):
    """Turned on its path by 180, 90 and 15 degrees, a walk goes backward, to a side, and hardly to a side."""

    def heading_off(degrees):
        turn = np.array([np.cos(np.radians(degrees / 2)), 0.0, 0.0, np.sin(np.radians(degrees / 2))])
        qpos = walk.qpos.copy()
        qpos[:, 3:7] = rotations.multiply(qpos[:, 3:7], turn)
        return MotionClip.from_qpos("off", walk.robot, walk.rate, qpos)

    assert [segment.forward(heading_off(degrees)) for degrees in (0, 180, 90, 15)] == [True, False, False, True]
    path = motion.save(gait.make(robot, gait.Command(-0.4, 0.0, 0.0)).clip(4.0), tmp_path / "back.npz")
    run("segment", path, "--out", tmp_path / "all")
    run("segment", path, "--out", tmp_path / "ahead", "--forward")
    assert len(list((tmp_path / "all").glob("*.npz"))) == 1 and not (tmp_path / "ahead").exists()
    run("segment", motion.save(walk, tmp_path / "walk.npz"), "--out", tmp_path / "ahead", "--forward")
    assert len(list((tmp_path / "ahead").glob("*.npz"))) == 1 and "walking" in capsys.readouterr().out


def test_a_fast_walk_is_no_run(external, robot):
    clip = motion.load(external("walk1_subject1.csv"), frames="3180:3450", rate=30.0)
    found, _ = segment.segment(robot, clip)
    assert {s.kind for s in found} <= {"walking", "turning"} and sum(len(s.clip) for s in found) > 200
    clip = motion.load(external("run1_subject2.csv"), frames="3831:4004", rate=30.0)
    assert {s.kind for s in segment.segment(robot, clip)[0]} == {"running"}


def test_the_papers_stretch_is_found(external, robot):
    clip = motion.load(external("walk1_subject1.csv"), frames="2300:2700", rate=30.0)
    found, _ = segment.segment(robot, clip, offset=2300)
    assert any(s.kind == "walking" and s.first <= 2370 and s.last >= 2580 and s.verdict == "good" for s in found)


@pytest.mark.parametrize(("name", "frames"), [("walk1_subject1.csv", "2370:2580"), ("run1_subject2.csv", "5000:5200")])
def test_real_clips_are_fit(robot, external, name, frames):
    clip = motion.load(external(name), frames=frames)
    assert "broken" not in {figure.verdict for figure in check.check(robot, clip)}


def test_a_clip_is_not_repeated_without_end(walk):
    with pytest.raises(UserError, match="--repeat is 100000000: 379 samples that many times are more than"):
        edit.repeated(walk, 100_000_000)
