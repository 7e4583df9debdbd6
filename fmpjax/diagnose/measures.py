"""Figures that several columns make together. Each is of a `Course`, and None where it says nothing of it."""

import math

from fmpjax.diagnose.course import RECENT, Course, Missing, number
from fmpjax.metrics import TURNS

MOVES = 0.1  # m/s, from which a demonstration moves
TRAVELS = 0.15  # of the demonstration's speed, from which a policy travels
STEPS = 0.5  # excursion from which the legs step
STEADIEST = 0.3  # rad/s, the least turning rate that errors in turning are measured against
DISTINCT = 0.1  # score spread from which the windows differ by more than the noise of one source bank
GOOD = 0.3  # quality from which there is something to lose


def fallen(course: Course) -> float:
    """Share of the evaluation's episodes that end in a fall."""
    return course["eval/falls"] / max(course["eval/episodes"], 1.0)


def fall_step(course: Course) -> float:
    """Mean step at which those that fall do; the others last to the end."""
    falls, episodes = course["eval/falls"], course["eval/episodes"]
    lasted = (episodes - falls) * course.config.env.episode_steps
    return (course["eval/mean_length"] * episodes - lasted) / max(falls, 1.0)


def falls(course: Course, *, late: bool) -> float | None:
    """Share of the episodes that fall, where they do so within the steps of training or, if ``late``, after them."""
    share = fallen(course)
    return share if share and (fall_step(course) > course.config.env.last_cap) == late else None


def turning(course: Course) -> float:
    """Turning rate of the demonstration either way, rad/s; old courses have one demonstration and no such column."""
    try:
        return course["eval/demonstration_turning"]
    except Missing:
        return abs(course["eval/demonstration_turn"])


def speed(course: Course) -> float:
    """Late speed, m/s; that along the robot's own heading where the demonstration turns."""
    try:
        turns = turning(course) > TURNS
    except Missing:  # courses from before turning was measured are of straight walks
        turns = False
    return course["eval/path_speed" if turns else "eval/late_speed"]


def travel(course: Course) -> float | None:
    """Late speed over the demonstration's; None where most episodes fall, or the demonstration stands."""
    if fallen(course) > 0.5 or course["eval/demonstration_speed"] < MOVES:
        return None
    return speed(course) / course["eval/demonstration_speed"]


def excursion(course: Course, *, travels: bool) -> float | None:
    """Excursion of the legs of a policy that travels, or of one that does not."""
    share = travel(course)
    return course["eval/excursion"] if share is not None and (abs(share) >= TRAVELS) == travels else None


def marching(course: Course) -> float | None:
    """Late speed over the demonstration's, either way, where the legs step."""
    share = travel(course)
    return None if share is None or course["eval/excursion"] < STEPS else abs(share)


def pace(course: Course) -> float | None:
    """Late speed over the demonstration's, where the policy travels."""
    share = travel(course)
    return None if share is None or abs(share) < TRAVELS else share


def turn_error(course: Course) -> float | None:
    """Error of the turning rate over the demonstration's, or over `STEADIEST`."""
    if pace(course) is None:
        return None
    own = course["eval/demonstration_turn"]
    # Left and right turns of several motions cancel in the means.
    if turning(course) > abs(own) + TURNS:
        return None
    return abs(course["eval/turn"] - own) / max(abs(own), STEADIEST)


def limp(course: Course) -> float | None:
    """Imbalance less the demonstration's own, which only evaluation.json tells."""
    if fallen(course) > 0.5 or course["eval/excursion"] < STEPS:
        return None
    ranges = course.evaluation.get("expert_ranges")
    if not isinstance(ranges, list) or not all(isinstance(value, int | float) for value in ranges):
        ranges = []
    pairs = list(zip(ranges[: len(ranges) // 2], ranges[len(ranges) // 2 :], strict=False))
    own = sum(2.0 * abs(a - b) / max(a + b, 1e-9) for a, b in pairs) / max(len(pairs), 1)
    return course["eval/imbalance"] - own


def stamping(course: Course) -> float | None:
    """Excursion of the legs, where most episodes stay up."""
    return None if fallen(course) > 0.5 else course["eval/excursion"]


def kept(course: Course) -> float | None:
    """Quality of the course's newest evaluation over its best."""
    found = [number("eval/quality", row.get("eval/quality")) for row in course.rows]
    found = [value for value in found if not math.isnan(value)]
    if not found:
        raise Missing("eval/quality")
    return found[-1] / max(found) if max(found) >= GOOD else None


def correlation(course: Course) -> float | None:
    """Correlation over the newest rows in which windows differ; None where none does."""
    course["fit/score_spread"], course["fit/value_correlation"]
    spread = [number("fit/score_spread", row.get("fit/score_spread")) for row in course.rows]
    rows = [row for row, value in zip(course.rows, spread, strict=True) if value >= DISTINCT]
    return course.mean("fit/value_correlation", rows[-RECENT:]) if rows else None


def nonfinite(course: Course) -> float:
    """The count since the start, so of the last row."""
    return course.mean("train/nonfinite", course.rows[-1:])


def kl(course: Course) -> float | None:
    """KL divergence of the updates over its target."""
    target = course.config.ppo.target_kl
    return course["ppo/kl"] / target if target else None
