"""Figures that several columns make together. Each is of a `History`, and None where it says nothing of it."""

import math

from fmpjax.diagnose.history import RECENT, History, Missing, number
from fmpjax.metrics import TURNS, choosing

MOVES = 0.1  # m/s, from which a demonstration moves
TRAVELS = 0.15  # of the demonstration's speed, from which a policy travels
STEPS = 0.5  # excursion from which the legs step
STEADIEST = 0.3  # rad/s, the least turning rate that errors in turning are measured against
DISTINCT = 0.1  # score spread from which the windows differ by more than the noise of one source bank
GOOD = 0.3  # quality or score from which there is something to lose


def fallen(history: History) -> float:
    """Share of the evaluation's episodes that end in a fall."""
    return history["eval/falls"] / max(history["eval/episodes"], 1.0)


def fall_step(history: History) -> float:
    """Mean step at which those that fall do; the others last to the end."""
    falls, episodes = history["eval/falls"], history["eval/episodes"]
    lasted = (episodes - falls) * history.config.env.episode_steps
    return (history["eval/mean_length"] * episodes - lasted) / max(falls, 1.0)


def falls(history: History, *, late: bool) -> float | None:
    """Share of the episodes that fall, where they do so within the steps of training or, if ``late``, after them."""
    share = fallen(history)
    return share if share and (fall_step(history) > history.config.env.last_cap) == late else None


def turning(history: History) -> float:
    """Turning rate of the demonstration either way, rad/s; old runs have one demonstration and no such column."""
    try:
        return history["eval/demonstration_turning"]
    except Missing:
        return abs(history["eval/demonstration_turn"])


def speed(history: History) -> float:
    """The late speed that counts, m/s; old runs have no column of it, and are in world axes."""
    try:
        return history["eval/pace"]
    except Missing:
        pass
    try:
        turns = turning(history) > TURNS
    except Missing:  # runs from before turning was measured are of straight walks
        turns = False
    return history["eval/path_speed" if turns else "eval/late_speed"]


def travel(history: History) -> float | None:
    """Late speed over the demonstration's; None where most episodes fall, or the demonstration stands."""
    if fallen(history) > 0.5 or history["eval/demonstration_speed"] < MOVES:
        return None
    return speed(history) / history["eval/demonstration_speed"]


def excursion(history: History, *, travels: bool) -> float | None:
    """Excursion of the legs of a policy that travels, or of one that does not."""
    share = travel(history)
    return history["eval/excursion"] if share is not None and (abs(share) >= TRAVELS) == travels else None


def marching(history: History) -> float | None:
    """Late speed over the demonstration's, either way, where the legs step."""
    share = travel(history)
    return None if share is None or history["eval/excursion"] < STEPS else abs(share)


def pace(history: History) -> float | None:
    """Late speed over the demonstration's, where the policy travels."""
    share = travel(history)
    return None if share is None or abs(share) < TRAVELS else share


def turn_error(history: History) -> float | None:
    """Error of the turning rate over the demonstration's, or over `STEADIEST`."""
    if pace(history) is None:
        return None
    own = history["eval/demonstration_turn"]
    # Left and right turns of several motions cancel in the means.
    if turning(history) > abs(own) + TURNS:
        return None
    return abs(history["eval/turn"] - own) / max(abs(own), STEADIEST)


def limp(history: History) -> float | None:
    """Imbalance less the demonstration's own, which only evaluation.json tells."""
    if fallen(history) > 0.5 or history["eval/excursion"] < STEPS:
        return None
    ranges = history.evaluation.get("expert_ranges")
    if not isinstance(ranges, list) or not all(isinstance(value, int | float) for value in ranges):
        ranges = []
    pairs = list(zip(ranges[: len(ranges) // 2], ranges[len(ranges) // 2 :], strict=False))
    own = sum(2.0 * abs(a - b) / max(a + b, 1e-9) for a, b in pairs) / max(len(pairs), 1)
    return history["eval/imbalance"] - own


def stamping(history: History) -> float | None:
    """Excursion of the legs, where most episodes stay up."""
    return None if fallen(history) > 0.5 else history["eval/excursion"]


def kept(history: History) -> float | None:
    """Quality of the history's newest evaluation over its best; with a command the score."""
    name = choosing(history.config.command.kind)
    found = [number(name, row.get(name)) for row in history.rows]
    found = [value for value in found if not math.isnan(value)]
    if not found:
        raise Missing(name)
    return found[-1] / max(found) if max(found) >= GOOD else None


def correlation(history: History) -> float | None:
    """Correlation over the newest rows in which windows differ; None where none does."""
    history["fit/score_spread"], history["fit/value_correlation"]
    spread = [number("fit/score_spread", row.get("fit/score_spread")) for row in history.rows]
    rows = [row for row, value in zip(history.rows, spread, strict=True) if value >= DISTINCT]
    return history.mean("fit/value_correlation", rows[-RECENT:]) if rows else None


def nonfinite(history: History) -> float:
    """The count since the start, so of the last row."""
    return history.mean("train/nonfinite", history.rows[-1:])


def kl(history: History) -> float | None:
    """KL divergence of the updates over its target, which is another one where the policy settles."""
    config = history.config
    if not config.ppo.target_kl:
        return None
    # A row is of the iterations since the one before: the first that ends here may have begun earlier.
    begins = (config.settles_at + config.chunk) * config.transitions_per_iteration
    settled = [row for row in history.rows[-RECENT:] if number("transitions", row.get("transitions")) >= begins]
    if config.ppo.settle and settled:
        return history.mean("ppo/kl", settled) / config.ppo.settle_target_kl
    return history["ppo/kl"] / config.ppo.target_kl
