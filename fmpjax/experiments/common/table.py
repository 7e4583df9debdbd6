"""The matched comparison's results: Table I and the learning curves, the paper's figures beside ours."""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy import stats

from fmpjax import tables
from fmpjax.experiments.common import results
from fmpjax.experiments.common.cells import Cell
from fmpjax.experiments.common.results import Verdict
from fmpjax.logs import MetricsLog
from fmpjax.motion import library

TITLES = {
    "fmp": "FMP",
    "endpoint": "Endpoint",
    "value": "Value",
    "bank16": "16-bank score",
    "amp": "AMP",
    "barycentric": "Barycentric OT",
    "gail": "GAIL",
    "wail": "WAIL",
    "pwil": "PWIL",
    "smp": "SMP",
    "add": "ADD",
    "tracking": "Tracking",
}


class Column(NamedTuple):
    """A column of Table I."""

    name: str
    heading: str
    digits: int
    episodes: str = ""  # the figure that says how many episodes are behind it


COLUMNS = (
    Column("mean_length", "mean steps", 1),
    Column("falls", "falls, %", 1, "episodes"),
    Column("late_speed", "speed, m/s", 3, "late_n"),
    Column("excursion", "excursion", 3),
    Column("amplitude_mae", "amp. MAE, °", 2),
    Column("discrepancy", "Sinkhorn", 3),
)
_EPISODES = 1024  # of the paper's evaluations
# The paper's Table I, after 50 M transitions: steps, falls, speed, excursion, MAE, Sinkhorn, late n.
_PAPER = {
    ("dataset", "fmp"): (500.0, 0, 0.727, 1.119, 9.95, 0.159, 64),
    ("dataset", "endpoint"): (500.0, 0, 0.571, 0.997, 9.44, 0.158, 64),
    ("dataset", "value"): (500.0, 0, 0.776, 1.089, 8.69, 0.186, 64),
    ("dataset", "bank16"): (500.0, 0, 0.518, 0.891, 9.25, 0.196, 64),
    ("dataset", "amp"): (498.8, 3, 0.478, 1.035, 9.37, 0.239, 64),
    ("dataset", "barycentric"): (499.3, 3, 0.000, 0.025, 38.44, 0.347, 64),
    ("fixed", "fmp"): (469.4, 129, 0.338, 0.754, 12.60, 0.285, 61),
    ("fixed", "endpoint"): (453.8, 243, 0.147, 0.703, 13.38, 0.285, 64),
    ("fixed", "value"): (451.6, 315, 0.047, 0.387, 25.23, 0.308, 63),
    ("fixed", "bank16"): (466.7, 196, -0.021, 0.667, 14.27, 0.526, 62),
    ("fixed", "amp"): (500.0, 0, 0.000, 0.027, 39.24, 0.424, 64),
    ("fixed", "barycentric"): (500.0, 0, 0.000, 0.144, 35.15, 0.557, 64),
}
_PAPERS = ""  # cell of the paper's figures
_SIZED = "falls_at_"  # and the size of the perturbation at the start, rad


def title(method: str, variant: str = "") -> str:
    """A method's name for people, with its variant's."""
    return TITLES.get(method, method) + (f", {variant}" if variant else "")


@dataclasses.dataclass(frozen=True)
class Row:
    """One evaluation of one cell; figures that are not defined are NaN."""

    cell: str
    method: str
    reset: str
    variant: str
    seed: int
    transitions: int
    seconds: float  # of training
    figures: dict[str, float]

    def figure(self, name: str) -> float:
        """One of the figures; NaN where the evaluation, of an earlier version, has no such one."""
        return self.figures.get(name, math.nan)

    @property
    def alike(self) -> bool:
        """Whether all episodes are one: our earlier versions did not perturb the fixed pose from which they start."""
        perturbed = any(math.isfinite(v) for k, v in self.figures.items() if k == "noise" or k.startswith(_SIZED))
        return self.cell != _PAPERS and self.reset == "fixed" and not perturbed


def evaluations(cell: Cell, folder: Path) -> list[Row]:
    """All evaluations of a cell's run, in their order; falls in per cent of the episodes."""
    rows = []
    for line in MetricsLog.read(folder / cell.name / "metrics.csv"):
        if not line.get("eval/quality"):
            continue
        figures = {k.removeprefix("eval/"): float(v or "nan") for k, v in line.items() if k.startswith("eval/")}
        for name in [name for name in figures if name == "falls" or name.startswith(_SIZED)]:
            figures[name] *= 100.0 / figures[name.replace("falls", "episodes")]
        config = cell.config
        rows.append(
            Row(
                cell.name, config.method, config.env.reset, cell.variant, config.seed,
                int(line["transitions"]), float(line["seconds"]), figures,
            )
        )  # fmt: skip
    return rows


def interval(values: Iterable[float]) -> tuple[float, float]:
    """Mean of the finite values, and half the width of its 95 % interval over seeds (Student's t; NaN below two)."""
    finite = np.array([v for v in values if math.isfinite(v)])
    if not len(finite):
        return math.nan, math.nan
    if len(finite) == 1:
        return float(finite[0]), math.nan
    half = stats.t.ppf(0.975, len(finite) - 1) * finite.std(ddof=1) / math.sqrt(len(finite))
    return float(finite.mean()), float(half)


def _groups(final: Sequence[Row]) -> dict[tuple[str, str, str], list[Row]]:
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in final:
        groups.setdefault((row.reset, row.method, row.variant), []).append(row)
    return groups


def _number(value: float, digits: int, half: float = math.nan) -> str:
    if math.isnan(value):
        return "–"
    return f"{value:.{digits}f}" + ("" if math.isnan(half) else f" ± {half:.{digits}f}")


def _paper(reset: str, method: str) -> Row:
    length, falls, speed, excursion, mae, discrepancy, late = _PAPER[reset, method]
    figures = {
        "mean_length": length, "falls": 100.0 * falls / _EPISODES, "episodes": _EPISODES, "late_speed": speed,
        "late_n": late, "excursion": excursion, "amplitude_mae": mae, "discrepancy": discrepancy,
    }  # fmt: skip
    return Row(_PAPERS, method, reset, "", 0, 50_003_968, math.nan, figures)


def _sizes(rows: Iterable[Row]) -> list[float]:
    """Sizes of perturbation at which the evaluations count falls, rad."""
    return sorted({float(name.removeprefix(_SIZED)) for row in rows for name in row.figures if name.startswith(_SIZED)})


def lines(final: Sequence[Row]) -> tuple[list[str], list[list[str]]]:
    """Headings and lines of Table I, the paper's beside ours; falls at every size of perturbation that a line has."""
    at_size = [Column(f"{_SIZED}{size:g}", f"at {size:g} rad, %", 1, f"episodes_at_{size:g}") for size in _sizes(final)]
    columns = [*COLUMNS[:2], *at_size, *COLUMNS[2:]]
    headings = ["reset", "method", "seeds", *(column.heading for column in columns), "training, min"]
    body = []
    for (reset, method, variant), rows in _groups(final).items():
        minutes = np.mean([r.seconds for r in rows]) / 60
        name = title(method, variant)
        ours = [_cell(rows, column) for column in columns]
        body.append([reset, name, str(len(rows)), *ours, f"{minutes:.0f}"])
        if not variant:
            theirs = [_cell([_paper(reset, method)], column) for column in columns]
            body.append([reset, f"{name}, the paper's", "1", *theirs, ""])
    return headings, body


def _cell(rows: Sequence[Row], column: Column) -> str:
    """Mean and interval, the episodes behind them, and of how many seeds where some have no such figure."""
    values = [row.figure(column.name) for row in rows]
    mean, half = interval(values)
    text = _number(mean, column.digits, half)
    defined = [row for row, value in zip(rows, values, strict=True) if math.isfinite(value)]
    counts = [row.figure(column.episodes) for row in defined] if column.episodes else []
    if counts and all(map(math.isfinite, counts)):
        starts = sum(1 if row.alike else count for row, count in zip(defined, counts, strict=True))
        text += " (1 start per seed)" if all(row.alike for row in defined) else f" (n = {starts:.0f})"
    return text + (f" ({len(defined)} of {len(rows)})" if 0 < len(defined) < len(rows) else "")


def markdown(final: Sequence[Row]) -> str:
    """Table I in Markdown."""
    return tables.markdown(*lines(final), texts=2)


def latex(final: Sequence[Row]) -> str:
    """Table I in LaTeX."""
    return tables.latex(*lines(final), texts=2)


def curves(rows: Sequence[Row], paths: Sequence[Path]) -> None:
    """Late speed, excursion and falls over the budget: a row of panels for each reset, a color for each method.

    Thick lines are means over seeds, thin ones single seeds.
    """
    resets = list(dict.fromkeys(row.reset for row in rows))
    labels = list(dict.fromkeys((row.method, row.variant) for row in rows))
    panels = (("late_speed", "late speed, m/s"), ("excursion", "excursion"), ("falls", "falls, %"))
    figure = Figure((10.5, 2.9 * len(resets) + 0.5), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(resets), len(panels), squeeze=False, sharex=True)
    handles = {}
    for line, reset in zip(grid, resets, strict=True):
        for panel, (key, heading) in zip(line, panels, strict=True):
            for index, (method, variant) in enumerate(labels):
                chosen = [r for r in rows if (r.reset, r.method, r.variant) == (reset, method, variant)]
                name = title(method, variant)
                for seed in sorted({r.seed for r in chosen}):
                    mine = [r for r in chosen if r.seed == seed]
                    panel.plot(
                        [r.transitions / 1e6 for r in mine], [r.figure(key) for r in mine],
                        color=f"C{index}", linewidth=0.7, alpha=0.5,
                    )  # fmt: skip
                stops = sorted({r.transitions for r in chosen})
                means = [interval(r.figure(key) for r in chosen if r.transitions == stop)[0] for stop in stops]
                (handles[name],) = panel.plot(
                    np.array(stops) / 1e6, means, color=f"C{index}", linewidth=1.8, marker="o", markersize=3
                )
            panel.set_title(f"{reset} reset: {heading}", fontsize=9, loc="left")
            panel.tick_params(labelsize=7, length=2)
            panel.grid(alpha=0.25, linewidth=0.5)
            panel.spines[["top", "right"]].set_visible(False)
    for panel in grid[-1]:
        panel.set_xlabel("million transitions", fontsize=8)
    figure.legend(handles.values(), handles, loc="outside upper center", ncols=6, fontsize=8, frameon=False)
    for path in paths:
        figure.savefig(path)


def write(cells: Sequence[Cell], folder: Path, places: Iterable[Path | str] = ()) -> list[Path]:
    """Tables and curves of the cells' runs in ``folder``, of which, as of the ``places``, only names are kept."""
    rows = [row for cell in cells for row in evaluations(cell, folder)]
    final = [rows_of[-1] for cell in cells if (rows_of := [r for r in rows if r.cell == cell.name])]
    flat = [{k: v for k, v in dataclasses.asdict(r).items() if k != "figures"} | r.figures for r in rows]
    motions = [name for cell in cells for name, _ in library.parse(cell.config.motion)]
    # The cells may have been trained by other versions than the one that writes this.
    runs = {cell.name: origin(folder / cell.name) for cell in cells}
    results.save(folder, "results", {"runs": runs, "evaluations": flat}, flat, {folder, *places, *motions})
    (folder / "table.md").write_text("\n\n".join([markdown(final), *notes(final)]) + "\n")
    (folder / "table.tex").write_text(latex(final) + "\n")
    curves(rows, [folder / "curves.png", folder / "curves.pdf"])
    return [folder / n for n in ("results.csv", "results.json", "table.md", "table.tex", "curves.png", "curves.pdf")]


def notes(final: Sequence[Row]) -> list[str]:
    """What the table's reader must know of its figures."""
    sizes: dict[str, set[float]] = {}
    for row in final:
        if math.isfinite(row.figure("noise")):
            sizes.setdefault(row.reset, set()).add(row.figure("noise"))
    each = [f"{', '.join(f'{size:g}' for size in sorted(sizes[reset]))} rad ({reset} reset)" for reset in sizes]
    found = []
    if sizes:
        found.append(
            "Falls at a size are of starts with joint noise of that deviation, all other figures of starts with "
            f"{' and '.join(each)}. n counts the episodes of all seeds; late speeds are of the first 64 of an "
            "evaluation, as the paper's."
        )
    if any(math.isnan(row.figure("noise")) for row in final):
        found.append(
            "Evaluations by earlier versions are among these. Their starts are not perturbed, so that from the fixed "
            "pose all their episodes are one; their late speeds are of all episodes; their Sinkhorn discrepancies, in "
            "the run's own features, do not compare with the paper's and are left out."
        )
    return found


def origin(run: Path) -> dict[str, Any]:
    """Commit, date and device of a run."""
    made = json.loads((run / "provenance.json").read_text())
    return {key: made[key] for key in ("commit", "uncommitted_changes", "date", "device")}


def final(evaluations: Iterable[Mapping[str, Any]]) -> list[Row]:
    """The last evaluation of every cell, of the evaluations that `write` left in ``results.json``."""
    named = [field.name for field in dataclasses.fields(Row) if field.name != "figures"]
    last = {}
    for line in evaluations:
        figures = {k: math.nan if v is None else v for k, v in line.items() if k not in named}
        last[line["cell"]] = Row(*(line[name] for name in named), figures)
    return list(last.values())


def _pace(figures: Mapping[str, float]) -> str:
    return "no one after 5 s" if math.isnan(figures["late_speed"]) else f"{figures['late_speed']:.3f} m/s"


def verdicts(final: Sequence[Row]) -> list[Verdict]:
    """The paper's claims on the matched comparison, by our figures; those of which a side is missing are left out."""
    found = {}
    for (reset, method, variant), rows in _groups(final).items():
        keys = ("late_speed", "falls", "excursion", "demonstration_speed")
        found |= {} if variant else {(reset, method): {k: interval(r.figures[k] for r in rows)[0] for k in keys}}
    fmp, amp = found.get(("dataset", "fmp")), found.get(("dataset", "amp"))
    result = []
    if fmp:
        result.append(
            Verdict(
                "FMP walks from demonstration resets",
                f"{fmp['late_speed']:.3f} m/s of the demonstration's {fmp['demonstration_speed']:.3f}, "
                f"{fmp['falls']:.1f} % of episodes fall",
                fmp["late_speed"] > 0.5 * fmp["demonstration_speed"] and fmp["falls"] < 5.0,
            )
        )
    if fmp and amp:
        result.append(
            Verdict(
                "FMP walks faster than AMP from demonstration resets",
                f"{_pace(fmp)} against {_pace(amp)}",
                # Where no episode lasts five seconds there is no late speed; any speed is more than none.
                not math.isnan(fmp["late_speed"]) and not amp["late_speed"] >= fmp["late_speed"],
            )
        )
    for reset in ("dataset", "fixed"):
        if bary := found.get((reset, "barycentric")):
            result.append(
                Verdict(
                    f"The barycentric reward leaves the robot standing, {reset} reset",
                    f"{bary['late_speed']:.3f} m/s, {bary['excursion']:.3f} of the demonstration's excursion",
                    abs(bary["late_speed"]) < 0.1 and bary["excursion"] < 0.3,
                )
            )
    fmp, endpoint = found.get(("fixed", "fmp")), found.get(("fixed", "endpoint"))
    if fmp and endpoint:
        result.append(
            Verdict(
                "Path supervision makes for fewer falls and more speed from the default pose",
                f"{fmp['falls']:.1f} % and {_pace(fmp)} against {endpoint['falls']:.1f} % and "
                f"{_pace(endpoint)} (Endpoint)",
                fmp["falls"] < endpoint["falls"]
                and not math.isnan(fmp["late_speed"])
                and not endpoint["late_speed"] >= fmp["late_speed"],
            )
        )
    return result
