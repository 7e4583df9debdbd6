"""The benchmark's scores and statistics, on figures whose answers are known, and the page that shows them."""

import csv
import json
import math
import re
import shutil
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest

from fmpjax.errors import UserError
from fmpjax.experiments import benchmark
from fmpjax.experiments.common import comparison, explorer, measured, scores, statistics
from fmpjax.experiments.common.scores import History, Result
from fmpjax.experiments.common.statistics import Estimate
from fmpjax.experiments.common.table import Row
from tests.helpers import PROVENANCE

GOOD = {
    "quality": 0.9, "falls": 0.0, "late_speed": 0.9, "path_speed": 0.5, "demonstration_speed": 1.0,
    "demonstration_turning": 0.0, "excursion": 0.8, "amplitude_mae": 4.0, "discrepancy": 0.2, "contact_foot_speed": 0.1,
    "action_rate": 3.0, "joint_jerk": 900.0, "power": 80.0,
}  # fmt: skip


def row(transitions=100, seconds=10.0, method="fmp", motion="walk", seed=0, **figures):
    return Row(f"{method}/{seed}", method, "dataset", motion, seed, transitions, seconds, GOOD | figures)


def history(rows, machines=("2 CPU cores",)):
    first = rows[0]
    config = SimpleNamespace(method=first.method, seed=first.seed, env=SimpleNamespace(reset=first.reset))
    return History(SimpleNamespace(config=config, variant=first.variant), rows, 30.0, frozenset(machines))


# --- scores of a cell ------------------------------------------------------------------------------------------------


def test_scores_of_an_evaluation():
    found = scores.scores(row(), still=30.0)
    # The others are measured after training.
    assert [*found, *measured.scores([], [])] == [score.name for score in scores.SCORES]
    assert found["pace_error"] == pytest.approx(0.1) and found["excursion_error"] == pytest.approx(0.2)
    assert found["walks"] == 100.0
    assert (found["quality"], found["falls"], found["amplitude_error"], found["sinkhorn"]) == (0.9, 0.0, 4.0, 0.2)
    assert (found["foot_slip"], found["action_rate"], found["joint_jerk"], found["power"]) == (0.1, 3.0, 900.0, 80.0)
    # Where the demonstration turns, the pace is along the own heading.
    assert scores.scores(row(demonstration_turning=0.5), 30.0)["pace_error"] == pytest.approx(0.5)


def test_falls_stand_at_every_size_of_noise():
    """Also of records that have none, as earlier versions wrote them."""
    figures = {"falls_at_0": 0.0, "falls_at_0.001": 2.0, "falls_at_0.01": 40.0}
    assert figures.items() <= scores.scores(row(**figures), 30.0).items()
    assert math.isnan(scores.scores(row(), 30.0)["falls_at_0.01"])
    found = record([result(method, seed, 0.5, **figures) for method in ("fmp", "amp") for seed in (0, 1)])
    headings = comparison.table(found).headings
    place = headings.index("at 0.01 rad, %")
    assert headings[place - 3 : place] == ["falls, %", "at 0 rad, %", "at 0.001 rad, %"]
    assert comparison.table(found).lines[0][place].startswith("40.0 (")
    found["scores"] = [line for line in found["scores"] if not line["score"].startswith("falls_at")]
    assert comparison.table(found).lines[0][place] == "–"
    assert any("joint noise" in note for note in found["notes"])


def test_who_falls_early_scores_as_one_who_holds_still():
    undefined = dict.fromkeys(("late_speed", "path_speed", "excursion", "amplitude_mae"), math.nan)
    found = scores.scores(row(falls=100.0, **undefined), still=30.0)
    assert (found["pace_error"], found["excursion_error"], found["amplitude_error"]) == (1.0, 1.0, 30.0)
    assert found["walks"] == 0.0


@pytest.mark.parametrize(
    ("figures", "walks"),
    [
        ({}, True),
        ({"late_speed": 1.2}, True),
        ({"late_speed": 1.21}, False),
        ({"late_speed": 0.79}, False),
        ({"falls": 0.1}, False),
    ],
)
def test_a_policy_walks_with_no_fall_within_a_fifth_of_the_pace(figures, walks):
    assert scores.walks(row(**figures)) is walks


def test_time_to_walk_is_of_the_first_evaluation_that_walks():
    rows = [row(100, 10.0, late_speed=0.1), row(200, 21.0), row(300, 32.0, falls=3.0)]
    assert scores.time_to_walk(rows) == (200.0, 21.0)
    assert np.isnan(scores.time_to_walk(rows[:1])).all()


def test_equal_transitions_take_the_last_evaluation_and_equal_wall_time_the_last_in_time():
    """The seeds of the fast method end by 31 s; one that is a little later, at 38 s, is later."""
    fast = [history([row(100, 15.0, "amp", seed=s), row(200, end, "amp", seed=s)]) for s, end in ((0, 29.0), (1, 31.0))]
    slow = history([row(20, 9.0, falls=5.0), row(50, 21.0, quality=0.5), row(100, 38.0), row(200, 80.0)])
    found = {(r.method, r.seed, r.budget): r for r in scores.results([*fast, slow])}
    assert {(key[2], r.transitions) for key, r in found.items() if key[0] == "amp"} == {
        ("transitions", 200), ("seconds", 200),
    }  # fmt: skip
    assert found["fmp", 0, "transitions"].seconds == 80.0
    equal = found["fmp", 0, "seconds"]
    assert (equal.transitions, equal.seconds, equal.scores["quality"]) == (50, 21.0, 0.5)
    # Until then it had walked once; at equal transitions no other way.
    assert (equal.walk_transitions, equal.walk_seconds) == (50.0, 21.0)
    assert equal.scores["time_to_walk"] == pytest.approx(50e-6)
    early = history([row(50, 29.0, falls=5.0), row(200, 60.0)])
    (never,) = (r for r in scores.results([*fast, early]) if (r.method, r.budget) == ("fmp", "seconds"))
    # One that has not walked may do so right after.
    assert math.isnan(never.walk_transitions) and never.scores["time_to_walk"] == pytest.approx(50e-6)
    # The first evaluation counts where even that is later.
    late = history([row(50, 40.0), row(200, 60.0)])
    (only,) = (r for r in scores.results([*fast, late]) if (r.method, r.budget) == ("fmp", "seconds"))
    assert only.seconds == 40.0
    # Another motion has a time of its own.
    other = history([row(100, 50.0, motion="turn"), row(200, 100.0, motion="turn")])
    (found,) = (r for r in scores.results([*fast, other]) if (r.motion, r.budget) == ("turn", "seconds"))
    assert found.seconds == 100.0


def test_wall_times_of_different_machines_are_not_compared():
    histories = [history([row(seed=0)]), history([row(seed=1)], ["1 CPU cores"])]
    assert {each.budget for each in scores.results(histories)} == {"transitions"}
    record = {"cells": {"planned": 3, "finished": 2}, "machines": scores.machines(histories)}
    said = benchmark.notes(record)
    assert said[0] == "2 of 3 cells are finished." and "(1 CPU cores, 2 CPU cores), whose wall times do not" in said[-1]


# --- statistics ------------------------------------------------------------------------------------------------------


def test_interquartile_mean_is_of_the_middle_half_of_all_motions():
    """Of 1 to 8 that is the mean of 3 to 6; one value more than far off changes nothing."""
    found = statistics.interquartile_mean([np.array([1.0, 4.0, 5.0, 8.0]), np.array([2.0, 3.0, 6.0, 7.0])])
    assert found.value == 4.5 and 1.0 <= found.low < 4.5 < found.high <= 8.0
    far = statistics.interquartile_mean([np.array([1.0, 4.0, 5.0, 800.0]), np.array([2.0, 3.0, 6.0, 7.0])])
    assert far.value == 4.5


def test_intervals_are_those_of_a_normal_mean():
    """Of 400 values the bootstrap's interval is the mean ± 1.96 deviations over their root."""
    values = np.random.default_rng(0).normal(2.0, 3.0, 400)
    found = statistics.mean([values])
    half = 1.96 * values.std() / 20.0
    np.testing.assert_allclose(found, [values.mean(), values.mean() - half, values.mean() + half], atol=0.06 * half)


def test_intervals_are_stratified_by_motion():
    """Motions that differ by 100 do not widen the interval, since no resample has more of one of them."""
    rng = np.random.default_rng(1)
    parts = [offset + rng.normal(0.0, 1.0, 20) for offset in (0.0, 100.0)]
    found, alone = statistics.mean(parts), statistics.mean([parts[0], parts[1] - 100.0])
    assert found.high - found.low == pytest.approx(alone.high - alone.low, rel=1e-6) and found.high - found.low < 1.0
    assert found == statistics.mean(parts)  # and they are the same each time


def test_profile_is_the_share_at_or_above_each_threshold():
    found = statistics.profile([np.array([0.1, 0.5]), np.array([0.5, 0.9])], np.array([0.0, 0.5, 0.6, 1.0]))
    assert [each.value for each in found] == [1.0, 0.75, 0.25, 0.0]
    # Where all or none are, no resample differs: Wilson's interval of 4 of 4, from 1 / (1 + 1.96² / 4) on.
    least = 4 / (4 + 1.959964**2)
    assert found[0] == pytest.approx((1.0, least, 1.0)) and found[3] == pytest.approx((0.0, 0.0, 1 - least))
    assert found[1].low < 0.75 and statistics.share([np.ones(2), np.ones(2)]) == found[0]
    assert statistics.share([np.array([0.0, 1.0]), np.ones(2)]) == statistics.mean([np.array([0.0, 1.0]), np.ones(2)])


def test_improvement_is_paired_by_seed():
    """A constant gain under a spread fifty times larger: every pair shows it, and ties count half."""
    theirs = [np.random.default_rng(i).normal(0.0, 5.0, 5) for i in range(3)]
    always = statistics.improvement([part + 0.1 for part in theirs], theirs)
    # All pairs alike: Wilson's interval of 15 of 15, from 1 / (1 + 1.96² / 15) on.
    assert always == (1.0, pytest.approx(15 / (15 + 1.959964**2)), 1.0) and statistics.differs(always)
    assert statistics.improvement(theirs, theirs).value == 0.5
    mixed = statistics.improvement([np.array([1.0, 1.0, 0.0, 0.5])], [np.full(4, 0.5)])
    assert mixed.value == 0.625 and mixed.low < 0.5 < mixed.high and not statistics.differs(mixed)
    # Two wins of two are no proof, and motions weigh the same however many seeds they have.
    assert not statistics.differs(statistics.improvement([np.ones(2)], [np.zeros(2)]))
    assert statistics.improvement([np.ones(2), np.zeros(6)], [np.zeros(2), np.ones(6)]).value == 0.5


def test_sign_test_counts_pairs_of_all_motions():
    """Of 13 wins in 20 pairs p is 0.26, though three of four motions are unanimous; five of five are no proof."""
    theirs = [np.zeros(5)] * 4
    ours = [np.ones(5), np.ones(5), -np.ones(5), np.array([1.0, 1.0, 1.0, -1.0, -1.0])]
    assert statistics.differs(statistics.improvement(ours, theirs))  # the bootstrap sees one motion vary
    assert statistics.sign_test(ours, theirs) == pytest.approx(0.2632, abs=1e-4)
    assert statistics.sign_test(ours[:1], theirs[:1]) == 2 * 0.5**5
    assert statistics.sign_test([np.array([1.0, 0.0, 0.0])], [np.zeros(3)]) == 1.0  # ties are left out
    assert statistics.sign_test(theirs, theirs) == 1.0


def test_one_seed_has_no_interval_and_nothing_no_value():
    found = statistics.interquartile_mean([np.array([1.0, 2.0]), np.array([3.0])])
    assert found.value == 2.0 and np.isnan(found[1:]).all() and not statistics.differs(found)
    assert np.isnan(statistics.mean([])).all()


# --- comparison ------------------------------------------------------------------------------------------------------


def result(method, seed, quality, motion="walk", budget="transitions", **changed):
    values = scores.scores(row(quality=quality), 30.0) | changed
    return Result(method, "dataset", motion, seed, budget, 200, 30.0, values, 100.0 + seed, 9.0)


def record(results):
    found = {"plan": {"methods": ["fmp", "amp"]}, "cells": {"planned": 9, "finished": 9}, "machines": ["2 CPU cores"]}
    found |= comparison.compare(results)
    return json.loads(json.dumps(found | {"notes": benchmark.notes(found)}).replace("NaN", "null"))


def test_methods_are_compared_on_the_seeds_that_all_have():
    """Seed 5 of FMP would lift its quality, and AMP has no such cell; a foot slip that is not defined is left out."""
    results = [result("fmp", seed, 0.2 + 0.1 * seed) for seed in range(6)]
    results += [result("amp", seed, 0.9 - 0.1 * seed, foot_slip=math.nan if seed else 0.3) for seed in range(5)]
    found = record(results)
    by = {(s["method"], s["score"]): s for s in found["scores"]}
    assert by["fmp", "quality"]["cells"] == by["amp", "quality"]["cells"] == 5
    assert by["fmp", "quality"]["value"] == pytest.approx(0.4) and by["amp", "foot_slip"]["value"] == 0.3
    assert by["amp", "foot_slip"]["low"] is None
    walks = by["fmp", "walks"]  # all five do: Wilson's interval
    assert [walks[key] for key in Estimate._fields] == pytest.approx([100.0, 100 * 5 / (5 + 1.959964**2), 100.0])
    of_walk = [{k: v for k, v in line.items() if k != "motion"} for line in found["by_motion"]]
    assert of_walk == found["scores"]  # there is one motion
    (ours,) = (i for i in found["improvements"] if i["method"] == "amp")
    assert ours["value"] == 0.8 and ours["seeds"] == 5 and ours["over"] == "fmp"
    table = comparison.table(found)
    line = dict(zip(table.headings, table.lines[1], strict=True))
    assert line["reset, budget: method"] == "dataset, equal transitions: AMP" and line["cells"] == "5"
    assert line["foot slip, m/s"] == "0.300 (no interval)" and line["better than FMP, %"].startswith("80 (")
    assert table.lines[0][-1] == "–"
    # Without a cell in common there is nothing to compare.
    assert record([result("fmp", 0, 0.5), result("amp", 1, 0.5)])["scores"] == []


@pytest.mark.parametrize(
    ("ours", "seeds", "said"),
    [
        (0.9, 5, "AMP is better than FMP (100 (72 to 100) %)"),
        (0.1, 5, "AMP is worse than FMP (0 (0 to 28) %)"),
        (0.5, 5, "no difference between AMP and FMP is shown"),
        # Eight of ten pairs: the bootstrap's interval leaves out a half, but the sign test's p is 0.11.
        ((0.9, 0.9, 0.9, 0.1, 0.1), 5, "no difference between AMP and FMP is shown (80 (60 to 100) %)"),
        (0.9, 4, "nothing is claimed of AMP and FMP, with fewer than 5 seeds of a motion"),
        (0.9, 1, "nothing is claimed of AMP and FMP, with fewer than 5 seeds of a motion"),
    ],
)
def test_claims_have_intervals_and_seeds(ours, seeds, said):
    """Ten pairs on two motions; 10 of 10 are Wilson's 72 to 100 %."""
    turn = ours if isinstance(ours, tuple) else (ours,) * 5
    results = [
        result(method, seed, quality, motion)
        for motion, better in (("walk", turn[:1] * 5), ("turn", turn))
        for seed in range(seeds)
        for method, quality in (("fmp", 0.5), ("amp", better[seed]))
    ]
    (sentence,) = comparison.sentences(record(results))
    assert sentence.startswith("dataset reset, equal transitions: ") and said in sentence


def test_profiles_are_drawn(tmp_path):
    results = [
        result(method, seed, 0.1 * seed, budget=budget)
        for method in ("fmp", "amp") for seed in (0, 1) for budget in scores.BUDGETS
    ]  # fmt: skip
    (path,) = comparison.draw(record(results), results, [tmp_path / "profiles.png"])
    assert path.stat().st_size > 10_000


# --- the page --------------------------------------------------------------------------------------------------------


def test_the_page_has_every_line_and_a_filter_for_each_column_of_few_texts():
    lines = [
        {"method": "fmp", "motion": "a<b", "seed": "0", "quality": "0.123456"},
        {"method": "amp", "motion": "walk", "seed": "1", "quality": ""},
    ]
    page = explorer.page(lines)
    assert page.count("<tr>") == 3 and re.findall(r'data-column="(\d)"', page) == ["0", "1", "2"]
    assert "<option>a&lt;b</option>" in page and "a<b" not in page
    assert '<td data-value="0.123456">0.1235</td>' in page and '<td data-value="">–</td>' in page
    assert "http" not in page + explorer.script() and "import" not in explorer.script()


def test_a_broken_table_is_refused(tmp_path):
    path = tmp_path / "benchmark.csv"
    for text, said in (("a,b\n1\n", "lines of different lengths"), ("a,b\n", "has no lines"), ("", "has no lines")):
        path.write_text(text)
        with pytest.raises(UserError, match=said):
            explorer.read(path)
    with pytest.raises(UserError, match="none.csv cannot be read"):
        explorer.read(tmp_path / "none.csv")


BROWSER = """
class Element {
  constructor(fields) { this.listeners = {}; this.attributes = {}; Object.assign(this, fields); }
  addEventListener(name, listener) { this.listeners[name] = listener; }
  getAttribute(name) { return this.attributes[name]; }
  setAttribute(name, value) { this.attributes[name] = value; }
  removeAttribute(name) { delete this.attributes[name]; }
}
const lines = DATA.map((row) => new Element({ cells: row.map((value) => ({ dataset: { value } })), hidden: false }));
const buttons = DATA[0].map(() => new Element({}));
const headings = buttons.map((button) => new Element({ querySelector: () => button }));
const body = { lines, querySelectorAll: () => lines, append(...moved) { this.lines = moved; } };
const select = new Element({ dataset: { column: "0" }, value: "" }), output = {};
const box = { querySelectorAll: () => [select], querySelector: () => output };
const table = { querySelector: () => body, querySelectorAll: () => headings, closest: () => box };
const document = { querySelectorAll: () => [table] };
const text = (line) => line.cells.map((cell) => cell.dataset.value).join(" ");
const shown = () => body.lines.filter((line) => !line.hidden).map(text);
const click = (column) => { buttons[column].listeners.click(); return shown(); };
"""


@pytest.mark.skipif(not shutil.which("node"), reason="no Node.js here")
def test_the_script_sorts_and_filters(tmp_path):
    """Numbers by their size and not their digits, what is not defined last either way, texts by the alphabet."""
    data = [["fmp", "10"], ["amp", "9"], ["fmp", ""], ["gail", "-1e2"]]
    script = f"const DATA = {json.dumps(data)};\n{BROWSER}\n{explorer.SCRIPT.read_text()}\n" + (
        "const found = { begin: output.textContent, up: click(1), down: click(1), text: click(0) };\n"
        'select.value = "fmp"; select.listeners.change(); found.fmp = shown(); found.count = output.textContent;\n'
        "found.state = headings.map((h) => h.attributes); console.log(JSON.stringify(found));\n"
    )
    (tmp_path / "test.js").write_text(script)
    done = subprocess.run(["node", str(tmp_path / "test.js")], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["begin"] == "4 of 4 lines"
    assert found["up"] == ["gail -1e2", "amp 9", "fmp 10", "fmp "]
    assert found["down"] == ["fmp 10", "amp 9", "gail -1e2", "fmp "]
    assert [line.split()[0] for line in found["text"]] == ["amp", "fmp", "fmp", "gail"]
    assert found["fmp"] == ["fmp 10", "fmp "] and found["count"] == "2 of 4 lines"
    assert found["state"] == [{"aria-sort": "ascending"}, {}]


def test_the_report_holds_the_benchmark(tmp_path):
    from fmpjax.experiments import report

    results = [
        result(m, s, q, budget=b) for m, q in (("fmp", 0.5), ("amp", 0.6)) for s in (0, 1) for b in scores.BUDGETS
    ]
    found = record(results)
    (tmp_path / "benchmark.json").write_text(json.dumps(found | {"provenance": PROVENANCE}))
    with (tmp_path / "benchmark.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(results[0].line()))
        writer.writeheader()
        writer.writerows(each.line() for each in results)
    report.write(tmp_path, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert page.count("<script>") == 1 and "http" not in page and page.count('data-column="') == 5
    assert page.count('<tr><td data-value="') == 8 and "dataset, equal wall time: AMP" in page
    text = (tmp_path / "report.md").read_text()
    assert "dataset, equal transitions: FMP" in text
    said = "dataset reset, equal wall time: nothing is claimed of AMP and FMP"
    assert f"- {said}" in text and f"<li>{said}" in page and page.count("<img") == 0
    # One of an earlier version, without the sign test, is refused in a sentence.
    earlier = record([result(m, s, q) for m, q in (("fmp", 0.5), ("amp", 0.6)) for s in range(5)])
    for line in earlier["improvements"]:
        del line["p"]
    (tmp_path / "earlier").mkdir()
    (tmp_path / "earlier" / "benchmark.json").write_text(json.dumps(earlier | {"provenance": PROVENANCE}))
    with pytest.raises(UserError, match="benchmark.json is no result of this version"):
        report.gather(tmp_path / "earlier")
    (tmp_path / "benchmark_courses.png").write_bytes(b"picture")
    report.write(tmp_path, tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text().count("<img") == 1


def test_estimates_of_the_table_say_where_there_is_no_interval():
    estimate = Estimate(0.5, math.nan, math.nan)._asdict()
    assert comparison._cell(estimate | {"low": None, "high": None}, 2) == "0.50 (no interval)"
    assert comparison._cell({"value": None, "low": None, "high": None}, 2) == "–"
