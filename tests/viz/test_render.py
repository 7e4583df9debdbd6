"""Pictures: they come out with every renderer, show something, and never touch the physics."""

import csv
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest
from PIL import Image

from fmpjax import robots, robustness, runs
from fmpjax.errors import UserError
from fmpjax.runs import films, outputs
from fmpjax.viz import curves, opengl, render, video

SIZE = {"width": 96, "height": 72}


@pytest.fixture(scope="module")
def robot():
    return robots.load("unitree_g1")


@pytest.fixture(scope="module")
def walk(robot):
    """Three configurations that move ahead and swing the left hip."""
    qpos = np.repeat(robot.default_qpos[None], 3, axis=0)
    qpos[:, 0] = [0.0, 0.3, 0.6]
    qpos[:, 7 + robot.sagittal_joints[0]] -= [0.0, 0.3, 0.6]
    return qpos


@pytest.fixture(params=["found", "skeleton"])
def using(request):
    return render.backend() if request.param == "found" else request.param


def test_frames_show_a_moving_robot(robot, walk, using):
    frames = render.render_frames(robot, walk, using=using, **SIZE)
    assert frames.shape == (3, 72, 96, 3) and frames.dtype == np.uint8
    assert all(frame.std() > 5 for frame in frames)
    assert np.abs(np.diff(frames.astype(int), axis=0)).max(axis=(1, 2, 3)).min() > 20


def test_ghost_and_labels_change_the_picture(robot, walk, using):
    plain = render.render_frames(robot, walk, using=using, **SIZE)
    ghost = render.render_frames(robot, walk, ghost=walk + np.eye(walk.shape[1])[0] * 0.4, using=using, **SIZE)
    labeled = render.render_frames(robot, walk, labels=["", "two", ""], using=using, **SIZE)
    assert (plain != ghost).any(axis=(1, 2, 3)).all()
    assert (plain != labeled).any(axis=(1, 2, 3)).tolist() == [False, True, False]


@pytest.mark.skipif(render.backend() == "skeleton", reason="MuJoCo draws nothing here")
def test_edges_are_smooth_unless_told_otherwise(robot, walk):
    smooth, rough = (render.render_frames(robot, walk[:1], smooth=value, **SIZE)[0] for value in (True, False))
    jump = lambda image: np.abs(np.diff(image.astype(int).sum(-1), axis=1)).max()  # noqa: E731
    assert (smooth != rough).any() and jump(rough) > jump(smooth)


def test_still_camera_sees_the_robot_cross_the_picture(robot, walk):
    walk = np.repeat(walk[:1], 2, axis=0)
    walk[1, 0] += 2.0
    frames = render.render_frames(robot, walk, follow=False, using="skeleton", **SIZE)
    dark = [np.flatnonzero((frame < 100).all(axis=-1).any(axis=0)).mean() for frame in frames]
    assert dark[1] - dark[0] > 20


def test_an_empty_motion_gives_no_frames(robot, walk):
    assert render.render_frames(robot, walk[:0], using="skeleton", **SIZE).shape == (0, 72, 96, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"qpos": np.zeros((2, 5))}, r"\(2, 5\)"),
        ({"qpos": np.full((2, 36), np.nan)}, "frame 0"),
        ({"ghost": np.zeros((1, 36))}, "ghost has 1"),
        ({"labels": ["one"]}, "labels has 1"),
        ({"using": "crayon"}, "crayon"),
    ],
)
def test_bad_input_is_named(robot, walk, arguments, message):
    with pytest.raises(UserError, match=message):
        render.render_frames(robot, **({"qpos": walk, "using": "skeleton"} | arguments))


def test_grid_holds_the_shorter_motion(robot, walk):
    frames = render.grid(robot, (walk, walk[:1]), ("a", "b"), columns=2, width=130, height=72, using="skeleton")
    assert frames.shape == (3, 72, 130, 3)
    right = frames[:, :, 66:]
    assert (right == right[:1]).all() and right.std() > 5
    assert (frames[0, :, :64] != frames[2, :, :64]).any()


def test_backend_can_be_switched_off(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert render.backend.__wrapped__() == "skeleton"


def test_no_driver_means_skeleton(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(opengl, "_PROBE", "raise SystemExit(1)")
    assert render.backend.__wrapped__() == "skeleton"


@pytest.fixture
def only_egl(monkeypatch):
    """EGL draws, nothing else does, and nothing has been said yet."""
    monkeypatch.setattr(opengl, "_HERE", ("egl", "osmesa"))
    monkeypatch.setattr(opengl, "_draws", lambda name: name == "egl")
    opengl.say.cache_clear()


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("", ""), ("egl", ""), ("glfw", ""),
        ("wrong", "fmpjax: MUJOCO_GL is 'wrong', which draws nothing here: pictures are drawn by 'egl' instead\n"),
        ("osmesa", "fmpjax: MUJOCO_GL is 'osmesa', which draws nothing here: pictures are drawn by 'egl' instead\n"),
    ],
)  # fmt: skip
def test_another_backend_draws_where_the_one_asked_for_does_not(only_egl, monkeypatch, capsys, asked, said):
    monkeypatch.setenv("MUJOCO_GL", asked)
    assert render.backend.__wrapped__() == "egl"
    assert capsys.readouterr().err == said


def test_the_backend_asked_for_is_tried_first(monkeypatch):
    tried = []
    monkeypatch.setattr(opengl, "_HERE", ("egl", "osmesa"))
    monkeypatch.setattr(opengl, "_draws", lambda name: not tried.append(name))
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    assert render.backend.__wrapped__() == "osmesa" and tried == ["osmesa"]


def test_a_driver_that_fails_after_all_leaves_the_skeleton(robot, walk, monkeypatch, capsys):
    def fail(name):
        raise RuntimeError("no driver\nat all")

    opengl.say.cache_clear()
    monkeypatch.setattr(opengl.importlib, "import_module", fail)
    frames = render.render_frames(robot, walk, using="egl", **SIZE)
    np.testing.assert_array_equal(frames, render.render_frames(robot, walk, using="skeleton", **SIZE))
    render.render_frames(robot, walk, using="egl", **SIZE)
    assert capsys.readouterr().err == (
        "fmpjax: the renderer 'egl' failed (no driver): pictures are drawn by 'skeleton' instead\n"
    )


def test_a_dead_display_gives_a_picture_and_a_sentence(tmp_path):
    """In a process of its own: MuJoCo's viewer would end it."""
    command = [sys.executable, "-m", "fmpjax.cli", "motion", "view", "strider_walk", "--robot", "strider"]
    environment = os.environ | {"DISPLAY": ":77"}
    environment.pop("WAYLAND_DISPLAY", None)
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stderr == "fmpjax: no window opens on DISPLAY ':77': a picture is drawn instead\n"
    assert done.stdout == "wrote strider_walk.png\n"
    with Image.open(tmp_path / "strider_walk.png") as image:
        assert np.asarray(image.convert("L")).std() > 5


def test_a_picture_that_fails_does_not_fail_a_finished_training(tmp_path, monkeypatch, capsys):
    def fail(*arguments, **options):
        raise RuntimeError("no driver")

    def refuse(*arguments, **options):
        raise UserError("cannot write policy.mp4: no space")

    (tmp_path / "metrics.csv").write_text("")
    run = runs.Run(tmp_path)
    monkeypatch.setattr(outputs, "_stride_frames", fail)
    monkeypatch.setattr(outputs, "video", refuse)
    monkeypatch.setattr(outputs.curves, "learning_curves", lambda table, picture: picture)
    assert outputs._pictures(run, None, None) == [tmp_path / "curves.png"]
    assert capsys.readouterr().err == "no frames.png: no driver\nno policy.mp4: cannot write policy.mp4: no space\n"


def _noise(count: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 255, (count, 32, 48, 3), dtype=np.uint8)


def test_gif_has_every_frame_and_the_right_duration(tmp_path):
    path = render.write_video(tmp_path / "new" / "walk.gif", _noise(7), fps=30)
    with Image.open(path) as image:
        assert image.n_frames == 7 and image.size == (48, 32)
        durations = []
        for i in range(7):
            image.seek(i)
            durations.append(image.info["duration"])
    assert sum(durations) == pytest.approx(7000 / 30, abs=5)


def test_mp4_or_gif_is_what_is_written(tmp_path):
    path = render.write_video(tmp_path / "walk.mp4", _noise(4)[:, :31, :47], fps=30)
    assert path.suffix in (".mp4", ".gif") and path.stat().st_size > 500


def test_without_an_encoder_a_gif_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(video, "_encoder", lambda: None)
    path = render.write_video(tmp_path / "walk.mp4", _noise(2), fps=30)
    assert path == tmp_path / "walk.gif" and path.exists()


def test_contact_sheet_is_a_grid(tmp_path):
    path = render.contact_sheet(tmp_path / "sheet.png", _noise(5), columns=3)
    with Image.open(path) as image:
        assert image.size == (3 * 48 + 2 * 4, 2 * 32 + 4)


@pytest.mark.parametrize("name", ["walk.mp4", "walk.gif", "sheet.png"])
def test_unwritable_path_is_named(tmp_path, name):
    (tmp_path / "file").write_text("in the way")
    path = tmp_path / "file" / name
    with pytest.raises(UserError, match=name):
        if path.suffix == ".png":
            render.contact_sheet(path, _noise(2), columns=2)
        else:
            render.write_video(path, _noise(2), fps=30)


def test_unknown_video_format_is_named(tmp_path):
    with pytest.raises(UserError, match="walk.avi"):
        render.write_video(tmp_path / "walk.avi", _noise(2), fps=30)


def test_looks_leave_the_physics_alone(robot):
    model = robot.model
    looks = model.geom_group == 1
    assert looks.sum() > 50
    assert not model.geom_contype[looks].any() and not model.geom_conaffinity[looks].any()
    # The floor, four points on either foot and two shins collide; the mass is the maker's.
    assert ((model.geom_contype | model.geom_conaffinity) != 0).sum() == 1 + 2 * 4 + 2
    assert model.body_mass.sum() == pytest.approx(33.341142, abs=1e-6)
    without = mujoco.MjSpec.from_file(str(robots.resources.folder("robots") / robot.name / "robot.xml"))
    for geom in [geom for geom in without.geoms if geom.group == 1]:
        without.delete(geom)
    bare = without.compile()
    for name in ("body_mass", "body_ipos", "body_inertia", "body_iquat", "dof_armature", "jnt_range"):
        np.testing.assert_array_equal(getattr(bare, name), getattr(model, name))


def test_curves_skip_missing_columns(tmp_path):
    table, picture = tmp_path / "metrics.csv", tmp_path / "plots" / "curves.png"
    names = ["iteration", "transitions", "seconds", "train/episode_length", "eval/late_speed", "fit/new", "ppo/kl"]
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        for i in range(60):
            writer.writerow([i, 1000 * i, i, 50 + i, 0.5 if i % 20 == 0 else "", np.sin(i), ""])
        file.write("60,60000,6")  # a row that is being written
    assert curves.learning_curves(table, picture) == picture
    with Image.open(picture) as image:
        # Two panels: a column of no panel is left to TensorBoard, an empty one to nobody.
        assert image.width == 2 * 288 and np.asarray(image.convert("L")).std() > 5


def test_curves_name_a_table_without_metrics(tmp_path):
    table = tmp_path / "metrics.csv"
    with pytest.raises(UserError, match="metrics.csv"):
        curves.learning_curves(table, tmp_path / "curves.png")
    table.write_text("iteration,train/falls\n")
    with pytest.raises(UserError, match="no metrics"):
        curves.learning_curves(table, tmp_path / "curves.png")


def test_grid_fills_its_panes_in_order(robot, walk):
    """Five motions in three columns: the sixth pane stays white, panes of the same motion are the same picture."""
    motions = [walk[:2], walk[1:3], walk[:1], walk[1:3], walk[:2]]
    frames = render.grid(robot, motions, ["a"] * 5, columns=3, width=196, height=130, using="skeleton")
    assert frames.shape == (2, 130, 196, 3)
    assert (frames[:, 66:, 132:] == 255).all()
    panes = [frames[0, y : y + 64, x : x + 64] for y in (0, 66) for x in (0, 66, 132)]
    np.testing.assert_array_equal(panes[0], panes[4])
    np.testing.assert_array_equal(panes[1], panes[3])
    assert (panes[0] != panes[1]).any()
    with pytest.raises(UserError, match="a motion to show has no frames"):
        render.grid(robot, [walk[:0]], ["a"], using="skeleton")


@pytest.mark.parametrize(
    ("heading", "said"), [(0.0, "to its left"), (0.5, "ahead"), (1.0, "to its right"), (-0.5, "back")]
)
def test_a_film_says_where_a_push_goes_as_the_robot_sees_it(robot, heading, said):
    """Pushed along the world's y while it faces ``heading`` half turns from x; then it falls."""
    qpos = np.tile(robot.default_qpos, (100, 1, 1))
    qpos[..., 3:7] = [np.cos(heading * np.pi / 2), 0.0, 0.0, np.sin(heading * np.pi / 2)]
    pushes = np.zeros((100, 1, 6))
    pushes[40, 0, 1] = 0.5
    words = films._happened(robustness.Played(qpos, np.array([80]), np.array([True]), pushes), 0, 50.0)
    assert words[39] == "" and words[40] == words[69] == f"pushed {said}, 0.5 m/s"
    assert words[70] == words[79] == "" and words[80] == words[99] == "fell"
