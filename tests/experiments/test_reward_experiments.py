"""The reward-level experiments: each of their measures against a closed form, their commands and the report."""

import dataclasses
import json
import math
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fmpjax import cli, potential, priors, runs, transport
from fmpjax.config import Config, PriorConfig
from fmpjax.errors import UserError
from fmpjax.experiments import barycenter, curvature, generalization, ranking, report, standing, static_teacher
from fmpjax.experiments.common import histories, offline, reference, results, table
from fmpjax.priors import flow
from fmpjax.trainer import Trainer
from tests.helpers import PROVENANCE, tiny

SMALL = PriorConfig(bank=16, minibatch=16, hidden=(8,))


# --- references and agreement ----------------------------------------------------------------------------------------


def test_reference_of_one_atom_on_either_side():
    """Every window at s, the expert at y: whatever the bank, the score is (y - s) x up to a constant."""
    s, y = np.array([0.3, -0.2]), np.array([-0.4, 0.7])
    query = np.random.default_rng(0).normal(size=(9, 2))
    pool, expert, query = (jnp.asarray(a, jnp.float32) for a in (np.tile(s, (40, 1)), np.tile(y, (5, 1)), query))
    found = reference.reference(pool, expert, query, 2.0, SMALL, jax.random.PRNGKey(0), 3)
    expected = np.asarray(query) @ (y - s)
    np.testing.assert_allclose(found.score, expected - expected.mean(), atol=1e-5)
    np.testing.assert_allclose(found.gradient, np.tile(y - s, (9, 1)), atol=1e-5)


def test_reference_is_the_mean_over_fresh_banks():
    rng = np.random.default_rng(1)
    pool, expert, query = (
        jnp.asarray(rng.normal(size=(n, 3)) + c, jnp.float32) for n, c in ((200, 0), (16, 1), (7, 0))
    )
    found = reference.reference(pool, expert, query, 3.0, SMALL, jax.random.PRNGKey(4), 2)

    @jax.jit
    def one(key):
        fitted = transport.fit_score(pool[jax.random.randint(key, (16,), 0, 200)], expert, threshold=1e-6)
        return fitted.score(query), fitted.gradient(query)

    scores, slopes = zip(*map(one, jax.random.split(jax.random.PRNGKey(4), 2)), strict=True)
    expected = np.mean(scores, 0)
    np.testing.assert_allclose(found.score, expected - expected.mean(), atol=1e-3)
    np.testing.assert_allclose(found.gradient, np.mean(slopes, 0), atol=1e-3)
    assert jnp.abs(slopes[0] - slopes[1]).max() > 0.01, "the banks are one and the same"


@pytest.fixture(scope="module")
def compared():
    """A layout, a reference on it, and the reference's score and gradient."""
    layout = offline.lay_out(held_out=40, paths=8, standing=6, walking=5)
    assert (layout.held_out, layout.executed, layout.walking) == (slice(40), slice(80, 91), slice(86, 91))
    assert [(s.start, s.stop) for s in layout.paths] == [(40, 48), (48, 56), (56, 64), (64, 72), (72, 80)]
    rng = np.random.default_rng(2)
    score, slope = rng.normal(size=91).astype(np.float32), rng.normal(size=(91, 3)).astype(np.float32)
    return layout, reference.Reference(jnp.asarray(score), jnp.asarray(slope)), score, slope


def test_agreement_with_a_scaled_copy(compared):
    """Twice the score, plus seven: what a scale and a constant do not change is perfect, the rest is known."""
    layout, truth, score, slope = compared
    figures = offline.agreement(reference.Reference(7 + 2 * truth.score, 2 * truth.gradient), truth, layout, 1e-6)
    assert figures["held_out_error"] == pytest.approx(0, abs=1e-5)
    assert figures["source_error"] == pytest.approx(0, abs=1e-5)
    assert figures["path_correlation"] == pytest.approx([1] * 5, abs=1e-5)
    for key in ("held_out_cosine", "held_out_correlation", "walking_cosine", "walking_correlation"):
        assert figures[key] == pytest.approx(1, abs=1e-5)
    source = score[40:48]
    scale = np.subtract(*np.quantile(source, [0.75, 0.25]))
    increments = [np.sqrt(np.mean((score[40 + 8 * i : 48 + 8 * i] - source) ** 2)) / scale for i in range(5)]
    assert figures["path_increment"] == pytest.approx(increments, rel=1e-4, abs=1e-6)
    executed = score[80:]
    expected = executed.std() / np.subtract(*np.quantile(executed, [0.75, 0.25]))
    assert figures["executed_error"] == pytest.approx(expected, rel=1e-4)


def test_agreement_with_the_opposite(compared):
    layout, truth, score, _ = compared
    figures = offline.agreement(reference.Reference(-truth.score, -truth.gradient), truth, layout, 1e-6)
    assert figures["path_cosine"] == pytest.approx([-1] * 5, abs=1e-5)
    assert figures["walking_correlation"] == pytest.approx(-1, abs=1e-5)
    # A reward and the opposite one are two together: 2 sigma(u) and 2 sigma(-u).
    low, middle, high = np.quantile(score[:40], [0.25, 0.5, 0.75])
    reward = 2 / (1 + np.exp(-(score[:40] - middle) / (high - low)))
    assert figures["held_out_error"] == pytest.approx(np.abs(2 * reward - 2).mean(), rel=1e-4)


# --- fitting ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def banks():
    rng = np.random.default_rng(3)
    return {name: jnp.asarray(rng.normal(size=(16, 3)) + c, jnp.float32) for name, c in (("b", 0), ("c", 0), ("e", 1))}


def test_static_supervision_is_the_score_gradient_of_a_second_bank(banks):
    """At the dynamic samples' points, at time zero; the loss is eq. static."""
    query, params = banks["c"] + 0.1, potential.init(jax.random.PRNGKey(1), 3, 3.0, (8,))
    first, second = (priors.couple(banks[name], banks["e"], 3.0, SMALL) for name in "bc")
    teacher = flow.teach(first, banks["e"], query)
    dynamic = flow.sample_flow(jax.random.PRNGKey(2), query, teacher, banks["b"], banks["e"])
    static = flow.static_path(dynamic, second, banks["e"])
    np.testing.assert_array_equal(static.point, dynamic.point)
    with jax.enable_x64(True):
        bank, expert, points = (np.asarray(x, np.float64) for x in (banks["c"], banks["e"], dynamic.point))
        expected = np.asarray(jax.jit(lambda: transport.fit_score(bank, expert).gradient(points))())
    np.testing.assert_allclose(static.velocity, expected, atol=5e-3)
    params = params._replace(weights=tuple(w + 0.3 for w in params.weights))
    _, stats = flow.losses(params, query, teacher, static, 3.0, SMALL)
    _, slope = potential.score_and_gradient(params, dynamic.point, 3.0)
    loss = np.mean(np.sum((np.asarray(slope) - np.asarray(static.velocity)) ** 2, -1))
    assert float(stats["flow_loss"]) == pytest.approx(float(loss), rel=1e-4)


def test_priors_of_a_study_share_start_and_streams():
    """Without the loss along the paths, the static teacher and Endpoint are one: the same bank, queries and start."""
    rng = np.random.default_rng(5)
    windows = jnp.asarray(rng.normal(size=(30, 3)) + 1, jnp.float32)
    expert = priors.Expert(windows, 3.0, jnp.full(3, 3**-0.5), 1)
    rollout = priors.Rollout(jnp.asarray(rng.normal(size=(8, 16, 3)), jnp.float32), jnp.ones((8, 16), bool))
    config = Config(prior=dataclasses.replace(SMALL, flow_weight=0.0, query_is_bank=True, query_share=1.0))
    fits, rate = offline.fit(("static", "endpoint"), expert, config, rollout, 3, jax.random.PRNGKey(0))
    assert np.abs(fits["static"].state.params.linear).max() > 0 and rate > 0
    jax.tree.map(np.testing.assert_array_equal, fits["static"].state, fits["endpoint"].state)


def test_paths_lead_from_the_windows_to_expert_atoms(banks):
    source = banks["b"] - 2
    points = offline.paths(banks["b"], banks["e"], source, 3.0, SMALL, jax.random.PRNGKey(0))
    assert len(points) == len(offline.FRACTIONS)
    np.testing.assert_array_equal(points[0], source)
    np.testing.assert_allclose(points[2], 0.5 * (points[0] + points[4]), atol=1e-6)
    np.testing.assert_allclose(points[1], 0.75 * points[0] + 0.25 * points[4], atol=1e-6)
    distance = np.linalg.norm(np.asarray(points[4])[:, None] - np.asarray(banks["e"]), axis=-1)
    assert distance.min(-1).max() < 1e-5


def test_floor_counts_the_products_of_an_update():
    """2.88 GFLOP at the paper's size; static labels cost a second teacher's products."""
    dynamic = offline.product_flops(PriorConfig(), 1170)
    static = offline.product_flops(PriorConfig(), 1170, static=True)
    assert sum(dynamic.values()) == pytest.approx(2.88e9, rel=0.01)
    assert sum(static.values()) - sum(dynamic.values()) == 2 * 1170 * 256 * 256 * 6


@pytest.mark.parametrize(
    ("updates", "smoke", "chosen"), [(None, False, 9216), (None, True, 4), (256, False, 256), (5, True, 5)]
)
def test_size_of_a_study(updates, smoke, chosen):
    assert offline.size(updates, smoke).updates == chosen


@pytest.mark.parametrize("updates", [0, -128, 130])
def test_updates_are_whole_blocks(updates):
    with pytest.raises(UserError, match=f"--updates is {updates}: expected a multiple of 128"):
        offline.size(updates, False)


# --- barycenter and curvature ----------------------------------------------------------------------------------------


def test_retention_of_opposite_and_of_equal_velocities():
    velocity = np.array([[3.0, 4.0, 0, 0, 0, 0], [-3.0, -4.0, 0, 0, 0, 0]])
    kept, matched = barycenter.retention(np.array([[0.5, 0.5], [1.0, 0.0], [0.75, 0.25]]), velocity)
    np.testing.assert_allclose(kept, [0.0, 5.0, 2.5])
    np.testing.assert_allclose(matched, [5.0, 5.0, 5.0])


@pytest.fixture(scope="module")
def trainer():
    config = tiny(**{"method": "barycentric", "ppo.rollout_steps": 32, "ppo.critic_batch": 8, "ppo.actor_batch": 8})
    return Trainer(config, runs.load_motion(config))


def test_features_go_back_to_units(trainer):
    windows = trainer.env.clip_windows()[20:30]
    newest = np.asarray(trainer.feature_map(windows), np.float64).reshape(10, trainer.env.horizon, -1)[:, -1]
    expected = np.asarray(windows[:, -1])
    np.testing.assert_allclose(barycenter.in_units(trainer.feature_map, newest)[:, 2:], expected[:, 2:], atol=1e-4)
    legs = -trainer.robot.joint_count + trainer.robot.sagittal_joints
    rows = np.arange(20, 30) + trainer.env.horizon - 1
    np.testing.assert_allclose(
        expected[:, legs], trainer.clip.qvel[rows][:, 6 + trainer.robot.sagittal_joints], atol=1e-5
    )


@pytest.mark.slow
def test_barycentric_rewards_are_made_anew(trainer):
    figures, other = barycenter.measure(trainer, 64, (0, 1))[0.1]
    assert figures["retention"] != other["retention"] and figures["bank"] == other["bank"]
    assert figures["reward_difference"] < barycenter.REWARD_TOLERANCE and figures["exponent_difference"] < 1e-3
    assert 0 < figures["retention"] < 1 and 1 <= figures["effective_atoms"] <= figures["bank"] == 16
    assert figures["retention"] == pytest.approx(figures["target_leg_velocity"] / figures["matched_leg_velocity"])
    # The bundled walk goes at 0.86 m/s.
    assert figures["bank_speed"] == pytest.approx(0.86, abs=0.1)
    with pytest.raises(UserError, match="the first rollout has 256 windows: expected at least 300"):
        barycenter.measure(trainer, 300, (0,))


def test_barycentric_figures_are_means_over_draws():
    """Retentions of 0.1 and 0.3: 0.2, deviation 0.1 sqrt 2. Of what must agree the largest difference is kept."""

    def draw(retention, difference):
        names = ("target_leg_velocity", "matched_leg_velocity", "effective_atoms", "target_speed", "bank_speed", "bank")
        figures = dict.fromkeys((*names, "exponent_difference"), 2.0) | {"effective_atoms_quantiles": [0.0, retention]}
        return figures | {"retention": retention, "reward_difference": difference}

    found = barycenter.over_draws([draw(0.1, 1e-7), draw(0.3, 2e-8)])
    assert found["retention"] == pytest.approx(0.2) and found["deviation"]["retention"] == pytest.approx(
        0.1414, abs=1e-4
    )
    assert found["reward_difference"] == 1e-7 and found["effective_atoms_quantiles"] == pytest.approx([0.0, 0.2])
    assert barycenter.over_draws([draw(0.1, 1e-7)])["deviation"] == {}
    record = {"settings": {"targets": 64, "draws": 2, "entropy": 0.1}, "resets": {"fixed": found}}
    shown = barycenter.table(record | {"entropies": {"0.15": {"fixed": draw(0.05, 0.0)}}})
    assert "means over 2 draws" in shown.caption
    assert [line[:2] for line in shown.lines] == [
        ["fixed reset", "0.200 ± 0.141"], ["fixed reset, entropy 0.15", "0.050"], ["fixed reset, the paper's", "0.103"],
    ]  # fmt: skip
    # A result of an earlier version is of one draw.
    assert barycenter.table({"settings": {"targets": 64}, "resets": {"fixed": draw(0.2, 0.0)}}).lines[0][1] == "0.200"


def test_curvature_is_its_closed_form():
    """-1 + a^2 / epsilon for another a than the command's; the barycentric reward's is -4 whatever epsilon."""
    found = curvature.landscapes(0.7, (0.1, 0.49, 2.0), np.array([-0.7, 0.0, 0.7]))
    np.testing.assert_allclose(found["score_curvature"], -1 + 0.49 / np.array([0.1, 0.49, 2.0]), atol=1e-10)
    np.testing.assert_allclose(found["barycentric_curvature"], -4.0, atol=1e-10)
    # Below a^2 the atoms are better than the middle for the score, for the barycenter never.
    assert found["score"][0, 0] == pytest.approx(found["score"][0, 2]) and found["score"][0, 0] > 0
    assert (found["score"][2, [0, 2]] < 0).all() and (found["barycentric"][:, [0, 2]] < 0).all()


# --- bad input -------------------------------------------------------------------------------------------------------


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys):
    """Run a bad command of an experiment below ``tmp_path``; the sentence that it earned."""
    monkeypatch.chdir(tmp_path)

    def run(main, *arguments):
        before = sorted(tmp_path.rglob("*"))
        capsys.readouterr()
        with pytest.raises(SystemExit) as exit_:
            results.entry(main, [str(a) for a in arguments])
        error = capsys.readouterr().err
        assert exit_.value.code == 2 and error.startswith("fmpjax: ") and error.count("\n") == 1, error
        assert sorted(tmp_path.rglob("*")) == before, "a refused command wrote something"
        return error

    return run


def test_run_without_a_policy(refused, tmp_path):
    runs.Run.create(tmp_path / "run", tiny())
    error = refused(generalization.main, "--run", "run", "--walking", "run", "--out", "out", "--smoke")
    assert "has no checkpoint in checkpoints/: train the run first" in error
    assert "none is not a run folder" in refused(
        static_teacher.main, "--run", "none", "--walking", "run", "--out", "out"
    )


def test_place_that_cannot_be_written(refused, tmp_path):
    (tmp_path / "file").write_text("")
    assert "--out file/out cannot be written" in refused(curvature.main, "--out", "file/out")
    assert "--out file cannot be written" in refused(standing.COMMANDS, "measure", "--out", "file")
    look = ("look", "--run", "run", "--out")
    assert "--out file cannot be written" in refused(standing.COMMANDS, *look, "file/look.csv")
    (tmp_path / "folder").mkdir()
    assert "--out folder is a folder: expected a file" in refused(standing.COMMANDS, *look, "folder")
    runs.Run.create(tmp_path / "run", tiny())
    assert "--out folder is a folder" in refused(ranking.main, "--run", "run", "--out", "folder")


def test_a_study_of_a_potential_wants_one(refused):
    measure = ("measure", "--out", "out", "--set", "method=amp")
    assert "method is 'amp': expected one that fits a potential" in refused(standing.COMMANDS, *measure)


def test_a_table_is_written_into_a_new_folder_with_whole_numbers_and_blanks(tmp_path):
    path = results.write_csv(tmp_path / "new" / "a.csv", [{"n": 12_345_678, "x": 1 / 3}, {"n": 1, "x": math.nan}])
    assert path.read_text().split() == ["n,x", "12345678,0.333333", "1,"]


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (("--draws", "0"), "--draws is 0: expected at least 1"),
        (("--entropies", "0.1", "-1"), "--entropies has -1: expected numbers above 0"),
        (("--entropies", "nan"), "--entropies has nan: expected numbers above 0"),
    ],
)
def test_bad_draws_and_entropies(refused, option, message):
    assert message in refused(barycenter.main, "--out", "out", *option)


def test_history_longer_than_the_time_since_the_reset():
    trainer = SimpleNamespace(config=tiny(), env=SimpleNamespace(horizon=18))
    with pytest.raises(UserError, match="a history of 18 frames needs 18 steps: expected at most 17, the steps from"):
        histories.soon_after_reset(trainer, None, None, jax.random.PRNGKey(0), 4, "standing")


@pytest.mark.slow
def test_cohort_of_those_who_stay_up(trainer, monkeypatch):
    """Histories end 17 to 32 steps after the reset, in environments that have not fallen; without any, one sentence."""
    state, key = trainer.init(), jax.random.PRNGKey(0)
    play = trainer.env.rollout

    def falling(share):
        def rollout(*arguments):
            after, record = play(*arguments)
            late = jnp.arange(len(record.fell))[:, None] >= 16  # the step after which a history may end
            return after, record._replace(fell=late & (jnp.arange(record.fell.shape[1]) < share))

        return rollout

    def cohort():
        return histories.soon_after_reset(trainer, state.ppo, trainer.feature_map, key, 4, "walking")

    monkeypatch.setattr(trainer.env, "rollout", falling(5))
    assert cohort().features.shape == (3, trainer.expert.windows.shape[-1])
    monkeypatch.setattr(trainer.env, "rollout", falling(8))
    with pytest.raises(UserError, match="the walking cohort is empty: all 8 episodes fell before 0.64 s"):
        cohort()


@pytest.mark.slow
def test_a_study_from_run_folders_to_its_files(tmp_path, capsys):
    run = runs.Run.create(tmp_path / "here" / "run", tiny())
    run.checkpoints.save(run.trainer().init())
    generalization.main(run.folder, run.folder, tmp_path / "out", smoke=True)
    record = json.loads((tmp_path / "out" / "generalization.json").read_text())
    assert set(record["models"]) == {"fmp", "endpoint", "value", "groups"}
    assert str(tmp_path) not in json.dumps(record)
    assert record["models"]["fmp"]["path_increment"][0] == 0 and record["models"]["fmp"]["seconds"] > 0
    assert len((tmp_path / "out" / "generalization.csv").read_text().splitlines()) == 5
    assert (tmp_path / "out" / "generalization.png").stat().st_size > 10_000
    assert "FMP, the paper's" in capsys.readouterr().out


# --- the report ------------------------------------------------------------------------------------------------------


def static_record(dynamic=0.3, static=0.4):
    def model(error):
        figures = {"path_increment": [0.0, error, error, 1 / error, 1 / error], "path_cosine": [0.9] * 4 + [error]}
        return figures | {"source_error": 0.06, "walking_correlation": 0.9, "seconds": 1000 * error}

    return {
        "provenance": PROVENANCE,
        "settings": {"updates": 9216},
        "fractions": list(offline.FRACTIONS),
        "models": {"fmp": model(dynamic), "static": model(static)},
    }


def write_static(folder, record):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "static_teacher.json").write_text(json.dumps(record))
    static_teacher.figure(record, folder / "static_teacher.png")


def test_report_is_one_page_that_needs_nothing_else(tmp_path):
    write_static(tmp_path / "deep" / "reward", static_record())
    (tmp_path / "deep" / "policy.mp4").write_bytes(b"film")
    cli.main(["report", str(tmp_path), "--out", str(tmp_path / "report.html")])
    page = (tmp_path / "report.html").read_text()
    assert set(re.findall(r'(?:src|href)="(.*?)[;"]', page)) == {"data:image/png", "data:video/mp4"}
    assert "http" not in page and "<script" not in page
    assert page.count("Not measured here") == 4
    assert "generalization --run STANDING_RUN --walking WALKING_RUN --out FOLDER" in page
    assert "commit 0123456789ab" in page
    assert page.count('<span class="yes">') == 6 and '<span class="no">' not in page
    # The paper's figures stand beside ours.
    assert "0.284" in page and "0.300" in page and "a ratio of 1.33 (the paper&#x27;s 1.41)" in page
    text = (tmp_path / "report.md").read_text()
    assert "![Dynamic against static path supervision](deep/reward/static_teacher.png)" in text
    assert text.count("**Holds.**") == 6


def test_report_follows_the_figures(tmp_path):
    """The other way round, no claim but the times' holds, and that not either."""
    write_static(tmp_path, static_record(0.4, 0.3))
    report.write(tmp_path, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert page.count('<span class="no">') == 6 and '<span class="yes">' not in page


def test_report_without_results(tmp_path, capsys):
    for folder, message in ((tmp_path, "no results below"), (tmp_path / "none", "is not a folder")):
        with pytest.raises(SystemExit):
            cli.main(["report", str(folder)])
        assert message in capsys.readouterr().err
    (tmp_path / "curvature.json").write_text("{}")
    with pytest.raises(UserError, match="curvature.json is no result of this version"):
        report.write(tmp_path, tmp_path / "report.html")
    (tmp_path / "curvature.json").unlink()
    for broken in ({"provenance": {}}, {"provenance": None}):
        (tmp_path / "static_teacher.json").write_text(json.dumps(static_record() | broken))
        with pytest.raises(UserError, match="static_teacher.json is no result of this version"):
            report.write(tmp_path, tmp_path / "report.html")
    assert not list(tmp_path.glob("report*"))


def test_matched_comparison_in_the_report():
    """Claims follow the last evaluation of each cell; those without a side are left out."""

    def evaluation(method, speed, transitions=2, falls=0.0, reset="dataset"):
        figures = {"late_speed": speed, "falls": falls, "excursion": None, "demonstration_speed": 0.8}
        cell = {"cell": method, "method": method, "reset": reset, "variant": "", "seed": 0, "seconds": 1.0}
        return cell | {"transitions": transitions} | figures

    final = table.final([evaluation("fmp", 0.1, 1), evaluation("fmp", 0.7), evaluation("amp", 0.5)])
    assert [row.figures["late_speed"] for row in final] == [0.7, 0.5]
    assert [v.holds for v in table.verdicts(final)] == [True, True]
    final = table.final([evaluation("fmp", 0.7, falls=9.0), evaluation("amp", 0.75)])
    assert [v.holds for v in table.verdicts(final)] == [False, False]
    assert len(table.verdicts(final[:1])) == 1
    # Where everybody falls within five seconds there is no late speed.
    walks, falls = evaluation("fmp", 0.7, reset="fixed"), evaluation("endpoint", None, falls=100.0, reset="fixed")
    (verdict,) = table.verdicts(table.final([walks, falls]))
    assert verdict.holds and verdict.found.endswith("100.0 % and no one after 5 s (Endpoint)")
    (verdict,) = table.verdicts(table.final([walks | {"late_speed": None, "falls": 100.0}, falls]))
    assert not verdict.holds
