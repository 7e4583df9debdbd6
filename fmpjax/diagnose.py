"""What is wrong with a run, in words: one sentence per symptom, with the figure, its healthy range and where to look.

`RULES` is the one place where the healthy ranges stand; the table in ``docs/metrics.md`` is `page()`. A rule reads a
`Course`: the rows of ``metrics.csv``, the configuration and one evaluation. The bounds separate the courses that walk
from those that do not among the 62 below ``experiments/results``, which hold 354 evaluations; `Rule.evidence` names
them. Where no course shows the fault, the bound lies beyond all that the courses reach, and the evidence says so.

A figure that a course lacks silences the rules that read it, and the report says which.
"""

import dataclasses
import json
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fmpjax import config as configuration
from fmpjax import tables
from fmpjax.config import Config
from fmpjax.errors import UserError
from fmpjax.logs import MetricsLog
from fmpjax.metrics import TURNS

RECENT = 10  # rows that a training figure is the mean of: a million transitions of `laptop`
MOVES = 0.1  # m/s, from which a demonstration moves
TRAVELS = 0.15  # of the demonstration's speed, from which a policy travels
STEPS = 0.5  # excursion from which the legs step
STEADIEST = 0.3  # rad/s, the least turning rate that errors in turning are measured against
DISTINCT = 0.1  # score spread from which the windows differ by more than the noise of one source bank
GOOD = 0.3  # quality from which there is something to lose
# Share of the budget by which the good runs of `laptop` stay up, per reset.
SETTLED = {"dataset": 0.5, "fixed": 0.7}

_POTENTIALS = ("fmp", "endpoint", "value")
_CENTERED = (*_POTENTIALS, "bank16")  # the reward is divided by the score's spread
_TRANSPORTS = (*_CENTERED, "barycentric")
_SECTIONS = ("prior", "amp", "gail", "wail", "pwil", "smp")  # settings of a reward; transports share "prior"


class Missing(KeyError):
    """A figure that a course lacks, or that is not defined in it."""


@dataclasses.dataclass(frozen=True)
class Course:
    """What a diagnosis reads. ``course["eval/NAME"]`` is of the evaluation, any other a mean over the recent rows."""

    rows: Sequence[Mapping[str, Any]]  # of metrics.csv, oldest first; values are numbers, texts of numbers or empty
    config: Config
    evaluation: Mapping[str, Any]  # as in evaluation.json; empty where there is none yet
    source: str = "the newest evaluation"  # where the evaluation is from

    def __getitem__(self, name: str) -> float:
        """The figure called ``name`` in the units of its column.

        Raises:
          Missing: the course has no such figure.
        """
        if name.startswith("eval/"):
            value = _number(name, self.evaluation.get(name.removeprefix("eval/")))
            return _defined(name, value)
        return self.mean(name, self.recent)

    @property
    def recent(self) -> Sequence[Mapping[str, Any]]:
        """The last rows. The first one of a run is left out where there are others: it is of an untrained policy."""
        return self.rows[1:][-RECENT:] or self.rows

    def mean(self, name: str, rows: Sequence[Mapping[str, Any]]) -> float:
        """Mean of a column over those of ``rows`` that have it."""
        values = [_number(name, row.get(name)) for row in rows]
        values = [value for value in values if not math.isnan(value)]
        return _defined(name, statistics.fmean(values) if values else math.nan)

    @property
    def progress(self) -> float:
        """Share of the budget behind the last row."""
        return _number("transitions", self.rows[-1].get("transitions")) / self.config.transitions


def _number(name: str, value: Any) -> float:
    """A cell as a number; NaN where it is empty."""
    if value is None or value == "":
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError):
        raise UserError(f"{name} of the run's figures is {value!r}: expected a number") from None


def _defined(name: str, value: float) -> float:
    if math.isnan(value):
        raise Missing(name)
    return value


@dataclasses.dataclass(frozen=True)
class Range:
    """Healthy values, both bounds included."""

    low: float = -math.inf
    high: float = math.inf

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        if self.high == math.inf:
            return f"at least {self.low:g}"
        if self.high == 0.0:  # of counts
            return "0"
        return f"at most {self.high:g}" if self.low == -math.inf else f"{self.low:g} to {self.high:g}"


@dataclasses.dataclass(frozen=True)
class Rule:
    """A symptom: a figure that leaves its healthy range."""

    name: str
    says: str  # how the sentence begins; figures of the course in braces
    figure: str  # what is measured
    measure: Callable[[Course], float | None]  # None where the rule does not apply
    healthy: Range
    look: tuple[str, ...]  # settings
    evidence: str  # what the committed courses show
    when: str = ""  # the rule applies, for the page
    methods: tuple[str, ...] = ()  # that have the figure; empty for all

    def sentence(self, course: Course) -> str | None:
        """What is wrong; None where the figure is healthy or the rule does not apply.

        Raises:
          Missing: the course lacks a figure.
        """
        if self.methods and course.config.method not in self.methods:
            return None
        value = self.measure(course)
        if value is None or value in self.healthy:
            return None
        settings = configuration.flatten(course.config)
        # A switch that is off already is no advice.
        mine = [key for key in self.look if _reads(course.config.method, key) and settings[key] is not False]
        look = [f"{key} (now {settings[key]})" for key in mine]
        where = " and ".join([", ".join(look[:-1]), look[-1]] if look[1:] else look)
        says = self.says.format_map(course)
        return f"{says}: {self.figure} is {value:.3g}, healthy is {self.healthy}; look at {where}."


_READ_BY = {
    "prior.query_is_bank": ("fmp", "endpoint", "value"),
    "prior.endpoint_weight": ("fmp", "endpoint"),
    "prior.flow_weight": ("fmp",),
    "prior.temperature": ("barycentric",),
}


def _reads(method: str, setting: str) -> bool:
    """Whether the reward reads the setting, or it is not one of a reward."""
    if setting in _READ_BY:
        return method in _READ_BY[setting]
    section = setting.partition(".")[0]
    return section not in _SECTIONS or section == (method if method in _SECTIONS else "prior")


def _fallen(course: Course) -> float:
    """Share of the evaluation's episodes that end in a fall."""
    return course["eval/falls"] / max(course["eval/episodes"], 1.0)


def _fall_step(course: Course) -> float:
    """Mean step at which those that fall do; the others last to the end."""
    falls, episodes = course["eval/falls"], course["eval/episodes"]
    lasted = (episodes - falls) * course.config.env.episode_steps
    return (course["eval/mean_length"] * episodes - lasted) / max(falls, 1.0)


def _falls(course: Course, *, late: bool) -> float | None:
    share = _fallen(course)
    return share if share and (_fall_step(course) > course.config.env.last_cap) == late else None


def _turning(course: Course) -> float:
    """Turning rate of the demonstration either way, rad/s; old courses have one demonstration and no such column."""
    try:
        return course["eval/demonstration_turning"]
    except Missing:
        return abs(course["eval/demonstration_turn"])


def _travel(course: Course) -> float | None:
    """Late speed over the demonstration's; None where most episodes fall, or the demonstration stands."""
    if _fallen(course) > 0.5 or course["eval/demonstration_speed"] < MOVES:
        return None
    try:
        turns = _turning(course) > TURNS
    except Missing:  # courses from before turning was measured are of straight walks
        turns = False
    return course["eval/path_speed" if turns else "eval/late_speed"] / course["eval/demonstration_speed"]


def _excursion(course: Course, *, travels: bool) -> float | None:
    travel = _travel(course)
    return course["eval/excursion"] if travel is not None and (abs(travel) >= TRAVELS) == travels else None


def _marching(course: Course) -> float | None:
    travel = _travel(course)
    return None if travel is None or course["eval/excursion"] < STEPS else abs(travel)


def _pace(course: Course) -> float | None:
    travel = _travel(course)
    return None if travel is None or abs(travel) < TRAVELS else travel


def _turn_error(course: Course) -> float | None:
    if _pace(course) is None:
        return None
    own = course["eval/demonstration_turn"]
    # Left and right turns of several motions cancel in the means.
    if _turning(course) > abs(own) + TURNS:
        return None
    return abs(course["eval/turn"] - own) / max(abs(own), STEADIEST)


def _limp(course: Course) -> float | None:
    """Imbalance less the demonstration's own, which only evaluation.json tells."""
    if _fallen(course) > 0.5 or course["eval/excursion"] < STEPS:
        return None
    ranges = course.evaluation.get("expert_ranges")
    if not isinstance(ranges, list) or not all(isinstance(value, int | float) for value in ranges):
        ranges = []
    pairs = list(zip(ranges[: len(ranges) // 2], ranges[len(ranges) // 2 :], strict=False))
    own = sum(2.0 * abs(a - b) / max(a + b, 1e-9) for a, b in pairs) / max(len(pairs), 1)
    return course["eval/imbalance"] - own


def _stamping(course: Course) -> float | None:
    return None if _fallen(course) > 0.5 else course["eval/excursion"]


def _kept(course: Course) -> float | None:
    """Quality of the course's newest evaluation over its best."""
    found = [_number("eval/quality", row.get("eval/quality")) for row in course.rows]
    found = [value for value in found if not math.isnan(value)]
    if not found:
        raise Missing("eval/quality")
    return found[-1] / max(found) if max(found) >= GOOD else None


def _correlation(course: Course) -> float | None:
    """Correlation over the newest rows in which windows differ; None where none does."""
    course["fit/score_spread"], course["fit/value_correlation"]
    spread = [_number("fit/score_spread", row.get("fit/score_spread")) for row in course.rows]
    rows = [row for row, value in zip(course.rows, spread, strict=True) if value >= DISTINCT]
    return course.mean("fit/value_correlation", rows[-RECENT:]) if rows else None


def _nonfinite(course: Course) -> float:
    """The count since the start, so of the last row."""
    return course.mean("train/nonfinite", course.rows[-1:])


def _kl(course: Course) -> float | None:
    target = course.config.ppo.target_kl
    return course["ppo/kl"] / target if target else None


RULES = (
    Rule(
        "falls early",
        "It falls within the steps that training episodes have, in {eval/falls:.0f} of {eval/episodes:.0f} episodes",
        "share of evaluation episodes that fall",
        lambda course: _falls(course, late=False),
        Range(high=0.1),
        ("env.reset_noise", "ppo.gae_lambda", "transitions"),
        "walks end at 0.06 or less; `lafan1_standing` 0.29, `table1/value-fixed-seed0` 1",
        "they fall by step `env.last_cap` on average",
    ),
    Rule(
        "falls late",
        "It falls later than training episodes last, in {eval/falls:.0f} of {eval/episodes:.0f} episodes",
        "share of evaluation episodes that fall",
        lambda course: _falls(course, late=True),
        Range(high=0.1),
        ("env.last_cap", "evaluations"),
        "walks end at 0.06 or less; `learning_apart/late-128-seed0` 0.37, `mirrored-seed0` 0.48",
        "they fall after step `env.last_cap` on average",
    ),
    Rule(
        "falls in training",
        "It falls in training, where episodes last {train/episode_length:.0f} of {env/cap:.0f} steps",
        "share of training episodes that fall",
        lambda course: course["train/falls"],
        Range(high=0.2),
        ("ppo.gae_lambda", "env.first_cap", "transitions"),
        "walks end at 0.18 or less; `learning_apart/rollout-128-seed0` 0.34, "
        "`table1/fixed_pose/value-fixed-seed1` 0.52, `lafan1_standing` 0.75",
    ),
    Rule(
        "stands",
        "It stands, at {eval/late_speed:.2f} m/s where the demonstration goes at {eval/demonstration_speed:.2f}",
        "excursion",
        lambda course: _excursion(course, travels=False),
        Range(low=STEPS),
        ("prior.query_is_bank", "ppo.discount", "method"),
        "`lafan1_standing` 0.18, `table1/barycentric-*` 0.01, `table1_bank_queries/fmp-fixed-seed0` 0.36; none that "
        "stands is above 0.43, and none that travels below 0.69",
        f"the late speed is under {TRAVELS:g} of the demonstration's",
    ),
    Rule(
        "marches",
        "Its legs step at an excursion of {eval/excursion:.2f} and it does not travel: it marches on the spot, or "
        "stops on the way",
        "late speed, either way, over the demonstration's",
        _marching,
        Range(low=TRAVELS),
        ("env.last_cap", "ppo.discount", "evaluations"),
        "`learning_apart/late-128-seed0` 0.08, `mirrored-seed0` 0.05; the slowest that walks is at 0.26",
        f"the excursion is at least {STEPS:g}",
    ),
    Rule(
        "shuffles",
        "It travels on steps that are too small",
        "excursion",
        lambda course: _excursion(course, travels=True),
        Range(low=STEPS),
        ("features.deviation_floor", "features.angular_velocity_floor"),
        "all that walk are at 0.69 or more; no course shuffles",
        f"the late speed is at least {TRAVELS:g} of the demonstration's",
    ),
    Rule(
        "stamps",
        "Its legs move much further than the demonstration's",
        "excursion",
        _stamping,
        Range(high=1.5),
        ("env.action", "ppo.bound_penalty"),
        "the highest is 1.40, `lafan1_walk_seed1` on the way; no course stamps",
    ),
    Rule(
        "too slow",
        "It is slower than the demonstration",
        "late speed over the demonstration's",
        _pace,
        Range(low=0.6),
        ("features.angular_velocity_floor", "frames", "evaluations"),
        "walks end between 0.64 and 1.33; `learning_apart/lambda-090-seed2` ends at 0.50, `lafan1_walk_seed1` at "
        "0.33, its best policy at 1.00",
        f"it is at least {TRAVELS:g}, forward or backward",
    ),
    Rule(
        "too fast",
        "It is faster than the demonstration",
        "late speed over the demonstration's",
        _pace,
        Range(high=1.4),
        ("frames", "evaluations"),
        "walks end between 0.64 and 1.33; `table1_bank_queries/bank16-fixed-seed0` ends at 1.53, `lafan1_fixed_seed1` "
        "at 1.45, its best policy at 1.30",
        f"it is at least {TRAVELS:g}, forward or backward",
    ),
    Rule(
        "turns wrong",
        "It turns at {eval/turn:+.2f} rad/s where the demonstration turns at {eval/demonstration_turn:+.2f}",
        f"error of the turning rate over the demonstration's, or over {STEADIEST:g} rad/s if that turns less",
        _turn_error,
        Range(high=0.5),
        ("features.axes", "motion"),
        "`turn_left` ends at 0.08, straight walks at 0.29 or less; `turn_left` at 4.3 M, where it falls, is at 0.97",
        "it travels",
    ),
    Rule(
        "limps",
        "It limps",
        "left-right imbalance beyond the demonstration's own",
        _limp,
        Range(high=0.4),
        ("motion", "transitions"),
        "the highest is 0.33, `table1/value-dataset-seed0` on the way; no course that stays up limps",
        f"the excursion is at least {STEPS:g}",
    ),
    Rule(
        "got worse",
        "The newest policy is much worse than the best one, which `best/` keeps",
        "`eval/quality` of the newest evaluation over the best",
        _kept,
        Range(low=0.25),
        ("ppo.target_kl", "evaluations"),
        "`learning_apart/late-128-seed0` 0.06, `mirrored-seed0` 0.03; `lafan1_walk_seed1`, which only slows down, 0.33",
    ),
    Rule(
        "reward flat",
        "The reward is flat: scores tie, or differ by less than the floor",
        "`train/reward_spread`",
        lambda course: course["train/reward_spread"],
        Range(low=0.45),
        ("prior.spread_floor",),
        "0.486 to 0.490 in every course, standing ones too; no row under 0.472",
        methods=_CENTERED,
    ),
    Rule(
        "reward flat, not centered",
        "The reward is flat: whatever the policy does earns about the same",
        "`train/reward_spread`",
        lambda course: course["train/reward_spread"],
        Range(low=0.08),
        ("prior.temperature", "amp.gradient_penalty", "wail.gradient_penalty", "method"),
        "`table1/barycentric-fixed-seed0`, which stands, 0.04; AMP walks at 0.20; no course is of WAIL",
        methods=("amp", "barycentric", "wail"),
    ),
    Rule(
        "reward flat, in its logarithm",
        "The reward is flat: whatever the policy does earns about the same share of the most that it can",
        "`fit/score_spread`",
        lambda course: course["fit/score_spread"],
        Range(low=0.1),
        ("pwil.decay", "smp.decay", "smp.iterations", "method"),
        "half of the rewards are within a tenth of each other; no course is of these methods",
        methods=("pwil", "smp"),
    ),
    Rule(
        "scores tie",
        "The policy's windows score alike, so that the reward magnifies noise",
        "`fit/score_spread` over `prior.spread_floor`",
        lambda course: course["fit/score_spread"] / course.config.prior.spread_floor,
        Range(low=3.0),
        ("prior.spread_floor", "ppo.deviation"),
        "`table1_bank_queries/value-fixed-seed0`, which stands, 2.1; the bundled walks 12, no row of theirs under 5",
        methods=_CENTERED,
    ),
    Rule(
        "margin negative",
        "The reward does not rank the demonstration above the policy",
        "`fit/expert_margin`",
        lambda course: course["fit/expert_margin"],
        Range(low=0.1),
        (
            *("prior.endpoint_weight", "prior.flow_weight", "amp.gradient_penalty", "gail.gradient_penalty"),
            *("wail.updates", "smp.iterations", "method"),
        ),
        "`table1/value-fixed-seed0` −40, `table1/fixed_pose/value-fixed-seed1` −26; the bundled walks, the least of "
        "those that walk, 0.34 to 0.54",
        methods=(*_CENTERED, "amp", "gail", "wail", "smp"),
    ),
    Rule(
        "discriminator saturated",
        "The discriminator is sure of every window (it tells {fit/agent_accuracy:.2f} of the policy's), and its reward "
        "is near 0",
        "`fit/discriminator_loss`",
        lambda course: course["fit/discriminator_loss"],
        Range(low=0.05),
        (
            *("amp.gradient_penalty", "amp.learning_rate", "amp.updates"),
            *("gail.gradient_penalty", "gail.learning_rate", "gail.updates"),
        ),
        "AMP is at 0.24 to 0.41 at the ends, no row under 0.11; an accuracy of 1 alone is no fault: "
        "`table1/amp-fixed-seed0` walks with it; no course is of GAIL",
        methods=("amp", "gail"),
    ),
    Rule(
        "fit unconverged",
        "The transport does not converge",
        "`fit/unconverged`, solves per rollout",
        lambda course: course["fit/unconverged"],
        Range(high=0.1),
        ("prior.sinkhorn_iterations", "prior.epsilon_fraction"),
        "0 in every row of every course",
        methods=_TRANSPORTS,
    ),
    Rule(
        "iterations at their maximum",
        "The transport's solves take nearly all the iterations that they may",
        "`fit/sinkhorn_iterations` over `prior.sinkhorn_iterations`",
        lambda course: course["fit/sinkhorn_iterations"] / max(course.config.prior.sinkhorn_iterations, 1),
        Range(high=0.9),
        ("prior.sinkhorn_iterations", "prior.epsilon_fraction"),
        "0.29 at most, the bundled walks",
        methods=_TRANSPORTS,
    ),
    Rule(
        "fit does not follow",
        "The learned score does not follow the transport's",
        "`fit/value_correlation`",
        _correlation,
        Range(low=0.5),
        ("prior.learning_rate", "prior.updates", "prior.clip_norm"),
        "no such row under 0.57; with smaller spreads good walks go down to −0.08, which is no fault",
        f"`fit/score_spread` is at least {DISTINCT:g}, in the newest such rows",
        methods=_POTENTIALS,
    ),
    Rule(
        "states not finite",
        "There were numbers that are not finite",
        "`train/nonfinite`, since the start",
        _nonfinite,
        Range(high=0.0),
        ("physics.timestep", "nonfinite_limit"),
        "0 in every row of every course",
    ),
    Rule(
        "reward updates skipped",
        "Updates of the reward are left out",
        "`fit/skipped`, per rollout",
        lambda course: course["fit/skipped"],
        Range(high=0.0),
        tuple(f"{section}.learning_rate" for section in ("prior", "amp", "gail", "wail", "smp")),
        "0 in every row of every course",
        methods=(*_POTENTIALS, "amp", "gail", "wail", "smp"),
    ),
    Rule(
        "policy updates skipped",
        "Updates of the policy or its critic are left out",
        "`ppo/skipped`, per rollout",
        lambda course: course["ppo/skipped"],
        Range(high=0.0),
        ("ppo.learning_rate", "ppo.clip_norm"),
        "0 in every row of every course",
    ),
    Rule(
        "KL off its target",
        "The policy's updates are not of the size that is asked for",
        "`ppo/kl` over `ppo.target_kl`",
        _kl,
        Range(0.5, 2.0),
        ("ppo.target_kl", "ppo.learning_rate"),
        "0.73 to 1.40 at the ends, no row above 1.9 after 0.15 M transitions; no course without a target",
    ),
    Rule(
        "clipped share high",
        "Most samples leave PPO's bound",
        "`ppo/clipped`",
        lambda course: course["ppo/clipped"],
        Range(high=0.6),
        ("ppo.learning_rate", "ppo.actor_epochs", "ppo.clip"),
        "0.20 to 0.48 at the ends, no row above 0.57",
    ),
    Rule(
        "critic worse than a constant",
        "The critic predicts returns worse than their mean would",
        "`ppo/explained_variance`",
        lambda course: course["ppo/explained_variance"],
        Range(low=0.0),
        ("ppo.critic_epochs", "ppo.learning_rate"),
        "0.71 or more at the ends; under 0 in the first row of the fixed pose alone",
    ),
)


def symptoms(course: Course) -> dict[str, str]:
    """The sentence of each rule whose figure is out of its range, by the rule's name."""
    return _apply(course)[0]


def _apply(course: Course) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Sentences by rule, and the rules that could not be checked by the figure that they lack."""
    found, lacking = {}, {}
    for rule in RULES:
        try:
            sentence = rule.sentence(course)
        except Missing as missing:
            lacking.setdefault(missing.args[0], []).append(rule.name)
            continue
        if sentence is not None:
            found[rule.name] = sentence
    return found, lacking


def report(course: Course) -> list[str]:
    """The diagnosis: a sentence per symptom, or one that there is none; then what could not be checked."""
    found, lacking = _apply(course)
    lines = list(found.values()) or ["No symptom: every figure that was checked is in its healthy range."]
    settled = SETTLED[course.config.env.reset]
    if found and course.progress < settled:
        lines.append(
            f"This is at {100 * course.progress:.0f} % of the budget: good runs of `laptop` from this reset fall and "
            f"stand, too, up to {100 * settled:.0f} %."
        )
    if lacking:
        which = "; ".join(f"{', '.join(names)} (no {figure})" for figure, names in lacking.items())
        lines.append(f"Not checked: {which}.")
    return lines


def text(course: Course) -> str:
    """The diagnosis as lines for people."""
    transitions = _number("transitions", course.rows[-1].get("transitions"))
    rows = f"{len(course.recent)} rows" if course.recent[1:] else "row"
    head = f"diagnosis at {transitions:,.0f} transitions, by {course.source} and the last {rows} of metrics.csv:"
    return "\n".join([head, *(f"  - {line}" for line in report(course))])


def read(folder: Path, *, last: bool = False) -> Course:
    """The course in a run folder or in a folder of exported results.

    Args:
      folder: holds ``config.json`` and ``metrics.csv``; ``evaluation.json``, the best policy's, where there is one.
      last: take the newest evaluation of ``metrics.csv`` in place of ``evaluation.json``.

    Raises:
      UserError: a file is missing or broken.
    """
    if not (folder / "config.json").is_file():
        raise UserError(f"{folder} is not a run folder: expected config.json in it")
    config = configuration.read(folder / "config.json")
    rows = MetricsLog.read(folder / "metrics.csv")
    if not rows:
        raise UserError(f"{folder / 'metrics.csv'} has no rows: expected the metrics of a run that has begun to train")
    path = folder / "evaluation.json"
    if last or not path.exists():
        return Course(rows, config, newest(rows))
    try:
        evaluation = json.loads(path.read_text())
    except ValueError:
        evaluation = None
    if not isinstance(evaluation, dict):
        raise UserError(f"{path} is not valid JSON: expected the figures of an evaluation")
    return Course(rows, config, evaluation, f"{path.name} (the best policy)")


def newest(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of the newest evaluation in the rows, by name; none where there is none."""
    for row in reversed(rows):
        if row.get("eval/quality") not in (None, ""):
            return {name.removeprefix("eval/"): value for name, value in row.items() if name.startswith("eval/")}
    return {}


def page() -> str:
    """The rules as the table in ``docs/metrics.md``."""
    lines = ["| symptom | figure | healthy | look at | what the courses show |", "|---|---|---|---|---|"]
    for rule in RULES:
        figure = rule.figure + (f", where {rule.when}" if rule.when else "")
        figure += f" (`{'`, `'.join(rule.methods)}`)" if rule.methods else ""
        look = ", ".join(f"`{key}`" for key in rule.look)
        lines.append(tables.row((rule.name, figure, str(rule.healthy), look, rule.evidence)))
    return "\n".join(lines)
