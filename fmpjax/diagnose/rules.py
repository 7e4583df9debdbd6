"""The symptoms and their healthy ranges: the one place where these stand."""

import dataclasses
import math
from collections.abc import Callable

from fmpjax import config as configuration
from fmpjax.diagnose import measures
from fmpjax.diagnose.history import History
from fmpjax.diagnose.measures import DISTINCT, STEADIEST, STEPS, TRAVELS

_POTENTIALS = ("fmp", "endpoint", "value")
_CENTERED = (*_POTENTIALS, "bank16")  # the reward is divided by the score's spread
_TRANSPORTS = (*_CENTERED, "barycentric")
_COMMANDS = ("velocity", "phase", "motion")  # whose reward is combined with the prior's before it is measured
_SECTIONS = (
    "prior",
    "amp",
    "gail",
    "wail",
    "pwil",
    "smp",
    "add",
    "tracking",
)  # settings of a reward; transports share "prior"


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


class _Figures(dict):
    """The figures that a sentence may name: those of the history, and ``speed``."""

    def __init__(self, history: History):
        self._history = history

    def __missing__(self, name: str) -> float:
        return measures.speed(self._history) if name == "speed" else self._history[name]


@dataclasses.dataclass(frozen=True)
class Rule:
    """A symptom: a figure that leaves its healthy range."""

    name: str
    says: str  # how the sentence begins; figures of the history, or `speed`, in braces
    figure: str  # what is measured
    measure: Callable[[History], float | None]  # None where the rule does not apply
    healthy: Range
    look: tuple[str, ...]  # settings
    evidence: str  # what the committed runs show
    when: str = ""  # the rule applies, for the page
    methods: tuple[str, ...] = ()  # that have the figure; empty for all
    not_with: tuple[str, ...] = ()  # commands under which the figure means something else

    def sentence(self, history: History) -> str | None:
        """What is wrong; None where the figure is healthy or the rule does not apply.

        Raises:
          Missing: the history does not have a figure.
        """
        if self.methods and history.config.method not in self.methods or history.config.command.kind in self.not_with:
            return None
        value = self.measure(history)
        if value is None or value in self.healthy:
            return None
        settings = configuration.flatten(history.config)
        # A switch that is off already is no advice.
        mine = [key for key in self.look if reads(history.config.method, key) and settings[key] is not False]
        look = [f"{key} (now {settings[key]})" for key in mine]
        where = " and ".join([", ".join(look[:-1]), look[-1]] if look[1:] else look)
        says = self.says.format_map(_Figures(history))
        return f"{says}: {self.figure} is {value:.3g}, healthy is {self.healthy}; look at {where}."


_READ_BY = {
    "prior.query_is_bank": ("fmp", "endpoint", "value"),
    "prior.endpoint_weight": ("fmp", "endpoint"),
    "prior.flow_weight": ("fmp",),
    "prior.temperature": ("barycentric",),
}


def reads(method: str, setting: str) -> bool:
    """Whether the reward reads the setting, or it is not one of a reward."""
    if setting in _READ_BY:
        return method in _READ_BY[setting]
    section = setting.partition(".")[0]
    return section not in _SECTIONS or section == (method if method in _SECTIONS else "prior")


RULES = (
    Rule(
        "falls early",
        "It falls within the steps that training episodes have, in {eval/falls:.0f} of {eval/episodes:.0f} episodes",
        "share of evaluation episodes that fall",
        lambda history: measures.falls(history, late=False),
        Range(high=0.1),
        ("env.reset_noise", "ppo.gae_lambda", "transitions"),
        "walks end at 0.06 or less; `lafan1_standing` 0.29, `table1/value-fixed-seed0` 1",
        "they fall by step `env.last_cap` on average",
    ),
    Rule(
        "falls late",
        "It falls later than training episodes last, in {eval/falls:.0f} of {eval/episodes:.0f} episodes",
        "share of evaluation episodes that fall",
        lambda history: measures.falls(history, late=True),
        Range(high=0.1),
        ("env.last_cap", "evaluations"),
        "walks end at 0.06 or less; `learning_apart/late-128-seed0` 0.37, `mirrored-seed0` 0.48",
        "they fall after step `env.last_cap` on average",
    ),
    Rule(
        "falls in training",
        "It falls in training, where episodes last {train/episode_length:.0f} of {env/cap:.0f} steps",
        "share of training episodes that fall",
        lambda history: history["train/falls"],
        Range(high=0.2),
        ("ppo.gae_lambda", "env.first_cap", "transitions"),
        "walks end at 0.18 or less; `learning_apart/rollout-128-seed0` 0.34, "
        "`table1/fixed_pose/value-fixed-seed1` 0.52, `lafan1_standing` 0.75",
    ),
    Rule(
        "stands",
        "It stands, at {speed:.2f} m/s where the demonstration goes at {eval/demonstration_speed:.2f}",
        "excursion",
        lambda history: measures.excursion(history, travels=False),
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
        measures.marching,
        Range(low=TRAVELS),
        ("env.last_cap", "ppo.discount", "evaluations"),
        "`learning_apart/late-128-seed0` 0.08, `mirrored-seed0` 0.05; the slowest that walks is at 0.26",
        f"the excursion is at least {STEPS:g}",
        not_with=("phase",),
    ),
    Rule(
        "shuffles",
        "It travels on steps that are too small",
        "excursion",
        lambda history: measures.excursion(history, travels=True),
        Range(low=STEPS),
        ("features.deviation_floor", "features.angular_velocity_floor"),
        "all that walk are at 0.69 or more; no run shuffles",
        f"the late speed is at least {TRAVELS:g} of the demonstration's",
    ),
    Rule(
        "stamps",
        "Its legs move much further than the demonstration's",
        "excursion",
        measures.stamping,
        Range(high=1.5),
        ("env.action", "ppo.bound_penalty"),
        "the highest is 1.40, `lafan1_walk_seed1` on the way; no run stamps",
    ),
    Rule(
        "too slow",
        "It is slower than the demonstration",
        "late speed over the demonstration's",
        measures.pace,
        Range(low=0.6),
        ("features.angular_velocity_floor", "frames", "evaluations"),
        "walks end between 0.64 and 1.33; `learning_apart/lambda-090-seed2` ends at 0.50, `lafan1_walk_seed1` at "
        "0.33, its best policy at 1.00",
        f"it is at least {TRAVELS:g}, forward or backward",
        not_with=("phase",),
    ),
    Rule(
        "too fast",
        "It is faster than the demonstration",
        "late speed over the demonstration's",
        measures.pace,
        Range(high=1.4),
        ("frames", "evaluations"),
        "walks end between 0.64 and 1.33; `table1_bank_queries/bank16-fixed-seed0` ends at 1.53, `lafan1_fixed_seed1` "
        "at 1.45, its best policy at 1.30",
        f"it is at least {TRAVELS:g}, forward or backward",
        not_with=("phase",),
    ),
    Rule(
        "turns wrong",
        "It turns at {eval/turn:+.2f} rad/s where the demonstration turns at {eval/demonstration_turn:+.2f}",
        f"error of the turning rate over the demonstration's, or over {STEADIEST:g} rad/s if that turns less",
        measures.turn_error,
        Range(high=0.5),
        ("features.axes", "motion"),
        "`turn_left` ends at 0.08, straight walks at 0.29 or less; `turn_left` at 4.3 M, where it falls, is at 0.97",
        "it travels",
        not_with=("phase",),
    ),
    Rule(
        "limps",
        "It limps",
        "left-right imbalance beyond the demonstration's own",
        measures.limp,
        Range(high=0.4),
        ("motion", "transitions"),
        "the highest is 0.33, `table1/value-dataset-seed0` on the way; no run that stays up limps",
        f"the excursion is at least {STEPS:g}",
    ),
    Rule(
        "got worse",
        "The newest policy is much worse than the best one, which `best/` keeps",
        "`eval/quality` of the newest evaluation over the best; with a command `eval/score`",
        measures.kept,
        Range(low=0.25),
        ("ppo.target_kl", "evaluations"),
        "`learning_apart/late-128-seed0` 0.06, `mirrored-seed0` 0.03; `lafan1_walk_seed1`, which only slows down, 0.33",
    ),
    Rule(
        "reward flat",
        "The reward is flat: scores tie, or differ by less than the floor",
        "`train/reward_spread`",
        lambda history: history["train/reward_spread"],
        Range(low=0.45),
        ("prior.spread_floor",),
        "0.486 to 0.490 in every run without a command, standing ones too; no row under 0.472",
        methods=_CENTERED,
        not_with=_COMMANDS,
    ),
    Rule(
        "reward flat, not centered",
        "The reward is flat: whatever the policy does earns about the same",
        "`train/reward_spread`",
        lambda history: history["train/reward_spread"],
        Range(low=0.08),
        ("prior.temperature", "amp.gradient_penalty", "wail.gradient_penalty", "method"),
        "`table1/barycentric-fixed-seed0`, which stands, 0.04; AMP walks at 0.20; no run is of WAIL",
        methods=("amp", "barycentric", "wail"),
        not_with=_COMMANDS,
    ),
    Rule(
        "reward flat, in its logarithm",
        "The reward is flat: whatever the policy does earns about the same share of the most that it can",
        "`fit/score_spread`",
        lambda history: history["fit/score_spread"],
        Range(low=0.1),
        ("pwil.decay", "smp.decay", "smp.iterations", "method"),
        "half of the rewards are within a tenth of each other; no run is of these methods",
        methods=("pwil", "smp"),
    ),
    Rule(
        "scores tie",
        "The policy's windows score alike, so that the reward magnifies noise",
        "`fit/score_spread` over `prior.spread_floor`",
        lambda history: history["fit/score_spread"] / history.config.prior.spread_floor,
        Range(low=3.0),
        ("prior.spread_floor", "ppo.deviation"),
        "`table1_bank_queries/value-fixed-seed0`, which stands, 2.1; the bundled walks 12, no row of theirs under 5",
        methods=_CENTERED,
    ),
    Rule(
        "margin negative",
        "The reward does not rank the demonstration above the policy",
        "`fit/expert_margin`",
        lambda history: history["fit/expert_margin"],
        Range(low=0.1),
        (
            *("prior.endpoint_weight", "prior.flow_weight", "amp.gradient_penalty", "gail.gradient_penalty"),
            *("wail.updates", "smp.iterations", "add.gradient_penalty", "method"),
        ),
        "`table1/value-fixed-seed0` −40, `table1/fixed_pose/value-fixed-seed1` −26; the bundled walks, the least of "
        "those that walk, 0.34 to 0.54",
        methods=(*_CENTERED, "amp", "gail", "wail", "smp", "add"),
    ),
    Rule(
        "discriminator saturated",
        "The discriminator is sure of every window (it tells {fit/agent_accuracy:.2f} of the policy's), and its reward "
        "is near 0",
        "`fit/discriminator_loss`",
        lambda history: history["fit/discriminator_loss"],
        Range(low=0.05),
        (
            *("amp.gradient_penalty", "amp.learning_rate", "amp.updates"),
            *("gail.gradient_penalty", "gail.learning_rate", "gail.updates"),
            *("add.gradient_penalty", "add.learning_rate", "add.updates"),
        ),
        "AMP is at 0.24 to 0.41 at the ends, no row under 0.11; an accuracy of 1 alone is no fault: "
        "`table1/amp-fixed-seed0` walks with it; no run is of GAIL or ADD",
        methods=("amp", "gail", "add"),
    ),
    Rule(
        "fit unconverged",
        "The transport does not converge",
        "`fit/unconverged`, solves per rollout",
        lambda history: history["fit/unconverged"],
        Range(high=0.1),
        ("prior.sinkhorn_iterations", "prior.epsilon_fraction"),
        "0 in every row of every run",
        methods=_TRANSPORTS,
    ),
    Rule(
        "iterations at their maximum",
        "The transport's solves take nearly all the iterations that they may",
        "`fit/sinkhorn_iterations` over `prior.sinkhorn_iterations`",
        lambda history: history["fit/sinkhorn_iterations"] / max(history.config.prior.sinkhorn_iterations, 1),
        Range(high=0.9),
        ("prior.sinkhorn_iterations", "prior.epsilon_fraction"),
        "0.29 at most, the bundled walks",
        methods=_TRANSPORTS,
    ),
    Rule(
        "fit does not follow",
        "The learned score does not follow the transport's",
        "`fit/value_correlation`",
        measures.correlation,
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
        measures.nonfinite,
        Range(high=0.0),
        ("physics.timestep", "nonfinite_limit"),
        "0 in every row of every run",
    ),
    Rule(
        "reward updates skipped",
        "Updates of the reward are left out",
        "`fit/skipped`, per rollout",
        lambda history: history["fit/skipped"],
        Range(high=0.0),
        tuple(f"{section}.learning_rate" for section in ("prior", "amp", "gail", "wail", "smp", "add")),
        "0 in every row of every run",
        methods=(*_POTENTIALS, "amp", "gail", "wail", "smp", "add"),
    ),
    Rule(
        "policy updates skipped",
        "Updates of the policy or its critic are left out",
        "`ppo/skipped`, per rollout",
        lambda history: history["ppo/skipped"],
        Range(high=0.0),
        ("ppo.learning_rate", "ppo.clip_norm"),
        "0 in every row of every run",
    ),
    Rule(
        "KL off its target",
        "The policy's updates are not of the size that is asked for",
        "`ppo/kl` over `ppo.target_kl`, or over `ppo.settle_target_kl` where the policy settles",
        measures.kl,
        Range(0.5, 2.0),
        ("ppo.target_kl", "ppo.learning_rate"),
        "0.73 to 1.40 at the ends, no row above 1.9 after 0.15 M transitions; no run without a target",
    ),
    Rule(
        "clipped share high",
        "Most samples leave PPO's bound",
        "`ppo/clipped`",
        lambda history: history["ppo/clipped"],
        Range(high=0.6),
        ("ppo.learning_rate", "ppo.actor_epochs", "ppo.clip"),
        "0.20 to 0.48 at the ends, no row above 0.57",
    ),
    Rule(
        "critic worse than a constant",
        "The critic predicts returns worse than their mean would",
        "`ppo/explained_variance`",
        lambda history: history["ppo/explained_variance"],
        Range(low=0.0),
        ("ppo.critic_epochs", "ppo.learning_rate"),
        "0.71 or more at the ends; under 0 in the first row of the fixed pose alone",
    ),
)
