"""A diagnosis in words: the rules applied to a history, and the table of the rules."""

from fmpjax import tables
from fmpjax.diagnose.history import History, Missing, number
from fmpjax.diagnose.rules import RULES

# Share of the budget by which the good runs of `laptop` stay up, per reset.
SETTLED = {"dataset": 0.5, "fixed": 0.7}


def symptoms(history: History) -> dict[str, str]:
    """The sentence of each rule whose figure is out of its range, by the rule's name."""
    return apply_rules(history)[0]


def apply_rules(history: History) -> tuple[dict[str, str], dict[str, list[str]]]:
    """Sentences by rule, and the rules that could not be checked by the figure that is missing."""
    found, lacking = {}, {}
    for rule in RULES:
        try:
            sentence = rule.sentence(history)
        except Missing as missing:
            lacking.setdefault(missing.args[0], []).append(rule.name)
            continue
        if sentence is not None:
            found[rule.name] = sentence
    return found, lacking


def report(history: History) -> list[str]:
    """The diagnosis: a sentence per symptom, or one that there is none; then what could not be checked."""
    found, lacking = apply_rules(history)
    lines = list(found.values()) or ["No symptom: every figure that was checked is in its healthy range."]
    settled = SETTLED[history.config.env.reset]
    if found and history.progress < settled:
        lines.append(
            f"This is at {100 * history.progress:.0f} % of the budget: good runs of `laptop` from this reset fall and "
            f"stand, too, up to {100 * settled:.0f} %."
        )
    if lacking:
        which = "; ".join(f"{', '.join(names)} (no {figure})" for figure, names in lacking.items())
        lines.append(f"Not checked: {which}.")
    return lines


def text(history: History) -> str:
    """The diagnosis as lines for people."""
    transitions = number("transitions", history.rows[-1].get("transitions"))
    rows = f"{len(history.recent)} rows" if history.recent[1:] else "row"
    head = f"diagnosis at {transitions:,.0f} transitions, by {history.source} and the last {rows} of metrics.csv:"
    return "\n".join([head, *(f"  - {line}" for line in report(history))])


def page() -> str:
    """The rules as the table in ``docs/metrics.md``."""
    lines = ["| symptom | figure | healthy | look at | what the runs show |", "|---|---|---|---|---|"]
    for rule in RULES:
        figure = rule.figure + (f", where {rule.when}" if rule.when else "")
        figure += f" (`{'`, `'.join(rule.methods)}`)" if rule.methods else ""
        if rule.not_with:
            figure += " (not with a command)" if rule.not_with[1:] else f" (not with the command `{rule.not_with[0]}`)"
        look = ", ".join(f"`{key}`" for key in rule.look)
        lines.append(tables.row((rule.name, figure, str(rule.healthy), look, rule.evidence)))
    return "\n".join(lines)
