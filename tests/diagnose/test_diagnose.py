"""What a diagnosis says of histories that were made up, and of the project's own runs that stand, fall and walk.

``data/histories.json`` holds figures of runs below ``experiments/results``: the first 3 rows and the last 10, those
with an evaluation, and the best figures where the folder has them.
"""

import json
import subprocess
import sys

import pytest

from fmpjax import cli, diagnose
from fmpjax.config import flatten, preset, to_json
from fmpjax.diagnose import measures, rules, sentences
from fmpjax.errors import UserError
from tests.helpers import ROOT

RULES = {rule.name: rule for rule in diagnose.RULES}

TRAINING = {
    "transitions": 3e6,
    "env/cap": 150,
    "train/episode_length": 150,
    "train/falls": 0.0,
    "train/reward_spread": 0.49,
    "train/nonfinite": 0,
    "fit/score_spread": 0.2,
    "fit/expert_margin": 2.0,
    "fit/value_correlation": 0.9,
    "fit/unconverged": 0,
    "fit/sinkhorn_iterations": 30,
    "fit/skipped": 0,
    "fit/discriminator_loss": 0.4,
    "fit/agent_accuracy": 0.9,
    "ppo/kl": 0.03,
    "ppo/clipped": 0.4,
    "ppo/explained_variance": 0.9,
    "ppo/skipped": 0,
}
EVALUATION = {
    "episodes": 100,
    "falls": 0,
    "mean_length": 500,
    "late_speed": 1.0,
    "path_speed": 1.0,
    "turn": 0.0,
    "excursion": 1.0,
    "imbalance": 0.1,
    "demonstration_speed": 1.0,
    "demonstration_turn": 0.0,
    "demonstration_turning": 0.0,
    "quality": 0.8,
}


def history(method="fmp", settings=None, rows=12, **figures):
    """A healthy history of 3 M transitions, but for ``figures``, named as ``fit_score_spread`` or ``turn``."""
    training, evaluation = dict(TRAINING), dict(EVALUATION)
    for name, value in figures.items():
        section = name.replace("_", "/", 1)
        assert section in training or name in evaluation or name == "expert_ranges", name
        (training if section in training else evaluation)[section if section in training else name] = value
    table = [dict(training) for _ in range(rows)]
    config = preset("laptop", method=method, **(settings or {}))
    best = "eval/quality" if config.command.kind == "none" else "eval/score"
    table[-2][best], table[-1][best] = 0.8, evaluation["quality"]
    return diagnose.History(table, config, evaluation)


# Each rule at the last healthy figure and just beyond it.
BOUNDS = [
    ("falls early", dict(falls=10, mean_length=460), dict(falls=11, mean_length=456)),
    ("falls late", dict(falls=10, mean_length=490), dict(falls=11, mean_length=489)),
    ("falls in training", dict(train_falls=0.2), dict(train_falls=0.21)),
    ("stands", dict(late_speed=0.14, excursion=0.5), dict(late_speed=0.14, excursion=0.49)),
    ("stands", dict(late_speed=0.15, excursion=0.1), dict(late_speed=-0.14, excursion=0.1)),
    ("marches", dict(late_speed=0.15), dict(late_speed=0.14)),
    ("marches", dict(late_speed=-0.15), dict(late_speed=-0.14)),
    ("shuffles", dict(excursion=0.5), dict(excursion=0.49)),
    ("stamps", dict(excursion=1.5), dict(excursion=1.51)),
    ("too slow", dict(late_speed=0.6), dict(late_speed=0.59)),
    ("too slow", dict(late_speed=0.6), dict(late_speed=-1.0)),
    ("too fast", dict(late_speed=1.4), dict(late_speed=1.41)),
    ("turns wrong", dict(turn=0.15), dict(turn=-0.16)),
    (
        "turns wrong",
        dict(demonstration_turn=0.5, demonstration_turning=0.5, turn=0.25),
        dict(demonstration_turn=0.5, demonstration_turning=0.5, turn=0.24),
    ),
    ("limps", dict(imbalance=0.4), dict(imbalance=0.41)),
    ("got worse", dict(quality=0.2), dict(quality=0.19)),
    ("reward flat", dict(train_reward_spread=0.45), dict(train_reward_spread=0.44)),
    (
        "reward flat, not centered",
        dict(method="amp", train_reward_spread=0.08),
        dict(method="barycentric", train_reward_spread=0.07),
    ),
    (
        "reward flat, in its logarithm",
        dict(method="pwil", fit_score_spread=0.1),
        dict(method="smp", fit_score_spread=0.09),
    ),
    ("scores tie", dict(fit_score_spread=0.003), dict(fit_score_spread=0.0029)),
    ("margin negative", dict(fit_expert_margin=0.1), dict(fit_expert_margin=-1.0)),
    (
        "discriminator saturated",
        dict(method="amp", fit_discriminator_loss=0.05),
        dict(method="amp", fit_discriminator_loss=0.04),
    ),
    ("fit unconverged", dict(fit_unconverged=0.1), dict(fit_unconverged=0.11)),
    ("iterations at their maximum", dict(fit_sinkhorn_iterations=180), dict(fit_sinkhorn_iterations=181)),
    ("fit does not follow", dict(fit_value_correlation=0.5), dict(fit_value_correlation=0.49)),
    (
        "fit does not follow",
        dict(fit_value_correlation=0.0, fit_score_spread=0.09),
        dict(fit_value_correlation=0.0, fit_score_spread=0.1),
    ),
    ("states not finite", dict(train_nonfinite=0), dict(train_nonfinite=1)),
    ("reward updates skipped", dict(fit_skipped=0), dict(fit_skipped=0.04)),
    ("policy updates skipped", dict(ppo_skipped=0), dict(ppo_skipped=0.04)),
    ("KL off its target", dict(ppo_kl=0.06), dict(ppo_kl=0.061)),
    ("KL off its target", dict(ppo_kl=0.015), dict(ppo_kl=0.0149)),
    ("clipped share high", dict(ppo_clipped=0.6), dict(ppo_clipped=0.61)),
    ("critic worse than a constant", dict(ppo_explained_variance=0.0), dict(ppo_explained_variance=-0.01)),
]


@pytest.mark.parametrize(("name", "healthy", "sick"), BOUNDS, ids=[name for name, *_ in BOUNDS])
def test_a_rule_fires_beyond_its_bound_and_not_at_it(name, healthy, sick):
    assert name not in diagnose.symptoms(history(**healthy))
    said = diagnose.symptoms(history(**sick))[name]
    rule = RULES[name]
    assert (
        f"{rule.figure} is " in said
        and f"healthy is {rule.healthy};" in said
        and any(f"{key} (now " in said for key in rule.look)
    )
    assert said.endswith(".") and "\n" not in said


def test_every_rule_is_tried_at_its_bound():
    assert set(RULES) == {name for name, *_ in BOUNDS} and len(RULES) == len(diagnose.RULES)


@pytest.mark.parametrize(
    "method",
    [
        *("fmp", "endpoint", "value", "bank16", "barycentric", "amp", "gail", "wail", "pwil", "smp"),
        *("add", "tracking"),
    ],
)
def test_a_healthy_course_earns_one_sentence(method):
    assert diagnose.report(history(method)) == ["No symptom: every figure that was checked is in its healthy range."]


def test_a_sentence_names_the_figure_the_range_and_the_setting():
    said = diagnose.symptoms(history(late_speed=0.02, excursion=0.1))
    assert said == {
        "stands": "It stands, at 0.02 m/s where the demonstration goes at 1.00: excursion is 0.1, healthy is at least "
        "0.5; look at ppo.discount (now 0.97) and method (now fmp)."
    }


def test_settings_of_another_reward_are_not_named():
    assert "prior." not in diagnose.symptoms(history("amp", fit_expert_margin=-1))["margin negative"]
    assert "amp." not in diagnose.symptoms(history("value", fit_expert_margin=-1))["margin negative"]
    said = diagnose.symptoms(history("gail", fit_discriminator_loss=0.01))["discriminator saturated"]
    assert "look at gail.gradient_penalty (now 0.0), gail.learning_rate" in said and "amp." not in said


@pytest.mark.parametrize(
    "figures",
    [
        dict(falls=51, mean_length=400, late_speed=0.0, excursion=0.1, imbalance=1.5, turn=1.0),
        dict(falls=100, mean_length=60, late_speed=None, path_speed=None, turn=None, excursion=None, imbalance=None),
    ],
)
def test_where_most_episodes_fall_the_gait_is_not_judged(figures):
    found, lacking = sentences.apply_rules(history(**figures))
    assert list(found) in (["falls early"], ["falls late"]) and not set(lacking) - {"eval/excursion"}


def test_a_demonstration_that_stands_has_no_pace():
    assert not diagnose.symptoms(history(demonstration_speed=0.05, late_speed=0.0, path_speed=0.0))


def test_where_the_demonstration_turns_the_pace_is_along_the_own_heading():
    turning = dict(demonstration_turn=0.5, demonstration_turning=0.5, turn=0.5, late_speed=-0.4)
    assert not diagnose.symptoms(history(**turning))
    assert list(diagnose.symptoms(history(**turning, path_speed=2.0))) == ["too fast"]
    standing = diagnose.symptoms(history(**turning, path_speed=0.02, excursion=0.1))["stands"]
    assert standing.startswith("It stands, at 0.02 m/s where the demonstration goes at 1.00")


def test_left_and_right_turns_that_cancel_are_not_judged():
    assert not diagnose.symptoms(history(demonstration_turn=0.1, demonstration_turning=0.6, turn=0.4))


def test_a_demonstration_that_limps_may_be_followed():
    ranges = [60, 60, 60, 30, 30, 30]  # an imbalance of 2/3
    assert not diagnose.symptoms(history(imbalance=0.9, expert_ranges=ranges))
    assert "limps" in diagnose.symptoms(history(imbalance=1.1, expert_ranges=ranges))


def test_without_a_target_the_divergence_is_not_judged():
    assert not diagnose.symptoms(history(ppo_kl=1.0, settings={"ppo.target_kl": 0.0}))


def test_updates_of_a_policy_that_settles_have_another_target():
    made = history(settings={"ppo.settle": 0.25, "transitions": 1_000_000})
    for i, row in enumerate(made.rows):
        row["transitions"] = 100_000 * (i - 1)
        # The row in which it begins is of both.
        row["ppo/kl"] = 0.03 if row["transitions"] <= 800_000 else 0.008
    assert measures.kl(made) == pytest.approx(1.0) and not diagnose.symptoms(made)
    for row in made.rows:
        row["ppo/kl"] = 0.03
    assert len(diagnose.symptoms(made)) == 1


def test_training_figures_are_means_of_the_last_rows_without_the_first():
    made = history(rows=6)
    made.rows[0]["ppo/kl"] = 100.0
    assert not diagnose.symptoms(made)
    long = history(rows=30)
    for row in long.rows[:20]:
        row["train/falls"] = 1.0
    assert not diagnose.symptoms(long)
    long.rows[20]["train/falls"] = 1.0
    assert diagnose.History(long.rows, long.config, long.evaluation)["train/falls"] == pytest.approx(0.1)
    only = history(rows=2)
    assert diagnose.symptoms(diagnose.History(only.rows[:1], only.config, {"quality": 0.8})) == {}


@pytest.mark.parametrize("name", [*TRAINING, *(f"eval/{name}" for name in EVALUATION)])
def test_a_missing_figure_silences_its_rules_and_is_named(name):
    made = history(fit_skipped=1)
    evaluation = {k: v for k, v in made.evaluation.items() if f"eval/{k}" != name}
    rows = [{k: v for k, v in row.items() if k != name or k == "transitions"} for row in made.rows]
    found, lacking = sentences.apply_rules(diagnose.History(rows, made.config, evaluation))
    assert set(found) == {"reward updates skipped"} - set(lacking.get("fit/skipped", []))
    of_amp = ("fit/discriminator_loss", "fit/agent_accuracy")
    of_falls = ("env/cap", "train/episode_length", "eval/mean_length")
    of_turns = ("eval/path_speed", "eval/demonstration_turning")  # the demonstration goes straight
    assert (name in lacking) == (name not in ("transitions", *of_amp, *of_falls, *of_turns))
    if lacking:
        assert diagnose.report(diagnose.History(rows, made.config, evaluation))[-1] == (
            f"Not checked: {', '.join(lacking[name])} (no {name})."
        )


def test_a_run_without_an_evaluation_says_what_it_could_not_check():
    made = history()
    rows = [{k: v for k, v in row.items() if k != "eval/quality"} for row in made.rows]
    said = diagnose.report(diagnose.History(rows, made.config, diagnose.newest(rows)))
    assert said[0].startswith("No symptom") and len(said) == 2
    assert (
        said[1].startswith("Not checked: falls early, falls late, stands, ")
        and "got worse (no eval/quality)" in said[1]
    )


def test_figures_that_a_command_changes_are_not_judged_with_it():
    flat = dict(train_reward_spread=0.2, late_speed=0.59, turn=0.4)
    assert list(diagnose.symptoms(history(**flat))) == ["too slow", "turns wrong", "reward flat"]
    told = history(**flat, settings={"command.kind": "velocity"})
    assert list(diagnose.symptoms(told)) == ["too slow", "turns wrong"]
    assert not diagnose.symptoms(history(**flat, settings={"command.kind": "phase"}))


@pytest.mark.parametrize(("reset", "settled"), diagnose.SETTLED.items())
def test_symptoms_early_in_a_run_are_put_in_their_place(reset, settled):
    settings = {"env.reset": reset, "transitions": round(3e6 / settled)}
    assert "good runs" not in diagnose.text(history(train_falls=1.0, settings=settings))
    settings["transitions"] += 100_000
    assert f"up to {100 * settled:.0f} %" in diagnose.text(history(train_falls=1.0, settings=settings))
    assert "good runs" not in diagnose.text(history(settings=settings))


# --- the project's own runs -------------------------------------------------------------------------------------------

SYMPTOMS = {
    "lafan1_standing": ["falls early", "falls in training", "stands"],
    "lafan1_walk": [],
    "lafan1_walk_seed1": ["too slow"],  # its last policy; the best one walks, below
    "lafan1_fixed": [],
    "bundled_walk": [],
    "run1_jog": [],
    "turn_left": [],
    "learning_apart/late-128-seed0": ["falls late", "marches", "got worse"],
    "table1/value-fixed-seed0": ["falls early", "falls in training", "margin negative"],
    "table1/amp-dataset-seed0": [],
    "table1/barycentric-dataset-seed0": ["stands"],
    "table1/barycentric-fixed-seed0": ["stands", "reward flat, not centered"],
    "table1_bank_queries/fmp-fixed-seed0": ["stands"],
    "table1_bank_queries/fmp-dataset-seed0": [],
    "table1_bank_queries/value-fixed-seed0": ["stands", "scores tie", "margin negative"],
}


@pytest.fixture(scope="module")
def histories(data):
    recorded = json.loads((data / "histories.json").read_text())
    made = {}
    for name, kept in recorded.items():
        rows = [dict(zip(kept["columns"], row, strict=True)) for row in kept["rows"]]
        settings = {"env.reset": kept["reset"], "env.last_cap": kept["last_cap"]}
        made[name] = (rows, preset("laptop", method=kept["method"], **settings), kept.get("best"))
    return made


@pytest.mark.parametrize("name", SYMPTOMS)
def test_the_last_policy_of_a_run(histories, name):
    rows, config, _ = histories[name]
    made = diagnose.History(rows, config, diagnose.newest(rows))
    found, lacking = sentences.apply_rules(made)
    assert list(found) == SYMPTOMS[name]
    # Courses from before turning was measured do not say how the policy turns.
    old = name in ("table1_bank_queries/fmp-dataset-seed0",)
    assert lacking == ({"eval/demonstration_turn": ["turns wrong"]} if old else {})


@pytest.mark.parametrize("name", ["lafan1_walk", "lafan1_walk_seed1", "lafan1_fixed", "bundled_walk", "run1_jog"])
def test_the_best_policy_of_a_walk_has_no_symptom(histories, name):
    rows, config, best = histories[name]
    assert diagnose.symptoms(diagnose.History(rows, config, best)) == {}


def test_no_rule_is_for_a_method_or_a_setting_that_does_not_exist():
    from fmpjax import priors

    known = flatten(preset("laptop"))
    for rule in diagnose.RULES:
        assert set(rule.look) <= set(known) and set(rule.methods) <= set(priors.METHODS)
        for method in rule.methods or priors.METHODS:
            assert any(rules.reads(method, key) for key in rule.look), (rule.name, method)


def test_the_page_has_the_ranges_of_the_rules():
    """Where this fails, ``print(fmpjax.diagnose.page())`` is the table."""
    assert diagnose.page() in (ROOT / "docs" / "metrics.md").read_text()


# --- files and the command -------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
    """A run's folder: its last policy stands, the best one walks."""
    made = history(late_speed=0.0, path_speed=0.0, excursion=0.1, quality=0.7)
    last = {f"eval/{name}": value for name, value in made.evaluation.items()}
    rows = [made.rows[0], *made.rows[1:-1], made.rows[-1] | last]
    names = ["iteration", "seconds", *rows[-1]]
    lines = [",".join(names), *(",".join(str(row.get(name, "")) for name in names) for row in rows)]
    (tmp_path / "metrics.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "config.json").write_text(to_json(made.config))
    (tmp_path / "evaluation.json").write_text(json.dumps(EVALUATION))
    return tmp_path


def test_the_command_judges_the_best_policy_or_the_newest(folder, capsys):
    cli.main(["diagnose", str(folder)])
    best = capsys.readouterr().out
    assert best.startswith(
        "diagnosis at 3,000,000 transitions, by evaluation.json (the best policy) and the last 10 rows"
    )
    assert "No symptom" in best and "It stands" not in best
    cli.main(["diagnose", str(folder), "--last"])
    last = capsys.readouterr().out
    assert "by the newest evaluation" in last and "  - It stands, at 0.00 m/s" in last
    (folder / "evaluation.json").unlink()
    cli.main(["diagnose", str(folder)])
    assert capsys.readouterr().out == last


@pytest.mark.parametrize(
    ("file", "content", "expected"),
    [
        ("config.json", None, "is not a run folder: expected config.json in it"),
        ("config.json", "{", "config.json is not valid JSON"),
        ("metrics.csv", None, "metrics.csv has no rows"),
        ("metrics.csv", "iteration,transitions,seconds\n", "metrics.csv has no rows"),
        (
            "metrics.csv",
            "iteration,transitions,seconds,train/falls\n1,9,1,high\n",
            "train/falls of the run's figures is",
        ),
        ("evaluation.json", "[]", "evaluation.json is not valid JSON: expected the figures of an evaluation"),
        ("evaluation.json", "{", "evaluation.json is not valid JSON"),
        ("evaluation.json", '{"falls": "few"}', "eval/falls of the run's figures is 'few': expected a number"),
    ],
)
def test_a_broken_folder_is_one_sentence(folder, capsys, file, content, expected):
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_text(content)
    with pytest.raises(SystemExit) as exited:
        cli.main(["diagnose", str(folder)])
    error = capsys.readouterr().err
    assert exited.value.code == 2 and expected in error and error.count("\n") == 1
    with pytest.raises(UserError):
        diagnose.text(diagnose.read(folder))


def test_the_module_needs_no_jax():
    command = [sys.executable, "-c", "import sys, fmpjax.diagnose; sys.exit('jax' in sys.modules)"]
    assert subprocess.run(command, cwd=ROOT, timeout=60, check=False).returncode == 0
