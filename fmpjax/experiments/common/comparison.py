"""What a benchmark's scores say of the methods: interquartile means, profiles and who is better, with intervals.

Methods of one reset and budget are compared on the motions and seeds that all of them have finished.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from fmpjax.experiments.common import statistics
from fmpjax.experiments.common.results import Table, number
from fmpjax.experiments.common.scores import BUDGETS, SCORES, Result
from fmpjax.experiments.common.statistics import Estimate
from fmpjax.experiments.common.table import title

BY = "quality"  # the score by which one method is better than another
POINTS = 41  # of a profile
# Of one cell they may be 0 or 100 and nothing between, as from the fixed pose, which has one start without noise.
SHARES = ("walks", "falls_at_0")
MOST_P = 0.05  # of the sign test, up to which one method is said to be better than another
LEAST_SEEDS = 5  # of every motion, from which on one method is said to be better than another
_EQUAL = {"transitions": "equal transitions", "seconds": "equal wall time"}

_NOTHING = dict.fromkeys(Estimate._fields)

Group = Mapping[str, Mapping[tuple[str, int], Result]]  # by method, and by motion and seed


def groups(results: Sequence[Result]) -> dict[tuple[str, str], Group]:
    """The results by reset and budget, of the motions and seeds that all methods there have."""
    found: dict[tuple[str, str], dict[str, dict[tuple[str, int], Result]]] = {}
    for budget in BUDGETS:
        for each in results:
            if each.budget == budget:
                methods = found.setdefault((each.reset, budget), {})
                methods.setdefault(each.method, {})[each.motion, each.seed] = each
    for methods in found.values():
        common = set.intersection(*map(set, methods.values()))
        for method, cells in methods.items():
            methods[method] = {key: cells[key] for key in cells if key in common}
    return {key: methods for key, methods in found.items() if all(methods.values())}


def samples(cells: Mapping[tuple[str, int], Result], score: str) -> list[np.ndarray]:
    """A score's values, an array a motion, seeds in their order; those that are not defined are left out."""
    motions: dict[str, list[float]] = {}
    for (motion, _), result in sorted(cells.items()):
        value = result.scores.get(score, math.nan)
        motions.setdefault(motion, []).extend([value] if math.isfinite(value) else [])
    return [np.array(values) for values in motions.values() if values]


def compare(results: Sequence[Result]) -> dict[str, Any]:
    """All statistics, for JSON.

    ``scores`` has the interquartile mean of each score of each method (of `SHARES` the mean), ``by_motion`` the same
    for each motion, ``improvements`` how often each method has the higher quality than each other one, and ``profiles``
    the share of cells with at least a quality.
    """
    scores, by_motion, improvements, profiles = [], [], [], []
    thresholds = np.linspace(0.0, 1.0, POINTS)
    for (reset, budget), methods in groups(results).items():
        where = {"reset": reset, "budget": budget}
        for method, cells in methods.items():
            of = where | {"method": method}
            scores += [of | line for line in _scores(cells)]
            for motion in sorted({motion for motion, _ in cells}):
                own = {key: result for key, result in cells.items() if key[0] == motion}
                by_motion += [of | {"motion": motion} | line for line in _scores(own)]
            ours = samples(cells, BY)
            shares = statistics.profile(ours, thresholds)
            profiles.append(of | {"thresholds": thresholds.tolist()} | _columns(shares))
            for other in [name for name in methods if name != method]:
                theirs = samples(methods[other], BY)
                found = statistics.improvement(ours, theirs)._asdict() | {"p": statistics.sign_test(ours, theirs)}
                improvements.append(of | {"over": other} | found | {"seeds": min(map(len, ours))})
    return {"scores": scores, "by_motion": by_motion, "improvements": improvements, "profiles": profiles}


def _scores(cells: Mapping[tuple[str, int], Result]) -> list[dict[str, Any]]:
    """The estimate of each score over the cells of a method."""
    lines = []
    for score in SCORES:
        values = samples(cells, score.name)
        if score.name == "walks":
            found = Estimate(*(100.0 * end for end in statistics.share([part / 100.0 for part in values])))
        else:
            found = (statistics.mean if score.name in SHARES else statistics.interquartile_mean)(values)
        lines.append({"score": score.name} | found._asdict() | {"cells": sum(map(len, values))})
    return lines


def _columns(estimates: Sequence[Estimate]) -> dict[str, list[float]]:
    return {name: [getattr(each, name) for each in estimates] for name in Estimate._fields}


def _cell(line: Mapping[str, Any], digits: int, scale: float = 1.0) -> str:
    """An estimate for people."""
    value, low, high = (math.nan if line[key] is None else scale * line[key] for key in Estimate._fields)
    if math.isnan(value):
        return "–"
    held = "no interval" if math.isnan(low) else f"{number(low, digits)} to {number(high, digits)}"
    return f"{number(value, digits)} ({held})"


def table(record: Mapping[str, Any]) -> Table:
    """A line for each reset, budget and method: its scores, and how often it is better than the first method."""
    reference = record["plan"]["methods"][0]
    scores = {(s["reset"], s["budget"], s["method"], s["score"]): s for s in record["scores"]}
    better = {(i["reset"], i["budget"], i["method"]): i for i in record["improvements"] if i["over"] == reference}
    headings = ["reset, budget: method", "cells", *(score.heading for score in SCORES)]
    headings.append(f"better than {title(reference)}, %")
    lines = []
    for reset, budget, method in dict.fromkeys((s["reset"], s["budget"], s["method"]) for s in record["scores"]):
        # A record of an earlier version has fewer scores.
        cells = [scores.get((reset, budget, method, score.name), _NOTHING) for score in SCORES]
        against = better.get((reset, budget, method))
        lines.append(
            [
                f"{reset}, {_EQUAL[budget]}: {title(method)}",
                str(cells[0]["cells"]),
                *(_cell(cell, score.digits) for cell, score in zip(cells, SCORES, strict=True)),
                _cell(against, 0, 100.0) if against else "–",
            ]
        )
    return Table(" ".join(record["notes"]), headings, lines)


def sentences(record: Mapping[str, Any]) -> list[str]:
    """Who is better than the first method, where both the interval and the sign test say so."""
    reference = record["plan"]["methods"][0]
    found = []
    for line in record["improvements"]:
        if line["over"] != reference:
            continue
        estimate = Estimate(*(math.nan if line[key] is None else line[key] for key in Estimate._fields))
        ours, theirs = title(line["method"]), title(reference)
        if math.isnan(estimate.low) or line["seeds"] < LEAST_SEEDS:
            said = f"nothing is claimed of {ours} and {theirs}, with fewer than {LEAST_SEEDS} seeds of a motion"
        elif statistics.differs(estimate) and line["p"] <= MOST_P:
            said = f"{ours} is {'better' if estimate.low > 0.5 else 'worse'} than {theirs}"
        else:
            said = f"no difference between {ours} and {theirs} is shown"
        found.append(f"{line['reset']} reset, {_EQUAL[line['budget']]}: {said} ({_cell(line, 0, 100.0)} %).")
    return found


def draw(record: Mapping[str, Any], results: Sequence[Result], paths: Sequence[Path]) -> list[Path]:
    """Profiles of the quality at both budgets and of the time to walk: a row of panels for each reset.

    Bands are the 95 % intervals. The time to walk is the share of a method's cells that have walked by then.
    """
    resets = list(dict.fromkeys(line["reset"] for line in record["profiles"]))
    colors = {method: f"C{i}" for i, method in enumerate(dict.fromkeys(p["method"] for p in record["profiles"]))}
    figure = Figure((10.5, 2.9 * len(resets) + 0.5), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    grid, handles = figure.subplots(len(resets), 3, squeeze=False, sharey=True), {}
    for panels, reset in zip(grid, resets, strict=True):
        for panel, budget in zip(panels, BUDGETS, strict=False):
            for line in record["profiles"]:
                if (line["reset"], line["budget"]) == (reset, budget):
                    color = colors[line["method"]]
                    (curve,) = panel.plot(line["thresholds"], line["value"], color=color, linewidth=1.5)
                    panel.fill_between(line["thresholds"], line["low"], line["high"], color=color, alpha=0.15)
                    handles[title(line["method"])] = curve
            panel.set_title(f"{reset} reset, {_EQUAL[budget]}", fontsize=9, loc="left")
            panel.set_xlabel("quality of at least", fontsize=8)
        for method, cells in groups(results)[reset, "transitions"].items():
            walked = sorted(r.walk_transitions for r in cells.values() if math.isfinite(r.walk_transitions))
            times = np.array([0, *walked, max(r.transitions for r in cells.values())]) / 1e6
            shares = np.array([*range(len(walked) + 1), len(walked)]) / len(cells)
            panels[2].step(times, shares, where="post", color=colors[method], linewidth=1.5)
        panels[2].set_title(f"{reset} reset, cells that have walked", fontsize=9, loc="left")
        panels[2].set_xlabel("million transitions", fontsize=8)
        for panel in panels:
            panel.tick_params(labelsize=7, length=2)
            panel.set_ylim(-0.02, 1.02)
            panel.grid(alpha=0.25, linewidth=0.5)
            panel.spines[["top", "right"]].set_visible(False)
        panels[0].set_ylabel("share of cells", fontsize=8)
    figure.legend(handles.values(), handles, loc="outside upper center", ncols=6, fontsize=8, frameon=False)
    for path in paths:
        figure.savefig(path)
    return list(paths)
