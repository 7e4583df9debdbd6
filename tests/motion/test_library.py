"""Several demonstrations at once: what is drawn from them, how often, and a run that learns from two."""

import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import cli, features, motion, physics, rotations, runs
from fmpjax.config import FeatureConfig, preset
from fmpjax.env import Env
from fmpjax.errors import UserError
from fmpjax.evaluate import planar_speed
from fmpjax.motion import MotionClip, MotionLibrary, library, load_library
from fmpjax.motion.clip import refined
from fmpjax.priors import Expert
from fmpjax.trainer import Trainer
from tests.helpers import TINY, settings

HORIZON = 10
SHARES = (0.8, 0.2)


@pytest.fixture(scope="module")
def two(walk):
    """A short clip of eight tenths of the weight and a long one of two tenths, told apart by their height."""

    def piece(name, rows, lift):
        qpos = walk.qpos[:rows].copy()
        qpos[:, 2] += lift
        return MotionClip.from_qpos(name, walk.robot, walk.rate, qpos)

    return MotionLibrary((piece("short", 30, 0.0), piece("long", 200, 1.0)), SHARES)


@pytest.fixture(scope="module")
def env(robot, two):
    return Env(robot, two, preset("smoke"), physics.make(robot, preset("smoke").physics))


# --- names and weights -----------------------------------------------------------------------------------------------


def test_a_list_of_names_and_weights():
    assert library.parse("walk") == [("walk", 1.0)]
    assert library.parse("a.npz,b.npz:0.3") == [("a.npz", 1.0), ("b.npz", 0.3)]
    assert library.parse(" walk:2 , turn_left:6 ") == [("walk", 2.0), ("turn_left", 6.0)]
    assert library.shares(library.parse("walk:2,turn_left:6")) == (0.25, 0.75)
    np.testing.assert_allclose(library.shares(library.parse("a,b:0.25")), (0.8, 0.2))


def test_a_file_with_commas_and_colons_in_its_name_is_a_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    source = Path(motion.formats.locate("walk"))
    shutil.copy(source, "a,b.npz")
    shutil.copy(source, "take:2")
    assert library.parse("a,b.npz") == [("a,b.npz", 1.0)]
    assert library.parse("walk,take:2") == [("walk", 1.0), ("take:2", 1.0)]


def test_folders_and_patterns_are_their_files(tmp_path):
    source = Path(motion.formats.locate("walk"))
    for name in ("b.npz", "a.npz", "in/c.npz", "in/d.motion"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(source, tmp_path / name)
    (tmp_path / "notes.md").write_text("mine")
    a, b, c, d = (f"{tmp_path}/{name}" for name in ("a.npz", "b.npz", "in/c.npz", "in/d.motion"))
    assert library.listed(f"{tmp_path}/in") == f"{c}:0.5,{d}:0.5"
    assert library.listed(f"{tmp_path}/*.npz:3,walk") == f"{a}:1.5,{b}:1.5,walk"
    assert library.listed(f"{tmp_path}/[ab].npz") == f"{a}:0.5,{b}:0.5"
    assert len(library.parse(library.listed(f"{tmp_path}/**/*.npz"))) == 3
    with pytest.raises(UserError, match=r"no file matches the pattern '.*/x\*': expected motion files"):
        library.listed(f"{tmp_path}/x*")
    shutil.copy(source, tmp_path / "in" / "c,d.npz")
    with pytest.raises(UserError, match="c,d.npz has a comma in its name"):
        library.listed(f"{tmp_path}/in")


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        ("walk:much", "motion 'walk:much' has weight 'much': expected NAME:WEIGHT, a number above 0"),
        ("walk,turn_left:0", "has weight '0': expected NAME:WEIGHT, a number above 0"),
        ("walk:-1", "has weight '-1'"),
        ("walk:nan", "has weight 'nan'"),
        ("walk:inf", "has weight 'inf'"),
        ("walk,", "names nothing before or after a comma"),
        (":2,walk", "names nothing before or after a comma"),
        ("walk,wlak:2", "unknown motion 'wlak'"),
    ],
)
def test_bad_lists_are_refused_in_a_sentence(names, sentence):
    with pytest.raises(UserError, match=sentence.replace("(", r"\(")):
        load_library(names)


def test_a_long_list_is_shown_by_its_first_names():
    assert library.briefly("walk,turn_left:0.5") == "motion walk,turn_left:0.5"
    many = library.listed("gaits")
    said = library.briefly(many)
    assert said.startswith(f"{len(many.split(','))} motions: gaits/") and said.endswith(" more") and len(said) < 120


def test_frames_of_each_motion():
    both = load_library("walk,turn_left", frames="0:49,10:69")
    assert both.lengths.tolist() == [50, 60]
    np.testing.assert_array_equal(both.clips[1].qpos, motion.load("turn_left", frames="10:69").qpos)
    with pytest.raises(UserError, match="frames is '0:49': expected FIRST:LAST for each of the 2 motions"):
        load_library("walk,turn_left", frames="0:49")


# --- what is drawn ---------------------------------------------------------------------------------------------------


def test_windows_lie_within_a_clip(two, env):
    ends = two.rows_after(HORIZON - 1)
    assert ends.tolist() == [*range(9, 30), *range(39, 230)]
    heights = np.asarray(env.clip_windows())[..., 2]
    assert heights.shape == (212, HORIZON)
    # No window has feet on the floor and a meter above it.
    assert np.ptp(heights, axis=1).max() < 0.2


def test_a_clip_has_its_weight_however_long_it_is(two):
    share = two.share_after(HORIZON - 1)
    np.testing.assert_allclose([share[:21].sum(), share[21:].sum()], SHARES)
    np.testing.assert_allclose(share[:21], 0.8 / 21)
    assert MotionLibrary.of(two.clips[0]).share_after(HORIZON - 1) is None


def test_of_many_windows_an_even_part_stands_for_all(two, env, monkeypatch):
    """Memory does not grow with the demonstrations; every clip keeps its weight."""
    monkeypatch.setattr("fmpjax.env.MOST_WINDOWS", 80)
    whole = two.rows_after(HORIZON - 1)
    rows, share = two.rows_after(HORIZON - 1, 80), two.share_after(HORIZON - 1, 80)
    assert rows.tolist() == [*range(9, 30, 3), *range(39, 230, 3)] and len(whole) == 212
    np.testing.assert_allclose([share[:7].sum(), share[7:].sum()], SHARES)
    assert two.rows_after(HORIZON - 1, 212).tolist() == whole.tolist()
    assert env.clip_windows().shape[0] == len(rows) == len(env.window_share())
    np.testing.assert_array_equal(
        env.clip_windows()[5], np.asarray(env._table.frame)[env.history_rows(jnp.array([24]))[0]]
    )


def test_episodes_start_in_the_clips_by_weight(two, env):
    rows = np.asarray(env.reset_rows(jax.random.PRNGKey(0), 20_000))
    short = rows < 30
    assert abs(short.mean() - 0.8) < 0.01
    # A whole window comes before each start, in the same clip, and every such row is met.
    assert set(rows[short]) == set(range(HORIZON - 1, 30)) and set(rows[~short]) == set(range(30 + HORIZON - 1, 230))
    before = np.asarray(env.history_rows(jnp.asarray(rows)))
    assert (two.clip_of(before) == two.clip_of(rows)[:, None]).all()


def test_any_time_of_a_clip_begins_an_episode_and_its_first_frame_stands_before_it(robot, two):
    """The paper's setting: four times per control step, from the first frame on; each clip's own first frame."""
    parts = 4
    settings = preset("smoke", **{"env.demonstration_parts": parts, "env.early_frames": True})
    env = Env(robot, two, settings, physics.make(robot, settings.physics))
    lengths = [(len(clip) - 1) * parts + 1 for clip in two.clips]
    assert env.clip_rows == sum(lengths) and env.library.clips[0].rate == 200.0
    rows = np.asarray(env.reset_rows(jax.random.PRNGKey(0), 20_000))
    assert set(rows[rows < lengths[0]]) == set(range(lengths[0])) and rows.max() == sum(lengths) - 1
    second = lengths[0]
    asked = jnp.array([0, 3, 5, 40, second - 1, second, second + 2, second + 9, env.clip_rows])
    before = np.asarray(env.history_rows(asked))
    expected = [
        [max(row - parts * k, second if row >= second else 0) for k in reversed(range(HORIZON))] for row in asked[:-1]
    ]
    np.testing.assert_array_equal(before, [*expected, [env.clip_rows] * HORIZON])
    # The prior's windows are those histories, of every row.
    windows = np.asarray(env.clip_windows())
    assert len(windows) == env.clip_rows and env.window_share().shape == (env.clip_rows,)
    table = np.asarray(env._table.frame)
    np.testing.assert_array_equal(windows[second + 9], table[before[-2]])
    np.testing.assert_allclose([env.window_share()[:second].sum(), env.window_share()[second:].sum()], SHARES)
    np.testing.assert_array_equal(env.clip_of(np.array([0, second - 1, second, env.clip_rows])), [0, 0, 1, 0])


def test_refined_clip_holds_the_clips_samples_and_what_lies_between(walk):
    fine = refined(walk, 4)
    assert len(fine) == 4 * (len(walk) - 1) + 1 and fine.rate == 200.0
    np.testing.assert_array_equal(fine.qpos[::4], walk.qpos)
    np.testing.assert_allclose(fine.qvel[::4], walk.qvel, atol=1e-12)
    np.testing.assert_allclose(fine.qpos[1::4, 7:], 0.75 * walk.qpos[:-1, 7:] + 0.25 * walk.qpos[1:, 7:], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(fine.qpos[:, 3:7], axis=1), 1.0, atol=1e-12)
    # Half way the root has turned by half.
    whole = rotations.log_map(rotations.multiply(rotations.conjugate(walk.qpos[5, 3:7]), walk.qpos[6, 3:7]))
    half = rotations.log_map(rotations.multiply(rotations.conjugate(walk.qpos[5, 3:7]), fine.qpos[22, 3:7]))
    np.testing.assert_allclose(half, whole / 2, atol=1e-12)
    assert refined(walk, 1) is walk


def test_one_clip_draws_as_it_always_did(robot, walk):
    one = Env(robot, walk, preset("smoke"), physics.make(robot, preset("smoke").physics))
    key = jax.random.PRNGKey(3)
    expected = jax.random.randint(key, (64,), HORIZON - 1, len(walk))
    np.testing.assert_array_equal(one.reset_rows(key, 64), expected)


def test_the_expert_bank_and_single_draws_follow_the_weights(two):
    windows = jnp.arange(212.0)[:, None]
    expert = Expert(windows, 1.0, jnp.ones(1), 1, share=jnp.asarray(two.share_after(HORIZON - 1)))
    for seed in range(10):
        rows = np.asarray(expert.bank_rows(jax.random.PRNGKey(seed), 500))
        counts = np.bincount(rows, minlength=212)
        # Stratified: each window as often as its share of the bank, rounded down or up.
        expected = 500 * np.asarray(expert.share)
        assert (np.abs(counts - expected) < 1 + 1e-3).all()
        assert abs((rows < 21).sum() - 400) <= 1
    drawn = np.asarray(expert.draw(jax.random.PRNGKey(0), (100, 200)))
    assert drawn.shape == (100, 200, 1) and abs((drawn < 21).mean() - 0.8) < 0.01


def test_features_are_standardized_by_weight(robot, two, env):
    """A weight of eight to two is as good as repeating windows until they are eight to two."""
    windows = env.clip_windows()
    weighed = features.fit_feature_map(robot, windows, FeatureConfig(), two.share_after(HORIZON - 1))
    # 21 windows of share 0.8 / 21 and 191 of 0.2 / 191: repeated 764 and 21 times.
    repeated = jnp.concatenate([jnp.repeat(windows[:21], 764, axis=0), jnp.repeat(windows[21:], 21, axis=0)])
    plain = features.fit_feature_map(robot, repeated, FeatureConfig())
    np.testing.assert_allclose(weighed.mean, plain.mean, atol=1e-5)
    np.testing.assert_allclose(weighed.deviation, plain.deviation, rtol=1e-4)
    uneven = features.fit_feature_map(robot, windows, FeatureConfig())
    assert np.abs(weighed.mean[..., 2] - uneven.mean[..., 2]).min() > 0.5


def test_means_over_clips_follow_the_weights(two):
    np.testing.assert_allclose(two.mean([1.0, 2.0]), 1.2)


def test_what_needs_one_motion_says_so():
    trainer = Trainer(preset("smoke", **TINY), motion.load_library("walk,turn_left"))
    with pytest.raises(UserError, match=r"the run has 2 motions \(walk, turn_left\): expected one"):
        _ = trainer.clip


# --- a run -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short run on two motions from the command line, opened again when their files are gone."""
    folder = tmp_path_factory.mktemp("library")
    mine = folder / "mine.npz"
    motion.save(motion.load("turn_left"), mine)
    changes = TINY | {"evaluation_episodes": 32, "transitions": 128, "evaluations": (1.0,)}
    command = ["train", "--preset", "smoke", "--motion", f"walk,{mine}:0.5", "--run", folder / "run", "--no-pictures"]
    cli.main([str(a) for a in [*command, *settings(changes)]])
    mine.unlink()
    return runs.Run.open(folder / "run")


@pytest.mark.slow
def test_a_run_learns_from_two_motions(trained):
    lib = trained.trainer().library
    assert [clip.name for clip in lib.clips] == ["walk", "mine"]
    np.testing.assert_allclose(lib.weights, (2 / 3, 1 / 3))
    assert trained.trainer().expert.share is not None
    found = json.loads((trained.folder / "evaluation.json").read_text())
    assert [share["motion"] for share in found["motions"]] == ["walk", "mine"]
    assert sum(share["episodes"] for share in found["motions"]) == 32
    assert sum(share["falls"] for share in found["motions"]) == found["falls"]
    expected = sum(w * planar_speed(clip) for w, clip in zip(lib.weights, lib.clips, strict=True))
    np.testing.assert_allclose(found["demonstration_speed"], expected)


@pytest.mark.slow
def test_an_export_hides_where_each_motion_lay(trained, tmp_path):
    runs.export(trained, tmp_path / "out")
    text = (tmp_path / "out" / "config.json").read_text()
    assert json.loads(text)["motion"] == "walk,mine.npz:0.5"
    assert str(trained.folder.parent) not in text + (tmp_path / "out" / "provenance.json").read_text()
